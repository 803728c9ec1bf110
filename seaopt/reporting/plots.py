"""The attribute `plot` of results: all figures of a result when called, each by itself by name.

A single figure takes `ax` and returns the Axes it is drawn on; what needs several axes takes a sequence of them and
returns the Figure. Nothing is registered with pyplot: a figure that is not used any more is gone.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

from seaopt.control import Controller, Frontier, Impedance, ImpedanceRegion
from seaopt.errors import ControlError, LogError, SeaoptError, suggestion
from seaopt.estimation import Diagnostics, Experiment, Fit, ModelledOutputs, Ranking, diagnose
from seaopt.logs import Log
from seaopt.reporting.comparison import experiment_survey, fit_surveys, response_panels
from seaopt.reporting.figures import certificate as certificates
from seaopt.reporting.figures import fit as fits
from seaopt.reporting.figures import log as logs
from seaopt.reporting.figures import loop as loops
from seaopt.reporting.figures import simulation as simulations
from seaopt.reporting.figures.frontier import frontier_panel, frontier_panels
from seaopt.reporting.figures.impedance import region_panel
from seaopt.reporting.figures.panel import Panel, compose_sheet, draw_panel
from seaopt.reporting.figures.ranking import evidence_panel, octave_panels
from seaopt.robustness import Certificate
from seaopt.robustness.verification.environments import StabilityMap
from seaopt.robustness.verification.large_signal import LargeSignal
from seaopt.robustness.verification.verification import Verification

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from seaopt.reporting.figures.canvas import PlainFigure

Place = Any  # Axes, a sequence of Axes, or None
Make = Callable[[], Panel | Iterable[Panel]]


class Plots:
    """Figures of one result: call it for a sheet of the main ones, or one of its methods for a figure by itself."""

    def __call__(self, *, columns: int = 2) -> PlainFigure:
        """Draw the main figures on one sheet.

        Parameters
        ----------
        columns : int
            Of the sheet.

        Returns
        -------
        matplotlib.figure.Figure
            ``savefig`` writes it as SVG, PDF or PNG, with text as text.

        Raises
        ------
        SeaoptError
            The result has not what a figure needs.

        """
        panels = self.panels()
        if not panels:
            raise SeaoptError(f"there is nothing to draw: {self._explain()}")
        return compose_sheet(panels, columns)

    def panels(self) -> list[Panel]:
        """Return the main figures that the result allows."""
        panels: list[Panel] = []
        for make in self._main():
            with suppress(SeaoptError):
                made = make()
                panels += [made] if isinstance(made, Panel) else made
        return panels

    def _main(self) -> Iterable[Make]:
        """Return what makes the panels of the sheet."""
        raise NotImplementedError

    def _explain(self) -> str:
        """Return why there may be nothing to draw."""
        return "the result is empty"

    def to_html(self) -> str:
        """Return the sheet for a notebook; nothing where nothing can be drawn."""
        panels = self.panels()
        return compose_sheet(panels)._repr_html_() if panels else ""

    def __dir__(self) -> list[str]:
        """List the figures by name."""
        return sorted(name for name in vars(type(self)) if not name.startswith("_"))

    def __repr__(self) -> str:
        return f"{type(self).__name__}: call it, or one of {', '.join(dir(self))}"


def _draw(panels: Panel | Sequence[Panel], ax: Place) -> Any:
    """Draw one panel, where it is told to; several on a sheet."""
    if isinstance(panels, Panel):
        return draw_panel(panels, ax)
    if len(panels) == 1:
        return draw_panel(panels[0], ax)
    if ax is not None:
        names = ", ".join(panel.name for panel in panels)
        raise SeaoptError(f"ax is for one figure, and these are {len(panels)} ({names}); name one of them")
    return compose_sheet(panels)


class FitPlots(Plots):
    """Figures of a fit.

    Those of experiments need their logs: a fit that was read from a file has none, unless `Fit.from_dict` was given the
    experiments.

    Examples
    --------
    >>> import seaopt as so
    >>> from seaopt.bench import PAPER_STAND
    >>> stand, thor, noise = so.plants.high_impedance(), so.plants.thor(), so.Sensors(noise_std={"F1": 2.0})
    >>> log = so.virtual_log(stand, thor, PAPER_STAND, duration_s=10, rate_hz=400, seed=1, sensors=noise)
    >>> fit = so.fit([so.Experiment(plant=stand, log=log, outputs=("F1",))], thor.free("J", "b_r"))
    >>> dir(fit.plot)
    ['autocorrelation', 'correlation', 'inputs', 'outputs', 'parameters', 'residuals', 'response', 'spectrum']
    >>> fit.plot.residuals().get_ylabel()
    'F1 [N]'

    """

    def __init__(self, fit: Fit) -> None:
        self._fit = fit

    def _main(self) -> Iterable[Make]:
        for experiment in self._fit.experiments:
            prediction = self._fit.predict(experiment)
            yield lambda one=prediction: fits.outputs_panel(one)
            yield lambda one=prediction: fits.residuals_panel(one)
            yield lambda one=experiment: self._responses(one, None)[:1]
            yield lambda one=prediction: fits.spectrum_panel(one)
        yield lambda: fits.parameters_panel(self._fit)
        yield lambda: fits.correlation_panel(self._fit)

    def _explain(self) -> str:
        return "no parameter was free, and the fit has no logs"

    def _predict(self, experiment: str | None, output: str | None) -> list[ModelledOutputs]:
        chosen = fits.choose_experiments(self._fit, experiment)
        return [_select(self._fit.predict(one), output) for one in chosen]

    def outputs(
        self,
        experiment: str | None = None,
        output: str | None = None,
        *,
        span_s: tuple[float, float] | None = None,
        ax: Place = None,
    ) -> Axes | PlainFigure:
        """Draw measured and model outputs.

        Parameters
        ----------
        experiment, output : str, optional
            All if left out.
        span_s : (float, float), optional
            From when to when, seconds after the first sample; the second with the largest motion if left out.
        ax : Axes, or a sequence of them, optional
            To draw on, one per output.

        """
        return _draw([fits.outputs_panel(one, span_s) for one in self._predict(experiment, output)], ax)

    def residuals(
        self, experiment: str | None = None, output: str | None = None, *, ax: Place = None
    ) -> Axes | PlainFigure:
        """Draw measured minus model over the whole log."""
        return _draw([fits.residuals_panel(one) for one in self._predict(experiment, output)], ax)

    def spectrum(
        self, experiment: str | None = None, output: str | None = None, *, ax: Place = None
    ) -> Axes | PlainFigure:
        """Draw the spectral density of what was measured and of the residual."""
        return _draw([fits.spectrum_panel(one) for one in self._predict(experiment, output)], ax)

    def response(self, experiment: str | None = None, pair: str | None = None, *, ax: Place = None) -> PlainFigure:
        """Draw measured frequency responses (H1) and the fitted model: magnitude, phase and coherence.

        Parameters
        ----------
        experiment, pair : str, optional
            The pair by its name, such as F1/I; all if left out.
        ax : sequence of three Axes, optional
            To draw on.

        """
        chosen = fits.choose_experiments(self._fit, experiment)
        panels = [panel for one in chosen for panel in self._responses(one, pair)]
        if not panels:
            raise LogError(f"no frequency response of {pair or 'the logs'} can be estimated; look at fit.experiments")
        return _draw(panels, ax)

    def _responses(self, experiment: Experiment, pair: str | None) -> list[Panel]:
        survey = experiment_survey(experiment, self._fit)
        return response_panels(experiment, survey, {"model, fitted": self._fit}, pair=pair)

    def parameters(self, *, ax: Axes | None = None) -> Axes:
        """Draw the 95 % interval of each free parameter in percent of its value, and what was known before."""
        return _draw(fits.parameters_panel(self._fit), ax)

    def correlation(self, *, ax: Axes | None = None) -> Axes:
        """Draw the correlation of the free parameters' errors."""
        return _draw(fits.correlation_panel(self._fit), ax)

    @cached_property
    def _diagnostics(self) -> Diagnostics:
        return diagnose(self._fit)

    def autocorrelation(self, experiment: str | None = None, *, ax: Place = None) -> Axes | PlainFigure:
        """Draw the correlation of each output's weighted residual with itself."""
        return DiagnosticsPlots(self._diagnostics).autocorrelation(experiment, ax=ax)

    def inputs(self, experiment: str | None = None, *, ax: Place = None) -> Axes | PlainFigure:
        """Draw the correlation of each output's weighted residual with each input."""
        return DiagnosticsPlots(self._diagnostics).inputs(experiment, ax=ax)


