"""The stages of a bring-up: what is played stays within its limits, its C is the table, its logs are accepted."""

from __future__ import annotations

import json
import subprocess
from dataclasses import replace

import numpy as np
import pytest

import seaopt as so
from seaopt.formatting import format_number
from seaopt.machine.bringup.excitation import design_excitation
from seaopt.machine.bringup.files import write_bring_up
from seaopt.robustness import Requirement
from seaopt.robustness.certificate.requirement import DrawnAt
from tests.machine.simulator import Bench, Machine

SHARE = 0.4
MAIN = r"""#include <stdio.h>
#include "reference.h"
int main(void)
{
    unsigned long k;
    for (k = 0; k <= STAGE_TICKS; k++) printf("%.17g\n", stage_reference(k));
    return 0;
}
"""


@pytest.fixture(scope="module")
def plan(controller):
    return so.bring_up(
        controller,
        {"stand": so.plants.high_impedance()},
        so.plants.thor(),
        samples=20,
        share=SHARE,
        limits={"F1": 900.0},
    )


def test_the_stages_lead_up_to_the_full_law_and_each_is_certified(plan, controller):
    assert [stage.controller.spec.bandwidth_hz for stage in plan.stages] == [7.5, 15.0, 30.0]
    assert plan.met and plan.stages[-1].controller is controller
    assert all(stage.certificate.controller is stage.controller for stage in plan.stages)


def test_a_stage_whose_law_is_not_certified_says_on_what(plan):
    first, *others = plan.stages
    rows = [replace(row, met=row.name != "max_sensitivity") for row in first.requirements]
    lost = DrawnAt(number="2", parameters={"f_c": 60.0}, seed=3)
    words = {"plant": "stand", "scenario": "small step", "draw": lost, "text": "512 steps leave an error of 0.1"}
    rows += [Requirement(name="simulation_failures", limit=0.0, value=1.0, met=False, cause="not simulated", **words)]
    failed = replace(first, requirements=tuple(rows))
    text = " ".join(repr(replace(plan, stages=(failed, *others))).split())
    assert text.startswith("not met") and "stage_1: the certificate of its law failed, on max_sensitivity " in text
    assert "on simulation_failures 1, limit ≤ 0 (a scenario could not be simulated" in text
    assert "stand, small step, draw 2, seed 3 at f_c = 60: 512 steps leave an error of 0.1" in text
    assert "sticks = true of the plant" in text  # the remedy


def test_stages_before_the_last_leave_out_the_sweeps_of_which_nothing_is_required(plan):
    stage = plan.stages[0]
    assert not stage.certificate.simulated.large_signal and plan.stages[-1].certificate.simulated.large_signal
    swept = so.certify(stage.controller, {"stand": so.plants.high_impedance()}, so.plants.thor(), samples=20)
    assert swept.simulated.large_signal and swept.requirements == stage.certificate.requirements


def test_what_is_played_stays_within_its_share_of_current_and_force(plan, compiler, tmp_path):
    for stage in plan.stages:
        bench = Bench(compiler, tmp_path, stage.controller, stage.name)
        log = bench.log(Machine(), stage.excitation.reference, noise=0.0)
        settled = log.between(2.0 * stage.excitation.waves.shape[1] * 1e-3, log.time[-1])
        for name, limit in (("I", 9.0), ("F1", 900.0)):
            peak = np.max(np.abs(settled[name]))
            share = SHARE * stage.controller.spec.bandwidth_hz / 30.0
            assert peak <= 1.02 * share * limit and np.isclose(peak, stage.excitation.peaks[name], rtol=0.05)
            assert np.max(np.abs(log[name])) < stage.stop[name]


def test_the_log_of_each_stage_is_accepted_and_that_of_another_stage_is_not(plan, compiler, tmp_path):
    first, second, _ = plan.stages
    bench = Bench(compiler, tmp_path, first.controller)
    log = bench.log(Machine(), first.excitation.reference)
    assert so.accept(first.controller, [log]).met
    other = so.accept(second.controller, [log], others={"stage_1/controller.json": first.controller})
    assert not other.met and other.replays[0].causes[0].what == "stage_1/controller.json"


