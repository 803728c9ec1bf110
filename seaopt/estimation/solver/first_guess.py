"""A first guess from frequency responses: where time-domain least squares starts when the given values are far off.

The H1 estimate of each input-output pair is compared with the linearised plant, in log magnitude and phase, which has
no local minima to speak of in inertias, stiffnesses and dampings. The given values are refined by Gauss-Newton with
CasADi's derivatives; where that leaves the responses unexplained, candidates are drawn over two decades around the
given values, screened, and the best are refined.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from jaxtyping import Complex, Float, Int

from seaopt.errors import LogError
from seaopt.estimation.problem.fit_experiment import FitExperiment
from seaopt.estimation.problem.fit_problem import FitProblem
from seaopt.estimation.problem.shapes import ParameterVector, Vector
from seaopt.frequency.response import FrequencyResponse, conditioned_responses, responses
from seaopt.parameters import ParameterSet
from seaopt.plants.friction import leave_out_waves, remove_friction
from seaopt.plants.sensors.difference import read_positions
from seaopt.records import record
from seaopt.simulation import Model, linearise, make_model

CANDIDATES = 128
REFINED_CANDIDATES = 8
MATCHED_POINTS = 60
EXPLAINED_MISFIT = 2.0  # rms misfit, in standard deviations of the responses, of a guess that needs no other
LONGEST_WINDOW = 1 << 14  # samples of a window: resolution enough for a guess
QUICK_WINDOWS = [2**a * 3**b for a in range(15) for b in range(9)]


@record(eq=False)
class _Target:
    """The measured responses of an experiment's outputs to its input, and the linearised model of them. Rows are
    frequencies, columns outputs; the weight is zero where an output has no response to be matched.
    """

    model: Model
    index: list[int]
    input: int
    outputs: list[int]
    s: Complex[np.ndarray, " m"]
    shift: Complex[np.ndarray, "m ny"]
    log_response: Complex[np.ndarray, "m ny"]
    weight: Float[np.ndarray, "m ny"]


def guess_from_responses(problem: FitProblem, rng: np.random.Generator) -> tuple[list[Vector], bool]:
    """Return unknowns with shared parameters that match the frequency responses, the best first, and whether it does.
    None of them where no experiment has a usable response: gaps, or no coherence. Inputs that move together have one
    each, of what the others leave.
    """
    unknowns = problem.unknowns
    shared = unknowns.start[: unknowns.shared]
    targets = [target for each in problem.experiments for target in _measure_targets(each, problem.params, shared)]
    if not targets:
        return [], False
    every = (unknowns.start, unknowns.low, unknowns.high, unknowns.prior_std)
    start, low, high, prior_std = (values[: unknowns.shared] for values in every)
    spread = np.isinf(prior_std) & (start != 0.0)
    refined = _refine(targets, start[None], low, high, spread)
    enough = 0.5 * EXPLAINED_MISFIT**2 * 2 * sum(int(np.count_nonzero(target.weight)) for target in targets)
    if refined[0][0] > enough:
        factors = 10.0 ** rng.uniform(-1.2, 1.2, (CANDIDATES, start.size))
        candidates = np.clip(start * np.where(spread, factors, 1.0), low, high)
        ranked = np.argsort(_misfit(targets, candidates)[0], kind="stable")
        refined += _refine(targets, candidates[ranked[:REFINED_CANDIDATES]], low, high, spread)
    refined.sort(key=lambda pair: pair[0])
    guesses = [np.concatenate([theta, unknowns.start[unknowns.shared :]]) for _, theta in refined]
    return guesses, refined[0][0] <= enough


def _measure_targets(experiment: FitExperiment, params: ParameterSet, theta: ParameterVector) -> Iterator[_Target]:
    """Yield what there is to match of an experiment, for each of its inputs that moves: of several those to which the
    plant responds at `theta`, as it does not where it rests to the voltage of a supply.
    """
    data, log = experiment.data, experiment.data.log
    active = [n for n in data.plant.inputs if n in log.signals and np.ptp(log[n]) > 0.0]
    if not active or len(data.log_segments) != 1:
        return
    whole = [o for o, output in enumerate(data.outputs) if np.all(np.isfinite(log[output]))]
    if not whole:
        return
    measured, stretch_s = [log[data.outputs[o]] for o in whole], _choose_window(len(log)) * log.period
    try:
        if len(active) == 1:
            estimated = [responses(log[active[0]], measured, log.period, stretch_s=stretch_s)]
        else:
            estimated = conditioned_responses([log[n] for n in active], measured, log.period, stretch_s=stretch_s)
    except LogError:
        return
    for name, estimates in zip(active, estimated, strict=True):
        target = _choose_target(experiment, params, name, dict(zip(whole, estimates, strict=True)))
        if target is not None and (len(active) == 1 or np.isfinite(_misfit([target], theta[None])[0][0])):
            yield target


def _choose_target(
    experiment: FitExperiment, params: ParameterSet, name: str, estimated: Mapping[int, FrequencyResponse]
) -> _Target | None:
    """Return the coherent lines of the responses to an input, by output, beside the model of them."""
    data, log, band_hz = experiment.data, experiment.data.log, experiment.band_hz
    chosen: dict[int, tuple[FrequencyResponse, Int[np.ndarray, "..."]]] = {}
    low, high = band_hz if band_hz is not None else (0.0, np.inf)
    for o, estimate in estimated.items():
        f = estimate.frequency_hz
        good = (estimate.coherence > 0.5) & (f > low) & (f < min(high, 0.4 / log.period))
        if np.count_nonzero(good) >= 8:
            chosen[o] = estimate, _space_by_logarithm(f, good)
    if not chosen:
        return None
    estimates, places = zip(*chosen.values(), strict=True)
    rows = np.unique(np.concatenate(places))
    used = np.column_stack([np.isin(rows, each) for each in places])
    response = np.column_stack([estimate.response[rows] for estimate in estimates])
    spread = np.column_stack([np.maximum(estimate.relative_std[rows], 0.02) for estimate in estimates])
    delay = experiment.slots.delay.value + (0.5 * log.period if data.hold == "zero" else 0.0)
    s = 2j * np.pi * estimates[0].frequency_hz[rows]
    gain = np.array([experiment.slots.gain[o].value for o in chosen])
    # Dry friction at rest is a damper of f_c/v_s, which is no more there once the actuator moves.
    model, plant, shift = experiment.model, data.plant, np.exp(-s * delay)[:, None] * gain
    if data.differences:
        plant = read_positions(plant, data.differences)
        for column, o in enumerate(chosen):
            if (difference := data.differences.get(data.outputs[o])) is not None:
                shift[:, column] *= difference.respond(s, log.period)
    if not model.linear and plant.friction:
        plant = leave_out_waves(remove_friction(plant))
    if plant is not data.plant:
        model = make_model(plant, data.apply_own(params), model.free, model.outputs)
    model = linearise(model)
    return _Target(
        model=model,
        index=experiment.theta.tolist(),
        input=list(data.plant.inputs).index(name),
        outputs=list(chosen),
        s=s,
        shift=shift,
        log_response=np.log(np.where(used, response, 1.0)),
        weight=np.where(used, 1.0 / spread, 0.0),
    )


def _choose_window(n: int) -> int:
    """Return a sixteenth of the log, of a length that is quick to transform, and not too long."""
    length = min(n // 16, LONGEST_WINDOW)
    return max((size for size in QUICK_WINDOWS if size <= length), default=16)


def _space_by_logarithm(f: Float[np.ndarray, " m"], good: Any) -> Any:
    """Return indices of good frequencies, about evenly spread on a logarithmic axis."""
    candidates = np.flatnonzero(good)
    places = np.log(f[candidates])
    grid = np.linspace(places[0], places[-1], MATCHED_POINTS)
    after = np.clip(np.searchsorted(places, grid), 1, places.size - 1)
    nearest = np.where(grid - places[after - 1] <= places[after] - grid, after - 1, after)
    return candidates[np.unique(nearest)]


@np.errstate(all="ignore")  # callers look for what is not finite
def _mismatch(
    target: _Target, g: Float[np.ndarray, "*k rows cols"]
) -> tuple[
    Complex[np.ndarray, "*k m ny"],
    Complex[np.ndarray, "*k m ny"],
    Complex[np.ndarray, "*k m nx"],
    Complex[np.ndarray, "*k m nx nx"],
]:
    """Return weighted differences of the log responses, the responses, the states' and the resolvents."""
    nx, rows = target.model.nx, [target.model.nx + o for o in target.outputs]
    b, c, d = g[..., :nx, nx + target.input], g[..., rows, :nx], g[..., rows, nx + target.input]
    back = np.linalg.inv(target.s[:, None, None] * np.eye(nx) - g[..., None, :nx, :nx])
    x = (back @ b[..., None, :, None])[..., 0]
    response = (x @ np.swapaxes(c, -1, -2) + d[..., None, :]) * target.shift
    difference: Any = np.log(response) - target.log_response
    wrapped = difference.real + 1j * (np.mod(difference.imag + np.pi, 2 * np.pi) - np.pi)
    return target.weight * wrapped, response, x, back


