r"""A plant that moves its own scheduling variable: the nonlinear plant under the interpolated gains, by simulation.

A sweep (`schedule_sweep`) imposes how the variable moves. Where the variable is a state, such as the angle of a link
that swings under load, what the law commands moves it and its gains follow: a loop that neither frozen points nor
sweeps contain. Here nothing is imposed. From rest in the middle of the table the reference steps to and fro,

.. math:: r(t) = y_0 + A\,m(t), \qquad m = 1, -1, -1, 1, \; 1, -1, -1, 1, \ldots, 0,

so that a link which nothing holds comes back; from one push to the next in a period of the bandwidth, since a jump
would take the command to its limit. Each push lasts as long as the variable takes from the middle of the table to its
end at the rate that is stated, and A is as large as makes it move at that rate, or as table and limit of the command
allow. Where the rate is not reached, pushes of another length are tried: of a mass A moves it by :math:`A T^2` at the
rate :math:`A T`, so that it is fastest where a push takes it to the end of the table and the command to its limit. What
is judged is then the rate that is reached, and the result says which.

Two things are judged over the last two periods of the bandwidth in every push: how far the output is from its
reference, so that a loop that departs is found, and what remains of that beside the best parabola, which is what rings:
a link that swings is slower. Each is over the step of 2 A, and a tenth of it at most, or twice what the loops of the
points leave under the same reference while the variable stands still.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from seaopt.codec import OrInfinite
from seaopt.control.running.closed_loop import LoopRun
from seaopt.control.scheduling.scheduled_controller import ScheduledController
from seaopt.errors import SimulationError
from seaopt.formatting import format_percent
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.records import record
from seaopt.robustness.verification.judgement import Judge, take_ends
from seaopt.robustness.verification.oscillation import Signal
from seaopt.robustness.verification.scenarios import SETTLED
from seaopt.robustness.verification.schedule_sweep import RestStart, find_least_effort

PUSHES, ROUNDS = (1.0, -1.0, -1.0, 1.0), 3
LEAST_PERIODS, MOST_PERIODS, JUDGED_PERIODS = 5, 20, 2  # of the least bandwidth: of a push, and of its end
FIRST_SHARE = 1e-3  # of the effort that the command's limit leaves: the first push that is tried
NEAR, AIM, TRIES = 0.97, 0.985, 12  # shares of what is allowed that a push takes: enough, sought; pushes that are tried
LEAST_ROOM = 1e-6  # share of it: a variable that moves by less is not moved
LOST_SHARE = 4.0  # of what is allowed, that a push is taken to take which is lost


@record
class Motion:
    """The findings on a plant that moves the variable, by simulation."""

    plant: str
    asked: float  # the rate of the variable that was to be reached, in its unit per second
    rate: float  # the largest that was
    low: float  # ends of its motion
    high: float
    size: float  # A, in the output's unit
    left: OrInfinite  # at the end of a push, over 2 A: how far the output is off
    ringing: OrInfinite  # what of that is fast
    fault: str  # why it does not keep the judgement; empty where it does
    lost: str = ""  # how larger pushes are, where that is why the rate was not reached


@record(eq=False)
class _Push:
    """A run under pushes of a size: the rate reached, and the shares taken of the room and of the command's limit."""

    size: float
    run: LoopRun
    rate: float
    room: float
    command: float


@record(eq=False)
class _Pushing:
    """A plant under a schedule, at rest in the middle of the table, and the pushes of its reference."""

    schedule: ScheduledController
    plant: Plant
    start: RestStart
    middle: float
    room: float
    pushes: Signal
    lasting: int
    period: int

    def follow(self, run: LoopRun) -> Signal:
        """Return the variable at each sample."""
        return run.states[0, :, list(self.plant.states).index(self.schedule.over)]

    def find_push(self, rate: float, first: float) -> tuple[_Push | None, str]:
        """Return the push that moves the variable at a rate, or as fast as it may; None where even small ones fail. And
        how larger ones were lost, where that ends the search.
        """
        size, kept, limit, loss = first, None, self.schedule.runnable().command_limit, ""
        for _ in range(TRIES):
            try:
                run = self.start.run(self.plant, self.start.params, size * self.pushes[None])
                path = self.follow(run)
                push = _Push(
                    size=size,
                    run=run,
                    rate=float(np.max(np.abs(np.diff(path)))) / self.schedule.spec.sample_time_s,
                    room=float(np.max(np.abs(path - self.middle))) / self.room,
                    command=float(np.max(np.abs(run.current))) / limit,
                )
                share = max(NEAR * push.rate / rate, push.room, push.command)
                kept = push if share <= 1.0 else kept
            except SimulationError as error:
                share, loss = LOST_SHARE, f"is lost: {error}"
            if NEAR <= share <= 1.0:
                return kept, ""
            size *= AIM / max(share, AIM / LOST_SHARE)
        return kept, loss

    def measure(self, error: Signal) -> tuple[float, float]:
        """Return how large an error is at the ends of pushes, over their step, and its fast part."""
        ends, judged = range(self.lasting, self.pushes.size + 1, self.lasting), JUDGED_PERIODS * self.period
        windows = take_ends(error, ends, judged)
        slow = np.linalg.qr(np.vander(np.linspace(-1.0, 1.0, judged), 3))[0]
        fast = windows - windows @ slow @ slow.T
        return 0.5 * float(np.max(np.abs(windows))), 0.5 * float(np.max(np.abs(fast)))