def test_a_step_of_the_machine_lies_in_the_band(plan, compiler, tmp_path):
    stage = plan.stages[0]
    size = 0.99 * stage.step_size
    log = Bench(compiler, tmp_path, stage.controller).log(Machine(), np.full(len(stage.step.at), size), noise=0.0)
    assert np.allclose(log["F1"] / size, stage.step.nominal, atol=2e-3)
    assert np.isclose(np.max(np.abs(log["I"])), 0.99 * 9.0, rtol=1e-6)


def test_the_files_are_there_and_the_c_of_the_reference_is_the_table(plan, compiler, tmp_path):
    files = write_bring_up(plan, tmp_path)
    assert json.loads((tmp_path / "bringup.json").read_text())["schema"] == "seaopt/bringup/2"
    folder = tmp_path / "stage_1"
    assert {"force_law.c", "reference.csv", "reference.c", "expected_step.csv"} <= {path.name for path in files}
    (folder / "main.c").write_text(MAIN)
    flags = ["-Wall", "-Wextra", "-Werror", "-std=c99", "-pedantic"]
    subprocess.run([*compiler, *flags, "main.c", "reference.c", "-o", "play"], cwd=folder, check=True)
    played = subprocess.run([str(folder / "play")], capture_output=True, text=True, check=True).stdout
    table = so.read_log(folder / "reference.csv")["reference"]
    played = np.array(played.split(), dtype=float)
    assert played[-1] == 0.0 and np.allclose(played[:-1], table, atol=1e-6 * np.max(np.abs(table)))


@pytest.mark.parametrize("fit_met", [True, False, None])
def test_the_files_state_whether_the_fit_is_met(plan, tmp_path, fit_met):
    write_bring_up(plan, tmp_path, fit_met=fit_met)
    content = json.loads((tmp_path / "bringup.json").read_text())
    assert content.get("fit_met") is fit_met and content["met"] is (fit_met is not False)
    assert json.loads((tmp_path / "full" / "controller.json").read_text()).get("fit_met") is fit_met


def test_where_no_slower_law_is_certified_it_is_the_same_with_less_effort(controller, plan):
    def refuse(fraction):
        raise so.SeaoptError("none")

    kept, options = [], {"samples": 5, "large_signals": False}
    lowered = so.bring_up(
        controller,
        {"stand": so.plants.high_impedance()},
        so.plants.thor(),
        fractions=(0.25,),
        certificate=plan.stages[-1].certificate,
        tune_stage=refuse,
        keep_stage=lambda stage: kept.append(stage.name),
        certify_stage=lambda law: so.certify(law, {"stand": so.plants.high_impedance()}, so.plants.thor(), **options),
    )
    stage = lowered.stages[0]
    assert kept == [each.name for each in lowered.stages]
    assert stage.controller.command_limit == 2.25 and "effort" in stage.note
    assert np.array_equal(stage.controller.law.a, controller.law.a)


@pytest.fixture(scope="module")
def rubbing():
    """Return a knee with 6 N m of dry friction, of 23 N m that its motor makes, with its law and a certificate."""
    plant = so.plants.rotary(link="locked")
    stated = {"N": 100, "K_tau": 0.0369, "eta": 0.7, "J_m": 2.4e-5, "b_r": 1e-4, "f_c": 0.06, "v_s": 1.0, "k_s": 300.0}
    values = plant.complete(so.ParameterSet()).update(**stated)
    spec = so.ControllerSpec(
        bandwidth_hz=20, structure="pid_dob", measured="tau_s", max_sensitivity=1.6, max_noise_gain=45,
        current_limit_A=9.0,
    )  # fmt: skip
    law = so.tune(plant, values, spec)
    return plant, values, law, so.certify(law, {"knee": plant}, values, samples=5, simulations=False)


def plan_first(rubbing, share):
    """Return the bring-up whose first stage is the law with a quarter of its effort, or what its friction takes."""
    plant, values, law, certificate = rubbing

    def refuse(fraction):
        raise so.SeaoptError("none")

    options = {"certificate": certificate, "tune_stage": refuse, "certify_stage": lambda _: certificate}
    return so.bring_up(
        law, {"knee": plant}, values, samples=5, share=share, fractions=(0.25,), limits={"tau_s": 20.0}, **options
    )


