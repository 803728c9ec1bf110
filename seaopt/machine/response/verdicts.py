r"""The loop's response from periods of a log, and which of its limits the log confirms or refutes.

The reference R is known without error, so that everything is taken from it, jointly (the joint input-output method):
U/R and what the law makes of the readings, :math:`V/R = \sum_i C_i Y_i/R`. Then :math:`\hat L = \bar V/\bar U` at each
line, however the noise goes round the loop. The tracking is Y/R itself. From U and Y alone, the direct estimate
:math:`\sum \bar U_p Y_p / \sum |U_p|^2` tends to a mean of the plant and of -1/C, with the shares of U that the
reference and the noise make (Forssell and Ljung, Automatica 35, 1999); it stands beside the plant, to show what noise
does: with :math:`y_p` what differs from period to period of one set of phases, and
:math:`u_p = c (z - A)^{-1} z\,x_p - \sum_i C_i y_{ip}` what the law makes of it, where its state is another by
:math:`x_p` at the start of a period than at its end, it is
:math:`(\hat G (\sum |U_p|^2 - \sum |u_p|^2) + \sum \bar u_p y_p) / \sum |U_p|^2` where nothing else biases it.

With :math:`\hat L` of std s and the limit :math:`M_s`, at a risk :math:`\alpha` of a false statement:

- *confirmed*, where all lines have :math:`|1 + \hat L| - x - M_s x^2/2 \ge 1/M_s`, x the radial bound at
  :math:`\alpha`. To confirm is to state each of several things, so that each may keep the whole of the risk.
- *refuted*, where a line has :math:`|1 + \hat L| + R(\alpha/m) < 1/M_s`: one of m statements.
- *undecided* otherwise; the std falls with the root of the periods, which tells how many would decide.

With dry friction, what a law adds to its linear part (friction, weight, ripple) counts to the machine, as in what is
predicted: there U is what the linear part makes of reference and readings, :math:`C_r R - V`, with which 1/(1 + L) is
the sensitivity of what runs.

The other figures are judged by the discs in the same way: all lines at :math:`\alpha`, or one of them at
:math:`\alpha/m`. Nothing is said between the lines, nor beyond them; that lines keep a limit therefore confirms it
only where they lie closely about the crossover. With dry friction the response is that of the amplitude and the phases
that were played: blocks are the means over periods of one set of phases, of at least six.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Complex, Float

from seaopt.codec import Key
from seaopt.control import Controller
from seaopt.control.loops.loop import Loop
from seaopt.control.loops.measured.loop import bound_disc, find_first
from seaopt.control.loops.peaks import HALF_POWER
from seaopt.machine.response.discs import Ratio
from seaopt.machine.response.judged import Doubt, Judged, Measured, Outcome, Prediction
from seaopt.machine.response.measured_margins import list_margins
from seaopt.machine.response.periods import Blocks
from seaopt.machine.response.reach import Band, find_missing, find_reach
from seaopt.plants.friction import find_dry_friction, split_friction
from seaopt.records import Result, record

LEAST_PHASES = 6  # sets of phases, with dry friction
SAME_GAIN = 0.1  # relative, between two amplitudes
APART = 1.8  # of two amplitudes, about twice: what friction changes falls as one over the amplitude, and shows by half
GRACE = 0.05  # of each limit: a machine is not its model to the last digit
SAME_LINE = 1e-3  # relative
SHORT_BY = 0.1  # of the bandwidth
CENTRE = 1.0 - 1e-9  # a risk at which discs are points
MOST_PERIODS = 1e6  # that are counted
TRACKING = ("reference peak", "bandwidth")
PEAKS = {"Ms": "max_sensitivity", "Mt": "max_complementary", "reference peak": "max_reference_peak"}
LONGEST = 600.0  # s: a record that is longer is not asked for


@record
class Motion:
    """Whether dry friction, by the effort that it takes, lets the motor move under an effort that swings."""

    dry: float
    effort: float | None
    moves: bool


class AgainstFriction:
    """What has an effort that swings, and dry friction that it is to overcome; None where there is none."""

    effort: float | None
    friction: float | None

    @property
    def still(self) -> bool:
        """Whether dry friction holds the motor in all periods."""
        return self.effort is not None and self.friction is not None and self.effort <= self.friction

    @property
    def motion(self) -> Motion | None:
        """What a file has of it."""
        if self.friction is None:
            return None
        return Motion(dry=self.friction, effort=self.effort, moves=not self.still)


@record(eq=False)
class Response(AgainstFriction, Result):
    """The measured loop, and its limits."""

    json_keys = (
        *("met", "confidence"),
        Key(field="judged", name="figures"),
        *("at_amplitude_only", "needs_phases"),
        Key(field="needs_lines", name="needs_lines_hz"),
        Key(field="missing", name="missing_hz"),
        *("rate", "period_s"),
        Key(field="motion", name="friction"),
        Key(field="lines", name="measured"),
    )

    met: bool
    confidence: float
    judged: tuple[Judged, ...]
    measured: tuple[Measured, ...] = ()  # by amplitude; not read back from a file
    at_amplitude_only: bool  # dry friction, and the gain is another one at another amplitude, or was seen at one only
    needs_phases: bool  # dry friction, and fewer than six sets of phases
    needs_lines: tuple[float, float] | None = None  # Hz, from where to where lines are to lie, where they do not
    missing: tuple[Band, ...] = ()  # Hz, between which of them none do, or too few
    effort: float | None = None  # with dry friction: the most by which the effort swings about its middle in a period
    friction: float | None = None  # which dry friction takes: below it the motor does not move
    rate: float = 1.0  # of the law, over what the clock of the logs says: Hz and seconds are those of the machine
    period_s: float = 0.0  # the longest of the references

    @property
    def lines(self) -> tuple[dict[str, Any], ...]:
        """What a file has of the measured responses."""
        return tuple(_describe_lines(part, 1.0 - self.confidence) for part in self.measured)


def _describe_lines(part: Measured, alpha: float) -> dict[str, Any]:
    loop_radius, plant_radius = (ratio.disc(alpha)[1] for ratio in (part.loop, part.plant))
    return {
        "amplitude": part.amplitude,
        "periods": part.periods,
        "blocks": part.blocks,
        "phases": part.phases,
        "saturated": part.left_out.limit,
        "left_out": part.left_out,
        "frequency_hz": part.f,
        "loop_re": np.real(part.loop.value),
        "loop_im": np.imag(part.loop.value),
        "loop_radius": np.where(np.isfinite(loop_radius), loop_radius, -1.0),
        "plant_re": np.real(part.plant.value),
        "plant_im": np.imag(part.plant.value),
        "plant_radius": np.where(np.isfinite(plant_radius), plant_radius, -1.0),
        "direct_re": np.real(part.direct),
        "direct_im": np.imag(part.direct),
        "direct_bias": part.find_bias(alpha),
        "tracking_re": np.real(part.tracking.value),
        "tracking_im": np.imag(part.tracking.value),
        "tracking_radius": part.tracking.disc(alpha)[1],
    }


def measure(controller: Controller, blocks: Blocks, by_phases: bool) -> Measured:
    """Return the response of periods of one amplitude; `by_phases`: of means over the periods of each set of phases."""
    responses = controller.law.responses(blocks.f)
    if has_terms(controller):
        blocks = blocks.follow(responses)
    rows = blocks.average() if by_phases else blocks.unbroken or blocks
    feedback = -responses[1:]
    effort = rows.effort / rows.reference
    measured = rows.measured / rows.reference[:, None, :]
    returned = np.sum(feedback * measured, axis=1)
    outputs = dict(zip(controller.signals, measured.swapaxes(0, 1), strict=True))
    outputs |= {name: each / rows.reference for name, each in rows.beside.items()}
    return Measured(
        f=blocks.f,
        loop=Ratio(numerator=returned, denominator=effort),
        tracking=Ratio(numerator=measured[:, 0], denominator=np.ones_like(effort)),
        outputs={name: Ratio(numerator=each, denominator=effort) for name, each in outputs.items()},
        periods=len(blocks.reference),
        blocks=len(rows.reference),
        phases=blocks.realisations,
        amplitude=blocks.amplitude,
        left_out=blocks.left_out,
        direct=np.sum(np.conj(blocks.effort) * blocks.measured[:, 0], axis=0)
        / np.sum(np.abs(blocks.effort) ** 2, axis=0),
        by_noise=_predict_direct(controller, blocks, np.mean(measured[:, 0], axis=0) / np.mean(effort, axis=0)),
    )


def _predict_direct(
    controller: Controller, blocks: Blocks, plant: Complex[np.ndarray, " m"]
) -> Complex[np.ndarray, " m"]:
    """Return what the direct estimate is of a plant where only noise that goes round the loop biases it."""
    law, kinds, periods = controller.law, np.unique(blocks.realisation), len(blocks.reference)
    read, effort = blocks.measured.copy(), blocks.effort.copy()
    for rows in (blocks.realisation == kind for kind in kinds):
        read[rows] -= read[rows].mean(axis=0)
        effort[rows] -= effort[rows].mean(axis=0)
    made = np.sum(law.responses(blocks.f)[1:] * read, axis=1)
    z = np.exp(2j * np.pi * blocks.f * law.sample_time_s)
    states = z[:, None] * np.linalg.solve(z[:, None, None] * np.eye(law.c.size) - law.a.T, law.c)
    parts, left = (np.concatenate([each.real, each.imag]) for each in (states, (effort - made).T))
    made += (states @ np.linalg.lstsq(parts, left)[0]).T
    total = np.sum(np.abs(blocks.effort) ** 2, axis=0)
    of_noise = np.sum(np.conj(made) * (read[:, 0] - plant * made), axis=0)
    return plant + of_noise / total * (periods - 1) / max(periods - kinds.size, 1)


def has_terms(controller: Controller) -> bool:
    """Tell whether what a law adds to its linear part belongs to the machine: with dry friction, where both are
    simulated. The response of a linear machine is that to all of the command.
    """
    return controller.compensation is not None and has_dry_friction(controller)


def has_dry_friction(controller: Controller) -> bool:
    """Tell whether the design plant has dry friction at its values."""
    return find_friction(controller) > 0.0


def find_friction(controller: Controller) -> float:
    """Return the effort at the spring that the design plant's dry friction takes at its values."""
    if controller.design is None:
        return 0.0
    plant, values = controller.design
    return sum(find_dry_friction(plant, plant.complete(values)).values())


