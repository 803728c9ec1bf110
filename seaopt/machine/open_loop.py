r"""Whether the commands of a log follow its readings at all: whether the loop was open.

A linear law of order n, whatever its gains, makes its command of the n rows before, the reference and the readings.
With :math:`\varepsilon_{t-j}` what rows before do not predict of a reading, in

.. math:: u_t = \sum_{i=1}^p a_i u_{t-i} + \sum_{i=0}^p b_i r_{t-i} + \sum_{i=0}^p c_i y_{t-i} + e_t

the part of :math:`\varepsilon_{t-j}` in the command is that of a law with its readings j rows late, and nothing is left
over. A command that was played by itself is independent of the noise of the readings, whatever it is, and however much
of it they hold by way of the machine. The columns are taken in the order above, the older readings first, so that each
leaves the one before out (the partial regression of Granger, Econometrica 37, 1969).

It takes readings whose noise is in the log: more than its rounding, which the law never saw.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from seaopt.logs.quality.faults import find_quantisation
from seaopt.machine.stepped import Match, Setting, find_at_limit, find_modes
from seaopt.records import record

ROWS = 32  # p
ANSWERS = 5  # rows within which a law answers a reading
FEWEST, MOST = 10 * ROWS, 20000  # rows that are compared
SIGMAS = 4.0
WEAKEST = 0.2  # of the law's own answer: one above would have been seen
UNFELT = 1e-3  # of it: one below is none
LEAST_NOISE = 1e-5  # of a reading's std, that rows before do not predict
OFF = 0.5  # of the command's rms: a law that is nearer than that is followed


@record(eq=False)
class Answers:
    """What a command holds of a reading's noise, after so many rows, with its std."""

    size: Float[np.ndarray, " j"]
    std: Float[np.ndarray, " j"]
    noise: float  # std of the reading's


def find_unfollowed(setting: Setting, match: Match) -> tuple[str, ...]:
    """Return the signals that a command was seen not to follow, where it follows none; none where a log does not tell.
    `match`: of the law's replay.
    """
    ticks, law = setting.ticks, setting.linear
    limited = find_at_limit(ticks, law)
    if np.sqrt(match.energy) < OFF * np.std(ticks.command) or not np.ptp(ticks.command):
        return ()
    found = list[str]()
    after = find_modes(law, np.zeros(ANSWERS, dtype=bool)) @ np.reshape(law.b_measurement, (law.c.size, -1))
    of_law = np.max(np.abs(np.vstack([law.per_effort * np.ravel(law.d_measurement), after])), axis=0)
    for i, name in enumerate(setting.controller.signals):
        answers = measure_answers(setting, i, ~limited)
        values = ticks.measured[:, i]
        floor = max(find_quantisation(values), LEAST_NOISE * float(np.std(values)))
        if answers is None or answers.noise <= floor:
            continue
        size, unsure = np.abs(answers.size), SIGMAS * answers.std + UNFELT * of_law[i]
        if np.any(size > unsure):
            return ()
        if np.all(size + unsure < WEAKEST * of_law[i]):
            found.append(name)
    return tuple(found)


def measure_answers(setting: Setting, signal: int, free: Bool[np.ndarray, " n"]) -> Answers | None:
    """Return what a command holds of the noise of one of its readings, in the rows that are free; None of too few."""
    ticks, p = setting.ticks, ROWS
    last = min(len(ticks), MOST)
    rows = np.arange(p, last)[free[p:last]]
    others = [ticks.measured[:, i] for i in range(ticks.measured.shape[1]) if i != signal]
    width = 2 + (3 + len(others)) * (p + 1)
    if rows.size < FEWEST + width:
        return None
    lags = np.arange(p, -1, -1)
    columns = [np.ones((rows.size, 1)), *(_shift(each, rows, lags) for each in (ticks.reference, *others))]
    table = np.hstack([*columns, _shift(ticks.command, rows, lags[:-1]), _shift(ticks.measured[:, signal], rows, lags)])
    command = ticks.command[rows] - np.mean(ticks.command[rows])
    q, r = np.linalg.qr(table)
    along = q.T @ command
    left = float(np.sqrt(np.mean((command - q @ along) ** 2) * rows.size / (rows.size - table.shape[1])))
    noise = np.abs(np.diag(r)[-1 - ANSWERS :]) * float(np.std(ticks.measured[:, signal]))
    safe = np.maximum(noise, np.finfo(float).tiny)
    return Answers(size=along[-1 - ANSWERS :] / safe, std=left / safe, noise=float(np.min(noise) / np.sqrt(rows.size)))


def _shift(values: Float[np.ndarray, " n"], rows: np.ndarray, lags: np.ndarray) -> Float[np.ndarray, "m k"]:
    """Return a signal about its mean in some rows, and so many before each."""
    moved = values - np.mean(values)
    return moved[rows[:, None] - lags] / max(float(np.std(values)), np.finfo(float).tiny)
