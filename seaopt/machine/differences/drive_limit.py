r"""A limit of the drive behind the logged command, which the law does not know of.

A drive that gives at most :math:`I_m` of what is commanded looks, at the lines of a reference with random phases, like
a smaller torque constant: the best linear approximation of a static curve is a gain (Bussgang, MIT RLE Tech. Rep. 216,
1952). It distorts besides: it answers at frequencies that were not played, where a gain does not. These tell the two
apart in one log, where the distortion is above the noise; a log at another amplitude does by the gain alone.

The model has no noise, and the command has some, which rounds the corners of the limit. With the std :math:`s` that the
command has from period to period, the mean of what a drive gives of u and of normal noise about it is

.. math:: g(u) = u - h(u - I_m) + h(-u - I_m), \qquad h(v) = s\,\varphi(v/s) + v\,\Phi(v/s) .
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import casadi as ca
import numpy as np
from jaxtyping import Float

from seaopt.machine.differences.comparison import Comparison
from seaopt.machine.differences.leeway import Spread
from seaopt.machine.differences.size_fit import Tried
from seaopt.machine.differences.size_search import Knob, Search, find_slopes, refine
from seaopt.machine.response.periods import Blocks, cut_periods, join_blocks, shorten
from seaopt.machine.ticks import Ticks
from seaopt.parameters import Parameter, ParameterSet
from seaopt.plants import Plant

LIMIT, NOISE = "drive_limit", "command_noise"
SHARES = np.geomspace(0.05, 0.95, 14)  # of the largest command: levels from which the search begins
NONE = 1e9  # times the largest command: no limit
LEAST = 1e-6  # of the largest command: noise that is none


def limit_drive(plant: Plant, none: float, noise: float) -> Plant:
    """Return a plant whose drive gives no more than a limit, a parameter of it, of its first input. `none`: one that
    is never reached; `noise`: of the command, std.
    """
    driven = next(iter(plant.inputs))

    def limit(equations: Any) -> Any:
        def limited(t: Any, x: Any, u: Any, p: Any) -> Any:
            command, most, std = getattr(u, driven), getattr(p, LIMIT), getattr(p, NOISE)
            given = command - _exceed(command - most, std) + _exceed(-command - most, std)
            return equations(t, x, SimpleNamespace(**(vars(u) | {driven: given})), p)

        return limited

    added = [
        Parameter(name=name, value=value, unit=plant.inputs[driven], min=0.0)
        for name, value in ((LIMIT, none), (NOISE, noise))
    ]
    parameters = {**plant.parameters, **{each.name: each for each in added}}
    return replace(plant, f=limit(plant.f), h=limit(plant.h), parameters=parameters)


def _exceed(beyond: Any, std: Any) -> Any:
    """Return the mean of the positive part of a normal variable."""
    z = beyond / std
    return std * ca.exp(-0.5 * z**2) / math.sqrt(2.0 * math.pi) + 0.5 * beyond * (1.0 + ca.erf(z / math.sqrt(2.0)))


def take_limited(comparison: Comparison, logs: Sequence[Ticks]) -> Comparison:
    """Return a comparison whose model has a drive that is limited, which is simulated. `logs`: whole."""
    controller = comparison.controller
    assert controller.design is not None
    plant, values = controller.design
    most = max(float(np.nanmax(np.abs(ticks.command))) for ticks in logs)
    noise = max(cut_periods(controller, ticks).noise for ticks in logs)
    limited = replace(controller, design=(limit_drive(plant, NONE * most, max(noise, LEAST * most)), values))
    return replace(comparison, controller=limited, logs=[*map(shorten, logs)], simulated=True)


def make_knob(limited: Comparison, level: float) -> Knob:
    """Return what moves the limit of a drive from a level on."""
    return Knob(kind="drive limit", parameter=replace(limited.plant.defaults[LIMIT], value=level))


def try_limit(limited: Comparison, values: ParameterSet, spread: Spread) -> Tried | None:
    """Return the limit of the drive that fits best, beside what certified machines differ by."""
    most = max(float(np.nanmax(np.abs(ticks.command))) for ticks in limited.logs)
    knobs = [make_knob(limited, level) for level in (most * SHARES).tolist()]
    models = limited.predict([knob.place(values, 0.0) for knob in knobs])
    misfits = [limited.misfit(model) for model in models]
    if not np.any(np.isfinite(misfits)):
        return None
    best = int(np.nanargmin(misfits))
    slopes = find_slopes(limited, spread, knobs[best].place(values, 0.0), models[best])
    start = Search(knobs=(knobs[best],), sizes=np.zeros(1), model=models[best], slopes=slopes)
    found = refine(limited, spread, values, [start])
    return found[0].conclude(values) if found else None


def find_distortion(comparison: Comparison, logs: Sequence[Ticks], sets: Sequence[ParameterSet]) -> list[float]:
    """Return how far the model with each of some values is from the logs where the reference has nothing: the sum of
    squares over frequencies, sets of phases and amplitudes.
    """
    measured = join_blocks([cut_periods(comparison.controller, ticks) for ticks in logs])
    return [
        sum(map(_compare, groups, measured)) if len(groups) == len(measured) else math.inf
        for groups in comparison.simulate(sets)
    ]


def _compare(model: Blocks, measured: Blocks) -> float:
    """Return the sum of squares by which two differ between the lines, of the sets of phases that both have."""
    model, measured = model.average(), measured.average()
    _, first, second = np.intersect1d(model.realisation, measured.realisation, return_indices=True)
    size = min(model.between.shape[1], measured.between.shape[1])
    off: Float[np.ndarray, "b k"] = np.abs(model.between[first, :size] - measured.between[second, :size])
    return float(np.sum(off**2)) if off.size else math.inf
