r"""Which of several fits to the same logs explains them best, how surely, and where the others fall short.

Each fit has a Gaussian likelihood L at its own sigmas, k unknowns and N samples, and

.. math:: \mathrm{BIC} = k \log N - 2 \log L,

whose differences are worth a bare mention below 2, positive evidence to 6, strong to 10, and beyond that very strong
(Schwarz, Ann. Stat. 6, 1978; Kass and Raftery, J. Am. Stat. Assoc. 90, 1995, sec. 3.2 and 4.1.3).

That counts every sample, and coloured residuals make samples say the same thing over and over. What the likelihoods
compare is the residuals' variances, and of a variance a series with autocorrelation :math:`\rho` tells as much as

.. math:: N_e = N \Big/ \Big(1 + 2 \sum_{k>0} \rho_k^2\Big)

independent samples (Bayley and Hammersley, Suppl. J. R. Stat. Soc. 8, 1946). The *effective* BIC counts these; for each
output all fits get the number of the one that has the fewest, so that it errs on the side of not deciding. It ranks.

A ranking by likelihood says which model is nearer, not whether the plant repeats. So samples held out have the last
word: the preferred fit must not predict them worse, in free run, than one it beats.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from jaxtyping import Float

from seaopt.errors import EstimationError
from seaopt.estimation.advice.forecasts import Percent, fit_percent, free_run, in_band, used_and_held_out
from seaopt.estimation.advice.ranking import Band, Ranked, Ranking
from seaopt.estimation.problem.correlation import autocorrelation
from seaopt.estimation.problem.residual_statistics import Errors
from seaopt.estimation.problem.residuals import Residuals
from seaopt.estimation.result.fit_result import Fit

MENTION, STRONG, VERY_STRONG = 2.0, 6.0, 10.0  # differences of BIC (Kass and Raftery)
WORSE = 1.02  # ratio of held-out residuals that contradicts the likelihood
OCTAVES = 12  # at most, below the Nyquist frequency
LINES = 4  # lines of the spectrum that the lowest octave has at least


def compare(fits: Sequence[Fit] | Mapping[str, Fit]) -> Ranking:
    """Rank fits of several models, or by several methods, to the same logs.

    Parameters
    ----------
    fits : sequence of Fit, or mapping of name to Fit
        Two or more, as `fit` returned them, from the same experiments: the same logs, outputs, samples used, band and
        loss. In a sequence each is called by its plants' names.

    Returns
    -------
    Ranking

    Raises
    ------
    EstimationError
        Fewer than two fits, one that was read from a file, or fits to data that are not the same.

    Examples
    --------
    What a load cell at link 2 sees tells the models of the drive apart:

    >>> import seaopt as so
    >>> from seaopt.bench import PAPER_STAND, Sensors, virtual_log
    >>> truth = so.plants.thor().free("J", "b_r")
    >>> log = virtual_log(so.plants.high_impedance(), truth, PAPER_STAND, duration_s=10, rate_hz=400, seed=1,
    ...                   sensors=Sensors(noise_std={"F2": 2.0}))
    >>> fits = {
    ...     drive: so.fit(
    ...         [so.Experiment(plant=so.plants.high_impedance(drive=drive), log=log, outputs=("F2",))], truth
    ...     )
    ...     for drive in ("unlumped", "lumped")
    ... }
    >>> ranking = so.compare(fits)
    >>> ranking.preferred, ranking.evidence
    ('unlumped', 'very strong')

    """
    named = _named(fits)
    minima = {name: fit.at_minimum("compare") for name, fit in named.items()}
    problems = {name: minimum.problem for name, minimum in minima.items()}
    _check(problems)
    weighted = {name: minimum.errors() for name, minimum in minima.items()}
    free = {name: free_run(minimum, weighted[name]) for name, minimum in minima.items()}
    shared = next(iter(problems.values()))
    places = [(e, o) for e, experiment in enumerate(shared.experiments) for o in range(len(experiment.outputs))]
    effective = {
        (e, o): min(_effective(left[e], o) for left in weighted.values()) for e, o in places
    }  # fmt: skip
    bic = {name: _effective_bic(fit, problems[name], weighted[name], effective) for name, fit in named.items()}
    order = sorted(named, key=lambda name: bic[name])
    rows = tuple(
        Ranked(
            name=name, aic=named[name].aic, bic=named[name].bic, effective_bic=bic[name],
            unknowns=named[name]._count, free_run=_percents(problems[name], free[name]),
            held_out_ratio=_held_out(shared, free[name], free[order[0]]),
        )
        for name in order
    )  # fmt: skip
    bands = tuple(band for e, o in places for band in _bands({n: problems[n] for n in order}, e, o, weighted))
    evidence = _evidence(rows)
    return Ranking(
        rows=rows, preferred=None if evidence == "undecided" else order[0], evidence=evidence,
        samples=named[order[0]].samples, effective_samples=float(sum(effective.values())), bands=bands,
        sentences=_sentences(rows, evidence, bands, named), fits={name: named[name] for name in order},
    )  # fmt: skip


def _named(fits: Sequence[Fit] | Mapping[str, Fit]) -> dict[str, Fit]:
    """Return the fits under names of their own."""
    if isinstance(fits, Fit):
        raise EstimationError("compare takes two fits or more; put them in brackets, [one, other]")
    found: dict[str, Fit] = {}
    for given, fit in fits.items() if isinstance(fits, Mapping) else ((None, fit) for fit in fits):
        if not isinstance(fit, Fit):
            raise EstimationError(f"compare got a {type(fit).__name__}; give results of fit")
        plants = dict.fromkeys(experiment.plant.name for experiment in fit.experiments)
        label = given if given is not None else " + ".join(plants) or "fit"
        name, number = label, 1
        while name in found:
            number += 1
            name = f"{label} {number}"
        found[name] = fit
    if len(found) < 2:
        raise EstimationError(f"compare got {len(found)} fit; give two or more to the same logs")
    return found


def _check(problems: dict[str, Residuals]) -> None:
    """Refuse fits to data that are not the same: their likelihoods are not of the same thing."""
    (first, one), *others = problems.items()
    for name, other in others:
        what = _difference(one, other)
        if what:
            raise EstimationError(
                f'compare: "{name}" and "{first}" differ in {what}, and likelihoods of other data cannot be compared; '
                "fit both to the same experiments with the same holdout, band_hz and loss"
            )


def _difference(one: Residuals, other: Residuals) -> str:
    """Return what differs in the data of two problems; empty if nothing does."""
    names, others = [e.name for e in one.experiments], [e.name for e in other.experiments]
    if names != others:
        return f"their experiments ({', '.join(names)}; {', '.join(others)})"
    if one.band_hz != other.band_hz:
        return f"band_hz ({one.band_hz}; {other.band_hz})"
    if one.loss != other.loss:
        return f"their loss ({one.loss}; {other.loss})"
    if one.holdout != other.holdout:
        return f"holdout ({one.holdout:g}; {other.holdout:g})"
    for a, b in zip(one.experiments, other.experiments, strict=True):
        if a.outputs != b.outputs:
            return f"the outputs of {a.name} ({', '.join(a.outputs)}; {', '.join(b.outputs)})"
        channels = [*a.outputs, *(u for u in a.plant.inputs if u in a.log.signals and u in b.plant.inputs)]
        same = a.log is b.log or (
            np.array_equal(a.log.time, b.log.time)
            and all(name in b.log.signals and np.array_equal(a.log[name], b.log[name], True) for name in channels)
        )
        if not same:
            return f"the log of {a.name}"
    return ""


def _effective(row: list[Errors], o: int) -> float:
    """Return how many independent samples tell as much of the variance of an output's residual."""
    r = np.concatenate([error.weighted[:, o] for error in row])
    count = int(np.count_nonzero(r))
    lags = int(min(max(32, 4 * np.sqrt(r.size)), r.size - 1))
    squares = autocorrelation(r, lags)[1:] ** 2 - 1.0 / max(count, 1)  # what white noise leaves is taken off
    return count / (1.0 + 2.0 * max(float(np.sum(squares)), 0.0))