def test_what_the_fade_to_a_bias_takes_does_not_count_as_motion(compiler, tmp_path, rubbing):
    """The motor moves on the way to a bias of 11 N m, and stays there: its friction is 6, the periods swing by 4.6."""
    _, values, law, _ = rubbing
    excitation = design_excitation(
        law, share=0.6, bias=11.0, limits={"tau_s": 20.0}, seed=1, phases=6, periods=4
    )  # fmt: skip
    log = Bench(compiler, tmp_path, law).log(Machine.of_knee(values), excitation.reference, noise=0.01)
    response = so.accept(law, [log]).response
    whole, period = 100 * 0.0369 * 0.7 * log["I"], excitation.waves.shape[1]
    assert np.ptp(whole) / 2.0 > 6.0 > np.ptp(whole[period:-period]) / 2.0
    assert response.still and response.effort == pytest.approx(np.ptp(whole[period:-period]) / 2.0, rel=0.1)


@pytest.mark.parametrize(("share", "moves"), [(0.5, True), (0.2, False)])
def test_a_stage_moves_the_motor_against_its_friction_or_says_that_it_does_not(
    compiler, tmp_path, rubbing, share, moves
):
    """What is said is what the stage's own C does on a machine with the same friction."""
    plan = plan_first(rubbing, share)
    stage = plan.stages[0]
    assert stage.still is not moves and stage.friction == pytest.approx(100 * 0.06)
    content = plan.to_dict()["stages"][0]["friction"]
    assert content["moves"] is moves and content["effort"] == pytest.approx(stage.effort)
    text = " ".join(repr(plan).split()).partition("Stage full")[0]
    assert ("the motor moves" in text) is moves and ("THIS STAGE DOES NOT MOVE THE MOTOR" in text) is not moves
    bench = Bench(compiler, tmp_path, stage.controller)
    log = bench.log(Machine.of_knee(rubbing[1]), stage.excitation.reference, noise=0.0)
    assert np.max(np.abs(log["I"])) <= stage.stop["I"] and np.max(np.abs(log["tau_s"])) <= share * 20.0
    speed = np.max(np.abs(np.diff(log["tau_s"]))) / 1e-3 / 300.0 * 100.0  # rad/s of the motor
    assert speed > 3.0 if moves else speed < 1.2  # its friction is smoothed over 1 rad/s

    result = so.accept(
        stage.controller, [bench.log(Machine.of_knee(rubbing[1]), stage.excitation.reference, noise=0.01)]
    )
    assert result.replayed and result.response.still is not moves
    (row,) = (each for each in result.response.judged if each.name == "bandwidth")
    said = " ".join(repr(result).split())
    assert row.state == "as played" and "not the 20 Hz that was asked" in said
    assert row.limit <= 0.9 * row.predicted and abs(row.value / row.predicted - 1.0) < 0.1, row
    assert ("dry friction held the motor" in said) is not moves


def test_two_stages_that_are_the_same_experiment_are_one(rubbing):
    """With less effort both take what moves the motor: the second would be played for nothing."""
    plant, values, law, certificate = rubbing
    certified = []

    def refuse(fraction):
        raise so.SeaoptError("none")

    def certify(lower):
        certified.append(lower.command_limit)
        return replace(certificate, controller=lower)

    plan = so.bring_up(
        law, {"knee": plant}, values, samples=5, share=0.5, fractions=(0.25, 0.3), limits={"tau_s": 20.0},
        certificate=certificate, tune_stage=refuse, certify_stage=certify,
    )  # fmt: skip
    assert [stage.name for stage in plan.stages] == ["stage_1", "full"] and len(certified) == 1
    assert "stage_2 would be the same experiment, and is left out" in plan.stages[0].note
    assert repr(plan).count("same experiment") == 1
    assert plan.stages[1].excitation.amplitude > 1.1 * plan.stages[0].excitation.amplitude


