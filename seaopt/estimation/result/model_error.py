r"""What the structure that is left in a fit's residuals may move its parameters by: their model covariance.

A covariance of residuals tells how far noise moves the estimates. What a model lacks moves them too, and no formula on
one log tells by how much; what a log can tell is put together here. All is linear in the minimum, over the parameters
and delays alone: the other unknowns :math:`\nu` (offsets, initial states) are eliminated, so that with H the Hessian
of all unknowns and E the columns of those that are wanted

.. math:: S = (E^T H^{-1} E)^{-1}, \qquad \tilde J_t = J_t H^{-1} E S, \qquad S = \sum_t \tilde J_t^T \tilde J_t + P,
          \qquad g_A = \sum_{t \in A} \tilde J_t^T r_t, \qquad H_A = \sum_{t \in A} \tilde J_t^T \tilde J_t .

- b, the noise: the largest of the std for white residuals, of that for coloured ones (`covariance`), of what the
  scores :math:`\tilde J_t^T r_t` vary by within 0.1 s (Newey and West, Econometrica 55, 1987), and of what the steps of
  coarse sensors make (`rounding`), which is all there is of outputs whose step is stated; at least 0.02 % where the
  residual is more than noise, and as little as a clock of quartz is off by where it is not.
- j, parts of the log: without one of 8 contiguous parts the estimates move by :math:`d_k = -(S - H_k)^{-1} g_k`
  (a jackknife of one step: Efron, The Jackknife, the Bootstrap and Other Resampling Plans, 1982);
  :math:`v = \tfrac78 \sum (d_k - \bar d)^2` and :math:`j^2 = \max(0, v - b^2)`. Where few parts have all the
  information, noise alone gives more than b^2 and scatters more: where the residual is noise, so much is taken off.
- t, halves of the log, by time, by amplitude and by speed: :math:`d = (H_A^{-1} g_A - H_B^{-1} g_B)/2`, of the halves
  that differ the most; where it is beyond 3 of its own standard deviations.
- g, few values: an output's residual is in part a model's error, :math:`m_o = 1 - (\text{noise}/\text{rms})^2`, which
  has some 80 independent values however long the log is (`noise_floor`):
  :math:`G = \tfrac{N}{80} S^{-1} \big(\sum_o m_o \tilde J_o^T \tilde J_o\, \text{rms}_o^2\big) S^{-1}`.

The count of 80, the halves and the limits are from fits of simulated actuators with 28 kinds of physics that the model
lacked. Beyond an excess of 3 none of this suffices: see `seaopt.estimation.judgement`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import field
from functools import reduce

import numpy as np
from jaxtyping import Bool, Float

from seaopt.estimation.problem.experiment import Experiment
from seaopt.estimation.problem.fit_experiment import FitExperiment
from seaopt.estimation.problem.fit_problem import FitProblem
from seaopt.estimation.problem.noise_floor import NoiseFloor, list_excess
from seaopt.estimation.problem.normal_equations import invert
from seaopt.estimation.problem.residual_statistics import ExperimentResiduals, ResidualsByExperiment, stream_columns
from seaopt.estimation.problem.rounding import Rounding, equate
from seaopt.estimation.problem.shapes import ParameterMatrix, ParameterVector, Signal, Vector
from seaopt.estimation.result.covariance import compute_bread, compute_influence, map_to_influence, take_root
from seaopt.records import record
from seaopt.signals import bridge, median

PARTS = 8
HALVES = 3  # by time, by amplitude, by speed
WINDOW_S, WINDOWS = 0.1, 20  # over which scores correlate; and at least so many of them in a log
ENVELOPE_S = 0.25
APART = 3.0  # standard deviations from which halves differ
INDEPENDENT = 80.0  # values of a model's error
LEAST_SHARE = 2e-4  # of a value, below which no std is believed where a residual is more than noise
CLOCK = 2e-5  # of a value: what a clock of quartz is off by
SCATTER = 3.0  # standard deviations by which the jackknife of a log whose information is in few parts may scatter
CHANCE = 4.0  # over sqrt(N), the share of a residual's power by which its noise is misjudged: two std of that estimate
SEEN = 1e-3  # of the whole log's information: what a part has less of it does not show
LITTLE = 1.5  # excess up to which a residual is taken for noise
FEWEST = 0.1  # share of the samples that a half has to have


@record(eq=False)
class ModelError:
    """What the structure of residuals may move parameters and delays by, each part a covariance in SI."""

    names: tuple[str, ...]  # the free parameters, then the delays that were fitted
    excess: Mapping[str, float]  # of each output, EXPERIMENT.OUTPUT: its residual over its sensor's noise
    # colour: what the noise's std lacks of b; parts: j; halves: t; few_values: g
    colour: ParameterMatrix = field(default_factory=lambda: np.zeros((0, 0)))
    parts: ParameterMatrix = field(default_factory=lambda: np.zeros((0, 0)))
    halves: ParameterMatrix = field(default_factory=lambda: np.zeros((0, 0)))
    few_values: ParameterMatrix = field(default_factory=lambda: np.zeros((0, 0)))
    # of each output whose rounding is found in the log, and of each of `names`: variances over those of white noise
    rounding: Mapping[str, ParameterVector] = field(default_factory=dict[str, ParameterVector])
    # what one unit of each moves an output by, the other unknowns following: rms over the output's spread
    effect: ParameterVector = field(default_factory=lambda: np.zeros(0))

    @property
    def matrix(self) -> ParameterMatrix:
        """The model covariance: the sum of all."""
        return self.colour + self.parts + self.halves + self.few_values


def estimate_model_error(
    problem: FitProblem,
    z: Vector,
    residuals: ResidualsByExperiment,
    floors: Mapping[str, NoiseFloor],
    noise: ParameterMatrix,
) -> ModelError:
    """Return what the residuals at a minimum may move its parameters and delays by, besides their noise. `residuals`,
    `floors`: at `z`; `noise`: the covariance of the parameters and the fitted delays, in their order.
    """
    unknowns = problem.unknowns
    delays = [e.slots.delay.index for e in problem.experiments if e.slots.delay.index is not None]
    stated = np.array([*range(unknowns.shared), *delays], dtype=int)
    names = tuple(unknowns.names[i] for i in stated)
    excess = list_excess(problem, floors)
    bread = problem.evaluate(z).hessian if problem.loss.quadratic else compute_bread(problem, z)
    if not stated.size or not np.all(np.isfinite(bread)):
        zero = np.zeros((stated.size,) * 2)
        parts = dict.fromkeys(("colour", "parts", "halves", "few_values"), zero)
        return ModelError(names=names, excess=excess, **parts, effect=np.zeros(stated.size))
    columns = invert(bread)[0][:, stated]
    inverse = columns[stated]
    information = invert(inverse)[0]
    sums = _sum_parts(problem, z, residuals, columns @ information, floors)
    scores = inverse @ sums.windows @ inverse
    variance = np.where(np.isfinite(np.diag(noise)), np.diag(noise), 0.0)
    white = np.diag(inverse @ sums.power @ inverse)
    rounded, known = inverse @ sums.rounded @ inverse, inverse @ sums.stated @ inverse
    if sums.known:
        known = _resize(known, equate(sums.known, inverse, np.diag(known)))
    others = np.clip(1.0 - np.diag(inverse @ sums.stated_power @ inverse) / np.maximum(white, 1e-300), 0.0, 1.0)
    found = [variance, white, np.diag(scores)]
    noisy = np.maximum.reduce([*(others * each for each in found), np.diag(rounded)]) + np.diag(known)
    most = np.maximum.reduce([*found, noisy])  # what chance may make of parts and halves
    inflation = most / np.maximum(np.diag(inverse), 1e-300)
    noise_alone = max(excess.values()) <= LITTLE
    least = ((CLOCK if noise_alone else LEAST_SHARE) * z[stated]) ** 2
    b2 = np.maximum(most, least)
    return ModelError(
        names=names,
        excess=excess,
        colour=_resize(scores + rounded + known, np.maximum(noisy, least) - variance),
        parts=_jackknife(information, sums, b2, inflation, noise_alone=noise_alone),
        halves=_compare_halves(information, sums, inflation),
        few_values=inverse @ sums.error_power @ inverse * (sums.count / INDEPENDENT),
        rounding={
            label: np.diag(inverse @ made @ inverse) / np.maximum(np.diag(inverse @ if_white @ inverse), 1e-300)
            for label, (made, if_white) in sums.found.items()
        },
        effect=sums.effect,
    )


def _resize(matrix: ParameterMatrix, variances: ParameterVector) -> ParameterMatrix:
    """Return a covariance of the same correlations with other variances, which count as zero where they are below."""
    std = np.sqrt(np.maximum(np.diag(matrix), 0.0))
    wanted = np.sqrt(np.maximum(variances, 0.0))
    scale = np.where(std > 0.0, wanted / np.where(std > 0.0, std, 1.0), 0.0)
    resized = matrix * scale[:, None] * scale
    np.fill_diagonal(resized, wanted**2)
    return resized


@record(eq=False)
class _Sums:
    """Sums over the samples, over the parameters and delays alone: H_k and g_k of parts, and of a half of each split.
    `share` is how many of the samples are in that half, `windows` the scores' products within a window, `power` and
    `error_power` the information of the outputs weighted with the power of their residuals, and with that of the
    model's error, `stated` and `stated_power` with the errors of those whose rounding is stated, and with the power of
    their residuals, `found` with the errors of each output whose rounding the log shows, and with white ones of the
    same power, `coarse` all roundings and `known` those that are stated, `effect` the largest rms over the outputs'
    spreads that a unit of each makes.
    """

    information: Float[np.ndarray, "parts q q"]
    score: Float[np.ndarray, "parts q"]
    half_information: Float[np.ndarray, "halves q q"]
    half_score: Float[np.ndarray, "halves q"]
    share: Float[np.ndarray, " halves"]
    windows: ParameterMatrix
    power: ParameterMatrix
    stated: ParameterMatrix
    stated_power: ParameterMatrix
    error_power: ParameterMatrix
    found: Mapping[str, tuple[ParameterMatrix, ParameterMatrix]]
    coarse: Sequence[Rounding]
    known: Sequence[Rounding]
    effect: ParameterVector
    count: float

    @property
    def rounded(self) -> ParameterMatrix:
        """The information of all outputs whose rounding the log shows, weighted with its errors."""
        return sum((made for made, _ in self.found.values()), np.zeros_like(self.power))


def _jackknife(
    information: ParameterMatrix, sums: _Sums, b2: ParameterVector, inflation: ParameterVector, *, noise_alone: bool
) -> ParameterMatrix:
    """Return what the estimates move by without one part of the log, beyond what noise moves them."""
    root = take_root(invert(information)[0])
    without = _invert_parts(information - sums.information, root)
    moved = -np.einsum("kij,kj->ki", without, sums.score)
    by_noise = np.diagonal(without @ sums.information @ without, 0, 1, 2) * inflation
    apart = moved - np.mean(moved, axis=0)
    share = (PARTS - 1.0) / PARTS
    matrix = share * apart.T @ apart
    chance = share * np.sum(by_noise, axis=0)
    # Of one degree of freedom where one part has all the information, of 8 where they have as much.
    freedom = np.sum(by_noise, axis=0) ** 2 / np.maximum(np.sum(by_noise**2, axis=0), 1e-300)
    scatter = SCATTER * (np.sqrt(2.0 / np.maximum(freedom, 1.0)) - np.sqrt(2.0 / PARTS))
    expected = np.maximum(np.where(scatter > 0.0, chance * (1.0 + scatter), b2), b2) if noise_alone else b2
    return _resize(matrix, np.diag(matrix) - expected)


def _compare_halves(information: ParameterMatrix, sums: _Sums, inflation: ParameterVector) -> ParameterMatrix:
    """Return half of what the estimates of two halves differ by, of the splits that differ the most."""
    q, root = len(information), take_root(invert(information)[0])
    priors = information - np.sum(sums.information, axis=0)
    whole_score, whole = np.sum(sums.score, axis=0), np.sum(sums.information, axis=0)
    apart = np.zeros((HALVES, q))
    for s in range(HALVES):
        if not FEWEST < sums.share[s] < 1.0 - FEWEST:
            continue
        halves = np.array([sums.half_information[s], whole - sums.half_information[s]])
        inverses = _invert_parts(halves + 0.5 * priors, root)
        scores = (sums.half_score[s] - 0.5 * whole_score, 0.5 * whole_score - sums.half_score[s])
        shift = 0.5 * (inverses[0] @ scores[0] - inverses[1] @ scores[1])
        white = np.maximum(np.diag(np.sum(inverses, axis=0)), 0.0) * inflation
        rounded = sum((each.compare(s, inverses) for each in sums.coarse), np.zeros(q))
        std = 0.5 * np.sqrt(np.maximum(white, rounded))
        apart[s] = np.where(np.abs(shift) > APART * std, shift, 0.0)
    largest = np.abs(apart) == np.max(np.abs(apart), axis=0)
    chosen = np.where(largest, apart, 0.0)
    return chosen.T @ chosen


def _invert_parts(information: Float[np.ndarray, "k q q"], root: ParameterMatrix) -> Float[np.ndarray, "k q q"]:
    """Return the inverses of parts' information over what each shows; `root`: of the inverse of the whole's."""
    values, vectors = np.linalg.eigh(root.T @ information @ root)
    along = root @ vectors
    return (along / np.where(values > SEEN, values, np.inf)[:, None, :]) @ along.swapaxes(1, 2)


def _sum_parts(
    problem: FitProblem,
    z: Vector,
    residuals: ResidualsByExperiment,
    inverse: Float[np.ndarray, "n q"],
    floors: Mapping[str, NoiseFloor],
) -> _Sums:
    """Sum over all samples, in one pass; `inverse` takes sensitivities to those of the parameters and delays alone."""
    q, loss = inverse.shape[1], problem.loss
    information, score = np.zeros((PARTS, q, q)), np.zeros((PARTS, q))
    half_information, half_score, in_half = np.zeros((HALVES, q, q)), np.zeros((HALVES, q)), np.zeros(HALVES)
    windows, power, stated, stated_power, error_power = (np.zeros((q, q)) for _ in range(5))
    found, effect = dict[str, tuple[ParameterMatrix, ParameterMatrix]](), np.zeros(q)
    every, known = list[Rounding](), list[Rounding]()
    masks = {
        e.name: [reduce(np.logical_or, s.mark_counted(e.weights.settle).T) for s in e.segments]
        for e in problem.experiments
    }
    samples = sum(int(np.count_nonzero(mask)) for rows in masks.values() for mask in rows)
    before = 0
    for experiment in problem.experiments:
        floor = floors[experiment.name]
        rms2 = floor.rms**2
        error = np.clip(1.0 - (1.0 + CHANCE / np.sqrt(np.maximum(floor.count, 1.0))) / floor.excess**2, 0.0, 1.0)
        length = max(1, min(round(WINDOW_S / experiment.period), experiment.samples // WINDOWS))
        split = _split(experiment, residuals[experiment.name], masks[experiment.name])
        grams = np.zeros((len(rms2), q, q))
        coarse = [Rounding.of(step, noise, q, HALVES) for step, noise in zip(floor.step, floor.noise, strict=True)]
        for segment, high, counted in zip(experiment.segments, split, masks[experiment.name], strict=True):
            order = before + np.cumsum(counted) - counted
            into = map_to_influence(experiment, segment, inverse)
            tail = np.zeros((q, length))
            for rows, columns, used in stream_columns(experiment, segment, z):
                along = compute_influence(columns, used, into)
                r = (columns[:, :, 0] / experiment.sigma).T
                weighted = along if loss.quadratic else along * loss.curvature(r)[:, None, :]
                scores = np.sum(along * loss.slope(r)[:, None, :], axis=0)
                part = np.minimum(order[rows] * PARTS // samples, PARTS - 1)
                for k in range(int(part[0]), int(part[-1]) + 1):
                    chosen = slice(*np.searchsorted(part, [k, k + 1]))
                    gram = _multiply(weighted[:, :, chosen], along[:, :, chosen])
                    information[k] += np.sum(gram, axis=0)
                    score[k] += np.sum(scores[:, chosen], axis=1)
                    grams += gram if loss.quadratic else _multiply(along[:, :, chosen], along[:, :, chosen])
                for s, mask in enumerate(high[:, rows]):
                    within = np.compress(mask, along, axis=2)
                    half = within if loss.quadratic else np.compress(mask, weighted, axis=2)
                    half_information[s] += np.sum(_multiply(half, within), axis=0)
                half_score += high[:, rows] @ scores.T
                in_half += np.count_nonzero(high[:, rows], axis=1)
                for o, rounding in enumerate(coarse):
                    if rounding is not None:
                        rounding.add(along[o], r[o], high[:, rows])
                tail = _add_windows(windows, tail, scores)
            _add_windows(windows, tail, np.zeros((q, length - 1)))
            before += int(np.count_nonzero(counted))
        power += np.tensordot(rms2, grams, 1)
        for output, rounding, gram in zip(experiment.outputs, coarse, grams, strict=True):
            o, if_white = output.index, floor.noise[output.index] ** 2 * gram
            made = if_white if rounding is None else rounding.multiply(gram)
            if floor.step[o] and output.name in experiment.data.quantisation:
                stated, stated_power = stated + made, stated_power + rms2[o] * gram
                known += [rounding] if rounding is not None else []
            elif rounding is not None:
                found[output.label] = made, if_white
        every += [rounding for rounding in coarse if rounding is not None]
        error_power += np.tensordot(rms2 * error, grams, 1)
        size = experiment.sigma / np.maximum(experiment.spread * np.sqrt(np.maximum(floor.count, 1.0)), 1e-300)
        effect = np.maximum(effect, np.max(np.sqrt(np.diagonal(grams, 0, 1, 2)) * size[:, None], axis=0, initial=0.0))
    return _Sums(
        information=information,
        score=score,
        half_information=half_information,
        half_score=half_score,
        share=in_half / max(samples, 1),
        windows=windows,
        power=power,
        stated=stated,
        stated_power=stated_power,
        error_power=error_power,
        found=found,
        coarse=every,
        known=known,
        effect=effect,
        count=float(sum(np.sum(floor.count) for floor in floors.values())),
    )


def _multiply(a: Float[np.ndarray, "ny q m"], b: Float[np.ndarray, "ny q m"]) -> Float[np.ndarray, "ny q q"]:
    return np.matmul(a, b.transpose(0, 2, 1))


def _add_windows(
    windows: ParameterMatrix, tail: Float[np.ndarray, "q l"], scores: Float[np.ndarray, "q m"]
) -> Float[np.ndarray, "q l"]:
    """Add the products of the scores' sums over every window that ends in these samples; return the new tail."""
    length = tail.shape[1]
    joined = np.concatenate([tail, scores], axis=1)
    total = np.concatenate([np.zeros((len(joined), 1)), np.cumsum(joined, axis=1)], axis=1)
    sums = total[:, length + 1 :] - total[:, 1:-length]
    windows += sums @ sums.T / length
    return joined[:, joined.shape[1] - length :]