def _select(prediction: ModelledOutputs, output: str | None) -> ModelledOutputs:
    """Return a prediction of one output alone."""
    if output is None:
        return prediction
    if output not in prediction.measured:
        raise SeaoptError(f'output = "{output}" was not measured; {suggestion(output, prediction.measured)}')
    return replace(prediction, measured={output: prediction.measured[output]}, model={output: prediction.model[output]})


class DiagnosticsPlots(Plots):
    """Figures of diagnostics."""

    def __init__(self, diagnostics: Diagnostics) -> None:
        self._diagnostics = diagnostics

    def _main(self) -> Iterable[Make]:
        for name in self._diagnostics.outputs:
            yield lambda one=name: fits.autocorrelation_panel(self._diagnostics, one)
            yield lambda one=name: fits.input_correlation_panel(self._diagnostics, one)

    def _choose(self, experiment: str | None) -> list[str]:
        known = list(self._diagnostics.outputs)
        if experiment is not None and experiment not in known:
            raise SeaoptError(f'experiment = "{experiment}" is none of the fit\'s; {suggestion(experiment, known)}')
        return [name for name in known if experiment in (None, name)]

    def autocorrelation(self, experiment: str | None = None, *, ax: Place = None) -> Axes | PlainFigure:
        """Draw the correlation of each output's weighted residual with itself."""
        return _draw([fits.autocorrelation_panel(self._diagnostics, name) for name in self._choose(experiment)], ax)

    def inputs(self, experiment: str | None = None, *, ax: Place = None) -> Axes | PlainFigure:
        """Draw the correlation of each output's weighted residual with each input."""
        return _draw([fits.input_correlation_panel(self._diagnostics, name) for name in self._choose(experiment)], ax)


