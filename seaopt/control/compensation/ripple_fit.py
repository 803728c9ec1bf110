r"""Torque ripple and cogging from a log in which the motor turns slowly in both directions.

Where inertia does not matter, the command holds up against friction, ripple and what is regulated,

.. math::
    I_t = c_0 + c\, \mathrm{sign}\, v_t + b_\pm v_t + g F_t
          + \sum_n \left( a_n \cos n\varphi_t + b_n \sin n\varphi_t \right) + e_t, \qquad \varphi = 2\pi\theta/\Theta,

which is linear in everything unknown. The constant and Coulomb friction give each direction a level of its own;
viscous friction has one slope for each, where the speed within each varies enough to tell it from the level. Samples
slower than a fifth of the log's speed are left out: near a reversal friction is neither its one level nor the other.

What is left, e, is coloured, so that the covariance of least squares is :math:`H^{-1} B H^{-1}`,
:math:`H = X^T X`, :math:`B = \sum_{t,s} x_t R(t - s) x_s^T`, with R the autocovariance of e under Parzen's window
(Newey, West, Econometrica 55, 1987), summed in the frequency domain, where it is nowhere negative.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from seaopt.control.loops.compensation.ripple_term import RIPPLE_FRACTION, CompensateRipple, check_cycles
from seaopt.errors import ControlError, require_number
from seaopt.estimation.problem.correlation import autocorrelation, parzen
from seaopt.logs import Log
from seaopt.records import record

DEFAULT_HIGHEST = 24
SLOWEST = 0.2  # of the 90 % quantile of speed
VARIES = 0.1  # of the mean speed: its spread, from which viscous friction is told from Coulomb's
CHANCE = 0.01  # of finding a harmonic that is none, over all that are looked at
BINS_PER_CYCLE, LEAST_BINS = 4, 12
SHORTEST_WINDOW, WIDER = 8, 3  # lags, and the window's reach over the last lag that differs from chance
ALIKE = 1e-6  # the least singular value of the terms over the largest
Rows = Float[np.ndarray, "n p"]


@record(eq=False)
class RippleFit:
    """Ripple over the motor's angle, and the friction that it was told from.

    Parameters
    ----------
    cycles : tuple of int
        Harmonics, in cycles per revolution.
    cos, sin, cos_std, sin_std : tuple of float
        Of each, the command that meets it, and its standard deviation.
    period : float
        What the angle's channel moves in one revolution.
    unit : str
        Of the command.
    constant, coulomb, coulomb_std : float
        The command that is left at no speed, and the one that meets Coulomb friction.
    viscous : (float, float) or None
        Command per speed forwards and backwards; None where the speed did not vary enough to tell it.
    per_force : float or None
        Command per what is regulated; None where none was given.
    residual_std : float
        Of what is left of the command.
    samples : int
        That were used.
    """

    cycles: tuple[int, ...]
    cos: tuple[float, ...]
    sin: tuple[float, ...]
    cos_std: tuple[float, ...]
    sin_std: tuple[float, ...]
    period: float
    unit: str
    constant: float
    coulomb: float
    coulomb_std: float
    viscous: tuple[float, float] | None
    per_force: float | None
    residual_std: float
    samples: int

    @property
    def amplitudes(self) -> tuple[float, ...]:
        """The amplitude of each harmonic, in the command's unit."""
        return tuple(map(math.hypot, self.cos, self.sin))

    def compensation(self, fraction: float = RIPPLE_FRACTION) -> CompensateRipple:
        """Return what to ask of `add_compensation`, with the log's period."""
        return CompensateRipple(cycles=self.cycles, cos=self.cos, sin=self.sin, fraction=fraction, period=self.period)

    def to_toml(self, fraction: float = RIPPLE_FRACTION) -> str:
        """Return the line for [controller] of a problem file."""
        lists = {"cycles": self.cycles, "cos": self.cos, "sin": self.sin}
        keys = ", ".join(
            f"{name} = [{', '.join(f'{value:.6g}' for value in values)}]" for name, values in lists.items()
        )
        return f"compensate = {{ ripple = {{ {keys}, fraction = {fraction:g}, period = {self.period:.12g} }} }}"

    def __repr__(self) -> str:
        rows = zip(self.cycles, self.cos, self.cos_std, self.sin, self.sin_std, strict=True)
        return "\n".join(
            [
                f"Ripple over {self.period:.6g} per revolution, {self.unit}, of {self.samples} samples",
                *(
                    f"  {n} cycles: cos {cos:.4g} +- {cos_std:.2g}, sin {sin:.4g} +- {sin_std:.2g}"
                    for n, cos, cos_std, sin, sin_std in rows
                ),
                f"  Coulomb friction {self.coulomb:.4g} +- {self.coulomb_std:.2g}, "
                f"left over {self.residual_std:.3g} rms",
            ]
        )


