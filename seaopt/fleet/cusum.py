r"""CUSUM charts of standardised innovations, and how often they raise an alarm where nothing has changed.

A chart of one parameter of one actuator has a run of value :math:`y_t` at a time, whose fit has the variance
:math:`R_t`. While nothing changes, :math:`y_t = \mu + u_t + v_t`, with v of the fit, and u of what differs from run to
run: of variance :math:`\sigma^2`, and alike in runs that follow each other, :math:`u_t = \phi u_{t-1} + w_t`. A Kalman
filter of :math:`\mu` and u, which knows nothing of :math:`\mu` before the first run, has the innovations

.. math:: z_t = (y_t - m_{t-1} - \phi \hat u_{t-1}) / s_t, \qquad t = 2, 3, \ldots

with their stds s. They are independent and standard normal, although the baseline is learnt from the same runs: for
:math:`\phi = 0` they are recursive residuals (Brown, Durbin and Evans 1975). Charts of them start by themselves
(Hawkins 1987) and need no healthy period. Where runs have heavy tails, or variances are estimates of few degrees of
freedom, Student's distribution is mapped to the normal one. An innovation counts for no more than `CLIP`, in chart and
baseline alike: one wild run raises no alarm, two that agree do. u follows it in full, for what is alike in the next
runs is a wild u too, which else would count again there; since it may be a wild v instead, the part of it that does not
count adds its square to the variance of u. Both sides are

.. math:: S^\pm_t = \max(0,\ S^\pm_{t-1} \pm z_t - k), \qquad \text{alarm where } S^\pm_t > h

(Page 1954). For the probability of an alarm within n runs, S between 0 and h is a Markov chain of many states (Brook
and Evans 1972). The threshold h is where that is what is allowed, shared out evenly (Bonferroni) among the charts of
an actuator and their two sides; clipping makes alarms rarer yet.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from scipy.special import ndtr, ndtri, stdtr

from seaopt.errors import SeaoptError
from seaopt.records import record
from seaopt.signals import VectorN

Runs = Float[np.ndarray, "actuators runs"]

ALLOWANCE = 0.5  # k: best for a change of one standard deviation
CLIP = 4.0
STATES = 200  # of the Markov chain: average run lengths are right within 0.1 %
LARGEST = 40.0  # threshold that is looked for
LEAST = 1e-6  # false_alarms: of each side of some thousand charts rounding then leaves digits
STEPS = 10  # to the most likely mean of Student's t
LEARNT_DOF = 1e6  # from where on a variance is known


def _make_chain(threshold: float) -> Float[np.ndarray, "m m"]:
    """Return the transitions of a one-sided chart among its states below the threshold; what is missing is alarm."""
    width = 2.0 * threshold / (2 * STATES - 1)  # the state of zero is half as wide: it has no values below
    steps = (np.arange(STATES)[None, :] - np.arange(STATES)[:, None]) * width + ALLOWANCE
    chain = ndtr(steps + width / 2) - ndtr(steps - width / 2)
    chain[:, 0] = ndtr(steps[:, 0] + width / 2)
    return chain


def alarm_probabilities(threshold: float, runs: int) -> VectorN:
    """Return the probabilities that a one-sided chart raises an alarm within 0, 1, ... runs, where nothing has changed.
    `threshold`: h, in standard deviations. `runs`: how many, at most.
    """
    chain, left = _make_chain(threshold), np.eye(STATES)[0]
    within = np.zeros(runs + 1)
    for run in range(runs):
        left = left @ chain
        within[run + 1] = 1.0 - left.sum()
    return within


@lru_cache(maxsize=64)
def choose_threshold(probability: float, runs: int, charts: int) -> float:
    """Return the threshold h with which an actuator of so many `charts`, a parameter each, raises a false alarm within
    `runs` runs with at most this probability. Raises SeaoptError: the probability is not between 1e-6 and 1.
    """
    if not 0.0 < probability < 1.0:
        raise SeaoptError(f"false_alarms = {probability:g} is no probability above 0 and below 1; give 0.01")
    if probability < LEAST:
        raise SeaoptError(f"false_alarms = {probability:g} is too small; give {LEAST:g} or more")
    from scipy.optimize import brentq  # deferred: 0.2 s

    share = probability / (2 * charts)

    def exceed(threshold: float) -> float:
        return float(np.log(max(alarm_probabilities(threshold, runs)[-1], 1e-15) / share))

    solver: Any = brentq
    return float(solver(exceed, 0.1, LARGEST, xtol=1e-4))


@record(eq=False)
class Charts:
    """Charts of one parameter: a row per actuator, a column per run."""

    # innovations over their stds; nan at the first run and where there is none
    ratios: Runs
    innovations: Runs  # the same as they counted
    # upper, lower: S+ and S-
    upper: Runs
    lower: Runs
    alarm: Int[np.ndarray, " actuators"]  # at which run the alarm was raised; -1 for none


def chart_runs(
    values: Runs,
    variances: Runs,
    threshold: float,
    *,
    between: float = 0.0,
    correlation: float = 0.0,
    scale: float = 1.0,
    dof: float = np.inf,
    start: int = 1,
) -> Charts:
    """Chart runs, the values of each actuator in the order of time.

    After an alarm the baseline stays as it was, so that it does not learn what is wrong.

    `values`: nan where an actuator has no run. `variances`: of each value: independent from run to run, as that of its
    fit. `threshold`: h, in standard deviations. `between`, `correlation`: variance between runs, and the correlation of
    that in runs that follow each other. `scale`, `dof`: of Student's t, of which innovations over their stds are; 1 and
    infinite where they are normal. `start`: runs that a baseline starts from, without a chart of them: of heavy tails
    several, by Student's t.
    """
    count, runs = values.shape
    ratios, innovations = np.full((2, count, runs), np.nan)
    sums, now, alarm = np.zeros((2, count, runs)), np.zeros((2, count)), np.full(count, -1)
    # mean and state u of each actuator, with their variances and covariance
    mean, state, begun = np.zeros(count), np.zeros(count), np.zeros(count, dtype=bool)
    of_mean, of_both, of_state = np.zeros(count), np.zeros(count), np.full(count, between)
    for run in range(runs):
        present = np.isfinite(values[:, run])
        charted = present & begun
        variance = np.where(present, variances[:, run], 1.0)
        state, of_both = correlation * state, correlation * of_both
        of_state = correlation**2 * of_state + (1.0 - correlation**2) * between
        spread = scale * np.sqrt(of_mean + 2.0 * of_both + of_state + variance)
        ratio = (values[:, run] - mean - state) / spread
        z = np.where(charted, np.clip(_normalise(ratio, dof), -CLIP, CLIP), 0.0)
        ratios[charted, run], innovations[charted, run] = ratio[charted], z[charted]
        now = np.where(charted, np.maximum(0.0, now + np.stack([z, -z]) - ALLOWANCE), now)
        sums[:, :, run] = now
        alarm[(alarm < 0) & np.any(now > threshold, axis=0)] = run
        # Kalman's gains, of the innovation as it counted
        total = (spread / scale) ** 2
        gain, gain_state = (of_mean + of_both) / total, (of_both + of_state) / total
        learns = charted & (alarm < 0)
        mean = mean + np.where(learns, gain * z * spread, 0.0)
        state = state + np.where(charted, gain_state * ratio * spread, 0.0)
        of_mean = of_mean - np.where(learns, gain**2 * total, 0.0)
        of_both = of_both - np.where(charted, gain * gain_state * total, 0.0)  # also of a mean that does not learn
        excess = (ratio - z) * spread
        of_state = of_state + np.where(charted, gain_state**2 * (excess**2 - total), 0.0)
        starts = present & ~begun & (run >= start - 1)
        if starts.any():
            begun |= starts
            mean[starts], of_mean[starts], of_both[starts] = _start(
                values[starts, : run + 1], variances[starts, : run + 1], between, correlation, scale, dof
            )
            state[starts], of_state[starts] = 0.0, between
    return Charts(ratios=ratios, innovations=innovations, upper=sums[0], lower=sums[1], alarm=alarm)


def _start(
    values: Runs, variances: Runs, between: float, correlation: float, scale: float, dof: float
) -> tuple[VectorN, VectorN, VectorN]:
    """Return the mean of the first runs, its variance, and its covariance with u of the last of them. They tell mean
    and u together, and nothing of u alone. Of several runs it is the most likely mean of Student's t.
    """
    present = np.isfinite(values)
    if values.shape[1] == 1:
        return values[:, 0], between + variances[:, 0], np.full(len(values), -between)
    count, apart = present.sum(axis=1), np.arange(values.shape[1])
    weights = present / (between + np.where(present, variances, 1.0))
    mean = np.nanmedian(values, axis=1)
    for _ in range(STEPS):
        square = np.where(present, (values - mean[:, None]) ** 2, 0.0) * weights / scale**2
        pulls = weights * (1.0 + 1.0 / dof) / (1.0 + square / dof)
        mean = np.sum(pulls * np.where(present, values, 0.0), axis=1) / pulls.sum(axis=1)
    alike = between * correlation ** np.abs(apart[:, None] - apart)
    pairs = present[:, :, None] & present[:, None, :]
    spread = np.where(pairs, alike, 0.0).sum(axis=(1, 2)) + np.where(present, variances, 0.0).sum(axis=1)
    spread *= (1.0 + 3.0 / dof) / (1.0 + 1.0 / dof)
    return mean, spread / count**2, -np.where(present, alike[-1], 0.0).sum(axis=1) / count


def _normalise(ratio: VectorN, dof: float) -> VectorN:
    """Return what is distributed as Student's t as what is standard normal."""
    if dof > LEARNT_DOF:
        return ratio
    return np.sign(ratio) * -ndtri(np.maximum(stdtr(dof, -np.abs(ratio)), 1e-300))


def find_change(values: VectorN, weights: VectorN) -> int:
    """Return from which run on a mean is another one: the step that is most likely, if there is one (Hinkley 1970).
    `weights`: one over the variances of the values, of at least two runs.
    """
    before = np.cumsum(weights)[:-1]
    after = weights.sum() - before
    below = np.cumsum(weights * values)[:-1]
    above = np.sum(weights * values) - below
    gain = (above / after - below / before) ** 2 * before * after / (before + after)
    return int(np.argmax(gain)) + 1