class PredictionPlots(Plots):
    """Figures of measured and model outputs of one log."""

    def __init__(self, prediction: ModelledOutputs) -> None:
        self._prediction = prediction

    def _main(self) -> Iterable[Make]:
        yield lambda: fits.outputs_panel(self._prediction)
        yield lambda: fits.residuals_panel(self._prediction)
        yield lambda: fits.spectrum_panel(self._prediction)

    def outputs(
        self, output: str | None = None, *, span_s: tuple[float, float] | None = None, ax: Place = None
    ) -> Axes | PlainFigure:
        """Draw measured and model outputs; over the second with the largest motion if `span_s` is left out."""
        return _draw(fits.outputs_panel(_select(self._prediction, output), span_s), ax)

    def residuals(self, output: str | None = None, *, ax: Place = None) -> Axes | PlainFigure:
        """Draw measured minus model over the whole log."""
        return _draw(fits.residuals_panel(_select(self._prediction, output)), ax)

    def spectrum(self, output: str | None = None, *, ax: Place = None) -> Axes | PlainFigure:
        """Draw the spectral density of what was measured and of the residual."""
        return _draw(fits.spectrum_panel(_select(self._prediction, output)), ax)


class LogPlots(Plots):
    """Figures of a log: its clock, what its inputs excite, each channel in time and in frequency, faults marked."""

    def __init__(self, log: Log) -> None:
        self._log = log

    def _main(self) -> Iterable[Make]:
        yield lambda: logs.log_panels(self._log, self._quality)

    @cached_property
    def _quality(self) -> Any:
        return self._log.quality

    def _choose(self, channel: str | None) -> list[str]:
        known = list(self._quality.channels)
        if channel is not None and channel not in known:
            raise LogError(f'channel = "{channel}" is not in {self._log.source}; {suggestion(channel, known)}')
        return [name for name in known if channel in (None, name)]

    def clock(self, *, ax: Axes | None = None) -> Axes:
        """Draw the steps of time between samples."""
        return _draw(logs.clock_panel(self._log, self._quality), ax)

    def excitation(self, *, ax: Axes | None = None) -> Axes:
        """Draw the coherence of the best output with each input, band by band."""
        return _draw(logs.excitation_panel(self._quality), ax)

    def channels(self, channel: str | None = None, *, ax: Axes | None = None) -> Axes | PlainFigure:
        """Draw a channel over time, all of them on a sheet if left out."""
        return _draw([logs.channel_panel(self._log, self._quality, name) for name in self._choose(channel)], ax)

    def spectrum(self, channel: str | None = None, *, ax: Axes | None = None) -> Axes | PlainFigure:
        """Draw the spectral density of a channel, of all of them on a sheet if left out."""
        return _draw([logs.density_panel(self._quality, name) for name in self._choose(channel)], ax)


