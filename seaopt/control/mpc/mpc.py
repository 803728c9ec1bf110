r"""Constrained force control: a quadratic program a sample, within the motor's current and current slew.

Each sample a Kalman filter (see `estimator`) corrects plant and disturbance with the measured force; the state is
predicted over the delay with the currents that are on their way; the targets that hold the reference against the
disturbance,

.. math:: u_s = \operatorname{clip}(F_\mathrm{ref}/g - \hat d,\ \pm I_\mathrm{max}), \qquad
          x_s = (I - A)^{-1} b\,(u_s + \hat d),

make the force free of offset wherever a current within limits can (Pannocchia and Rawlings, AIChE J. 49, 2003); and
the program of `prediction`, which always has a solution, is solved exactly, from what the last one held (`active_set`).

While no limit is active the controller is a linear law (`ForceMPC.law`), whose loop is judged by the table of limits as
a tuned controller's is: on the sliding design plant, which it is designed for, and on the stuck one where there is
friction. The drift carries what friction has above its flattest slope.

What the solver returns is not trusted: its status is checked, its currents are held against the limits, and the one
that is used is clipped to them. If it fails, the current goes towards :math:`u_s` as fast as the slew limit lets it,
and the step says so.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import field, replace
from itertools import pairwise
from typing import Any

import numpy as np
from jaxtyping import Float

from seaopt.control.laws.command import Command, command_of, limit_notes
from seaopt.control.laws.delay import settle_delays, warn_delays
from seaopt.control.laws.friction import find_friction_margin
from seaopt.control.laws.limits import MeasuredLoop
from seaopt.control.laws.plausibility import PlausibilityGate, is_number
from seaopt.control.laws.realisation import check_guards
from seaopt.control.laws.verdict import (
    BindingLimit,
    LimitVerdict,
    explain_broken,
    judge_all,
    list_broken,
    shorten_blocked,
)
from seaopt.control.loops.absolute_stability import FrictionMargin
from seaopt.control.loops.compensation.link_feedforward import LinkPath
from seaopt.control.loops.compensation.terms import Compensation
from seaopt.control.loops.law import Law
from seaopt.control.loops.loop import Loop, LoopFigures
from seaopt.control.loops.outer_loop import OuterLoop
from seaopt.control.loops.sampled_plant import DELAYS, find_delay, find_rows, read_conditions, sample
from seaopt.control.mpc.active_set import SOLVED, UNFINISHED
from seaopt.control.mpc.estimator import Estimator, EstimatorState, estimator
from seaopt.control.mpc.force_plant import ForcePlant, find_static_gain, interpolate_knots, limit_command, spread_knots
from seaopt.control.mpc.noise import NoiseModel
from seaopt.control.mpc.output_bounds import SLACK_UNIT, bound_outputs
from seaopt.control.mpc.prediction import HorizonProgram, Regulator, condense, find_plan_bandwidth, tune_regulator
from seaopt.control.mpc.quadratic_program import (
    PENALTY,
    WIDE,
    QPSolution,
    QuadraticProgram,
    factor_program,
    stack_hessian,
)
from seaopt.control.mpc.spec import MPCSpec
from seaopt.control.mpc.step import MPCState, MPCStep, ReadsLink, add_terms, read_references, shape_references
from seaopt.control.tuning.possible_bandwidths import find_end, list_steps
from seaopt.errors import ControlError, require_type
from seaopt.estimation import Fit
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant, state_space
from seaopt.plants.friction import split_friction, take_sliding
from seaopt.plants.memo import memo
from seaopt.plants.motor.heat_guard import HeatGuard
from seaopt.plants.motor.thermal import freeze_heat, rate_motor
from seaopt.plants.plant import name_input, require_plant
from seaopt.records import Result, Worded, record

References = Float[np.ndarray, " r"]
State = Float[np.ndarray, " n"]  # z of the filter
PerRow = Float[np.ndarray, " m"]  # of the program
VIOLATION = 1e-2  # of the limits; a solution further outside is not used
LOWEST_SHARE = 7.0  # of the bandwidth asked: down to a seventh of it one that is possible is looked for
AROUND = ("gate", "heat", "outer", "compensation", "link", "warnings")  # fields of what stands around the plan
SENSOR = 1.0 / 120.0  # default sensor noise per static gain: the filter is then quick, and the loop's Ms moderate


@record(eq=False, repr=False)
class ForceMPC(ReadsLink, Result, Worded):
    """A force controller within limits; `force_mpc` makes one.

    Parameters
    ----------
    spec : MPCSpec
    design : (Plant, ParameterSet)
    kalman : Estimator
    regulator : Regulator
        The controller without limits.
    prediction : HorizonProgram
        What the quadratic program minimises, and its limits.
    static_gain : float
        N/A.
    rest_state : array, shape (nx,)
        The plant's state at rest per ampere.
    shift : array, shape (n, n)
        Shifts the plan at the knots by one sample.
    solver : QuadraticProgram
        The program's matrices, factored.
    gate : PlausibilityGate, optional
        Which measurements are believed, the first if it is in range; the others are predicted, and at a fault the
        current goes to zero.
    heat : HeatGuard, optional
        What lowers the limit of the command as the winding warms up; the plan keeps the lowered one.
    outer : OuterLoop, optional
        What makes the reference of a stiffness and a damping at the link (`seaopt.control.add_impedance`); its `step`
        comes before this one's.
    compensation : Compensation, optional
        What is added to reference and command (`seaopt.control.add_compensation`), whose sum the plan keeps in limits.
    link : LinkPath, optional
        What is added to the command of the link's motion (`seaopt.robustness.feed_link_forward`), likewise.
    warnings : tuple of str
        What is doubtful, such as a delay that is too short.
    """

    spec: MPCSpec
    design: tuple[Plant, ParameterSet]
    kalman: Estimator
    regulator: Regulator
    prediction: HorizonProgram
    static_gain: float
    rest_state: Float[np.ndarray, " nx"]
    shift: Float[np.ndarray, "n n"]
    solver: QuadraticProgram
    gate: PlausibilityGate | None = None
    heat: HeatGuard | None = None
    outer: OuterLoop | None = None
    compensation: Compensation | None = None
    link: LinkPath | None = None
    warnings: tuple[str, ...] = ()
    memory: dict[Any, Any] = field(init=False, repr=False, default_factory=dict)  # of what follows from the fields

    def __reduce__(self) -> tuple[Any, ...]:
        around = {name: getattr(self, name) for name in AROUND}
        return _design, (*self.design, self.spec, around)  # what it remembers does not pickle

    @property
    @memo
    def loops(self) -> Mapping[str, Loop]:
        """Around the design plant while no limit is active, in newtons of motor force; with friction sliding, stuck."""
        plant, values = self.design
        states = split_friction({"design plant": plant}, values)
        return {name: self.close(model, values) for name, model in states.items()}

    @property
    @memo
    def measured_loops(self) -> tuple[MeasuredLoop, ...]:
        """These loops as limits are judged on them."""
        return tuple(
            MeasuredLoop(name=name, figures=loop.figures(), gain_unit=self.actuation.gain_unit)
            for name, loop in self.loops.items()
        )

    @property
    @memo
    def verdicts(self) -> tuple[LimitVerdict, ...]:
        """Every limit of the specification against these loops."""
        return tuple(judge_all(self.spec, self.measured_loops, len(self.measured_loops)))

    @property
    @memo
    def possible_hz(self) -> float | None:
        """Where a limit is broken: a bandwidth that keeps them all; None where none does down to a seventh.

        It is the first on the way down from the one asked, in steps of a sixth, moved up by bisection to a hundredth.
        """
        return None if self.met else _find_possible(self)

    @property
    @memo
    def friction(self) -> FrictionMargin | None:
        """How much steeper friction may be with stability shown while no limit is active; None without friction."""
        return find_friction_margin(self, *self.design)

    @property
    def measured(self) -> str:
        """The output that is fed back."""
        return self.spec.measured

    @property
    def sample_time_s(self) -> float:
        """Seconds between samples."""
        return self.spec.sample_time_s

    @property
    def compute_delay_samples(self) -> int:
        """Whole samples from a reading to the command being put out, besides the hold."""
        return self.spec.loop_delay_samples

    @property
    def drive_delay_s(self) -> float:
        """Seconds from the command to its effect on the design plant."""
        plant, values = self.design
        return float(find_delay(plant, read_conditions(plant, values)))

    @property
    @memo
    def actuation(self) -> Command:
        """What is commanded for an effort, of the design plant."""
        return command_of(*self.design, self.measured)

    @property
    def per_effort(self) -> float:
        """The command for one unit of effort, of the design plant."""
        return self.actuation.per_effort

    @property
    def command_limit(self) -> float:
        """The limit of the command: what is asked for, and no more than the plant's actuation takes."""
        return limit_command(self.spec, *self.design)

    @property
    def heat_guard(self) -> HeatGuard | None:
        """The guard of the design plant's motor; None without the part "thermal", or where no current is commanded."""
        if self.design[0].winding is None or self.actuation.unit != "A":
            return None
        return HeatGuard.of_rating(rate_motor(*self.design, self.command_limit), self.sample_time_s)

    @property
    def achieved(self) -> LoopFigures:
        """The design plant's figures while no limit is active, sliding where it has friction."""
        return self.measured_loops[0].figures

    @property
    def met(self) -> bool:
        """Whether every limit is met, as measured."""
        return all(verdict.met for verdict in self.verdicts)

    @property
    def broken(self) -> tuple[BindingLimit, ...]:
        """The limits that are broken, with the state of the design plant that breaks them."""
        return tuple(list_broken(self.verdicts))

    @property
    def explanation(self) -> str:
        """One line: the limits that block, and the bandwidth that is possible; empty where every limit is met."""
        if self.met:
            return ""
        loop = next(iter(self.loops.values()))
        blocked = shorten_blocked([*explain_broken(self.spec, self.verdicts, self.measured_loops[0], loop).values()])
        remedy = (
            f"{self.possible_hz:.4g} Hz is possible (tuned, not certified)"
            if self.possible_hz is not None
            else "no lower bandwidth is known that keeps them; shorten the delay, sample faster, give the plan more "
            "moves, or raise a limit"
        )
        return f"{self.spec.bandwidth_hz:g} Hz is blocked by {blocked}; {remedy}"

    @property
    def notes(self) -> tuple[str, ...]:
        """Remarks besides the limits, one sentence each."""
        proof = () if self.friction is None else (f"{self.friction}, while no limit is active",)
        limit = limit_notes(self.actuation, self.spec)
        return (*self.spec.lifted_notes, *self.warnings, *limit, *self._filter_notes(), *proof)

    def _filter_notes(self) -> tuple[str, ...]:
        """Return what the prefilter is, and the bandwidth without it."""
        chosen = self.spec.reference_filter
        if chosen is None:
            return ()
        plan = self.unlimited().scaled(1.0 / self.per_effort)
        bare = replace(self.close(*self.design), law=plan).figures().bandwidth_hz
        kind = chosen.order.replace("_", " ")
        return (f"prefilter of {kind} at {chosen.corner_hz:.4g} Hz; without it the bandwidth is {bare:.4g} Hz",)

    @property
    def start(self) -> MPCState:
        """At rest at zero."""
        n, m = self.prediction.knots.size, len(self.prediction.rows)
        return MPCState(
            kalman=self.kalman.start,
            command=0.0,
            plan=np.zeros(n),
            sides=np.zeros(m, dtype=int),
            age=self.spec.samples,
            shaped=() if self.spec.low_pass is None else (0.0,) * (self.spec.low_pass.den.size - 1),
        )

    def step(
        self, state: MPCState, reference_N: float | References, measurement_N: float, readings: Sequence[float] = ()
    ) -> MPCStep:
        """Return the current for a reference and a measured force; one that is not finite is predicted.

        Parameters
        ----------
        state : MPCState
            After the last sample.
        reference_N : float or array, shape (r,)
            Of this sample, and of those that follow as far as they are known, `spec.preview_samples` of them at most;
            the last is held.
        measurement_N : float
            The measured force.
        readings : sequence of float
            Of `reads`; where one is not finite, what is added is that of the last sample.

        Raises
        ------
        ControlError
            A reference is not a finite number within +-1e15, or there are more of them than the specification says.
        """
        began = time.perf_counter()
        references, shaped = read_references(reference_N, self.spec.preview_samples), state.shaped
        terms = add_terms(self.compensation, self.link_filter, state.terms, references, readings)
        references = references + terms[0]
        if self.spec.low_pass is not None:
            references, shaped = shape_references(self.spec.low_pass, shaped, references)
        limit, last, seen = self.command_limit, state.command, state.gate
        most = limit if self.heat is None else min(limit, self.heat.limit(state.heat))
        if self.gate is not None:
            _, seen = self.gate.screen(seen, measurement_N)
            measurement_N = np.nan if seen.held else measurement_N
        measurement_N = measurement_N if is_number(measurement_N) else np.nan
        terms = (terms[0], 0.0, *terms[2:]) if seen.fault else terms
        added = terms[1] * self.per_effort  # which the model has no part of, nor of the friction that it meets
        corrected, innovation, ahead = self._observe(state.kalman, measurement_N)
        drift, before = float(ahead[-1]), last - state.terms[1] * self.per_effort
        u_s, targets = self._targets(drift, references, -most - added, most - added)
        xi = ahead[: self.rest_state.size] - self.rest_state * (u_s + drift)
        q, low, high = self.program(xi, u_s, before, drift, targets, most)
        shifted = self.shift @ state.plan
        taken = self.prediction.take(added / limit, (added - last + before) / self.spec.slew_per_sample)
        low, high = low - taken, high - taken
        solution = self.solver.solve(q, low, high, state.sides, self.spec.max_iterations)
        theta, status = solution.x, self._fault(solution, low, high)
        planned, age, sides = limit * theta[: shifted.size] + u_s, 0, solution.sides
        if not np.all(np.isfinite(theta)):
            sides = np.zeros_like(sides)  # the next step starts afresh
        if status:  # the last plan goes on for as long as its horizon
            old = state.age >= self.spec.samples
            planned, age = (np.full(shifted.size, u_s) if old else shifted), min(state.age + 1, self.spec.samples)
        if self.gate is not None and seen.fault:
            status, age, sides = "sensor fault", self.spec.samples, np.zeros_like(sides)
            planned = np.full(shifted.size, self.gate.ramp(last, self.spec.sample_time_s))
        current = self.admissible(float(planned[0]) + added, last, most)
        heat = state.heat if self.heat is None else self.heat.warm(state.heat, current)
        kalman = self._command(state.kalman, corrected, innovation, current - added)
        after = replace(state, kalman=kalman, command=current, plan=planned, sides=sides, age=age)
        return MPCStep(
            command=current,
            solved=not status,
            status=status or solution.status,
            target_N=float(targets[-1]),
            slack=0.0 if status else SLACK_UNIT * float(np.max(theta[shifted.size :], initial=0.0)),
            state=replace(after, gate=seen, heat=heat, shaped=shaped, terms=terms),
            force_N=float(self.kalman.C[0] @ corrected),
            iterations=solution.iterations,
            step_time_s=time.perf_counter() - began,
        )

    def command(
        self, state: MPCState, reference_N: float | References, measurement_N: float, readings: Sequence[float] = ()
    ) -> tuple[float, MPCState]:
        """Return the current and the next state alone, as `close_loop` takes them."""
        result = self.step(state, reference_N, measurement_N, readings)
        return result.command, result.state

    def admissible(self, command: float, last: float, most: float) -> float:
        """Return the current nearest to one given that slew and size allow after the last."""
        slew = self.spec.slew_per_sample
        return float(np.clip(np.clip(command, last - slew, last + slew), -most, most))

    def program(
        self, xi: Float[np.ndarray, " nx"], u_s: float, last: float, drift: float, targets: References, most: float
    ) -> tuple[Float[np.ndarray, " nv"], PerRow, PerRow]:
        """Return the vectors of the quadratic program: its gradient, lower and upper bounds of its rows.

        `xi`: the state's distance from its target. `u_s`, `last`, `drift`: the command at rest, the last one, and the
        estimate of its disturbance. `targets`: the force's, from the first sample that a command reaches on, as far as
        they are known. `most`: the limit of the command at this sample.
        """
        prediction, limit, ones = self.prediction, self.command_limit, np.ones(self.prediction.knots.size)
        slopes = np.zeros(len(prediction.M))
        if slopes.size:
            slopes[0] = (last - u_s) / self.spec.slew_per_sample
        lag = prediction.lag_s / self.spec.sample_time_s
        delta = targets[:-1] - targets[-1] + lag * np.diff(targets)
        gradient = prediction.F @ np.append(xi, last - u_s) + prediction.R @ delta
        under, over = prediction.outputs.limits(np.append(xi, last - u_s), u_s + drift, WIDE)
        q = np.concatenate([gradient, np.full(len(prediction.outputs.names), PENALTY)])
        low = np.concatenate([(-most / limit - u_s / limit) * ones, slopes - 1.0, under])
        high = np.concatenate([(most / limit - u_s / limit) * ones, slopes + 1.0, over])
        return q, low, high

    def _observe(self, kalman: EstimatorState, measurement: float) -> tuple[State, Float[np.ndarray, " 1"], State]:
        """Return z with the measurement, the innovation, and z when a current commanded now arrives."""
        line = kalman.past  # D = 0: which of them acts does not matter to the innovation
        corrected, innovation = self.kalman.correct(kalman, np.array([measurement]), line[0])
        ahead = corrected
        for older, newer in pairwise(line):
            ahead = self.kalman.advance(ahead, older, newer)
        return corrected, innovation, ahead

    def _targets(
        self, drift: float, references: Float[np.ndarray, " p"], least: float, most: float
    ) -> tuple[float, References]:
        """Return the current at rest for the last reference, and the nearest forces to all that the limits can hold."""
        ends = self.prediction.outputs.admissible_rest(drift, least, most)
        currents = np.clip(references / self.static_gain - drift, *ends)
        first = min(self.kalman.delay_samples, references.size - 1)
        return float(currents[-1]), self.static_gain * (currents[first:] + drift)

    def _fault(self, solution: QPSolution, low: PerRow, high: PerRow) -> str:
        """Return why a solution is not used; an unfinished one is if it keeps the limits."""
        if solution.status not in (SOLVED, UNFINISHED):
            return solution.status
        if not np.all(np.isfinite(solution.x)):
            return "solution is not finite"
        rows = self.prediction.rows @ solution.x
        outside = float(np.max(np.maximum(low - rows, rows - high)))
        broken = "" if outside <= VIOLATION else f"solution breaks a limit by {outside:.1%} of it"
        return f"{UNFINISHED}, {broken}" if broken and solution.status == UNFINISHED else broken

    def _command(
        self, kalman: EstimatorState, corrected: State, innovation: Float[np.ndarray, " 1"], current: float
    ) -> EstimatorState:
        """Return the filter's state after a sample at which a current was commanded."""
        line = np.vstack([kalman.past, np.zeros(self.kalman.B.shape[1])])
        line[-1, 0] = current
        return self.kalman.go_on(line, corrected, innovation)

    def unlimited(self) -> Law:
        """Return the plan as long as no limit is active: from its reference and the measurement to current."""
        gains = -np.linalg.solve(self.prediction.H, self.prediction.F)[0] * self.command_limit
        x_rest, kalman, start = self.rest_state, self.kalman, self.kalman.start
        n, delay = len(kalman.A), kalman.delay_samples
        acting = max(delay + bool(np.any(kalman.late)), 1)  # commands that still act, of which the last is one

        def respond(inputs: Float[np.ndarray, " k"]) -> Float[np.ndarray, " k1"]:
            """Return z and the acting commands a sample later, and the current, from z, commands, reference, force."""
            z, past, (r, y) = inputs[:n], start.past.copy(), inputs[-2:]
            past[delay + 1 - acting :, 0] = inputs[n:-2]
            state = replace(start, predicted=z, past=past)
            corrected, innovation, ahead = self._observe(state, y)
            u_s = r / self.static_gain - ahead[-1]
            current = u_s + gains @ np.append(ahead[: x_rest.size] - x_rest * r / self.static_gain, past[-1, 0] - u_s)
            after = self._command(state, corrected, innovation, current)
            return np.concatenate([after.predicted, after.past[delay + 1 - acting :, 0], [current]])

        size = n + acting
        offset = respond(np.zeros(size + 2))
        whole = np.column_stack([respond(unit) - offset for unit in np.eye(size + 2)])
        return Law(
            a=whole[:size, :size],
            b=whole[:size, size:],
            c=whole[size, :size],
            d=whole[size, size:],
            sample_time_s=self.spec.sample_time_s,
        )

    @property
    def law(self) -> Law:
        """What it is while no limit is active, from reference and measurement to effort."""
        plan, low_pass = self.unlimited().scaled(1.0 / self.per_effort), self.spec.low_pass
        law = plan if low_pass is None else plan.behind(low_pass)
        return law if self.link_filter is None else law.reading(self.link_filter[0])


