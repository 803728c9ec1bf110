r"""A scheduled law as it runs: one step a sample, with the gains of where the scheduling variable is.

The step is that of `seaopt.control.scheduling.step_order`, with limit and anti-windup: the share
:math:`T_s/(T_t + T_s)` is that of `seaopt.control.laws.realisation` at every point, interpolated too.

A scheduling variable that is not finite, or beyond 1e15, is not used: the last one that was stands, and the value of
`fallback` where there was none since the reset.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from seaopt.control.laws.plausibility import LARGEST, GateState, PlausibilityGate, is_number
from seaopt.control.laws.realisation import Reading, RunnableLaw, realise
from seaopt.control.scheduling.gain_table import GainTable
from seaopt.control.scheduling.step_order import SHARE
from seaopt.errors import ControlError, require_number
from seaopt.plants.motor.heat_guard import COLD, HeatGuard
from seaopt.records import record
from seaopt.units import show_command


@record
class ScheduleState:
    """The state of a running scheduled law.

    Parameters
    ----------
    x : mapping of str to float
        What the law's blocks keep, by the names of `seaopt.control.scheduling.step_order`.
    place : float
        The scheduling variable that was used last; beyond the ends of the table the ends count.
    command : float
        The last, in its unit.
    held : int
        Samples in a row that were not used because a number in them was not finite.
    misplaced : int
        Samples in a row without a finite scheduling variable.
    gate : GateState
        What the plausibility gate, where there is one, has seen.
    heat : (float, float)
        Winding and case above the ambient, K, as the heat guard, where there is one, estimates them.
    """

    x: Mapping[str, float]
    place: float = 0.0
    command: float = 0.0
    held: int = 0
    misplaced: int = 0
    gate: GateState = GateState()
    heat: tuple[float, float] = COLD


@record(eq=False)
class RunnableSchedule:
    """A table of gains with limit and anti-windup.

    Parameters
    ----------
    table : GainTable
        The gains.
    anti_windup : array, shape (n,)
        The share T_s/(T_t + T_s) at the table's points; zero where nothing integrates.
    fallback : float
        The value that counts until there was a finite one.
    per_effort : float
        The command is this times the effort.
    limit : float
        The command's largest magnitude, in its unit; infinite where there is no limit.
    command : (str, str)
        Name and unit of the input that is commanded.
    gate, heat : PlausibilityGate, HeatGuard, optional
        As those of `seaopt.control.laws.realisation.RunnableLaw`.
    """

    table: GainTable
    anti_windup: Float[np.ndarray, " n"]
    fallback: float
    per_effort: float
    limit: float
    command: tuple[str, str] = ("I", "A")
    gate: PlausibilityGate | None = None
    heat: HeatGuard | None = None

    @property
    def measured(self) -> int:
        """How many signals it reads, besides the scheduling variable."""
        return self.table.order.measured

    @property
    def sample_time_s(self) -> float:
        """Of the table."""
        return self.table.sample_time_s

    @property
    def command_limit(self) -> float:
        """The limit, by the name that `RunnableLaw` has for it."""
        return self.limit

    @property
    def force_limit_N(self) -> float:
        """The effort at the limit."""
        return self.limit / self.per_effort

    def __repr__(self) -> str:
        table = self.table
        limit = "no limit" if math.isinf(self.limit) else f"limited to {show_command(self.limit, *self.command)}"
        return (
            f"RunnableSchedule of a {table.structure} over {table.over}, {table.points[0]:g} to {table.points[-1]:g} "
            f"{table.unit} in {table.points.size} points, at {1.0 / table.sample_time_s:.6g} Hz, {limit}"
        )

    def reset(
        self, reference: float = 0.0, measurement: Reading | None = None, place: float = math.nan, command: float = 0.0
    ) -> ScheduleState:
        """Return the state at rest under constant inputs, with the integral set to continue from a command.

        Parameters
        ----------
        reference : float
            In the measured unit.
        measurement : float or array
            What was measured, of several signals one each; zero if left out.
        place : float
            The scheduling variable; `fallback` counts where it is not finite.
        command : float
            In its unit; a law without an integral cannot be set, and its next command follows from the inputs.

        Raises
        ------
        ControlError
            Reference, measurement or command is not finite or beyond 1e15, or the command is above the limit.
        """
        order = self.table.order
        readings = [0.0] * order.measured if measurement is None else np.ravel(measurement).tolist()
        if len(readings) != order.measured:
            raise ControlError(f"measurement has {len(readings)} numbers; give {order.measured}, one per signal")
        for name, value in (("reference", reference), *(("measurement", y) for y in readings), ("command", command)):
            if not is_number(require_number(value, name, ControlError)):
                raise ControlError(f"{name} = {value:g}: give a finite number, within +-{LARGEST:g}")
        if not abs(command) <= self.limit:
            limit = show_command(self.limit, *self.command)
            raise ControlError(f"command = {command:g} is above the limit of {limit}; lower it")
        seen = self.gate.start(readings[0]) if self.gate is not None and measurement is not None else GateState()
        missing = not is_number(place)
        at = self.fallback if missing else place
        x = order.continue_from(self.table.find_numbers(at), command / self.per_effort, reference, readings)
        return ScheduleState(x=x, place=at, command=command, misplaced=int(missing), gate=seen)

    def step(
        self, state: ScheduleState, reference: float, measurement: Reading, place: float
    ) -> tuple[float, ScheduleState]:
        """Return the command of this sample, and the next state.

        A sample whose reference or measurement is not finite (or beyond 1e15), or what would follow from them, is not
        used: the last command is held, the state stays, and `held` counts. Gate and heat guard act as in `RunnableLaw`.
        """
        missing, readings = not is_number(place), np.ravel(measurement).tolist()
        at, misplaced = state.place if missing else place, state.misplaced + 1 if missing else 0
        limit = self.limit if self.heat is None else min(self.limit, self.heat.limit(state.heat))
        following = self._decide(replace(state, place=at, misplaced=misplaced), reference, readings, limit)
        if self.heat is None:
            return following.command, following
        command = min(max(following.command, -limit), limit)  # one that is held or taken to zero, too
        return command, replace(following, command=command, heat=self.heat.warm(state.heat, command))

    def _decide(self, state: ScheduleState, reference: float, readings: list[float], limit: float) -> ScheduleState:
        """Return the next state, its command within a limit."""
        most = limit / self.per_effort
        if self.gate is not None:
            readings[0], seen = self.gate.screen(state.gate, readings[0])
            state = replace(state, gate=seen)
            if seen.fault:
                return replace(state, command=self.gate.ramp(state.command, self.table.sample_time_s))
        with np.errstate(all="ignore"):
            effort, applied, x = self.table.order.step(
                self.table.find_numbers(state.place, **{SHARE: self.anti_windup}),
                state.x,
                reference,
                readings,
                lambda effort: min(max(effort, -most), most),
            )
        if not (all(map(is_number, (reference, *readings))) and all(map(math.isfinite, (effort, *x.values())))):
            return replace(state, held=state.held + 1)
        return replace(state, x=x, command=min(max(applied * self.per_effort, -limit), limit), held=0)


def make_runnable(
    table: GainTable,
    *,
    per_effort: float = 1.0,
    limit: float | None = None,
    fallback: float | None = None,
    tracking_time_s: float | None = None,
    command: tuple[str, str] = ("I", "A"),
) -> RunnableSchedule:
    """Return a table of gains ready to run. `per_effort`: the command for one unit of effort. `limit`: of the command,
    in its unit; None: no limit. `fallback`: the scheduling variable that counts until there was a finite one; the first
    point if left out. `tracking_time_s`: of the anti-windup, at every point; that of `seaopt.control.laws.realisation`
    at each if left out. `command`: name and unit of the input that is commanded. Raises ControlError: a number is out
    of range.
    """
    # An observer sees the limited command: what winds up is the integral of the law without it.
    each = [
        realise(
            replace(table.find_gains(point), observer=None).law(table.structure, table.sample_time_s).balanced(),
            per_effort=per_effort,
            command_limit=limit,
            tracking_time_s=tracking_time_s,
            command=command,
        )
        for point in table.points.tolist()
    ]
    return RunnableSchedule(
        table=table,
        anti_windup=np.array([_find_share(law) for law in each]),
        fallback=float(table.points[0]) if fallback is None else fallback,
        per_effort=per_effort,
        limit=each[0].command_limit,
        command=command,
    )


def _find_share(law: RunnableLaw) -> float:
    """Return T_s/(T_t + T_s) of a law; zero where nothing integrates."""
    return 0.0 if law.tracking_time_s is None else law.sample_time_s / (law.tracking_time_s + law.sample_time_s)
