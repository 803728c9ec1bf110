r"""The logs of a fit as last judge of a law: Ms and stability on the response that each of them shows.

A log's outputs less those that the fitted model simulates have a response :math:`\hat E` from the command in discs of
radius R (`seaopt.frequency.residual`). Around the model's own response G the law's loop is then
:math:`1 + C (G + \hat E)`, and of m lines at a risk :math:`\alpha`

- *refuted*, where a line has :math:`|1 + C (G + \hat E)| + |C| R(\alpha/m) < 1/M_s`, or all discs leave zero out and
  the loop turns about it once more, or less, than the model's;
- *confirmed*, by samples that were not fitted, where all lines have :math:`|1 + C(G + \hat E)| - x - M_s x^2/2 \ge
  1/M_s`, x being the radial bound of R, lie about the crossover, and turn about zero as the model's do;
- *undecided* otherwise. Samples that were fitted are not independent: they can refute, and confirm nothing.

Besides, a log may *contradict the model*, whether the law's Ms is kept or not (`agreement`): the other checks, which
stand on the model alone, are then of another actuator. Each statement has its own share of the risk.

A log whose input carries its noise judges nothing: where it was taken under a law (stated, or found in it), or the fit
is of prediction errors, as of such logs. Where noise dominates G + E would tend to -1/C, whatever the plant is.

Beyond the lines whose discs are small nothing is said, and the model stands as the other checks judge it. With dry
friction G is the response of the simulated outputs by the same windows, so that model and log are compared at the log's
amplitude; a line at which the model itself breaks the limit there is one only where the log is worse than the model.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from functools import cache, partial
from typing import Any, Literal

import numpy as np
from jaxtyping import Complex, Int

from seaopt.codec import OrInfinite
from seaopt.control import Controller
from seaopt.control.laws.delay import find_given_drive_delay
from seaopt.control.loops.measured.plant import hold_response
from seaopt.errors import SeaoptError
from seaopt.estimation import Experiment, Fit
from seaopt.estimation.judgement.intervals import ROUGH
from seaopt.estimation.result.covariance import take_root
from seaopt.estimation.result.findings import Nuisance
from seaopt.formatting import join_words
from seaopt.frequency.residual import LENGTHS, ResidualResponse, find_feedback, measure_residual
from seaopt.frequency.response import ComplexLines, Lines, find_band
from seaopt.frequency.sampled import sampled_response
from seaopt.logs.quality.faults import find_runs
from seaopt.parameters import ParameterSet
from seaopt.plants.friction import has_friction
from seaopt.records import record
from seaopt.robustness.uncertainty.agreement import Agreement, find_radius, judge_agreement, widen_by_model
from seaopt.simulation import Clock, linearise, make_model

GRACE = 0.05  # of Ms: an actuator is not its model to the last digit
REFUTE, CONFIRM, CONTRADICT = 0.01, 0.05, 0.01  # the risk of a false statement: on the law, twice, and on the model
EACH = CONTRADICT / LENGTHS  # of the last, of windows of one length
LARGEST_DISC = 0.5  # of the distance from zero: where discs are larger, the log says nothing
SMOOTH = 5  # lines of which the median disc decides whether one tells
FEWEST_LINES = 8
STEP = 3e-3  # of a parameter, by which its effect on a log is measured
SHARED = 0.01  # of the samples: slices of one log have an end in common
PERIODS = 120.0  # of the bandwidth in the longest window
HIGHEST = 0.5  # of the Nyquist frequency of log and law: above, folding is no longer small
ABOUT = 0.5, 1.25  # of the crossover, and of where Ms is predicted too: from where to where lines must confirm
Samples = Literal["fitted", "held out", "validate"]
Outcome = Literal["confirmed", "refuted", "undecided"]


@record
class LogVerdict:
    """What a log says of the law's loop, as measured and as the model predicts it for this log."""

    experiment: str
    samples: Samples
    outcome: Outcome
    band_hz: tuple[float, float]  # in which the log can tell, or confirms
    ms: OrInfinite  # at the line that says most; infinite where the loop is unstable
    ms_hz: float  # that line
    ms_least: OrInfinite  # what the log leaves there at least
    ms_predicted: float  # at `ms_hz`
    confidence: float | None  # of a refutation, or a confirmation, had or not; None of samples that were fitted
    amplitude: float  # rms of the input, in `unit`
    unit: str
    at_amplitude: bool  # friction is dry: at another amplitude the response is another one
    asked_hz: tuple[float, float] | None = None  # from where to where lines must keep the limit to confirm it
    agreement: Agreement | None = None  # with the model, at a risk of CONTRADICT; None in an older file


