r"""What differs between the machine and what was certified: the measured plant beside the model's, cause by cause.

The measured plant :math:`\hat G_k = \bar Y/\bar U` has a std s at each line. A cause with a size :math:`\theta`, a
parameter's factor, a gain, a delay, a mode, makes another response of the model, and

.. math:: \chi^2(\theta) = \sum_k |\hat G_k - G_k(\theta)|^2/s_k^2

is least at its size. Causes are ranked by how much of :math:`\chi^2` they take away beyond the number of lines, which
noise leaves. Some cannot be told from each other (a torque constant and an efficiency): they are named together.

With dry friction the model's response is that of the same law on the nonlinear plant, simulated under the logged
reference and cut as the log is, since it depends on amplitude; two periods of each set of phases do, without noise.

**Inside what was certified** is a machine whose response at every line is no further from the nominal one than a draw
of the certificate is, but for the disc of the measurement and 2 % of the response.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Complex, Float

from seaopt.control import Controller
from seaopt.control.loops.sampled_plant import DELAYS
from seaopt.logs.quality.faults import find_runs
from seaopt.machine.design_run import run_design
from seaopt.machine.response.periods import cut_periods, join_blocks, shorten
from seaopt.machine.response.verdicts import Measured, has_dry_friction
from seaopt.machine.ticks import Ticks
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.plants.friction import take_sliding
from seaopt.records import record
from seaopt.robustness.uncertainty.worst import place_values

STEP = 0.02  # of a parameter, to see what it does
ROUNDS = 4  # of Gauss and Newton
FOUND = 1e-3  # of a factor's logarithm: it is found where it moves by less
SIMULATED = 60  # draws that are simulated, with dry friction
MOST_LOG = 1.5  # of a factor: its logarithm goes no further
MOST_SPREAD = 10.0  # of a factor's logarithm, above which the log does not tell the factor
ALIKE = 0.05  # of what the best cause takes away: causes that are as good
TOLERATED = 0.02  # of the response, by which a machine may be off everything drawn
FEWEST_FLAT = 10  # readings at the edge of a range, some in a row
MODE_DAMPINGS = (0.02, 0.1)
SEEN = 5.0  # std by which a line differs where a mode is looked for
MODE_COST = 2.0  # by which a mode, of several sizes, has to leave less than another cause does
LEAST_DAMPING, MOST_DAMPED = math.log(1e-4), 0.3
MOST = 4  # causes that are listed
Lines = Complex[np.ndarray, " m"]
Values = Mapping[str, float]


@record
class Difference:
    """A way in which the machine differs, its size, and how much of the difference it explains."""

    kind: str  # parameter, gain, delay, mode, range
    name: str  # the parameter, the signal
    value: float  # factor of a parameter or gain; seconds; Hz; the range
    low: float | None
    high: float | None
    unit: str
    explains: float  # share of the misfit
    alike: tuple[str, ...] = ()  # parameters that would explain as much
    size: float | None = None  # of a mode: its zero's frequency over its pole's


@record
class Differences:
    """How the measured plant differs from the certified one."""

    inside: bool  # the machine is one of those that were certified
    misfit: float  # mean square of the difference over its std; 1 is noise
    off: float  # largest share of the response by which it differs, beyond its disc
    off_hz: float | None
    found: tuple[Difference, ...]
    nearest: Mapping[str, float]  # of the certificate's draws, the values of the one that is nearest
    nearest_misfit: float | None


@record(eq=False)
class Comparison:
    """The measured plant and a model of it, as one vector of lines."""

    controller: Controller
    measured: Sequence[Measured]
    logs: Sequence[Ticks]

    @property
    def response(self) -> Lines:
        """The measured response, signal by signal, amplitude by amplitude."""
        return np.concatenate([ratio.value for part in self.measured for ratio in part.plants])

    @property
    def std(self) -> Float[np.ndarray, " m"]:
        """Its std."""
        return np.concatenate([ratio.std for part in self.measured for ratio in part.plants])

    @property
    def f(self) -> Float[np.ndarray, " m"]:
        """Hz, of each of its lines."""
        return np.concatenate([part.f for part in self.measured for _ in part.plants])

    def radius(self, alpha: float) -> Float[np.ndarray, " m"]:
        """Return the radii of its discs, all of which hold the truth but with the probability `alpha`."""
        each = alpha / self.f.size
        return np.concatenate([ratio.disc(each)[1] for part in self.measured for ratio in part.plants])

    def misfit(self, model: Lines) -> float:
        """Return the sum of squares of a model's difference, over the std."""
        return float(np.sum(np.abs((self.response - model) / self.std) ** 2))

    def predict(self, sets: Sequence[ParameterSet]) -> list[Lines]:
        """Return the responses of the model with each of some values."""
        assert self.controller.design is not None
        plant = self.controller.design[0]
        if has_dry_friction(self.controller):
            return self._simulate(sets)
        return [self._linearise(plant, values) for values in sets]

    def _linearise(self, plant: Plant, values: ParameterSet) -> Lines:
        seen = self.controller.plant(take_sliding(plant, values), values)
        return np.concatenate([seen.responses(part.f).ravel() for part in self.measured])

    def _simulate(self, sets: Sequence[ParameterSet]) -> list[Lines]:
        """Return the responses of the law on the nonlinear plant, under the logged references."""
        runs = [run_design(self.controller, sets, ticks.reference) for ticks in self.logs]
        return [self._cut([run.outputs for run in runs], k) for k in range(len(sets))]

    def _cut(self, outputs: Sequence[Mapping[str, Float[np.ndarray, "runs n"]]], k: int) -> Lines:
        """Return the response of the k-th of some runs, cut as the logs are."""
        law, parts = self.controller.law, list[Lines]()
        blocks = []
        for ticks, run in zip(self.logs, outputs, strict=True):
            readings = np.column_stack([run[name][k] for name in self.controller.signals])
            blocks.append(cut_periods(self.controller, replace(ticks, measured=readings, command=0.0 * ticks.command)))
        for group in join_blocks(blocks):
            mean = group.average()
            read = np.mean(mean.measured / mean.reference[:, None, :], axis=0)
            forward, *feedback = law.responses(group.f)
            effort = forward + np.sum(np.array(feedback) * read, axis=0)
            parts.append((read / effort).ravel())
        return np.concatenate(parts)


