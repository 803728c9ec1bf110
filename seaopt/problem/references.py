"""What a problem file says of its own plants: every name must be one of theirs."""

from __future__ import annotations

from collections.abc import Mapping

from seaopt.errors import ProblemError, SeaoptError, suggestion
from seaopt.plants import Plant
from seaopt.problem.columns import check_inside
from seaopt.problem.schema import ExperimentTable, ProblemTable, SensorsTable
from seaopt.robustness import check_ranges


def check_references(table: ProblemTable, plants: Mapping[str, Plant]) -> None:
    """Refuse names of plants, inputs, outputs and ranges that the file's plants do not have.

    Raises
    ------
    ProblemError
        As said; the message names the key.

    """
    places = [(f"experiment.{item.name}.plant", item.plant) for item in table.experiment]
    if table.controller:
        places.append(("controller.plant", table.controller.plant))
        places += [("controller.robust_to", name) for name in table.controller.robust_to]
    if table.robustness:
        places += [("robustness.plants", name) for name in table.robustness.plants]
    for place, name in places:
        if name not in plants:
            raise ProblemError(f'{place} = "{name}" is no [plant] of this file; {suggestion(name, plants)}')
    _check_measured(table, plants)
    _check_ranges(table, plants)
    _check_sensors(table, plants)
    seen: set[str] = set()
    for item in table.experiment:
        if item.name in seen:
            raise ProblemError(f'experiment.name = "{item.name}" is used twice; rename one')
        seen.add(item.name)
        _check_experiment(item, plants[item.plant])


def _check_measured(table: ProblemTable, plants: Mapping[str, Plant]) -> None:
    if table.controller is None:
        return
    measured = table.controller.measured
    for name in (
        table.controller.plant,
        *table.controller.robust_to,
        *(table.robustness.plants if table.robustness else ()),
    ):
        if measured not in plants[name].outputs:
            raise ProblemError(
                f'controller.measured = "{measured}" is not an output of plant.{name}; '
                f"{suggestion(measured, plants[name].outputs)}"
            )


def _check_sensors(table: ProblemTable, plants: Mapping[str, Plant]) -> None:
    given = table.robustness.sensors if table.robustness else SensorsTable()
    known = {name for plant in plants.values() for name in plant.outputs}
    for kind in SensorsTable.model_fields:
        for name in getattr(given, kind):
            if name not in known:
                raise ProblemError(f'robustness.sensors.{kind} names "{name}"; {suggestion(name, known)}')


def _check_ranges(table: ProblemTable, plants: Mapping[str, Plant]) -> None:
    try:
        check_ranges(table.robustness.parameters if table.robustness else {}, plants)
    except SeaoptError as error:
        raise ProblemError(f"robustness.parameters: {error}") from error


def _check_experiment(item: ExperimentTable, plant: Plant) -> None:
    place = f"experiment.{item.name}"
    if (item.log is None) == (item.virtual is None):
        raise ProblemError(f"{place}: give either log or virtual, and not both")
    if item.log is not None:
        driven = any(name not in plant.optional_inputs for name in plant.inputs)
        if not item.outputs or (driven and not item.inputs):
            raise ProblemError(f"{place}: a log needs time, inputs and outputs; name their columns")
        check_inside(place, item)
    for kind, given, known in (
        ("inputs", item.inputs, plant.inputs),
        ("outputs", item.outputs, plant.outputs),
    ):
        for name in given:
            if name not in known:
                raise ProblemError(f'{place}.{kind} names "{name}"; {suggestion(name, known)}')
