"""The usual forms of PID as a law: what a drive's manual or a textbook calls k_p, K, T_i."""

from __future__ import annotations

import math
from typing import Literal, get_args

from seaopt.control.laws.structures import Gains, InnerLoop, SpeedLoop
from seaopt.control.loops.law import Law
from seaopt.errors import ControlError, require_number

Integral = Literal["trapezoid", "backward", "forward"]


def parallel_pid(
    *,
    k_p: float,
    k_i: float = 0.0,
    k_d: float = 0.0,
    T_f: float = 0.0,
    sample_time_s: float,
    b: float = 1.0,
    c: float = 1.0,
    feedforward: float = 0.0,
    integral: Integral = "trapezoid",
) -> Law:
    r"""Return :math:`u = k_p (b r - y) + k_i \int (r - y) + k_d \frac{d}{dt}(c r - y) + k_{ff} r`, discrete.

    Parameters
    ----------
    k_p, k_i, k_d : float
        Gains, of effort per measured unit, per second of it, and per rate of it.
    T_f : float
        Seconds: time constant of the derivative's filter, a backward difference (D(q) of `seaopt.control.laws`); of 0
        it is the plain difference.
    sample_time_s : float
        Seconds.
    b, c : float
        Weights of the reference in the proportional and the derivative part; 0 where a drive differentiates the
        measurement alone.
    feedforward : float
        Gain of the reference besides: 1 where the drive adds the force that is asked for.
    integral : {"trapezoid", "backward", "forward"}
        How the drive sums up: the mean of the last two errors, the new one, or the old one.

    Raises
    ------
    ControlError
        A number is not finite, or a time is negative.

    Examples
    --------
    >>> law = parallel_pid(k_p=2.0, k_i=10.0, sample_time_s=1e-3, integral="backward")
    >>> law.integrators, law.d.round(6).tolist()
    (1, [2.01, -2.01])
    """
    _check_numbers(k_p=k_p, k_i=k_i, k_d=k_d, T_f=T_f, b=b, c=c, feedforward=feedforward, sample_time_s=sample_time_s)
    if integral not in get_args(Integral):
        raise ControlError(f'integral = "{integral}" is not known; give one of {", ".join(get_args(Integral))}')
    # Sums of the new or the old error are the trapezoid's, and half a sample of it more or less.
    more = 0.5 * k_i * sample_time_s * {"trapezoid": 0.0, "backward": 1.0, "forward": -1.0}[integral]
    gains = Gains(k_p=k_p + more, k_i=k_i, k_d=k_d, T_f=T_f, k_r=b * k_p + more + feedforward, c=c)
    return gains.law("pid", sample_time_s).balanced()


def cascade_pid(
    *,
    k_v: float,
    T_v: float = math.inf,
    k_p: float,
    k_i: float = 0.0,
    k_d: float = 0.0,
    T_f: float = 0.0,
    sample_time_s: float,
    b: float = 1.0,
    c: float = 1.0,
    feedforward: float = 0.0,
) -> Law:
    r"""Return a drive's cascade: a force loop that asks a speed loop of the motor for a speed.

    .. math::
        v_\mathrm{ref} &= k_p (b r - y) + k_i \int (r - y) + k_d \frac{d}{dt}(c r - y), \\
        u &= k_v \Big[v_\mathrm{ref} - v + \frac{1}{T_v} \int (v_\mathrm{ref} - v)\Big] + k_{ff} r .

    With a P inside (T_v infinite) it is a PID of gains :math:`k_v k_p, k_v k_i, k_v k_d` with damping by the motor's
    speed. Integrals are trapezoids.

    Parameters
    ----------
    k_v : float
        Of the speed loop: effort per motor speed, N s/m or N m s/rad.
    T_v : float
        Seconds: its integral time; infinite for none.
    k_p, k_i, k_d : float
        Of the force loop: motor speed per measured unit, per second of it, and per rate of it.
    T_f, b, c, feedforward
        As in `parallel_pid`; feedforward is of effort.
    sample_time_s : float
        Seconds.

    Returns
    -------
    Law
        From (reference, measured, motor speed): of a specification with ``measured = ("tau_s", "thetad_m")``.

    Raises
    ------
    ControlError
        A number is not finite, or a time is negative.

    Examples
    --------
    >>> law = cascade_pid(k_v=0.3, k_p=5.0, k_i=60.0, T_v=0.05, sample_time_s=1e-3)
    >>> law.integrators, law.d.size
    (2, 3)
    """
    require_number(T_v, "T_v", ControlError)
    if not T_v > 0.0 or not math.isfinite(k_v):
        raise ControlError(f"k_v = {k_v:g}, T_v = {T_v:g}: give a finite gain and a positive time")
    _check_numbers(k_p=k_p, k_i=k_i, k_d=k_d, T_f=T_f, b=b, c=c, feedforward=feedforward, sample_time_s=sample_time_s)
    gains = Gains(
        k_p=k_v * k_p,
        k_i=k_v * k_i,
        k_d=k_v * k_d,
        T_f=T_f,
        k_r=k_v * b * k_p,
        c=c,
        inner=InnerLoop(k_v=k_v, T_v=T_v, k_ff=feedforward, speed=SpeedLoop(differenced=False)),
    )
    return gains.law("cascade", sample_time_s).balanced()


