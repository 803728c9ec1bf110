"""The delay that a fit finds reaches the controller: against a loop held in steps of 40 us with the true delay."""

from __future__ import annotations

import json
import pickle
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from scipy.signal import cont2discrete

import seaopt as so
from seaopt.control import MPCSpec, draw, force_mpc, read_law
from seaopt.control.laws.delay import describe_delays, find_drive, settle_delays, split_delayed, warn_delays
from seaopt.control.laws.friction import find_friction_margin
from seaopt.control.laws.passivity import passivity
from seaopt.control.loops.port import probe_of
from seaopt.control.loops.sampled_plant import add_drive_delay, find_delay, read_conditions
from seaopt.control.tuning.tuner import make_task
from seaopt.errors import ControlError, ProblemError
from seaopt.files import to_json
from seaopt.plants.friction import split_friction
from seaopt.plants.parts import wrapped
from seaopt.problem import read_problem
from seaopt.problem.stages import assess_problem, list_plants
from seaopt.robustness import batch_figures, bracket, combine_uncertainty
from seaopt.robustness.certificate.cases import find_own_drive
from seaopt.robustness.certificate.simulated import STEPS
from seaopt.robustness.uncertainty.delay_margin import sampled_delay_margin
from seaopt.robustness.verification.environments import attach_environment
from seaopt.robustness.verification.large_signal import large_signal
from seaopt.robustness.verification.playback import Rig, play
from seaopt.robustness.verification.scenarios import Phase, Scenario
from tests.checks import leave_out
from tests.words import flatten

DELAY_S = 2.04e-3
SUBSTEPS, STEPS_LATE = 25, 51  # of 1 ms: 2.04 ms are 51 steps of 40 us
SPEC = so.ControllerSpec(bandwidth_hz=25, max_sensitivity=1.6, max_noise_gain=25)


@pytest.fixture(autouse=True)
def without_steps(monkeypatch):
    """Let certificates have no simulated steps: what is looked at here is linear."""
    leave_out(monkeypatch, STEPS)


