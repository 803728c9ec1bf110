"""Certificates read from robustness.json and schedule_robustness.json; linear figures are computed again.

Null stands for what is infinite: the value of a requirement that an unstable plant breaks, a bound that there is not.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import field, fields, replace
from typing import Annotated, Any, Literal

from seaopt.bench import Sensors
from seaopt.codec import Constraints, OrInfinite, from_content
from seaopt.control import Controller, ScheduledController
from seaopt.control.laws.limits import BY_REQUIREMENT
from seaopt.errors import FileError, SeaoptError
from seaopt.files import check_seal, plain
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.plants.friction import split_friction
from seaopt.records import record
from seaopt.robustness.bounds.bracket import Bracket
from seaopt.robustness.bounds.stretch import StretchBound
from seaopt.robustness.certificate.cases import DESIGN_NAMES, Cases
from seaopt.robustness.certificate.certificate import NO_MODEL, Certificate
from seaopt.robustness.certificate.compensation import (
    FRICTION_COMPENSATION,
    CompensationDraws,
    find_nominal_compensation,
)
from seaopt.robustness.certificate.constrained import ConstrainedRuns
from seaopt.robustness.certificate.friction import FrictionDraws, find_nominal_margins
from seaopt.robustness.certificate.impedance import ImpedanceDraws, certify_impedance
from seaopt.robustness.certificate.requirement import KEPT_TO, DrawnAt, Requirement
from seaopt.robustness.certificate.scheduled import ScheduleCertificate
from seaopt.robustness.certificate.simulated import Simulated, find_port_figures
from seaopt.robustness.uncertainty.draws import Varied
from seaopt.robustness.uncertainty.failure_probability import MonteCarlo
from seaopt.robustness.uncertainty.plant_margins import plant_margins
from seaopt.robustness.uncertainty.worst import Worst, combine_worst, measure_worst
from seaopt.robustness.verification.impedance_steps import ImpedanceStep
from seaopt.robustness.verification.large_signal import LargeSignal
from seaopt.robustness.verification.limit_cycles import FoundCycle
from seaopt.robustness.verification.playback import STEP_IN_FILE
from seaopt.robustness.verification.schedule_motion import Motion
from seaopt.robustness.verification.schedule_sweep import Sweep
from seaopt.robustness.verification.verification import Verification, make_stages

FILE, SCHEDULE_FILE, CERTIFY_AGAIN = "robustness.json", "schedule_robustness.json", "certify again"
OLDER_TOLERANCE = 0.5  # of a bandwidth, of which older files do not say whether a law was tuned for it


@record
class StoredRequirement:
    """A figure against its limit; `where`, in words, is all that older files have of what follows it."""

    name: str
    limit: OrInfinite
    value: OrInfinite
    met: bool
    where: str
    sense: Literal["≤", "≥", "="] | None = None
    tolerance: Annotated[float, Constraints(ge=0.0, le=0.5)] | None = None
    unit: str = ""
    plant: str | None = None
    state: str = ""
    place: Annotated[dict[str, float], Constraints(min_length=1, max_length=1)] | None = None
    scenario: str = ""
    draw: DrawnAt | None = None
    text: str = ""
    remedy: str = ""
    count: Annotated[int, Constraints(ge=1)] = 1

    def build(self) -> Requirement:
        """Return the row; of an older file, which does not say it, one that is to be equal may be off by a half."""
        sense, names = self.sense or find_sense(self.name), {each.name for each in fields(Requirement)}
        older: dict[str, Any] = {
            "plant": self.plant or "",
            "sense": sense,
            "tolerance": (OLDER_TOLERANCE if sense == "=" else KEPT_TO) if self.tolerance is None else self.tolerance,
            "place": None if self.place is None else next(iter(self.place.items())),
            "text": self.where if self.plant is None else self.text,
        }
        return Requirement(**{name: getattr(self, name) for name in names - older.keys()}, **older)


def find_sense(name: str) -> str:
    """Return what a requirement's value must be to its limit, as a sign, of a law that was tuned."""
    if name in BY_REQUIREMENT:
        return BY_REQUIREMENT[name].symbol
    return "≥" if name == FRICTION_COMPENSATION or name.startswith("min_") else "≤"


@record
class StoredWorst:
    """The parameters of a worst case, and of the largest Ms and Mt."""

    parameters: dict[str, float]
    largest: dict[str, DrawnAt] = field(default_factory=dict[str, DrawnAt])

    @property
    def cases(self) -> list[Mapping[str, float]]:
        """The parameters of the worst case, and those of the largest Ms and Mt."""
        return [self.parameters, *(each.parameters for each in self.largest.values())]


@record
class StoredPlant:
    """A plant: its worst case."""

    worst: StoredWorst


