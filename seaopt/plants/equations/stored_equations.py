"""Plants that pickle, whatever functions their equations are: each function is stored as a CasADi function.

Python pickles no lambda and no function inside another one, which is what equations are written as. What they return
is symbolic, though, and CasADi stores that: a pickled plant has, in the place of each of its functions, a
`StoredFunction` that holds the expressions. It takes symbols or numbers as the function did, so that the plant works
on as before, in another process too.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import fields, replace
from functools import partial
from types import SimpleNamespace
from typing import Any

import casadi as ca

from seaopt.plants.roles import Friction, Port
from seaopt.records import record


@record(eq=False)
class StoredFunction:
    """A function of namespaces (or of scalars), as the expressions that it returned for symbols."""

    function: Any  # of the symbols that the expressions depend on
    # where each of them comes from: which argument, and which of its attributes (None: the argument itself)
    places: tuple[tuple[int, str | None], ...]
    layout: Any  # what is returned; a whole number stands for that output of the function

    def __call__(self, *arguments: Any) -> Any:
        """Return what the stored function returned, at these arguments."""
        values = [arguments[index] if name is None else getattr(arguments[index], name) for index, name in self.places]
        return _arrange(self.layout, self.function.call(values))


def store_function(function: Callable[..., Any], *arguments: Iterable[str] | str) -> StoredFunction:
    """Return a function as its expressions. `function`: returns expressions, alone or in mappings and tuples (with
    texts among them). `*arguments`: the attributes of each argument; a single text stands for an argument that is one
    symbol.
    """
    symbols: dict[tuple[int, str | None], Any] = {}
    symbolic: list[Any] = []
    for index, names in enumerate(arguments):
        if isinstance(names, str):
            symbols[index, None] = ca.SX.sym(names)
            symbolic.append(symbols[index, None])
        else:
            attributes = {name: ca.SX.sym(name) for name in names}
            symbols |= {(index, name): symbol for name, symbol in attributes.items()}
            symbolic.append(SimpleNamespace(**attributes))
    leaves: list[Any] = []
    layout = _take_leaves(function(*symbolic), leaves)
    # What the expressions do not depend on need not be there when they are evaluated.
    used = {origin: symbol for origin, symbol in symbols.items() if any(ca.depends_on(leaf, symbol) for leaf in leaves)}
    return StoredFunction(
        function=ca.Function("stored", list(used.values()), leaves), places=tuple(used), layout=layout
    )


def _take_leaves(result: Any, leaves: list[Any]) -> Any:
    """Return the layout of a result; its expressions are added to `leaves`."""
    if isinstance(result, Mapping):
        return {name: _take_leaves(part, leaves) for name, part in result.items()}
    if isinstance(result, tuple):
        return tuple(_take_leaves(part, leaves) for part in result)
    if isinstance(result, str):
        return result
    leaves.append(ca.SX(result))
    return len(leaves) - 1


def _arrange(layout: Any, leaves: list[Any]) -> Any:
    if isinstance(layout, dict):
        return {name: _arrange(part, leaves) for name, part in layout.items()}
    if isinstance(layout, tuple):
        return tuple(_arrange(part, leaves) for part in layout)
    return layout if isinstance(layout, str) else leaves[layout]


# What the functions of a plant and of its roles take: time t, states x, inputs u, parameters p (with rated loads, l), a
# velocity v and the deflection of bristles z.
ARGUMENTS = {
    "f": "txup", "h": "txup", "derived": "p", "energy": "xp",
    "effort": "p", "speed": "xp", "largest": "p", "deflection": "xp", "pull": "xp", "ratio": "p",
    "velocity": "xp", "force": "vl", "slopes": "l", "jump": "vl", "loads": "xup",
    "coordinate": "xp", "stiffness": "p", "damping": "p", "rate": "zvl",
}  # fmt: skip


def store_plant(plant: Any) -> dict[str, Any]:
    """Return what a `Plant` is made of, with every function of its names_of as a `StoredFunction`."""
    spaces: dict[str, Any] = {"t": "t", "v": "velocity", "z": "z", "x": tuple(plant.states)}
    spaces |= {"u": (*plant.inputs, *plant.friction, *plant.followed), "p": tuple(plant.parameters)}

    def store(owner: Any, loads: Iterable[str] = ()) -> dict[str, Any]:
        """Return the functions of a plant or a role that do not pickle as they are, stored."""
        names_of = spaces | {"l": (*spaces["p"], *loads)}
        functions = {name: getattr(owner, name, None) for name in ARGUMENTS}
        return {
            name: store_function(function, *(names_of[letter] for letter in ARGUMENTS[name]))
            for name, function in functions.items()
            if callable(function) and not _has_name(function)
        }

    def store_friction(friction: Friction) -> Friction:
        bristles, loads = friction.bristles, friction.rated
        bristles = bristles and replace(bristles, **store(bristles, loads))
        return replace(friction, **store(friction, loads), bristles=bristles)

    def store_port(port: Port) -> Port:
        return replace(port, **store(port), held=_store_maker(port.held), probe=_store_maker(port.probe))

    roles = {name: getattr(plant, name) for name in ("actuation", "winding", "spring")}
    return {
        **{field.name: getattr(plant, field.name) for field in fields(plant) if field.init},
        **store(plant),
        **{name: role and replace(role, **store(role)) for name, role in roles.items()},
        "ports": tuple(map(store_port, plant.ports)),
        "friction": {name: store_friction(friction) for name, friction in plant.friction.items()},
    }


def _has_name(function: Any) -> bool:
    """Tell whether a function pickles as it is: by the name of its package's module, or as what it is made of."""
    if isinstance(function, StoredFunction):
        return True
    if isinstance(function, partial):
        inner = [function.func, *(argument for argument in function.args if callable(argument))]
        return all(map(_has_name, inner))
    # A function of the user's script may not be there under its name in another process.
    return "<" not in getattr(function, "__qualname__", "<") and function.__module__.startswith("seaopt.")


def _store_maker(maker: Callable[[], Any] | None) -> Callable[[], Any] | None:
    return maker if maker is None or _has_name(maker) else partial(_give_back, maker())


def _give_back(plant: Any) -> Any:
    return plant
