r"""Critically damped impedances in closed form, for the sampled loop as it is.

With X(z) from the force law's reference to the link's position, the force loop closed, the outer loop's poles are the
zeros of :math:`N(z) - K_v - D_v D(z)`. N = -1/X, in the direction of the link, is the dynamic stiffness of the link
under force control: of a rigid link with nothing but a delay :math:`\tau`, :math:`N = -(m s^2 + d s) e^{s \tau}`. A
double pole at a real :math:`z = e^{-pT}` is where value and slope vanish, two linear equations:

.. math:: D_v = \frac{N'(z)}{D'(z)}, \qquad K_v = N(z) - D_v D(z) .

They are exact for the sampled loop: force loop, hold, delay and filter are in X and D. For the rigid link with its
delay they are :math:`K_v = m p^2 e^{-p\tau}(1 - p\tau)` and :math:`D_v = m p e^{-p\tau} (2 - p\tau)`, so that the
stiffest critically damped link has :math:`p\tau = 2 - \sqrt 2` and :math:`K_v = 0.079\, m/\tau^2`. Paine and Sentis
(ASME J. Dyn. Syst. Meas. Control 137(4), 2015) fit closed expressions for a rigid link with delay and filter to an
exhaustive search, to 2 to 4 %.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from seaopt.control.impedance.link import ControlledLink, find_link
from seaopt.control.impedance.moving_loop import MovingLoop, close_link
from seaopt.control.laws.controller import Controller
from seaopt.control.loops.loop import GROWING
from seaopt.control.loops.outer_loop import Impedance
from seaopt.errors import ControlError, require_number
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.records import record
from seaopt.units import mechanics_of

SLOWEST_POLE, FASTEST_POLE = 1e-4, 1.2  # p T of the double pole, looked at
POLES = 800
SAME_POLE = 1e-5  # to which the two poles of a double one are computed
REAL = 1e-9  # imaginary part of a pole that does not oscillate
NEWTON_STEPS, SMALL_STEP = 4, 1e-6
Poles = Float[np.ndarray, " k"]


@record(eq=False)
class CriticalImpedances:
    """Stiffness and damping of links with a double real pole and no slower oscillation, from soft to stiff."""

    stiffness: Float[np.ndarray, " n"]
    damping: Float[np.ndarray, " n"]
    rate: Float[np.ndarray, " n"]  # the double pole, rad/s


def critical_impedance(
    controller: Controller,
    plant: Plant,
    parameters: ParameterSet,
    stiffness: float,
    *,
    velocity_filter_s: float | None = None,
) -> Impedance:
    """Return the `Impedance` of a stiffness at the link that is critically damped: two of its poles are one real one.

    Parameters
    ----------
    controller, plant, parameters, velocity_filter_s
        As `seaopt.control.passive_region`.
    stiffness : float
        K_v, N/m or N m/rad.

    Raises
    ------
    ControlError
        The link does not move, or there is no such impedance; the error names the stiffnesses that have one.

    Examples
    --------
    >>> import seaopt as so
    >>> knee, values = so.plants.rotary(), so.plants.rotary().defaults.update(N=50.0, k_s=300.0, d_l=1.0)
    >>> force = so.tune(so.plants.rotary("locked"), values, so.ControllerSpec(measured="tau_s", bandwidth_hz=20))
    >>> critical_impedance(force, knee, values, 3.0).damping > 0
    True
    """
    require_number(stiffness, "stiffness", ControlError)
    link = find_link(controller, plant, parameters)
    return find_critical(link, link.speed_filter(velocity_filter_s).velocity_filter_s, stiffness)


def scan_critical(link: ControlledLink, velocity_filter_s: float) -> CriticalImpedances:
    """Return critically damped impedances up to the stiffest: beyond it something slower, of weight, oscillates."""
    p = np.geomspace(SLOWEST_POLE, FASTEST_POLE, POLES)
    loop = close_link(link, velocity_filter_s)
    k, d = _place(loop, p)
    good = np.isfinite(k) & np.isfinite(d) & (k > 0.0)
    poles = loop.eigenvalues(np.where(good, k, 0.0), np.where(good, d, 0.0))
    slower = np.abs(poles) > np.exp(-p)[:, None] * (1.0 + SAME_POLE)
    good &= ~np.any(slower & ((np.abs(np.imag(poles)) > REAL) | (np.abs(poles) > GROWING)), axis=-1)
    kept = np.flatnonzero(good)
    joins = (np.diff(kept) == 1) & (np.diff(k[kept]) > 0.0)  # neighbours that get stiffer are of one branch
    kept = max(np.split(kept, np.flatnonzero(~joins) + 1), key=len) if kept.size else kept
    return CriticalImpedances(stiffness=k[kept], damping=d[kept], rate=p[kept] / link.sample_time_s)


def find_critical(link: ControlledLink, velocity_filter_s: float, stiffness: float) -> Impedance:
    """Return the critically damped impedance of a stiffness. Raises ControlError, with those that have one."""
    scan = scan_critical(link, velocity_filter_s)
    stiffnesses = scan.stiffness
    unit = mechanics_of(link.port.place_unit).stiffness
    if not stiffnesses.size:
        raise ControlError(
            f"stiffness = {stiffness:g} {unit}: the link is critically damped at no stiffness, as something slower "
            "oscillates; give damping a number, or tune a faster force loop"
        )
    if not stiffnesses[0] <= stiffness <= stiffnesses[-1]:
        raise ControlError(
            f"stiffness = {stiffness:g} {unit} has no critically damped impedance; under this force law there is one "
            f"from {stiffnesses[0]:.4g} to {stiffnesses[-1]:.4g} {unit}"
        )
    loop = close_link(link, velocity_filter_s)
    p = float(np.interp(stiffness, stiffnesses, scan.rate)) * link.sample_time_s
    for _ in range(NEWTON_STEPS):  # the table is fine enough for Newton's method on K_v(p)
        k, _ = _place(loop, np.array([p, p * (1.0 + SMALL_STEP)]))
        p += (stiffness - float(k[0])) * SMALL_STEP * p / float(k[1] - k[0])
    damping = float(_place(loop, np.array([p]))[1][0])
    return Impedance(stiffness=stiffness, damping=damping, velocity_filter_s=velocity_filter_s)


def _place(loop: MovingLoop, p: Poles) -> tuple[Poles, Poles]:
    """Return K_v and D_v of double poles at z = exp(-p)."""
    z, outer = np.exp(-p), loop.outer
    system, position = loop.block, loop.block.c[0]
    inner = z[:, None, None] * np.eye(len(system.a)) - system.a
    once = np.linalg.solve(inner, system.b)
    twice = np.linalg.solve(inner, once)[:, :, 0]
    x, slope = once[:, :, 0] @ position, -(twice @ position)
    with np.errstate(divide="ignore", invalid="ignore"):
        n, n_slope = -1.0 / (outer.direction * x), slope / (outer.direction * x**2)
        d = n_slope / outer.difference_slope(z)
        return n - d * np.real(outer.difference(z.astype(complex))), d
