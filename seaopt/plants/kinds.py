"""The kinds of plant that a problem file can name: the built-in ones and those of installed packages."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from importlib.metadata import entry_points
from typing import Any

from seaopt.errors import PlantError, suggestion
from seaopt.parameters import Parameter
from seaopt.plants.friction import let_stick
from seaopt.plants.motor.thermal import winding
from seaopt.plants.parts import PARTS
from seaopt.plants.plant import Plant
from seaopt.plants.published import all_parameters
from seaopt.plants.rotary import rotary, rotary_parameters
from seaopt.plants.two_link import high_impedance, moving_output, two_link

ENTRY_POINTS = "seaopt.plants"
KINDS: dict[str, Callable[..., Plant]] = {
    "high_impedance": high_impedance,
    "moving_output": moving_output,
    "two_link": two_link,
    "rotary": rotary,
    "winding": winding,
}


def plant_of_kind(kind: str, *, sticks: Any = False, **options: Any) -> Plant:
    """Return a plant by the name of its kind, built in or from the entry-point group ``seaopt.plants``.

    With `sticks` it is simulated and fitted with friction that jumps at rest: `let_stick`.

    Raises
    ------
    PlantError
        The kind or one of its options is unknown, or an installed package's entry point fails.
    """
    installed = {entry.name: entry for entry in entry_points(group=ENTRY_POINTS)}
    if kind not in KINDS and kind not in installed:
        raise PlantError(f'kind = "{kind}" is not a plant; {suggestion(kind, [*KINDS, *installed])}')
    if kind in KINDS:
        make = KINDS[kind]
    else:
        try:
            make = installed[kind].load()
        except Exception as error:
            raise PlantError(f'kind = "{kind}" cannot be loaded from {installed[kind].value}: {error}') from error
    accepted = list(inspect.signature(make).parameters)
    for name in options:
        if name not in accepted:
            raise PlantError(f'{name} is not an option of kind "{kind}"; {suggestion(name, accepted)}')
    if not isinstance(sticks, bool):
        raise PlantError(f"sticks = {sticks!r} is not true or false; give one of them")
    plant = make(**options)
    return let_stick(plant) if sticks else plant


def known_parameters(*, rotary_first: bool = False) -> dict[str, Parameter]:
    """Return every parameter that some built-in plant has, by name (a problem file may name any of them).

    Of a name that linear and rotary plants have in different units it is the linear one's, unless the rotary comes
    first.
    """
    linear = [*(parameter for items in PARTS.values() for parameter in items), *all_parameters()]
    turning = list(rotary_parameters())
    every = (*linear, *turning) if rotary_first else (*turning, *linear)
    return {parameter.name: parameter for parameter in every}