@record(eq=False)
class _RippleSolution:
    """Coefficients of a regression, their covariance, and the std of what is left."""

    values: Float[np.ndarray, " p"]
    covariance: Float[np.ndarray, "p p"]
    residual_std: float


def identify_ripple(
    log: Log,
    *,
    command: str = "I",
    angle: str = "theta_m",
    force: str | None = None,
    cycles: Sequence[int] | None = None,
    highest: int = DEFAULT_HIGHEST,
    period: float | None = None,
    speed_window_s: float = 0.1,
) -> RippleFit:
    """Return the ripple over the motor's angle, of a log in which it turns slowly both ways.

    Parameters
    ----------
    log : Log
        Slow enough that inertia needs next to nothing, over at least one revolution in each direction.
    command, angle : str
        Its channels: what is commanded, and the motor's position.
    force : str, optional
        Channel of the regulated force or torque, where the motor works against one.
    cycles : sequence of int, optional
        Harmonics, in cycles per revolution; those up to `highest` that differ from chance where left out.
    highest : int
        Up to which harmonics are looked for.
    period : float, optional
        What the angle's channel moves in one revolution; 2 pi where it is in rad and this left out. A longer one, of
        several revolutions, has the slower harmonics of a gear.
    speed_window_s : float
        Over which the angle is differentiated.

    Raises
    ------
    ControlError
        The log does not cover a whole revolution in both directions, its terms cannot be told apart, no harmonic
        differs from chance, or an argument is out of range.
    LogError
        A channel is not there, or the log is not sampled uniformly.

    Examples
    --------
    >>> import numpy as np
    >>> t = np.arange(4000) / 100.0
    >>> theta = 8.0 * np.sin(2 * np.pi * t / 40.0)
    >>> I = 0.3 * np.sign(np.cos(2 * np.pi * t / 40.0)) + 0.05 * np.cos(6 * theta)
    >>> I = I + 0.01 * np.random.default_rng(0).normal(size=t.size)
    >>> fit = identify_ripple(Log.from_arrays(time=t, I=I, theta_m=theta, units={"I": "A", "theta_m": "rad"}))
    >>> fit.cycles, round(fit.cos[0], 3), round(fit.coulomb, 2)
    ((6,), 0.05, 0.3)
    """
    period = _choose_period(log, angle, period)
    wanted = list(range(1, highest + 1)) if cycles is None else np.asarray(cycles).tolist()  # not of NumPy
    if not wanted:
        raise ControlError("cycles: is empty; give harmonics, or leave it out to find them")
    check_cycles(wanted, "highest" if cycles is None else "cycles")
    speed, moves = _find_speed(log, angle, speed_window_s)
    turns = log[angle] / period
    _require_revolutions(turns, speed, moves, max(wanted), log.source)
    drag = _list_drag(log, speed, moves, force)
    fit = _regress(log[command], drag, turns, wanted, moves)
    if cycles is None:
        wanted = _select(fit, len(drag), wanted, log.source)
        fit = _regress(log[command], drag, turns, wanted, moves)
    stds = np.sqrt(np.diag(fit.covariance))
    first, harmonics = len(drag), slice(len(drag), None, 2)
    names = list(drag)
    value_of = dict(zip(names, map(float, fit.values[:first]), strict=True))
    return RippleFit(
        cycles=tuple(wanted),
        cos=_floats(fit.values[harmonics]),
        sin=_floats(fit.values[first + 1 :: 2]),
        cos_std=_floats(stds[harmonics]),
        sin_std=_floats(stds[first + 1 :: 2]),
        period=period,
        unit=log.signal(command).unit,
        constant=value_of["constant"],
        coulomb=value_of["coulomb"],
        coulomb_std=float(stds[names.index("coulomb")]),
        viscous=(value_of["forwards"], value_of["backwards"]) if "forwards" in value_of else None,
        per_force=value_of.get("force"),
        residual_std=fit.residual_std,
        samples=int(np.count_nonzero(moves)),
    )


