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

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import field
from functools import partial
from itertools import chain, pairwise
from typing import Any

import numpy as np

from seaopt.codec import Key, to_content
from seaopt.errors import EstimationError
from seaopt.estimation.advice.forecasts import (
    Percent,
    compute_percent,
    filter_to_band,
    measure_length,
    simulate_freely,
    split_samples,
)
from seaopt.estimation.problem.correlation import autocorrelation
from seaopt.estimation.problem.fit_experiment import FitOutput
from seaopt.estimation.problem.fit_problem import FitProblem
from seaopt.estimation.problem.residual_statistics import ResidualsByExperiment
from seaopt.estimation.problem.shapes import Signal
from seaopt.estimation.result.fit_result import Fit
from seaopt.formatting import tell_apart
from seaopt.records import PlotAccessor, Worded, record

MENTION, STRONG, VERY_STRONG = 2.0, 6.0, 10.0  # differences of BIC (Kass and Raftery)
CONTRADICTION = 1.02  # ratio of held-out residuals that contradicts the likelihood
OCTAVES = 12  # at most, below the Nyquist frequency
LOWEST_LINES = 4  # lines of the spectrum that the lowest octave has at least


@record(eq=False)
class Ranked:
    """One fit in a ranking."""

    name: str  # its label
    aic: float  # aic, bic: with every sample counted
    bic: float
    effective_bic: float  # with the effective number of samples, up to a constant that all fits share
    unknowns: int  # sigmas included
    # Held-out residual over that of the first in the ranking, geometric mean over outputs; None if nothing is held out
    held_out_ratio: float | None
    free_run: Mapping[str, Mapping[str, Percent]]  # fit of the simulation, over the samples used and those held out


@record(eq=False)
class OctavePower:
    """Power of the residuals in one octave of one output: mean squares by fit, in the output's unit squared."""

    json_keys = ("experiment", "output", "low_hz", "high_hz", Key(field="power_unit", name="unit"), "power")

    experiment: str
    output: str
    unit: str
    low_hz: float
    high_hz: float
    power: Mapping[str, float]

    @property
    def power_unit(self) -> str:
        """The unit of the power."""
        return f"({self.unit})^2"


@record(eq=False, repr=False)
class Ranking(Worded):
    """Fits ranked by how well they explain the same logs; ``print(ranking)`` is a report.

    Parameters
    ----------
    rows : tuple of Ranked
        Best first, by effective BIC.
    preferred : str or None
        The first's name; None if undecided.
    evidence : str
        For it, against the next: "very strong", "strong", "positive" or "undecided".
    samples, effective_samples : int, float
        Of all outputs.
    bands : tuple of OctavePower
        Residual power per octave, of every output.
    sentences : tuple of str
        The verdict, and why.
    fits : mapping of name to Fit
        In the order of `rows`.
    """

    json_keys = (
        *("preferred", "evidence", "samples", "effective_samples", "sentences"),
        *(Key(field="rows", name="ranking"), "bands"),
    )
    plot = PlotAccessor()

    rows: tuple[Ranked, ...]
    preferred: str | None
    evidence: str
    samples: int
    effective_samples: float
    bands: tuple[OctavePower, ...]
    sentences: tuple[str, ...]
    fits: Mapping[str, Fit] = field(repr=False)

    @property
    def decisive(self) -> bool:
        """Whether the evidence is very strong: a difference of BIC beyond 10, and no objection by held-out samples."""
        return self.evidence == "very strong"

    def to_dict(self) -> dict[str, Any]:
        """Return the content as numbers, lists and text."""
        return to_content(self)


