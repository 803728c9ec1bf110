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
from seaopt.logs.reading.vocabulary import read_header
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.plants.motor.thermal import PARAMETERS as HEAT
from seaopt.problem.bench_tables import ExperimentTable, SensorsTable
from seaopt.problem.columns import check_inside
from seaopt.problem.schema import ControllerTable, ExpectTable, ProblemTable, RangeTable
from seaopt.robustness import check_ranges, place_value
from seaopt.robustness.uncertainty.draws import find_modes
from seaopt.units import factor, unit_after

MAX_LINK_DELAY_SAMPLES = 20
RESPONSE = "frf:"  # before the name of an experiment whose frequency response is meant


def check_references(table: ProblemTable, plants: Mapping[str, Plant], parameters: ParameterSet) -> None:
    """Refuse names and ranges that the file's plants do not have (ProblemError, with the key)."""
    keys = [(f"experiment.{experiment.name}.plant", experiment.plant) for experiment in table.experiment]
    if table.controller:
        _check_responses(table, table.controller)
        named = [("controller.plant", table.controller.plant)]
        named += [("controller.robust_to", name) for name in table.controller.robust_to]
        keys += [(key, name) for key, name in named if not name.startswith(RESPONSE)]
        gravity = table.controller.compensation.gravity
        if gravity is not None and gravity.plant is not None:
            keys.append(("controller.compensate.gravity.plant", gravity.plant))
    if table.impedance:
        if table.controller is None:
            raise ProblemError("[impedance] is there, and no [controller] is; add one, or leave it out")
        keys.append(("impedance.plant", table.impedance.plant))
    keys += [("robustness.plants", name) for name in table.robustness.plants] if table.robustness else []
    for key, name in keys:
        if name not in plants:
            near = _nearest(name, [*plants])
            line = f'plant = "{near}"' if key.endswith(".plant") else f'{key.rpartition(".")[2]} = ["{near}"]'
            raise ProblemError(
                f'{key} = "{name}" is not a [plant] of this file ({suggestion(name, plants)}); write {line}'
            )
    _check_schedule(table, plants)
    _check_measured(table, plants)
    _check_link(table, plants)
    _check_ranges(table, plants, parameters)
    _check_sensors(table, plants)
    names = [experiment.name for experiment in table.experiment]
    for experiment in table.experiment:
        if names.count(experiment.name) > 1:
            raise ProblemError(
                f'experiment.name = "{experiment.name}" is used twice; rename one: name = "{experiment.name}_2"'
            )
        _check_experiment(experiment, plants[experiment.plant])
    if table.expect is not None:
        _check_expected(table, table.expect, plants, parameters)


def _check_schedule(table: ProblemTable, plants: Mapping[str, Plant]) -> None:
    """Refuse a schedule over what no plant has, and keys that go with one law only."""
    schedule = None if table.controller is None else table.controller.schedule
    if schedule is None or table.controller is None:
        return
    if table.controller.plant.startswith(RESPONSE):
        raise ProblemError(
            f"controller.schedule is there, and {table.controller.plant} is a measured response, taken at one value of "
            f"{schedule.over}: at the others nothing is known of it; name a plant, and the response in "
            "robust_to, or leave the schedule out"
        )
    named = [name for name in [table.controller.plant, *table.controller.robust_to] if not name.startswith(RESPONSE)]
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
    law, robustness, expect = table.controller, table.robustness, table.expect
    if robustness is not None and schedule.over in robustness.parameters:
        raise ProblemError(
            f"robustness.parameters.{schedule.over} is a range of what controller.schedule is over, whose points are "
            "its range; take it out"
        )
    for key, there in (
        ('controller.structure = "mpc"', law.structure == "mpc"),
        ("expect.controller", expect is not None and expect.controller is not None),
        ("expect.certificate", expect is not None and expect.certificate is not None),
    ):
        if there:
            raise ProblemError(f"{key} is there, and is not made of a controller.schedule; leave one of them out")


def _check_responses(table: ProblemTable, controller: ControllerTable) -> None:
    """Refuse measured responses of experiments that the file has not."""
    experiments = [experiment.name for experiment in table.experiment]
    named = [("plant", controller.plant), *(("robust_to", name) for name in controller.robust_to)]
    for field, name in named:
        if not name.startswith(RESPONSE):
            continue
        key, source = f'controller.{field} = "{name}"', name.removeprefix(RESPONSE)
        if source not in experiments:
            raise ProblemError(f"{key} is of no [[experiment]] of this file; {suggestion(source, experiments)}")