class ControllerPlots(Plots):
    """Figures of a controller, on its design plant or on `plants`, a mapping of name to (plant, parameters).

    Examples
    --------
    >>> import seaopt as so
    >>> stand, thor = so.plants.high_impedance(), so.plants.thor()
    >>> controller = so.tune(stand, thor, so.ControllerSpec(bandwidth_hz=30))
    >>> axis = controller.plot.sensitivity(plants={"stand": (stand, thor), "swing": (so.plants.moving_output(), thor)})
    >>> axis.get_ylabel(), [line.get_label() for line in axis.lines][:2]
    ('|S| [dB]', ['stand', 'swing'])

    """

    def __init__(self, controller: Controller) -> None:
        self._controller = controller

    def _main(self) -> Iterable[Make]:
        for name in ("step", "bode", "sensitivity", "tracking", "nyquist", "noise"):
            yield lambda panel=loops.LOOP_PANELS[name]: panel(self._controller, None)

    def _explain(self) -> str:
        return "the controller does not know its design plant; read it with Controller.from_dict"

    def step(
        self,
        *,
        plants: loops.Plants | None = None,
        size: float = 1.0,
        duration_s: float | None = None,
        ax: Place = None,
    ) -> PlainFigure:
        """Draw what is measured, and what is commanded, after a step of the reference.

        Parameters
        ----------
        plants : mapping of name to (Plant, ParameterSet), optional
            The design plant if left out.
        size : float
            Of the step, in the reference's unit.
        duration_s : float, optional
            Until it has settled if left out.
        ax : sequence of two Axes, optional
            To draw on.

        """
        return _draw(loops.step_panel(self._controller, plants, size=size, duration_s=duration_s), ax)

    def bode(self, *, plants: loops.Plants | None = None, ax: Place = None) -> PlainFigure:
        """Draw magnitude and phase of the open loop; `ax` is a sequence of two Axes."""
        return _draw(loops.bode_panel(self._controller, plants), ax)

    def nyquist(self, *, plants: loops.Plants | None = None, ax: Axes | None = None) -> Axes:
        """Draw the open loop in the complex plane, with the disk that it must not enter."""
        return _draw(loops.nyquist_panel(self._controller, plants), ax)

    def sensitivity(self, *, plants: loops.Plants | None = None, ax: Axes | None = None) -> Axes:
        """Draw abs(S), with its limits."""
        return _draw(loops.sensitivity_panel(self._controller, plants), ax)

    def complementary(self, *, plants: loops.Plants | None = None, ax: Axes | None = None) -> Axes:
        """Draw abs(T), with its limit."""
        return _draw(loops.complementary_panel(self._controller, plants), ax)

    def tracking(self, *, plants: loops.Plants | None = None, ax: Axes | None = None) -> Axes:
        """Draw what is measured over its reference, with the bandwidth that was asked for."""
        return _draw(loops.tracking_panel(self._controller, plants), ax)

    def noise(self, *, plants: loops.Plants | None = None, ax: Axes | None = None) -> Axes:
        """Draw the effort per noise on what is measured, with its limit."""
        return _draw(loops.noise_panel(self._controller, plants), ax)

    def impedance(self, *, ax: Place = None) -> PlainFigure:
        """Draw the impedance at link 2 of the design plant, where it has a port; `ax` is a sequence of two Axes."""
        return _draw(certificates.impedance_panel(self._controller), ax)


