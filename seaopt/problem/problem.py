"""A problem: plants, parameters, experiments, controller specification and robustness, as one TOML file states them."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from seaopt.bench import Chirp, Excitation, Multisine, Noise, Sensors, virtual_log
from seaopt.control import ControllerSpec, MPCSpec
from seaopt.control import draw as draw_values
from seaopt.control.laws.delay import LoopSpec, find_drive, find_drive_delay, take_own_delays
from seaopt.control.loops.sampled_plant import add_drive_delay, find_signals
from seaopt.errors import EstimationError, LogError, ProblemError, SeaoptError, suggestion
from seaopt.estimation import (
    Experiment,
    Fit,
    Huber,
    Method,
    MultipleShooting,
    OutputError,
    PredictionError,
    SoftL1,
    Squares,
)
from seaopt.formatting import format_remedies
from seaopt.frequency import MeasuredResponse, measure_response
from seaopt.logs import Counter, Log, Readings, read_log
from seaopt.parameters import Parameter, ParameterSet
from seaopt.plants import DifferencedSpeed, Plant
from seaopt.plants.plant import name_input
from seaopt.problem.bench_tables import (
    ColumnTable,
    EquationsTable,
    ExperimentTable,
    FitTable,
    UnknownTable,
    VirtualTable,
)
from seaopt.problem.columns import check_links, list_log_files, make_column, make_rule
from seaopt.problem.equations import list_partners, list_unused, order_plants
from seaopt.problem.option_tables import make_record
from seaopt.problem.parameters import make_parameter
from seaopt.problem.references import RESPONSE, guess_remarks, range_remarks
from seaopt.problem.schema import ControllerTable, ProblemTable, RobustnessTable, ScheduleTable
from seaopt.records import record
from seaopt.robustness import place_value
from seaopt.signals import Signal
from seaopt.simulation import Clock
from seaopt.units import same_dimension

WRITE_ONE = "add one, or write a file from a log: seaopt new LOG"
OWN = "parameter "  # before the name of a parameter that is read as a channel
ROUNDED = 1e-9  # relative: a constant column that was interpolated to another clock


@record(eq=False)
class Problem:
    """What a problem file describes; logs are read, or made, when asked for.

    Parameters
    ----------
    title : str
    source : str
        The file, for messages.
    folder : Path
        Relative paths of logs start here.
    parameters : ParameterSet
        Values of the file over the plants' defaults.
    plants : mapping of name to Plant
    table : ProblemTable
        The validated file.
    spec : ControllerSpec or None
        What is asked of the controller; of predictive control while no limit of its plan is active.
    mpc : MPCSpec or None
        What is asked of predictive control, with structure = "mpc".
    refused : str
        What is wrong in the tables of a design, where the file was read without them: `read_problem(design=False)`.
    """

    title: str
    source: str
    folder: Path
    parameters: ParameterSet
    plants: Mapping[str, Plant]
    table: ProblemTable
    spec: ControllerSpec | None
    mpc: MPCSpec | None = None
    refused: str = ""

    @property
    def fit_options(self) -> dict[str, Any]:
        """Keyword arguments for `seaopt.fit`."""
        table: FitTable = self.table.fit
        return {
            "method": _make_method(table),
            "loss": {"linear": Squares(), "huber": Huber(), "soft_l1": SoftL1()}[table.loss],
            "band_hz": table.band_hz,
            "holdout": table.holdout,
            "causes": table.causes,
        }

    @property
    def controller_table(self) -> ControllerTable:
        """The file's [controller].

        Raises ProblemError: there is none; the message says what is wrong in it, or how to add one.
        """
        if self.table.controller is not None:
            return self.table.controller
        least = f'controller = {{ plant = "{next(iter(self.plants), "stand")}", bandwidth_hz = 30 }}'
        raise ProblemError(self.refused or f"{self.source}: has no [controller]; add one to tune or certify: {least}")

    @property
    def design_plant(self) -> Plant:
        """The plant that the controller is designed on; of a measured response, what was on the bench."""
        on_bench = {f"{RESPONSE}{experiment.name}": experiment.plant for experiment in self.table.experiment}
        return self.plants[on_bench.get(self.controller_table.plant, self.controller_table.plant)]

    @property
    def schedule(self) -> ScheduleTable | None:
        """What the controller's gains are scheduled over; None for one law for all."""
        return None if self.table.controller is None else self.table.controller.schedule

    @property
    def designs_on_response(self) -> bool:
        """Whether the controller is designed on a measured response, without a model."""
        return self.table.controller is not None and self.table.controller.plant.startswith(RESPONSE)

    @property
    def response_names(self) -> tuple[str, ...]:
        """The measured responses that the controller is tuned on, such as frf:chirp."""
        controller = self.table.controller
        names = [] if controller is None else [controller.plant, *controller.robust_to]
        return tuple(dict.fromkeys(name for name in names if name.startswith(RESPONSE)))

    def measure_responses(self, source: Fit | ParameterSet) -> dict[str, MeasuredResponse]:
        """Return the measured responses that the controller is tuned on, by name.

        The delay that an experiment is known to have, given or fitted, is in its response already.
        Raises SeaoptError: a log cannot be read, or does not allow a frequency response.
        """
        responses: dict[str, MeasuredResponse] = {}
        for name in self.response_names:
            table = next(experiment for experiment in self.table.experiment if f"{RESPONSE}{experiment.name}" == name)
            try:
                experiment = self._make_experiment(table)
                there = experiment.apply_own(self.values(source))
                response = measure_response(
                    experiment.plant,
                    experiment.log,
                    find_signals(experiment.plant, self.controller_table.measured),
                    name=experiment.name,
                    confidence=self.controller_table.frf_confidence,
                    clock=Clock(
                        period=experiment.log.period, hold=experiment.hold, delay_s=_find_delay(experiment, source)
                    ),
                )
                responses[name] = replace(response, values={key: there[key].value for key in experiment.parameters})
            except SeaoptError as error:
                raise type(error)(f"{self.source}: {name}: {error}") from error
        return responses

    @property
    def notes(self) -> list[str]:
        """What of the file may be a mistake: what it declares and does not use."""
        tables = {name: table for name, table in self.table.plant.items() if isinstance(table, EquationsTable)}
        notes = [f"plant.{name}.{text}" for name, table in tables.items() for text in list_unused(table)]
        used = {name for plant in self.plants.values() for name in plant.parameters}
        for name in self.table.parameters:
            if name not in used and self.plants:
                remedy = suggestion(name, sorted(used - self.table.parameters.keys()))
                notes.append(f"parameters.{name} is of no plant of this file; {remedy}")
        return notes

    @property
    def robustness(self) -> RobustnessTable:
        """What the controller must survive; every plant if the file does not say, but for those that others name."""
        if self.table.robustness is not None:
            return self.table.robustness
        partners = {partner for table in self.table.plant.values() for partner in list_partners(table)}
        return RobustnessTable(plants=[name for name in self.plants if name not in partners])

    def with_partners(self, names: Iterable[str]) -> list[str]:
        """Return plants and those that they hold or probe with, in the file's order."""
        wanted = set(names)
        for name in reversed(order_plants(self.table.plant)):  # those that name others first
            if name in wanted:
                wanted |= set(list_partners(self.table.plant[name]))
        return [name for name in self.plants if name in wanted]

    @property
    def ranges(self) -> dict[str, tuple[float, float]]:
        """Ranges of parameters besides the fit's covariance."""
        return dict(self.robustness.parameters)

    @property
    def sensors(self) -> Sensors:
        """What the certificate's simulations read the measured output with."""
        return make_record(Sensors, self.robustness.sensors)

    def certified_plants(self) -> dict[str, Plant]:
        """Return the design plant and those of [robustness], by name; none where all is measured."""
        controller = self.controller_table
        names = [name for name in (controller.plant, *controller.robust_to) if not name.startswith(RESPONSE)]
        names += [] if self.table.impedance is None else [self.table.impedance.plant]
        if not self.designs_on_response or self.table.robustness is not None:
            names += self.robustness.plants
        return {name: self.plants[name] for name in dict.fromkeys(names)}

    def remarks(self, parameters: ParameterSet) -> list[str]:
        """Return remarks on ranges that are valid but may not be meant, at nominal parameters."""
        plants = self.certified_plants()
        return [
            *range_remarks(self.ranges, plants, parameters),
            *guess_remarks(self.table.guessed, self.ranges, plants, parameters),
        ]

    def values(self, source: Fit | ParameterSet, spec: LoopSpec | None = None) -> ParameterSet:
        """Return the values to design with: a fit's, the file's for what it does not have.

        The drive's delay is as the file's specification says, or another that is asked.
        """
        values = self.parameters.with_parameters(*source.parameters.values()) if isinstance(source, Fit) else source
        spec = spec or self.spec or self.mpc
        return values if spec is None else add_drive_delay(values, find_drive_delay(spec, self.design_plant, source))

    def robust_to(
        self, source: Fit | ParameterSet, spec: LoopSpec | None = None
    ) -> dict[str, tuple[Plant, ParameterSet]]:
        """Return the plants of `robust_to`, at the nominal parameters and at the ends of the ranges.

        Each is behind the drive of its own experiments; the delays are as in `values`.
        """
        spec = spec or self.spec or self.mpc
        if spec is None:
            return {}
        pairs: dict[str, tuple[Plant, ParameterSet]] = {}
        parameters, plants = self.values(source, spec), take_own_delays(spec, self.design_plant, self.plants, source)
        for name in self.controller_table.robust_to:
            if name.startswith(RESPONSE):
                continue
            plant = plants[name]
            values = plant.complete(parameters).drop_conditions()
            pairs[name] = (plant, values)
            for parameter, ends in self.ranges.items():
                for end in ends:
                    corner = place_value(plant, values, parameter, end, self.certified_plants())
                    if corner is not None:
                        pairs[f"{name}, {parameter} = {end:g}"] = (plant, corner)
        return pairs

    def draws(self, source: Fit | ParameterSet) -> list[dict[str, float]]:
        """Return the draws of parameters at which the controller must hold while it is tuned."""
        if self.spec is None or not self.controller_table.draws:
            return []
        drive = find_drive(self.spec, self.design_plant, source)
        return draw_values(source, self.controller_table.draws, self.robustness.seed, self.ranges, drive)

    def experiments(self) -> tuple[Experiment, ...]:
        """Read the logs, and make the virtual ones.

        Raises SeaoptError: a log cannot be read, or does not fit its plant.
        """
        experiments: list[Experiment] = []
        for table in self.table.experiment:
            try:
                experiments.append(self._make_experiment(table))
            except SeaoptError as error:
                where = "" if isinstance(error, EstimationError) else f"experiment {table.name}: "  # it names itself
                raise type(error)(f"{self.source}: {where}{error}") from error
        return tuple(experiments)

    def choose_fitted(self, experiments: Sequence[Experiment]) -> tuple[Experiment, ...]:
        """Return those of the problem's experiments that are fitted; the others are scored (`use = "validate"`)."""
        scored = {table.name for table in self.table.experiment if table.use == "validate"}
        return tuple(experiment for experiment in experiments if experiment.name not in scored)

    def experiment_like(self, log: Path, like: str | None = None, *, keep_slice: bool = False) -> Experiment:
        """Return another log as an experiment that is named after its file, and read as the one of a name.

        `like` is the first experiment if left out; with `keep_slice`, of the same test, its slice_s holds too.
        Raises SeaoptError: there is no such experiment, or the log cannot be read as it would read it.
        """
        renamed = {"name": name_after(log.stem), "log": str(log.resolve())} | ({} if keep_slice else {"slice_s": None})
        template = self.choose_template(like)
        if template.held is not None and not keep_slice:
            raise ProblemError(
                f"{self.source}: held of {template.name} is of its log alone, and {log.name} begins anywhere in the "
                'firmware\'s period; give it an [[experiment]] of its own, with its held, and use = "validate"'
            )
        return self._make_experiment(template.model_copy(update=renamed), anywhere=True)

    def choose_template(self, like: str | None = None) -> ExperimentTable:
        """Return the experiment of a name that has a log; the first, if no name is given.

        Raises ProblemError: there is none.
        """
        tables = {table.name: table for table in self.table.experiment if table.virtual is None}
        if not tables or (like is not None and like not in tables):
            missing = f'experiment "{like}"' if like else "[[experiment]]"
            raise ProblemError(f"{self.source}: has no {missing} with a log to read this one by; add one")
        return tables[like or next(iter(tables))]

    def _make_experiment(self, table: ExperimentTable, *, anywhere: bool = False) -> Experiment:
        """Return an experiment; a log's error names the keys that are its remedy."""
        try:
            return self._read_experiment(table, anywhere=anywhere)
        except LogError as error:
            if not error.keys:
                raise
            raise LogError(format_remedies(str(error), error.keys)) from error

    def _read_experiment(self, table: ExperimentTable, *, anywhere: bool) -> Experiment:
        plant = self.plants[table.plant]
        if table.virtual:
            values = {name: value for name, value in table.parameters.items() if isinstance(value, float | int)}
            log = _compute_speeds(self._simulate_bench(plant, table.virtual, values), table)
        else:
            log = self._read_log(table, anywhere=anywhere)
        if table.slice_s is not None:
            log = log.between(*table.slice_s)
        log = _resample(log, table).decimate(table.decimate)
        if table.held is not None:
            log = log.hold(name_input(plant)[0], table.held.samples, table.held.first)
        columns = {name: column for name, column in table.outputs.items() if isinstance(column, ColumnTable)}
        sigma = table.sigma | {name: column.sigma for name, column in columns.items() if column.sigma is not None}
        return make_record(
            Experiment,
            table,
            plant=plant,
            log=log,
            outputs=_virtual_outputs(plant, table.virtual) if table.virtual else tuple(table.outputs),
            sigma=sigma,
            gain={name: _make_unknown(name, "-", gain) for name, gain in table.gain.items()},
            delay_s=_make_unknown("delay_s", "s", table.delay_s),
            parameters={name: self._make_own(plant, table, name, log) for name in table.parameters},
            differences={name: make_record(DifferencedSpeed, each) for name, each in table.differences.items()},
        )

    def _make_own(self, plant: Plant, table: ExperimentTable, name: str, log: Log) -> float | Parameter:
        """Return a parameter of one log alone: a value, a free one, or the constant of a column or the header."""
        stated, unit = table.parameters[name], plant.parameter_unit(name)
        if isinstance(stated, UnknownTable):
            default, made = plant.defaults.get(name), _make_unknown(name, unit, stated)
            if default is None or not isinstance(made, Parameter):
                return made
            low = made.min if stated.min is not None else min(default.min, made.value)
            return replace(made, min=low, max=made.max if stated.max is not None else max(default.max, made.value))
        if not isinstance(stated, ColumnTable):
            return stated
        signal, where = log.signal(OWN + name), f"experiment {table.name}: parameters: {name}"
        if signal.unit and signal.unit != unit and not same_dimension(signal.unit, unit):
            raise EstimationError(
                f'{where} is in {unit or "no unit"}, and column "{stated.column}" in {signal.unit}; correct the '
                "column's unit"
            )
        value = float(np.median(signal.values))
        if not np.all(np.abs(signal.values - value) <= ROUNDED * abs(value)):
            raise EstimationError(f'{where} is not one value throughout column "{stated.column}"; make it an input')
        return value

    def _read_log(self, table: ExperimentTable, *, anywhere: bool) -> Log:
        """Read an experiment's log; `anywhere`: one that the user named, not the file, may lie outside its folder."""
        check_links(self.folder, [name for name in list_log_files(table) if not (anywhere and name == table.log)])
        constants = {OWN + name: column for name, column in table.parameters.items() if isinstance(column, ColumnTable)}
        channels = {**table.inputs, **table.outputs, **constants}
        return read_log(
            [self.folder / name for name in list_log_files(table)],
            time=None if table.time is None else make_column(table.time, self.folder),
            channels={name: make_column(column, self.folder) for name, column in channels.items()},
            align=make_rule(table.align),
            window_s=table.window_s,
            counter=None if table.counter is None else make_record(Counter, table.counter),
            rate_hz=table.rate_hz,
            duplicates=table.duplicates,
        )

    def _simulate_bench(self, plant: Plant, table: VirtualTable, overrides: Mapping[str, float]) -> Log:
        kinds = {"chirp": Chirp, "noise": Noise, "multisine": Multisine}
        excitation: Excitation = tuple(
            make_record(kind, part)
            for name, kind in kinds.items()
            if (part := getattr(table.excitation, name)) is not None
        )
        values, changed = plant.complete(self.parameters), {**overrides, **table.truth}
        for name in changed:
            if name not in values:
                raise ProblemError(f'{self.source}: truth names "{name}"; {suggestion(name, values)}')
        truth = [replace(parameter, value=changed.get(name, parameter.value)) for name, parameter in values.items()]
        return virtual_log(
            plant,
            ParameterSet(truth),
            excitation,
            duration_s=table.duration_s,
            rate_hz=table.rate_hz,
            seed=table.seed,
            sensors=make_record(Sensors, table),
        )


