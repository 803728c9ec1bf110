"""How steep a friction stability is shown for, at nominal parameters and over draws, for the certificate.

At the nominal parameters every multiplier is tried. Over draws the one that served there is tried first, and the others
only where it shows too little: a margin of a draw is then a lower bound of what could be shown.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import TypeVar

import numpy as np

from seaopt.codec import OrInfinite
from seaopt.control import Controller
from seaopt.control.laws.friction import find_friction_margin, find_friction_margins
from seaopt.control.loops.absolute_stability import FrictionMargin
from seaopt.control.loops.compensation.stability import CompensationMargin
from seaopt.executors import Shared
from seaopt.formatting import format_values
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.plants.friction import has_friction
from seaopt.progress import Progress
from seaopt.records import record
from seaopt.robustness.certificate.cases import Cases, Check, CheckContext, Draw, Evidence
from seaopt.robustness.certificate.measured_draws import judge_draws
from seaopt.robustness.certificate.requirement import MIN_FRICTION_MARGIN, DrawnAt, Requirement, require_at_least

MARGIN_DRAWS = 100  # at most so many are looked at
SECONDS = 0.3  # that a plant takes as a rule
NO_FRICTION = "no friction: any margin holds"
Margin = TypeVar("Margin", FrictionMargin | None, CompensationMargin)


@record
class MarginDraws:
    """For how many draws stability is shown for all friction of their sector, and the least margin."""

    samples: int
    shown: int
    least_slope: OrInfinite  # the steepest friction for which it is, N s/m; zero where it is not for one draw
    factor: OrInfinite  # that slope over the draw's own; zero where nothing is shown
    parameters: dict[str, float]  # of the draw with the least: the first for which nothing is shown, if there is one

    def __str__(self) -> str:
        head = f"over draws, it is shown for {self.shown} of {self.samples}"
        where = f" at {format_values(self.parameters)}" if self.parameters else ""
        if not self.least_slope:
            return f"{head}; the first for which it is not is{where or ' the plant as it is'}"
        if np.isinf(self.least_slope):
            return f"{head}, however steep"
        return f"{head}, the least up to {self.factor:.3g} times its own{where}"


def measure_friction(context: CheckContext, progress: Progress) -> Evidence:
    """Return for how steep a friction stability is shown on every plant, and what is required of that."""
    progress("friction at the draws", 0.0)
    controller = context.cases.controller
    margins = find_nominal_margins(controller, context.cases.models, context.cases.unknown.nominal)
    draws = find_margins_at_draws(context, margins)
    rows = friction_requirements(margins, draws, context.min_friction_margin, controller.command.mechanics.damping)
    fields = {"friction": margins, "friction_draws": draws}
    return Evidence(requirements=rows, fields=fields, scope="drawn" if draws else "nominal")


FRICTION = Check(
    measure=measure_friction,
    seconds=lambda context: SECONDS * len(context.cases.plants),
    brief=lambda context: context.min_friction_margin is not None,
)


def find_nominal_margins(
    controller: Controller, models: Mapping[str, Plant], params: ParameterSet
) -> dict[str, FrictionMargin]:
    """Return the friction margin of every plant that has friction."""
    margins = {name: find_friction_margin(controller, model, params) for name, model in models.items()}
    return {name: margin for name, margin in margins.items() if margin is not None}


def find_margins_at_draws(context: CheckContext, nominal: Mapping[str, FrictionMargin]) -> dict[str, MarginDraws]:
    """Return margins at draws, of plants whose nominal margin is shown or enough, or that rub at draws alone."""
    unknown, required = context.cases.unknown, context.min_friction_margin
    varied = [row.name for row in unknown.varied()]
    enough = {
        name: nominal.get(name)
        for name, model in context.cases.models.items()
        if has_friction(model, unknown.nominal, varied) and _shows_enough(nominal.get(name), required)
    }
    if required is None and not context.thorough:
        judge_draws(context, MARGIN_DRAWS, dict.fromkeys(enough, _leave_out))  # the checks that follow draw the same
        return {}
    return draw_margins(context, {name: partial(_find_margins, margin) for name, margin in enough.items()})


def draw_margins(
    context: CheckContext, judges: Mapping[str, Callable[[Shared[Cases], str, Sequence[Draw]], Sequence[Margin]]]
) -> dict[str, MarginDraws]:
    """Return what plants' judgements make of draws."""
    made: dict[str, MarginDraws] = {}
    for name, pairs in judge_draws(context, MARGIN_DRAWS, judges).items():
        draw, margin = min(pairs, key=lambda pair: _take_slope(pair[1]))
        made[name] = MarginDraws(
            samples=len(pairs),
            shown=sum(each is None or each.shown for _, each in pairs),
            least_slope=_take_slope(margin),
            factor=np.inf if margin is None else margin.factor,
            parameters=dict(draw),
        )
    return made


def _take_slope(margin: FrictionMargin | CompensationMargin | None) -> float:
    if margin is None:  # without friction there is nothing to show
        return np.inf
    return margin.slope if isinstance(margin, CompensationMargin) else margin.least_slope


def _shows_enough(margin: FrictionMargin | None, required: float | None) -> bool:
    """Tell whether the nominal parameters leave something to look for at draws; without friction there they do."""
    return margin is None or margin.shown or (required is not None and margin.least_slope >= required)


def _leave_out(cases: Shared[Cases], name: str, draws: Sequence[Draw]) -> list[None]:
    """Return nothing of draws."""
    return [None for _ in draws]


def _find_margins(
    nominal: FrictionMargin | None, cases: Shared[Cases], name: str, draws: Sequence[Draw]
) -> list[FrictionMargin | None]:
    """Return the margins of one plant at draws, the multiplier that served at the nominal parameters tried first."""
    first, least = ("", 0.0) if nominal is None else (nominal.multiplier, 1.0 if nominal.shown else 0.0)
    at = cases.value
    return find_friction_margins(at.controller, at.models[name], at.place(name, draws), first, least)


def friction_requirements(
    margins: Mapping[str, FrictionMargin], draws: Mapping[str, MarginDraws], least: float | None, unit: str
) -> list[Requirement]:
    """Return that stability is shown for friction as steep as asked, nominal and drawn; infinite without friction."""
    if least is None:
        return []

    require = partial(require_at_least, MIN_FRICTION_MARGIN, limit=least, unit=unit)
    rows: list[Requirement] = []
    for name in dict.fromkeys((*margins, *draws)):
        margin, drawn = margins.get(name), draws.get(name)
        nominal = np.inf if margin is None else margin.least_slope
        if drawn is not None and drawn.least_slope < nominal:
            rows.append(require(value=drawn.least_slope, plant=name, draw=DrawnAt(parameters=drawn.parameters)))
        else:
            text = NO_FRICTION if margin is None else f"{margin.multiplier} at {margin.frequency_hz:.4g} Hz"
            rows.append(require(value=nominal, plant=name, text=text))
    return rows or [require(value=np.inf, text=NO_FRICTION)]
