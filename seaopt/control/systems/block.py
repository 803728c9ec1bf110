r"""Sampled linear systems with named signals, and their connection.

A `Block` is :math:`x^+ = A x + B u,\ y = C x + D u`, or a stack of such systems that share their names, over leading
axes. `connect` joins blocks by name: a signal is the sum of all outputs of that name and of what is put in from outside
under it. With the blocks side by side, :math:`u = M y + L w` of zeros and ones, and an output :math:`z = E y + F w`,

.. math::
    y = (I - D M)^{-1} (C x + D L w), \qquad x^+ = A x + B (M y + L w) .

This is where every loop is closed. Where no signal comes back to itself within a sample, the inverse is
:math:`I + D M + (D M)^2 + \dots`, which ends: what does not feed a state is zero there to the last bit, so that a law
keeps the integrators that it has set apart (`seaopt.control.loops.law`). What stands in series with them, and leaves
them apart, is put together by `seaopt.control.laws.assembly`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache

import numpy as np
from jaxtyping import Float

from seaopt.records import record

Names = tuple[str, ...]
Matrix = Float[np.ndarray, "... _ _"]

REFERENCE, EFFORT, COMMAND = "reference", "effort", "command"
LATE = "late command"  # as it reaches the plant
OUTSIDE = "outside"  # what comes in place of a signal that a law takes, or beside them


@record(eq=False)
class Block:
    """x+ = a x + b u, y = c x + d u with named signals; leading axes are those of a stack."""

    a: Matrix
    b: Matrix
    c: Matrix
    d: Matrix
    inputs: Names
    outputs: Names


def add_up(output: str, gains: Mapping[str, float]) -> Block:
    """Return a signal that is a sum of others, each times a gain."""
    d = np.array([list(gains.values())])
    a, b, c = np.zeros((0, 0)), np.zeros((0, d.size)), np.zeros((1, 0))
    return Block(a=a, b=b, c=c, d=d, inputs=tuple(gains), outputs=(output,))


def subtract_last(read: str, output: str, kept: float = 1.0, gain: float = 1.0) -> Block:
    """Return a signal less a share of what it was a sample before, times a gain."""
    unit = np.ones((1, 1))
    return Block(a=0.0 * unit, b=unit, c=-kept * gain * unit, d=gain * unit, inputs=(read,), outputs=(output,))


@cache
def name_readings(count: int) -> Names:
    """Return the names of so many measured signals, the regulated one first."""
    return tuple(f"reading {number}" for number in range(1, count + 1))


def make_plant(
    a: Float[np.ndarray, "... n n"],
    b: Float[np.ndarray, "... n"],
    c: Float[np.ndarray, "... y n"],
    d: Float[np.ndarray, "... y"],
    delay_samples: int = 0,
) -> Block:
    """Return a sampled plant, or a stack of them, from the command so many samples later to every reading. Commands on
    their way are states behind the plant's, the newest first.
    """
    late = LATE if delay_samples else COMMAND
    readings = name_readings(c.shape[-2])
    plant = Block(a=a, b=b[..., None], c=c, d=d[..., None], inputs=(late,), outputs=readings)
    return connect([plant, make_delay(delay_samples)], [COMMAND], readings) if delay_samples else plant


def make_delay(samples: int) -> Block:
    """Return the command some samples later."""
    return Block(
        a=np.eye(samples, k=-1),
        b=np.eye(samples, 1),
        c=np.eye(1, samples, k=samples - 1),
        d=np.full((1, 1), 0.0 if samples else 1.0),
        inputs=(COMMAND,),
        outputs=(LATE,),
    )


def connect(blocks: Sequence[Block], inputs: Sequence[str], outputs: Sequence[str]) -> Block:
    """Return blocks joined by the names of their signals, as a block from some of these to some; its states are theirs
    in order.
    """
    into, fed, read, direct = _route(
        tuple(block.inputs for block in blocks), tuple(block.outputs for block in blocks), tuple(inputs), tuple(outputs)
    )
    a, b, c, d = (_put_side_by_side([getattr(block, name) for block in blocks]) for name in "abcd")
    states = a.shape[-1]
    driven = d @ fed
    of_all = np.concatenate([c, driven], axis=-1)
    signals = _pass_on(d @ into, of_all, len(blocks))  # y of the states and of w
    taken = into @ signals
    taken[..., states:] += fed
    shown = read @ signals
    shown[..., states:] += direct
    moved = b @ taken
    return Block(
        a=a + moved[..., :states],
        b=moved[..., states:],
        c=shown[..., :states],
        d=shown[..., states:],
        inputs=tuple(inputs),
        outputs=tuple(outputs),
    )


def _pass_on(through: Matrix, of_all: Matrix, most: int) -> Matrix:
    """Return (I - through)^-1 of what is put into every signal: without a loop the sum of at most so many powers."""
    signals = passed = of_all
    for _ in range(most):
        passed = through @ passed
        if not np.any(passed):
            return signals
        signals = signals + passed
    return np.linalg.solve(np.eye(through.shape[-1]) - through, of_all)


@cache
def _route(
    taken: tuple[Names, ...], given: tuple[Names, ...], inputs: Names, outputs: Names
) -> tuple[Float[np.ndarray, "u y"], Float[np.ndarray, "u w"], Float[np.ndarray, "z y"], Float[np.ndarray, "z w"]]:
    """Return M, L, E and F of the module's docstring."""
    all_taken, all_given = (tuple(name for names in each for name in names) for each in (taken, given))

    def match(rows: Names, columns: Names) -> Float[np.ndarray, "r c"]:
        return np.array([[float(row == column) for column in columns] for row in rows]).reshape(len(rows), len(columns))

    return match(all_taken, all_given), match(all_taken, inputs), match(outputs, all_given), match(outputs, inputs)


def _put_side_by_side(parts: Sequence[Matrix]) -> Matrix:
    """Return matrices, or stacks of them, down the diagonal of one."""
    stack = max((part.shape[:-2] for part in parts), key=len)
    out = np.zeros((*stack, sum(part.shape[-2] for part in parts), sum(part.shape[-1] for part in parts)))
    row = column = 0
    for part in parts:
        height, width = part.shape[-2:]
        out[..., row : row + height, column : column + width] = part
        row, column = row + height, column + width
    return out
