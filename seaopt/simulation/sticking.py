r"""Simulation of dry friction that jumps at rest, so that what sticks stands still.

A friction whose role declares its `jump` F is here the set-valued

.. math:: \lambda \in F(|v|)\,\mathrm{Sgn}(v), \qquad \mathrm{Sgn}(0) = [-1, 1],

in place of its smoothed curve.

Of a plant with one such joint, log passes step from event to event (`seaopt.simulation.events`, `step.c`), between
which the plant is smooth: the joint slides in the direction m = 1 or -1, or is held, m = 0, by the force that leaves it
no acceleration. `joint_equations` are its equations.

Closed loops, and plants with several such joints, have a step of fixed structure. It first slides on, with the sign
that the velocity has, by Runge's and Kutta's method of order four. If the velocity changes its sign in it, the step
goes to where a straight line between both velocities passes zero, and for the rest of it the force is the constant that
leaves no velocity at its end: the joint sticks. Where that takes more than F(0), the force is F(0), and the joint
slides in the other direction. To step with such a constant is Moreau's and Jean's method (Acary and Brogliato,
Numerical Methods for Nonsmooth Dynamical Systems, 2008); here it is used for no more than the rest of a step in which a
joint stops. Where it holds a joint for a whole step, the joint's place is kept as it was.

An output that contains accelerations contains the friction: at a joint that stands still the force that keeps it so.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import product
from typing import Any

import casadi as ca

from seaopt.plants import Plant
from seaopt.plants.friction import separate_friction
from seaopt.plants.memo import memo
from seaopt.plants.plant import name_symbols
from seaopt.simulation.runge_kutta import runge_kutta_step

LATEST_STOP = 0.999  # of a step: in what is left of it a force must have an effect that can be divided by
AT_ONCE = 1e-6  # of a step: a joint that stops before that is at rest
SHORTEST_S = 1e-12  # in place of a step without length, whose forces would be zero over zero
TINY = 1e-300  # beside a difference that may be zero
STILL_S = 1e-13  # a velocity that friction alone takes away in this time is rounding
SWEEPS = 30  # over the forces of several joints that stop at once


def separate_jumps(plant: Plant) -> tuple[Any, Any, Any]:
    """Return f and h without friction that jumps, and what holds each joint at rest, in the plant's symbols."""
    joints, arguments = _Joints(plant), plant.symbols
    levels = joints.levels(*arguments[1:])
    return joints.rate(*arguments, 0.0 * levels), joints.read(*arguments, 0.0 * levels), levels


@memo
def sticking_step(plant: Plant) -> ca.Function:
    """Return the CasADi function (t, x, u, p, h) -> x+ of one step with friction that jumps, u held."""
    h = ca.SX.sym("h")
    after = sticking_line_step(plant)(plant.t, plant.x, plant.u, plant.u, plant.p, h)
    return ca.Function("seaopt_step", [*plant.symbols, h], [ca.cse(after)])


@memo
def sliding_step(plant: Plant) -> ca.Function:
    """Return the CasADi function (t, x, u, p, h) -> (x+, stops) of a step in which all joints slide on, as the first
    part of `sticking_step`: where one stops, which `stops` tells, that step ends elsewhere.
    """
    joints, h = _Joints(plant), ca.SX.sym("h")
    t, x, u, p = plant.symbols
    signs = joints.signs(t, x, u, p)
    end = runge_kutta_step(lambda t, x: joints.rate(t, x, u, p, joints.slide(x, u, p, signs)), t, x, h)
    stops = ca.mmax(signs * joints.speeds(end, p) <= 0.0)
    ends: Any = ca.cse([ca.densify(end), ca.densify(stops)])
    return ca.Function("seaopt_slide", [*plant.symbols, h], ends)


