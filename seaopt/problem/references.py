"""Checks of a problem file against its own plants: names must be theirs, and ranges that are odd get a remark."""

from __future__ import annotations

import math
import shlex
from collections.abc import Iterable, Mapping, Sequence
from difflib import get_close_matches

import numpy as np

from seaopt.control.loops.sampled_plant import DELAYS, find_signals, list_names
from seaopt.control.scheduling.gain_table import check_points
from seaopt.control.scheduling.scheduled_controller import find_unit
from seaopt.errors import ControlError, ProblemError, SeaoptError, UnitError, suggestion
from seaopt.formatting import join_words
from seaopt.parameters import Parameter, ParameterSet
from seaopt.plants import Plant
from seaopt.plants.motor.thermal import PARAMETERS as HEAT
from seaopt.problem.bench_tables import ExperimentTable, SensorsTable
from seaopt.problem.columns import check_inside
from seaopt.problem.proposal.vocabulary import read_header
from seaopt.problem.schema import ControllerTable, ExpectTable, ProblemTable, RangeTable
from seaopt.robustness import check_ranges, place_value
from seaopt.robustness.uncertainty.draws import find_modes
from seaopt.units import factor, unit_after

MAX_LINK_DELAY_SAMPLES = 20
RESPONSE = "frf:"  # before the name of an experiment whose frequency response is meant


def check_references(table: ProblemTable, plants: Mapping[str, Plant], parameters: ParameterSet) -> None:
    """Refuse names of plants, inputs, outputs and ranges that the file's plants do not have, and ranges out of bounds.

    Raises ProblemError: the message names the key.
    """
    places = [(f"experiment.{experiment.name}.plant", experiment.plant) for experiment in table.experiment]
    if table.controller:
        _check_responses(table, table.controller)
        named = [("controller.plant", table.controller.plant)]
        named += [("controller.robust_to", name) for name in table.controller.robust_to]
        places += [(place, name) for place, name in named if not name.startswith(RESPONSE)]
        gravity = table.controller.compensation.gravity
        if gravity is not None and gravity.plant is not None:
            places.append(("controller.compensate.gravity.plant", gravity.plant))
    if table.impedance:
        if table.controller is None:
            raise ProblemError("[impedance] is there, and no [controller] is; add one, or leave it out")
        places.append(("impedance.plant", table.impedance.plant))
    if table.robustness:
        places += [("robustness.plants", name) for name in table.robustness.plants]
    for place, name in places:
        if name not in plants:
            key, near = place.rpartition(".")[2], _nearest(name, [*plants])
            line = f'{key} = "{near}"' if key == "plant" else f'{key} = ["{near}"]'
            raise ProblemError(
                f'{place} = "{name}" is not a [plant] of this file ({suggestion(name, plants)}); write {line}'
            )
    _check_schedule(table, plants)
    _check_measured(table, plants)
    _check_link(table, plants)
    _check_ranges(table, plants, parameters)
    _check_sensors(table, plants)
    seen: set[str] = set()
    for experiment in table.experiment:
        if experiment.name in seen:
            raise ProblemError(
                f'experiment.name = "{experiment.name}" is used twice; rename one: name = "{experiment.name}_2"'
            )
        seen.add(experiment.name)
        _check_experiment(experiment, plants[experiment.plant])
    if table.expect is not None:
        _check_expected(table, table.expect, plants, parameters)


def _check_schedule(table: ProblemTable, plants: Mapping[str, Plant]) -> None:
    """Refuse a schedule over what no plant has, and what is not made of a schedule."""
    schedule = None if table.controller is None else table.controller.schedule
    if schedule is None or table.controller is None:
        return
    named = [table.controller.plant, *table.controller.robust_to]
    responses = [name for name in named if name.startswith(RESPONSE)]
    if responses:
        raise ProblemError(
            f"controller.schedule is there, and {responses[0]} is a measured response, which stands at one value of "
            f"{schedule.over}; name plants, or leave the schedule out"
        )
    try:
        check_points(schedule.over, np.array(schedule.points))
        find_unit(schedule.over, {name: plants[name] for name in named})
    except ControlError as error:
        raise ProblemError(f"controller.schedule: {error}") from error
    if schedule.bandwidth_hz is not None and len(schedule.bandwidth_hz) != len(schedule.points):
        raise ProblemError(
            f"controller.schedule.bandwidth_hz has {len(schedule.bandwidth_hz)} values and points "
            f"{len(schedule.points)}; give one per point, or leave it out"
        )
    _check_beside_schedule(table, schedule.over)


