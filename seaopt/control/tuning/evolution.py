r"""Look for a law that keeps the limits by differential evolution, before the tuner says that none is known.

The scan and what follows it go downhill from a few starts. This is a search of another kind: a population of laws of
all filters and gains at once, from everywhere in their ranges and from the laws that are known, whose worst usage of a
limit on a coarse set of frequencies is to fall below 1. All members are evaluated together, as arrays, as many times as
is fixed beforehand; the generator's seed is fixed, so that the same request has the same answer.

The bandwidth holds exactly in every member. With :math:`k_i = \rho (1 + k_p)` and
:math:`w_r = \sigma (1/P(0) + k_p)` both responses are affine in k_p (terms of `LawTerms`, symbols of
`seaopt.control.tuning.starts`),

.. math::
    C_y = g\,(\kappa k_p + Y), \quad C_r = g F\,(\eta k_p + R), \qquad
    \kappa = 1 + \rho I, \quad \eta = \kappa - \sigma, \quad Y = \rho I + k_d D + O, \quad
    R = \frac{h/g - \sigma}{P(0)} + \rho I + (k_d - w_c) D,

and k_p is a root of :math:`2\,|aF(\eta k_p + R)|^2 = |B + aY + a \kappa k_p|^2`. Of the others,
:math:`\rho, \sigma, k_d, w_c/k_d`, k_v, T_f, T_q, T_v, notch and prefilter, a member has the logarithms or shares, each
from 0 to 1 over its range. A part whose member is at the end of its range is next to none: a notch of depth 1, a
prefilter far above the bandwidth, a speed loop of no gain; a share of the population begins there.

The step is current-to-pbest/1 with binomial crossover (Zhang, Sanderson, JADE, IEEE TEC 13(5), 2009), its numbers drawn
anew for every member instead of adapted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int

from seaopt.control.laws.limits import INTEGRAL_RAD_S
from seaopt.control.tuning.grid import Grid, Values
from seaopt.control.tuning.law_numbers import (
    DAMPING,
    K_D,
    K_I,
    K_P,
    K_V,
    NOTCH_DEPTH,
    PREFILTER_W,
    SLOWEST_SPEED_RATE,
    SPEED_RATE,
    T_F,
    W_C,
    W_R,
    LawNumbers,
    least_integral_rate,
)
from seaopt.control.tuning.optimisation_problem import SCOPES, STEADY, Task
from seaopt.control.tuning.starts import (
    SCANNED_PLANTS,
    judge_loops,
    make_rest_start,
    solve_bandwidth,
    thin_grid,
    use_tracking,
)
from seaopt.records import record

SEED = 20260
MEMBERS = 40
GENERATIONS = 150
SHORT = 50  # generations where no second population begins
HANDED_ON = 4  # laws of one population to the next
BEST_SHARE = 0.15  # of the population: what members are drawn to
NEUTRAL_SHARE = 0.3  # of the population: begin without the optional parts
KEPT = 0.99  # worst usage at which the search ends
HOPELESS = 1.05  # worst usage beyond which one law is handed on, for what it misses least
COLLAPSED = 1.0001  # ratio of usages within a population that has come together at one place: it leads nowhere else
ENCIRCLES = 1e3  # factor of the usage of a loop whose turns say that it is unstable
NO_ROOT = 1e9  # usage where no k_p makes the bandwidth
HIGHEST_RATE = 3.0  # of the bandwidth's rad/s: rho
GAINS = (1e-3, 30.0)  # of k_d and k_v: over what makes as much as the inverse plant at the bandwidth

Population = Float[np.ndarray, "n d"]


@record(eq=False)
class Evolution:
    """The search for one task."""

    task: Task
    grid: Grid  # not many frequencies
    low: LawNumbers  # ends of the numbers' ranges; of k_i those of rho, of the weights those of their shares
    high: LawNumbers
    free: Int[np.ndarray, " d"]  # the numbers in which members differ; k_p is not among them

    @classmethod
    def of(cls, task: Task, grid: Grid, starts: Sequence[LawNumbers] = ()) -> Evolution:
        """Prepare the search on some frequencies of a grid, and on the plants that bear the first known law worst."""
        grid = thin_grid(task, grid, _choose_plants(task, grid, starts))
        numbers, at = make_rest_start(task), task.find_bandwidth(grid)
        if task.speed_loop is not None and task.spec.speed_loop == "PI":
            numbers[SPEED_RATE] = SLOWEST_SPEED_RATE
        low, high = task.bounds(numbers)
        w_b = 2 * np.pi * task.spec.bandwidth_hz
        if high[K_I] > 0.0:
            least = 1.01 * least_integral_rate(numbers) if task.integrates(numbers) else 1e-3 * INTEGRAL_RAD_S
            low[K_I], high[K_I] = least, HIGHEST_RATE * w_b
        low[K_D], high[K_D] = np.array(GAINS) / max(float(np.abs(grid.plants.y[0, at])), 1e-9) / w_b
        if high[K_V] > 0.0:
            low[K_V], high[K_V] = np.array(GAINS) / max(task.speed_gain(grid), 1e-12)
        low[T_F] = max(low[T_F], 1e-2 * task.spec.sample_time_s)
        low[[W_R, W_C]], high[[W_R, W_C]] = 0.0, np.minimum(high[[W_R, W_C]], 1.0)
        if task.spec.reference_weights == "measurement":
            low[W_C] = 1.0
        high[K_P] = low[K_P]
        return cls(task=task, grid=grid, low=low, high=high, free=np.flatnonzero(high > low))

    def without_parts(self) -> Evolution:
        """Return the search among the laws without notch, prefilter and speed loop, as far as these are tuned."""
        low, high = self.low.copy(), self.high.copy()
        for k, end in ((NOTCH_DEPTH, 1.0), (PREFILTER_W, high[PREFILTER_W]), (K_V, 0.0), (SPEED_RATE, 0.0)):
            if k in self.free:
                low[k] = high[k] = end
        return replace(self, low=low, high=high, free=np.flatnonzero(high > low))

    def decode(self, members: Population) -> Float[np.ndarray, "two_n 14"]:
        """Return the laws of members, two of each, not a number in k_p where there is none that makes the bandwidth."""
        task, at = self.task, self.grid.at(np.array([self.task.find_bandwidth(self.grid)]))
        x = np.tile(self.low, (len(members), 1))
        for column, k in zip(members.T, self.free, strict=True):
            shares = k in (W_R, W_C)
            ends = self.low[k], self.high[k]
            x[:, k] = ends[0] + column * (ends[1] - ends[0]) if shares else ends[0] * (ends[1] / ends[0]) ** column
        if SPEED_RATE in self.free:  # its lower third is a speed loop without an integral
            share = 1.5 * members[:, list(self.free).index(SPEED_RATE)] - 0.5
            rate = self.low[SPEED_RATE] * (self.high[SPEED_RATE] / self.low[SPEED_RATE]) ** np.maximum(share, 0.0)
            x[:, SPEED_RATE] = np.where(share > 0.0, rate, 0.0)
        x[:, W_C] *= x[:, K_D]
        rho, sigma = x[:, K_I].copy(), x[:, W_R].copy()
        if task.settles:
            left = np.minimum(1.0, STEADY * (1.0 + rho * task.steady_s))
            sigma *= np.where(x[:, SPEED_RATE] == 0.0, left, 1.0)
        wide = x.T[:, :, None]
        terms = task.terms(at, wide)
        series, integral, rate, more, ahead, prefilter = (np.ravel(np.broadcast_to(t, (len(x), 1))) for t in terms)
        plant = at.plants.alone.at(0)
        through, back = plant.y * series, plant.add_constant(x[:, K_V] * series * task.sense(at.q), 0.0 * series)
        kappa = 1.0 + rho * integral
        slope = task.k_ff * (ahead / series - sigma) + rho * integral + (x[:, K_D] - x[:, W_C]) * rate
        reached = back + through * (rho * integral + x[:, K_D] * rate + more)
        front = through * prefilter
        k_p = solve_bandwidth(through * kappa, front * (kappa - sigma), front * slope, reached)
        x, rho, sigma = np.tile(x, (2, 1)), np.tile(rho, 2), np.tile(sigma, 2)
        x[:, K_P], x[:, K_I], x[:, W_R] = k_p, rho * (1.0 + k_p), sigma * (task.k_ff + k_p)
        return x

    def judge(self, members: Population) -> tuple[Values, Float[np.ndarray, "n 14"]]:
        """Return the worst usage of a limit of members, each with the better of its two laws, and the laws."""
        x = self.decode(members)
        valid = np.isfinite(x[:, K_P]) & (x[:, K_P] >= 0.0)
        usage = np.full(len(x), NO_ROOT)
        if np.any(valid):
            laws = self.task.respond(self.grid, x[valid].T[:, :, None])
            _, worst, encircles = judge_loops(self.task, self.grid, laws)
            worst = np.maximum(worst, use_tracking(self.task, self.grid, laws))
            usage[valid] = np.where(np.isfinite(worst), worst * np.where(encircles, ENCIRCLES, 1.0), NO_ROOT)
        first, second = np.split(usage, 2)
        better = first <= second
        return np.where(better, first, second), np.where(better[:, None], *np.split(x, 2))

    def encode(self, x: LawNumbers) -> Float[np.ndarray, " d"]:
        """Return the member next to a law."""
        x = x.copy()
        x[W_C] /= max(x[K_D], 1e-12)
        x[W_R] /= max(self.task.k_ff + x[K_P], 1e-12)
        x[K_I] /= 1.0 + x[K_P]
        low, high, x = self.low[self.free], self.high[self.free], x[self.free]
        shares = np.isin(self.free, [W_R, W_C])
        safe = np.where(shares, 1.0, np.maximum(low, 1e-300))
        with np.errstate(divide="ignore", invalid="ignore"):
            logarithms = np.log(np.maximum(x, safe) / safe) / np.log(high / safe)
        return np.clip(np.where(shares, (x - low) / (high - low), logarithms), 0.0, 1.0)

    def spread(self, rng: np.random.Generator, starts: Sequence[LawNumbers], count: int) -> Population:
        """Return a first population: a Latin hypercube, a share of it without the optional parts, and known laws."""
        d = self.free.size
        members = (rng.permuted(np.tile(np.arange(count), (d, 1)), axis=1).T + rng.random((count, d))) / count
        bare = slice(0, int(NEUTRAL_SHARE * count))
        for k, end in ((NOTCH_DEPTH, 1.0), (PREFILTER_W, 1.0), (DAMPING, 0.5), (K_V, 0.0)):
            members[bare, self.free == k] = end
        for row, x in enumerate(starts[:count]):
            members[count - 1 - row] = self.encode(x)
        return members

    def run(
        self,
        starts: Sequence[LawNumbers] = (),
        *,
        members: int = MEMBERS,
        generations: int = GENERATIONS,
        seed: int = 0,
    ) -> tuple[Values, Float[np.ndarray, "n 14"]]:
        """Return the worst usages of the last population and its laws, the best first."""
        rng = np.random.default_rng((SEED, seed))
        population = self.spread(rng, starts, members)
        usage, laws = self.judge(population)
        best = max(2, int(BEST_SHARE * members))
        for _ in range(generations):
            least = np.min(usage)
            if least <= KEPT or (least > HOPELESS and np.max(usage) < COLLAPSED * least):
                break
            order = np.argsort(usage)
            towards = population[order[rng.integers(best, size=members)]]
            first, second = (population[rng.integers(members, size=members)] for _ in range(2))
            factor = rng.uniform(0.3, 0.9, size=(members, 1))
            trial = population + factor * (towards - population) + factor * (first - second)
            crossed = rng.random(trial.shape) < rng.choice([0.5, 0.9], size=(members, 1))
            crossed[np.arange(members), rng.integers(trial.shape[1], size=members)] = True
            trial = np.where(crossed, trial, population)
            trial = np.where(trial < 0.0, 0.5 * population, np.where(trial > 1.0, 0.5 * (1.0 + population), trial))
            trial_usage, trial_laws = self.judge(trial)
            better = trial_usage <= usage
            population = np.where(better[:, None], trial, population)
            usage, laws = np.where(better, trial_usage, usage), np.where(better[:, None], trial_laws, laws)
        order = np.argsort(usage, kind="stable")
        return usage[order], laws[order]

    def find(self, starts: Sequence[LawNumbers] = (), *, again: bool = True) -> list[LawNumbers]:
        """Return the best stable law found; where limits are nearly kept, the two best. Where the first population
        keeps no limits another one may begin `again`, with its best, and with the best of one without the optional
        parts.
        """
        usage, laws = self.run(starts, generations=GENERATIONS if again else SHORT)
        if usage[0] > KEPT and again:
            handed, bare = list(laws[:HANDED_ON]), self.without_parts()
            if bare.free.size < self.free.size:
                handed += [*bare.run(starts, seed=1)[1][:HANDED_ON]]
            usage, laws = self.run([*starts, *handed], seed=2)
        stable: list[LawNumbers] = []
        count = 1 if usage[0] > HOPELESS else 2
        for x in laws[usage < ENCIRCLES]:
            x = self.task.tidy(x)
            if len(stable) < count and not any(np.allclose(x, other, rtol=0.1, atol=1e-6) for other in stable):
                stable += [x] if self.task.is_stable(x) else []
        return stable


def _choose_plants(task: Task, grid: Grid, starts: Sequence[LawNumbers]) -> list[int]:
    """Return some of the task's plants, the first of them those of the design."""
    plants = list(range(task.design_states, len(grid.rows)))
    if starts:
        law = task.respond(grid, starts[0])

        def find_worst(plant: int) -> float:
            usage = task.curves(SCOPES["every plant"], grid, plant, law)
            return max((float(np.max(curve)) for curve in usage.values()), default=0.0)

        plants.sort(key=find_worst, reverse=True)
    return [*range(task.design_states), *plants][:SCANNED_PLANTS]
