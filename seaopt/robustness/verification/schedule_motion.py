r"""A plant that moves its own scheduling variable: the nonlinear plant under the interpolated gains, by simulation.

A sweep (`schedule_sweep`) imposes how the variable moves. Where the variable is a state, such as the angle of a link
that swings under load, what the law commands moves it and its gains follow: a loop that neither frozen points nor
sweeps contain. Here nothing is imposed. From rest in the middle of the table the reference steps to and fro,

.. math:: r(t) = y_0 + A\,m(t), \qquad m = 1, -1, -1, 1, \; 1, -1, -1, 1, \ldots, 0,

so that a link which nothing holds comes back; from one push to the next in a period of the bandwidth, since a jump
would take the command to its limit. Each push lasts as long as the variable takes from the middle of the table to its
end at the rate that is stated, and A is as large as makes it move at that rate, or as table and limit of the command
allow.

Two things are judged over the last two periods of the bandwidth in every push: how far the output is from its
reference, so that a loop that departs is found, and what remains of that beside the best parabola, which is what rings:
a link that swings is slower. Each is over the step of 2 A, and a tenth of it at most, or twice what the loops of the
points leave under the same reference while the variable stands still.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

from seaopt.control.loops.loop import Loop
from seaopt.control.running.force_run import ForceRun, close_loop
from seaopt.control.scheduling.scheduled_controller import ScheduledController, place_variable
from seaopt.errors import ControlError, SimulationError
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.records import record
from seaopt.robustness.verification.scenarios import SETTLED
from seaopt.robustness.verification.schedule_sweep import RestStart, find_least_effort
from seaopt.units import unit_after

PUSHES, ROUNDS = (1.0, -1.0, -1.0, 1.0), 3
LEAST_PERIODS, MOST_PERIODS, JUDGED_PERIODS = 5, 20, 2  # of the least bandwidth: of a push, and of its end
FIRST_SHARE = 1e-3  # of the effort that the command's limit leaves: the first push that is tried
NEAR, AIM, TRIES = 0.97, 0.985, 12  # shares of what is allowed that a push takes: enough, sought; pushes that are tried
LOST_SHARE = 4.0  # of what is allowed, that a push is taken to take which is lost


@record
class Motion:
    """What the simulation of a plant that moves the variable found.

    Parameters
    ----------
    plant : str
        Its name.
    rate, low, high : float
        The largest rate of the variable, in its unit per second, and the ends of its motion.
    size : float
        A, in the output's unit.
    left, ringing : float
        At the end of a push, over 2 A: how far the output is off, and what of that is fast.
    fault : str
        Why it does not keep the judgement; empty where it does.

    """

    plant: str
    rate: float
    low: float
    high: float
    size: float
    left: float
    ringing: float
    fault: str


@record(eq=False)
class _Pushing:
    """A plant under a schedule, at rest in the middle of the table, and the pushes of its reference."""

    schedule: ScheduledController
    plant: Plant
    start: RestStart
    middle: float
    room: float
    pushes: Float[np.ndarray, " n"]
    lasting: int
    judged: int

    def run(self, size: float) -> ForceRun:
        """Return the loop under pushes of a size."""
        law, start, spec = self.schedule.runnable(), self.start, self.schedule.spec
        return close_loop(
            law.step, law.reset(start.output, start.output, self.middle, start.command), self.plant, start.params,
            start.output + size * self.pushes, measured=spec.regulated, sample_time_s=spec.sample_time_s,
            delay_samples=spec.loop_delay_samples, start_state=start.take(self.plant), start_command=start.command,
            place=self.schedule.over,
        )  # fmt: skip

    def follow(self, run: ForceRun) -> Float[np.ndarray, " n"]:
        """Return the variable at each sample."""
        return run.state[:, list(self.plant.states).index(self.schedule.over)]

    def measure_rate(self, run: ForceRun) -> float:
        """Return the variable's largest rate."""
        return float(np.max(np.abs(np.diff(self.follow(run))))) / self.schedule.spec.sample_time_s

    def find_size(self, rate: float, first: float) -> float | None:
        """Return the push that moves the variable at a rate, or as fast as it may; None where even small ones fail."""
        size, kept, limit = first, None, self.schedule.runnable().limit
        for _ in range(TRIES):
            try:
                run = self.run(size)
                away = float(np.max(np.abs(self.follow(run) - self.middle)))
                share = max(
                    self.measure_rate(run) / rate, away / self.room, float(np.max(np.abs(run.current))) / limit
                )  # fmt: skip
            except (ControlError, SimulationError):
                share = LOST_SHARE
            kept = size if share <= 1.0 else kept
            if NEAR <= share <= 1.0:
                break
            size *= AIM / max(share, AIM / LOST_SHARE)
        return kept

    def measure(self, error: Float[np.ndarray, " n"]) -> tuple[float, float]:
        """Return how large an error is at the ends of pushes, over their step, and its fast part."""
        ends = np.arange(self.lasting, self.pushes.size + 1, self.lasting)
        windows = np.array([error[end - self.judged : end] for end in ends])
        slow = np.linalg.qr(np.vander(np.linspace(-1.0, 1.0, self.judged), 3))[0]
        fast = windows - windows @ slow @ slow.T
        return 0.5 * float(np.max(np.abs(windows))), 0.5 * float(np.max(np.abs(fast)))

    def respond(self, loop: Loop) -> Float[np.ndarray, " n"]:
        """Return the error of a loop whose variable stands still, under pushes of one."""
        system, error = loop.system(), np.zeros(self.pushes.size)
        x = np.zeros(len(system.a))
        for k, r in enumerate(self.pushes):
            error[k] = system.c[0] @ x + system.d[0, 1] * r - r
            x = system.a @ x + system.b[:, 1] * r
        return error