def force_mpc(
    plant: Plant,
    params: ParameterSet | Fit,
    spec: MPCSpec,
    *,
    gate: PlausibilityGate | None = None,
    heat: HeatGuard | None = None,
) -> ForceMPC:
    """Return a force controller that plans within current and slew limits.

    A bandwidth at which a limit of its margins is broken gives a controller that is not `feasible`, and says which
    bandwidth is possible.

    Parameters
    ----------
    plant, params
        The design plant, the test stand as a rule, and its parameters or a fit, whose experiments' delay is taken where
        the specification leaves it out; its first input is what is commanded.
    spec : MPCSpec
        Limits and bandwidth.
    gate : PlausibilityGate, optional
        Which measurements are believed.
    heat : HeatGuard, optional
        What lowers the limit of the command, a current, as the winding warms up.

    Raises
    ------
    ControlError
        The measured output does not settle under a constant current, or responds to it at once; the limits hold less
        than `spec.largest_force_N`; or the bandwidth is not possible.

    Examples
    --------
    >>> import seaopt as so
    >>> from seaopt.control import MPCSpec, force_mpc
    >>> spec = MPCSpec(current_limit_A=9.0, bandwidth_hz=20)
    >>> mpc = force_mpc(so.plants.high_impedance(), so.plants.thor(), spec)
    >>> step = mpc.step(mpc.start, reference_N=2000.0, measurement_N=0.0)
    >>> mpc.feasible, step.solved, round(step.command, 3)
    (True, True, 7.99)
    """
    require_plant(plant, "plant", ControlError)
    require_type(params, (ParameterSet, Fit), "params", "give a ParameterSet or a Fit", ControlError)
    require_type(spec, MPCSpec, "spec", "give an MPCSpec", ControlError)
    check_guards(gate, heat, name_input(plant))
    if gate is not None and gate.reads:
        raise ControlError("gate.agreement: predictive control reads the force alone; leave it out")
    find_rows(plant, spec.measured)  # refuses a name that is no output
    warnings = warn_delays(spec, plant, params)
    spec, values = settle_delays(spec, plant, params, plans=True)
    return _design(plant, values, spec, {"gate": gate, "heat": heat, "warnings": warnings})


