"""The certificate of a schedule: with its variable standing still at the points, between them, and in sweeps.

What is said, and how it is known:

- **at the points and at three values in every stretch between two** (checked): all that `seaopt.certify` looks at of
  one law, here of the law frozen there, with the draws spread evenly over these values; at the points also with
  simulations on the plants that hold the variable by themselves;
- **at every value of the table** (proved, rounding estimated, of the nominal parameters): each frozen loop is stable,
  and its Ms below a bound (`seaopt.robustness.bounds.stretch`);
- **while the variable moves** (simulated): sweeps at growing rates with the law as it is exported
  (`seaopt.robustness.verification.schedule_sweep`). That the variable moves slowly is an assumption of all the rest,
  and the fastest sweep that keeps its judgement puts a number to it;
- **while the plant moves the variable** (simulated): pushes of the reference that move it at that rate, or the one that
  is required (`seaopt.robustness.verification.schedule_motion`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np

from seaopt.codec import to_content
from seaopt.control import ScheduledController
from seaopt.control.running.fed_back import close_terms, split_states
from seaopt.control.scheduling.scheduled_controller import PARTS, list_inner, place_variable
from seaopt.errors import ControlError
from seaopt.estimation import Fit
from seaopt.executors import Shared, map_ordered
from seaopt.files import seal
from seaopt.formatting import join_words
from seaopt.parameters import Parameter, ParameterSet
from seaopt.plants import Plant
from seaopt.progress import Progress, count_off
from seaopt.records import Result, Worded, record
from seaopt.robustness.bounds.bracket import Budget
from seaopt.robustness.bounds.stretch import StretchBound, bound_stretch
from seaopt.robustness.certificate.cases import Cases, Check, Evidence, Survey, pose_cases
from seaopt.robustness.certificate.certificate import ROBUSTNESS_SCHEMA, Certificate
from seaopt.robustness.certificate.measured_draws import draw_requirements, name_worst
from seaopt.robustness.certificate.requirement import Requirement, Spot, require_at_least, require_at_most
from seaopt.robustness.uncertainty.draws import Plants, Ranges, Source
from seaopt.robustness.uncertainty.failure_probability import MonteCarlo, join_counts
from seaopt.robustness.uncertainty.worst import Worst
from seaopt.robustness.verification.schedule_motion import Motion, describe_motion, move_schedule
from seaopt.robustness.verification.schedule_sweep import Sweep, describe_sweeps, find_fastest, sweep_schedule
from seaopt.units import unit_after

MOTION_RATE = "min_motion_rate"
FED_BACK = "what its terms feed back changes with it, too"
BOUND, SWEEP = 0.2, 5.0  # seconds that a stretch, and the sweeps of a plant, take as a rule


@record(eq=False, repr=False)
class ScheduleCertificate(Result, Worded):
    """The result of `certify` of a schedule.

    Parameters
    ----------
    schedule : ScheduledController
        What was certified.
    places : tuple of Certificate
        Of the law frozen at the points and between them, ascending; `place` is the value there.
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
    places: tuple[Certificate, ...]
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
    def values(self) -> tuple[float, ...]:
        """The values of the variable at `places`."""
        return tuple(place.place[1] for place in self.places if place.place is not None)

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
        """Proof, assumption, sweeps, motions, and the notes of all places, else of the points, one sentence each."""
        unit, over = self.rate_unit, self.schedule.over
        swept = (f"{name}: {describe_sweeps(sweeps, unit)}" for name, sweeps in self.sweeps.items())
        moved = (f"{name}: {describe_motion(motion, over, unit)}" for name, motion in self.motions.items())
        said = dict(zip(self.values, (place.notes for place in self.places), strict=True))
        shared = [note for note in next(iter(said.values())) if all(note in notes for notes in said.values())]
        at_points = (
            f"{over} = {value:g}: {note}"
            for value in self.schedule.points
            for note in said[value]
            if note not in shared
        )
        return (self.proof, self.assumption, *swept, *moved, *shared, *at_points)

    def to_dict(self) -> dict[str, Any]:
        """Return the content of robustness.json (schema seaopt/robustness/3), with its digest."""
        over = self.schedule.over
        pairs = zip(self.values, self.places, strict=True)
        written = [{"place": {over: value}} | place.list_content() for value, place in pairs]
        return seal(
            {
                "schema": ROBUSTNESS_SCHEMA,
                "met": self.met,
                "passed": self.met,
                "requirements": to_content(self.requirements),
                "plants": _take_worst(written, "plants", lambda plant: plant["worst"]["severity"]),
                "friction": _take_worst(written, "friction", _rank_friction),
                "monte_carlo": to_content(self.monte_carlo),
                "passivity": None,
                "simulation": None,
                "notes": list(self.notes),
                "schedule": {
                    "over": over,
                    "unit": self.schedule.unit,
                    "places": written,
                    "stretches": to_content(self.stretches),
                    "sweeps": to_content(self.sweeps),
                    "motions": to_content(self.motions),
                    "fastest_rate": self.fastest,
                    "rate_unit": self.rate_unit,
                    "proof": self.proof,
                    "assumption": self.assumption,
                },
            }
        )

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
        """Return the certificate of a schedule's robustness.json; nothing is simulated.

        Linear figures are computed again. Arguments are those of `certify` of a schedule. Raises FileError: a field is
        missing or malformed, it was edited or written by hand, or nothing is required in it.
        """
        from seaopt.robustness.certificate.stored import build_schedule_certificate  # deferred: pydantic

        places = pose_places(schedule, plants, parameters, ranges or {}, others or ParameterSet())
        return build_schedule_certificate(content, schedule, places)