@pytest.fixture(scope="module")
def fit(stand, thor):
    """A fit of a log made outside the package: steps of a microsecond's grid, the command late by a known time."""
    rng = np.random.default_rng(5)
    current = np.repeat(rng.normal(size=500), 8) + 0.3 * rng.normal(size=4000)
    current[:10] = 0.0  # nothing is known of the command before the log
    fine = np.concatenate([np.zeros(STEPS_LATE), np.repeat(current, SUBSTEPS)])[: current.size * SUBSTEPS]
    plant = stand.linearize(thor)
    a, b, c, d, _ = cont2discrete((plant.A, plant.B, plant.C, plant.D), 1e-3 / SUBSTEPS)
    x, force = np.zeros(a.shape[0]), np.zeros(current.size)
    row = plant.output_labels.index("F1")
    for k, u in enumerate(fine):
        if k % SUBSTEPS == 0:
            force[k // SUBSTEPS] = c[row] @ x + d[row, 0] * u
        x = a @ x + b[:, 0] * u
    log = so.Log.from_arrays(time=1e-3 * np.arange(current.size), I=current, F1=force + rng.normal(size=current.size))
    delay = so.Parameter(name="delay_s", value=1e-3, unit="s", free=True, max=0.01)
    experiment = so.Experiment(plant=stand, log=log, sigma={"F1": 1.0}, initial_state="rest", delay_s=delay)
    return so.fit([experiment], thor.update(b_r=1.3e-4).free("b_r"), diagnostics=False)


def _true_ms(controller, plant, params, seconds):
    """Return the peak of abs(S) on a dense grid, of a loop that is late by so many seconds: held in steps of 40 us."""
    period, system = controller.sample_time_s, plant.linearize(params)
    fine = period / SUBSTEPS
    a, b, c, d, _ = cont2discrete((system.A, system.B, system.C[:1], system.D[:1]), fine)
    z = np.exp(2j * np.pi * np.geomspace(0.01, 499.9, 8_000) * period)
    c_y = np.polyval(controller.measurement.num[::-1], 1 / z) / np.polyval(controller.measurement.den[::-1], 1 / z)
    late = round(seconds / fine)
    whole, part = divmod(late, SUBSTEPS)
    power = np.linalg.matrix_power
    older = sum((power(a, SUBSTEPS - 1 - k) @ b for k in range(part)), np.zeros_like(b))
    newer = sum((power(a, SUBSTEPS - 1 - k) @ b for k in range(part, SUBSTEPS)), np.zeros_like(b))
    x = np.linalg.solve(z[:, None, None] * np.eye(len(a)) - power(a, SUBSTEPS), (newer + older / z[:, None, None]))
    p = (c @ x)[:, 0, 0] * controller.command.per_effort
    assert d[0, 0] == 0.0
    return np.max(1.0 / np.abs(1.0 + p * z**-whole * c_y))


def test_a_fitted_delay_is_the_drives_and_the_program_that_logged_waits_for_nothing(fit, stand):
    assert fit.delay_s(stand) == pytest.approx(DELAY_S, abs=2e-5)
    controller = so.tune(stand, fit, SPEC)
    assert (controller.compute_delay_samples, controller.drive_delay_s) == (0, fit.delay_s(stand))
    assert controller.delay_samples == pytest.approx(2.04, abs=0.02)
    assert controller.feasible
    assert _true_ms(controller, stand, fit.parameters, DELAY_S) == pytest.approx(controller.achieved.ms, rel=2e-3)
    assert _true_ms(controller, stand, fit.parameters, DELAY_S + 1e-3) > 1.02 * controller.achieved.ms
    assert "compute delay 0 samples + drive delay 2.0" in flatten(repr(controller))


def test_a_command_that_is_measured_says_nothing_of_the_program(fit, stand):
    """Of inputs that run straight between samples, as measured currents do, the drive's delay is known alone."""
    own = {name: replace(one, hold="first") for name, one in fit.nuisance.items()}
    controller = so.tune(stand, replace(fit, nuisance=own), SPEC)
    assert (controller.compute_delay_samples, controller.drive_delay_s) == (1, fit.delay_s(stand))


def test_an_output_with_the_present_command_in_it_waits_for_a_sample(fit):
    """F2 of the lumped drive contains the motor's force."""
    lumped = so.plants.high_impedance(drive="lumped")
    assert settle_delays(so.ControllerSpec(measured="F2"), lumped, fit)[0].compute_delay_samples == 1
    assert settle_delays(so.ControllerSpec(measured="F1"), lumped, fit)[0].compute_delay_samples == 0


def test_less_delay_than_the_fits_is_warned_of(fit, stand):
    spec = so.ControllerSpec(
        bandwidth_hz=50, max_sensitivity=1.6, max_noise_gain=60, compute_delay_samples=0, drive_delay_s=1e-3
    )
    controller = so.tune(stand, fit, spec)
    assert controller.delay_samples == 1
    assert _true_ms(controller, stand, fit.parameters, DELAY_S) > 1.65 > controller.achieved.ms
    certificate = so.certify(controller, {"stand": stand}, fit, samples=10, simulations=False)
    assert "drive_delay_s = 0.001, but the experiments have a delay of 2.0" in certificate.notes[0]
    assert not warn_delays(SPEC, stand, fit)


def test_the_older_key_is_the_whole_loop(fit, stand):
    older = so.ControllerSpec(bandwidth_hz=25, max_sensitivity=1.6, max_noise_gain=25, delay_samples=3)
    newer = replace(older, delay_samples=None, compute_delay_samples=3, drive_delay_s=0.0)
    one, other = so.tune(stand, fit, older), so.tune(stand, fit, newer)
    assert (one.compute_delay_samples, one.drive_delay_s) == (3, 0.0)
    assert one.achieved == other.achieved
    (warning,) = warn_delays(older, stand, fit)
    assert "delay_samples = 3 is an older key" in warning
    assert "experiments have a delay" in warn_delays(replace(older, delay_samples=2), stand, fit)[1]


@pytest.mark.parametrize("other", [{"compute_delay_samples": 0}, {"drive_delay_s": 0.0}])
@pytest.mark.parametrize("make", [so.ControllerSpec, partial(MPCSpec, current_limit_A=9.0)])
def test_the_older_key_is_refused_beside_a_new_one(make, other):
    (name,) = other
    with pytest.raises(ControlError, match=rf"delay_samples = 2 and {name} = 0 are both given.*keep compute_delay"):
        make(delay_samples=2, **other)


@pytest.mark.parametrize("value", [-1e-3, 2.0, np.nan, True])
def test_a_drives_delay_is_in_seconds(value):
    with pytest.raises(ControlError, match=r"drive_delay_s = .* (is in seconds|is not a finite number)"):
        so.ControllerSpec(drive_delay_s=value)


def test_predictive_control_has_the_fits_delay(fit, stand, thor):
    """Left out it is the fit's, and a sample for planning; a shorter one is warned of."""
    mpc = force_mpc(stand, fit, MPCSpec(current_limit_A=9.0, bandwidth_hz=15))
    assert mpc.warnings == () and mpc.delay_samples == pytest.approx(1 + 1e3 * fit.delay_s(stand))
    given = MPCSpec(current_limit_A=9.0, bandwidth_hz=15, compute_delay_samples=1, drive_delay_s=0.0)
    short = force_mpc(stand, fit, given)
    assert short.delay_samples == 1 and "drive_delay_s = 0, but" in short.warnings[0]
    assert short.warnings[0] in flatten(repr(short))
    assert force_mpc(stand, thor, MPCSpec(current_limit_A=9.0, bandwidth_hz=15)).delay_samples == 1


def test_a_law_of_ones_own_has_the_delays_of_its_file_and_of_the_fit(fit, stand, tmp_path):
    """Whatever the problem's own law counts on; and of a tuned law with the older key they are the whole loop."""
    (tmp_path / "p.toml").write_text(
        'schema = 1\ntitle = "t"\n[plant.stand]\nkind = "high_impedance"\ndrive = "unlumped"\n'
        '[controller]\nplant = "stand"\nbandwidth_hz = 25\ndelay_samples = 3\n',
        encoding="utf-8",
    )
    problem, pid = read_problem(tmp_path / "p.toml"), "sample_rate_hz = 1000\npid = { k_p = 2.0, k_i = 30.0 }\n"
    older = so.tune(stand, fit, replace(SPEC, delay_samples=3)).to_dict()
    texts = {
        "new.toml": (f"compute_delay_samples = 0\n{pid}", 1e3 * fit.delay_s(stand)),
        "drive.toml": (f"compute_delay_samples = 1\ndrive_delay_s = 5e-4\n{pid}", 1.5),
        "old.toml": (f"delay_samples = 2\n{pid}", 2.0),
        "controller.json": (to_json(older), 3.0),
    }
    for name, (text, samples) in texts.items():
        (tmp_path / name).write_text(text, encoding="utf-8")
        controller = assess_problem(problem, read_law(tmp_path / name), fit)
        assert controller.delay_samples == pytest.approx(samples, rel=1e-9)
        assert controller.compute_delay_samples + 1e3 * find_own_drive_s(controller, fit) == pytest.approx(samples)
    (tmp_path / "both.toml").write_text(f"compute_delay_samples = 0\ndelay_samples = 2\n{pid}", encoding="utf-8")
    with pytest.raises(so.SeaoptError, match="not both"):
        read_law(tmp_path / "both.toml")


def find_own_drive_s(controller, source):
    """Return the drive's delay that a certificate has."""
    drive = find_own_drive(controller, source)
    return 0.0 if drive is None else drive.delay_s


def test_under_the_older_key_a_certificate_adds_no_drive(stand, thor):
    late = add_drive_delay(thor, 2e-3)
    controller = so.tune(stand, late, replace(SPEC, delay_samples=3))
    certificate = so.certify(controller, {"stand": stand}, late, samples=2, simulations=False)
    assert certificate.plants["stand"].ms == pytest.approx(controller.achieved.ms, rel=1e-9)


def test_a_drives_range_is_in_seconds(stand, thor):
    controller = so.tune(stand, thor, SPEC)
    with pytest.raises(ControlError, match=r"range of drive_delay_s reaches 5 s"):
        so.certify(controller, {"stand": stand}, thor, samples=2, simulations=False, ranges={"drive_delay_s": (0, 5)})


def test_without_a_fit_it_is_one_sample(stand, thor):
    assert so.tune(stand, thor, SPEC).delay_samples == 1


def test_the_fit_read_again_has_the_delay(fit, stand, swing):
    again = so.estimation.Fit.from_dict(fit.to_dict())
    assert again.delay_s(stand) == fit.delay_s(stand)
    assert again.delay_s(swing) == fit.delay_s(stand)  # no experiment of its own: that of the same electronics


@pytest.fixture(scope="module")
def pair(stand, thor):
    """The same law behind two samples of the program's, and behind one of them and a drive that takes the other."""
    spec = so.ControllerSpec(
        bandwidth_hz=25, max_sensitivity=1.6, max_noise_gain=25, compute_delay_samples=2, current_limit_A=9.0
    )
    one = so.tune(stand, thor.update(f_c=5.0), spec)
    halved = replace(spec, compute_delay_samples=1, drive_delay_s=1e-3)
    values = add_drive_delay(one.design[1], 1e-3)
    return one, replace(one, spec=halved, compute_delay_samples=1, drive_delay_s=1e-3, design=(one.design[0], values))


def bracket_ms(law, plant, values):
    """Return what is proved of Ms over a range of inertia."""
    unknown = combine_uncertainty(values, so.ParameterSet(), {"J": (3e-6, 3.1e-6)}, {"": plant})
    return bracket(law, plant, unknown).ms_upper


STEP = Scenario(name="step", phases=(Phase(duration_s=0.12, force_N=30.0),))
MEASURES = {
    "figures": lambda law, plant, values: law.close(plant, values).figures().ms,
    "passivity": lambda law, plant, values: passivity(law, plant, values).least_cosine,
    "friction": lambda law, plant, values: find_friction_margin(law, plant, values).least_slope,
    "delay margin": lambda law, plant, values: sampled_delay_margin(law, plant, values, 0.05),
    "draws": lambda law, plant, values: batch_figures(law, plant, values, {"J": np.array([2e-6, 4e-6])}).ms,
    "bounds": lambda law, plant, values: bracket_ms(law, plant, values.update(f_c=0.0)),
    "amplitudes": lambda law, plant, values: (
        large_signal(law, plant, values, amplitudes_N=(500.0,), frequencies_hz=(15.0,)).gain
    ),
    "steps": lambda law, plant, values: play(Rig(controller=law, plant=plant), STEP, [values]).outputs["F1"][0],
}


@pytest.mark.parametrize("name", MEASURES)
def test_a_whole_sample_of_the_drive_is_as_one_of_the_program(name, pair, stand, thor):
    """Of a law that brings its drive's delay with it: what is given are values without one."""
    program, drive = (MEASURES[name](one, stand, thor.update(f_c=5.0)) for one in pair)
    np.testing.assert_allclose(drive, program, rtol=1e-6, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("structure", ["pid_dob", "cascade"])
def test_what_is_tuned_is_the_same(structure, thor):
    knee = so.plants.rotary("locked")
    values = knee.defaults.update(N=50.0, k_s=300.0)
    spec = so.ControllerSpec(
        measured=("tau_s", "thetad_m") if structure == "cascade" else "tau_s", structure=structure, bandwidth_hz=20
    )
    program = so.tune(knee, values, replace(spec, compute_delay_samples=2))
    drive = so.tune(knee, values, replace(spec, compute_delay_samples=1, drive_delay_s=1e-3))
    assert drive.achieved.ms == pytest.approx(program.achieved.ms, rel=1e-4)
    assert dict(drive.gains) == pytest.approx(dict(program.gains), rel=1e-2)


def test_a_fitted_delay_is_drawn_with_the_parameters(fit, stand):
    """Its std is the fit's, and so is its correlation with friction, which makes the force late too."""
    controller = so.tune(stand, fit, SPEC)
    drive = find_drive(SPEC, stand, fit)
    unknown = combine_uncertainty(fit, so.ParameterSet(), {}, {"stand": stand}, drive)
    assert unknown.names == ("b_r", "drive_delay_s")
    drawn = unknown.values(unknown.draw(4000, np.random.default_rng(1)))
    own = fit.nuisance["experiment"]
    assert np.std(drawn["drive_delay_s"]) == pytest.approx(own.std["delay_s"], rel=0.05)
    assert np.mean(drawn["drive_delay_s"]) == pytest.approx(own.delay_s, abs=0.1 * own.std["delay_s"])
    joint = fit.delay_covariance.matrix
    correlation = joint[0, 1] / np.sqrt(joint[0, 0] * joint[1, 1])
    assert np.corrcoef(drawn["b_r"], drawn["drive_delay_s"])[0, 1] == pytest.approx(correlation, abs=0.05)
    certificate = so.certify(controller, {"stand": stand}, fit, samples=20, simulations=False)
    assert [row.name for row in certificate.varied] == ["b_r", "drive_delay_s"]
    again = so.estimation.Fit.from_dict(json.loads(to_json(fit.to_dict())))
    np.testing.assert_array_equal(again.delay_covariance.matrix, joint)


@pytest.fixture(scope="module")
def vague(fit):
    """The same fit with a delay that is known to 0.4 ms, and goes with friction, as of a short log."""
    joint = fit.delay_covariance
    std, correlation = np.array([joint.std("b_r"), 4e-4]), np.array([[1.0, -0.8], [-0.8, 1.0]])
    return replace(fit, delay_covariance=replace(joint, matrix=std[:, None] * correlation * std))


def test_the_tuner_draws_a_fitted_delay_as_the_certificate_does(vague, stand, tmp_path):
    """From Python and from a problem file: its std, and its correlation with friction."""
    drive = find_drive(SPEC, stand, vague)
    unknown = combine_uncertainty(vague, so.ParameterSet(), {}, {"stand": stand}, drive)
    drawn = draw(vague, 3000, 1, drive=drive)
    of = {name: np.array([one[name] for one in drawn]) for name in unknown.names}
    assert set(drawn[0]) == set(unknown.names) == {"b_r", "drive_delay_s"}
    np.testing.assert_allclose(np.cov([*of.values()]), unknown.covariance, rtol=0.1)
    (tmp_path / "p.toml").write_text(
        'schema = 1\ntitle = "t"\n[plant.stand]\nkind = "high_impedance"\ndrive = "unlumped"\n'
        '[controller]\nplant = "stand"\nbandwidth_hz = 25\ndraws = 3\n',
        encoding="utf-8",
    )
    assert read_problem(tmp_path / "p.toml").draws(vague) == drawn[:3]
    whole = tmp_path / "whole.toml"
    whole.write_text((tmp_path / "p.toml").read_text().replace("draws", "delay_samples = 3\ndraws"), encoding="utf-8")
    assert set(read_problem(whole).draws(vague)[0]) == {"b_r"}


def test_a_delay_that_is_drawn_is_that_of_its_plant(stand, thor):
    """Which is later by as much at every frequency where a hold does next to nothing."""
    spec, values = settle_delays(replace(SPEC, drive_delay_s=1e-3), stand, thor)
    nominal, drawn = make_task(stand, values, spec, {}, [{"drive_delay_s": 2.3e-3}]).plants
    f = np.array([0.5, 2.0, 5.0])
    np.testing.assert_allclose(drawn.response(f) / nominal.response(f), np.exp(-2j * np.pi * f * 1.3e-3), rtol=1e-4)


@pytest.mark.slow
def test_a_law_tuned_with_draws_keeps_its_limits_at_the_delays_drawn(vague, stand):
    """On a loop held in steps of 40 us, whose delays are whole numbers of them; without draws it does not."""
    drawn = [
        one | {"drive_delay_s": 4e-5 * round(one["drive_delay_s"] / 4e-5)}
        for one in draw(vague, 6, 1, drive=find_drive(SPEC, stand, vague))
    ]
    assert max(one["drive_delay_s"] for one in drawn) > DELAY_S + 2e-4

    def find_worst(controller):
        return max(
            _true_ms(controller, stand, vague.parameters.update(b_r=one["b_r"]), one["drive_delay_s"]) for one in drawn
        )

    alone, held = so.tune(stand, vague, SPEC), so.tune(stand, vague, SPEC, draws=drawn)
    assert held.feasible and held.drive_delay_s == alone.drive_delay_s
    assert find_worst(held) < SPEC.max_sensitivity * 1.002 and find_worst(alone) > SPEC.max_sensitivity * 1.01


def test_a_plant_that_the_law_is_robust_to_has_the_delay_of_its_own_experiments(fit, stand, swing, tmp_path):
    """As in the certificate, from Python and from a problem file."""
    own = fit.nuisance["experiment"]
    slower = replace(own, plant=swing.name, delay_s=own.delay_s + 2e-3)
    two = replace(fit, nuisance={"experiment": replace(own, plant=stand.name), "swung": slower})
    spec = so.ControllerSpec(bandwidth_hz=15, max_sensitivity=1.6, max_noise_gain=25)
    controller = so.tune(stand, two, spec, robust_to={"swing": swing})
    certificate = so.certify(controller, {"stand": stand, "swing": swing}, two, samples=2, simulations=False)
    assert controller.feasible and certificate.plants["swing"].ms < 1.6
    (tmp_path / "p.toml").write_text(
        'schema = 1\ntitle = "t"\n[plant.stand]\nkind = "high_impedance"\ndrive = "unlumped"\n'
        '[plant.swing]\nkind = "moving_output"\n'
        '[controller]\nplant = "stand"\nbandwidth_hz = 15\nrobust_to = ["swing"]\n',
        encoding="utf-8",
    )
    problem = read_problem(tmp_path / "p.toml")
    named = replace(two, nuisance={**two.nuisance, "swung": replace(slower, plant=problem.plants["swing"].name)})
    assert list_plants(problem, named)[1]["swing"][0].drive_offset_s == pytest.approx(2e-3)


def test_values_that_change_keep_the_drives_delay(stand, swing, thor):
    late = add_drive_delay(thor, 1e-3)
    for plant in (stand, swing):
        values = plant.complete(late)
        changed = (values.update(J=3e-6), values.drop_conditions(), values.with_parameters(values["k"]))
        assert all(read_conditions(plant, one) == {"drive_delay_s": 1e-3} for one in changed)


def test_experiments_whose_delays_differ_are_two_plants_of_the_certificate(fit, stand):
    own = fit.nuisance["experiment"]
    other = replace(own, delay_s=1e-3)
    two = replace(fit, nuisance={"experiment": own, "second": other})
    controller = so.tune(stand, two, SPEC)
    assert controller.drive_delay_s == own.delay_s  # the longest
    certificate = so.certify(controller, {"stand": stand}, two, samples=5, simulations=False)
    assert list(certificate.plants) == ["stand", "stand, shortest delay"]
    shortest = certificate.plants["stand, shortest delay"].ms
    assert shortest == pytest.approx(_true_ms(controller, stand, fit.parameters, 1e-3), rel=2e-3)
    shorter = split_delayed(SPEC, stand, {"stand": stand}, two)["stand, shortest delay"]
    states = split_friction({"": shorter}, fit.parameters.update(f_c=5.0)).values()
    for plant in (*states, probe_of(shorter), attach_environment(shorter), pickle.loads(pickle.dumps(shorter))):
        assert plant.drive_offset_s == shorter.drive_offset_s == pytest.approx(-1.04e-3, abs=2e-5)
    alike = replace(fit, nuisance={"experiment": own, "second": replace(own, delay_s=own.delay_s - 1e-7)})
    assert list(split_delayed(SPEC, stand, {"stand": stand}, alike)) == ["stand"]


def test_under_the_older_key_no_drive_of_the_values_is_added(stand, thor):
    """delay_samples is the whole loop, whatever the values that a plant is closed with say."""
    late, spec = add_drive_delay(thor, 2e-3), replace(SPEC, delay_samples=3)
    law = so.tune(stand, thor, spec, robust_to={"late": (stand, late)})
    assert law.feasible
    for values in (thor, late, stand.complete(late)):
        assert law.close(stand, values).figures().ms == pytest.approx(law.achieved.ms, rel=1e-9)
    again = so.Controller.from_dict(json.loads(to_json(law.to_dict())), stand, late)
    assert again.achieved.ms == pytest.approx(law.achieved.ms, rel=1e-9)
    plan = force_mpc(stand, thor, MPCSpec(current_limit_A=9.0, bandwidth_hz=15, delay_samples=3))
    assert plan.close(stand, late).figures().ms == pytest.approx(plan.achieved.ms, rel=1e-9)
    assert "delay_samples = 3 is an older key, the whole loop" in plan.warnings[0]
    assert plan.warnings[0] in flatten(repr(plan)) and "delay 3 samples in all, the drive's among them" in flatten(
        repr(plan)
    )


def test_completed_values_keep_a_drive_of_their_own(stand, thor):
    law, late = so.tune(stand, add_drive_delay(thor, 1e-3), SPEC), add_drive_delay(thor, 2e-3)
    one, other = (law.close(stand, values).figures().ms for values in (late, stand.complete(late)))
    assert one == other > 1.1 * law.achieved.ms


@pytest.mark.parametrize(("asked", "stated", "words"), [
    ("delay_samples = 3", "compute_delay_samples = 0", r"counts 0 ms .* delay_samples = 3, the whole loop, 3 ms"),
    ("drive_delay_s = 2e-3", "delay_samples = 1", r"counts 1 ms .* drive_delay_s = 0.002 of the drive alone"),
    ("delay_samples = 3", "compute_delay_samples = 3", ""),
    ("delay_samples = 3", "compute_delay_samples = 0\ndrive_delay_s = 0.0", ""),
    ("drive_delay_s = 2e-3", "compute_delay_samples = 0", ""),
])  # fmt: skip
def test_a_law_of_ones_own_is_no_sooner_than_the_problem_says(asked, stated, words, thor, tmp_path):
    """Where no fit tells the drive's delay, and the law's file does not say it."""
    (tmp_path / "p.toml").write_text(
        'schema = 1\ntitle = "t"\n[plant.stand]\nkind = "high_impedance"\ndrive = "unlumped"\n'
        f'[controller]\nplant = "stand"\nbandwidth_hz = 25\n{asked}\n',
        encoding="utf-8",
    )
    pid = "sample_rate_hz = 1000\npid = { k_p = 2.0, k_i = 30.0 }\n"
    (tmp_path / "law.toml").write_text(f"{stated}\n{pid}", encoding="utf-8")
    problem, law = read_problem(tmp_path / "p.toml"), read_law(tmp_path / "law.toml")
    if not words:
        assert assess_problem(problem, law, thor).compute_delay_samples == law.delays["compute_delay_samples"]
        return
    with pytest.raises(ProblemError, match=words):
        assess_problem(problem, law, thor)


def test_a_delay_that_the_plant_has_as_a_part_counts_once(fit, stand):
    """Of a log of one tick the program waits for nothing, and the loop has that delay and no other."""
    late = wrapped(stand, ["command_delay"])
    values = late.complete(fit.parameters).with_parameters(so.Parameter(name="T_c", value=DELAY_S, unit="s"))
    own = replace(fit.nuisance["experiment"], plant=late.name, delay_s=0.0, std={})
    known = replace(fit, parameters=values, nuisance={"experiment": own})
    controller = so.tune(late, known, SPEC)
    assert (controller.compute_delay_samples, controller.drive_delay_s) == (0, 0.0)
    assert _true_ms(controller, stand, fit.parameters, DELAY_S) == pytest.approx(controller.achieved.ms, rel=2e-3)
    measured = replace(known, nuisance={"experiment": replace(own, hold="first")})
    assert settle_delays(SPEC, late, measured)[0].compute_delay_samples == 1
    assert settle_delays(SPEC, stand, known)[0].compute_delay_samples == 1
    assert warn_delays(SPEC, late, known) == ()
    (warning,) = warn_delays(replace(SPEC, drive_delay_s=DELAY_S), late, known)
    assert "T_c = 2.04 ms of the plant counts besides drive_delay_s = 0.00204" in warning
    assert "counts besides delay_samples = 3" in warn_delays(replace(SPEC, delay_samples=3), late, known)[1]


def test_both_delays_are_added_and_described():
    assert find_delay(so.plants.high_impedance(), {"drive_delay_s": 0.002, "delay_s": 0.001}) == pytest.approx(0.003)
    assert describe_delays(0, 1.32e-3, 1e-3) == "compute delay 0 samples + drive delay 1.32 ms = 1.32 samples"
    assert describe_delays(1, 0.0, 1e-3) == "compute delay 1 sample, no drive delay"
