r"""The replay of a log that has every n-th tick only: line by line, since the law's state between the rows is unknown.

The law is linear while nothing limits it, so that at each line of a periodic reference

.. math:: U = (C_r R - C_y Y)\,e^{-j\omega T l} + G \gamma + e,

with C at the law's own rate, T its sample time, and l the ticks by which the command is logged late. G holds what a
state at the start of a period adds (:math:`c A^{nk}` over the rows k, and powers of k for what integrates); it is
projected out. What is left, e, is what noise above half of the log's rate folds into a line: neighbouring lines have as
much of it, and it is independent from period to period. Lines of the reference above half of the log's rate come back
as others, where the law does not hold.

With d what the command is off by at the lines, and :math:`\Phi` what another law's would be, both over the std of e and
of a command that is as good as the same, :math:`a = \Phi^T d/\Phi^T\Phi` is the share of the other law, with the std
:math:`1/|\Phi|`: 0 for the exported one, 1 for the other.

- The law is *refuted* where :math:`|d|^2` is more than noise leaves, or a share is not zero.
- It is *confirmed* where in each case another share than one is sure: of a gain of half its size, of a reference,
  reading or command that is halved, of a tick's delay. Of laws with a part left out, or made for another rate, it says
  which are not excluded: few references tell all of them.
- Else the log cannot tell. The std falls with the root of the periods, which says how many would do; and at another
  line the loop of the model makes more of the other law, which says where to play one.

A law under an outer loop with a stiffness is one law with it, of x_0, the readings and the link's position. Without a
stiffness the link's place drifts, and has no lines.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
from jaxtyping import Complex, Float

from seaopt.control import Controller, RunnableSchedule, ScheduledController
from seaopt.control.laws.structures import Gains
from seaopt.control.loops.law import Law
from seaopt.control.loops.moved_link import enclose_law
from seaopt.control.loops.outer_loop import OuterLoop
from seaopt.errors import LogError
from seaopt.logs.quality.faults import find_quantisation
from seaopt.machine.alternatives import list_parts, name_factor
from seaopt.machine.causes import MOST_CAUSES, SHORT, Cause, leave_open
from seaopt.machine.response.enclosed import take_given
from seaopt.machine.response.periods import Blocks, cut_periods
from seaopt.machine.response.verdicts import LEAST_PHASES, has_dry_friction
from seaopt.machine.stepped import Others, Setting, keep_over, stand, stands_still
from seaopt.machine.ticks import Ticks, find_saturated
from seaopt.plants.friction import take_sliding
from seaopt.records import record

MOST = 20  # ticks per row
SAME_RATE = 0.02  # relative: of the log's clock and the law's, or a whole number of its ticks
RISK = 1e-4  # that this law is taken for another's, or one that is excluded is the law
OFF = 0.01  # of the command at a line, that is as good as nothing
LATE = (0, 1, -1)  # ticks
NEIGHBOURS = 3  # lines on each side that have as much noise
FITTED = 4.0  # of the misfit, that a size that is fitted has to take away more than a cause without
MATTERS = 0.02  # of the law's response: what changes less of it at any frequency is the same law
GRID = np.geomspace(1e-5, 0.45, 200)  # of the law's rate, where that is looked at
SMALL = 1e-9  # of the largest singular value
SPAN = (0.1, 0.45)  # of the lowest line, and of the log's rate, between which a line that would tell is looked for
FINER = 200  # times the lines of a period that such ones lie closer
PLENTY = 2.0  # times what a share needs at least to be sure, that such a line tells

Parts = Complex[np.ndarray, "b m"]  # a row per period, or per set of phases, at the lines
Lines = Complex[np.ndarray, " m"]  # their means over the reference


# Of another law: a log has to exclude it; or it is named where a log does not, as few references tell it; or it is only
# tried as a cause.
Role = Literal["excluded", "named", "tried"]


@record(eq=False)
class LineMatch:
    """How far the command is from the law's at the lines; nothing where they cannot be compared."""

    causes: tuple[Cause, ...]  # none where it is this law
    off: Float[np.ndarray, " m"] | None = None  # of the command at each line, in its unit
    allowed: float | None = None  # rms, in the command's unit
    late: int = 0  # ticks
    possible: tuple[Cause, ...] = ()  # laws with other parts, which are not excluded beside it

    @property
    def tells(self) -> bool:
        """Whether it is this law, another whose name is sure, or too short a log to tell."""
        first = self.causes[0] if self.causes else None
        return first is None or first.explains or first.kind in SHORT.values()


