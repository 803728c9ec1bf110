"""What a law is to do under the reference of a stage, alone or with its outer loop: what is played and expected."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
from jaxtyping import Float

from seaopt.bench import Sensors
from seaopt.codec import OrInfinite
from seaopt.control import Controller
from seaopt.control.loops.moved_link import MOVED, find_position
from seaopt.control.loops.outer_loop import OuterLoop
from seaopt.control.scheduling.scheduled_controller import place_variable
from seaopt.errors import ControlError, suggestion
from seaopt.formatting import join_words
from seaopt.machine.bringup.excitation import Excitation, design_excitation
from seaopt.machine.bringup.predicted import DRAWN, find_share, list_broken, predict_played
from seaopt.machine.design_run import run_design
from seaopt.machine.response.enclosed import enclose_outer
from seaopt.machine.response.judged import Prediction
from seaopt.machine.response.verdicts import LEAST_PHASES, AgainstFriction, find_friction, has_dry_friction
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.plants.friction import can_stick
from seaopt.records import record
from seaopt.robustness.uncertainty.worst import place_values
from seaopt.robustness.verification.verification import list_readings

STOP = 1.3  # times what is predicted: where to stop
MOVES = 2.0  # times the dry friction: the effort that a stage's reference is to make where the limits leave room
BARELY = 1.2  # times the dry friction: the effort where the limits leave no room for that
RAISES, ONWARD = 4, 1.1  # times that an amplitude is raised to it, and by which factor at least
SILENT = 1e-3  # share of the limits that a reference takes beside which noise is looked at by itself
ROOM, LESS, LOWERS = 0.95, 0.85, 8  # of the limit of the command, below which peaks stay, and steps down to it
SEED = 1
NOISE_RUNS = 20  # with noise, at least
KEPT = 0.98  # of certified machines, that stay below what is expected at most of a signal
BELOW = 0.998  # by t: of 20 peaks, whose distribution is Gumbel's, 98.5 % of one more machine
PERIODS, PERIODS_OF_PHASES = 10, 4  # of one set of phases, and of each of six
Peaks = Float[np.ndarray, "ways n"]  # of each run, with friction as its curve says and sticking


@record
class Band:
    """A response over time or frequency, and between what it lies on the draws."""

    at: tuple[float, ...]  # s or Hz
    nominal: tuple[OrInfinite, ...]
    low: tuple[OrInfinite, ...]
    high: tuple[OrInfinite, ...]


@record(eq=False)
class Expected(AgainstFriction):
    """What is played, and what it is to do.

    Parameters
    ----------
    controller : Controller
        What closes the loop, as one law.
    excitation : Excitation
        The reference to play.
    tracking, sensitivity : Band
        Sizes of Y/R and S at the lines.
    step : Band
        What follows the reference, after a step of one.
    step_size : float or None
        The largest step whose command stays within its limit; None without one.
    stop : mapping of str to float
        Largest magnitudes; beyond them the stage is to be stopped.
    effort : float or None
        Of a plant with dry friction: the most by which the effort swings about its middle while the periods are
        played, by simulation.
    friction : float or None
        The effort that dry friction takes: below it the motor does not move.
    prediction : Prediction or None
        Of a plant with dry friction: what it and draws of it do under this reference, as acceptance will judge its log;
        None with an outer loop.
    enough : float or None
        Where these break a limit of the law themselves: the share of the limits of command, travel and force at which
        they keep it; None where none does.
    lowered : bool
        Whether that share is not played for the peak of the command, which is at its limit there.
    ran_away : int
        Draws of the certified machines whose loop grows without end: they are in no band and no peak.
    """

    controller: Controller
    excitation: Excitation
    tracking: Band
    sensitivity: Band
    step: Band
    step_size: float | None
    stop: Mapping[str, float]
    effort: float | None = None
    friction: float | None = None
    prediction: Prediction | None = None
    enough: float | None = None
    lowered: bool = False
    ran_away: int = 0

    @property
    def broken(self) -> tuple[str, ...]:
        """The figures whose limits certified machines break themselves under this reference."""
        return () if self.prediction is None else tuple(list_broken(self.controller, self.prediction))

    @property
    def unit(self) -> str:
        """Of the reference."""
        return self.controller.command.reference_unit

    @property
    def follows(self) -> str:
        """The output that follows the reference."""
        return self.controller.spec.regulated


@record(eq=False)
class OuterExpected(Expected):
    """What is played once the outer loop is closed around the full law, on the plant of its link; `controller` is the
    law with the outer loop in it. The reference is x_0, without a stiffness the force that the damping is added to.
    """

    outer: OuterLoop

    @property
    def unit(self) -> str:
        """Of the reference."""
        return self.outer.place_unit if self.outer.stiffness else self.controller.command.reference_unit

    @property
    def follows(self) -> str:
        """The output that follows the reference."""
        return self.outer.position if self.outer.stiffness else self.controller.spec.regulated


def expect(
    controller: Controller,
    draws: Sequence[Mapping[str, float]],
    options: Mapping[str, Any],
    count: int | None = None,
    *,
    shown: Controller | None = None,
    runs: Controller | None = None,
    per_given: float = 1.0,
) -> dict[str, Any]:
    """Return the fields of what is expected. `count`: samples of a step, as many as a period has if left out. Of a law
    with an outer loop in it `shown` is the same law, what follows the reference being the first that it reads, `runs`
    is what runs, and `per_given` the controller's reference by one of what that is given.
    """
    shown = controller if shown is None else shown
    runs = replace(controller, outer=None) if runs is None else runs  # a stage is of the force law alone
    assert controller.design is not None
    plant, values = controller.design
    closed = [(each, shown.close(plant, place_values(plant, values, each))) for each in draws]
    kept = [(each, loop) for each, loop in closed if not loop.grows()]
    excitation, fields = _excite(controller, runs, per_given, draws, [each for each, _ in kept], options)
    loops = [shown.close(plant, values), *(loop for _, loop in kept)]
    f, size = excitation.frequency_hz, abs(per_given)
    stepped = [loop.simulate(np.full(count or excitation.period, per_given)) for loop in loops]
    steps, efforts = (np.array([run[k] for run in stepped]) for k in (0, 1))
    limit = controller.command_limit
    return {
        "controller": controller,
        "excitation": _scale(excitation, per_given),
        "tracking": _band(f, size * np.abs([loop.tracking(f) for loop in loops])),
        "sensitivity": _band(f, np.abs([loop.sensitivity(f) for loop in loops])),
        "step": _band(controller.sample_time_s * np.arange(steps.shape[1]), steps),
        "step_size": None if limit is None else float(limit / controller.per_effort / np.max(np.abs(efforts))),
        "stop": {key: min(STOP * peak, excitation.limits.get(key, np.inf)) for key, peak in excitation.peaks.items()},
        "ran_away": len(closed) - len(kept),
        **fields,
    }


def find_noise(controller: Controller, options: Mapping[str, Any]) -> float:
    """Return the peak of a law's command that the noise and the rounding of what it reads make by themselves."""
    given: dict[str, Any] = {key: options[key] for key in ("limits", "seed")}
    silent = design_excitation(controller, share=SILENT, bias=0.0, phases=1, periods=PERIODS, **given)
    runs = replace(controller, outer=None)
    return _bound_next(_find_peaks(controller, runs, silent, (), options["sensors"])[controller.command.input])