def judge_response(
    controller: Controller,
    groups: Sequence[Blocks],
    confidence: float,
    rate: float = 1.0,
    prediction: Prediction | None = None,
    *,
    tracks: bool = True,
) -> Response:
    """Return the response of periods, a group per amplitude, and what it says of the controller's limits. `rate`: at
    which the law was stepped, over what the clock of the logs says; `prediction`: of the same references, with dry
    friction; `tracks`: whether the reference is what the force is to be.
    """
    friction = find_friction(controller)
    dry = friction > 0.0
    by_phases = dry or all(group.realisations >= LEAST_PHASES for group in groups)
    by_phases = by_phases and all(group.realisations >= 2 for group in groups)
    parts = [measure(controller, group, by_phases) for group in groups]  # the law goes by ticks, whatever they last
    measured = tuple(replace(part, f=rate * part.f) for part in parts)
    needs_phases = dry and any(part.phases < LEAST_PHASES for part in measured)
    alpha = 1.0 - confidence
    rows = [
        _judge_stability(controller, measured, alpha),
        *_judge_peaks(controller, measured, alpha),
        _judge_bandwidth(controller, measured, alpha, prediction),
        *list_margins(controller, measured, alpha),
    ]
    if not tracks:
        rows = [row for row in rows if row.name not in TRACKING]
    if prediction is not None:
        rows = [replace(row, predicted=prediction.figures.get(row.name)) for row in rows]
        rows = [_compare_certified(row, prediction) for row in rows]
    if needs_phases:  # nothing is confirmed, for the discs do not hold the truth
        rows = [_leave_open(row) for row in rows]
    low, high = find_reach(controller)
    missing = find_missing(np.unique(np.concatenate([part.f for part in measured])), low, high)
    needs_lines = (low, high) if missing else None
    if needs_lines:  # a line that breaks a limit does so whatever lies beside it; turns are counted from line to line
        open_ = [row.outcome == "confirmed" or row.name == "stability" for row in rows]
        rows = [_leave_open(row) if each else row for row, each in zip(rows, open_, strict=True)]
    longest_s = max(group.period_s for group in groups) / rate
    rows = [_tell_near(row, longest_s) for row in rows]
    limited = [row for row in rows if row.limit is not None]
    return Response(
        met=all(row.outcome == "confirmed" for row in limited),
        confidence=confidence,
        judged=tuple(rows),
        measured=measured,
        at_amplitude_only=dry and not _is_same_gain(measured),
        needs_phases=needs_phases,
        needs_lines=needs_lines,
        missing=missing,
        effort=max(group.swing for group in groups) if dry else None,
        friction=friction if dry else None,
        rate=rate,
        period_s=longest_s,
    )


