"""The cases of a certificate, a law on its plants with each friction sliding and stuck, and what a check makes of them.

A schedule is the law that it is at each of its points and between them. A check measures the cases of a law, or what
those of a schedule say together, and gives evidence: requirements, fields of the certificate, and remarks. `certify`
asks each that applies, one after the other: a check may read what those before it found.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import field, replace
from hashlib import sha256
from typing import Any

import numpy as np

from seaopt.bench import Sensors
from seaopt.control import Controller, ForceMPC, ScheduledController
from seaopt.control.laws.delay import Drive, find_drive, find_given_drive_delay, split_delayed
from seaopt.control.loops.sampled_plant import DELAYS, DRIVE_DELAY
from seaopt.control.running.fed_back import split_states
from seaopt.control.scheduling.scheduled_controller import PARTS, list_inner
from seaopt.errors import ControlError
from seaopt.estimation import Fit
from seaopt.executors import Shared
from seaopt.frequency import MeasuredResponse
from seaopt.options import check_options, option
from seaopt.parameters import Parameter, ParameterSet
from seaopt.plants import Plant
from seaopt.plants.friction import name_states
from seaopt.plants.motor.thermal import AMBIENT, find_warm_range
from seaopt.progress import Progress, divide
from seaopt.records import record
from seaopt.robustness.bounds.bracket import Budget
from seaopt.robustness.certificate.requirement import DESIGN_PLANT, MIN_FRICTION_MARGIN, CheckScope, Requirement, Spot
from seaopt.robustness.uncertainty.draws import Plants, Ranges, Source, Uncertainty, check_ranges, combine_uncertainty
from seaopt.robustness.uncertainty.worst import place_values

CONFIDENCE = 1.0 - 1e-6
MOST_DELAY_SAMPLES = 20  # samples
ENDED = "a requirement is not met, and what takes long was left out from there on"
DESIGN_NAMES = ("design", DESIGN_PLANT)  # of the design plant where the caller does not list it
Draw = Mapping[str, float]
Subject = Controller | ScheduledController | ForceMPC


@record
class CertifyOptions:
    """The numbers that `certify` and `tune_certified` take, with their ranges."""

    samples: int = option("Draws.", default=1375, least=1)
    seed: int = option("Of the draws and of simulated noise.", default=1, least=0)
    confidence: float = option("Of the failure probability's bound.", default=CONFIDENCE, above=0.0, below=1.0)
    max_failure_probability: float | None = option("Required of that bound.", default=None, above=0.0, most=1.0)
    min_friction_margin: float | None = option("Slope, N s/m (N m s/rad).", default=None, above=0.0)
    min_rate: float | None = option("Of the schedule's variable, in its unit per second.", default=None, above=0.0)
    runs: int = option("Runs with limits active.", default=100, least=1)
    bound_tolerance: float = option("Share of half the width of a signal's bounds.", default=0.1, least=0.0)
    command_step: float = option("What the command is rounded to, in its unit.", default=0.0, least=0.0)
    rounds: int = option("Of tuning and certifying.", default=6, least=1)


def check_numbers(**numbers: Any) -> None:
    """Refuse numbers that are out of the range of `CertifyOptions`."""
    check_options(CertifyOptions(**numbers), ControlError)


@record(eq=False)
class Cases:
    """A law on its plants, and what is uncertain of them."""

    controller: Controller
    models: Mapping[str, Plant]  # as they are, with their friction
    unknown: Uncertainty
    # Those whose loops are measured, with what terms feed back of them: one with friction is there sliding and stuck.
    plants: Mapping[str, Plant]
    bounds: Budget | None = None  # the work to spend on bounds of each worst case; none without

    @property
    def spots(self) -> dict[str, Spot]:
        """Plant and state of friction behind each name of `plants`."""
        states = name_states(self.models, self.unknown.nominal, [row.name for row in self.unknown.varied()])
        return {label: Spot(*state) for label, state in states.items()}

    def place(self, name: str, draws: Sequence[Draw]) -> list[ParameterSet]:
        """Return the parameters of the model of a name at draws."""
        return [place_values(self.models[name], self.unknown.nominal, draw) for draw in draws]


@record(eq=False)
class CheckContext:
    """The cases of one law, how they are to be measured, and what earlier checks found."""

    subject: Subject
    shared: Shared[Cases]  # of the subject's law, of predictive control in its linear region
    source: Source
    options: CertifyOptions
    drawing: np.random.Generator  # of the draws that are counted
    rng: np.random.Generator  # of all others
    supplement: ParameterSet = field(default_factory=ParameterSet)  # of parameters that the source does not have
    place: tuple[str, float] | None = None  # a schedule's variable and its value; draws are then judged together
    point: bool = True  # whether the law was tuned for just this
    steps: bool = True  # whether steps are simulated,
    simulations: bool = True  # and all scenarios,
    large_signals: bool = True  # with sweeps of amplitudes
    thorough: bool = True  # else what takes long is left out once a requirement is broken,
    broken: bool = False  # as one is already, of another value of the schedule
    sensors: Sensors | None = None
    measured: Mapping[str, MeasuredResponse] = field(default_factory=dict[str, MeasuredResponse])
    executor: Executor | None = None
    places: Sequence[CheckContext] = ()  # of a schedule as a whole: those of its values
    found: Mapping[str, Any] = field(default_factory=dict[str, Any])  # fields of the certificate, of earlier checks

    @property
    def devices(self) -> dict[str, Any]:
        """What runs read with, and what their command is rounded to."""
        return {"sensors": self.sensors, "command_step": self.options.command_step}

    @property
    def cases(self) -> Cases:
        """The cases as they are in this process."""
        return self.shared.value

    @property
    def schedule(self) -> ScheduledController:
        """The subject of a check of a schedule as a whole."""
        assert isinstance(self.subject, ScheduledController)
        return self.subject

    @property
    def plan(self) -> ForceMPC | None:
        """The subject where it is predictive control."""
        return self.subject if isinstance(self.subject, ForceMPC) else None

    @property
    def ends_early(self) -> bool:
        """Whether what takes long is left out: a requirement is broken, or will be, as a draw fails."""
        draws = self.found.get("monte_carlo")
        return not self.thorough and (self.broken or (draws is not None and draws.failures > 0))

    @property
    def samples(self) -> int:
        """Draws: none where nothing is uncertain."""
        return self.options.samples if self.cases.unknown.size else 0

    @property
    def min_friction_margin(self) -> float | None:
        """The larger of what the options and the specification ask."""
        slopes = (self.options.min_friction_margin, self.cases.controller.spec.level(MIN_FRICTION_MARGIN))
        return max((slope for slope in slopes if slope is not None), default=None)


@record(eq=False)
class Evidence:
    """What a check found."""

    requirements: Sequence[Requirement] = ()
    fields: Mapping[str, Any] = field(default_factory=dict[str, Any])  # of the certificate
    remarks: tuple[str, ...] = ()
    scope: CheckScope = ""  # of the requirements, and
    risk: float | None = None  # the check's share of the risk, of those that state none themselves


@record(eq=False)
class Check:
    """One thing to look at; `seconds` that it takes as a rule."""

    measure: Callable[[CheckContext, Progress], Evidence]
    seconds: Callable[[CheckContext], float] = lambda _: 0.0
    applies: Callable[[CheckContext], bool] = lambda context: bool(context.cases.models)
    # Whether it is asked where a requirement is broken already, and what takes long is then left out.
    brief: Callable[[CheckContext], bool] = lambda _: False


def ask(checks: Sequence[Check], context: CheckContext, progress: Progress) -> Evidence:
    """Return what each of some checks that applies finds, with the fields that were found before."""
    applicable = [check for check in checks if check.applies(context)]
    rows, remarks = list[Requirement](), list[str]()
    for check, part in zip(
        applicable, divide(progress, *(check.seconds(context) for check in applicable)), strict=True
    ):
        if context.ends_early and not check.brief(context):
            remarks += [] if ENDED in remarks else [ENDED]
            continue
        evidence = check.measure(context, part)
        for row in evidence.requirements:
            risk = evidence.risk if row.risk is None else row.risk
            rows.append(replace(row, place=row.place or context.place, scope=evidence.scope, risk=risk))
        remarks += evidence.remarks
        broken = context.broken or not all(row.met for row in evidence.requirements)
        context = replace(context, found={**context.found, **evidence.fields}, broken=broken)
    return Evidence(requirements=rows, fields=context.found, remarks=tuple(remarks))


def count_seconds(checks: Sequence[Check], context: CheckContext) -> float:
    """Return how long the checks that apply take as a rule."""
    return sum(check.seconds(context) for check in checks if check.applies(context))


def pose(
    law: Controller | ScheduledController,
    plants: Plants,
    parameters: Source,
    ranges: Ranges,
    supplement: ParameterSet,
    bounds: Budget | None = None,
) -> dict[float | None, Cases]:
    """Return the cases of a law, by None; of a schedule those of the law frozen at each value at which it is certified,
    its points and between them. Raises ControlError: the variable has a range, or is estimated by the fit.
    """
    if isinstance(law, Controller):
        return {None: pose_cases(law, plants, parameters, ranges, supplement, bounds)}
    over, posed = law.over, dict[float | None, Cases]()
    if over in ranges:
        raise ControlError(f"range of {over}: the schedule is over it, and its points are its range; take it out")
    if isinstance(parameters, Fit) and over in parameters.covariance.names:
        raise ControlError(
            f"{over} is estimated by the fit, and the schedule is over it; fix it in the experiments that are fitted"
        )
    # What it was tuned on besides is judged by the checks, with all other plants; a feedforward finds its link there.
    alone = law if law.spec.link_feedforward else replace(law, others={})
    for value in sorted({*law.points, *list_inner(law.points, PARTS)}):
        variable, source, other = Parameter(name=over, value=value, unit=law.unit), parameters, supplement
        if isinstance(source, ParameterSet):
            source = source.with_parameters(variable)
        elif over in source.parameters:
            source = replace(source, parameters=source.parameters.with_parameters(variable))
        else:
            other = other.with_parameters(variable)
        posed[value] = pose_cases(alone.at(value), plants, source, ranges, other, bounds)
    return posed


def pose_cases(
    controller: Controller,
    plants: Plants,
    parameters: Source,
    ranges: Ranges,
    supplement: ParameterSet,
    bounds: Budget | None = None,
) -> Cases:
    """Return a controller on its plants, the design plant's among them, with what is uncertain of them."""
    if controller.design is None:  # designed on a measured response
        nominal = parameters.parameters if isinstance(parameters, Fit) else parameters
        nothing = Uncertainty(nominal=nominal, names=(), covariance=np.zeros((0, 0)), ranges={})
        return Cases(controller=controller, models={}, plants={}, unknown=nothing)
    design, values = controller.design
    seen = {name: controller.see(plant) for name, plant in plants.items()}
    models = add_design(design, seen)
    if len(models) > len(seen):  # the design plant has its own values of what nobody else gives
        missing = (values[name] for name in values if name in design.parameters and name not in supplement)
        supplement = supplement.with_parameters(*missing)
    models = split_delayed(controller.spec, design, models, parameters)
    ranges = _add_warm_winding(ranges, models, parameters, supplement)
    unknown = combine_uncertainty(parameters, supplement, ranges, models, find_own_drive(controller, parameters))
    _check_delay(controller, unknown.ranges)
    plants = split_states(controller, models, unknown.nominal, [row.name for row in unknown.varied()])
    return Cases(controller=controller, models=models, plants=plants, unknown=unknown, bounds=bounds)


