"""The checks of a plant when it is made: names and units, equations, roles, bristles, structure."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np

from seaopt.errors import PlantError, suggestion
from seaopt.parameters import Parameter
from seaopt.plants.roles import Friction
from seaopt.units import DIMENSIONLESS, si_unit

if TYPE_CHECKING:
    from seaopt.plants.plant import Plant

ENERGY = "energy"  # among the outputs of a simulation, what the plant stores (J)
# Units that need no look-up, products and quotients of SI's: asking pint takes half a second the first time.
_ATOM = r"(?:m|s|kg|N|A|rad|V|K|J|W|Hz|ohm)(?:\^\d)?"
_PRODUCT = rf"{_ATOM}(?: {_ATOM})*"
PLAIN_UNIT = re.compile(rf"degC|(?:1|{_PRODUCT})(?:/(?:{_ATOM}|\({_PRODUCT}\)))*")


def evaluate_equations(
    plant: Plant, what: str, equations: Callable[..., Mapping[str, Any]], *arguments: Any
) -> Mapping[str, Any]:
    """Return what f or h gives; a name that it uses and that is not there is a PlantError."""
    try:
        return equations(*arguments)
    except AttributeError as error:
        if not isinstance(error.obj, SimpleNamespace):
            raise
        raise PlantError(
            f'{what} uses "{error.name}"; {suggestion(str(error.name), vars(error.obj))}', plant=plant.name
        ) from error
    except (TypeError, RuntimeError, NotImplementedError) as error:
        reason = str(error).strip().splitlines()[-1][:160]
        raise PlantError(
            f"{what} cannot be made symbolic ({reason}); use CasADi's functions, and ca.if_else for a branch",
            plant=plant.name,
        ) from error


def check_names(plant: Plant) -> None:
    """Refuse names that are no identifiers or are used twice, and units that are missing or unknown."""
    for group in ("states", "inputs", "outputs", "parameters"):
        if not isinstance(getattr(plant, group), Mapping):
            raise PlantError(f"{group} is no mapping; give {{name: unit}}", plant=plant.name)
        for name, declared in getattr(plant, group).items():
            unit = declared.unit if isinstance(declared, Parameter) else declared
            if not isinstance(unit, str) or (group == "parameters" and not unit.strip()):
                raise PlantError(f'"{name}" in {group} has no unit; give one, "-" for a pure number', plant=plant.name)
            if unit.strip() not in DIMENSIONLESS and not PLAIN_UNIT.fullmatch(unit):
                si_unit(unit)
    seen: dict[str, str] = {}
    for group in ("states", "inputs", "parameters", "friction"):
        for name in getattr(plant, group):
            if not name.isidentifier():
                raise PlantError(f'"{name}" in {group} is not a name; use letters, digits and _', plant=plant.name)
            if name in seen:
                raise PlantError(f'"{name}" is in {seen[name]} and in {group}; rename one', plant=plant.name)
            seen[name] = group
    if ENERGY in plant.outputs:
        raise PlantError(
            f'the output "{ENERGY}" has the name of the simulated energy (J); rename the output, '
            "and give energy=lambda x, p: ... where it is what the plant stores",
            plant=plant.name,
        )
    unknown = sorted(plant.optional_inputs - set(plant.inputs))
    if unknown:
        raise PlantError(f"optional input {unknown[0]} is not an input; add it to inputs", plant=plant.name)


def check_loads(plant: Plant, name: str, friction: Friction, spaces: list[SimpleNamespace]) -> None:
    """Refuse loads of a friction that are not rated, or that have a parameter's name."""
    loads = list(friction.loads(*spaces)) if friction.loads is not None else []
    if sorted(loads) != sorted(friction.rated):
        rated = ", ".join(friction.rated) or "none"
        raise PlantError(
            f"friction {name} has the loads {', '.join(loads) or 'none'}, and rated has {rated}; "
            "give the largest size of each load in rated",
            plant=plant.name,
        )
    taken = [load for load in loads if load in plant.parameters]
    if taken:
        raise PlantError(f'load "{taken[0]}" of friction {name} is a parameter; name it otherwise', plant=plant.name)


# What the fields of a role name.
_REFERENCES: Mapping[str, Mapping[str, str]] = {
    "actuation": {"input": "inputs", "efficiency": "parameters"},
    "sensing": {"regulated": "outputs", "from_encoders": "outputs"}
    | dict.fromkeys(("motor_position", "motor_speed", "link_position"), "signals"),
    "spring": {"stiffness": "parameters", "play": "parameters", "mass": "figures", "damping": "figures"},
    "port": {"motion": "outputs", "effort": "inputs", "payload": "parameters"}
    | dict.fromkeys(("coordinate", "rate", "drive"), "states"),
    "friction": {"smoothing": "parameters"},
    "bristles": {"state": "states"},
    "mode": {"parameter": "parameters", "state": "states"},
    "winding": {"rises": "states", "temperatures": "outputs"},
}


