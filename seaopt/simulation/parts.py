r"""A pass over a log of a nonlinear plant as parts that run at once.

A step waits for one chain of operations, in which a processor could do several times as many: a thread steps four parts
side by side in the time of one, and several threads may have four each. A part has to know the state :math:`x_s` in
which it begins. Damping makes a plant forget the state it came from: so the state alone, without derivatives, goes from
the log's first state through a *run-up* before sample :math:`s`, and what it comes to is compared with where the part
before ends. Derivatives are exact whatever the run-up: those of a part begin anew, with
:math:`\partial x_s/\partial x_s = 1`, and with :math:`S = \partial x_s/\partial[\theta, x_0]`, which follows from the
parts before, the chain rule gives those of the whole,

.. math:: \frac{\partial r}{\partial \theta} \leftarrow \frac{\partial r}{\partial \theta}
          + \frac{\partial r}{\partial x_s} S_\theta, \qquad
          \frac{\partial r}{\partial x_0} = \frac{\partial r}{\partial x_s} S_{x_0},

a product :math:`v' T` of the columns, and :math:`T' G T` of their Gram matrices. How long a state is remembered is told
by the parts' :math:`\partial x_n/\partial x_s`, also of a pass whose run-up was too short.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from seaopt.signals import VectorX
from seaopt.simulation.passes import Layout

LANES = 4  # parts that a thread steps side by side, as in lanes.h
PARALLEL = 20_000  # samples below which a second thread does not pay, and what plants remember leaves no room for parts
SHARE = 0.5  # of a part that its run-up takes at most
FORGOTTEN = 1e-15  # of a state, after the run-up
TOLERANCE = 1e-12  # of the residuals, by which the state in which a part begins may move them
TINY = 1e-300  # of a sensitivity: smaller ones are taken as zero


def count_parts(samples: int, run_up: int = 0) -> int:
    """Return into how many parts a log is cut: a power of two, as many as run-ups leave room for."""
    parts = 2 * LANES if samples >= PARALLEL else 1
    while parts > 1 and parts * run_up > SHARE * samples:
        parts //= 2
    return parts


def guess_run_up(samples: int) -> int:
    """Return a first run-up: the longest for which there is room. One that is too short costs the pass."""
    return int(SHARE * samples) // count_parts(samples)


def find_run_up(sensitivities: Float[np.ndarray, "parts nx nx"], samples: int, *, least: int = 0) -> int:
    """Return after how many samples a state is forgotten, from the sensitivity of the state at the end of parts to that
    at their start; 0 if that, or `least`, is too long for parts.
    """
    if not np.all(np.isfinite(sensitivities)):
        return 0
    length = samples // len(sensitivities)
    decays = np.maximum(np.max(np.abs(np.linalg.eigvals(sensitivities)), axis=1, initial=0.0), TINY)
    decay = float(np.max(decays))
    run_up = math.ceil(length * math.log(FORGOTTEN) / math.log(decay)) if decay < 1.0 else samples
    run_up = max(run_up, least)
    return run_up if count_parts(samples, run_up) > 1 else 0


@np.errstate(all="ignore")  # of a plant that overflows
def join_parts(reached: Sequence[Float[np.ndarray, "nx nj"]], layout: Layout) -> Float[np.ndarray, "parts nc nc"]:
    """Return T of every part, from the states and their derivatives at the ends of all."""
    first, nx = 1 + layout.shared, layout.nx
    joins = np.array([np.eye(layout.columns)] * len(reached))
    for z, before, after in zip(reached, joins, joins[1:], strict=False):
        by_all = z[:, first : first + nx] @ before[layout.start, 1 : first + nx]
        by_all[:, : layout.shared] += z[:, 1:first]
        after[layout.start, 1 : first + nx] = by_all
    return joins


def moves_little(start: VectorX, end: VectorX, grams: Float[np.ndarray, "ny nc nc"], layout: Layout) -> bool:
    """Tell whether a part may begin in a state in place of that in which the part before it ends: it moves no output's
    residuals by more than they tell, and is the same where an output was not measured, which tells nothing.
    """
    at, miss = np.arange(layout.start.start, layout.start.stop), np.abs(start - end)
    moved, power = np.sqrt(grams[:, at, at]) @ miss, grams[:, 0, 0]
    same = bool(np.all(miss <= TOLERANCE * np.abs(end)))
    return bool(np.all((moved <= TOLERANCE * np.sqrt(power)) & ((power > 0.0) | same)))
