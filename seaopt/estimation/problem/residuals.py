r"""The weighted least-squares problem of a fit, evaluated by one pass a segment.

Residuals are in units of sigma: the cost is half their squared norm plus half that of the priors' residuals. A pass
gives each output's Gram matrix of [residual, derivatives]; weighting by 1/sigma^2 and adding up gives the cost, its
gradient and the Gauss-Newton Hessian.

Residuals are affine in some unknowns :math:`\nu` (offsets, drifts, initial states of linear plants). With squares as
the loss each evaluation moves to the best of them, which the same Gram matrices give exactly (variable projection,
Golub and Pereyra, SIAM J. Numer. Anal. 10(2), 1973, in Kaufman's form):

.. math:: \nu^* = \nu - H_{\nu\nu}^{-1} g_\nu, \qquad
          c^* = c - \tfrac12 g_\nu^T H_{\nu\nu}^{-1} g_\nu, \qquad
          g_\zeta^* = g_\zeta - H_{\zeta\nu} H_{\nu\nu}^{-1} g_\nu .

Process noise is an unknown through :math:`\lambda`, the logarithm of its standard deviation. Where it is hardly there
the residuals follow its variance :math:`w = e^{2\lambda}`, so that
:math:`c_{\lambda\lambda} = 4 w^2 c_{ww} + 2 c_\lambda`; where it rules they follow 1/w, which turns the sign of the
last term. Gauss and Newton see the first term alone, which dies out on either side: :math:`2 |c_\lambda|` is added, or
steps overshoot and the region shrinks for all unknowns. It stays in the Hessian that the covariance inverts:
where noise is hardly there it is the true second derivative.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import field, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float, Int

from seaopt.errors import EstimationError
from seaopt.estimation.problem.experiment import Experiment
from seaopt.estimation.problem.losses import NAMES, Linear, Loss
from seaopt.estimation.problem.normal_equations import add_gram, solved
from seaopt.estimation.problem.unknowns import Unknowns
from seaopt.records import record
from seaopt.simulation import Clock, Pass, Point, Segment, Weights, run_passes, threads

if TYPE_CHECKING:
    from seaopt.estimation.problem.observer import Observer

CHUNK = 1 << 14  # samples whose sums stay in a core's cache
WATCHED = 8_000  # first samples that tell the integration error in an output, and a filter's sizes and places
LOST = 1e-3  # below zero: a sum of squares that is nothing but rounding of a far larger one
ALONE = 8_000  # samples below which experiments are not worth a thread each


@record(eq=False)
class Evaluation:
    """Cost, gradient and Gauss-Newton Hessian at `z`, and each output's weighted sum of squares and count.

    `passes` were made at `origin`, from where residuals are straight to `z`: the two differ in the linear unknowns
    alone, or by the last step of a search (see `least_squares`). `undamped` tells which unknowns a step may change at
    will: the linear ones. `pending` is the fall of the cost still expected from unknowns that are
    not in z (see `shooting`).
    """

    z: Float[np.ndarray, " n"]
    cost: float
    gradient: Float[np.ndarray, " n"]
    hessian: Float[np.ndarray, "n n"]
    squares: tuple[Float[np.ndarray, " _"], ...]
    counts: tuple[Float[np.ndarray, " _"], ...]
    undamped: Bool[np.ndarray, " n"]
    origin: Float[np.ndarray, " n"]
    passes: tuple[tuple[Pass, ...], ...]
    pending: float = 0.0


@record(eq=False)
class Residuals:
    """Experiments, unknowns and weights: what a fit minimises.

    Parameters
    ----------
    experiments, segments : tuples, one an experiment
        The data.
    unknowns : Unknowns
        What may change.
    sigma : tuple of arrays, shape (ny,)
        Of the filtered residual, one array an experiment.
    loss : Linear, Huber or SoftL1
        Applied to residuals in sigma.
    band_hz : (low, high) or None
        Residuals are filtered to this band.
    substeps : tuple of int
        Integration steps a sample, one an experiment.
    observers : tuple of Observer or None
        One an experiment: the residual is then the error of the prediction one sample ahead.
    holdout : float
        Last fraction of each log that gets no weight.
    spread : tuple of arrays, shape (ny,)
        Standard deviation of each measured output.

    """

    experiments: tuple[Experiment, ...]
    segments: tuple[tuple[Segment, ...], ...]
    unknowns: Unknowns
    sigma: tuple[Float[np.ndarray, " _"], ...]
    loss: Loss = field(default_factory=Linear)
    band_hz: tuple[float, float] | None = None
    substeps: tuple[int, ...] = ()
    observers: tuple[Observer, ...] | None = None
    holdout: float = 0.0
    spread: tuple[Float[np.ndarray, " _"], ...] = ()

    def point(self, e: int, z: Float[np.ndarray, " n"]) -> Point:
        """Return where the passes of experiment e are made."""
        experiment, places = self.experiments[e], self.unknowns.locals_of[e]
        point = Point(
            theta=self.unknowns.theta(self.unknowns.models[e], z),
            offset=np.array([slot.at(z) for slot in places.offset]),
            gain=np.array([slot.at(z) for slot in places.gain]),
            drift=np.array([[slot.at(z) for slot in row] for row in places.drift]),
            clock=Clock(
                period=experiment.log.period,
                hold=experiment.hold,
                delay_s=places.delay.at(z),
                delay_free=places.delay.index is not None,
            ),
            substeps=self.substeps[e] if self.substeps else 1,
        )
        if self.observers is None:
            return point
        noise = np.array([slot.at(z) for slot in places.noise])
        return replace(point, correction=self.observers[e].correction(self.unknowns.models[e], point, noise))

    def start(self, e: int, s: int, z: Float[np.ndarray, " n"]) -> Float[np.ndarray, " nx"]:
        """Return the state at the first sample of a segment."""
        return np.array([slot.at(z) for slot in self.unknowns.locals_of[e].initial[s]])

    def weights(self, e: int) -> Weights:
        """Return the filter and loss of experiment e."""
        knee = np.full(len(self.sigma[e]), np.inf)
        if not isinstance(self.loss, Linear):
            knee = self.loss.threshold * self.sigma[e]
        sections, settle = band_filter(self.band_hz, self.experiments[e].log.period)
        return Weights(sections=sections, settle=settle, knee=knee, loss=NAMES[type(self.loss)])

    def columns(self, e: int, s: int) -> list[Int[np.ndarray, " nc"]]:
        """Return, for each output, the unknown of each derivative column of a pass; -1 where that is known."""
        return self.unknowns.columns(e, s, self.observers is not None)

    def run(self, e: int, s: int, z: Float[np.ndarray, " n"], **keep: Any) -> Pass:
        """Run the pass of experiment e, segment s."""
        model, start = self.unknowns.models[e], self.start(e, s, z)[None]
        return run_passes(model, self.segments[e][s], self.point(e, z), start, self.weights(e), **keep)

    def passes_of(self, e: int, z: Float[np.ndarray, " n"]) -> tuple[Pass, ...]:
        """Run the passes of experiment e; those of a nonlinear plant keep the outputs of the first samples."""
        model, point, weights = self.unknowns.models[e], self.point(e, z), self.weights(e)
        shown = 0 if model.linear else WATCHED
        return tuple(
            run_passes(model, piece, point, self.start(e, s, z)[None], weights, outputs=shown > 0, shown=shown)
            for s, piece in enumerate(self.segments[e])
        )

    def map(self, call: Callable[[int], Any]) -> list[Any]:
        """Call for every experiment; in threads of their own where they are long enough."""
        count = len(self.experiments)
        if count < 2 or sum(piece.n for row in self.segments for piece in row) < ALONE:
            return [call(e) for e in range(count)]
        return list(threads().map(call, range(count)))

    def passes(self, z: Float[np.ndarray, " n"]) -> tuple[tuple[Pass, ...], ...]:
        """Run every pass."""
        return tuple(self.map(lambda e: self.passes_of(e, z)))

    def evaluate(self, z: Float[np.ndarray, " n"], here: Evaluation | None = None, damping: float = 0.0) -> Evaluation:
        """Return cost, gradient and Hessian at the best linear unknowns; infinite if the plant overflows."""
        del here, damping  # all unknowns are in z
        return self.assemble(z, self.passes(z))

    @np.errstate(all="ignore")  # a plant that overflows gives a cost that is not finite, which is said there
    def assemble(
        self,
        z: Float[np.ndarray, " n"],
        passes: tuple[tuple[Pass, ...], ...],
        to: Float[np.ndarray, " n"] | None = None,
    ) -> Evaluation:
        """Return the evaluation that passes at `z` give: other sigmas need no other passes.

        It is that of `to`, if given, as far as residuals are straight from `z`.
        """
        n, unknowns = z.size, self.unknowns
        cost, gradient, hessian = unknowns.prior(z)
        for e, row in enumerate(passes):
            own = self.normal(e, row)
            gradient, hessian = gradient + own[0, 1:], hessian + own[1:, 1:]
            cost += sum(float(np.sum(found.loss[0] / self.sigma[e] ** 2)) for found in row)
            noise = [slot.index for slot in unknowns.locals_of[e].noise if slot.index is not None]
            hessian[noise, noise] += 2.0 * np.abs(own[0, 1:][noise])  # see above
        finite = np.isfinite(cost) and np.all(np.isfinite(gradient)) and np.all(np.isfinite(hessian))
        linear = unknowns.linear if self.exactly_linear else np.zeros(n, dtype=bool)
        moved = np.zeros(n) if to is None else to - z
        if finite and to is not None:
            bent = hessian @ moved
            cost += float(moved @ (gradient + 0.5 * bent))
            gradient = gradient + bent
        if finite and np.any(linear):
            best = np.zeros(n)
            best[linear] = -solved(hessian[np.ix_(linear, linear)], gradient[linear], 1e-13)
            cost += 0.5 * float(best @ gradient)
            finite = finite and cost > -LOST
            gradient = np.where(linear, 0.0, gradient + hessian @ best)
            moved += best
        squares, counts = self._sums(passes, moved)
        return Evaluation(
            z=z + moved, cost=cost if finite else np.inf, gradient=gradient, hessian=hessian, squares=squares,
            counts=counts, undamped=linear, origin=z, passes=passes,
        )  # fmt: skip

    def normal(self, e: int, row: Sequence[Pass]) -> Float[np.ndarray, "n1 n1"]:
        """Return the normal matrix of [residual, unknowns], in sigma, of an experiment's passes."""
        total = np.zeros((1 + self.unknowns.start.size,) * 2)
        for s, found in enumerate(row):
            for o, places in enumerate(self.columns(e, s)):
                add_gram(total, found.gram[0, o] / self.sigma[e][o] ** 2, places)
        return total

    def followed(self, here: Evaluation, z: Float[np.ndarray, " n"]) -> Evaluation:
        """Return what an evaluation says of a `z` nearby, as far as residuals are straight to there."""
        return self.assemble(here.origin, here.passes, z)

    @property
    def straight(self) -> bool:
        """Whether a pass tells the weighted residuals nearby: it does for least squares of simulation errors."""
        return isinstance(self.loss, Linear) and self.observers is None

    @property
    def exactly_linear(self) -> bool:
        """Whether the linear unknowns' best values follow from one evaluation."""
        if not isinstance(self.loss, Linear):
            return False
        return self.observers is None or all(model.linear for model in self.unknowns.models)

    def _sums(
        self, passes: tuple[tuple[Pass, ...], ...], moved: Float[np.ndarray, " n"]
    ) -> tuple[tuple[Float[np.ndarray, " _"], ...], tuple[Float[np.ndarray, " _"], ...]]:
        """Return each output's sum of squares after the linear unknowns have moved, and its count."""
        squares = tuple(np.zeros(len(sigma)) for sigma in self.sigma)
        counts = tuple(np.zeros(len(sigma)) for sigma in self.sigma)
        for e, row in enumerate(passes):
            for s, found in enumerate(row):
                for o, places in enumerate(self.columns(e, s)):
                    step = np.concatenate([[1.0], np.where(places >= 0, moved[places], 0.0)])
                    squares[e][o] += max(float(step @ found.gram[0, o] @ step), 0.0)
                    counts[e][o] += found.count[0, o]
        return squares, counts

    def with_sigma(self, sigma: tuple[Float[np.ndarray, " _"], ...]) -> Residuals:
        """Return the problem with other sigmas."""
        return replace(self, sigma=sigma)