def _find_delay(experiment: Experiment, source: Fit | ParameterSet) -> float:
    """Return the delay that an experiment is known to have: fitted or given; none where it is still to be fitted."""
    if isinstance(source, Fit) and experiment.name in source.nuisance:
        return source.nuisance[experiment.name].delay_s
    delay = experiment.delay_s
    if isinstance(delay, Parameter):
        return 0.0 if delay.free else delay.value
    return delay


def name_after(stem: str) -> str:
    """Return the name of an experiment that is named after a log file."""
    name = re.sub(r"[^A-Za-z0-9_-]", "_", stem)
    return name if name[:1].isalpha() else f"log_{name}"


def _compute_speeds(log: Log, table: ExperimentTable) -> Log:
    """Return a virtual log with the speeds that a device computes from the positions as they were read."""
    speeds: dict[str, Signal] = {}
    for name, difference in table.differences.items():
        if difference.of not in log.signals:
            near = suggestion(difference.of, log.signals)
            raise EstimationError(f'experiment {table.name}: differences: {name} is of "{difference.of}"; {near}')
        values = make_record(DifferencedSpeed, difference).read(log[difference.of], log.period)
        speeds[name] = Signal(name=name, values=values, unit=f"{log.signals[difference.of].unit}/s")
    return replace(log, signals={**log.signals, **speeds}) if speeds else log