def _split(
    experiment: FitExperiment, residuals: ExperimentResiduals, counted: Sequence[Bool[np.ndarray, " n"]]
) -> list[Bool[np.ndarray, "halves n"]]:
    """Return which of the samples that count, of each segment, are late in the log, large, and fast."""
    effort, fast = [], []
    for segment, left in zip(experiment.segments, residuals.segments, strict=True):
        model = np.stack([bridge(values) for values in (np.stack(segment.samples.y, axis=1) + left.raw).T], axis=1)
        effort.append(_measure_envelope(model[:, find_effort(experiment.data)], experiment.period))
        fast.append(_measure_speed(experiment, model))
    used = np.concatenate(counted)
    middles = [_find_middle(np.concatenate(parts)[used]) for parts in (effort, fast)]
    masks: list[Bool[np.ndarray, "halves n"]] = []
    first, samples = 0, int(np.count_nonzero(used))
    for envelope, speed, mask in zip(effort, fast, counted, strict=True):
        late = first + np.cumsum(mask) > 0.5 * samples
        masks.append(mask & np.array([late, envelope > middles[0], speed > middles[1]]))
        first += int(np.count_nonzero(mask))
    return masks


def find_effort(experiment: Experiment) -> int:
    """Return the output that is the spring's force or torque; the first where none is measured."""
    sensing, outputs = experiment.plant.sensing, experiment.outputs
    regulated = sensing.regulated if sensing is not None else ()
    return next((outputs.index(name) for name in regulated if name in outputs), 0)