def predict_response(controller: Controller, simulated: Sequence[Sequence[Blocks]]) -> Prediction:
    """Return what machines do under the references that were played. `simulated`: the periods of each, those of the
    design plant first, with the logs' noise where that shakes the motor through its friction.
    """
    parts = [
        [measure(controller, group, by_phases=all(each.realisations >= 2 for each in groups)) for group in groups]
        for groups in simulated
    ]
    peaks = [_judge_peaks(controller, part, CENTRE) for part in parts]
    rows = [*peaks[0], *list_margins(controller, parts[0], CENTRE)]
    bandwidths = [_measure_bandwidth(controller, part) for part in parts]
    figures = {row.name: row.value for row in rows if row.value is not None and math.isfinite(row.value)}
    largest = {row.name: max(each[k].value or 0.0 for each in peaks) for k, row in enumerate(peaks[0])}
    if math.isfinite(bandwidths[0]):
        figures["bandwidth"] = bandwidths[0]
    turned = any(_compare_turns(controller, part)[0] for part in parts)
    return Prediction(figures=figures, peaks=largest, bandwidth_hz=min(bandwidths), turned=turned)


def list_limits(controller: Controller) -> dict[str, float]:
    """Return the limits of a loop's peaks as they are judged, with the grace, by the names of their rows."""
    asked = {name: controller.spec.level(key) for name, key in PEAKS.items()}
    return {name: (1.0 + GRACE) * limit for name, limit in asked.items() if limit is not None}


