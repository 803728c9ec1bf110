"""The expectations of a problem file's [expect] table, one by one, for `seaopt run` and the pytest plugin.

A number is the limit on the bad side of a figure (an Ms at most, a margin at least), a pair of numbers a range. What
has a limit in [controller] is judged with that limit's tolerance, everything else to a millionth.
"""

from __future__ import annotations

import math
import shlex
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, Literal

from seaopt.control import LoopFigures
from seaopt.control.laws.limits import BY_NAME, LIMIT_ROUNDING
from seaopt.formatting import format_band, format_figure, join_words
from seaopt.problem import Problem, Stages
from seaopt.problem.schema import FIGURES, WORST_FIGURES, FiguresTable, RangeTable
from seaopt.records import record
from seaopt.units import factor, unit_after

UNITS = {"hz": "Hz", "db": "dB", "deg": "deg", "s": "s"}  # by how a figure's name ends
LIMITS = {  # of [controller], by figure
    "bandwidth_hz": "bandwidth_hz", "sensitivity_bandwidth_hz": "min_sensitivity_bandwidth_hz", "ms": "max_sensitivity",
    "mt": "max_complementary", "reference_peak": "max_reference_peak", "droop_db": "max_droop_db",
    "disk_margin": "min_disk_margin", "noise_gain": "max_noise_gain",
}  # fmt: skip
BANDS = ("bandwidth_hz", "crossover_hz", "sensitivity_bandwidth_hz", "tracking_band_hz")
FASTER = "another bandwidth_hz in [controller] moves it"
SHOWN = 3  # requirements of a certificate that a message names

Ends = float | tuple[float, float]


@record
class Judgement:
    """A figure and the limit asked of it, in words, and what to do where it is not met."""

    met: bool
    found: str
    expected: str
    remedy: str


@record(eq=False)
class Expectation:
    """One thing that a problem file expects.

    Parameters
    ----------
    name : str
        As in the problem file, after "expect.".
    stage : {"fit", "controller", "certificate"}
        Whose result it is about.
    judge : callable
        Judges the results, of which that stage's is there.
    """

    name: str
    stage: Literal["fit", "controller", "certificate"]
    judge: Callable[[Stages], Judgement]

    def check(self, results: Stages) -> tuple[bool, str]:
        """Return whether the problem's results meet it, and a sentence: what was found, what was asked and, if it is
        not met, what to do.
        """
        if getattr(results, self.stage) is None:
            fit = results.fit
            why = "none was made" if fit is None or fit.met else f"the fit is not met: {fit.verdict}"
            return False, f"expect.{self.name}: there is no {self.stage}; {why}"
        outcome = self.judge(results)
        remedy = f"; {outcome.remedy}" if outcome.remedy and not outcome.met else ""
        return outcome.met, f"expect.{self.name}: found {outcome.found}, asked for {outcome.expected}{remedy}"


def list_expectations(problem: Problem) -> list[Expectation]:
    """Return what a problem expects of its results, in the order of the stages; nothing without [expect].

    Parameters
    ----------
    problem : Problem
        What `seaopt.read_problem` returned.

    Examples
    --------
    >>> import seaopt as so
    >>> list_expectations(so.read_problem(so.demo_path()))
    []
    """
    expect = problem.table.expect
    if expect is None:
        return []
    expectations: list[Expectation] = []

    def add(
        stage: Literal["fit", "controller", "certificate"], name: str, judge: Callable[..., Judgement], *limits: Any
    ) -> None:
        expectations.append(Expectation(name=name, stage=stage, judge=partial(judge, *limits)))

    if problem.table.experiment:
        add("fit", "fit_met", _judge_met, "fit", expect.fit_met)
    for parameter, limits in expect.parameters.items():
        add("fit", f"parameters.{parameter}", _judge_parameter, parameter, limits)
    for experiment, limits in expect.fit_percent.items():
        for output, ends in (limits if isinstance(limits, dict) else {"": limits}).items():
            name = ".".join(filter(None, ("fit_percent", experiment, output)))
            add("fit", name, _judge_percent, experiment, output, ends)
    if expect.controller is not None:
        add("controller", "controller.met", _judge_met, "controller", expect.controller.met)
        for figure, ends in _list_limits(expect.controller):
            add("controller", f"controller.{figure}", _judge_design, figure, ends)
    if expect.certificate is not None:
        add("certificate", "certificate.met", _judge_met, "certificate", expect.certificate.met)
        if expect.certificate.failure_probability is not None:
            most = expect.certificate.failure_probability
            add("certificate", "certificate.failure_probability", _judge_probability, most)
        for plant, figures in expect.certificate.plants.items():
            for figure, ends in _list_limits(figures):
                add("certificate", f"certificate.plants.{plant}.{figure}", _judge_plant, plant, figure, ends)
    return expectations


