r"""Leave out drift: motion that a plant's equations and its fed-back output do not depend on.

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

from collections.abc import Mapping
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import casadi as ca
import numpy as np
from jaxtyping import Bool, Float

from seaopt.plants import Plant
from seaopt.plants.friction import leave_out_waves, remembers
from seaopt.plants.memo import memo
from seaopt.plants.motor.thermal import freeze_heat
from seaopt.plants.plant import jacobians
from seaopt.plants.roles import Friction, with_values
from seaopt.signals import MatrixMN, MatrixNN, VectorN

PLACES = 4  # states, inputs and parameters at random where the equations are looked at
SEED = 1
FORGOTTEN = 1e-4  # of what drifts, in a period, where its differences alone are read
ROUNDING = 1e-9  # of a column's size
CANCELLED = 1e-13  # of a row's largest slope


Slopes = list[tuple[MatrixNN, Float[np.ndarray, "y n"], Any]]


def take_linear(plant: Plant, measured: str | tuple[str, ...]) -> Plant:
    """Return the plant as linear loops have it: its heat stands still, waves of a position are left out, and so is what
    drifts (`leave_out_drift`).
    """
    return leave_out_drift(freeze_heat(leave_out_waves(plant)), measured)


@memo
def leave_out_drift(plant: Plant, measured: str | tuple[str, ...]) -> Plant:
    """Return the plant, relative to what drifts, without the motion that neither it nor the outputs `measured` depend
    on, nor outputs that tell where that is; often the plant itself, as where friction that remembers holds a link.
    """
    names = {measured} if isinstance(measured, str) else {*measured}
    if remembers(plant) or not names <= plant.outputs.keys():
        return plant
    slopes = _sample_slopes(plant)
    shifts = _find_shifts(plant, slopes)
    if not shifts:
        return plant
    column = ca.vertcat(*(ca.SX(shifts.get(name, 0.0)) for name in plant.states))
    direction, telling = ca.Function("drift", [plant.p], [ca.densify(column)]), set[str]()
    for a, c, p in slopes:
        v = np.array(direction(p)).ravel()
        if np.any(_depends(a, v)):
            return plant
        telling |= {name for name, depends in zip(plant.outputs, _depends(c, v), strict=True) if depends}
    return plant if names & telling else leave_out_drift(_take_out(plant, shifts, telling), measured)


def _depends(block: MatrixMN, v: VectorN) -> Bool[np.ndarray, " m"]:
    """Tell which rows of slopes depend on a direction."""
    return np.abs(block @ v) > ROUNDING * (np.abs(block) @ np.abs(v)) + 1e-300


def _sample_slopes(plant: Plant) -> Slopes:
    """Return the slopes of f and h by the states at random places, and the parameters there."""
    rng, function = np.random.default_rng(SEED), jacobians(plant)
    # A parameter of zero has a value all the same: whether a link is held must not hang on where its spring starts.
    defaults = {name: plant.defaults[name].value for name in plant.parameters if name in plant.defaults}
    nominal = np.array([defaults.get(name) or 1.0 for name in plant.parameters])
    slopes: Slopes = []
    for _ in range(PLACES):
        p = nominal * rng.uniform(0.8, 1.25, nominal.size)
        x, u = (0.1 * rng.normal(size=symbols.numel()) for symbols in (plant.x, plant.u))
        a, _, c, _ = (_clean(np.array(block)) for block in function(x, u, p))
        slopes.append((a, c, p))
    return slopes


def _clean(block: MatrixMN) -> MatrixMN:
    """Return slopes without what terms that cancel leave of each other in a row."""
    return np.where(np.abs(block) > CANCELLED * np.max(np.abs(block), axis=1, keepdims=True), block, 0.0)


def _find_shifts(plant: Plant, slopes: Slopes) -> dict[str, Any]:
    """Return how far states move together without a force, by name: expressions of the plant's parameters. Empty if the
    slopes have no such direction. The last state moves by 1; the ratios are solved for in symbols, from as many
    equations as there are other states.
    """
    first = slopes[0][0]
    if not all(np.all(np.isfinite(a)) for a, _, _ in slopes):
        return {}
    size = np.linalg.norm(first, axis=0)
    size[size == 0.0] = 1.0
    _, singular, turned = np.linalg.svd(first / size)
    if singular[-1] > ROUNDING * singular[0]:
        return {}
    *coupled, along = (int(i) for i in np.flatnonzero(np.abs(turned[-1]) > ROUNDING))
    names, ratios = list(plant.states), list[Any]()
    if coupled:
        # The rows that tell the ratios best: a triangle with pivots picks them.
        from scipy.linalg import qr  # deferred: scipy is slow to load

        pivots: Any = qr(first[:, coupled].T, mode="r", pivoting=True)[-1]
        rows = np.sort(pivots[: len(coupled)])
        by_state = ca.substitute(ca.jacobian(plant.dynamics, plant.x), plant.t, 0.0)
        by_state = ca.substitute(by_state, ca.vertcat(plant.x, plant.u), ca.SX.zeros(plant.x.numel() + plant.u.numel()))
        picked = by_state[rows.tolist(), :]
        ratios = ca.vertsplit(ca.simplify(-ca.solve(picked[:, coupled], picked[:, along])))
    return {**{names[i]: ratio for i, ratio in zip(coupled, ratios, strict=True)}, names[along]: ca.SX(1.0)}


def _take_out(plant: Plant, shifts: Mapping[str, Any], telling: set[str]) -> Plant:
    """Return the plant relative to the last state that drifts, without the outputs that tell where that is."""
    *coupled, along = shifts
    ratios = ca.Function("ratios", [plant.p], [ca.vertcat(*shifts.values())])

    # The equations may differentiate by their states, so that a symbol stands for this one until they are written.
    zero = ca.SX.sym(along)

    def fill(x: Any) -> SimpleNamespace:
        return SimpleNamespace(**{**vars(x), along: zero})

    there = {name: reading for name, reading in plant.followed.items() if reading.state != along}
    gone = dict.fromkeys(plant.followed.keys() - there.keys(), zero)

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
        rates = {name: settle(rate) for name, rate in plant.f(t, fill(x), with_values(u, gone), p).items()}
        together = rates.pop(along)
        values = ratios(ca.vertcat(*(getattr(p, name) for name in plant.parameters)))
        for i, name in enumerate(coupled):
            rates[name] = rates[name] - values[i] * together
        return rates

    def h(t: Any, x: Any, u: Any, p: Any) -> dict[str, Any]:
        return {
            name: settle(value)
            for name, value in plant.h(t, fill(x), with_values(u, gone), p).items()
            if name not in telling
        }

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
        followed=there,
        states={name: unit for name, unit in plant.states.items() if name != along},
        outputs={name: unit for name, unit in plant.outputs.items() if name not in telling},
        friction={name: relative(friction) for name, friction in plant.friction.items()},
    )


def add_forgetful(plant: Plant, output: str, rate: float, state: str) -> Plant:
    """Return a plant with one more state, which moves as an output does and forgets at a rate (1/s) where it is."""
    at = plant.output[list(plant.outputs).index(output)]
    speed = ca.Function("speed", [*plant.symbols], [ca.jtimes(at, plant.x, plant.dynamics)])

    def f(t: Any, x: Any, u: Any, p: Any) -> dict[str, Any]:
        vectors = (
            ca.vertcat(*(getattr(space, name) for name in names))
            for space, names in ((x, plant.states), (u, plant.inputs), (p, plant.parameters))
        )
        return {**plant.f(t, x, u, p), state: speed(t, *vectors) - rate * getattr(x, state)}

    return replace(plant, f=f, states={**plant.states, state: plant.outputs[output]})
