r"""Refuse, before anything is tuned, what a delay or a current limit rules out for every controller.

**Delay.** If the loop's first response comes k samples late, the sensitivity of every stable loop is
:math:`S(q) = 1 + O(q^k)`, analytic in the unit disk. It is to stay below w: :math:`1/\sqrt2` up to :math:`f_s`,
:math:`M_s` above. Let W be the outer function with :math:`|W| = w` on the circle,

.. math:: W(q) = \exp\big(a_0 + 2\sum_n a_n q^n\big), \qquad
    a_0 = \tfrac{\omega_s}{\pi}\ln\tfrac{1}{\sqrt2} + \big(1 - \tfrac{\omega_s}{\pi}\big)\ln M_s, \quad
    a_n = \frac{\sin n\omega_s}{n\pi}\,\ln\frac{1}{\sqrt2 M_s} .

Then :math:`G = S/W` is analytic with :math:`|G| \le 1`, and its first k coefficients are those of 1/W. Such a G exists
if and only if the lower triangular Toeplitz matrix of these coefficients has norm 1 at most (Caratheodory, Schur). At
k = 1 that is Bode's integral.

**Current.** At rest a force F takes the motor force :math:`k_\mathrm{ff} F`, whatever the gains.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

from seaopt.control.laws.command import Command
from seaopt.control.laws.spec import ControllerSpec
from seaopt.control.loops.sampled_plant import DigitalPlant
from seaopt.control.tuning.grid import Curve, Values
from seaopt.errors import ControlError

LEAST_SHARE = 1e-4  # of the sample rate: what is below is called nothing


def sensitivity_possible(sensitivity_hz: float, ms: float, sample_time_s: float, late: int) -> bool:
    """Tell whether a loop that answers `late` (1 or more) samples late can have abs(S) below -3 dB up to a frequency,
    with abs(S) at most `ms` above it.
    """
    omega, n = 2 * np.pi * sensitivity_hz * sample_time_s, np.arange(1, late)
    low, high = np.log(np.sqrt(0.5)), np.log(ms)
    constant = omega / np.pi * low + (1 - omega / np.pi) * high
    slopes = -2.0 * np.sin(n * omega) / (n * np.pi) * (low - high)  # of -ln W
    return bool(np.linalg.norm(_toeplitz(_exponential(-constant, slopes)), 2) <= 1.0 + 1e-9)


def _exponential(constant: float, slopes: Values) -> Curve:
    """Return the first coefficients of exp(constant + sum of slopes q^n): n g_n = sum of k slopes_k g_(n-k)."""
    g = np.zeros(slopes.size + 1)
    g[0] = np.exp(constant)
    weighted = slopes * np.arange(1, slopes.size + 1)
    for n in range(1, g.size):
        g[n] = weighted[:n] @ g[n - 1 :: -1][:n] / n
    return g


def _toeplitz(g: Values) -> Float[np.ndarray, "n n"]:
    index = np.arange(g.size)[:, None] - np.arange(g.size)
    return np.where(index >= 0, g[index], 0.0)


def check_delay(spec: ControllerSpec, plant: DigitalPlant) -> None:
    """Refuse a bandwidth that the delay rules out for every controller, with what the delay allows."""
    wanted, ms = spec.sensitivity_bandwidth_limit_hz, spec.level("max_sensitivity")
    late = _count_waiting(plant)
    if ms is None or wanted <= 0.0 or late < 1 or sensitivity_possible(wanted, ms, spec.sample_time_s, late):
        return
    low, high = LEAST_SHARE * spec.sample_rate_hz, wanted
    while high / low > 1.01:
        middle = float(np.sqrt(low * high))
        low, high = (middle, high) if sensitivity_possible(middle, ms, spec.sample_time_s, late) else (low, middle)
    request = f"bandwidth_hz = {spec.bandwidth_hz:g} with a delay of {late - 1} whole samples"
    raise ControlError(
        f"{request} at {spec.sample_rate_hz:g} Hz: no controller keeps |S| below -3 dB up to {wanted:.4g} Hz with "
        f"max_sensitivity = {ms:g}; the delay allows at most {low:.3g} Hz, so lower bandwidth_hz or "
        "min_sensitivity_bandwidth_hz, or the delay"
    )


def _count_waiting(plant: DigitalPlant) -> int:
    """Return after how many samples an output first answers, the drive's delay among them."""
    if plant.d[0]:
        return plant.delay_samples
    x, late = plant.b, 1
    while plant.c[0] @ x == 0.0 and late <= x.size:
        x, late = plant.a @ x, late + 1
    return plant.delay_samples + late


def _advise(spec: ControllerSpec, limit: float) -> str:
    if spec.limit_asked is None or spec.limit_asked > limit:
        return "that is the whole range of the command"
    return f"raise {'command_limit' if spec.current_limit_A is None else 'current_limit_A'}"


def check_current(spec: ControllerSpec, k_ff: float, command: Command, friction: Mapping[str, float]) -> None:
    """Refuse a current limit that does not hold the step, or does not overcome dry friction."""
    limit, per_effort, unit = command.limit(spec.limit_asked), command.per_effort, command.effort_unit
    if limit is None:
        return
    if limit <= per_effort * sum(friction.values()):
        levels = " and ".join(f"{name} of {effort:.4g} {unit}" for name, effort in friction.items())
        raise ControlError(
            f"a {command.word} of up to {command.show(limit)} makes {limit / per_effort:.4g} {unit}, no more than the "
            f"friction {levels}: nothing moves; {_advise(spec, limit)}"
        )
    largest = limit / (per_effort * abs(k_ff))
    if spec.step_N is not None and spec.step_N > largest:
        raise ControlError(
            f"step_N = {spec.step_N:g} takes {command.show(limit * spec.step_N / largest)} at rest, more than the "
            f"limit of {command.show(limit)}: no controller makes it; ask for {largest:.4g} {unit} at most"
        )
