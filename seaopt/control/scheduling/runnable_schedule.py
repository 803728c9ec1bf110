r"""A scheduled law as it runs: one step a sample, with the gains of where the scheduling variable is.

.. math::
    u &= k_r r - k_p y + x_I + \tfrac12 k_i T_s (r - y)
         + k_d\,\alpha\,\big(c\,(r - x_r) - (y - x_y)\big), \qquad \alpha = \frac{1}{T_f + T_s}, \\
    x_I^+ &= x_I + k_i T_s (r - y) + K (\mathrm{sat}(u) - u), \qquad
    x_r^+ = x_r + \alpha T_s (r - x_r), \qquad x_y^+ = x_y + \alpha T_s (y - x_y) .

The integral's state is an effort, and those of the derivative's filter are a reference and a measurement: a gain that
changes never makes a jump of what is stored in them. With gains that stand still this is the law of
`seaopt.control.laws.structures` exactly, since :math:`\frac{T_s}{2}\frac{1+q}{1-q} = T_s \frac{q}{1-q} +
\frac{T_s}2` and :math:`D = \alpha (1 - \frac{(1-p) q}{1 - p q})` with :math:`p = T_f/(T_f + T_s)`; c stands outside the
filter, so that its change is not differentiated. K is the anti-windup of `seaopt.control.laws.realisation` at every
point, interpolated too.

A scheduling variable that is not finite, or beyond 1e15, is not used: the last one that was stands, and the value of
`fallback` where there was none since the reset.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from seaopt.control.laws.plausibility import LARGEST, is_number
from seaopt.control.laws.realisation import realise
from seaopt.control.scheduling.gain_table import GainTable
from seaopt.errors import ControlError, require_number
from seaopt.records import record
from seaopt.units import show_command


@record
class ScheduleState:
    """The state of a running scheduled law.

    Parameters
    ----------
    effort : float
        The integral's, in the effort's unit.
    reference, measurement : float
        As the derivative's filter has them.
    place : float
        The scheduling variable that was used last; beyond the ends of the table the ends count.
    command : float
        The last, in its unit.
    held : int
        Samples in a row that were not used because a number in them was not finite.
    misplaced : int
        Samples in a row without a finite scheduling variable.
    """

    effort: float = 0.0
    reference: float = 0.0
    measurement: float = 0.0
    place: float = 0.0
    command: float = 0.0
    held: int = 0
    misplaced: int = 0


@record(eq=False)
class RunnableSchedule:
    """A table of gains with limit and anti-windup.

    Parameters
    ----------
    table : GainTable
        The gains.
    anti_windup : array, shape (n,)
        K at the table's points; zero where nothing integrates.
    fallback : float
        The value that counts until there was a finite one.
    per_effort : float
        The command is this times the effort.
    limit : float
        The command's largest magnitude, in its unit; infinite where there is no limit.
    command : (str, str)
        Name and unit of the input that is commanded.
    """

    table: GainTable
    anti_windup: Float[np.ndarray, " n"]
    fallback: float
    per_effort: float
    limit: float
    command: tuple[str, str] = ("I", "A")

    def __repr__(self) -> str:
        table = self.table
        limit = "no limit" if math.isinf(self.limit) else f"limited to {show_command(self.limit, *self.command)}"
        return (
            f"RunnableSchedule of a {table.structure} over {table.over}, {table.points[0]:g} to {table.points[-1]:g} "
            f"{table.unit} in {table.points.size} points, at {1.0 / table.sample_time_s:.6g} Hz, {limit}"
        )

    def reset(
        self, reference: float = 0.0, measurement: float = 0.0, place: float = math.nan, command: float = 0.0
    ) -> ScheduleState:
        """Return the state at rest under constant inputs, with the integral set to continue from a command.

        Parameters
        ----------
        reference, measurement : float
            In the measured unit.
        place : float
            The scheduling variable; `fallback` counts where it is not finite.
        command : float
            In its unit; a law without an integral cannot be set, and its next command follows from the inputs.

        Raises
        ------
        ControlError
            Reference, measurement or command is not finite or beyond 1e15, or the command is above the limit.
        """
        for name, value in (("reference", reference), ("measurement", measurement), ("command", command)):
            if not is_number(require_number(value, name, ControlError)):
                raise ControlError(f"{name} = {value:g}: give a finite number, within +-{LARGEST:g}")
        if not abs(command) <= self.limit:
            limit = show_command(self.limit, *self.command)
            raise ControlError(f"command = {command:g} is above the limit of {limit}; lower it")
        missing = not is_number(place)
        at_rest = ScheduleState(
            reference=reference,
            measurement=measurement,
            place=self.fallback if missing else place,
            command=command,
            misplaced=int(missing),
        )
        if not self.table.integrates:
            return at_rest
        effort, *_ = self._find_effort(at_rest, reference, measurement, at_rest.place)
        return replace(at_rest, effort=command / self.per_effort - effort)

    def _find_effort(
        self, state: ScheduleState, reference: float, measurement: float, place: float
    ) -> tuple[float, float, float, float]:
        """Return the effort, not limited, what half a sample adds to the integral, alpha, and K."""
        g, ts = self.table.interpolate(place, K=self.anti_windup), self.table.sample_time_s
        alpha = 1.0 / (g["T_f"] + ts)
        half = 0.5 * ts * g["k_i"] * (reference - measurement) if self.table.integrates else 0.0
        rate = g["c"] * (reference - state.reference) - (measurement - state.measurement)
        effort = g["k_r"] * reference - g["k_p"] * measurement + state.effort + half + g["k_d"] * alpha * rate
        return effort, half, alpha, g["K"]

    def step(
        self, state: ScheduleState, reference: float, measurement: float, place: float
    ) -> tuple[float, ScheduleState]:
        """Return the command of this sample, and the next state.

        A sample whose reference or measurement is not finite (or beyond 1e15), or what would follow from them, is not
        used: the last command is held, the state stays, and `held` counts.
        """
        missing = not is_number(place)
        at = state.place if missing else place
        misplaced = state.misplaced + 1 if missing else 0
        with np.errstate(all="ignore"):
            effort, half, alpha, share = self._find_effort(state, reference, measurement, at)
            most = self.limit / self.per_effort
            applied = min(max(effort, -most), most)
            pull, turn = share * (applied - effort), alpha * self.table.sample_time_s
            following = ScheduleState(
                effort=state.effort + 2.0 * half + pull,
                reference=state.reference + turn * (reference - state.reference),
                measurement=state.measurement + turn * (measurement - state.measurement),
                place=at,
                command=min(max(applied * self.per_effort, -self.limit), self.limit),
                misplaced=misplaced,
            )
        if not all((is_number(reference), is_number(measurement), *map(math.isfinite, (effort, following.effort)))):
            return state.command, replace(state, place=at, held=state.held + 1, misplaced=misplaced)
        return following.command, following


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
    each = [
        realise(
            table.law(point),
            per_effort=per_effort,
            command_limit=limit,
            tracking_time_s=tracking_time_s,
            command=command,
        )
        for point in table.points.tolist()
    ]
    return RunnableSchedule(
        table=table,
        anti_windup=np.array([law.anti_windup[0] if law.integrators else 0.0 for law in each]),
        fallback=float(table.points[0]) if fallback is None else fallback,
        per_effort=per_effort,
        limit=each[0].command_limit,
        command=command,
    )
