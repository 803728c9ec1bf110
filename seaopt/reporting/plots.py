"""The attribute `plot` of results: all figures of a result when called, each by itself by name.

`KINDS` lists the figures of each kind of result: functions of the result and options that return a panel or several.
A single figure takes `ax` and returns the Axes it is drawn on; what needs several axes takes a sequence of them and
returns the Figure. Nothing is registered with pyplot: a figure that is not used any more is gone.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial, wraps
from inspect import Parameter, signature
from typing import TYPE_CHECKING, Any

from seaopt.control import Frontier
from seaopt.errors import ControlError, EstimationError, LogError, SeaoptError, UnknownAttributeError, suggestion
from seaopt.estimation import Diagnostics, Experiment, Fit, ModelledOutputs, Ranking, diagnose
from seaopt.logs import Log
from seaopt.records import record
from seaopt.reporting.comparison import experiment_survey, fit_surveys, response_panels
from seaopt.reporting.figures import certificate as certificates
from seaopt.reporting.figures import fit as fits
from seaopt.reporting.figures import log as logs
from seaopt.reporting.figures import loop as loops
from seaopt.reporting.figures import simulation as simulations
from seaopt.reporting.figures.frontier import FIGURES as FRONTIER_FIGURES
from seaopt.reporting.figures.frontier import frontier_panel
from seaopt.reporting.figures.impedance import region_panel
from seaopt.reporting.figures.panel import Panel, compose_sheet, draw_panel
from seaopt.reporting.figures.ranking import evidence_panel, octave_panels
from seaopt.reporting.figures.schedule import schedule_panels
from seaopt.robustness import Certificate
from seaopt.robustness.verification.large_signal import LargeSignal
from seaopt.robustness.verification.verification import Verification

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from seaopt.reporting.figures.canvas import PlainFigure

Panels = Panel | Sequence[Panel]
Make = Callable[..., Panels]


@record
class Kind:
    """The figures of a kind of result by name, those on its sheet, and why there may be none."""

    figures: Mapping[str, Make]
    sheet: Sequence[str] | Callable[[Any], Iterable[Callable[[], Panels]]] = ()  # all figures, if left out
    missing: str = "the result is empty"


class Plots:
    """Figures of one result: call it for a sheet of the main ones, or one of its methods for a figure by itself."""

    def __init__(self, result: object) -> None:
        self._result = result
        self._kind = KINDS[type(result).__name__]

    def __call__(self, *, columns: int = 2) -> PlainFigure:
        """Return the main figures on one sheet of so many columns; `savefig` writes it as SVG, PDF or PNG, with text as
        text. Raises SeaoptError: the result lacks what a figure needs.
        """
        panels = self._list_panels()
        if not panels:
            raise SeaoptError(f"there is nothing to draw: {self._kind.missing}")
        return compose_sheet(panels, columns)

    def _list_panels(self) -> list[Panel]:
        sheet, figures = self._kind.sheet, self._kind.figures
        makers = (
            sheet(self._result) if callable(sheet) else [partial(figures[n], self._result) for n in sheet or figures]
        )
        panels: list[Panel] = []
        for make in makers:
            with suppress(SeaoptError):
                panels += _as_list(make())
        return panels

    def to_html(self) -> str:
        """Return the sheet for a notebook; nothing where nothing can be drawn."""
        panels = self._list_panels()
        return compose_sheet(panels)._repr_html_() if panels else ""

    def __getattr__(self, name: str) -> Callable[..., Axes | PlainFigure]:
        if name.startswith("_"):  # before `_kind` is there, too
            raise AttributeError(name)
        make = self._kind.figures.get(name)
        if make is None:
            raise UnknownAttributeError(f"plot has no figure {name}; {suggestion(name, self._kind.figures)}")

        @wraps(make)
        def draw(*args: Any, ax: Any = None, **options: Any) -> Any:
            return _draw(_as_list(make(self._result, *args, **options)), ax)

        form = signature(make)
        ax = Parameter("ax", Parameter.KEYWORD_ONLY, default=None)
        parameters = sorted([*list(form.parameters.values())[1:], ax], key=lambda each: each.kind)
        vars(draw)["__signature__"] = form.replace(parameters=parameters)
        return draw

    def __dir__(self) -> list[str]:
        """List the figures by name."""
        return sorted(self._kind.figures)

    def __repr__(self) -> str:
        return f"plot of {type(self._result).__name__}: call it, or one of {', '.join(dir(self))}"


def _as_list(panels: Panels) -> list[Panel]:
    return [panels] if isinstance(panels, Panel) else list(panels)


def _draw(panels: list[Panel], ax: Any) -> Any:
    """Draw one panel, on given axes or its own; several on a sheet."""
    if len(panels) == 1:
        return draw_panel(panels[0], ax)
    if ax is not None:
        names = ", ".join(panel.name for panel in panels)
        raise SeaoptError(f"ax is for one figure, and these are {len(panels)} ({names}); name one of them")
    return compose_sheet(panels)


def _choose(name: str | None, names: Iterable[str], argument: str, where: str) -> list[str]:
    """Return the one that an argument names, or all."""
    names = list(names)
    if name is None or name in names:
        return [each for each in names if name in (None, each)]
    raise SeaoptError(f'{argument} = "{name}" is not in {where}; {suggestion(name, names)}')


def _choose_experiments(fit: Fit, experiment: str | None) -> list[Experiment]:
    if not fit.experiments:
        raise EstimationError("this fit was read from a file without its logs; Fit.from_dict(content, experiments)")
    by_name = {each.name: each for each in fit.experiments}
    return [by_name[name] for name in _choose(experiment, by_name, "experiment", "the fit")]


def _draw_prediction(panel: Callable[..., Panel]) -> Callable[..., Panel]:
    """Return what draws a panel of a prediction, of all outputs or one."""

    def make(prediction: ModelledOutputs, output: str | None = None, **options: Any) -> Panel:
        names = _choose(output, prediction.measured, "output", "the log")
        chosen = {field: {name: getattr(prediction, field)[name] for name in names} for field in ("measured", "model")}
        return panel(replace(prediction, **chosen), **options)

    make.__doc__ = panel.__doc__
    return make


def _draw_predictions(panel: Callable[..., Panel]) -> Make:
    """Return what draws a panel of each of a fit's predictions, or of one experiment."""
    draw = _draw_prediction(panel)

    def make(fit: Fit, experiment: str | None = None, output: str | None = None, **options: Any) -> list[Panel]:
        return [draw(fit.predict(each), output, **options) for each in _choose_experiments(fit, experiment)]

    make.__doc__ = panel.__doc__
    return make


