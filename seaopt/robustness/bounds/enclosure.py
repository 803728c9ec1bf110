"""Enclosures of CasADi functions over boxes, for the bounds: their instructions, one by one, on Taylor models."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import casadi as ca
import numpy as np
from jaxtyping import Float

from seaopt.errors import ControlError
from seaopt.robustness.bounds.taylor import Basis, Taylor, make_constant, stack_models

Entry = Taylor | float
LARGEST_POWER = 64


def enclose(function: Any, arguments: Sequence[Sequence[Entry]]) -> list[list[Entry]]:
    """Return enclosures of the entries of a function's outputs, column by column. Entries that depend on nothing
    uncertain are numbers, computed as CasADi does, whatever the instruction. The function is of SX, its outputs dense;
    an instruction on something uncertain may have no enclosure.
    """
    if not function.is_a("SXFunction"):
        raise ControlError(f"{function.name()} is not of scalar instructions (SX); no bound can be computed")
    work: list[Entry] = [0.0] * function.sz_w()
    out: list[list[Entry]] = [[0.0] * function.nnz_out(k) for k in range(function.n_out())]
    for k in range(function.n_instructions()):
        op = function.instruction_id(k)
        target, source = function.instruction_output(k), function.instruction_input(k)
        if op == ca.OP_INPUT:
            work[target[0]] = arguments[source[0]][source[1]]
        elif op == ca.OP_OUTPUT:
            out[target[0]][target[1]] = work[source[0]]
        elif op == ca.OP_CONST:
            work[target[0]] = float(function.instruction_constant(k))
        else:
            work[target[0]] = _apply_operation(op, [work[i] for i in source])
    return out


def _apply_operation(op: int, operands: list[Entry]) -> Entry:
    """Return the result of one operation, on numbers or on models."""
    numbers = [ca.SX(entry) for entry in operands if not isinstance(entry, Taylor)]
    if len(numbers) == len(operands):
        return float((ca.SX.binary if len(numbers) == 2 else ca.SX.unary)(op, *numbers))
    enclosures = BINARY if len(operands) == 2 else UNARY
    if op not in enclosures:
        names = [name for name in dir(ca) if name.startswith("OP_") and getattr(ca, name) == op]
        raise ControlError(f"the plant's equations have {names[0][3:].lower()}, which has no enclosure")
    return enclosures[op](*operands)


def _raise_to_power(a: Entry, b: Entry) -> Entry:
    """Return a whole power by repeated products, any other of a positive number by its series."""
    if isinstance(b, Taylor):
        raise ControlError("the plant's equations have an uncertain exponent, which has no enclosure")
    assert isinstance(a, Taylor)
    if b == round(b) and 0 < abs(b) <= LARGEST_POWER:
        whole = a
        for _ in range(abs(round(b)) - 1):
            whole = whole * a
        return whole if b > 0 else whole.reciprocal()
    degree = a.basis.degree
    factors = np.cumprod([1.0, *((b - k) / (k + 1) for k in range(degree + 1))])
    low, high = a.c - a.reach, a.c + a.reach
    ends = np.maximum(np.abs(low) ** (b - degree - 1), np.abs(high) ** (b - degree - 1))
    last = np.where(low > 0.0, abs(factors[-1]) * ends, np.inf)
    return a.compose([factors[k] * a.c ** (b - k) for k in range(degree + 1)], last)


def _sine(a: Taylor, turn: float) -> Taylor:
    """Return sin(a + turn)."""
    series = [np.sin(a.c + turn + 0.5 * np.pi * k) / math.factorial(k) for k in range(a.basis.degree + 1)]
    return a.compose(series, np.full(a.c.shape, 1.0 / math.factorial(a.basis.degree + 1)))


def _exponential(a: Taylor) -> Taylor:
    degree = a.basis.degree
    series = [np.exp(a.c) / math.factorial(k) for k in range(degree + 1)]
    return a.compose(series, np.exp(a.c + a.reach) / math.factorial(degree + 1))


def _logarithm(a: Taylor) -> Taylor:
    degree, low = a.basis.degree, a.c - a.reach
    series = [np.log(a.c), *(-((-1.0 / a.c) ** k) / k for k in range(1, degree + 1))]
    return a.compose(series, np.where(low > 0.0, np.abs(low) ** -(degree + 1.0) / (degree + 1), np.inf))


def _tanh(a: Taylor) -> Taylor:
    """Return tanh(a), its series by t' = 1 - t^2; no coefficient is above tan(1), the largest size in a disk of 1."""
    series = [np.tanh(a.c)]
    for k in range(a.basis.degree):
        squared = sum((series[i] * series[k - i] for i in range(k + 1)), np.zeros_like(a.c))
        series.append((float(k == 0) - squared) / (k + 1))
    return a.compose(series, np.full(a.c.shape, math.tan(1.0)))


