"""The weighted least-squares problem of a fit, evaluated by one pass a segment.

Residuals are in units of sigma: the cost is half their squared norm plus half that of the priors' residuals. A pass
gives each output's Gram matrix of [residual, derivatives]; weighting by 1/sigma^2 and adding up gives the cost, its
gradient and the Gauss-Newton Hessian.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from jaxtyping import Float

from seaopt.errors import EstimationError
from seaopt.estimation.experiment import Experiment
from seaopt.estimation.unknowns import Unknowns
from seaopt.simulation import Clock, Pass, Point, Segment, Weights, run_pass


@dataclass(frozen=True, slots=True, kw_only=True)
class Linear:
    """Plain least squares."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Huber:
    """Squares up to `threshold` sigma, absolute values beyond (Huber 1964): outliers pull less.

    Parameters
    ----------
    threshold : float
        In sigma; 1.345 keeps 95 % of the efficiency on Gaussian noise.

    """

    threshold: float = 1.345


Loss = Linear | Huber


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Evaluation:
    """Cost, gradient and Gauss-Newton Hessian at a point, and each output's weighted sum of squares and count."""

    cost: float
    gradient: Float[np.ndarray, " n"]
    hessian: Float[np.ndarray, "n n"]
    squares: tuple[Float[np.ndarray, " ny"], ...]
    counts: tuple[Float[np.ndarray, " ny"], ...]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
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
    loss : Linear or Huber
        Applied to residuals in sigma.
    band_hz : (low, high) or None
        Residuals are filtered to this band.
    substeps : tuple of int
        Integration steps a sample, one an experiment.

    """

    experiments: tuple[Experiment, ...]
    segments: tuple[tuple[Segment, ...], ...]
    unknowns: Unknowns
    sigma: tuple[Float[np.ndarray, " ny"], ...]
    loss: Loss = Linear()
    band_hz: tuple[float, float] | None = None
    substeps: tuple[int, ...] = ()

    def point(self, e: int, s: int, z: Float[np.ndarray, " n"]) -> Point:
        """Return where the pass of experiment e, segment s is made."""
        experiment, places = self.experiments[e], self.unknowns.locals_of[e]
        return Point(
            theta=self.unknowns.theta(self.unknowns.models[e], z),
            x0=np.array([slot.at(z) for slot in places.initial[s]]),
            offset=np.array([slot.at(z) for slot in places.offset]),
            gain=np.array([slot.at(z) for slot in places.gain]),
            clock=Clock(
                period=experiment.log.period,
                hold=experiment.hold,
                delay_s=places.delay.at(z),
                delay_free=places.delay.index is not None,
            ),
            substeps=self.substeps[e] if self.substeps else 1,
        )

    def weights(self, e: int) -> Weights:
        """Return the filter and loss of experiment e."""
        knee = np.full(len(self.sigma[e]), np.inf)
        if isinstance(self.loss, Huber):
            knee = self.loss.threshold * self.sigma[e]
        sections, settle = band_filter(self.band_hz, self.experiments[e].log.period)
        return Weights(sections=sections, settle=settle, knee=knee)

    def columns_of(self, e: int, s: int, output: int) -> list[int | None]:
        """Return, for each derivative column of a pass, its unknown; None where that is known."""
        places, model = self.unknowns.locals_of[e], self.unknowns.models[e]
        index: list[int | None] = [*self.unknowns.theta_index(model)]
        if places.delay.index is not None:
            index.append(places.delay.index)
        index += [slot.index for slot in places.initial[s]]
        return [*index, places.offset[output].index, places.gain[output].index]

    def run(self, e: int, s: int, z: Float[np.ndarray, " n"], **keep: bool) -> Pass:
        """Run the pass of experiment e, segment s."""
        return run_pass(self.unknowns.models[e], self.segments[e][s], self.point(e, s, z), self.weights(e), **keep)

    def map(self, call: Callable[[int, int], Any]) -> list[list[Any]]:
        """Call for every (experiment, segment), in order."""
        return [[call(e, s) for s in range(len(self.segments[e]))] for e in range(len(self.experiments))]

    def evaluate(self, z: Float[np.ndarray, " n"]) -> Evaluation:
        """Return cost, gradient and Hessian at `z`; the cost is infinite where the simulation overflows."""
        n = z.size
        cost, gradient, hessian = 0.0, np.zeros(n), np.zeros((n, n))
        squares = tuple(np.zeros(len(sigma)) for sigma in self.sigma)
        counts = tuple(np.zeros(len(sigma)) for sigma in self.sigma)
        passes = self.map(lambda e, s: self.run(e, s, z))
        for e, row in enumerate(passes):
            for s, found in enumerate(row):
                for o, sigma in enumerate(self.sigma[e]):
                    gram = found.gram[o] / sigma**2
                    cost += float(found.loss[o]) / sigma**2
                    index = self.columns_of(e, s, o)
                    kept = [i for i, k in enumerate(index) if k is not None]
                    place = [k for k in index if k is not None]
                    gradient[place] += gram[0, 1:][kept]
                    hessian[np.ix_(place, place)] += gram[1:, 1:][np.ix_(kept, kept)]
                    squares[e][o] += found.gram[o, 0, 0]
                    counts[e][o] += found.count[o]
        prior = (z - self.unknowns.start) / self.unknowns.prior_std
        cost += 0.5 * float(prior @ prior)
        gradient += prior / self.unknowns.prior_std
        hessian[np.diag_indices(n)] += self.unknowns.prior_std**-2.0
        if not (np.isfinite(cost) and np.all(np.isfinite(gradient)) and np.all(np.isfinite(hessian))):
            cost = np.inf
        return Evaluation(cost=cost, gradient=gradient, hessian=hessian, squares=squares, counts=counts)

    def with_sigma(self, sigma: tuple[Float[np.ndarray, " ny"], ...]) -> Residuals:
        """Return the problem with other sigmas."""
        return replace(self, sigma=sigma)


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
