r"""A scheduled law as it runs: one step a sample, with the gains of where the scheduling variable is.

The step is that of `seaopt.control.scheduling.step_order`, with limit and anti-windup: the share
:math:`T_s/(T_t + T_s)` is that of `seaopt.control.laws.realisation` at every point, interpolated too.

A scheduling variable that is not finite, or beyond 1e15, is not used: the last one that was stands, and the value of
`fallback` where there was none since the reset.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import fields, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from seaopt.control.laws.plausibility import is_number
from seaopt.control.laws.realisation import Guarded, LawState, Reading, RunnableLaw, realise
from seaopt.control.scheduling.gain_table import GainTable
from seaopt.control.scheduling.step_order import SHARE
from seaopt.plants.motor.heat_guard import COLD
from seaopt.records import record
from seaopt.units import show_command


@record(eq=False)
class ScheduleState(LawState):
    """The state of a running scheduled law; x is what `seaopt.control.scheduling.step_order` keeps.

    Parameters
    ----------
    place : float
        The scheduling variable that was used last; beyond the ends of the table the ends count.
    misplaced : int
        Samples in a row without a finite scheduling variable.
    """

    place: float = 0.0
    misplaced: int = 0


@record(eq=False)
class RunnableSchedule(Guarded):
    """A table of gains with limit and anti-windup.

    Parameters
    ----------
    table : GainTable
        The gains.
    anti_windup : array, shape (n,)
        The share T_s/(T_t + T_s) at the table's points; zero where nothing integrates.
    fallback : float
        The value that counts until there was a finite one.
    """

    table: GainTable
    anti_windup: Float[np.ndarray, " n"]
    fallback: float

    @property
    def measured(self) -> int:
        """How many signals it reads."""
        return self.table.order.measured

    def __repr__(self) -> str:
        table = self.table
        limit = (
            "no limit"
            if math.isinf(self.command_limit)
            else f"limited to {show_command(self.command_limit, *self.command)}"
        )
        return (
            f"RunnableSchedule of a {table.structure} over {table.over}, {table.points[0]:g} to {table.points[-1]:g} "
            f"{table.unit} in {table.points.size} points, at {1.0 / table.sample_time_s:.6g} Hz, {limit}"
        )

    def reset(
        self,
        reference: float = 0.0,
        measurement: Reading | None = None,
        place: float = math.nan,
        current_A: float = 0.0,
        heat: tuple[float, float] = COLD,
        readings: Sequence[float] = (),
    ) -> ScheduleState:
        """Return the state at rest under constant inputs, with the integral set to continue from a command.

        A law without an integral cannot be set: its next command follows from the inputs. `place` is the scheduling
        variable; `fallback` counts where it is not finite. All else is as of `RunnableLaw.reset`.
        """
        reference, measurement, effort, seen = self.begin(reference, measurement, current_A, readings)
        missing = not is_number(place)
        at = self.fallback if missing else place
        x = self.table.order.continue_from(
            self.table.find_numbers(at), effort, reference, np.ravel(measurement).tolist()
        )
        return ScheduleState(
            x=np.array(list(x.values())), current_A=current_A, gate=seen, heat=heat, place=at, misplaced=int(missing)
        )

    def step(
        self, state: ScheduleState, reference: float, measurement: Reading, place: float, readings: Sequence[float] = ()
    ) -> tuple[float, ScheduleState]:
        """Return the command of this sample, and the next state (`Guarded.guard`)."""
        missing = not is_number(place)
        at = state.place if missing else place
        order, numbers = self.table.order, self.table.find_numbers(at, **{SHARE: self.anti_windup})

        def advance(reference: float, measurement: Reading, added: float, most: float) -> tuple[float, float, Any]:
            x = dict(zip(self.table.states, state.x.tolist(), strict=True))
            signals = np.ravel(measurement).tolist()
            force, applied, after = order.step(
                numbers, x, reference, signals, lambda effort: min(max(effort, -most), most), added
            )
            return force, applied, np.array(list(after.values()))

        misplaced = state.misplaced + 1 if missing else 0
        return self.guard(state, reference, measurement, readings, advance, place=at, misplaced=misplaced)


def make_runnable(
    table: GainTable, *, fallback: float | None = None, limit: float | None = None, **guards: Any
) -> RunnableSchedule:
    """Return a table of gains ready to run. `fallback`: the scheduling variable that counts until there was a finite
    one; the first point if left out. `limit`: of the command, in its unit; None: no limit. All else is as of `realise`,
    the anti-windup at every point. Raises ControlError: a number is out of range.
    """
    # An observer sees the limited command: what winds up is the integral of the law without it.
    each = [
        realise(
            replace(table.find_gains(point), observer=None).law(table.structure, table.sample_time_s).balanced(),
            command_limit=limit,
            **guards,
        )
        for point in table.points.tolist()
    ]
    return RunnableSchedule(
        table=table,
        anti_windup=np.array([_find_share(law) for law in each]),
        fallback=float(table.points[0]) if fallback is None else fallback,
        **{field.name: getattr(each[0], field.name) for field in fields(Guarded)},
    )


def _find_share(law: RunnableLaw) -> float:
    """Return T_s/(T_t + T_s) of a law; zero where nothing integrates."""
    return 0.0 if law.tracking_time_s is None else law.sample_time_s / (law.tracking_time_s + law.sample_time_s)