def move_schedule(
    schedule: ScheduledController, name: str, plant: Plant, params: ParameterSet, rate: float
) -> Motion | None:
    """Push a plant so that it moves its scheduling variable, under the schedule; None of one that holds it.

    Parameters
    ----------
    schedule : ScheduledController
        The law.
    name : str
        The plant's, for the result.
    plant, params
        Of which the variable is a state.
    rate : float
        Of the variable, in its unit per second, that the pushes are to reach.

    Raises
    ------
    ControlError
        The plant cannot rest in the middle of the table.

    """
    if schedule.over not in plant.states:
        return None
    pushing = _make_pushing(schedule, plant, params, rate)
    size = pushing.find_size(rate, FIRST_SHARE * find_least_effort(schedule))
    if size is None:
        return Motion(
            plant=name, rate=0.0, low=pushing.middle, high=pushing.middle, size=0.0, left=math.inf, ringing=math.inf,
            fault="is lost under any push, small ones too",
        )  # fmt: skip
    run = pushing.run(size)
    place, (left, ringing) = pushing.follow(run), pushing.measure((run.force - run.reference) / size)
    loops = [
        one.close(plant, place_variable(plant, params, schedule.over, point))
        for point, one in zip(schedule.points, schedule.controllers, strict=True)
    ]
    still = [(0.0, 0.0), *(pushing.measure(pushing.respond(loop)) for loop in loops if loop.is_stable())]
    most, most_ringing = (max(SETTLED, 2.0 * max(values)) for values in zip(*still, strict=True))
    fault = ""
    if not ringing <= most_ringing:
        fault = f"rings: {100 * ringing:.3g} % of a push at its end, {100 * most_ringing:.3g} % allowed"
    elif not left <= most:
        fault = f"departs: a push is still {100 * left:.3g} % off at its end, {100 * most:.3g} % allowed"
    return Motion(
        plant=name, rate=pushing.measure_rate(run), low=float(np.min(place)), high=float(np.max(place)), size=size,
        left=left, ringing=ringing, fault=fault,
    )  # fmt: skip


def _make_pushing(schedule: ScheduledController, plant: Plant, params: ParameterSet, rate: float) -> _Pushing:
    """Return the pushes that move a plant's variable at a rate."""
    low, high, ts = schedule.points[0], schedule.points[-1], schedule.spec.sample_time_s
    middle, room = 0.5 * (low + high), 0.5 * (high - low)
    period = math.ceil(1.0 / min(schedule.bandwidths_hz) / ts)
    lasting = int(np.clip(round(room / rate / ts), LEAST_PERIODS * period, MOST_PERIODS * period))
    edge = np.hanning(period + 2)
    steps = np.repeat([*(PUSHES * ROUNDS), 0.0, 0.0], lasting)
    return _Pushing(
        schedule=schedule, plant=plant, start=RestStart.at_rest(schedule, plant, params, middle), middle=middle,
        room=room, pushes=np.convolve(steps, edge / np.sum(edge))[: steps.size], lasting=lasting,
        judged=JUDGED_PERIODS * period,
    )  # fmt: skip


def move_plants(
    schedule: ScheduledController, plants: Mapping[str, Plant], params: ParameterSet, rate: float
) -> dict[str, Motion]:
    """Return what is found of each plant that moves the variable."""
    found = {name: move_schedule(schedule, name, plant, params, rate) for name, plant in plants.items()}
    return {name: motion for name, motion in found.items() if motion is not None}


def describe_motion(motion: Motion, over: str, unit: str) -> str:
    """Return what was found where a plant moves the variable, in one line."""
    per, ends = f"{unit_after(unit).strip()}/s", f"{motion.low:.3g} and {motion.high:.3g}"
    head = f"{motion.plant} moves {over} by itself between {ends} at up to {motion.rate:.3g} {per}"
    return f"{head}, pushed to and fro, and {motion.fault or 'neither rings nor departs'}"
