"""Normal equations of many segments: blocks eliminated one by one, against NumPy's own inverse of the whole."""

from __future__ import annotations

import numpy as np
import pytest

import seaopt as so
from seaopt.estimation.problem import normal_equations
from seaopt.estimation.problem.normal_equations import (
    eliminate,
    find_arrow,
    invert,
    measure_decrement,
    solve_seen,
)


def make_arrow(rng, shared=4, sizes=(2,) * 60 + (3,) * 20, order=True):
    """Return J'J of segments whose unknowns meet the shared ones alone, with the unknowns in any order."""
    n = shared + sum(sizes)
    rows, first = [], shared
    for size in sizes:
        j = np.zeros((12, n))
        j[:, :shared] = rng.normal(size=(12, shared)) * 10.0 ** np.arange(shared)
        j[:, first : first + size] = rng.normal(size=(12, size))
        rows.append(j)
        first += size
    mixed = rng.permutation(n)
    j = np.concatenate(rows)[:, mixed]
    return j.T @ j, mixed


def test_the_shape_of_an_arrow_is_found():
    matrix, mixed = make_arrow(np.random.default_rng(1))
    shape = find_arrow(matrix)
    assert sorted(mixed[shape.shaft]) == [0, 1, 2, 3]
    assert [rows.shape for rows in shape.blocks] == [(60, 2), (20, 3)]
    full = np.random.default_rng(2).normal(size=(150, 150))
    assert find_arrow(full @ full.T) is None
    assert find_arrow(matrix[:50, :50]) is None


def test_an_arrow_is_solved_as_numpy_solves_the_whole():
    rng = np.random.default_rng(3)
    matrix, _ = make_arrow(rng)
    right = rng.normal(size=(len(matrix), 2))
    np.testing.assert_allclose(solve_seen(matrix, right, 1e-13), np.linalg.solve(matrix, right), rtol=1e-6)
    np.testing.assert_allclose(solve_seen(matrix, right[:, 0], 1e-13), np.linalg.solve(matrix, right[:, 0]), rtol=1e-6)
    inverse, unseen = invert(matrix)
    exact = np.linalg.inv(matrix)
    size = np.sqrt(np.outer(np.diag(exact), np.diag(exact)))
    assert np.max(np.abs(inverse - exact) / size) < 1e-8 and np.max(unseen) < 1e-9
    assert measure_decrement(matrix, right[:, 0], 1e-12) == pytest.approx(right[:, 0] @ exact @ right[:, 0])
    reduced = matrix[:5, :5] - matrix[:5, 5:] @ np.linalg.solve(matrix[5:, 5:], matrix[5:, :5])
    np.testing.assert_allclose(eliminate(matrix, 5), reduced, atol=1e-8 * np.max(np.abs(reduced)))


@pytest.mark.parametrize("lost", [0, 10])
def test_what_an_arrow_does_not_show_is_named(lost):
    """Two unknowns that enter only as their sum: of the shaft, or of one block. The rest is as if one were known."""
    rng = np.random.default_rng(4)
    sizes = (2,) * 60
    j = np.zeros((1200, 4 + sum(sizes)))
    for k in range(60):
        rows = slice(20 * k, 20 * k + 20)
        j[rows, :4] = rng.normal(size=(20, 4))
        j[rows, 4 + 2 * k : 6 + 2 * k] = rng.normal(size=(20, 2))
    j[:, lost + 1] = j[:, lost]
    inverse, unseen = invert(j.T @ j)
    np.testing.assert_allclose(unseen[[lost, lost + 1]], 0.5, atol=1e-6)
    others = np.delete(np.arange(j.shape[1]), [lost, lost + 1])
    assert np.max(unseen[others]) < 1e-9
    known = np.delete(j, lost + 1, axis=1)
    exact = np.linalg.inv(known.T @ known)
    kept = np.delete(np.arange(len(exact)), lost)
    np.testing.assert_allclose(inverse[np.ix_(others, others)], exact[np.ix_(kept, kept)], atol=1e-9)


@pytest.mark.parametrize("f_c", [0.0, pytest.param(20.0, marks=pytest.mark.slow)])
def test_a_fit_of_many_segments_is_that_of_the_whole_matrix(f_c, monkeypatch):
    """A linear plant's initial states follow the other unknowns, a nonlinear one's are searched for with them."""
    rng = np.random.default_rng(5)
    truth = so.plants.thor().update(f_c=f_c)
    plant, time = so.plants.high_impedance(), np.arange(500) / 400
    current = 3.0 * rng.normal(size=time.size)
    force = so.simulate(plant, truth, so.Log.from_arrays(time=time, I=current))["F1"]
    gaps = time + 0.01 * (np.arange(time.size) // 20)  # 25 segments
    log = so.Log.from_arrays(time=gaps, I=current, F1=force + rng.normal(size=time.size))

    def fit():
        experiment = so.Experiment(plant=plant, log=log, outputs=("F1",))
        return so.fit([experiment], truth.update(J=2.5e-6, b_r=2e-4).free("J", "b_r"), diagnostics=False)

    monkeypatch.setattr(normal_equations, "FEWEST", 20)
    blocks = fit()
    monkeypatch.setattr(normal_equations, "FEWEST", 10**9)
    whole = fit()
    for name in ("J", "b_r"):
        one, other = blocks.parameters[name], whole.parameters[name]
        assert one.value == pytest.approx(other.value, abs=1e-3 * other.std)
        assert one.std == pytest.approx(other.std, rel=1e-6)
        assert abs(one.value - truth[name].value) < 4.0 * one.std
    assert blocks.status == whole.status == "converged"