def _resample(log: Log, table: ExperimentTable) -> Log:
    """Return the log on the uniform clock that the file asks for; as it is, if it asks for none."""
    resample = table.resample
    anew = table.decimate > 1 or (resample is not None and resample != "restamp" and resample.rule != "restamp")
    if table.differences and anew:
        raise EstimationError(
            f"experiment {table.name}: {next(iter(table.differences))} is a difference over samples as they were "
            "taken, which decimate and resample do not keep; leave them out, or fit the position"
        )
    if resample is None:
        return log
    if resample == "restamp":
        return log.restamp()
    if resample.rule == "restamp":
        return log.restamp(rate_hz=resample.rate_hz)
    rule = make_rule(resample.rule)
    steps = list(table.inputs) if table.hold == "zero" and isinstance(rule, Readings | None) else []
    return log.resample(rate_hz=resample.rate_hz, rule=rule, steps=steps, bridge_s=resample.bridge_s)


def _make_method(table: FitTable) -> Method:
    if table.segments is not None and table.method != "multiple_shooting":
        raise ProblemError(
            f'[fit] segments = {table.segments} belongs to method = "multiple_shooting", not "{table.method}"; '
            "leave it out"
        )
    if table.method == "multiple_shooting":
        return MultipleShooting() if table.segments is None else MultipleShooting(segments=table.segments)
    return PredictionError() if table.method == "prediction_error" else OutputError()


def _virtual_outputs(plant: Plant, table: VirtualTable) -> tuple[str, ...]:
    """Return the outputs a virtual experiment measures: as listed, else those with noise, else the regulated ones."""
    if table.outputs:
        return tuple(table.outputs)
    noisy = tuple(name for name in plant.outputs if name in table.noise_std)
    forces = plant.sensing.regulated if plant.sensing is not None else ()
    return noisy or forces or tuple(plant.outputs)


def _make_unknown(name: str, unit: str, table: float | UnknownTable) -> float | Parameter:
    made = Parameter(name=name, value=0.0, unit=unit)
    return make_parameter(made, table) if isinstance(table, UnknownTable) else table
