"""The numbers of a law that the tuner moves, by their place in an array."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from seaopt.control.laws.limits import INTEGRAL_RAD_S

SLOWEST_SPEED_RATE = 4.0 * INTEGRAL_RAD_S  # 1/T_v, rad/s, of a speed loop that integrates

# k_p, k_i, k_d, w_r, w_c, k_v, T_f, T_q, 1/T_v, notch_w, notch_width, notch_depth, prefilter_w, prefilter_damping
LawNumbers = Float[np.ndarray, " 14"]
LawsNumbers = Float[np.ndarray, "14 *n"]  # of one law, or of n: then of the shape (14, n, 1)
K_P, K_I, K_D, W_R, W_C, K_V, T_F, T_Q, SPEED_RATE, NOTCH_W, NOTCH_WIDTH, NOTCH_DEPTH, PREFILTER_W, DAMPING = range(14)


def least_integral_rate(x: LawNumbers) -> float:
    r"""Return the least k_i/(1 + k_p) of numbers, rad/s. Behind a speed loop that integrates, two integrals act at the
    rate :math:`(T_v + k_p/k_i)^{-1}`; with this k_i it is at least the least rate of one for every T_v allowed.
    """
    return INTEGRAL_RAD_S / (1.0 - INTEGRAL_RAD_S / SLOWEST_SPEED_RATE) if x[SPEED_RATE] > 0.0 else INTEGRAL_RAD_S


def warp_frequency(f: float, ts: float) -> float:
    """Return a corner as the bilinear transform has it, tan(pi f T_s)."""
    return float(np.tan(np.pi * f * ts))
