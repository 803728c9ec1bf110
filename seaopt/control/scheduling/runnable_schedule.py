r"""A scheduled law as it runs: one step a sample, with the gains of where the scheduling variable is.

The step is that of `seaopt.control.scheduling.step_order`, with limit and anti-windup: the share
:math:`T_s/(T_t + T_s)` is that of `seaopt.control.laws.realisation` at every point, interpolated too.

A scheduling variable that is not finite, or beyond 1e15, is not used: the last one that was stands, and the value of
`fallback` where there was none since the reset.

Law and gains of a place are an expression of CasADi (`ScheduleShape`), which runs here in its virtual machine, compiled
in the loops of `seaopt.control.running`. Where the variable stands still the law is linear, and `freeze` returns it so.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from functools import lru_cache
from threading import get_ident
from typing import Any

import casadi as ca
import numpy as np
from jaxtyping import Float

from seaopt.control.laws.plausibility import is_number
from seaopt.control.laws.realisation import Guarded, LawState, Reading, RunnableLaw, realise
from seaopt.control.loops.compensation.terms import Compensation
from seaopt.control.scheduling.gain_table import GainTable
from seaopt.control.scheduling.step_order import SHARE, StepOrder
from seaopt.plants.motor.heat_guard import COLD
from seaopt.records import record
from seaopt.signals import VectorM, VectorN
from seaopt.simulation.direct_call import DirectCall
from seaopt.units import show_command


@record
class ScheduleShape:
    """What a scheduled law's step depends on; all else is numbers: the points, and a row of gains of each."""

    order: StepOrder
    points: int
    columns: tuple[str, ...]
    states: tuple[str, ...]

    @property
    def size(self) -> int:
        """How many numbers it takes."""
        return self.points * (1 + len(self.columns))

    def express_gains(self, numbers: Any, variable: Any) -> dict[str, Any]:
        """Return the gains at a place, as `GainTable.find_numbers` does."""
        count = len(self.columns)
        points, rows = numbers[: self.points], ca.reshape(numbers[self.points :], count, self.points)
        inside = ca.fmin(ca.fmax(variable, points[0]), points[-1])
        first, *further = (
            ca.vertcat(points[i], points[i + 1], rows[:, i], rows[:, i + 1]) for i in range(self.points - 1)
        )
        for stretch in further:
            first = ca.if_else(inside >= stretch[0], stretch, first)
        low, high, below, above = ca.vertsplit(first, [0, 1, 2, 2 + count, 2 + 2 * count])
        gains = below + (inside - low) / (high - low) * (above - below)
        return dict(zip(self.columns, ca.vertsplit(gains), strict=True))

    def express_step(
        self,
        gains: Any,
        x: Any,
        reference: Any,
        measured: Sequence[Any],
        saturate: Callable[[Any], Any],
        added: Any = None,
    ) -> tuple[Any, Any, Any]:
        """Return the effort, what is left of it in its limit, and the next x, with the gains of a place."""
        kept = dict(zip(self.states, ca.vertsplit(x), strict=True))
        effort, applied, after = self.order.step(gains, kept, reference, measured, saturate, added)
        return effort, applied, ca.vertcat(*after.values())


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
    terms : array, shape (n, c), optional
        The numbers of the compensation at the table's points.
    """

    table: GainTable
    anti_windup: VectorN
    fallback: float
    terms: Float[np.ndarray, "n c"] | None = None

    def find_terms(self, value: float) -> list[float] | None:
        """Return the numbers of the compensation at a value of the variable; None without one."""
        if self.terms is None:
            return None
        i, t = self.table.find_stretch(value)
        return (self.terms[i] + t * (self.terms[i + 1] - self.terms[i])).tolist()

    @property
    def measured(self) -> int:
        """How many signals it reads."""
        return self.table.order.measured

    @property
    def shape(self) -> ScheduleShape:
        """What its step depends on."""
        table = self.table
        return ScheduleShape(
            order=table.order,
            points=table.points.size,
            columns=(*table.columns, SHARE, *name_terms(self.terms)),
            states=table.states,
        )

    @property
    def numbers(self) -> VectorM:
        """All else, as its shape takes it."""
        rows = np.array([*self.table.columns.values(), self.anti_windup, *([] if self.terms is None else self.terms.T)])
        return np.concatenate([self.table.points, rows.ravel("F")])

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
        command: float = 0.0,
        heat: tuple[float, float] = COLD,
        readings: Sequence[float] = (),
    ) -> ScheduleState:
        """Return the state at rest under constant inputs, with the integral set to continue from a command.

        A law without an integral cannot be set: its next command follows from the inputs. `place` is the scheduling
        variable; `fallback` counts where it is not finite. All else is as of `RunnableLaw.reset`.
        """
        missing = not is_number(place)
        at = self.fallback if missing else place
        numbers = self.find_terms(at)
        reference, measurement, effort, seen = self.begin(reference, measurement, command, readings, numbers)
        x = self.table.order.continue_from(
            self.table.find_numbers(at), effort, reference, np.ravel(measurement).tolist()
        )
        return ScheduleState(
            x=np.array(list(x.values())), command=command, gate=seen, heat=heat, place=at, misplaced=int(missing)
        )

    def freeze(self, place: float, compensation: Compensation | None = None) -> RunnableLaw:
        """Return the law while the variable stands at a value, with the states that it has here. `compensation`: the
        terms that it has there.
        """
        run, n, y = _compile_step(self, get_ident()), len(self.table.states), self.measured

        def respond(x: Any, reference: float, read: Any, most: float, added: float) -> VectorM:
            effort, _, after = run(place, x, reference, read, most, added)
            return np.concatenate([after[:, 0], effort[0]])

        unit, still, nothing = np.eye(n + 1 + y), np.zeros(n), np.zeros(y)
        columns = np.array([respond(row[:n], row[n], row[n + 1 :], math.inf, 0.0) for row in unit]).T
        wound = respond(still, 0.0, nothing, 0.0, 1.0) - respond(still, 0.0, nothing, math.inf, 1.0)
        kept: dict[str, Any] = {field.name: getattr(self, field.name) for field in fields(Guarded)}
        kept["compensation"] = compensation
        return RunnableLaw(
            **kept,
            a=columns[:n, :n],
            b_reference=columns[:n, n],
            b_measurement=-columns[:n, n + 1] if y == 1 else -columns[:n, n + 1 :],
            c=columns[n, :n],
            d_reference=float(columns[n, n]),
            d_measurement=-float(columns[n, n + 1]) if y == 1 else -columns[n, n + 1 :],
            anti_windup=-wound[:n],
            integrators=0,
            tracking_time_s=None,
        )

    def step(
        self, state: ScheduleState, reference: float, measurement: Reading, place: float, readings: Sequence[float] = ()
    ) -> tuple[float, ScheduleState]:
        """Return the command of this sample, and the next state (`Guarded.guard`)."""
        missing = not is_number(place)
        at = state.place if missing else place
        run = _compile_step(self, get_ident())

        def advance(reference: float, measurement: Reading, added: float, most: float) -> tuple[float, float, Any]:
            effort, applied, x = run(at, state.x, reference, measurement, most, added)
            return float(effort[0, 0]), float(applied[0, 0]), x[:, 0]

        misplaced = state.misplaced + 1 if missing else 0
        terms = self.find_terms(at)
        return self.guard(state, reference, measurement, readings, advance, terms, place=at, misplaced=misplaced)


def name_terms(terms: Float[np.ndarray, "n c"] | None) -> list[str]:
    """Return the names that the numbers of a compensation have among the columns."""
    return [] if terms is None else [f"compensation_{i}" for i in range(terms.shape[1])]


@lru_cache(maxsize=16)
def _compile_step(law: RunnableSchedule, _thread: int) -> DirectCall:
    """Return a law's step of place, x, reference, measured, limit and added effort, which a thread has to itself."""
    shape, y = law.shape, law.measured
    variable, r, most, added = (ca.SX.sym(name) for name in ("place", "r", "most", "added"))
    x, measured = ca.SX.sym("x", len(shape.states)), ca.SX.sym("y", y)
    gains = shape.express_gains(ca.SX(ca.DM(law.numbers)), variable)
    step = shape.express_step(
        gains, x, r, ca.vertsplit(measured), lambda effort: ca.fmin(ca.fmax(effort, -most), most), added
    )
    return DirectCall(ca.Function("step", [variable, x, r, measured, most, added], [ca.densify(part) for part in step]))