def _arctangent(a: Taylor) -> Taylor:
    """Return atan(a), the integral of the series of 1/(1 + a^2); coefficient n is at most 1/n."""
    degree, below = a.basis.degree, 1.0 + a.c**2
    slope = [1.0 / below, -2.0 * a.c / below**2]
    for k in range(2, degree):
        slope.append(-(2.0 * a.c * slope[k - 1] + slope[k - 2]) / below)
    series = [np.arctan(a.c), *(slope[k] / (k + 1) for k in range(degree))]
    return a.compose(series, np.full(a.c.shape, 1.0 / (degree + 1)))


def _absolute(a: Taylor) -> Taylor:
    """Return abs(a) where its sign is certain; else the strip between the chord of abs over the range and its parallel.
    With the range c +- h the chord's slope is c/h, and abs lies between it and it less (h^2 - c^2)/h.
    """
    reach = a.reach
    sure = np.abs(a.c) > reach
    bounded = ~sure & np.isfinite(reach) & (reach > 0.0)
    h = np.where(bounded, reach, 1.0)
    half = np.where(bounded, 0.5 * (h - a.c**2 / h), 0.0)
    slope = np.where(sure, np.sign(a.c), np.where(bounded, a.c / h, 0.0))
    remainder = np.where(sure | bounded, np.abs(slope) * a.r + half, reach)
    return (a * slope + half).with_remainder(remainder)


def _larger(a: Entry, b: Entry) -> Entry:
    return 0.5 * (a + b + _absolute(a - b))  # pyright: ignore[reportArgumentType]


def _sign(a: Taylor) -> Taylor:
    sure = np.abs(a.c) > a.reach
    return make_constant(np.where(sure, np.sign(a.c), 0.0), a.basis).with_remainder(np.where(sure, 0.0, 1.0))


def _compare(a: Entry, b: Entry) -> Entry:
    """Return 1 where a is the smaller for certain, 0 where it is the larger, and between them elsewhere."""
    return 0.5 * (1.0 + _sign(b - a))  # pyright: ignore[reportArgumentType]


BINARY: dict[int, Callable[[Any, Any], Entry]] = {
    ca.OP_ADD: lambda a, b: a + b,
    ca.OP_SUB: lambda a, b: a - b,
    ca.OP_MUL: lambda a, b: a * b,
    ca.OP_DIV: lambda a, b: a * (b.reciprocal() if isinstance(b, Taylor) else 1.0 / b),
    ca.OP_POW: _raise_to_power,
    ca.OP_CONSTPOW: _raise_to_power,
    ca.OP_LT: _compare,
    ca.OP_LE: _compare,
    ca.OP_FMAX: _larger,
    ca.OP_FMIN: lambda a, b: -_larger(-a, -b),
}
UNARY: dict[int, Callable[[Any], Entry]] = {
    ca.OP_ASSIGN: lambda a: a,
    ca.OP_NEG: lambda a: -a,
    ca.OP_TWICE: lambda a: 2.0 * a,
    ca.OP_SQ: lambda a: a * a,
    ca.OP_INV: lambda a: a.reciprocal(),
    ca.OP_FABS: _absolute,
    ca.OP_SIGN: _sign,
    ca.OP_SIN: lambda a: _sine(a, 0.0),
    ca.OP_COS: lambda a: _sine(a, 0.5 * np.pi),
    ca.OP_TANH: _tanh,
    ca.OP_EXP: _exponential,
    ca.OP_LOG: _logarithm,
    ca.OP_SQRT: lambda a: _raise_to_power(a, 0.5),
    ca.OP_ATAN: _arctangent,
}


def assemble_matrix(entries: Sequence[Entry], rows: int, count: int, over: Basis) -> Taylor:
    """Return a matrix, shape (count, rows, columns), of entries column by column."""
    columns = len(entries) // rows
    models = [
        entry if isinstance(entry, Taylor) else make_constant(np.full(count, float(entry)), over) for entry in entries
    ]
    flat, shape = stack_models(models), (count, columns, rows)
    return Taylor(over, np.swapaxes(flat.a.reshape(-1, *shape), -1, -2), np.swapaxes(flat.r.reshape(shape), -1, -2))


def count_halvings(norm: Float[np.ndarray, " b"], reach: float) -> int:
    """Return how many halvings bring every finite norm within `reach`."""
    largest = float(np.max(norm, initial=0.0, where=np.isfinite(norm)))
    return max(0, math.ceil(math.log2(largest / reach))) if largest > 0.0 else 0
