"""What forbids to believe the intervals of a fit: a residual far above noise, values known only roughly, one event.

An interval holds where the residual is noise, or where logs of two amplitudes tell how far what the model lacks moves
the values (`second_log`). It has to be narrow enough to design with, and the log has to have the power to refute it.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from seaopt.estimation.judgement.second_log import FAR, SECOND, find_excess, has_two_amplitudes
from seaopt.estimation.problem.chance import exceeds
from seaopt.estimation.problem.experiment import Experiment
from seaopt.estimation.problem.fit_problem import FitProblem
from seaopt.estimation.problem.normal_equations import solve_seen
from seaopt.estimation.problem.residual_statistics import compute_residuals
from seaopt.estimation.problem.shapes import Signal, Vector
from seaopt.estimation.result.covariance import measure_colour
from seaopt.estimation.result.findings import FitFinding
from seaopt.estimation.result.fit_result import Fit, Minimum
from seaopt.estimation.result.model_error import ModelError
from seaopt.estimation.solver.least_squares import minimise
from seaopt.estimation.solver.step_shares import copy_steps
from seaopt.estimation.solver.step_size import STEP_ERROR_PARAMETER, STEP_ERROR_SIGMA
from seaopt.formatting import format_percent
from seaopt.logs.quality.faults import find_quantisation
from seaopt.parameters import QUANTILE, Parameter
from seaopt.plants.friction import list_smoothing
from seaopt.simulation.simulate import input_samples
from seaopt.units import unit_after

ROUGH = 0.2  # half of the width of an interval over its value, beyond which a value is known only roughly
DEPENDS = 0.7  # correlation from which half of a value's variance is that of another one
UNSEEN = 0.02  # of an output's spread: what may be zero is known well enough where half its interval does less
BLOCKS, EVENT = 64, 0.1  # of a log: in so many blocks an input moves or rests; and the longest event, as a share
MOVES = 0.01  # of the block in which an input moves the most
LOUD = 6.0  # standard deviations of a reading's noise in a block, above which it moves
FOLLOWED = 30.0  # standard deviations by which the outputs follow what is small: a tenth off is three of them off
MORE = 1.5  # times the variance by white noise of its size, that rounding makes of a value: worth a word
CHANCE = 4.5e-5  # with which a log's residual falls by chance as far as is taken for a wrong state at its start
HALF = 0.5  # of a residual's power: what leaves less is another explanation, wherever the values are
NEAR, ITERATIONS = 1e-2, 8  # squared standard deviations that may be left to a minimum, and steps to come so near
FAINT = 1e-6  # of an output's spread: a residual that is less is no motion
ROUNDING = 1e-12  # of what an unknown does: less of it left is rounding
READING = 0.05  # of a constant, up to which what is white about it is a reading's noise


def find_excesses(fit: Fit) -> Iterator[FitFinding]:
    """Yield plants whose residual is far above their sensors' noise: errors without logs of two amplitudes."""
    for plant in dict.fromkeys(experiment.plant.name for experiment in fit.experiments):
        excess = find_excess(fit, plant)
        if excess <= FAR:
            continue
        where = next(
            f"{name}.{output}"
            for name, row in fit.outputs.items()
            for output, figures in row.items()
            if figures.excess == excess
        )
        told = has_two_amplitudes(fit.logs, plant)
        what = f"its residual is {excess:.3g} times its sensor's noise: the model lacks something"
        if told:
            text = f"{what}, and the intervals are as wide as the values differ between the logs' amplitudes"
        else:
            several = sum(experiment.plant.name == plant for experiment in fit.experiments) > 1
            alone = sum(log.determined and log.plant == plant for log in fit.logs.values()) > 1
            advice = (
                "logs that do not determine them one by one do not tell: fix what is known"
                if several and not alone
                else "one amplitude does not tell: record a second log at half the amplitude and give both"
            )
            text = (
                f"{what}, and how far that moves the values {advice}; or give the sensor's noise, sigma, where it is "
                "no white noise"
            )
        yield FitFinding(severity="warning" if told else "error", kind="excess", where=where, text=text)


