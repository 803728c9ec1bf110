"""Predictive control while no limit is active: a law, its limits, and what a sweep of its bandwidth finds.

The plan's first command is then linear in state and reference, so that its loop has margins, worst cases and draws as
every other's.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields, replace
from typing import Any

from seaopt.control import Controller, ControllerSpec, ForceMPC, Frontier, Law, LinkFeedforward, MPCSpec, assess
from seaopt.control.frontier.rows import FrontierRow
from seaopt.control.given.assessment import assess_row
from seaopt.control.laws.delay import DELAY_KEYS
from seaopt.control.laws.structures import CUSTOM
from seaopt.control.mpc.spec import MPC_BANDWIDTH_TOLERANCE, MPC_LIMITS
from seaopt.control.tuning.solution import LOWER_FRACTIONS
from seaopt.control.tuning.tuner import RobustTo, choose_fraction, find_link
from seaopt.errors import ControlError
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.plants.friction import take_sliding


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
    controller = assess(_split_law(mpc), *mpc.design, linear_spec(mpc.spec))
    controller, link = replace(controller, outer=mpc.outer, compensation=mpc.compensation), mpc.link
    if link is None:
        return controller
    stated = {field.name: getattr(link, field.name) for field in fields(LinkFeedforward)}
    fed = replace(
        controller,
        law=controller.law.reading(link.feedback(mpc.sample_time_s)),
        spec=replace(controller.spec, link_feedforward=LinkFeedforward(**stated)),
        design=(link.see(mpc.design[0]), mpc.design[1]),
        link=link,
        reads=mpc.signals,
    )
    return replace(fed, achieved=fed.close(*mpc.design).figures())


def feed_link_forward(
    mpc: ForceMPC, feedforward: LinkFeedforward, plants: Mapping[str, tuple[Plant, ParameterSet]]
) -> ForceMPC:
    """Return predictive control that feeds a link's motion forward beside its plan.

    Parameters
    ----------
    mpc : ForceMPC
        Designed on a plant that holds its link.
    feedforward : LinkFeedforward
        Which motion is fed forward, and how.
    plants : mapping of name to (Plant, ParameterSet)
        What the path is made of is the first of them whose link moves. Where no fraction is stated it is as much as
        leaves Ms on these, or leaves it as it is without, in steps of a fifth.

    Raises
    ------
    ControlError
        The design plant's link moves, none of the others' does, or its drive is not an inertia and a damper.
    """
    if mpc.design[0].moves:
        raise ControlError(
            f"link_feedforward: predictive control is designed on {mpc.design[0].name}, whose link moves, so that its "
            "plan follows it already; design on a plant that holds its link, or leave link_feedforward out"
        )
    spec, named = replace(linear_spec(mpc.spec), link_feedforward=feedforward), dict(plants)
    link = find_link(spec, named, mpc.per_effort)
    assert link is not None
    fed, pairs = replace(mpc, link=link), (mpc.design, *named.values())
    if feedforward.fraction is not None:
        return fed
    link = choose_fraction(link, spec, [fed.plant(take_sliding(*pair), pair[1]) for pair in pairs])
    allowed = spec.level("max_sensitivity") or math.inf
    most = [max(allowed, mpc.close(*pair).figures().ms) for pair in pairs]
    none = replace(mpc, link=replace(link, fraction=0.0))
    lower = (replace(link, fraction=round(0.8**power * link.fraction, 3)) for power in range(LOWER_FRACTIONS + 1))
    tried = (replace(mpc, link=each) for each in lower)
    return next((each for each in tried if _keeps(each, pairs, most)), none)


def _keeps(mpc: ForceMPC, pairs: Sequence[tuple[Plant, ParameterSet]], most: Sequence[float]) -> bool:
    """Tell whether the linear region is stable and has no more than an Ms on each of some plants."""
    figures = [mpc.close(*pair).figures() for pair in pairs]
    return all(each.stable and each.ms <= allowed for each, allowed in zip(figures, most, strict=True))


def _split_law(mpc: ForceMPC) -> Law:
    """Return the law that reads the force alone with its integrator apart: rounding leaves that pole on either side of
    the unit circle.
    """
    return replace(mpc, link=None).law.set_apart()


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
