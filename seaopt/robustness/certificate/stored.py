"""Certificates read from robustness.json: linear figures are computed again, and nothing is simulated.

Null stands for what is infinite: the value of a requirement that an unstable plant breaks, a bound that there is not.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import field, fields, replace
from typing import Any

import numpy as np

from seaopt.bench import Sensors
from seaopt.codec import from_content, join_schemas
from seaopt.control import Controller, ForceMPC, LoopFigures, ScheduledController
from seaopt.control.laws.limits import BY_REQUIREMENT
from seaopt.control.running.fed_back import close_whole, feeds_back, split_states
from seaopt.errors import FileError, SeaoptError
from seaopt.files import check_schema, check_seal, plain
from seaopt.records import record
from seaopt.robustness.bounds.bracket import Bracket
from seaopt.robustness.bounds.stretch import StretchBound
from seaopt.robustness.certificate.cases import Cases
from seaopt.robustness.certificate.certificate import NO_MODEL, ROBUSTNESS_SCHEMA, Certificate
from seaopt.robustness.certificate.compensation import FRICTION_COMPENSATION, find_nominal_compensation
from seaopt.robustness.certificate.constrained import ConstrainedRuns
from seaopt.robustness.certificate.friction import MarginDraws, find_nominal_margins
from seaopt.robustness.certificate.impedance import ImpedanceDraws, certify_impedance
from seaopt.robustness.certificate.requirement import DrawnAt, Requirement
from seaopt.robustness.certificate.scheduled import take_worst
from seaopt.robustness.certificate.simulated import Simulated, find_port_figures
from seaopt.robustness.uncertainty.draws import Varied
from seaopt.robustness.uncertainty.failure_probability import MonteCarlo
from seaopt.robustness.uncertainty.logs import LogVerdict
from seaopt.robustness.uncertainty.plant_margins import plant_margins
from seaopt.robustness.uncertainty.worst import combine_worst, measure_worst
from seaopt.robustness.verification.impedance_steps import ImpedanceStep
from seaopt.robustness.verification.large_signal import LargeSignal
from seaopt.robustness.verification.limit_cycles import FoundCycle
from seaopt.robustness.verification.scenarios import WITHIN_LIMIT
from seaopt.robustness.verification.schedule_motion import Motion
from seaopt.robustness.verification.schedule_sweep import Sweep
from seaopt.robustness.verification.verification import Verification, make_rigs

FILE, CERTIFY_AGAIN = "robustness.json", "certify again"
SAME_FIGURES = 1e-5  # of Ms and Mt, below which the loop that a file is of is the one that is closed today


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

    sensors: Sensors
    command_step: float
    seed: int
    large_signal: tuple[LargeSignal, ...]
    left_out: Mapping[str, str]
    unchecked: tuple[str, ...] = ()


@record
class StoredFriction:
    """A plant's margin with friction, or with it compensated: all but draws and limit cycles is found again."""

    draws: MarginDraws | None = None
    limit_cycles: tuple[FoundCycle, ...] = ()


@record
class StoredImpedance:
    """The impedance at the link; all but draws and simulated steps is computed again."""

    draws: ImpedanceDraws | None = None
    steps: tuple[ImpedanceStep, ...] = ()


@record(eq=False)
class StoredCertificate:
    """The robustness.json of one law, or a place in that of a schedule."""

    requirements: tuple[Requirement, ...]
    plants: dict[str, StoredPlant]
    monte_carlo: MonteCarlo
    varied: tuple[Varied, ...] = ()
    steps: Mapping[str, Any] = field(default_factory=dict[str, Any])
    simulation: StoredSimulation | None = None
    remarks: tuple[str, ...] = ()
    friction: dict[str, StoredFriction] = field(default_factory=dict[str, StoredFriction])
    impedance: StoredImpedance | None = None
    compensation: dict[str, StoredFriction] = field(default_factory=dict[str, StoredFriction])
    logs: tuple[LogVerdict, ...] = ()
    constrained: ConstrainedRuns | None = None
    schedule: None = None


@record(eq=False)
class StoredPlaces:
    """What a schedule was certified at, between its points, and while its variable moves."""

    over: str
    places: tuple[StoredCertificate, ...]
    stretches: tuple[StretchBound, ...]
    sweeps: Mapping[str, tuple[Sweep, ...]]
    motions: Mapping[str, Motion]


