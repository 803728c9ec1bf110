"""Acceptance of a law that compensates dry friction, on logs of a machine that shares nothing with seaopt."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import seaopt as so
from seaopt.control import (
    CompensateFriction,
    CompensateGravity,
    LinkFeedforward,
    SampledLoop,
    add_compensation,
    compensate_schedule,
    run_loop,
    runnable,
    tune_schedule,
)
from seaopt.control.loops.compensation.terms import SOURCES
from seaopt.control.running.law_step import run_law
from seaopt.machine.bringup.excitation import design_excitation
from seaopt.machine.response.periods import cut_periods
from seaopt.machine.ticks import take_ticks
from tests.machine.simulator import Bench, Machine, multisine

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


def test_a_schedule_is_measured_without_its_terms_where_it_stood(compiler, tmp_path):
    values = so.plants.thor().update(f_c=FRICTION, v_s=5e-3)
    spec = so.ControllerSpec(bandwidth_hz=30, max_sensitivity=1.6, max_noise_gain=45, current_limit_A=9.0)
    schedule = tune_schedule(so.plants.high_impedance(), values, spec, "k", [5e5, 8e5])
    schedule = compensate_schedule(schedule, friction=CompensateFriction(fraction=0.7))
    place = MACHINE.stiffness
    reference = play(schedule.at(place), SHARES[1]).reference
    log = Bench(compiler, tmp_path, schedule).log(MACHINE, reference, noise=0.5, places=np.full(reference.size, place))
    result = so.accept(schedule, [log], uncertainty=values, ranges=RANGES)
    assert result.met and result.differences.inside and not result.differences.found, result


@pytest.mark.parametrize("fed", [None, LinkFeedforward()])
def test_what_the_linear_part_makes_is_the_command_less_every_term(fed):
    """Of friction from the speed and of a link's weight, with the link fed forward, on a link that moves."""
    swing, values = so.plants.moving_output(), so.plants.thor().update(d=2.0, f_c=FRICTION, v_s=5e-3)
    spec = so.ControllerSpec(
        bandwidth_hz=20, max_sensitivity=1.6, max_noise_gain=45, current_limit_A=9.0, link_feedforward=fed
    )
    law = so.tune(swing if fed else so.plants.high_impedance(), values, spec)
    friction, gravity = CompensateFriction(fraction=0.7, source="speed"), CompensateGravity(fraction=0.9)
    law = add_compensation(law, friction=friction, gravity=gravity, link=(swing, values))
    lines = np.unique(np.round(np.geomspace(2, 120, 25)).astype(int))
    reference = multisine(1000, lines, 16, 20.0, 3)  # the link comes to rest in its swing
    loop = SampledLoop(plant=swing, law=runnable(law), measured=law.signals, delay_samples=1)
    run = run_loop(loop, [swing.complete(values).drop_conditions()], reference)
    columns = {name: run.outputs[name][0][:-1] for name in {*law.signals, *law.further}}
    log = so.Log.from_arrays(
        time=1e-3 * np.arange(reference.size - 1), reference=reference[:-1], I=run.current[0][1:], **columns
    )  # the command of a row is put out in the next one
    ticks, memory, terms = take_ticks(law, log), (0.0, 0.0), list[tuple[float, float]]()
    for asked, readings in zip(ticks.reference, ticks.further[:, : len(law.compensation.reads)].tolist(), strict=True):
        shaped, added, memory = law.compensation.step(memory, asked, readings)
        terms.append((shaped - asked, added))
    weight, rubs = law.per_effort * np.transpose(terms)
    whole = cut_periods(law, ticks)
    responses = law.law.responses(whole.f)
    less = cut_periods(law, replace(ticks, command=ticks.command - rubs)).effort
    less -= responses[0] * cut_periods(law, replace(ticks, command=weight)).effort
    made = whole.make_efforts(responses)
    off, terms_are = np.abs(made - less)[-1] / np.abs(less)[-1], np.abs(whole.effort - less)[-1] / np.abs(less)[-1]
    assert np.max(off) < 1e-4 and np.max(terms_are) > 0.1
