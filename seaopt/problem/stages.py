"""The stages of a problem, one call each: fit, tune and certify with what the file says of them."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from seaopt.control import (
    Controller,
    ControllerSpec,
    ForceMPC,
    Frontier,
    GivenLaw,
    LinkFeedforward,
    ScheduledController,
    assess,
    command_of,
    force_mpc,
    sweep,
    tune,
    tune_schedule,
)
from seaopt.control.laws.delay import DELAY_KEYS, NEGLIGIBLE, LoopSpec, find_drive_delay, settle_delays
from seaopt.control.loops.sampled_plant import list_names
from seaopt.control.mpc.stored import check_described
from seaopt.control.scheduling.scheduled_controller import restore_law
from seaopt.errors import ControlError, ProblemError, SeaoptError
from seaopt.estimation import Experiment, Fit, ModelledOutputs, fit
from seaopt.estimation.result.findings import find_guesses, order_findings
from seaopt.files import parse_file
from seaopt.frequency import MeasuredResponse
from seaopt.logs import Log
from seaopt.parameters import Parameter, ParameterSet
from seaopt.plants import Plant
from seaopt.problem.completion import (
    complete_controller,
    complete_schedule,
    derates,
    find_outer,
    make_gate,
    surround_controller,
)
from seaopt.problem.option_tables import make_value
from seaopt.problem.problem import WRITE_ONE, Problem
from seaopt.progress import Progress, count_off, ignore
from seaopt.robustness import (
    Budget,
    Certificate,
    JointTuning,
    certify,
    feed_link_forward,
    linear_controller,
    tune_certified,
)
from seaopt.robustness.certificate.linear_region import sweep_plans
from seaopt.robustness.certificate.retuning.reserve import Look, keep_reserve, look_at_draws
from seaopt.robustness.verification.verification import list_readings
from seaopt.signals import Signal
from seaopt.simulation import simulate

ROUNDS = 3  # of tuning and certifying, where a first look at the draws finds one that is over a limit


def fit_problem(
    problem: Problem,
    experiments: Sequence[Experiment] | None = None,
    *,
    start: Fit | None = None,
    causes: bool = True,
    keep: Callable[[Fit], object] | None = None,
    progress: Progress = ignore,
) -> Fit:
    """Fit the problem's logs, as `seaopt fit` does.

    Parameters
    ----------
    problem : Problem
        What `read_problem` returned.
    experiments : sequence of Experiment, optional
        All of the problem's, where they are read already; read here if left out.
    start : Fit, optional
        An earlier fit of fewer logs, to go on from, as in `seaopt.fit`.
    causes : bool
        False leaves out the search for what the model lacks, whatever the problem says of it.
    keep, progress : callable, optional
        As in `seaopt.fit`.

    Raises
    ------
    ProblemError
        There is nothing to fit.
    """
    if not problem.table.experiment:
        raise ProblemError(f"{problem.source}: has no [[experiment]] to fit; {WRITE_ONE}")
    every = problem.experiments() if experiments is None else experiments
    fitted = problem.choose_fitted(every)
    if not fitted:
        raise ProblemError(f'{problem.source}: every [[experiment]] has use = "validate"; fit one of them: use = "fit"')
    options = problem.fit_options
    options["causes"] = causes and options["causes"]
    result = fit(
        fitted,
        problem.parameters,
        start=start,
        keep=keep,
        progress=progress,
        alternatives=tuple(problem.plants.values()),
        validation=[experiment for experiment in every if experiment not in fitted],
        **options,
    )
    guesses = find_guesses(problem.table.guessed)
    return replace(result, findings=order_findings((*result.findings, *guesses))) if guesses else result


def simulate_experiment(problem: Problem, experiment: Experiment) -> Log:
    """Simulate the segments of an experiment, each from its initial state (zero where that is to be estimated)."""
    delay, start = experiment.delay_s, experiment.initial_state
    options: dict[str, Any] = {
        "delay_s": delay.value if isinstance(delay, Parameter) else delay,
        "initial_state": None if isinstance(start, str) else start,
        "hold": experiment.hold,
    }
    log = experiment.log
    clock = log.time - log.time[0]
    segments = [log.between(float(clock[p.start]), float(clock[p.stop - 1])) for p in log.segments]
    runs = [simulate(experiment.plant, problem.parameters, segment, **options) for segment in segments]
    signals = {
        name: Signal(name=name, values=np.concatenate([run[name] for run in runs]), unit=signal.unit)
        for name, signal in runs[0].signals.items()
    }
    return Log(time=np.concatenate([run.time for run in runs]), signals=signals, source=runs[0].source)


def score_problem(problem: Problem, result: Fit, experiments: Sequence[Experiment]) -> list[ModelledOutputs]:
    """Return a fit's predictions of the problem's experiments that are not fitted (`use = "validate"`)."""
    fitted = {experiment.name for experiment in problem.choose_fitted(experiments)}
    return [result.predict(experiment) for experiment in experiments if experiment.name not in fitted]


def can_design(problem: Problem, result: Fit) -> bool:
    """Tell whether a controller can be designed with a fit: it ended well, and what it leaves open has a range."""
    if result.status not in ("converged", "not_identifiable"):
        return False
    covariance = result.covariance
    return all(np.isfinite(covariance.std(name)) or name in problem.ranges for name in covariance.names)


def design_mpc(problem: Problem, source: Fit | ParameterSet) -> ForceMPC:
    """Design the predictive controller that a problem asks for."""
    assert problem.mpc is not None
    if problem.designs_on_response:
        raise ProblemError(
            f"{problem.source}: predictive control takes a model, and [controller] is designed on "
            f"{problem.response_names[0]}; name a plant there"
        )
    mpc = force_mpc(problem.design_plant, source, problem.mpc)
    heat = mpc.heat_guard if derates(problem, mpc) else None
    mpc = replace(mpc, gate=make_gate(problem, mpc, source), heat=heat)
    feedforward = make_value(problem.controller_table.link_feedforward, LinkFeedforward | None)
    if feedforward is not None:
        plants = {name: (plant, problem.values(source)) for name, plant in problem.certified_plants().items()}
        mpc = feed_link_forward(mpc, feedforward, plants)
    if problem.table.impedance is None and not problem.controller_table.compensate:
        return mpc
    law = surround_controller(problem, linear_controller(mpc), source)
    return replace(mpc, outer=law.outer, compensation=law.compensation)


def check_mpc_file(problem: Problem, mpc: ForceMPC, path: Path, remedy: str) -> None:
    """Refuse a file other than the controller.json of a problem's predictive controller (SeaoptError)."""
    is_json = path.suffix.lower() == ".json"
    content = parse_file(path, json.loads, "JSON", remedy="give a controller.json") if is_json else None
    if not isinstance(content, dict) or "mpc" not in content:
        raise ProblemError(
            f'{problem.source}: [controller] has structure = "mpc", and a law of one\'s own is no plan; write '
            'structure = "pid" for its limits'
        )
    check_described(content["mpc"], mpc, source=str(path), problem=problem.source, remedy=remedy)