@record(eq=False)
class StoredScheduleCertificate:
    """The robustness.json of a schedule; its plants and their friction are those of the worst place."""

    requirements: tuple[Requirement, ...]
    plants: dict[str, StoredPlant]
    monte_carlo: MonteCarlo
    schedule: StoredPlaces
    remarks: tuple[str, ...] = ()


@record
class StoredRequirements:
    """The rows of a robustness.json."""

    requirements: tuple[Requirement, ...]


def robustness_schema() -> dict[str, Any]:
    """Return the JSON Schema of a robustness.json: of one law, or of a schedule."""
    return join_schemas(StoredCertificate, StoredScheduleCertificate)


def check_file(content: Mapping[str, Any], *, of_schedule: bool) -> None:
    """Refuse a certificate of another version or of another kind of law, and one that was edited or written by hand
    (FileError).
    """
    check_schema(content, ROBUSTNESS_SCHEMA, FILE, CERTIFY_AGAIN)
    check_seal(content, FILE, CERTIFY_AGAIN)
    if (content.get("schedule") is not None) is not of_schedule:
        kinds = ("one law", "a schedule")
        raise FileError(
            f"{FILE}: is of {kinds[not of_schedule]}, and law is {kinds[of_schedule]}; give the law that it is of, or "
            f"{CERTIFY_AGAIN}"
        )


def read_certificate(content: Mapping[str, Any]) -> StoredCertificate:
    """Return what a certificate needs of a robustness.json; one that was edited or written by hand is refused."""
    check_file(content, of_schedule=False)
    return from_content(StoredCertificate, content, FILE, remedy=CERTIFY_AGAIN)


def build_certificate(
    content: Mapping[str, Any],
    law: Controller | ScheduledController,
    posed: Mapping[float | None, Cases],
    plan: ForceMPC | None = None,
) -> Certificate:
    """Return the certificate of a robustness.json, as `Certificate.from_dict` does."""
    if isinstance(law, Controller):
        (cases,) = posed.values()
        return _build_one(read_certificate(content), content, cases, None, plan)
    check_file(content, of_schedule=True)
    stored = from_content(StoredScheduleCertificate, content, FILE, remedy=CERTIFY_AGAIN)
    of_schedule = stored.schedule
    if len(of_schedule.places) != len(posed):
        raise FileError(f"{FILE}: has {len(of_schedule.places)} places, and the schedule {len(posed)}; {CERTIFY_AGAIN}")
    places = tuple(
        _build_one(stored_at, written, cases, (law.over, value))
        for stored_at, written, (value, cases) in zip(
            of_schedule.places, content["schedule"]["places"], posed.items(), strict=True
        )
        if value is not None
    )
    return Certificate(
        requirements=read_requirements(content),
        monte_carlo=stored.monte_carlo,
        controller=law.controllers[0],
        models=places[-1].models,
        parameters=places[-1].parameters,
        varied=places[-1].varied,
        schedule=law,
        places=places,
        stretches=of_schedule.stretches,
        sweeps=of_schedule.sweeps,
        motions=of_schedule.motions,
        remarks=stored.remarks,
        **take_worst(places),
    )