def compare(
    controller: Controller,
    measured: Sequence[Measured],
    logs: Sequence[Ticks],
    draws: Sequence[Values],
    confidence: float,
) -> Differences | None:
    """Return how the machine differs from a controller's design plant; None where the controller does not know it.
    `logs`: those that `measured` comes from. `draws`: of the certificate.
    """
    if controller.design is None:
        return None
    dry = has_dry_friction(controller)
    comparison = Comparison(controller=controller, measured=measured, logs=[*map(shorten, logs)] if dry else logs)
    plant, values = controller.design
    nominal = plant.complete(values)
    response, count = comparison.response, comparison.f.size
    draws = draws[:SIMULATED] if dry else draws
    drawn = comparison.predict([values, *(place_values(plant, values, draw) for draw in draws)])
    model, drawn = drawn[0], np.array(drawn[1:]).reshape(-1, count)
    before = comparison.misfit(model)
    reach = np.max(np.abs(drawn - model), axis=0, initial=0.0)
    left = np.abs(response - model) - comparison.radius(1.0 - confidence) - reach
    share = left / np.abs(model)
    flat = [*_list_clipped(controller, logs)]
    found = [*flat, *_explain(comparison, plant, nominal, values, model, before)]
    misfits = [comparison.misfit(row) for row in drawn]
    best = int(np.argmin(misfits)) if misfits else None
    inside = bool(np.all(share <= TOLERATED)) and not flat
    worst = int(np.argmax(share))
    return Differences(
        inside=inside,
        misfit=before / count,
        off=max(float(share[worst]), 0.0),
        off_hz=float(comparison.f[worst]) if share[worst] > TOLERATED else None,
        found=tuple(found),
        nearest={} if best is None else dict(draws[best]),
        nearest_misfit=None if best is None else misfits[best] / count,
    )


def _list_clipped(controller: Controller, logs: Sequence[Ticks]) -> Iterator[Difference]:
    """Yield the signals whose readings stop at an edge."""
    for i, name in enumerate(controller.signals):
        for ticks in logs:
            size = np.abs(ticks.measured[:, i])
            top = size >= np.max(size) * (1.0 - 1e-9)
            runs = find_runs(top)
            if np.count_nonzero(top) >= FEWEST_FLAT and np.max(runs.lengths, initial=0) >= 3 and not np.all(top):
                unit = controller.command.reference_unit if i == 0 else ""
                edge = float(np.max(size))
                yield Difference(kind="range", name=name, value=edge, low=None, high=None, unit=unit, explains=1.0)
                break


