r"""The limits that a controller can be asked to keep, one row each, for tuner, certificate, problem file and report.

A limit has a *figure* of one closed loop, and is kept where that figure is at most, at least or equal to what the
specification allows. While tuning, most limits are also a *curve*: with L the loop gain, broken at the command, at
every frequency from `from_hz` to `until_hz`,

.. math:: |X| \le m\,|1 + L| \quad (\text{or} \ge), \qquad X \in \{1,\, L,\, 1 - L,\, C_y,\, C_v,\, P C_r\},

which is affine in the gains between the absolute values. Scan, quadratic programs and interior point need no more than
X and m, and the certificate no more than the figure.

A new limit is one row here, and a field of the same name in `laws.spec.ControllerSpec`, which takes default, range and
description from the row; problem files have it from there.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any, Literal

from seaopt.control.loops.loop import DROOP_BAND, FALLEN_ABOVE, SHOULDER, SHOULDER_FALL, STABLE, LoopFigures
from seaopt.control.loops.peaks import HALF_POWER
from seaopt.errors import ControlError
from seaopt.formatting import join_words
from seaopt.records import record
from seaopt.units import LINEAR

LIMIT_ROUNDING = 1e-6  # by which a figure that lies on its limit may be beyond it
BANDWIDTH_TOLERANCE = 0.005
PASSIVE_ROUNDING = 1e-9  # Re Z/abs(Z) that is still called zero
PLACED_BELOW = 0.97  # of the bandwidth: up to here abs(F/F_ref) must be above -3 dB, which it reaches at the bandwidth
INTEGRAL_RAD_S = 2 * math.pi * 0.05  # k_i/(1 + k_p) at least, so that an integral does something
STEADY = 0.02  # of a step of the reference: how far the force may be off in the end
STEADY_PERIODS = 80.0  # of the bandwidth, after which that end begins

OTHER_NOISE, FAST_BANDWIDTH = "max_other_noise_gain", "min_bandwidth_sliding_fast_hz"

Sense = Literal["at most", "at least", "equal to"]
Symbol = Literal["≤", "≥", "="]
SYMBOLS: dict[Sense, Symbol] = {"at most": "≤", "at least": "≥", "equal to": "="}
Scope = Literal["every plant", "design plant"]


@record
class PortFigures:
    """How passive the design plant's port is in the band asked."""

    least_cosine: float  # least Re Z/abs(Z)
    at_hz: float  # where it is
    held_stable: bool  # nothing grows in the loop with its link held; where something does, it is passive nowhere


@record
class MeasuredLoop:
    """One plant's loop as limits are judged on it."""

    name: str  # of the plant
    figures: LoopFigures
    port: PortFigures | None = None  # the design plant's, where a passive band is asked for
    filter_samples: float = math.inf  # time constant of the derivative's filter; infinite where there is no derivative
    integral_rad_s: float = math.inf  # how fast the integral takes an error away, k_i/(1 + k_p); infinite without one
    # friction_slope, slope_unit: the steepest friction for which stability is shown, infinite where there is none, or
    # none is asked about, and its unit, empty without friction
    friction_slope: float = math.inf
    slope_unit: str = ""
    fast: LoopFigures | None = None  # where it slides fast, of a plant whose friction falls with the speed before
    gain_unit: str = LINEAR.gain  # of what the law gives over what it measures: N/N, N m/(N m), N m/rad
    other_gain_unit: str = ""  # the same of what it reads besides, where that is known

    def unit(self, limit: Limit) -> str:
        """Return the unit of a limit's figure: those of a friction's slope and of the noise gain are the plant's."""
        plants = {
            "max_noise_gain": self.gain_unit, OTHER_NOISE: self.other_gain_unit, "min_friction_margin": self.slope_unit
        }  # fmt: skip
        return plants.get(limit.name) or limit.unit


