"""Predictive control as a law: while no limit is active the plan's first command is linear in state and reference.

So its loop has margins, worst cases and draws as every other's. Where the program's constraints are active there is no
such law: `constrained` simulates that.
"""

from __future__ import annotations

from typing import Any

from seaopt.control import Controller, ControllerSpec, ForceMPC, Law, MPCSpec, assess
from seaopt.control.laws.delay import DELAY_KEYS
from seaopt.control.laws.structures import CUSTOM
from seaopt.control.mpc.spec import MPC_BANDWIDTH_TOLERANCE, MPC_LIMITS


def linear_controller(mpc: ForceMPC) -> Controller:
    """Return a predictive controller's law while no limit is active, as a controller with the same limits of its loop.

    It has no limit of the command: what the plan does with one is no part of it.

    Examples
    --------
    >>> import seaopt as so
    >>> from seaopt.control import MPCSpec, force_mpc
    >>> spec = MPCSpec(current_limit_A=9.0, bandwidth_hz=20)
    >>> controller = linear_controller(force_mpc(so.plants.high_impedance(), so.plants.thor(), spec))
    >>> controller.structure, controller.feasible
    ('custom', True)
    """
    law = mpc.law  # its integrator apart: rounding leaves that pole on either side of the unit circle
    split = Law.from_state_space(law.a, law.b, law.c, law.d, law.sample_time_s)
    return assess(split, *mpc.design, linear_spec(mpc.spec))


def linear_spec(spec: MPCSpec) -> ControllerSpec:
    """Return the limits of a predictive controller's loop while no limit of its plan is active, as those of a law."""
    levels: dict[str, Any] = {
        limit.name: getattr(spec, limit.name)
        for limit in MPC_LIMITS
        if limit.has_field and limit.name != "bandwidth_hz"
    }
    return ControllerSpec(
        structure=CUSTOM,
        measured=spec.measured,
        bandwidth_hz=spec.bandwidth_hz,
        bandwidth_range_hz=(min(15.0, spec.bandwidth_hz), max(60.0, spec.bandwidth_hz)),
        sample_rate_hz=spec.sample_rate_hz,
        min_filter_samples=False,
        bandwidth_tolerance=MPC_BANDWIDTH_TOLERANCE,
        **levels,
        **{name: getattr(spec, name) for name in DELAY_KEYS},
    )
