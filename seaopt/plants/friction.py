"""Friction as a linear loop meets it: stuck, where its curve is steepest, and sliding, where it is flattest.

Dry friction smoothed through zero, f_c tanh(v/v_s), looks at rest like a damper of f_c/v_s, which vanishes as soon as
the joint moves; Stribeck's falling part is then even a negative one. A loop is therefore looked at on two plants that
are linear in that velocity: with every friction replaced by viscous friction of its steepest and of its flattest slope.
They have the names, roles and parameters of the plant they stand for, so that all that works on a plant works on them.
No motion keeps to the speed at which a curve falls the steepest: a third plant is flat there, as where it slides fast.

A friction with bristles (LuGre's, a spring's hysteresis) is a spring where it sticks, of the stiffness sigma_0 beside
the damping sigma_1. It may stick while others slide, as a spring does behind a motor that moves: each is looked at in
either state, and those that are curves of the velocity together.

A force that is a wave of a position (cogging) has any slope from -n a to n a at rest, by where the motor stands, which
no model knows; over many waves it has none. Sliding it is left out. Stuck it is what dry friction leaves of it, a
spring of n (a - f_c) as in the well where the motor comes to rest; friction that holds more than the wave pushes holds
it anywhere. What it does on its crests, and to a motion of about a wave, only simulations show.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import replace
from functools import partial
from itertools import product
from typing import Any

import casadi as ca
import numpy as np
from jaxtyping import Float

from seaopt.errors import PlantError
from seaopt.parameters import ParameterSet
from seaopt.plants.memo import memo
from seaopt.plants.plant import (
    CompletedParameters,
    Plant,
    extend,
    jacobians,
    name_parameters,
    name_symbols,
    state_space,
)
from seaopt.plants.roles import Bristles, Friction, Reading, change_ports, with_values
from seaopt.records import record
from seaopt.signals import VectorN

SLIDING, STUCK, FAST = "sliding", "stuck", "sliding fast"
STATES = (SLIDING, STUCK)
# Speeds at which a curve that does not state its slopes is looked at, m/s or rad/s.
SAMPLED_SPEEDS = np.concatenate([[0.0], np.geomspace(1e-7, 1e3, 201)])
SMOOTHED = 10.0  # times the speed of its smoothing a curve is what it smooths
LOW_SPEED = 1.0  # m/s or rad/s: up to here a curve shows its dry friction
FLAT = 1e-6  # of a curve's steepest slope, that is rounding
LEAST_SIZE = 1e-15  # N or N m: of a wave
FORGETTING = 1.0  # rad/s: by which bristles of a linear plant go back; nothing depends on them there


def bound_slopes(friction: Friction, p: Any) -> tuple[Any, Any]:
    """Return the flattest and the steepest slope of a friction curve at parameters p, numbers or expressions. They are
    what the role states; else the least and largest at `SAMPLED_SPEEDS` in both directions.
    """
    p = friction.add_rated(p)
    if friction.slopes is not None:
        return friction.slopes(p)
    v = ca.SX.sym("v")
    slope = ca.jacobian(ca.SX(friction.force(v, p)), v)
    sampled = [ca.substitute(slope, v, float(sign * speed)) for speed in SAMPLED_SPEEDS for sign in (1.0, -1.0)]
    return ca.mmin(ca.vertcat(*sampled)), ca.mmax(ca.vertcat(*sampled))


def friction_slopes(plant: Plant, params: ParameterSet) -> tuple[Float[np.ndarray, " p"], Float[np.ndarray, " p"]]:
    """Return the flattest and the steepest slope of each friction of a plant, in the order of its roles."""
    p = plant.complete(params).by_attribute
    bounds = [[float(ca.DM(bound)) for bound in bound_slopes(friction, p)] for friction in plant.friction.values()]
    flattest, steepest = np.reshape(np.array(bounds, dtype=float), (-1, 2)).T
    return flattest, steepest


def name_slope_unit(plant: Plant) -> str:
    """Return the unit of the slopes of a plant's friction; empty where it has none."""
    return " or ".join(dict.fromkeys(friction.slope_unit for friction in plant.friction.values()))


