r"""The loop of a law and a measured plant: the worst that any response in its discs does, and whether it is stable.

With P in the disc of centre :math:`P_0` and radius r, what the law reads besides in a disc of centre b - 1 and radius
:math:`\rho_b` (:math:`\sum_i P_i C_i`, of the centres, and :math:`\sum_i r_i |C_i|`; b = 1 where it reads nothing
else), :math:`1 + L = b + P C_y` of the centres a, :math:`\rho = r |C_y| + \rho_b` and :math:`D = |a|^2 - \rho^2 > 0`,
every figure but the last is a Moebius map of L, whose image is again a disc:

.. math:: \frac{X}{1 + L} \in \frac{1}{D}\Big(X_0 \bar a + s,\; R\Big), \qquad
    \begin{array}{c|cccccc} X & 1 & L & 1 - L & C_y & C_v & P C_r \\ \hline
    s & 0 & -\rho^2 & \rho^2 & 0 & 0 & -r^2 C_r \bar C_y \\
    R & \rho & \rho & 2\rho & \rho |C_y| & \rho |C_v| & r |C_r b| \end{array}

so that the largest and the least are exact. The last is one of P, with :math:`r |C_y|` for :math:`\rho`; of all the
values of b it is at most :math:`(|a| - r |C_y|)/(|a| - \rho)` times the largest, and at least
:math:`(|a| - r |C_y|)/(|a| - r |C_y| + \rho_b)` times the least. Where :math:`D \le 0` some response in the discs makes
a pole on the circle.

**Stability** cannot be told from points alone. With a stable plant, a law with m poles at 1 and none outside, and no
discs in which 1 + L reaches zero at any frequency, it can: every response in the discs turns 1 + L as often as the
centres do, and the loop is stable if and only if that is :math:`m \pi/2` from 0 Hz to the Nyquist frequency (Nyquist;
as the condition on measured data: Karimi, Kammer, Automatica 85, 2017, theorem 1, with C = 0 as the stabilising law
that is known). Between, below and above the points it holds under the assumptions of
`seaopt.control.loops.measured.plant`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from seaopt.codec import OrInfinite, OrNaN
from seaopt.control.loops.law import Law
from seaopt.control.loops.loop import DROOP_BAND, FALLEN_ABOVE, GRID_LOWEST_HZ, SHOULDER, SHOULDER_FALL, LoopFigures
from seaopt.control.loops.measured.plant import ASSUMED, MeasuredPlant
from seaopt.control.loops.peaks import HALF_POWER
from seaopt.control.loops.transfer_function import Frequencies, Response
from seaopt.control.systems.crossings import count_turns, find_crossings
from seaopt.formatting import format_number, format_percent
from seaopt.records import record

POINTS_BETWEEN = 4  # of the grid between two measured frequencies
MOST_TURN_RAD = 0.5  # between neighbours of the grid, refined until then
REFINEMENTS = 12
LEFT = 0.1  # of abs(1 + L)^2: where discs leave less, D goes on as a positive number, so that it has a logarithm
KNOWN_TO = 0.97  # of a bandwidth: what `seaopt.control.laws.limits` asks of |F/F_ref| up to there
ROUND = 0.25  # of a quarter turn, by which the count may be off
SLOWEST_HZ = 1e-6


def leave_positive(left: Any, least: Any = np.minimum, most: Any = np.maximum) -> Any:
    """Return a number, or below `LEFT` a positive one that continues it smoothly; of arrays or expressions."""
    return most(left, LEFT) - LEFT + LEFT * LEFT / (2.0 * LEFT - least(left, LEFT))


@record(eq=False)
class DiscLoop:
    """A measured plant closed by a law; what this reads besides the outputs, such as a held link, is zero."""

    plant: MeasuredPlant
    law: Law

    def open_loop(self, f: Frequencies) -> Response:
        """Return L of the centres."""
        back = self.law.feedback_responses(f)
        return np.sum(self.plant.responses(f, len(back)) * back, axis=0)

    def sensitivity(self, f: Frequencies) -> Response:
        """Return S of the centres."""
        return 1.0 / (1.0 + self.open_loop(f))

    def tracking(self, f: Frequencies) -> Response:
        """Return F/F_ref of the centres."""
        return self.plant.response(f) * self.law.reference_response(f) * self.sensitivity(f)

    def bound(self, f: Frequencies, *names: str, signal: int = 0) -> list[tuple[Frequencies, Frequencies]]:
        """Return the least and the largest abs(X)/abs(1 + L) of the responses in the discs, for each X by its name; of
        C_v the filter of one signal.
        """
        reference, *negative = self.law.responses(f)
        back = -np.array(negative)
        p, r = self.plant.responses(f, len(back)), self.plant.discs(f, len(back))
        constant, reach = 1.0 + np.sum(p[1:] * back[1:], axis=0), np.sum(r[1:] * np.abs(back[1:]), axis=0)
        return [bound_disc(of, p[0], r[0], back[0], reference, constant, reach, back[signal]) for of in names]

    def grid(self) -> Frequencies:
        """Return frequencies up to the Nyquist frequency: the measured ones, some between, and the law's own."""
        at, nyquist = self.plant.f, self.plant.nyquist_hz
        steps = np.linspace(0.0, 1.0, POINTS_BETWEEN, endpoint=False)
        between = (at[:-1, None] + np.diff(at)[:, None] * steps).ravel()
        law_hz = np.abs(np.angle(self.law.poles)) / (2 * np.pi * self.plant.sample_time_s)
        grid = np.concatenate([np.geomspace(GRID_LOWEST_HZ, nyquist, 1200), between, at[-1:], law_hz])
        return np.unique(grid[(grid >= GRID_LOWEST_HZ) & (grid <= nyquist)])

    def is_stable(self) -> bool:
        """Tell whether the loop is stable with every response in the discs, under the assumptions of the module."""
        f = self.grid()
        back = self.law.feedback_responses(f)
        reach = np.sum(self.plant.discs(f, len(back)) * np.abs(back), axis=0)
        if np.any(np.abs(1.0 + self.open_loop(f)) <= reach):
            return False
        if np.any(np.abs(self.law.poles[self.law.integrators :]) >= 1.0):
            return False  # a law that grows by itself is not counted here
        f = np.concatenate([[SLOWEST_HZ], f])
        turn, _ = count_turns(lambda x: 1.0 + self.open_loop(x), f, MOST_TURN_RAD, REFINEMENTS + 1)
        return abs(turn / (0.5 * np.pi) - self.law.integrators) < ROUND

    def figures(self, asked_hz: float | None = None) -> LoopFigures:
        r"""Return the worst figures of all responses in the discs; of a loop that is not shown to be stable, none. The
        bandwidth is that asked for where the discs cannot tell it from their own: it lies between their least and their
        largest, and the least is above 0.97 of it. Else it is the least. The crossover is that of the centres. Gain and
        phase margins are those that Ms and Mt leave at least, and the delay margin that of
        :math:`|1 - e^{-j\omega\tau}| < 1/|T|` at every frequency.
        """
        if not self.is_stable():
            return LoopFigures(stable=False, spectral_radius=np.inf)
        f = self.grid()
        names = ("1", "L", "1 - L", "C_y", "P C_r")
        sizes = dict(zip(names, self.bound(f, *names), strict=True))
        (least, most), s = sizes["P C_r"], sizes["1"][1]
        crossovers = find_crossings(lambda x: np.abs(self.open_loop(x)) - 1.0, f)
        ms, static = float(np.max(s)), 1.0 if self.law.integrators else float(least[0])
        down, top = (find_first(f, HALF_POWER * static - size) for size in (least, most))
        if down is not None and asked_hz is not None and KNOWN_TO * asked_hz <= down <= asked_hz <= (top or np.inf):
            down = asked_hz
        droop = np.min(least[f <= DROOP_BAND * (down or f[-1])], initial=static)
        mt = float(np.max(sizes["L"][1], initial=1.0 if self.law.integrators else 0.0))  # T is 1 at 0 Hz
        phase = 2.0 * np.arcsin(min(max(0.5 / ms, 0.5 / mt), 1.0))
        large = sizes["L"][1] > 0.5
        late = np.arcsin(0.5 / sizes["L"][1][large]) / (np.pi * f[large])
        return LoopFigures(
            stable=True,
            spectral_radius=0.0,
            bandwidth_hz=down,
            tracking_band_hz=_band(f, least, most),
            crossover_hz=float(crossovers[-1]) if crossovers.size else None,
            sensitivity_bandwidth_hz=find_first(f, s - HALF_POWER) or float(f[-1]),
            ms=ms,
            mt=mt,
            ms_hz=float(f[np.argmax(s)]),
            reference_peak=max(float(np.max(most)) / static, 1.0),
            droop_db=max(0.0, -20.0 * float(np.log10(max(droop, 1e-300) / static))),
            return_hz=None if down is None else self._find_return(f, most, down, static),
            gain_margin_db=float(-20.0 * np.log10(1.0 - 1.0 / ms)) if ms > 1.0 else None,
            phase_margin_deg=float(np.degrees(phase)),
            delay_margin_s=float(np.min(late)) if late.size else None,
            disk_margin=2.0 / float(np.max(sizes["1 - L"][1])),
            noise_gain=float(np.max(sizes["C_y"][1])),
            other_noise_gains=tuple(
                float(np.max(self.bound(f, "C_v", signal=signal)[0][1])) for signal in range(1, self.law.d.size - 1)
            ),
        )

    def bandwidths_hz(self) -> tuple[float | None, float | None]:
        """Return the least and the largest bandwidth of the responses in the discs."""
        f = self.grid()
        (sizes,) = self.bound(f, "P C_r")
        static = 1.0 if self.law.integrators else float(sizes[0][0])
        least, most = (find_first(f, HALF_POWER * static - size) for size in sizes)
        return least, most

    def _find_return(self, f: Frequencies, most: Frequencies, down: float, static: float) -> float | None:
        """Return where the largest of the discs comes back above -3 dB, or lingers, above the bandwidth."""
        low, high = FALLEN_ABOVE * down, min(SHOULDER * down, self.plant.nyquist_hz)
        allowed = HALF_POWER * static * (down / f) ** SHOULDER_FALL
        back = f[(f > low) & (f < high) & (most > allowed)]
        return float(back[0]) if back.size else None


