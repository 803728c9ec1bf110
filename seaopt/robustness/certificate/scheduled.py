"""Certify a schedule: with its variable standing still at the points, between them, and in sweeps.

What is said, and how it is known:

- **at the points and at three values in every stretch between two** (checked): the limits at the nominal parameters, on
  every plant; draws of what is uncertain, spread evenly over these values; at the points also the worst case that a
  search finds, and `seaopt.certify` with its simulations on the plants that hold the variable by themselves;
- **at every value of the table** (proved, rounding estimated, of the nominal parameters): each frozen loop is stable,
  and its Ms below a bound (`seaopt.robustness.bounds.stretch`);
- **while the variable moves** (simulated): sweeps at growing rates with the law as it is exported
  (`seaopt.robustness.verification.schedule_sweep`). That the variable moves slowly is an assumption of all the rest,
  and the fastest sweep that keeps its judgement puts a number to it;
- **while the plant moves the variable** (simulated): pushes of the reference that move it at that rate, or the one that
  is required (`seaopt.robustness.verification.schedule_motion`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import replace
from functools import partial
from hashlib import sha256
from itertools import pairwise
from typing import Any

import numpy as np
from jaxtyping import Float

from seaopt.bench import Sensors
from seaopt.codec import to_content
from seaopt.control import Controller, LoopFigures, ScheduledController
from seaopt.control.laws.delay import split_delayed
from seaopt.control.loops.sampled_plant import conditions
from seaopt.control.scheduling.scheduled_controller import PARTS, list_inner, place_variable
from seaopt.errors import ControlError, require_number, require_seed, require_type
from seaopt.estimation import Fit
from seaopt.executors import Shared, check_executor, map_ordered
from seaopt.formatting import format_count, join_words
from seaopt.parameters import Parameter, ParameterSet
from seaopt.plants import Plant
from seaopt.plants.friction import name_states, split_friction
from seaopt.progress import Progress, count_off, divide, ignore
from seaopt.records import Result, Worded, record
from seaopt.robustness.bounds.stretch import StretchBound, bound_stretch
from seaopt.robustness.certificate.certificate import Certificate
from seaopt.robustness.certificate.certify import CONFIDENCE, add_design, certify, failure_bound, find_own_drive
from seaopt.robustness.certificate.friction import find_margins_at_draws, find_nominal_margins
from seaopt.robustness.certificate.measured_draws import Failures, Loops
from seaopt.robustness.certificate.requirement import MIN_FRICTION_MARGIN, Requirement, Spot
from seaopt.robustness.certificate.requirements import (
    design_requirements,
    draw_requirements,
    friction_requirements,
    plant_requirements,
)
from seaopt.robustness.uncertainty.batch import batch_figures
from seaopt.robustness.uncertainty.draws import Uncertainty, combine_uncertainty, find_modes
from seaopt.robustness.uncertainty.failure_probability import MonteCarlo
from seaopt.robustness.uncertainty.severity import find_failures
from seaopt.robustness.uncertainty.worst import Worst, find_worst
from seaopt.robustness.verification.schedule_motion import Motion, describe_motion, move_plants
from seaopt.robustness.verification.schedule_sweep import Sweep, describe_sweeps, find_fastest, sweep_schedule
from seaopt.units import unit_after

SCHEDULE_ROBUSTNESS_SCHEMA = "seaopt/schedule_robustness/1"
MOTION_RATE = "min_motion_rate"
POINT, BOUND, SWEEP = 4.0, 0.2, 5.0  # seconds that a part takes as a rule: of a point, a stretch, the sweeps of a plant


@record(eq=False)
class PlaceCertificate(Result):
    """What was found with the variable standing at one value.

    Parameters
    ----------
    value : float
        Of the variable.
    point : bool
        Whether the gains were tuned there.
    plants : mapping of name to LoopFigures
        At the nominal parameters; one with friction twice.
    worst : mapping of name to Worst
        The worst case found; empty between the points.
    draws, unstable, over_ms, over_mt : int
        Draws there, and how many of them fail in which way.
    requirements : tuple of Requirement
        Of the nominal parameters, and of what was simulated.
    simulated : Certificate or None
        What `certify` found on the plants that hold the variable; None between the points, or where there is none.

    """

    value: float
    point: bool
    plants: Mapping[str, LoopFigures]
    worst: Mapping[str, Worst]
    draws: int
    unstable: int
    over_ms: int
    over_mt: int
    requirements: tuple[Requirement, ...]
    simulated: Certificate | None = None

    @property
    def met(self) -> bool:
        """Whether every requirement there is met."""
        return all(row.met for row in self.requirements)

    def on(self, plants: Mapping[str, Plant]) -> PlaceCertificate:
        """Return the same of plants that equal its own (`Worst.on`)."""
        return replace(self, worst={name: case.on(plants[name]) for name, case in self.worst.items()})

    @property
    def ms(self) -> float:
        """The largest Ms of its plants at the nominal parameters."""
        return max(one.ms for one in self.plants.values())

    @property
    def worst_ms(self) -> float | None:
        """The largest Ms of the worst cases that were searched for; None between the points."""
        return max((one.ms for one in self.worst.values()), default=None)


@record(eq=False, repr=False)
class ScheduleCertificate(Result, Worded):
    """What `certify_schedule` returns.

    Parameters
    ----------
    schedule : ScheduledController
        What was certified.
    places : tuple of PlaceCertificate
        At the points and between them, ascending.
    monte_carlo : MonteCarlo
        All draws, spread evenly over the places.
    stretches : tuple of StretchBound
        What is proved between neighbouring places.
    sweeps : mapping of name to tuple of Sweep
        Of each plant that has the variable.
    motions : mapping of name to Motion
        Of each plant that moves the variable.
    requirements : tuple of Requirement
        All of them.

    """

    schedule: ScheduledController
    places: tuple[PlaceCertificate, ...]
    monte_carlo: MonteCarlo
    stretches: tuple[StretchBound, ...]
    sweeps: Mapping[str, tuple[Sweep, ...]]
    motions: Mapping[str, Motion]
    requirements: tuple[Requirement, ...]

    @property
    def met(self) -> bool:
        """Whether every requirement is met."""
        return all(row.met for row in self.requirements)

    @property
    def fastest(self) -> float:
        """The largest rate of the variable at which every plant keeps its judgement in a sweep; zero for none."""
        return min((find_fastest(sweeps) for sweeps in self.sweeps.values()), default=0.0)

    @property
    def rate_unit(self) -> str:
        """Unit of `fastest`."""
        return f"{unit_after(self.schedule.unit).strip()}/s"

    @property
    def assumption(self) -> str:
        """What is assumed of the variable's motion, with the number that the simulations give it."""
        over, rate = self.schedule.over, f"{self.fastest:.3g} {self.rate_unit}"
        if not self.sweeps:
            return (
                f"{over} is assumed to move slowly: the limits hold with it standing still, and no sweep was simulated"
            )
        if not self.fastest:
            return f"{over} is assumed to stand still: the slowest sweep that was simulated does not keep its judgement"
        return (
            f"{over} is assumed to move slowly: the limits hold with it standing still, and sweeps of up to {rate} "
            "keep the judgement of a step in simulation"
        )

    @property
    def proof(self) -> str:
        """What is proved between the points, and what is not."""
        over, first, last = self.schedule.over, self.schedule.points[0], self.schedule.points[-1]
        missing = [one for one in self.stretches if not one.shown]
        shown = [one.ms for one in self.stretches if one.shown]
        if not missing:
            return (
                f"for every {over} from {first:g} to {last:g}, standing still, at the nominal parameters: stable, Ms "
                f"below {_round_up(max(shown))}, proved"
            )
        spans = [f"{over} = {one.low:.4g} to {one.high:.4g} on {one.plant}" for one in missing[:3]]
        more = [f"{len(missing) - 3} more"] if len(missing) > 3 else []
        where = join_words([*spans, *more])
        return f"nothing is proved between the values that were looked at for {where}: {missing[0].reason}"

    @property
    def notes(self) -> tuple[str, ...]:
        """What is proved, assumed and simulated, one sentence each."""
        unit, over = self.rate_unit, self.schedule.over
        swept = (f"{name}: {describe_sweeps(sweeps, unit)}" for name, sweeps in self.sweeps.items())
        moved = (f"{name}: {describe_motion(motion, over, unit)}" for name, motion in self.motions.items())
        return (self.proof, self.assumption, *swept, *moved)

    def to_dict(self) -> dict[str, Any]:
        """Return the content of schedule_robustness.json (schema seaopt/schedule_robustness/1)."""
        return {
            "schema": SCHEDULE_ROBUSTNESS_SCHEMA,
            "met": self.met,
            "passed": self.met,
            "over": self.schedule.over,
            "unit": self.schedule.unit,
            "requirements": [row.to_dict() for row in self.requirements],
            "places": [
                {
                    "met": place.met,
                    "value": place.value,
                    "point": place.point,
                    "plants": {
                        name: {key: getattr(one, key) for key in ("stable", "bandwidth_hz", "ms", "mt", "disk_margin")}
                        for name, one in place.plants.items()
                    },
                    "worst": {
                        name: {
                            "parameters": one.parameters,
                            "ms": one.ms,
                            "mt": one.mt,
                            "largest": {
                                figure: at.parameters for figure, at in zip(("ms", "mt"), one.largest, strict=True)
                            },
                        }
                        for name, one in place.worst.items()
                    },
                    "draws": place.draws,
                    "unstable": place.unstable,
                    "over_ms": place.over_ms,
                    "over_mt": place.over_mt,
                    "simulated": None if place.simulated is None else place.simulated.to_dict(),
                }
                for place in self.places
            ],
            "monte_carlo": to_content(self.monte_carlo),
            "stretches": to_content(self.stretches),
            "sweeps": to_content(self.sweeps),
            "motions": to_content(self.motions),
            "fastest_rate": self.fastest,
            "rate_unit": self.rate_unit,
            "proof": self.proof,
            "assumption": self.assumption,
            "notes": list(self.notes),
        }

    @classmethod
    def from_dict(
        cls,
        content: Mapping[str, Any],
        schedule: ScheduledController,
        plants: Mapping[str, Plant],
        parameters: Fit | ParameterSet,
        *,
        ranges: Mapping[str, tuple[float, float]] | None = None,
        others: ParameterSet | None = None,
    ) -> ScheduleCertificate:
        """Return the certificate of a schedule_robustness.json; nothing is simulated.

        Linear figures are computed again. Arguments are those of `certify_schedule`.

        Raises
        ------
        FileError
            A field is missing or malformed, it was edited or written by hand, or nothing is required in it.

        """
        from seaopt.robustness.certificate.stored import build_schedule_certificate  # deferred: pydantic

        given = find_standing(schedule, plants, parameters, dict(ranges or {}), others or ParameterSet())
        return build_schedule_certificate(content, schedule, given)