@record
class SilentLog:
    """A log that says nothing of the law's loop, and why."""

    experiment: str
    why: Literal["lacks a signal", "taken under feedback", "looks like feedback", "too weak", "an error"]
    detail: str = ""


@record(eq=False)
class _Record:
    """A part of a log beside the fit's simulation of it."""

    experiment: Experiment
    samples: Samples
    nuisance: Nuisance
    command: Any
    model: Any  # outputs by rows, as the sensors' gains have them
    error: Any
    rows: slice
    names: tuple[str, ...]  # of these outputs, which the law reads
    dry: bool  # friction of the plant, so that the response is one of the log's amplitude

    @property
    def runs(self) -> list[slice]:
        """The rows without a gap, in which nothing is missing."""
        good = np.isfinite(self.command) & np.all(np.isfinite(self.model) & np.isfinite(self.error), axis=0)
        good[: self.rows.start] = False
        joined = np.zeros(good.size, dtype=bool)
        for rows in self.experiment.log_segments:
            joined[rows] = True
            joined[rows.start] = False  # no run goes over a gap
        runs = find_runs(good & joined)
        return [*map(slice, runs.start.tolist(), runs.stop.tolist())]


def judge_log(
    controller: Controller, fit: Fit, experiment: Experiment, ms: float
) -> tuple[tuple[LogVerdict, ...], SilentLog | None]:
    """Return what a log says of a law that is to keep Ms, whole and where it was held out; or why it says nothing."""
    silent = partial(SilentLog, experiment=experiment.name)
    there = {*experiment.outputs, *experiment.log.signals.keys() & experiment.plant.inputs.keys()}
    needed = [controller.command.input, *(name for name in controller.signals if name in experiment.plant.outputs)]
    if lacking := [name for name in needed if name not in there]:
        return (), silent(why="lacks a signal", detail=join_words(lacking))
    if experiment.feedback or experiment.log.law or fit.method == "prediction_error":
        return (), silent(why="taken under feedback")
    try:
        whole, *parts = _list_records(fit, experiment, controller)
        runs = whole.runs
        if find_feedback(whole.command, whole.error, runs):
            return (), silent(why="looks like feedback")
        judged = [_judge(controller, fit, part, part.runs, ms * (1.0 + GRACE)) for part in parts]
        first = _judge(controller, fit, whole, runs, ms * (1.0 + GRACE))
    except SeaoptError as error:
        return (), silent(why="an error", detail=str(error))
    verdicts = tuple(verdict for verdict in (first, *judged) if verdict is not None)
    return verdicts, silent(why="too weak") if first is None else None


def _list_records(fit: Fit, experiment: Experiment, controller: Controller) -> Iterator[_Record]:
    """Yield a log with its simulation, and what was held out of it alone."""
    predicted, n = fit.predict(experiment), len(experiment.log)
    names = tuple(name for name in controller.signals if name in experiment.outputs)
    gain = np.array([predicted.own.gain[name] for name in names])[:, None]
    model = np.array([predicted.model[name] for name in names]) / gain
    error = np.array([predicted.measured[name] for name in names]) / gain - model
    whole = _Record(
        experiment=experiment,
        samples="fitted" if any(_shares(each, experiment, fit.holdout) for each in fit.experiments) else "validate",
        nuisance=predicted.own,
        command=experiment.log[controller.command.input],
        model=model,
        error=error,
        rows=slice(0, n),
        names=names,
        dry=has_friction(experiment.plant, experiment.apply_own(fit.parameters)),
    )
    yield whole
    if fit.holdout and any(experiment is each for each in fit.experiments):
        yield replace(whole, samples="held out", rows=slice(experiment.count_fitted(fit.holdout), n))


def _shares(fitted: Experiment, other: Experiment, holdout: float) -> bool:
    """Tell whether samples that were fitted are another experiment's, too: of one log, or of a file that is read twice
    in slices that overlap by more than their ends.
    """
    if fitted is other or fitted.log is other.log:
        return True
    count = fitted.count_fitted(holdout)
    _, a, b = np.intersect1d(fitted.log.time[:count], other.log.time, assume_unique=True, return_indices=True)
    names = fitted.log.signals.keys() & other.log.signals.keys()
    same = (np.array_equal(fitted.log[name][a], other.log[name][b], equal_nan=True) for name in names)
    return bool(names) and a.size > SHARED * len(other.log) and all(same)


