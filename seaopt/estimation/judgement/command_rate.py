r"""Was the command held at a faster rate than the log's? A log of every second tick has half of what was commanded.

What acts between two rows is then not the value of the row, and the fit makes up for that by what it has: a shorter
delay, damping, or nothing. Two kinds of commands leave different traces.

A smooth one can be had back between its rows, by a polynomial through twelve of them. With D values a row the outputs
come (1 - 1/D) / 2 rows sooner than with one. The fit is refitted so, which takes a few iterations, and where that
removes the excess the rate is the one that leaves the least. Inputs that are stamped late do nearly the same: refitted
with a free shift of its rows, the logs have to be nearer to the interpolated ones than to these. Where neither is
nearer the rate is named beside the other causes, and where the shift is it is not.

A delay that is free makes up for it so well that there is hardly an excess: with twice the values a row it is a quarter
of a row longer. One step from the minimum tells whether the logs speak against that. Where they do not, the delay is
named as what such a log does not tell; where they speak for it the rate is, and the intervals reach to the values with
it.

Of one that changes from tick to tick, as binary noise, the rows tell nothing about what lies between them. With
the spectrum F of what is white in the rows, and S of all of them, the outputs follow the rows at a frequency only to

.. math:: \gamma^2 = 1 - (1 - 1/D) F / S

(the white part of the rows is D times folded, of which one is the output's): half of their power where S = F and
D = 2, alike at all frequencies and of all outputs, which no lack of physics does. A random force as large as the
command would look alike, so that other causes are still looked for, though not for long.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Literal

import numpy as np
from jaxtyping import Float

from seaopt import welch
from seaopt.errors import SeaoptError
from seaopt.estimation.judgement.candidates import lead_inputs
from seaopt.estimation.judgement.causes import ENOUGH
from seaopt.estimation.judgement.coherence import Octave, measure_octaves
from seaopt.estimation.judgement.score_test import free_delay
from seaopt.estimation.judgement.second_log import FAR
from seaopt.estimation.problem.experiment import Experiment
from seaopt.estimation.problem.fit_problem import Evaluation, FitProblem
from seaopt.estimation.problem.noise_floor import NoiseFloor
from seaopt.estimation.problem.residual_statistics import ResidualsByExperiment
from seaopt.estimation.problem.shapes import Signal, Vector
from seaopt.estimation.result.covariance import measure_colour
from seaopt.estimation.result.findings import FitFinding
from seaopt.estimation.result.fit_result import Fit, Minimum
from seaopt.estimation.solver.least_squares import find_blocked
from seaopt.estimation.solver.settle import measure_misfit, settle_roughly
from seaopt.estimation.solver.step_shares import copy_steps
from seaopt.formatting import format_percent
from seaopt.records import record
from seaopt.signals import HOLDS, weigh_points

RATES = (2, 3, 4, 5, 10)  # values a row that are tried, as long as each is better than the one before
POINTS = np.arange(-5.0, 7.0)  # rows of a polynomial, about the two that a value lies between
FAST, SMOOTH = 0.35, 0.05  # of the rate, above which a command that its rows tell has so much of its changes' power
FIRST = 4  # iterations, after which a refit has to be nearer to the logs than the fit
NOISE, HIGH = 1.5, 3.0  # times its noise, that a residual may be at the end; and where it was seven times that
FALLS = 1.0 / 7.0
QUIET, WHITE = 0.2, 2.0  # noise over an output's power in an octave, and an input's power over that of the last one
FEWEST = 2  # such octaves
SHARE, SPREAD = (0.4, 0.95), 1.7  # of the power that follows no row, over F / S, and of the largest over the least
READING = ', or, where the column is a measured current, give hold = "first"'


@record(eq=False)
class UnloggedCommand:
    """What says that a command was held at a faster rate than its log's."""

    findings: tuple[FitFinding, ...]
    # "certain": nothing else is to be looked for; "likely": hardly anything, and what leaves an excess is no cause;
    # "possible": something else explains as much
    standing: Literal["certain", "likely", "possible"]
    values: Mapping[str, float] | None = None  # of all unknowns, to which their intervals are to reach


