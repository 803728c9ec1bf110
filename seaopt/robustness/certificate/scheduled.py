"""What is asked of a schedule as a whole: with its variable standing still at the points, between them, and in sweeps.

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

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from seaopt.control import ScheduledController
from seaopt.control.running.fed_back import LaterTerms, feeds_back, split_states
from seaopt.control.scheduling.scheduled_controller import RESERVE_BETWEEN, place_variable
from seaopt.executors import Shared, map_ordered
from seaopt.formatting import join_words
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.progress import Progress, count_off
from seaopt.robustness.bounds.stretch import PLACE, StretchBound, bound_stretch, place_plant
from seaopt.robustness.certificate.cases import Check, CheckContext, Evidence
from seaopt.robustness.certificate.measured_draws import draw_requirements, name_worst
from seaopt.robustness.certificate.requirement import Requirement, Spot, require_at_least, require_at_most
from seaopt.robustness.uncertainty.failure_probability import join_counts
from seaopt.robustness.uncertainty.worst import Worst
from seaopt.robustness.verification.schedule_motion import Motion, describe_motion, move_schedule
from seaopt.robustness.verification.schedule_sweep import Sweep, find_fastest, sweep_schedule
from seaopt.units import unit_after

if TYPE_CHECKING:
    from seaopt.robustness.certificate.certificate import Certificate

BETWEEN, MOTION_RATE = "limits_between_points", "min_motion_rate"
TERMS_CHANGE = "what is compensated changes with a state of the plant on the stretch"
BOUND, SWEEP = 0.2, 5.0  # seconds that a stretch, and the sweeps of a plant, take as a rule


def measure_stretches(context: CheckContext, progress: Progress) -> Evidence:
    """Bound Ms between neighbouring values, on every plant; what the tuner found there is what is required."""
    values = [context.place[1] for context in context.places if context.place is not None]
    pairs, schedule, cases = list(pairwise(values)), context.schedule, context.cases
    shared = Shared((schedule, dict(cases.models)))
    bounds = map_ordered(partial(_bound_plants, shared, cases.unknown.nominal), pairs, context.executor)
    stretches = tuple(bound for _ in count_off(pairs, "stretch", progress) for bound in next(bounds))
    rows = [*_require_limits_between(schedule), *_refute_limits_between(schedule, stretches)]
    return Evidence(requirements=rows, fields={"stretches": stretches}, scope="nominal")


def join_places(context: CheckContext, _: Progress) -> Evidence:
    """Count the draws of all values together, require the worst of all, and return each plant at its worst place."""
    places: Sequence[Certificate] = context.found["places"]
    counts, worst = join_counts([certificate.monte_carlo for certificate in places]), dict[Spot, Worst]()
    for at, certificate in zip(context.places, places, strict=True):
        worst |= name_worst(at, certificate.worst)
    rows = draw_requirements(counts, worst, context.options.max_failure_probability)
    fields = {"monte_carlo": counts, **take_worst(places)}
    return Evidence(requirements=rows, fields=fields, scope="drawn", risk=counts.risk)


def take_worst(places: Sequence[Certificate]) -> dict[str, Any]:
    """Return the figures and the worst case of each plant at its worst place, as fields of a certificate."""
    at: dict[str, Certificate] = {}
    for certificate in places:
        for name, case in certificate.worst.items():
            if name not in at or case.severity > at[name].worst[name].severity:
                at[name] = certificate
    return {
        "plants": {name: certificate.plants[name] for name, certificate in at.items()},
        "worst": {name: certificate.worst[name] for name, certificate in at.items()},
    }


def measure_sweeps(context: CheckContext, progress: Progress) -> Evidence:
    """Simulate sweeps of the variable on every plant, and plants that move it themselves."""
    schedule, models, nominal = context.schedule, context.cases.models, context.cases.unknown.nominal
    least, sweeps = context.options.min_rate, dict[str, tuple[Sweep, ...]]()
    for name in count_off(list(models), "sweeps, plant", progress) if context.simulations else ():
        of_plant = sweep_schedule(schedule, name, models[name], nominal, executor=context.executor)
        sweeps |= {name: of_plant} if of_plant else {}
    motions: dict[str, Motion] = {}
    if sweeps:
        slowest = min(of_plant[0].rate for of_plant in sweeps.values())
        rate = least or find_common_rate(sweeps) or slowest
        moved = (move_schedule(schedule, name, plant, nominal, rate) for name, plant in models.items())
        motions = {motion.plant: motion for motion in moved if motion is not None}
    unit = name_rate_unit(schedule)
    return Evidence(
        requirements=(
            *(require_rate(of_plant, unit, least) for of_plant in sweeps.values()),
            *(require_motion(motion, schedule.over, unit, least) for motion in motions.values()),
        ),
        fields={"sweeps": sweeps, "motions": motions},
        scope="simulated",
    )


STRETCHES = Check(
    measure=measure_stretches, seconds=lambda context: BOUND * len(context.places) * len(context.cases.models)
)
JOINT_DRAWS = Check(measure=join_places, brief=lambda _: True)
SWEEPS = Check(measure=measure_sweeps, seconds=lambda context: SWEEP * context.simulations * len(context.cases.models))


def _bound_plants(
    shared: Shared[tuple[ScheduledController, dict[str, Plant]]], nominal: ParameterSet, stretch: tuple[float, float]
) -> list[StretchBound]:
    """Return what is proved of every plant on the stretch between two neighbouring values."""
    (schedule, models), (low, high) = shared.value, stretch
    law, first, last = schedule.table.law(0.5 * (low + high)), schedule.terms_at(low), schedule.terms_at(high)
    middle = replace(schedule.controllers[0], law=law, compensation=first)
    out: list[StretchBound] = []
    for name, model in models.items():
        plant, later = place_plant(model, schedule.over, schedule.unit), None
        variable = schedule.over if schedule.over in {*plant.parameters, *plant.states} else PLACE
        if last is not None and last != first:
            later = LaterTerms(terms=last, over=variable, low=low, high=high)
        values = place_variable(plant, nominal, variable, 0.5 * (low + high))
        for label, variant in split_states(middle, {name: plant}, values, later=later).items():
            if later is not None and variable in plant.states and feeds_back(replace(middle, outer=None), variant):
                out.append(StretchBound(plant=label, low=low, high=high, ms=np.inf, reason=TERMS_CHANGE))
                continue
            out.append(bound_stretch(label, middle, schedule.table, variant, values, low, high))
    return out


def _require_limits_between(schedule: ScheduledController) -> list[Requirement]:
    """Return that the design plant's limits hold between the points, 0.9 of the bandwidth asked among them."""
    return [
        require_at_most(
            BETWEEN,
            float(len(figures.broken)),
            0.0,
            place=(schedule.over, figures.value),
            text=", ".join(figures.broken),
            remedy=schedule.remedy if figures.broken else "",
        )
        for figures in schedule.between
    ]


