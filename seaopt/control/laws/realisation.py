r"""The law as it runs: one step a sample, with the command's limit and anti-windup.

.. math::
    u &= C x + D_r r - D_y y, \qquad x^+ = A x + B_r r - B_y y + K (\mathrm{sat}(u) - u)

K does nothing until the command saturates. While it does, the state moves with :math:`A - K C`: K is chosen so that
the poles of the m integrators go from 1 to :math:`\lambda = T_t/(T_t + T_s)`, and the others stay:
:math:`K_j = \binom{m}{j} (1-\lambda)^j` on the chain and zero elsewhere. For one integrator that is back-calculation
with the tracking time constant T_t (Astrom, Hagglund, PID Controllers, 2nd ed., ISA 1995, integrator windup). Theirs
is T_i for a PI, and :math:`\sqrt{T_i T_d}` with a derivative. The feedforward of these laws makes another one right.
At rest at the limit, with a reference that is out of reach by e,
:math:`u - \mathrm{sat}(u) = k_r e + x_I - x_I^*` and :math:`\dot x_I = k_i e - (u - \mathrm{sat}(u))/T_t`, with
:math:`x_I^* = (1/P(0) + k_p - k_r) F` the integral that the force in reach needs (zero where k_r is not weighted), so
that the integrator rests there, and the law returns from saturation as if it had been given the reference that is in
reach (Hanus, Kinnaert, Henrotte, Automatica 23(6), 1987), for

.. math:: T_t = \frac{k_r}{k_i}, \qquad \text{in general } T_s \frac{a_1}{a_0} \text{ of }
          C_r = a_0 \delta^{-m} + a_1 \delta^{1-m} + \dots

the default (a sample at least), which is T_i where there is no feedforward.

A disturbance observer, :math:`u = v + Q (\mathrm{sat}(u) - P_n^{-1} y)`, has to see the saturated command, not its
own. Here it does: unsaturated, :math:`u = (v - Q P_n^{-1} y)/(1 - Q)` integrates, since Q = 1 at 0 Hz, and the
saturated law differs from it by sat(u) - u at the input of Q, which is a K. For :math:`Q = (1-\lambda)/(z - \lambda)`
that K is :math:`1 - \lambda`: this module's, with T_t the time constant of Q, and since
:math:`1/(1-Q) = (1 - \lambda q)/(1-q)`, that is the default too. For Q of higher order K moves the integrator alone;
the other poles of 1/(1 - Q), about as fast as Q, stay.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from types import NoneType
from typing import Any, Literal, TypeVar

import numpy as np
from jaxtyping import Float

from seaopt.control.laws.command import Command
from seaopt.control.laws.controller import Controller
from seaopt.control.laws.plausibility import LARGEST, GateState, PlausibilityGate, is_number, list_further
from seaopt.control.laws.spec import ControllerSpec
from seaopt.control.laws.structures import Gains
from seaopt.control.loops.compensation.terms import FORGOTTEN, Compensation, Memory
from seaopt.control.loops.law import SLOW_LAG, Law
from seaopt.control.loops.outer_loop import FIRST, OuterLoop, OuterState, follow_link
from seaopt.errors import ControlError, require_number, require_type
from seaopt.formatting import join_words
from seaopt.plants.motor.heat_guard import COLD, HeatGuard
from seaopt.records import record
from seaopt.units import name_command, show_command

Vector = Float[np.ndarray, " n"]
State = TypeVar("State", bound="LawState")
Advance = Callable[[float, Any, float, float], tuple[float, float, Any]]
Reading = float | Float[np.ndarray, " y"]  # of the measured signal, or of several, the regulated one first


@record(eq=False)
class LawState:
    """The state of a running law.

    Parameters
    ----------
    x : array, shape (n,)
        State.
    command : float
        The last command, in its unit.
    held : int
        Samples in a row that were not used because a number in them was not finite, or beyond 1e15.
    gate : GateState
        What the plausibility gate, where there is one, has seen.
    heat : (float, float)
        Winding and case above the ambient, K, as the heat guard, where there is one, estimates them.
    memory : (float, float)
        What the compensation, where there is one, keeps of the last sample.
    outer : (float, float, float)
        What the outer loop, where there is one, keeps.
    """

    x: Vector
    command: float = 0.0
    held: int = 0
    gate: GateState = GateState()
    heat: tuple[float, float] = COLD
    memory: Memory = FORGOTTEN
    outer: OuterState = FIRST

    @property
    def status(self) -> str:
        """Tell "ok", "held" (a reading was not used) or "fault" (the command goes to zero until the law is reset)."""
        return "held" if self.held and not self.gate.fault else self.gate.status


@record(eq=False)
class Guarded:
    """A law as it runs, but for the law itself: its limit, and what stands around it."""

    sample_time_s: float
    per_effort: float  # the command is this times the effort: A/N or A/(N m) of a current
    command_limit: float  # the command's largest magnitude, in its unit; infinite where there is no limit
    gate: PlausibilityGate | None = None  # which readings are believed
    command: tuple[str, str] = ("I", "A")  # name and unit of the input that is commanded
    heat: HeatGuard | None = None  # what lowers the limit as the winding warms up
    compensation: Compensation | None = None  # what is added to reference and effort; it may read further outputs
    # what makes the law's reference of an x_0, then the reference of every method, and of the link's position; one
    # without a stiffness adds damping to the reference, which stays a force
    outer: OuterLoop | None = None

    @property
    def measured(self) -> int:
        """How many signals it reads."""
        raise NotImplementedError

    @property
    def further(self) -> tuple[str, ...]:
        """The outputs that its terms read besides, then those that its gate and its outer loop do."""
        return list_further(self.compensation, self.gate, self.outer)

    @property
    def force_limit_N(self) -> float:
        """The motor force at the limit."""
        return self.command_limit / self.per_effort

    def begin(
        self,
        reference: float,
        measurement: Reading | None,
        command: float,
        readings: Sequence[float],
        numbers: Sequence[float] | None = None,
    ) -> tuple[float, Reading, float, GateState]:
        """Return reference and measurement at rest, the effort that is to be the law's, and what the gate has seen.
        Raises ControlError: an input is not finite or beyond 1e15, the measurement is outside the gate's range, or the
        current is above the limit.
        """
        for name, value in (("reference", reference), ("command", command)):
            require_number(value, name, ControlError)
        is_stated, measurement = measurement is not None, self._check_measurement(measurement)
        seen = self.gate.start(float(np.ravel(measurement)[0])) if self.gate is not None and is_stated else GateState()
        if not all(map(is_number, (reference, command, *np.ravel(measurement), *readings))):
            raise ControlError(
                f"reference = {reference:g}, measurement = {measurement}, command = {command:g}, readings = "
                f"{list(readings)}: give finite numbers, within +-{LARGEST:g}"
            )
        if not abs(command) <= self.command_limit:
            limit = show_command(self.command_limit, *self.command)
            raise ControlError(f"command = {command:g} is above the limit of {limit}; lower it")
        added = 0.0
        if self.outer is not None:
            (position,) = self._take(readings, self.outer.position) if readings else (0.0,)
            x_0, force = self.outer.split(reference)
            reference = force + follow_link(self.outer.numbers, FIRST, x_0, position)[-1]
        if self.compensation is not None:
            reads = self._take_terms(readings) or (0.0,) * len(self.compensation.reads)
            reference, added, _ = self.compensation.step(FORGOTTEN, reference, reads, numbers)
        return reference, measurement, command / self.per_effort - added, seen

    def _take_terms(self, readings: Sequence[float]) -> tuple[float, ...]:
        """Return the readings of the terms, of all."""
        if self.outer is None and (self.gate is None or not self.gate.reads):
            return tuple(readings)
        return tuple(readings[: 0 if self.compensation is None else len(self.compensation.reads)])

    def _take(self, readings: Sequence[float], *reads: str) -> list[float]:
        """Return the readings of some of the further outputs, of all. Raises ControlError: they are not as many."""
        names = self.further
        if len(readings) != len(names):
            raise ControlError(
                f"readings: the law reads {join_words(names)} besides, and got {len(readings)}; give one of each"
            )
        return [readings[names.index(name)] for name in reads]

    def _check_measurement(self, measurement: Reading | None) -> Reading:
        """Return what was measured at rest: zero where it is left out, else as many numbers as there are signals."""
        if self.measured == 1:
            measurement = measurement.item() if isinstance(measurement, np.ndarray) else measurement
            return 0.0 if measurement is None else require_number(measurement, "measurement", ControlError)
        values = np.zeros(self.measured) if measurement is None else np.asarray(measurement, dtype=float)
        if values.shape != (self.measured,):
            raise ControlError(
                f"measurement has the shape {values.shape}; give {self.measured} numbers, one per signal"
            )
        return values

    def guard(
        self,
        state: State,
        reference: float,
        measurement: Reading,
        readings: Sequence[float],
        advance: Advance,
        numbers: Sequence[float] | None = None,
        **noted: Any,
    ) -> tuple[float, State]:
        """Return the command of this sample, and the next state.

        A sample with a number that is not finite (or beyond 1e15), in its inputs or in what would follow, is not used:
        the last command is held, the state stays, and `held` counts. A gate bridges a reading that cannot be true, and
        takes the command to zero at a fault. A heat guard lowers the limit of each command, and counts what it heats.
        `readings` are of the outputs `further`, in their order. `advance` is the law: of reference,
        measurement, what is added to the effort, and its limit, the effort, what is left of it, and the next x.
        `numbers` of the compensation, where they are not its own; `noted`: further fields of the next state.
        An outer loop comes first, and goes on with its last reference where what it is given is not a number.
        """
        if self.outer is not None:
            (position,), outer = self._take(readings, self.outer.position), state.outer
            x_0, force = self.outer.split(reference)
            if is_number(x_0) and is_number(position):
                outer = follow_link(self.outer.numbers, outer, x_0, position)
            noted["outer"], reference = outer, force + outer[-1]
        if self.heat is None:
            return self._decide(state, reference, measurement, readings, self.command_limit, advance, numbers, noted)
        limit = min(self.command_limit, self.heat.limit(state.heat))
        current, following = self._decide(state, reference, measurement, readings, limit, advance, numbers, noted)
        current = min(max(current, -limit), limit)  # one that is held or taken to zero, too
        return current, replace(following, command=current, heat=self.heat.warm(state.heat, current))

    def _decide(
        self,
        state: State,
        reference: float,
        measurement: Reading,
        readings: Sequence[float],
        limit: float,
        advance: Advance,
        numbers: Sequence[float] | None,
        noted: Mapping[str, Any],
    ) -> tuple[float, State]:
        """Return the command within a limit, and the next state."""
        seen = state.gate
        if self.gate is not None:
            encoders = self._take(readings, *self.gate.reads) if self.gate.reads else ()
            regulated, seen = self.gate.screen(seen, float(np.ravel(measurement)[0]), encoders)
            measurement = regulated if self.measured == 1 else np.array([regulated, *np.ravel(measurement)[1:]])
            if seen.fault:
                current = self.gate.ramp(state.command, self.sample_time_s)
                return current, replace(state, command=current, gate=seen, **noted)
        readings = self._take_terms(readings)
        taken = all(map(is_number, (reference, *np.ravel(measurement), *readings)))
        added, memory = 0.0, state.memory
        with np.errstate(all="ignore"):
            if self.compensation is not None:
                reference, added, memory = self.compensation.step(state.memory, reference, readings, numbers)
            force, applied, x = advance(reference, measurement, added, limit / self.per_effort)
        if not (taken and math.isfinite(force) and np.isfinite(x).all()):
            return state.command, replace(state, held=state.held + 1, gate=seen, **noted)
        current = applied * self.per_effort
        current = min(max(current, -limit), limit)  # a limit to the last bit
        return current, replace(state, x=x, command=current, held=0, gate=seen, memory=memory, **noted)


@record(eq=False)
class RunnableLaw(Guarded):
    """F = c x + d_reference r - d_measurement y, x+ = a x + b_reference r - b_measurement y + anti_windup (sat(F) - F).

    Parameters
    ----------
    a, b_reference, b_measurement, c, d_reference, d_measurement
        Matrices, shapes (n, n), (n,), (n,), (n,) and numbers; the first `integrators` states are the integrators. Of
        several measured signals b_measurement and d_measurement have a column for each, (n, y) and (y,), and every
        measurement below is an array of them.
    anti_windup : array, shape (n,)
        K of the module's docstring.
    integrators : int
        How many poles at z = 1.
    tracking_time_s : float or None
        T_t; None where nothing integrates.
    """

    a: Float[np.ndarray, "n n"]
    b_reference: Vector
    b_measurement: Float[np.ndarray, "n ..."]
    c: Vector
    d_reference: float
    d_measurement: float | Float[np.ndarray, " y"]
    anti_windup: Vector
    integrators: int
    tracking_time_s: float | None

    @property
    def measured(self) -> int:
        """How many signals it reads."""
        return int(np.size(self.d_measurement))

    def __repr__(self) -> str:
        tracking = "" if self.tracking_time_s is None else f", tracking time {self.tracking_time_s:.4g} s"
        limit = f"limited to {show_command(self.command_limit, *self.command)}"
        if math.isinf(self.command_limit):
            limit = f"no limit of the {name_command(*self.command)}"
        return (
            f"RunnableLaw of order {self.c.size} ({self.integrators} of it integrators{tracking}) at "
            f"{1 / self.sample_time_s:.6g} Hz, {limit}"
        )

    def find_rest(self) -> tuple[Vector, Float[np.ndarray, "n ..."]]:
        """Return x per reference and per measurement (counted negative) at rest, integrators zero."""
        m, n = self.integrators, self.c.size
        out = np.zeros((n, 1 + self.measured))
        inner = np.eye(n - m) - self.a[m:, m:]
        out[m:] = np.linalg.solve(inner, np.column_stack([self.b_reference[m:], self.b_measurement[m:]]))
        return out[:, 0], out[:, 1:].reshape(self.b_measurement.shape)

    def reset(
        self,
        reference: float = 0.0,
        measurement: Reading | None = None,
        command: float = 0.0,
        heat: tuple[float, float] = COLD,
        readings: Sequence[float] = (),
    ) -> LawState:
        """Return the state at rest under constant inputs, with the integrator set to continue from a current.

        A law without an integrator cannot be set: its next command follows from the inputs alone. A measurement that is
        left out is zero, and a gate judges the first reading by its range; one that is given, by its jump from it.
        `heat` is what is known of winding and case above the ambient (K); cold if left out. `readings` are of
        `further`; zero if left out. Raises ControlError: an input is not finite or beyond 1e15, the measurement is
        outside the gate's range, or the current is above the limit.
        """
        reference, measurement, effort, seen = self.begin(reference, measurement, command, readings)
        per_reference, per_measurement = self.find_rest()
        x = per_reference * reference - np.dot(per_measurement, measurement)
        if self.integrators:
            x[0] = effort - self._find_force(x, reference, measurement)
        return LawState(x=x, command=command, gate=seen, heat=heat)

    def _find_force(self, x: Vector, reference: float, measurement: Reading) -> float:
        """Return the effort, not limited."""
        return float(self.c @ x) + self.d_reference * reference - float(np.dot(self.d_measurement, measurement))

    def step(
        self, state: LawState, reference: float, measurement: Reading, readings: Sequence[float] = ()
    ) -> tuple[float, LawState]:
        """Return the command (a current in A, as a rule) of this sample, and the next state (`Guarded.guard`)."""

        def advance(reference: float, measurement: Reading, added: float, most: float) -> tuple[float, float, Vector]:
            force = self._find_force(state.x, reference, measurement) + added
            applied = min(max(force, -most), most)
            x = self.a @ state.x + self.b_reference * reference - np.dot(self.b_measurement, measurement)
            return force, applied, x + self.anti_windup * (applied - force)

        return self.guard(state, reference, measurement, readings, advance)

    def run(
        self,
        references: Float[np.ndarray, " samples"],
        measurements: Float[np.ndarray, "samples ..."],
        state: LawState | None = None,
        readings: Float[np.ndarray, "samples r"] | None = None,
    ) -> tuple[Float[np.ndarray, " samples"], LawState]:
        """Return the commands of a sequence of samples, and the last state; it starts from zero if not given."""
        state = self.reset() if state is None else state
        out = np.zeros(references.size)
        further = np.zeros((references.size, 0)) if readings is None else readings
        for i, (reference, measurement, more) in enumerate(zip(references, measurements, further, strict=True)):
            read = float(measurement) if self.measured == 1 else measurement
            out[i], state = self.step(state, float(reference), read, more.tolist())
        return out, state


def runnable(
    controller: Controller,
    *,
    command_limit: float | None = None,
    tracking_time_s: float | None = None,
    gate: PlausibilityGate | Literal[False] | None = None,
    heat: HeatGuard | Literal[False] | None = None,
    outer: bool = False,
) -> RunnableLaw:
    """Return a controller's law ready to run, as it is exported.

    Parameters
    ----------
    controller : Controller
        As tuned or read.
    command_limit : float, optional
        Of the command, in its unit: the specification's if left out, and no more than the range of the command;
        infinite where none of them is given.
    tracking_time_s : float, optional
        T_t of the anti-windup; the module's docstring has the default. Not of a schedule's law, frozen, which has its
        share.
    gate : PlausibilityGate or False, optional
        Which readings are believed; the controller's own if left out, none with False.
    heat : HeatGuard or False, optional
        What lowers the limit as the winding warms up; `controller.heat_guard` if left out and the controller derates.
    outer : bool
        With the controller's outer loop, where it has one: the reference then is x_0, or without a stiffness a force.

    Raises
    ------
    ControlError
        As `realise`.

    Examples
    --------
    >>> import seaopt as so
    >>> spec = so.ControllerSpec(bandwidth_hz=30, max_sensitivity=1.6, current_limit_A=9.0)
    >>> law = runnable(so.tune(so.plants.high_impedance(), so.plants.thor(), spec))
    >>> current, state = law.step(law.reset(), reference=5000.0, measurement=0.0)
    >>> round(current, 6)
    9.0
    """
    law = realise(
        **_wind_up(controller, tracking_time_s),
        per_effort=controller.command.per_effort,
        command_limit=choose_limit(controller.command, controller.spec, command_limit),
        command=(controller.command.input, controller.command.unit),
        gate=controller.gate if gate is None else gate or None,
        heat=(controller.heat_guard if controller.derate else None) if heat is None else heat or None,
        compensation=controller.compensation,
    )
    return replace(law, outer=controller.outer) if outer else law


def _wind_up(controller: Controller, tracking_time_s: float | None) -> dict[str, Any]:
    """Return what `realise` takes of a controller's law and anti-windup: of a schedule's law, frozen, as the schedule
    winds up there. Raises ControlError: a tracking time is given beside its share.
    """
    law, share = controller.law, controller.share
    if share is None:
        return {"law": law, "tracking_time_s": tracking_time_s}
    if tracking_time_s is not None:
        raise ControlError(
            f"tracking_time_s = {tracking_time_s:g}: the law is a schedule's, frozen, and winds up as that does; leave "
            "it out"
        )
    excess = controller.observer is not None
    if excess:
        gains = Gains.from_names(controller.gains, controller.observer, link=controller.link)
        law = gains.law(controller.spec.structure, law.sample_time_s, share).balanced()
    tracking_time_s = law.sample_time_s * (1.0 / share - 1.0) if share else None
    return {"law": law, "tracking_time_s": tracking_time_s, "excess": excess}


def choose_limit(command: Command, spec: ControllerSpec, requested: float | None) -> float | None:
    """Return the limit of a running law: the one asked for, infinite for none at all, else the controller's own."""
    if requested is not None and not 0.0 < require_number(requested, "command_limit", ControlError) < math.inf:
        return requested  # none at all, or for `realise` to refuse
    return command.limit(spec.limit_asked if requested is None else requested)


