"""What is allowed: no false alarm from noise, no cycle that is missed, no current above the limit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import cont2discrete

import seaopt as so
from seaopt.control import Gains, Loop
from seaopt.control.laws.realisation import runnable
from seaopt.errors import SimulationError
from seaopt.robustness.verification.linear import linearise_last_phase
from seaopt.robustness.verification.playback import Rig, play
from seaopt.robustness.verification.scenarios import Phase, Scenario, default_scenarios
from seaopt.robustness.verification.verification import verify
from tests.blocks import of_one_input
from tests.laws import scaled


@pytest.fixture(scope="module")
def controller(limited_controller):
    return limited_controller


def chosen(controller, plant, name):
    (scenario,) = [scenario for scenario in default_scenarios(controller, plant) if scenario.name == name]
    return scenario


def test_an_amplifier_that_rounds_stays_within_the_limit(controller, stand, thor):
    """The law's own commands, rounded by NumPy to whole steps and cut at 8.96 A = 128 steps of 0.07 A."""
    rig = Rig(controller=controller, plant=stand, command_step=0.07)
    trace = play(rig, chosen(controller, stand, "saturating doublet"), [thor])
    commands, _ = runnable(controller).run(trace.reference[0], trace.outputs["F1"][0])
    rounded = np.clip(0.07 * np.round(commands / 0.07), -8.96, 8.96)
    np.testing.assert_allclose(trace.current[0, 1:], rounded[:-1], atol=1e-9)
    assert np.max(np.abs(commands)) == 9.0 and np.max(np.abs(trace.current)) == pytest.approx(8.96)
    scenarios = [chosen(controller, stand, name) for name in ("saturating doublet", "saturating hold")]
    verification = verify(controller, {"stand": stand}, thor, command_step=0.07, scenarios=scenarios)
    assert max(row.peak_command for row in verification.rows) <= 9.0
    assert verification.rows[1].saturated > 0.1


def test_a_step_above_the_limit_leaves_no_current(controller, stand, thor):
    with pytest.raises(SimulationError, match="every command but zero"):
        verify(controller, {"stand": stand}, thor, command_step=9.5)


def test_a_load_is_no_bound_on_what_is_known(controller, stand, swing, thor):
    """The same run, sample by sample, whether the inertia's bounds hold 1.5 times its value or not."""
    bounded = thor.with_parameters(replace(thor["I_p"], min=0.3, max=0.5))
    rig = Rig(controller=controller, plant=swing, partner=stand)
    loaded = [play(rig, chosen(controller, swing, "payload"), [params]) for params in (thor, bounded)]
    np.testing.assert_array_equal(loaded[0].outputs["phi"], loaded[1].outputs["phi"])
    assert verify(controller, {"swing": swing}, bounded, scenarios=[chosen(controller, swing, "payload")]).passed


@pytest.mark.parametrize(
    ("on_stand", "on_swing"), [((1, 2), (0, 1)), pytest.param((8, 8), (2, 2), marks=pytest.mark.slow)]
)
def test_noise_on_a_healthy_loop_is_no_fault(controller, stand, swing, thor, on_stand, on_swing):
    """60 Hz, and so many seeds of a load cell of 2 N and of 20 N, more than half of the unsaturated step."""
    healthy = so.tune(stand, thor, replace(controller.spec, bandwidth_hz=60), robust_to={"swing": swing})
    for plant, counts in ((stand, on_stand), (swing, on_swing)):
        scenarios = [chosen(healthy, plant, name) for name in ("unsaturated step", "chirp")]
        for std, seeds in zip((2.0, 20.0), counts, strict=True):
            for seed in range(seeds):
                cell = so.Sensors(noise_std={"F1": std})
                verification = verify(healthy, {"p": plant}, thor, scenarios=scenarios, sensors=cell, seed=seed)
                assert verification.passed, (std, seed, verification)


def end_rounded(controller, params, force, quantum):
    """Return how far off the force ends, by the exact response of the stand and a reading that is rounded."""
    v = {name: params[name].value for name in params}
    r = v["l"] / (2 * np.pi * v["N_p"])
    mass, b = v["J"] / r**2 + v["m_l"], v["b_r"] / r**2
    a = np.array([[0.0, 1.0], [-v["k"] / mass, -b / mass]])
    push = np.array([[0.0], [v["eta"] * v["K_tau"] / r / mass]])
    step, push = cont2discrete((a, push, np.eye(2), np.zeros((2, 1))), 1e-3)[:2]
    law = runnable(controller)
    x, state, waiting, out = np.zeros(2), law.reset(), 0.0, []
    for _ in range(3000):
        out.append(v["k"] * x[0])
        command, state = law.step(state, force, quantum * np.floor(out[-1] / quantum + 0.5))
        x, waiting = step @ x + push[:, 0] * waiting, command
    return abs(force - np.mean(out[-600:]))


def test_a_step_may_end_half_a_count_off_and_no_more(controller, stand, thor):
    """What an integral cannot see is no fault: its reading is the reference, or hops about it."""
    small = chosen(controller, stand, "2 % step")
    force, quantum = small.phases[-1].force_N, 20.0
    off = end_rounded(controller, thor, force, quantum)
    assert small.final_error < off < small.final_error + 0.5 * quantum
    cell = so.Sensors(quantisation={"F1": quantum})
    row = verify(controller, {"p": stand}, thor, scenarios=[small], sensors=cell).rows[0]
    assert abs(row.final_error_N) == pytest.approx(off, rel=0.05) and not any(
        fault.kind == "steady error" for fault in row.faults
    )
    offset = so.Sensors(quantisation={"F1": quantum}, offset={"F1": 40.0})
    row = verify(controller, {"p": stand}, thor, scenarios=[small], sensors=offset).rows[0]
    assert any(fault.kind == "steady error" for fault in row.faults)


