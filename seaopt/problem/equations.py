"""Plants that a problem file writes down itself: names with units, equations as text, roles.

Every name stands for itself in the texts. f and h may use states, inputs, frictions, parameters and the time t; a role
may use what its function in `seaopt.plants.roles` gets, which is parameters, often with states, and for the curves of a
friction the velocity v. A definition stands for its text in all of them. The texts become CasADi functions, as those of
a plant that was pickled.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from graphlib import CycleError, TopologicalSorter
from typing import Any

import casadi as ca

from seaopt.errors import PlantError, UnitError, suggestion
from seaopt.parameters import Parameter
from seaopt.plants import Actuation, Friction, Mode, Plant, Port, Sensing, SeriesSpring, wrapped
from seaopt.plants.equations.expressions import MAX_LENGTH, RESERVED, list_names, parse
from seaopt.plants.equations.stored_equations import ARGUMENTS, StoredFunction, store_function
from seaopt.problem.bench_tables import AnyPlant, EquationsTable, Formula, PortTable
from seaopt.problem.option_tables import StrictTable
from seaopt.records import record
from seaopt.units import factor, si_unit

MAX_NAMES, MAX_ROLES, MAX_TEXT = 500, 20, 50_000  # of one plant; its frictions, and its ports; characters
TIME, VELOCITY = "t", "v"  # names of their own: in f and h, and in the curves of a friction
KINDS = {
    "states": "a state", "inputs": "an input", "friction": "a friction", "parameters": "a parameter",
    "definitions": "a definition",
}  # fmt: skip
FRICTION_FORMULAS = ("velocity", "force", "effort", "slopes", "jump", "loads")
Read = Callable[[str, Formula], Any]  # returns the expression of a formula, given its key


def order_plants(tables: Mapping[str, AnyPlant]) -> list[str]:
    """Return the names of a file's plants, those that others name as held or probe before these. Raises PlantError: a
    plant that is named is not there, or plants name each other in a circle.
    """
    named = {name: set(list_partners(table)) for name, table in tables.items()}
    for name, partners in named.items():
        for partner in sorted(partners - tables.keys()):
            remedy = suggestion(partner, tables)
            raise PlantError(f'plant.{name}: ports names "{partner}", which is not a [plant] of this file; {remedy}')
    return _sort(named, "plants hold or probe each other")


def list_partners(table: AnyPlant) -> list[str]:
    """Return the names of the plants that a plant's ports name."""
    ports = table.ports if isinstance(table, EquationsTable) else []
    return [name for port in ports for name in (port.held, port.probe) if name is not None]


def make_plant(name: str, table: EquationsTable, partners: Mapping[str, Plant]) -> Plant:
    """Return the plant of a table. `name`: of the plant. `partners`: the plants that its ports name. Raises PlantError:
    a name, an equation or a role is not as it must be; the message names the key. Raises UnitError: a unit is
    unknown, or not SI.
    """
    _check_names(table)
    _check_units(table)
    _check_equations(table)
    texts = _Texts(table=table, definitions=_sort_definitions(table), names=_list_kinds(table))
    everything = (TIME, texts.states, (*table.inputs, *table.friction), texts.parameters)

    def write_rates(read: Read) -> dict[str, Any]:
        for definition in table.definitions:  # those that nothing uses are to be right, too
            read(f"definitions.{definition}", definition)
        return {key: read(f"f.{key}", text) for key, text in table.f.items()}

    def write_outputs(read: Read) -> dict[str, Any]:
        return {key: read(f"h.{key}", text) for key, text in table.h.items()}

    plant = Plant(
        name=name,
        states=table.states,
        inputs=table.inputs,
        outputs=table.outputs,
        parameters={key: _declare(key, declared) for key, declared in table.parameters.items()},
        f=texts.store(write_rates, *everything),
        h=texts.store(write_outputs, *everything),
        derived=texts.derive(),
        energy=texts.take("energy", table.energy, ARGUMENTS["energy"]),
        optional_inputs=frozenset(table.optional_inputs),
        actuation=texts.make(Actuation, "actuation", table.actuation, "effort", "speed", "largest"),
        sensing=texts.make(Sensing, "sensing", table.sensing),
        spring=texts.make(SeriesSpring, "spring", table.spring, "deflection", "pull"),
        ports=tuple(texts.port(f"ports.{number}", port, partners) for number, port in enumerate(table.ports, 1)),
        friction={
            key: texts.make(Friction, f"friction.{key}", curve, *FRICTION_FORMULAS)
            for key, curve in table.friction.items()
        },
        mode=texts.make(Mode, "mode", table.mode),
        sticks=table.sticks,
    )
    _check_outputs(plant)
    _check_held(plant)
    return wrapped(plant, table.parts)


def list_unused(table: EquationsTable) -> list[str]:
    """Return a sentence for each parameter, input and definition that nothing of the plant uses."""
    content = table.model_dump(exclude={"states", "inputs", "outputs", "parameters", "definitions"})
    used = {name for text in _list_texts(content) for name in list_names(text)}
    for name in reversed(_sort_definitions(table)):  # those that use others first
        if name in used:
            used |= set(list_names(str(table.definitions[name])))
    return [
        f'{group}.{name} is not used; leave it out, or look for the equation that lacks "{name}"'
        for group in ("parameters", "inputs", "definitions")
        for name in getattr(table, group)
        if name not in used
    ]