def _find_middle(values: Signal) -> float:
    """Return the median of the samples that are there."""
    return median(values[~np.isnan(values)])


def _measure_envelope(values: Signal, period: float) -> Signal:
    """Return the largest distance from the median within 0.25 s; NaN where samples are missing."""
    away = np.abs(values - _find_middle(values)) if np.any(np.isfinite(values)) else np.zeros_like(values)
    width, length = max(1, round(ENVELOPE_S / period)), 1
    largest = np.pad(np.nan_to_num(away), (width // 2, width - 1 - width // 2))
    while length < width:  # the largest of ever longer stretches from each sample on
        step = min(length, width - length)
        largest, length = np.maximum(largest[:-step], largest[step:]), length + step
    return largest


def _measure_speed(experiment: FitExperiment, model: Float[np.ndarray, "n ny"]) -> Signal:
    """Return how fast the motor is, by its speed or position where one is measured, else by the spring's force."""
    sensing, outputs = experiment.data.plant.sensing, experiment.data.outputs
    if sensing is not None and sensing.motor_speed in outputs:
        return np.abs(model[:, outputs.index(sensing.motor_speed)])
    position = sensing.motor_position if sensing is not None else None
    column = outputs.index(position) if position in outputs else find_effort(experiment.data)
    return np.abs(np.gradient(model[:, column])) if len(model) > 1 else np.zeros(len(model))
