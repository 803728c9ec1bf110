"""Acceptance of a law that compensates dry friction, on logs of a machine that shares nothing with seaopt."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import seaopt as so
from seaopt.control import CompensateFriction, add_compensation, runnable
from seaopt.control.loops.compensation.terms import SOURCES
from seaopt.control.running.law_step import run_law
from seaopt.machine.bringup.excitation import design_excitation
from tests.machine.simulator import Bench, Machine

FRICTION = 40.0
MACHINE = replace(Machine(), coulomb=FRICTION, smoothing=5e-3)
SHARES = 0.5, 0.2  # of what the limits allow
RANGES = {"f_c": (36.0, 44.0), "k": (640e3, 670e3)}


@pytest.fixture(scope="module", params=SOURCES)
def compensated(request, compiler, tmp_path_factory):
    """Return a bench of a law with a compensation of friction, and the law without it."""
    values = so.plants.thor().update(f_c=FRICTION, v_s=5e-3)
    spec = so.ControllerSpec(bandwidth_hz=30, max_sensitivity=1.6, max_noise_gain=45, current_limit_A=9.0)
    bare = so.tune(so.plants.high_impedance(), values, spec)
    law = add_compensation(bare, friction=CompensateFriction(fraction=0.7, source=request.param))
    return Bench(compiler, tmp_path_factory.mktemp(request.param), law), bare


def play(law, share):
    """Return an excitation of six sets of phases, three periods each."""
    options = {"bias": 0.0, "phases": 6, "periods": 3, "limits": {"F1": 600.0}, "seed": 1}
    return design_excitation(law, share=share, **options)


def measure_peaks(bare, log, played):
    """Return Ms and Mt at the lines of a log without noise: of what the law without its terms, run over the log tick by
    tick, commands in the last period of each set of phases.
    """
    linear = runnable(bare)
    command = run_law(linear, log["reference"], log["F1"][:, None], np.zeros((len(log.time), 0)), None, linear.reset())
    period = played.waves.shape[1]

    def average(values):
        lasts = [values[period * (1 + 3 * k + 2) :][:period] for k in range(6)]
        responses = [np.fft.rfft(last)[played.lines] for last in lasts]
        references = [np.fft.rfft(wave)[played.lines] for wave in played.waves]
        return np.mean([a / b for a, b in zip(responses, references, strict=True)], axis=0)

    forward = bare.law.responses(played.frequency_hz)[0]
    sensitivity = average(command) / bare.per_effort / forward
    return np.max(np.abs(sensitivity)), np.max(np.abs(1.0 - sensitivity))


@pytest.mark.parametrize("share", SHARES)
def test_the_loop_of_a_right_machine_is_that_of_the_linear_law_at_every_amplitude(compensated, share):
    bench, bare = compensated
    played = play(bare, share)
    peaks = measure_peaks(bare, bench.log(MACHINE, played.reference, noise=0.0), played)
    values, log = bare.design[1], bench.log(MACHINE, played.reference, noise=0.5)
    result = so.accept(bench.controller, [log], uncertainty=values, ranges=RANGES)
    assert result.met and result.differences.inside and not result.differences.found, result
    rows = {row.name: row for row in result.response.judged}
    for name, peak in zip(("Ms", "Mt"), peaks, strict=True):
        assert rows[name].low <= peak <= rows[name].high, (name, peak, rows[name])
        assert np.isclose(rows[name].value, rows[name].predicted, rtol=0.02)


def test_doubled_friction_is_named_beside_its_compensation(compensated):
    bench, bare = compensated
    machine = replace(MACHINE, coulomb=2.0 * FRICTION)
    log = bench.log(machine, play(bare, SHARES[0]).reference, noise=0.5)
    result = so.accept(bench.controller, [log], uncertainty=bare.design[1], ranges=RANGES)
    first = result.differences.found[0]
    factors = dict(zip((first.name, *first.alike), (first.value, *first.alike_values), strict=True))
    assert not result.met and np.isclose(factors["f_c"], 2.0, rtol=0.1) and first.explains > 0.95, result
