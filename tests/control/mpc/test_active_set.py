"""The dual active-set method against qpOASES, HiGHS and the conditions of an optimum, on thousands of programs."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from scipy.optimize import linprog

from seaopt.control import MPCSpec, force_mpc
from seaopt.control.mpc.active_set import INFEASIBLE, SOLVED, UNFINISHED, find_nearest
from seaopt.control.mpc.quadratic_program import factor_program, stack_hessian

AGREES = 1e-8


def other_solver(H, A):
    """Return q, low, high -> the solution by qpOASES; None where it has none."""
    shapes = {"h": ca.Sparsity.dense(*H.shape), "a": ca.Sparsity.dense(*A.shape)}
    solver = ca.conic("other", "qpoases", shapes, {"printLevel": "none", "error_on_fail": False})

    def solve(q, low, high):
        found = solver(h=H, g=q, a=A, lba=low, uba=high)
        return found["x"].full().ravel() if solver.stats()["success"] else None

    return solve


def can_be_kept(A, low, high):
    """Whether a point keeps all rows, by HiGHS."""
    free = [(None, None)] * A.shape[1]
    return linprog(np.zeros(A.shape[1]), np.vstack([A, -A]), np.concatenate([high, -low]), bounds=free).status == 0


def miss_of_optimum(H, A, q, low, high, solution):
    """Return by how much a solution misses the conditions of an optimum: feasible, stationary, multipliers' signs."""
    rows, held = A @ solution.x, solution.sides != 0
    outward = solution.sides[held, None] * A[held]
    gradient = H @ solution.x + q
    multipliers = np.linalg.lstsq(outward.T, -gradient, rcond=None)[0] if held.any() else np.zeros(0)
    ends = np.where(solution.sides > 0, high, low)
    return max(
        np.max(np.maximum(rows - high, low - rows)), np.max(np.abs(rows - ends)[held], initial=0.0),
        np.max(np.abs(gradient + outward.T @ multipliers)), -np.min(multipliers, initial=0.0),
    )  # fmt: skip