@memo
def sticking_line_step(plant: Plant) -> ca.Function:
    """Return the CasADi function (t, x, u0, u1, p, h) -> x+ of one step, u a straight line from u0 to u1."""
    joints = _Joints(plant)
    t, x, u0, p, length = plant.t, plant.x, plant.u, plant.p, ca.SX.sym("h")
    u1, h = ca.SX.sym("u1", u0.numel()), length + ca.if_else(length > 0.0, 0.0, SHORTEST_S)
    before = joints.speeds(x, p)
    signs = joints.signs(t, x, u0, p)

    # Of the place s in the step, from 0 to 1, so that nothing is divided by its length.
    def find_input(s: Any) -> Any:
        return u0 + s * (u1 - u0)

    def slide(s: Any, x: Any, change: Callable[[Any], Any] = lambda force: force) -> Any:
        u = find_input(s)
        return h * joints.rate(t + s * h, x, u, p, change(joints.slide(x, u, p, signs)))

    end = runge_kutta_step(slide, 0.0, x, 1.0)
    after = joints.speeds(end, p)
    stops = signs * after <= 0.0
    shares = ca.if_else(stops, ca.fmin(ca.fabs(before) / (ca.fabs(before - after) + TINY), LATEST_STOP), 1.0)
    share = ca.mmin(shares)
    # A joint that stops later is found by the next step; not so beside one at rest, which ends every step at its start.
    first = stops * ca.if_else(share < AT_ONCE, 1.0, shares <= share)
    middle = runge_kutta_step(slide, 0.0, x, share)

    def hold(forces: Any) -> Any:
        stopping = partial(slide, change=lambda sliding: ca.if_else(first, forces, sliding))
        return runge_kutta_step(stopping, share, middle, 1.0 - share)

    levels = joints.levels(middle, find_input(share), p)
    free, pushed = hold(0.0 * levels), [hold(force) for force in _push_each(levels)]
    speeds, limits = joints.speeds(free, p), ca.if_else(levels > 0.0, 1.0, 0.0)
    effects = ca.horzcat(*(speeds - joints.speeds(each, p) for each in pushed))
    forces = _find_holding(speeds, effects, first, limits)
    stopped = free + ca.mtimes(ca.horzcat(*(each - free for each in pushed)), forces)
    # One force for a step leaves no velocity at its end, but some within it: what it holds all along does not move.
    held = first * (share < AT_ONCE) * (ca.fabs(forces) < limits)
    rate_of = joints.rate(t, x, u0, p, ca.SX.sym("force", levels.numel()))
    rates, velocities = ca.vertsplit(rate_of), ca.vertsplit(joints.speeds(x, p))
    for (state, rate), (joint, speed) in product(enumerate(rates), enumerate(velocities)):
        if _moves_with(rate, speed, x):
            stopped[state] = ca.if_else(held[joint], x[state], stopped[state])
    return ca.Function("step", [t, x, u0, u1, p, length], [ca.densify(ca.if_else(ca.mmax(stops), stopped, end))])


@memo
def sticking_output(plant: Plant) -> ca.Function:
    """Return the CasADi function (t, x, u, p) -> y of a plant with friction that jumps."""
    joints = _Joints(plant)
    t, x, u, p = plant.symbols
    speeds, levels = joints.speeds(x, p), joints.levels(x, u, p)
    slide = joints.slide(x, u, p, joints.signs(t, x, u, p))
    push = joints.accelerate(t, x, u, p, 0.0 * levels)
    effects = ca.horzcat(*(push - joints.accelerate(t, x, u, p, force) for force in _push_each(levels)))
    still = ca.fabs(speeds) <= STILL_S * ca.fabs(ca.diag(effects))
    free = joints.accelerate(t, x, u, p, ca.if_else(still, 0.0, slide))
    limits = ca.if_else(levels > 0.0, 1.0, 0.0)
    holding = _find_holding(free, effects, still, limits) * ca.if_else(levels > 0.0, levels, 1.0)
    y = joints.read(t, x, u, p, ca.if_else(still, holding, slide))
    return ca.Function("output", [t, x, u, p], [ca.densify(y)])


def has_one_joint(plant: Plant) -> bool:
    """Tell whether one friction of a plant sticks, so that passes go from event to event."""
    return sum(friction.jumps for friction in plant.friction.values()) == 1


@memo
def joint_equations(plant: Plant) -> tuple[Any, Any, Any, Any]:
    """Return the mode m of a plant's one joint, f with it, [v, holding force, F(0)], and what a force adds to f. All
    are expressions of the plant's own symbols, and of m: 1 or -1 where the joint slides that way, 0 where it is held.
    """
    joints, mode, force = _Joints(plant), ca.SX.sym("mode"), ca.SX.sym("force")
    t, x, u, p = plant.symbols
    level = joints.levels(x, u, p)
    free = joints.accelerate(t, x, u, p, 0.0)
    holding = free / (free - joints.accelerate(t, x, u, p, 1.0))
    sliding = joints.slide(x, u, p, mode)
    f = joints.rate(t, x, u, p, ca.if_else(mode == 0.0, holding, sliding))
    effect = ca.jacobian(joints.rate(t, x, u, p, force), force)
    return mode, f, ca.vertcat(joints.speeds(x, p), holding, level), ca.densify(effect)