def make_runnable(
    table: GainTable,
    *,
    fallback: float | None = None,
    limit: float | None = None,
    compensations: Sequence[Compensation | None] = (),
    **guards: Any,
) -> RunnableSchedule:
    """Return a table of gains ready to run. `fallback`: the scheduling variable that counts until there was a finite
    one; the first point if left out. `limit`: of the command, in its unit; None: no limit. `compensations`: at every
    point, of one shape. All else is as of `realise`, the anti-windup at every point. Raises ControlError: a number is
    out of range.
    """
    terms = [each for each in compensations if each is not None]
    # An observer sees the limited command: what winds up is the integral of the law without it.
    each = [
        realise(
            replace(table.find_gains(point), observer=None, link=None)
            .law(table.structure, table.sample_time_s)
            .balanced(),
            command_limit=limit,
            compensation=terms[0] if terms else None,
            **guards,
        )
        for point in table.points.tolist()
    ]
    return RunnableSchedule(
        table=table,
        anti_windup=np.array([_find_share(law) for law in each]),
        fallback=float(table.points[0]) if fallback is None else fallback,
        terms=np.array([each.numbers for each in terms]) if terms else None,
        **{field.name: getattr(each[0], field.name) for field in fields(Guarded)},
    )


def _find_share(law: RunnableLaw) -> float:
    """Return T_s/(T_t + T_s) of a law; zero where nothing integrates."""
    return 0.0 if law.tracking_time_s is None else law.sample_time_s / (law.tracking_time_s + law.sample_time_s)