def find_rough(fit: Fit, error: ModelError) -> Iterator[FitFinding]:
    """Yield free parameters whose interval is wider than a design can use. One that may be zero, as a friction that a
    plant need not have, is known well enough where it hardly does anything; how large an effect is that a part brings
    does not have to be known, as long as the actuator's values do not depend on it.

    How wide an interval is, is told over the value; over the hypotenuse of both where two are components of one size,
    as cogging's sine and cosine are: where the encoder has its zero splits it between them, and may leave nothing to
    one.
    """
    if fit.status != "converged":
        return
    plants = {experiment.plant.name: experiment.plant for experiment in fit.experiments}.values()
    sizes = _measure_waves(fit)
    smoothing, rough = {name for plant in plants for name in list_smoothing(plant)}, list[str]()
    for name in fit.covariance.names:
        parameter = fit.parameters[name]
        half = QUANTILE * (parameter.total_std or 0.0)
        if parameter.known is None or not parameter.identified or parameter.at_bound:
            continue
        if half <= ROUGH * max(abs(parameter.value), sizes.get(name, 0.0)):
            continue
        if name in smoothing:  # a means of the simulation, no figure of the actuator
            continue
        defaults = (plant.parameters.get(name) for plant in plants)
        may_be_zero = any(isinstance(default, Parameter) and default.value == 0.0 for default in defaults)
        if not may_be_zero or half * error.effect[error.names.index(name)] > UNSEEN:
            rough.append(name)
    effects = _list_effects(fit) if rough else set[str]()  # makes plants anew
    for name in rough:
        yield FitFinding(
            severity="warning" if name in effects else "error",
            kind="rough",
            where=name,
            text=f"known only roughly, no better than to {format_percent(ROUGH, 2)}: excite it more, measure another "
            "output, or fix it, or give it a prior, at what is known of it from elsewhere",
        )


def find_rounding(fit: Fit, error: ModelError) -> Iterator[FitFinding]:
    """Yield outputs of which rounding decides the noise, and moves a value more than white noise would, with the line
    that states their step.
    """
    free = [i for i, name in enumerate(error.names) if name in fit.covariance.names]
    for experiment in fit.require_minimum("find_rounding").problem.experiments:
        for output in experiment.outputs:
            variances = error.rounding.get(output.label, np.ones(len(error.names)))[free]
            if not free or np.max(variances) <= MORE:
                continue
            most = free[int(np.argmax(variances))]
            times = math.sqrt(error.rounding[output.label][most])
            step = find_quantisation(np.concatenate(output.measured))
            line = f"quantisation = {{ {output.name} = {step:.6g} }}"
            yield FitFinding(
                severity="note",
                kind="quantisation",
                where=output.label,
                text=f"its readings are rounded to steps of {step:.4g}{unit_after(output.unit)}, whose error follows "
                f"the motion: it moves {error.names[most]} by {times:.2g} times what white noise of its size would. "
                f"The intervals allow for it, and for noise of any other colour; {line} in its [[experiment]] takes "
                "the error as uniform",
                proposal=f"[[experiment]]\n{line}",
                python=f'so.Experiment(..., quantisation={{"{output.name}": {step:.6g}}})',
            )


def find_wrong_starts(fit: Fit) -> Iterator[FitFinding]:
    """Yield logs that do not begin in the state that is stated: with it free, their residuals fall by more than chance
    makes of residuals of this colour. Where that moves values beyond their intervals, these are not to be believed. One
    step from the minimum tells, but where joints stick: it throws one that is to be found in motion.
    """
    minimum = fit.require_minimum("find_wrong_starts")
    problem = minimum.problem
    stated = {e.name for e in problem.experiments if e.data.initial_state != "estimate"}
    if not stated or fit.status != "converged":
        return
    freed, at, states = free_starts(minimum, stated)
    if not any(states.values()):  # the fit's band has forgotten how they begin
        return
    first = freed.evaluate(at)
    if not np.all(np.isfinite(first.hessian)):
        return
    step = solve_seen(first.hessian, -first.gradient, ROUNDING)
    second = freed.evaluate(np.clip(first.z + step, freed.unknowns.low, freed.unknowns.high))
    nearer = min(first, second, key=lambda evaluation: evaluation.cost)
    low, high = freed.unknowns.low, freed.unknowns.high
    best = minimise(freed, nearer, low, high, decrement=NEAR, max_iterations=ITERATIONS).evaluation
    fitted, values = problem.evaluate(minimum.z).power, freed.unknowns.by_name(best.z)
    moved = {name: abs(values[name] - fit.parameters[name].value) for name in fit.covariance.names}
    beyond = {n: away for n, away in moved.items() if away > QUANTILE * (fit.parameters[n].total_std or 0.0)}
    colour = measure_colour(fit.covariance, fit.white_covariance)
    for experiment in problem.experiments:
        name, sizes = experiment.name, experiment.sigma / np.maximum(experiment.spread, 1e-300)
        if not states.get(name):
            continue
        before, after = fitted[name].rms, best.power[name].rms
        falls = np.log(np.maximum(before, 1e-300) / np.maximum(after, 1e-300))
        # Each state that is freed takes some away.
        by_chance = exceeds(0.5 * states[name], float(fitted[name].counts @ falls) / colour)
        # Of simulated logs without noise the residual is rounding, and the integration's error.
        if by_chance > CHANCE or np.max(before * sizes) < FAINT:
            continue
        gone = 1.0 - math.exp(-2.0 * float(np.max(falls)))
        most = max(beyond, key=lambda n: beyond[n] / max(abs(values[n]), 1e-300), default="")
        moves = f", and {most} = {values[most]:.4g} in place of {fit.parameters[most].value:.4g}" if most else ""
        yield FitFinding(
            severity="error" if beyond or gone > HALF else "warning",
            kind="initial",
            where=name,
            text="does not begin at rest, or in the state that initial_state states: with that free, "
            f"{format_percent(gone)} of a residual's power is gone{moves}; leave it free, with initial_state = "
            '"estimate", or cut the log to where it rests, with slice_s',
            proposal='[[experiment]]\ninitial_state = "estimate"',
            python='so.Experiment(..., initial_state="estimate")',
        )


