"""A law that compensates friction by its reference, under references as small as the friction: what logs can tell."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import seaopt as so
from seaopt.control import CompensateFriction, add_compensation
from seaopt.machine.bringup.excitation import design_excitation
from seaopt.machine.bringup.expected import Expected, expect
from seaopt.machine.bringup.page import say_prediction
from seaopt.machine.page.verdict import judge
from seaopt.reporting.sections.data import Commands
from tests.machine.simulator import Bench, Machine, multisine

WRIST = {
    "N": 44, "K_tau": 0.0168, "J_m": 1.1e-6, "b_r": 1.6e-5, "f_c": 0.0042, "v_s": 1.0, "k_s": 12.3, "c_s": 0.0
}  # fmt: skip
SPEC = so.ControllerSpec(
    bandwidth_hz=5, measured="tau_s", max_sensitivity=2.0, max_complementary=1.6, max_noise_gain=60,
    current_limit_A=2.8, bandwidth_range_hz=(5.0, 60.0),
)  # fmt: skip
PLANT = so.plants.rotary(link="locked")
NOISE, SEEDS = 0.012, 8  # N m; whose mean is the truth
SMALL, LARGE = 0.05, 0.4  # of the current's limit


@pytest.fixture(scope="module")
def wrist(compiler, tmp_path_factory):
    """Return the bench of a wrist's law, its machine, and the references of its amplitudes."""
    values = PLANT.complete(so.ParameterSet()).update(**WRIST)
    law = add_compensation(so.tune(PLANT, values, SPEC), friction=CompensateFriction(fraction=0.8, source="reference"))
    options = {"bias": 0.0, "phases": 6, "periods": 3, "limits": {}, "seed": 1}
    played = {share: design_excitation(law, share=share, **options) for share in (SMALL, LARGE)}
    return Bench(compiler, tmp_path_factory.mktemp("wrist"), law), Machine.of_knee(values), played


def measure_sensitivity(bench, machine, played):
    """Return the largest |S| of a machine at the lines: of C_r R - C_y Y over C_r R, as sums over the last periods of
    all sets of phases of several logs, with numpy alone: the noise is part of what moves the motor.
    """
    period, (forward, feedback) = played.waves.shape[1], bench.controller.law.responses(played.frequency_hz)
    last, parts = [period * (1 + played.periods) + period * (played.periods * k - 1) for k in range(6)], []
    for seed in range(SEEDS):
        log = bench.log(machine, played.reference, noise=NOISE, seed=100 + seed)
        reference, torque = (
            np.array([np.fft.rfft(log[name][at : at + period])[played.lines] for at in last])
            for name in ("reference", "tau_s")
        )
        parts.append(np.mean((forward * reference + feedback * torque) / (forward * reference), axis=0))
    return float(np.max(np.abs(np.mean(parts, axis=0))))


def accept(wrist, machine, share):
    bench, _, played = wrist
    result = so.accept(bench.controller, [bench.log(machine, played[share].reference, noise=NOISE)])
    return result, {row.name: row for row in result.response.judged}


def test_a_limit_that_the_right_machine_breaks_under_what_was_played_is_not_refuted(wrist):
    bench, machine, played = wrist
    truth = {share: measure_sensitivity(bench, machine, each) for share, each in played.items()}
    result, rows = accept(wrist, machine, SMALL)
    limit = rows["Ms"].limit
    assert truth[LARGE] < limit < truth[SMALL]  # by the simulator: the same machine, at two amplitudes
    assert not any(row.outcome == "refuted" for row in rows.values()), rows
    assert rows["Ms"].outcome == "undecided" and rows["Ms"].certified == pytest.approx(truth[SMALL], rel=0.1)
    assert result.differences.inside and not result.met
    (reason,) = (each.what for each in judge(result, Commands()).reasons)
    assert "Ms: machines within the uncertainty that was given themselves break the limit as judged, 2.1" in reason
    assert "record a larger amplitude" in reason and "periods" not in reason.replace("periods in", "")
    stored = {row["name"]: row for row in result.to_dict()["response"]["figures"]}
    assert stored["Ms"]["certified"] == rows["Ms"].certified


@pytest.fixture(scope="module")
def quick(compiler, tmp_path_factory):
    """Return the bench of a faster law of the same wrist."""
    values = PLANT.complete(so.ParameterSet()).update(**WRIST)
    law = so.tune(PLANT, values, replace(SPEC, bandwidth_hz=20))
    law = add_compensation(law, friction=CompensateFriction(fraction=0.8, source="reference"))
    return Bench(compiler, tmp_path_factory.mktemp("quick"), law)


def play_half_at_the_limit(bench, machine):
    """Return the acceptance of one set of phases, the first half of it at an amplitude at which all periods have the
    command at its limit, and the share of the ticks that do.
    """
    lines = np.unique(np.round(np.geomspace(1, 45, 24)).astype(int))
    loud = multisine(1000, lines, 7, 1.29, 3)
    log = bench.log(machine, np.concatenate([loud, 0.457 * loud]), noise=NOISE, decimals=3)
    at_limit = np.abs(log["I"]).reshape(14, -1).max(axis=1) > 2.8 - 1e-4
    assert np.all(at_limit[:7]) and not np.all(at_limit[7:])
    return so.accept(bench.controller, [log])


