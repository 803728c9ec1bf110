"""How well a fit predicts: in free run and one sample ahead, over the samples used and over those held out.

The prediction one sample ahead is a steady-state Kalman filter's (see `observer`). A fit of errors of prediction has
one; for any other the plant stays as fitted, and the process noise is the multiple of the states' size that predicts
best.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from seaopt.estimation.problem.residual_statistics import Errors, counted, errors
from seaopt.estimation.problem.residuals import Residuals
from seaopt.estimation.problem.unknowns import Slot
from seaopt.estimation.result.fit_result import Minimum
from seaopt.estimation.solver.solve import with_observers
from seaopt.records import record

LEVELS = (np.log(1e-6), np.log(0.1))  # of process noise over the states' size
NONE = 1e300  # the cost of a filter that runs away
COARSE = 0.3  # of a level: no finer than the forecast feels


@record
class Percent:
    """Fit percent, in the fit's band, over the samples used and over those held out; None where there are none."""

    used: float
    held_out: float | None


def used_and_held_out(problem: Residuals, e: int, o: int) -> tuple[Bool[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
    """Return which samples of an output took part in the fit, and which were held out but can be predicted."""
    pieces, settle = problem.segments[e], problem.weights(e).settle
    used = np.concatenate([counted(piece, settle)[:, o] for piece in pieces])
    # A segment that lies wholly in the part held out has no initial state: it says nothing of the model.
    started = np.concatenate([np.full(piece.n, not piece.keep or bool(np.any(piece.keep[0]))) for piece in pieces])
    present = np.concatenate([np.isfinite(piece.y[o]) for piece in pieces])
    kept = np.concatenate([counted(piece, 0)[:, o] for piece in pieces])
    return used, ~kept & started & present


def fit_percent(problem: Residuals, e: int, o: int, left: list[list[Errors]]) -> Percent:
    """Return 100 (1 - |residual| / |measured - mean|), in the fit's band, over samples used and over those held out."""
    measured = in_band(problem, e, [piece.y[o] for piece in problem.segments[e]])
    raw = in_band(problem, e, [error.raw[:, o] for error in left[e]])

    def percent(rows: Bool[np.ndarray, " n"]) -> float:
        spread = float(np.sum((measured[rows] - np.mean(measured[rows])) ** 2))
        return 100.0 * (1.0 - float(np.sqrt(np.sum(raw[rows] ** 2) / max(spread, 1e-300))))

    used, held = used_and_held_out(problem, e, o)
    return Percent(used=percent(used), held_out=percent(held) if np.any(held) else None)


def in_band(problem: Residuals, e: int, rows: list[Float[np.ndarray, "..."]]) -> Float[np.ndarray, " n"]:
    """Return one signal of all segments, filtered to the fit's band where it has one; missing samples count as zero."""
    found = [np.where(np.isfinite(row), row, 0.0) for row in rows]
    sections = problem.weights(e).sections
    if len(sections):
        from scipy.signal import sosfilt, sosfilt_zi  # deferred: 1 s

        sos = np.insert(sections, 3, 1.0, axis=1)
        start = np.asarray(sosfilt_zi(sos))  # as if the first sample had stood for ever: no step at the start
        found = [np.asarray(sosfilt(sos, row, zi=start * row[0])[0]) for row in found]
    return np.concatenate(found)


def free_run(minimum: Minimum, left: list[list[Errors]]) -> list[list[Errors]]:
    """Return what the simulation leaves over, which is the fit's own residuals unless they are errors of prediction."""
    if minimum.problem.observers is None:
        return left
    return errors(replace(minimum.problem, observers=None), minimum.z)


def one_step(minimum: Minimum) -> list[list[Errors]] | None:
    """Return the errors of prediction one sample ahead, held-out samples too; None where no filter is found."""
    problem = minimum.problem
    segments = tuple(tuple(replace(piece, keep=()) for piece in pieces) for pieces in problem.segments)
    if problem.observers is not None:  # which see what is measured only where it is not held out
        return errors(replace(problem, segments=segments), minimum.z)
    watched = with_observers(replace(problem, band_hz=None), minimum.z, follows=False)
    if watched is None:
        return None
    found = [_predicted(replace(watched, segments=segments), minimum, e) for e in range(len(segments))]
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
    used = np.concatenate([counted(piece, 0) for piece in minimum.problem.segments[e]])

    def at(level: float) -> list[Errors]:
        places = replace(unknowns.locals_of[e], noise=(Slot(value=float(level)),) * unknowns.models[e].nx)
        own = replace(unknowns, locals_of=(places,), models=(unknowns.models[e],))
        return errors(replace(alone, unknowns=own), minimum.z)[0]

    def cost(level: float) -> float:
        with np.errstate(all="ignore"):
            squares = np.sum(np.where(used, np.concatenate([error.raw for error in at(level)]), 0.0) ** 2, axis=0)
            total = float(np.sum(np.log(np.maximum(squares, 1e-300))))
        return total if np.isfinite(total) else NONE

    best = minimize_scalar(cost, bounds=LEVELS, method="bounded", options={"xatol": COARSE})
    return at(float(best.x)) if best.fun < NONE else None
