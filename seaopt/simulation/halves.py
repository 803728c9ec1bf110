r"""A pass over a long log of a nonlinear plant as two halves that run at once.

The second half has to know the state :math:`x_s` in which it begins. Damping makes a plant forget the state it came
from: so the state alone, without derivatives, goes from the log's first state through a *run-up* before sample
:math:`s`, and what it comes to is compared with where the first half ends. Derivatives are exact whatever the run-up:
those of the second half begin anew, with :math:`\partial x_s/\partial x_s = 1`, and with the first half's
:math:`S = \partial x_s/\partial[\theta, x_0]` the chain rule gives those of the whole,

.. math:: \frac{\partial r}{\partial \theta} \leftarrow \frac{\partial r}{\partial \theta}
          + \frac{\partial r}{\partial x_s} S_\theta, \qquad
          \frac{\partial r}{\partial x_0} = \frac{\partial r}{\partial x_s} S_{x_0},

a product :math:`v' T` of the columns, and :math:`T' G T` of their Gram matrices. How long a state is remembered is told
by :math:`\partial x_n/\partial x_0` of a pass that ran as one.
"""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float

from seaopt.signals import MatrixNN, VectorX
from seaopt.simulation.passes import Layout

FORGOTTEN = 1e-15  # of a state, after the run-up
TOLERANCE = 1e-12  # of the residuals, by which the state in which the second half begins may move them
MOST = 6  # runs-up that a log holds at least: a sixth more work is the price of two halves
TINY = 1e-300  # of a sensitivity: smaller ones are taken as zero


def find_run_up(sensitivity: MatrixNN, samples: int) -> int:
    """Return after how many samples a state is forgotten, from its sensitivity to the one so many samples before; 0 if
    that is too long for halves.
    """
    if not np.all(np.isfinite(sensitivity)):
        return 0
    decay = max(float(np.max(np.abs(np.linalg.eigvals(sensitivity)), initial=0.0)), TINY)
    run_up = math.ceil(samples * math.log(FORGOTTEN) / math.log(decay)) if decay < 1.0 else samples
    return run_up if MOST * run_up <= samples else 0


def join_columns(z: Float[np.ndarray, "nx nj"], layout: Layout) -> MatrixNN:
    """Return T from the state and its derivatives at the end of the first half."""
    first, nx = 1 + layout.shared, layout.nx
    matrix = np.eye(layout.columns)
    matrix[first : first + nx, 1 : first + nx] = z[:, 1 : first + nx]
    return matrix


def moves_little(miss: VectorX, grams: Float[np.ndarray, "ny nc nc"], layout: Layout) -> bool:
    """Tell whether a state that is so much off moves no output's residuals by more than they tell."""
    at = np.arange(1 + layout.shared, 1 + layout.shared + layout.nx)
    moved = np.sqrt(grams[:, at, at]) @ np.abs(miss)
    return bool(np.all(moved <= TOLERANCE * np.sqrt(grams[:, 0, 0])))