def compare(fits: Sequence[Fit] | Mapping[str, Fit]) -> Ranking:
    """Rank fits of several models, or by several methods, to the same logs (`Ranking`).

    Parameters
    ----------
    fits : sequence of Fit, or mapping of name to Fit
        Two or more, as `fit` returned them, from the same experiments: the same logs, outputs, samples used, band and
        loss. In a sequence each is named after its plants.

    Raises
    ------
    EstimationError
        Fewer than two fits, one that was read from a file, or fits to different data.

    Examples
    --------
    A load cell at link 2 distinguishes the models of the drive:

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
    named = _name_apart(fits)
    minima = {name: fit.require_minimum("compare") for name, fit in named.items()}
    problems = {name: minimum.problem for name, minimum in minima.items()}
    _check(problems)
    residuals = {name: minimum.residuals() for name, minimum in minima.items()}
    free = {name: simulate_freely(minimum, residuals[name]) for name, minimum in minima.items()}
    shared = next(iter(problems.values()))
    effective = {
        output.label: min(_count_effective(output, residual) for residual in residuals.values())
        for output in shared.outputs
    }
    bic = {name: _compute_bic(fit, problems[name], residuals[name], effective) for name, fit in named.items()}
    order = sorted(named, key=lambda name: bic[name])
    rows = tuple(
        Ranked(
            name=name,
            aic=named[name].aic,
            bic=named[name].bic,
            effective_bic=bic[name],
            unknowns=named[name].all_unknowns,
            free_run=problems[name].map_outputs(partial(compute_percent, residuals=free[name])),
            held_out_ratio=_compare_held_out(shared, free[name], free[order[0]]),
        )
        for name in order
    )
    octaves = (
        _compute_octaves(places, {name: residuals[name] for name in order})
        for places in zip(*(problems[name].outputs for name in order), strict=True)
    )
    bands = tuple(chain.from_iterable(octaves))
    evidence = _weigh_evidence(rows)
    return Ranking(
        rows=rows,
        preferred=None if evidence == "undecided" else order[0],
        evidence=evidence,
        samples=named[order[0]].samples,
        effective_samples=float(sum(effective.values())),
        bands=bands,
        sentences=_explain(rows, evidence, bands, named),
        fits={name: named[name] for name in order},
    )


def _name_apart(fits: Sequence[Fit] | Mapping[str, Fit]) -> dict[str, Fit]:
    """Return the fits under names of their own."""
    if isinstance(fits, Fit):
        raise EstimationError("compare takes two fits or more; put them in brackets, [one, other]")
    named: dict[str, Fit] = {}
    for label, fit in fits.items() if isinstance(fits, Mapping) else ((None, fit) for fit in fits):
        if not isinstance(fit, Fit):
            raise EstimationError(f"compare got a {type(fit).__name__}; give results of fit")
        if label is None:
            label = " + ".join(dict.fromkeys(experiment.plant.name for experiment in fit.experiments)) or "fit"
        named[tell_apart(label, named, " ")] = fit
    if len(named) < 2:
        raise EstimationError(f"compare got {len(named)} fit; give two or more to the same logs")
    return named


def _check(problems: Mapping[str, FitProblem]) -> None:
    """Refuse fits to data that are not the same: their likelihoods are not of the same thing."""
    (first, reference), *further = problems.items()
    for name, other in further:
        difference = next(_find_differences(reference, other), None)
        if difference:
            raise EstimationError(
                f'compare: "{name}" and "{first}" differ in {difference}, and likelihoods of other data cannot be '
                "compared; fit both to the same experiments with the same holdout, band_hz and loss"
            )


def _find_differences(first: FitProblem, other: FitProblem) -> Iterator[str]:
    """Yield what differs in the data of two problems."""
    a_names, b_names = (", ".join(e.name for e in problem.experiments) for problem in (first, other))
    settings: dict[str, tuple[Any, Any]] = {
        "their experiments": (a_names, b_names),
        "band_hz": (first.band_hz, other.band_hz),
        "their loss": (first.loss, other.loss),
        "holdout": (first.holdout, other.holdout),
    }
    yield from (f"{what} ({a}; {b})" for what, (a, b) in settings.items() if a != b)
    for a, b in zip((e.data for e in first.experiments), (e.data for e in other.experiments), strict=True):
        if a.outputs != b.outputs:
            yield f"the outputs of {a.name} ({', '.join(a.outputs)}; {', '.join(b.outputs)})"
        channels = [*a.outputs, *(u for u in a.plant.inputs if u in a.log.signals and u in b.plant.inputs)]
        same = a.log is b.log or (
            np.array_equal(a.log.time, b.log.time)
            and all(name in b.log.signals and np.array_equal(a.log[name], b.log[name], True) for name in channels)
        )
        if not same:
            yield f"the log of {a.name}"


def _count_effective(output: FitOutput, residuals: ResidualsByExperiment) -> float:
    """Return how many independent samples tell as much of the variance of an output's residual."""
    r = np.concatenate(residuals[output.experiment.name].weighted_of(output.name))
    count = int(np.count_nonzero(r))
    lags = int(min(max(32, 4 * np.sqrt(r.size)), r.size - 1))
    squares = autocorrelation(r, lags)[1:] ** 2 - 1.0 / max(count, 1)  # what white noise leaves is taken off
    return count / (1.0 + 2.0 * max(float(np.sum(squares)), 0.0))


def _compute_bic(
    fit: Fit, problem: FitProblem, residuals: ResidualsByExperiment, effective: Mapping[str, float]
) -> float:
    """Return the BIC with the effective number of samples of each output."""
    total = 0.0
    for output in problem.outputs:
        r = np.concatenate(residuals[output.experiment.name].weighted_of(output.name)) * output.sigma
        power = float(np.sum(r**2)) / max(np.count_nonzero(r), 1)
        total += effective[output.label] * float(np.log(max(power, 1e-300)))
    return total + fit.all_unknowns * float(np.log(max(sum(effective.values()), 1.0)))


def _compare_held_out(problem: FitProblem, other: ResidualsByExperiment, best: ResidualsByExperiment) -> float | None:
    """Return the ratio of held-out residuals to the best fit's, geometric mean over outputs."""
    logs: list[float] = []
    for output in problem.outputs:
        _, held_out = split_samples(output)
        if np.any(held_out):
            raw = [residuals[output.experiment.name].raw_of(output.name) for residuals in (other, best)]
            signals = [filter_to_band(output.experiment, rows)[held_out] for rows in raw]
            lengths = [max(measure_length(signal), 1e-150) for signal in signals]
            logs.append(float(np.log(lengths[0] / lengths[1])))
    return float(np.exp(np.mean(logs))) if logs else None


