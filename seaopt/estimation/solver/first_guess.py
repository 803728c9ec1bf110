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
    refined = [_refine(targets, start, low, high, spread)]
    enough = 0.5 * EXPLAINED_MISFIT**2 * 2 * sum(int(np.count_nonzero(target.weight)) for target in targets)
    if refined[0][0] > enough:
        candidates = [
            np.clip(start * np.where(spread, 10.0 ** rng.uniform(-1.2, 1.2, start.size), 1.0), low, high)
            for _ in range(CANDIDATES)
        ]
        ranked = np.argsort(_misfits(targets, candidates), kind="stable")
        refined += [_refine(targets, candidates[k], low, high, spread) for k in ranked[:REFINED_CANDIDATES]]
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
        if target is not None and (len(active) == 1 or np.isfinite(_misfit([target], theta)[0])):
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


def _misfits(targets: list[_Target], candidates: list[ParameterVector]) -> Float[np.ndarray, " k"]:
    """Return half the squared misfit of each candidate, of all at once."""
    costs = np.zeros(len(candidates))
    for target in targets:
        g = np.array([target.model.matrices(theta[target.index])[0] for theta in candidates])
        try:
            r, _, _, _ = _mismatch(target, g)
        except np.linalg.LinAlgError:  # of one of them
            return np.array([_misfit(targets, theta)[0] for theta in candidates])
        costs += 0.5 * np.sum(np.real(r) ** 2 + np.imag(r) ** 2, axis=(1, 2))
    return np.where(np.isfinite(costs), costs, np.inf)


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


def _misfit(targets: list[_Target], theta: ParameterVector, derivatives: bool = False) -> tuple[float, Any, Any]:
    """Return half the squared misfit, and its gradient and Gauss-Newton Hessian if asked."""
    cost, gradient, hessian = 0.0, np.zeros(theta.size), np.zeros((theta.size, theta.size))
    for target in targets:
        nx, rows = target.model.nx, [target.model.nx + o for o in target.outputs]
        g, dg = target.model.matrices(theta[target.index])
        try:
            r, response, x, back = _mismatch(target, g)
        except np.linalg.LinAlgError:
            return np.inf, gradient, hessian
        if not np.all(np.isfinite(r)):
            return np.inf, gradient, hessian
        cost += 0.5 * float(np.vdot(r, r).real)
        if derivatives:
            c, db, dc = g[rows, :nx], dg[:, :nx, nx + target.input], dg[:, rows, :nx]
            moved = back @ ((dg[:, :nx, :nx] @ x.T).transpose(2, 1, 0) + db.T)
            slope = c @ moved + (dc @ x.T).transpose(2, 1, 0) + dg[:, rows, nx + target.input].T
            j = ((target.weight / response * target.shift)[:, :, None] * slope).reshape(r.size, -1)
            gradient[target.index] += (j.conj().T @ r.ravel()).real
            columns = np.array(target.index)
            hessian[columns[:, None], columns] += (j.conj().T @ j).real
    return cost, gradient, hessian


def _refine(
    targets: list[_Target], theta: ParameterVector, low: Any, high: Any, spread: Any
) -> tuple[float, ParameterVector]:
    """Gauss-Newton in the logarithms of the parameters, damped."""
    damping = 1e-2
    cost, gradient, hessian = _misfit(targets, theta, derivatives=True)
    for _ in range(25):
        scale = np.where(spread, theta, 0.0)
        h = hessian * np.outer(scale, scale)
        h[np.diag_indices(theta.size)] += damping * np.diag(h) + 1e-9 * (1.0 + np.max(np.diag(h)))
        step = np.clip(-np.linalg.solve(h, gradient * scale), -1.5, 1.5)
        trial = np.clip(np.where(spread, theta * np.exp(step), theta), low, high)
        trial_cost, trial_gradient, trial_hessian = _misfit(targets, trial, derivatives=True)
        if trial_cost < cost:
            small = cost - trial_cost < 1e-3 * cost  # least squares in time goes on from here
            theta, cost, gradient, hessian = trial, trial_cost, trial_gradient, trial_hessian
            damping = max(damping / 5, 1e-9)
            if small:
                break
        else:
            damping *= 8
            if damping > 1e6:
                break
    return cost, theta