def _check_numbers(*, T_f: float, sample_time_s: float, **gains: float) -> None:
    for name, value in {**gains, "T_f": T_f, "sample_time_s": sample_time_s}.items():
        require_number(value, name, ControlError)
    if T_f < 0.0 or not sample_time_s > 0.0:
        raise ControlError(f"T_f = {T_f:g} s, sample_time_s = {sample_time_s:g} s: give times that are not negative")


def ideal_pid(
    *,
    K: float,
    T_i: float = math.inf,
    T_d: float = 0.0,
    N: float = math.inf,
    sample_time_s: float,
    b: float = 1.0,
    c: float = 1.0,
    feedforward: float = 0.0,
    integral: Integral = "trapezoid",
) -> Law:
    r"""Return :math:`u = K [b r - y + \frac{1}{T_i}\int (r - y) + T_d \frac{d}{dt}(c r - y)] + k_{ff} r`, discrete.

    Parameters
    ----------
    K : float
        Gain, of effort per measured unit.
    T_i, T_d : float
        Seconds: integral and derivative time.
    N : float
        The derivative's filter has the time constant T_d/N.
    sample_time_s, b, c, feedforward, integral
        As in `parallel_pid`.

    Raises
    ------
    ControlError
        A number is not finite, or a time is not positive.

    Examples
    --------
    >>> ideal_pid(K=2.0, T_i=0.2, sample_time_s=1e-3).d.round(6).tolist()
    [2.005, -2.005]
    """
    if not (T_i > 0.0 and T_d >= 0.0 and N > 0.0):
        raise ControlError(f"T_i = {T_i:g}, T_d = {T_d:g}, N = {N:g}: give positive times and a positive N")
    return parallel_pid(
        k_p=K,
        k_i=K / T_i,
        k_d=K * T_d,
        T_f=T_d / N,
        sample_time_s=sample_time_s,
        b=b,
        c=c,
        feedforward=feedforward,
        integral=integral,
    )


def drive_pid(
    *,
    per_effort: float,
    k_p: float,
    k_i: float = 0.0,
    k_d: float = 0.0,
    T_f: float = 0.0,
    sample_time_s: float,
    b: float = 1.0,
    c: float = 1.0,
    feedforward: float = 0.0,
    integral: Integral = "trapezoid",
) -> Law:
    """Return `parallel_pid` of gains in a drive's own units: the command (A, V, duty) per measured unit.

    Parameters
    ----------
    per_effort : float
        The command for one unit of effort, `command_of(plant, params, measured).per_effort`.
    k_p, k_i, k_d, feedforward : float
        Of the command: A/N, A/(N s), A s/N, and A/N.
    T_f, sample_time_s, b, c, integral
        As in `parallel_pid`.

    Raises
    ------
    ControlError
        As `parallel_pid`, or per_effort is not positive.

    Examples
    --------
    >>> drive_pid(per_effort=0.004, k_p=0.008, sample_time_s=1e-3).d.round(6).tolist()
    [2.0, -2.0]
    """
    if not require_number(per_effort, "per_effort", ControlError) > 0.0:
        raise ControlError(f"per_effort = {per_effort:g} is not positive; give the command for one unit of effort")
    return parallel_pid(
        k_p=k_p,
        k_i=k_i,
        k_d=k_d,
        T_f=T_f,
        sample_time_s=sample_time_s,
        b=b,
        c=c,
        feedforward=feedforward,
        integral=integral,
    ).scaled(1.0 / per_effort)