def _take_worst(
    written: Sequence[Mapping[str, Any]], key: str, rank: Callable[[Mapping[str, Any]], Any]
) -> dict[str, Any]:
    """Return what the places have under a key, by plant: at its worst place, and which that is."""
    worst: dict[str, Any] = {}
    for name in dict.fromkeys(name for each in written for name in each[key]):
        at = max((each for each in written if name in each[key]), key=lambda each: rank(each[key][name]))
        worst[name] = {"place": at["place"], **at[key][name]}
    return worst


def _rank_friction(found: Mapping[str, Any]) -> tuple[bool, float]:
    """Return how bad a place's friction is: first whether it is not shown to be harmless, then the least
    slope that is, at the nominal parameters and at draws.
    """
    drawn = found.get("draws")
    slopes = [] if drawn is None else [drawn["least_slope"]]
    if "slopes" in found:  # as `FrictionMargin.least_slope`
        slopes.append(min((slope for slope in found["slopes"] if slope > 0.0), default=0.0))
    return not found["sector_stable"], -min(slopes, default=np.inf)


def pose_places(
    schedule: ScheduledController,
    plants: Plants,
    parameters: Source,
    ranges: Ranges,
    others: ParameterSet,
    bounds: Budget | None = None,
) -> dict[float, Cases]:
    """Return the cases of the law frozen at each value at which a schedule is certified, its points and between them.
    Raises ControlError: the variable has a range, or is estimated by the fit.
    """
    over = schedule.over
    if over in ranges:
        raise ControlError(f"range of {over}: the schedule is over it, and its points are its range; take it out")
    if isinstance(parameters, Fit) and over in parameters.covariance.names:
        raise ControlError(
            f"{over} is estimated by the fit, and the schedule is over it; fix it in the experiments that are fitted"
        )
    places: dict[float, Cases] = {}
    for value in sorted({*schedule.points, *list_inner(schedule.points, PARTS)}):
        variable, source, other = Parameter(name=over, value=value, unit=schedule.unit), parameters, others
        if isinstance(source, ParameterSet):
            source = source.with_parameters(variable)
        elif over in source.parameters:
            source = replace(source, parameters=source.parameters.with_parameters(variable))
        else:
            other = other.with_parameters(variable)
        places[value] = pose_cases(schedule.at(value), plants, source, ranges, other, bounds)
    return places


def measure_stretches(survey: Survey, progress: Progress) -> Evidence:
    """Bound Ms between neighbouring values, on every plant; what the tuner found there is what is required."""
    pairs, schedule, cases = list(pairwise(survey.places)), _take_schedule(survey), survey.cases
    shared = Shared((schedule, dict(cases.models)))
    bounds = map_ordered(partial(_bound_plants, shared, cases.unknown.nominal), pairs, survey.executor)
    stretches = tuple(bound for _ in count_off(pairs, "stretch", progress) for bound in next(bounds))
    return Evidence(requirements=_require_limits_between(schedule), fields={"stretches": stretches})


def measure_joint_draws(survey: Survey, _: Progress) -> Evidence:
    """Count the draws of all values together, and require the worst of all."""
    places: Sequence[Certificate] = survey.found["places"]
    counts, worst = join_counts([place.monte_carlo for place in places]), dict[Spot, Worst]()
    for at, place in zip(survey.places.values(), places, strict=True):
        worst |= name_worst(at, place.worst)
    rows = draw_requirements(counts, worst, survey.options.max_failure_probability)
    return Evidence(requirements=rows, fields={"monte_carlo": counts})