def split_limits(
    controller: Controller, limits: Mapping[str, float], link: tuple[Plant, ParameterSet] | None
) -> tuple[dict[str, float], dict[str, float]]:
    """Return the limits of the law alone, and of it with its outer loop on the plant of its link. Raises ControlError:
    neither plant has such a signal.
    """
    assert controller.design is not None
    own = {controller.command.input, *filter(None, controller.see(controller.design[0]).outputs)}
    other = set[str]() if controller.outer is None or link is None else {*controller.see(link[0]).outputs}
    for name in limits:
        if name not in own | other:
            known = sorted(own | other, key=lambda each: (each != controller.command.input, each))
            raise ControlError(f"limits names {name}; {suggestion(name, known)}")
    alone = {name: value for name, value in limits.items() if name in own}
    return alone, {name: value for name, value in limits.items() if name in other}


def enclose_link(
    controller: Controller, link: tuple[Plant, ParameterSet] | None, place: tuple[str, float] | None
) -> Controller | None:
    """Return a law with its outer loop in it, where that is stable on the plant of its link. `place`: of a schedule's
    variable.
    """
    if controller.outer is None or link is None:
        return None
    enclosed = enclose_outer(controller, link if place is None else (link[0], place_variable(*link, *place)))
    return enclosed if enclosed.achieved.stable else None