def _list_texts(content: Any) -> Iterator[str]:
    """Return every formula of a table, and every name in a role, which reads as one."""
    if isinstance(content, Mapping):
        for key, value in content.items():
            yield from _list_texts(value) if key != "unit" else ()
    elif isinstance(content, list | tuple):
        for value in content:
            yield from _list_texts(value)
    elif isinstance(content, str):
        yield content


@record
class _Texts:
    """A table's formulas as functions."""

    table: EquationsTable
    definitions: list[str]  # their names, in an order in which each uses only earlier ones
    names: Mapping[str, str]  # what each name of the plant is, in words

    @property
    def states(self) -> tuple[str, ...]:
        return tuple(self.table.states)

    @property
    def parameters(self) -> tuple[str, ...]:
        return tuple(self.table.parameters)

    def store(self, write: Callable[[Read], Any], *arguments: tuple[str, ...] | str) -> StoredFunction:
        """Return what `write` makes of the formulas that it reads, as a function of namespaces and single names."""

        def function(*given: Any) -> Any:
            symbols: dict[str, Any] = {}
            for names, argument in zip(arguments, given, strict=True):
                symbols |= {names: argument} if isinstance(names, str) else vars(argument)
            defined = {
                name: symbol for name, symbol in symbols.items() if name != VELOCITY or VELOCITY not in arguments
            }

            def read(key: str, text: Formula) -> Any:
                self.define(defined, text)
                return self.read(key, text, defined | symbols)

            return write(read)

        return store_function(function, *arguments)

    def define(self, defined: dict[str, Any], text: Formula) -> None:
        """Add the definitions that a formula needs to what is defined, if they use nothing else of the plant."""
        needed = set(list_names(str(text)))
        for name in reversed(self.definitions):
            if name in needed:
                needed |= set(list_names(str(self.table.definitions[name])))
        for name in self.definitions:
            if name in needed and name not in defined:
                uses = self.names.keys() & set(list_names(str(self.table.definitions[name]))) - RESERVED
                if uses <= defined.keys():
                    defined[name] = self.read(f"definitions.{name}", self.table.definitions[name], defined)

    def read(self, key: str, text: Formula, symbols: Mapping[str, Any]) -> Any:
        """Return the expression of a formula in which these names may stand."""
        if not isinstance(text, str):
            return ca.SX(float(text))

        def explain(name: str) -> str | None:
            kind = self.names.get(name)
            if kind == "an output":
                return "is an output; write its expression, or make it one of definitions"
            return None if kind is None else f"is {kind}, which may not stand here; known: {', '.join(symbols)}"

        return parse(text, symbols, key, explain)

    def derive(self) -> StoredFunction | None:
        """Return the function of the derived figures."""
        figures = self.table.derived

        def write(read: Read) -> dict[str, Any]:
            return {name: (read(f"derived.{name}", figure.value), figure.unit) for name, figure in figures.items()}

        return self.store(write, self.parameters) if figures else None

    def take(self, key: str, value: Any, takes: str, loads: Iterable[str] = ()) -> StoredFunction | None:
        """Return a formula, or several in a list or a table, as a function of what it `takes`: the letters of
        `ARGUMENTS`. None where there is none.
        """
        spaces: dict[str, Any] = {"x": self.states, "u": tuple(self.table.inputs), "p": self.parameters, "v": VELOCITY}
        spaces["l"] = (*self.parameters, *loads)

        def write(read: Read) -> Any:
            if isinstance(value, Mapping):
                return {name: read(f"{key}.{name}", text) for name, text in value.items()}
            return tuple(read(key, text) for text in value) if isinstance(value, tuple) else read(key, value)

        none = value is None or value == {}
        return None if none else self.store(write, *(spaces[letter] for letter in takes))

    def make(self, kind: Any, key: str, role: StrictTable | None, *formulas: str, **makers: Any) -> Any:
        """Return a role of a table whose keys are its fields, some of them formulas; None where there is no table."""
        if role is None:
            return None
        fields = {name: tuple(value) if isinstance(value, list) else value for name, value in role}
        loads = fields.get("loads") or ()
        functions = {name: self.take(f"{key}.{name}", fields[name], ARGUMENTS[name], loads) for name in formulas}
        return kind(**fields | functions | makers)

    def port(self, key: str, role: PortTable, partners: Mapping[str, Plant]) -> Port:
        """Return a port; the plants that it names are made already."""
        makers = {
            field: None if name is None else lambda name=name: partners[name]
            for field, name in (("held", role.held), ("probe", role.probe))
        }
        return self.make(Port, key, role, "ratio", **makers)


def _list_kinds(table: EquationsTable) -> dict[str, str]:
    """Return what each name of a plant is, in words."""
    kinds = {TIME: "the time"} | dict.fromkeys(table.outputs, "an output")
    for group, kind in KINDS.items():
        kinds |= dict.fromkeys(getattr(table, group), kind)
    return kinds


