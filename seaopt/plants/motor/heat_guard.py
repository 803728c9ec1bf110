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
        winding, case = rises
        target = winding + self.share * (self.allowed_rise - winding)
        room = target - (self.a_11 * winding + self.a_12 * case)
        return math.sqrt(max(room, 0.0) / (self.b_1 * (self.resistance + self.slope * target)))

    def warm(self, rises: tuple[float, float], current_A: float) -> tuple[float, float]:
        """Return winding and case above the ambient (K) after a sample of a current."""
        winding, case = rises
        free, squared = self.a_11 * winding + self.a_12 * case, current_A * current_A
        end = free + self.b_1 * (self.resistance + self.slope * winding) * squared
        loss = (self.resistance + self.slope * max(winding, end)) * squared
        return free + self.b_1 * loss, self.a_21 * winding + self.a_22 * case + self.b_2 * loss
