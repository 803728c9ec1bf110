"""The result of a fit: parameters with their uncertainty, what the data cannot tell, and how well it went."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import field
from typing import Any

import numpy as np
from jaxtyping import Float

from seaopt.errors import EstimationError
from seaopt.estimation.problem.experiment import Experiment
from seaopt.estimation.problem.fit_problem import FitProblem
from seaopt.estimation.problem.residual_statistics import ExperimentResiduals, compute_residuals
from seaopt.estimation.result.covariance import Covariance
from seaopt.estimation.result.findings import GUESS, DerivedFigure, FitFinding, ModelledOutputs, Nuisance, OutputFit
from seaopt.estimation.result.identifiability import Identifiability
from seaopt.estimation.result.nuisance import estimate_nuisance, take_sensors
from seaopt.estimation.solver.methods import Method
from seaopt.formatting import format_figure, format_number, html_list, html_paragraph, html_table
from seaopt.parameters import Parameter, ParameterSet
from seaopt.plants import Plant
from seaopt.plants.parts import list_dead_times
from seaopt.records import PlotAccessor, Result, record
from seaopt.simulation import Clock, Point, make_model, run_passes
from seaopt.units import unit_after

FIT_SCHEMA = "seaopt/fit/2"
KNOWN_DELAY_S, BETTER = 1e-4, 10.0  # std of a delay that is known; and how many times better another one is


@record(eq=False)
class Minimum:
    """The problem that was solved, with its sigma and steps, the unknowns where its cost is least, and the method."""

    problem: FitProblem
    z: Float[np.ndarray, " n"]
    method: Method

    def residuals(self) -> dict[str, ExperimentResiduals]:
        """Return the residuals of each experiment, by a simulation of them all."""
        return compute_residuals(self.problem, self.z)


@record(eq=False)
class Fit(Result):
    """What `fit` returns; ``print(fit)`` is a report.

    Parameters
    ----------
    status : str
        "converged", "max_iterations", "stalled" or "not_identifiable"; `message` explains it.
    parameters : ParameterSet
        Every parameter of the plants, free ones with their std (infinite where not identifiable); `identified` is False
        for those that the data cannot identify.
    covariance : Covariance
        Of the free parameters; posterior, and allowing for coloured residuals.
    white_covariance : Covariance
        The covariance for white residuals; compared with the other it shows the effect of their colour.
    delay_covariance : Covariance or None
        Of the free parameters and of the delays that were fitted, `chirp.delay_s`; None where none was.
    derived : mapping
        Figures that follow from the parameters.
    outputs : mapping of experiment to mapping of output to OutputFit
    nuisance : mapping of experiment to Nuisance
    identifiability : Identifiability
    cost : float
        Half the squared norm of the residuals in sigma, priors included.
    iterations, samples : int
        Least-squares iterations; samples that counted, all outputs together.
    wall_s : float
        Seconds from call to result.
    step_error_sigma, step_error_parameter : float
        Largest integration error in an output, in sigma, and in a parameter, in its standard deviations; zero for
        linear plants, which are discretised exactly.
    log_likelihood : float
        Gaussian, with each output's sigma at its best value.
    unknowns : int
        Number of all unknowns, those of the experiments included, sigmas not.
    method : str
        "output_error", "multiple_shooting" or "prediction_error".
    findings : tuple of FitFinding
        What is wrong with it, errors first; empty without diagnostics.
    notes : tuple of str
        What was done to the logs, and which samples had no weight, one sentence each.
    experiments : tuple of Experiment
        The data; empty when read from a file.
    minimum : Minimum or None
        The problem and its unknowns, from which refits start; None when read from a file.

    """

    plot = PlotAccessor("seaopt.reporting.plots:FitPlots")

    status: str
    message: str
    parameters: ParameterSet
    covariance: Covariance
    white_covariance: Covariance
    derived: Mapping[str, DerivedFigure]
    outputs: Mapping[str, Mapping[str, OutputFit]]
    nuisance: Mapping[str, Nuisance]
    identifiability: Identifiability
    cost: float
    iterations: int
    samples: int
    wall_s: float
    step_error_sigma: float = 0.0
    step_error_parameter: float = 0.0
    log_likelihood: float = math.nan
    unknowns: int = 0
    method: str = "output_error"
    findings: tuple[FitFinding, ...] = ()
    notes: tuple[str, ...] = ()
    delay_covariance: Covariance | None = field(default=None, repr=False)
    experiments: tuple[Experiment, ...] = field(default=(), repr=False)
    minimum: Minimum | None = field(default=None, repr=False)

    @property
    def met(self) -> bool:
        """Whether it may be used: it converged, identifies every free parameter, and no finding is an error."""
        return self.status == "converged" and not self.errors

    @property
    def errors(self) -> tuple[FitFinding, ...]:
        """The findings that forbid to use it."""
        return tuple(finding for finding in self.findings if finding.severity == "error")

    @property
    def guesses(self) -> str:
        """What to say of the guesses that it rests on, "on 2 guesses: N_p, l"; empty where there are none."""
        return next((one.where for one in self.findings if one.kind == GUESS), "")

    @property
    def verdict(self) -> str:
        """What to say of it in one line."""
        if self.met:
            return f"{self.status} ({self.message})" + (f", {self.guesses}" if self.guesses else "")
        if self.status != "converged":
            return f"{self.status.replace('_', ' ')}: {self.message}"
        first, *more = self.errors
        where = f"{first.where}: " if first.where else ""
        return f"{where}{first.text}" + (f" (and {len(more)} more)" if more else "")

    @property
    def caveat(self) -> str:
        """What to say beside the standard deviations of a fit that is not met; empty of one that is."""
        if self.met:
            return ""
        return "standard deviations and intervals hold only if the model is right, and this fit is not met"

    @property
    def aic(self) -> float:
        """Akaike's criterion, -2 log L + 2 k, with k the unknowns and one sigma per output."""
        return 2.0 * self.all_unknowns - 2.0 * self.log_likelihood

    @property
    def bic(self) -> float:
        """Schwarz's criterion, -2 log L + k log N."""
        return self.all_unknowns * math.log(max(self.samples, 1)) - 2.0 * self.log_likelihood

    @property
    def all_unknowns(self) -> int:
        """Number of all unknowns, sigmas included."""
        return self.unknowns + sum(len(own.gain) for own in self.nuisance.values())

    def delay_s(self, plant: Plant) -> float:
        """Return the longest delay of the plant's experiments, fitted or given; of all, where it has none.

        A fitted one that its log hardly tells does not count where another log tells its own ten times better.
        """
        return max((one.delay_s for one in self.list_delayed(plant).values()), default=0.0)

    def shows_delay(self, plant: Plant) -> bool:
        """Tell whether an experiment of the plant has a delay behind a command that is held until the next.

        It is the experiment's own, or one that the plant has as a part.
        """
        late = bool(list_dead_times(plant))
        return any(
            one.hold == "zero" and (one.delay_s > 0.0 or (late and one.plant in ("", plant.name)))
            for one in self.list_delayed(plant).values()
        )

    def list_delayed(self, plant: Plant) -> dict[str, Nuisance]:
        """Return those experiments of a plant, of all where it has none, whose delay is known."""
        of_plant = {name: one for name, one in self.nuisance.items() if one.plant in ("", plant.name)}
        own = of_plant or dict(self.nuisance)
        stds = [one.std["delay_s"] for one in own.values() if "delay_s" in one.std]
        known = max(KNOWN_DELAY_S, BETTER * min(stds, default=0.0))
        return {name: one for name, one in own.items() if one.std.get("delay_s", 0.0) <= known}

    @property
    def own_unknowns(self) -> dict[str, DerivedFigure]:
        """Delays and gains that were fitted, each of one experiment: `chirp.delay_s`, `chirp.gain.F1`."""
        return {f"{name}.{key}": one for name, own in self.nuisance.items() for key, one in own.fitted.items()}

    def require_minimum(self, what: str) -> Minimum:
        """Return the minimum, for `what` needs it.

        Raises
        ------
        EstimationError
            The fit was read from a file.

        """
        if self.minimum is None:
            raise EstimationError(f"{what} needs the fit itself, and this one was read from a file; call fit again")
        return self.minimum

    def predict(self, experiment: Experiment) -> ModelledOutputs:
        """Return measured and model outputs of an experiment, with fit percent; prints itself.

        Parameters
        ----------
        experiment : Experiment
            One of the fit's, simulated with what was estimated for it; or of any other log, whose initial state and
            offsets are estimated from that log, the parameters being those of the fit. A delay and gains that the fit
            estimated are taken over where the experiment states none.

        Raises
        ------
        EstimationError
            The log is too short, or has a free parameter of its own that the fit has not.

        """
        for name, parameter in experiment.list_own().items():
            if parameter.name not in self.parameters:
                raise EstimationError(
                    f"experiment {experiment.name}: its own {name} is free, and the fit has no {parameter.name}; "
                    f"give {name} a value, or fit it with this log"
                )
        own, in_band = self._find_nuisance(experiment)
        model = make_model(experiment.plant, experiment.apply_own(self.parameters), (), experiment.outputs)
        n = len(experiment.log)
        y = np.full((n, len(experiment.outputs)), np.nan)
        point = Point(
            theta=np.zeros(0),
            gain=np.array([own.gain[name] for name in experiment.outputs]),
            offset=np.array([own.offset[name] for name in experiment.outputs]),
            clock=Clock(period=experiment.log.period, hold=experiment.hold, delay_s=own.delay_s),
            drift=np.zeros((len(experiment.outputs), 0)),
            substeps=own.substeps,
        )
        for segment, piece, state in zip(experiment.segments(), experiment.pieces, own.initial_state, strict=True):
            start = np.array([list(state.values())])
            outputs = run_passes(model, segment, point, start, sums=False, outputs=True).outputs
            assert outputs is not None
            y[piece] = outputs * point.gain + point.offset
            for o, name in enumerate(experiment.outputs):
                drift = np.array(own.drift.get(name, ()))
                y[piece, o] += segment.drift_basis(slice(0, segment.n), drift.size) @ drift
        log = experiment.log
        return ModelledOutputs(
            time=log.time,
            inputs={name: log[name] for name in experiment.plant.inputs if name in log.signals},
            measured={name: log[name] for name in experiment.outputs},
            model={name: y[:, i] for i, name in enumerate(experiment.outputs)},
            name=experiment.name,
            own=own,
            band_fit_percent=in_band,
            units={name: experiment.plant.outputs[name] for name in experiment.outputs},
        )

    def _find_nuisance(self, experiment: Experiment) -> tuple[Nuisance, dict[str, float | None]]:
        """Return an experiment's own unknowns, fitted or else estimated, and outputs' fit percent in the band."""
        known = any(experiment.log is one.log and experiment.name == one.name for one in self.experiments)
        if known:
            rows = self.outputs.get(experiment.name, {})
            return self.nuisance[experiment.name], {name: row.band_fit_percent for name, row in rows.items()}
        same = (own for own in self.nuisance.values() if own.plant in ("", experiment.plant.name))
        band_hz = None if self.minimum is None else self.minimum.problem.band_hz
        return estimate_nuisance(take_sensors(experiment, next(same, None)), self.parameters, band_hz)

    def to_dict(self) -> dict[str, Any]:
        """Return the content of fit.json (schema seaopt/fit/2)."""
        return {
            "schema": FIT_SCHEMA,
            "met": self.met,
            "findings": [_fields(finding) for finding in self.findings],
            "status": self.status,
            "message": self.message,
            "cost": self.cost,
            "iterations": self.iterations,
            "samples": self.samples,
            "parameters": {name: _parameter_dict(one) for name, one in self.parameters.items()},
            "derived": {
                name: {"value": figure.value, "unit": figure.unit, "std": figure.std, "ci95": list(figure.ci95)}
                for name, figure in self.derived.items()
            },
            "covariance": {"names": list(self.covariance.names), "matrix": self.covariance.matrix},
            "white_covariance": {"names": list(self.white_covariance.names), "matrix": self.white_covariance.matrix},
            **self._delay_dict(),
            "outputs": {
                name: {output: _fields(one) for output, one in row.items()} for name, row in self.outputs.items()
            },
            "identifiability": {
                "rank": self.identifiability.rank,
                "free": self.identifiability.free,
                "condition": self.identifiability.condition,
                "unidentifiable": list(self.identifiability.unidentifiable),
                "weak": list(self.identifiability.weak),
                "structural_rank": self.identifiability.structural_rank,
            },
            "experiments": {name: _fields(nuisance) for name, nuisance in self.nuisance.items()},
            "step_error_sigma": self.step_error_sigma,
            "step_error_parameter": self.step_error_parameter,
            "method": self.method,
            "log_likelihood": self.log_likelihood,
            "unknowns": self.unknowns,
            "aic": self.aic,
            "bic": self.bic,
            "notes": list(self.notes),
            "provenance": {"wall_s": self.wall_s},
        }

    def _delay_dict(self) -> dict[str, Any]:
        """Return the covariance with the delays, where one was fitted."""
        joint = self.delay_covariance
        return {} if joint is None else {"delay_covariance": {"names": list(joint.names), "matrix": joint.matrix}}

    @classmethod
    def from_dict(cls, content: Mapping[str, Any], experiments: tuple[Experiment, ...] = ()) -> Fit:
        """Return the fit of a fit.json; `experiments` brings the data back for predictions.

        Raises
        ------
        FileError
            A field is missing or malformed.

        """
        from seaopt.estimation.result.stored import read_fit  # deferred: pydantic

        return cls(**read_fit(content), experiments=experiments)

    def __repr__(self) -> str:
        lines = [f"Fit: {'met' if self.met else 'NOT MET'}, {self.status} ({self.message})"]
        lines += [
            f"  {finding.severity}: {f'{finding.where}: ' if finding.where else ''}{finding.text}"
            for finding in self.findings
        ]
        lines.append(f"  {self.samples} samples, {self.iterations} iterations, {self.wall_s:.2f} s")
        free = ParameterSet(parameter for parameter in self.parameters.values() if parameter.free)
        lines += [f"  {self.caveat}:"] if self.caveat and free else []
        lines += [f"  {line}" for line in repr(free).splitlines()]
        lines += [
            f"  {name} = {figure.value:.5g} ± {figure.std:.2g}{unit_after(figure.unit)}"
            for name, figure in self.derived.items()
        ]
        for name, own in self.nuisance.items():
            lines += [f"  {name}: {line}" for line in own.describe()]
            if len(own.initial_state) > 1:
                lines.append(f"  {name}: {len(own.initial_state)} segments with initial states of their own")
        for name, row in self.outputs.items():
            for output, one in row.items():
                others = "" if one.holdout_fit_percent is None else f", held out {one.holdout_fit_percent:.2f} %"
                others += "" if one.band_fit_percent is None else f", in the band {one.band_fit_percent:.2f} %"
                others += "" if one.one_step_fit_percent is None else f", one step {one.one_step_fit_percent:.2f} %"
                lines.append(
                    f"  {name}.{output}: fit {one.fit_percent:.2f} %{others}, "
                    f"rms residual {one.rms_residual:.4g}{unit_after(one.unit)}"
                )
        lines += [f"  {note}" for note in self.notes]
        return "\n".join(lines)

    def _repr_html_(self) -> str:
        return format_fit(self) + self.plot.to_html()


