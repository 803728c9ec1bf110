r"""Other laws that rounding hides tick by tick: a matched filter over the whole log.

With e what the log has more than the law's commands, and c what another law makes more than it, both over segments of
the log, less the polynomials that integrals hold, under Hann's window w and transformed, the share of c in e is

.. math::
    a &= \frac{\sum \mathrm{Re}(\bar C E)/S + B}{\sum |C|^2/S}, \qquad
    \sigma_a^2 = \frac{\max(1, \chi^2)}{\sum |C|^2/S}, \\
    S &= \frac{\sum w^2}{12}\Big(q_u^2 + \sum_i q_i^2 |R_i|^2\Big), \qquad
    B = \frac{\sum w^2}{12} \sum_i \sum q_i^2\, \mathrm{Re}(\overline{\Delta R_i} R_i)/S,

S what rounding of the command by :math:`q_u`, and of reference and readings by :math:`q_i`, leaves of the law's
commands by its responses R, and :math:`\chi^2` what is left of :math:`|E - a C|^2/S` per line. The rounding of a
reference that repeats itself repeats, too: what it adds to the variance counts once a period, not once a row. B takes
account of the rounding of what the laws are given, which is in e and in c, with :math:`\Delta R` what the other law's
responses are more. Where the command is at its limit now and then, rounding is cut off there: the std is the larger of
:math:`\sigma_a` and that of the shares without one segment each (the jackknife's).

Under the law a is 0, under the other one 1. A share is told where both are far from each other: an effect far below the
rounding of a tick adds up over 40,000 of them. Rounding is noise only where the readings' own noise is not much smaller
than a step, or the step is small beside their motion: else it goes with the signal (Bennett, Bell System Technical
Journal 27, 1948), and nothing is told.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from jaxtyping import Complex, Float

from seaopt.control import RunnableLaw
from seaopt.logs.quality.faults import find_quantisation
from seaopt.machine.alternatives import Alternative, list_others, list_parts
from seaopt.machine.causes import Cause
from seaopt.machine.gains.free_gains import make_law
from seaopt.machine.response.periods import find_period
from seaopt.machine.stepped import (
    FLOOR,
    Match,
    Others,
    Setting,
    count_integrals,
    leave_integrals,
    list_steps,
    play,
    take_weights,
)
from seaopt.machine.ticks import find_saturated
from seaopt.records import record

SEGMENT = 8192  # rows of one
FEWEST = 3  # of them that tell their scatter
SIGMAS = 6.0  # of a share, that tell it from 0, and half of which tell it from 1
GAINS = ("k_p", "k_i", "k_d", "k_r")
DITHERED = 0.5  # of a step: noise of a reading, from which on its rounding is noise, too
FINE = 0.003  # of a reading's std: a step below that goes with nothing
STEP = 0.1  # of a gain, by which its effect is measured


@record(eq=False)
class Segments:
    """What a log has more than a law's commands, at the lines of each segment, over the std of rounding."""

    off: Complex[np.ndarray, "s m"]
    f: Float[np.ndarray, " m"]  # cycles per row
    std: Float[np.ndarray, " m"]
    responses: Complex[np.ndarray, "k m"]  # of the law
    rounded: Float[np.ndarray, " k"]  # variance of what it is given, at a line
    window: Float[np.ndarray, " n"]
    integrals: int
    repeats: float  # periods of the reference that the log has

    @classmethod
    def make(cls, setting: Setting, match: Match) -> Segments:
        """Return those of a law's replay."""
        ticks, rows = setting.ticks, min(SEGMENT, len(setting.ticks))
        window, f = np.hanning(rows + 1)[:-1], np.fft.rfftfreq(rows)[1:]
        responses, steps = respond(setting.linear, f), list_steps(setting.ticks) * setting.rounded
        power = float(np.sum(window**2)) / 12.0
        floor = power * (ticks.quantum**2 + (FLOOR**2 * float(np.std(ticks.command))) ** 2)
        variance = floor + np.sum(power * steps[:, None] ** 2 * np.abs(responses) ** 2, axis=0)
        empty = cls(
            off=np.zeros((0, f.size), dtype=complex),
            f=f,
            std=np.sqrt(variance),
            responses=responses,
            rounded=power * steps**2,
            window=window,
            integrals=count_integrals(setting.linear),
            repeats=len(ticks) / (find_period(ticks.reference) or len(ticks)),
        )
        return replace(empty, off=empty.transform(-match.error))

    def transform(self, values: Float[np.ndarray, " n"]) -> Complex[np.ndarray, "s m"]:
        """Return values at the lines of each segment, half of which is in the next, over the std of rounding."""
        rows = self.window.size
        starts = range(0, values.size - rows + 1, max(1, rows // 2))
        parts = np.array([leave_integrals(values[start : start + rows], self.integrals) for start in starts])
        return np.fft.rfft(parts * self.window, axis=1)[:, 1:] / self.std

    def find_share(self, law: RunnableLaw, commands: Float[np.ndarray, " n"]) -> tuple[float, float]:
        """Return the share of another law in what is off, and its std. `commands`: that it makes more."""
        made = self.transform(commands)
        size, count = np.sum(np.abs(made) ** 2, axis=1), len(made)
        if not np.all(size):
            return 0.0, math.inf
        common = np.real(np.conj(respond(law, self.f) - self.responses) * self.responses) * self.rounded[:, None]
        shared = np.sum(np.real(np.conj(made) * self.off), axis=1) + float(np.sum(common / self.std**2))
        share = float(np.sum(shared) / np.sum(size))
        left = float(np.mean(np.abs(self.off - share * made) ** 2))
        repeated = np.abs(made) ** 2 @ (self.rounded[0] * np.abs(self.responses[0]) ** 2 / self.std**2)
        again = (self.repeats - 1.0) * float(np.sum(repeated)) / float(np.sum(size)) ** 2
        std = math.sqrt(max(1.0, left) / float(np.sum(size)) + again)
        if count < FEWEST:
            return share, std
        without = (np.sum(shared) - shared) / (np.sum(size) - size)
        return share, max(std, math.sqrt((count - 1) / count * float(np.sum((without - share) ** 2))))


def respond(law: RunnableLaw, f: Float[np.ndarray, " m"]) -> Complex[np.ndarray, "k m"]:
    """Return the commands of a law per reference and reading, at frequencies in cycles per row."""
    columns, direct = take_weights(law)
    z = np.exp(2j * np.pi * f)[:, None, None]
    states = np.linalg.solve(z * np.eye(law.c.size) - law.a, np.broadcast_to(columns, (f.size, *columns.shape)))
    return law.per_effort * (direct[:, None] + np.einsum("i,mik->km", law.c, states))


def find_hidden(setting: Setting, match: Match, others: Others) -> tuple[Cause, ...]:
    """Return the laws of which the log is rather than of this one, the surest first, though the command is off by no
    more than rounding allows; none where it is of this one, or does not tell.
    """
    law, columns = setting.law, [setting.ticks.reference, *setting.ticks.measured.T]
    if not isinstance(law, RunnableLaw) or not law.c.size or not all(map(_is_dithered, columns)):
        return ()
    segments, least = Segments.make(setting, match), FLOOR * float(np.std(setting.ticks.command))
    limited = find_saturated(setting.ticks, law.command_limit) > 0.0
    if limited and len(segments.off) < FEWEST:
        return ()
    found = list[tuple[float, Cause]]()
    for alternative, size in _list_hidden(setting, others):
        changed = alternative.change(setting)
        other = play(changed).commands - match.commands
        share, std = segments.find_share(changed.linear, other)
        whole = abs(share - 1.0) < 0.5 and std < 0.5 / SIGMAS
        if abs(share) <= SIGMAS * std or not (whole if size is None else not limited):
            continue
        left = float(np.mean((match.error + share * other) ** 2))
        cause = Cause(
            kind=alternative.kind,
            what=alternative.what,
            value=alternative.value if size is None else size * (1.0 + STEP * share),
            unit=alternative.unit,
            removes=max(0.0, 1.0 - left / match.energy),
            explains=True,
            sigmas=abs(share) / std,
        )
        found.append((abs(share) * float(np.std(other)), cause))
    found.sort(key=lambda pair: -(pair[1].sigmas or 0.0))
    if not found or found[0][0] < least:  # what is surest is as good as nothing
        return ()
    return tuple(cause for _, cause in found)


def _list_hidden(setting: Setting, others: Others) -> Iterator[tuple[Alternative, float | None]]:
    """Yield other laws, and of those with a gain of another size that gain."""
    for alternative in list_others(setting, others):
        yield alternative, None
    controller, gains = setting.controller, setting.controller.read_gains()
    if gains is None:
        return
    for kind, what, value, part in list_parts(gains):
        change = make_law(controller, part)
        yield Alternative(kind=kind, what=what, value=value, change=change), None
    for name in GAINS:
        if size := getattr(gains, name):
            change = make_law(controller, replace(gains, **{name: (1.0 + STEP) * size}))
            yield Alternative(kind="gain", what=name, change=change), size


def _is_dithered(values: Float[np.ndarray, " n"]) -> bool:
    """Tell whether the rounding of values is noise."""
    step = find_quantisation(values)
    noise = math.sqrt(float(np.mean(np.diff(values, 2) ** 2)) / 6.0)
    return noise >= DITHERED * step or step <= FINE * float(np.std(values))
