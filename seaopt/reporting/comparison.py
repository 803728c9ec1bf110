"""The frequency responses of a fit's experiments beside the fitted model: how far they differ, for the report."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from seaopt.errors import LogError
from seaopt.estimation import DerivedFigure, Experiment, Fit
from seaopt.formatting import join_words
from seaopt.frequency import DriveEstimate, Pair, Survey, Uncertain, survey
from seaopt.parameters import Parameter, ParameterSet
from seaopt.plants.friction import has_friction
from seaopt.reporting.bode import Curve, Panel, bode_figure
from seaopt.simulation import Clock

if TYPE_CHECKING:
    from matplotlib.figure import Figure

GIVEN, FITTED, FORM = "#d55e00", "#0072b2", "#009e73"
FAR = 3.0  # standard deviations: what lies farther is said to differ


def experiment_survey(experiment: Experiment, fit: Fit | None = None, stretch_s: float | None = None) -> Survey:
    """Return the frequency responses of an experiment.

    Parameters
    ----------
    experiment : Experiment
        With its log.
    fit : Fit, optional
        Its delay and gains take the place of the experiment's own.
    stretch_s : float, optional
        Length of a stretch, as of `seaopt.h1`.

    Raises
    ------
    LogError
        The log does not allow an estimate.

    """
    nuisance = fit.nuisance.get(experiment.name) if fit is not None else None
    delay = experiment.delay_s
    free = isinstance(delay, Parameter) and delay.free and nuisance is None
    known = nuisance.delay_s if nuisance is not None else _value(delay)
    clock = Clock(period=experiment.log.period, hold=experiment.hold, delay_s=known, delay_free=free)
    gain = nuisance.gain if nuisance is not None else {name: _value(gain) for name, gain in experiment.gain.items()}
    estimate = survey(
        experiment.plant, experiment.log, outputs=experiment.outputs, clock=clock, gain=gain, stretch_s=stretch_s
    )
    return replace(estimate, adapt=experiment.apply_own)


def _value(number: float | Parameter) -> float:
    return number.value if isinstance(number, Parameter) else number


def fit_surveys(fit: Fit) -> dict[str, Survey]:
    """Return the frequency responses of a fit's experiments, without those whose log does not allow one."""
    surveys: dict[str, Survey] = {}
    for experiment in fit.experiments:
        try:
            surveys[experiment.name] = experiment_survey(experiment, fit)
        except LogError:
            continue
    return surveys


def survey_figure(
    surveys: Mapping[str, Survey],
    given: ParameterSet | None = None,
    fitted: Mapping[str, tuple[Survey, Fit]] | None = None,
) -> Figure:
    """Draw every pair of the surveys with its second-order fit, and the plant with given values and as fitted.

    Parameters
    ----------
    surveys : mapping of experiment to Survey
        What to draw.
    given : ParameterSet, optional
        Values before a fit.
    fitted : mapping of experiment to (Survey, Fit), optional
        The survey under the fit's delay and gains, and the fit.

    """
    panels: list[Panel] = []
    for name, measured in surveys.items():
        for pair in measured.pairs:
            curves: list[Curve] = []
            if fitted is not None and name in fitted:
                fitted_survey, fit = fitted[name]
                curves.append(
                    Curve(label="model, fitted", response=fitted_survey.model(pair, fit.parameters), colour=FITTED)
                )
            if given is not None:
                model = measured.model(pair, given)
                curves.append(Curve(label="model, the file's values", response=model, colour=GIVEN, style="-."))
            if pair.second_order is not None:
                form = pair.second_order.response
                curves.append(Curve(label="second-order fit", response=form, colour=FORM, style="--"))
            title = f"{name}: {pair.name} [{pair.unit}]"
            panels.append(Panel(title=title, pair=pair, curves=tuple(curves)))
    return bode_figure(panels)


def sentence(measured: Survey, fit: Fit, experiment: str) -> str:
    """Say in plain words how the frequency responses of the experiment of a name compare with the fit."""
    usable = [pair for pair in measured.pairs if pair.second_order is not None]
    if not usable:
        return "The log is not coherent enough for a comparison in frequency."
    away = [pair.misfit(measured.model(pair, fit.parameters)) for pair in usable]
    names = [pair.name for pair in usable]
    parts = [f"The fitted model lies {_each(away, names)} standard deviations from H1 (rms over its coherent lines)"]
    forms = [pair.second_order.misfit for pair in usable if pair.second_order is not None]
    parts.append(f", the second-order fit {_each(forms, names)}. ")
    if has_friction(measured.plant, measured.adapt(fit.parameters)):
        parts.append("With dry friction a response depends on the amplitude: the model's is that of sliding. ")
    elif max(away) > FAR:
        parts.append("The model lacks something that the log shows. ")
    odd = [name for name, form, model in zip(names, forms, away, strict=True) if form > FAR * max(model, 1.0)]
    if odd:
        parts.append(f"{join_words(odd)} {'is' if len(odd) == 1 else 'are'} not of second order.")
    spring = measured.plant.spring
    if spring is not None and spring.mass is not None and spring.damping is not None:
        figures = (spring.mass, spring.damping)
        derived = {name: fit.derived.get(f"{experiment}.{name}") or fit.derived[name] for name in figures}
        parts += [_reading(pair, drive, derived) for pair, drive in _drives(measured, fit)[:1]]
    return "".join(parts).strip()


def _drives(measured: Survey, fit: Fit) -> list[tuple[Pair, DriveEstimate]]:
    pairs = [(pair, measured.drive(pair, fit.parameters)) for pair in measured.pairs]
    return [(pair, drive) for pair, drive in pairs if drive is not None]


def _reading(pair: Pair, drive: DriveEstimate, derived: Mapping[str, DerivedFigure]) -> str:
    """Say what (16) gives for the sprung mass and the damping, and what the fit gives; `derived` is these two."""
    (m_k, mass), (b_m, damping) = derived.items()
    words = f"{_gap(m_k, drive.m_k, mass)} and {_gap(b_m, drive.b_m, damping)}"
    averaged = ""
    if abs(drive.efficiency.value - 1.0) > FAR * drive.efficiency.std:
        averaged = (
            f" The form's static gain is {drive.efficiency.value:.3f} of what the motor gives, not 1: averaging K and "
            f"b, as the paper does, would give {m_k} = {drive.m_k_averaged.value:.4g} {drive.m_k_averaged.unit} and "
            f"{b_m} = {drive.b_m_averaged.value:.5g} {drive.b_m_averaged.unit}."
        )
    return (
        f"Read as (16) with k known, {pair.name} gives {m_k} = {drive.m_k} and {b_m} = {drive.b_m}; the fit in time "
        f"gives {mass.value:.5g} ± {mass.std:.2g} {mass.unit} and {damping.value:.5g} ± {damping.std:.2g} "
        f"{damping.unit}. So (16) has {words}.{averaged}"
    )


def _gap(name: str, form: Uncertain, fitted: DerivedFigure) -> str:
    away, std = form.value - fitted.value, float(np.hypot(form.std, fitted.std))
    side = "above" if away > 0.0 else "below"
    return f"{name} {abs(away / fitted.value):.2%} {side} it ({abs(away) / max(std, 1e-300):.1f} combined std)"


def _each(values: list[float], names: list[str]) -> str:
    if len(values) == 1:
        return f"{values[0]:.3g}"
    return join_words([f"{value:.3g} ({name})" for value, name in zip(values, names, strict=True)])
