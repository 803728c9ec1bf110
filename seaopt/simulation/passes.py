"""What a pass over a segment of a log needs and finds: outputs, sensitivities, Gram matrices of weighted residuals.

The same pass runs in two ways with the same numbers: compiled (`seaopt.simulation.compiled`), which accumulates in
O(1) memory, and without a compiler (`seaopt.simulation.interpreted`).
"""

from __future__ import annotations

from dataclasses import field
from typing import Literal

import numpy as np
from jaxtyping import Float, Int, UInt8

from seaopt.errors import SimulationError
from seaopt.records import record
from seaopt.signals import VectorM, VectorN
from seaopt.simulation.discretisation import Clock

MAX_SECTIONS = 8  # as in layout.h
SLACK = 1e-9  # of a step: rounding of a share
RobustLoss = Literal["square", "huber", "soft_l1"]
Influence = Float[np.ndarray, "ny p nc"]  # of the column v of an output on p estimates
DoubleSum = Float[np.ndarray, "forms p p"]  # over all t and s, and where asked for over t = s
Lagged = Float[np.ndarray, "lags1 ny ny"]  # R(k) of outputs, a lag each


@record(eq=False)
class Weights:
    """What happens to a residual before it is summed, the same for every sample.

    Parameters
    ----------
    sections : array, shape (m, 5)
        Second-order sections b0 b1 b2 a1 a2 of the band filter (a0 = 1); m = 0 for none.
    settle : int
        Samples left out while the filter settles.
    loss : {"square", "huber", "soft_l1"}
        Of the filtered residual r: r^2 / 2; the same up to the knee and straight beyond; or the smooth
        knee^2 (sqrt(1 + (r / knee)^2) - 1).
    knee : array, shape (ny,)
        Where a robust loss leaves the square, in the output's unit.
    """

    sections: Float[np.ndarray, "m 5"]
    settle: int
    knee: Float[np.ndarray, " ny"]
    loss: RobustLoss = "square"

    def __post_init__(self) -> None:
        if len(self.sections) > MAX_SECTIONS:
            raise SimulationError(f"{len(self.sections)} filter sections; a pass has room for {MAX_SECTIONS}")

    @classmethod
    def plain(cls, ny: int) -> Weights:
        """Return weights that change nothing."""
        return cls(sections=np.zeros((0, 5)), settle=0, knee=np.full(ny, np.inf))


@record(eq=False)
class Segment:
    """A gap-free part of a log: one array per channel, in the order of a model's inputs and outputs.

    Parameters
    ----------
    u : tuple of arrays, shape (lead + n,)
        Input samples; finite.
    y : tuple of arrays, shape (n,)
        Measured outputs, NaN where missing. Empty: simulate only.
    keep : tuple of arrays, shape (n,)
        One per output, 0 where a sample gets no weight. Empty: all are kept.
    lead : int
        How many of the input samples go before the first sample: what a delay reaches back to.
    start_s : float
        Time of the first sample, for plants that depend on time.
    drift_span : (float, float)
        Drift's coordinate, which runs from -1 to 1 over the whole log, at the first sample, and its step.
    shares : array, shape (2, n), optional
        Parts of a point's `substeps` and of its `stable` steps: each sample takes the larger number. All if left out.
    """

    u: tuple[VectorM, ...]
    y: tuple[VectorN, ...] = ()
    keep: tuple[UInt8[np.ndarray, " n"], ...] = ()
    lead: int = 0
    start_s: float = 0.0
    drift_span: tuple[float, float] = (0.0, 0.0)
    shares: Float[np.ndarray, "2 n"] | None = None

    @property
    def n(self) -> int:
        """Number of samples."""
        return self.u[0].size - self.lead

    @property
    def inputs(self) -> tuple[VectorN, ...]:
        """Input samples at the samples of the outputs."""
        return tuple(channel[self.lead :] for channel in self.u)

    def drift_basis(self, rows: slice, terms: int) -> Float[np.ndarray, "m nd"]:
        """Return Legendre's polynomials 1 to `terms` at the drift coordinate of a slice of samples."""
        tau = self.drift_span[0] + self.drift_span[1] * np.arange(rows.start, rows.stop)
        return np.polynomial.legendre.legvander(tau, terms)[:, 1:]


