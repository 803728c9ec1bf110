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
from jaxtyping import Bool

from seaopt.bench import Sensors
from seaopt.codec import to_content
from seaopt.control import LoopFigures, ScheduledController
from seaopt.control.laws.delay import split_delayed
from seaopt.control.loops.sampled_plant import conditions
from seaopt.control.scheduling.scheduled_controller import PARTS, list_inner, place_variable
from seaopt.errors import ControlError, require_type
from seaopt.estimation import Fit
from seaopt.executors import Shared, check_executor, map_ordered
from seaopt.formatting import format_count, join_words
from seaopt.parameters import Parameter, ParameterSet
from seaopt.plants import Plant
from seaopt.plants.friction import split_friction
from seaopt.progress import Progress, count_off, divide, ignore
from seaopt.records import Result, Worded, record
from seaopt.robustness.bounds.stretch import StretchBound, bound_stretch
from seaopt.robustness.certificate.certificate import Certificate
from seaopt.robustness.certificate.certify import (
    CONFIDENCE,
    add_design,
    certify,
    check_numbers,
    find_own_drive,
    name_spots,
    split_states,
)
from seaopt.robustness.certificate.friction import find_margins_at_draws, find_nominal_margins
from seaopt.robustness.certificate.measured_draws import Loops
from seaopt.robustness.certificate.requirement import MIN_FRICTION_MARGIN, Requirement, Spot
from seaopt.robustness.certificate.requirements import (
    design_requirements,
    draw_requirements,
    friction_requirements,
    plant_requirements,
    require_limits_between,
    require_motion,
    require_rate,
)
from seaopt.robustness.uncertainty.batch import batch_figures
from seaopt.robustness.uncertainty.draws import (
    Plants,
    Points,
    Ranges,
    Source,
    Uncertainty,
    combine_uncertainty,
    find_modes,
)
from seaopt.robustness.uncertainty.failure_probability import MonteCarlo, count_failures
from seaopt.robustness.uncertainty.severity import find_failures
from seaopt.robustness.uncertainty.worst import Worst, find_worst
from seaopt.robustness.verification.schedule_motion import Motion, describe_motion, move_schedule
from seaopt.robustness.verification.schedule_sweep import Sweep, describe_sweeps, find_fastest, sweep_schedule
from seaopt.units import unit_after

SCHEDULE_ROBUSTNESS_SCHEMA = "seaopt/schedule_robustness/1"
POINT, BOUND, SWEEP = 4.0, 0.2, 5.0  # seconds that a part takes as a rule: of a point, a stretch, the sweeps of a plant


