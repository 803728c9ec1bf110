"""The numbers of a law that the tuner moves, by their place in an array."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

from seaopt.control.laws.limits import INTEGRAL_RAD_S
from seaopt.control.laws.spec import ControllerSpec
from seaopt.control.laws.structures import DisturbanceObserver, Gains, InnerLoop, Nominal, Notch, Prefilter, SpeedLoop

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


def make_gains(
    spec: ControllerSpec, x: LawNumbers, k_ff: float, speed_loop: SpeedLoop | None, nominal: Nominal | None
) -> Gains:
    """Return the gains of numbers. `k_ff` is 1/P(0), `nominal` an observer's nominal plant."""
    ts, notch, low_pass = spec.sample_time_s, None, spec.reference_filter
    if spec.notch is not None:
        centre = float(np.arctan(x[NOTCH_W]) / (np.pi * ts))
        notch = Notch(frequency_hz=centre, width=float(x[NOTCH_WIDTH]), depth=float(x[NOTCH_DEPTH]))
    if low_pass is not None:
        damping = float(x[DAMPING]) if low_pass.is_second_order else None
        corner = float(np.arctan(x[PREFILTER_W]) / (np.pi * ts))
        low_pass = Prefilter(order=low_pass.order, corner_hz=corner, damping=damping)
    k_p, k_d = float(x[K_P]), float(x[K_D])
    whole = spec.reference_weights != "measurement"
    inner = None
    if speed_loop is not None:
        T_v = 1.0 / float(x[SPEED_RATE]) if x[SPEED_RATE] > 0.0 else np.inf
        inner = InnerLoop(k_v=float(x[K_V]), T_v=T_v, k_ff=k_ff, speed=speed_loop)
    return Gains(
        k_p=k_p,
        k_i=float(x[K_I]),
        k_d=k_d,
        T_f=float(x[T_F]),
        k_r=k_p - float(x[W_R]) + (k_ff if inner is None else 0.0),
        c=1.0 - float(x[W_C]) / k_d if k_d > 0.0 else float(whole),
        notch=notch,
        inner=inner,
        prefilter=low_pass,
        observer=None if nominal is None else DisturbanceObserver(nominal=nominal, T_q=float(x[T_Q])),
    )


def read_numbers(gains: Mapping[str, float], k_ff: float, ts: float) -> LawNumbers:
    """Return the numbers of gains by name, the inverse of `make_gains`; those that a law does not have are ones. `k_ff`
    is 1/P(0).
    """
    x = np.ones(14)
    x[[K_P, K_I, K_D, T_F]] = [gains[name] for name in ("k_p", "k_i", "k_d", "T_f")]
    x[W_R] = gains["k_p"] - gains["k_r"] + (0.0 if "k_v" in gains else k_ff)
    x[W_C] = (1.0 - gains["c"]) * gains["k_d"]
    x[SPEED_RATE] = 1.0 / gains["T_v"] if "T_v" in gains else 0.0
    for name, index in (("k_v", K_V), ("T_q", T_Q), ("notch_width", NOTCH_WIDTH), ("notch_depth", NOTCH_DEPTH)):
        x[index] = gains.get(name, 1.0)
    for name, index in (("notch_frequency_hz", NOTCH_W), ("prefilter_corner_hz", PREFILTER_W)):
        x[index] = warp_frequency(gains[name], ts) if name in gains else 1.0
    x[DAMPING] = gains.get("prefilter_damping", 1.0)
    return x


def warp_frequency(f: float, ts: float) -> float:
    """Return a corner as the bilinear transform has it, tan(pi f T_s)."""
    return float(np.tan(np.pi * f * ts))
