r"""Every margin of a closed loop, with the perturbation that uses it up.

A factor :math:`f` on the loop gain, real, of modulus one, or complex, makes the loop unstable when
:math:`1 + f L(z_0) = 0` somewhere on the circle. Disk margins bound all of them at once (Seiler, Packard, Gahinet,
IEEE Control Systems 40(5), 2020): the loop is stable for every

.. math:: f = \frac{2 + (1 - \sigma)\delta}{2 - (1 + \sigma)\delta}, \qquad
          |\delta| < \alpha = 1 \Big/ \Big\lVert S + \frac{\sigma - 1}{2} \Big\rVert_\infty ,

with skew :math:`\sigma = 0` (symmetric), 1 (S-based, :math:`\alpha = 1/M_s`) and -1 (T-based, :math:`1/M_t`). At the
peak, :math:`\delta_0 = 1/(S + (\sigma - 1)/2)` has :math:`|\delta_0| = \alpha`, and its :math:`f_0` puts a pole on the
circle: that is the witness.

The delay margin turns a phase at a crossover into seconds. A delay that is no whole number of samples changes the
hold's response too, so that this is exact for whole samples only; `seaopt.robustness` recomputes the loop with the
delay in it.
"""

from __future__ import annotations

from dataclasses import field

import numpy as np

from seaopt.control.loops.loop import GRID_LOWEST_HZ, GROWING, STABLE, Loop
from seaopt.control.loops.peaks import find_extremes
from seaopt.control.systems.crossings import add_minima, count_turns
from seaopt.errors import ControlError
from seaopt.records import record
from seaopt.signals import VectorM

ON_THE_CIRCLE = 1e-10  # distance of a pole from 1 that is rounding
SETTLED_DECADES, POINTS_PER_DECADE = 3.0, 30  # below the lowest pole, where a response is a power law
SKEWS = {"symmetric": (0.0, 2), "S-based": (1.0, 0), "T-based": (-1.0, 1)}  # skew, curve whose peak decides


@record
class DiskMargin:
    """A disk of complex gains for which the loop stays stable.

    Parameters
    ----------
    skew : float
        0: symmetric, 1: S-based, -1: T-based.
    alpha : float
        The disk's size.
    frequency_hz : float
        Where the loop is nearest to instability.
    perturbation : complex
        The smallest factor on L that puts a pole on the unit circle there.
    gain_range : (low, high)
        Real factors inside the disk.
    phase_deg : float
        Pure phases inside the disk; 180 where every one is.
    """

    skew: float
    alpha: float
    frequency_hz: float
    perturbation: complex
    gain_range: tuple[float, float]
    phase_deg: float


@record
class Margins:
    """Every margin of a loop; an unstable loop has none (`disks` is empty, the rest zero).

    Parameters
    ----------
    gain_up_db, gain_down_db : float or None
        How far the gain may rise, or fall (negative), before the loop is unstable; None: without limit.
    phase_deg, phase_hz : float or None
        The smallest phase, lag (positive) or lead (negative), that makes the loop unstable, and its crossover.
    delay_s, delay_hz : float or None
        The smallest delay that does, and its crossover.
    gain_crossings : tuple of (hz, factor)
        Every factor on L that puts it through -1.
    phase_crossings : tuple of (hz, degrees of lag to -1)
        Every crossover, from -180 to 180 degrees.
    disks : mapping of kind to DiskMargin
        Symmetric, S-based and T-based.
    """

    gain_up_db: float | None = 0.0
    gain_down_db: float | None = 0.0
    phase_deg: float | None = 0.0
    phase_hz: float | None = None
    delay_s: float | None = 0.0
    delay_hz: float | None = None
    gain_crossings: tuple[tuple[float, float], ...] = ()
    phase_crossings: tuple[tuple[float, float], ...] = ()
    disks: dict[str, DiskMargin] = field(default_factory=dict[str, DiskMargin])


def margins(loop: Loop) -> Margins:
    """Return every margin of a loop.

    Examples
    --------
    >>> import seaopt as so
    >>> from seaopt.control.loops.margins import margins
    >>> spec = so.ControllerSpec(bandwidth_hz=30, max_sensitivity=1.6)
    >>> controller = so.tune(so.plants.high_impedance(), so.plants.thor(), spec)
    >>> found = margins(controller.close(so.plants.high_impedance(), so.plants.thor()))
    >>> found.disks["S-based"].alpha >= 1 / 1.6
    True
    """
    system = loop.system()
    if not np.max(np.abs(system.poles), initial=0.0) < STABLE:
        return Margins()
    extremes = find_extremes(system)
    hz = 1.0 / (2 * np.pi * loop.plant.sample_time_s)
    gains, lag, delays = extremes.gains_db, extremes.lags_deg, extremes.delays * loop.plant.sample_time_s
    least, soonest = (int(np.argmin(x)) if x.size else None for x in (np.abs(lag), delays))
    disks = {
        kind: disk(skew, float(extremes.at[curve]), system.sensitivity(extremes.at[curve : curve + 1])[0], hz)
        for kind, (skew, curve) in SKEWS.items()
    }
    return Margins(
        gain_up_db=float(np.min(gains[gains > 0.0])) if np.any(gains > 0.0) else None,
        gain_down_db=float(np.max(gains[gains < 0.0])) if np.any(gains < 0.0) else None,
        phase_deg=None if least is None else float(lag[least]),
        phase_hz=None if least is None else float(extremes.crossovers[least]) * hz,
        delay_s=None if soonest is None else float(delays[soonest]),
        delay_hz=None if soonest is None else float(extremes.crossovers[soonest]) * hz,
        gain_crossings=tuple(zip((extremes.gain_angles * hz).tolist(), extremes.gain_factors.tolist(), strict=True)),
        phase_crossings=tuple(zip((extremes.crossovers * hz).tolist(), lag.tolist(), strict=True)),
        disks=disks,
    )