def find_dry_friction(plant: Plant, params: CompletedParameters) -> dict[str, float]:
    """Return the effort at the spring that each dry friction takes, by name; what is linear in its velocity is not dry.
    It is the largest force at low speeds, less viscous friction of the flattest slope.
    """
    p = params.by_attribute
    efforts: dict[str, float] = {}
    slopes = zip(*friction_slopes(plant, params), strict=True)
    for (name, friction), (flattest, steepest) in zip(plant.friction.items(), slopes, strict=True):
        if flattest != steepest:
            viscous = max(float(flattest), 0.0)
            rated = friction.add_rated(p)
            speeds = [sign * speed for speed in _list_low_speeds(friction, params) for sign in (1.0, -1.0)]
            level = max(abs(float(friction.force(speed, rated)) - viscous * speed) for speed in speeds)
            efforts[name] = abs(float(friction.effort(p))) * level
    return efforts


def find_breakaway(plant: Plant, params: CompletedParameters) -> float:
    """Return the effort at the spring that is needed to let every joint that can stick slide, N or N m. It is the
    largest force of each friction that declares its jump, at low speeds.
    """
    p = params.by_attribute
    return sum(
        abs(float(friction.effort(p)))
        * max(float(friction.jump(speed, friction.add_rated(p))) for speed in _list_low_speeds(friction, params))
        for friction in plant.friction.values()
        if friction.jump is not None
    )


def _list_low_speeds(friction: Friction, params: CompletedParameters) -> list[float]:
    """Return the speeds up to `LOW_SPEED`, or as far as the smoothing reaches, that of a motor before its gear."""
    smoothed = SMOOTHED * params[friction.smoothing].value if friction.smoothing is not None else 0.0
    return [float(speed) for speed in SAMPLED_SPEEDS if speed <= max(LOW_SPEED, smoothed)]


def find_locked_modes(plant: Plant, params: ParameterSet) -> VectorN:
    """Return the frequencies (Hz) at which the plant swings at rest while every joint that can stick does so. With A of
    the sliding plant, B the effect of the friction forces and C the rows of their velocities, a force that keeps C x at
    zero leaves A - B (C B)^-1 C A. Where bristles hold it, the plant is the stuck one.
    """
    a = state_space(friction_states(plant)[SLIDING if can_stick(plant) else STUCK], params)[0]
    if can_stick(plant):
        at = np.zeros(len(plant.states)), np.zeros(len(plant.inputs)), plant.complete(params).vector
        effects, _, rows = (np.array(block) for block in friction_matrices(plant)(*at))
        sticks = [friction.jumps for friction in plant.friction.values()]
        effects, rows = effects[:, sticks], rows[sticks]
        a = a - effects @ np.linalg.solve(rows @ effects, rows @ a)
    poles = np.linalg.eigvals(a)
    return np.sort(np.abs(poles[np.imag(poles) > 0.0])) / (2 * np.pi)


@memo
def friction_states(plant: Plant) -> Mapping[str, Plant]:
    """Return the plant with every friction at its flattest slope and at its steepest, as "sliding" and "stuck". Beside
    others a friction with bristles is in either state by itself: "NAME stuck" is where it sticks alone. The sliding
    plant is the first.
    """
    bristled = _list_bristles(plant)
    curves = [name for name in plant.friction if name not in bristled]
    groups = [*([curves] if curves else []), *([name] for name in bristled)]
    states: dict[str, Plant] = {}
    for choice in product((False, True), repeat=len(groups)):
        sticking = tuple(name for group, sticks in zip(groups, choice, strict=True) if sticks for name in group)
        state = STUCK if all(choice) else f"{' and '.join(sticking)} {STUCK}" if any(choice) else SLIDING
        states[state] = _with_slopes(plant, state, sticking)
    return states


@memo
def leave_out_waves(plant: Plant) -> Plant:
    """Return the plant without forces that are waves of a position, as one has it that moves over many of them."""
    if not plant.followed:
        return plant
    return extend(plant, find_parameters=_flatten(plant), ports=change_ports(plant.ports, leave_out_waves))


def _flatten(plant: Plant) -> Callable[[Any], Any]:
    """Return what makes the sizes of a plant's waves zero among parameters."""
    sizes = dict.fromkeys((size for reading in plant.followed.values() for size in reading.sizes), 0.0)
    return lambda p: with_values(p, sizes) if sizes else p


