"""Predictive control simulated with its limits active over draws.

While no limit is active it is a law (`linear_region`). Where the program's constraints are active there is no such law.
Then parameters, steps and disturbances are drawn. Each run is the law as it runs, solver and fallback included, on the
nonlinear plants:

    rest, a step, the step reversed, the disturbance with the reference held.

Sizes and signs are drawn, from steps that stay within the limits to those that take all that the command holds. What
the law reads is what the sensors make of the output, and what acts is its command as the amplifier rounds it. A run
fails where it diverges or grows, breaks a bound of an output by more than a tolerance, rings in the last phase above
what noise and rounding make in the linear loop, or, on a plant whose link does not move, does not settle. With n runs
and f failures the probability that a run drawn so fails is below Clopper's and Pearson's bound; nothing is claimed
beyond that distribution.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import field, replace
from functools import partial
from typing import Any

import numpy as np

from seaopt.bench import Sensors
from seaopt.codec import to_content
from seaopt.control import ForceMPC, ForceRun
from seaopt.control.loops.sampled_plant import DELAYS, conditions
from seaopt.control.mpc.compiled import PlanSample
from seaopt.errors import SeaoptError
from seaopt.executors import Shared, map_ordered
from seaopt.formatting import format_count, format_percent
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.plants.plant import deflection_row
from seaopt.progress import Progress, count_off
from seaopt.records import Result, record
from seaopt.robustness.certificate.cases import Check, CheckContext, Evidence
from seaopt.robustness.certificate.requirement import DrawnAt, Requirement, require_at_most
from seaopt.robustness.uncertainty.failure_probability import failure_bound
from seaopt.robustness.uncertainty.worst import place_values
from seaopt.robustness.verification.judgement import Fault, Judge, find_noise_floor, take_ends
from seaopt.robustness.verification.linear import LinearView, view_loop
from seaopt.robustness.verification.oscillation import Oscillation, Signal, measure_swing
from seaopt.robustness.verification.playback import Rig, run_plan
from seaopt.robustness.verification.scenarios import SETTLED
from seaopt.robustness.verification.verification import make_rigs
from seaopt.units import LINEAR

CONSTRAINED_STREAM = 0x3C  # the runs' own stream of random numbers, whatever the seed
STEP_SHARES = (0.3, 1.0)  # of the force that the limits hold, of the steps
DISTURBANCE_SHARE = 0.1  # of the limit of the command, at most
PERIODS, LEAST_PHASE_S, REST_S = 3.0, 0.1, 0.02  # of the bandwidth that a phase lasts besides a preview; before it
JUDGED_PERIODS = 8.0  # of the bandwidth that the last phase lasts besides, in which a ring would last
SLOWEST = 0.5  # of the bandwidth: slower rings, of the linear law, are looked for in its own simulations
LAST_SHARE = 0.2  # of a phase, over which the force is off by at most a settled share of the step
FORGOTTEN = 1e-3  # of a mode, that is left after a sample
RUNAWAY, GROWTH = 3.0, 1.5  # times what the limits hold; second half of the last phase over its first
CONSTRAINED_FAILURES, CONSTRAINED_PROBABILITY = "constrained_failures", "constrained_failure_probability"
RUN_SECONDS = 0.35  # that a run on a plant takes as a rule
DIVERGED, OVER_BOUND, UNSETTLED, RINGS = "diverged", "over a bound", "not settled", "ringing"


@record
class ConstrainedRuns(Result):
    """Runs with limits active: how many failed, by what, and the worst of them.

    Parameters
    ----------
    runs, failures, seed : int
        A run is one draw on every plant; it fails if it fails on one.
    diverged, over_bound, not_settled, ringing : int
        The failures by their first reason.
    confidence, failure_probability_bound : float
        With that confidence the probability of failure is below the bound.
    bound_tolerance, largest_violation : float
        By how much a bounded signal may leave its bounds, and did, as a share of half their width.
    largest_ring : float
        The furthest that what still swings at the end of a run, faster than half the bandwidth, is from its mean, of
        noise and rounding too, in the regulated output's unit.
    at_limit, fallback : float
        Share of the samples with the command at its limit or its slew limit, and without a plan that keeps the limits.
    iterations : int
        The most of any step.
    sensors, command_step
        What the law reads with, and what its command is rounded to.
    unit : str
        Of the ring: N, or N m of a torque.
    plant, run, text, parameters
        Of the first run that failed: the plant, the number of its draw, what happened, and what was drawn; empty
        where none did.
    remedy : str
        What stands in its way, found by playing it again at other parameters, and what to do about it.
    left_out : tuple of str
        Bounded signals that a plant does not have, and conditions that are not drawn.
    """

    runs: int
    failures: int
    seed: int
    diverged: int
    over_bound: int
    not_settled: int
    confidence: float
    failure_probability_bound: float
    bound_tolerance: float
    largest_violation: float
    at_limit: float
    fallback: float
    iterations: int
    ringing: int = 0
    largest_ring: float = 0.0
    sensors: Sensors = field(default_factory=Sensors)
    command_step: float = 0.0
    unit: str = LINEAR.unit
    plant: str = ""
    run: str = ""
    text: str = ""
    parameters: Mapping[str, float] = field(default_factory=dict[str, float])
    remedy: str = ""
    left_out: tuple[str, ...] = ()

    @property
    def met(self) -> bool:
        """Whether no run failed."""
        return not self.failures

    def to_dict(self) -> dict[str, Any]:
        """Return the fields as they stand in robustness.json under "constrained"."""
        return {"met": self.met, **to_content(self)}

    def __str__(self) -> str:
        kinds = (
            (self.diverged, DIVERGED), (self.over_bound, OVER_BOUND), (self.not_settled, UNSETTLED),
            (self.ringing, RINGS),
        )  # fmt: skip
        counts = ", ".join(f"{count} {kind}" for count, kind in kinds if count)
        swings = "; what swings at the end faster than half the bandwidth reaches"
        ring = f"{swings} {self.largest_ring:.3g} {self.unit}" if self.largest_ring else ""
        failures, runs = format_count(self.failures, "failure"), format_count(self.runs, "simulated run")
        return (
            f"with limits active: {failures} in {runs}{f' ({counts})' if counts else ''}, failure probability below "
            f"{self.failure_probability_bound:.2g} at a confidence of {format_percent(self.confidence, 6)}; the "
            f"command at a limit in {self.at_limit:.0%} of the samples, no new plan in {self.fallback:.2%}, "
            f"{self.iterations} iterations at most{ring}"
        )

    @property
    def notes(self) -> tuple[str, ...]:
        """The certificate's remarks on these runs."""
        return (
            "margins, worst cases and draws are of the linear region, in which no limit of the plan is active",
            str(self),
            *self.left_out,
        )