def _compute_octaves(places: Sequence[FitOutput], residuals: Mapping[str, ResidualsByExperiment]) -> list[OctavePower]:
    """Return the power that each likelihood sees of an output's residual (`places`: in each fit), in octaves."""
    output, period, most = places[0], places[0].experiment.period, 1
    spectra: dict[str, tuple[Any, Any]] = {}
    for fitted, (name, residual) in zip(places, residuals.items(), strict=True):
        r = np.concatenate(residual[fitted.experiment.name].weighted_of(fitted.name)) * fitted.sigma
        count = max(int(np.count_nonzero(r)), 1)
        spectra[name], most = _compute_spectrum(r, count, period), max(most, count)
    edges = [0.5 / period]
    while len(edges) <= OCTAVES and edges[-1] / 2.0 > LOWEST_LINES / (most * period):
        edges.append(edges[-1] / 2.0)
    edges[-1] = 0.0
    octaves = [
        OctavePower(
            experiment=output.experiment.name,
            output=output.name,
            unit=output.unit,
            low_hz=low,
            high_hz=high,
            power={
                name: float(np.sum(density[(f <= high) & ((f > low) | (low == 0.0))]))
                for name, (f, density) in spectra.items()
            },
        )
        for high, low in pairwise(edges)
    ]
    return octaves[::-1]


def _compute_spectrum(r: Signal, count: int, period: float) -> tuple[Any, Any]:
    """Return frequencies, and the mean square of the samples that counted which each line carries (Parseval)."""
    from scipy.fft import rfft  # deferred: scipy is slow to load

    line = np.abs(np.asarray(rfft(r))) ** 2
    line[1 : (r.size + 1) // 2] *= 2.0
    return np.arange(line.size) / (r.size * period), line / (r.size * count)


def _weigh_evidence(rows: tuple[Ranked, ...]) -> str:
    margin = rows[1].effective_bic - rows[0].effective_bic
    if margin <= MENTION or any(_contradicts(row) for row in rows[1:]):
        return "undecided"
    return "very strong" if margin > VERY_STRONG else "strong" if margin > STRONG else "positive"


def _contradicts(row: Ranked) -> bool:
    """Tell whether held-out samples are predicted better than by the fit that the likelihood prefers."""
    return row.held_out_ratio is not None and row.held_out_ratio < 1.0 / CONTRADICTION


def _explain(
    rows: tuple[Ranked, ...], evidence: str, bands: tuple[OctavePower, ...], fits: Mapping[str, Fit]
) -> tuple[str, ...]:
    first, second = rows[0], rows[1]
    margin, whole = second.effective_bic - first.effective_bic, second.bic - first.bic
    counted = f"BIC differs by {margin:.3g} with the effective number of samples, {whole:+.3g} with all"
    objections = [row.name for row in rows[1:] if _contradicts(row)]
    if objections:
        rivals = ", ".join(objections)
        verdict = f"undecided: the likelihood prefers {first.name} ({counted}), held-out samples {rivals}"
    elif evidence == "undecided":
        verdict = f"undecided between {first.name} and {second.name}: {counted}; excite or measure where they differ"
    else:
        verdict = f"{first.name} is preferred, with {evidence} evidence against {second.name}: {counted}"
    sentences = [verdict]
    if first.held_out_ratio is None:
        sentences.append("no samples were held out: fit with holdout=0.2 to see whether the best repeats")
    sentences += [
        _explain_loss(row.name, first.name, bands)
        for row in rows[1:]
        if row.effective_bic - first.effective_bic > MENTION
    ]
    sentences += [
        f"{name} ended as {fit.status.replace('_', ' ')} and may explain more than was found: {fit.message}"
        for name, fit in fits.items()
        if fit.status != "converged"
    ]
    return tuple(sentences)


def _explain_loss(loser: str, winner: str, bands: tuple[OctavePower, ...]) -> str:
    """Return in which output and octave a fit falls short most, in units of the winner's residual."""
    totals: dict[tuple[str, str], float] = {}
    for band in bands:
        key = (band.experiment, band.output)
        totals[key] = totals.get(key, 0.0) + band.power[winner]

    def excess(band: OctavePower) -> float:
        return (band.power[loser] - band.power[winner]) / max(totals[band.experiment, band.output], 1e-300)

    worst = max(bands, key=excess)
    rms = [float(np.sqrt(worst.power[name])) for name in (loser, winner)]
    return (
        f"{loser} falls short most in {worst.experiment}.{worst.output} from {worst.low_hz:.3g} to "
        f"{worst.high_hz:.3g} Hz: a residual of {rms[0]:.3g} {worst.unit} against {rms[1]:.3g} {worst.unit}"
    )