def _compare_certified(row: Judged, prediction: Prediction) -> Judged:
    """Return a row whose limit certified machines break themselves under the reference that was played, which refutes
    this one only where it is beyond theirs.
    """
    if row.name == "stability":
        return (
            replace(row, outcome="undecided", certified=0.0) if prediction.turned and row.outcome == "refuted" else row
        )
    worst = prediction.peaks.get(row.name)
    if row.limit is None or worst is None or worst <= row.limit or row.outcome == "confirmed":
        return row
    if row.outcome == "refuted" and row.low is not None and row.low > (1.0 + GRACE) * worst:
        return row
    return replace(_leave_open(row), certified=worst)


def _measure_bandwidth(controller: Controller, measured: Sequence[Measured]) -> float:
    """Return where the tracking falls below -3 dB, at the amplitude at which it does first."""
    bound = _bound_tracking(controller)
    return min(_find_fall(part.f, _find_middle(bound, part)) for part in measured)


def _leave_open(row: Judged) -> Judged:
    return replace(row, outcome="undecided", periods=None, doubt=None)


def _tell_near(row: Judged, period_s: float) -> Judged:
    """Return a row with how near its estimate is to the limit, where no record of sensible length would decide."""
    if row.periods is None or row.periods * period_s <= LONGEST or row.value is None or not row.limit:
        return row
    return replace(row, near=abs(row.value / row.limit - 1.0))


def _is_same_gain(measured: Sequence[Measured]) -> bool:
    """Tell whether amplitudes that are apart have the same gain at every line."""
    if not compares_amplitudes(measured):
        return False
    gains = [np.abs(part.plant.value) for part in measured]
    return all(bool(np.all(np.abs(gain / gains[0] - 1.0) < SAME_GAIN)) for gain in gains[1:])


def compares_amplitudes(measured: Sequence[Measured]) -> bool:
    """Tell whether amplitudes were played that are apart, at the same lines."""
    first, sizes = measured[0], [part.amplitude for part in measured]
    alike = all(part.f.size == first.f.size and np.allclose(part.f, first.f, rtol=SAME_LINE) for part in measured)
    return alike and max(sizes) >= APART * min(sizes)