def _draw_diagnostics(panel: Callable[[Diagnostics, str], Panel]) -> Make:
    """Return what draws a panel of each experiment's diagnostics, or of one."""

    def make(result: Diagnostics | Fit, experiment: str | None = None) -> list[Panel]:
        diagnostics = diagnose(result) if isinstance(result, Fit) else result
        names = _choose(experiment, diagnostics.outputs, "experiment", "the fit")
        return [panel(diagnostics, name) for name in names]

    make.__doc__ = panel.__doc__
    return make


def _draw_responses(fit: Fit, experiment: str | None = None, pair: str | None = None) -> list[Panel]:
    """Draw H1 and the fitted model: magnitude, phase, coherence; `pair` such as F1/I. `ax`: three Axes, of one pair."""
    experiments = _choose_experiments(fit, experiment)
    surveys = {each.name: experiment_survey(each, fit) for each in experiments}
    return _list_responses(experiments, surveys, {"model, fitted": fit}, pair)


def _compare_responses(ranking: Ranking, experiment: str | None = None, pair: str | None = None) -> list[Panel]:
    """Draw measured frequency responses and the model of every fit; `ax` is a sequence of three Axes."""
    models = {row.name: ranking.fits[row.name] for row in ranking.rows}
    best = next(iter(models.values()))
    return _list_responses(_choose_experiments(best, experiment), fit_surveys(best), models, pair)


def _list_responses(
    experiments: Iterable[Experiment], surveys: Mapping[str, Any], models: Mapping[str, Fit], pair: str | None
) -> list[Panel]:
    panels = [
        panel
        for each in experiments
        if each.name in surveys
        for panel in response_panels(each, surveys[each.name], models, pair=pair)
    ]
    if not panels:
        raise LogError(f"no frequency response of {pair or 'the logs'} can be estimated; look at fit.experiments")
    return panels