class CertificatePlots(Plots):
    """Figures of a certificate; those of simulations need `with_simulation`."""

    def __init__(self, certificate: Certificate) -> None:
        self._certificate = certificate

    def _main(self) -> Iterable[Make]:
        certificate = self._certificate
        yield lambda: certificates.requirements_panel(certificate)
        yield lambda: certificates.worst_panel(certificate)
        yield lambda: certificates.draws_panel(certificate)
        yield lambda: loops.step_panel(certificate.controller, certificates.plants_of(certificate))
        yield lambda: certificates.friction_panel(certificate)
        yield lambda: simulations.bandwidth_panel(self._sweeps())

    def _sweeps(self) -> tuple[LargeSignal, ...]:
        simulated = self._certificate.simulated
        sweeps = () if simulated is None else simulated.large_signal
        if not sweeps:
            raise ControlError(
                "this certificate has no large signals: call with_simulation(); they need a limit of the command, or "
                "friction"
            )
        return sweeps

    def requirements(self, *, ax: Axes | None = None) -> Axes:
        """Draw how much of its limit each kind of requirement uses."""
        return _draw(certificates.requirements_panel(self._certificate), ax)

    def sensitivity(self, *, ax: Axes | None = None) -> Axes:
        """Draw abs(S) of every plant, nominal and at the worst parameters found."""
        return _draw(certificates.worst_panel(self._certificate), ax)

    def draws(self, *, ax: Axes | None = None) -> Axes:
        """Draw which share of the draws has at most a given Ms."""
        return _draw(certificates.draws_panel(self._certificate), ax)

    def step(self, *, size: float = 1.0, duration_s: float | None = None, ax: Place = None) -> PlainFigure:
        """Draw the step response of every plant, linear; `ax` is a sequence of two Axes."""
        certificate = self._certificate
        panel = loops.step_panel(
            certificate.controller, certificates.plants_of(certificate), size=size, duration_s=duration_s
        )
        return _draw(panel, ax)

    def friction(self, *, ax: Axes | None = None) -> Axes:
        """Draw how much steeper than its own each plant's friction may be for stability to be shown."""
        return _draw(certificates.friction_panel(self._certificate), ax)

    def bandwidth(self, *, ax: Axes | None = None) -> Axes:
        """Draw bandwidth against amplitude, simulated and predicted."""
        return _draw(simulations.bandwidth_panel(self._sweeps()), ax)

    def amplitude(self, plant: str | None = None, *, ax: Axes | None = None) -> Axes | PlainFigure:
        """Draw the gain against frequency at several amplitudes."""
        return _draw([simulations.amplitude_panel(one) for one in self._sweeps() if plant in (None, one.plant)], ax)

    def simulations(self, plant: str | None = None, scenario: str | None = None, *, ax: Place = None) -> PlainFigure:
        """Draw the worst run of each scenario, simulated again; of one plant, or one scenario, if named."""
        if self._certificate.runs is None:
            raise ControlError("nothing was simulated for this certificate; call with_simulation()")
        return VerificationPlots(self._certificate.runs).runs(plant, scenario, ax=ax)

    def environments(self, *, ax: Axes | None = None) -> Axes | PlainFigure:
        """Draw where the loop is stable against a mass on a spring and a damper, a figure per damper."""
        simulated = self._certificate.simulated
        if simulated is None or simulated.environments is None:
            reason = "call with_simulation()" if simulated is None else simulated.left_out.get("environments", "")
            raise ControlError(f"this certificate has no environments: {reason}")
        return _draw(simulations.environment_panels(simulated.environments), ax)

    def impedance(self, *, ax: Place = None) -> PlainFigure:
        """Draw the impedance at link 2 of the design plant; `ax` is a sequence of two Axes."""
        return _draw(certificates.impedance_panel(self._certificate.controller), ax)


class VerificationPlots(Plots):
    """Figures of simulated runs."""

    def __init__(self, verification: Verification) -> None:
        self._verification = verification

    def _main(self) -> Iterable[Make]:
        yield lambda: self._choose(None, None)

    def _choose(self, plant: str | None, scenario: str | None) -> list[Panel]:
        rows = [row for row in self._verification.worst() if plant in (None, row.plant)]
        rows = [row for row in rows if scenario in (None, row.scenario)]
        if not rows:
            played = ", ".join(f"{row.scenario} on {row.plant}" for row in self._verification.worst())
            raise ControlError(
                f"{scenario or 'no scenario'} on {plant or 'any plant'} was not played; these were: {played}"
            )
        return [simulations.simulation_panel(self._verification, row) for row in rows]

    def runs(self, plant: str | None = None, scenario: str | None = None, *, ax: Place = None) -> PlainFigure:
        """Draw the worst run of each scenario, simulated again; `ax` of one of them is a sequence of two Axes."""
        return _draw(self._choose(plant, scenario), ax)


class LargeSignalPlots(Plots):
    """Figures of a sweep over amplitudes."""

    def __init__(self, sweep: LargeSignal) -> None:
        self._sweep = sweep

    def _main(self) -> Iterable[Make]:
        yield lambda: simulations.bandwidth_panel([self._sweep])
        yield lambda: simulations.amplitude_panel(self._sweep)
        yield lambda: simulations.saturation_panel(self._sweep)

    def bandwidth(self, *, ax: Axes | None = None) -> Axes:
        """Draw bandwidth against amplitude."""
        return _draw(simulations.bandwidth_panel([self._sweep]), ax)

    def amplitude(self, *, ax: Axes | None = None) -> Axes:
        """Draw the gain against frequency at each amplitude."""
        return _draw(simulations.amplitude_panel(self._sweep), ax)

    def saturation(self, *, ax: Axes | None = None) -> Axes:
        """Draw the amplitude at which the command of the linear loop saturates."""
        return _draw(simulations.saturation_panel(self._sweep), ax)


