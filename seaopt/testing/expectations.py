"""What a problem file's [expect] asks of its results, one expectation each, for `seaopt run` and the pytest plugin.

A number is the limit on the bad side of a figure (an Ms at most, a margin at least), a pair of numbers a range. What
has a limit in [controller] is judged with that limit's tolerance, everything else to a millionth.
"""

from __future__ import annotations

import math
import shlex
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import Any, Literal

from seaopt.control import LoopFigures
from seaopt.control.laws.limits import BY_NAME, LIMIT_ROUNDING
from seaopt.formatting import format_band, format_figure, join_words
from seaopt.problem import Problem, Stages
from seaopt.problem.schema import FiguresTable, RangeTable
from seaopt.records import record
from seaopt.units import factor, unit_after

AT_MOST = ("ms", "mt", "reference_peak", "droop_db", "noise_gain", "worst_ms", "worst_mt")
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
    """A figure against what was asked of it, in words, and what to do where it is not met."""

    met: bool
    found: str
    asked: str
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
        """Return whether it is met, and a sentence: what was found, what was asked and, if it is not, what to do.

        Parameters
        ----------
        results : Stages
            The problem's.

        """
        if getattr(results, self.stage) is None:
            fit = results.fit
            why = "none was made" if fit is None or fit.met else f"the fit is not met: {fit.verdict}"
            return False, f"expect.{self.name}: there is no {self.stage}; {why}"
        outcome = self.judge(results)
        remedy = f"; {outcome.remedy}" if outcome.remedy and not outcome.met else ""
        return outcome.met, f"expect.{self.name}: found {outcome.found}, asked for {outcome.asked}{remedy}"


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
    if problem.table.expect is None:
        return []
    return [*_of_fit(problem), *_of_controller(problem), *_of_certificate(problem)]


def _of_fit(problem: Problem) -> Iterator[Expectation]:
    asked = problem.table.expect
    assert asked is not None
    if problem.table.experiment:
        yield Expectation(name="fit_met", stage="fit", judge=partial(_judge_fit, wanted=asked.fit_met))
    for parameter, limits in asked.parameters.items():
        judge = partial(_judge_parameter, parameter=parameter, limits=limits, source=problem.source)
        yield Expectation(name=f"parameters.{parameter}", stage="fit", judge=judge)
    for experiment, limits in asked.fit_percent.items():
        for output, ends in (limits if isinstance(limits, dict) else {"": limits}).items():
            name = ".".join(filter(None, ("fit_percent", experiment, output)))
            judge = partial(_judge_percent, experiment=experiment, output=output, ends=ends, source=problem.source)
            yield Expectation(name=name, stage="fit", judge=judge)


def _of_controller(problem: Problem) -> Iterator[Expectation]:
    asked = problem.table.expect.controller if problem.table.expect is not None else None
    if asked is None:
        return
    judge = partial(_judge_feasible, wanted=asked.feasible)
    yield Expectation(name="controller.feasible", stage="controller", judge=judge)
    for figure, ends in _list_asked(asked):
        judge = partial(_judge_design, figure=figure, ends=ends)
        yield Expectation(name=f"controller.{figure}", stage="controller", judge=judge)


def _of_certificate(problem: Problem) -> Iterator[Expectation]:
    asked = problem.table.expect.certificate if problem.table.expect is not None else None
    if asked is None:
        return
    judge = partial(_judge_passed, wanted=asked.passed)
    yield Expectation(name="certificate.passed", stage="certificate", judge=judge)
    if asked.failure_probability is not None:
        judge = partial(_judge_probability, most=asked.failure_probability)
        yield Expectation(name="certificate.failure_probability", stage="certificate", judge=judge)
    for plant, figures in asked.plants.items():
        for figure, ends in _list_asked(figures):
            judge = partial(_judge_plant, plant=plant, figure=figure, ends=ends)
            yield Expectation(name=f"certificate.plants.{plant}.{figure}", stage="certificate", judge=judge)


def _list_asked(figures: FiguresTable) -> list[tuple[str, Ends]]:
    """Return the figures that a table asks for, with their limits."""
    asked = {name: getattr(figures, name) for name in type(figures).model_fields}
    return [(name, ends) for name, ends in asked.items() if ends is not None and not isinstance(ends, bool)]


def _judge_fit(results: Stages, wanted: bool) -> Judgement:
    assert results.fit is not None
    return _judge_flag(results.fit.met, wanted, results.fit.verdict)


def _judge_feasible(results: Stages, wanted: bool) -> Judgement:
    assert results.controller is not None
    return _judge_flag(results.controller.feasible, wanted, results.controller.explanation)


def _judge_passed(results: Stages, wanted: bool) -> Judgement:
    assert results.certificate is not None
    broken = [str(row) for row in results.certificate.requirements if not row.met]
    more = [f"{len(broken) - SHOWN} more in robustness.json"] if len(broken) > SHOWN else []
    return _judge_flag(results.certificate.passed, wanted, "; ".join([*broken[:SHOWN], *more]))


def _judge_flag(found: bool, wanted: bool, remedy: str) -> Judgement:
    words = {True: "yes", False: "no"}
    return Judgement(met=found is wanted, found=words[found], asked=words[wanted], remedy=remedy)