def test_where_friction_makes_two_bandwidths_both_are_said_with_which_is_which(plan, tmp_path):
    """The stuck plant is that of the equations: a motor that does not move behind its spring, but for v_s."""
    from seaopt.machine.bringup.page import write_bring_up_page
    from seaopt.reporting import write_report

    values = so.plants.thor().update(f_c=60.0, v_s=5e-3)
    law = so.tune(so.plants.high_impedance(), values, so.ControllerSpec(bandwidth_hz=30, current_limit_A=9.0))
    f = np.geomspace(0.1, 100.0, 4000)
    r = values["l"].value / (2.0 * np.pi * values["N_p"].value)
    mass, k = values["m_l"].value + values["J"].value / r**2, values["k"].value
    s = 2j * np.pi * f
    damping = values["b_r"].value / r**2 + 60.0 / 5e-3
    plant = k / (mass * s**2 + damping * s + k) * np.exp(-s * 1.5e-3)  # a hold of a sample, and one of delay
    forward, feedback = law.law.responses(f)
    tracking = np.abs(forward * plant / (1.0 - feedback * plant))
    stuck = f[np.flatnonzero(tracking < np.sqrt(0.5) * tracking[0])[0]]
    said = format_number(law.measure_states()[" stuck"].bandwidth_hz, 3)
    assert float(said) == pytest.approx(stuck, rel=0.03) and float(said) < 0.7 * 30.0
    certificate = replace(plan.stages[-1].certificate, controller=law)  # as if it were certified
    options = {"fractions": (), "limits": {"F1": 600.0}, "certificate": certificate}
    plan = so.bring_up(law, {"stand": so.plants.high_impedance()}, values, **options)
    both = f"30 Hz sliding and {said} Hz stuck"
    page = write_bring_up_page(plan, tmp_path / "bringup.html").read_text()
    report = write_report([law], tmp_path / "report.html").read_text()
    for text in (repr(law), repr(plan), page, report):
        assert both in " ".join(text.split())
    assert "bandwidth, stuck" in repr(law) and "bandwidth, sliding" in repr(law)


def test_what_cannot_be_played_is_refused(controller, plan):
    def unused(law):
        raise AssertionError("a law was certified")

    options = {"plants": {"stand": so.plants.high_impedance()}, "uncertainty": so.plants.thor(), "samples": 5}
    options["certificate"] = plan.stages[-1].certificate
    for wrong, says in (
        ({"fractions": (1.5,)}, "between 0 and 1"),
        ({"share": 0.0}, "share = 0"),
        ({"fractions": (), "bias": 5000.0}, "bias = 5000"),
        (
            {"certificate": plan.stages[0].certificate},
            r"certificate = that of law \w+, 7.5 Hz: the controller is law \w+, ",
        ),
        ({"certificate": "robustness.json"}, "certificate = .*give what certify returned"),
        ({"certificate": None, "limits": {"f1": 900.0}}, "limits names f1; known: I, F1"),  # before a law is certified
    ):
        with pytest.raises(so.SeaoptError, match=says):
            so.bring_up(controller, certify_stage=unused, **options | wrong)


def test_sets_of_phases_follow_each_other_smoothly_and_peaks_are_those_of_the_whole_run(plan):
    from seaopt.control import CompensateFriction, add_compensation, run_loop
    from seaopt.control.running.sampled_loop import SampledLoop

    stand, values = so.plants.high_impedance(), so.plants.thor().update(f_c=300.0, v_s=5e-3)
    law = so.tune(stand, values, so.ControllerSpec(bandwidth_hz=30, max_noise_gain=45, current_limit_A=9.0))
    law = add_compensation(law, friction=CompensateFriction(fraction=0.8))
    certificate = replace(plan.stages[-1].certificate, controller=law)  # as if it were certified
    options = {"fractions": (), "limits": {"F1": 600.0}, "certificate": certificate}
    excitation = so.bring_up(law, {"stand": stand}, values, **options).stages[0].excitation
    period, rows = excitation.waves.shape[1], excitation.reference
    joints = period * (1 + excitation.periods * np.arange(1, len(excitation.waves)))
    assert np.max(np.abs(np.diff(rows)[joints - 1])) < np.max(np.abs(np.diff(rows[period : 2 * period])))
    loop = SampledLoop(plant=stand, law=so.control.runnable(law), measured="F1", delay_samples=1)
    run = run_loop(loop, [stand.complete(values)], rows, rtol=1e-4)
    assert np.max(np.abs(run.current)) <= 1.001 * excitation.peaks["I"] < 0.8 * 9.0


