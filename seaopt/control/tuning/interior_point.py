r"""Refine all numbers of a law at once by an interior-point method on exact derivatives, the tuner's third step.

The quadratic programs leave filters where the scan put them and stop at a first-order step. Here gains, weights, T_f,
T_q, T_v, notch and prefilter move together: minimise the objective subject to

.. math:: \ln u_i(x) \le s, \qquad \ln (\sqrt2\,|P C_r| / |1 + L|)_{f_b} = 0

and the linear limits on the gains, with :math:`u_i` the usages of `seaopt.control.tuning.optimisation_problem` at the
points of plant and frequency that matter (in the passive band :math:`u_i - 1` in place of the logarithm), and one slack
:math:`s \ge 0` at a price that is beyond any gain of the objective, so that limits that cannot all be kept are missed
by one common factor, the least possible. Derivatives, first and second, are CasADi's; the solver is IPOPT. A program
of given numbers of points is built once and used for every plant and specification.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from jaxtyping import Int

from seaopt.control.laws.limits import LimitCurve
from seaopt.control.laws.structures import evaluate_terms
from seaopt.control.loops.measured.loop import leave_positive, map_disc
from seaopt.control.tuning.frequencies import choose_prominent
from seaopt.control.tuning.grid import FRICTION, Grid, LawResponse, Path, Values
from seaopt.control.tuning.law_numbers import (
    DAMPING,
    K_D,
    K_I,
    K_P,
    K_V,
    NOTCH_DEPTH,
    NOTCH_W,
    NOTCH_WIDTH,
    PREFILTER_W,
    SPEED_RATE,
    T_F,
    T_Q,
    W_C,
    W_R,
    LawNumbers,
)
from seaopt.control.tuning.optimisation_problem import CURVES, LINEAR_LIMITS, NOISE, PASSIVE, SCOPES, Task
from seaopt.executors import solve_ipopt

POINTS_PER_LIMIT = 24  # of each kind of limit
SPREAD_POINTS = 10  # of them, at even distances
LARGEST_FACTOR, SMALLEST_FACTOR = 3.0, 1.1  # by which a number may change in one solution
WORST_PLANTS = 2  # plants whose objective is followed
QUADRATURE_CHUNK = 64  # quadrature points come in multiples of this
SLACK_PRICE = 1e3
LEAST_SPEED_GAIN = 1e-2  # of the inverse of the speed per command at the bandwidth: k_v that makes a difference
HOPELESS = 1.05  # worst usage beyond which solutions that bring next to nothing are not repeated
CLEARLY = 1.01  # and beyond which they are not that bring neither more nor less
STALLED, MOST_STALLED = 0.9, 2  # of what was missed before: that is next to nothing; how often it may be
UNUSED = 1e-6  # of a limit: outside its band, or not imposed
SMOOTHING = 1e-12  # keeps magnitudes differentiable at zero


@dataclass(frozen=True, slots=True)  # not a record: the algebra below makes them by position
class _Complex:
    """A complex CasADi vector; with it, formulas for NumPy arrays make expressions."""

    re: Any
    im: Any

    @staticmethod
    def of(value: Any) -> _Complex:
        return value if isinstance(value, _Complex) else _Complex(value, 0.0)

    def __add__(self, other: Any) -> _Complex:
        o = _Complex.of(other)
        return _Complex(self.re + o.re, self.im + o.im)

    def __neg__(self) -> _Complex:
        return _Complex(-self.re, -self.im)

    def __sub__(self, other: Any) -> _Complex:
        return self + -_Complex.of(other)

    def __rsub__(self, other: Any) -> _Complex:
        return -self + other

    def __mul__(self, other: Any) -> _Complex:
        o = _Complex.of(other)
        return _Complex(self.re * o.re - self.im * o.im, self.re * o.im + self.im * o.re)

    def __truediv__(self, other: Any) -> _Complex:
        o = _Complex.of(other)
        top = self * _Complex(o.re, -o.im)
        size = o.square()
        return _Complex(top.re / size, top.im / size)

    def __rtruediv__(self, other: Any) -> _Complex:
        return _Complex.of(other) / self

    __radd__, __rmul__ = __add__, __mul__

    def square(self) -> Any:
        """Return the squared magnitude."""
        return self.re * self.re + self.im * self.im

    def conjugate(self) -> _Complex:
        """Return the conjugate."""
        return _Complex(self.re, -self.im)

    def at(self, where: slice) -> _Complex:
        """Return some of the rows."""
        return _Complex(self.re[where], self.im[where])


def refine(task: Task, grid: Grid, start: LawNumbers, rounds: int = 5, *, keeping: bool = False) -> LawNumbers:
    """Return the numbers at a local optimum near a stable start, or the start if no better ones are found. `rounds`:
    solutions at most; each adds the points where the one before broke a limit. `keeping`: whether the first numbers
    that keep all limits are enough, whatever their objective.
    """
    x, chosen, factor = start, _choose_points(task, grid, start), LARGEST_FACTOR
    rank, stalled = task.rank(grid, start), 0
    for _ in range(rounds):
        if keeping and rank[0] == 0.0:
            break
        trial = _solve(task, grid, x, chosen, factor)
        if trial is None:
            break
        again = _add_missed(task, grid, trial, chosen)
        trial_rank = task.rank(grid, trial)
        stalled = stalled + 1 if _has_stalled(rank[0], trial_rank[0]) else 0
        if trial_rank < rank and task.is_stable(trial):
            again = again or _reached_end(trial, x, factor)
            x, rank, factor = trial, trial_rank, min(factor**2, LARGEST_FACTOR)
        elif task.speed_loop is not None:  # along its flat valleys other points matter at every step that is far
            factor = max(np.sqrt(factor), SMALLEST_FACTOR)
        if not again or stalled == MOST_STALLED:
            break
    return x


def _has_stalled(usage: float, trial: float) -> bool:
    """Tell whether a solution brought next to nothing, where limits are missed clearly."""
    left = (trial - 1.0) / max(usage - 1.0, 1e-9)
    return usage > CLEARLY and left > STALLED and (usage > HOPELESS or left < 1.0 / STALLED)


def _reached_end(trial: LawNumbers, x: LawNumbers, factor: float) -> bool:
    """Tell whether a number changed by as much as it may in one solution; the weights may as they like."""
    bounded = np.delete(np.arange(x.size), [W_R, W_C])
    return bool(np.any((trial > 0.99 * factor * x)[bounded] | (trial < 1.01 / factor * x)[bounded]))


def _add_missed(task: Task, grid: Grid, x: LawNumbers, chosen: dict[str, Int[np.ndarray, " n"]]) -> bool:
    """Add the points where more of a limit is used than at any chosen one, in place of the last; tell if there are."""
    missed = False
    for name, curve in task.usage(grid, task.respond(grid, x)).items():
        if np.max(curve) > max(1.0, float(np.max(curve.ravel()[chosen[name]]))) + 1e-4:
            missed = True
            keep = POINTS_PER_LIMIT - SPREAD_POINTS
            worst = np.concatenate([choose_prominent(curve, keep // 2), chosen[name][:keep]])[:keep]
            chosen[name] = np.concatenate([worst, chosen[name][keep:]])
    return missed


def _choose_points(task: Task, grid: Grid, x: LawNumbers) -> dict[str, Int[np.ndarray, " n"]]:
    """Return flat indices of points for each limit: those that matter most, and some at even distances."""
    chosen: dict[str, Int[np.ndarray, " n"]] = {}
    for name, curve in task.usage(grid, task.respond(grid, x)).items():
        worst = np.argmax(curve, axis=0)
        used = np.flatnonzero(np.max(curve, axis=0) > UNUSED)
        even = used[np.linspace(0, used.size - 1, SPREAD_POINTS).astype(int)] if used.size else np.zeros(1, dtype=int)
        index = np.concatenate(
            [choose_prominent(curve, POINTS_PER_LIMIT - SPREAD_POINTS), worst[even] * grid.f.size + even]
        )
        chosen[name] = np.resize(index, POINTS_PER_LIMIT)
    return chosen


class _SymbolicPoints(NamedTuple):
    """Plants and law at some points, as expressions."""

    p: _Complex
    c_y: _Complex
    c_r: _Complex
    c_v: _Complex
    loop: _Complex


@lru_cache(maxsize=32)
def _build_program(
    quadrature: int,
    kinds: tuple[str, ...],
    observer: bool,
    notch: bool,
    noise: bool,
    discs: bool,
    paths: bool,
    gains: int,
    inside: bool,
    prefilter: str,
    signals: int,
    moved: bool,
) -> Any:
    """Return the IPOPT solver; its data are those of `_solve`, in the same order."""
    passive, tops = PASSIVE in kinds, POINTS_PER_LIMIT * ((PASSIVE in kinds) + signals * (FRICTION in kinds))
    n = POINTS_PER_LIMIT * len(kinds)
    total = n + quadrature * WORST_PLANTS * (not noise)
    complex_data = ("p", "q", "kept", "inverse")
    complex_data += (("fixed", "speed", "sense") if paths else ()) + (("asked",) if moved else ())
    shapes = (
        {f"{name}_{part}": total for name in complex_data for part in ("re", "im")}
        | {
            "weight": quadrature,
            "ln_level": n,
            "at": 2 * len(complex_data),
            "ts": 1,
            "kff": 1,
            "scale": 14,
            "linear": LINEAR_LIMITS * gains,
            "unit": 2 * POINTS_PER_LIMIT * passive,
            "discs": 3 * n * discs,
        }
        | {f"top_{name}_{part}": tops for name in ("fixed", "y", "v") for part in ("re", "im")}
    )
    data = {name: ca.MX.sym(name, rows) for name, rows in shapes.items()}
    v, t, slack = ca.MX.sym("v", 14), ca.MX.sym("t"), ca.MX.sym("slack")
    x = v * data["scale"]

    def law(part: dict[str, Any]) -> _SymbolicPoints:
        """Return plants and law at some points."""
        at = {name: _Complex(part[f"{name}_re"], part[f"{name}_im"]) for name in complex_data}
        series, integral, rate, more, ahead, low_pass = evaluate_terms(
            at["q"],
            data["ts"],
            x[T_F],
            (x[T_Q], at["kept"], at["inverse"]) if observer else None,
            (x[NOTCH_W], x[NOTCH_WIDTH], x[NOTCH_DEPTH]) if notch else None,
            x[SPEED_RATE] if inside else 0.0,
            (x[PREFILTER_W], x[DAMPING] if prefilter == "second_order" else None) if prefilter else None,
        )
        both = integral * x[K_I] + x[K_P]
        c_y = (both + rate * x[K_D] + more) * series
        c_r = ((both - x[W_R] + rate * (x[K_D] - x[W_C])) * series + _Complex.of(ahead) * data["kff"]) * low_pass
        loop, c_v = at["p"] * c_y, _Complex.of(0.0)
        if paths:
            c_v = _Complex.of(series) * x[K_V] * at["sense"]
            loop = loop + (at["fixed"] - 1.0) + c_v * at["speed"]
        if moved:
            loop = loop + c_r * at["asked"]
        return _SymbolicPoints(p=at["p"], c_y=c_y, c_r=c_r, c_v=c_v, loop=loop)

    names = [f"{name}_{part}" for name in complex_data for part in ("re", "im")]
    p, c_y, c_r, c_v, open_loop = law({name: data[name][:n] for name in names})
    squared = (open_loop + 1.0).square() + SMOOTHING
    radii = ca.vertsplit(data["discs"], n) if discs else []
    slices = {kind: slice(POINTS_PER_LIMIT * i, POINTS_PER_LIMIT * (i + 1)) for i, kind in enumerate(kinds)}

    def add_up(number: int, where: slice) -> _Complex:
        """Return the sums of a block of `Path`s on the law at the points of a limit."""
        rows = slice(POINTS_PER_LIMIT * number, POINTS_PER_LIMIT * (number + 1))
        fixed, y, v = (_Complex(data[f"top_{k}_re"][rows], data[f"top_{k}_im"][rows]) for k in ("fixed", "y", "v"))
        return fixed + y * c_y.at(where) + (v * c_v.at(where) if paths else 0.0)

    usage: dict[str, Any] = {}
    for kind, where in slices.items():
        level = data["ln_level"][where]
        if kind == PASSIVE:  # the plant is the port here
            unit = _Complex(data["unit"][:POINTS_PER_LIMIT], data["unit"][POINTS_PER_LIMIT:])
            top = add_up(0, where)
            turned = unit * top * (open_loop + 1.0).at(where).conjugate()
            cosine = turned.re / ca.sqrt((top.square() + SMOOTHING) * squared[where])
            usage[kind] = (1 - cosine) / ca.exp(level) - 1
        elif kind == FRICTION:  # a noise gain, weighted, on a plant of its own
            size = sum(add_up(passive + k, where).square() for k in range(signals))
            usage[kind] = 0.5 * ca.log((size + SMOOTHING) / squared[where]) - level
        else:
            curve = CURVES[kind]
            if discs:
                size = _bound_disc(curve, p, open_loop, radii, c_y, c_r, c_v)[where]
            else:
                value = curve.numerator(p, c_y, c_r, open_loop, c_v)
                top = value.square()[where] if isinstance(value, _Complex) else value
                size = 0.5 * ca.log((top + SMOOTHING) / squared[where])
            usage[kind] = level - size if curve.floor else size - level
    there = law({name: data["at"][i] for i, name in enumerate(names)})
    bandwidth = 0.5 * ca.log(2 * (there.p * there.c_r).square() / (there.loop + 1.0).square())
    if noise:
        where = slices[NOISE]
        worst = [usage[NOISE] + data["ln_level"][where] - t]
    else:
        along = law({name: data[name][n:] for name in names})
        size = 1 / ca.sqrt((along.loop + 1.0).square() + SMOOTHING)
        worst = [ca.dot(data["weight"], size[quadrature * i : quadrature * (i + 1)]) - t for i in range(WORST_PLANTS)]
    g = ca.vertcat(
        bandwidth,
        ca.reshape(data["linear"], LINEAR_LIMITS, gains) @ v[:gains],
        *worst,
        *(rows - slack for rows in usage.values()),
    )
    nlp = {"x": ca.vertcat(v, t, slack), "p": ca.vertcat(*data.values()), "f": t + SLACK_PRICE * slack, "g": g}
    options = {
        "print_time": False, "error_on_fail": False, "show_eval_warnings": False,
        "ipopt": {"print_level": 0, "sb": "yes", "max_iter": 80, "tol": 1e-6, "acceptable_tol": 1e-4,
                  "mu_init": 1e-3, "acceptable_iter": 5, "warm_start_init_point": "no",
                  # Scaled already and small: MUMPS's own scaling and ordering take longer than its solution.
                  "mumps_pivot_order": 0, "mumps_permuting_scaling": 0, "mumps_scaling": 0},
    }  # fmt: skip
    return ca.nlpsol("polish", "ipopt", nlp, options)


def _bound_disc(
    curve: LimitCurve,
    p: _Complex,
    open_loop: _Complex,
    radii: Sequence[Any],
    c_y: _Complex,
    c_r: _Complex,
    c_v: _Complex,
) -> Any:
    """Return the logarithm of the largest (of a floor the least) X/(1 + L) of discs, as `bound_disc` has it. `radii`
    are those around P, around what the law reads at fixed gains, and around a speed.
    """
    r, fixed, speed = radii
    constant_radius = fixed + speed * _size(c_v)
    size, reach = (open_loop + 1.0).square() + SMOOTHING, r * _size(c_y) + constant_radius
    room = size * leave_positive(1.0 - reach * reach / size, ca.fmin, ca.fmax)
    centre, radius, rooms = map_disc(curve.of, p, r, c_y, c_r, open_loop, constant_radius, c_v, room, _size)
    far = _size(centre)
    if curve.floor:
        return ca.log(far * leave_positive(1.0 - radius / far, ca.fmin, ca.fmax) / rooms[0])
    return ca.log((far + radius) / rooms[1])


def _size(value: _Complex) -> Any:
    return ca.sqrt(value.square() + SMOOTHING)


def _solve(
    task: Task, grid: Grid, start: LawNumbers, chosen: dict[str, Int[np.ndarray, " n"]], factor: float
) -> LawNumbers | None:
    """Solve the program on the chosen points, numbers within a factor; None if its answer is not of numbers."""
    spec, noise = task.spec, task.spec.objective == "noise"
    m, kinds, passive, friction = grid.f.size, tuple(grid.levels), task.port is not None, grid.friction.y.size > 0
    row, column = np.divmod(np.concatenate([chosen[kind] for kind in kinds]), m)
    columns, tops = [column], list[Path]()
    bottoms = [grid.plants.at((row, column))]
    if bottoms[0].r is not None:  # what is asked of the design plant is asked of the force law alone
        bottoms[0].r[np.repeat([kind in SCOPES["design plant"] for kind in kinds], POINTS_PER_LIMIT)] = 0.0
    discs, unit = grid.discs.at((row, column)), np.zeros(0, dtype=complex)
    levels = [grid.levels[kind][chosen[kind] % m] for kind in kinds]
    if passive:
        at_port = chosen[PASSIVE]
        levels.append(np.full(at_port.size, 1.0 - spec.reserve))
        columns.append(at_port)
        unit = np.where(grid.unit == 0.0, 1.0, grid.unit)[at_port]  # outside the band nothing is required
        bottoms.append(grid.port.at(at_port))
        tops.append(grid.force.at(at_port))
    if friction:
        row, column = np.divmod(chosen[FRICTION], m)
        levels.append(np.ones(column.size))
        columns.append(column)
        bottoms.append(grid.friction.at((row, column)))
        tops += [grid.friction_size.at((row, k, column)) for k in range(grid.friction_size.y.shape[1])]
    size = sum(part.size for part in columns)
    parts = (discs.y, discs.fixed, discs.v) if grid.in_discs else ()
    radii = np.concatenate([np.zeros(0), *(np.pad(part, (0, size - part.size)) for part in parts)])
    weights, law = np.zeros(0), task.respond(grid, start)
    if not noise:
        inside = np.flatnonzero(task.weights(grid.f) > 0.0)
        padded = np.resize(inside, QUADRATURE_CHUNK * (1 + (inside.size - 1) // QUADRATURE_CHUNK))
        weights = np.where(np.arange(padded.size) < inside.size, task.weights(grid.f)[padded], 0.0)
        worst = np.resize(np.argsort(-_integrate_sensitivity(task, grid, law))[:WORST_PLANTS], WORST_PLANTS)
        columns += [padded] * WORST_PLANTS
        bottoms += [grid.plants.at((plant, padded)) for plant in worst]
    column = np.concatenate(columns)
    p, fixed, speed = (np.concatenate([getattr(path, part) for path in bottoms]) for part in ("y", "fixed", "v"))
    outer = np.concatenate([0.0 * path.y if path.r is None else path.r for path in bottoms])
    at = task.find_bandwidth(grid)
    low, high = task.bounds(start)
    sizes = np.abs(start)
    sizes[[W_R, W_C]] = task.k_ff + start[K_P], start[K_D]
    least_v = LEAST_SPEED_GAIN / (task.speed_gain(grid) or 1.0)
    scale = np.maximum(
        sizes, [0.1, 0.1, 1e-4, 0.1, 1e-4, least_v, 0.1 * spec.sample_time_s, 1e-4, 1.0, 1e-3, 1e-2, 1e-2, 1e-3, 1e-2]
    )
    (linear, least, largest), gains = task.linear_limits(start), task.gains_tuned
    rows = np.max(np.abs(linear * scale[gains]), axis=1)  # each in units of its largest term
    near, far = (np.maximum(low, start / factor), np.minimum(high, factor * np.maximum(start, 0.3 * scale)))
    near[[W_R, W_C]], far[[W_R, W_C]] = low[[W_R, W_C]], high[[W_R, W_C]]
    design, paths = grid.plants.at(0), grid.reads_more
    every = [(p, design.y)] + [(part[column], part) for part in (grid.q, grid.kept, grid.inverse)]
    if paths:
        sense = task.sense(grid.q)
        every += [(fixed, design.fixed), (speed, design.v), (sense[column], sense)]
    if grid.plants.r is not None:
        every.append((outer, 0.0 * design.y))  # the bandwidth is the force law's
    data = [
        *(part for z, _ in every for part in (np.real(z), np.imag(z))), weights, np.log(np.concatenate(levels)),
        [part for _, z in every for part in (z[at].real, z[at].imag)], [spec.sample_time_s], [task.k_ff], scale,
        (linear * scale[gains] / rows[:, None]).ravel(order="F"), np.real(unit), np.imag(unit), radii,
        *_stack(tops),
    ]  # fmt: skip
    solver = _build_program(
        weights.size,
        (*kinds, *([PASSIVE] * passive), *([FRICTION] * friction)),
        task.nominal is not None,
        spec.notch is not None,
        noise,
        radii.size > 0,
        paths,
        gains.stop,
        bool(start[SPEED_RATE] > 0.0),
        "" if spec.reference_filter is None else spec.reference_filter.order,
        grid.friction_size.y.shape[1],
        grid.plants.r is not None,
    )
    value = task.objective(grid, law)
    slack = max(0.0, np.log(task.worst(grid, law))) + 0.01
    x0 = np.concatenate([start / scale, [np.log(value) if noise else value, slack]])
    count = int(solver.size_out("g")[0])
    lower, upper = np.full(count, -np.inf), np.zeros(count)
    lower[0] = 0.0
    lower[1 : 1 + least.size], upper[1 : 1 + least.size] = least / rows, largest / rows
    answer = solve_ipopt(
        solver,
        x0=x0,
        p=np.concatenate([np.asarray(part, dtype=float) for part in data]),
        lbg=lower,
        ubg=upper,
        lbx=[*(near / scale), -np.inf, 0.0],
        ubx=[*(far / scale), np.inf, np.inf],
    )
    x = np.array(answer["x"]).ravel()[: start.size] * scale
    return task.tidy(x) if np.all(np.isfinite(x)) else None


def _stack(paths: Sequence[Path]) -> list[Values]:
    """Return real and imaginary parts of the paths' fixed parts, then those of y, and of v."""
    whole = [np.concatenate([np.zeros(0), *(getattr(path, name) for path in paths)]) for name in ("fixed", "y", "v")]
    return [part for values in whole for part in (np.real(values), np.imag(values))]


def _integrate_sensitivity(task: Task, grid: Grid, law: LawResponse) -> Values:
    """Return the integral of abs(S) of every plant."""
    return (1.0 / np.abs(grid.plants.add_up(law.c_y, law.c_v, law.c_r))) @ task.weights(grid.f)