@record(eq=False)
class LimitCurve:
    """The constraint that the tuner keeps at every frequency: abs(X) below, or above, m abs(1 + L)."""

    of: Literal["1", "L", "1 - L", "C_y", "C_v", "P C_r"]  # X
    level: Callable[[float], float] = float  # m, of what the specification allows
    # from_hz, until_hz: where it begins and ends, of what is allowed and of the bandwidth asked; None: at every
    # frequency
    from_hz: Callable[[float, float], float] | None = None
    until_hz: Callable[[float, float], float] | None = None
    floor: bool = False  # abs(X) is to be above, not below
    fall: float = 0.0  # the level falls with the frequency to this power, from the bandwidth asked
    symbol: str = ""  # of abs(X)/abs(1 + L), where a message states this rather than the figure

    def numerator(self, p: Any, c_y: Any, c_r: Any, open_loop: Any, c_v: Any = 0.0) -> Any:
        """Return X of responses, which may be arrays or a solver's expressions."""
        match self.of:
            case "1":
                return 1.0
            case "L":
                return open_loop
            case "1 - L":
                return 1.0 - open_loop
            case "C_y":
                return c_y
            case "C_v":
                return c_v
            case "P C_r":
                return p * c_r

    def change(self, p: Any, by_y: Any, by_r: Any, by_loop: Any, by_v: Any = 0.0) -> Any:
        """Return the change of X with changes of C_y, C_r, C_v and L: X is affine in them."""
        return {"1": 0.0, "L": by_loop, "1 - L": -by_loop, "C_y": by_y, "C_v": by_v, "P C_r": p * by_r}[self.of]


@record(eq=False)
class Limit:
    """One limit."""

    name: str  # of the specification's field, of the problem file's key, and in messages
    label: str  # of the figure, in tables
    figure: Callable[[MeasuredLoop], float]
    sense: Sense  # what the figure is to be to what is allowed
    scope: Scope  # whose figure
    # meaning, remedy: what it means, and what to do where it is broken
    meaning: str
    remedy: str
    eased_by: tuple[str, ...] = ()  # other limits that stand in its way where they are active
    unit: str = ""  # of the figure; empty for a ratio
    # default, bandwidth_divisor: what is allowed where the specification leaves it out (None), a number or bandwidth_hz
    # over one; without either it is then not imposed. False in the specification lifts a limit
    default: float | None = None
    bandwidth_divisor: float | None = None
    # of a limit of the design plant: where friction sticks it holds there too, not on the sliding plant alone
    stuck_too: bool = False
    # of a limit of the design plant: it is asked where that slides fast, not where its friction falls the most
    of_fast: bool = False
    allowed: float | None = None  # what is always allowed, of a limit whose field says where it holds, or that has none
    has_field: bool = True  # of the specification; without one the limit always holds
    # above, below: ends, exclusive, of what may be asked; `above` is None where the specification has its own check
    above: float | None = 0.0
    below: float | None = None
    condition: Callable[[MeasuredLoop], bool] | None = None  # what must be true of the loop besides
    tolerance: float = LIMIT_ROUNDING  # by which the figure may miss what is allowed: a share, or of 0 an amount
    # where the tuner takes the specification's reserve off: the figure itself; only the curve's level, where the figure
    # is a frequency; nowhere
    reserve: Literal["figure", "curve", "none"] = "figure"
    curve: LimitCurve | None = None  # what the tuner looks at
    requirement: str = ""  # the name in a certificate, where it is another

    @property
    def symbol(self) -> Symbol:
        """The sense as a sign."""
        return SYMBOLS[self.sense]

    @property
    def default_text(self) -> str:
        """The default in words."""
        if not self.has_field:
            return "always"
        if self.bandwidth_divisor is not None:
            return f"bandwidth_hz/{self.bandwidth_divisor:g}"
        return "not imposed" if self.default is None else f"{self.default:g}"

    @property
    def description(self) -> str:
        """Its meaning, the plant it judges, its default, and what to do where it is broken."""
        return f"{self.meaning} ({self.scope}; left out: {self.default_text}). Where it is broken: {self.remedies}."

    @property
    def remedies(self) -> str:
        """What to do where it is broken, with the other limits to ease where they are active."""
        active = join_words([f"{name} where it is active" for name in self.eased_by])
        return f"{self.remedy}, or ease {active}" if active else self.remedy

    @property
    def is_default(self) -> bool:
        """Whether it is imposed where the specification leaves it out."""
        return self.default is not None or self.bandwidth_divisor is not None

    def allow(self, level: Any, bandwidth_hz: float) -> float | None:
        """Return what a specification's level allows, None being its default; None where nothing is imposed.
        `bandwidth_hz` is the one that is asked for. A limit without a field has no level.
        """
        if level is False or (self.allowed is not None and self.has_field and level is None):
            return None
        if self.allowed is not None:
            return self.allowed
        if level is not None:
            return level
        return self.default if self.bandwidth_divisor is None else bandwidth_hz / self.bandwidth_divisor

    def check(self, level: Any, bandwidth_hz: float) -> None:
        """Refuse a level that is not a finite number, None or False, or that no loop can keep."""
        if level is None or level is False:
            return
        if isinstance(level, bool) or not isinstance(level, (int, float)) or not math.isfinite(level):
            raise ControlError(
                f"{self.name} = {level!r} is not a finite number; give one, or lift the limit: {self.name} = false"
            )
        if self.above is not None and not self.above < level < (self.below or math.inf):
            upper = "" if self.below is None else f" and less than {self.below:g}"
            raise ControlError(
                f"{self.name} = {level:g} can be met by no loop; give more than {self.above:g}{upper}, "
                f"or lift the limit: {self.name} = false"
            )
        if self.bandwidth_divisor is not None and not 0.0 <= level < bandwidth_hz:
            raise ControlError(
                f"{self.name} = {level:g} is not between 0 and bandwidth_hz = {bandwidth_hz:g}; lower it: "
                f"{self.name} = {0.2 * bandwidth_hz:g}"
            )

    def keeps(self, value: float, allowed: float) -> bool:
        """Tell whether a figure keeps the limit."""
        slack = self.tolerance * (abs(allowed) or 1.0)
        if self.sense == "equal to":
            return bool(abs(value - allowed) <= slack)
        return bool(value <= allowed + slack if self.sense == "at most" else value >= allowed - slack)

    def usage(self, value: float, allowed: float) -> float:
        """Return how much of the limit a figure uses: 1 is all of it."""
        if self.allowed == 0.0:
            return 1.0 - value
        return value / allowed if self.sense == "at most" else allowed / max(value, 1e-12)