@record(eq=False)
class PlaceCertificate(Result):
    """The findings with the variable standing at one value.

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

    def on(self, plants: Plants) -> PlaceCertificate:
        """Return the same of plants that equal its own (`Worst.on`)."""
        return replace(self, worst={name: case.on(plants[name]) for name, case in self.worst.items()})

    def to_dict(self) -> dict[str, Any]:
        """Return what schedule_robustness.json has of it."""
        figures = ("stable", "bandwidth_hz", "ms", "mt", "disk_margin")
        return {
            "met": self.met,
            "value": self.value,
            "point": self.point,
            "plants": {name: {key: getattr(loop, key) for key in figures} for name, loop in self.plants.items()},
            "worst": {
                name: {
                    "parameters": case.parameters,
                    "ms": case.ms,
                    "mt": case.mt,
                    "largest": {"ms": case.largest[0].parameters, "mt": case.largest[1].parameters},
                }
                for name, case in self.worst.items()
            },
            **{name: getattr(self, name) for name in ("draws", "unstable", "over_ms", "over_mt")},
            "simulated": None if self.simulated is None else self.simulated.to_dict(),
        }

    @property
    def ms(self) -> float:
        """The largest Ms of its plants at the nominal parameters."""
        return max(loop.ms for loop in self.plants.values())

    @property
    def worst_ms(self) -> float | None:
        """The largest Ms of the worst cases that were searched for; None between the points."""
        return max((case.ms for case in self.worst.values()), default=None)


@record(eq=False, repr=False)
class ScheduleCertificate(Result, Worded):
    """The result of `certify_schedule`.

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
        return _rate_unit(self.schedule)

    @property
    def assumption(self) -> str:
        """The assumption on the variable's motion, with the number that the simulations give it."""
        over = self.schedule.over
        if self.sweeps and not self.fastest:
            return f"{over} is assumed to stand still: the slowest sweep that was simulated does not keep its judgement"
        swept = f"sweeps of up to {self.fastest:.3g} {self.rate_unit} keep the judgement of a step in simulation"
        motion = swept if self.sweeps else "no sweep was simulated"
        return f"{over} is assumed to move slowly: the limits hold with it standing still, and {motion}"

    @property
    def proof(self) -> str:
        """The statement that is proved between the points, or where none is."""
        over, first, last = self.schedule.over, self.schedule.points[0], self.schedule.points[-1]
        missing = [stretch for stretch in self.stretches if not stretch.shown]
        if not missing:
            largest = np.ceil(1e3 * max(stretch.ms for stretch in self.stretches)) / 1e3
            return (
                f"for every {over} from {first:g} to {last:g}, standing still, at the nominal parameters: stable, Ms "
                f"below {largest:.3f}, proved"
            )
        spans = [f"{over} = {stretch.low:.4g} to {stretch.high:.4g} on {stretch.plant}" for stretch in missing[:3]]
        more = [f"{len(missing) - 3} more"] if len(missing) > 3 else []
        where = join_words([*spans, *more])
        return f"nothing is proved between the values that were looked at for {where}: {missing[0].reason}"

    @property
    def notes(self) -> tuple[str, ...]:
        """Proof, assumption, sweeps and motions, one sentence each."""
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
            "places": [place.to_dict() for place in self.places],
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
        plants: Plants,
        parameters: Source,
        *,
        ranges: Ranges | None = None,
        others: ParameterSet | None = None,
    ) -> ScheduleCertificate:
        """Return the certificate of a schedule_robustness.json; nothing is simulated.

        Linear figures are computed again. Arguments are those of `certify_schedule`. Raises FileError: a field is
        missing or malformed, it was edited or written by hand, or nothing is required in it.
        """
        from seaopt.robustness.certificate.stored import build_schedule_certificate  # deferred: pydantic

        standing = find_standing(schedule, plants, parameters, dict(ranges or {}), others or ParameterSet())
        return build_schedule_certificate(content, schedule, standing)


