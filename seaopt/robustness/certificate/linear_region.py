"""Predictive control while no limit is active: a law, its limits, and what a sweep of its bandwidth finds.

The plan's first command is then linear in state and reference, so that its loop has margins, worst cases and draws as
every other's.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

from seaopt.control import Controller, ControllerSpec, ForceMPC, Frontier, Law, MPCSpec, assess
from seaopt.control.frontier.rows import FrontierRow
from seaopt.control.given.assessment import assess_row
from seaopt.control.laws.delay import DELAY_KEYS
from seaopt.control.laws.structures import CUSTOM
from seaopt.control.mpc.spec import MPC_BANDWIDTH_TOLERANCE, MPC_LIMITS
from seaopt.control.tuning.tuner import RobustTo


def linear_controller(mpc: ForceMPC) -> Controller:
    """Return a predictive controller's law while no limit is active, as a controller with the same limits of its loop.

    It has no limit of the command: what the plan does with one is no part of it. What stands around the plan does
    around it.

    Examples
    --------
    >>> import seaopt as so
    >>> from seaopt.control import MPCSpec, force_mpc
    >>> spec = MPCSpec(current_limit_A=9.0, bandwidth_hz=20)
    >>> controller = linear_controller(force_mpc(so.plants.high_impedance(), so.plants.thor(), spec))
    >>> controller.structure, controller.feasible
    ('custom', True)
    """
    law = assess(_split_law(mpc), *mpc.design, linear_spec(mpc.spec))
    return replace(law, outer=mpc.outer, compensation=mpc.compensation)


def _split_law(mpc: ForceMPC) -> Law:
    """Return the law with its integrator apart: rounding leaves that pole on either side of the unit circle."""
    law = mpc.law
    return Law.from_state_space(law.a, law.b, law.c, law.d, law.sample_time_s)


def sweep_plans(plans: Iterable[ForceMPC], robust_to: RobustTo | None = None) -> Frontier:
    """Return the rows of plans of several bandwidths, each of its linear region with its outer loop, as
    `seaopt.control.sweep` does of gains. `robust_to`: plants or measured responses besides the design plant.
    """
    rows, laws = zip(*(_describe_row(mpc, robust_to or {}) for mpc in plans), strict=True)
    return Frontier(rows=rows, controllers=laws)


def _describe_row(mpc: ForceMPC, robust_to: RobustTo) -> tuple[FrontierRow, Controller]:
    spec = mpc.spec
    row, law = assess_row(_split_law(mpc), *mpc.design, linear_spec(spec), robust_to, outer=lambda _: mpc.outer)
    limits = {"current_limit_A": spec.current_limit_A, "command_limit": spec.command_limit}
    limited = replace(law, spec=replace(law.spec, **limits))
    return replace(row, force_limit_N=limited.force_limit(spec.bandwidth_hz)), law


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
