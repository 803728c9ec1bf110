r"""A scheduled law in step order: blocks made of the gains of the place, whose states are signals.

Only gains are interpolated, so that the law at a place is made where it is used, and what it keeps from one sample to
the next has to mean the same with any gains: efforts, references and measurements as filters have them. With the
reference r behind the prefilter, and r and every reading behind the notch,

.. math::
    v &= k_r r - k_p y + x_I + \tfrac12 k_i T_s (r - y)
         + k_d\,\alpha\,\big(c\,(r - x_r) - (y - x_y)\big), \qquad \alpha = \frac{1}{T_f + T_s}, \\
    x_I^+ &= x_I + k_i T_s (r - y) + K_1 (\mathrm{sat}(u) - u), \qquad
    x_r^+ = x_r + \alpha T_s (r - x_r), \qquad x_y^+ = x_y + \alpha T_s (y - x_y) .

Of a pid u is v. **A cascade** has a speed s, read or the difference of two positions,

.. math:: w = v - k_v s, \qquad u = k_{ff} r + w + \tfrac{T_s}{2 T_v} w + x_v, \qquad
          x_v^+ = x_v + \tfrac{T_s}{T_v} w + K_2 (\mathrm{sat}(u) - u) .

**An observer** sees the saturated command,

.. math:: u = v + Q_0 \Big(\sum_i \kappa_i q^i\, \mathrm{sat}(u) - \frac{A}{B_s B_u(1)} y\Big),

two equal lags behind the last efforts and an inverse plant, whose factors are the same at all places.

**A link's feedforward** has the filters of `seaopt.control.loops.compensation.link_feedforward` in front of its two
numbers, outside all else: an observer sees what it makes as little as what terms add.

**Filters** are state-variable ones by Tustin's rule (Zavalishin, The Art of VA Filter Design, 2012): w = tan(pi f T_s),

.. math:: h = \frac{u - (2\zeta + w) s_1 - s_2}{1 + 2\zeta w + w^2}, \qquad b = w h + s_1, \qquad l = w b + s_2, \qquad
          s_1^+ = b + w h, \qquad s_2^+ = l + w b ,

l the low-pass and b the band-pass, of which a notch is :math:`u - 2 \zeta (1 - g) b`. At rest :math:`s_1 = 0` and
:math:`s_2 = u`. In front of all else the notch does not delay what anti-windup does to the integral.

With gains that stand still this is the law of `seaopt.control.laws.structures` exactly, since
:math:`\frac{T_s}{2}\frac{1+q}{1-q} = T_s \frac{q}{1-q} + \frac{T_s}2` and :math:`D = \alpha (1 - \frac{(1-p) q}{1 - p
q})` with :math:`p = T_f/(T_f + T_s)`; c stands outside the filter, so that its change is not differentiated. K moves
the m integrators as in `seaopt.control.laws.realisation`.

Numbers may be floats or symbols: the C code is this step, traced.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal

import numpy as np

from seaopt.control.laws.structures import PREFILTER_DAMPING, PREFILTER_ORDERS, Nominal, PrefilterOrder, SpeedLoop
from seaopt.control.loops.transfer_function import TransferFunction
from seaopt.records import record

Numbers = Mapping[str, Any]
SHARE = "anti_windup"  # T_s/(T_t + T_s), among the numbers of a place
INVERSE_GAIN = "inverse_gain"  # of the nominal plant's inverse, there


@record
class StepOrder:
    """What a scheduled law is made of, alike at all places."""

    sample_time_s: float
    integrates: bool  # the error
    prefilter: PrefilterOrder | None = None
    notch: bool = False
    speed: SpeedLoop | None = None  # of a cascade
    speed_integrates: bool = False
    nominal: Nominal | None = None  # of an observer, but for the gain of its inverse
    link: Literal["position", "speed"] | None = None  # what is fed forward of it, the last signal that is read
    link_high_pass: bool = False

    @property
    def measured(self) -> int:
        """How many signals it reads."""
        return 1 + (self.speed is not None) + (self.link is not None)

    def find_rest(self, reference: Any, readings: Sequence[Any]) -> dict[str, Any]:
        """Return the states at rest under constant inputs, integrals at zero."""
        x = {"integral": 0.0, "reference": reference, "measurement": readings[0]}
        if not self.integrates:
            del x["integral"]
        if self.speed is not None:
            x |= {"position": readings[1]} if self.speed.differenced else {}
            x |= {"speed_integral": 0.0} if self.speed_integrates else {}
        if self.nominal is not None:
            x |= {"lag_1": 0.0, "lag_2": 0.0} | dict.fromkeys(self._list_efforts(), 0.0)
            seen = readings[0]
            for i, part in enumerate(self.nominal.inverse[:-1], start=1):
                given, seen = seen, seen * float(np.sum(part.num) / np.sum(part.den))
                later = 0.0
                for number, (b, a) in reversed(list(enumerate(_pair_coefficients(part), start=1))):
                    x[f"inverse_{i}_{number}"] = later = (b * given - a * seen) + later
        filters = {"prefilter": reference} if self.prefilter else {}
        if self.notch:
            law = readings[: self.measured - (self.link is not None)]
            filters |= {"notch_reference": reference} | {f"notch_{i}": y for i, y in enumerate(law, start=1)}
        if self.link is not None:
            filters |= {"link_slow": readings[-1], "link": 0.0} if self.link_high_pass else {"link": readings[-1]}
        for name, value in filters.items():
            x |= {name: value} if self._is_first_order(name) else {f"{name}_band": 0.0, name: value}
        return x

    def _list_efforts(self) -> list[str]:
        """Return the names of the last efforts, the newest first."""
        return [] if self.nominal is None else [f"effort_{i}" for i in range(1, self.nominal.kept.size)]

    def _is_first_order(self, name: str) -> bool:
        return name == "link_slow" or (name == "prefilter" and self.prefilter == PREFILTER_ORDERS[0])

    def continue_from(self, g: Numbers, effort: Any, reference: Any, readings: Sequence[Any]) -> dict[str, Any]:
        """Return the states at rest from which the next effort is one that was, where something integrates."""
        x = self.find_rest(reference, readings)
        if self.link is not None:
            effort = effort - self._feed_link(g, x, {}, readings[-1])
        outer, scale = "speed_integral" if self.speed_integrates else "integral", 1.0
        if self.nominal is not None:  # both lags rest, or the second makes the effort where nothing else can
            x |= dict.fromkeys(self._list_efforts(), effort)
            lag = g["T_q"] + self.sample_time_s
            gap = self._evaluate(g, x, reference, readings)[3]["lag_1"] * (lag / self.sample_time_s)
            x |= {"lag_1": gap, "lag_2": gap if self.integrates else 0.0}
            outer, scale = (outer, 1.0) if self.integrates else ("lag_2", lag / g["T_q"])
        if self.speed_integrates and self.integrates:  # what the speed loop integrates rests
            x["integral"] = -self._evaluate(g, x, reference, readings)[1]
        if outer in x:
            x[outer] = (effort - self._evaluate(g, x, reference, readings)[0]) * scale
        return x

    def step(
        self,
        g: Numbers,
        x: Numbers,
        reference: Any,
        readings: Sequence[Any],
        saturate: Callable[[Any], Any],
        added: Any = None,
    ) -> tuple[Any, Any, dict[str, Any]]:
        """Return the effort with what is added to it, what is left of it in its limit, and the next states."""
        effort, into_speed, half, after = self._evaluate(g, x, reference, readings)
        outside: Any = None if self.link is None else self._feed_link(g, x, after, readings[-1])
        if added is not None:
            outside = added if outside is None else outside + added
        effort = effort if outside is None else effort + outside
        applied, ts, share = saturate(effort), self.sample_time_s, g[SHARE]
        excess = applied - effort
        pull = share * excess
        if self.speed_integrates:
            inner = share * (share * (g["T_v"] / ts)) if self.integrates else 0.0
            outer = (2.0 * share - inner) - 0.5 * (share * share) if self.integrates else share
            after["speed_integral"] = (x["speed_integral"] + (ts / g["T_v"]) * into_speed) + outer * excess
            pull = inner * excess
        if self.integrates:
            after["integral"] = (x["integral"] + 2.0 * half) + pull
        efforts = self._list_efforts()
        seen = applied if outside is None else applied - outside
        after |= dict(zip(efforts, (seen, *(x[name] for name in efforts[:-1])), strict=False))
        return effort, applied, {name: after[name] for name in x}

    def _evaluate(
        self, g: Numbers, x: Numbers, reference: Any, readings: Sequence[Any]
    ) -> tuple[Any, Any, Any, dict[str, Any]]:
        """Return the effort, not limited, what a speed loop integrates, what half a sample adds to the integral, and
        the next states but for integrals.
        """
        after, ts = dict[str, Any](), self.sample_time_s
        y, *further = readings[: self.measured - (self.link is not None)]
        r = reference
        if self.prefilter:
            r = _filter(x, after, "prefilter", r, g["prefilter_w"], g.get(PREFILTER_DAMPING))[0]
        if self.notch:
            r, y, *further = (
                u
                - (2.0 * g["notch_width"] * (1.0 - g["notch_depth"]))
                * _filter(x, after, name, u, g["notch_w"], g["notch_width"])[1]
                for name, u in zip(("notch_reference", "notch_1", "notch_2"), (r, y, *further), strict=False)
            )
        alpha = 1.0 / (g["T_f"] + ts)
        half = ((0.5 * ts) * g["k_i"]) * (r - y) if self.integrates else 0.0
        rate = g["c"] * (r - x["reference"]) - (y - x["measurement"])
        turn = alpha * ts
        after["reference"] = x["reference"] + turn * (r - x["reference"])
        after["measurement"] = x["measurement"] + turn * (y - x["measurement"])
        effort = g["k_r"] * r - g["k_p"] * y
        if self.integrates:
            effort = (effort + x["integral"]) + half
        effort = effort + (g["k_d"] * alpha) * rate
        if self.nominal is not None:
            effort = effort + self._observe(g, x, after, y)
        if self.speed is None:
            return effort, 0.0, half, after
        (speed,) = further
        if self.speed.differenced:
            after["position"], speed = speed, (speed - x["position"]) / ts
        into_speed = effort - g["k_v"] * speed
        effort = g["k_ff"] * r + into_speed
        if self.speed_integrates:
            effort = (effort + (0.5 * ts / g["T_v"]) * into_speed) + x["speed_integral"]
        return effort, into_speed, half, after

    def _feed_link(self, g: Numbers, x: Numbers, after: dict[str, Any], read: Any) -> Any:
        """Return what is fed forward of the link's motion, and put down its next states."""
        if self.link_high_pass:
            read = read - _filter(x, after, "link_slow", read, g["link_slow_w"], None)[0]
        low, band = _filter(x, after, "link", read, g["link_w"], math.sqrt(0.5))
        corner = (2.0 / self.sample_time_s) * g["link_w"]
        if self.link == "speed":
            return corner * (g["link_inertia"] * band) + g["link_damping"] * low
        high = (read - low) - math.sqrt(2.0) * band
        return corner * (corner * (g["link_inertia"] * high) + g["link_damping"] * band)

    def _observe(self, g: Numbers, x: Numbers, after: dict[str, Any], y: Any) -> Any:
        """Return what an observer adds to the effort, and put down its next states."""
        assert self.nominal is not None
        for i, part in enumerate(self.nominal.inverse[:-1], start=1):
            pairs = [*_pair_coefficients(part), (0.0, 0.0)]
            names = [f"inverse_{i}_{number}" for number in range(1, len(pairs))]
            seen = float(part.num[0]) * y + x[names[0]] if names else float(part.num[0]) * y
            for name, (b, a), later in zip(names, pairs, (*names[1:], ""), strict=False):
                after[name] = (b * y - a * seen) + x[later] if later else b * y - a * seen
            y = seen
        gap = -g[INVERSE_GAIN] * y
        for weight, name in zip(self.nominal.kept[1:].tolist(), self._list_efforts(), strict=True):
            gap = gap + weight * x[name] if weight else gap
        lag = 1.0 / (g["T_q"] + self.sample_time_s)
        short, pole = self.sample_time_s * lag, g["T_q"] * lag
        after["lag_1"] = pole * x["lag_1"] + short * gap
        after["lag_2"] = pole * x["lag_2"] + short * after["lag_1"]
        return after["lag_2"]


def _pair_coefficients(part: TransferFunction) -> list[tuple[float, float]]:
    """Return numerator and denominator from the first power of q on, in pairs."""
    count = max(part.num.size, part.den.size)
    num, den = (np.pad(side, (0, count - side.size)).tolist() for side in (part.num, part.den))
    return list(zip(num[1:], den[1:], strict=True))


def _filter(x: Numbers, after: dict[str, Any], name: str, u: Any, w: Any, damping: Any) -> tuple[Any, Any]:
    """Return the low-pass and the band-pass of a signal, and put down its next states; without a damping it is of first
    order, and has no band-pass.
    """
    if damping is None:
        moved = (u - x[name]) * (w / (1.0 + w))
        low = moved + x[name]
        after[name] = low + moved
        return low, 0.0
    band = f"{name}_band"
    high = ((u - (2.0 * damping + w) * x[band]) - x[name]) / (1.0 + w * (2.0 * damping + w))
    passed = w * high + x[band]
    low = w * passed + x[name]
    after[band], after[name] = passed + w * high, low + w * passed
    return low, passed