@record(eq=False)
class Shift:
    """What another law, or another log, would make of the commands at the lines."""

    kind: str
    what: str
    commands: Parts  # of another less those of the law
    unit: str = ""
    value: float | None = None
    base: float | None = None  # of what is scaled: its size, of which the shift is a half
    role: Role = "tried"

    def name(self, share: float, signals: Sequence[str]) -> tuple[str, float | None]:
        """Return its kind and value where a share of it is there."""
        if self.base is None:
            return self.kind, self.value
        value = self.base * (1.0 - 0.5 * share)
        return name_factor(self.what, value, signals) if self.kind == "factor" else (self.kind, value)


@record(eq=False)
class Off:
    """What the command is off by at the lines, where it is taken to be logged so many ticks late."""

    late: int
    mean: Lines
    std: Float[np.ndarray, " m"]  # of each of its parts
    noise: Float[np.ndarray, " m"]  # of that, what falls with the root of the periods
    free: int  # real numbers less what was projected out
    known: float  # degrees of freedom of the std

    def scale(self, mean: Lines) -> Float[np.ndarray, " k"]:
        """Return real and imaginary parts over their std."""
        return np.concatenate([np.real(mean) / self.std, np.imag(mean) / self.std])

    @property
    def misfit(self) -> float:
        """Sum of squares of what is off."""
        return float(np.sum(self.scale(self.mean) ** 2))

    @property
    def most(self) -> float:
        """What a sum of squares is below, if nothing but noise is in it."""
        from scipy.special import fdtri  # deferred: 0.1 s

        return self.free * float(fdtri(self.free, self.known, 1.0 - RISK))

    @property
    def sigmas(self) -> float:
        """How many std a share is within."""
        from scipy.special import stdtrit  # deferred: 0.1 s

        return float(stdtrit(self.known, 1.0 - 0.5 * RISK))

    def fit(self, mean: Lines) -> tuple[float, float]:
        """Return the share of a shift, and its std."""
        vector = self.scale(mean)
        size = float(vector @ vector)
        return (float(vector @ self.scale(self.mean)) / size, size**-0.5) if size else (0.0, math.inf)

    def excludes(self, mean: Lines) -> bool:
        """Tell whether another share than one is sure."""
        share, std = self.fit(mean)
        return abs(share) + self.sigmas * std < 1.0


