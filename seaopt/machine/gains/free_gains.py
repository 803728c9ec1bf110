r"""The gains of a law whose command is logged: all of them fitted to it at once.

At given time constants :math:`\tau` (of filters, observer, notch, prefilter) a law's commands are affine in its gains
:math:`\theta` and linear in its state at the first row (`seaopt.control.laws.structures`), while no limit is active:

.. math:: u = u_0(\tau) + \Phi(\tau)\,\theta + M(\tau)\,x_0 .

Least squares of the logged commands over :math:`\theta` and :math:`x_0` leaves a residual that depends on
:math:`\tau` alone, which a search in their logarithms makes smallest (variable projection; Golub, Pereyra, Inverse
Problems 19, 2003). It takes runs of rows none of which is at the limit, each with a state of its own. Command and
readings of a law without noise of its own determine it to their rounding.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float

from seaopt.control import Controller, RunnableLaw, runnable
from seaopt.control.laws.structures import LAW_GAINS, Gains
from seaopt.control.loops.law import Law
from seaopt.errors import SeaoptError
from seaopt.logs.quality.faults import find_runs
from seaopt.machine.stepped import FLOOR, Inputs, Others, Setting, find_at_limit, transform
from seaopt.machine.ticks import Ticks
from seaopt.records import record

FEWEST, MOST = 400, 4000  # rows without a limit that it takes in all
RUNS = 8  # of them one after another, each from a state of its own
SHORTEST, PER_STATE = 40, 8  # rows of one, and per state
STARTS = (1.0, 0.3, 3.0)  # times the law's own time constants
REACH = 30.0  # times them, up and down
SMALL = 1e-3  # of a gain's natural size, where the law has none of it: its term is there all the same
STEP = 1e-6  # of a logarithm, by which the search differentiates
SAME_GAINS = 0.01  # relative: gains that are those of another law


def make_law(controller: Controller, gains: Gains, sample_time_s: float | None = None) -> Callable[[Setting], Setting]:
    """Return what gives a setting the law of other gains, or of another sample time, with the guards that it has."""

    def change(setting: Setting) -> Setting:
        period = sample_time_s or controller.sample_time_s
        made = runnable(replace(controller, law=gains.law(controller.spec.structure, period).balanced()))
        guards: dict[str, Any] = {
            name: getattr(setting.linear, name) for name in ("gate", "heat", "compensation", "command_limit")
        }
        if not np.any(setting.linear.anti_windup):
            guards["anti_windup"] = np.zeros_like(made.anti_windup)
        return replace(setting, law=replace(made, **guards))

    return change


@record(eq=False)
class _Numbers:
    """The numbers of a law, those it is affine in and those it is not."""

    gains: Gains

    @property
    def linear(self) -> Float[np.ndarray, " k"]:
        """The gains that the law is affine in, none of them zero: k_p, k_i, k_d, k_r, c k_d, and k_v of a cascade."""
        g = self.gains
        size = 1.0 + abs(g.k_p)
        natural = [size, size, size * g.T_f, size, size * g.T_f] + ([] if g.inner is None else [1.0])
        stated = [g.k_p, g.k_i, g.k_d, g.k_r, g.c * g.k_d] + ([] if g.inner is None else [g.inner.k_v])
        return np.array([a or SMALL * b for a, b in zip(stated, natural, strict=True)])

    @property
    def times(self) -> dict[str, float]:
        """The numbers that it is not affine in, by name."""
        others = {*LAW_GAINS, "k_v", "k_ff"} - {"T_f"}
        return {name: value for name, value in self.gains.by_name().items() if name not in others}

    def make(self, linear: Float[np.ndarray, " k"], times: Mapping[str, float]) -> Gains:
        """Return the gains of other numbers."""
        k_p, k_i, k_d, k_r, rate, *inner = (float(value) for value in linear)
        g, stated = self.gains, self.gains.by_name() | dict(times)
        stated |= {"k_p": k_p, "k_i": k_i, "k_d": k_d, "k_r": k_r, "c": rate / k_d if k_d else 0.0}
        stated |= {"k_v": inner[0]} if inner else {}
        observer = None if g.observer is None else replace(g.observer, T_q=stated["T_q"])
        return Gains.from_names(stated, observer, None if g.inner is None else g.inner.speed, g.link)


def fit_gains(setting: Setting) -> Gains | None:
    """Return the gains with which a setting's law is nearest to the logged commands; None where it has none with
    names, or the command is at its limit too often.
    """
    from scipy.optimize import least_squares  # deferred: 0.1 s

    own, rows = setting.controller.read_gains(), _find_free(setting)
    if own is None or not isinstance(setting.law, RunnableLaw) or not rows:
        return None
    linear = setting.linear
    runs = [_Run(efforts=ticks.command / linear.per_effort, inputs=Inputs.make(linear, ticks)) for ticks in rows]
    numbers, scale = _Numbers(gains=own), float(np.std(setting.ticks.command)) / abs(linear.per_effort)
    names, first = list(numbers.times), np.log(list(numbers.times.values()))

    def solve(z: Float[np.ndarray, " t"]) -> tuple[Gains, Float[np.ndarray, " n"]]:
        return _project(setting.controller, runs, numbers, dict(zip(names, np.exp(z).tolist(), strict=True)))

    best: tuple[float, Gains] | None = None
    for factor in STARTS:
        start, reach = first + np.log(factor), np.log(REACH)
        try:
            found = least_squares(
                lambda z: solve(z)[1] / scale, start, bounds=(first - reach, first + reach), diff_step=STEP, xtol=1e-12
            )
            off, gains = math.sqrt(float(np.mean(found.fun**2))), solve(found.x)[0]
        except (SeaoptError, np.linalg.LinAlgError, ValueError):  # no law of these numbers can run
            continue
        if best is None or off < best[0]:
            best = off, gains
        if off < FLOOR:
            break
    return None if best is None else best[1]


@record(eq=False)
class _Run:
    """A run of rows without a limit."""

    efforts: Float[np.ndarray, " n"]
    inputs: Inputs

    def leave_states(
        self, first: Law, others: Sequence[Law]
    ) -> tuple[Float[np.ndarray, "n k"], Float[np.ndarray, " n"]]:
        """Return what each of other laws makes more than a first one, and the logged efforts less those of the first,
        from zero, both without what a state at the first row adds. They have the first one's time constants, and so
        its states, which take something else of what they are given.
        """
        made, rows = self.inputs.respond(first)
        more = np.stack([law.b for law in others], axis=2) - first.b[:, :, None]
        out = self.inputs.columns @ (np.stack([law.d for law in others], axis=1) - first.d[:, None])
        taken = (transform(rows) @ more.reshape(len(more), -1)).reshape(-1, *more.shape[1:])
        out[1:] += np.fft.irfft(np.einsum("fko,fk->fo", taken, self.inputs.spectra), axis=0)[: len(rows) - 1]
        basis = np.linalg.qr(rows / np.maximum(np.linalg.norm(rows, axis=0), np.finfo(float).tiny))[0]
        columns = np.column_stack([out, self.efforts - made])
        columns -= basis @ (basis.T @ columns)
        return columns[:, :-1], columns[:, -1]


def _project(
    controller: Controller, runs: Sequence[_Run], numbers: _Numbers, times: Mapping[str, float]
) -> tuple[Gains, Float[np.ndarray, " n"]]:
    """Return the best gains at given time constants, and what they and the best states at the start of each run leave
    of the efforts.
    """
    own = numbers.linear
    # Its own gains, and where each is half as large again, of which the efforts change by half of its column.
    first, *others = (
        numbers.make(own + 0.5 * step, times).law(controller.spec.structure, controller.sample_time_s)
        for step in (np.zeros(own.size), *np.diag(own))
    )
    table, target = (
        np.concatenate(each) for each in zip(*(run.leave_states(first, others) for run in runs), strict=True)
    )
    size = np.maximum(np.linalg.norm(table, axis=0), np.finfo(float).tiny)
    solved = np.linalg.lstsq(table / size, target, rcond=1e-12)[0] / size
    return numbers.make(own * (1.0 + 0.5 * solved), times), target - table @ solved


def _find_free(setting: Setting) -> list[Ticks]:
    """Return the longest runs of rows in which no command is at a limit, up to some rows in all; none where they are
    few.
    """
    ticks = setting.ticks
    runs = find_runs(~find_at_limit(ticks, setting.linear))
    found, left = list[Ticks](), MOST
    for k in np.argsort(-runs.lengths, kind="stable")[:RUNS]:
        stop, rows = int(runs.stop[k]), min(int(runs.lengths[k]), left)
        if rows >= max(SHORTEST, PER_STATE * setting.linear.c.size):
            found.append(ticks.take(slice(stop - rows, stop)))
            left -= rows
    return found if MOST - left >= FEWEST else []


def find_same(gains: Gains, others: Others) -> str | None:
    """Return which of other laws has these gains; None where none has."""
    found = gains.by_name()
    for name, other in others.items():
        stated: dict[str, Any] = dict(other.gains) if isinstance(other, Controller) else {}
        if stated.keys() == found.keys() and all(
            abs(found[key] - stated[key]) <= SAME_GAINS * abs(stated[key]) for key in found
        ):
            return name
    return None