def _list_limits(figures: FiguresTable) -> list[tuple[str, Ends]]:
    """Return the figures that a table names, with their limits."""
    limits = {name: getattr(figures, name) for name in type(figures).model_fields}
    return [(name, ends) for name, ends in limits.items() if ends is not None and not isinstance(ends, bool)]


def _judge_met(stage: str, wanted: bool, results: Stages) -> Judgement:
    """Judge whether a result is met, as it should be or should not."""
    result = getattr(results, stage)
    if stage == "certificate":
        broken = [str(row) for row in result.requirements if not row.met]
        more = [f"{len(broken) - SHOWN} more in robustness.json"] if len(broken) > SHOWN else []
        remedy = "; ".join([*broken[:SHOWN], *more])
    else:
        remedy = result.verdict if stage == "fit" else result.explanation
    words = {True: "yes", False: "no"}
    return Judgement(met=result.met is wanted, found=words[result.met], expected=words[wanted], remedy=remedy)


def _judge_parameter(parameter: str, limits: tuple[float, float] | RangeTable, results: Stages) -> Judgement:
    assert results.fit is not None
    if isinstance(limits, RangeTable):
        low = -math.inf if limits.min is None else limits.min
        ends, unit = (low, math.inf if limits.max is None else limits.max), limits.unit
    else:
        ends, unit = limits, None
    estimate = {**results.fit.derived, **results.fit.parameters}.get(parameter)
    if estimate is None:
        remedy = "no experiment that is fitted has it"
        return Judgement(met=False, found="nothing", expected=_format_ends(ends, unit or ""), remedy=remedy)
    unit, scale = (estimate.unit, 1.0) if unit is None else (unit, factor(estimate.unit, unit))
    value, std = estimate.value * scale, None if estimate.total_std is None else estimate.total_std * scale
    identified = std is None or math.isfinite(std)
    if identified:
        remedy = (
            f"{_spell_run(results)} reports what the fit rests on; widen the range if the actuator is as it should be"
        )
    else:
        remedy = f"the logs do not identify {parameter}; excite it, or give its value"
    return Judgement(
        met=identified and _inside(value, ends),
        found=f"{value:.5g}" + ("" if std is None else f" ± {std:.2g}") + unit_after(unit),
        expected=_format_ends(ends, unit),
        remedy=remedy,
    )


def _spell_run(results: Stages) -> str:
    return f'"seaopt run {shlex.quote(results.problem.source)}"'


def _judge_percent(experiment: str, output: str, ends: Ends, results: Stages) -> Judgement:
    assert results.fit is not None
    percents = {name: row.fit_percent for name, row in results.fit.outputs.get(experiment, {}).items()}
    if not percents:
        percents = next((score.fit_percent for score in results.scores if score.name == experiment), {})
    values = {name: value for name, value in percents.items() if output in ("", name)}
    remedy = f"{_spell_run(results)} shows the residuals of {experiment}, and what may be missing in the model"
    if not values:
        remedy = f"{experiment} measures {join_words(list(percents))}"
    return _judge_values(values, _span(ends, at_most=False), "%", remedy)


def _judge_design(figure: str, ends: Ends, results: Stages) -> Judgement:
    assert results.controller is not None
    remedy = "a larger min_disk_margin or a lower bandwidth_hz in [controller] raises it"
    if figure in BANDS:
        remedy = FASTER
    elif figure in LIMITS:
        limit = ends if not isinstance(ends, tuple) else ends[1] if FIGURES[figure] == "at most" else ends[0]
        remedy = f"ask the tuner for it: {LIMITS[figure]} = {limit:g} in [controller]"
    return _judge_figure({"": _measure(results.controller.achieved, figure)}, figure, ends, remedy)