@record(eq=False)
class LoggedPeriods:
    """The periods of a log, and what the law makes of them."""

    controller: Controller
    blocks: Blocks
    ticks_per_row: int
    made: Parts
    outer: OuterLoop | None  # around the law
    leakage: Float[np.ndarray, "k n"]  # an orthonormal basis of what a state at the start of a period adds
    rounding: Float[np.ndarray, " m"]  # std of each part of a command, of what the log is rounded to

    @classmethod
    def make(
        cls, controller: Controller, ticks: Ticks, blocks: Blocks, ticks_per_row: int, outer: OuterLoop | None
    ) -> LoggedPeriods:
        """Return the table of a log."""
        law = _enclose(controller.law, controller.signals, outer)
        responses = evaluate(law, blocks, ticks_per_row)
        steps = [find_quantisation(ticks.measured[:, i]) for i in range(ticks.measured.shape[1])]
        steps = [ticks.quantum / abs(controller.command.per_effort), *steps]
        gains = np.vstack([np.ones(blocks.f.size), np.abs(responses[1:])])
        each = np.sqrt(np.sum((gains * np.array(steps)[:, None]) ** 2, axis=0) / (6.0 * blocks.rows))
        return cls(
            controller=controller,
            blocks=blocks,
            ticks_per_row=ticks_per_row,
            made=blocks.make_efforts(responses),
            outer=outer,
            leakage=find_leakage(law, blocks, ticks_per_row),
            rounding=each,
        )

    @property
    def names(self) -> tuple[str, ...]:
        """What is read."""
        signals = self.controller.signals
        outside = self.outer is not None and self.outer.position not in signals
        return (*signals, self.outer.position) if outside and self.outer is not None else signals

    def enclose(self, law: Law) -> Law:
        """Return a law with the outer loop around it."""
        return _enclose(law, self.controller.signals, self.outer)

    def project(self, commands: Parts) -> Parts:
        """Return commands without what a state at the start of a period adds."""
        table = np.concatenate([np.real(commands), np.imag(commands)], axis=1)
        table = table - table @ self.leakage @ self.leakage.T
        return table[:, : commands.shape[1]] + 1j * table[:, commands.shape[1] :]

    def average(self, commands: Parts) -> Lines:
        """Return the mean of commands over the reference, without what a state adds."""
        return np.mean(self.project(commands) / self.blocks.reference, axis=0)

    def try_late(self, late: int) -> Off:
        """Return what the command is off by; its std is that of its scatter over the periods, as much at neighbouring
        lines.
        """
        blocks = self.blocks
        off = self.project(blocks.effort * self.turn(late) - self.made)
        (count, m), strength = off.shape, np.sqrt(np.mean(np.abs(blocks.reference) ** 2, axis=0))
        normal = off / blocks.reference * strength
        scatter = np.sum(np.abs(normal - np.mean(normal, axis=0)) ** 2, axis=0) / (2.0 * count * (count - 1))
        free = 2 * m - self.leakage.shape[1]
        share = free / (2.0 * m)  # of the noise, that was not projected out
        window = np.ones(2 * NEIGHBOURS + 1)
        near = np.convolve(scatter, window, "same")[:m] if m >= window.size else np.full(m, np.sum(scatter))
        of = np.convolve(np.ones(m), window, "same")[:m] if m >= window.size else np.full(m, m)
        noise = np.sqrt(near / of / share)
        same = OFF * np.mean(np.abs(self.made), axis=0)
        return Off(
            late=late,
            mean=np.mean(off / blocks.reference, axis=0),
            std=np.sqrt(noise**2 + same**2 + self.rounding**2) / strength,
            noise=noise / strength,
            free=free,
            known=2.0 * (count - 1) * float(np.min(of)) * share,
        )

    def list_late(self, taken: int) -> Iterator[Shift]:
        """Yield commands that are logged otherwise late than is taken."""
        for late in LATE:
            if late != taken:
                commands = self.made * (self.turn(taken - late) - 1.0)
                yield Shift(kind="late", what="command", commands=commands, value=late, unit="ticks", role="excluded")

    def turn(self, ticks: int) -> Lines:
        """Return what commands so many ticks earlier are multiplied by."""
        return turn_lines(self.controller, self.blocks, ticks)

    def list_shifts(self, others: Others, place: float) -> Iterator[Shift]:
        """Yield what may run in place of the law, or stand in its log; `place`: of the variable of a schedule."""
        controller, blocks, made = self.controller, self.blocks, self.made
        law, signals = controller.law, controller.signals
        forward, *feedback = evaluate(self.enclose(law), blocks, self.ticks_per_row)
        fed = forward * blocks.reference
        parts = {"reference": fed, controller.command.input: made}
        parts |= {name: feedback[i] * blocks.measured[:, i] for i, name in enumerate(self.names)}
        for name, part in parts.items():
            role: Role = "excluded" if np.any(part) else "tried"
            yield Shift(kind="factor", what=name, commands=-0.5 * part, base=1.0, role=role)
        turned = np.exp(-2j * np.pi * blocks.f * controller.sample_time_s)
        for late in (1, 2):
            commands = (made - fed) * (turned**late - 1.0)
            role = "excluded" if late == 1 else "tried"
            yield Shift(kind="late", what="readings", commands=commands, value=late, unit="ticks", role=role)
        for name, other in others.items():
            first = other.controllers[0] if isinstance(other, ScheduledController) else stand(other, None)
            if first.signals == signals and math.isclose(first.sample_time_s, law.sample_time_s, rel_tol=1e-3):
                stood = other.table.law(place) if isinstance(other, ScheduledController) else first.law
                yield Shift(kind="another law", what=name, commands=self.differ(stood))
        yield from self._list_outer()
        gains = controller.read_gains()
        if gains is not None:
            yield from self._list_gains(gains)

    def _list_outer(self) -> Iterator[Shift]:
        """Yield an outer loop of half the stiffness, of which x_0 is a part of the reference, or half the damping."""
        if self.outer is None:
            return
        own, reference = self.enclose(self.controller.law), self.blocks.reference
        for name in ("stiffness", "damping"):
            half = replace(self.outer, **{name: 0.5 * getattr(self.outer, name)})
            law = _enclose(self.controller.law, self.controller.signals, half)
            given = reference * (0.5 if name == "stiffness" else 1.0)
            commands = replace(self.blocks, reference=given).make_efforts(
                evaluate(law, self.blocks, self.ticks_per_row)
            )
            role: Role = "excluded" if _matters(own, law) else "tried"
            yield Shift(kind="factor", what=name, commands=commands - self.made, base=1.0, role=role)

    def _list_gains(self, gains: Gains) -> Iterator[Shift]:
        structure, period, law = self.controller.spec.structure, self.controller.sample_time_s, self.controller.law
        sizes = gains.by_name()
        for name, half in _halve(gains):
            changed = half.law(structure, period).balanced()
            role: Role = "excluded" if _matters(law, changed) else "tried"
            yield Shift(kind="gain", what=name, commands=self.differ(changed), base=sizes[name], role=role)
        rates = [factor * period for factor in (0.5, 2.0)]
        parts = [(kind, what, value, "", part.law(structure, period)) for kind, what, value, part in list_parts(gains)]
        parts += [("rate", "gains", 1.0 / each, "Hz", gains.law(structure, each)) for each in rates]
        for kind, what, value, unit, changed in parts:
            role = "named" if _matters(law, changed) else "tried"
            yield Shift(kind=kind, what=what, commands=self.differ(changed), value=value, unit=unit, role=role)

    def differ(self, law: Law) -> Parts:
        """Return what another law makes more than this one."""
        return self.blocks.make_efforts(evaluate(self.enclose(law), self.blocks, self.ticks_per_row)) - self.made

    def is_alias(self, found: Off) -> bool:
        """Tell whether the law holds at what comes back as the lines, above half of the log's rate."""
        reach, law = self.ticks_per_row // 2, self.enclose(self.controller.law)
        responses = [evaluate(law, self.blocks, self.ticks_per_row, k) for k in range(-reach, reach + 1)]
        off = np.array([self.blocks.effort - self.blocks.make_efforts(each) for each in responses])
        nearest = np.argmin(np.mean(np.abs(off), axis=1), axis=0)
        chosen = np.take_along_axis(off, nearest[None, None, :], axis=0)[0]
        return float(np.sum(found.scale(self.average(chosen)) ** 2)) <= found.most


