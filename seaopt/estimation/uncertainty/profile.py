r"""The profile of a parameter: the least cost at each of its values, and the interval that follows from it.

With :math:`c(\theta)` the least cost over all other unknowns while one parameter is held at :math:`\theta`, the root

.. math:: \tau(\theta) = \operatorname{sign}(\theta - \hat\theta) \sqrt{2\, (c(\theta) - c(\hat\theta)) / s}

is standard normal at the truth in large samples (likelihood ratio; Bates and Watts, Nonlinear Regression Analysis and
its Applications, 1988, sec. 6.1, as profile t). The 95 % interval is where the cost has risen by less than 1.92 s.
Where residuals are affine in the parameters :math:`\tau` is a straight line, and the interval is the estimate ± 1.96
std; where they are not, it may be lopsided, or open.

s is 1 for white residuals and squares as the loss. Otherwise the cost is not the likelihood, and its rise is scaled by
how much more the parameter varies than its curvature says (Rotnitzky and Jewell, Biometrika 77, 1990;
Pauli, Racugno and Ventura, Statistica Sinica 21, 2011, for adjusting the magnitude). Sigma stays as at the minimum.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from seaopt.codec import to_content
from seaopt.errors import EstimationError, suggestion
from seaopt.estimation.problem.normal_equations import invert, solve_seen
from seaopt.estimation.problem.shapes import Matrix, Vector
from seaopt.estimation.result.covariance import compute_bread
from seaopt.estimation.result.fit_result import Fit, Minimum
from seaopt.estimation.solver.least_squares import minimise
from seaopt.formatting import format_percent, html_text
from seaopt.records import record
from seaopt.signals import weigh_points
from seaopt.units import unit_after

CLOSE_TO_END = 2e-3  # of tau: near enough for an end of the interval to be interpolated
MOST_REFITS = 40  # per end
NOWHERE = 1e4  # std from the estimate: an end beyond is nowhere
BETTER_COST = 1e-3  # fall of the cost below the fit's that is no rounding
CURVE_MARGIN = 0.15  # of the interval, that the curve shows on either side


@record(eq=False, repr=False)
class Profile:
    """The profile of one parameter; ``print(profile)`` is a summary.

    Parameters
    ----------
    name, unit : str
        The parameter.
    estimate : float
        The fit's value.
    level : float
        Of the interval.
    interval : (float, float)
        Where the scaled rise stays below the level's quantile. An end that the parameter's bound cuts off is that
        bound; one that is not reached is infinite.
    closed : (bool, bool)
        Whether the rise reaches the quantile at each end.
    wald : (float, float)
        Estimate ± quantile x std, for comparison.
    values : array, shape (n,)
        Values at which the other parameters were refitted, in order, the estimate among them.
    rises : array, shape (n,)
        Of the cost above the fit's, scaled; half of tau squared.
    scale : float
        Robust over white variance of the parameter; 1 for white residuals.
    refits : int
        How many there were.
    message : str
        Remarks; empty if there are none.
    """

    name: str
    unit: str
    estimate: float
    level: float
    interval: tuple[float, float]
    closed: tuple[bool, bool]
    wald: tuple[float, float]
    values: Vector
    rises: Vector
    scale: float
    refits: int
    message: str = ""

    @property
    def tau(self) -> Vector:
        """The signed root of the likelihood ratio at `values`."""
        return np.sign(self.values - self.estimate) * np.sqrt(2.0 * np.maximum(self.rises, 0.0))

    def to_dict(self) -> dict[str, Any]:
        """Return the content as numbers, lists and text."""
        return to_content(self)

    def __repr__(self) -> str:
        low, high = self.interval
        ends = [f"{end:.6g}" + ("" if shut else " (open)") for end, shut in zip((low, high), self.closed, strict=True)]
        lines = [
            f"Profile of {self.name}: {self.estimate:.6g}{unit_after(self.unit)}, {format_percent(self.level, 6)} "
            f"interval {ends[0]} to {ends[1]}",
            f"  from the std alone: {self.wald[0]:.6g} to {self.wald[1]:.6g}",
            f"  {self.refits} refits; the cost's rise is divided by {self.scale:.3g} for the residuals' colour",
        ]
        return "\n".join(lines + ([f"  {self.message}"] if self.message else []))

    _repr_html_ = html_text


def profile(fit: Fit, name: str, *, points: int = 9, level: float = 0.95, coloured: bool = True) -> Profile:
    """Return the likelihood-ratio interval of a parameter, and the curve that it is read off (`Profile`).

    Parameters
    ----------
    fit : Fit
        As `fit` returned it; refits start from it and go on with its sigma and integration steps.
    name : str
        A free parameter of the plants.
    points : int
        Values at which the curve is drawn, besides those that the search for the ends tries.
    level : float
        Of the interval.
    coloured : bool
        Scale the rise for coloured residuals; False takes them as white.

    Raises
    ------
    EstimationError
        The fit was read from a file, the parameter is not free, or the level is not between 0 and 1.

    Examples
    --------
    >>> import seaopt as so
    >>> from seaopt.bench import PAPER_STAND, Sensors, virtual_log
    >>> from seaopt.estimation import profile
    >>> plant, truth = so.plants.high_impedance(), so.plants.thor()
    >>> log = virtual_log(plant, truth, PAPER_STAND, duration_s=20, rate_hz=400, seed=1,
    ...                   sensors=Sensors(noise_std={"F1": 2.0, "F2": 2.0}))
    >>> fit = so.fit([so.Experiment(plant=plant, log=log, outputs=("F1", "F2"))], truth.free("J", "b_r"))
    >>> low, high = profile(fit, "J", points=0).interval
    >>> low < 3.31e-6 < high
    True
    """
    minimum = fit.require_minimum("profile")
    names = minimum.problem.shared_names
    if name not in names:
        raise EstimationError(f'profile: "{name}" is not a free parameter of the plants; {suggestion(name, names)}')
    if not 0.0 < level < 1.0:
        raise EstimationError(f"profile: level = {level:g} is not between 0 and 1; give 0.95")
    if points < 0:
        raise EstimationError(f"profile: points = {points} is negative; give 0 or more")
    from scipy.special import erfinv  # deferred: scipy is slow to load

    scale, std = _measure_scale(fit, minimum, name, coloured)
    reach = float(np.sqrt(2.0) * erfinv(level))
    curve = _ProfileCurve(minimum, names.index(name), scale, std)
    (low, shut_low), (high, shut_high) = curve.find_end(-reach), curve.find_end(reach)
    curve.fill(low, high, points)
    order = np.argsort(curve.values)
    estimate = float(minimum.z[curve.index])
    return Profile(
        name=name,
        unit=fit.parameters[name].unit,
        estimate=estimate,
        level=level,
        interval=(low, high),
        closed=(shut_low, shut_high),
        wald=(estimate - reach * std, estimate + reach * std),
        values=np.array(curve.values)[order],
        rises=np.array(curve.rises)[order],
        scale=scale,
        refits=len(curve.values) - 1,
        message=curve.warn(name),
    )


def _measure_scale(fit: Fit, minimum: Minimum, name: str, coloured: bool) -> tuple[float, float]:
    """Return the variance over what the cost's curvature says, and the std; 1 where the variance is not known."""
    std = (fit.covariance if coloured else fit.white_covariance).std(name)
    curved, problem = fit.white_covariance.std(name), minimum.problem
    if not problem.loss.quadratic:
        bread = compute_bread(problem, minimum.z)
        curved = float(np.sqrt(invert(bread)[0][(problem.unknowns.names.index(name),) * 2]))
    finite = np.isfinite(curved) and np.isfinite(std) and curved > 0.0 and std > 0.0
    return (std / curved) ** 2 if finite else 1.0, std