def _find_fast_bandwidth(loop: MeasuredLoop) -> float:
    """Return the bandwidth where the plant slides fast; where its friction does not fall, as it slides at all."""
    figures = loop.figures if loop.fast is None else loop.fast
    reached = math.inf if figures.bandwidth_hz is None else figures.bandwidth_hz
    return reached if figures.stable else 0.0


def _port(loop: MeasuredLoop) -> PortFigures:
    assert loop.port is not None, "a passive band is judged on the port's figures"
    return loop.port


LIMITS = (
    Limit(
        name="stability", requirement="spectral_radius", has_field=False, label="spectral radius",
        figure=lambda loop: loop.figures.spectral_radius, sense="at most", scope="every plant", allowed=1.0,
        tolerance=STABLE - 1.0, reserve="none",
        meaning="largest magnitude of the closed loop's eigenvalues; below 1 the loop is stable",
        remedy="tune with that plant in robust_to",
    ),
    Limit(
        name="max_sensitivity", label="Ms", figure=lambda loop: loop.figures.ms, sense="at most", scope="every plant",
        above=1.0, default=1.7, curve=LimitCurve(of="1"),
        meaning="Ms, peak of |S|: 1/Ms is the distance of the loop gain from -1",
        remedy="lower the bandwidth, or sample faster", eased_by=("max_noise_gain",),
    ),
    Limit(
        name="max_complementary", label="Mt", figure=lambda loop: loop.figures.mt, sense="at most",
        scope="every plant", default=1.3, curve=LimitCurve(of="L"),
        meaning="Mt, peak of |L/(1 + L)|: 1/Mt is the relative error of the plant that the loop tolerates",
        remedy="lower the bandwidth", eased_by=("max_sensitivity", "max_noise_gain"),
    ),
    Limit(
        name="min_disk_margin", label="disk margin", figure=lambda loop: loop.figures.disk_margin, sense="at least",
        scope="every plant", below=2.0, curve=LimitCurve(of="1 - L", level=lambda margin: 2.0 / margin),
        meaning="symmetric disk margin, below 2: gain and phase may both be off by this much at once",
        remedy="lower the bandwidth",
    ),
    Limit(
        name="max_reference_peak", label="reference peak", figure=lambda loop: loop.figures.reference_peak,
        sense="at most", scope="design plant", above=1.0, default=1.3, stuck_too=True,
        curve=LimitCurve(of="P C_r"),
        meaning="peak of |F/F_ref| over its static value",
        remedy="use a pid_dob, leave reference_weights tuned, or lower the bandwidth",
    ),
    Limit(
        name="max_droop_db", label="droop", figure=lambda loop: loop.figures.droop_db, sense="at most",
        scope="design plant", unit="dB", default=1.0, below=3.0,
        curve=LimitCurve(
            of="P C_r", level=lambda droop_db: 10.0 ** (-droop_db / 20.0),
            until_hz=lambda _, bandwidth_hz: bandwidth_hz * DROOP_BAND, floor=True,
        ),
        meaning="how far |F/F_ref| falls below its static value up to a third of the bandwidth",
        remedy="leave reference_weights tuned, or ask for another bandwidth",
        eased_by=("max_sensitivity", "max_noise_gain"),
    ),
    Limit(
        name="max_noise_gain", label="noise gain", figure=lambda loop: loop.figures.noise_gain, sense="at most",
        scope="design plant", unit="N/N", stuck_too=True, curve=LimitCurve(of="C_y"),
        meaning="peak of |F_m/noise on F|: motor force that the sensor's noise makes",
        remedy="lower the bandwidth, or filter the sensor",
    ),
    Limit(
        name=OTHER_NOISE, label="other signals' noise gain",
        figure=lambda loop: max(loop.figures.other_noise_gains, default=0.0), sense="at most", scope="design plant",
        unit="effort per unit", stuck_too=True, curve=LimitCurve(of="C_v"),
        meaning="peak of |F_m/noise on what the law reads besides|, the largest; of a cascade that of its encoder "
        "(per rad or m), or of its speed",
        remedy="lower the bandwidth", eased_by=("max_noise_gain",),
    ),
    Limit(
        name="min_sensitivity_bandwidth_hz", label="sensitivity bandwidth",
        figure=lambda loop: loop.figures.sensitivity_bandwidth_hz, sense="at least", scope="design plant", unit="Hz",
        above=None, bandwidth_divisor=5.0, tolerance=1e-3, reserve="curve",
        curve=LimitCurve(of="1", level=lambda _: HALF_POWER, until_hz=lambda allowed, _: allowed, symbol="|S|"),
        meaning="|S| stays below -3 dB up to here: feedback, not feedforward, makes the bandwidth",
        remedy="lower the bandwidth, or shorten the delay",
        eased_by=("max_sensitivity", "max_complementary", "max_noise_gain"),
    ),
    Limit(
        name="bandwidth_hz", label="bandwidth",
        figure=lambda loop: math.inf if loop.figures.bandwidth_hz is None else loop.figures.bandwidth_hz,
        sense="equal to", scope="design plant", unit="Hz", above=None,
        default=30.0, tolerance=BANDWIDTH_TOLERANCE, reserve="none",
        curve=LimitCurve(
            of="P C_r", level=lambda _: HALF_POWER, until_hz=lambda _, bandwidth_hz: PLACED_BELOW * bandwidth_hz,
            floor=True,
        ),
        meaning="lowest frequency at which |F/F_ref| is 3 dB below its value at 0 Hz, met to 0.5 %",
        remedy="ask for the largest bandwidth that the result names",
    ),
    Limit(
        name=FAST_BANDWIDTH, label="bandwidth, sliding fast", figure=_find_fast_bandwidth,
        sense="at least", scope="design plant", unit="Hz", of_fast=True, tolerance=BANDWIDTH_TOLERANCE, reserve="curve",
        curve=LimitCurve(
            of="P C_r", level=lambda _: HALF_POWER, until_hz=lambda allowed, _: allowed, floor=True,
        ),
        meaning="the bandwidth where friction that falls with the speed (Stribeck's) falls no more; bandwidth_hz is "
        "placed where it falls the steepest, which no motion keeps to",
        remedy="ask for a higher bandwidth_hz", eased_by=("max_sensitivity", "max_noise_gain"),
    ),
    Limit(
        name="shoulder_hz", has_field=False, label="|F/F_ref| again above -3 dB at",
        figure=lambda loop: math.inf if loop.figures.return_hz is None else loop.figures.return_hz,
        sense="at least", scope="design plant", unit="Hz", bandwidth_divisor=1.0 / SHOULDER,
        tolerance=BANDWIDTH_TOLERANCE, reserve="curve",
        curve=LimitCurve(
            of="P C_r", level=lambda _: HALF_POWER, from_hz=lambda _, bandwidth_hz: FALLEN_ABOVE * bandwidth_hz,
            until_hz=lambda allowed, _: allowed, fall=SHOULDER_FALL,
        ),
        meaning="where |F/F_ref| (f/bandwidth)^0.25 is again above -3 dB, three bandwidths or more: neither a dip nor "
        "a shoulder makes a bandwidth",
        remedy="ask for the bandwidths that the result names",
    ),
    Limit(
        name="min_filter_samples", label="derivative's filter", figure=lambda loop: loop.filter_samples,
        sense="at least", scope="design plant", unit="T_s", default=1.0, reserve="none",
        meaning="T_f in samples: a faster filter lets the derivative amplify what lies between two samples",
        remedy="tune again",
    ),
    Limit(
        name="integral_rad_s", has_field=False, label="rate of the integral", figure=lambda loop: loop.integral_rad_s,
        sense="at least", scope="design plant", unit="rad/s", allowed=INTEGRAL_RAD_S, reserve="none",
        meaning="k_i/(1 + k_p) of an integral, 2 pi 0.05 or more: a slower one leaves errors for tens of seconds",
        remedy="tune again, or leave the integral out",
    ),
    Limit(
        name="min_friction_margin", label="friction margin", figure=lambda loop: loop.friction_slope, sense="at least",
        scope="every plant", unit="N s/m or N m s/rad",
        meaning="steepest friction, counted from its flattest slope, for which stability is shown",
        remedy="ask for the largest that the result names, or lower the bandwidth", eased_by=("max_noise_gain",),
    ),
    Limit(
        name="passive_band_hz", label="least Re Z/|Z| in the passive band", sense="at least",
        scope="design plant", figure=lambda loop: _port(loop).least_cosine,
        condition=lambda loop: _port(loop).held_stable, above=None, allowed=0.0, tolerance=PASSIVE_ROUNDING,
        meaning="from low to high the port at link 2 is passive with link 1 held: Re Z/|Z| is not negative, "
        "and the loop does not grow",
        remedy="tune with this band, or narrow it",
    ),
)  # fmt: skip
BY_NAME = {limit.name: limit for limit in LIMITS}
BY_REQUIREMENT = {limit.requirement or limit.name: limit for limit in LIMITS}
FIELDS = tuple(limit for limit in LIMITS if limit.has_field)
LIFTABLE = (*(limit.name for limit in FIELDS if limit.above is not None), "min_sensitivity_bandwidth_hz")


@cache
def list_given_limits(bandwidth_tolerance: float) -> tuple[Limit, ...]:
    """Return the limits of a law that is given, not tuned: it may have more bandwidth, and less by this share."""
    return tuple(
        replace(row, sense="at least", tolerance=bandwidth_tolerance) if row.name == "bandwidth_hz" else row
        for row in LIMITS
    )
