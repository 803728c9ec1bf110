"""Advice on fits in words: diagnostics, with the tests of the residuals, and which of several fits is preferred."""

from __future__ import annotations

from seaopt.estimation import Diagnostics, Ranking
from seaopt.estimation.advice.diagnostics import SIGNIFICANCE
from seaopt.estimation.advice.forecasts import Percent
from seaopt.formatting import format_number
from seaopt.reporting.sections.data import Section, Table
from seaopt.units import unit_after

NO_PROBLEM = (
    "No problem found: the residuals follow no input, and held-out samples, if any, are predicted about as well as "
    "those that were used."
)


def format_percent(percent: Percent) -> str:
    """Return a fit in percent, that of the held-out samples in brackets."""
    held_out = "" if percent.held_out is None else f" ({format_number(percent.held_out)})"
    return format_number(percent.used) + held_out


def describe(result: Diagnostics | Ranking) -> list[Section]:
    """Return problems, tests and sources of information of a fit, or how several of them compare."""
    return _describe_ranking(result) if isinstance(result, Ranking) else _describe_diagnostics(result)


def _describe_diagnostics(diagnostics: Diagnostics) -> list[Section]:
    """Return the problems, a row for each output and input, and the share of information of each experiment."""
    rows: list[tuple[str, ...]] = []
    for name, outputs in diagnostics.outputs.items():
        for output, figures in outputs.items():
            percents = format_percent(figures.free_run), format_percent(figures.one_step)
            head = (name, output, *percents, format_number(figures.whiteness_p, 2))
            inputs = [(u, str(each.worst_lag), format_number(each.worst, 2)) for u, each in figures.inputs.items()]
            for row in inputs or [("–", "", "")]:
                rows.append((*head, *row))
                head = ("",) * len(head)
    fixed = tuple(
        f"{name} = {test.value:.6g}{unit_after(test.unit)} held fixed: chi-square {test.chi2:.3g}; one step with it "
        f"free goes to {test.preferred:.4g}"
        for name, test in diagnostics.held.items()
        if test.p < SIGNIFICANCE
    )
    heads = ("experiment", "output", "simulated %", "one sample ahead %", "whiteness p")
    heads = (*heads, "input", "worst lag", "over bound")
    tests = Table(label="Tests of the residuals", head=heads, rows=tuple(rows), align="<<>>><>>")
    sections = [
        Section(
            title="Diagnostics",
            part="diagnostics",
            sentences=diagnostics.sentences or (NO_PROBLEM,),
            tables=(tests,),
            remarks=(
                *fixed,
                "In brackets: held out. Even a residual that follows nothing exceeds its bound at some lags; the "
                f"sentences above allow for that. AIC {diagnostics.aic:.8g}, BIC {diagnostics.bic:.8g}.",
            ),
        )
    ]
    sources = diagnostics.leverage
    if len(sources) > 1:
        names = next(iter(sources.values())).parameters
        shares = tuple(
            (name, *(format_number(100 * share, 3) for share in (source.whole, *source.parameters.values())))
            for name, source in sources.items()
        )
        head = ("experiment", "all %", *(f"{name} %" for name in names))
        table = Table(head=head, rows=shares, align="<".ljust(len(head), ">"))
        sections.append(Section(title="Information by experiment", part="diagnostics", tables=(table,)))
    return sections


def _describe_ranking(ranking: Ranking) -> list[Section]:
    """Return the verdict with its reasons, and a row per fit; criteria are counted from those of the best."""
    best = ranking.rows[0]
    rows = tuple(
        (
            row.name,
            *(
                f"{getattr(row, criterion) - getattr(best, criterion):+.6g}"
                for criterion in ("effective_bic", "bic", "aic")
            ),
            str(row.unknowns),
            ", ".join(
                f"{name}.{output} {format_percent(percent)}"
                for name, outputs in row.free_run.items()
                for output, percent in outputs.items()
            ),
        )
        for row in ranking.rows
    )
    head = ("fit", "effective BIC", "BIC", "AIC", "unknowns", "simulated (held out) %")
    table = Table(label="Fits compared", head=head, rows=rows, align="<>>>><")
    return [
        Section(
            title="Ranking",
            part="ranking",
            sentences=ranking.sentences,
            tables=(table,),
            remarks=(
                f"The residuals are coloured: {format_number(ranking.effective_samples, 3)} of {ranking.samples} "
                "samples count as independent. Differences of BIC beyond 10 are very strong evidence.",
            ),
        )
    ]