def find_telling(table: LoggedPeriods, found: Off, others: Others, place: float) -> list[float | None]:
    """Return of each shift, and each command that is logged otherwise late, the frequency at which a line as strong as
    the others would tell it, by the loop of the design plant: the nearest to those that were played; None of it where
    none would.
    """
    controller, blocks = table.controller, table.blocks
    if controller.design is None or table.outer is not None:
        return []
    plant, values = controller.design
    rows, period_s = FINER * blocks.rows, FINER * blocks.period_s
    edges = SPAN[0] * blocks.f[0], SPAN[1] * blocks.rows / blocks.period_s
    f = np.unique(np.round(np.geomspace(*edges, GRID.size) * period_s)) / period_s
    reads, law = controller.plant(take_sliding(plant, values), values).responses(f), controller.law.responses(f)
    effort = law[0] / (1.0 - np.sum(law[1:] * reads, axis=0))
    played = replace(
        blocks, f=f, rows=rows, period_s=period_s, reference=np.ones((1, f.size), dtype=complex), effort=effort[None],
        measured=(reads * effort)[None], beside={},
    )  # fmt: skip
    there = replace(table, blocks=played, made=effort[None])
    std = np.hypot(np.median(found.noise), OFF * np.abs(effort))
    away = np.maximum(np.log(blocks.f[0] / f), np.log(f / blocks.f[-1]))
    told = list[float | None]()
    for shift in (*there.list_shifts(others, place), *there.list_late(found.late)):
        sure = np.flatnonzero(np.abs(shift.commands[0]) >= PLENTY * found.sigmas * std)
        told.append(float(f[sure[np.argmin(away[sure])]]) if sure.size else None)
    return told


def count_ticks_per_row(controller: Controller, ticks: Ticks) -> int:
    """Return how many ticks of a law a row of its log takes by its clock; 1 where that is no whole number."""
    ratio = 1.0 / (controller.sample_time_s * ticks.rate_hz)
    whole = round(ratio)
    return whole if 2 <= whole <= MOST and abs(ratio / whole - 1.0) <= SAME_RATE else 1