def tune_problem(
    problem: Problem, source: Fit | ParameterSet, progress: Progress = ignore, executor: Executor | None = None
) -> Controller | JointTuning | ScheduledController:
    """Tune the problem's controller or schedule, as `seaopt tune` does; with `retune`, until it is certified.

    Where [robustness] leaves `retune` out, so is a law that is over a limit at the draws that a certificate makes; a
    look at some of them tells. With predictive control it is the law while no limit is active; `design_mpc` returns all
    of it.

    Parameters
    ----------
    problem : Problem
        What `read_problem` returned.
    source : Fit or ParameterSet
        The fit; or values, of a problem without experiments.
    progress : callable, optional
        As in `seaopt.tune`.
    executor : concurrent.futures.Executor, optional
        For the certificates, with `retune`; as in `seaopt.certify`.
    """
    if problem.mpc is not None:
        return linear_controller(design_mpc(problem, source))
    design, robust_to = list_plants(problem, source)
    assert problem.spec is not None
    spec, draws = settle_delays(problem.spec, problem.design_plant, source)[0], problem.draws(source)
    values, schedule, table = problem.values(source), problem.schedule, problem.robustness
    rounds = table.retune
    scheduled: dict[str, Any] = {}
    outer = find_outer(problem, source)
    if schedule is not None:
        scheduled = {"over": schedule.over, "points": schedule.points, "bandwidths_hz": schedule.bandwidth_hz}
    if schedule is not None and not rounds:

        def make(
            spec_now: ControllerSpec,
            witnesses: Mapping[str, tuple[Plant, ParameterSet]],
            near: ScheduledController | None,
            points: Sequence[float],
            part: Progress,
        ) -> ScheduledController:
            bands = schedule.bandwidth_hz and [schedule.bandwidth_hz[schedule.points.index(at)] for at in points]
            # A measured response has its place, where a pilot may have no point.
            whole = len(points) == len(schedule.points)
            kept = {name: at for name, at in robust_to.items() if whole or not isinstance(at, MeasuredResponse)}
            options: dict[str, Any] = {"draws": draws, "witnesses": witnesses, "near": near, "outer": outer}
            options["progress"] = part
            tuned = tune_schedule(
                problem.design_plant, values, spec_now, schedule.over, points, kept, bandwidths_hz=bands, **options
            )
            return complete_schedule(problem, tuned, source)

        if rounds == 0:
            return make(spec, {}, None, schedule.points, progress)
        return keep_reserve(make, partial(_look, problem, source=source), spec, schedule.points, progress)
    if not rounds:
        tuned = tune(design, values, spec, robust_to, draws=draws, outer=outer, progress=progress)
        tuned = complete_controller(problem, tuned, source)
        if rounds == 0 or not _needs_reserve(problem, tuned, source):
            return tuned
        rounds = ROUNDS
    if problem.designs_on_response and not problem.certified_plants():
        raise ProblemError(
            f"{problem.source}: retune = {rounds} in [robustness] tunes again at worst draws, and of "
            f"{problem.response_names[0]}, a measured response, nothing is drawn; leave retune out, or name models in "
            "plants of [robustness]"
        )
    return tune_certified(
        design,
        source,
        spec,
        problem.certified_plants(),
        ranges=problem.ranges,
        robust_to=robust_to,
        **scheduled,
        draws=draws,
        others=problem.parameters,
        measured=problem.measure_responses(source),
        samples=table.samples,
        seed=table.seed + 1,
        rounds=rounds,
        complete=partial(complete_controller if schedule is None else complete_schedule, problem, source=source),
        executor=executor,
        progress=progress,
    )


