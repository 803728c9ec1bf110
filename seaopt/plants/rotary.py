r"""A rotary series elastic actuator, unlumped: motor, gearbox with the housing's reaction, spring, link."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import casadi as ca

from seaopt.parameters import Parameter
from seaopt.plants.parts import Part, wrapped
from seaopt.plants.plant import Plant
from seaopt.plants.roles import Actuation, Port, Sensing, SeriesSpring

_PARAMETERS = (
    Parameter(name="J_m", value=1e-4, unit="kg m^2", min=1e-15, description="motor inertia", plausible=(1e-10, 10)),
    Parameter(name="b_r", value=1e-4, unit="N m s", min=0.0, description="motor damping", plausible=(0, 100)),
    Parameter(
        name="K_tau", value=0.05, unit="N m/A", min=0.0, description="motor torque constant", plausible=(0.0001, 100)
    ),
    Parameter(name="N", value=50.0, unit="-", min=1e-9, description="gear ratio", plausible=(0.02, 10000)),
    Parameter(name="k_s", value=300.0, unit="N m/rad", min=0.0, description="spring stiffness", plausible=(0.01, 1e08)),
    Parameter(name="c_s", value=0.0, unit="N m s/rad", min=0.0, description="spring damping", plausible=(0, 1e06)),
    Parameter(name="J_l", value=0.1, unit="kg m^2", min=1e-15, description="link inertia", plausible=(1e-08, 100000)),
    Parameter(name="d_l", value=0.0, unit="N m s/rad", min=0.0, description="link damping", plausible=(0, 100000)),
)


def rotary_parameters() -> tuple[Parameter, ...]:
    """Return the parameters of `rotary` with their defaults."""
    return _PARAMETERS


def rotary(parts: Sequence[Part] = ()) -> Plant:
    r"""Return a rotary series elastic actuator: the two-mass drive with a gearbox.

    Parameters
    ----------
    parts : sequence of str
        ``current_loop`` and ``command_delay`` on the current, ``load_cell`` and ``measurement_delay`` on tau_s; see
        `seaopt.plants.parts`.

    Returns
    -------
    Plant
        Input I (A); outputs tau_s (N m, the spring's torque on the link), theta_m, theta_l (rad) and tau_h (N m, the
        torque on the housing).

    Notes
    -----
    With :math:`\tau_s = k_s(\theta_m/N - \theta_l) + c_s(\dot\theta_m/N - \dot\theta_l)`:

    .. math:: J_m \ddot\theta_m = K_\tau I - b_r \dot\theta_m - \tau_s/N, \qquad
              J_l \ddot\theta_l = \tau_s - d_l \dot\theta_l

    The housing carries the stator, :math:`-(K_\tau I - b_r\dot\theta_m)`, and the gearbox, which turns the torque
    :math:`\tau_s/N` into :math:`\tau_s`: :math:`\tau_h = -J_m \ddot\theta_m - \tau_s`, so that motor, link and housing
    together conserve angular momentum except for d_l. The unlumped view matters here as in the paper: the motor's
    inertia does not turn with the link at :math:`N^2 J_m`, it turns N times as fast (Orekhov et al. 2015, Sec. V).

    With the motor held the link swings at :math:`\sqrt{k_s/J_l}` (the antiresonance of theta_m, and a clamped flexible
    link's frequency); free, both swing at :math:`\sqrt{k_s(1/J_l + 1/(N^2 J_m))}`. N = 1 is the two-mass drive.

    Examples
    --------
    >>> import seaopt as so
    >>> plant = so.plants.rotary()
    >>> model = plant.linearize(plant.defaults)
    >>> model.output_labels
    ['tau_s', 'theta_m', 'theta_l', 'tau_h']

    """

    def torques(x: Any, u: Any, p: Any) -> tuple[Any, Any]:
        spring = p.k_s * (x.theta_m / p.N - x.theta_l) + p.c_s * (x.thetad_m / p.N - x.thetad_l)
        return spring, (p.K_tau * u.I - p.b_r * x.thetad_m - spring / p.N) / p.J_m

    def f(t: Any, x: Any, u: Any, p: Any) -> dict[str, Any]:
        spring, motor = torques(x, u, p)
        link = (spring - p.d_l * x.thetad_l) / p.J_l
        return {"theta_m": x.thetad_m, "thetad_m": motor, "theta_l": x.thetad_l, "thetad_l": link}

    def h(t: Any, x: Any, u: Any, p: Any) -> dict[str, Any]:
        spring, motor = torques(x, u, p)
        return {"tau_s": spring, "theta_m": x.theta_m, "theta_l": x.theta_l, "tau_h": -p.J_m * motor - spring}

    def derived(p: Any) -> dict[str, tuple[Any, str]]:
        return {
            "antiresonance_hz": (ca.sqrt(p.k_s / p.J_l) / (2 * math.pi), "Hz"),
            "resonance_hz": (ca.sqrt(p.k_s * (1 / p.J_l + 1 / (p.N**2 * p.J_m))) / (2 * math.pi), "Hz"),
        }

    def energy(x: Any, p: Any) -> Any:
        kinetic = 0.5 * (p.J_m * x.thetad_m**2 + p.J_l * x.thetad_l**2)
        return kinetic + 0.5 * p.k_s * (x.theta_m / p.N - x.theta_l) ** 2

    plant = Plant(
        name="rotary",
        states={"theta_m": "rad", "thetad_m": "rad/s", "theta_l": "rad", "thetad_l": "rad/s"},
        inputs={"I": "A"},
        outputs={"tau_s": "N m", "theta_m": "rad", "theta_l": "rad", "tau_h": "N m"},
        parameters={parameter.name: parameter for parameter in _PARAMETERS},
        f=f,
        h=h,
        derived=derived,
        energy=energy,
        actuation=Actuation(input="I", effort=lambda p: p.N * p.K_tau, unit="N m"),
        sensing=Sensing(
            regulated=("tau_s",), motor_position="theta_m", motor_speed="thetad_m", link_position="theta_l"
        ),
        spring=SeriesSpring(deflection=lambda x, p: x.theta_m / p.N - x.theta_l, unit="rad", stiffness="k_s"),
        ports=(
            Port(
                motion="theta_l", coordinate="theta_l", rate="thetad_l", payload=("J_l",), drive="theta_m",
                ratio=lambda p: -p.N,
            ),
        ),
    )  # fmt: skip
    return wrapped(plant, parts)
