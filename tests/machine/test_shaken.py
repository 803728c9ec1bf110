"""A right machine whose motor noise shakes through its friction, beside its model under noise of its own."""

from __future__ import annotations

import numpy as np
import pytest

import seaopt as so
from seaopt.machine.differences.comparison import Comparison
from seaopt.machine.response.periods import cut_periods, join_blocks, shorten
from seaopt.machine.response.verdicts import measure
from seaopt.machine.ticks import take_ticks
from tests.machine.simulator import Bench, Machine

NOISE = 0.05


@pytest.fixture(scope="module")
def stage(compiler, tmp_path_factory, gentle):
    """Return the first stage, its values and its bench."""
    (first, _), values = gentle
    return first, values, Bench(compiler, tmp_path_factory.mktemp("shaken"), first.controller)


def test_the_std_has_that_of_what_noise_makes_of_the_model(stage):
    """Of means over other draws of the noise: they lie about each other, and about the model, by what is stated."""
    first, values, bench = stage
    log = bench.log(Machine.of_knee(values), first.excitation.reference, noise=NOISE)
    ticks = take_ticks(first.controller, log)
    parts = [
        measure(first.controller, group, by_phases=True)
        for group in join_blocks([cut_periods(first.controller, ticks)])
    ]
    one = Comparison(controller=first.controller, measured=parts, logs=[shorten(ticks)], names=("tau_s",))
    settled = one.settle(values, *one.simulate([values]))
    (model,) = settled.predict([values])
    draws = np.array([one.read(*one.simulate([values], seed)) for seed in range(100, 124)])
    truth, spread = draws.mean(axis=0), np.sqrt(np.var(draws, axis=0, ddof=1) / 4.0)  # of means over four
    assert np.sqrt(np.mean(settled.scatter**2 / spread**2)) == pytest.approx(1.0, abs=0.35)
    assert np.sqrt(np.mean(np.abs(model - truth) ** 2 / settled.scatter**2)) < 2.0
    assert np.allclose(settled.std, np.hypot(one.std, settled.scatter)) and np.max(spread / one.std) > 0.2


@pytest.mark.slow
def test_right_machines_are_off_by_what_is_stated_and_none_is_refused(stage):
    first, values, bench = stage
    misfits = list[float]()
    for seed in range(8):
        log = bench.log(Machine.of_knee(values), first.excitation.reference, noise=NOISE, seed=seed)
        result = so.accept(first.controller, [log])
        assert result.replayed and result.differences.inside and not result.differences.found, result
        misfits.append(result.differences.misfit)
    assert np.sqrt(np.mean(misfits)) == pytest.approx(1.0, abs=0.15), misfits