def sweep_problem(
    problem: Problem,
    source: Fit | ParameterSet,
    bandwidths_hz: Sequence[float],
    *,
    free_law: bool = False,
    executor: Executor | None = None,
    progress: Progress = ignore,
) -> tuple[Frontier, list[ForceMPC]]:
    """Tune a problem's controller at each of several bandwidths, as `seaopt tune --sweep` does; of predictive control
    the rows are of its linear region, and the plans are returned too. `free_law`, `executor`, `progress`: as in
    `seaopt.control.sweep`.
    """
    design, robust_to = list_plants(problem, source)
    if free_law and (problem.designs_on_response or problem.mpc is not None):
        on = f"is designed on {problem.response_names[0]}" if problem.designs_on_response else 'has structure = "mpc"'
        raise ProblemError(
            f"{problem.source}: --free-law compares gains with any law of a model, and [controller] {on}; leave "
            "--free-law out"
        )
    if problem.mpc is not None:
        specs = [replace(problem.mpc, bandwidth_hz=bandwidth_hz) for bandwidth_hz in bandwidths_hz]
        plans = [design_mpc(replace(problem, mpc=spec), source) for spec in count_off(specs, "bandwidth", progress)]
        return sweep_plans(plans, robust_to), plans
    assert problem.spec is not None
    schedule = problem.schedule
    result = sweep(
        design,
        problem.values(source),
        settle_delays(problem.spec, problem.design_plant, source)[0],
        bandwidths_hz,
        robust_to,
        over=None if schedule is None else schedule.over,
        points=() if schedule is None else schedule.points,
        outer=find_outer(problem, source),
        draws=problem.draws(source),
        free_law=free_law,
        executor=executor,
        progress=progress,
    )
    return result, []