def _steepest_wave(plant: Plant, reading: Reading, p: Any) -> Any:
    """Return the steepest slope of a wave beyond what friction holds; its derivative by the sizes is zero where they
    are.
    """
    friction, size = plant.friction[reading.friction], sum(getattr(p, name) ** 2 for name in reading.sizes)
    jump = 0.0 if friction.jump is None else friction.jump(0.0, friction.add_rated(p))
    return getattr(p, reading.wave) * ca.fmax(ca.sqrt(size + LEAST_SIZE**2) - jump, 0.0)


def split_friction(plants: Mapping[str, Plant], params: ParameterSet, varied: Collection[str] = ()) -> dict[str, Plant]:
    """Return the plants, one with friction in each of its states, as NAME sliding and NAME stuck (`name_states`)."""
    return {
        label: friction_states(plants[name])[state] if state else plants[name]
        for label, (name, state) in name_states(plants, params, varied).items()
    }


def name_states(
    plants: Mapping[str, Plant], params: ParameterSet, varied: Collection[str] = ()
) -> dict[str, tuple[str, str]]:
    """Return plant and state of friction, "" without, behind each name of `split_friction`. `params`: a plant whose
    friction is nothing there has none. `varied`: parameters that may take other values: friction that depends on one of
    them is there.
    """
    return {
        (f"{name} {state}" if state else name): (name, state)
        for name, plant in plants.items()
        for state in (friction_states(plant) if has_friction(plant, params, varied) else ("",))
    }


def take_sliding(plant: Plant, params: ParameterSet) -> Plant:
    """Return the sliding plant where there is friction, else the plant itself."""
    return next(iter(split_friction({"": plant}, params).values()))


@memo
def slide_fast(plant: Plant) -> Plant:
    """Return the sliding plant where no friction falls with the speed any more: flat in place of a falling slope."""
    return _with_slopes(plant, FAST, ())


def falls(plant: Plant, params: ParameterSet) -> bool:
    """Tell whether a friction falls with the speed somewhere, and no more at high speed, as Stribeck's does."""
    p, v = plant.complete(params).by_attribute, ca.SX.sym("v")
    for friction in plant.friction.values():
        slope = ca.Function("slope", [v], [ca.jacobian(ca.SX(friction.force(v, friction.add_rated(p))), v)])
        slopes = np.array(slope(np.outer([-1.0, 1.0], SAMPLED_SPEEDS).reshape(1, -1))).reshape(2, -1)
        if np.min(slopes) < -FLAT * np.max(np.abs(slopes)) <= np.min(slopes[:, -1]):
            return True
    return False


def can_stick(plant: Plant) -> bool:
    """Tell whether a plant has a friction that can be simulated as a jump at rest."""
    return any(friction.jumps for friction in plant.friction.values())


def can_hold(plant: Plant) -> bool:
    """Tell whether friction can hold a joint at rest: one that jumps there, or one with bristles."""
    return can_stick(plant) or remembers(plant)


def remembers(plant: Plant) -> bool:
    """Tell whether a plant has a friction with bristles, whose force depends on what was before."""
    return bool(_list_bristles(plant))


def _list_bristles(plant: Plant) -> dict[str, Bristles]:
    return {name: friction.bristles for name, friction in plant.friction.items() if friction.bristles is not None}


def list_smoothing(plant: Plant) -> tuple[str, ...]:
    """Return the parameters that are speeds over which a simulated friction is smoothed: not that of bristles."""
    frictions = (friction for friction in plant.friction.values() if friction.bristles is None)
    return tuple(dict.fromkeys(friction.smoothing for friction in frictions if friction.smoothing is not None))


def let_stick(plant: Plant) -> Plant:
    """Return the plant with friction that sticks: simulated and fitted as it jumps at rest, not as its smoothed curve.

    A joint that friction holds then stands still, where the smoothed curve lets it creep. The speed of the smoothing
    no longer does anything in simulation and fit; linear analysis goes on with the smoothed curve.

    Raises
    ------
    PlantError
        No friction of the plant declares its jump.

    Examples
    --------
    >>> import numpy as np
    >>> import seaopt as so
    >>> plant, params = so.plants.high_impedance(), so.plants.thor().update(f_c=300.0)
    >>> log = so.Log.from_arrays(time=np.arange(2000) / 1000, I=np.ones(2000))  # 1 A is 240 N
    >>> bool(abs(so.simulate(so.plants.let_stick(plant), params, log)["F1"][-1]) < 1e-12)
    True
    >>> round(float(so.simulate(plant, params, log)["F1"][-1]))  # smoothed, it creeps on towards 240 N
    237
    """
    if not can_stick(plant) and remembers(plant):
        raise PlantError(
            f"plant {plant.name} has friction with bristles (part lugre), which sticks by itself; leave out "
            "sticks = true, or the part"
        )
    if not can_stick(plant):
        raise PlantError(
            f"plant {plant.name} has no friction that sticks; declare its jump where the plant is made: "
            "friction={NAME: Friction(..., jump=lambda speed, p: ...)}"
        )
    return replace(plant, sticks=True)


