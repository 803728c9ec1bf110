"""The frequency responses of a fit's experiments beside the fitted model: how far they differ, for the report."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from itertools import combinations

import numpy as np

from seaopt.errors import LogError
from seaopt.estimation import Experiment, Fit
from seaopt.frequency import Pair, Survey, h1, survey
from seaopt.frequency.survey import ResponseFunction
from seaopt.logs import Log
from seaopt.parameters import Parameter, ParameterSet
from seaopt.reporting.figures.panel import Panel
from seaopt.reporting.figures.response import Curve, response_panel
from seaopt.simulation import Clock
from seaopt.units import divide_units

GIVEN, FITTED, FORM = "#d55e00", "#0072b2", "#009e73"
_LOOKS = ((FITTED, "-"), (GIVEN, "-."), ("#cc79a7", ":"), ("#e69f00", "--"))  # of models, one after the other


def experiment_survey(experiment: Experiment, fit: Fit | None = None, stretch_s: float | None = None) -> Survey:
    """Return the frequency responses of an experiment.

    Parameters
    ----------
    experiment : Experiment
        With its log.
    fit : Fit, optional
        Its delay and gains take the place of the experiment's own.
    stretch_s : float, optional
        Length of a window, as of `seaopt.h1`.

    Raises
    ------
    LogError
        The log does not allow an estimate.
    """
    view = view_sensors(experiment, fit)
    estimate = survey(
        experiment.plant,
        experiment.log,
        outputs=experiment.outputs,
        clock=view.clock,
        gain=view.gain,
        stretch_s=stretch_s,
    )
    return replace(estimate, adapt=experiment.apply_own)


def view_sensors(experiment: Experiment, fit: Fit | None = None) -> Survey:
    """Return an experiment's plant as its sensors see it, with a fit's delay and gains, without estimates."""
    nuisance = fit.nuisance.get(experiment.name) if fit is not None else None
    delay = experiment.delay_s
    free = isinstance(delay, Parameter) and delay.free and nuisance is None
    delay_s = nuisance.delay_s if nuisance is not None else _value(delay)
    clock = Clock(period=experiment.log.period, hold=experiment.hold, delay_s=delay_s, delay_free=free)
    gain = nuisance.gain if nuisance is not None else {name: _value(gain) for name, gain in experiment.gain.items()}
    return Survey(plant=experiment.plant, clock=clock, gain=gain, pairs=(), adapt=experiment.apply_own)


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


def response_panels(
    experiment: Experiment, measured: Survey, fits: Mapping[str, Fit], *, pair: str | None = None
) -> list[Panel]:
    """Return a panel for every pair of an experiment, and for outputs of one unit over each other, with models on top.
    `experiment`: of the first fit, with its measurement. `fits`: drawn over it, each has an experiment of that name.
    `pair`: the only one wanted, by its name.
    """
    views: dict[str, tuple[Survey, Fit]] = {}
    for label, fit in fits.items():
        counterpart = next((each for each in fit.experiments if each.name == experiment.name), None)
        if counterpart is not None:
            views[label] = (view_sensors(counterpart, fit), fit)
    panels: list[Panel] = []
    for measurement in (*measured.pairs, *_pair_outputs(experiment.log, measured)):
        if pair not in (None, measurement.name):
            continue
        curves = [
            Curve(label=label, response=_respond(view, measurement, measured, fit), colour=colour, style=style)
            for (label, (view, fit)), (colour, style) in zip(views.items(), _LOOKS * 3, strict=False)
        ]
        curves += _list_forms(measurement)
        name = f"response_{experiment.name}_{measurement.output}_{measurement.source}"
        panels.append(response_panel(name, f"{experiment.name}: {measurement.name}", measurement, curves))
    return panels


def _list_forms(pair: Pair) -> list[Curve]:
    if pair.second_order is None:
        return []
    return [Curve(label="second-order fit", response=pair.second_order.response, colour=FORM, style="--")]


def _pair_outputs(log: Log, measured: Survey) -> list[Pair]:
    """Return outputs of one unit over each other, which one input moves: F1/F2 tells where a load cell may sit."""
    units = measured.plant.outputs
    names = list(dict.fromkeys(pair.output for pair in measured.pairs))
    if len({pair.source for pair in measured.pairs}) != 1:
        return []
    pairs: list[Pair] = []
    for first, second in combinations(names, 2):
        if units[first] == units[second] and np.ptp(log[second]) > 0.0:
            unit = divide_units(units[first], units[second])
            estimate = h1(log[second], log[first], log.period)
            pairs.append(
                Pair(
                    source=second,
                    output=first,
                    unit=unit,
                    estimate=estimate,
                    good_band_hz=None,
                    peak=None,
                    second_order=None,
                )
            )
    return pairs


def _respond(view: Survey, pair: Pair, measured: Survey, fit: Fit) -> ResponseFunction:
    """Return a model's response from input to output, or from one output to another, both of them from the input."""
    if pair.source in view.plant.inputs:
        return view.model(pair, fit.parameters)
    by_output = {each.output: view.model(each, fit.parameters) for each in measured.pairs}
    return lambda f: by_output[pair.output](f) / by_output[pair.source](f)


def survey_panels(
    surveys: Mapping[str, Survey],
    given: ParameterSet | None = None,
    fitted: Mapping[str, tuple[Survey, Fit]] | None = None,
) -> list[Panel]:
    """Return a panel for every pair of the surveys with its second-order fit, the plant as given, and as fitted.
    `given`: values before a fit. `fitted`: by experiment the survey under the fit's delay and gains, and the fit.
    """
    panels: list[Panel] = []
    for name, measured in surveys.items():
        for pair in measured.pairs:
            curves: list[Curve] = []
            if fitted is not None and name in fitted:
                view, fit = fitted[name]
                curves.append(Curve(label="model, fitted", response=view.model(pair, fit.parameters), colour=FITTED))
            if given is not None:
                model = measured.model(pair, given)
                curves.append(Curve(label="model, the file's values", response=model, colour=GIVEN, style="-."))
            curves += _list_forms(pair)
            panels.append(response_panel(f"{name}_{pair.name}", f"{name}: {pair.name}", pair, curves))
    return panels