def certify_schedule(
    schedule: ScheduledController,
    plants: Plants,
    parameters: Source,
    *,
    ranges: Ranges | None = None,
    others: ParameterSet | None = None,
    samples: int = 1375,
    seed: int = 1,
    confidence: float = CONFIDENCE,
    max_failure_probability: float | None = None,
    min_rate: float | None = None,
    simulations: bool = True,
    sensors: Sensors | None = None,
    command_step: float = 0.0,
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
    parameters, ranges, others, samples, seed, confidence, max_failure_probability, sensors, command_step
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
    check_numbers(
        samples=samples,
        seed=seed,
        confidence=confidence,
        max_failure_probability=max_failure_probability,
        min_rate=min_rate,
    )
    ranges, over = dict(ranges or {}), schedule.over
    if over in ranges:
        raise ControlError(f"range of {over}: the schedule is over it, and its points are its range; take it out")
    if isinstance(parameters, Fit) and over in parameters.covariance.names:
        raise ControlError(
            f"{over} is estimated by the fit, and the schedule is over it; fix it in the experiments that are fitted"
        )
    standing = find_standing(schedule, plants, parameters, ranges, others or ParameterSet())
    models, values, unknowns = standing.models, standing.values, standing.unknowns
    holding, proving, sweeping = divide(
        progress, POINT * len(schedule.points), BOUND * len(values) * len(models), SWEEP * len(models) * simulations
    )
    count = -(-samples // len(values))
    rng = np.random.default_rng([seed, *_digest(schedule)])
    drawn = [unknown.draw(count if unknown.size else 0, rng) for unknown in unknowns]
    shared, nominal = Shared((schedule, models)), unknowns[-1].nominal
    parts = zip(values, unknowns, drawn, rng.spawn(len(values)), strict=True)
    certified = map_ordered(partial(_certify_place, shared), parts, executor)
    places: list[PlaceCertificate] = []
    worst, failed = dict[Spot, Worst](), list[Bool[np.ndarray, "3 n"]]()
    for number, value in enumerate(count_off(values, f"value of {over}", holding)):
        (place, fails), spots = next(certified), name_spots(models, unknowns[number])
        place = place.on(split_states(models, unknowns[number]))
        failed.append(fails)
        worst |= {spots[name]._replace(place=(over, value)): case for name, case in place.worst.items()}
        if held := list_held(schedule, models, value):
            source, other = standing.sources[number]
            simulated = certify(
                schedule.at(value),
                held,
                source,
                ranges=_choose_ranges(ranges, held),
                others=other,
                samples=count,
                seed=seed,
                simulations=simulations,
                sensors=sensors if simulations else None,
                command_step=command_step if simulations else 0.0,
                executor=executor,
            )
            required = {(row.name, row.plant, row.state) for row in place.requirements}
            rows = _place(schedule, value, simulated.requirements)
            new = (row for row in rows if (row.name, row.plant, row.state) not in required)
            place = replace(place, simulated=simulated, requirements=(*place.requirements, *new))
        places.append(place)
    pairs = list(pairwise(values))
    bounds = map_ordered(partial(_bound_plants, shared, nominal), pairs, executor)
    stretches = [bound for _ in count_off(pairs, "stretch", proving) for bound in next(bounds)]
    sweeps: dict[str, tuple[Sweep, ...]] = {}
    for name in count_off(list(models), "sweeps, plant", sweeping) if simulations else ():
        of_plant = sweep_schedule(schedule, name, models[name], nominal, executor=executor)
        sweeps |= {name: of_plant} if of_plant else {}
    motions: dict[str, Motion] = {}
    if sweeps:
        fastest = min(find_fastest(of_plant) for of_plant in sweeps.values())
        slowest = min(of_plant[0].rate for of_plant in sweeps.values())
        rate = min_rate or fastest or slowest
        moved = (move_schedule(schedule, name, plant, nominal, rate) for name, plant in models.items())
        motions = {motion.plant: motion for motion in moved if motion is not None}
    draws, unit = count_failures(np.hstack(failed), seed, confidence), _rate_unit(schedule)
    progress(f"{format_count(len(places), 'value')} of {over}", 1.0)
    return ScheduleCertificate(
        schedule=schedule,
        places=tuple(places),
        monte_carlo=draws,
        stretches=tuple(stretches),
        sweeps=sweeps,
        motions=motions,
        requirements=(
            *(row for place in places for row in place.requirements),
            *require_limits_between(schedule),
            *draw_requirements(draws, worst, max_failure_probability),
            *(require_rate(of_plant, unit, min_rate) for of_plant in sweeps.values()),
            *(require_motion(motion, over, unit, min_rate) for motion in motions.values()),
        ),
    )


@record(eq=False)
class Standing:
    """Plants and values of the variable at which a schedule is certified, with the parameters at each."""

    models: dict[str, Plant]
    values: tuple[float, ...]
    sources: tuple[tuple[Source, ParameterSet], ...]  # and others
    unknowns: tuple[Uncertainty, ...]


def find_standing(
    schedule: ScheduledController, plants: Plants, parameters: Source, ranges: Ranges, others: ParameterSet
) -> Standing:
    """Return what a schedule is certified at: its points and the values between them, with the design plant."""
    design, _ = schedule.design
    models = split_delayed(schedule.spec, design, add_design(design, plants), parameters)
    values = tuple(sorted({*schedule.points, *list_inner(schedule.points, PARTS)}))
    sources = tuple(_place_source(schedule, parameters, others, value) for value in values)
    drive = find_own_drive(schedule.controllers[0], parameters)
    unknowns = tuple(combine_uncertainty(*source, ranges, models, drive) for source in sources)
    return Standing(models=models, values=values, sources=sources, unknowns=unknowns)


def _place_source(
    schedule: ScheduledController, parameters: Source, others: ParameterSet, value: float
) -> tuple[Source, ParameterSet]:
    """Return what is known of the parameters, and the others, with the variable at a value."""
    variable = Parameter(name=schedule.over, value=value, unit=schedule.unit)
    if isinstance(parameters, ParameterSet):
        return parameters.with_parameters(variable), others
    if schedule.over in parameters.parameters:
        return replace(parameters, parameters=parameters.parameters.with_parameters(variable)), others
    return parameters, others.with_parameters(variable)


def _certify_place(
    shared: Shared[tuple[ScheduledController, dict[str, Plant]]],
    part: tuple[float, Uncertainty, Points, np.random.Generator],
) -> tuple[PlaceCertificate, Bool[np.ndarray, "3 n"]]:
    """Check the law at one value: nominal, draws and, at a point, a search; also return how each draw fails."""
    (schedule, models), (value, unknown, points, rng) = shared.value, part
    controller, point, plants = schedule.at(value), value in schedule.points, split_states(models, unknown)
    figures = {name: controller.close(plant, unknown.nominal).figures() for name, plant in plants.items()}
    failed, drawn = np.zeros((3, len(points)), dtype=bool), unknown.values(points)
    for plant in plants.values() if len(points) else ():
        failed |= find_failures(controller, batch_figures(controller, plant, unknown.nominal, drawn))
    counts = count_failures(failed, 0, CONFIDENCE)
    spots = name_spots(models, unknown)
    rows = [row for name, spot in spots.items() for row in plant_requirements(controller, spot, figures[name])]
    rows += _require_friction(schedule, models, value, unknown, len(points), rng)
    if point:
        rows += design_requirements(controller, schedule.design[0], unknown.nominal)
    place = PlaceCertificate(
        value=value,
        point=point,
        plants=figures,
        worst={name: find_worst(controller, plant, unknown, points) for name, plant in plants.items()} if point else {},
        draws=counts.samples,
        unstable=counts.unstable,
        over_ms=counts.over_ms,
        over_mt=counts.over_mt,
        requirements=_place(schedule, value, rows),
    )
    return place, failed


def list_held(schedule: ScheduledController, models: Plants, value: float) -> dict[str, Plant]:
    """Return the plants that `certify` takes: at a point those that hold the variable, if the design plant does. Where
    a plant moves the variable, a law that is frozen there is not what runs.
    """
    held = {name: plant for name, plant in models.items() if schedule.over not in plant.states}
    design, _ = schedule.design
    return held if value in schedule.points and any(plant is design for plant in held.values()) else {}


def _require_friction(
    schedule: ScheduledController,
    models: Plants,
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
    loops = Loops(controller=controller, models=apart, plants=apart, unknown=unknown)
    draws = find_margins_at_draws(Shared(loops), margins, samples, rng, least)
    return friction_requirements(margins, draws, least, controller.command.mechanics.damping)


def _rate_unit(schedule: ScheduledController) -> str:
    return f"{unit_after(schedule.unit).strip()}/s"


def _place(schedule: ScheduledController, value: float, rows: Sequence[Requirement]) -> tuple[Requirement, ...]:
    return tuple(replace(row, place=(schedule.over, value)) for row in rows)


def _choose_ranges(ranges: Ranges, plants: Plants) -> dict[str, tuple[float, float]]:
    """Return the ranges of what some of these plants have."""
    names = {*conditions(tuple(plants.values())), *find_modes(plants)}.union(
        *(plant.parameters for plant in plants.values())
    )
    return {name: ends for name, ends in ranges.items() if name in names}


def _bound_plants(
    shared: Shared[tuple[ScheduledController, dict[str, Plant]]], nominal: ParameterSet, stretch: tuple[float, float]
) -> list[StretchBound]:
    """Return what is proved of every plant on the stretch between two neighbouring values."""
    (schedule, models), (low, high) = shared.value, stretch
    middle = schedule.at(0.5 * (low + high))
    out: list[StretchBound] = []
    for name, plant in split_friction(models, nominal).items():
        values = place_variable(plant, nominal, schedule.over, 0.5 * (low + high))
        out.append(bound_stretch(name, middle, schedule.table, plant, values, low, high))
    return out


def _digest(schedule: ScheduledController) -> tuple[int, ...]:
    """Return numbers of the law's own, so that another law meets other draws at the same seed."""
    text = " ".join(f"{value:.6g}" for row in schedule.table.gains.values() for value in row)
    return tuple(int(word) for word in np.frombuffer(sha256(text.encode()).digest()[:16], dtype=np.uint32))
