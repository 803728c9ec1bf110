"""One pass over a log segment: outputs, sensitivities and the Gram matrices of the weighted residuals.

The same pass runs in two ways with the same numbers: compiled (`seaopt.simulation.compiled`), which accumulates in
O(1) memory, and without a compiler (`seaopt.simulation.interpreted`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8

from seaopt.errors import SimulationError
from seaopt.simulation.discretisation import Clock

MAX_SECTIONS = 8  # as in pass.c


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Weights:
    """What happens to a residual before it is squared, the same for every sample.

    Parameters
    ----------
    sections : array, shape (m, 5)
        Second-order sections b0 b1 b2 a1 a2 of the band filter (a0 = 1); m = 0 for none.
    settle : int
        Samples left out while the filter settles.
    knee : array, shape (ny,)
        Huber's threshold on the filtered residual, in the output's unit; infinite for least squares.

    """

    sections: Float[np.ndarray, "m 5"]
    settle: int
    knee: Float[np.ndarray, " ny"]

    def __post_init__(self) -> None:
        if len(self.sections) > MAX_SECTIONS:
            raise SimulationError(f"{len(self.sections)} filter sections; pass.c has room for {MAX_SECTIONS}")

    @classmethod
    def plain(cls, ny: int) -> Weights:
        """Return weights that change nothing."""
        return cls(sections=np.zeros((0, 5)), settle=0, knee=np.full(ny, np.inf))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Segment:
    """A gap-free stretch of a log in the order of a model's inputs and outputs.

    Parameters
    ----------
    u : array, shape (n, nu)
        Input samples; finite.
    y : array, shape (n, ny), or None
        Measured outputs; NaN where missing. None: simulate only.
    keep : array, shape (n, ny), or None
        0 where a sample gets no weight.
    start_s : float
        Time of the first sample, for plants that depend on time.

    """

    u: Float[np.ndarray, "n nu"]
    y: Float[np.ndarray, "n ny"] | None = None
    keep: UInt8[np.ndarray, "n ny"] | None = None
    start_s: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Point:
    """Where a pass is made: the unknowns of one segment.

    Parameters
    ----------
    theta : array, shape (np,)
        The model's free parameters.
    x0 : array, shape (nx,)
        State at the first sample.
    offset, gain : array, shape (ny,)
        measured = gain * output + offset.
    clock : Clock
        Period, hold and delay.
    substeps : int
        Runge-Kutta steps a period (a linear model needs none).

    """

    theta: Float[np.ndarray, " np"]
    x0: Float[np.ndarray, " nx"]
    offset: Float[np.ndarray, " ny"]
    gain: Float[np.ndarray, " ny"]
    clock: Clock
    substeps: int = 1


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Pass:
    """What one pass found.

    Parameters
    ----------
    gram : array, shape (ny, nc, nc)
        Sums over samples of v v' with v = [residual, d/dtheta, (d/ddelay), d/dx0, d/doffset, d/dgain].
    loss : array, shape (ny,)
        Sums of the losses: half squares, or Huber's.
    count : array, shape (ny,)
        Samples that counted.
    outputs : array, shape (n, ny), or None
        Model outputs, without gain and offset.
    columns : array, shape (n, ny, nc), or None
        The v of every sample.
    states : array, shape (n, nx), or None
        State trajectory.
    last : array, shape (nx,)
        State one step after the last sample.

    """

    gram: Float[np.ndarray, "ny nc nc"]
    loss: Float[np.ndarray, " ny"]
    count: Float[np.ndarray, " ny"]
    outputs: Float[np.ndarray, "n ny"] | None
    columns: Float[np.ndarray, "n ny nc"] | None
    states: Float[np.ndarray, "n nx"] | None
    last: Float[np.ndarray, " nx"]