@record
class StoredSimulation:
    """The devices of the scenarios, sweeps of amplitudes, and why something is missing."""

    json_names = STEP_IN_FILE

    sensors: Sensors
    command_step: float
    seed: int
    large_signal: tuple[LargeSignal, ...]
    left_out: Mapping[str, str]


@record
class StoredFriction:
    """The margin of a plant with friction, of which all but draws and limit cycles is found again."""

    draws: FrictionDraws | None = None
    limit_cycles: tuple[FoundCycle, ...] = ()


@record
class StoredImpedance:
    """The impedance at the link; all but draws and simulated steps is computed again."""

    draws: ImpedanceDraws | None = None
    steps: tuple[ImpedanceStep, ...] = ()


@record
class StoredCompensation:
    """The margin of a plant whose friction is compensated from the speed, of which all but the draws is found again."""

    draws: CompensationDraws | None = None


@record(eq=False)
class StoredCertificate:
    """A robustness.json."""

    requirements: list[StoredRequirement]
    plants: dict[str, StoredPlant]
    monte_carlo: MonteCarlo
    varied: tuple[Varied, ...] = ()
    steps: Mapping[str, Any] = field(default_factory=dict[str, Any])
    simulation: StoredSimulation | None = None
    remarks: tuple[str, ...] = ()
    friction: dict[str, StoredFriction] = field(default_factory=dict[str, StoredFriction])
    impedance: StoredImpedance | None = None
    compensation: dict[str, StoredCompensation] = field(default_factory=dict[str, StoredCompensation])
    constrained: ConstrainedRuns | None = None


@record
class StoredRequirements:
    """The rows of a robustness.json, or of a schedule_robustness.json."""

    requirements: list[StoredRequirement]


def read_certificate(content: Mapping[str, Any]) -> StoredCertificate:
    """Return what a certificate needs of a robustness.json; one that was edited or written by hand is refused."""
    check_seal(content, FILE, CERTIFY_AGAIN)
    return from_content(StoredCertificate, content, FILE, remedy=CERTIFY_AGAIN)


def build_certificate(
    content: Mapping[str, Any],
    controller: Controller,
    models: Mapping[str, Plant],
    parameters: ParameterSet,
    place: tuple[str, float] | None = None,
) -> Certificate:
    """Return the certificate of a robustness.json, as `Certificate.from_dict` does."""
    stored = read_certificate(content)
    requirements = read_requirements(stored.requirements)
    if controller.design is not None:  # certified too where nobody listed it
        models = dict.fromkeys(DESIGN_NAMES, controller.design[0]) | dict(models)
    varied, names = stored.varied, [row.name for row in stored.varied]
    states = {name: split_friction({name: plant}, parameters, names) for name, plant in models.items()}
    models = {name: plant for name, plant in models.items() if any(state in stored.plants for state in states[name])}
    plants = {state: plant for name in models for state, plant in states[name].items()}
    for name in stored.plants:
        if name not in plants:
            raise FileError(f'{FILE}: plants has "{name}", which is not a plant given; {CERTIFY_AGAIN}')
    impedance = stored.impedance or StoredImpedance()
    try:
        linear = {name: plants[name] for name in stored.plants}
        worst = {name: content["plants"][name]["worst"] for name in linear}
        certificate = Certificate(
            requirements=requirements,
            place=place,
            plants={name: controller.close(plant, parameters).figures() for name, plant in linear.items()},
            margins={
                name: plant_margins(controller, plant, parameters)
                for name, plant in linear.items()
                if "nu_gap" in content["plants"][name]
            },
            worst={
                name: _measure_again(controller, plant, parameters, stored.plants[name].worst.cases)
                for name, plant in linear.items()
            },
            monte_carlo=stored.monte_carlo,
            controller=controller,
            models=models,
            parameters=parameters,
            varied=varied,
            brackets={
                name: from_content(Bracket, case, FILE, remedy=CERTIFY_AGAIN)
                for name, case in worst.items()
                if "ms_upper" in case  # bounds were asked for
            },
            friction=find_nominal_margins(controller, models, parameters),
            friction_draws={name: each.draws for name, each in stored.friction.items() if each.draws},
            compensation=find_nominal_compensation(controller, models, parameters),
            compensation_draws={name: each.draws for name, each in stored.compensation.items() if each.draws},
            impedance=certify_impedance(controller, models, parameters, impedance.draws, impedance.steps),
            constrained=stored.constrained,
            remarks=stored.remarks,
        )
        return _restore_runs(certificate, stored, plain(content))
    except FileError:
        raise
    except SeaoptError as error:
        raise FileError(f"{FILE}: {error}; {CERTIFY_AGAIN}") from error


