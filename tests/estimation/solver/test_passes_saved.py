"""What a fit does in fewer passes: halves of a log at once, sums over influences, and a last step that is followed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares

import seaopt as so
from seaopt.estimation.problem.correlation import LaggedSums
from seaopt.estimation.problem.normal_equations import QuadraticModel
from seaopt.estimation.solver.least_squares import LOST_STEPS, minimise
from seaopt.simulation import Clock, Point, Segment, Weights, double_sum, keep_passes, make_model, run_passes, stream
from seaopt.simulation.compiled import PARALLEL, Program
from seaopt.simulation.interpreted import interpret_pass
from seaopt.simulation.native import find_compiler

needs_compiler = pytest.mark.skipif(find_compiler() is None, reason="no C compiler")
RATE = 400.0


@pytest.fixture(scope="module")
def case(thor):
    """Return a pass of the stand over a log long enough to be halved, with samples missing."""
    stand, free, rng = so.plants.high_impedance(), ("J", "b_r"), np.random.default_rng(0)
    model = make_model(stand, thor, free, ("F1", "F2"))
    y = rng.normal(size=(2, PARALLEL + 777)) * 100.0
    y[0, 500:600] = np.nan
    u = rng.normal(size=y.shape[1])
    point = Point(
        theta=np.array(thor.values_of(free)) * 1.1, offset=np.array([3.0, -2.0]), gain=np.array([1.0, 1.1]),
        drift=np.array([[1.0], [2.0]]), clock=Clock(period=1 / RATE, delay_s=0.3 / RATE, delay_free=True),
    )  # fmt: skip
    return model, Segment(u=(u,), y=tuple(y), drift_span=(-1.0, 2.0 / y.shape[1])), point, np.array([1e-3, 0.05])


@needs_compiler
@pytest.mark.parametrize("loss", ["square", "huber"])
def test_two_halves_are_the_interpreted_whole(case, loss):
    model, segment, point, x0 = case
    weights = replace(Weights.plain(2), loss=loss, knee=np.full(2, 80.0))
    program = Program.make(model, segment, point, weights)
    assert program is not None
    assert 0 < program.run_up < segment.n // 8
    ours = run_passes(model, segment, point, x0, weights)
    theirs = interpret_pass(model, segment, point, weights, segment.n, x0)
    np.testing.assert_allclose(ours.gram, theirs.gram, rtol=1e-9, atol=1e-12 * np.max(theirs.gram))
    np.testing.assert_allclose(ours.loss, theirs.loss, rtol=1e-10)
    np.testing.assert_array_equal(ours.count, theirs.count)


@needs_compiler
def test_a_plant_that_does_not_forget_is_not_halved(case):
    """A mass that nothing brakes or holds keeps its state: the second half cannot start from zero."""
    segment = case[1]
    mass = so.Plant(
        name="mass", states={"x": "m", "v": "m/s"}, inputs={"F": "N"}, outputs={"y": "m"}, parameters={"m": "kg"},
        f=lambda t, x, u, p: {"x": x.v, "v": u.F / p.m}, h=lambda t, x, u, p: {"y": x.x},
    )  # fmt: skip
    model = make_model(mass, so.ParameterSet.of(m=(2.0, "kg")), ("m",), ("y",))
    here = Point(theta=np.array([2.0]), offset=np.zeros(1), gain=np.ones(1), clock=Clock(period=1 / RATE))
    program = Program.make(model, Segment(u=segment.u, y=segment.y[:1]), here, Weights.plain(1))
    assert program is not None
    assert program.run_up == 0


@needs_compiler
@pytest.mark.parametrize(("rows", "lags", "p"), [(400, 0, 2), (400, 7, 3), (None, 5, 6)])
def test_the_double_sum_is_numpys(case, rows, lags, p):
    model, segment, point, x0 = case
    cut = slice(0, rows)
    segment = Segment(u=(segment.u[0][cut],), y=tuple(y[cut] for y in segment.y), drift_span=segment.drift_span)
    rng = np.random.default_rng(1)
    columns = run_passes(model, segment, point, x0, sums=False, columns=True).columns
    into = rng.normal(size=(2, p, columns.shape[2])) / np.sqrt(np.mean(columns**2, axis=0))[:, None]
    into[:, :, 0] = 0.0
    r = rng.normal(size=(lags + 1, 2, 2))
    r[0] += r[0].T
    influence = np.einsum("opc,toc->top", into, columns) * np.isfinite(np.array(segment.y)).T[:, :, None]
    expected = np.einsum("tai,ab,tbj->ij", influence, r[0], influence)
    together = expected.copy()
    for k in range(1, lags + 1):
        part = np.einsum("tai,ab,tbj->ij", influence[k:], r[k], influence[:-k])
        expected += part + part.T
    sums = double_sum(model, segment, point, x0, Weights.plain(2), into, r)
    assert sums is not None
    for found, expected_sum in zip(sums, (expected, together), strict=True):
        np.testing.assert_allclose(found, expected_sum, rtol=1e-9, atol=1e-10 * np.max(np.abs(expected)))


@needs_compiler
@pytest.mark.parametrize("settle", [0, 300])
def test_what_is_kept_serves_for_what_is_asked_later(case, settle, monkeypatch):
    """Sums, outputs, columns and double sums of a kept pass are those of passes made anew; none is simulated again."""
    model, segment, point, x0 = case
    weights = replace(Weights.plain(2), settle=settle)
    nc = run_passes(model, segment, point, x0, weights, stop=1, sums=False, columns=True).columns.shape[2]
    rng = np.random.default_rng(4)
    into, r = rng.normal(size=(2, 3, nc)), rng.normal(size=(6, 2, 2))
    into[:, :, 0], r[0] = 0.0, r[0] + r[0].T

    def ask():
        parts = [part.outputs.copy() for part in stream(model, segment, point, x0, weights, chunk=3_000)]
        columns = [
            part.columns.copy() for part in stream(model, segment, point, x0, weights, chunk=3_000, columns=True)
        ]
        whole = run_passes(model, segment, point, x0, weights, outputs=True, output_rows=50)
        twice = double_sum(model, segment, point, x0, weights, into, r)
        return np.concatenate(parts), np.concatenate(columns), whole.gram, whole.count, whole.outputs, twice

    expected = ask()
    with keep_passes():
        run_passes(model, segment, point, x0, weights, keep=True)
        monkeypatch.setattr(Program, "run", None)
        found = ask()
    for ours, theirs in zip(found, expected, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-11 * np.max(np.abs(theirs)))


@needs_compiler
def test_what_is_kept_is_of_one_point(case):
    """Another parameter, state or weight is simulated anew, and so is everything once keeping has ended."""
    model, segment, point, x0 = case
    weights = Weights.plain(2)
    with keep_passes():
        first = run_passes(model, segment, point, x0, weights, keep=True)
        for other in (
            (replace(point, theta=1.01 * point.theta), x0, weights),
            (replace(point, offset=point.offset + 1.0), x0, weights),
            (point, x0 + 1e-3, weights),
            (point, x0, replace(weights, settle=100)),
        ):
            assert not np.array_equal(run_passes(model, segment, *other).gram, first.gram)
        assert run_passes(model, segment, point, x0, weights).gram is first.gram
    assert run_passes(model, segment, point, x0, weights).gram is not first.gram


def test_lagged_sums_are_numpys():
    """Stretches that overlap by the lags, less the overlaps, are the whole."""
    x, lags = np.random.default_rng(2).normal(size=(3, 500)), 20
    whole, again = LaggedSums(3, 320, lags), LaggedSums(3, lags, lags)
    whole.add(x[:, :300])
    whole.add(x[:, 300 - lags :])
    again.add(x[:, 300 - lags : 300])
    expected = [[[np.sum(a[k:] * b[: 500 - k]) for b in x] for a in x] for k in range(lags + 1)]
    np.testing.assert_allclose(whole.sums() - again.sums(), expected, atol=1e-10)


def test_a_last_step_is_followed_without_an_evaluation_and_ends_where_scipy_does():
    """Of an exponential in noise; the same search with all evaluations takes one more."""
    t, rng = np.linspace(0, 3, 400), np.random.default_rng(3)
    y = 2.0 * np.exp(-0.7 * t) + 0.01 * rng.normal(size=t.size)
    seen: list[np.ndarray] = []
    origins: dict[int, tuple[QuadraticModel, np.ndarray]] = {}

    def residual(z):
        return (z[0] * np.exp(-z[1] * t) - y) / 0.01

    def jacobian(z):
        return np.column_stack([np.exp(-z[1] * t), -t * z[0] * np.exp(-z[1] * t)]) / 0.01

    def evaluation(z, origin):
        r, j = residual(origin), jacobian(origin)
        r = r + j @ (z - origin)
        here = QuadraticModel(
            z=z, cost=0.5 * float(r @ r), gradient=j.T @ r, hessian=j.T @ j, linear=np.zeros(2, dtype=bool)
        )
        origins[id(here)] = here, origin
        return here

    class Exponential:
        def evaluate(self, z):
            seen.append(z)
            return evaluation(z, z)

    bounds, start = np.full(2, np.inf), np.array([1.95, 0.71])
    all_made = minimise(Exponential(), start, -bounds, bounds)
    plain = len(seen)
    seen.clear()
    followed = minimise(
        Exponential(), start, -bounds, bounds, follow=lambda here, z: evaluation(z, origins[id(here)][1])
    )
    best = least_squares(residual, start, jac=jacobian, xtol=1e-15, ftol=1e-15, gtol=1e-15).x
    std = np.sqrt(np.diag(np.linalg.inv(jacobian(best).T @ jacobian(best))))
    assert followed.status == all_made.status == "converged"
    assert len(seen) < plain
    assert np.max(np.abs(followed.z - best) / std) < 1e-4
    near = 1.01 * all_made.evaluation.cost
    ended = minimise(Exponential(), start, -bounds, bounds, ends=lambda here: here.cost < near)
    assert ended.evaluation.cost < near and ended.iterations < all_made.iterations


class Wall:
    """A parabola about `least`, which no run reaches below `wall`."""

    def __init__(self, least, wall):
        self.least, self.wall, self.calls = least, wall, []

    def evaluate(self, z):
        self.calls.append(float(z[0]))
        apart = z - self.least
        cost = 0.5 * float(apart @ apart) + 1e3 if z[0] > self.wall else np.inf
        return QuadraticModel(z=z, cost=cost, gradient=apart, hessian=np.eye(1), linear=np.zeros(1, dtype=bool))


class Valley:
    """Rosenbrock's function (1960), which no run reaches beside its valley; `floor`: what noise adds to the cost."""

    def __init__(self, floor):
        self.floor = floor

    def evaluate(self, z):
        residuals = np.array([10.0 * (z[1] - z[0] ** 2), 1.0 - z[0]])
        slopes = np.array([[-20.0 * z[0], 10.0], [-1.0, 0.0]])
        cost = 0.5 * float(residuals @ residuals) + self.floor if z[1] >= z[0] ** 2 - 0.02 else np.inf
        linear = np.zeros(2, dtype=bool)
        return QuadraticModel(z=z, cost=cost, gradient=slopes.T @ residuals, hessian=slopes.T @ slopes, linear=linear)