def _build_one(
    stored: StoredCertificate,
    content: Mapping[str, Any],
    cases: Cases,
    place: tuple[str, float] | None,
    plan: ForceMPC | None = None,
) -> Certificate:
    """Return the certificate of what a robustness.json holds of one law."""
    _check_plan(stored, plan)
    controller, models, parameters = cases.controller, cases.models, cases.unknown.nominal
    varied, names = stored.varied, [row.name for row in stored.varied]
    states = {name: split_states(controller, {name: plant}, parameters, names) for name, plant in models.items()}
    models = {name: plant for name, plant in models.items() if any(state in stored.plants for state in states[name])}
    plants = {state: plant for name in models for state, plant in states[name].items()}
    for name in stored.plants:
        if name not in plants:
            raise FileError(f'{FILE}: plants has "{name}", which is not a plant given; {CERTIFY_AGAIN}')
    impedance = stored.impedance or StoredImpedance()
    linear = {name: plants[name] for name in stored.plants}
    try:
        figures = {name: close_whole(controller, plant, parameters).figures() for name, plant in linear.items()}
        for name, plant in linear.items():
            if feeds_back(controller, plant):
                _check_current(name, content["plants"][name], figures[name])
        worst = {name: content["plants"][name]["worst"] for name in linear}
        certificate = Certificate(
            requirements=read_requirements(content),
            place=place,
            plants=figures,
            margins={
                name: plant_margins(controller, plant, parameters)
                for name, plant in linear.items()
                if "nu_gap" in content["plants"][name]
            },
            worst={
                name: combine_worst(
                    [measure_worst(controller, plant, parameters, at) for at in stored.plants[name].worst.cases]
                )
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
            logs=stored.logs,
            constrained=stored.constrained,
            remarks=stored.remarks,
        )
        return _restore_runs(certificate, stored, plain(content), plan)
    except FileError:
        raise
    except SeaoptError as error:
        raise FileError(f"{FILE}: {error}; {CERTIFY_AGAIN}") from error


def _check_plan(stored: StoredCertificate, plan: ForceMPC | None) -> None:
    """Refuse a certificate of predictive control without its plan, or whose steps are not of it, and one of a law with
    a plan.
    """
    if stored.constrained is None:
        if plan is not None:
            raise FileError(f"{FILE}: is of a law, and not of predictive control; leave out plan, or {CERTIFY_AGAIN}")
        return
    if plan is None:
        raise FileError(f"{FILE}: is of predictive control, whose steps are the plan's; give plan=, the one certified")
    names = [row["scenario"] for row in stored.steps.get("rows", ())]
    if names and not any(name.startswith(WITHIN_LIMIT) for name in names):  # sized without a limit
        raise FileError(
            f'{FILE}: its steps ("{names[0]}") are of the linear region, as an older seaopt played them, and not of '
            f"the plan; {CERTIFY_AGAIN}"
        )


def _check_current(name: str, written: Mapping[str, Any], figures: LoopFigures) -> None:
    """Refuse a plant whose Ms or Mt in a file is of another loop than that with what the law feeds back besides."""
    for key in ("ms", "mt"):
        value, figure = written.get(key), getattr(figures, key)
        if not np.isclose(np.inf if value is None else value, figure, rtol=SAME_FIGURES, atol=0.0):
            raise FileError(
                f"{FILE}: {key} of {name} is {value}, and {figure:.4g} with what the law's compensation and outer loop "
                f"feed back: it is of an older seaopt, or of another law; {CERTIFY_AGAIN}"
            )


def _restore_runs(
    certificate: Certificate, stored: StoredCertificate, content: Mapping[str, Any], plan: ForceMPC | None
) -> Certificate:
    """Return a certificate with what its file says of steps, limit cycles and scenarios."""
    if not certificate.models:
        return replace(certificate, steps=NO_MODEL)
    runs, played = certificate.constrained, stored.simulation
    draws = {name: (certificate.parameters, *drawn) for name, drawn in certificate.list_draws().items()}

    def restore(rows: Mapping[str, Any], sensors: Sensors | None, command_step: float) -> Verification | None:
        rigs = make_rigs(certificate.controller, certificate.simulated_models, sensors, command_step, plan=plan)
        return Verification.from_dict(rows, rigs, draws, FILE, CERTIFY_AGAIN) if "rows" in rows else None

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


def read_requirements(content: Mapping[str, Any], source: str = FILE) -> tuple[Requirement, ...]:
    """Return the rows of a certificate as its file has them. Refuses one without any, which would pass whatever it is
    of, and a row that is called met but breaks its limit.
    """
    stored = from_content(StoredRequirements, content, source, remedy=CERTIFY_AGAIN).requirements
    if not stored:
        raise FileError(f"{source}: requirements is empty, and a certificate requires something; {CERTIFY_AGAIN}")
    places = [next(iter((row.get("place") or {}).items()), None) for row in plain(content["requirements"])]
    rows = tuple(replace(row, place=at) for row, at in zip(stored, places, strict=True))
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


def find_sense(name: str) -> str:
    """Return what a requirement's value must be to its limit, as a sign, of a law that was tuned."""
    if name in BY_REQUIREMENT:
        return BY_REQUIREMENT[name].symbol
    return "≥" if name == FRICTION_COMPENSATION or name.startswith("min_") else "≤"