def expect_outer(
    law: Controller,
    outer: OuterLoop,
    enclosed: Controller,
    draws: Sequence[Mapping[str, float]],
    options: Mapping[str, Any],
) -> OuterExpected:
    """Return what is played and expected with a law's outer loop closed, which is in the law that is enclosed: with a
    stiffness the link follows x_0.
    """
    assert enclosed.design is not None
    shown, runs = enclosed, replace(law, design=enclosed.design)
    if outer.stiffness:
        place = find_position(enclosed.design[0], outer)
        order = sorted(range(len(enclosed.signals)), key=lambda k: enclosed.signals[k] != place)
        columns = [0, *(1 + k for k in order)]
        ordered = replace(enclosed.law, b=enclosed.law.b[:, columns], d=enclosed.law.d[columns])
        shown = replace(enclosed, law=ordered, reads=tuple(enclosed.signals[k] for k in order))
    fields = expect(enclosed, draws, options, shown=shown, runs=runs, per_given=outer.per_given)
    fields["stop"].pop(MOVED, None)  # which is the position, as the damping has it
    peaks = {name: peak for name, peak in fields["excitation"].peaks.items() if name != MOVED}
    return OuterExpected(outer=outer, **fields | {"excitation": replace(fields["excitation"], peaks=peaks)})


def _excite(
    controller: Controller,
    runs: Controller,
    per_given: float,
    draws: Sequence[Mapping[str, float]],
    kept: Sequence[Mapping[str, float]],
    options: Mapping[str, Any],
) -> tuple[Excitation, dict[str, Any]]:
    """Return the reference of a stage; of a plant with dry friction the effort that it makes, the friction, and what
    certified machines do under it, with an amplitude that moves the motor, and at which they keep the limits of the
    law, where the largest share of the limits, "most", allows it. `kept`: the draws whose loop does not grow, of
    which the peaks are. Raises ControlError: a run is not finite.
    """
    dry = has_dry_friction(controller)
    given: dict[str, Any] = {key: options[key] for key in ("bias", "limits", "seed")}
    given["phases"], given["periods"] = (LEAST_PHASES, PERIODS_OF_PHASES) if dry else (1, PERIODS)
    share, most, friction = options["share"], options["most"], find_friction(controller)

    def play(share: float) -> tuple[Excitation, float | None]:
        excitation = design_excitation(controller, share=share, **given)
        return excitation, _measure_swing(controller, runs, _scale(excitation, per_given)) if dry else None

    def find_peaks(excitation: Excitation, most: float | None) -> dict[str, Peaks]:
        return _find_peaks(controller, runs, _scale(excitation, per_given), kept, options["sensors"], most)

    @cache  # runs of all draws, mostly asked for twice at the share that is played
    def predict(share: float) -> Prediction:
        excitation = design_excitation(controller, share=share, **given)
        return predict_played(controller, excitation, draws, options["sensors"])

    def keeps(share: float) -> bool:
        return not list_broken(controller, predict(share))

    limit, command = controller.command_limit, controller.command.input
    excitation, effort = play(share)
    for _ in range(RAISES):
        if effort is None or effort >= MOVES * friction or share >= most:
            break
        share = min(share * max(MOVES * friction / max(effort, 1e-12), ONWARD), most)
        excitation, effort = play(share)
    enough, predicts = None, dry and runs.outer is None
    if predicts:
        enough = share if keeps(share) else find_share(keeps, share, most)
        if enough is not None and share < enough <= most:
            share = enough
            excitation, effort = play(share)
    chosen, room = share, None if limit is None else ROOM * limit
    for _ in range(LOWERS):  # a period in which the command is at its limit is lost for the response
        peaks = find_peaks(excitation, room)
        if room is None or np.max(peaks[command]) < room:
            break
        share *= LESS
        excitation, effort = play(share)
    else:
        peaks = find_peaks(excitation, None)
    if endless := [name for name, seen in peaks.items() if not np.all(np.isfinite(seen))]:
        raise ControlError(
            f"{options.get('name', 'the law')}: {join_words(endless)} under its reference is not finite: the loop runs "
            "away; tune and certify a law that keeps its limits, or narrow the ranges of what it is certified for"
        )
    fields: dict[str, Any] = {"effort": effort, "friction": friction if dry else None}
    if predicts:
        fields["prediction"] = predict(share)
        if enough is not None and list_broken(controller, fields["prediction"]):
            fields |= {"enough": enough, "lowered": share < chosen}
    return replace(excitation, peaks={name: _bound_next(runs) for name, runs in peaks.items()}), fields


def _scale(excitation: Excitation, per_given: float) -> Excitation:
    """Return the reference of a law as it is given to what runs."""
    waves, size = excitation.list_waves() / per_given, abs(per_given)
    return replace(excitation, waves=waves, amplitude=excitation.amplitude / size, bias=excitation.bias / per_given)


