"""Whether the machine is one of those that were certified, and if not, what differs.

**Inside what was certified** is a machine whose response at every line is no further from the nominal one than a draw
of the certificate is, but for the disc of the measurement and 2 % of the response, and of which one machine within the
spread of the draws explains all lines together (`joint`). It is not where the best cause, at that end of its interval
where it does least, takes a line further than that: one size out of all lines tells what none of them does by itself.
The nearest draw is the one of the least misfit, sum over the lines of the square of what it is off by, over the
measurement's std.

A sensor is at its range where readings pile up at an edge of what was read while the command moves on.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from seaopt.control import Controller
from seaopt.machine.differences.comparison import TOLERATED, Comparison, Lines
from seaopt.machine.differences.explanations import explain
from seaopt.machine.differences.joint import is_one_of
from seaopt.machine.differences.leeway import take_spread
from seaopt.machine.differences.size_fit import Difference
from seaopt.machine.response.judged import Measured, Prediction
from seaopt.machine.response.periods import shorten
from seaopt.machine.response.verdicts import has_dry_friction, predict_response
from seaopt.machine.ticks import Ticks, find_edges
from seaopt.parameters import ParameterSet
from seaopt.records import record
from seaopt.robustness.uncertainty.worst import place_values

SIMULATED = 60  # draws that are simulated, with dry friction
MOVES = 0.5  # of the rows in which a reading stays at an edge: the command is another than in the one before
Values = Mapping[str, float]


@record
class Differences:
    """How the measured plant differs from the certified one."""

    inside: bool  # the machine is one of those that were certified
    each_line: bool  # each line by itself is within reach of them
    misfit: float  # mean square of the difference over its std; 1 is noise
    most_noise: float  # of such a one that noise leaves of a right model, 95 %
    off: float  # largest share of the response by which it differs, beyond its disc
    off_hz: float | None
    found: tuple[Difference, ...]
    nearest: Mapping[str, float]  # of the certificate's draws, the values of the one that is nearest
    nearest_misfit: float | None
    prediction: Prediction | None = None  # with dry friction

    @property
    def explained(self) -> bool:
        """Whether the first difference leaves no more than noise does, so that its interval holds."""
        return bool(self.found) and (self.found[0].left or 0.0) <= self.most_noise


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
    beside = replace(comparison, names=_list_beside(measured, controller.signals))
    plant, values = controller.design
    nominal = plant.complete(values)
    response, count = comparison.response, comparison.f.size
    draws = draws[:SIMULATED] if dry else draws
    sets = [values, *(place_values(plant, values, draw) for draw in draws)]
    comparison = comparison.settle(values) if dry else comparison
    simulated = comparison.simulate(sets) if dry else []
    drawn = [*map(comparison.read, simulated)] if dry else comparison.predict(sets)
    model, drawn = drawn[0], np.array(drawn[1:]).reshape(-1, count)
    before = comparison.misfit(model)
    reach = np.max(np.abs(drawn - model), axis=0, initial=0.0)
    left = np.abs(response - model) - comparison.radius(1.0 - confidence) - reach
    share = left / np.abs(model)
    flat = [*_list_clipped(controller, [ticks.take(np.flatnonzero(ticks.complete)) for ticks in logs])]
    at = {name: each.value for name, each in nominal.items()}
    spread = take_spread(draws, at)
    found = [*flat, *explain(comparison, beside, logs, model, spread)]
    misfits = [comparison.misfit(row) for row in drawn]
    best = int(np.argmin(misfits)) if misfits else None
    each_line = bool(np.all(share <= TOLERATED))
    together = is_one_of(comparison, spread, [model, *drawn], 1.0 - confidence) if each_line else False
    beyond = together and bool(found) and _is_beyond(comparison, values, found[0], model, reach)
    worst = int(np.argmax(share))
    return Differences(
        inside=together and not flat and not beyond,
        each_line=each_line,
        misfit=before / count,
        most_noise=comparison.most_noise,
        off=max(float(share[worst]), 0.0),
        off_hz=float(comparison.f[worst]) if share[worst] > TOLERATED else None,
        found=tuple(found),
        nearest={} if best is None else dict(draws[best]),
        nearest_misfit=None if best is None else misfits[best] / count,
        prediction=predict_response(controller, simulated) if dry else None,
    )


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
