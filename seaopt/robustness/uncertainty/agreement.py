r"""Whether a log agrees with the model that was fitted: an F test of the response of what the model leaves of it.

At m lines the error :math:`\hat E_k` of a loop's gain has a std s_k, with f complex degrees of freedom. It is moved by
:math:`J_k \delta`, :math:`\delta \sim N(0, 1)` of p parameters and a delay along the axes of their covariance, of noise
and model. The log contradicts the model at a risk :math:`\alpha` where no parameters within the fit's intervals explain
it:

.. math:: \min_{|\delta|^2 \le \chi^2_p(1 - \alpha/2)} \frac1m \sum_k \frac{|\hat E_k - J_k \delta|^2}{w s_k^2}
          > F(1 - \alpha/2;\, 2m, 2mf),

m being counted as so many lines as are independent. (A parameter that is off moves all lines alike, so that a sum of
:math:`|\hat E_k|^2/(s_k^2 + |J_k|^2)` is too large far more often than stated.)

What a model leaves besides noise is in part its own error, a share :math:`1 - 1/x^2` of its power at an excess x, which
has some 80 independent values in however many samples N (`seaopt.estimation.result.model_error`): hence
:math:`w = 1 + (1 - 1/x^2) N/80`. A log of another actuator widens excess and intervals, fitted or compared with the
fit's own, so that they count up to what a fit that is met may have: an excess of 1.5, and 20 % of a value in that
minimum where noise alone makes less.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Complex, Float

from seaopt.estimation.result.model_error import INDEPENDENT, LITTLE
from seaopt.frequency.residual import ALIKE
from seaopt.frequency.response import ComplexLines, Lines
from seaopt.records import record

Moves = Complex[np.ndarray, "k m"]  # of a loop's gain, by a std along each axis of the covariance


@record
class Agreement:
    """What the lines of a log say of the model: it is contradicted where `misfit` is above `allowed`."""

    misfit: float  # mean square of what the model leaves and its intervals do not explain, over that of noise
    allowed: float  # what chance makes of it, but for the risk
    off: float  # the model's error over |L| or |1 + L|, whichever is larger, at the line where most of it is no noise
    off_hz: float

    @property
    def contradicts(self) -> bool:
        """Whether the log contradicts the model."""
        return self.misfit > self.allowed


def judge_agreement(
    f: Lines,
    loop: ComplexLines,
    error: ComplexLines,
    std: Lines,
    unseen: Lines,
    *,
    freedom: float,
    alpha: float,
    move: Callable[[], Moves],
) -> Agreement:
    """Return whether the error of a loop's gain is what its `std` makes, but for a risk `alpha`, and what the fit's
    intervals `move` it by; these are asked for where noise alone does not explain it.
    """
    from scipy.special import fdtri  # deferred: 0.1 s

    beyond = np.maximum(np.abs(error) - unseen, 0.0)
    left = np.divide(beyond, std, out=np.zeros_like(beyond), where=beyond > 0.0)
    pairs = 2.0 * error.size / ALIKE
    z = _split(left * np.exp(1j * np.angle(error)))
    misfit, allowed = float(z @ z) / pairs, float(fdtri(pairs, pairs * freedom, 1.0 - 0.5 * alpha))
    if misfit > allowed:
        misfit -= _explain(z, _split(move() / std), alpha) / pairs
    size = np.maximum(np.maximum(np.abs(loop), np.abs(1.0 + loop)), 1e-300)
    radius = std * math.sqrt(freedom * math.expm1(-math.log(alpha / error.size) / freedom))
    at = int(np.argmax((beyond - radius) / size))
    off = np.abs(error[at]) / size[at]
    return Agreement(misfit=misfit, allowed=allowed, off=float(off), off_hz=float(f[at]))


def widen_by_model(excess: float | None, count: int) -> float:
    """Return how many times its noise the std of a response is with the model's error, in `count` samples, of a fit
    whose residual is `excess` times its noise; unknown, it counts as the most that a fit which is met may have.
    """
    x = LITTLE if excess is None else min(max(excess, 1.0), LITTLE)
    return math.sqrt(1.0 + (1.0 - x**-2) * count / INDEPENDENT)


def find_radius(count: int, alpha: float) -> float:
    """Return within how many std so many parameters are, but for the half of a risk that is theirs."""
    from scipy.special import chdtri  # deferred: 0.1 s

    return math.sqrt(float(chdtri(count, 0.5 * alpha)))


def _split(lines: Complex[np.ndarray, "*k m"]) -> Float[np.ndarray, "*k n"]:
    """Return real and imaginary parts, of variance 1 where a line has 1, over as many lines as are independent."""
    return np.concatenate([np.real(lines), np.imag(lines)], axis=-1) * math.sqrt(2.0 / ALIKE)


def _explain(z: Float[np.ndarray, " n"], moves: Float[np.ndarray, "k n"], alpha: float) -> float:
    """Return how much of the square of z some parameters take off that lie within their intervals but for a risk."""
    from scipy.optimize import brentq  # deferred: 0.2 s

    moves = moves[np.any(moves != 0.0, axis=1)]
    if not len(moves):
        return 0.0
    values, vectors = np.linalg.eigh(moves @ moves.T)
    onto, values = vectors.T @ (moves @ z), np.maximum(values, 1e-12 * values[-1])
    radius = find_radius(len(moves), alpha)

    def exceed(weight: float) -> Any:
        return np.linalg.norm(onto / (values + weight)) - radius

    weight = 0.0 if exceed(0.0) <= 0.0 else brentq(exceed, 0.0, np.linalg.norm(onto) / radius)
    step = onto / (values + weight)
    return float(np.sum(2.0 * step * onto - values * step**2))