def _check_expected(
    table: ProblemTable, expect: ExpectTable, plants: Mapping[str, Plant], parameters: ParameterSet
) -> None:
    """Refuse expectations of what this file's results do not have."""
    experiments = {experiment.name: experiment for experiment in table.experiment}
    for tables, needed, there in (
        (("parameters", "fit_percent"), "[[experiment]]", table.experiment),
        (("controller", "certificate"), "[controller]", table.controller),
    ):
        stated = next((name for name in tables if getattr(expect, name)), None)
        if stated is not None and not there:
            raise ProblemError(f"expect.{stated} is there, and no {needed} is; add one, or leave it out")
    derived = {name: unit for plant in plants.values() for name, (_, unit) in plant.derived_values().items()}
    units = {name: parameter.unit for name, parameter in parameters.items()} | derived
    certified = expect.certificate.plants if expect.certificate is not None else {}
    _check_names("expect.parameters", expect.parameters, units)
    _check_names("expect.fit_percent", expect.fit_percent, experiments)
    _check_names("expect.certificate.plants", certified, plants)
    for name, limits in expect.parameters.items():
        if isinstance(limits, RangeTable) and limits.unit is not None:
            try:
                factor(limits.unit, units[name])
            except UnitError as error:
                raise UnitError(f"expect.parameters.{name}: {error}") from error
    for name, limits in expect.fit_percent.items():
        experiment = experiments[name]
        outputs = {**plants[experiment.plant].outputs, **experiment.differences}
        _check_names(f"expect.fit_percent.{name}", limits if isinstance(limits, dict) else (), outputs)


def _check_names(key: str, names: Iterable[str], valid: Iterable[str]) -> None:
    for name in names:
        if name not in valid:
            raise ProblemError(f'{key} names "{name}"; {suggestion(name, valid)}')


def _check_measured(table: ProblemTable, plants: Mapping[str, Plant]) -> None:
    controller = table.controller
    if controller is None:
        return
    measured, *signals = list_names(controller.measured)
    named: list[str] = [controller.plant, *controller.robust_to]
    named += table.robustness.plants if table.robustness else []
    named += [table.impedance.plant] if table.impedance else []
    on_bench = {f"{RESPONSE}{experiment.name}": experiment for experiment in table.experiment}
    for key in named:
        name = on_bench[key].plant if key in on_bench else key
        plant = plants[name]
        if measured not in plant.outputs:
            stated = "" if "measured" in controller.model_fields_set else ", which is left out,"
            outputs = list(dict.fromkeys([*(plant.sensing.regulated if plant.sensing else ()), *plant.outputs]))
            raise ProblemError(
                f'controller.measured{stated} = "{measured}" is not an output of plant.{name}, which has '
                f'{", ".join(outputs)}; write measured = "{_nearest(measured, outputs)}" in [controller]'
            )
        try:
            reads = find_signals(plant, (measured, *signals))
        except ControlError as error:
            raise ProblemError(f"controller.{error}") from error
        if key in on_bench and on_bench[key].virtual is None:
            missing = [name for name in reads if name not in on_bench[key].outputs]
            if missing:
                raise ProblemError(
                    f"controller names {key}, an experiment that does not measure {join_words(missing)}, which the law "
                    f"reads; name the column in experiment.{on_bench[key].name}.outputs"
                )


def _check_link(table: ProblemTable, plants: Mapping[str, Plant]) -> None:
    """Refuse an impedance at a link that is held."""
    moving = [name for name, plant in plants.items() if plant.port is not None and plant.port.motion is not None]
    if table.impedance is not None and table.impedance.plant not in moving:
        remedy = f"write one of {', '.join(moving)}" if moving else "add a plant whose link moves"
        raise ProblemError(f'impedance.plant = "{table.impedance.plant}" holds its link; {remedy}')


def _nearest(name: str, names: list[str]) -> str:
    """Return the name that was likely meant, else the first of those that are there."""
    return next(iter(get_close_matches(name, names, n=1, cutoff=0.6)), names[0] if names else "...")


def _check_sensors(table: ProblemTable, plants: Mapping[str, Plant]) -> None:
    outputs = list(dict.fromkeys(name for plant in plants.values() for name in plant.outputs))
    sensors = table.robustness.sensors if table.robustness else SensorsTable()
    for kind in SensorsTable.model_fields:
        _check_names(f"robustness.sensors.{kind}", getattr(sensors, kind), outputs)


def _check_ranges(table: ProblemTable, plants: Mapping[str, Plant], parameters: ParameterSet) -> None:
    ranges = table.robustness.parameters if table.robustness else {}
    for name, ends in ranges.items():
        key = f"robustness.parameters.{name}"
        try:
            check_ranges({name: ends}, plants)
        except SeaoptError as error:
            raise ProblemError(f"{key}: {error}") from error
        key += f" = [{ends[0]:g}, {ends[1]:g}]"
        bounds = parameters.get(name)
        if bounds is not None and (ends[0] < bounds.min or ends[1] > bounds.max):
            raise ProblemError(
                f"{key}{unit_after(bounds.unit)} leaves the bounds [{bounds.min:g}, {bounds.max:g}] that this file "
                f"gives {name}; keep inside, or change min and max: min = {min(ends[0], bounds.min):g}, "
                f"max = {max(ends[1], bounds.max):g}"
            )
        if name in DELAYS and table.controller is not None:
            _check_delay(key, ends[1], table.controller.sample_rate_hz)
    try:
        check_ranges(ranges, plants)
    except SeaoptError as error:
        raise ProblemError(f"robustness.parameters: {error}") from error