def _list_fit(fit: Fit) -> Iterator[Callable[[], Panels]]:
    for experiment in fit.experiments:
        prediction = fit.predict(experiment)
        yield partial(fits.outputs_panel, prediction)
        yield partial(fits.residuals_panel, prediction)
        yield lambda name=experiment.name: _draw_responses(fit, name)[:1]
        yield partial(fits.spectrum_panel, prediction)
    yield partial(fits.parameters_panel, fit)
    yield partial(fits.correlation_panel, fit)


def _list_diagnostics(diagnostics: Diagnostics) -> Iterator[Callable[[], Panels]]:
    for name in diagnostics.outputs:
        yield partial(fits.autocorrelation_panel, diagnostics, name)
        yield partial(fits.input_correlation_panel, diagnostics, name)


def _draw_channels(log: Log, channel: str | None = None) -> list[Panel]:
    """Draw a channel over time with its faults, all of them on a sheet if left out."""
    quality = log.quality
    names = _choose(channel, quality.channels, "channel", log.source)
    return [logs.channel_panel(log, quality, name) for name in names]


def _draw_densities(log: Log, channel: str | None = None) -> list[Panel]:
    """Draw the spectral density of a channel, of all of them on a sheet if left out."""
    quality = log.quality
    return [logs.density_panel(quality, name) for name in _choose(channel, quality.channels, "channel", log.source)]


def _list_sweeps(certificate: Certificate) -> tuple[LargeSignal, ...]:
    sweeps = () if certificate.simulated is None else certificate.simulated.large_signal
    if not sweeps:
        raise ControlError(
            "this certificate has no large signals: call with_simulation(); they need a limit of the command, or "
            "friction"
        )
    return sweeps


def _draw_one_place(name: str, make: Make) -> Make:
    """Return what draws a figure of one law, and says of a schedule where each of its laws has it."""

    @wraps(make)
    def draw(certificate: Certificate, *args: Any, **options: Any) -> Panels:
        if certificate.schedule is not None:
            raise ControlError(
                f"{name} of a schedule is drawn at each of its places: certificate.places[0].plot.{name}()"
            )
        return make(certificate, *args, **options)

    return draw


def _list_certificate(certificate: Certificate) -> Iterator[Callable[[], Panels]]:
    if certificate.schedule is not None:
        yield partial(schedule_panels, certificate.schedule, certificate)
        yield partial(certificates.requirements_panel, certificate)
        return
    for panel in (certificates.requirements_panel, certificates.worst_panel, certificates.draws_panel, _draw_steps):
        yield partial(panel, certificate)
    yield partial(certificates.friction_panel, certificate)
    yield partial(_draw_bandwidths, certificate)


def _draw_steps(certificate: Certificate, *, size: float = 1.0, duration_s: float | None = None) -> Panel:
    """Draw the step response of every plant, linear; `ax` is a sequence of two Axes."""
    plants = certificates.plants_of(certificate)
    return loops.step_panel(certificate.controller, plants, size=size, duration_s=duration_s)


def _draw_amplitudes(certificate: Certificate, plant: str | None = None) -> list[Panel]:
    """Draw the gain against frequency at several amplitudes."""
    return [simulations.amplitude_panel(sweep) for sweep in _list_sweeps(certificate) if plant in (None, sweep.plant)]


def _draw_bandwidths(certificate: Certificate) -> Panel:
    """Draw bandwidth against amplitude, simulated and predicted."""
    return simulations.bandwidth_panel(_list_sweeps(certificate))


def _draw_simulations(certificate: Certificate, plant: str | None = None, scenario: str | None = None) -> list[Panel]:
    """Draw the worst run of each scenario, simulated again; of one plant, or one scenario, if named."""
    if certificate.runs is None:
        raise ControlError("nothing was simulated for this certificate; call with_simulation()")
    return _draw_runs(certificate.runs, plant, scenario)


def _draw_environments(certificate: Certificate) -> list[Panel]:
    """Draw where the loop is stable against a mass on a spring and a damper, a figure per damper."""
    simulated = certificate.simulated
    if simulated is None or simulated.environments is None:
        reason = "call with_simulation()" if simulated is None else simulated.left_out.get("environments", "")
        raise ControlError(f"this certificate has no environments: {reason}")
    return simulations.environment_panels(simulated.environments)