@pytest.mark.parametrize("cell", [so.Sensors(), so.Sensors(noise_std={"F1": 60.0}, quantisation={"F1": 5.0})])
@pytest.mark.parametrize(("factor", "late"), [(9.5, 0), (40.0, 0), (-0.05, 0), (1.0, 8)])
def test_every_run_of_an_unstable_loop_fails_and_says_so(controller, stand, thor, cell, factor, late):
    """Radius and frequency from the eigenvalues of loop matrices written out here."""
    wild = replace(controller, law=scaled(controller.law, factor), compute_delay_samples=1 + late)
    plant, tf = wild.plant(stand, thor), wild.measurement
    n, m, d = plant.b.size, tf.den.size - 1, wild.compute_delay_samples
    # States: plant, the last d commands (newest first), and the law's history of m measurements and m commands.
    size = n + max(d, m) + m
    a = np.zeros((size, size))
    a[:n, :n], a[:n, n + d - 1] = plant.a, plant.b
    num = np.pad(tf.num, (0, m + 1 - tf.num.size))
    command = np.zeros(size)
    command[:n] = -num[0] * plant.c[0]
    command[n : n + m] -= tf.den[1:]
    command[n + max(d, m) :] -= num[1:]
    a[n] = command
    a[n + 1 : n + max(d, m), n : n + max(d, m) - 1] = np.eye(max(d, m) - 1)
    a[n + max(d, m), :n] = plant.c[0]
    a[n + max(d, m) + 1 :, n + max(d, m) : -1] = np.eye(m - 1)
    poles = np.linalg.eigvals(a)
    fastest = poles[np.argmax(np.abs(poles))]
    assert abs(fastest) > 1.0
    verification = verify(wild, {"stand": stand}, thor, sensors=cell)
    for row in verification.rows:
        assert not row.passed
        assert f"unstable: the linear loop's spectral radius is {abs(fastest):.6g}" in row.reason
        assert f"at {abs(np.angle(fastest)) * 1e3 / (2 * np.pi):.4g} Hz" in row.reason


def test_the_force_that_noise_makes_is_the_covariance_of_the_loop(controller, stand, thor):
    """P = A P A' + B B' of noise and rounding, solved by SciPy, against the integral over frequency."""
    from scipy.linalg import solve_discrete_lyapunov

    rig = Rig(
        controller=controller, plant=stand, sensors=so.Sensors(noise_std={"F1": 2.0}, quantisation={"F1": 3.0}),
        command_step=0.1,
    )  # fmt: skip
    view = linearise_last_phase(rig, default_scenarios(controller, stand)[0], thor)
    system = controller.close(stand, thor).system().block
    read = np.outer(system.b[:, 0], system.b[:, 0]) * (4.0 + 9.0 / 12.0)
    c, d = system.c[0], (system.d[0, 0] - 1.0) ** 2 * (4.0 + 9.0 / 12.0)
    expected = c @ solve_discrete_lyapunov(system.a, read) @ c + d
    only_read = replace(view, step_N=0.0)
    assert only_read.force_std() == pytest.approx(np.sqrt(expected), rel=2e-3)
    a, b, (y,), _ = of_one_input(controller.close(stand, thor).plant.block)
    f = np.arange(0.5, 500.0)
    rounding = np.abs([y @ np.linalg.solve(np.exp(2j * np.pi * x * 1e-3) * np.eye(b.size) - a, b) for x in f])
    rounding = rounding * np.abs(controller.close(stand, thor).sensitivity(f))
    step = 0.1 / controller.command.per_effort / np.sqrt(12.0)
    assert view.force_std() ** 2 == pytest.approx(expected + step**2 * np.mean(rounding**2), rel=5e-3)


@pytest.mark.slow
def test_a_slow_stick_slip_cycle_is_found_with_its_fundamental(controller, stand, thor):
    """An integrator pushes against 300 N of static friction: 45 N at 2.7 Hz by the spectrum of the last 8 s."""
    hunter = so.tune(stand, thor, replace(controller.spec, max_noise_gain=None, reference_weights="error"))
    gains = Gains(**{**hunter.gains, "k_i": hunter.gains["k_i"] + 1.0})
    hunter = replace(hunter, law=gains.law("pid", hunter.sample_time_s))
    plant = so.plants.high_impedance(parts=["stribeck"])
    params = plant.complete(thor).update(f_c=100.0, v_s=1e-5, f_s=300.0, v_st=3e-4)
    assert Loop(plant=hunter.plant(plant, params), law=hunter.law).figures().stable
    hold = Scenario(name="hold", phases=(Phase(duration_s=0.2), Phase(duration_s=9.5, force_N=50.0)))
    force = play(Rig(controller=hunter, plant=plant), hold, [params]).outputs["F1"][0, -8192:]
    spectrum = np.abs(np.fft.rfft((force - force.mean()) * np.hanning(8192))) / 2048.0
    top = int(np.argmax(spectrum))
    assert spectrum[top] > 30.0 and 2.0 < top / 8.192 < 4.0
    rows = verify(hunter, {"stand": plant}, params, scenarios=[chosen(hunter, plant, "unsaturated step"), hold]).rows
    assert len(rows) == 2
    for row in rows:
        assert "sustains itself" in row.reason
        assert row.limit_cycle_hz == pytest.approx(top / 8.192, abs=0.15)
        assert row.limit_cycle_N == pytest.approx(spectrum[top], rel=0.1)
