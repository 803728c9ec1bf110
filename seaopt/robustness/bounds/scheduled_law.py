r"""A scheduled law on a stretch between two of its points, enclosed as the plant is, for the bounds.

Between two points every number of the law is a line over the variable s, and the law is the step that runs
(`seaopt.control.scheduling.step_order`), linear in what it keeps and reads: with what its terms and its outer loop feed
back (`seaopt.control.running.fed_back`) it has matrices A(s), B(s), c(s), d(s). With :math:`w = z - 1` it gains

.. math:: \frac{c\,\mathrm{adj}(wI - (A - I))\,B}{\det(wI - (A - I))} + d

from every signal that it reads, whose polynomials are enclosed by Leverrier's and Faddeev's method as those of the
plant are (`seaopt.robustness.bounds.impulse`), over the same boxes: where s is the plant's own variable, law and plant
change together.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np

from seaopt.control import Controller, GainTable
from seaopt.control.loops.drift import FORGOTTEN
from seaopt.control.loops.moved_link import find_position, keep_share
from seaopt.control.running.fed_back import AGAINST, TURNED, WEIGHT, close_terms
from seaopt.control.scheduling.step_order import SHARE
from seaopt.errors import ControlError
from seaopt.plants import Plant
from seaopt.records import record
from seaopt.robustness.bounds.enclosure import assemble_matrix, enclose
from seaopt.robustness.bounds.impulse import ImpulseTransfer, expand_polynomials
from seaopt.robustness.bounds.taylor import Taylor, make_constant


@record(eq=False)
class ScheduledLaw:
    """The law of a table from `low` to `high`, between which it has no point, around a plant of `split_states`."""

    table: GainTable
    low: float
    high: float
    middle: Controller  # the force law between the two, with terms and outer loop
    plant: Plant
    coordinate: str  # the parameter or state of the plant that is the table's variable
    matrices: Any  # A, B, c and d as a CasADi function of it; of an observer, the command is read last
    blocks: tuple[tuple[int, ...], ...]  # of states that move each other, in the order in which they move the next ones

    @classmethod
    def of(
        cls, table: GainTable, low: float, high: float, middle: Controller, plant: Plant, coordinate: str
    ) -> ScheduledLaw:
        """Return the law of a stretch with its matrices. Raises ControlError: a point of the table lies in it."""
        if np.any((table.points > low) & (table.points < high)):
            raise ControlError(f"a stretch from {low:g} to {high:g} has a point of the table in it; end it there")
        matrices, blocks = _write_matrices(table, low, high, middle, plant)
        return cls(
            table=table,
            low=low,
            high=high,
            middle=middle,
            plant=plant,
            coordinate=coordinate,
            matrices=matrices,
            blocks=blocks,
        )

    def at(self, value: float) -> Controller:
        """Return the controller at a value, with what it feeds back."""
        return close_terms(replace(self.middle, law=self.table.law(value)), self.plant)

    def extend(self, sampled: ImpulseTransfer, value: Taylor) -> ImpulseTransfer:
        """Return a sampled plant with the law in front of it, over boxes in which the variable has these values."""
        count, over = value.c.shape[0], value.basis
        sizes = [(self.matrices.size1_out(k), self.matrices.size2_out(k)) for k in range(4)]
        a, b, c, d = (
            assemble_matrix(block, rows, count, over)
            for block, (rows, _) in zip(enclose(self.matrices, [[value]]), sizes, strict=True)
        )
        denominator, numerators = _expand_law(a + (-np.eye(sizes[0][0])), b, c, self.blocks)
        heads, tails = list[Taylor](), list[Taylor]()
        for k in range(len(sampled.heads)):
            gain = -(numerators[k] + denominator * d[:, 0, k : k + 1])
            heads.append(multiply_polynomials(gain, sampled.heads[k]))
            tails.append(multiply_polynomials(gain, sampled.tails[k]))
        if len(numerators) > len(heads):  # an observer's loop around the command is closed here
            denominator = denominator - numerators[-1]
        return ImpulseTransfer(
            heads=tuple(heads),
            tails=tuple(tails),
            denominator=multiply_polynomials(denominator, sampled.denominator),
            whole=sampled.whole,
        )


def _write_matrices(
    table: GainTable, low: float, high: float, middle: Controller, plant: Plant
) -> tuple[Any, tuple[tuple[int, ...], ...]]:
    """Return A, B, c and d as a function of the variable, of the states that what is read moves and that move the
    effort, and the blocks of these. An observer reads the command.
    """
    value = ca.SX.sym("value")
    first, last, share = table.find_numbers(low), table.find_numbers(high), (value - low) / (high - low)
    numbers: dict[str, Any] = {SHARE: 0.0}
    for name, start in first.items():
        numbers[name] = start if start == last[name] else start + share * (last[name] - start)
    reads = {name: ca.SX.sym(name) for name in close_terms(middle, plant).signals}
    states: dict[str, Any] = {name: ca.SX.sym(name) for name in table.states}
    kept = dict(states)
    after, reference, outer = dict[str, Any](), ca.SX(0.0), middle.outer
    position = None if outer is None else find_position(plant, outer)
    if outer is not None and position is not None:
        stiffness, damping, pole, rate = outer.numbers
        kept["outer"], link = ca.SX.sym("outer"), reads[position]
        speed = kept["outer"] + rate * link
        reference = -stiffness * link - damping * speed
        after["outer"] = pole * speed - keep_share(position) * rate * link
    reference = reference + reads.get(WEIGHT, 0.0)
    force = [reads[name] for name in middle.signals]
    command = ca.SX.sym("command") if table.nominals else None
    effort, _, moved = table.order.step(
        numbers, states, reference, force, lambda effort: effort if command is None else command
    )
    if AGAINST in reads:
        kept["against"] = ca.SX.sym("against")
        effort = effort + reads[AGAINST] - (np.exp(-FORGOTTEN) if TURNED in plant.states else 1.0) * kept["against"]
        after["against"] = reads[AGAINST]
    inputs = [*reads.values(), *([] if command is None else [command])]
    x, y, step = (ca.vertcat(*parts) for parts in (kept.values(), inputs, ((moved | after)[name] for name in kept)))
    a, b, c, d = (ca.jacobian(of, by) for of in (step, effort) for by in (x, y))
    used = _find_used(*(np.array(ca.DM(matrix.sparsity(), 1.0)) != 0.0 for matrix in (a, b, c)))
    parts = a[used, used], b[used, :], c[:, used], d
    return ca.Function("law", [value], [ca.densify(part) for part in parts]), _list_blocks(parts[0])


def _find_used(a: Any, b: Any, c: Any) -> list[int]:
    """Return the states that what is read moves, at once or through others, and that move the effort."""
    moved, moving = np.any(b, axis=1), np.any(c, axis=0)
    for _ in range(a.shape[0]):
        moved, moving = moved | (a @ moved), moving | (moving @ a)
    return [int(k) for k in np.flatnonzero(moved & moving)]


def _list_blocks(a: Any) -> tuple[tuple[int, ...], ...]:
    """Return the states that move each other, each after those that move it. A law is a graph of small parts."""
    moves = np.array(ca.DM(a.sparsity(), 1.0)) != 0.0
    reached = np.eye(moves.shape[0], dtype=bool) | moves
    for _ in range(moves.shape[0]):
        reached = reached | (reached @ reached)
    together = reached & reached.T
    blocks = {tuple(int(k) for k in np.flatnonzero(row)) for row in together}
    return tuple(sorted(blocks, key=lambda block: (int(np.sum(reached[block[0]])), block)))


def _expand_law(f: Taylor, b: Taylor, c: Taylor, blocks: Sequence[tuple[int, ...]]) -> tuple[Taylor, list[Taylor]]:
    """Return det(wI - f) and c adj(wI - f) b of every column, ascending in w, block by block: a block's states are its
    adjugate times what moves it, over the determinants of all blocks before it and its own.
    """
    columns, count, over = b.c.shape[2], f.c.shape[0], f.basis
    whole = make_constant(np.ones((count, 1)), over)
    states: dict[int, list[Taylor]] = {}  # over `whole`, for each column
    for block in blocks:
        adjugate, determinant = _expand_block(f, block)
        moved = [
            [
                add_polynomials([whole * b[:, i, k : k + 1], *(states[j][k] * f[:, i, j : j + 1] for j in states)])
                for k in range(columns)
            ]
            for i in block
        ]
        states = {j: [multiply_polynomials(each, determinant) for each in state] for j, state in states.items()}
        for row, i in enumerate(block):
            parts = adjugate[row]
            states[i] = [
                add_polynomials([multiply_polynomials(parts[j], moved[j][k]) for j in range(len(block))])
                for k in range(columns)
            ]
        whole = multiply_polynomials(whole, determinant)
    size = whole.c.shape[1]
    nothing = make_constant(np.zeros((count, size)), over)
    return whole, [
        add_polynomials([nothing, *(states[j][k] * c[:, 0, j : j + 1] for j in states)]) for k in range(columns)
    ]


def _expand_block(f: Taylor, block: tuple[int, ...]) -> tuple[list[list[Taylor]], Taylor]:
    """Return adj(wI - f) of a block of states, entry by entry, and det(wI - f)."""
    part, size = f[:, block, :][:, :, block], len(block)
    unit = np.broadcast_to(np.eye(size), part.c.shape).copy()
    rows = [make_constant(unit, f.basis)[:, i : i + 1, :] for i in range(size)]
    drives = [make_constant(unit, f.basis)[:, :, j : j + 1] for j in range(size)]
    expanded = [expand_polynomials(part, row, drives) for row in rows]
    return [[entry[:, :-1] for entry in entries] for _, entries in expanded], expanded[0][0]


def add_polynomials(parts: Sequence[Taylor]) -> Taylor:
    """Return the sum of polynomials whose coefficients, ascending along the last axis, are models."""
    size = max(part.c.shape[1] for part in parts)
    out = make_constant(np.zeros((parts[0].c.shape[0], size)), parts[0].basis)
    for part in parts:
        out.a[:, :, : part.c.shape[1]] += part.a
        out.r[:, : part.c.shape[1]] += part.r
    return out


def multiply_polynomials(left: Taylor, right: Taylor) -> Taylor:
    """Return the product of polynomials whose coefficients, ascending along the last axis, are models."""
    count, size = left.c.shape[0], left.c.shape[1] + right.c.shape[1] - 1
    out = make_constant(np.zeros((count, size)), left.basis)
    for k in range(left.c.shape[1]):
        part, at = left[:, k : k + 1] * right, slice(k, k + right.c.shape[1])
        out.a[:, :, at] += part.a
        out.r[:, at] += part.r
    return out