def free_starts(minimum: Minimum, stated: Collection[str]) -> tuple[FitProblem, Vector, dict[str, int]]:
    """Return the problem with the states free in which some experiments begin, the minimum in it, and how many states
    of each are free.
    """
    problem = minimum.problem
    changed = {e.name: replace(e.data, initial_state="estimate") for e in problem.experiments if e.name in stated}
    freed, at = problem.rebuild(problem.params, minimum.z, changed)
    states = dict.fromkeys(stated, 0)
    for old, new in zip(problem.experiments, freed.experiments, strict=True):
        for before, after in zip(old.segments, new.segments, strict=True):
            for known, slot in zip(before.initial, after.initial, strict=True):
                if old.name in stated and slot.index is not None:
                    at[slot.index] = known.at(minimum.z)
                    states[old.name] += 1
    return copy_steps(freed, problem), at, states


def _measure_waves(fit: Fit) -> dict[str, float]:
    """Return the size of the wave that each of its components is part of."""
    readings = [reading for e in fit.experiments for reading in e.plant.followed.values()]
    pairs = [(name, reading.sizes) for reading in readings for name in reading.sizes]
    return {name: math.hypot(*(fit.parameters[each].value for each in both)) for name, both in pairs}


def find_step_error(fit: Fit) -> Iterator[FitFinding]:
    """Yield that the finest integration steps leave more error than they should, though too little to refuse a fit."""
    output, moved = fit.step_error_sigma, fit.step_error_parameter
    if fit.status == "converged" and (output > STEP_ERROR_SIGMA or moved > STEP_ERROR_PARAMETER):
        yield FitFinding(
            severity="warning",
            kind="step",
            where="",
            text=f"the finest integration steps leave an error of {format_percent(output, 2)} of a sensor's noise, "
            f"which moves values by up to {moved:.2g} of their std; up to {format_percent(STEP_ERROR_SIGMA, 2)} and "
            f"{STEP_ERROR_PARAMETER:.2g} are meant to be left",
        )


def _list_effects(fit: Fit) -> set[str]:
    """Return the free parameters that parts bring around an actuator, and that none of its own values depends on."""
    added = set[str]()
    for experiment in fit.experiments:
        recipe, plant = experiment.plant.recipe, experiment.plant
        added |= plant.parameters.keys() - recipe.make(()).parameters.keys() if recipe is not None else set()
    names, matrix = fit.total_covariance.names, fit.total_covariance.matrix
    stds = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    own = [i for i, name in enumerate(names) if name not in added]
    return {
        name
        for i, name in enumerate(names)
        if name in added and not np.any(np.abs(matrix[i, own]) > DEPENDS * stds[i] * stds[own])
    }


def find_single_event(experiments: Sequence[Experiment], minimum: Minimum | None = None) -> Iterator[FitFinding]:
    """Yield that one step is all that happens to every plant, in one log or in several alike: any model follows it with
    some values, which nothing refutes. Logs that are too short to tell are no evidence. What an input does before and
    after its step is a reading's noise, unless the outputs of the `minimum` follow it.
    """
    sizes: dict[str, list[list[float] | None]] = {}
    for experiment in experiments:
        if experiment.log.time.size > 2 * BLOCKS:
            sizes.setdefault(experiment.plant.name, []).append(_measure_event(experiment))
    if not sizes or not all(map(_are_alike, sizes.values())):
        return
    if minimum is not None and _follows_small(minimum):
        return
    yield FitFinding(
        severity="error",
        kind="event",
        where=", ".join(experiment.name for experiment in experiments),
        text="its inputs move once and rest: one step tests no model, however often it is logged, and other values "
        "follow it as well; record steps of several sizes, or an input that moves throughout",
    )


