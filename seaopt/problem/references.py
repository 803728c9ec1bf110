"""What a problem file says of its own plants: every name must be one of theirs."""

from __future__ import annotations

from collections.abc import Mapping

from seaopt.control.loops.sampled_plant import DELAY
from seaopt.errors import ProblemError, SeaoptError, suggestion
from seaopt.parameters import Parameter, ParameterSet
from seaopt.plants import Plant
from seaopt.problem.columns import check_inside
from seaopt.problem.schema import ExperimentTable, ProblemTable, SensorsTable
from seaopt.robustness import check_ranges
from seaopt.units import unit_after

MOST_DELAY_SAMPLES = 20


def check_references(table: ProblemTable, plants: Mapping[str, Plant], parameters: ParameterSet) -> None:
    """Refuse names of plants, inputs, outputs and ranges that the file's plants do not have, and ranges out of bounds.

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
    _check_ranges(table, plants, parameters)
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


def _check_ranges(table: ProblemTable, plants: Mapping[str, Plant], parameters: ParameterSet) -> None:
    given = table.robustness.parameters if table.robustness else {}
    for name, ends in given.items():
        place = f"robustness.parameters.{name}"
        try:
            check_ranges({name: ends}, plants)
        except SeaoptError as error:
            raise ProblemError(f"{place}: {error}") from error
        place += f" = [{ends[0]:g}, {ends[1]:g}]"
        if name in parameters:
            _check_own_bounds(place, ends, parameters[name])
        if name == DELAY and table.controller is not None:
            _check_delay(place, ends[1], table.controller.sample_rate_hz)
    try:
        check_ranges(given, plants)
    except SeaoptError as error:
        raise ProblemError(f"robustness.parameters: {error}") from error


def _check_own_bounds(place: str, ends: tuple[float, float], item: Parameter) -> None:
    if ends[0] < item.min or ends[1] > item.max:
        raise ProblemError(
            f"{place}{unit_after(item.unit)} leaves the bounds [{item.min:g}, {item.max:g}] that this file gives "
            f"{item.name}; keep inside, or change min and max of parameters.{item.name}"
        )


def _check_delay(place: str, longest_s: float, rate_hz: float) -> None:
    """Refuse a delay of many samples: each is a state of every draw's plant, and takes its time."""
    if longest_s * rate_hz > MOST_DELAY_SAMPLES * (1.0 + 1e-9):
        raise ProblemError(
            f"{place} s reaches {longest_s * rate_hz:.4g} sample times of controller.sample_rate_hz = {rate_hz:g}, and "
            f"takes at most {MOST_DELAY_SAMPLES} ({MOST_DELAY_SAMPLES / rate_hz:g} s); it is in seconds, and whole "
            "samples that are always there belong in controller.delay_samples"
        )


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