def draw_program(rng, kind, n=6, m=16):
    """Return H, A and vectors; "degenerate" ones repeat rows, fix some, and meet in more corners than dimensions."""
    root = rng.normal(size=(n, n))
    H = root @ root.T + 0.1 * np.eye(n)
    A = rng.normal(size=(m, n))
    middle = A @ rng.normal(size=n)
    low, high = middle - rng.uniform(0, 1, m), middle + rng.uniform(0, 1, m)
    if kind == "degenerate":
        A = rng.integers(-1, 2, (m, n)).astype(float)
        A[~A.any(axis=1), 0] = 1.0
        A[m // 2 :] = A[: m - m // 2]
        corner = rng.integers(-1, 2, n).astype(float)
        low, high = A @ corner - rng.integers(0, 2, m), A @ corner + rng.integers(0, 2, m)
    if kind == "contradictory":
        low, high = low + rng.normal(size=m), high + rng.normal(size=m)
        low, high = np.minimum(low, high), np.maximum(low, high)
    return H, A, rng.normal(size=n) * rng.choice([1.0, 30.0]), low, high


@pytest.mark.parametrize("kind", ["general", "degenerate", "contradictory"])
@pytest.mark.parametrize("programs", [60, pytest.param(400, marks=pytest.mark.slow)])
def test_random_programs(kind, programs):
    rng = np.random.default_rng(1)
    contradictory = 0
    for _ in range(programs):
        H, A, q, low, high = draw_program(rng, kind)
        solution = factor_program(H, A).solve(q, low, high, np.zeros(len(A), dtype=int), 500)
        if solution.status == INFEASIBLE:
            assert not can_be_kept(A, low, high)
            contradictory += 1
            continue
        assert solution.status == SOLVED
        assert miss_of_optimum(H, A, q, low, high, solution) < AGREES * (1.0 + np.max(np.abs(q)))
        assert solution.x == pytest.approx(other_solver(H, A)(q, low, high), abs=AGREES, rel=AGREES)
    assert (contradictory > programs / 3) == (kind == "contradictory")


@pytest.fixture(scope="module")
def mpc(stand, thor):
    bounds = {"qd": (-0.05, 0.05), "F1": (-1800.0, 1800.0)}
    return force_mpc(stand, thor, MPCSpec(current_limit_A=9.0, current_slew_A_per_s=2000.0, bounds=bounds))


def draw_vectors(mpc, rng, most_A=9.0):
    """Return gradient and bounds of a plan from a random state: deflections and speeds far beyond the bounds too."""
    xi = np.array([rng.uniform(-6e-3, 6e-3), rng.uniform(-0.2, 0.2)])
    u_s, last, drift = rng.uniform(-9, 9), rng.uniform(-most_A, most_A), rng.uniform(-1, 1)
    return mpc.program(xi, u_s, last, drift, np.array([mpc.static_gain * (u_s + drift)]), mpc.command_limit)


@pytest.mark.parametrize("samples", [100, pytest.param(1000, marks=pytest.mark.slow)])
def test_plans_from_random_states_each_from_what_the_last_one_held(mpc, samples):
    """Commands beyond their limit too, after which no plan within the slew limit keeps it."""
    H, A, rng = stack_hessian(mpc.prediction), mpc.prediction.rows, np.random.default_rng(2)
    other, sides, contradictory = other_solver(H, A), np.zeros(len(A), dtype=int), 0
    for _ in range(samples):
        q, low, high = draw_vectors(mpc, rng, most_A=11.5)
        solution = mpc.solver.solve(q, low, high, sides, mpc.spec.max_iterations)
        sides = solution.sides
        if solution.status == INFEASIBLE:
            assert not can_be_kept(A, low, high)
            contradictory += 1
            continue
        assert solution.status == SOLVED and miss_of_optimum(H, A, q, low, high, solution) < AGREES
        assert solution.x == pytest.approx(other(q, low, high), abs=AGREES)
    assert 0 < contradictory < samples / 10


def test_what_is_held_at_the_start_changes_nothing_but_the_count(mpc):
    rng = np.random.default_rng(3)
    none = np.zeros(len(mpc.prediction.rows), dtype=int)
    for _ in range(30):
        vectors = draw_vectors(mpc, rng)
        cold = mpc.solver.solve(*vectors, none, 100)
        again = mpc.solver.solve(*vectors, cold.sides, 100)
        assert again.iterations == 0 and again.x == pytest.approx(cold.x, abs=1e-12)


def test_iterations_that_do_not_suffice_are_continued_by_the_next_program(mpc):
    """One row can be taken in with one more than there are variables, whatever has to be let go for it."""
    rng, none = np.random.default_rng(4), np.zeros(len(mpc.prediction.rows), dtype=int)
    each, longer = mpc.prediction.rows.shape[1] + 1, 0
    for _ in range(30):
        vectors, sides, status = draw_vectors(mpc, rng), none, UNFINISHED
        whole = mpc.solver.solve(*vectors, none, 100)
        longer += whole.iterations > each
        for _ in range(whole.iterations):
            part = mpc.solver.solve(*vectors, sides, each)
            sides, status = part.sides, part.status
            assert part.iterations <= each
            if status == SOLVED:
                break
        assert status == SOLVED and part.x == pytest.approx(whole.x, abs=1e-10)
    assert longer > 5


def test_a_plan_without_a_limit_in_its_way_is_one_product(mpc):
    q, low, high = draw_vectors(mpc, np.random.default_rng(5))
    far = replace(mpc.solver, scale=1e6 * mpc.solver.scale)
    solution = far.solve(q, np.minimum(low, -1e-3), np.maximum(high, 1e-3), np.zeros(low.size, dtype=int), 0)
    assert solution.status == SOLVED and solution.iterations == 0
    assert solution.x == pytest.approx(-np.linalg.solve(stack_hessian(mpc.prediction), q), rel=1e-10)


def test_the_nearest_point_of_a_box():
    high = np.array([2.0, 2.0])
    nearest = find_nearest(np.array([3.0, 1.0]), np.eye(2), -high, high, np.zeros(2, int), max_iterations=10)
    assert (nearest.x.tolist(), nearest.sides.tolist(), nearest.status) == ([2.0, 1.0], [1, 0], SOLVED)