def match_lines(setting: Setting, ticks_per_row: int, others: Others) -> LineMatch:
    """Return how a law matches a log line by line, or why that cannot be told."""
    controller, ticks, law = setting.controller, setting.ticks, setting.law
    if setting.linear.compensation is not None:
        return LineMatch(causes=(leave_open("terms", "law"),))
    outer = None if ticks.rendered is None else controller.outer
    if outer is not None and not outer.stiffness:
        return LineMatch(causes=(leave_open("outer", "loop"),))
    if outer is not None:
        ticks = take_given(ticks, outer.position, controller.signals)
    place, others = math.nan, keep_over(others, law.table.over if isinstance(law, RunnableSchedule) else None)
    if isinstance(law, RunnableSchedule):
        place = law.fallback if ticks.middle is None else ticks.middle
        if ticks.place is not None and not stands_still(ticks.place, law.table.points):
            return LineMatch(causes=(leave_open("moving", law.table.over),))
    try:
        blocks = cut_periods(controller, ticks)
    except LogError:
        limited = find_saturated(ticks, setting.linear.command_limit) > 0.5
        return LineMatch(
            causes=(leave_open("saturated", "command") if limited else leave_open("periods", "reference"),)
        )
    dry, phases = has_dry_friction(controller), blocks.realisations
    if dry and phases >= LEAST_PHASES:
        blocks = blocks.average()
    table = LoggedPeriods.make(controller, ticks, blocks, ticks_per_row, outer)
    tried = [table.try_late(late) for late in LATE]
    found, shifts = min(tried, key=lambda each: each.misfit), [*table.list_shifts(others, place)]
    every, possible = [*shifts, *table.list_late(found.late)], ()
    vectors = [table.average(shift.commands) for shift in every]
    if is_off(found, every, vectors):
        named = [name_causes(each, shifts, vectors, table.names) for each in tried]
        at = min(range(len(tried)), key=lambda k: named[k][0])
        found, causes = tried[at], named[at][1]
        if not causes or not causes[0].explains:
            if dry and phases < LEAST_PHASES:
                causes = (leave_open("phases", "log"),)
            elif table.is_alias(found):
                causes = (leave_open("aliases", "reference"),)
    else:
        tells_hz = find_telling(table, found, others, place) or [None] * len(every)
        causes = list_untold(found, every, vectors, tells_hz, blocks.period_s * len(blocks.reference))
        possible = list_possible(found, shifts, table)
    size = np.sqrt(np.mean(np.abs(blocks.reference) ** 2, axis=0)) * abs(controller.command.per_effort)
    allowed = float(np.sqrt(np.sum((found.std * size) ** 2)))
    return LineMatch(causes=causes, off=np.abs(found.mean) * size, allowed=allowed, late=found.late, possible=possible)


def _enclose(law: Law, signals: Sequence[str], outer: OuterLoop | None) -> Law:
    """Return a law that reads these signals with an outer loop around it, of what that is given as a force."""
    if outer is None:
        return law
    return enclose_law(law, outer, signals.index(outer.position) if outer.position in signals else None, of_force=True)


def evaluate(law: Law, blocks: Blocks, ticks_per_row: int, image: int = 0) -> Complex[np.ndarray, "k m"]:
    """Return a law's responses at the lines, or at what comes back as them, by the log's own clock."""
    turns = (np.round(blocks.f * blocks.period_s) / blocks.rows + image) / ticks_per_row
    return law.evaluate(np.expm1(2j * np.pi * turns))


def find_leakage(law: Law, blocks: Blocks, ticks_per_row: int) -> Float[np.ndarray, "k n"]:
    """Return an orthonormal basis, at the lines, of what a law's state at the start of a period adds to its rows."""
    rows, lines = blocks.rows, np.round(blocks.f * blocks.period_s).astype(int)
    a, _, row = law.remainder
    stepped, columns = np.linalg.matrix_power(a, ticks_per_row), np.empty((rows, row.size))
    for k in range(rows):
        columns[k] = row
        row = row @ stepped
    powers = np.linspace(0.0, 1.0, rows, endpoint=False)[:, None] ** np.arange(1, law.integrators + 1)
    spectrum = np.fft.rfft(np.hstack([columns, powers]), axis=0)[lines]
    table = np.concatenate([spectrum.real, spectrum.imag])
    table /= np.maximum(np.linalg.norm(table, axis=0), np.finfo(float).tiny)
    left, size, _ = np.linalg.svd(table, full_matrices=False)
    return left[:, size > SMALL * np.max(size, initial=0.0)]


def shift_command(controller: Controller, blocks: Blocks, late: int) -> Blocks:
    """Return blocks with the command so many ticks of the law earlier."""
    turned = turn_lines(controller, blocks, late)
    return blocks.change_efforts(lambda each: each.effort * turned)