def _measure(controller: Controller, part: _Record, runs: list[slice]) -> list[ResidualResponse]:
    """Return the response of a record, up to where a law's loop can be told from it."""
    period = part.experiment.log.period
    if not runs or np.ptp(np.concatenate([part.command[run] for run in runs])) == 0.0:
        return []
    return measure_residual(
        part.command,
        part.model,
        part.error,
        period,
        runs,
        longest_s=PERIODS / controller.spec.bandwidth_hz,
        highest_hz=HIGHEST * 0.5 / max(period, controller.sample_time_s),
    )


def _weigh(controller: Controller, part: _Record, f: Lines) -> Complex[np.ndarray, "y m"]:
    """Return what of the loop gain is the law's, per response of the log's outputs: at the law's hold and delays."""
    read = [name in part.names for name in controller.signals]
    feedback = controller.law.feedback_responses(f)[: len(read)][read]
    clock = Clock(period=part.experiment.log.period, hold=part.experiment.hold)
    ratio = hold_response(f, Clock(period=controller.sample_time_s)) / hold_response(f, clock)
    given, late = find_given_drive_delay(controller.spec), controller.spec.loop_delay_samples * controller.sample_time_s
    if controller.spec.delay_samples is not None:  # the whole loop, with the log's delay in it
        late = max(late - part.nuisance.delay_s, 0.0)
    elif given is not None:
        late += given - part.nuisance.delay_s
    return feedback * (controller.command.per_effort * ratio * np.exp(-2j * np.pi * f * late))


def _find_base(controller: Controller, params: ParameterSet, part: _Record, f: Lines) -> Any:
    """Return the linear model's outputs per input as the log's clock has them."""
    experiment = part.experiment
    model = linearise(make_model(experiment.plant, experiment.apply_own(params), (), part.names))
    clock = Clock(period=experiment.log.period, hold=experiment.hold, delay_s=part.nuisance.delay_s)
    source = list(experiment.plant.inputs).index(controller.command.input)
    return sampled_response(model, np.zeros(0), clock, f, source)[0].T


@record(eq=False)
class _WindowLines:
    """The lines of windows of one length at which a log can tell of a loop."""

    f: Lines
    rows: Int[np.ndarray, " m"]  # among all lines
    loop: ComplexLines  # L as the model has it
    error: ComplexLines  # of it
    std: Lines
    unseen: Lines
    radius: Lines  # at the risk of a refutation
    freedom: float
    gapless: bool

    @property
    def predicted(self) -> Lines:
        """The distance of the model's loop from -1."""
        return np.abs(1.0 + self.loop)

    @property
    def measured(self) -> Lines:
        """That of the log."""
        return np.abs(1.0 + self.loop + self.error)


def _tell(
    controller: Controller, params: ParameterSet, part: _Record, response: ResidualResponse, alpha: float
) -> _WindowLines | None:
    """Return the lines at which a response can tell of the loop; None where they are too few."""
    from scipy.ndimage import median_filter  # deferred: 0.2 s

    f = response.frequency_hz
    c = _weigh(controller, part, f)
    loop, error, std, unseen = response.read(c)
    if not part.dry:
        loop = np.sum(c * _find_base(controller, params, part, f), axis=0)
    radius = std * response.widen(alpha) + unseen
    size = np.maximum(np.abs(1.0 + loop), np.abs(1.0 + loop + error))
    usable = median_filter(radius / size, SMOOTH, mode="nearest") < LARGEST_DISC
    if part.dry:  # what transients and friction make of the model's own response is no loop gain
        rough = np.sum(np.abs(c) * np.sqrt(response.rough), axis=0) * response.widen(CONFIRM)
        usable &= median_filter(rough / size, SMOOTH, mode="nearest") < LARGEST_DISC
    if np.count_nonzero(usable) < FEWEST_LINES:
        return None
    first, last = np.flatnonzero(usable)[[0, -1]]
    lines = (x[usable] for x in (f, np.arange(f.size), loop, error, std, unseen, radius))
    names = ("f", "rows", "loop", "error", "std", "unseen", "radius")
    return _WindowLines(
        **dict(zip(names, lines, strict=True)), freedom=response.freedom, gapless=bool(np.all(usable[first:last]))
    )