def _floats(values: Float[np.ndarray, " n"]) -> tuple[float, ...]:
    return tuple(map(float, values))


def _choose_period(log: Log, angle: str, period: float | None) -> float:
    unit = log.signal(angle).unit
    if period is None and unit != "rad":
        raise ControlError(
            f"period: {angle} of {log.source} is in {unit}, of which no revolution is known; give what it moves in one"
        )
    period = 2.0 * math.pi if period is None else require_number(period, "period", ControlError)
    if not 0.0 < period < math.inf:
        raise ControlError(f"period = {period:g} is not positive; give what {angle} moves in one revolution")
    return period


def _find_speed(log: Log, angle: str, window_s: float) -> tuple[Float[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
    """Return the speed, of parabolas over a window, and where the motor moves at it."""
    from scipy.signal import savgol_filter  # deferred: scipy is slow to load

    length = max(5, 2 * round(0.5 * require_number(window_s, "speed_window_s", ControlError) / log.period) + 1)
    speed, has_speed = np.zeros(len(log)), np.zeros(len(log), dtype=bool)
    for segment in log.segments:
        if segment.stop - segment.start > length:
            speed[segment] = savgol_filter(log[angle][segment], length, 2, deriv=1, delta=log.period)
            has_speed[segment] = True
    if not np.any(has_speed):
        raise ControlError(
            f"speed_window_s = {window_s:g}: no segment of {log.source} is as long; give a shorter window"
        )
    return speed, has_speed & (np.abs(speed) > SLOWEST * np.quantile(np.abs(speed[has_speed]), 0.9))


def _require_revolutions(
    turns: Float[np.ndarray, " n"],
    speed: Float[np.ndarray, " n"],
    moves: Bool[np.ndarray, " n"],
    highest: int,
    source: str,
) -> None:
    """Refuse a log that does not pass every part of a revolution in both directions."""
    bins = max(LEAST_BINS, BINS_PER_CYCLE * highest)
    for word, sign in (("forwards", 1.0), ("backwards", -1.0)):
        passed = turns[moves & (sign * speed > 0.0)] % 1.0
        share = np.unique(np.minimum((passed * bins).astype(int), bins - 1)).size / bins
        if share < 1.0:
            raise ControlError(
                f"{source}: the motor moves {word} over {100.0 * share:.0f} % of a revolution, looked at in {bins} "
                "parts; log at least one whole revolution in each direction, more slowly or at a higher rate, or give "
                "fewer or lower cycles"
            )


def _list_drag(
    log: Log, speed: Float[np.ndarray, " n"], moves: Bool[np.ndarray, " n"], force: str | None
) -> dict[str, Float[np.ndarray, " n"]]:
    """Return the terms besides the ripple: a constant, friction by direction, and what is regulated."""
    forwards, backwards = np.maximum(speed, 0.0), np.minimum(speed, 0.0)
    drag = {"constant": np.ones_like(speed), "coulomb": np.sign(speed)}
    ways = [direction[moves & (direction != 0.0)] for direction in (forwards, backwards)]
    if all(np.std(way) > VARIES * abs(np.mean(way)) for way in ways):
        drag |= {"forwards": forwards, "backwards": backwards}
    return drag if force is None else drag | {"force": log[force]}


def _regress(
    command: Float[np.ndarray, " n"],
    drag: dict[str, Float[np.ndarray, " n"]],
    turns: Float[np.ndarray, " n"],
    cycles: Sequence[int],
    moves: Bool[np.ndarray, " n"],
) -> _RippleSolution:
    """Return least squares of the samples that move, with the covariance of a coloured residual."""
    angles = 2.0 * np.pi * (turns % 1.0)
    columns = [*drag.values(), *(wave(n * angles) for n in cycles for wave in (np.cos, np.sin))]
    x = np.where(moves[:, None], np.stack(columns, axis=1), 0.0)  # in their places: lags are those of the log
    y = np.where(moves, command, 0.0)
    if not (np.all(np.isfinite(x)) and np.all(np.isfinite(y))):
        raise ControlError("the log has values that are not finite; cut them out with log.between")
    scale = np.linalg.norm(x, axis=0)
    u, sizes, vt = np.linalg.svd(x / np.maximum(scale, 1e-300), full_matrices=False)
    if not sizes[-1] > ALIKE * sizes[0]:
        raise ControlError(
            f"the terms {', '.join(drag)} and the harmonics {list(cycles)} cannot be told apart in this log; log more "
            "revolutions, leave force out where it is constant, or give fewer cycles"
        )
    back = (vt.T / sizes) @ u.T / scale[:, None]
    values = back @ y
    left = np.where(moves, y - x @ values, 0.0)
    count = int(np.count_nonzero(moves))
    if count <= 2 * values.size:
        raise ControlError(f"{count} samples move, of {values.size} unknowns; log longer, or give fewer cycles")
    power = float(left @ left) / (count - values.size)
    return _RippleSolution(values=values, covariance=power * _sum_coloured(back.T, left), residual_std=math.sqrt(power))


def _sum_coloured(influence: Rows, left: Float[np.ndarray, " n"]) -> Float[np.ndarray, "p p"]:
    """Return the sum over t and s of the influences times the residual's correlation at t - s."""
    n = left.size
    rho = autocorrelation(left, n // 10)
    chance = 2.0 * math.sqrt(math.log10(n) / n)
    small = np.flatnonzero(np.abs(rho) < chance)
    last = int(small[0]) if small.size else rho.size - 1  # from where it first is no more than chance
    reach = min(max(SHORTEST_WINDOW, WIDER * last), rho.size - 1)
    size = n + reach
    lags = np.zeros(size)
    lags[: reach + 1] = rho[: reach + 1] * parzen(reach)
    lags[size - reach :] = lags[reach:0:-1]
    density = np.maximum(np.fft.rfft(lags).real, 0.0)
    weights = np.full(density.size, 2.0)
    weights[0] = 1.0
    weights[-1] = 1.0 if size % 2 == 0 else 2.0
    spectra = np.fft.rfft(influence, size, axis=0)
    return (spectra.conj().T @ (spectra * (weights * density)[:, None])).real / size


def _select(fit: _RippleSolution, first: int, cycles: Sequence[int], source: str) -> list[int]:
    """Return the harmonics that differ from chance, by Wald's test at 1 % over all of them."""
    chosen: list[int] = []
    for i, n in enumerate(cycles):
        pair = slice(first + 2 * i, first + 2 * i + 2)
        wald = fit.values[pair] @ np.linalg.solve(fit.covariance[pair, pair], fit.values[pair])
        if math.exp(-0.5 * wald) < CHANCE / len(cycles):
            chosen.append(n)
    if not chosen:
        raise ControlError(
            f"{source}: no harmonic up to {max(cycles)} cycles per revolution differs from chance; log longer, look "
            "further with highest, or leave ripple alone"
        )
    return chosen
