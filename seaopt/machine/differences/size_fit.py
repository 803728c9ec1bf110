"""A cause with its size as it is found, and the least-squares fit of sizes beside what certified machines differ by."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from seaopt.codec import from_content
from seaopt.machine.differences.comparison import TOLERATED, Comparison, Lines
from seaopt.machine.differences.leeway import Leeway
from seaopt.parameters import ParameterSet
from seaopt.records import record

# Of the misfit, in what noise leaves of a line: twice the difference of two causes is a chi square, 99.9 %.
UNTOLD = 5.4
MODE_COST = 2.0  # by which a mode, of several sizes, has to leave less than another cause does
RATE_COST = 2.0  # by which a usual rate may leave more than another cause does
BESIDE_OTHERS = ("parameter", "gain", "delay")  # kinds whose intervals hold beside another difference
SLIGHT = 1.5e-8  # of a size, for slopes


@record
class Difference:
    """A way in which the machine differs, its size, and how much of the difference it explains."""

    kind: str  # parameter, gain, delay, mode, range, rate, drive limit
    name: str  # the parameter, the signal
    value: float  # factor of a parameter or gain; seconds; Hz of a mode, of the law's ticks; the range; the limit
    low: float | None
    high: float | None
    unit: str
    explains: float  # share of the misfit, of what no certified machine has
    left: float | None = None  # mean square of what it leaves, over the std
    alike: tuple[str, ...] = ()  # parameters that would explain as much
    alike_values: tuple[float, ...] = ()  # their factors
    size: float | None = None  # of a mode: its zero's frequency over its pole's; of a rate: over that of the log
    changes: float | None = None  # of a mode: by which factor it makes the response at a line another one, at most
    changes_low: float | None = None  # its interval
    changes_high: float | None = None
    beside: tuple[Difference, ...] = ()  # what differs besides, of two that explain it together
    unless: tuple[tuple[str, ...], ...] = ()  # others that do what it does: its interval is without them
    untold: bool = False  # the log does not tell it from the one that is named first

    @classmethod
    def _from_json(cls, content: dict[str, Any]) -> Difference:  # one may hold others
        return from_content(cls, content, "a difference", remedy="correct that entry")

    @property
    def width(self) -> float:
        """Of its interval; infinite where none is stated."""
        return math.inf if self.low is None or self.high is None else self.high - self.low

    @property
    def held_beside_others(self) -> bool:
        """Whether its interval is to hold beside another difference that noise hides."""
        return all(part.kind in BESIDE_OTHERS for part in (self, *self.beside))

    @property
    def is_there(self) -> bool:
        """Whether its interval excludes that there is none."""
        none = {"parameter": 1.0, "gain": 1.0, "delay": 0.0}.get(self.kind, math.inf)
        return self.low is not None and self.high is not None and not self.low <= none <= self.high


@record(eq=False)
class Tried:
    """A cause with the size that fits best, and the misfit that it leaves."""

    difference: Difference
    left: float
    response: Lines
    values: ParameterSet | None = None  # of the plant, where a parameter is the cause

    def is_like(self, other: Tried, noise: float) -> bool:
        """Tell whether two causes may be one, both factors of parameters or gains: the log does not tell them apart, or
        their responses differ by less than a machine and its model do. `noise`: what it leaves of the misfit.
        """
        mine, its = self.difference, other.difference
        if not (mine.unit == its.unit == "-" and {mine.kind, its.kind} <= {"parameter", "gain"}):
            return False
        return self.is_untold(other, noise) or bool(np.max(np.abs(self.response / other.response - 1.0)) <= TOLERATED)

    def is_untold(self, best: Tried, noise: float) -> bool:
        """Tell whether the log does not tell a cause from the best one."""
        return self.left - best.left <= UNTOLD * max(best.left / noise, 1.0)

    @property
    def rank(self) -> float:
        """What it leaves, times what its kind costs."""
        if self.difference.kind == "rate":
            return self.left / RATE_COST
        return self.left * (MODE_COST if self.difference.kind == "mode" else 1.0)


def rank(tried: Iterable[Tried]) -> list[Tried]:
    """Return causes, the best first; of those that no log can tell apart (torque constant, efficiency) that with the
    widest interval, which holds for each of them, and not the one that rounding puts first.
    """
    return sorted(tried, key=lambda each: (drop_digits(each.rank), -drop_digits(each.difference.width)))


def drop_digits(value: float) -> float:
    """Return a misfit or a width to the digits that do not hang on the order of sums."""
    return float(f"{value:.6g}")


@record(eq=False)
class Best:
    """Sizes that fit best."""

    sizes: Float[np.ndarray, " k"]
    covariance: Float[np.ndarray, "k k"]
    left: float  # of the misfit
    response: Lines

    @property
    def stds(self) -> Float[np.ndarray, " k"]:
        """Of the sizes; infinite of one that nothing tells."""
        variances = np.diag(self.covariance)
        return np.where(variances > 0.0, np.sqrt(np.maximum(variances, 0.0)), np.inf)


@record(eq=False)
class SizeFit:
    """A least-squares fit of a cause's sizes to the measured response, and of what certified machines differ by."""

    comparison: Comparison
    leeway: Leeway

    def solve(
        self, make: Callable[[Any], Lines], start: Sequence[float], ends: Sequence[tuple[float, float]] | None = None
    ) -> Best:
        """Return the best sizes of what makes a response of sizes. `ends`: between which each may be."""
        from scipy.optimize import least_squares  # deferred: 0.2 s

        k, leeway, measured = len(start), self.leeway, self.comparison.response
        std = self.comparison.std / math.sqrt(2.0)
        prior = np.eye(leeway.std.size, k + leeway.std.size, k) / leeway.std[:, None]

        def respond(x: Float[np.ndarray, " n"]) -> Lines:
            return make(x[:k]) * np.exp(x[k:] @ leeway.directions)

        def errors(x: Float[np.ndarray, " n"]) -> Float[np.ndarray, " r"]:
            off = (measured - respond(x)) / std
            return np.concatenate([off.real, off.imag, x[k:] / leeway.std])

        def differentiate(x: Float[np.ndarray, " n"]) -> Float[np.ndarray, "r n"]:
            beside = np.exp(x[k:] @ leeway.directions)
            response = (made := make(x[:k])) * beside
            steps = SLIGHT * np.maximum(1.0, np.abs(x[:k]))
            ways = [(make(x[:k] + each) - made) / np.max(each) * beside for each in np.diag(steps)]
            off = -np.array([*ways, *(response * leeway.directions)]).T / std[:, None]
            return np.vstack([off.real, off.imag, prior])

        first = np.array([*start, *(0.5 * (leeway.low + leeway.high))])  # at an edge the search would stay
        if not first.size:
            left = 0.5 * float(np.sum(errors(first) ** 2))
            return Best(sizes=first, covariance=np.zeros((0, 0)), left=left, response=respond(first))
        low, high = np.reshape(ends or [(-math.inf, math.inf)] * k, (k, 2)).T
        edges = [np.concatenate([low, leeway.low]), np.concatenate([high, leeway.high])]
        scale = np.concatenate([np.maximum(np.abs(start), 1e-3), leeway.std])
        solve: Any = least_squares  # whose types know no function of slopes
        solved = solve(errors, first, differentiate, x_scale=scale, bounds=edges, max_nfev=200)
        left, covariance = float(solved.cost), np.linalg.pinv(solved.jac.T @ solved.jac, hermitian=True)[:k, :k]
        covariance = covariance * max(left / measured.size, 1.0) * self.comparison.widening**2
        return Best(sizes=solved.x[:k], covariance=covariance, left=left, response=respond(solved.x))