@np.errstate(all="ignore")
def _misfit(
    targets: list[_Target], candidates: Float[np.ndarray, "k p"], *, derivatives: bool = False
) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, "k p"], Float[np.ndarray, "k p p"]]:
    """Return half the squared misfit of all candidates at once, with gradients and Gauss-Newton Hessians if asked."""
    k, p = candidates.shape
    cost, gradient, hessian = np.zeros(k), np.zeros((k, p)), np.zeros((k, p, p))
    for target in targets:
        nx, index = target.model.nx, np.array(target.index, dtype=int)
        rows, column = [nx + o for o in target.outputs], nx + target.input
        g, dg = (np.array(each) for each in zip(*map(target.model.matrices, candidates[:, index]), strict=True))
        try:
            r, response, x, back = _mismatch(target, g)
        except np.linalg.LinAlgError:
            if k == 1:
                return np.full(1, np.inf), np.zeros((1, p)), np.zeros((1, p, p))
            alone = [_misfit(targets, candidate[None], derivatives=derivatives) for candidate in candidates]
            cost, gradient, hessian = (np.concatenate(each) for each in zip(*alone, strict=True))
            return cost, gradient, hessian
        cost += 0.5 * np.sum(np.real(r) ** 2 + np.imag(r) ** 2, axis=(1, 2))
        if not derivatives:
            continue
        along, across = x.swapaxes(1, 2)[:, None], (0, 3, 2, 1)
        db, dc, dd = dg[:, :, :nx, column], dg[:, :, rows, :nx], dg[:, :, rows, column]
        moved = back @ ((dg[:, :, :nx, :nx] @ along).transpose(across) + db.swapaxes(1, 2)[:, None])
        slope = g[:, None, rows, :nx] @ moved + (dc @ along).transpose(across) + dd.swapaxes(1, 2)[:, None]
        j = ((target.weight / response * target.shift)[..., None] * slope).reshape(k, -1, index.size)
        turned = j.conj().swapaxes(1, 2)
        gradient[:, index] += (turned @ r.reshape(k, -1, 1)).real[..., 0]
        hessian[:, index[:, None], index] += (turned @ j).real
    lost = ~np.isfinite(cost)
    cost[lost], gradient[lost], hessian[lost] = np.inf, 0.0, 0.0
    return cost, gradient, hessian