@record(eq=False)
class Point:
    """Where passes are made: the unknowns of an experiment, but for its initial states.

    Parameters
    ----------
    theta : array, shape (np,)
        The model's free parameters.
    offset, gain : array, shape (ny,)
        measured = gain * output + offset + drift.
    drift : array, shape (ny, nd)
        Coefficients of Legendre's polynomials 1 to nd over the log.
    clock : Clock
        Period, hold and delay.
    substeps : int
        Runge-Kutta steps per period (a linear model needs none).
    stable : int
        The least that are stable.
    halved : bool
        Whether all of these steps are made in two.
    correction : array, shape (1 + ns, nx, ny), or None
        Gain by which the prediction error corrects the next state, and its derivatives with respect to theta, a free
        delay, and what else it depends on (ns in all). None: the plant is simulated.
    """

    theta: Float[np.ndarray, " np"]
    offset: Float[np.ndarray, " ny"]
    gain: Float[np.ndarray, " ny"]
    clock: Clock
    drift: Float[np.ndarray, "ny nd"] = field(default_factory=lambda: np.zeros((1, 0)))
    substeps: int = 1
    stable: int = 1
    halved: bool = False
    correction: Float[np.ndarray, "ns1 nx ny"] | None = None

    @property
    def drift_terms(self) -> int:
        """Drift coefficients per output."""
        return self.drift.shape[1]

    @property
    def most_steps(self) -> int:
        """The Runge-Kutta steps of a sample that takes all."""
        return (1 + self.halved) * max(self.substeps, self.stable)

    def count_steps(self, segment: Segment) -> Int[np.ndarray, " n"]:
        """Return the Runge-Kutta steps of every sample of a segment."""
        if segment.shares is None:
            return np.full(segment.n, self.most_steps)
        steps = np.maximum(self.substeps * segment.shares[0], self.stable * segment.shares[1])
        return (1 + self.halved) * np.maximum(np.ceil(steps - SLACK), 1.0).astype(np.int64)

    def read(self, outputs: Float[np.ndarray, "ny m"], segment: Segment, rows: slice) -> Float[np.ndarray, "ny m"]:
        """Return what the sensors read of model outputs over rows of a segment: gain * output + offset + drift."""
        readings = np.multiply(outputs, self.gain[:, None], order="C")  # an output's samples side by side
        readings += self.offset[:, None]
        if self.drift_terms:
            readings += self.drift @ segment.drift_basis(rows, self.drift_terms).T
        return readings


@record
class Layout:
    """The columns of v = [residual, shared, initial state, own of the output], and of the state's derivatives.

    shared: d/dtheta, then d/ddelay where it is free, then what else the correction depends on. own: d/doffset,
    d/ddrift, d/dgain; with a correction those of every output, because they act on the state.
    """

    shared: int
    nx: int
    ny: int
    drift_terms: int
    corrected: bool

    @property
    def per_output(self) -> int:
        """Columns that belong to one output."""
        return 2 + self.drift_terms

    @property
    def states(self) -> int:
        """The state and its derivatives, in columns."""
        return 1 + self.shared + self.nx + (self.ny * self.per_output if self.corrected else 0)

    @property
    def start(self) -> slice:
        """The columns of the initial state."""
        return slice(1 + self.shared, 1 + self.shared + self.nx)

    @property
    def columns(self) -> int:
        """Columns of v."""
        return 1 + self.shared + self.nx + (self.ny if self.corrected else 1) * self.per_output


@record(eq=False)
class Pass:
    """What a pass over one segment, or its first samples, found."""

    gram: Float[np.ndarray, "ny nc nc"]  # sums over samples of v v', weighted as the loss asks; columns as in `Layout`
    loss: Float[np.ndarray, " ny"]  # sums of the losses
    count: Float[np.ndarray, " ny"]  # samples that counted
    outputs: Float[np.ndarray, "n ny"] | None = None  # model outputs, without gain and offset
    columns: Float[np.ndarray, "n ny nv"] | None = None  # the v of every sample
    chosen: Int[np.ndarray, " nc"] | None = None  # which of those columns are this pass's; all if None
    states: Float[np.ndarray, "n nx"] | None = None  # state trajectory
    changes: Float[np.ndarray, "n nx"] | None = None  # of each sample's next state, by steps of half the length


def layout_of(nx: int, ny: int, np_: int, point: Point) -> Layout:
    """Return the columns of passes at a point of a model with `np_` free parameters."""
    shared = np_ + point.clock.delay_free if point.correction is None else point.correction.shape[0] - 1
    return Layout(shared=shared, nx=nx, ny=ny, drift_terms=point.drift_terms, corrected=point.correction is not None)