def _effective_bic(
    fit: Fit, problem: Residuals, left: list[list[Errors]], effective: Mapping[tuple[int, int], float]
) -> float:
    total = 0.0
    for (e, o), number in effective.items():
        r = np.concatenate([error.weighted[:, o] for error in left[e]]) * problem.sigma[e][o]
        total += number * float(np.log(max(float(np.sum(r**2)) / max(np.count_nonzero(r), 1), 1e-300)))
    return total + fit._count * float(np.log(max(sum(effective.values()), 1.0)))


def _percents(problem: Residuals, left: list[list[Errors]]) -> dict[str, dict[str, Percent]]:
    return {
        experiment.name: {name: fit_percent(problem, e, o, left) for o, name in enumerate(experiment.outputs)}
        for e, experiment in enumerate(problem.experiments)
    }


def _held_out(problem: Residuals, left: list[list[Errors]], best: list[list[Errors]]) -> float | None:
    """Return the ratio of held-out residuals to the best fit's, geometric mean over outputs."""
    logs: list[float] = []
    for e, experiment in enumerate(problem.experiments):
        for o in range(len(experiment.outputs)):
            _, held = used_and_held_out(problem, e, o)
            if np.any(held):
                rms = [
                    float(np.sqrt(np.mean(in_band(problem, e, _raw(found, e, o))[held] ** 2))) for found in (left, best)
                ]
                logs.append(float(np.log(max(rms[0], 1e-300) / max(rms[1], 1e-300))))
    return float(np.exp(np.mean(logs))) if logs else None