def turn_lines(controller: Controller, blocks: Blocks, ticks: int) -> Lines:
    """Return what a command so many ticks of the law earlier is multiplied by at each line."""
    return np.exp(2j * np.pi * blocks.f * controller.sample_time_s * ticks)


def is_off(found: Off, shifts: Sequence[Shift], means: Sequence[Lines]) -> bool:
    """Tell whether the command is off by more than noise: as a whole, or towards what is excluded or named."""
    towards = [found.fit(mean) for shift, mean in zip(shifts, means, strict=True) if shift.role != "tried"]
    return found.misfit > found.most or any(abs(share) > found.sigmas * std for share, std in towards)


def list_untold(
    found: Off, shifts: Sequence[Shift], means: Sequence[Lines], tells_hz: Sequence[float | None], seconds: float
) -> tuple[Cause, ...]:
    """Return what the log does not exclude beside the law, with the seconds of it that would, the longest first; none
    where no length would. `tells_hz`: where a line would tell each; `seconds`: of the log's periods.
    """
    untold: list[Cause] = []
    for shift, mean, hertz in zip(shifts, means, tells_hz, strict=True):
        if shift.role != "excluded" or found.excludes(mean):
            continue
        needed, (_, std) = math.inf, found.fit(mean)
        if math.isfinite(std):
            vector = found.scale(mean)
            part = float(np.sum((vector * np.tile(found.noise / found.std, 2)) ** 2)) * std**2  # that periods lessen
            least = (0.5 / found.sigmas) ** 2 - std**2 * (1.0 - part)
            needed = max(std**2 * part / least, 1.0) if least > 0.0 else math.inf
        value = seconds * needed if math.isfinite(needed) else None
        untold.append(replace(leave_open(SHORT[shift.kind], shift.what, value, "s"), tells_hz=hertz))
    return tuple(sorted(untold, key=lambda cause: -(cause.value or math.inf)))


def list_possible(found: Off, shifts: Sequence[Shift], table: LoggedPeriods) -> tuple[Cause, ...]:
    """Return the laws with another part that the log does not exclude beside the law, its command logged late or not:
    a filter that is slower is much like a command that is logged later.
    """
    turns, made = [table.turn(found.late - late) for late in LATE], table.made
    return tuple(
        Cause(kind=shift.kind, what=shift.what, value=shift.value, unit=shift.unit, removes=0.0, explains=False)
        for shift in shifts
        if shift.role == "named"
        if not all(found.excludes(table.average((made + shift.commands) * turned - made)) for turned in turns)
    )


Rank = tuple[bool, float]


def name_causes(
    found: Off, shifts: Sequence[Shift], means: Sequence[Lines], signals: Sequence[str]
) -> tuple[Rank, tuple[Cause, ...]]:
    """Return what would explain that the command is off, the best first, and how good that is."""
    target, before = found.scale(found.mean), found.misfit
    rated: list[tuple[Rank, Cause]] = []
    for shift, mean in zip(shifts, means, strict=False):
        share = 1.0 if shift.base is None else found.fit(mean)[0]
        after = float(np.sum((target - share * found.scale(mean)) ** 2))
        kind, value = shift.name(share, signals)
        removes, explains = 1.0 - after / before, after <= found.most
        cause = Cause(kind=kind, what=shift.what, value=value, unit=shift.unit, removes=removes, explains=explains)
        if removes > 0.0 and (shift.kind != "gain" or (value or 0.0) > 0.0):
            rated.append(((not explains, after + FITTED * (kind in ("gain", "factor"))), cause))
    rated.sort(key=lambda pair: pair[0])
    rank = rated[0][0] if rated else (True, before)
    return rank, tuple(cause for _, cause in rated[:MOST_CAUSES])


def _halve(gains: Gains) -> Iterator[tuple[str, Gains]]:
    """Yield the gains in which a law is linear, each at half its size."""
    for name in ("k_p", "k_i", "k_d", "k_r"):
        value = getattr(gains, name)
        if value:
            yield name, replace(gains, **{name: 0.5 * value})
    if gains.inner is not None:
        yield "k_v", replace(gains, inner=replace(gains.inner, k_v=0.5 * gains.inner.k_v))


def _matters(law: Law, other: Law) -> bool:
    """Tell whether another law differs somewhere by more than is as good as nothing."""
    first, second = (each.evaluate(np.expm1(2j * np.pi * GRID)) for each in (law, other))
    return bool(np.any(np.abs(second - first) > MATTERS * np.abs(first)))