def _check_beside_schedule(table: ProblemTable, over: str) -> None:
    """Refuse a range of what is scheduled over, and what is made of one law alone."""
    robustness, expect = table.robustness, table.expect
    if robustness is not None and over in robustness.parameters:
        raise ProblemError(
            f"robustness.parameters.{over} is a range of what controller.schedule is over, whose points are its range; "
            "take it out"
        )
    law = table.controller
    for key, there in (
        ('controller.structure = "mpc"', law is not None and law.structure == "mpc"),
        ("controller.prefilter", law is not None and law.prefilter is not None),
        ("controller.link_feedforward", law is not None and law.link_feedforward is not False),
        ("controller.compensate", law is not None and bool(law.compensate)),
        ("controller.gate", law is not None and law.gate is not None),
        ("impedance", table.impedance is not None),
        ("robustness.retune", robustness is not None and robustness.retune),
        ("expect.controller", expect is not None and expect.controller is not None),
        ("expect.certificate", expect is not None and expect.certificate is not None),
    ):
        if there:
            raise ProblemError(f"{key} is there, and is not made of a controller.schedule; leave one of them out")


def _check_responses(table: ProblemTable, controller: ControllerTable) -> None:
    """Refuse measured responses of experiments that the file has not, or that do not measure what is regulated."""
    experiments = {experiment.name: experiment for experiment in table.experiment}
    for place, names in (("plant", [controller.plant]), ("robust_to", controller.robust_to)):
        for name in names:
            if not name.startswith(RESPONSE):
                continue
            of = name.removeprefix(RESPONSE)
            if of not in experiments:
                raise ProblemError(
                    f'controller.{place} = "{name}" is of no [[experiment]] of this file; {suggestion(of, experiments)}'
                )
            experiment = experiments[of]
            if experiment.virtual is None and controller.measured not in experiment.outputs:
                raise ProblemError(
                    f'controller.{place} = "{name}" is of an experiment that does not measure {controller.measured}; '
                    f"name its column in experiment.{of}.outputs"
                )


def _check_expected(
    table: ProblemTable, expect: ExpectTable, plants: Mapping[str, Plant], parameters: ParameterSet
) -> None:
    """Refuse expectations of what this file's results do not have."""
    experiments = {experiment.name: experiment for experiment in table.experiment}
    of_fit = [name for name in ("parameters", "fit_percent") if getattr(expect, name)]
    of_design = [name for name in ("controller", "certificate") if getattr(expect, name) is not None]
    for keys, needed, there in (
        (of_fit, "[[experiment]]", table.experiment),
        (of_design, "[controller]", table.controller),
    ):
        if keys and not there:
            raise ProblemError(f"expect.{keys[0]} is there, and no {needed} is; add one, or leave it out")
    derived = {name: unit for plant in plants.values() for name, (_, unit) in plant.derived_values().items()}
    units = {name: parameter.unit for name, parameter in parameters.items()} | derived
    certified = expect.certificate.plants if expect.certificate is not None else {}
    for place, names, known in (
        ("expect.parameters", expect.parameters, units),
        ("expect.fit_percent", expect.fit_percent, experiments),
        ("expect.certificate.plants", certified, plants),
    ):
        _check_names(place, names, known)
    for name, limits in expect.parameters.items():
        if isinstance(limits, RangeTable) and limits.unit is not None:
            try:
                factor(limits.unit, units[name])
            except UnitError as error:
                raise UnitError(f"expect.parameters.{name}: {error}") from error
    for name, limits in expect.fit_percent.items():
        experiment = experiments[name]
        known = {**plants[experiment.plant].outputs, **experiment.differences}
        _check_names(f"expect.fit_percent.{name}", limits if isinstance(limits, dict) else (), known)


def _check_names(place: str, names: Iterable[str], known: Iterable[str]) -> None:
    for name in names:
        if name not in known:
            raise ProblemError(f'{place} names "{name}"; {suggestion(name, known)}')