def test_of_one_set_of_phases_half_at_the_limit_no_cause_is_named_on_a_right_machine(quick, wrist):
    result = play_half_at_the_limit(quick, wrist[1])
    differences, text = result.differences, " ".join(repr(result).split())
    assert differences.untold == "phases" and not differences.found and not result.met, differences
    reasons = [each.what for each in judge(result, Commands()).reasons]
    assert any("record 6 sets of random phases, with the command below its limit" in each for each in reasons)
    assert "it is undecided whether the machine is" in text and "times its value" not in text
    assert result.to_dict()["differences"]["untold"] == "phases"


def test_of_six_sets_of_phases_below_the_limit_the_same_machine_is_the_right_one(quick, wrist):
    lines = np.unique(np.round(np.geomspace(1, 45, 24)).astype(int))
    reference = np.concatenate([0.457 * multisine(1000, lines, 4, 1.29, seed) for seed in range(6)])
    result = so.accept(quick.controller, [quick.log(wrist[1], reference, noise=NOISE, decimals=3)])
    assert result.differences.inside and result.differences.untold == "", result


@pytest.mark.slow
@pytest.mark.parametrize("change", [{"per_ampere": 1.4}, {"delay_s": 3e-3}])
@pytest.mark.parametrize("share", [SMALL, LARGE])
def test_another_machine_is_refused_at_either_amplitude(wrist, change, share):
    """Where it is at the limit of stability, the command is at its limit in every period, and no response is had."""
    bench, machine, played = wrist
    wrong = replace(
        machine,
        **{name: value * (machine.per_ampere if name == "per_ampere" else 1.0) for name, value in change.items()},
    )
    result = so.accept(bench.controller, [bench.log(wrong, played[share].reference, noise=NOISE)])
    assert not result.met
    if result.response is None:
        assert share == LARGE and "near its limit of stability or beyond" in " ".join(str(result).split())
        return
    refuted = any(row.outcome == "refuted" for row in result.response.judged)
    assert refuted or (not result.differences.inside and result.differences.found), result


@pytest.mark.parametrize("most", [0.5, SMALL])
def test_a_stage_is_played_at_an_amplitude_at_which_the_machine_keeps_its_limits_or_says_which_would(wrist, most):
    bench, machine, played = wrist
    options = {"share": SMALL, "most": most, "bias": 0.0, "limits": {}, "seed": 1}
    fields = expect(bench.controller, [], options | {"sensors": so.Sensors(noise_std={"tau_s": NOISE})})
    stage, limit = Expected(**fields), 2.1
    truth = measure_sensitivity(bench, machine, stage.excitation)
    (*_, said) = say_prediction(stage)
    if most > SMALL:
        assert not stage.broken and truth < limit and stage.excitation.amplitude > played[SMALL].amplitude
        assert "Ms" in said and "2.1 allowed" in said
    else:
        assert "Ms" in stage.broken and truth > limit and f"--share {stage.enough:.2g}" in said
        options = {"bias": 0.0, "phases": 6, "periods": 3, "limits": {}, "seed": 1}
        larger = design_excitation(bench.controller, share=stage.enough, **options)
        assert measure_sensitivity(bench, machine, larger) < limit


def test_a_stage_that_is_lowered_for_the_peak_of_its_command_says_that_this_limit_stands_in_the_way(
    wrist, compiler, tmp_path
):
    """It said that no amplitude avoids it, though one does on the same machine with a larger limit."""
    bench, machine, _ = wrist
    law = replace(bench.controller, spec=replace(bench.controller.spec, current_limit_A=0.6))
    options = {"share": 0.1, "most": 0.95, "bias": 0.0, "limits": {}, "seed": 1}
    stage = Expected(**expect(law, [], options | {"sensors": so.Sensors(noise_std={"tau_s": NOISE})}))
    assert stage.lowered and "Ms" in stage.broken and measure_sensitivity(bench, machine, stage.excitation) > 2.1
    larger = design_excitation(law, share=stage.enough, bias=0.0, phases=6, periods=3, limits={}, seed=1)
    assert measure_sensitivity(bench, machine, larger) < 2.1
    limited, played = Bench(compiler, tmp_path, law), stage.excitation
    log = limited.log(machine, larger.reference, noise=NOISE)
    assert np.max(np.abs(log["I"])) > 0.95 * 0.6
    logs = [limited.log(machine, played.reference, noise=NOISE, seed=seed) for seed in range(6)]
    assert 0.8 < max(np.max(np.abs(each["tau_s"])) for each in logs) / played.peaks["tau_s"] <= 1.0
    said = say_prediction(stage)[-1]
    assert f"At a share of {stage.enough:.2g}" in said and "the limit of the command stands in the way" in said
