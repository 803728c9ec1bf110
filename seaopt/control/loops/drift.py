r"""What drifts, left out: motion that a plant's equations and its fed-back output do not depend on.

A link that nothing holds may be anywhere: with :math:`v` its shift and that of what it carries along (of a geared
joint, the motor's N turns for one of the link),

.. math:: \frac{\partial f}{\partial x} v = 0, \qquad \frac{\partial h}{\partial x} v = 0

at every state. Sampled, such a direction is an eigenvalue of 1 in every loop, whatever the law: no margin depends on
it, and a force that is regulated does not care where the link is. The coordinates relative to one of them,
:math:`x_i - (v_i / v_j) x_j`, have equations of their own without it. Where nothing brakes the link either, its speed
is the next such direction.

A loop that feeds back what drifts, such as a link's angle, keeps it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import casadi as ca
import numpy as np
from jaxtyping import Float

from seaopt.plants import Plant
from seaopt.plants.friction import remembers
from seaopt.plants.memo import memo
from seaopt.plants.plant import jacobians
from seaopt.plants.roles import Friction
from seaopt.records import record

PLACES = 4  # states, inputs and parameters at random where the equations are looked at
SEED = 1
ROUNDING = 1e-9  # of a column's size
CANCELLED = 1e-13  # of a row's largest slope


@record(eq=False)
class _Drift:
    """A direction that nothing depends on: how far other states move when the state `along` moves by one."""

    along: str
    others: Mapping[str, Any]
    """Expressions of the plant's own parameter symbols."""


@memo
def leave_out_drift(plant: Plant, measured: str | tuple[str, ...]) -> Plant:
    """Return the plant without the motion that neither it nor a fed-back output depends on; often the plant itself.

    `plant`: friction that remembers where it bent holds a link: such a plant is returned as it is. `measured`: the
    output that is fed back, or all that are. Returned: in the coordinates relative to what drifts; outputs that tell
    where that is are left out.

    Examples
    --------
    >>> import seaopt as so
    >>> free = so.plants.rotary(link="free")
    >>> list(free.states), list(leave_out_drift(free, "tau_s").states)
    (['theta_m', 'thetad_m', 'theta_l', 'thetad_l'], ['theta_m', 'thetad_m', 'thetad_l'])
    >>> leave_out_drift(free, "theta_l") is free
    True

    """
    names = {measured} if isinstance(measured, str) else {*measured}
    if remembers(plant) or not names <= plant.outputs.keys():
        return plant
    drift = _find_drift(plant)
    if drift is None:
        return plant
    remaining = _take_out(plant, drift)
    return leave_out_drift(remaining, measured) if names <= remaining.outputs.keys() else plant


def _look(plant: Plant) -> list[tuple[Float[np.ndarray, "_ n"], Float[np.ndarray, "_ n"], Any]]:
    """Return the slopes of f and h by the states at random places, and the parameters there."""
    rng, function = np.random.default_rng(SEED), jacobians(plant)
    # A parameter of zero has a value all the same: whether a link is held must not hang on where its spring starts.
    defaults = {name: plant.defaults[name].value for name in plant.parameters if name in plant.defaults}
    nominal = np.array([defaults.get(name) or 1.0 for name in plant.parameters])
    places: list[tuple[Any, Any, Any]] = []
    for _ in range(PLACES):
        p = nominal * rng.uniform(0.8, 1.25, nominal.size)
        x, u = (0.1 * rng.normal(size=symbols.numel()) for symbols in (plant.x, plant.u))
        a, _, c, _ = (_clean(np.array(block)) for block in function(x, u, p))
        places.append((a, c, p))
    return places


def _clean(block: Float[np.ndarray, "m n"]) -> Float[np.ndarray, "m n"]:
    """Return slopes without what terms that cancel leave of each other in a row."""
    return np.where(np.abs(block) > CANCELLED * np.max(np.abs(block), axis=1, keepdims=True), block, 0.0)


def _find_drift(plant: Plant) -> _Drift | None:
    """Return a direction that the equations do not depend on; None if there is none."""
    places = _look(plant)
    if not all(np.all(np.isfinite(a)) for a, _, _ in places):
        return None
    first = places[0][0]
    size = np.linalg.norm(first, axis=0)
    size[size == 0.0] = 1.0
    _, singular, turned = np.linalg.svd(first / size)
    if singular[-1] > ROUNDING * singular[0]:
        return None
    direction = turned[-1] / size
    touched = np.flatnonzero(np.abs(direction * size) > ROUNDING)
    along = int(touched[-1])
    coupled = [int(i) for i in touched[:-1]]
    moved = _solve_ratios(plant, first, along, coupled)
    names = list(plant.states)
    drift = _Drift(along=names[along], others={names[i]: ratio for i, ratio in zip(coupled, moved, strict=True)})
    return drift if _is_drift(plant, drift, places) else None