def _judge_parameter(
    results: Stages, parameter: str, limits: tuple[float, float] | RangeTable, source: str
) -> Judgement:
    assert results.fit is not None
    fit = results.fit
    low, high, unit = _read_range(limits)
    one = fit.parameters[parameter] if parameter in fit.parameters else fit.derived.get(parameter)
    if one is None:
        asked = _format_ends((low, high), unit or "")
        return Judgement(met=False, found="nothing", asked=asked, remedy="no experiment that is fitted has it")
    unit, scale = (one.unit, 1.0) if unit is None else (unit, factor(one.unit, unit))
    value, std = one.value * scale, None if one.std is None else one.std * scale
    identified = std is None or math.isfinite(std)
    again = f'"seaopt run {shlex.quote(source)}"'
    remedy = f"{again} reports what the fit rests on; widen the range if the actuator is as it should be"
    if not identified:
        remedy = f"the logs do not identify {parameter}; excite it, or give its value"
    return Judgement(
        met=identified and _inside(value, (low, high)),
        found=f"{value:.5g}" + ("" if std is None else f" ± {std:.2g}") + unit_after(unit),
        asked=_format_ends((low, high), unit),
        remedy=remedy,
    )


def _read_range(limits: tuple[float, float] | RangeTable) -> tuple[float, float, str | None]:
    """Return the ends of a range, infinite where it has none, and the unit they are in, None for the figure's own."""
    if not isinstance(limits, RangeTable):
        return *limits, None
    low = -math.inf if limits.min is None else limits.min
    return low, math.inf if limits.max is None else limits.max, limits.unit


def _judge_percent(results: Stages, experiment: str, output: str, ends: Ends, source: str) -> Judgement:
    assert results.fit is not None
    fitted = {name: row.fit_percent for name, row in results.fit.outputs.get(experiment, {}).items()}
    scored = {} if fitted else {one.name: one.fit_percent for one in results.scores}
    percents = fitted or scored.get(experiment, {})
    values = {name: value for name, value in percents.items() if output in ("", name)}
    remedy = (
        f'"seaopt run {shlex.quote(source)}" shows the residuals of {experiment}, and what may be missing in the model'
    )
    if not values:
        remedy = f"{experiment} measures {join_words(list(percents))}"
    return _judge_values(values, _span(ends, at_most=False), "%", remedy)


def _judge_design(results: Stages, figure: str, ends: Ends) -> Judgement:
    assert results.controller is not None
    remedy = "a larger min_disk_margin or a lower bandwidth_hz in [controller] raises it"
    if figure in BANDS:
        remedy = FASTER
    elif figure in LIMITS:
        asked = ends if not isinstance(ends, tuple) else ends[1] if figure in AT_MOST else ends[0]
        remedy = f"ask the tuner for it: {LIMITS[figure]} = {asked:g} in [controller]"
    return _judge_figure({"": _measure(results.controller.achieved, figure)}, figure, ends, remedy)


def _judge_probability(results: Stages, most: float) -> Judgement:
    assert results.certificate is not None
    draws = results.certificate.monte_carlo
    few = "raise samples in [robustness]" if not draws.failures else f"{draws.failures} of {draws.samples} draws fail"
    return _judge_values({"": draws.failure_probability_bound}, (-math.inf, most), "", few)


def _judge_plant(results: Stages, plant: str, figure: str, ends: Ends) -> Judgement:
    """Judge a figure of a plant, of one with friction both sliding and stuck."""
    assert results.certificate is not None
    loops, worst = results.certificate.plants, results.certificate.worst
    states = [state for state in loops if state in (plant, f"{plant} sliding", f"{plant} stuck")]
    values = {
        state: getattr(worst[state], figure.removeprefix("worst_"))
        if figure.startswith("worst_")
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
    if figure == "tracking_band_hz":
        assert isinstance(ends, tuple)
        return _judge_band(values, ends, remedy)
    tolerance = BY_NAME[LIMITS[figure]].tolerance if figure in LIMITS else LIMIT_ROUNDING
    unit = UNITS.get(figure.rpartition("_")[2], "")
    return _judge_values(values, _span(ends, at_most=figure in AT_MOST), unit, remedy, tolerance)


def _judge_band(values: Mapping[str, tuple[float, float] | None], asked: tuple[float, float], remedy: str) -> Judgement:
    """Judge bands by place, each of which is to contain the one that is asked for."""
    return Judgement(
        met=bool(values)
        and all(band is not None and _inside(asked[0], band) and _inside(asked[1], band) for band in values.values()),
        found=_format_places({place: format_band(band, "Hz") for place, band in values.items()}),
        asked=f"one that contains {format_band(asked, 'Hz')}",
        remedy=remedy,
    )


def _judge_values(
    values: Mapping[str, float], ends: tuple[float, float], unit: str, remedy: str, tolerance: float = LIMIT_ROUNDING
) -> Judgement:
    """Judge figures by place, all of which are to be inside."""
    return Judgement(
        met=bool(values) and all(_inside(value, ends, tolerance) for value in values.values()),
        found=_format_places({place: format_figure(value, unit, 5) for place, value in values.items()}),
        asked=_format_ends(ends, unit),
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
    return ", ".join(f"{text} ({place})" if place else text for place, text in figures.items()) or "nothing"


def _format_ends(ends: tuple[float, float], unit: str) -> str:
    low, high = ends
    if math.isinf(low):
        return f"at most {high:.5g}{unit_after(unit)}"
    if math.isinf(high):
        return f"at least {low:.5g}{unit_after(unit)}"
    return f"{low:.5g} to {high:.5g}{unit_after(unit)}"