def measure_sweeps(survey: Survey, progress: Progress) -> Evidence:
    """Simulate sweeps of the variable on every plant, and plants that move it themselves."""
    schedule, models, nominal = _take_schedule(survey), survey.cases.models, survey.cases.unknown.nominal
    least, sweeps = survey.options.min_rate, dict[str, tuple[Sweep, ...]]()
    for name in count_off(list(models), "sweeps, plant", progress) if survey.simulations else ():
        of_plant = sweep_schedule(schedule, name, models[name], nominal, executor=survey.executor)
        sweeps |= {name: of_plant} if of_plant else {}
    motions: dict[str, Motion] = {}
    if sweeps:
        fastest = min(find_fastest(of_plant) for of_plant in sweeps.values())
        slowest = min(of_plant[0].rate for of_plant in sweeps.values())
        rate = least or fastest or slowest
        moved = (move_schedule(schedule, name, plant, nominal, rate) for name, plant in models.items())
        motions = {motion.plant: motion for motion in moved if motion is not None}
    unit = _rate_unit(schedule)
    return Evidence(
        requirements=(
            *(require_rate(of_plant, unit, least) for of_plant in sweeps.values()),
            *(require_motion(motion, schedule.over, unit, least) for motion in motions.values()),
        ),
        fields={"sweeps": sweeps, "motions": motions},
    )


STRETCHES = Check(
    measure=measure_stretches, seconds=lambda survey: BOUND * len(survey.places) * len(survey.cases.models)
)
JOINT_DRAWS = Check(measure=measure_joint_draws)
SWEEPS = Check(measure=measure_sweeps, seconds=lambda survey: SWEEP * survey.simulations * len(survey.cases.models))


def _take_schedule(survey: Survey) -> ScheduledController:
    assert isinstance(survey.subject, ScheduledController)
    return survey.subject


def _rate_unit(schedule: ScheduledController) -> str:
    return f"{unit_after(schedule.unit).strip()}/s"


def _bound_plants(
    shared: Shared[tuple[ScheduledController, dict[str, Plant]]], nominal: ParameterSet, stretch: tuple[float, float]
) -> list[StretchBound]:
    """Return what is proved of every plant on the stretch between two neighbouring values."""
    (schedule, models), (low, high) = shared.value, stretch
    middle = replace(schedule.controllers[0], law=schedule.table.law(0.5 * (low + high)))
    out: list[StretchBound] = []
    for name, plant in split_states(middle, models, nominal).items():
        if close_terms(middle, plant) is not middle:
            out.append(StretchBound(plant=name, low=low, high=high, ms=np.inf, change=np.inf, reason=FED_BACK))
            continue
        values = place_variable(plant, nominal, schedule.over, 0.5 * (low + high))
        out.append(bound_stretch(name, middle, schedule.table, plant, values, low, high))
    return out


def _require_limits_between(schedule: ScheduledController) -> list[Requirement]:
    """Return that the design plant's limits hold between the points, 0.9 of the bandwidth asked among them."""
    return [
        require_at_most(
            "limits_between_points",
            float(len(place.broken)),
            0.0,
            place=(schedule.over, place.value),
            text=", ".join(place.broken),
            remedy=schedule.remedy if place.broken else "",
        )
        for place in schedule.between
    ]


def require_rate(sweeps: Sequence[Sweep], unit: str, least: float | None) -> Requirement:
    """Return that a plant's sweeps keep their judgement: the slowest at all, and as fast as asked."""
    faults = [sweep.fault for sweep in sweeps if sweep.fault]
    return require_at_least(
        "min_schedule_rate",
        find_fastest(sweeps),
        sweeps[0].rate if least is None else least,
        unit=unit,
        plant=sweeps[0].plant,
        scenario="sweep",
        text=faults[0] if faults else f"the fastest tried is {sweeps[-1].rate:.3g} {unit}",
    )


def require_motion(motion: Motion, over: str, unit: str, least: float | None) -> Requirement:
    """Return that a plant that moves the variable keeps its judgement: at the rate reached at all, or as asked. What
    keeps its judgement at less than was asked is not met: nothing is known of the rate that was.
    """
    row = require_at_least(
        MOTION_RATE,
        0.0 if motion.fault else motion.rate,
        motion.rate if least is None else least,
        unit=unit,
        plant=motion.plant,
        text=describe_motion(motion, over, unit),
    )
    if motion.fault or row.met:
        return replace(row, met=not motion.fault)
    return replace(row, remedy="ask a smaller min_rate, or give the command a higher limit")