def check_roles(plant: Plant) -> None:
    """Refuse a role that names what the plant does not have."""
    groups: dict[str, Mapping[str, Any]] = {
        name: getattr(plant, name) for name in ("inputs", "outputs", "states", "parameters")
    }
    groups |= {"signals": {**plant.outputs, **plant.states}, "figures": plant.derived_values()}
    roles = [(kind, kind, getattr(plant, kind)) for kind in ("actuation", "sensing", "spring", "mode", "winding")]
    roles += [("port", "port", port) for port in plant.ports]
    for name, friction in plant.friction.items():
        roles += [
            ("friction", f"friction.{name}", friction),
            ("bristles", f"friction.{name}.bristles", friction.bristles),
        ]
    for kind, key, role in roles:
        for field, group in _REFERENCES[kind].items():
            stated = getattr(role, field, None) or ()
            for name in (stated,) if isinstance(stated, str) else stated:
                if name not in groups[group]:
                    raise PlantError(
                        f'{key}.{field} = "{name}" is not one of its own; {suggestion(name, groups[group])}',
                        plant=plant.name,
                    )
    if plant.actuation is not None and plant.actuation.input != next(iter(plant.inputs)):
        raise PlantError(
            f'actuation.input = "{plant.actuation.input}" is not the first input; put it first', plant=plant.name
        )


def check_bristles(plant: Plant, spaces: list[SimpleNamespace]) -> None:
    """Refuse bristles that `f` contradicts, at one point: in their rate, or in that of their coordinate."""
    x, u, p = spaces
    for name, friction in plant.friction.items():
        bristles = friction.bristles
        if bristles is None:
            continue
        slip, speed = ca.SX(friction.find_rate(x, u, p)), ca.SX(friction.velocity(x, p))
        moves = ca.jtimes(ca.SX(bristles.coordinate(x, p)), plant.x, plant.dynamics)
        stated = plant.dynamics[list(plant.states).index(bristles.state)]
        rng = np.random.default_rng(0)
        values = [rng.uniform(0.5, 1.5, symbol.shape[0]) for symbol in plant.symbols]
        rates = map(float, ca.Function("bristles", plant.symbols, [stated, slip, moves, speed]).call(values))
        for message in (
            f'f gives "{bristles.state}" another rate than bristles.rate; use the same in both',
            "the rate of bristles.coordinate is not the velocity; give the coordinate it belongs to",
        ):
            rate, expected = next(rates), next(rates)
            if abs(rate - expected) > 1e-6 * max(abs(rate), abs(expected)):  # what is not finite there is not judged
                raise PlantError(f"friction {name}: {message} ({rate:.6g} against {expected:.6g})", plant=plant.name)


def stack_rows(plant: Plant, what: str, equations: Mapping[str, Any], names: Mapping[str, str]) -> Any:
    """Return the expressions in the order of `names`, refusing missing and unknown ones."""
    if not isinstance(equations, Mapping):
        raise PlantError(f"{what} returns a {type(equations).__name__}; give {{name: expression}}", plant=plant.name)
    for name in equations:
        if name not in names:
            raise PlantError(f'{what} returns "{name}"; {suggestion(name, names)}', plant=plant.name)
    for name in names:
        if name not in equations:
            raise PlantError(f'{what} returns nothing for "{name}"; add its equation', plant=plant.name)
    rows: list[Any] = []
    for name in names:
        try:
            row = ca.SX(equations[name])
        except (TypeError, NotImplementedError) as error:
            raise PlantError(f'{what} gives no expression for "{name}"', plant=plant.name) from error
        if not row.is_scalar():
            raise PlantError(f'{what} gives "{name}" the shape {row.shape}; give one expression', plant=plant.name)
        rows.append(row)
    return ca.vertcat(*rows) if rows else ca.SX(0, 1)


def check_structure(plant: Plant) -> None:
    """Refuse what can only be a mistake: an output of nothing, a state that neither moves nor is driven."""
    moved_by = ca.vertcat(plant.t, plant.x, plant.u)
    still = () if plant.sensing is None else plant.sensing.still
    for index, name in enumerate(plant.outputs):
        if name not in still and not ca.depends_on(plant.output[index], moved_by):
            raise PlantError(f'output "{name}" depends on no state and no input; check h', plant=plant.name)
    sampled = {*plant.sampling.sets, *plant.sampling.reads} if plant.sampling is not None else set[str]()
    for index, name in enumerate(plant.states):
        if name in sampled:
            continue
        movers = ca.vertcat(plant.t, *(x for k, x in enumerate(ca.vertsplit(plant.x)) if k != index), plant.u)
        free = not plant.inputs  # a plant without inputs may decay by itself
        if not ca.depends_on(plant.dynamics[index], moved_by if free else movers):
            raise PlantError(
                f'state "{name}" is driven by nothing, no input, no other state; check f, or make it a parameter',
                plant=plant.name,
            )