def _solve_ratios(plant: Plant, a: Float[np.ndarray, "n n"], along: int, coupled: Sequence[int]) -> list[Any]:
    """Return how far the others move with one, solved for in symbols: from as many equations as there are others."""
    if not coupled:
        return []
    # The rows that tell the others best: a triangle with pivots picks them.
    from scipy.linalg import qr  # deferred: scipy is slow to load

    pivots: Any = qr(a[:, coupled].T, mode="r", pivoting=True)[-1]
    rows = np.sort(pivots[: len(coupled)])
    slopes = ca.substitute(ca.jacobian(plant.dynamics, plant.x), plant.t, 0.0)
    slopes = ca.substitute(slopes, ca.vertcat(plant.x, plant.u), ca.SX.zeros(plant.x.numel() + plant.u.numel()))
    picked = slopes[rows.tolist(), :]
    return ca.vertsplit(ca.simplify(-ca.solve(picked[:, list(coupled)], picked[:, along])))


def _is_drift(plant: Plant, drift: _Drift, places: Sequence[tuple[Any, Any, Any]]) -> bool:
    """Tell whether the equations do not depend on a direction at any of the places."""
    direction = _direction_function(plant, drift)
    for a, _, p in places:
        v = np.array(direction(p)).ravel()
        if np.any(np.abs(a @ v) > ROUNDING * (np.abs(a) @ np.abs(v)) + 1e-300):
            return False
    return True


def _direction_function(plant: Plant, drift: _Drift) -> Any:
    """Return the CasADi function p -> the direction."""
    column = [ca.SX(1.0) if name == drift.along else ca.SX(drift.others.get(name, 0.0)) for name in plant.states]
    return ca.Function("drift", [plant.p], [ca.densify(ca.vertcat(*column))])


def _take_out(plant: Plant, drift: _Drift) -> Plant:
    """Return the plant relative to what drifts, with the outputs that do not tell where that is."""
    ratios = ca.Function("ratios", [plant.p], [ca.vertcat(*drift.others.values(), ca.SX(0.0))])
    told = _find_telling(plant, drift)

    # The equations may differentiate by their states, so that a symbol stands for this one until they are written.
    zero = ca.SX.sym(drift.along)

    def fill(x: Any) -> SimpleNamespace:
        return SimpleNamespace(**{**vars(x), drift.along: zero})

    def settle(expression: Any) -> Any:
        return ca.substitute(ca.SX(expression), zero, 0.0)

    def relative(friction: Friction) -> Friction:
        velocity, loads = friction.velocity, friction.loads
        return replace(
            friction,
            velocity=lambda x, p: settle(velocity(fill(x), p)),
            loads=None if loads is None else lambda x, u, p: settle(loads(fill(x), u, p)),
        )

    def f(t: Any, x: Any, u: Any, p: Any) -> dict[str, Any]:
        rates = {name: settle(rate) for name, rate in plant.f(t, fill(x), u, p).items()}
        together = rates.pop(drift.along)
        values = ratios(ca.vertcat(*(getattr(p, name) for name in plant.parameters)))
        for i, name in enumerate(drift.others):
            rates[name] = rates[name] - values[i] * together
        return rates

    def h(t: Any, x: Any, u: Any, p: Any) -> dict[str, Any]:
        return {name: settle(value) for name, value in plant.h(t, fill(x), u, p).items() if name not in told}

    return replace(
        plant,
        f=f,
        h=h,
        ports=(),
        energy=None,
        spring=None,
        sensing=None,
        mode=None,
        derived=None,
        states={name: unit for name, unit in plant.states.items() if name != drift.along},
        outputs={name: unit for name, unit in plant.outputs.items() if name not in told},
        friction={name: relative(friction) for name, friction in plant.friction.items()},
    )


def _find_telling(plant: Plant, drift: _Drift) -> set[str]:
    """Return the outputs that tell where a drift is."""
    told: set[str] = set()
    direction = _direction_function(plant, drift)
    for _, c, p in _look(plant):
        v = np.array(direction(p)).ravel()
        seen = np.abs(c @ v) > ROUNDING * (np.abs(c) @ np.abs(v)) + 1e-300
        told |= {name for name, depends in zip(plant.outputs, seen, strict=True) if depends}
    return told