@np.errstate(invalid="ignore")  # no gain where both are infinite
def _refine(
    targets: list[_Target], candidates: Float[np.ndarray, "k p"], low: Any, high: Any, spread: Any
) -> list[tuple[float, ParameterVector]]:
    """Gauss-Newton in the logarithms of the parameters, damped, from each candidate: their misfits, and where."""
    theta, damping, going = candidates.copy(), np.full(len(candidates), 1e-2), np.ones(len(candidates), dtype=bool)
    cost, gradient, hessian = _misfit(targets, theta, derivatives=True)
    diagonal = np.arange(theta.shape[1])
    for _ in range(25):
        at = np.flatnonzero(going)
        if not at.size:
            break
        scale = np.where(spread, theta[at], 0.0)
        h = hessian[at] * scale[:, :, None] * scale[:, None, :]
        sizes = h[:, diagonal, diagonal]
        h[:, diagonal, diagonal] += damping[at, None] * sizes + 1e-9 * (1.0 + np.max(sizes, axis=1, keepdims=True))
        step = np.clip(-np.linalg.solve(h, (gradient[at] * scale)[..., None])[..., 0], -1.5, 1.5)
        trial = np.clip(np.where(spread, theta[at] * np.exp(step), theta[at]), low, high)
        of_trial = _misfit(targets, trial, derivatives=True)
        better, gain = of_trial[0] < cost[at], cost[at] - of_trial[0]
        small = better & (gain < 1e-3 * cost[at])  # least squares in time goes on from here
        damping[at] = np.where(better, np.maximum(damping[at] / 5, 1e-9), damping[at] * 8)
        going[at] = ~(small | (~better & (damping[at] > 1e6)))
        for values, new in zip((theta, cost, gradient, hessian), (trial, *of_trial), strict=True):
            values[at[better]] = new[better]
    return [(float(each), values) for each, values in zip(cost, theta, strict=True)]
