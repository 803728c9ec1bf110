"""Frequency responses of experiments in words: a row per response, and the actuator as the second order sees it."""

from __future__ import annotations

from seaopt.formatting import MISSING, format_number
from seaopt.frequency import DriveEstimate, Pair, Survey
from seaopt.reporting.responses import Responses
from seaopt.reporting.sections.data import Section, Table

HEAD = ("response", "coherent", "peak", "gain", "f_n", "zeta", "form", "file", "fit")
COLUMNS = (
    "coherent: band of coherence above 0.8; peak and natural frequency f_n in Hz; gain, f_n and damping ratio zeta are "
    "those of the fitted second-order form K/(s² + a s + b); form, file, fit: distance from H1 of that form, of the "
    "model with the file's values and with the fitted values, in standard deviations of H1"
)


def describe(responses: Responses) -> list[Section]:
    """Return a section per experiment, and details of the second-order forms."""
    sections: list[Section] = []
    for name, survey in responses.surveys.items():
        sections.append(
            Section(
                title=name,
                tables=(
                    Table(
                        head=HEAD,
                        rows=tuple(_format_pair(responses, name, survey, pair) for pair in survey.pairs),
                        align="<<".ljust(len(HEAD), ">"),
                    ),
                ),
                remarks=tuple(
                    line
                    for pair in survey.pairs
                    if (drive := survey.drive(pair, responses.guess)) is not None
                    for line in _describe_drive(survey, pair, drive)
                ),
            )
        )
    forms = tuple(line.strip() for form in responses.list_forms() for line in repr(form).splitlines())
    return [
        *sections,
        Section(title="Columns", sentences=(COLUMNS,)),
        *([Section(title="Second-order forms", sentences=forms, folded=True)] if forms else []),
    ]


def _format_pair(responses: Responses, name: str, survey: Survey, pair: Pair) -> tuple[str, ...]:
    band, peak, form = pair.good_band_hz, pair.peak, pair.second_order
    figures = (form.static_gain, form.natural_frequency_hz, form.damping_ratio) if form is not None else ()
    misfits = (
        form.misfit if form is not None else None,
        pair.misfit(survey.model(pair, responses.guess)),
        responses.fitted_misfit(name, pair),
    )
    return (
        pair.name,
        f"{band[0]:.2g}–{band[1]:.3g}" if band is not None else "none",
        format_number(None if peak is None else peak.frequency_hz, 3),
        *(format_number(figure.value, 3) for figure in figures),
        *([MISSING] * (3 - len(figures))),
        *(format_number(misfit, 3) for misfit in misfits),
    )


def _describe_drive(survey: Survey, pair: Pair, drive: DriveEstimate) -> tuple[str, ...]:
    form, spring = pair.second_order, survey.plant.spring
    assert form is not None and spring is not None
    m_k, b_m = spring.mass, spring.damping
    return (
        f"{pair.name} in second order, per unit of motor effort: "
        f"{drive.K.value:.5g}/(s² + {form.a.value:.4g} s + {form.b.value:.5g})",
        f"with k known: {m_k} = {drive.m_k}, {b_m} = {drive.b_m}, efficiency {drive.efficiency}",
        f"K and b averaged, as the paper does: {m_k} = {drive.m_k_averaged}, {b_m} = {drive.b_m_averaged}",
    )