def find_unlogged_command(
    fit: Fit, residuals: ResidualsByExperiment, floors: Mapping[str, NoiseFloor], excess: Mapping[str, float]
) -> UnloggedCommand | None:
    """Return that the command changes between the rows of the logs; None where nothing speaks for it. `fit`: with its
    minimum; `residuals`, `floors`, `excess`: there.
    """
    minimum = fit.require_minimum("find_unlogged_command")
    experiments = [e.data for e in minimum.problem.experiments]
    plain = all(e.hold == "zero" and not e.feedback and len(e.log_segments) == e.shots == 1 for e in experiments)
    first = max(excess.values(), default=0.0)
    if not plain or minimum.problem.predicts or any(e.plant.followed or HOLDS in e.log.signals for e in experiments):
        return None  # a command that is known to be held over rows is none that changes between them
    commands = [e.log[name] for e in experiments for name in _list_commands(e)]
    if not commands or not all(np.all(np.isfinite(command)) for command in commands):
        return None
    if all(map(_is_smooth, commands)):
        try:
            return _weigh_rates(fit, minimum) if first <= FAR else _fill_rows(fit, minimum, floors, first)
        except SeaoptError:  # nothing that can be simulated, or in time
            return None
    if first <= FAR:
        return None
    octaves = ((e.data, measure_octaves(e, residuals[e.name], floors[e.name])) for e in minimum.problem.experiments)
    white = tuple(finding for e, each in octaves if (finding := _find_white(e, each)) is not None)
    return UnloggedCommand(findings=white, standing="likely") if white else None


def _list_commands(experiment: Experiment) -> list[str]:
    """Return the inputs of an experiment that its log has, and that move."""
    plant, log = experiment.plant, experiment.log
    return [n for n in plant.inputs if n in log.signals and n != plant.clock and np.ptp(log[n]) > 0.0]


def _is_smooth(command: Signal) -> bool:
    """Tell whether the rows of a command tell what lies between them: whether little changes from row to row."""
    changes = np.diff(command)
    power = welch.square(np.fft.rfft(changes * welch.hann(changes.size)))
    return float(np.sum(power[int(2.0 * FAST * power.size) :])) <= SMOOTH * float(np.sum(power))


def interpolate(values: Signal, count: int) -> Float[np.ndarray, " m"]:
    """Return `count` values for each, those between on polynomials through twelve."""
    padded = np.pad(values, (int(-POINTS[0]), int(POINTS[-1])), mode="edge")
    rows = np.stack([padded[i : i + values.size] for i in range(POINTS.size)], axis=1)
    weights = np.stack([weigh_points(POINTS, j / count) for j in range(count)], axis=1)
    return (rows @ weights).ravel()


def _fill_rows(fit: Fit, minimum: Minimum, floors: Mapping[str, NoiseFloor], first: float) -> UnloggedCommand | None:
    """Return the finding of commands that are had back between their rows; None where these leave an excess, too."""
    problem, best = minimum.problem, minimum.problem.evaluate(minimum.z)
    fitted, least, found = best, measure_misfit(best), None
    for count in RATES:
        evaluation = _refit(problem, minimum.z, count, least)
        if evaluation is None or not measure_misfit(evaluation) < least:
            break
        best, least, found = evaluation, measure_misfit(evaluation), count
        if count == RATES[0] and _measure_left(problem, best, floors) > max(HIGH, first / 2.0):
            return None  # twice as many values take more than half of it
    left = _measure_left(problem, best, floors)
    if found is None or (left > NOISE and (left > HIGH or left > FALLS * first)):
        return None
    shifted = _refit_late(problem, minimum.z, found)
    nearer = 0.5 * fit.samples * (_measure_mean(shifted) - _measure_mean(best))  # of log-likelihood
    if nearer < -ENOUGH:
        return None
    gone = 1.0 - min(
        float(np.min((best.power[e.name].rms / np.maximum(fitted.power[e.name].rms, 1e-300)) ** 2))
        for e in problem.experiments
    )
    seen = f"with the values between interpolated {format_percent(gone)} of a residual's power is gone"
    certain = nearer > ENOUGH
    if not certain:
        seen += ", and as much with inputs that are stamped late"
    findings = tuple(_state(e.data, found, seen, READING, certain=certain) for e in problem.experiments)
    return UnloggedCommand(findings=findings, standing="certain" if certain else "possible")