def _check_measured(table: ProblemTable, plants: Mapping[str, Plant]) -> None:
    if table.controller is None:
        return
    measured, *others = list_names(table.controller.measured)
    named: list[str] = [table.controller.plant, *table.controller.robust_to]
    named += table.robustness.plants if table.robustness else []
    named += [table.impedance.plant] if table.impedance else []
    by_experiment = {f"{RESPONSE}{experiment.name}": experiment.plant for experiment in table.experiment}
    for name in [by_experiment.get(name, name) for name in named]:
        if measured not in plants[name].outputs:
            given = "measured" in table.controller.model_fields_set
            sensing = plants[name].sensing
            regulated = sensing.regulated if sensing is not None else ()
            known = [*regulated, *(output for output in plants[name].outputs if output not in regulated)]
            raise ProblemError(
                f'controller.measured{"" if given else ", which is left out,"} = "{measured}" is not an output of '
                f'plant.{name}, which has {", ".join(known)}; write measured = "{_nearest(measured, known)}" in '
                "[controller]"
            )
        try:
            find_signals(plants[name], tuple(others))
        except ControlError as error:
            raise ProblemError(f"controller.{error}") from error


def _check_link(table: ProblemTable, plants: Mapping[str, Plant]) -> None:
    """Refuse an impedance at a link that is held."""
    if table.impedance is None:
        return
    moving = [name for name, plant in plants.items() if plant.port is not None and plant.port.motion is not None]
    if table.impedance.plant not in moving:
        known = f"write one of {', '.join(moving)}" if moving else "add a plant whose link moves"
        raise ProblemError(f'impedance.plant = "{table.impedance.plant}" holds its link; {known}')


def _nearest(name: str, known: list[str]) -> str:
    """Return the name that was likely meant, else the first of those that are there."""
    return next(iter(get_close_matches(name, known, n=1, cutoff=0.6)), known[0] if known else "...")


def _check_sensors(table: ProblemTable, plants: Mapping[str, Plant]) -> None:
    sensors = table.robustness.sensors if table.robustness else SensorsTable()
    known = list(dict.fromkeys(name for plant in plants.values() for name in plant.outputs))
    for kind in SensorsTable.model_fields:
        for name in getattr(sensors, kind):
            if name not in known:
                raise ProblemError(f'robustness.sensors.{kind} names "{name}"; {suggestion(name, known)}')


def _check_ranges(table: ProblemTable, plants: Mapping[str, Plant], parameters: ParameterSet) -> None:
    ranges = table.robustness.parameters if table.robustness else {}
    for name, ends in ranges.items():
        place = f"robustness.parameters.{name}"
        try:
            check_ranges({name: ends}, plants)
        except SeaoptError as error:
            raise ProblemError(f"{place}: {error}") from error
        place += f" = [{ends[0]:g}, {ends[1]:g}]"
        if name in parameters:
            _check_own_bounds(place, ends, parameters[name])
        if name in DELAYS and table.controller is not None:
            _check_delay(place, ends[1], table.controller.sample_rate_hz)
    try:
        check_ranges(ranges, plants)
    except SeaoptError as error:
        raise ProblemError(f"robustness.parameters: {error}") from error


def _check_own_bounds(place: str, ends: tuple[float, float], parameter: Parameter) -> None:
    if ends[0] < parameter.min or ends[1] > parameter.max:
        raise ProblemError(
            f"{place}{unit_after(parameter.unit)} leaves the bounds [{parameter.min:g}, {parameter.max:g}] that this "
            f"file gives {parameter.name}; keep inside, or change min and max: "
            f"min = {min(ends[0], parameter.min):g}, max = {max(ends[1], parameter.max):g}"
        )


def _check_delay(place: str, longest_s: float, rate_hz: float) -> None:
    """Refuse a delay of many samples: each is a state of every draw's plant, and takes its time."""
    if longest_s * rate_hz > MAX_LINK_DELAY_SAMPLES * (1.0 + 1e-9):
        raise ProblemError(
            f"{place} s reaches {longest_s * rate_hz:.4g} sample times of controller.sample_rate_hz = {rate_hz:g}, and "
            f"takes at most {MAX_LINK_DELAY_SAMPLES} ({MAX_LINK_DELAY_SAMPLES / rate_hz:g} s); it is in seconds, and "
            f"a delay that is always there is controller.drive_delay_s = {longest_s:g}"
        )


def _first_log(experiment: ExperimentTable) -> str:
    return experiment.log if isinstance(experiment.log, str) else next(iter(experiment.log or ["LOG"]))


