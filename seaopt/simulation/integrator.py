r"""The step of a nonlinear plant: classical Runge-Kutta of order four, as a CasADi function with its derivatives.

One step of length :math:`h` from :math:`x` at :math:`t`, with the input a straight line from :math:`u_0` to
:math:`u_1` over the step. `step_function` lets CasADi differentiate the step itself. `rate_functions` gives what
compiled code needs to do the same faster: differentiating the four stages gives the same method applied to

.. math:: \dot S = f_x S + f_p,

so that one evaluation of :math:`f, f_x, f_p` per stage serves every derivative, and the sensitivities are again those
of the numbers that the step computes.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np
from jaxtyping import Float

from seaopt.plants.memo import memo
from seaopt.records import record
from seaopt.simulation.events import EventStep
from seaopt.simulation.model import Model, fill_parameters, linearise
from seaopt.simulation.passes import Point, Segment
from seaopt.simulation.runge_kutta import runge_kutta_step
from seaopt.simulation.sticking import joint_equations, sticking_line_step, sticking_output

SQUARINGS = 4  # to the power of 16, whose root is near the largest eigenvalue
STABLE = 2.5  # of a rate times the step: order four is stable up to 2.78 along the real axis, 2.83 along the imaginary


@memo
def step_function(model: Model) -> ca.Function:
    """Return the CasADi function (t, x, u0, u1, p, h) -> (x1, dx1/dx, dx1/d[theta, h, u0, u1])."""
    t, h = ca.SX.sym("t"), ca.SX.sym("h")
    x, p = ca.SX.sym("x", model.nx), ca.SX.sym("p", model.p.numel())
    u0, u1 = ca.SX.sym("u0", model.nu), ca.SX.sym("u1", model.nu)
    arguments = [t, x, u0, u1, p, h]
    if model.sticks and not model.by_events:
        x1 = sticking_line_step(model.plant)(t, x, u0, u1, fill_parameters(model, p), h)
    else:
        mode, f = _find_moving(model)[:2]
        rate = ca.Function("rate", [model.t, model.x, model.u, model.p, mode], [f])
        x1 = runge_kutta_step(lambda s, x: h * rate(t + s * h, x, u0 + s * (u1 - u0), p, mode), 0.0, x, 1.0)
        arguments += [mode] if model.by_events else []
    moved = ca.vertcat(p[: model.np], h, u0, u1)
    results = [x1, ca.densify(ca.jacobian(x1, x)), ca.densify(ca.jacobian(x1, moved))]
    step = ca.Function("seaopt_step", arguments, results, {"cse": True})
    if not model.by_events:
        return step
    mode, f, _, joint = _find_moving(model)
    where = [model.t, model.x, model.u, model.p]
    return EventStep(step, ca.Function("rate", [*where, mode], [f]), ca.Function("joint", where, joint), model.np)


def _find_moving(model: Model) -> tuple[Any, Any, Any, list[Any]]:
    """Return mode, f, h, and of a joint that sticks its figures, their speed's derivatives, and a force's effect.
    Without such a joint the mode is nothing.
    """
    if not model.by_events:
        return ca.SX(0, 1), model.f, model.h, []
    mode, f, figures, effect = joint_equations(model.plant)
    rows = [list(model.plant.outputs).index(name) for name in model.outputs]
    h = sticking_output(model.plant)(model.t, model.x, model.u, model.plant.p)[rows]
    filled = fill_parameters(model, model.p)
    f, h, figures, effect = ca.substitute([f, h, figures, effect], [model.plant.p], [filled])
    by = [ca.densify(ca.jacobian(figures[0], each)) for each in (model.x, model.theta)]
    return mode, f, h, [ca.densify(figures), *by, effect]


def count_stable_steps(model: Model, theta: Float[np.ndarray, " np"], period: float) -> float:
    """Return how many steps of a period are stable near rest, where friction smoothed through zero is stiffest.

    Its slope there is f_c/v_s, and the rate that follows, f_c/(m v_s), grows without limit as v_s falls.
    """
    return _count_stable_steps(model, np.asarray(theta, dtype=float).tobytes(), period)


@lru_cache(maxsize=32)  # a solver asks several times at one point
def _count_stable_steps(model: Model, theta: bytes, period: float) -> float:
    nx = model.nx
    a = linearise(model).matrices(np.frombuffer(theta))[0][:nx, :nx]
    if not np.all(np.isfinite(a)):
        return 1.0
    return float(np.ceil(np.max(np.abs(np.linalg.eigvals(a)), initial=0.0) * period / STABLE))


@memo
def _slope_function(model: Model) -> ca.Function:
    slope = ca.densify(ca.jacobian(model.f, model.x))
    return ca.Function("slope", [model.t, model.x, model.u, model.p], [slope], {"cse": True})


@np.errstate(all="ignore")
def find_stable_steps(
    model: Model, point: Point, segment: Segment, states: Float[np.ndarray, "n nx"]
) -> Float[np.ndarray, " n"]:
    """Return how many steps are stable in each sample of a segment, from the states there: not whole numbers."""
    n, nx, period = len(states), model.nx, point.clock.period
    u = np.vstack([channel[:n] for channel in segment.inputs])
    t, p = segment.start_s + period * np.arange(n), model.parameters(point.theta)
    slopes = _slope_function(model).map(n)(t[None], states.T, u, np.repeat(p[:, None], n, 1))
    size = np.maximum(np.sqrt(np.mean(states**2, axis=0)), 1e-300)
    power = np.array(slopes).reshape(nx, n, nx).transpose(1, 0, 2) * size / size[:, None]
    rate = np.zeros(n)  # logarithm of the norm of a power of the slopes, whose root is that of the largest eigenvalue
    for _ in range(SQUARINGS):
        norm = np.linalg.norm(power, axis=(1, 2), keepdims=True)
        rate = 2.0 * (rate + np.log(norm[:, 0, 0]))
        power = (power / norm) @ (power / norm)
    rate += np.log(np.linalg.norm(power, axis=(1, 2)))
    return np.exp(rate / 2.0**SQUARINGS) * period / STABLE


@memo
def output_function(model: Model) -> ca.Function:
    """Return the CasADi function (t, x, u, p) -> (y, dy/dx, dy/dtheta, dy/du)."""
    arguments = [model.t, model.x, model.u, model.p]
    h = model.h
    if model.sticks:
        rows = [list(model.plant.outputs).index(name) for name in model.outputs]
        h = sticking_output(model.plant)(*arguments[:3], fill_parameters(model, model.p))[rows]
    derivatives = (ca.densify(ca.jacobian(h, by)) for by in (model.x, model.theta, model.u))
    return ca.Function("seaopt_output", arguments, [ca.densify(h), *derivatives], {"cse": True})


def _take_reciprocals(expression: Any, arguments: list[Any], p: Any) -> tuple[Any, Any, Any]:
    """Return an expression that multiplies by a symbol where it divided by something of parameters alone, these symbols
    and what they stand for: a division takes as long as three products, and a step of order four waits for eight.
    """
    inputs, outputs, reciprocals = [*arguments, p], [ca.SX(0)] * expression.numel(), dict[int, tuple[Any, Any]]()
    function, work = ca.Function("expression", inputs, [expression]), dict[int, tuple[Any, bool]]()  # value, varies
    for k in range(function.n_instructions()):
        operation, read, (to, *entry) = (
            function.instruction_id(k), function.instruction_input(k), function.instruction_output(k)
        )  # fmt: skip
        if operation == ca.OP_OUTPUT:
            outputs[entry[0]] = work[read[0]][0]
        elif operation == ca.OP_INPUT:
            work[to] = inputs[read[0]].nz[read[1]], read[0] < len(arguments)
        elif operation == ca.OP_CONST:
            work[to] = ca.SX(function.instruction_constant(k)), False
        else:
            values, varies = zip(*(work[each] for each in read), strict=True)
            if operation == ca.OP_DIV and varies == (True, False) and not values[1].is_constant():
                symbol = ca.SX.sym(f"reciprocal{len(reciprocals)}")
                value = values[0] * reciprocals.setdefault(values[1].element_hash(), (symbol, 1.0 / values[1]))[0]
            else:
                value = (ca.SX.unary if len(values) == 1 else ca.SX.binary)(operation, *values)
            work[to] = value, any(varies)
    symbols, meanings = zip(*reciprocals.values(), strict=True) if reciprocals else ((), ())
    return ca.vertcat(*outputs), ca.vertcat(ca.SX(0, 1), *symbols), ca.vertcat(ca.SX(0, 1), *meanings)


_LANES = {  # operations of vectors, as C,
    **{"ASSIGN": "{0}", "ADD": "{0} + {1}", "SUB": "{0} - {1}", "MUL": "{0} * {1}", "DIV": "{0} / {1}", "NEG": "-{0}"},
    **{"SQ": "{0} * {0}", "TWICE": "2.0 * {0}", "INV": "1.0 / {0}", "TANH": "seaopt_tanh_lanes({0})"},
}
_NUMBERS = {  # and of one number
    **{"SIN": "sin({0})", "COS": "cos({0})", "TAN": "tan({0})", "ATAN": "atan({0})", "ATAN2": "atan2({0}, {1})"},
    **{"EXP": "exp({0})", "LOG": "log({0})", "POW": "pow({0}, {1})", "CONSTPOW": "pow({0}, {1})", "SQRT": "sqrt({0})"},
    **{"COSH": "cosh({0})", "SINH": "sinh({0})", "FMIN": "fmin({0}, {1})", "FMAX": "fmax({0}, {1})"},
    **{"FABS": "fabs({0})", "COPYSIGN": "copysign({0}, {1})", "FLOOR": "floor({0})", "CEIL": "ceil({0})"},
    **{"LT": "{0} < {1}", "LE": "{0} <= {1}", "EQ": "{0} == {1}", "NE": "{0} != {1}", "NOT": "!{0}"},
    **{"AND": "{0} && {1}", "OR": "{0} || {1}", "IF_ELSE_ZERO": "{0} != 0.0 ? {1} : 0.0"},
    "SIGN": "{0} < 0.0 ? -1.0 : {0} > 0.0 ? 1.0 : {0}",
}


def write_in_lanes(function: ca.Function) -> str:
    """Return the C code of a function of numbers in several lanes; nothing where it has other operations than these."""
    arguments = [f"a{i}" for i in range(function.n_in())]
    results = [f"r{i}" for i in range(function.n_out())]
    vectors, numbers = ({getattr(ca, f"OP_{name}"): c for name, c in table.items()} for table in (_LANES, _NUMBERS))
    lines, places = list[str](), set[int]()
    for k in range(function.n_instructions()):
        operation, read, to = function.instruction_id(k), function.instruction_input(k), function.instruction_output(k)
        places.update(to if operation != ca.OP_OUTPUT else read)
        if operation == ca.OP_OUTPUT:
            lines.append(f"{results[to[0]]}[{to[1]}] = w{read[0]};")
        elif operation == ca.OP_INPUT:
            lines.append(f"w{to[0]} = {arguments[read[0]]}[{read[1]}];")
        elif operation == ca.OP_CONST and math.isfinite(function.instruction_constant(k)):
            lines.append(f"w{to[0]} = zero + {function.instruction_constant(k)!r};")
        elif operation in vectors:
            lines.append(f"w{to[0]} = {vectors[operation].format(*(f'w{place}' for place in read))};")
        elif operation in numbers:
            value = numbers[operation].format(*(f"w{place}[l]" for place in read))
            lines.append(f"for (int l = 0; l < LANES; l++) w{to[0]}[l] = {value};")
        else:
            return ""
    head = ", ".join([*(f"const lanes *{name}" for name in arguments), *(f"lanes *{name}" for name in results)])
    work = ["const lanes zero = {0.0}; (void)zero;", *(f"lanes w{place};" for place in sorted(places))]
    name = f"static inline __attribute__((always_inline)) void {function.name()}({head}) {{"
    return "\n    ".join([name, *work, *lines]) + "\n}\n"


@record(eq=False)
class Rates:
    """Right-hand side and outputs for compiled code, with what depends on parameters alone taken out."""

    prepare: Any  # p -> c, once per pass
    # rate, output: (t, x, u, du, c) -> f or h, and the nonzeros of its derivatives by x and by theta; where inputs move
    # with the delay, by du each second, then by the delay too. The rate of a joint that sticks takes its mode besides
    rate: Any
    output: Any
    joint: Any  # (t, x, u, c) -> [speed, holding force, F(0)], d speed/dx, d speed/d theta, what a force adds to f
    # rate_pattern, output_pattern: where those nonzeros stand
    rate_pattern: tuple[list[tuple[int, int]], list[tuple[int, int]]]
    output_pattern: tuple[list[tuple[int, int]], list[tuple[int, int]]]


@memo
def rate_functions(model: Model, *, moving: bool = False) -> Rates:
    """Return the functions of compiled passes; of inputs that move with a free delay, or not."""
    du, parts = ca.SX.sym("du", model.nu), list[Any]()
    mode, f, h, joint = _find_moving(model)
    for e in (f, h):
        by_theta = ca.jacobian(e, model.theta)
        along = ca.jtimes(e, model.u, du) if moving else ca.SX(e.numel(), 0)
        parts += [e, ca.jacobian(e, model.x), ca.sparsify(ca.horzcat(by_theta, along))]
    dense = [ca.densify(part) if i % 3 == 0 else part for i, part in enumerate(parts)] + joint
    sizes = [part.nnz() for part in dense]
    flat = ca.cse(ca.vertcat(*(entry for part in dense for entry in part.nonzeros())))
    reciprocals = meanings = ca.SX(0, 1)
    if not joint:  # whose events take longer than its rates
        flat, reciprocals, meanings = _take_reciprocals(flat, [model.t, model.x, model.u, du], model.p)
    flat, symbols, values = ca.extract_parametric(flat, ca.vertcat(model.p, reciprocals), {"extract_trivial": True})
    c, columns = ca.vertcat(*symbols), []
    for size in sizes:
        columns.append(flat[:size])
        flat = flat[size:]
    where = [model.t, model.x, model.u]
    modes = [mode] if joint else []
    rate = ca.Function("seaopt_rate", [*where, du, c, *modes], columns[:3])
    output = ca.Function("seaopt_output", [*where, du, c], columns[3:6])
    prepare = ca.Function("seaopt_prepare", [model.p], ca.substitute([ca.vertcat(*values)], [reciprocals], [meanings]))
    pattern = [list(zip(*part.sparsity().get_triplet(), strict=True)) for part in dense]
    return Rates(
        prepare=prepare,
        rate=rate,
        output=output,
        joint=ca.Function("seaopt_joint", [*where, c], columns[6:]) if joint else None,
        rate_pattern=(pattern[1], pattern[2]),
        output_pattern=(pattern[4], pattern[5]),
    )