def _explain(
    comparison: Comparison, plant: Plant, nominal: ParameterSet, values: ParameterSet, model: Lines, before: float
) -> list[Difference]:
    """Return the causes that explain the misfit, the best first."""
    noise = float(comparison.f.size)
    if before <= 2.0 * noise:
        return []
    tried = [
        *_try_parameters(comparison, nominal, values, model),
        *_try_shapes(comparison, model),
    ]
    excess = before - noise
    tried.sort(key=lambda pair: pair[1] * (MODE_COST if pair[0].kind == "mode" else 1.0))
    rated = [(difference, max(0.0, 1.0 - max(after - noise, 0.0) / excess)) for difference, after in tried]
    listed: list[Difference] = []
    for difference, share in rated:
        twin = next(
            (
                k
                for k, other in enumerate(listed)
                if abs(other.explains - share) < ALIKE * share and _same(other, difference)
            ),
            None,
        )
        if twin is not None:
            listed[twin] = replace(listed[twin], alike=(*listed[twin].alike, difference.name))
        elif share > 0.0:
            listed.append(replace(difference, explains=share))
    return listed[:MOST]


def _same(first: Difference, second: Difference) -> bool:
    """Tell whether two causes that explain as much may be one: factors of parameters and gains."""
    return first.unit == second.unit == "-" and {first.kind, second.kind} <= {"parameter", "gain"}


Tried = tuple[Difference, float]


def _try_parameters(
    comparison: Comparison, nominal: ParameterSet, values: ParameterSet, model: Lines
) -> Iterator[Tried]:
    """Yield the parameters of the plant with the factors that fit best."""
    names = [name for name, each in nominal.items() if each.value and name not in DELAYS]

    def change(name: str, log: float) -> ParameterSet:
        each = nominal[name]
        return values.with_parameters(replace(each, value=each.value * math.exp(log), min=-math.inf, max=math.inf))

    logs = dict.fromkeys(names, 0.0)
    models = dict.fromkeys(names, model)
    slopes: dict[str, Lines] = {}
    moved: dict[str, float] = {}
    for _ in range(ROUNDS):
        stepped = comparison.predict([change(name, logs[name] + STEP) for name in names])
        for name, after in zip(names, stepped, strict=True):
            slope = (after - models[name]) / STEP
            weight = 1.0 / comparison.std**2
            size = float(np.sum(weight * np.abs(slope) ** 2))
            if size <= 0.0 or not math.isfinite(size):
                continue
            slopes[name] = slope
            error = comparison.response - models[name]
            step = float(np.sum(weight * np.real(np.conj(slope) * error))) / size
            before = logs[name]
            logs[name] = float(np.clip(before + np.clip(step, -0.5, 0.5), -MOST_LOG, MOST_LOG))
            moved[name] = abs(logs[name] - before)
        names = [name for name in names if moved.get(name, 0.0) > FOUND]
        if not names:
            break
        fitted = comparison.predict([change(name, logs[name]) for name in names])
        models |= dict(zip(names, fitted, strict=True))
    for name in slopes:
        after = comparison.misfit(models[name])
        std = _find_std(comparison, slopes[name], after)
        spread, value = 1.96 * std, math.exp(logs[name])
        low, high = (value * math.exp(-spread), value * math.exp(spread)) if spread < MOST_SPREAD else (None, None)
        yield Difference(kind="parameter", name=name, value=value, low=low, high=high, unit="-", explains=0.0), after


def _find_std(comparison: Comparison, slope: Lines, after: float) -> float:
    """Return the std of a real size whose slope is given, widened by what is left of the misfit."""
    information = 2.0 * float(np.sum(np.abs(slope / comparison.std) ** 2))
    return math.sqrt(max(after / comparison.f.size, 1.0) / information) if information else math.inf


