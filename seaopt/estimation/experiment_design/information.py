r"""The Fisher information of a log that has not been recorded yet.

The plant is simulated from rest over the samples of an excitation, with its sensitivities. The information of the
parameters theta, the initial state and the offsets is the sum of s s' / sigma^2 over samples and measured outputs;
that of theta alone, the others being estimated too, is its Schur complement: the inverse of a block of the inverse.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from seaopt.bench import Excitation, excite
from seaopt.errors import EstimationError, require_seed, suggestion
from seaopt.estimation.problem.normal_equations import invert
from seaopt.estimation.problem.shapes import ParameterMatrix, ParameterVector, Signal
from seaopt.estimation.result.covariance import mark_unseen
from seaopt.estimation.solver.step_size import MAX_SUBSTEPS, STEP_ERROR_SIGMA
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.records import record
from seaopt.simulation import Clock, Model, Pass, Point, Segment, make_model, run_passes


@record(eq=False)
class Trial:
    """What a simulated log identifies and what it takes."""

    covariance: ParameterMatrix  # expected of the free parameters; infinite where they cannot be identified
    rms: float  # of the input
    peaks: Mapping[str, float]  # largest magnitude of the input and of each watched signal


@record(eq=False)
class Bench:
    """A plant with its guess and sensors, to be tried with one excitation after another."""

    plant: Plant  # plant, params: the actuator and every parameter of it
    params: ParameterSet
    model: Model  # the plant in its free parameters; the measured outputs come first
    theta: ParameterVector  # theta, prior: free parameters, and what is known of them beforehand: 1/std^2
    prior: ParameterVector
    sigma: Float[np.ndarray, " nm"]  # noise of the measured outputs
    input_name: str  # the input that is excited
    watched: tuple[str, ...]  # outputs and states whose peaks are wanted
    clock: Clock  # period and hold
    n: int  # samples
    offset: bool  # offset, initial: whether those are estimated too
    initial: bool
    substeps: int = 1  # integration steps per sample

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
        """Return the bench with integration steps that are fine enough for `u`.

        Raises EstimationError: no step is.
        """
        substeps = self.substeps
        while not self.model.linear:
            coarse, fine = self._pass(u, substeps).outputs, self._pass(u, 2 * substeps).outputs
            assert coarse is not None and fine is not None
            m = self.sigma.size
            with np.errstate(invalid="ignore"):
                error = float(np.max(np.abs(coarse - fine)[:, :m] / self.sigma)) * 16.0 / 15.0
            if error <= STEP_ERROR_SIGMA:
                break
            substeps *= 2
            if substeps > MAX_SUBSTEPS:
                raise EstimationError(
                    f"steps of 1/{MAX_SUBSTEPS} sample still leave an error of {error:.2g} sigma in an output; "
                    "raise rate_hz, or smooth the friction (v_s)"
                )
        return replace(self, substeps=substeps)

    def _pass(self, u: Signal, substeps: int) -> Pass:
        still = np.zeros(u.size)
        inputs = tuple(u if i == self.channel else still for i in range(self.model.nu))
        # A residual is needed to be counted: nothing measured is all zeros.
        segment = Segment(u=inputs, y=(still,) * self.model.ny)
        point = Point(
            theta=self.theta,
            offset=np.zeros(self.model.ny),
            gain=np.ones(self.model.ny),
            drift=np.zeros((self.model.ny, 0)),
            clock=self.clock,
            substeps=substeps,
        )
        return run_passes(self.model, segment, point, np.zeros(self.model.nx), outputs=True, states=True)

    def _covariance(self, result: Pass) -> ParameterMatrix:
        p, nx, m = self.theta.size, self.model.nx, self.sigma.size
        size = p + nx * self.initial + m * self.offset
        total = np.zeros((size, size))
        for o, sigma in enumerate(self.sigma):
            rows = [*range(1, 1 + p), *(range(1 + p, 1 + p + nx) if self.initial else ())]
            columns = list(range(len(rows)))
            if self.offset:
                rows.append(1 + p + nx)
                columns.append(p + nx * self.initial + o)
            total[np.array(columns)[:, None], columns] += result.gram[o][rows][:, rows] / sigma**2
        if not np.all(np.isfinite(total)):
            return np.full((p, p), np.inf)
        total[np.arange(p), np.arange(p)] += self.prior
        inverted, unseen = invert(total)
        return mark_unseen(inverted[:p, :p], unseen[:p])


def make_bench(
    plant: Plant,
    params: ParameterSet,
    sigma: Mapping[str, float],
    *,
    duration_s: float,
    rate_hz: float,
    offset: bool,
    initial_state: str,
    input_name: str | None,
    watched: tuple[str, ...] = (),
) -> Bench:
    """Return a bench for the free parameters of `params`; the outputs in `sigma` are measured.

    Raises EstimationError: nothing is free, or a name or a value is wrong.
    """
    if not isinstance(sigma, Mapping) or not sigma:
        raise EstimationError(f"sigma = {sigma!r}; give a mapping of each measured output to its noise")
    for name, value in sigma.items():
        if name not in plant.outputs:
            raise EstimationError(
                f'sigma names "{name}", which is not an output of {plant.name}; {suggestion(name, plant.outputs)}'
            )
        if not 0.0 < value < np.inf:
            raise EstimationError(f"sigma of {name} = {value:g} is not positive; give the noise's standard deviation")
    if initial_state not in ("estimate", "rest"):
        raise EstimationError(f'initial_state = "{initial_state}" is not known; use "estimate" or "rest"')
    excited = input_name if input_name is not None else next(iter(plant.inputs), "")
    if excited not in plant.inputs:
        raise EstimationError(f'input "{excited}" is not one of {plant.name}; {suggestion(excited, plant.inputs)}')
    complete = plant.complete(params)
    free = _free_names(plant, params)
    outputs = (*sigma, *(name for name in watched if name in plant.outputs and name not in sigma))
    stds = [complete[name].prior_std for name in free]
    return Bench(
        plant=plant,
        params=complete,
        model=make_model(plant, complete, free, outputs),
        theta=np.array(complete.values_of(free)),
        prior=np.array([0.0 if std is None else std**-2.0 for std in stds]),
        sigma=np.array([float(value) for value in sigma.values()]),
        input_name=excited,
        watched=watched,
        clock=Clock(period=1.0 / rate_hz),
        n=round(duration_s * rate_hz),
        offset=offset,
        initial=initial_state == "estimate",
    )


def _free_names(plant: Plant, params: ParameterSet) -> tuple[str, ...]:
    if not params.free_names:
        raise EstimationError("no parameter is free; free those of interest: params.free('J')")
    for name in params.free_names:
        if name not in plant.parameters:
            raise EstimationError(
                f"parameter {name} is free, but {plant.name} has none; {suggestion(name, plant.parameters)}"
            )
    return params.free_names