def _needs_reserve(problem: Problem, controller: Controller, source: Fit | ParameterSet) -> bool:
    """Tell whether a controller that keeps its limits breaks one at the draws of its certificate."""
    if not controller.met or problem.response_names:
        return False
    return any(each.is_over for each in _look(problem, controller, source).values())


def _look(problem: Problem, law: Controller | ScheduledController, source: Fit | ParameterSet) -> dict[str, Look]:
    """Return the worst case of every plant of the certificate, at a look."""
    try:
        return look_at_draws(law, problem.certified_plants(), source, problem.ranges, problem.parameters)
    except ControlError:  # of what nothing can be drawn: the certificate says so, and needs it
        return {}


def list_plants(
    problem: Problem, source: Fit | ParameterSet, spec: LoopSpec | None = None
) -> tuple[Plant | MeasuredResponse, dict[str, Any]]:
    """Return design and robust plants, models and measured responses; `spec`: its delays replace the problem's."""
    measured, plants = problem.measure_responses(source), problem.robust_to(source, spec)
    responses = {name: response for name, response in measured.items() if name in problem.controller_table.robust_to}
    design = measured[problem.controller_table.plant] if problem.designs_on_response else problem.design_plant
    return design, {**plants, **responses}


def read_law(
    problem: Problem, source: Fit | ParameterSet, content: Mapping[str, Any]
) -> Controller | ScheduledController:
    """Return the law or schedule of a problem's controller.json; nothing is tuned. Raises FileError: it is damaged."""
    return restore_law(content, *_list_arguments(problem, source))


def read_sweep(problem: Problem, source: Fit | ParameterSet, content: Mapping[str, Any]) -> Frontier:
    """Return the sweep of a problem's frontier.json, as `read_law` does."""
    return Frontier.from_dict(content, *_list_arguments(problem, source))


def _list_arguments(problem: Problem, source: Fit | ParameterSet) -> tuple[Any, ...]:
    """Return what a law was tuned on, in the order of `from_dict`."""
    design, _ = list_plants(problem, source)
    return design, problem.values(source), problem.robust_to(source), problem.draws(source)


def assess_problem(problem: Problem, given: GivenLaw, source: Fit | ParameterSet) -> Controller:
    """Measure a law of one's own against the problem's limits, as `seaopt certify --controller` does. `given`: what
    `seaopt.control.read_law` returned; its rate and its delay are the loop's. Raises ProblemError: the problem has no
    [controller], or the law measures something else than it does.
    """
    if problem.schedule is not None:
        raise ProblemError(
            f"{problem.source}: has a [controller.schedule], and one law is measured against one [controller]; take it "
            "out"
        )
    if problem.spec is None:
        raise ProblemError(
            f"{problem.source}: has no [controller], whose limits a law is measured against; add one: bandwidth_hz = 30"
        )
    measured = problem.spec.measured if given.measured is None else given.measured
    regulated = list_names(measured)[0]
    if regulated != problem.spec.regulated:
        raise ProblemError(
            f"the law measures {regulated}, and [controller] of {problem.source} {problem.spec.regulated}; "
            f'correct one of them: measured = "{regulated}"'
        )
    at_its_rate = replace(problem.spec, sample_rate_hz=1.0 / given.law.sample_time_s, measured=measured)
    spec = replace(at_its_rate, **_choose_delays(problem.spec, given))
    _check_drive_delay(problem, given, spec, source)
    values = problem.values(source, spec)
    design, robust_to = list_plants(problem, source, spec)
    law = given.to_effort(command_of(problem.design_plant, values, spec.regulated).per_effort)
    outer = find_outer(problem, source)
    controller = assess(law, design, values, spec, robust_to, draws=problem.draws(source), outer=outer)
    return complete_controller(problem, controller, source)