def _judge(controller: Controller, fit: Fit, part: _Record, runs: list[slice], limit: float) -> LogVerdict | None:
    """Return what a record says of a law; None where it says nothing."""
    responses = _measure(controller, part, runs)
    alpha = REFUTE / max(sum(response.frequency_hz.size for response in responses), 1)
    readable = [_tell(controller, fit.parameters, part, response, alpha) for response in responses]
    kinds = [lines for lines in readable if lines is not None]
    if not kinds:
        return None
    surest = max(kinds, key=lambda lines: _bound_ms(lines, limit)[0])
    least, at = _bound_ms(surest, limit)
    refuted, independent = least > limit, part.samples != "fitted"
    low, high = min(lines.f[0] for lines in kinds), max(lines.f[-1] for lines in kinds)
    confirmed = [] if refuted or not independent else [_confirm(controller, lines, limit) for lines in kinds]
    confirmed = [band for band in confirmed if band is not None]
    outcome: Outcome = "refuted" if refuted else "confirmed" if confirmed else "undecided"
    return LogVerdict(
        experiment=part.experiment.name,
        samples=part.samples,
        outcome=outcome,
        band_hz=max(confirmed, key=lambda band: band[1] / band[0]) if confirmed else (float(low), float(high)),
        ms=np.inf if np.isinf(least) else float(1.0 / surest.measured[at]),
        ms_hz=float(surest.f[at]),
        ms_least=least,
        ms_predicted=float(1.0 / surest.predicted[at]),
        confidence=None if not independent else 1.0 - (REFUTE if refuted else CONFIRM),
        amplitude=float(np.nanstd(part.command[part.rows])),
        unit=controller.command.unit,
        at_amplitude=part.dry,
        asked_hz=_ask_band(controller, surest) if independent else None,
        agreement=_compare(controller, fit, part, runs, readable),
    )


def _compare(
    controller: Controller, fit: Fit, part: _Record, runs: list[slice], readable: list[_WindowLines | None]
) -> Agreement:
    """Return whether a record agrees with the model, by the windows that say most."""
    count = sum(run.stop - run.start for run in runs)
    wider, found = widen_by_model(_find_excess(fit, part), count), list[Agreement]()

    @cache
    def measure() -> list[list[ResidualResponse]]:
        return [_measure(controller, moved, runs) for moved in _move(fit, part)]

    def move(k: int, lines: _WindowLines) -> Complex[np.ndarray, "k m"]:
        c = _weigh(controller, part, lines.f)
        moves = [np.sum(c * responses[k].model[:, lines.rows], axis=0) for responses in measure()]
        return np.array(moves).reshape(-1, lines.f.size)

    for k, lines in enumerate(readable):
        if lines is not None:
            found.append(
                judge_agreement(
                    lines.f,
                    lines.loop,
                    lines.error,
                    wider * lines.std,
                    lines.unseen,
                    freedom=lines.freedom,
                    alpha=EACH,
                    move=partial(move, k, lines),
                )
            )
    return max(found, key=lambda agreement: agreement.misfit / agreement.allowed)


def _find_excess(fit: Fit, part: _Record) -> float | None:
    """Return how many times their noise the fit's residuals of a record's outputs are, at most; None if not known."""
    of_plant = [name for name, own in fit.nuisance.items() if own.plant in ("", part.experiment.plant.name)]
    fitted = [
        output
        for name in of_plant
        for output_name, output in fit.outputs.get(name, {}).items()
        if output_name in part.names
    ]
    return max((output.excess for output in fitted if output.excess is not None), default=None)


def _move(fit: Fit, part: _Record) -> Iterator[_Record]:
    """Yield what a std along each axis of the fit's covariance, of noise and model, changes of a record's outputs: of
    the parameters, as far as those of a fit that is met are off, and of the delay where it is one of the fit's.
    """
    own, joint = part.nuisance, fit.total_delay_covariance
    covariance = fit.total_covariance if joint is None else joint
    of_delay = [f"{name}.delay_s" for name, each in fit.nuisance.items() if each.delay_s == own.delay_s]
    places = {name: k for k, name in enumerate(covariance.names) if np.isfinite(covariance.std(name))}
    late = [name for name in of_delay if name in places][:1]
    names = [name for name in places if name in fit.parameters]
    rows = [places[name] for name in (*names, *late)]
    values = np.array([*fit.parameters.values_of(names), *([own.delay_s] * len(late))])
    noise = [*map(fit.covariance.std, names), *([np.inf] * len(late))]
    most = np.maximum(ROUGH / find_radius(max(len(rows), 1), EACH) * np.abs(values), noise)
    root = take_root(covariance.matrix[np.ix_(rows, rows)])
    root *= np.minimum(1.0, most / np.maximum(np.linalg.norm(root, axis=1), 1e-300))[:, None]
    low = np.array([*(fit.parameters[name].min for name in names), *([0.0] * len(late))])
    high = np.array([*(fit.parameters[name].max for name in names), *([np.inf] * len(late))])
    scale, gain = np.maximum(np.abs(values), np.linalg.norm(root, axis=1)), [own.gain[name] for name in part.names]
    for axis in root.T[np.any(root != 0.0, axis=0)]:
        step = STEP / np.max(np.abs(axis[scale > 0.0]) / scale[scale > 0.0])
        inside = [np.all((low <= at) & (at <= high)) for at in (values + step * axis, values - step * axis)]
        step = -step if inside == [False, True] else step
        moved = dict(zip((*names, *late), np.clip(values + step * axis, low, high).tolist(), strict=True))
        delay_s = moved.pop(late[0]) if late else own.delay_s
        at = replace(
            fit,
            parameters=fit.parameters.update(**moved),
            experiments=(part.experiment,),
            nuisance={part.experiment.name: replace(own, delay_s=delay_s)},
        )
        outputs = at.predict(part.experiment).model
        change = np.array([outputs[name] for name in part.names]) / np.array(gain)[:, None] - part.model
        yield replace(part, model=change / step, error=change / step)


