r"""How much wider an interval is whose weights come from few periods, and how much more noise leaves.

A size that is fitted to lines with weights of :math:`1/s_k^2`, each s of P blocks, is

.. math:: \hat\theta = \frac{\sum_k d_k e_k/s_k^2}{\sum_k d_k^2/s_k^2}, \qquad
          \operatorname{std} = \Big(2\sum_k d_k^2/s_k^2\Big)^{-1/2} \max(1, \chi^2/m)^{1/2},

with :math:`\chi^2` what is left over the noise of m lines. With one line it is Student's t with 2P - 2 degrees of
freedom; with more of them those whose s is too small by chance have the most weight, so that it is further off than
any t of these. Its quantile is therefore drawn, of lines that say as much as each other. What a right model leaves of a
line, over :math:`s_k^2`, is an F of 2 and 2P - 2 degrees of freedom: with six periods 1.25 on average.
"""

from __future__ import annotations

from functools import cache

import numpy as np

DRAWS = 20000
LEVEL = 0.95
NORMAL = 1.959964  # std, of 95 % where s is known
AT_ONCE = 2**19  # numbers


@cache
def find_widening(blocks: int, lines: int) -> float:
    """Return the quantile of 95 % of a size's error, over that of the normal distribution."""
    rng, free, parts = np.random.default_rng(1), 2 * blocks - 2, list[np.ndarray]()
    count = max(AT_ONCE // lines, 1)
    for _ in range(-(-DRAWS // count)):
        error = rng.normal(size=(2, count, lines)) / np.sqrt(2.0)
        weight = free / rng.chisquare(free, (count, lines))
        total = np.sum(weight, axis=1)
        size = np.sum(weight * error[0], axis=1) / total
        left = np.sum(weight * ((error[0] - size[:, None]) ** 2 + error[1] ** 2), axis=1)
        parts.append(np.abs(size) * np.sqrt(2.0 * total / np.maximum(left / lines, 1.0)))
    return max(float(np.quantile(np.concatenate(parts), LEVEL)) / NORMAL, 1.0)


@cache
def find_most_noise(blocks: int, lines: int) -> float:
    """Return the quantile of 95 % of what a right model leaves of a line on average, over the noise."""
    rng, count = np.random.default_rng(1), max(AT_ONCE // lines, 1)
    left = [np.mean(rng.f(2, 2 * blocks - 2, (count, lines)), axis=1) for _ in range(-(-DRAWS // count))]
    return float(np.quantile(np.concatenate(left), LEVEL))