def _measure_swing(controller: Controller, runs: Controller, given: Excitation) -> float:
    """Return the most by which the effort of the design plant swings about its middle while the periods are played."""
    assert controller.design is not None
    run, period = run_design(runs, [controller.design[1]], given.reference), given.period
    return float(np.ptp(run.current[0, period:-period])) / 2.0 / abs(controller.per_effort)


def _find_peaks(
    controller: Controller,
    runs: Controller,
    given: Excitation,
    draws: Sequence[Mapping[str, float]],
    sensors: Sensors | None,
    most: float | None = None,
) -> dict[str, Peaks]:
    """Return the peaks of the command, the plant's outputs and what is read under a reference, one for each run: by its
    lines where the machine is known, linear and read without error, else of the design plant and of draws, each with
    its own noise. With dry friction the lines tell nothing: they are those of a machine without it; and each runs with
    friction as its curve says, and with one that sticks, as a machine may be of either. A reading's noise is drawn anew
    for its own peak, which does not change how likely it is: white noise reaches the plant a sample later at the
    earliest. Once the command is not below the `most`, no further machine runs.
    """
    assert controller.design is not None
    plant, values = controller.design
    noise = Sensors() if sensors is None else Sensors(noise_std=sensors.noise_std, quantisation=sensors.quantisation)
    noise = noise.of(list_readings(runs, {"": plant}))
    noisy, dry = any((*noise.noise_std.values(), *noise.quantisation.values())), has_dry_friction(controller)
    by_lines = controller.compensation is None and given.phases == 1 and not dry
    if by_lines and not noisy and not draws:
        return {name: np.array([[peak]]) for name, peak in given.peaks.items()}
    sets = [values, *(place_values(plant, values, draw) for draw in draws[:DRAWN])]
    if noisy:
        sets = [*sets, *sets * NOISE_RUNS][: max(len(sets), NOISE_RUNS)]
    seen = controller.see(plant)
    completed = seen.complete(controller.delay(values))
    errors = {name: noise.combine_errors(seen, completed, name) for name in controller.signals if name in given.peaks}
    groups = math.ceil(0.5 * len(sets)) if noisy else 1  # two runs share their noise, with both signs

    def reaches(peaks: Mapping[str, Sequence[float]]) -> bool:
        return most is not None and not np.max(peaks[controller.command.input]) < most  # which NaN is not

    def run_all(sticks: bool) -> dict[str, list[float]]:
        peaks: dict[str, list[float]] = {name: [] for name in given.peaks}
        for seed in range(groups):
            part = sets[seed::groups]
            signs = np.resize([1.0, -1.0], len(part))  # of the noise, which is the same in all runs of a call
            run = run_design(runs, part, given.reference, sensors=noise, seed=seed, noise_gain=signs, sticks=sticks)
            signals = {**run.outputs, controller.command.input: run.current}
            rng = np.random.default_rng((SEED, seed))
            for name, (std, step) in errors.items():
                signals[name] = np.abs(signals[name] + std * rng.normal(size=signals[name].shape)) + 0.5 * step
            for name, rows in peaks.items():
                rows += np.max(np.abs(signals[name]), axis=1).tolist()
            if reaches(peaks):
                break
        return peaks

    ways = list[dict[str, list[float]]]()
    for sticks in (False, True) if dry and can_stick(seen) else (False,):
        ways.append(run_all(sticks))
        if reaches(ways[-1]):
            return {name: np.array([peaks]) for name, peaks in ways[-1].items()}
    return {name: np.array([peaks[name] for peaks in ways]) for name in given.peaks}


def _bound_next(peaks: Peaks) -> float:
    """Return what the peak of one more machine stays below, in whichever way it runs: by Student's t, of the distance
    from the mean of some to one more. At least the largest that was seen.
    """
    from scipy.special import stdtrit  # deferred: 0.1 s

    n, largest = peaks.shape[1], float(np.max(peaks))
    if n == 1:
        return largest
    factor = float(stdtrit(n - 1, BELOW)) * math.sqrt(1.0 + 1.0 / n)
    return max(largest, float(np.max(np.mean(peaks, axis=1) + factor * np.std(peaks, axis=1, ddof=1))))


def _band(at: Float[np.ndarray, " m"], rows: Any) -> Band:
    rows = np.asarray(rows)
    return Band(
        at=tuple(at.tolist()),
        nominal=tuple(rows[0].tolist()),
        low=tuple(np.min(rows, axis=0).tolist()),
        high=tuple(np.max(rows, axis=0).tolist()),
    )