def move_schedule(
    schedule: ScheduledController, name: str, plant: Plant, params: ParameterSet, rate: float
) -> Motion | None:
    """Push a plant so that it moves its scheduling variable at a rate, per second; None of one that holds it."""
    if schedule.over not in plant.states:
        return None
    pushing = _make_pushing(schedule, plant, params, rate)
    push, loss = pushing.find_push(rate, FIRST_SHARE * find_least_effort(schedule))
    if push is None:
        middle, lost = (dict.fromkeys(("low", "high"), pushing.middle), dict.fromkeys(("left", "ringing"), math.inf))
        fault = f"{loss}, under any push, small ones too"
        return Motion(plant=name, asked=rate, rate=0.0, size=0.0, fault=fault, **middle, **lost)
    if push.rate < rate:
        pushing, push, loss = _change_length(pushing, push, loss, rate)
    path, size = pushing.follow(push.run), push.size
    left, ringing = pushing.measure(pushing.start.find_errors(push.run, path)[0] / size)
    standing = [
        pushing.measure(loop.simulate(pushing.pushes)[0] - pushing.pushes)
        for loop in schedule.close_points(plant, params)
        if loop.is_stable()
    ]
    most, most_ringing = (
        max(SETTLED, *(2.0 * each for each in values)) for values in zip((0.0, 0.0), *standing, strict=True)
    )
    judge = Judge()
    rings = f"rings: {format_percent(ringing)} of a push at its end, {format_percent(most_ringing)} allowed"
    judge.require("ringing", ringing, most_ringing, rings)
    off = f"departs: a push is still {format_percent(left)} off at its end, {format_percent(most)} allowed"
    judge.require("settling", left, most, off)
    return Motion(
        plant=name,
        asked=rate,
        rate=push.rate,
        low=float(np.min(path)),
        high=float(np.max(path)),
        size=size,
        left=left,
        ringing=ringing,
        fault=judge.first,
        lost=loss if push.rate < rate else "",
    )


def _change_length(pushing: _Pushing, push: _Push, loss: str, rate: float) -> tuple[_Pushing, _Push, str]:
    """Return pushes of the length that takes both room and command to their limits, where these are faster."""
    lasting = _limit_length(pushing.lasting * math.sqrt(push.command / max(push.room, LEAST_ROOM)), pushing.period)
    if lasting == pushing.lasting:
        return pushing, push, loss
    other = replace(pushing, pushes=_make_pushes(lasting, pushing.period), lasting=lasting)
    faster, later = other.find_push(rate, push.size)
    return (pushing, push, loss) if faster is None or faster.rate <= push.rate else (other, faster, later)


def _make_pushing(schedule: ScheduledController, plant: Plant, params: ParameterSet, rate: float) -> _Pushing:
    """Return the pushes that move a plant's variable at a rate."""
    low, high, ts = schedule.points[0], schedule.points[-1], schedule.spec.sample_time_s
    middle, room = 0.5 * (low + high), 0.5 * (high - low)
    period = math.ceil(1.0 / min(schedule.bandwidths_hz) / ts)
    lasting = _limit_length(room / rate / ts, period)
    return _Pushing(
        schedule=schedule,
        plant=plant,
        start=RestStart.at_rest(schedule, plant, params, middle),
        middle=middle,
        room=room,
        pushes=_make_pushes(lasting, period),
        lasting=lasting,
        period=period,
    )


def _limit_length(samples: float, period: int) -> int:
    return int(np.clip(round(samples), LEAST_PERIODS * period, MOST_PERIODS * period))


def _make_pushes(lasting: int, period: int) -> Signal:
    """Return pushes of one that last so many samples."""
    edge = np.hanning(period + 2)
    steps = np.repeat([*(PUSHES * ROUNDS), 0.0, 0.0], lasting)
    return np.convolve(steps, edge / np.sum(edge))[: steps.size]


def describe_motion(motion: Motion, over: str, unit: str) -> str:
    """Return what was found where a plant moves the variable `over`, in one line; rates are in `unit`."""
    ends = f"{motion.low:.3g} and {motion.high:.3g}"
    head = f"moves {over} by itself between {ends} at up to {motion.rate:.3g} {unit}"
    moves = f"{head}, pushed to and fro, and {motion.fault or 'neither rings nor departs'}"
    if motion.rate >= motion.asked:
        return moves
    why = f": a larger push {motion.lost}" if motion.lost else " within the table and the command's limit"
    return f"{moves}; {motion.asked:.3g} {unit} is not reached{why}"