def _judge_stability(controller: Controller, measured: Sequence[Measured], alpha: float) -> Judged:
    """Judge whether the loop is stable: no disc about 1 + L has zero in it, and 1 + L turns as that of the model."""
    lines = sum(part.f.size for part in measured)
    room, where, open_ = math.inf, None, list[float]()
    turned, known = _compare_turns(controller, measured)
    for part in measured:
        centre, radius = part.loop.disc(alpha / lines)
        ratio = np.abs(1.0 + centre) / np.maximum(radius, 1e-300)
        at = int(np.argmin(ratio))
        open_ += part.f[ratio <= 1.0].tolist()
        if ratio[at] < room:
            room, where = float(ratio[at]), float(part.f[at])
    outcome: Outcome = (
        "refuted" if turned and room > 1.0 and known else "confirmed" if room > 1.0 and known else "undecided"
    )
    count = sum(part.periods for part in measured)
    needed = math.ceil(count / room**2) if outcome == "undecided" and 0.0 < room <= 1.0 else None
    return Judged(
        name="stability", limit=1.0, sense="at least", value=room, low=None, high=None, unit="-", outcome=outcome,
        where_hz=where, periods=needed, doubt=_find_doubt(outcome, open_),
    )  # fmt: skip


def _compare_turns(controller: Controller, measured: Sequence[Measured]) -> tuple[bool, bool]:
    """Return whether 1 + L turns otherwise than that of the model, and whether lines are close enough to count it: of a
    plant with dry friction as it slides or as it is stuck, both of which are stable, whichever is nearer.
    """
    if controller.design is None:
        return False, True
    plant, values = controller.design
    states = list[tuple[float, bool]]()
    for model in split_friction({"": plant}, values).values():
        loop = Loop(plant=controller.plant(model, values), law=controller.law)
        turns = [np.unwrap(np.angle(part.distance / (1.0 + loop.open_loop(part.f)))) for part in measured]
        largest = max(float(np.max(np.abs(np.diff(turn)), initial=0.0)) for turn in turns)
        states.append((largest, any(abs(float(turn[-1] - turn[0])) > math.pi for turn in turns)))
    largest, turned = min(states)
    return turned, largest < 0.5 * math.pi


def _judge_peaks(controller: Controller, measured: Sequence[Measured], alpha: float) -> list[Judged]:
    spec, rows = controller.spec, list[Judged]()
    ms, mt, peak = map(spec.level, PEAKS.values())
    figures = controller.achieved
    rows.append(replace(_judge_sensitivity(ms, measured, alpha), predicted=figures.ms))
    rows.append(replace(_judge_discs("Mt", mt, measured, alpha, _bound_complementary), predicted=figures.mt))
    tracked = _judge_discs("reference peak", peak, measured, alpha, _bound_tracking(controller))
    rows.append(replace(tracked, predicted=figures.reference_peak))
    return rows


def _judge_sensitivity(asked: float | None, measured: Sequence[Measured], alpha: float) -> Judged:
    """Judge Ms by the inequalities of the module."""
    limit = None if asked is None else asked * (1.0 + GRACE)
    m = sum(part.f.size for part in measured)
    low = high = value = 0.0
    where, needed = None, 0.0
    confirmed, refuted, least = True, False, math.inf
    near, unsure = list[float](), list[float]()
    for part in measured:
        distance = np.abs(part.distance)
        wide, narrow = part.loop.disc(alpha / m), part.loop.disc(alpha)
        lower = 1.0 / (np.abs(1.0 + wide[0]) + wide[1])
        left = np.abs(1.0 + narrow[0]) - narrow[1]
        upper = np.where(left > 0.0, 1.0 / np.where(left > 0.0, left, 1.0), np.inf)
        value, low, high = (max(a, float(np.max(b))) for a, b in ((value, 1.0 / distance), (low, lower), (high, upper)))
        if limit is None:
            continue
        x = part.loop.radial(alpha)
        slack = distance - x - 0.5 * limit * x**2 - 1.0 / limit
        confirmed = confirmed and bool(np.all(slack >= 0.0) and np.all(part.loop.sure))
        near += part.f[slack < 0.0].tolist()
        unsure += part.f[~part.loop.sure].tolist()
        refuted = refuted or bool(np.any(lower > limit))
        surety = part.loop.surety
        ranked = np.where(surety < 1.0, np.minimum(slack, surety - 1.0), slack)  # what is not sure decides, too
        at = int(np.argmin(ranked))
        if ranked[at] < least:
            least, where = float(ranked[at]), float(part.f[at])
        room = distance - 1.0 / limit
        allowed = (np.sqrt(1.0 + 2.0 * limit * np.maximum(room, 0.0)) - 1.0) / limit  # x that would just confirm
        share = np.where(room > 0.0, x / np.maximum(allowed, 1e-300), wide[1] / np.maximum(-room, 1e-300))
        most = np.max(np.concatenate([share[slack < 0.0], 1.0 / surety[surety < 1.0]]), initial=0.0)
        needed = max(needed, float(most) ** 2 * part.periods)
    outcome = _decide(confirmed, refuted) if limit is not None else "undecided"
    return Judged(
        name="Ms", limit=limit, sense="at most", value=value, low=low, high=high, unit="-", outcome=outcome,
        where_hz=where, periods=_count_periods(outcome, needed), doubt=_find_doubt(outcome, near, unsure),
    )  # fmt: skip


