r"""Steps of a plant with one joint that sticks, from event to event, in Python: those of step.c, for no compiler.

Between events the plant is smooth. The joint slides in a direction, m = 1 or -1, under the force :math:`m F(|v|)`, or
is held, m = 0, by the force :math:`\lambda` that leaves it no acceleration; each stretch is one step of Runge's and
Kutta's method of order four. Events are

- a stop, where the joint slides and its velocity passes zero: where the cubic of its values and accelerations at both
  ends of the stretch does. It is then held if :math:`|\lambda| \le F(0)`, and else slides the other way;
- a start, where it is held and :math:`|\lambda|` passes F(0): found by the secant rule.

An event that comes later by :math:`dt` leaves :math:`(f^- - f^+)\,dt` in the state, with the rates on both sides of it.
A velocity :math:`v = c x` passes zero at :math:`dt = -v/(c f^-)`, so that from values and derivatives alike

.. math:: \frac{f^- - f^+}{c f^-}\, v

is taken at a stop (Hiskens and Pai, IEEE Trans. Circuits Syst. I 47(2), 2000): derivatives are exact, and an error e of
where it is leaves one of e squared. Where the joint is held from there, :math:`f^- - f^+` and :math:`c f^-` are a
force's effect b and c b times the same, which leaves :math:`b v/(c b)`: none of its velocity. At a start both rates are
the same, and nothing is left.
"""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
from jaxtyping import Float

from seaopt.records import record
from seaopt.simulation.direct_call import DirectCall

PHASES = 8  # of a step; these constants are those of step.c
STILL_S = 1e-13  # a velocity that friction alone takes away in this time is rounding
ROUNDS = 8  # of Newton's method on the cubic

Vector = Float[np.ndarray, " _"]


@record(eq=False)
class _Joint:
    """A joint's figures at a place, how its speed depends on x and theta, and what a force adds to f."""

    speed: float
    holding: float
    level: float
    by_x: Vector
    by_theta: Vector
    effect: Vector

    @property
    def room(self) -> float:
        """The force by which it is held more than it is pushed."""
        return self.level - abs(self.holding)

    def choose_mode(self) -> float:
        """Return how it goes on from rest."""
        return 0.0 if abs(self.holding) <= self.level else float(np.sign(self.holding))


class EventStep(ca.Callback):
    """The CasADi function (t, x, u0, u1, p, h) -> (x1, dx1/dx, dx1/d[theta, h, u0, u1]), u a line from u0 to u1.

    `phase`: (t, x, u0, u1, p, h, mode) -> the same of a stretch in a mode; `rate`: (t, x, u, p, mode) -> f; `joint`:
    (t, x, u, p) -> [v, holding force, F(0)], dv/dx, dv/dtheta, what a force adds to f.
    """

    def __init__(self, phase: ca.Function, rate: ca.Function, joint: ca.Function, thetas: int) -> None:
        ca.Callback.__init__(self)
        self.phase, self.thetas = phase, thetas
        self.sizes = [phase.sparsity_in(i) for i in range(6)], [phase.sparsity_out(i) for i in range(3)]
        self._phase, self._rate, self._joint = (DirectCall(function) for function in (phase, rate, joint))
        self.construct("seaopt_step", {})

    def get_n_in(self) -> int:
        """Return how many arguments there are."""
        return 6

    def get_n_out(self) -> int:
        """Return how many results there are."""
        return 3

    def get_sparsity_in(self, i: int) -> Any:
        """Return the shape of an argument."""
        return self.sizes[0][i]

    def get_sparsity_out(self, i: int) -> Any:
        """Return the shape of a result."""
        return self.sizes[1][i]

    def has_eval_buffer(self) -> bool:
        """Tell that arguments and results come as memory, which is quicker."""
        return True

    @np.errstate(all="ignore")
    def eval_buffer(self, arg: Any, res: Any) -> int:
        """Step from the arguments to the results."""
        t, x, u0, u1, p, h = (np.frombuffer(each) for each in arg)
        results = _Steps(self, float(t[0]), u0, u1, p, float(h[0])).run(x)
        for room, result in zip(res, results, strict=True):
            if room is not None:
                np.frombuffer(room)[:] = result.ravel(order="F")
        return 0


