r"""The Fisher information of a log that has not been recorded yet.

The plant is simulated from rest over the samples of an excitation, with its sensitivities: a `FitProblem` whose log has
the excitation as input and zeros as measured outputs. Its Hessian at the guess is the information of the parameters
theta, the initial state and the offsets; the inverse of that has the covariance of theta, the others being estimated
too. An output that is watched and not measured has an infinite sigma.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Literal

import numpy as np

from seaopt.bench import Excitation, excite
from seaopt.errors import EstimationError, require_seed, suggestion
from seaopt.estimation.problem.experiment import Experiment
from seaopt.estimation.problem.fit_experiment import MAX_SUBSTEPS, FitExperiment
from seaopt.estimation.problem.fit_problem import FitProblem, pose_problem
from seaopt.estimation.problem.losses import Squares
from seaopt.estimation.problem.normal_equations import invert
from seaopt.estimation.problem.shapes import ParameterMatrix, ParameterVector, PerOutput, Signal
from seaopt.estimation.result.covariance import mark_unseen
from seaopt.estimation.solver.step_size import STEP_ERROR_SIGMA
from seaopt.logs import Log
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.plants.friction import list_smoothing
from seaopt.records import record
from seaopt.simulation import Clock, Model, Pass, run_passes


@record(eq=False)
class Trial:
    """A simulated log: the covariance to expect, and its size."""

    covariance: ParameterMatrix  # expected of the free parameters; infinite where they cannot be identified
    rms: float  # of the input
    peaks: Mapping[str, float]  # largest magnitude of the input and of each watched signal


@record(eq=False)
class Bench:
    """A plant with its guess and sensors, to be tried with one excitation after another."""

    problem: FitProblem  # of one experiment, the measured outputs first
    measured: int  # outputs
    input_name: str  # the input that is excited
    watched: tuple[str, ...]  # outputs and states whose peaks are limited
    substeps: int = 1  # integration steps per sample

    @property
    def experiment(self) -> FitExperiment:
        """The experiment that is simulated."""
        return self.problem.experiments[0]

    @property
    def plant(self) -> Plant:
        """The actuator."""
        return self.experiment.data.plant

    @property
    def model(self) -> Model:
        """The plant in its free parameters."""
        return self.experiment.model

    @property
    def theta(self) -> ParameterVector:
        """The guess of the free parameters."""
        return self.problem.unknowns.start[: self.model.np]

    @property
    def sigma(self) -> PerOutput:
        """The noise of the measured outputs."""
        return self.experiment.sigma[: self.measured]

    @property
    def clock(self) -> Clock:
        """Period and hold."""
        return self.experiment.point(self.problem.unknowns.start).clock

    @property
    def n(self) -> int:
        """Number of samples."""
        return self.experiment.longest

    @property
    def channel(self) -> int:
        """The excited input's place."""
        return list(self.plant.inputs).index(self.input_name)

    def place(self, name: str) -> int:
        """Return where a signal stands among outputs, then states."""
        return [*self.model.outputs, *self.plant.states].index(name)

    def samples(self, excitation: Excitation, seed: int = 0) -> Signal:
        """Return an excitation on the bench's clock."""
        rate = 1.0 / self.clock.period
        rng = np.random.default_rng(require_seed(seed, EstimationError))
        return excite(excitation, duration_s=self.n / rate, rate_hz=rate, rng=rng)[1]

    def run(self, u: Signal) -> Trial:
        """Simulate the excitation `u` from rest."""
        result = self._pass(u, self.substeps)
        assert result.outputs is not None and result.states is not None
        signals = np.concatenate([result.outputs, result.states], axis=1)
        peaks = {name: float(np.max(np.abs(signals[:, self.place(name)]))) for name in self.watched}
        return Trial(
            covariance=self._covariance(result),
            rms=float(np.sqrt(np.mean(u**2))),
            peaks={self.input_name: float(np.max(np.abs(u))), **peaks},
        )

    def refine_steps(self, u: Signal) -> Bench:
        """Return the bench with integration steps that are fine enough for `u`. Raises EstimationError: no step is."""
        substeps = self.substeps
        while not self.model.linear:
            coarse, fine = self._pass(u, substeps).outputs, self._pass(u, 2 * substeps).outputs
            assert coarse is not None and fine is not None
            with np.errstate(invalid="ignore"):
                error = float(np.max(np.abs(coarse - fine)[:, : self.measured] / self.sigma)) * 16.0 / 15.0
            if error <= STEP_ERROR_SIGMA:
                break
            substeps *= 2
            if substeps > MAX_SUBSTEPS:
                speeds = ", ".join(list_smoothing(self.plant))
                raise EstimationError(
                    f"steps of 1/{MAX_SUBSTEPS} sample still leave an error of {error:.2g} sigma in an output; "
                    "raise rate_hz" + (f", or smooth the friction ({speeds})" if speeds else "")
                )
        return replace(self, substeps=substeps)

    def _pass(self, u: Signal, substeps: int) -> Pass:
        (segment,), z = self.experiment.segments, self.problem.unknowns.start
        inputs = tuple(u if i == self.channel else still for i, still in enumerate(segment.samples.u))
        point = replace(self.experiment.point(z), substeps=substeps, stable=1)
        samples = replace(segment.samples, u=inputs)
        return run_passes(self.model, samples, point, segment.start(z), outputs=True, states=True)

    def _covariance(self, result: Pass) -> ParameterMatrix:
        p, n = self.model.np, self.problem.unknowns.start.size
        information = self.experiment.normal([result], n)[1:, 1:] + np.diag(self.problem.unknowns.precision)
        if not np.all(np.isfinite(information)):
            return np.full((p, p), np.inf)
        inverted, unseen = invert(information)
        return mark_unseen(inverted[:p, :p], unseen[:p])