def _choose_delays(spec: LoopSpec, given: GivenLaw) -> dict[str, Any]:
    """Return the delays that a law's file states; the problem's of the drive where it states none."""
    stated = dict.fromkeys(DELAY_KEYS) | dict(given.delays)
    if stated["delay_samples"] is None and stated["drive_delay_s"] is None:
        stated["drive_delay_s"] = spec.drive_delay_s
    return stated


def _check_drive_delay(problem: Problem, given: GivenLaw, spec: LoopSpec, source: Fit | ParameterSet) -> None:
    """Refuse a law whose loop is shorter than the problem says, and of which nobody tells how long the drive takes."""
    assert problem.spec is not None
    in_file, drive = problem.spec, find_drive_delay(spec, problem.design_plant, source)
    if given.delays.get("drive_delay_s") is not None or (in_file.delay_samples is not None and drive):
        return
    counted = spec.loop_delay_samples / spec.sample_rate_hz + drive
    if in_file.delay_samples is not None and spec.delay_samples is None:
        least = in_file.delay_samples / in_file.sample_rate_hz
        said = f"delay_samples = {in_file.delay_samples}, the whole loop"
    else:
        least = in_file.drive_delay_s or 0.0
        said = f"drive_delay_s = {least:g} of the drive alone"
    if counted < least - NEGLIGIBLE / spec.sample_rate_hz:
        raise ProblemError(
            f"the law's file counts {1e3 * counted:.4g} ms of delay in all, and [controller] of {problem.source} has "
            f"{said}, {1e3 * least:.4g} ms; give the law's file compute_delay_samples and drive_delay_s"
        )


def certify_problem(
    problem: Problem,
    controller: Controller | ScheduledController,
    source: Fit | ParameterSet,
    progress: Progress = ignore,
    executor: Executor | None = None,
    simulations: bool = True,
    large_signals: bool = True,
    thorough: bool = True,
) -> Certificate:
    """Certify a controller or schedule on the problem's plants, simulations included, as `seaopt certify` does.

    Parameters
    ----------
    problem : Problem
        What `read_problem` returned.
    controller : Controller or ScheduledController
        The law, which knows its design plant.
    source : Fit or ParameterSet
        The fit; or values, of a problem without experiments.
    progress, executor, simulations, large_signals, thorough
        As in `seaopt.certify`; without all simulations sensors and rounding are not simulated.
    """
    table, plants, measured = problem.robustness, problem.certified_plants(), problem.measure_responses(source)
    source, unread_logs = _add_logs(problem, source)
    if isinstance(controller, Controller) and problem.designs_on_response:
        if not plants:
            return certify(controller, plants, source, seed=table.seed, measured=measured)
        controller = controller.with_model
    law = controller.controllers[0] if isinstance(controller, ScheduledController) else controller
    read = list_readings(law, plants)
    certificate = certify(
        controller if problem.mpc is None else design_mpc(problem, source),
        plants,
        source,
        ranges=problem.ranges,
        others=problem.parameters,
        samples=table.samples,
        seed=table.seed,
        max_failure_probability=table.max_failure_probability,
        min_friction_margin=table.min_friction_margin,
        min_rate=None if problem.schedule is None else problem.schedule.min_rate,
        runs=table.constrained_runs,
        bound_tolerance=table.bound_tolerance,
        bounds=Budget() if table.bounds else None,
        simulations=simulations,
        large_signals=large_signals,
        thorough=thorough,
        sensors=problem.sensors.of(read) if simulations else None,  # the file may name those of its other laws
        command_step=table.step if simulations else 0.0,
        measured=measured,
        executor=executor,
        progress=progress,
    )
    unread, notes = [name for name in problem.sensors.names if name not in read], list(unread_logs)
    if unread:
        notes.append(f"errors of {', '.join(unread)} in sensors are in no run: the law reads {', '.join(read)}")
    return replace(certificate, remarks=(*certificate.remarks, *notes)) if notes else certificate