def sees_level(band_hz: tuple[float, float] | None) -> bool:
    """Tell whether residuals of a band show an offset: whether the band begins at 0 Hz."""
    return band_hz is None or band_hz[0] <= 0.0


def spread_of(values: Float[np.ndarray, " n"]) -> float:
    """Return the standard deviation of the samples that are there, in the memory of a chunk."""
    first = float(values[np.argmax(np.isfinite(values))])
    count, total, square = 0, 0.0, 0.0
    for start in range(0, values.size, CHUNK):
        part = values[start : start + CHUNK] - first
        level = float(np.sum(part))
        if not np.isfinite(level):
            part = part[np.isfinite(part)]
            level = float(np.sum(part))
        count, total, square = count + part.size, total + level, square + float(np.einsum("m,m->", part, part))
    return float(np.sqrt(max(square / count - (total / count) ** 2, 0.0)))


@lru_cache(maxsize=32)
def band_filter(band_hz: tuple[float, float] | None, period: float) -> tuple[Float[np.ndarray, "m 5"], int]:
    """Return the sections of a Butterworth filter of order 4 for a band, and the samples it takes to settle.

    An edge at 0 or at the Nyquist frequency needs no filter.

    Raises
    ------
    EstimationError
        The band is empty.

    """
    none = np.zeros((0, 5)), 0
    if band_hz is None:
        return none
    low, high = band_hz
    nyquist = 0.5 / period
    if not 0.0 <= low < high or low >= nyquist:
        raise EstimationError(
            f"band_hz = [{low:g}, {high:g}] is not a band below the Nyquist frequency {nyquist:g} Hz; "
            "give [low, high] with 0 <= low < high"
        )
    from scipy.signal import butter  # deferred: 1 s

    if low > 0.0 and high < 0.999 * nyquist:
        sos = butter(4, [low, high], "bandpass", fs=1 / period, output="sos")
    elif low > 0.0:
        sos = butter(4, low, "highpass", fs=1 / period, output="sos")
    elif high < 0.999 * nyquist:
        sos = butter(4, high, "lowpass", fs=1 / period, output="sos")
    else:
        return none
    sections = np.ascontiguousarray(np.asarray(sos)[:, [0, 1, 2, 4, 5]])
    sections.setflags(write=False)
    slowest = max(float(np.max(np.abs(np.roots([1.0, a1, a2])))) for a1, a2 in sections[:, 3:])
    return sections, int(np.ceil(np.log(1e-4) / np.log(slowest)))