def has_friction(plant: Plant, params: ParameterSet, varied: Collection[str] = ()) -> bool:
    """Tell whether a plant's friction, and the waves that hold it as friction does, differ from stuck to sliding."""
    if not plant.friction:
        return False
    values = plant.complete(params)
    flattest, steepest = friction_slopes(plant, values)
    holds = bool(np.any(flattest != steepest)) or any(find_bristle_stiffness(plant, values))
    waves = any(values[size].value for reading in plant.followed.values() for size in reading.sizes)
    return holds or waves or bool(list_friction_parameters(plant) & set(varied))


def find_bristle_stiffness(plant: Plant, params: ParameterSet) -> list[float]:
    """Return the stiffness of each friction's bristles, zero without any."""
    p = plant.complete(params).by_attribute
    bristles = _list_bristles(plant)
    return [float(bristles[name].stiffness(p)) if name in bristles else 0.0 for name in plant.friction]


@memo
def remove_friction(plant: Plant) -> Plant:
    """Return the plant as it moves at speed, where dry friction no longer changes with the velocity."""
    friction = {name: _take_viscous(friction, lambda p: 0.0) for name, friction in plant.friction.items()}
    return replace(plant, name=f"{plant.name} at speed", friction=friction)


def _take_viscous(friction: Friction, slope: Callable[[Any], Any]) -> Friction:
    """Return friction of one slope, an expression of p, with the velocity and effort of another."""
    return replace(
        friction,
        force=lambda v, p: slope(p) * v,
        slopes=lambda p: (slope(p),) * 2,
        jump=None,
        loads=None,
        rated={},
        bristles=None,
    )


@memo
def list_friction_parameters(plant: Plant) -> frozenset[str]:
    """Return the parameters on which dry friction depends, by the difference of its slopes."""
    p = name_parameters(plant, plant.p)
    bounds = [bound_slopes(friction, p) for friction in plant.friction.values()]
    spans = [ca.SX(steepest - flattest) for flattest, steepest in bounds]
    spans += [ca.SX(bristles.stiffness(p)) for bristles in _list_bristles(plant).values()]
    spans += [ca.SX(_steepest_wave(plant, reading, p)) for reading in plant.followed.values()]
    return frozenset(_list_parameters(plant, ca.vertcat(*spans)))


def list_fall_parameters(plant: Plant, friction: Friction) -> tuple[str, ...]:
    """Return the parameters of a plant on which the flattest slope of one of its frictions depends."""
    flattest, _ = bound_slopes(friction, name_parameters(plant, plant.p))
    return _list_parameters(plant, ca.SX(flattest))


def _list_parameters(plant: Plant, expression: ca.SX) -> tuple[str, ...]:
    """Return the parameters on which an expression depends."""
    symbols = zip(plant.parameters, ca.vertsplit(plant.p), strict=True)
    return tuple(name for name, symbol in symbols if ca.depends_on(expression, symbol))


def _with_slopes(plant: Plant, state: str, sticking: Collection[str]) -> Plant:
    """Return the plant with viscous friction in the place of each curve, and springs for what holds where it sticks."""
    bristled = _list_bristles(plant)

    def choose_slope(name: str, friction: Friction, p: Any) -> Any:
        if name not in sticking:
            flattest = bound_slopes(friction, p)[0]
            return ca.fmax(flattest, 0.0) if state == FAST else flattest
        return bristled[name].damping(p) if name in bristled else bound_slopes(friction, p)[1]

    def hold(x: Any, u: Any, p: Any) -> Any:
        forces = {name: getattr(u, name) for name in sticking}
        for name in bristled.keys() & forces.keys():
            forces[name] += bristled[name].stiffness(p) * bristled[name].coordinate(x, p)
        for reading in plant.followed.values():
            if reading.friction in forces:
                forces[reading.friction] += _steepest_wave(plant, reading, p) * getattr(x, reading.state)
        readings = {name: getattr(x, reading.state) for name, reading in plant.followed.items()}
        return with_values(u, {**forces, **readings})

    def forget(t: Any, x: Any, u: Any, p: Any) -> Mapping[str, Any]:
        return {
            bristles.state: plant.friction[name].velocity(x, p) - FORGETTING * getattr(x, bristles.state)
            for name, bristles in bristled.items()
        }

    return extend(
        plant,
        find_inputs=hold,
        find_parameters=_flatten(plant),
        rates=forget,
        name=f"{plant.name} {state}",
        ports=change_ports(plant.ports, _choose_state, state),
        followed={},
        friction={
            name: _take_viscous(friction, partial(choose_slope, name, friction))
            for name, friction in plant.friction.items()
        },
    )