def certify_schedule(
    schedule: ScheduledController,
    plants: Mapping[str, Plant],
    parameters: Fit | ParameterSet,
    *,
    ranges: Mapping[str, tuple[float, float]] | None = None,
    others: ParameterSet | None = None,
    samples: int = 1375,
    seed: int = 1,
    confidence: float = CONFIDENCE,
    max_failure_probability: float | None = None,
    min_rate: float | None = None,
    simulations: bool = True,
    sensors: Sensors | None = None,
    current_step_A: float = 0.0,
    executor: Executor | None = None,
    progress: Progress = ignore,
) -> ScheduleCertificate:
    """Check a schedule against plants, with its variable standing still and in sweeps.

    Parameters
    ----------
    schedule : ScheduledController
        The gains.
    plants : mapping of name to Plant
        Plants on which it must pass; the design plant is certified too.
    parameters, ranges, others, samples, seed, confidence, max_failure_probability, sensors, current_step_A
        As in `seaopt.certify`; the draws are spread evenly over the points and the values between them. What the
        schedule is over has no range: its points are it.
    min_rate : float, optional
        Required of the fastest sweep that keeps its judgement, and reached by a plant that moves the variable itself,
        in the variable's unit per second; if left out, the rates are stated, not required.
    simulations : bool
        Simulate the points on the plants that hold the variable, and the sweeps.
    executor : concurrent.futures.Executor, optional
        Where values, stretches and sweeps are worked on (`seaopt.executors`); here, if left out. The result is the
        same, bit for bit.
    progress : callable, optional
        Called with what is done and the share of it that is done.

    Raises
    ------
    ControlError
        As `seaopt.certify`; the variable has a range, or is estimated by the fit.

    Examples
    --------
    >>> import seaopt as so
    >>> from seaopt.robustness import certify_schedule
    >>> from seaopt.control import tune_schedule
    >>> stand, thor = so.plants.high_impedance(), so.plants.thor()
    >>> spec = so.ControllerSpec(bandwidth_hz=20, max_sensitivity=1.6)
    >>> schedule = tune_schedule(stand, thor, spec, "k", [5e5, 6e5])
    >>> certificate = certify_schedule(schedule, {"stand": stand}, thor, simulations=False)
    >>> certificate.passed, all(one.shown for one in certificate.stretches)
    (True, True)

    """
    require_type(schedule, ScheduledController, "schedule", "give a ScheduledController", ControlError)
    require_type(parameters, (Fit, ParameterSet), "parameters", "give a Fit or a ParameterSet", ControlError)
    check_executor(executor, ControlError)
    if min_rate is not None and not require_number(min_rate, "min_rate", ControlError) > 0.0:
        raise ControlError(f"min_rate = {min_rate:g} is not positive; give a rate in {schedule.unit}/s")
    ranges, others = dict(ranges or {}), others or ParameterSet()
    _check_variable(schedule, parameters, ranges)
    given = find_standing(schedule, plants, parameters, ranges, others)
    models, values, unknowns, sources = given.models, given.values, given.unknowns, given.sources
    standing, proving, sweeping = divide(
        progress, POINT * len(schedule.points), BOUND * len(values) * len(models), SWEEP * len(models) * simulations
    )
    count = -(-samples // len(values))
    rng = np.random.default_rng([require_seed(seed, ControlError), *_digest(schedule)])
    drawn = [unknown.draw(count if unknown.size else 0, rng) for unknown in unknowns]
    shared, nominal = Shared((schedule, models)), unknowns[-1].nominal
    parts = zip(values, unknowns, drawn, rng.spawn(len(values)), strict=True)
    standing_at = map_ordered(partial(_certify_place, shared), parts, executor)
    places: list[PlaceCertificate] = []
    for number, value in enumerate(count_off(values, f"value of {schedule.over}", standing)):
        place, (source, rest) = next(standing_at).on(split_states(models, unknowns[number])), sources[number]
        if held := list_held(schedule, models, value):
            simulated = certify(
                schedule.at(value),
                held,
                source,
                ranges=_choose_ranges(ranges, held),
                others=rest,
                samples=count,
                seed=seed,
                simulations=simulations,
                sensors=sensors if simulations else None,
                current_step_A=current_step_A if simulations else 0.0,
                executor=executor,
            )
            place = _add_simulations(schedule, place, simulated)
        places.append(place)
    pairs = list(pairwise(values))
    bounds = map_ordered(partial(_bound_plants, shared, nominal), pairs, executor)
    stretches = [bound for _ in count_off(pairs, "stretch", proving) for bound in next(bounds)]
    sweeps: dict[str, tuple[Sweep, ...]] = {}
    for name in count_off(list(models), "sweeps, plant", sweeping) if simulations else ():
        found = sweep_schedule(schedule, name, models[name], nominal, executor=executor)
        sweeps |= {name: found} if found else {}
    draws = _count_draws(places, seed, confidence)
    spots = {
        value: {
            label: spot._replace(place=(schedule.over, value)) for label, spot in _name_spots(models, unknown).items()
        }
        for value, unknown in zip(values, unknowns, strict=True)
    }
    certificate = ScheduleCertificate(
        schedule=schedule,
        places=tuple(places),
        monte_carlo=draws,
        stretches=tuple(stretches),
        sweeps=sweeps,
        motions={},
        requirements=(
            *(row for place in places for row in place.requirements),
            *_require_limits_between(schedule),
            *_require_draws(places, spots, draws, max_failure_probability),
        ),
    )
    progress(f"{format_count(len(places), 'value')} of {schedule.over}", 1.0)
    if not sweeps:
        return certificate
    slowest = min(found[0].rate for found in sweeps.values())
    motions = move_plants(schedule, models, nominal, min_rate or certificate.fastest or slowest)
    return replace(
        certificate,
        motions=motions,
        requirements=(
            *certificate.requirements,
            *_require_rate(certificate, min_rate),
            *(_require_motion(motion, schedule.over, certificate.rate_unit, min_rate) for motion in motions.values()),
        ),
    )


@record(eq=False)
class Standing:
    """What a schedule is certified at: plants, values of its variable, and at each what is known and uncertain."""

    models: dict[str, Plant]
    values: tuple[float, ...]
    sources: tuple[tuple[Fit | ParameterSet, ParameterSet], ...]  # and others
    unknowns: tuple[Uncertainty, ...]


def find_standing(
    schedule: ScheduledController,
    plants: Mapping[str, Plant],
    parameters: Fit | ParameterSet,
    ranges: Mapping[str, tuple[float, float]],
    others: ParameterSet,
) -> Standing:
    """Return what a schedule is certified at: its points and the values between them, with the design plant."""
    models = add_design(schedule.design[0], plants)
    models = split_delayed(schedule.spec, schedule.design[0], models, parameters)
    values = tuple(sorted({*schedule.points, *list_inner(schedule.points, PARTS)}))
    sources = tuple(_place_source(schedule, parameters, others, value) for value in values)
    drive = find_own_drive(schedule.controllers[0], parameters)
    unknowns = tuple(combine_uncertainty(source, rest, ranges, models, drive) for source, rest in sources)
    return Standing(models=models, values=values, sources=sources, unknowns=unknowns)


def _check_variable(
    schedule: ScheduledController, parameters: Fit | ParameterSet, ranges: Mapping[str, tuple[float, float]]
) -> None:
    over = schedule.over
    if over in ranges:
        raise ControlError(f"range of {over}: the schedule is over it, and its points are its range; take it out")
    if isinstance(parameters, Fit) and over in parameters.covariance.names:
        raise ControlError(
            f"{over} is estimated by the fit, and the schedule is over it; fix it in the experiments that are fitted"
        )


def _place_source(
    schedule: ScheduledController, parameters: Fit | ParameterSet, others: ParameterSet, value: float
) -> tuple[Fit | ParameterSet, ParameterSet]:
    """Return what is known of the parameters, and the others, with the variable at a value."""
    here = Parameter(name=schedule.over, value=value, unit=schedule.unit)
    if isinstance(parameters, ParameterSet):
        return parameters.with_parameters(here), others
    if schedule.over in parameters.parameters:
        return replace(parameters, parameters=parameters.parameters.with_parameters(here)), others
    return parameters, others.with_parameters(here)


_Scheduled = tuple[ScheduledController, dict[str, Plant]]


def split_states(models: Mapping[str, Plant], unknown: Uncertainty) -> dict[str, Plant]:
    """Return the plants whose loops are measured: one with friction is there sliding and stuck."""
    return split_friction(models, unknown.nominal, [row.name for row in unknown.varied()])


def _name_spots(models: Mapping[str, Plant], unknown: Uncertainty) -> dict[str, Spot]:
    """Return plant and state behind each name of `split_states`."""
    states = name_states(models, unknown.nominal, [row.name for row in unknown.varied()])
    return {label: Spot(*state) for label, state in states.items()}


def _certify_place(
    shared: Shared[_Scheduled], part: tuple[float, Uncertainty, Float[np.ndarray, "n k"], np.random.Generator]
) -> PlaceCertificate:
    """Check the law at one value: the nominal parameters, draws and, at a point, a search for the worst case."""
    (schedule, models), (value, unknown, points, rng) = shared.value, part
    controller, point, plants = schedule.at(value), value in schedule.points, split_states(models, unknown)
    figures = {name: controller.close(plant, unknown.nominal).figures() for name, plant in plants.items()}
    failures = _count_failures(controller, plants, unknown, points)
    spots = _name_spots(models, unknown)
    rows = [row for name, spot in spots.items() for row in plant_requirements(controller, spot, figures[name])]
    rows += _require_friction(schedule, models, value, unknown, len(points), rng)
    if point:
        design, _ = schedule.design
        rows += design_requirements(controller, design, unknown.nominal)
    return PlaceCertificate(
        value=value,
        point=point,
        plants=figures,
        worst={name: find_worst(controller, plant, unknown, points) for name, plant in plants.items()} if point else {},
        draws=len(points),
        unstable=failures.unstable,
        over_ms=failures.over_ms,
        over_mt=failures.over_mt,
        requirements=_place(schedule, value, rows),
    )


def list_held(schedule: ScheduledController, models: Mapping[str, Plant], value: float) -> dict[str, Plant]:
    """Return the plants that `certify` takes: at a point those that hold the variable, if the design plant does.

    Where a plant moves the variable, a law that is frozen there is not what runs.
    """
    held = {name: plant for name, plant in models.items() if schedule.over not in plant.states}
    design, _ = schedule.design
    return held if value in schedule.points and any(plant is design for plant in held.values()) else {}


def _require_friction(
    schedule: ScheduledController,
    models: Mapping[str, Plant],
    value: float,
    unknown: Uncertainty,
    samples: int,
    rng: np.random.Generator,
) -> list[Requirement]:
    """Return the friction margins asked at a value, of the plants that `certify` does not take there."""
    controller, held = schedule.at(value), list_held(schedule, models, value)
    least = controller.spec.level(MIN_FRICTION_MARGIN)
    apart = {name: plant for name, plant in models.items() if name not in held}
    if least is None or not apart:
        return []
    margins = find_nominal_margins(controller, apart, unknown.nominal)
    loops = Loops(controller=controller, models=apart, plants=apart, unknown=unknown, bounds=None)
    draws = find_margins_at_draws(Shared(loops), margins, samples, rng, least)
    return friction_requirements(margins, draws, least, controller.command.mechanics.damping)


def _count_failures(
    controller: Controller, plants: Mapping[str, Plant], unknown: Uncertainty, points: Float[np.ndarray, "n k"]
) -> Failures:
    """Count the draws that fail on some plant, as `certify` does."""
    failed, drawn = np.zeros((3, len(points)), dtype=bool), unknown.values(points)
    for plant in plants.values() if len(points) else ():
        failed |= find_failures(controller, batch_figures(controller, plant, unknown.nominal, drawn))
    failures = Failures()
    failures.add(failed)
    return failures


def _place(schedule: ScheduledController, value: float, rows: Sequence[Requirement]) -> tuple[Requirement, ...]:
    return tuple(replace(row, place=(schedule.over, value)) for row in rows)


def _choose_ranges(
    ranges: Mapping[str, tuple[float, float]], plants: Mapping[str, Plant]
) -> dict[str, tuple[float, float]]:
    """Return the ranges of what some of these plants have."""
    known = {*conditions(tuple(plants.values())), *find_modes(plants)}.union(
        *(one.parameters for one in plants.values())
    )
    return {name: ends for name, ends in ranges.items() if name in known}


def _add_simulations(
    schedule: ScheduledController, place: PlaceCertificate, certificate: Certificate
) -> PlaceCertificate:
    """Return a point with the certificate of the plants that hold the variable there."""
    known = {(row.name, row.plant, row.state) for row in place.requirements}
    rows = _place(schedule, place.value, certificate.requirements)
    new = tuple(row for row in rows if (row.name, row.plant, row.state) not in known)
    return replace(place, simulated=certificate, requirements=(*place.requirements, *new))


def _bound_plants(
    shared: Shared[_Scheduled], nominal: ParameterSet, stretch: tuple[float, float]
) -> list[StretchBound]:
    """Return what is proved of every plant on the stretch between two neighbouring values."""
    (schedule, models), (low, high) = shared.value, stretch
    middle = schedule.at(0.5 * (low + high))
    out: list[StretchBound] = []
    for name, plant in split_friction(models, nominal).items():
        values = place_variable(plant, nominal, schedule.over, 0.5 * (low + high))
        out.append(bound_stretch(name, middle, schedule.table, plant, values, low, high))
    return out


def _count_draws(places: Sequence[PlaceCertificate], seed: int, confidence: float) -> MonteCarlo:
    unstable, over_ms, over_mt, samples = (
        sum(getattr(place, name) for place in places) for name in ("unstable", "over_ms", "over_mt", "draws")
    )
    failures = unstable + over_ms + over_mt
    return MonteCarlo(
        samples=samples,
        failures=failures,
        seed=seed,
        confidence=confidence,
        unstable=unstable,
        over_ms=over_ms,
        over_mt=over_mt,
        failure_probability_bound=failure_bound(samples, failures, confidence),
    )


def _require_draws(
    places: Sequence[PlaceCertificate],
    spots: Mapping[float, Mapping[str, Spot]],
    draws: MonteCarlo,
    max_failure_probability: float | None,
) -> list[Requirement]:
    """Return what the draws require, the worst case found at a point beside them."""
    worst = {spots[place.value][name]: case for place in places for name, case in place.worst.items()}
    return draw_requirements(draws, worst, max_failure_probability)


def _require_limits_between(schedule: ScheduledController) -> list[Requirement]:
    """Return that the design plant's limits hold between the points, 0.9 of the bandwidth asked among them."""
    return [
        Requirement(
            name="limits_between_points",
            limit=0.0,
            value=float(len(place.broken)),
            met=not place.broken,
            place=(schedule.over, place.value),
            text=", ".join(place.broken),
            remedy=schedule.remedy if place.broken else "",
        )
        for place in schedule.between
    ]


def _require_rate(certificate: ScheduleCertificate, least: float | None) -> list[Requirement]:
    """Return that sweeps keep their judgement: the slowest at all, and as fast as asked."""
    rows: list[Requirement] = []
    for sweeps in certificate.sweeps.values():
        fastest, faults = find_fastest(sweeps), [sweep.fault for sweep in sweeps if sweep.fault]
        asked = sweeps[0].rate if least is None else least
        text = faults[0] if faults else f"the fastest tried is {sweeps[-1].rate:.3g} {certificate.rate_unit}"
        rows.append(
            Requirement(
                name="min_schedule_rate",
                limit=asked,
                value=fastest,
                met=fastest >= asked,
                sense="≥",
                unit=certificate.rate_unit,
                plant=sweeps[0].plant,
                scenario="sweep",
                text=text,
            )
        )
    return rows


def _require_motion(motion: Motion, over: str, unit: str, least: float | None) -> Requirement:
    """Return that a plant that moves the variable keeps its judgement: at the rate reached at all, or as asked.

    What keeps its judgement at less than was asked is not met: nothing is known of the rate that was.
    """
    asked = motion.rate if least is None else least
    short = not motion.fault and motion.rate < asked
    return Requirement(
        name=MOTION_RATE,
        limit=asked,
        value=0.0 if motion.fault else motion.rate,
        met=not motion.fault and not short,
        sense="≥",
        unit=unit,
        plant=motion.plant,
        text=describe_motion(motion, over, unit),
        remedy="ask a smaller min_rate, or give the command a higher limit" if short else "",
    )


def _digest(schedule: ScheduledController) -> tuple[int, ...]:
    """Return numbers of the law's own, so that another law meets other draws at the same seed."""
    text = " ".join(f"{value:.6g}" for row in schedule.table.gains.values() for value in row)
    return tuple(int(word) for word in np.frombuffer(sha256(text.encode()).digest()[:16], dtype=np.uint32))


def _round_up(value: float) -> str:
    """Return a number with three decimals, rounded up."""
    return f"{np.ceil(1e3 * value) / 1e3:.3f}"