def _find_possible(mpc: ForceMPC) -> float | None:
    """Return the first bandwidth below the one asked that keeps every limit; None where none is found."""

    def keeps(bandwidth_hz: float) -> bool:
        try:
            return _design(*mpc.design, replace(mpc.spec, bandwidth_hz=bandwidth_hz)).feasible
        except ControlError:  # slower than any weight makes it
            return False

    bandwidth_hz = mpc.spec.bandwidth_hz
    return find_end(keeps, list_steps(bandwidth_hz, bandwidth_hz / LOWEST_SHARE), bandwidth_hz, bandwidth_hz)


def _design(plant: Plant, values: ParameterSet, spec: MPCSpec, around: Mapping[str, Any] | None = None) -> ForceMPC:
    """Return the controller of a settled specification, with fields of `AROUND`; friction slides in its model."""
    design = (plant, values)
    plant = freeze_heat(take_sliding(plant, values))
    completed = plant.complete(ParameterSet(parameter for name, parameter in values.items() if name not in DELAYS))
    digital = sample(plant, completed, spec.measured, 1.0, spec.sample_time_s, 0)
    limit = limit_command(spec, plant, completed)
    gain = find_static_gain(plant, digital, spec, limit)
    drive = next(iter(plant.inputs))
    noise = spec.noise or NoiseModel(
        sensor_std={spec.measured: SENSOR * abs(gain)}, input_noise={drive: 1.0}, input_drift={drive: 3.0}
    )
    if not noise.input_drift.get(drive, 0.0) > 0.0 or len(noise.input_drift) > 1:
        raise ControlError(
            f"noise: input_drift must be of {drive} alone and above zero, for it takes the force's offset away"
        )
    kalman = estimator(
        plant,
        values,
        noise,
        outputs=(spec.measured,),
        sample_time_s=spec.sample_time_s,
        delay_samples=spec.loop_delay_samples,
    )
    nx = digital.b.size
    a, _, c, _ = state_space(plant, completed)
    rate = c[list(plant.outputs).index(spec.measured)] @ a  # of the force, without the current's own part

    def make_plant(plan_hz: float) -> ForcePlant:
        lag_s = spec.decay / (2.0 * math.pi * plan_hz)
        return ForcePlant(
            a=digital.a,
            b=kalman.B[:nx, 0],
            late=kalman.late[:nx, 0],
            c=digital.c[0],
            w=digital.c[0] + lag_s * rate,
            lag_s=lag_s,
            gain=gain,
            sample_time_s=spec.sample_time_s,
        )

    plan_hz = find_plan_bandwidth(make_plant, spec.bandwidth_hz, spec.low_pass)
    sampled = make_plant(plan_hz)
    regulator = tune_regulator(sampled, plan_hz)
    knots = spread_knots(spec.samples, spec.moves)
    outputs = bound_outputs(spec.bounds, kalman, sampled, interpolate_knots(knots), limit)
    preview = max(spec.preview_samples - kalman.delay_samples, 0)
    prediction = condense(sampled, regulator, knots, limit, spec.slew_per_sample, preview, outputs)
    return ForceMPC(
        spec=spec,
        design=design,
        kalman=kalman,
        regulator=regulator,
        prediction=prediction,
        static_gain=gain,
        rest_state=sampled.rest_state,
        shift=np.column_stack([np.interp(knots + 1, knots, row) for row in np.eye(knots.size)]),
        solver=factor_program(stack_hessian(prediction), prediction.rows),
        **around or {},
    )