def _weigh_rates(fit: Fit, minimum: Minimum) -> UnloggedCommand | None:
    """Return what the logs tell of commands that are had back between their rows, where free delays may make up for
    them; None where they speak against those.
    """
    problem, colour = minimum.problem, measure_colour(fit.covariance, fit.white_covariance)
    if fit.status != "converged" or any(e.slots.delay.index is None for e in problem.experiments):
        return None
    fitted, enough = problem.evaluate(minimum.z), ENOUGH * colour
    best, found, nearer = fitted, RATES[0], -np.inf
    for count in RATES:
        filled, start = _pose_filled(problem, minimum.z, count)
        evaluation = filled.evaluate(start)
        free = ~find_blocked(evaluation, filled.unknowns.low, filled.unknowns.high)
        promised = fitted.cost - evaluation.cost + 0.5 * evaluation.distance_squared(free)
        if not promised > max(nearer, -enough):
            break
        evaluation = settle_roughly(filled, evaluation, checked=True).solution.evaluation
        gain = 0.5 * (measure_misfit(fitted) - measure_misfit(evaluation))
        if not gain > max(nearer, -enough):
            break
        best, found, nearer = evaluation, count, gain
        if nearer < enough:
            break
    if not np.isfinite(nearer):
        return None
    if nearer < enough:
        findings = tuple(_state_open(e.data, found) for e in problem.experiments)
        return UnloggedCommand(findings=findings, standing="possible")
    seen = f"with the values between interpolated the logs are e^{nearer:.3g} times as likely, and the delay longer"
    findings = tuple(_state(e.data, found, seen, READING, certain=False) for e in problem.experiments)
    return UnloggedCommand(findings=findings, standing="possible", values=problem.unknowns.by_name(best.z))


def _refit_late(problem: FitProblem, z: Vector, count: int) -> Evaluation:
    """Return a rough minimum with the rows of each input as they are, and as much earlier or later as suits the
    outputs: from where so many values of each would put them.
    """
    delays = {
        e.name: e.period + (e.slots.delay.value if e.slots.delay.index is None else float(z[e.slots.delay.index]))
        for e in problem.experiments
    }
    data = {e.name: free_delay(lead_inputs(e.data, 1), delays[e.name]) for e in problem.experiments}
    shifted, start = problem.rebuild(problem.params, z, data)
    start = start.copy()
    for e in shifted.experiments:
        start[e.slots.delay.index] = max(delays[e.name] - 0.5 * (1.0 - 1.0 / count) * e.period, 0.0)
    shifted = copy_steps(shifted, problem)
    return settle_roughly(shifted, shifted.evaluate(start), checked=True).solution.evaluation


def _measure_mean(evaluation: Evaluation) -> float:
    """Return the misfit of a sample."""
    return measure_misfit(evaluation) / sum(float(np.sum(power.counts)) for power in evaluation.power.values())


def _refit(problem: FitProblem, z: Vector, count: int, least: float) -> Evaluation | None:
    """Return a rough minimum with so many values of each command a row, the outputs as they are; None where a few
    iterations come to no less of a misfit.
    """
    filled, start = _pose_filled(problem, z, count)
    points = 0

    def ends(evaluation: Evaluation) -> bool:
        nonlocal points
        points += 1
        return points > FIRST and not measure_misfit(evaluation) < least

    found = settle_roughly(filled, filled.evaluate(start), ends=ends, checked=True).solution.evaluation
    return found if np.isfinite(found.cost) else None