def bound_disc(
    of: str, p: Any, r: Any, c_y: Any, c_r: Any, constant: Any = 1.0, constant_radius: Any = 0.0, c_v: Any = 0.0
) -> tuple[Float[np.ndarray, "*k m"], Float[np.ndarray, "*k m"]]:
    """Return the least and the largest abs(X)/abs(1 + L) of the responses in discs; see the module's table. 1 + L is
    `constant` + P C_y, with `constant` in a disc of radius `constant_radius`: of a model both radii are zero.
    """
    open_loop = constant - 1.0 + p * c_y
    reach, size = r * np.abs(c_y) + constant_radius, np.abs(1.0 + open_loop) ** 2
    room = np.maximum(size * leave_positive(1.0 - reach**2 / np.maximum(size, 1e-300)), 1e-300)
    centre, radius, rooms = map_disc(of, p, r, c_y, c_r, open_loop, constant_radius, c_v, room, np.abs)
    centre = np.abs(centre)
    return np.maximum(centre - radius, 0.0) / rooms[0], (centre + radius) / rooms[1]


def map_disc(
    of: str,
    p: Any,
    r: Any,
    c_y: Any,
    c_r: Any,
    open_loop: Any,
    constant_radius: Any,
    c_v: Any,
    room: Any,
    size: Callable[[Any], Any],
) -> tuple[Any, Any, tuple[Any, Any]]:
    """Return centre and radius of the module's table, times D, and what the least and the largest are to be divided by,
    which is D, or `room` in its place, but for the last of the table; of arrays or expressions, whose `size` is abs.
    """
    return_difference, alone = 1.0 + open_loop, r * size(c_y)
    back, reach = return_difference.conjugate(), alone + constant_radius
    match of:
        case "1":
            return back, reach, (room, room)
        case "L":
            return open_loop * back - reach * reach, reach, (room, room)
        case "1 - L":
            return (1.0 - open_loop) * back + reach * reach, 2.0 * reach, (room, room)
        case "C_y":
            return c_y * back, reach * size(c_y), (room, room)
        case "C_v":
            return c_v * back, reach * size(c_v), (room, room)
        case "P C_r":
            whole = size(return_difference)
            least = room + constant_radius * (whole + 3.0 * alone + constant_radius)
            centre, radius = c_r * (p * back - c_y.conjugate() * (r * r)), r * size(c_r * (return_difference - p * c_y))
            return centre, radius, (least, room * (whole + alone) / (whole + reach))
        case _:
            raise AssertionError(of)