def _are_alike(sizes: Sequence[list[float] | None]) -> bool:
    """Tell whether logs have one step each, of about one size."""
    steps = [size for size in sizes if size is not None]
    return (
        len(steps) == len(sizes)
        and bool(np.any(steps))
        and not np.any(np.min(steps, axis=0) < SECOND * np.max(steps, axis=0))
    )


def _measure_event(experiment: Experiment) -> list[float] | None:
    """Return how far each input moves where all move once, from their values before the log, zero, where they are
    constant; None where one moves for longer.
    """
    plant, sizes = experiment.plant, list[float]()
    for name, values in zip(plant.inputs, input_samples(plant, experiment.log), strict=True):
        if name == plant.clock:
            continue
        steps = np.diff(values)
        middle, noise = float(np.mean(values)), float(np.std(values))
        if noise <= READING * abs(middle) and np.var(steps) >= noise**2:  # a reading that is white about a constant
            sizes.append(abs(middle))
            continue
        first, last = _find_moves(values)
        if last - first > EVENT * BLOCKS:
            return None
        sizes.append(float(np.ptp(values)))
    return sizes


def _find_moves(values: Signal) -> tuple[int, int]:
    """Return the blocks from an input's first move to its last, which is left out; none where it never moves."""
    power = _sum_blocks(np.diff(values) ** 2)
    rest, largest = float(np.median(power)), float(np.ptp(values))
    power -= rest  # of a reading's noise
    moves = power > MOVES * np.max(power)
    # Of what changes from sample to sample: twice the variance of what is white.
    square = rest / math.ceil(values.size / BLOCKS)
    small = values.size > BLOCKS and 0.0 < 0.5 * square <= (READING * largest) ** 2
    blocks = np.array_split(values, BLOCKS) if small else []
    if small and float(np.median([np.var(block) for block in blocks])) <= square:  # white
        means = np.diff([float(np.mean(block)) for block in blocks], prepend=float(np.mean(blocks[0])))
        spread = 1.4826 * float(np.median(np.abs(power - np.median(power))))
        moves &= power > LOUD * spread
        moves |= np.abs(means) > max(LOUD * np.sqrt(square / blocks[0].size), MOVES**0.5 * np.max(np.abs(means)))
    moving = np.flatnonzero(moves)
    return (int(moving[0]), int(moving[-1]) + 1) if moving.size and largest > 0.0 else (0, 0)


def _sum_blocks(values: Signal) -> Float[np.ndarray, " blocks"]:
    """Return the sums over blocks that are cut as `np.array_split` cuts them."""
    if values.size < BLOCKS:  # some of them are empty, of which reduceat makes what follows them
        return np.array([float(np.sum(block)) for block in np.array_split(values, BLOCKS)])
    sizes = values.size // BLOCKS + (np.arange(BLOCKS) < values.size % BLOCKS)
    return np.add.reduceat(values, np.cumsum(sizes) - sizes)


def _follows_small(minimum: Minimum) -> bool:
    """Tell whether outputs follow what inputs do while they rest: whether residuals grow where that is left out."""
    problem, z = minimum.problem, minimum.z
    flat = {each.name: _flatten(each.data) for each in problem.experiments}
    without = compute_residuals(*problem.rebuild(problem.params, z, flat))
    gain = 0.0
    for name, residuals in minimum.residuals().items():
        before, after = (np.sum(each.weighted**2, axis=0) for each in (residuals, without[name]))
        counts = np.count_nonzero(residuals.weighted, axis=0)
        gain += float(np.sum((after - before) * counts / np.maximum(before, 1e-300)))
    return gain > FOLLOWED**2


def _flatten(experiment: Experiment) -> Experiment:
    """Return an experiment whose inputs are constant before their moves, and after."""
    plant, log = experiment.plant, experiment.log
    values = {name: log[name] for name in log.signals}
    for name, column in zip(plant.inputs, input_samples(plant, log), strict=True):
        if name not in values or name == plant.clock:
            continue
        rows = np.array_split(np.arange(column.size), BLOCKS)
        first, last = _find_moves(column)
        flat = column.copy()
        for rest in (rows[:first], rows[last:]):
            if rest:
                flat[np.concatenate(rest)] = np.mean(column[np.concatenate(rest)])
        values[name] = flat
    return replace(experiment, log=log.with_values(log.time, values, "inputs at rest are constant"))


def leaves_something(fit: Fit, findings: Sequence[FitFinding], error: ModelError, most: float) -> bool:
    """Tell whether a fit leaves something to look into, as an excess above `most`."""
    warned = any(finding.severity != "note" for finding in findings)
    return warned or fit.status != "converged" or any(ratio > most for ratio in error.excess.values())