def _find_doubt(outcome: Outcome, near: Sequence[float], unsure: Sequence[float] = ()) -> Doubt | None:
    """Return the lines at which a figure is open. `near`: whose disc reaches beyond the limit; `unsure`: where the
    command is too near its scatter.
    """
    lines = near or unsure
    if outcome != "undecided" or not lines:
        return None
    return Doubt(lines_hz=tuple(sorted({*lines})), why="disc" if near else "command")


def _count_periods(outcome: Outcome, needed: float) -> int | None:
    """Return how many periods would decide, or the most that are counted; None where it is decided, or no number
    would.
    """
    return math.ceil(min(needed, MOST_PERIODS)) if outcome == "undecided" and needed > 0.0 else None


def _decide(confirmed: bool, refuted: bool) -> Outcome:
    return "refuted" if refuted else "confirmed" if confirmed else "undecided"


Bounds = tuple[Float[np.ndarray, " m"], Float[np.ndarray, " m"]]


def _bound_complementary(part: Measured, alpha: float) -> Bounds:
    centre, radius = part.loop.disc(alpha)
    known = radius < np.abs(1.0 + centre)
    low, high = bound_disc("L", centre, np.where(known, radius, 0.0), np.ones_like(centre), np.ones_like(centre))
    return np.where(known, low, 0.0), np.where(known, high, np.inf)


def _bound_tracking(controller: Controller) -> Any:
    def bound(part: Measured, alpha: float) -> Bounds:
        centre, radius = part.tracking.disc(alpha)
        static = _find_static(controller, part)
        size = np.abs(centre)
        return np.maximum(size - radius, 0.0) / static, (size + radius) / static

    return bound


def _find_middle(bound: Any, part: Measured) -> Float[np.ndarray, " m"]:
    """Return a size at the centres of the discs."""
    lower, upper = bound(part, CENTRE)
    return 0.5 * (lower + upper)


def _find_static(controller: Controller, part: Measured) -> float:
    """Return the tracking at rest: one with an integral, else that of the lowest line."""
    return 1.0 if controller.law.integrators else float(np.abs(part.tracking.value[0]))


def _judge_discs(name: str, asked: float | None, measured: Sequence[Measured], alpha: float, bound: Any) -> Judged:
    """Judge a peak by discs: all lines keep the limit, each at `alpha`, or one breaks it, at its share of `alpha`."""
    limit = None if asked is None else asked * (1.0 + GRACE)
    m = sum(part.f.size for part in measured)
    low = high = value = needed = 0.0
    where, open_ = None, list[float]()
    for part in measured:
        lower, upper = bound(part, alpha / m)[0], bound(part, alpha)[1]
        middle = _find_middle(bound, part)
        low, high = max(low, float(np.max(lower))), max(high, float(np.max(upper)))
        at = int(np.argmax(middle))
        if middle[at] > value:
            value, where = float(middle[at]), float(part.f[at])
        if limit is not None:
            over = upper > limit
            open_ += part.f[over].tolist()
            room = np.abs(limit - middle[over])
            needed = max(
                needed,
                float(np.max((upper - middle)[over] / np.maximum(room, 1e-300), initial=0.0)) ** 2 * part.periods,
            )
    outcome = "undecided" if limit is None else _decide(high <= limit, low > limit)
    return Judged(
        name=name, limit=limit, sense="at most", value=value, low=low, high=high if math.isfinite(high) else None,
        unit="-", outcome=outcome, where_hz=where, doubt=_find_doubt(outcome, open_),
        periods=_count_periods(outcome, needed),
    )  # fmt: skip


