r"""What chance exceeds, of gamma and chi-square variables, without SciPy, which is as long to load as a short fit.

The regularised incomplete gamma function Q(a, x) is the series of 1 - Q below x = a + 1, and Legendre's continued
fraction from there on, by Lentz's method (Press et al., Numerical Recipes, 3rd ed., sec. 6.2). Both take a few times
:math:`\sqrt a` terms.
"""

from __future__ import annotations

import math

ROUNDING = 2.0**-53
TINY = 1e-300  # in place of a denominator of zero


def exceeds(shape: float, x: float) -> float:
    """Return the probability that a gamma variable of this shape (and scale 1) exceeds x; of 2 `shape` degrees of
    freedom that chi-square exceeds 2 x. One of shape 0 is 0.
    """
    if math.isnan(x):
        return math.nan
    if x <= 0.0:
        return 1.0
    if shape <= 0.0:
        return 0.0
    front = math.exp(shape * math.log(x) - x - math.lgamma(shape)) if math.isfinite(x) else 0.0
    if x < shape + 1.0:
        return 1.0 - front * _sum_series(shape, x)
    return front * _continue_fraction(shape, x) if front else 0.0


def _sum_series(a: float, x: float) -> float:
    term = total = 1.0 / a
    while term > ROUNDING * total:
        a += 1.0
        term *= x / a
        total += term
    return total


def _continue_fraction(a: float, x: float) -> float:
    b = x + 1.0 - a
    c, d = 1.0 / TINY, 1.0 / b
    value, factor, i = d, 0.0, 0.0
    while abs(factor - 1.0) > 4.0 * ROUNDING:
        i += 1.0
        b += 2.0
        numerator = i * (a - i)
        d = 1.0 / (numerator * d + b or TINY)
        c = b + numerator / c or TINY
        factor = c * d
        value *= factor
    return value