def _pose_filled(problem: FitProblem, z: Vector, count: int) -> tuple[FitProblem, Vector]:
    """Return the problem with so many values of each command a row, the outputs as they are, and where it begins."""
    data = {e.name: _fill(e.data, count) for e in problem.experiments}
    filled, start = problem.rebuild(problem.params, z, data)
    start, low = start.copy(), filled.unknowns.low
    for e in filled.experiments:  # what the fit's delay lacks, but for a bound
        place = e.slots.delay.index
        if place is not None and start[place] > low[place]:
            start[place] += 0.5 * (count - 1) * e.period
    return copy_steps(filled, problem), start


def _fill(experiment: Experiment, count: int) -> Experiment:
    """Return an experiment with so many rows for each, of which its outputs have the first."""
    log, commands = experiment.log, _list_commands(experiment)
    values = dict[str, Signal]()
    for name in log.signals:
        if name in commands:
            values[name] = interpolate(log[name], count)
        elif name in experiment.outputs:
            values[name] = np.full(count * len(log), np.nan)
            values[name][::count] = log[name]
        else:
            values[name] = np.repeat(log[name], count)
    time = log.time[0] + np.arange(count * len(log)) * (log.period / count)
    return replace(experiment, log=log.with_values(time, values, f"{count} rows for each, interpolated"))


def _measure_left(problem: FitProblem, evaluation: Evaluation, floors: Mapping[str, NoiseFloor]) -> float:
    """Return how many times the noise that the fit's residuals have, those of an evaluation are at most."""
    noise = {e.name: np.maximum(floors[e.name].noise * e.sigma, 1e-300) for e in problem.experiments}
    return max(float(np.max(evaluation.power[name].rms / each)) for name, each in noise.items())


def _find_white(experiment: Experiment, octaves: Iterable[Octave]) -> FitFinding | None:
    """Return the finding of commands that change from tick to tick: from octaves in which noise is little and the rows
    are white.
    """
    told = [octave for octave in octaves if octave.noise <= QUIET and octave.input <= WHITE]
    shares = np.array([(1.0 - np.clip(o.follows / (1.0 - o.noise), 0.0, 1.0)) * o.input for o in told])
    if shares.size < FEWEST:
        return None
    least, most = float(np.min(shares)), float(np.max(shares))
    if least < SHARE[0] or most > min(SHARE[1], SPREAD * least):
        return None
    share = float(np.average(shares, weights=[octave.lines for octave in told]))
    low, high = min(o.band_hz[0] for o in told), max(o.band_hz[1] for o in told)
    seen = (
        f"alike at all frequencies from {low:.3g} to {high:.3g} Hz, {format_percent(share, 2)} of the outputs' power "
        "follows no row of it, as if a random force as large acted on the motor"
    )
    return _state(experiment, max(round(1.0 / (1.0 - share)), 2), seen)


def _state(experiment: Experiment, count: int, seen: str, besides: str = "", *, certain: bool = True) -> FitFinding:
    logged_hz = 1.0 / experiment.log.period
    return FitFinding(
        severity="error" if certain else "warning",
        kind="command",
        where=experiment.name,
        text=f"the command {'was' if certain else 'may have been'} held at a faster rate than the {logged_hz:.4g} Hz "
        f"of the log: at about {count * logged_hz:.4g} Hz, {count} values for each that is logged ({seen}); log every "
        f"tick, or command at the log's rate{besides}",
        rate_hz=count * logged_hz,
    )


def _state_open(experiment: Experiment, count: int) -> FitFinding:
    period = experiment.log.period
    return FitFinding(
        severity="note",
        kind="command",
        where=experiment.name,
        text=f"the log does not tell whether the command was held at its rate of {1.0 / period:.4g} Hz or at a faster "
        f"one: at {count / period:.4g} Hz the delay would be {500.0 * (1.0 - 1.0 / count) * period:.3g} ms "
        "longer, which its interval does not allow for; one with more at high frequencies would tell",
        rate_hz=count / period,
    )