def _draw_impedance(certificate: Certificate) -> Panel:
    """Draw the impedance at link 2 of the design plant; `ax` is a sequence of two Axes."""
    return certificates.impedance_panel(certificate.controller)


def _draw_runs(verification: Verification, plant: str | None = None, scenario: str | None = None) -> list[Panel]:
    """Draw the worst run of each scenario, simulated again; `ax` of one of them is a sequence of two Axes."""
    worst = verification.worst()
    rows = [row for row in worst if plant in (None, row.plant) and scenario in (None, row.scenario)]
    if not rows:
        played = ", ".join(f"{row.scenario} on {row.plant}" for row in worst)
        raise ControlError(f"{scenario or 'no scenario'} on {plant or 'any plant'} was not played, only: {played}")
    return [simulations.simulation_panel(verification, row) for row in rows]


def _draw_figure(figure: str) -> Make:
    """Return what draws a figure of a sweep against bandwidth."""

    def make(frontier: Frontier) -> Panel:
        return frontier_panel(frontier, figure)

    make.__doc__ = f"Draw {FRONTIER_FIGURES[figure][0].lower()} against bandwidth."
    return make


_PREDICTION = {"outputs": fits.outputs_panel, "residuals": fits.residuals_panel, "spectrum": fits.spectrum_panel}
_DIAGNOSTICS = {
    "autocorrelation": _draw_diagnostics(fits.autocorrelation_panel),
    "inputs": _draw_diagnostics(fits.input_correlation_panel),
}
_ONE_PLACE: dict[str, Make] = {
    "sensitivity": certificates.worst_panel,
    "draws": certificates.draws_panel,
    "step": _draw_steps,
    "friction": certificates.friction_panel,
    "bandwidth": _draw_bandwidths,
    "amplitude": _draw_amplitudes,
    "simulations": _draw_simulations,
    "environments": _draw_environments,
    "impedance": _draw_impedance,
}
KINDS = {
    "Fit": Kind(
        figures={
            **{name: _draw_predictions(panel) for name, panel in _PREDICTION.items()},
            **_DIAGNOSTICS,
            "response": _draw_responses,
            "parameters": fits.parameters_panel,
            "correlation": fits.correlation_panel,
        },
        sheet=_list_fit,
        missing="no parameter was free, and the fit has no logs",
    ),
    "Diagnostics": Kind(figures=_DIAGNOSTICS, sheet=_list_diagnostics),
    "ModelledOutputs": Kind(figures={name: _draw_prediction(panel) for name, panel in _PREDICTION.items()}),
    "Log": Kind(
        figures={
            "clock": lambda log: logs.clock_panel(log, log.quality),
            "excitation": lambda log: logs.excitation_panel(log.quality),
            "channels": _draw_channels,
            "spectrum": _draw_densities,
        },
        sheet=lambda log: [partial(logs.log_panels, log, log.quality)],
    ),
    "Controller": Kind(
        figures={**loops.LOOP_PANELS, "impedance": certificates.impedance_panel},
        sheet=loops.MAIN,
        missing="the controller does not know its design plant; read it with Controller.from_dict",
    ),
    "Certificate": Kind(
        figures={
            "requirements": certificates.requirements_panel,
            **{name: _draw_one_place(name, make) for name, make in _ONE_PLACE.items()},
        },
        sheet=_list_certificate,
    ),
    "Verification": Kind(figures={"runs": _draw_runs}),
    "LargeSignal": Kind(
        figures={
            "bandwidth": lambda sweep: simulations.bandwidth_panel([sweep]),
            "amplitude": simulations.amplitude_panel,
            "saturation": simulations.saturation_panel,
        }
    ),
    "StabilityMap": Kind(figures={"environments": simulations.environment_panels}),
    "ImpedanceRegion": Kind(figures={"region": region_panel}),
    "Frontier": Kind(
        figures={name.removesuffix("_deg").removesuffix("_N"): _draw_figure(name) for name in FRONTIER_FIGURES}
    ),
    "Ranking": Kind(
        figures={"evidence": evidence_panel, "octaves": octave_panels, "response": _compare_responses},
        sheet=("evidence", "octaves"),
    ),
}