def test_a_stage_of_less_effort_has_room_for_the_noise_of_what_it_reads(gentle, compiler, tmp_path):
    """Played on the simulator in C, with its own noise: no tick is at the limit, which would cost its period, and the
    machine is told from one with twice the friction."""
    stages, values = gentle
    stage = stages[0]
    assert "beside which the noise of what it reads has no room" in stage.note and stage.met
    bench, reference = Bench(compiler, tmp_path, stage.controller), stage.excitation.reference
    log = bench.log(Machine.of_knee(values), reference, noise=0.05)
    assert np.max(np.abs(log["I"])) < stage.controller.command_limit < 15.0
    # The noise shakes the motor through its friction: compared without it, v_s was 1.8 times what it is.
    result = so.accept(stage.controller, [log])
    assert result.replayed and result.differences.inside
    rubbing = bench.log(Machine.of_knee(values.update(f_c=0.02)), reference, noise=0.05)
    found = so.accept(stage.controller, [rubbing]).differences.found[0]
    assert "f_c" in (found.name, *found.alike) and found.explains > 0.95
    assert len(stages) == 2
    (tmp_path / "full").mkdir()
    law = stages[1].controller
    full = Bench(compiler, tmp_path / "full", law).log(
        Machine.of_knee(values), stages[1].excitation.reference, noise=0.05
    )
    assert so.accept(law, [full]).met


def test_expected_peaks_contain_the_noise_of_what_is_read(controller, compiler, tmp_path):
    """Against the simulator in C, whose noise is its own: without it the figures to stop at are too low."""
    stand, values = {"stand": so.plants.high_impedance()}, so.plants.thor()
    judged = so.certify(controller, stand, values, samples=5)
    options = {"fractions": (), "share": 0.02, "limits": {"F1": 900.0}, "certificate": judged}
    (still,) = so.bring_up(controller, stand, values, **options).stages
    (noisy,) = so.bring_up(controller, stand, values, sensors=so.Sensors(noise_std={"F1": 2.0}), **options).stages
    assert np.array_equal(still.excitation.reference, noisy.excitation.reference)
    bench = Bench(compiler, tmp_path, controller)
    for seed in (1, 2, 3):
        log = bench.log(Machine(), noisy.excitation.reference, noise=2.0, seed=seed)
        for name in ("I", "F1"):
            peak = np.max(np.abs(log[name]))
            assert still.excitation.peaks[name] < 0.9 * peak
            assert 0.8 * noisy.excitation.peaks[name] < peak < 1.1 * noisy.excitation.peaks[name]
            assert peak < noisy.stop[name]
        assert np.max(np.abs(log["I"])) > still.stop["I"]


def test_with_dry_friction_the_page_does_not_ask_that_logs_lie_in_the_band_of_the_sliding_machine(
    plan, controller, tmp_path
):
    from seaopt.machine.bringup.page import write_bring_up_page

    stand, values = so.plants.high_impedance(), so.plants.thor().update(f_c=60.0, v_s=5e-3)
    law = so.tune(stand, values, so.ControllerSpec(bandwidth_hz=30, current_limit_A=9.0))
    certificate = replace(plan.stages[-1].certificate, controller=law)  # as if it were certified
    rubbing = so.bring_up(law, {"stand": stand}, values, fractions=(), certificate=certificate)
    without, with_ = (write_bring_up_page(each, tmp_path / "bringup.html").read_text() for each in (plan, rubbing))
    assert "must lie" in without and "dry friction" not in without
    assert "must lie" not in with_ and "It has 60 N of dry friction at the spring" in with_
