"""The parameters of a problem file: its values over the plants' defaults, each in its plant's own unit."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

from seaopt.errors import ProblemError, UnitError, suggestion
from seaopt.formatting import join_words
from seaopt.parameters import Parameter, ParameterSet
from seaopt.plants import Plant, known_parameters
from seaopt.plants.motor.thermal import list_guessed_heat
from seaopt.problem.bench_tables import ParameterTable, UnknownTable
from seaopt.problem.schema import ProblemTable
from seaopt.units import ROTARY, factor, unit_after


def make_parameters(table: ProblemTable, plants: Mapping[str, Plant]) -> ParameterSet:
    """Return the file's values over the plants' defaults, in the plants' units. Raises ProblemError: a name is of no
    plant, or a value is missing that has no default, or several. Raises UnitError: a value's unit has another dimension
    than its parameter's.
    """
    tables = table.parameters
    for experiment in table.experiment:
        accepted = plants[experiment.plant].parameters if experiment.plant in plants else experiment.parameters
        for name in experiment.parameters:
            if name not in accepted:
                raise ProblemError(
                    f'experiment {experiment.name}: parameters names "{name}"; {suggestion(name, accepted)}'
                )
    # What each log states for itself need not be stated for all.
    of_logs = {key: _list_stated(table, key) for key in plants}
    declared = {name: default for plant in plants.values() for name, default in plant.defaults.items()}
    turns = any(plant.actuation is not None and plant.actuation.unit == ROTARY.unit for plant in plants.values())
    built_in = known_parameters(rotary_first=turns)
    for key, plant in plants.items():
        undeclared = [name for name in plant.parameters if name not in declared]
        missing = [name for name in undeclared if name not in tables and name not in of_logs[key]]
        if missing:
            raise ProblemError(_ask_for(key, plant, missing, built_in))
        declared |= {
            name: Parameter(name=name, value=0.0, unit=plant.parameter_unit(name))
            for name in undeclared
            if name in tables
        }
    _check_units(plants)
    _check_defaults(plants, {key: stated.union(tables) for key, stated in of_logs.items()})
    # A plant of the file may use a built-in plant's name for something else.
    accepted = built_in | declared
    parameters = {name: accepted[name] for name in accepted if name in declared or name in tables}
    for name, value in tables.items():
        if name not in accepted:
            remedy = suggestion(name, accepted)
            if name.lower().replace("_", "") == "ke":
                remedy = "a back-EMF constant in V s/rad is the torque constant in N m/A: give K_tau alone"
            raise ProblemError(f'parameters: unknown parameter "{name}"; {remedy}')
        entry = value if isinstance(value, ParameterTable) else ParameterTable(value=value)
        try:
            parameters[name] = make_parameter(parameters[name], entry)
        except UnitError as error:
            raise UnitError(f"parameters.{name}: {error}") from error
    return ParameterSet(parameters.values())


def name_guesses(table: ProblemTable, plants: Mapping[str, Plant]) -> ProblemTable:
    """Return the file with what it leaves out of a motor's heat among its guesses: no default is right for a motor."""
    names = list(table.guessed)
    for key, plant in plants.items():
        names += list_guessed_heat(plant, _list_stated(table, key).union(table.parameters))
    return table.model_copy(update={"guessed": list(dict.fromkeys(names))})


def _list_stated(table: ProblemTable, key: str) -> set[str]:
    """Return the parameters that every experiment of a plant states for itself."""
    stated = [set(experiment.parameters) for experiment in table.experiment if experiment.plant == key]
    return set[str].intersection(*stated) if stated else set()


def _ask_for(key: str, plant: Plant, missing: Sequence[str], described: Mapping[str, Parameter]) -> str:
    """Return what to say of parameters without a value or a default: what they are, in which unit, where they go."""
    words: list[str] = []
    for name in missing:
        unit = plant.parameter_unit(name)
        same = name in described and described[name].unit == unit
        about = [text for text in (described[name].description if same else "", unit_after(unit).strip()) if text]
        words.append(f"{name} ({', '.join(about)})" if about else name)
    example = ", ".join(f"{name} = ..." for name in missing)
    return (
        f"parameters.{missing[0]} is missing: plant.{key} needs {join_words(words)} and has no default; give {example} "
        "in [parameters], or in the parameters of each of its experiments"
    )


def _check_units(plants: Mapping[str, Plant]) -> None:
    """Refuse plants of which one has a parameter in N, say, and another one of the same name in N m."""
    first: dict[str, tuple[str, str]] = {}
    for key, plant in plants.items():
        for name in plant.parameters:
            unit = plant.parameter_unit(name)
            first_plant, first_unit = first.setdefault(name, (key, unit))
            try:
                factor(unit, first_unit)
            except UnitError as error:
                raise ProblemError(
                    f"parameters.{name} is in {first_unit} for plant.{first_plant} and in {unit} for plant.{key}; "
                    "give each a problem file of its own"
                ) from error


def _check_defaults(plants: Mapping[str, Plant], stated: Mapping[str, Collection[str]]) -> None:
    """Refuse plants whose defaults of a parameter differ, where neither the file nor their experiments state it."""
    first: dict[str, tuple[str, Parameter]] = {}
    for key, plant in plants.items():
        for name, default in plant.defaults.items():
            if name in stated[key]:
                continue
            first_plant, before = first.setdefault(name, (key, default))
            value = default.value * factor(default.unit, before.unit)
            if not math.isclose(value, before.value, rel_tol=1e-12):
                raise ProblemError(
                    f"parameters.{name} is missing: its default is {before.value:g} {before.unit} for "
                    f"plant.{first_plant} and {value:g} {before.unit} for plant.{key}; give {name} = ... in "
                    "[parameters]"
                )


def make_parameter(default: Parameter, table: UnknownTable) -> Parameter:
    """Return a parameter with a file's value and bounds, in its own unit."""
    unit = table.unit if isinstance(table, ParameterTable) else None
    scale = factor(unit, default.unit) if unit is not None else 1.0
    prior = None if table.prior_std is None else table.prior_std * scale
    free = table.free if table.free is not None else prior is not None
    low = default.min if table.min is None else table.min * scale
    high = default.max if table.max is None else table.max * scale
    return replace(default, value=table.value * scale, free=free, min=low, max=high, prior_std=prior)