def find_raised_limit(command: Command, spec: ControllerSpec, requested: float | None) -> str:
    """Return the limit that a controller was designed and certified with, where a higher one is asked for; else ""."""
    designed, running = (choose_limit(command, spec, limit) for limit in (None, requested))
    return command.show(designed) if designed is not None and running is not None and running > designed else ""


def check_guards(gate: object, heat: object, command: tuple[str, str]) -> None:
    """Refuse guards that a law with such a command, by name and unit, cannot have (ControlError)."""
    require_type(gate, (PlausibilityGate, NoneType), "gate", "give a PlausibilityGate", ControlError)
    require_type(heat, (HeatGuard, NoneType), "heat", "give a HeatGuard", ControlError)
    if heat is not None and command[1] != "A":
        raise ControlError(
            f"heat: a guard limits a current, and {command[0]} [{command[1]}] is commanded; leave it out"
        )


def realise(
    law: Law,
    *,
    per_effort: float = 1.0,
    command_limit: float | None = None,
    tracking_time_s: float | None = None,
    gate: PlausibilityGate | None = None,
    command: tuple[str, str] = ("I", "A"),
    heat: HeatGuard | None = None,
    compensation: Compensation | None = None,
    excess: bool = False,
) -> RunnableLaw:
    """Return a law with limit and anti-windup.

    Parameters
    ----------
    law : Law
        From (reference, measured) to effort; of two transfer functions: `Law.from_transfer_functions`.
    per_effort : float
        The command for one unit of effort: A/N or A/(N m).
    command_limit : float, optional
        Of the command, in its unit; None: no limit.
    tracking_time_s : float, optional
        T_t; the module's docstring has the default.
    gate : PlausibilityGate, optional
        Which readings are believed.
    command : (str, str)
        Name and unit of the input that is commanded.
    heat : HeatGuard, optional
        What lowers the limit as the winding warms up, of a command in A.
    compensation : Compensation, optional
        What is added to reference and effort.
    excess : bool
        The law's last input is the limited effort less the unlimited, and its column K.

    Raises
    ------
    ControlError
        A number is out of range, or the law by itself is unstable other than by integrators.
    """
    check_guards(gate, heat, command)
    for name, value in (
        ("sample_time_s", law.sample_time_s),
        ("per_effort", per_effort),
        ("command_limit", command_limit),
        ("tracking_time_s", tracking_time_s),
    ):
        if value is not None and not require_number(value, name, ControlError) > 0.0:
            raise ControlError(f"{name} = {value:g} is not positive; give a positive number")
    poles = law.poles[law.integrators :]
    radius = float(np.max(np.abs(poles), initial=0.0))
    if radius >= 1.0:
        near = float(np.min(np.abs(poles - 1.0)))
        hidden = f"its pole {near:.2g} from 1 is not told from a slow lag; give the law as gains, or fewer slow poles"
        meant = hidden if near < SLOW_LAG else "tune a stable one"
        raise ControlError(f"the law has a pole at |z| = {radius:.9g} besides its integrators; {meant}")
    m, taken = law.integrators, law.b[:, -1]
    law = replace(law, b=law.b[:, :-1], d=law.d[:-1]) if excess else law
    tracking = _compute_tracking_time(law) if tracking_time_s is None and m else tracking_time_s
    share = law.sample_time_s / (tracking + law.sample_time_s) if tracking is not None else 0.0
    chain = [math.comb(m, j) * share**j for j in range(1, m + 1)]
    measured = 1 if law.d.size == 2 else slice(1, None)
    return RunnableLaw(
        a=law.a,
        b_reference=law.b[:, 0].copy(),
        b_measurement=-law.b[:, measured],
        c=law.c,
        d_reference=float(law.d[0]),
        d_measurement=-law.d[measured],
        anti_windup=taken if excess else np.array(chain + [0.0] * (law.c.size - m)),
        integrators=m,
        tracking_time_s=tracking if m else None,
        sample_time_s=law.sample_time_s,
        per_effort=per_effort,
        command_limit=math.inf if command_limit is None else command_limit,
        gate=gate,
        command=command,
        heat=heat,
        compensation=compensation,
    )


def _compute_tracking_time(law: Law) -> float:
    """Return T_s abs(a_1/a_0) of C_r, of C_y where the reference is not integrated; a sample at least."""
    m = law.integrators
    column = 0 if law.b[m - 1, 0] else 1
    # The coefficient of w^(m-1), w = 1/(z - 1): the next one of the chain, or what is left at 0 Hz.
    following = law.b[m - 2, column] if m > 1 else law.static_remainder[column]
    ratio = abs(float(following) / float(law.b[m - 1, column]) - m)
    return law.sample_time_s * min(max(ratio, 1.0), 1e300)  # next to no integral it would be infinite