def _add_logs(problem: Problem, source: Fit | ParameterSet) -> tuple[Fit | ParameterSet, tuple[str, ...]]:
    """Return a fit that was read from a file with its logs, which judge the law; and why they cannot be read."""
    if not isinstance(source, Fit) or source.experiments:
        return source, ()
    try:
        every = problem.experiments()
    except SeaoptError as error:
        return source, (f"the fit's logs do not judge the law, for they cannot be read: {error}",)
    fitted = problem.choose_fitted(every)
    scored = tuple(experiment for experiment in every if experiment not in fitted)
    return replace(source, experiments=fitted, validation=scored, holdout=problem.table.fit.holdout), ()


_STAGE_OF = {"controller": "tune", "certificate": "certify"}  # what makes a result that is named otherwise


class Stages:
    """A problem's results, each made once, when it is first asked for; an error that making one raised is kept too.

    Parameters
    ----------
    problem : Problem
        What `read_problem` returned.
    **made
        Results that are there already, by name: fit, scores, controller, certificate.

    Examples
    --------
    >>> import seaopt as so
    >>> stages = Stages(so.read_problem(so.demo_path()))
    >>> stages.problem.title  # stages.fit, stages.controller and stages.certificate take their time
    'THOR linear SEA'
    """

    def __init__(self, problem: Problem, **made: Any) -> None:
        self.problem = problem
        self.results = {_STAGE_OF.get(name, name): result for name, result in made.items()}  # by stage

    @property
    def fit(self) -> Fit | None:
        """The fit; None of a problem without experiments."""
        fitted = self.problem.table.experiment
        return self._keep("fit", lambda: fit_problem(self.problem, self.experiments) if fitted else None)

    @property
    def scores(self) -> list[ModelledOutputs]:
        """The predictions of what was not fitted."""
        fit = self.fit
        return self._keep("scores", lambda: [] if fit is None else score_problem(self.problem, fit, self.experiments))

    @property
    def controller(self) -> Controller | None:
        """The controller; None where the problem asks for none, or for a schedule, or the fit allows none."""
        return None if self.problem.schedule else self._keep("tune", self._tune)

    @property
    def certificate(self) -> Certificate | None:
        """The certificate of the controller; None where there is none."""
        return None if self.problem.schedule else self._keep("certify", self._certify)

    @property
    def experiments(self) -> tuple[Experiment, ...]:
        """The problem's experiments, read or made once."""
        return self._keep("experiments", self.problem.experiments)

    @property
    def _source(self) -> Fit | ParameterSet:
        """What is designed with: the fit, or the file's values of a problem without experiments."""
        return self.problem.parameters if self.fit is None else self.fit

    def _tune(self) -> Controller | None:
        problem = self.problem
        if problem.spec is None or (self.fit is not None and not can_design(problem, self.fit)):
            return None
        tuned = tune_problem(problem, self._source)
        tuned = tuned.controller if isinstance(tuned, JointTuning) else tuned
        assert isinstance(tuned, Controller)
        return tuned

    def _certify(self) -> Certificate | None:
        if self.controller is None:
            return None
        certificate = certify_problem(self.problem, self.controller, self._source)
        assert isinstance(certificate, Certificate)
        return certificate

    def _keep(self, name: str, make: Callable[[], Any]) -> Any:
        if name not in self.results:
            try:
                self.results[name] = make()
            except SeaoptError as error:
                self.results[name] = error
        result = self.results[name]
        if isinstance(result, SeaoptError):
            raise result
        return result
