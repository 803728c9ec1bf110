"""How well a fit predicts: in free run and one sample ahead, over the samples used and over those held out.

The prediction one sample ahead is a steady-state Kalman filter's (see `observer`). A fit of errors of prediction has
one; for any other the plant stays as fitted, and the process noise is the multiple of the states' size that predicts
best.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool

from seaopt.estimation.covariance import Errors, counted, errors
from seaopt.estimation.residuals import Residuals
from seaopt.estimation.result import Fit, Minimum
from seaopt.estimation.solve import with_observers
from seaopt.estimation.unknowns import Slot

LEVELS = (np.log(1e-6), np.log(0.1))  # of process noise over the states' size
COARSE = 0.3  # of a level: no finer than the forecast feels


@dataclass(frozen=True, slots=True, kw_only=True)
class Percent:
    """Fit percent over the samples used, and over those held out; None where there are none."""

    used: float
    held_out: float | None


def used_and_held_out(problem: Residuals, e: int, o: int) -> tuple[Bool[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
    """Return which samples of an output took part in the fit, and which were held out but can be predicted."""
    pieces = problem.segments[e]
    used = np.concatenate([counted(piece, 0)[:, o] for piece in pieces])
    # A segment that lies wholly in the part held out has no initial state: it says nothing of the model.
    started = np.concatenate([np.full(piece.n, not piece.keep or bool(np.any(piece.keep[0]))) for piece in pieces])
    present = np.concatenate([np.isfinite(piece.y[o]) for piece in pieces])
    return used, ~used & started & present


def fit_percent(problem: Residuals, e: int, o: int, left: list[list[Errors]]) -> Percent:
    """Return 100 (1 - |residual| / |measured - mean|) over the samples used and over those held out."""
    measured = np.concatenate([piece.y[o] for piece in problem.segments[e]])
    raw = np.concatenate([error.raw[:, o] for error in left[e]])

    def percent(rows: Bool[np.ndarray, " n"]) -> float:
        spread = float(np.sum((measured[rows] - np.mean(measured[rows])) ** 2))
        return 100.0 * (1.0 - float(np.sqrt(np.sum(raw[rows] ** 2) / max(spread, 1e-300))))

    used, held = used_and_held_out(problem, e, o)
    return Percent(used=percent(used), held_out=percent(held) if np.any(held) else None)


def free_run(fit: Fit) -> list[list[Errors]]:
    """Return what the simulation leaves over, also of a fit of errors of prediction."""
    minimum = fit.at_minimum("free_run")
    if minimum.problem.observers is None:
        return fit.residuals or errors(minimum.problem, minimum.z)
    return errors(replace(minimum.problem, observers=None), minimum.z)


def one_step(minimum: Minimum, left: list[list[Errors]]) -> list[list[Errors]] | None:
    """Return the errors of prediction one sample ahead; None where no filter is found."""
    if minimum.problem.observers is not None:
        return left
    watched = with_observers(replace(minimum.problem, band_hz=None), minimum.z, follows=False)
    if watched is None:
        return None
    found = [_predicted(watched, minimum, e) for e in range(len(left))]
    return [row for row in found if row is not None] if all(row is not None for row in found) else None


def _predicted(watched: Residuals, minimum: Minimum, e: int) -> list[Errors] | None:
    """Return the errors of prediction of one experiment, at the level of process noise that predicts best."""
    from scipy.optimize import minimize_scalar  # deferred: scipy is slow to load

    assert watched.observers is not None
    alone = replace(
        watched, experiments=(watched.experiments[e],), segments=(watched.segments[e],), sigma=(watched.sigma[e],),
        substeps=watched.substeps[e : e + 1], observers=(watched.observers[e],),
    )  # fmt: skip
    unknowns = watched.unknowns
    states = unknowns.models[e].nx

    def at(level: float) -> list[Errors]:
        places = replace(unknowns.locals_of[e], noise=(Slot(value=float(level)),) * states)
        own = replace(unknowns, locals_of=(places,), models=(unknowns.models[e],))
        return errors(replace(alone, unknowns=own), minimum.z)[0]

    def cost(level: float) -> float:
        with np.errstate(all="ignore"):
            squares = np.sum([np.sum(error.weighted**2, axis=0) for error in at(level)], axis=0)
            total = float(np.sum(np.log(np.maximum(squares, 1e-300))))
        return total if np.isfinite(total) else 1e300

    best = minimize_scalar(cost, bounds=LEVELS, method="bounded", options={"xatol": COARSE})
    return at(float(best.x)) if best.fun < 1e300 else None
