"""Whether the machine is one of those that were certified, and if not, what differs.

**Inside what was certified** is a machine whose response at every line is no further from the nominal one than a draw
of the certificate is, but for the disc of the measurement and 2 % of the response, and of which one machine within the
spread of the draws explains all lines together (`joint`). It is not where the best cause, at that end of its interval
where it does least, takes a line further than that: one size out of all lines tells what none of them does by itself.
The nearest draw is the one of the least misfit, sum over the lines of the square of what it is off by, over the
measurement's std.

With dry friction a log of fewer than six sets of phases that is off does not tell, but where one cause explains it:
friction folds into the lines of each set, which the noise from period to period says nothing of, so that a right
machine may be off by more than that. Nor does one many of whose periods had the command at its limit: what is left
comes right after such a period, in which the loop was open.

A sensor is at its range where readings pile up at an edge of what was read while the command moves on. One that drifts
is told by what else knows the force (`drift`): a machine whose reading may drift by more than the 2 % is none of those,
and where another sensor may be what drifts in its place, the log does not tell.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
from jaxtyping import Float

from seaopt.control import Controller
from seaopt.machine.differences.comparison import TOLERATED, Comparison, Lines
from seaopt.machine.differences.drift import Drift, find_drifts
from seaopt.machine.differences.explanations import WORTH, explain
from seaopt.machine.differences.joint import is_one_of
from seaopt.machine.differences.leeway import take_spread
from seaopt.machine.differences.others import state
from seaopt.machine.differences.size_fit import Difference
from seaopt.machine.response.judged import Measured, Prediction
from seaopt.machine.response.periods import shorten
from seaopt.machine.response.verdicts import LEAST_PHASES, has_dry_friction, predict_response
from seaopt.machine.ticks import Ticks, find_edges
from seaopt.parameters import ParameterSet
from seaopt.records import record
from seaopt.robustness.uncertainty.worst import place_values

SIMULATED = 60  # draws that are simulated, with dry friction
MOVES = 0.5  # of the rows in which a reading stays at an edge: the command is another than in the one before
EXPLAINED = 0.95  # of the difference, from which on one cause is what differs
MOST_LIMITED = 0.25  # of the periods, that may have the command at its limit
Values = Mapping[str, float]
Untold = Literal["", "phases", "limit", "drift"]


@record
class Differences:
    """How the measured plant differs from the certified one."""

    inside: bool  # the machine is one of those that were certified; not so where the log does not tell
    each_line: bool  # each line by itself is within reach of them
    misfit: float  # mean square of the difference over its std; 1 is noise
    most_noise: float  # of such a one that noise leaves of a right model, 95 %
    off: float  # largest share of the response by which it differs, beyond its disc
    off_hz: float | None
    found: tuple[Difference, ...]
    nearest: Mapping[str, float]  # of the certificate's draws, the values of the one that is nearest
    nearest_misfit: float | None
    prediction: Prediction | None = None  # with dry friction
    # Why the log tells neither whether the machine is inside nor what differs: too few sets of phases for dry friction,
    # too many periods in which the command is at its limit, or a drift that may be another sensor's.
    untold: Untold = ""
    drifts: tuple[Drift, ...] = ()  # of the reading that is regulated, beside what else knows the force

    @property
    def explained(self) -> bool:
        """Whether the first difference leaves no more than noise does, so that its interval holds."""
        return bool(self.found) and (self.found[0].left or 0.0) <= self.most_noise

    @property
    def read_wrongly(self) -> bool:
        """Whether a sensor is what keeps the machine from being one of those: at its range, or drifting."""
        drifting = any(each.of_reading is not False for each in self.drifts)
        return drifting or any(each.kind == "range" for each in self.found)


def compare(
    controller: Controller,
    measured: Sequence[Measured],
    logs: Sequence[Ticks],
    draws: Sequence[Values],
    confidence: float,
    apart: Controller | None = None,
) -> Differences | None:
    """Return how the machine differs from a controller's design plant; None where the controller does not know it.
    `logs`: those that `measured` comes from. `draws`: of the certificate. `apart`: as in `Comparison`.
    """
    if controller.design is None:
        return None
    dry = has_dry_friction(controller)
    logs_taken = [*map(shorten, logs)] if dry else logs
    # Without a stiffness the link's place, which the enclosed law reads, drifts.
    names = controller.signals if apart is None or apart.renders else apart.signals
    comparison = Comparison(controller=controller, measured=measured, logs=logs_taken, names=names, apart=apart)
    comparison = comparison.listen() if dry else comparison
    beside = replace(comparison, names=_list_beside(measured, controller.signals))
    plant, values = controller.design
    nominal = plant.complete(values)
    response, count = comparison.response, comparison.f.size
    draws = draws[:SIMULATED] if dry else draws
    sets = [values, *(place_values(plant, values, draw) for draw in draws)]
    simulated = comparison.simulate(sets) if dry else []
    comparison = comparison.settle(values, simulated[0]) if dry else comparison
    drawn = [*map(comparison.read, simulated)] if dry else comparison.predict(sets)
    model, drawn = drawn[0], np.array(drawn[1:]).reshape(-1, count)
    before = comparison.misfit(model)
    reach = np.max(np.abs(drawn - model), axis=0, initial=0.0)
    left = np.abs(response - model) - comparison.radius(1.0 - confidence) - reach
    share = left / np.abs(model)
    flat = [*_list_clipped(controller, [ticks.take(np.flatnonzero(ticks.complete)) for ticks in logs])]
    at = {name: each.value for name, each in nominal.items()}
    spread = take_spread(draws, at)
    found, left_over = explain(comparison, beside, logs, model, spread)
    misfits = [comparison.misfit(row) for row in drawn]
    best = int(np.argmin(misfits)) if misfits else None
    each_line = bool(np.all(share <= TOLERATED))
    together = each_line and is_one_of(comparison, spread, [model, *drawn], 1.0 - confidence)
    beyond = together and bool(found) and _is_beyond(comparison, values, found[0], model, reach)
    found = [state(comparison, left_over, values, each) for each in found]
    drifts = find_drifts(controller, logs)
    alike = together and not flat and not beyond
    whose = {each.of_reading for each in drifts} - {False}
    inside = alike and not whose
    explained = bool(found) and found[0].explains >= EXPLAINED and (found[0].left or 0.0) <= WORTH
    untold = "" if inside or flat or explained else find_untold(controller, measured)
    untold = "drift" if alike and whose == {None} else untold
    worst = int(np.argmax(share))
    return Differences(
        inside=inside,
        each_line=each_line,
        misfit=before / count,
        most_noise=comparison.most_noise,
        off=max(float(share[worst]), 0.0),
        off_hz=float(comparison.f[worst]) if share[worst] > TOLERATED else None,
        found=() if untold else (*flat, *found),
        nearest={} if best is None else dict(draws[best]),
        nearest_misfit=None if best is None else misfits[best] / count,
        prediction=predict_response(controller, simulated) if dry else None,
        untold=untold,
        drifts=drifts,
    )


def find_untold(controller: Controller, measured: Sequence[Measured]) -> Untold:
    """Return why logs do not tell whether the machine is one of those that were certified, nor what differs."""
    if not has_dry_friction(controller):
        return ""
    if any(part.phases < LEAST_PHASES for part in measured):
        return "phases"
    limited = sum(part.left_out.limit for part in measured)
    return "limit" if limited > MOST_LIMITED * (limited + sum(part.periods for part in measured)) else ""


def _is_beyond(
    comparison: Comparison,
    values: ParameterSet,
    best: Difference,
    model: Lines,
    reach: Float[np.ndarray, " m"],
) -> bool:
    """Tell whether the best cause, with the least of it that its interval has, is more than certified machines have.
    `reach`: of their responses from the model's.
    """
    explained = (best.left or 0.0) <= comparison.most_noise
    if best.kind not in ("gain", "parameter") or best.beside or not explained or not best.is_there:
        return False
    least = min((each for each in (best.low, best.high) if each is not None), key=lambda each: abs(each - 1.0))
    if best.kind == "gain":
        changed = least * model
    else:
        parameter = comparison.plant.complete(values)[best.name]
        (changed,) = comparison.predict([values.with_parameters(replace(parameter, value=least * parameter.value))])
    return bool(np.any(np.abs(changed - model) - reach > TOLERATED * np.abs(model)))


def _list_beside(measured: Sequence[Measured], signals: Sequence[str]) -> tuple[str, ...]:
    """Return the outputs that were logged at every amplitude, and that the law does not feed back."""
    return tuple(
        name for name in measured[0].outputs if name not in signals and all(name in part.outputs for part in measured)
    )


def _list_clipped(controller: Controller, logs: Sequence[Ticks]) -> Iterator[Difference]:
    """Yield the signals whose readings stay at an edge while the command moves on."""
    for i, name in enumerate(controller.signals):
        edges = [
            float(np.max(np.abs(ticks.measured[edge, i])))
            for ticks in logs
            for edge in find_edges(ticks.measured[:, i])
            if np.mean(np.diff(ticks.command)[edge[1:] & edge[:-1]] != 0.0) > MOVES
        ]
        if edges:
            unit = controller.command.reference_unit if i == 0 else ""
            yield Difference(kind="range", name=name, value=max(edges), low=None, high=None, unit=unit, explains=1.0)