def format_fit(fit: Fit) -> str:
    """Return as HTML the verdict, the findings, the fitted parameters and what follows from them, and every output."""
    findings = (f"{one.severity}: {f'{one.where}: ' if one.where else ''}{one.text}" for one in fit.findings)
    fitted = [
        (one.name, format_number(one.value, 6), format_number(one.std, 2), unit_after(one.unit).strip())
        for one in fit.parameters.values()
        if one.free
    ]
    others = [
        (name, format_number(one.value, 6), format_number(one.std, 2), unit_after(one.unit).strip())
        for name, one in {**fit.own_unknowns, **fit.derived}.items()
    ]
    outputs = [
        (name, output, *(format_figure(value, "%") for value in (one.fit_percent, one.holdout_fit_percent)),
         format_figure(one.rms_residual, unit_after(one.unit).strip()))
        for name, row in fit.outputs.items()
        for output, one in row.items()
    ]  # fmt: skip
    return (
        html_paragraph(f"Fit: {'met' if fit.met else 'NOT MET'}, {fit.status} ({fit.message})")
        + html_list(findings)
        + (html_paragraph(fit.caveat) if fit.caveat else "")
        + html_table(("parameter", "value", "std", "unit"), [*fitted, *others])
        + html_table(("experiment", "output", "fit", "held out", "rms residual"), outputs)
        + html_list(fit.notes)
    )


def _fields(record: Any) -> dict[str, Any]:
    return {name: getattr(record, name) for name in record.__dataclass_fields__}


def _parameter_dict(parameter: Parameter) -> dict[str, Any]:
    ci95 = list(parameter.ci95) if parameter.ci95 is not None else None
    return {
        "value": parameter.value, "unit": parameter.unit, "free": parameter.free, "std": parameter.std, "ci95": ci95,
        "at_bound": parameter.at_bound, "min": parameter.min, "max": parameter.max, "prior_std": parameter.prior_std,
        "description": parameter.description, "identified": parameter.identified,
        "plausible": None if parameter.plausible is None else list(parameter.plausible),
    }  # fmt: skip