class _ProfileCurve:
    """Collects refits one by one; lives only inside `profile`."""

    def __init__(self, minimum: Minimum, index: int, scale: float, std: float) -> None:
        self.problem, self.index, self.scale = minimum.problem, index, scale
        evaluation = self.problem.evaluate(minimum.z)
        self.cost = evaluation.cost
        self.values, self.rises, self.points = [float(minimum.z[index])], [0.0], [minimum.z]
        self.along = _find_direction(evaluation.hessian, index)
        finite = np.isfinite(std) and std > 0.0
        self.step = std if finite else 0.1 * max(abs(self.values[0]), 1e-300)

    def refit_at(self, value: float) -> float:
        """Refit the others with the parameter at `value`, from the nearest refit, and return the scaled rise."""
        nearest = int(np.argmin(np.abs(np.array(self.values) - value)))
        start = self.points[nearest] + self.along * (value - self.values[nearest])
        start[self.index] = value
        unknowns = self.problem.unknowns.bound(self.index, value, value)
        solution = minimise(self.problem, np.clip(start, unknowns.low, unknowns.high), unknowns.low, unknowns.high)
        rise = (solution.evaluation.cost - self.cost) / self.scale
        if np.isfinite(rise):
            self.values.append(value)
            self.rises.append(float(rise))
            self.points.append(solution.z)
        return float(rise)

    def find_end(self, target: float) -> tuple[float, bool]:
        """Return where tau reaches the target, and whether it does before the parameter's bound. The value is smooth in
        tau, nearly straight: each trial is where the parabola through the nearest three points reaches the target, kept
        inside what brackets it.
        """
        estimate = self.values[0]
        limit = float((self.problem.unknowns.high if target > 0.0 else self.problem.unknowns.low)[self.index])
        taus, values = [0.0], [estimate]
        trial, outer = estimate + target * self.step, None
        for _ in range(MOST_REFITS):
            trial = min(trial, limit) if target > 0.0 else max(trial, limit)
            rise = self.refit_at(trial)
            tau = np.sign(target) * np.sqrt(2.0 * max(rise, 0.0))
            if np.isfinite(rise):
                taus.append(float(tau))
                values.append(trial)
            if abs(tau - target) <= CLOSE_TO_END * abs(target):
                return _interpolate_end(taus, values, target), True
            if abs(tau) < abs(target) and trial == limit:
                return limit, False
            if abs(tau) > abs(target):
                outer = trial if outer is None else min(outer, trial, key=lambda v: abs(v - estimate))
            elif abs(trial - estimate) > NOWHERE * self.step:
                break
            trial = self._choose_trial(taus, values, target, outer)
        return (float(np.copysign(np.inf, target)), False) if outer is None else (trial, True)

    def _choose_trial(self, taus: list[float], values: list[float], target: float, outer: float | None) -> float:
        """Return the next value to try: inside what brackets the target, or at most three times as far as yet."""
        inner = max(abs(v - values[0]) for t, v in zip(taus, values, strict=True) if abs(t) < abs(target))
        far = max(3.0 * inner, 0.1 * self.step) if outer is None else abs(outer - values[0])
        wanted = abs(_interpolate_end(taus, values, target) - values[0]) if len(taus) > 1 else 0.5 * far
        if not inner < wanted < far:
            wanted = far if outer is None else 0.5 * (inner + far)
        return values[0] + float(np.sign(target)) * wanted

    def fill(self, low: float, high: float, points: int) -> None:
        """Refit at evenly spaced values over the interval and a little beyond."""
        low, high = (end if np.isfinite(end) else far(self.values) for end, far in ((low, min), (high, max)))
        margin = CURVE_MARGIN * (high - low)
        bounds = self.problem.unknowns.low[self.index], self.problem.unknowns.high[self.index]
        for value in np.unique(np.clip(np.linspace(low - margin, high + margin, points), *bounds)):
            if value not in self.values:
                self.refit_at(float(value))

    def warn(self, name: str) -> str:
        """Return a warning where a refit is better than the fit; empty otherwise."""
        best = int(np.argmin(self.rises))
        if self.rises[best] * self.scale < -BETTER_COST:
            return f"a refit at {name} = {self.values[best]:.6g} is better than the fit: fit again from there"
        return ""


def _find_direction(hessian: Matrix, index: int) -> Vector:
    """Return how the other unknowns follow when one moves by one: to first order, their best values."""
    remaining = np.arange(len(hessian)) != index
    step = np.ones(len(hessian))
    step[remaining] = -solve_seen(hessian[remaining][:, remaining], hessian[remaining, index], 1e-12)
    return step


def _interpolate_end(taus: list[float], values: list[float], target: float) -> float:
    """Return where tau reaches the target on the parabola, or the line, through the nearest three points."""
    near = np.argsort(np.abs(np.array(taus) - target))[:3]
    t, v = np.array(taus)[near], np.array(values)[near]
    if np.min(np.abs(np.subtract.outer(t, t)) + np.eye(t.size)) < 1e-12:
        return float(values[int(near[0])])
    return float(weigh_points(t, target) @ v)
