r"""Derating: how much current a running law may command so that the winding never passes its largest temperature.

The network of `seaopt.plants.motor.thermal` runs with the law, exactly discretised for a loss that is held over a
sample,

.. math:: \vartheta_{k+1} = A \vartheta_k + b P_k, \qquad P_k = R(\vartheta_w) I_k^2, \qquad
          A = e^{A_0 T_s}, \; b = A_0^{-1} (A - 1) \begin{pmatrix} 1/C_w \\ 0 \end{pmatrix}

from the ambient temperature, with the current that was commanded. A sample's loss is limited so that the winding
comes no nearer to its largest rise H than by a share of what is left,

.. math:: \vartheta_{w,k+1} \le \vartheta_t = \vartheta_w + s (H - \vartheta_w), \qquad s = 1 - e^{-T_s/\tau}
          \quad\Rightarrow\quad I^2 \le \frac{\vartheta_t - (A \vartheta)_w}{b_w R(\vartheta_t)}

R is that of the sample's warm end, so that what it grows by meanwhile is on the safe side. A winding that is at H or
below stays so for ever, and the limit falls smoothly to the continuous current, as the case warms up. tau is the time
constant of that approach, a twentieth of the winding's own where it is left out. A cold winding is not limited at all
as long as the current limit warms it more slowly than that.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np

from seaopt.errors import ControlError, require_number
from seaopt.plants.motor.thermal import MotorRating
from seaopt.records import record

APPROACH = 0.05  # of the winding's time constant
COLD = (0.0, 0.0)


@record
class HeatGuard:
    """The two-state estimate of a winding's temperature at a sample rate, and what it allows."""

    # a_11, a_12, a_21, a_22, b_1, b_2: A, and b in K/W
    a_11: float
    a_12: float
    a_21: float
    a_22: float
    b_1: float
    b_2: float
    # resistance, slope: of the winding at the ambient temperature, ohm, and per kelvin above it
    resistance: float
    slope: float
    allowed_rise: float  # H, K above the ambient
    share: float  # s
    ambient: float  # degC that was assumed

    @classmethod
    def of_rating(
        cls, rating: MotorRating, sample_time_s: float, *, approach_s: float | None = None, margin_K: float = 0.0
    ) -> HeatGuard:
        """Return the guard of a motor. `sample_time_s`: of the law. `approach_s`: tau; a twentieth of the winding's
        time constant if left out. `margin_K`: how far below its largest temperature the winding is to stay, for what
        the network leaves out. Raises ControlError: a number is out of range.
        """
        tau = APPROACH * rating.time_constants_s()[0] if approach_s is None else approach_s
        for name, value in (("sample_time_s", sample_time_s), ("approach_s", tau)):
            if not require_number(value, name, ControlError) > 0.0:
                raise ControlError(f"{name} = {value:g} is not positive; give seconds")
        if not 0.0 <= require_number(margin_K, "margin_K", ControlError) < rating.allowed_rise:
            raise ControlError(
                f"margin_K = {margin_K:g} is not from 0 to below {rating.allowed_rise:g}, what T_max leaves above the "
                "ambient temperature"
            )
        rates, modes = np.linalg.eig(rating.matrix())
        inverse = np.linalg.inv(modes)
        a = modes @ np.diag(np.exp(rates * sample_time_s)) @ inverse
        b = modes @ np.diag(np.expm1(rates * sample_time_s) / rates) @ inverse[:, 0] / rating.winding
        return cls(
            a_11=float(a[0, 0]),
            a_12=float(a[0, 1]),
            a_21=float(a[1, 0]),
            a_22=float(a[1, 1]),
            b_1=float(b[0]),
            b_2=float(b[1]),
            resistance=rating.resistance,
            slope=rating.slope,
            allowed_rise=rating.allowed_rise - margin_K,
            share=-math.expm1(-sample_time_s / tau),
            ambient=rating.ambient,
        )

    def limit(self, rises: tuple[float, float]) -> float:
        """Return the largest current (A) of the next sample, from winding and case above the ambient (K)."""
        return limit_current(self.numbers, rises, _FLOATS)

    def warm(self, rises: tuple[float, float], current_A: float) -> tuple[float, float]:
        """Return winding and case above the ambient (K) after a sample of a current."""
        winding, case = warm_winding(self.numbers, rises, current_A, _FLOATS)
        return winding, case

    @property
    def numbers(self) -> tuple[float, ...]:
        """Its numbers, in the order in which `limit_current` and `warm_winding` take them."""
        heating = self.a_11, self.a_12, self.a_21, self.a_22, self.b_1, self.b_2
        return *heating, self.resistance, self.slope, self.allowed_rise, self.share


HEAT_NUMBERS = 10
_FLOATS = SimpleNamespace(sqrt=math.sqrt, fmax=max)


def limit_current(numbers: Sequence[Any], rises: Sequence[Any], operations: Any) -> Any:
    """Return the largest current of the next sample; `operations`: casadi for expressions."""
    a_11, a_12, _, _, b_1, _, resistance, slope, allowed_rise, share = numbers
    winding, case = rises
    target = winding + share * (allowed_rise - winding)
    room = target - (a_11 * winding + a_12 * case)
    return operations.sqrt(operations.fmax(room, 0.0) / (b_1 * (resistance + slope * target)))


def warm_winding(numbers: Sequence[Any], rises: Sequence[Any], current_A: Any, operations: Any) -> list[Any]:
    """Return winding and case after a sample of a current; `operations`: casadi for expressions."""
    a_11, a_12, a_21, a_22, b_1, b_2, resistance, slope, *_ = numbers
    winding, case = rises
    free, squared = a_11 * winding + a_12 * case, current_A * current_A
    end = free + b_1 * (resistance + slope * winding) * squared
    loss = (resistance + slope * operations.fmax(winding, end)) * squared
    return [free + b_1 * loss, a_21 * winding + a_22 * case + b_2 * loss]
