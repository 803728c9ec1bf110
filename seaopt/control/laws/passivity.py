r"""Passivity of the controlled actuator at link 2: what it does to a hand, a leg or a wall that moves it.

Link 1 is held, link 2 is moved with the speed v, and F2 v is the power that goes into the actuator (link 2 feels -F2,
so that a mass has the impedance +j omega m). The actuator is passive where its impedance Z = F2/v has Re Z >= 0; where
it is so at every frequency, nothing passive that link 2 is attached to is made unstable by it (Colgate, Hogan, Int. J.
Control 48(1), 1988). That takes a loop that does not grow with link 2 held, Z having no pole on the right: of any
other, Re Z says nothing.

With :math:`F_1 = G_{11} F_m + G_{12} v` and :math:`F_2 = G_{21} F_m + G_{22} v` of the plant's linearisation, and
:math:`F_m = -C' F_1`,

.. math:: Z = \frac{G_{22} + \Delta\, C'}{1 + G_{11} C'}, \qquad \Delta = G_{11} G_{22} - G_{12} G_{21} .

Unlumped, spring at link 1: from :math:`M \ddot q = F_m - b_m \dot q - F_2`, :math:`F_1 = k (q + x_2)` and
:math:`F_2 = F_1 + m_l (\ddot q + \ddot x_2)`,

.. math:: Z = \frac{(m_l s^2 + k)(M s + b_m)}{m_k s^2 + b_m s + k (1 + C')}, \qquad \Delta = 0 .

F1 tells F2, the sprung mass being rigid, which is why :math:`\Delta = 0`, and why Re Z >= 0 is affine in the gains:
:math:`\mathrm{Re}[G_{22} \overline{(1 + G_{11} C')}] \ge 0` (`passivity_rows`). For an undelayed PID it reads

.. math:: b_m k (1 + k_p) - M k k_i + (M k k_d - b_m m_l)\, \omega^2 \ge 0 \qquad (\omega^2 < k/m_l),

at low frequency :math:`k_i \le b_m (1 + k_p)/M`, where M = J/r^2 is m_k but for m_l. Beyond :math:`\omega^2 = k/m_l`
(160 Hz for THOR) F2 and F1 have opposite signs and the inequality is reversed: no undelayed PID of positive gains is
passive just above. `Passivity.limit_hz` is where that begins. A delay that has turned C' by more than a quarter of a
circle turns both: such a loop can lose passivity below and have it back above.

The sampled controller is taken as linear and time-invariant: :math:`C' = C_y(e^{j\omega T_s})\, e^{-j\omega d T_s}
(1 - e^{-j\omega T_s})/(j\omega T_s)`, with its delay and its hold. That leaves out the images that sampling folds back
onto f from f + n/T_s, which the plant has filtered out all but for a part that grows towards the Nyquist frequency.
Under a sinusoidal motion the mean power into the sampled loop is then abs(v)^2 Re Z/2, up to those images.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Complex, Float

from seaopt.codec import to_content
from seaopt.control.laws.controller import Controller
from seaopt.control.laws.limits import PortFigures
from seaopt.control.laws.spec import ControllerSpec
from seaopt.control.loops.law import Law
from seaopt.control.loops.loop import GROWING, Loop
from seaopt.control.loops.port import Frequencies, PortModel, Response, hold_response, port_of, weigh_passivity
from seaopt.control.systems.crossings import add_minima, find_crossings
from seaopt.errors import ControlError
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.plants.friction import take_sliding
from seaopt.records import Worded, record
from seaopt.units import LINEAR, mechanics_of

Curve = Callable[[Frequencies], Any]
LOWEST_PASSIVE_HZ = 0.01
POINTS = 2000
COSINE_ROUNDING = 1e-9  # cosines of the impedance's angle nearer to zero than this are zero
TINY = float(np.finfo(float).tiny)


@record(repr=False)
class Passivity(Worded):
    """Where the actuator is passive at link 2.

    Parameters
    ----------
    low_hz, high_hz : float
        The band that was examined.
    held_stable : bool
        No closed-loop eigenvalue is outside the circle with link 2 held.
    bands_hz : tuple of (low, high)
        Where Re Z >= 0; none if not `held_stable`.
    violated_hz : float or None
        The lowest frequency at which Re Z < 0 begins, `low_hz` if not `held_stable`; None: nowhere.
    least_damping_N_s_per_m : float
        The smallest Re Z; where it is negative, this much viscous damping at the port would compensate it.
    least_hz : float
        Where that is.
    least_cosine : float
        Re Z/abs(Z) there, from -1 to 1.
    limit_hz : float or None
        From here the fed-back force and the force at the port oppose each other; None where they never do.
    unit : str
        Of the damping: N s/m, or N m s/rad at a port that turns.
    """

    low_hz: float
    high_hz: float
    held_stable: bool
    bands_hz: tuple[tuple[float, float], ...]
    violated_hz: float | None
    least_damping_N_s_per_m: float
    least_hz: float
    least_cosine: float
    limit_hz: float | None
    unit: str = LINEAR.damping

    def holds(self, band_hz: tuple[float, float]) -> bool:
        """Tell whether Re Z >= 0 throughout a band. Raises ControlError: the band is not within the examined one."""
        low, high = band_hz
        if not self.low_hz <= low < high <= self.high_hz:
            raise ControlError(
                f"band_hz = [{low:g}, {high:g}] is not a band within {self.low_hz:g} to {self.high_hz:g} Hz; "
                "give one, or look further"
            )
        return any(start <= low and high <= stop for start, stop in self.bands_hz)

    def to_dict(self) -> dict[str, Any]:
        """Return the fields, for robustness.json."""
        return to_content(self)


def passivity(
    controller: Controller,
    plant: Plant,
    params: ParameterSet,
    *,
    low_hz: float = LOWEST_PASSIVE_HZ,
    high_hz: float | None = None,
) -> Passivity:
    """Find where a controlled actuator is passive at link 2.

    Parameters
    ----------
    controller : Controller
        Its measurement path closes the loop; the reference is constant.
    plant, params
        An actuator with a port at link 2; its own links do not matter: link 1 is held and link 2 moved. Where it has
        friction it slides.
    low_hz, high_hz : float
        The band to examine; up to the Nyquist frequency if left out.

    Returns
    -------
    Passivity
        Crossings refined to rounding, and the least of all local minima, refined too.

    Raises
    ------
    ControlError
        The plant has no port at link 2, or the band is not one below the Nyquist frequency.

    Examples
    --------
    >>> import seaopt as so
    >>> spec = so.ControllerSpec(bandwidth_hz=30, max_sensitivity=1.6, max_noise_gain=25, max_reference_peak=1.3)
    >>> plant, params = so.plants.high_impedance(), so.plants.thor()
    >>> found = passivity(so.tune(plant, params, spec), plant, params)
    >>> round(found.limit_hz, 1)
    160.3
    """
    ts = controller.sample_time_s
    high = 0.5 / ts if high_hz is None else high_hz
    if not 0.0 < low_hz < high <= 0.5 / ts:
        raise ControlError(
            f"low_hz = {low_hz:g}, high_hz = {high:g} is not a band; give 0 < low < high <= {0.5 / ts:g} Hz"
        )
    port = port_of(
        take_sliding(plant, params), controller.delay(params), controller.signals, controller.command.per_effort
    )
    law, waits = controller.law, controller.compute_delay_samples
    impedance, angle = _make_curves(port, law, waits)
    f = add_minima(angle, add_minima(lambda x: np.real(impedance(x)), _make_grid(port, law, low_hz, high)))
    stable = is_held_stable(port, law, waits)
    bands, violated = _find_bands(lambda x: angle(x) + COSINE_ROUNDING, f) if stable else ((), low_hz)

    def compare_directions(x: Frequencies) -> Frequencies:
        response = port.response(x)
        return np.real(response.motor_to_port * np.conj(response.motor_to_read[0]))

    opposed, z = find_crossings(compare_directions, f), impedance(f)
    least = int(np.argmin(np.real(z)))
    return Passivity(
        low_hz=low_hz,
        high_hz=high,
        held_stable=stable,
        bands_hz=bands,
        violated_hz=violated,
        least_damping_N_s_per_m=float(np.real(z[least])),
        least_hz=float(f[least]),
        least_cosine=float(np.real(z[least]) / max(abs(z[least]), TINY)),
        limit_hz=float(opposed[0]) if opposed.size else None,
        unit=mechanics_of(port.place_unit).damping,
    )


def measure_port(port: PortModel, law: Law, delay_samples: int, band_hz: tuple[float, float]) -> PortFigures:
    """Return the least Re Z/abs(Z) in a band, refined to rounding, where it is, and whether the held loop is stable."""
    _, angle = _make_curves(port, law, delay_samples)
    f = add_minima(angle, _make_grid(port, law, *band_hz))
    cosine = angle(f)
    least, stable = int(np.argmin(cosine)), is_held_stable(port, law, delay_samples)
    return PortFigures(least_cosine=float(cosine[least]), at_hz=float(f[least]), held_stable=stable)


def passivity_rows(
    plant: Plant,
    params: ParameterSet,
    spec: ControllerSpec,
    per_effort: float,
    basis: Complex[np.ndarray, "m n"],
    f: Frequencies,
) -> tuple[Float[np.ndarray, "m n"], Float[np.ndarray, " m"]]:
    """Return A and b with A theta >= b where C_y = sum of theta_i basis_i makes Re Z >= 0 at the frequencies f.

    Parameters
    ----------
    plant, params, spec
        The actuator, and what is measured, how fast, and how late.
    per_effort : float
        Of the controller.
    basis : array, shape (m, n)
        Responses of 1, the integrator, the filtered difference, ... at f, as the controller computes them: delay and
        hold are put in here.
    f : array, shape (m,)
        Hz, above zero.

    Returns
    -------
    A, b : arrays, shapes (m, n) and (m,)
        Each row in units of abs(G_22), so that A theta - b is Re Z/abs(Z) times abs(1 + L).

    Raises
    ------
    ControlError
        The measured force does not determine the force at the port (an elastic screw between them), so that the
        condition is quadratic in the gains.
    """
    port = port_of(plant, params, spec.regulated, per_effort)
    condition = weigh_passivity(port, spec.sample_time_s, spec.loop_delay_samples, f)
    if np.any(condition.forces):
        raise ControlError(
            "the force at the port does not follow from the measured one alone (an elastic screw between them), so "
            "that passivity is not affine in the gains; measure the force at the port, or give the band to tune: "
            "passive_band_hz"
        )
    return np.real(condition.unit[:, None] * np.conj(condition.loops[0][:, None] * basis)), -np.real(condition.unit)


def is_held_stable(port: PortModel, law: Law, delay_samples: int) -> bool:
    """Tell whether nothing grows in the sampled loop with link 2 held."""
    poles = Loop(plant=port.hold_link(law.sample_time_s, delay_samples), law=law).eigenvalues()
    return bool(np.max(np.abs(poles), initial=0.0) <= GROWING)


def _make_curves(port: PortModel, law: Law, delay_samples: int) -> tuple[Curve, Curve]:
    """Return Z and Re Z/abs(Z) as functions of frequency."""

    def impedance(f: Frequencies) -> Response:
        late = hold_response(f, law.sample_time_s, delay_samples)
        return port.response(f).impedance(law.feedback_responses(f) * late)

    def angle(f: Frequencies) -> Frequencies:
        z = impedance(f)
        return np.real(z) / np.maximum(np.abs(z), TINY)

    return impedance, angle


def _make_grid(port: PortModel, law: Law, low_hz: float, high_hz: float) -> Frequencies:
    """Return frequencies that resolve the modes of plant and law."""
    poles = law.poles[np.abs(law.poles) > TINY]
    poles = np.concatenate([port.find_poles(), np.log(poles) / law.sample_time_s])
    at, width = np.abs(poles.imag) / (2 * np.pi), np.abs(poles.real) / (2 * np.pi)
    fan = np.concatenate([[0.0], *([-x, x] for x in np.geomspace(0.03, 10.0, 20))])
    near = (at[:, None] + np.maximum(width, 1e-6 * high_hz)[:, None] * fan).ravel()
    inside = near[(near > low_hz) & (near < high_hz)]
    return np.unique(np.concatenate([np.geomspace(low_hz, high_hz, POINTS), inside]))


def _find_bands(
    curve: Callable[[Frequencies], Frequencies], f: Frequencies
) -> tuple[tuple[tuple[float, float], ...], float | None]:
    """Return where the curve is not negative, and where it first is."""
    edges = np.concatenate([f[:1], find_crossings(curve, f), f[-1:]])
    good = curve(np.sqrt(edges[:-1] * edges[1:])) >= 0.0
    ends = np.flatnonzero(np.diff(good, prepend=False, append=False)).reshape(-1, 2)
    bands = tuple((float(edges[first]), float(edges[last])) for first, last in ends)
    return bands, None if np.all(good) else float(edges[np.argmin(good)])