def _check_experiment(experiment: ExperimentTable, plant: Plant) -> None:
    place = f"experiment.{experiment.name}"
    if (experiment.log is None) == (experiment.virtual is None):
        raise ProblemError(f'{place}: give either log or virtual, and not both: log = "NAME.csv"')
    if experiment.log is not None:
        driven = any(name not in plant.optional_inputs for name in plant.inputs)
        if not experiment.outputs or (driven and not experiment.inputs):
            raise ProblemError(
                f"{place}: a log needs time, inputs and outputs; name their columns, as outputs = "
                f'{{ NAME = "COLUMN" }} (seaopt inspect {shlex.quote(_first_log(experiment))} --list lists them)'
            )
        check_inside(place, experiment)
    for kind, names, known in (
        ("inputs", experiment.inputs, plant.inputs),
        ("outputs", experiment.outputs, {**plant.outputs, **experiment.differences}),
    ):
        for name in names:
            if name not in known:
                remedy = suggestion(name, known)
                if kind == "outputs" and read_header(name).quantity == "speed":
                    position = plant.sensing.motor_position if plant.sensing is not None else None
                    remedy += (
                        "; a speed that a device computed from a position is declared with differences = "
                        f'{{ {name} = {{ of = "{position or next(iter(plant.outputs))}" }} }}'
                    )
                raise ProblemError(f'{place}.{kind} names "{name}"; {remedy}')


def range_remarks(
    ranges: Mapping[str, tuple[float, float]], plants: Mapping[str, Plant], nominal: ParameterSet
) -> list[str]:
    """Return a sentence for a range that turns an angle past a right one, or leaves out a nominal mode.

    A nominal value outside its range is among the notes of the certificate.

    `ranges`: those that `seaopt.robustness.check_ranges` takes. `plants`: what is certified. `nominal`: its values.
    """
    remarks: list[str] = []
    modes = find_modes(plants)
    angles = {name for plant in plants.values() for name, unit in plant.states.items() if unit == "rad"}
    for name, (low, high) in ranges.items():
        place = f"robustness.parameters.{name} = [{low:g}, {high:g}]"
        if name in modes and _mode_outside(name, (low, high), plants, nominal):
            remarks.append(f"{place} Hz leaves out the nominal mode, so that no draw is like the nominal plant")
        if name in angles and max(-low, high) > 0.5 * math.pi:
            ends = f"{math.degrees(low):.4g} to {math.degrees(high):.4g}"
            remarks.append(f"{place} is in rad: {ends} degrees, beyond a right angle; keep it if that is meant")
    return remarks


def guess_remarks(
    guessed: Sequence[str],
    ranges: Mapping[str, tuple[float, float]],
    plants: Mapping[str, Plant],
    nominal: ParameterSet,
) -> list[str]:
    """Return a sentence that names the guesses of which nothing is drawn, with ranges to draw them from.

    `guessed`: names of parameters, among words for other entries. What has a std in `nominal`, of a fit or as a prior,
    is drawn.
    """
    used = {name for plant in plants.values() for name in plant.parameters} - {parameter.name for parameter in HEAT}
    unknown = [nominal[name] for name in guessed if name in used and name not in ranges]
    fixed = [parameter for parameter in unknown if parameter.std is None and parameter.prior_std is None]
    if not fixed:
        return []
    wide = ", ".join(filter(None, map(_propose_range, fixed)))
    names, are = join_words([parameter.name for parameter in fixed]), "is a guess" if len(fixed) == 1 else "are guesses"
    return [
        f"nothing is drawn of {names}, which {are}: give each a range that holds the truth, in [robustness]"
        + (f": parameters = {{ {wide} }}" if wide else "")
    ]


def _propose_range(guess: Parameter) -> str:
    """Return a range from half a guess to its double, as a file has it; empty for 0, which says nothing of its size."""
    low, high = sorted((0.5 * guess.value, 2.0 * guess.value))
    return f"{guess.name} = [{max(low, guess.min):.3g}, {min(high, guess.max):.3g}]" if guess.value else ""


def _mode_outside(name: str, ends_hz: tuple[float, float], plants: Mapping[str, Plant], nominal: ParameterSet) -> bool:
    """Tell whether the nominal value is none of those that put a mode into the range."""
    plant = find_modes(plants)[name]
    assert plant.mode is not None
    placements = (place_value(plant, nominal, name, end, plants) for end in ends_hz)
    values = [each[plant.mode.parameter].value for each in placements if each is not None]
    return not min(values) <= plant.complete(nominal)[plant.mode.parameter].value <= max(values)