def add_design(design: Plant, plants: Plants) -> dict[str, Plant]:
    """Return the plants with the design plant first, by a name that is free, where it is not among them."""
    if any(plant is design for plant in plants.values()):
        return dict(plants)
    name = next((name for name in DESIGN_NAMES if name not in plants), None)
    if name is None:
        taken = '" and "'.join(DESIGN_NAMES)
        raise ControlError(f'plants other than the design plant are called "{taken}"; give one of them another name')
    return {name: design, **plants}


def find_own_drive(controller: Controller, source: Source) -> Drive | None:
    """Return a certificate's delay of the drive: the fit's or the parameters', or else what the law counts on."""
    assert controller.design is not None
    counted = Drive(delay_s=controller.drive_delay_s)
    has_own = DRIVE_DELAY in (source.parameters if isinstance(source, Fit) else source)
    stated = isinstance(source, Fit) or has_own or find_given_drive_delay(controller.spec) is not None
    drive = find_drive(controller.spec, controller.design[0], source) if stated else counted
    return drive if drive.delay_s or counted.delay_s or has_own else None


def digest_laws(*laws: Controller) -> int:
    """Return a number of some laws for other draws at the same seed; six digits, alike on two machines."""
    coefficients = (
        f"{value:.6g}" for law in laws for part in (law.reference, law.measurement) for value in (*part.num, *part.den)
    )
    return int.from_bytes(sha256(" ".join(coefficients).encode()).digest()[:8], "big")