@record(eq=False)
class _RunResult:
    """One run on one plant: its first fault, the signal furthest out of bounds, its ring, and what the law did."""

    fault: Fault | None = None
    violation: float = 0.0
    signal: str = ""
    ring: float = 0.0
    steps: int = 0
    unsolved: int = 0
    late: int = 0
    iterations: int = 0
    at_limit: int = 0


@record(eq=False)
class _RunDraw:
    """The draws of one run: parameters, the seed of its noise, its reference and its disturbance."""

    draw: dict[str, float]
    seed: int
    reference: Signal
    disturbance: Signal


@record(eq=False)
class _PlantRun:
    """A run on one plant: the rig has the law in its linear region; `tolerance` is of bounds."""

    mpc: ForceMPC
    rig: Rig
    tolerance: float
    values: ParameterSet
    drawn: _RunDraw

    @property
    def ideal(self) -> _PlantRun:
        """The same with an ideal sensor and amplifier."""
        return replace(self, rig=replace(self.rig, sensors=Sensors(), command_step=0.0))

    @property
    def is_ideal(self) -> bool:
        """Whether sensor and amplifier add nothing of their own."""
        return self.rig.sensors == Sensors() and not self.rig.command_step

    def play(self) -> _RunResult:
        """Simulate the run, and judge it."""
        mpc, judge, steps, figures = self.mpc, Judge(), list[PlanSample](), dict[str, Any]()
        try:
            run = self._simulate(steps)
        except SeaoptError as error:
            judge.refuse(DIVERGED, str(error))
        else:
            figures = self._judge(run, np.array([step.target for step in steps]), judge)
        current = np.array([step.command for step in steps])  # before the amplifier rounds it
        slews = np.abs(np.diff(current, prepend=0.0)) > mpc.spec.slew_per_sample * (1.0 - 1e-6)
        at_limit = int(np.count_nonzero(slews | (np.abs(current) > mpc.command_limit * (1.0 - 1e-6))))
        return _RunResult(
            fault=judge.faults[0] if judge.faults else None,
            steps=len(steps),
            unsolved=sum(not step.solved for step in steps),
            late=sum(step.unfinished for step in steps),
            iterations=max((step.iterations for step in steps), default=0),
            at_limit=at_limit,
            **figures,
        )

    def _judge(self, run: ForceRun, target: Signal, judge: Judge) -> dict[str, Any]:
        """Judge a run by its force, its bounds and what rings; return the figures of the last two."""
        self._judge_force(run, target, judge)
        violation, signal = self._find_violation(run)
        beyond = f"{signal} leaves its bounds by {violation:.1%} of half their width"
        judge.require(OVER_BOUND, violation, self.tolerance, beyond)
        return {"violation": violation, "signal": signal, "ring": self._judge_ring(run, judge)}

    def _simulate(self, steps: list[PlanSample]) -> ForceRun:
        """Return the samples of the run, and add each step of the law to `steps`; with an outer loop there is no
        preview.
        """
        mpc, rig = self.mpc, self.rig
        return run_plan(
            mpc,
            rig.plant,
            self.values,
            self.drawn.reference,
            steps,
            preview_samples=mpc.spec.preview_samples if mpc.outer is None else 0,
            sensors=rig.sensors,
            command_step=rig.command_step,
            disturbance=self.drawn.disturbance,
            seed=self.drawn.seed,
        )

    def _judge_force(self, run: ForceRun, target: Signal, judge: Judge) -> None:
        """Ask that the force stays within what the limits hold, comes to rest and, of a link that is held, settles."""
        mpc = self.mpc
        limit = abs(mpc.static_gain) * mpc.command_limit
        _, phase, lasting = _count_samples(mpc)
        peak, off = float(np.max(np.abs(run.force))), np.abs(run.force - target)
        described = f"{peak:.4g} {run.unit}, and the limits hold {limit:.4g} {run.unit}"
        judge.require(DIVERGED, peak, RUNAWAY * limit, described, run.unit)
        first, second = np.max(off[-lasting : -lasting // 2]), float(np.max(off[-lasting // 2 :]))
        grows = f"the error grows to {second:.4g} {run.unit} over the last phase"
        judge.require(DIVERGED, second, GROWTH * first + SETTLED * limit, grows, run.unit)
        if self.rig.plant.moves:
            return
        end_of_step = run.time.size - lasting - mpc.spec.preview_samples  # before its end the next phase is known
        ends = (run.time.size, end_of_step, end_of_step - phase)
        for end, errors in zip(ends, take_ends(off, ends, max(round(LAST_SHARE * phase), 1)), strict=True):
            error = float(np.mean(errors))
            text = f"{error:.4g} {run.unit} off {end / run.time.size:.0%} into the run"
            judge.require(UNSETTLED, error, SETTLED * abs(float(run.reference[-1])), text, run.unit)

    def _judge_ring(self, run: ForceRun, judge: Judge) -> float:
        """Judge what swings at the end of a run; return its peak, 0 for nothing. What rounding makes comes and goes, so
        that half of the runs that ring look as if they died out. What dies out is therefore no fault only where the
        same run on ideal devices has as much of it.
        """
        view = view_loop(self.rig, self.rig.plant, self.values)
        swing = self._measure_ring(run, view)
        fading = not (swing.sustained or swing.growing)
        if fading and self.is_ideal:
            return 0.0
        peak, lowest_hz = float(np.max(np.abs(run.force))), SLOWEST * self.mpc.spec.bandwidth_hz
        floor = find_noise_floor(self.rig, peak, view, lowest_hz)
        if fading and swing.amplitude > floor and not self._rings_by_devices(swing.amplitude, view):
            return 0.0
        what = f"an oscillation of {swing.amplitude:.3g} {run.unit}, at {swing.frequency_hz:.3g} Hz most, "
        text = f"{what}does not die out; noise and rounding explain {floor:.3g} {run.unit}"
        judge.require(RINGS, swing.amplitude, floor, text, run.unit)
        return swing.peak

    def _rings_by_devices(self, amplitude: float, view: LinearView) -> bool:
        """Tell whether most of what swings is gone with ideal devices, so that it is no transient of the loop."""
        try:
            ideal = self.ideal._simulate([])
        except SeaoptError:
            return False
        return self._measure_ring(ideal, view).amplitude < 0.5 * amplitude

    def _measure_ring(self, run: ForceRun, view: LinearView) -> Oscillation:
        """Return what swings at the end of a run; without the slow modes of a link that an outer loop makes swing, of
        which the ends of a window make fast ones.
        """
        mpc, lowest_hz = self.mpc, SLOWEST * self.mpc.spec.bandwidth_hz
        judged = round(JUDGED_PERIODS / mpc.spec.bandwidth_hz * mpc.spec.sample_rate_hz)
        force = run.force[-judged:]
        if mpc.outer is not None:
            poles = view.loop.eigenvalues()
            rates: Any = np.log(poles[np.abs(poles) > FORGOTTEN])
            slow = rates[(rates.imag >= 0.0) & (rates.imag < 2.0 * np.pi * lowest_hz * mpc.sample_time_s)]
            modes: Any = np.exp(np.outer(np.arange(judged), slow))
            basis = np.hstack([modes.real, modes.imag, np.ones((judged, 1))])
            force = force - basis @ np.linalg.lstsq(basis, force, rcond=None)[0]
        return measure_swing(force, mpc.sample_time_s, lowest_hz=lowest_hz)

    def _find_violation(self, run: ForceRun) -> tuple[float, str]:
        """Return by how much a bounded signal leaves its bounds at most, over half their width, and which it is."""
        plant, traces = self.rig.plant, dict[str, Signal]()
        if plant.spring is not None:
            stretch = run.state @ deflection_row(plant, plant.complete(self.values))
            traces = {"spring_deflection": stretch, "spring_rate": np.gradient(stretch, self.mpc.sample_time_s)}
        traces |= {**dict(zip(plant.states, run.state.T, strict=True)), **run.outputs}
        bounds = {name: ends for name, ends in self.mpc.spec.bounds.items() if name in traces}
        beyond = [
            (float(np.max(np.maximum(low - traces[name], traces[name] - high))) / (0.5 * (high - low)), name)
            for name, (low, high) in bounds.items()
        ]
        return max((case for case in beyond if case[0] > 0.0), default=(0.0, ""), key=lambda case: case[0])


def measure_constrained(context: CheckContext, progress: Progress) -> Evidence:
    """Draw and simulate runs of predictive control with limits active, each on every plant."""
    runs = run_constrained(context, progress)
    rows = require_constrained(runs, context.options.max_failure_probability)
    return Evidence(requirements=rows, fields={"constrained": runs}, scope="simulated")


CONSTRAINED = Check(
    measure=measure_constrained,
    seconds=lambda context: RUN_SECONDS * context.options.runs * len(context.cases.models),
    applies=lambda context: context.plan is not None,
)


def run_constrained(context: CheckContext, progress: Progress) -> ConstrainedRuns:
    """Return what runs with limits active come to; the context's law is the linear region of its subject."""
    mpc = context.plan
    assert mpc is not None
    law, plants, unknown = context.cases.controller, context.cases.models, context.cases.unknown
    runs, seed, sensors = context.options.runs, context.options.seed, context.sensors or Sensors()
    tolerance, command_step = context.options.bound_tolerance, context.options.command_step
    rng = np.random.default_rng([seed, CONSTRAINED_STREAM])
    drawn = unknown.values(unknown.draw(runs, rng))
    placed = {name for plant in plants.values() for name in conditions((plant,)) if name not in DELAYS}
    parts: list[_RunDraw] = []
    for k in range(runs):
        draw = {name: float(column[k]) for name, column in drawn.items() if name not in placed}
        reference, disturbance = _draw_references(mpc, rng)
        parts.append(_RunDraw(draw=draw, seed=seed + k, reference=reference, disturbance=disturbance))
    rigs = make_rigs(law, plants, sensors, command_step)
    shared = Shared((mpc, rigs, tolerance, unknown.nominal))
    played = map_ordered(partial(_play_run, shared), parts, context.executor)
    kinds: list[str] = []
    failed_run, outcomes = dict[str, Any](), list[_RunResult]()
    for k in count_off(range(runs), "limits active, run", progress):
        of_plants = dict(zip(plants, next(played), strict=True))
        outcomes += of_plants.values()
        failed, fault = next(((name, each.fault) for name, each in of_plants.items() if each.fault), ("", None))
        kinds.append("" if fault is None else fault.kind)
        if fault is not None and not failed_run:
            rig, draw, outcome = rigs[failed], parts[k].draw, of_plants[failed]
            has = place_values(rig.plant, unknown.nominal, draw)
            used, case = {key: draw[key] for key in draw if key in has}, _place_run(shared.value, rig, parts[k])
            remedy = _find_remedy(case, failed, unknown.nominal, used, outcome)
            failed_run.update(plant=failed, run=str(k + 1), text=fault.text, parameters=used, remedy=remedy)
    failures, steps = sum(map(bool, kinds)), max(sum(outcome.steps for outcome in outcomes), 1)
    missing = (
        f"{name} has no {signal}: its bounds are not checked there"
        for name, plant in plants.items()
        for signal in mpc.spec.bounds
        if not _has(plant, signal)
    )
    kept = (f"runs with limits active start at rest at zero: {name} is not drawn there" for name in placed & {*drawn})
    return ConstrainedRuns(
        runs=runs,
        failures=failures,
        seed=seed,
        diverged=kinds.count(DIVERGED),
        over_bound=kinds.count(OVER_BOUND),
        not_settled=kinds.count(UNSETTLED),
        ringing=kinds.count(RINGS),
        confidence=context.options.confidence,
        failure_probability_bound=failure_bound(runs, failures, context.options.confidence),
        bound_tolerance=tolerance,
        largest_violation=max(outcome.violation for outcome in outcomes),
        largest_ring=max(outcome.ring for outcome in outcomes),
        at_limit=sum(outcome.at_limit for outcome in outcomes) / steps,
        fallback=sum(outcome.unsolved for outcome in outcomes) / steps,
        iterations=max(outcome.iterations for outcome in outcomes),
        sensors=sensors,
        command_step=command_step,
        unit=law.command.reference_unit,
        **failed_run,
        left_out=(*missing, *kept),
    )


def _draw_references(mpc: ForceMPC, rng: np.random.Generator) -> tuple[Signal, Signal]:
    """Return the reference of a run, and the disturbance of its command, which lasts a phase and what is judged."""
    resting, phase, last = _count_samples(mpc)
    force = rng.choice([-1.0, 1.0]) * rng.uniform(*STEP_SHARES) * abs(mpc.static_gain) * mpc.command_limit
    disturbance = rng.uniform(-1.0, 1.0) * DISTURBANCE_SHARE * mpc.command_limit
    reference = np.concatenate([np.zeros(resting), np.full(phase, force), np.full(phase + last, -force)])
    return reference, np.concatenate([np.zeros(resting + 2 * phase), np.full(last, disturbance)])


def _count_samples(mpc: ForceMPC) -> tuple[int, int, int]:
    """Return how many samples a run is at rest, in a phase, and in its last phase."""
    rate, band = mpc.spec.sample_rate_hz, mpc.spec.bandwidth_hz
    phase_s = max(LEAST_PHASE_S, PERIODS / band) + mpc.spec.preview_samples * mpc.sample_time_s
    return round(REST_S * rate), round(phase_s * rate), round((phase_s + JUDGED_PERIODS / band) * rate)


_Staged = tuple[ForceMPC, dict[str, Rig], float, ParameterSet]


def _place_run(staged: _Staged, rig: Rig, run: _RunDraw) -> _PlantRun:
    """Return a run on one rig, at what was drawn."""
    mpc, _, tolerance, nominal = staged
    values = place_values(rig.plant, nominal, run.draw)
    return _PlantRun(mpc=mpc, rig=rig, tolerance=tolerance, values=values, drawn=run)


def _play_run(shared: Shared[_Staged], run: _RunDraw) -> list[_RunResult]:
    """Simulate one run on every plant, and judge it."""
    return [_place_run(shared.value, rig, run).play() for rig in shared.value[1].values()]


def _find_remedy(
    case: _PlantRun, name: str, nominal: ParameterSet, draw: Mapping[str, float], failed: _RunResult
) -> str:
    """Return what to change for a run that failed: iterations, specification, plant, or what was drawn of it."""
    mpc, plant = case.mpc, case.rig.plant
    over_bound = failed.fault is not None and failed.fault.kind == OVER_BOUND

    def fails(values: ParameterSet) -> bool:
        return replace(case, values=values).play().fault is not None

    if failed.late:
        return f"a larger max_iterations in [mpc]: {format_count(failed.late, 'sample')} of that run had no plan"
    # Of a bound the room that it needs is named.
    if not over_bound and not case.is_ideal and case.ideal.play().fault is None:
        return (
            "finer sensors of less offset and more range, a finer command_step, or a lower bandwidth_hz: with ideal "
            "ones that run passes"
        )
    design, values = mpc.design
    if (of_design := replace(case, rig=replace(case.rig, plant=design), values=values).play()).fault:
        return f"{_name_obstacle(mpc, of_design)}: the run fails on the design plant with its own parameters too"
    room = f", or leave {failed.signal} more room by bound_tolerance" if over_bound else ""
    at_nominal = place_values(plant, nominal, {})
    passes = plant is design and at_nominal == place_values(design, values, {})  # that run has just passed
    if not passes and fails(at_nominal):
        return f"design on {name}, which is not what the model says at its nominal parameters either{room}"
    alone = list(draw)  # of a single one it is the run that failed
    if len(draw) > 1:
        alone = [key for key in draw if fails(place_values(plant, nominal, {key: draw[key]}))]
    wrong, together = ", ".join(alone or draw), "" if alone else " together"
    if failed.fault is not None and failed.fault.kind == RINGS:  # the loop, of a plant that may be known well
        return f"a lower bandwidth_hz, or narrower ranges of {wrong} in [robustness]: the loop rings there"
    return f"fit {wrong} or narrow their ranges in [robustness]: the model is too wrong in them{together}{room}"


def _name_obstacle(mpc: ForceMPC, failed: _RunResult) -> str:
    """Return what of the specification is in the way of a run on the plant that it was made for."""
    if failed.fault is None or failed.fault.kind != OVER_BOUND:
        return "a lower bandwidth_hz, or a longer horizon_s in [mpc]"
    low, high = mpc.spec.bounds[failed.signal]
    more = 0.5 * (high - low) * failed.violation
    return f"bounds of {failed.signal} wider than [{low - more:.3g}, {high + more:.3g}] in [mpc], or bound_tolerance"


def _has(plant: Plant, name: str) -> bool:
    return name in plant.outputs or name in plant.states or (name.startswith("spring_") and plant.spring is not None)


def require_constrained(runs: ConstrainedRuns, max_failure_probability: float | None) -> tuple[Requirement, ...]:
    """Return what the runs with limits active require."""
    failures = require_at_most(
        CONSTRAINED_FAILURES,
        float(runs.failures),
        0.0,
        plant=runs.plant,
        scenario="limits active",
        draw=DrawnAt(parameters=runs.parameters, number=runs.run, seed=runs.seed),
        text=runs.text or format_count(runs.runs, "run"),
        remedy=runs.remedy,
    )
    if max_failure_probability is None:
        return (failures,)
    text = f"{format_count(runs.failures, 'failure')} in {format_count(runs.runs, 'run')}"
    bound = runs.failure_probability_bound
    probability = require_at_most(CONSTRAINED_PROBABILITY, bound, max_failure_probability, text=text)
    return failures, replace(probability, risk=1.0 - runs.confidence)
