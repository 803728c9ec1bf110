"""The result of a fit: parameters with their uncertainty, what the data cannot identify, and a verdict."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import field, replace
from typing import Any, Literal

import numpy as np

from seaopt.codec import Key, OrInfinite, OrNaN, check_agrees, read_fields, to_content
from seaopt.errors import EstimationError, FileError
from seaopt.estimation.problem.experiment import Experiment
from seaopt.estimation.problem.fit_problem import FitProblem
from seaopt.estimation.problem.residual_statistics import ExperimentResiduals, StatisticsByExperiment, compute_residuals
from seaopt.estimation.problem.shapes import Vector
from seaopt.estimation.result.covariance import Covariance
from seaopt.estimation.result.findings import (
    GUESS,
    DerivedFigure,
    FitFinding,
    LogValues,
    ModelledOutputs,
    Nuisance,
    OutputFit,
    SilentEffect,
)
from seaopt.estimation.result.identifiability import Identifiability
from seaopt.estimation.result.nuisance import estimate_nuisance, take_sensors
from seaopt.estimation.result.trials import HypothesisTrial
from seaopt.estimation.solver.methods import Method
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.plants.parts import list_dead_times
from seaopt.records import PlotAccessor, Result, Worded, record
from seaopt.simulation import Clock, Point, make_model, run_passes

FIT_SCHEMA = "seaopt/fit/2"
FitStatus = Literal["converged", "max_iterations", "stalled", "not_identifiable"]
FIT_AGAIN = "run the fit again"
KNOWN_DELAY_S, BETTER = 1e-4, 10.0  # std of a delay that is known; and how many times better another one is


@record(eq=False)
class Minimum:
    """The problem that was solved, with its sigma and steps, the unknowns where its cost is least, and the method."""

    problem: FitProblem
    z: Vector
    method: Method
    statistics: StatisticsByExperiment | None = None  # of the residuals there, where they were asked for

    def residuals(self) -> dict[str, ExperimentResiduals]:
        """Return the residuals of each experiment, by a simulation of them all."""
        return compute_residuals(self.problem, self.z)


@record
class Provenance:
    """The figures of a fit that differ from run to run: seconds from call to result."""

    wall_s: float


@record(eq=False, repr=False)
class Fit(Result, Worded):
    """The result of a fit; ``print(fit)`` is a report.

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
    model_covariance : Covariance or None
        Of the same: what the structure left in the residuals may move them by, besides noise; None without diagnostics.
    derived : mapping
        Figures that follow from the parameters.
    outputs : mapping of experiment to mapping of output to OutputFit
    nuisance : mapping of experiment to Nuisance
    identifiability : Identifiability
    cost : float
        Half the squared norm of the residuals in sigma, priors included.
    iterations, samples : int
        Least-squares iterations; samples that counted, all outputs together.
    provenance : Provenance
        Figures that differ from run to run, `wall_s`.
    step_error_sigma, step_error_parameter : float
        Largest integration error in an output, in sigma, and in a parameter, in its standard deviations; zero for
        linear plants, which are discretised exactly.
    log_likelihood : float
        Gaussian, with each output's sigma at its best value.
    unknowns : int
        Number of all unknowns, those of the experiments included, sigmas not.
    method : str
        "output_error", "multiple_shooting" or "prediction_error".
    logs : mapping of experiment to LogValues
        What each log says alone, where a plant has several: of its own log of the fit, or of one for validation.
    findings : tuple of FitFinding
        Faults and remarks, errors first; empty without diagnostics.
    notes : tuple of str
        Changes to the logs, and samples without weight, one sentence each.
    hypotheses : tuple of HypothesisTrial
        What the model may lack, as it was tried, the best first; empty where the residuals do not ask for it.
    silent : tuple of SilentEffect
        What the logs cannot tell, and the parameters that it touches.
    experiments, validation : tuple of Experiment
        The data that were fitted, and those that were not; empty when read from a file.
    holdout : float
        The last fraction of each log, that was not fitted; 0 when read from a file.
    minimum : Minimum or None
        The problem and its unknowns, from which refits start; None when read from a file.
    """

    plot = PlotAccessor()

    json_keys = (
        *("met", "findings", "status", "message", "cost", "iterations", "samples", "parameters", "derived"),
        *("covariance", "white_covariance", Key(field="delay_covariance", name="delay_covariance", omit_none=True)),
        Key(field="model_covariance", name="model_covariance", omit_none=True),
        *("outputs", "logs", "identifiability", Key(field="nuisance", name="experiments"), "step_error_sigma"),
        *("step_error_parameter", "method", "log_likelihood", "unknowns", "aic", "bic", "notes", "silent"),
        "hypotheses",
        "provenance",
    )

    status: FitStatus
    message: str
    parameters: ParameterSet
    covariance: Covariance
    white_covariance: Covariance
    derived: Mapping[str, DerivedFigure]
    outputs: Mapping[str, Mapping[str, OutputFit]]
    nuisance: Mapping[str, Nuisance]
    identifiability: Identifiability
    cost: OrInfinite
    iterations: int
    samples: int
    provenance: Provenance
    step_error_sigma: OrInfinite = 0.0
    step_error_parameter: OrInfinite = 0.0
    log_likelihood: OrNaN = math.nan
    unknowns: int = 0
    method: str = "output_error"
    logs: Mapping[str, LogValues] = field(default_factory=dict[str, LogValues])
    findings: tuple[FitFinding, ...] = ()
    notes: tuple[str, ...] = ()
    hypotheses: tuple[HypothesisTrial, ...] = ()
    silent: tuple[SilentEffect, ...] = ()
    delay_covariance: Covariance | None = field(default=None, repr=False)
    model_covariance: Covariance | None = field(default=None, repr=False)
    experiments: tuple[Experiment, ...] = field(default=(), repr=False)
    validation: tuple[Experiment, ...] = field(default=(), repr=False)
    holdout: float = field(default=0.0, repr=False)
    minimum: Minimum | None = field(default=None, repr=False)

    @property
    def wall_s(self) -> float:
        """Seconds from call to result."""
        return self.provenance.wall_s

    @property
    def total_covariance(self) -> Covariance:
        """The covariance of the free parameters, of noise and model together."""
        return self._add_model(self.covariance)

    @property
    def total_delay_covariance(self) -> Covariance | None:
        """The same of the free parameters and the delays that were fitted; None where none was."""
        return None if self.delay_covariance is None else self._add_model(self.delay_covariance)

    def _add_model(self, noise: Covariance) -> Covariance:
        model = self.model_covariance
        if model is None:
            return noise
        rows = [model.names.index(name) for name in noise.names]
        return replace(noise, matrix=noise.matrix + model.matrix[np.ix_(rows, rows)])

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
        """The guesses that it rests on, in words: "on 2 guesses: N_p, l"; empty where there are none."""
        return next((finding.where for finding in self.findings if finding.kind == GUESS), "")

    @property
    def verdict(self) -> str:
        """The result in one line."""
        if self.met:
            return f"{self.status} ({self.message})" + (f", {self.guesses}" if self.guesses else "")
        if self.status != "converged":
            return f"{self.status.replace('_', ' ')}: {self.message}"
        first, *more = self.errors
        where = f"{first.where}: " if first.where else ""
        return f"{where}{first.text}" + (f" (and {len(more)} more)" if more else "")

    @property
    def caveat(self) -> str:
        """A warning beside the standard deviations of a fit that is not met; empty for one that is."""
        if self.met:
            return ""
        return "standard deviations and intervals hold only if the model is right, and this fit is not met"

    @property
    def aic(self) -> OrNaN:
        """Akaike's criterion, -2 log L + 2 k, with k the unknowns and one sigma per output."""
        return 2.0 * self.all_unknowns - 2.0 * self.log_likelihood

    @property
    def bic(self) -> OrNaN:
        """Schwarz's criterion, -2 log L + k log N."""
        return self.all_unknowns * math.log(max(self.samples, 1)) - 2.0 * self.log_likelihood

    @property
    def all_unknowns(self) -> int:
        """Number of all unknowns, sigmas included."""
        return self.unknowns + sum(len(nuisance.gain) for nuisance in self.nuisance.values())

    def delay_s(self, plant: Plant) -> float:
        """Return the longest delay of the plant's experiments, fitted or given; of all, where it has none.

        A fitted one that its log determines ten times worse than another log does its own is not counted.
        """
        return max((nuisance.delay_s for nuisance in self.list_delayed(plant).values()), default=0.0)

    def shows_delay(self, plant: Plant) -> bool:
        """Tell whether an experiment of the plant has a delay behind a command that is held until the next.

        It is the experiment's own, or one that the plant has as a part.
        """
        late = bool(list_dead_times(plant))
        return any(
            nuisance.hold == "zero" and (nuisance.delay_s > 0.0 or (late and nuisance.plant in ("", plant.name)))
            for nuisance in self.list_delayed(plant).values()
        )

    def list_delayed(self, plant: Plant) -> dict[str, Nuisance]:
        """Return those experiments of a plant, of all where it has none, whose delay is known."""
        of_plant = {name: nuisance for name, nuisance in self.nuisance.items() if nuisance.plant in ("", plant.name)}
        candidates = of_plant or dict(self.nuisance)
        stds = [nuisance.std["delay_s"] for nuisance in candidates.values() if "delay_s" in nuisance.std]
        largest_std = max(KNOWN_DELAY_S, BETTER * min(stds, default=0.0))
        return {
            name: nuisance for name, nuisance in candidates.items() if nuisance.std.get("delay_s", 0.0) <= largest_std
        }

    @property
    def own_unknowns(self) -> dict[str, DerivedFigure]:
        """Delays and gains that were fitted, each of one experiment: `chirp.delay_s`, `chirp.gain.F1`."""
        return {
            f"{name}.{key}": figure
            for name, nuisance in self.nuisance.items()
            for key, figure in nuisance.fitted.items()
        }

    def require_minimum(self, what: str) -> Minimum:
        """Return the minimum, for `what` needs it. Raises EstimationError: the fit was read from a file."""
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
        nuisance, in_band = self._find_nuisance(experiment)
        model = make_model(
            experiment.follow(self.parameters), experiment.apply_own(self.parameters), (), experiment.outputs
        )
        n = len(experiment.log)
        y = np.full((n, len(experiment.outputs)), np.nan)
        point = Point(
            theta=np.zeros(0),
            gain=np.array([nuisance.gain[name] for name in experiment.outputs]),
            offset=np.array([nuisance.offset[name] for name in experiment.outputs]),
            clock=Clock(period=experiment.log.period, hold=experiment.hold, delay_s=nuisance.delay_s),
            drift=np.array([nuisance.drift.get(name, ()) for name in experiment.outputs]),
            substeps=nuisance.substeps,
        )
        segments = zip(
            experiment.segments(plant=model.plant), experiment.segment_rows, nuisance.initial_state, strict=True
        )
        for segment, rows, state in segments:
            start = np.array(list(state.values()))
            outputs = run_passes(model, segment, point, start, sums=False, outputs=True).outputs
            assert outputs is not None
            y[rows] = point.read(outputs.T, segment, slice(0, segment.n)).T
        log = experiment.log
        return ModelledOutputs(
            time=log.time,
            inputs={name: log[name] for name in experiment.plant.inputs if name in log.signals},
            measured={name: log[name] for name in experiment.outputs},
            model={name: y[:, i] for i, name in enumerate(experiment.outputs)},
            name=experiment.name,
            own=nuisance,
            band_fit_percent=in_band,
            units={name: experiment.plant.outputs[name] for name in experiment.outputs},
        )

    def _find_nuisance(self, experiment: Experiment) -> tuple[Nuisance, dict[str, float | None]]:
        """Return an experiment's own unknowns, fitted or else estimated, and outputs' fit percent in the band."""
        fitted = any(experiment.log is used.log and experiment.name == used.name for used in self.experiments)
        if fitted:
            rows = self.outputs.get(experiment.name, {})
            return self.nuisance[experiment.name], {name: row.band_fit_percent for name, row in rows.items()}
        same = (nuisance for nuisance in self.nuisance.values() if nuisance.plant in ("", experiment.plant.name))
        band_hz = None if self.minimum is None else self.minimum.problem.band_hz
        return estimate_nuisance(take_sensors(experiment, next(same, None)), self.parameters, band_hz)

    def to_dict(self) -> dict[str, Any]:
        """Return the content of fit.json (schema seaopt/fit/2)."""
        return {"schema": FIT_SCHEMA, **to_content(self)}

    @classmethod
    def from_dict(cls, content: Mapping[str, Any], experiments: tuple[Experiment, ...] = ()) -> Fit:
        """Return the fit of a fit.json; `experiments` brings the data back for predictions.

        Raises
        ------
        FileError
            A field is missing or malformed.
        """
        filled = {"white_covariance": content.get("covariance"), **content}  # an older file has one
        fields = read_fields(cls, filled, "fit.json", remedy=FIT_AGAIN)
        parameters, names = fields["parameters"], fields["covariance"].names
        if set(names) != set(parameters.free_names):
            raise FileError(
                f"fit.json: covariance.names = {', '.join(names)} is not what parameters has free, "
                f"{', '.join(parameters.free_names)}; {FIT_AGAIN}"
            )
        fit = cls(**fields, experiments=experiments)
        check_agrees(content, to_content(fit), "fit.json", remedy=FIT_AGAIN)
        return fit