def _restore_runs(certificate: Certificate, stored: StoredCertificate, content: Mapping[str, Any]) -> Certificate:
    """Return a certificate with what its file says of steps, limit cycles and scenarios."""
    if not certificate.models:
        return replace(certificate, steps=NO_MODEL)
    runs, played = certificate.constrained, stored.simulation
    draws = {name: (certificate.parameters, *drawn) for name, drawn in certificate.list_draws().items()}

    def restore(rows: Mapping[str, Any], sensors: Sensors | None, command_step: float) -> Verification | None:
        stages = make_stages(certificate.controller, certificate.simulated_models, sensors, command_step)
        return Verification.from_dict(rows, stages, draws, FILE, CERTIFY_AGAIN) if "rows" in rows else None

    devices = (None, 0.0) if runs is None else (runs.sensors, runs.command_step)
    steps = restore(stored.steps, *devices) if "rows" in stored.steps else stored.steps.get("left_out")
    cycles = {
        name: friction.limit_cycles
        for name, friction in stored.friction.items()
        if steps is not None and name in certificate.simulated_models
        if friction.limit_cycles or not certificate.shows_friction_harmless(name)
    }
    certificate = replace(certificate, steps=steps, cycles=cycles)
    if played is None:
        return certificate
    simulated = Simulated(
        verification=restore(content["simulation"], played.sensors, played.command_step),
        **{each.name: getattr(played, each.name) for each in fields(played)},
        **find_port_figures(certificate.controller),
    )
    return replace(certificate, simulated=simulated)


@record(eq=False)
class _StoredSchedule:
    """A schedule_robustness.json."""

    requirements: list[StoredRequirement]
    places: tuple[Mapping[str, Any], ...]
    monte_carlo: MonteCarlo
    stretches: tuple[StretchBound, ...]
    sweeps: Mapping[str, tuple[Sweep, ...]]
    motions: Mapping[str, Motion]


def build_schedule_certificate(
    content: Mapping[str, Any], schedule: ScheduledController, cases: Mapping[float, Cases]
) -> ScheduleCertificate:
    """Return the certificate of a schedule_robustness.json, as `ScheduleCertificate.from_dict` does."""
    check_seal(content, SCHEDULE_FILE, CERTIFY_AGAIN)
    stored = from_content(_StoredSchedule, content, SCHEDULE_FILE, remedy=CERTIFY_AGAIN)
    if len(stored.places) != len(cases):
        raise FileError(
            f"{SCHEDULE_FILE}: has {len(stored.places)} places, and the schedule {len(cases)}; {CERTIFY_AGAIN}"
        )
    return ScheduleCertificate(
        schedule=schedule,
        places=tuple(
            build_certificate(place, posed.controller, posed.models, posed.unknown.nominal, (schedule.over, value))
            for place, (value, posed) in zip(stored.places, cases.items(), strict=True)
        ),
        monte_carlo=stored.monte_carlo,
        stretches=stored.stretches,
        sweeps=stored.sweeps,
        motions=stored.motions,
        requirements=read_requirements(stored.requirements, SCHEDULE_FILE),
    )


def _measure_again(
    controller: Controller, plant: Plant, nominal: ParameterSet, cases: Sequence[Mapping[str, float]]
) -> Worst:
    """Return a worst case from parameters that a file keeps, its loops closed again."""
    return combine_worst([measure_worst(controller, plant, nominal, at) for at in cases])


def list_requirements(content: Mapping[str, Any], source: str) -> tuple[Requirement, ...]:
    """Return the rows of a certificate as it was read from a file, judged again as `read_requirements` does."""
    stored = from_content(StoredRequirements, content, source, remedy=CERTIFY_AGAIN)
    return read_requirements(stored.requirements, source)


def read_requirements(stored: Sequence[StoredRequirement], source: str = FILE) -> tuple[Requirement, ...]:
    """Return the rows of a certificate. Refuses one without any, which would pass whatever it is of, and a row that is
    called met but breaks its limit.
    """
    if not stored:
        raise FileError(f"{source}: requirements is empty, and a certificate requires something; {CERTIFY_AGAIN}")
    rows = tuple(row.build() for row in stored)
    for row in rows:
        sense = find_sense(row.name)
        if row.sense not in (sense, "≥" if sense == "=" else sense):  # a law that is given may have more
            raise FileError(
                f"{source}: requirements: {row.name} has the sense {row.sense}, and must be {sense} its limit; "
                f"{CERTIFY_AGAIN}"
            )
        if row.met and not row.keeps:
            raise FileError(
                f"{source}: requirements: {row.name} is called met, and its value {row.value:g} is not {row.sense} "
                f"{row.limit:g}; {CERTIFY_AGAIN}"
            )
    return rows
