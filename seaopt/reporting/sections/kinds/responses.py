"""Frequency responses of experiments in words: a row per response, its second-order form, and a fit beside them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import chain

import numpy as np

from seaopt.estimation import DerivedFigure, Fit
from seaopt.formatting import MISSING, format_number, join_words
from seaopt.frequency import DriveEstimate, Pair, Survey, Uncertain
from seaopt.plants.friction import has_friction
from seaopt.reporting.responses import Responses
from seaopt.reporting.sections.data import Section, Table

FAR = 3.0  # standard deviations: what lies farther is said to differ
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
        rows = tuple(_format_pair(responses, name, survey, pair) for pair in survey.pairs)
        table = Table(head=HEAD, rows=rows, align="<<".ljust(len(HEAD), ">"))
        drives = ((pair, survey.drive(pair, responses.guess)) for pair in survey.pairs)
        lines = (_describe_drive(survey, pair, drive) for pair, drive in drives if drive is not None)
        sections.append(Section(title=name, tables=(table,), remarks=tuple(chain.from_iterable(lines))))
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


def compare_with_fit(measured: Survey, fit: Fit, experiment: str) -> Iterator[str]:
    """Yield how an experiment's frequency responses compare with the fit, in sentences."""
    forms = {pair: pair.second_order for pair in measured.pairs if pair.second_order is not None}
    if not forms:
        yield "The log is not coherent enough for a comparison in frequency."
        return
    names, away = [pair.name for pair in forms], [pair.misfit(measured.model(pair, fit.parameters)) for pair in forms]
    of_form = [form.misfit for form in forms.values()]
    yield (
        f"The fitted model is {_list_each(away, names)} standard deviations from H1 (rms over its coherent lines), the "
        f"second-order form {_list_each(of_form, names)}."
    )
    if has_friction(measured.plant, measured.adapt(fit.parameters)):
        yield "With dry friction a response depends on the amplitude: the model's is that of sliding."
    elif max(away) > FAR:
        yield "The log shows dynamics that the model does not have."
    odd = [name for name, form, model in zip(names, of_form, away, strict=True) if form > FAR * max(model, 1.0)]
    if odd:
        yield f"{join_words(odd)} {'is' if len(odd) == 1 else 'are'} not of second order."
    yield from _compare_drive(measured, fit, experiment)


def _compare_drive(measured: Survey, fit: Fit, experiment: str) -> Iterator[str]:
    """Yield sprung mass and damping by the second-order form of the first response that tells them, and by the fit."""
    spring = measured.plant.spring
    if spring is None or spring.mass is None or spring.damping is None:
        return
    drives = ((pair, measured.drive(pair, fit.parameters)) for pair in measured.pairs)
    for pair, drive in drives:
        if drive is not None:
            names = (spring.mass, spring.damping)
            fitted = {name: fit.derived.get(f"{experiment}.{name}") or fit.derived[name] for name in names}
            yield from _describe_gap(pair, drive, fitted)
            return


def _describe_gap(pair: Pair, drive: DriveEstimate, fitted: Mapping[str, DerivedFigure]) -> Iterator[str]:
    by_form = dict(zip(fitted, (drive.m_k, drive.b_m), strict=True))
    in_form = [f"{name} = {figure}" for name, figure in by_form.items()]
    in_fit = [f"{name} = {figure.value:.5g} ± {figure.std:.2g} {figure.unit}" for name, figure in fitted.items()]
    yield (
        f"The second-order form K/(s² + a s + b) of {pair.name}, with k known, has {join_words(in_form)}; the fit in "
        f"time has {join_words(in_fit)}."
    )
    yield f"The form differs by {join_words([_compare(name, by_form[name], fitted[name]) for name in fitted])}."
    if abs(drive.efficiency.value - 1.0) > FAR * drive.efficiency.std:
        averaged = dict(zip(fitted, (drive.m_k_averaged, drive.b_m_averaged), strict=True))
        in_mean = [f"{name} = {figure.value:.5g} {figure.unit}" for name, figure in averaged.items()]
        yield (
            f"Its static gain is {drive.efficiency.value:.3f} of what the motor gives, not 1: the mean of its K "
            f"and b in place of b alone would give {join_words(in_mean)}."
        )


def _compare(name: str, form: Uncertain, fitted: DerivedFigure) -> str:
    away, std = form.value - fitted.value, float(np.hypot(form.std, fitted.std))
    return f"{100 * away / fitted.value:+.2f} % of {name} ({abs(away) / max(std, 1e-300):.1f} combined std)"


def _list_each(values: Sequence[float], names: Sequence[str]) -> str:
    if len(values) == 1:
        return f"{values[0]:.3g}"
    return join_words([f"{value:.3g} ({name})" for value, name in zip(values, names, strict=True)])