def disk(skew: float, angle: float, s: complex, hz: float) -> DiskMargin:
    """Return the disk margin of a skew, given S at the angle (rad) where abs(S + (skew - 1)/2) peaks."""
    delta = 1.0 / (complex(s) + (skew - 1.0) / 2.0)
    alpha = abs(delta)
    ends = [_factor(skew, -alpha), _factor(skew, alpha)]
    low, high = (end.real for end in ends)
    return DiskMargin(
        skew=skew,
        alpha=alpha,
        frequency_hz=angle * hz,
        perturbation=_factor(skew, delta),
        gain_range=(max(0.0, low), high if high > 1.0 else np.inf),
        phase_deg=_phase(low, high),
    )


def _factor(skew: float, delta: complex) -> complex:
    below = 2.0 - (1.0 + skew) * delta
    return complex((2.0 + (1.0 - skew) * delta) / below) if below else complex(np.inf)


def _phase(low: float, high: float) -> float:
    """Return the phase that the circle through two real factors allows at modulus one."""
    if not np.isfinite(high):
        return float(np.degrees(np.arccos(np.clip(low, -1.0, 1.0))))
    cosine = (1.0 + low * high) / (low + high) if low + high else -1.0
    return float(np.degrees(np.arccos(cosine))) if abs(cosine) <= 1.0 else 180.0


def nu_gap(first: Loop, second: Loop) -> tuple[float, float | None]:
    r"""Return Vinnicombe's gap of two loop gains and where it is reached (Hz); 1 and None if the winding differs.

    .. math:: \delta_\nu = \sup_\omega \frac{|L_1 - L_2|}{\sqrt{1 + |L_1|^2}\sqrt{1 + |L_2|^2}}

    where :math:`1 + \overline{L_2} L_1` winds about zero as often as :math:`L_1` has more poles outside the circle than
    :math:`L_2`, and half as often as it has more integrators; else it is 1 (Vinnicombe, Uncertainty and Feedback, 2001,
    3.3: the path runs outside around a pole at 1, which turns by half a circle, and those of :math:`L_2` count as
    poles outside). Computed on a grid that resolves the poles of both loops, their plants and their laws, from below
    the lowest of them, halved until neighbours turn by less than a right angle; every local maximum on it is refined
    by ternary search. The gap of a plant that is not finite is 1.

    Raises
    ------
    ControlError
        The loops run at different sample times.
    """
    if first.plant.sample_time_s != second.plant.sample_time_s:
        raise ControlError(
            f"the loops run at sample times {first.plant.sample_time_s:g} and {second.plant.sample_time_s:g} s; "
            "a gap needs one"
        )
    if not all(np.all(np.isfinite(loop.eigenvalues())) for loop in (first, second)):
        return 1.0, None
    loops = (first, second)
    laws = [loop.about(loop.law.poles) for loop in loops]
    f = np.unique(np.concatenate([_low_frequencies(loops), *(loop.grid() for loop in loops), *laws]))
    turn, f = count_turns(lambda x: 1.0 + np.conj(second.open_loop(x)) * first.open_loop(x), f, np.pi / 2, 40)
    half_turns = round(2.0 * turn / np.pi)
    outside = [int(np.sum(np.abs(np.linalg.eigvals(loop.plant.a)) > GROWING)) for loop in loops]
    integrators = [_count_integrators(loop) for loop in loops]
    if half_turns != 2 * (outside[0] - outside[1]) + integrators[0] - integrators[1]:
        return 1.0, None
    if not np.any(_chord(first, second, f)):  # the same loop: every point is a minimum
        return 0.0, float(f[0])
    f = add_minima(lambda x: -_chord(first, second, x), f)
    chord = _chord(first, second, f)
    worst = int(np.argmax(chord))
    return float(chord[worst]), float(f[worst])


def _low_frequencies(loops: tuple[Loop, Loop]) -> VectorM:
    """Return frequencies from where both loop gains are as they are at 0 Hz, a power law, up to their usual grid."""
    period = loops[0].plant.sample_time_s
    poles = np.concatenate([each for loop in loops for each in (loop.system().opened, loop.system().poles)])
    corners = np.abs(poles - 1.0) / (2 * np.pi * period)
    lowest = float(np.min(corners[corners > ON_THE_CIRCLE / period], initial=GRID_LOWEST_HZ))
    decades = max(1.0, np.log10(GRID_LOWEST_HZ / lowest) + SETTLED_DECADES)
    return np.geomspace(10.0**-decades * GRID_LOWEST_HZ, GRID_LOWEST_HZ, round(POINTS_PER_DECADE * decades))


def _count_integrators(loop: Loop) -> int:
    """Return how many poles of plant and law are at 1, as well as they are known."""
    system = loop.system()
    return int(np.sum(np.abs(system.opened - 1.0) <= np.maximum(system.resolution(), ON_THE_CIRCLE)))


def _chord(first: Loop, second: Loop, f: VectorM) -> VectorM:
    l1, l2 = first.open_loop(f), second.open_loop(f)
    return np.abs(l1 - l2) / np.sqrt((1.0 + np.abs(l1) ** 2) * (1.0 + np.abs(l2) ** 2))