class StabilityPlots(Plots):
    """Figures of stability against environments."""

    def __init__(self, stability: StabilityMap) -> None:
        self._stability = stability

    def _main(self) -> Iterable[Make]:
        yield lambda: simulations.environment_panels(self._stability)

    def environments(self, *, ax: Axes | None = None) -> Axes | PlainFigure:
        """Draw where the loop is stable, a figure per damper."""
        return _draw(simulations.environment_panels(self._stability), ax)


class ImpedancePlots(Plots):
    """Figures of what may be rendered at the link."""

    def __init__(self, region: ImpedanceRegion) -> None:
        self._region = region

    def _main(self) -> Iterable[Make]:
        yield lambda: region_panel(self._region)

    def region(self, asked: Impedance | None = None, *, ax: Axes | None = None) -> Axes:
        """Draw where stiffness and damping are passive, and what is asked for."""
        return _draw(region_panel(self._region, asked), ax)


class FrontierPlots(Plots):
    """Figures of a sweep of bandwidths."""

    def __init__(self, frontier: Frontier) -> None:
        self._frontier = frontier

    def _main(self) -> Iterable[Make]:
        yield lambda: frontier_panels(self._frontier)

    def noise_gain(self, *, ax: Axes | None = None) -> Axes:
        """Draw the noise gain against bandwidth."""
        return _draw(frontier_panel(self._frontier, "noise_gain"), ax)

    def ms(self, *, ax: Axes | None = None) -> Axes:
        """Draw the largest Ms of all plants against bandwidth."""
        return _draw(frontier_panel(self._frontier, "ms"), ax)

    def disturbance(self, *, ax: Axes | None = None) -> Axes:
        """Draw what is left of disturbances against bandwidth."""
        return _draw(frontier_panel(self._frontier, "disturbance"), ax)

    def phase_margin(self, *, ax: Axes | None = None) -> Axes:
        """Draw the phase margin against bandwidth."""
        return _draw(frontier_panel(self._frontier, "phase_margin_deg"), ax)

    def disk_margin(self, *, ax: Axes | None = None) -> Axes:
        """Draw the disk margin against bandwidth."""
        return _draw(frontier_panel(self._frontier, "disk_margin"), ax)

    def force_limit(self, *, ax: Axes | None = None) -> Axes:
        """Draw the largest reference at the bandwidth that the command's limit allows."""
        return _draw(frontier_panel(self._frontier, "force_limit_N"), ax)


class RankingPlots(Plots):
    """Figures of fits that are compared."""

    def __init__(self, ranking: Ranking) -> None:
        self._ranking = ranking

    def _main(self) -> Iterable[Make]:
        yield lambda: evidence_panel(self._ranking)
        yield lambda: octave_panels(self._ranking)

    def evidence(self, *, ax: Axes | None = None) -> Axes:
        """Draw how far each fit's effective BIC lies above the best one's."""
        return _draw(evidence_panel(self._ranking), ax)

    def octaves(self, *, ax: Axes | None = None) -> Axes | PlainFigure:
        """Draw the residual of every fit per octave, a figure per output."""
        return _draw(octave_panels(self._ranking), ax)

    def response(self, experiment: str | None = None, pair: str | None = None, *, ax: Place = None) -> PlainFigure:
        """Draw measured frequency responses and the model of every fit; `ax` is a sequence of three Axes."""
        rows = [self._ranking.fits[row.name] for row in self._ranking.rows]
        models = {row.name: fit for row, fit in zip(self._ranking.rows, rows, strict=True)}
        chosen = fits.choose_experiments(rows[0], experiment)
        surveys = fit_surveys(rows[0])
        panels = [
            panel
            for one in chosen
            if one.name in surveys
            for panel in response_panels(one, surveys[one.name], models, pair=pair)
        ]
        if not panels:
            raise LogError(f"no frequency response of {pair or 'the logs'} can be estimated; look at fit.experiments")
        return _draw(panels, ax)