class _Steps:
    """The stretches of one step."""

    def __init__(self, functions: Any, t: float, u0: Vector, u1: Vector, p: Vector, h: float) -> None:
        self.functions, self.t, self.p, self.h, self.u0, self.u1 = functions, t, p, h, u0, u1
        self.thetas = functions.thetas

    def run(self, x: Vector) -> tuple[Vector, Any, Any]:
        """Return the state at the end, and its derivatives."""
        moved = self.thetas + 1 + 2 * self.u0.size
        z = np.column_stack([x, np.eye(x.size), np.zeros((x.size, moved))])
        elapsed, mode = 0.0, 0.0
        for phase in range(PHASES):
            first = self._look(z, elapsed)
            effect = float(first.by_x @ first.effect)
            if not phase:
                still = abs(first.speed) <= STILL_S * abs(effect) * first.level
                mode = first.choose_mode() if still else float(np.sign(first.speed))
            if mode == 0.0:
                z = self._take_speed(z, first, first.effect / effect)
            end = self._advance(z, elapsed, 1.0, mode)
            if not self.h > 0.0 or phase == PHASES - 1:
                return _split(end)
            last = self._look(end, 1.0)
            if not (last.room < 0.0 if mode == 0.0 else mode * last.speed <= 0.0):
                return _split(end)
            if mode == 0.0:
                share = self._find_start(z, elapsed, first.room, last.room)
            else:
                length = mode * (1.0 - elapsed) * self.h
                slopes = (
                    length * float(at.by_x @ self._rate(each, where, mode))
                    for at, each, where in ((first, z, elapsed), (last, end, 1.0))
                )
                before, after = slopes
                share = find_turn(mode * first.speed, before, mode * last.speed, after)
            turn = elapsed + share * (1.0 - elapsed)
            z, elapsed = self._advance(z, elapsed, turn, mode), turn
            now = self._look(z, elapsed)
            following = now.choose_mode() if mode else float(np.sign(now.holding))
            if mode * following < 0.0:
                rates = self._rate(z, elapsed, mode), self._rate(z, elapsed, following)
                z = self._take_speed(z, now, (rates[0] - rates[1]) / float(now.by_x @ rates[0]))
            mode = following
        raise AssertionError  # the last phase returns

    def _find_start(self, z: Any, elapsed: float, below: float, above: float) -> float:
        """Return the share of what is left of a step after which a joint that is held gives way."""
        low, high = 0.0, 1.0
        for _ in range(2):
            share = low + (high - low) * below / (below - above)
            to = elapsed + share * (1.0 - elapsed)
            room = self._look(self._advance(z, elapsed, to, 0.0), to).room
            if room >= 0.0:
                low, below = share, room
            else:
                high, above = share, room
        return low + (high - low) * below / (below - above)

    def _input(self, elapsed: float) -> Vector:
        return self.u0 + elapsed * (self.u1 - self.u0)

    def _look(self, z: Any, elapsed: float) -> _Joint:
        call = self.functions._joint
        time = self.t + elapsed * self.h
        figures, by_x, by_theta, effect = (each.ravel() for each in call(time, z[:, 0], self._input(elapsed), self.p))
        return _Joint(
            speed=float(figures[0]),
            holding=float(figures[1]),
            level=float(figures[2]),
            by_x=by_x,
            by_theta=by_theta,
            effect=effect,
        )

    def _rate(self, z: Any, elapsed: float, mode: float) -> Vector:
        (f,) = self.functions._rate(self.t + elapsed * self.h, z[:, 0], self._input(elapsed), self.p, mode)
        return f.ravel()

    def _advance(self, z: Any, start: float, end: float, mode: float) -> Any:
        """Return the state and its derivatives at another place of the step."""
        nx, nq, nu = len(z), self.thetas, self.u0.size
        begin, h = self.t + start * self.h, (end - start) * self.h
        x, a, b = self.functions._phase(begin, z[:, 0], self._input(start), self._input(end), self.p, h, mode)
        after = np.empty_like(z)
        after[:, 0] = x.ravel()
        after[:, 1:] = a @ z[:, 1:]
        forced = after[:, 1 + nx :]
        forced[:, :nq] += b[:, :nq]
        forced[:, nq] += (end - start) * b[:, nq]
        by_first, by_last = b[:, nq + 1 : nq + 1 + nu], b[:, nq + 1 + nu :]
        forced[:, nq + 1 : nq + 1 + nu] += (1.0 - start) * by_first + (1.0 - end) * by_last
        forced[:, nq + 1 + nu :] += start * by_first + end * by_last
        return after

    def _take_speed(self, z: Any, at: _Joint, share: Vector) -> Any:
        w = at.by_x @ z
        w[0] = at.speed
        w[1 + len(z) : 1 + len(z) + self.thetas] += at.by_theta
        return z - np.outer(share, w)


def _split(z: Any) -> tuple[Vector, Any, Any]:
    nx = len(z)
    return z[:, 0], z[:, 1 : 1 + nx], z[:, 1 + nx :]


def find_turn(w0: float, d0: float, w1: float, d1: float) -> float:
    """Return where the cubic with these values and slopes at 0 and 1 falls through zero."""
    a, b = d0 + d1 - 2.0 * (w1 - w0), 3.0 * (w1 - w0) - 2.0 * d0 - d1
    low, high = 0.0, 1.0
    if w0 <= 0.0:
        if w0 + 0.5 * (d0 + 0.5 * (b + 0.5 * a)) <= 0.0:
            return 0.0
        r = low = 0.5
    else:
        r = w0 / (w0 - w1)
    for _ in range(ROUNDS):
        w, d = w0 + r * (d0 + r * (b + r * a)), d0 + r * (2.0 * b + 3.0 * a * r)
        if w > 0.0:
            low = r
        else:
            high = r
        r = r - w / d if d else np.inf
        if not low <= r <= high:
            r = 0.5 * (low + high)
    return float(r)
