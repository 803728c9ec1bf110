"""Another log in words: how well each of its outputs is predicted, and whether its own values are those of the fit."""

from __future__ import annotations

from seaopt.estimation import LogComparison, ModelledOutputs
from seaopt.formatting import format_number
from seaopt.reporting.sections.data import Commands, Reason, Section, Step, Table, Verdict
from seaopt.units import unit_after

APART = 3.0  # standard deviations
ALIKE = 1.2  # times an amplitude, within which another is the same


def judge(result: ModelledOutputs | LogComparison, commands: Commands) -> Verdict | None:
    """Return the verdict of a comparison, which values the log contradicts; a prediction alone has none."""
    if isinstance(result, ModelledOutputs):
        return None
    comparison = result
    distances = comparison.distances
    if comparison.met is None:
        return Verdict(met=False, text=f"{comparison.name}: undecided, this log alone does not determine the values")
    if comparison.met:
        within = format_number(max(distances.values(), default=0.0), 2)
        return Verdict(met=True, text=f"{comparison.name}: its own values are the fit's, within {within} std")
    reasons = list[Reason]()
    if not comparison.fit_met:
        reasons.append(Reason(what="the fit", where="is not met, and its values are not to be used"))
    if not comparison.explained:
        left = f"{comparison.log.excess:.3g} times its sensor's noise is left with values of its own"
        reasons.append(Reason(what="the model", where=f"{left}, {comparison.excess:.3g} on the logs of the fit"))
    apart = sorted((name for name, each in distances.items() if each > APART), key=lambda name: -distances[name])
    reasons += [
        Reason(
            what=name,
            where=f"{comparison.log.values[name][0]:.4g} by this log alone, {comparison.values[name][0]:.4g} by the "
            f"fit: {distances[name]:.2g} std apart{_describe_amplitude(comparison)}",
        )
        for name in apart
    ]
    agrees = comparison.explained and not apart
    return Verdict(
        met=False,
        text=f"{comparison.name}: {'its values agree, on a fit that is not met' if agrees else 'contradicts the fit'}",
        reasons=tuple(reasons),
        next=(Step(text=_advise(comparison)),) if apart else (),
    )


def describe(result: ModelledOutputs | LogComparison) -> list[Section]:
    """Return the scores of a prediction's outputs, or the values of a comparison."""
    return _describe_scores(result) if isinstance(result, ModelledOutputs) else _describe_comparison(result)


def _describe_scores(prediction: ModelledOutputs) -> list[Section]:
    """Return the scores of the outputs."""
    rows = tuple(
        (
            name,
            f"{row['fit_percent']:.2f}",
            format_number(row["band_fit_percent"]),
            f"{row['rms_residual']:.4g}",
            unit_after(row["unit"]).strip(),
        )
        for name, row in prediction.to_dict().items()
    )
    return [
        Section(
            title=f"Prediction of {prediction.name}",
            aside=f"{prediction.time.size} samples, with initial states and offsets of its own",
            tables=(Table(head=("output", "fit %", "in the band", "residual", ""), rows=rows, align="<>>><"),),
        )
    ]


def _describe_comparison(comparison: LogComparison) -> list[Section]:
    """Return the values of both."""
    distances = comparison.distances
    rows = tuple(
        (
            name,
            f"{comparison.values[name][0]:.6g}",
            f"± {comparison.values[name][1]:.2g}",
            f"{value:.6g}",
            f"± {std:.2g}",
            format_number(distances[name], 2),
        )
        for name, (value, std) in comparison.log.values.items()
    )
    head = ("parameter", "fit", "std", "this log", "std", "std apart")
    table = Table(label="Values by the fit and by this log alone", head=head, rows=rows, align="<>>>>>")
    left = f"{format_number(comparison.log.excess, 2)} times its sensor's noise left"
    return [Section(title=f"Values by {comparison.name} alone", aside=left, tables=(table,))]


def _advise(comparison: LogComparison) -> str:
    """Return what to do about a contradiction: what a model lacks of friction, say, is the same at one amplitude."""
    both = "fit both logs: values of one model then have the interval that both allow"
    ratio = _compare_amplitudes(comparison)
    if ratio is None or not 1.0 / ALIKE < ratio < ALIKE:
        return both
    return f"at one amplitude the actuator itself differs: another one, a changed one, or a warmer one; if not, {both}"


def _describe_amplitude(comparison: LogComparison) -> str:
    ratio = _compare_amplitudes(comparison)
    return "" if ratio is None else f", at {format_number(ratio, 2)} times the amplitude"


def _compare_amplitudes(comparison: LogComparison) -> float | None:
    """Return the log's amplitude over the largest that was fitted; None where none is known."""
    if not comparison.amplitudes:
        return None
    return comparison.log.amplitude / max(max(comparison.amplitudes), 1e-300)