def _judge_probability(most: float, results: Stages) -> Judgement:
    assert results.certificate is not None
    draws = results.certificate.monte_carlo
    remedy = f"{draws.failures} of {draws.samples} draws fail" if draws.failures else "raise samples in [robustness]"
    return _judge_values({"": draws.failure_probability_bound}, (-math.inf, most), "", remedy)


def _judge_plant(plant: str, figure: str, ends: Ends, results: Stages) -> Judgement:
    """Judge a figure of a plant, sliding and stuck where it has friction."""
    assert results.certificate is not None
    loops, worst = results.certificate.plants, results.certificate.worst
    states = [state for state in loops if state in (plant, f"{plant} sliding", f"{plant} stuck")]
    values = {
        state: getattr(worst[state], figure.removeprefix("worst_"))
        if figure in WORST_FIGURES
        else _measure(loops[state], figure)
        for state in states
    }
    table = results.problem.table.controller
    remedy = f'put "{plant}" into robust_to in [controller], or lower bandwidth_hz there'
    if not states:
        remedy = f'it is not certified; put "{plant}" into plants in [robustness]'
    elif figure in BANDS:
        remedy = FASTER
    elif table is not None and plant in (table.plant, *table.robust_to):
        remedy = "ask more of it in [controller], or lower bandwidth_hz there"
    return _judge_figure(values, figure, ends, remedy)


def _measure(figures: LoopFigures, figure: str) -> Any:
    """Return a figure of a loop; what has no end (no crossing, no fall below -3 dB) is infinite in a stable one."""
    value = getattr(figures, figure)
    if value is None and figure != "tracking_band_hz":
        return math.inf if figures.stable and figure != "crossover_hz" else 0.0
    return value


def _judge_figure(values: Mapping[str, Any], figure: str, ends: Ends, remedy: str) -> Judgement:
    if figure != "tracking_band_hz":
        tolerance = BY_NAME[LIMITS[figure]].tolerance if figure in LIMITS else LIMIT_ROUNDING
        unit, at_most = UNITS.get(figure.rpartition("_")[2], ""), (FIGURES | WORST_FIGURES)[figure] == "at most"
        return _judge_values(values, _span(ends, at_most=at_most), unit, remedy, tolerance)
    assert isinstance(ends, tuple)  # every plant's band is to contain it
    return Judgement(
        met=bool(values) and all(band and all(_inside(end, band) for end in ends) for band in values.values()),
        found=_format_places({at: format_band(band, "Hz") for at, band in values.items()}),
        expected=f"one that contains {format_band(ends, 'Hz')}",
        remedy=remedy,
    )


def _judge_values(
    values: Mapping[str, float], ends: tuple[float, float], unit: str, remedy: str, tolerance: float = LIMIT_ROUNDING
) -> Judgement:
    """Judge figures by plant, all of which are to be inside."""
    return Judgement(
        met=bool(values) and all(_inside(value, ends, tolerance) for value in values.values()),
        found=_format_places({at: format_figure(value, unit, 5) for at, value in values.items()}),
        expected=_format_ends(ends, unit),
        remedy=remedy,
    )


def _span(ends: Ends, at_most: bool) -> tuple[float, float]:
    """Return the range that is asked for: that of a number ends there, on the bad side."""
    if isinstance(ends, tuple):
        return ends
    return (-math.inf, ends) if at_most else (ends, math.inf)


def _inside(value: float, ends: tuple[float, float], tolerance: float = LIMIT_ROUNDING) -> bool:
    low, high = ends
    return low - tolerance * abs(low) <= value <= high + tolerance * abs(high)


def _format_places(figures: Mapping[str, str]) -> str:
    """Return figures as text, each with its place; one that has none is the only one."""
    return ", ".join(f"{text} ({at})" if at else text for at, text in figures.items()) or "nothing"


def _format_ends(ends: tuple[float, float], unit: str) -> str:
    low, high = ends
    if math.isinf(low):
        return f"at most {high:.5g}{unit_after(unit)}"
    if math.isinf(high):
        return f"at least {low:.5g}{unit_after(unit)}"
    return f"{low:.5g} to {high:.5g}{unit_after(unit)}"