def _add_warm_winding(
    ranges: Ranges, models: Plants, parameters: Source, supplement: ParameterSet
) -> dict[str, tuple[float, float]]:
    """Return the ranges with the temperatures of every winding that changes its loop, and those given for the air."""
    fitted = parameters.parameters if isinstance(parameters, Fit) else parameters
    values = supplement.with_parameters(*fitted.values())
    warm = [ends for plant in models.values() if (ends := find_warm_range(plant, values)) is not None]
    if not warm:
        return dict(ranges)
    check_ranges(ranges, models)
    lows, highs = zip(*warm, *([ranges[AMBIENT]] if AMBIENT in ranges else []), strict=True)
    return {**ranges, AMBIENT: (min(lows), max(highs))}


def _check_delay(controller: Controller, ranges: Ranges) -> None:
    """Refuse delays of so many samples that a plant with them is no plant to control."""
    period = controller.sample_time_s
    for name in DELAYS:
        high = ranges[name][1] if name in ranges else 0.0
        if high > MOST_DELAY_SAMPLES * period:
            raise ControlError(
                f"range of {name} reaches {high:g} s, {high / period:.0f} samples; delays are in seconds, and up to "
                f"{MOST_DELAY_SAMPLES} samples ({MOST_DELAY_SAMPLES * period:g} s) are certified"
            )