def _check_delay(key: str, longest_s: float, rate_hz: float) -> None:
    """Refuse a delay of many samples: each is a state of every draw's plant, and takes its time."""
    if longest_s * rate_hz > MAX_LINK_DELAY_SAMPLES * (1.0 + 1e-9):
        raise ProblemError(
            f"{key} s reaches {longest_s * rate_hz:.4g} sample times of controller.sample_rate_hz = {rate_hz:g}, and "
            f"takes at most {MAX_LINK_DELAY_SAMPLES} ({MAX_LINK_DELAY_SAMPLES / rate_hz:g} s); it is in seconds, and "
            f"a delay that is always there is controller.drive_delay_s = {longest_s:g}"
        )


def _check_experiment(experiment: ExperimentTable, plant: Plant) -> None:
    key = f"experiment.{experiment.name}"
    if (experiment.log is None) == (experiment.virtual is None):
        raise ProblemError(f'{key}: give either log or virtual, and not both: log = "NAME.csv"')
    if experiment.log is not None:
        driven = any(name not in plant.optional_inputs for name in plant.inputs)
        if not experiment.outputs or (driven and not experiment.inputs):
            first = experiment.log if isinstance(experiment.log, str) else next(iter(experiment.log), "LOG")
            raise ProblemError(
                f"{key}: a log needs time, inputs and outputs; name their columns, as outputs = "
                f'{{ NAME = "COLUMN" }} (seaopt inspect {shlex.quote(first)} --list lists them)'
            )
        check_inside(key, experiment)
    for kind, names, valid in (
        ("inputs", experiment.inputs, plant.inputs),
        ("outputs", experiment.outputs, {**plant.outputs, **experiment.differences}),
    ):
        for name in names:
            if name not in valid:
                remedy = suggestion(name, valid)
                if kind == "outputs" and read_header(name).quantity == "speed":
                    position = plant.sensing.motor_position if plant.sensing is not None else None
                    remedy += (
                        "; a speed that a device computed from a position is declared with differences = "
                        f'{{ {name} = {{ of = "{position or next(iter(plant.outputs))}" }} }}'
                    )
                raise ProblemError(f'{key}.{kind} names "{name}"; {remedy}')


def range_remarks(
    ranges: Mapping[str, tuple[float, float]], plants: Mapping[str, Plant], nominal: ParameterSet
) -> list[str]:
    """Return a remark on each range that turns an angle past a right one, or leaves out a nominal mode."""
    remarks: list[str] = []
    modes = find_modes(plants)
    angles = {name for plant in plants.values() for name, unit in plant.states.items() if unit == "rad"}
    for name, (low, high) in ranges.items():
        key = f"robustness.parameters.{name} = [{low:g}, {high:g}]"
        if name in modes and not _reaches_mode(name, (low, high), modes[name], plants, nominal):
            remarks.append(f"{key} Hz leaves out the nominal mode, so that no draw is like the nominal plant")
        if name in angles and max(-low, high) > 0.5 * math.pi:
            ends = f"{math.degrees(low):.4g} to {math.degrees(high):.4g}"
            remarks.append(f"{key} is in rad: {ends} degrees, beyond a right angle; keep it if that is meant")
    return remarks


def _reaches_mode(
    name: str, ends_hz: tuple[float, float], plant: Plant, plants: Mapping[str, Plant], nominal: ParameterSet
) -> bool:
    """Tell whether the nominal value is between those that put a mode at the ends of its range."""
    assert plant.mode is not None and plant.mode.parameter is not None
    placed = (place_value(plant, nominal, name, end, plants) for end in ends_hz)
    values = [parameters[plant.mode.parameter].value for parameters in placed if parameters is not None]
    return min(values) <= plant.complete(nominal)[plant.mode.parameter].value <= max(values)


def guess_remarks(
    guessed: Sequence[str],
    ranges: Mapping[str, tuple[float, float]],
    plants: Mapping[str, Plant],
    nominal: ParameterSet,
) -> list[str]:
    """Return a remark that names the guesses that are not varied, with ranges to vary them in. `guessed`: names of
    parameters, among words for other entries. What has a std in `nominal`, of a fit or as a prior, is drawn.
    """
    used = {name for plant in plants.values() for name in plant.parameters} - {parameter.name for parameter in HEAT}
    unknown = [nominal[name] for name in guessed if name in used and name not in ranges]
    fixed = [parameter for parameter in unknown if parameter.std is None and parameter.prior_std is None]
    if not fixed:
        return []
    proposed = ", ".join(
        f"{guess.name} = [{max(low, guess.min):.3g}, {min(high, guess.max):.3g}]"
        for guess in fixed
        if guess.value  # 0 says nothing of its size
        for low, high in [sorted((0.5 * guess.value, 2.0 * guess.value))]
    )
    names, what = join_words([parameter.name for parameter in fixed]), "a guess" if len(fixed) == 1 else "guesses"
    each = "a range that contains the true value" if len(fixed) == 1 else "ranges that contain the true values"
    return [
        f"the certificate does not vary {names}, {what}; add {each} to [robustness]"
        + (f": parameters = {{ {proposed} }}" if proposed else "")
    ]