class _Joints:
    """The frictions of a plant that declare their jump, and its equations with their forces as an argument."""

    def __init__(self, plant: Plant) -> None:
        self.plant = plant
        self.jumps = [(force.jump, force.add_loads) for force in plant.friction.values() if force.jump and force.jumps]
        equations, spaces = separate_friction(plant), name_symbols(plant, *plant.symbols[1:])
        chosen: list[Any] = []
        velocities: list[Any] = []
        forces, every = ca.vertsplit(equations.forces), ca.vertsplit(equations.velocities)
        f, h = equations.f, equations.h
        for force, velocity, friction in zip(forces, every, plant.friction.values(), strict=True):
            if friction.jumps:
                chosen.append(force)
                velocities.append(velocity)
            else:  # its curve is all there is
                curve = friction.force_at(*spaces)
                f, h = ca.substitute(f, force, curve), ca.substitute(h, force, curve)
        state, arguments = [plant.x, plant.p], [*plant.symbols, ca.vertcat(*chosen)]
        speeds = ca.vertcat(*velocities)
        self.speeds = ca.Function("speeds", state, [speeds])
        self.rate = ca.Function("rate", arguments, [f])
        self.read = ca.Function("read", arguments, [h])
        self.accelerate = ca.Function("accelerate", arguments, [ca.jtimes(speeds, plant.x, f)])

    def slide(self, x: Any, u: Any, p: Any, signs: Any) -> Any:
        """Return the forces of joints that slide in the directions `signs`."""
        return signs * self._levels(ca.fmax(signs * self.speeds(x, p), 0.0), x, u, p)

    def signs(self, t: Any, x: Any, u: Any, p: Any) -> Any:
        """Return the directions in which the joints slide: of one at rest, that in which it is pushed."""
        speeds = self.speeds(x, p)
        pushed = ca.if_else(self.accelerate(t, x, u, p, 0.0 * speeds) >= 0.0, 1.0, -1.0)
        return ca.if_else(speeds > 0.0, 1.0, ca.if_else(speeds < 0.0, -1.0, pushed))

    def levels(self, x: Any, u: Any, p: Any) -> Any:
        """Return what holds each joint at rest."""
        return self._levels(ca.SX.zeros(len(self.jumps)), x, u, p)

    def _levels(self, speeds: Any, x: Any, u: Any, p: Any) -> Any:
        spaces = name_symbols(self.plant, x, u, p)
        pairs = zip(self.jumps, ca.vertsplit(speeds), strict=True)
        return ca.vertcat(*(ca.SX(jump(speed, add_loads(*spaces))) for (jump, add_loads), speed in pairs))


def _moves_with(rate: Any, speed: Any, x: Any) -> bool:
    """Tell whether a state's rate is in proportion to a joint's speed: both are to the same one state."""
    needed = [ca.which_depends(each, x, 1) for each in (rate, speed)]
    if needed[0] != needed[1] or sum(needed[0]) != 1:
        return False
    alone = x[needed[0].index(True)]
    return all(
        not any(ca.which_depends(each, alone, 2)) and ca.substitute(each, alone, 0.0).is_zero()
        for each in (rate, speed)
    )


def _push_each(levels: Any) -> list[Any]:
    """Return the forces of which each pushes one joint, by its level or, where that is zero, by one."""
    return ca.horzsplit(ca.diag(ca.if_else(levels > 0.0, levels, 1.0)))


def _find_holding(speeds: Any, effects: Any, stopped: Any, limits: Any) -> Any:
    """Return the forces (in their units) that stop the joints in `stopped`, or their limits; the others' are zero.
    `speeds` are those without them, `effects` [i, j] what a unit of force j takes from speed i. Of several joints each
    is solved in turn, by Gauss' and Seidel's projected sweeps.
    """
    count = speeds.numel()
    forces: list[Any] = [ca.SX(0.0)] * count
    for _ in range(SWEEPS if count > 1 else 1):
        for i in range(count):
            left = speeds[i] - sum(effects[i, j] * forces[j] for j in range(count) if j != i)
            effect = ca.if_else(stopped[i], effects[i, i], 1.0)
            forces[i] = ca.if_else(stopped[i], ca.fmin(ca.fmax(left / effect, -limits[i]), limits[i]), 0.0)
    return ca.vertcat(*forces)