def _choose_state(plant: Plant, state: str) -> Plant:
    return slide_fast(plant) if state == FAST else friction_states(plant)[state]


@record(eq=False)
class SeparatedFriction:
    """A plant's equations with its friction forces as symbols: f, h, the forces, the velocities that they oppose."""

    f: Any
    h: Any
    forces: Any
    velocities: Any


@memo
def separate_friction(plant: Plant) -> SeparatedFriction:
    """Return the equations in the plant's own symbols t, x, u and p, and one symbol for each friction force."""
    forces = {name: ca.SX.sym(name) for name in plant.friction}
    x, u, p = name_symbols(plant, *plant.symbols[1:])
    for name, symbol in forces.items():
        setattr(u, name, symbol)
    f, h = plant.f(plant.t, x, u, p), plant.h(plant.t, x, u, p)
    return SeparatedFriction(
        f=ca.vertcat(*(ca.SX(f[name]) for name in plant.states)),
        h=ca.vertcat(*(ca.SX(h[name]) for name in plant.outputs)),
        forces=ca.vertcat(*forces.values()),
        velocities=ca.vertcat(*(ca.SX(friction.velocity(x, p)) for friction in plant.friction.values())),
    )


@memo
def friction_matrices(plant: Plant) -> Any:
    """Return the CasADi function (x, u, p) -> (effect of each friction force on f, on h; velocities' rows), at t = 0.
    The effects are those of a force in the direction of its velocity, shapes (nx, p) and (ny, p); the rows are
    derivatives of the velocities by the states, shape (p, nx).
    """
    equations = separate_friction(plant)
    effects = [
        -ca.jacobian(ca.substitute(block, plant.t, 0.0), equations.forces) for block in (equations.f, equations.h)
    ]
    blocks = [ca.densify(block) for block in (*effects, ca.jacobian(equations.velocities, plant.x))]
    return ca.Function("friction", plant.symbols[1:], blocks)


@memo
def rest_jacobians(plant: Plant) -> Any:
    """Return the CasADi function (x, u, p) -> (A, B, C, D) at rest, where bristles stick and are not bent. A deflection
    follows its coordinate from the rest on. Linearised as it is it would be a mode that nothing moves and nothing
    damps; the stuck plant's own rest is another, where bristles bend all the way from a coordinate of zero.
    """
    if not remembers(plant):
        return jacobians(plant)
    equations = separate_friction(plant)
    x, _, p = name_symbols(plant, *plant.symbols[1:])
    stuck, rates = friction_states(plant)[STUCK], ca.SX(equations.f)
    velocities = dict(zip(plant.friction, ca.vertsplit(equations.velocities), strict=True))
    bend = dict.fromkeys(plant.friction, ca.SX(0))
    for name, bristles in _list_bristles(plant).items():
        bend[name] = bristles.stiffness(p) * bristles.coordinate(x, p)
        rates[list(plant.states).index(bristles.state)] = velocities[name] - FORGETTING * getattr(x, bristles.state)
    forces = [stuck.friction[name].force(velocities[name], p) + bend[name] for name in plant.friction]
    by_state = ca.jacobian(ca.vertcat(*forces), plant.x)
    blocks: list[Any] = []
    for block in (rates, equations.h):
        blocks.append(ca.jacobian(block, plant.x) + ca.jacobian(block, equations.forces) @ by_state)
        blocks.append(ca.jacobian(block, plant.u))
    nothing = ca.SX.zeros(*equations.forces.shape)
    still = ca.substitute(ca.substitute(blocks, [equations.forces], [nothing]), [plant.t], [ca.SX(0)])
    return ca.Function("jacobians", plant.symbols[1:], [ca.densify(block) for block in still])
