"""What a predictive controller remembers from sample to sample, and what one of its steps returns."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from seaopt.control.laws.controller import ClosesLoops
from seaopt.control.laws.plausibility import GateState, is_number
from seaopt.control.loops.compensation.terms import FORGOTTEN, Compensation, Memory
from seaopt.control.loops.transfer_function import TransferFunction
from seaopt.control.mpc.estimator import EstimatorState
from seaopt.errors import ControlError
from seaopt.plants import Plant
from seaopt.plants.memo import memo
from seaopt.plants.motor.heat_guard import COLD
from seaopt.records import record

Added = tuple[float, float, Memory, tuple[float, ...]]


@record(eq=False)
class MPCState:
    """The controller's state from sample to sample.

    Parameters
    ----------
    kalman : EstimatorState
    command : float
        The last command.
    plan : array, shape (n,)
        The currents planned at the knots, A.
    sides : array of int, shape (m,)
        Where the last program held its rows, as in `active_set.QPSolution`; the next starts there.
    age : int
        Samples since a program was solved: so old is the plan. Of one that never was: the horizon.
    gate : GateState
        What the plausibility gate, where there is one, has seen; its `status` is "ok", "held" or "fault".
    heat : (float, float)
        Winding and case above the ambient, K, as the heat guard, where there is one, estimates them.
    shaped : tuple of float
        What the prefilter, where there is one, keeps.
    terms : (float, float, (float, float), tuple of float)
        What a compensation and a link's feedforward, where there are any, added to the reference and as effort, and
        what each remembers; of the link nothing before the first reading.
    """

    kalman: EstimatorState
    command: float
    plan: Float[np.ndarray, " n"]
    sides: Int[np.ndarray, " m"]
    age: int
    gate: GateState = GateState()
    heat: tuple[float, float] = COLD
    shaped: tuple[float, ...] = ()
    terms: Added = (0.0, 0.0, FORGOTTEN, ())


@record(eq=False)
class MPCStep:
    """One sample's result.

    Parameters
    ----------
    command : float
        The command, within limits.
    state : MPCState
        For the next step.
    solved : bool
        False: there is no plan that keeps the limits, and the current is that of the last one, or the safe one.
    status : str
        The solver's ("maximum iterations reached" with `solved`: the plan keeps the limits, and may not be the best),
        or what was wrong with its solution.
    force_N : float
        Estimate of the measured force, with this sample.
    target_N : float
        The last reference known, or the nearest force that the limits can hold.
    slack : float
        By how much the plan breaks the bounds of outputs, in units of half their width; the largest.
    iterations : int
        Rows that the solver took in or let go.
    step_time_s : float
        The whole step's, in Python.
    """

    command: float
    state: MPCState
    solved: bool
    status: str
    force_N: float
    target_N: float
    slack: float
    iterations: int
    step_time_s: float


class ReadsLink(ClosesLoops):
    """What predictive control reads besides the force: what its terms do, and the link where that is fed forward."""

    __slots__ = ()
    measured: Any
    compensation: Any
    link: Any
    memory: Any

    @property
    def signals(self) -> tuple[str, ...]:
        """The outputs that its law reads, the regulated one first."""
        return (self.measured,) if self.link is None else (self.measured, self.link.measured)

    @property
    def further(self) -> tuple[str, ...]:
        """The outputs that its terms read besides."""
        return () if self.compensation is None else self.compensation.reads

    @property
    def reads(self) -> tuple[str, ...]:
        """What a step reads besides the force."""
        return tuple(dict.fromkeys((*self.further, *self.signals[1:])))

    @property
    @memo
    def link_filter(self) -> tuple[TransferFunction, int] | None:
        """What feeds the link back, and which reading that is; None where it is not."""
        link = self.link
        return None if link is None else (link.feedback(self.sample_time_s), self.reads.index(link.measured))

    def see(self, plant: Plant) -> Plant:
        """Return a plant with every signal that is read."""
        return plant if self.link is None else self.link.see(plant)


def add_terms(
    terms: Compensation | None,
    link: tuple[TransferFunction, int] | None,
    last: Added,
    references: Float[np.ndarray, " p"],
    readings: Sequence[float],
) -> Added:
    """Return what terms add in a sample, and remember; as in the last one where a reading is no number. `link`: what
    feeds a link back, and which reading that is; it begins at rest at the first.
    """
    if not all(map(is_number, readings)):
        return last
    weight, effort, memory, kept = 0.0, 0.0, FORGOTTEN, last[3]
    if terms is not None:
        reference = float(references[0])
        shaped, effort, memory = terms.step(last[2], reference, readings[: len(terms.reads)])
        weight = shaped - reference
    if link is not None:
        path, at = link
        kept = kept or rest_filter(path, readings[at])
        fed, kept = shape_references(path, kept, np.array([readings[at]]))
        effort -= float(fed[0])
    return weight, effort, memory, kept


def rest_filter(path: TransferFunction, value: float) -> tuple[float, ...]:
    """Return what a filter keeps at rest at a value (transposed form)."""
    still = path.num - path.den * find_rest_gain(path)
    return tuple((value * np.cumsum(still[:0:-1])[::-1]).tolist())


def find_rest_gain(path: TransferFunction) -> float:
    """Return a filter's gain at rest."""
    return float(np.sum(path.num) / np.sum(path.den))


def shape_references(
    low_pass: TransferFunction, kept: tuple[float, ...], references: Float[np.ndarray, " r"]
) -> tuple[Float[np.ndarray, " r"], tuple[float, ...]]:
    """Return references that are known ahead behind a filter, and what that keeps after the first (transposed form)."""
    (first, *num), (_, *den) = low_pass.num.tolist(), low_pass.den.tolist()
    shaped, states = np.empty(references.size), [kept]
    for k, reference in enumerate(references.tolist()):
        state = states[-1]
        shaped[k] = out = first * reference + state[0]
        states.append(tuple(b * reference - a * out + s for b, a, s in zip(num, den, (*state[1:], 0.0), strict=True)))
    return shaped, states[1]


def read_references(given: float | Float[np.ndarray, " r"], preview_samples: int) -> Float[np.ndarray, " p"]:
    """Return the references of this sample and of all that may be known, the last held. Raises ControlError: they are
    more than that, or one is not finite.
    """
    references, count = np.atleast_1d(np.asarray(given, dtype=float)), 1 + preview_samples
    if not (references.ndim == 1 and 1 <= references.size <= count):
        raise ControlError(
            f"reference_N has the shape {references.shape}, and preview_samples = {preview_samples} takes up to "
            f"{count}; give preview_samples = {references.size - 1} in the specification"
        )
    if not all(map(is_number, references)):
        raise ControlError(f"reference_N = {given}: not a force; hold the last one instead")
    return np.concatenate([references, np.full(count - references.size, references[-1])])