@pytest.mark.parametrize("floor", [0.0, 1e4, 1e7])
def test_what_noise_adds_to_the_cost_does_not_end_a_search_beside_what_cannot_be_simulated(floor):
    bounds = np.full(2, np.inf)
    solution = minimise(Valley(floor), np.array([-1.2, 1.5]), -bounds, bounds, max_iterations=100)
    assert solution.status == "converged" and solution.z == pytest.approx([1.0, 1.0], abs=1e-3)


def test_a_search_ends_where_it_goes_to_what_cannot_be_simulated():
    bounds, start = np.full(1, np.inf), np.array([1.0])
    beyond = Wall(-0.5, 0.0)
    solution = minimise(beyond, start, -bounds, bounds)
    assert solution.lost and solution.status == "stalled"
    assert "cannot be simulated" in solution.message
    assert 0.0 < solution.z[0] < 0.5
    assert sum(z <= 0.0 for z in beyond.calls) == LOST_STEPS
    near = Wall(0.01, 0.0)  # a search that comes to its minimum beside the wall is not lost
    solution = minimise(near, start, -bounds, bounds)
    assert solution.status == "converged" and not solution.lost
    assert solution.z[0] == pytest.approx(0.01, abs=1e-6)


class Cliff:
    """A thousand, half the squared distance to 1 in standard deviations, and a jump just beyond `edge`."""

    def __init__(self, edge, jump):
        self.edge, self.jump, self.calls = edge, jump, []

    def evaluate(self, z):
        self.calls.append(float(z[0]))
        left = z[0] - 1.0
        return QuadraticModel(
            z=z, cost=1e3 + 0.5 * left**2 + self.jump * (z[0] > self.edge), gradient=np.array([left]),
            hessian=np.eye(1), linear=np.zeros(1, dtype=bool),
        )  # fmt: skip


@pytest.mark.parametrize(
    ("edge", "jump", "status"), [(0.6, 0.2, "converged"), (0.2, 0.4, "stalled"), (0.2, 0.0, "converged")]
)
def test_a_search_ends_where_its_cost_jumps_by_more_than_its_slope_gains(edge, jump, status):
    """Once: 20 steps and more, down to what is lost in rounding, and stalled wherever that was."""
    bounds, cliff = np.full(1, np.inf), Cliff(edge, jump)
    solution = minimise(cliff, np.array([edge]), -bounds, bounds, flat=1e-6)
    assert solution.status == status
    assert solution.z[0] == pytest.approx(edge if jump else 1.0)
    assert len(cliff.calls) < 15
    if jump:
        assert f"{1.0 - edge:.1g} standard deviations" in solution.message