def _refute_limits_between(schedule: ScheduledController, stretches: Sequence[StretchBound]) -> list[Requirement]:
    """Return a requirement for each stretch on which a loop was found that breaks a limit."""
    return [
        require_at_most(
            BETWEEN,
            1.0,
            0.0,
            plant=bound.plant,
            place=(schedule.over, bound.broken_at),
            text=bound.broken,
            remedy=f"add a point there, or tune with more room: reserve = {RESERVE_BETWEEN:g}",
        )
        for bound in stretches
        if bound.broken_at is not None
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


def state_assumption(schedule: ScheduledController, sweeps: Mapping[str, Sequence[Sweep]]) -> str:
    """Return the assumption on the variable's motion, with the number that the simulations give it."""
    over, fastest = schedule.over, find_common_rate(sweeps)
    if sweeps and not fastest:
        return f"{over} is assumed to stand still: the slowest sweep that was simulated does not keep its judgement"
    rate = f"{fastest:.3g} {name_rate_unit(schedule)}"
    swept = f"sweeps of up to {rate} keep the judgement of a step in simulation"
    motion = swept if sweeps else "no sweep was simulated"
    return f"{over} is assumed to move slowly: the limits hold with it standing still, and {motion}"


def state_proof(schedule: ScheduledController, stretches: Sequence[StretchBound]) -> str:
    """Return the statement that is proved between the points, or where none is."""
    over, first, last = schedule.over, schedule.points[0], schedule.points[-1]
    if not stretches:
        return "what is between the values that were looked at was left out"
    missing = [stretch for stretch in stretches if not stretch.shown]
    if not missing:
        largest = np.ceil(1e3 * max(stretch.ms for stretch in stretches)) / 1e3
        return (
            f"for every {over} from {first:g} to {last:g}, standing still, at the nominal parameters: stable, Ms "
            f"below {largest:.3f}, proved"
        )
    spans = [f"{over} = {stretch.low:.4g} to {stretch.high:.4g} on {stretch.plant}" for stretch in missing[:3]]
    more = [f"{len(missing) - 3} more"] if len(missing) > 3 else []
    where = join_words([*spans, *more])
    return f"nothing is proved between the values that were looked at for {where}: {missing[0].reason}"


def find_common_rate(sweeps: Mapping[str, Sequence[Sweep]]) -> float:
    """Return the largest rate of the variable at which every plant keeps its judgement in a sweep; zero for none."""
    return min((find_fastest(of_plant) for of_plant in sweeps.values()), default=0.0)


def name_rate_unit(schedule: ScheduledController) -> str:
    """Return the unit of the rate of a schedule's variable."""
    return f"{unit_after(schedule.unit).strip()}/s"