def _try_shapes(comparison: Comparison, model: Lines) -> Iterator[Tried]:
    """Yield a gain, a delay and a mode, each with the size that fits best."""
    from scipy.optimize import least_squares  # deferred: 0.2 s

    f, response, std = comparison.f, comparison.response, comparison.std
    weight = 1.0 / std**2

    def fit(shape: Callable[[Float[np.ndarray, " k"]], Lines], start: Sequence[float]) -> tuple[np.ndarray, float]:
        def errors(x: Float[np.ndarray, " k"]) -> Float[np.ndarray, " n"]:
            left = (response - model * shape(x)) / std
            return np.concatenate([left.real, left.imag])

        solved = least_squares(errors, start, x_scale=np.maximum(np.abs(start), 1e-3), max_nfev=200)
        return solved.x, 2.0 * float(solved.cost)

    gain = float(np.sum(weight * np.real(np.conj(model) * response)) / np.sum(weight * np.abs(model) ** 2))
    after = comparison.misfit(gain * model)
    spread = 1.96 * _find_std(comparison, model, after)
    yield (
        Difference(kind="gain", name="gain", value=gain, low=gain - spread, high=gain + spread, unit="-", explains=0.0),
        after,
    )
    (delay,), after = fit(lambda x: np.exp(-2j * np.pi * f * x[0]), [0.0])
    spread = 1.96 * _find_std(comparison, model * 2j * np.pi * f, after)
    yield (
        Difference(
            kind="delay", name="delay", value=delay, low=delay - spread, high=delay + spread, unit="s", explains=0.0
        ),
        after,
    )
    yield from _try_mode(comparison, model, fit)


def _try_mode(comparison: Comparison, model: Lines, fit: Callable[..., tuple[np.ndarray, float]]) -> Iterator[Tried]:
    """Yield the mode that fits best: a mass on a spring beside the drive, or a pair of zeros and one of poles. The
    force that a mass on a spring takes of the motion is added to the inverse of the response without hold and delay.
    """
    f, controller = comparison.f, comparison.controller
    late = (controller.delay_samples + 0.5) * controller.sample_time_s
    held = np.sinc(f * controller.sample_time_s) * np.exp(-2j * np.pi * f * late)
    moved = -model / held * (2.0 * np.pi * f) ** 2
    low, high = math.log(0.5 * f[0]), math.log(2.0 * np.max(f))

    def pair(hertz: Any, damping: Any) -> Lines:
        return 1.0 - (f / hertz) ** 2 + 2j * damping * f / hertz

    def take(x: Float[np.ndarray, " k"], k: int) -> tuple[Any, Any]:
        return np.exp(np.clip(x[k], low, high)), np.exp(np.clip(x[k + 1], LEAST_DAMPING, 0.0))

    def absorb(x: Float[np.ndarray, " k"]) -> Lines:
        hertz, damping = take(x, 0)
        return 1.0 / (1.0 + x[2] * scale * moved * (1.0 + 2j * damping * f / hertz) / pair(hertz, damping))

    def divide(x: Float[np.ndarray, " k"]) -> Lines:
        return pair(*take(x, 0)) / pair(*take(x, 2))

    misfit = np.abs((comparison.response - model) / comparison.std)
    best: tuple[float, float, float | None] | None = None
    apart = np.where(misfit > SEEN, np.abs(comparison.response / model - 1.0), 0.0)
    for line in np.unique(np.concatenate([np.argsort(-misfit)[:2], np.argsort(-apart)[:2]])):
        at, scale = math.log(f[line]), 1.0 / abs(moved[line])
        for damping in map(math.log, MODE_DAMPINGS):
            starts = [(absorb, [at, damping, sign * 0.1]) for sign in (1.0, -1.0)]
            starts += [(divide, [at, damping, at + step, damping]) for step in (-0.05, 0.05)]
            for shape, start in starts:
                x, after = fit(shape, start)
                hertz, damped = take(x, 0)
                inside = f[0] < hertz < np.max(f) and damped < MOST_DAMPED
                if inside and (best is None or after < best[0]):
                    best = after, float(hertz), float(hertz / take(x, 2)[0]) if shape is divide else None
    if best is not None:
        after, hertz, apart = best
        mode = Difference(
            kind="mode", name="mode", value=hertz, low=None, high=None, unit="Hz", explains=0.0, size=apart
        )
        yield mode, after + 3.0  # it has some sizes where others have one