def find_first(f: Frequencies, over: Frequencies) -> float | None:
    """Return the first frequency at which a curve is above zero, by a straight line; None where it never is."""
    above = np.flatnonzero(over > 0.0)
    if not above.size:
        return None
    k = int(above[0])
    if k == 0:
        return float(f[0])
    share = over[k - 1] / (over[k - 1] - over[k])
    return float(f[k - 1] + share * (f[k] - f[k - 1]))


def _band(f: Frequencies, least: Frequencies, most: Frequencies) -> tuple[float, float] | None:
    """Return the widest band in which every response in the discs stays within 3 dB of 1."""
    inside = (least > HALF_POWER) & (most < 1.0 / HALF_POWER)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], inside.astype(int), [0]]))).reshape(-1, 2)
    low, high = max(edges, key=lambda run: f[run[1] - 1] - f[run[0]], default=(0, 0))
    return (float(f[low]), float(f[high - 1])) if high > low else None


@record
class MeasuredFigures:
    """A law on one measured response; the figures are the worst of all responses in its discs, as in `LoopFigures`."""

    name: str  # such as frf:chirp
    confidence: float  # that the discs hold the truth, all of them
    points: int  # measured frequencies
    band_hz: tuple[float, float]  # (low, high)
    bandwidth_hz: tuple[float | None, float | None]  # (low or None, high or None); of the responses in the discs
    stable: bool  # shown to be stable, by the turns of 1 + L, under what is `assumed`
    # ms, ms_hz, mt, disk_margin, noise_gain, reference_peak, droop_db: infinite, and the disk margin zero, where it is
    # not
    ms: OrInfinite
    ms_hz: OrNaN
    mt: OrInfinite
    disk_margin: float
    noise_gain: OrInfinite
    reference_peak: OrInfinite
    droop_db: OrInfinite
    assumed: str = ASSUMED  # of the plant, besides the points

    def __str__(self) -> str:
        low, high = (format_number(f, 3) for f in self.band_hz)
        head = (
            f"{self.name}: on {self.points} measured points from {low} to {high} Hz, "
            f"at {format_percent(self.confidence, 4)}"
        )
        if not self.stable:
            return f"{head}, not shown to be stable"
        least, most = (format_number(f, missing="none") for f in self.bandwidth_hz)
        return (
            f"{head}: bandwidth {least} to {most} Hz, Ms {self.ms:.4g}, Mt {self.mt:.4g}, noise gain "
            f"{self.noise_gain:.4g}; assumed: {self.assumed}"
        )


def measure_discs(plant: MeasuredPlant, law: Law, bandwidth_hz: float) -> MeasuredFigures:
    """Return the figures of a law on a measured response; the bandwidth is that asked for."""
    loop = DiscLoop(plant=plant, law=law)
    figures = loop.figures(bandwidth_hz)
    taken = ("stable", "ms", "ms_hz", "mt", "disk_margin", "noise_gain", "reference_peak", "droop_db")
    return MeasuredFigures(
        name=plant.name,
        confidence=plant.confidence,
        points=plant.f.size,
        band_hz=plant.band_hz,
        bandwidth_hz=loop.bandwidths_hz() if figures.stable else (None, None),
        **{name: getattr(figures, name) for name in taken},
    )


def measure_all_discs(plants: Sequence[object], law: Law, bandwidth_hz: float) -> tuple[MeasuredFigures, ...]:
    """Return the figures of a law on those of some plants that are measured."""
    return tuple(measure_discs(plant, law, bandwidth_hz) for plant in plants if isinstance(plant, MeasuredPlant))