def _judge_bandwidth(
    controller: Controller, measured: Sequence[Measured], alpha: float, prediction: Prediction | None
) -> Judged:
    """Judge whether the tracking stays above -3 dB up to the bandwidth that was asked for, less its share, by one line
    at least; of a plant that friction makes slower, to that which certified machines have under what was played, where
    it is known.
    """
    least, state, certified = _choose_bandwidth(controller, measured, prediction)
    limit = (1.0 - SHORT_BY) * least
    tracked = controller.achieved.bandwidth_hz is not None and controller.achieved.bandwidth_hz < 1e6
    m, bound = sum(part.f.size for part in measured), _bound_tracking(controller)
    values, lows, highs, doubted = list[float](), list[float](), list[float](), list[float]()
    confirmed, refuted, needed, where = any(np.any(part.f <= limit) for part in measured), False, 0.0, None
    for part in measured:
        below = part.f <= limit
        lower, upper = bound(part, alpha)[0], bound(part, alpha / m)[1]
        middle = _find_middle(bound, part)
        confirmed = confirmed and bool(np.all(lower[below] >= HALF_POWER)) and bool(np.any(part.f > limit))
        broken = np.flatnonzero(below & (upper < HALF_POWER))
        refuted = refuted or broken.size > 0
        where = float(part.f[broken[0]]) if broken.size else where
        values.append(_find_fall(part.f, middle))
        lows.append(_find_fall(part.f, lower))  # which errs at one line, where the fall is
        highs.append(_find_fall(part.f, upper))  # which errs at any line below it
        open_ = below & (lower < HALF_POWER)
        doubted += part.f[open_].tolist()
        room = np.maximum(np.abs(middle - HALF_POWER), 1e-300)
        needed = max(needed, float(np.max(((middle - lower) / room)[open_], initial=0.0)) ** 2 * part.periods)
    outcome = _decide(confirmed, refuted) if certified is None else "undecided"
    high, predicted = min(highs), least if state == "stuck" else controller.achieved.bandwidth_hz
    return Judged(
        name="bandwidth", state=state, certified=certified if tracked else None,
        limit=limit if tracked else None, sense="at least", value=min(values), low=min(lows),
        high=high if math.isfinite(high) else None, unit="Hz", outcome=outcome, where_hz=where,
        periods=_count_periods(outcome, needed if certified is None else 0.0),
        doubt=_find_doubt(outcome, doubted) if certified is None and tracked else None,
        predicted=predicted if tracked else None,
    )  # fmt: skip


def _choose_bandwidth(
    controller: Controller, measured: Sequence[Measured], prediction: Prediction | None
) -> tuple[float, str, float | None]:
    """Return the bandwidth that is judged, and by dry friction of which machine it is; and the least of the certified
    machines, where no line of an amplitude lies below, and none tells therefore whether this one has it.
    """
    asked, (least, stuck) = controller.spec.bandwidth_hz, _find_least_bandwidth(controller)
    if prediction is None or not (stuck or prediction.bandwidth_hz < (1.0 - SHORT_BY) * least):
        return least, "stuck" if stuck else "", None
    least = min(asked, prediction.bandwidth_hz)
    untold = least < asked and any(part.f[0] > (1.0 - SHORT_BY) * least for part in measured)
    return least, "as played", least if untold else None


def _find_least_bandwidth(controller: Controller) -> tuple[float, bool]:
    """Return the bandwidth that was asked for; with dry friction no more than that of the plant that is stuck, which a
    small amplitude comes near; and whether it is that.
    """
    asked = controller.spec.bandwidth_hz
    if not has_dry_friction(controller):
        return asked, False
    least = min([asked, *(each.bandwidth_hz for each in controller.measure_states().values() if each.bandwidth_hz)])
    return least, least < (1.0 - SHORT_BY) * asked


def _find_fall(f: Float[np.ndarray, " m"], size: Float[np.ndarray, " m"]) -> float:
    """Return where a curve first falls below -3 dB, by a straight line; infinite where it does not."""
    first = find_first(f, HALF_POWER - size)
    return math.inf if first is None else first
