"""Samples that take different numbers of steps: compiled, by CasADi's interpreter, in parts, and sample by sample."""

from dataclasses import replace

import numpy as np
import pytest

from seaopt.simulation import Weights, run_passes
from seaopt.simulation.compiled import Program
from seaopt.simulation.interpreted import interpret_pass
from tests.simulation.test_parts import SAMPLES, X0, assert_same, make_program

MOST = 6


@pytest.fixture(scope="module")
def shared():
    """Return model, segment with a share of each sample, and point, whose delay is free and splits each period."""
    program, point = make_program(3000.0)
    shares = np.random.default_rng(1).integers(1, MOST + 1, (2, SAMPLES)) / MOST
    return program.model, replace(program.segment, shares=shares), replace(point, substeps=MOST, stable=3)


def test_every_sample_takes_its_share(shared):
    _, segment, point = shared
    asked, stable = np.rint(MOST * segment.shares)
    steps = np.maximum(asked, np.ceil(stable / 2.0))
    assert np.array_equal(point.count_steps(segment), steps)
    assert np.array_equal(replace(point, halved=True).count_steps(segment), 2 * steps)
    assert np.array_equal(replace(point, substeps=1, stable=1).count_steps(segment), np.ones(SAMPLES))


def test_compiled_interpreted_and_in_parts(shared):
    model, segment, point = shared
    program = Program.make(model, segment, point, Weights.plain(1))
    whole = program.run(0, SAMPLES, X0, outputs=True, columns=True)
    interpreted = interpret_pass(model, segment, point, Weights.plain(1), SAMPLES, X0)
    assert_same(whole, interpreted, 1e-9)
    program = Program.make(model, segment, point, Weights.plain(1), in_lanes=True)
    assert_same(program.run_parts(X0, 1500, output_rows=SAMPLES, columns=True)[0], whole, 1e-11)


@pytest.mark.parametrize("halved", [False, True])
def test_a_sample_is_stepped_as_with_its_number_in_all_samples(shared, halved):
    model, segment, point = shared
    few = 30
    point, segment = replace(point, halved=halved), replace(segment, start_s=0.0)
    states = run_passes(model, segment, point, X0, stop=few + 1, sums=False, states=True).states
    for k in range(few):
        count = int(point.count_steps(segment)[k])
        moved = tuple(channel[max(k - 1, 0) :] for channel in segment.u)  # with the sample before, which still acts
        alone = replace(segment, u=moved, lead=min(k, 1), y=(), keep=(), shares=None)
        alike = replace(point, substeps=count, stable=1, halved=False)
        after = run_passes(model, alone, alike, states[k], stop=2, sums=False, states=True).states[1]
        assert after == pytest.approx(states[k + 1], rel=1e-12, abs=1e-15)


def test_changes_by_steps_of_half_the_length(shared):
    model, segment, point = shared
    few = 200
    found = run_passes(model, segment, point, X0, stop=few, sums=False, states=True, changes=True)
    interpreted = interpret_pass(model, segment, point, Weights.plain(1), few, X0, changes=True)
    size = np.max(np.abs(found.states), axis=0)
    assert np.allclose(found.changes / size, interpreted.changes / size, rtol=1e-6, atol=1e-13)
    assert np.max(np.abs(found.changes) / size) > 1e-8
    # From the first state a pass of halved steps goes on as the change says.
    halved = run_passes(model, segment, replace(point, halved=True), X0, stop=2, sums=False, states=True)
    assert found.states[1] + found.changes[0] == pytest.approx(halved.states[1], rel=1e-12)
