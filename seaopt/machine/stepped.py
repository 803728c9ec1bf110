"""A law of any kind, stepped over the ticks of a log: its commands, its linear form, and states that it may begin in.

A law and a schedule run as in the compiled loop (`seaopt.control.running.law_step`), predictive control by its own
step. What a state at the first row adds to the commands is taken from the linear form: that of a schedule is the law
where its variable stands, of predictive control the law while no limit is active.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float

from seaopt.control import (
    Controller,
    ForceMPC,
    LawState,
    MPCState,
    RunnableLaw,
    RunnableSchedule,
    ScheduledController,
    force_mpc,
    runnable,
)
from seaopt.control.running.law_step import run_law
from seaopt.errors import SeaoptError
from seaopt.machine.ticks import Ticks
from seaopt.records import record
from seaopt.robustness import linear_controller

SETTLED = 400  # rows over which the estimate of predictive control follows the log
Source = Controller | ScheduledController | ForceMPC
State = LawState | MPCState


@record(eq=False)
class Setting:
    """A law and a log, as they are or as a cause has them."""

    controller: Controller  # the linear form, with what it was designed for
    law: RunnableLaw | RunnableSchedule | ForceMPC
    ticks: Ticks

    @property
    def linear(self) -> RunnableLaw:
        """The law while no limit is active and a schedule's variable stands where it is in the middle of the log."""
        law = self.law
        if isinstance(law, ForceMPC):
            return runnable(self.controller)
        if isinstance(law, RunnableSchedule):
            middle = self.ticks.middle
            return law.freeze(law.fallback if middle is None else middle, self.controller.compensation)
        return law


def stand(source: Source, place: float | None) -> Controller:
    """Return the controller that something is in its linear form; of a schedule where its variable is at a place."""
    if isinstance(source, ScheduledController):
        low, high = source.points[0], source.points[-1]
        return source.at(min(max(source.fallback if place is None else place, low), high))
    if isinstance(source, ForceMPC):
        linear = linear_controller(source)
        return replace(linear, spec=replace(linear.spec, command_limit=source.command_limit))
    return source


def make_setting(source: Source, ticks: Ticks) -> Setting:
    """Return a law on a log."""
    law: Any = source
    if not isinstance(source, ForceMPC):
        law = source.runnable() if isinstance(source, ScheduledController) else runnable(source)
    return Setting(controller=stand(source, ticks.middle), law=law, ticks=ticks)


def run_setting(setting: Setting, ticks: Ticks, start: State) -> Float[np.ndarray, " n"]:
    """Return the commands of a setting's law on some ticks."""
    law = setting.law
    if isinstance(law, ForceMPC):
        assert isinstance(start, MPCState)
        return _run_plan(law, ticks, start)[0]
    assert isinstance(start, LawState)
    places = ticks.place if isinstance(law, RunnableSchedule) else None
    return run_law(law, ticks.reference, ticks.measured, ticks.further, places, start)


def _run_plan(
    law: ForceMPC, ticks: Ticks, state: MPCState, *, follow: bool = False
) -> tuple[Float[np.ndarray, " n"], MPCState]:
    """Return the commands of predictive control, and its last state; `follow`: as if each command were the log's."""
    out, ahead = np.empty(len(ticks)), law.spec.preview_samples + 1
    for k in range(len(ticks)):
        before = state.kalman
        result = law.step(state, ticks.reference[k : k + ahead], float(ticks.measured[k, 0]))
        out[k], state = result.current_A, result.state
        if follow:
            line = np.vstack([before.past, np.zeros(before.past.shape[1])])
            line[-1, 0] = ticks.command[k]
            kalman = law.kalman.go_on(line, state.kalman.corrected, state.kalman.innovation)
            state = replace(state, current_A=float(ticks.command[k]), kalman=kalman)
    return out, state


def list_starts(setting: Setting) -> Iterator[tuple[State, int]]:
    """Yield states in which a law may begin, at zero and at rest under the first row, and from which row on."""
    law, ticks = setting.law, setting.ticks
    if isinstance(law, ForceMPC):
        yield law.start, 0
        if len(ticks) > 2 * SETTLED:
            state = _run_plan(law, ticks.take(slice(0, SETTLED)), law.start, follow=True)[1]
            yield _refine_start(law, ticks.take(slice(SETTLED, 2 * SETTLED)), state), SETTLED
        return
    yield law.reset(), 0
    first = ticks.measured[0]
    measured: Any = float(first[0]) if law.measured == 1 else first
    command = float(np.clip(ticks.command[0], -law.command_limit, law.command_limit))
    placed: dict[str, Any] = (
        {} if isinstance(law, RunnableLaw) else {"place": math.nan if ticks.place is None else ticks.place[0]}
    )
    try:
        yield (
            law.reset(
                float(ticks.reference[0]), measured, current_A=command, readings=ticks.further[0].tolist(), **placed
            ),
            0,
        )
    except SeaoptError:  # a reading outside the gate's range
        return


def _refine_start(law: ForceMPC, ticks: Ticks, state: MPCState) -> MPCState:
    """Return a state whose estimate is the one from which the next commands follow best, with no limit active."""
    linear, n = law.unlimited(), len(law.kalman.A)
    modes, moved = np.empty((len(ticks), n)), np.eye(linear.c.size)[:, :n]
    for k in range(len(ticks)):
        modes[k], moved = linear.c @ moved, linear.a @ moved
    left = ticks.command - _run_plan(law, ticks, state)[0]
    predicted = state.kalman.predicted + np.linalg.lstsq(modes, left, rcond=1e-10)[0]
    return replace(state, kalman=replace(state.kalman, predicted=predicted))


def limit_law(law: RunnableLaw | RunnableSchedule | ForceMPC, limit: float) -> Any:
    """Return a law with another limit of its command."""
    if not isinstance(law, ForceMPC):
        return replace(law, command_limit=limit)
    plant, values = law.design
    spec = replace(law.spec, **{"current_limit_A" if law.spec.current_limit_A is not None else "command_limit": limit})
    return force_mpc(plant, values, spec, gate=law.gate, heat=law.heat)