def _bound_ms(lines: _WindowLines, limit: float) -> tuple[float, int]:
    """Return what Ms is at least by what the model does not predict, and at which line; infinite of a loop that turns
    about -1 otherwise than the model's.
    """
    most = lines.measured + lines.radius
    low = np.where((lines.predicted >= 1.0 / limit) | (most < lines.predicted), 1.0 / most, 0.0)
    at = int(np.argmax(low))
    if lines.gapless and _is_turned(1.0 + lines.loop, lines.error, lines.radius):
        return np.inf, int(np.argmin(lines.measured))
    return float(low[at]), at


def _is_turned(model: Any, error: Any, radius: Any) -> bool:
    """Tell whether 1 + L turns about zero otherwise than the model's, all discs leaving zero out."""
    ends = [abs(error[k]) + radius[k] < abs(model[k]) for k in (0, -1)]
    certain = np.all(np.abs(1.0 + error / model) * np.abs(model) > radius)
    return bool(all(ends) and certain and _measure_turn(model, error) > np.pi)


def _ask_band(controller: Controller, lines: _WindowLines) -> tuple[float, float]:
    """Return a band about the crossover and the largest sensitivity that is predicted."""
    middle = controller.achieved.crossover_hz or controller.spec.bandwidth_hz
    peaks = controller.achieved.ms_hz, float(lines.f[np.argmin(lines.predicted)])  # that of the design, and at the log
    return ABOUT[0] * middle, ABOUT[1] * float(np.nanmax([middle, *peaks]))


def _confirm(controller: Controller, lines: _WindowLines, limit: float) -> tuple[float, float] | None:
    """Return the band in which every line keeps the limit, the error of each along a radius; None where that lacks a
    part of the band that is asked.
    """
    from scipy.special import stdtrit  # deferred: 0.1 s

    x = lines.std * stdtrit(2.0 * lines.freedom, 1.0 - CONFIRM / LENGTHS) / np.sqrt(2.0) + lines.unseen
    kept = lines.measured - x - 0.5 * limit * x**2 >= 1.0 / limit
    f = lines.f[find_band(lines.f, kept)]
    low, high = _ask_band(controller, lines)
    covers = lines.gapless and f.size and f[0] <= low and f[-1] >= high
    inside = (lines.f >= f[0]) & (lines.f <= f[-1]) if covers else np.zeros(lines.f.size, dtype=bool)
    turns = covers and _turns_alike((1.0 + lines.loop)[inside], lines.error[inside], x[inside])
    return (float(f[0]), float(f[-1])) if turns else None


def _turns_alike(model: Any, error: Any, radius: Any) -> bool:
    """Tell whether 1 + L turns about zero as often as the model's, where no line's disc holds zero: it turns as the
    model does along the lines, begins on the model's side, and leaves the model, which stands alone above, at the end.
    """
    ends = (1.0 + error[0] / model[0]).real > 0.0 and abs(error[-1]) + radius[-1] < abs(model[-1])
    return bool(ends and _measure_turn(model, error) < np.pi)


def _measure_turn(model: Any, error: Any) -> float:
    """Return by how much 1 + L turns about zero beside the model's, in radians; NaN where lines lie too far apart."""
    ratio = 1.0 + error / model
    steps = np.angle(ratio[1:] / ratio[:-1])
    return float(abs(np.sum(steps))) if np.all(np.abs(steps) < 0.5 * np.pi) else math.nan