def make_bench(
    plant: Plant,
    params: ParameterSet,
    sigma: Mapping[str, float],
    *,
    duration_s: float,
    rate_hz: float,
    offset: bool,
    initial_state: Literal["estimate", "rest"],
    input_name: str | None,
    watched: tuple[str, ...] = (),
) -> Bench:
    """Return a bench for what is free in `params`; the outputs in `sigma` are measured. Raises EstimationError: nothing
    is free, or a name or a value is wrong.
    """
    if not isinstance(sigma, Mapping) or not sigma:
        raise EstimationError(f"sigma = {sigma!r}; give a mapping of each measured output to its noise")
    for name in sigma:
        if name not in plant.outputs:
            raise EstimationError(
                f'sigma names "{name}", which is not an output of {plant.name}; {suggestion(name, plant.outputs)}'
            )
    excited = input_name if input_name is not None else next(iter(plant.inputs), "")
    if excited not in plant.inputs:
        raise EstimationError(f'input "{excited}" is not one of {plant.name}; {suggestion(excited, plant.inputs)}')
    if not params.free_names:
        raise EstimationError("no parameter is free; free those of interest: params.free('J')")
    outputs = (*sigma, *(name for name in watched if name in plant.outputs and name not in sigma))
    time = np.arange(round(duration_s * rate_hz)) / rate_hz
    still: dict[str, Any] = dict.fromkeys((*plant.inputs, *outputs), np.zeros(time.size))
    experiment = Experiment(
        plant=plant,
        log=Log.from_arrays(time=time, **still),
        name="design",
        outputs=outputs,
        sigma=sigma,
        offset=offset,
        initial_state=initial_state,
        mask="none",
    )
    problem = pose_problem((experiment,), params, loss=Squares())
    noise = np.array([sigma.get(name, np.inf) for name in outputs])
    return Bench(
        problem=problem.with_values("sigma", {"design": noise}),
        measured=len(sigma),
        input_name=excited,
        watched=watched,
    )