def _declare(name: str, declared: Any) -> str | Parameter:
    """Return a parameter's unit, or the parameter with its default."""
    if isinstance(declared, str):
        return declared
    return Parameter(name=name, **declared.model_dump(exclude_none=True))


def _sort_definitions(table: EquationsTable) -> list[str]:
    uses = {name: set(list_names(str(text))) & table.definitions.keys() for name, text in table.definitions.items()}
    return _sort(uses, "definitions use each other")


def _sort(uses: Mapping[str, Iterable[str]], what: str) -> list[str]:
    """Return names so that each comes after those that it uses; a circle is refused."""
    try:
        return list(TopologicalSorter(uses).static_order())
    except CycleError as error:
        circle = " -> ".join(reversed(error.args[1]))
        raise PlantError(f"{what} in a circle, {circle}; take one of them out") from error


def _check_names(table: EquationsTable) -> None:
    # A text that is too long by itself is refused where it is read, with its key.
    characters = sum(min(len(text), MAX_LENGTH) for text in _list_texts(table.model_dump()))
    for what, count, most in (
        ("characters of text", characters, MAX_TEXT),
        ("names", sum(len(getattr(table, group)) for group in (*KINDS, "outputs", "derived")), MAX_NAMES),
        ("frictions", len(table.friction), MAX_ROLES),
        ("ports", len(table.ports), MAX_ROLES),
    ):
        if count > most:
            raise PlantError(f"has {count} {what}; give at most {most}")
    seen: dict[str, str] = {}
    for group in KINDS:
        for name in getattr(table, group):
            key = f"{group}.{name}"
            if not name.isidentifier():
                raise PlantError(f'{group}: "{name}" is not a name; use letters, digits and _')
            if name in RESERVED or name == TIME:
                what = "the time" if name == TIME else "a function or constant"
                raise PlantError(f"{key} has the name of {what} of the equations; rename it")
            if any(name in (role.loads or ()) for role in table.friction.values()):
                raise PlantError(f"{key} has the name of a friction's load; rename one")
            if name == VELOCITY and table.friction and group in ("parameters", "definitions"):
                raise PlantError(f"{key} has the name of the velocity in a friction's force and jump; rename it")
            if name in seen:
                raise PlantError(f"{key} is also one of {seen[name]}; rename one")
            seen[name] = group


def _check_units(table: EquationsTable) -> None:
    """Refuse units that are unknown or not SI, for the equations are in SI and nothing converts inside them."""
    units = {
        f"{group}.{name}": unit
        for group in ("states", "inputs", "outputs")
        for name, unit in getattr(table, group).items()
    }
    for name, declared in table.parameters.items():
        units[f"parameters.{name}"] = declared if isinstance(declared, str) else declared.unit
    roles = {"actuation": table.actuation, "spring": table.spring}
    roles |= {f"friction.{name}": curve for name, curve in table.friction.items()}
    roles |= {f"derived.{name}": figure for name, figure in table.derived.items()}
    units |= {f"{key}.unit": role.unit for key, role in roles.items() if role is not None}
    for key, unit in units.items():
        try:
            same = factor(unit, si_unit(unit)) == 1.0
        except UnitError as error:
            raise UnitError(f"{key}: {error}") from error
        if not same:
            raise UnitError(f'{key} = "{unit}" is not an SI unit; write "{si_unit(unit)}", which equations are in')


def _check_equations(table: EquationsTable) -> None:
    for what, group in (("f", "states"), ("h", "outputs")):
        written, names = getattr(table, what), getattr(table, group)
        kind = group.removesuffix("s")
        for name in written:
            if name not in names:
                raise PlantError(f"{what}.{name} is the equation of no {kind}; {suggestion(name, names)}")
        for name in names:
            if name not in written:
                raise PlantError(f'{kind} "{name}" has no equation; write {what}.{name}')
    used = {
        name
        for text in (*table.f.values(), *table.h.values(), *table.definitions.values())
        for name in list_names(str(text))
    }
    for name in table.friction:
        if name not in used:
            raise PlantError(f'friction.{name} is in no equation; write "- {name}" in f, in place of its force')


def _check_outputs(plant: Plant) -> None:
    for name, row in zip(plant.outputs, ca.vertsplit(plant.output), strict=True):
        for source, symbol in zip(plant.inputs, ca.vertsplit(plant.u), strict=True):
            if ca.is_equal(row, symbol, 1):
                raise PlantError(
                    f'h.{name} is the input "{source}" itself, which tells nothing of the plant; leave it out'
                )


def _check_held(plant: Plant) -> None:
    """Refuse a held plant that is not this one without the link's states."""
    for number, port in enumerate(plant.ports, 1):
        if port.held is None:
            continue
        locked, left = port.held(), [name for name in plant.states if name not in (port.coordinate, port.rate)]
        if list(locked.states) != left or list(locked.inputs)[:1] != list(plant.inputs)[:1]:
            raise PlantError(
                f"ports.{number}.held: plant {locked.name} has the states {', '.join(locked.states) or 'none'}; with "
                f"the link held they are {', '.join(left) or 'none'}, and the first input is the same"
            )