def _raw(left: list[list[Errors]], e: int, o: int) -> list[Float[np.ndarray, "..."]]:
    return [error.raw[:, o] for error in left[e]]


def _bands(problems: Mapping[str, Residuals], e: int, o: int, left: Mapping[str, list[list[Errors]]]) -> list[Band]:
    """Return the power of what each likelihood sees of an output's residual, in octaves below the Nyquist frequency."""
    problem = next(iter(problems.values()))
    experiment, period = problem.experiments[e], problem.experiments[e].log.period
    residuals = {
        name: np.concatenate([error.weighted[:, o] for error in left[name][e]]) * own.sigma[e][o]
        for name, own in problems.items()
    }
    counts = {name: max(int(np.count_nonzero(r)), 1) for name, r in residuals.items()}
    lowest = LINES / (max(counts.values()) * period)
    edges = [0.5 / period]
    while len(edges) <= OCTAVES and edges[-1] / 2.0 > lowest:
        edges.append(edges[-1] / 2.0)
    edges[-1] = 0.0
    rows: list[Band] = []
    spectra = {name: _spectrum(r, counts[name], period) for name, r in residuals.items()}
    for high, low in pairwise(edges):
        power = {
            name: float(np.sum(density[(f > low if low else f >= 0.0) & (f <= high)]))
            for name, (f, density) in spectra.items()
        }  # fmt: skip
        rows.append(
            Band(
                experiment=experiment.name, output=experiment.outputs[o],
                unit=experiment.plant.outputs[experiment.outputs[o]], low_hz=low, high_hz=high, power=power,
            )
        )  # fmt: skip
    return rows[::-1]


def _spectrum(r: Float[np.ndarray, " n"], count: int, period: float) -> tuple[Any, Any]:
    """Return frequencies, and the mean square of the samples that counted which each line carries (Parseval)."""
    from scipy.fft import rfft  # deferred: scipy is slow to load

    line = np.abs(np.asarray(rfft(r))) ** 2
    line[1 : (r.size + 1) // 2] *= 2.0
    return np.arange(line.size) / (r.size * period), line / (r.size * count)


def _evidence(rows: tuple[Ranked, ...]) -> str:
    margin = rows[1].effective_bic - rows[0].effective_bic
    if margin <= MENTION or any(_objects(row) for row in rows[1:]):
        return "undecided"
    return "very strong" if margin > VERY_STRONG else "strong" if margin > STRONG else "positive"


def _objects(row: Ranked) -> bool:
    """Tell whether held-out samples are predicted better than by the fit that the likelihood prefers."""
    return row.held_out_ratio is not None and row.held_out_ratio < 1.0 / WORSE


def _sentences(
    rows: tuple[Ranked, ...], evidence: str, bands: tuple[Band, ...], fits: Mapping[str, Fit]
) -> tuple[str, ...]:
    first, second = rows[0], rows[1]
    margin, whole = second.effective_bic - first.effective_bic, second.bic - first.bic
    counted = f"BIC differs by {margin:.3g} with the effective number of samples, {whole:+.3g} with all"
    objections = [row.name for row in rows[1:] if _objects(row)]
    if objections:
        told = [f"undecided: the likelihood prefers {first.name} ({counted}), held-out samples {', '.join(objections)}"]
    elif evidence == "undecided":
        told = [f"undecided between {first.name} and {second.name}: {counted}; excite or measure what tells them apart"]
    else:
        told = [f"{first.name} is preferred, with {evidence} evidence against {second.name}: {counted}"]
    if first.held_out_ratio is None:
        told.append("no samples were held out: fit with holdout=0.2 to see whether the best repeats")
    told += [_why(row.name, first.name, bands) for row in rows[1:] if row.effective_bic - first.effective_bic > MENTION]
    told += [
        f"{name} ended as {fit.status.replace('_', ' ')} and may explain more than was found: {fit.message}"
        for name, fit in fits.items()
        if not fit.ok
    ]
    return tuple(told)


def _why(loser: str, winner: str, bands: tuple[Band, ...]) -> str:
    """Say in which output and octave a fit falls short most, in units of the winner's residual."""
    totals: dict[tuple[str, str], float] = {}
    for band in bands:
        key = (band.experiment, band.output)
        totals[key] = totals.get(key, 0.0) + band.power[winner]

    def excess(band: Band) -> float:
        return (band.power[loser] - band.power[winner]) / max(totals[band.experiment, band.output], 1e-300)

    worst = max(bands, key=excess)
    rms = [float(np.sqrt(worst.power[name])) for name in (loser, winner)]
    return (
        f"{loser} falls short most in {worst.experiment}.{worst.output} from {worst.low_hz:.3g} to "
        f"{worst.high_hz:.3g} Hz: a residual of {rms[0]:.3g} {worst.unit} against {rms[1]:.3g} {worst.unit}"
    )
