"""Predictive control of drives late by fractions of a sample, in a simulator of the tests: scipy's expm alone."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm

from seaopt.control import MPCSpec, NoiseModel, estimator, force_mpc
from seaopt.errors import ControlError
from seaopt.parameters import Parameter
from seaopt.robustness import linear_controller
from tests.c_code import CompiledMPC

TS, COMPUTE = 1e-3, 1
DRIVES = [pytest.param(0.3e-3, marks=pytest.mark.slow), 1.32e-3, pytest.param(2.3e-3, marks=pytest.mark.slow)]


class Stand:
    """A continuous plant whose command is late by whole samples and by a drive that takes any time; exact between."""

    def __init__(self, plant, params, drive_s, compute=COMPUTE):
        model = plant.linearize(params)
        self.a, self.b, self.c = np.array(model.A), np.array(model.B)[:, 0], np.array(model.C)[0]
        self.x, self.t, self.late, self.events = np.zeros(len(self.a)), 0.0, compute * TS + drive_s, []
        self.acting = 0.0

    def move(self, seconds):
        n = len(self.x)
        whole = np.zeros((n + 1, n + 1))
        whole[:n, :n], whole[:n, n] = self.a, self.b * self.acting
        self.x = (expm(whole * seconds) @ np.append(self.x, 1.0))[:n]

    def step(self, k, command):
        """Go from sample k to k + 1, the command of k taking effect when it arrives."""
        self.events.append((k * TS + self.late, command))
        t, end = k * TS, (k + 1) * TS
        while self.events and self.events[0][0] < end - 1e-12:
            at, value = self.events.pop(0)
            self.move(max(at - t, 0.0))
            t, self.acting = max(at, t), value
        self.move(end - t)

    @property
    def force(self):
        return float(self.c @ self.x)


@pytest.fixture(scope="module", params=DRIVES, ids=lambda drive: f"{drive / TS:g} samples")
def made(request, stand, thor):
    spec = MPCSpec(current_limit_A=9.0, bandwidth_hz=20, compute_delay_samples=COMPUTE, drive_delay_s=request.param)
    return force_mpc(stand, thor, spec), request.param


def run(mpc, plant, references, injected=None):
    state, forces, commands, errors = mpc.start, [], [], []
    for k, reference in enumerate(references):
        force = plant.force + (0.0 if injected is None else injected[k])
        forces.append(force)
        result = mpc.step(state, float(reference), force)
        state = result.state
        errors.append(float(state.kalman.innovation[0]))
        commands.append(result.command)
        plant.step(k, result.command)
    return np.array(forces), np.array(commands), np.array(errors)


def test_what_it_predicts_is_what_comes(made, stand, thor):
    """At its limits and within them; with a delay off by 0.3 of a sample it misses by most of a newton."""
    mpc, drive = made
    references = np.repeat([0.0, 1800.0, -400.0, 600.0], 60)
    forces, commands, errors = run(mpc, Stand(stand, thor, drive), references)
    assert np.max(np.abs(commands)) > 8.9
    assert np.max(np.abs(errors)) < 1e-8 * np.max(np.abs(forces))
    assert forces[-1] == pytest.approx(600.0, rel=0.02)
    _, _, wrong = run(mpc, Stand(stand, thor, drive + 0.3 * TS), references)
    assert np.max(np.abs(wrong)) > 0.5


def test_other_values_are_behind_the_drive_of_the_design(made, stand, thor):
    mpc, _ = made
    assert mpc.close(stand, thor).figures().ms == pytest.approx(mpc.achieved.ms, rel=1e-9)
    assert f"compute delay {COMPUTE} sample + drive delay" in mpc.delays


@pytest.mark.slow
def test_the_sensitivity_that_it_states_is_the_simulated_one(made, stand, thor):
    """Of sines added to the reading near the peak of S, by their amplitude once the start has died out."""
    mpc, drive = made
    peak_hz = mpc.achieved.ms_hz
    found = []
    for f in peak_hz * np.array([0.97, 1.0, 1.03]):
        count = round(round(0.6 * f) / f / TS)  # whole periods, 0.6 s or so
        t = np.arange(count + 1500) * TS
        injected = np.sin(2 * np.pi * f * t)
        forces, _, _ = run(mpc, Stand(stand, thor, drive), np.zeros(t.size), injected)
        tail = slice(t.size - count, t.size)
        wave = np.exp(-2j * np.pi * f * t[tail])
        found.append(abs(forces[tail] @ wave) / abs(injected[tail] @ wave))
    assert max(found) == pytest.approx(mpc.achieved.ms, rel=0.01)


def test_its_loop_counts_the_drives_delay_once(made, stand, thor):
    mpc, drive = made
    assert mpc.delay_samples == pytest.approx(COMPUTE + drive / TS)
    assert (mpc.compute_delay_samples, mpc.drive_delay_s) == (COMPUTE, drive)
    later = force_mpc(stand, thor, MPCSpec(current_limit_A=9.0, bandwidth_hz=20, compute_delay_samples=5))
    sooner = force_mpc(stand, thor, MPCSpec(current_limit_A=9.0, bandwidth_hz=20, compute_delay_samples=1))
    assert sooner.achieved.ms < mpc.achieved.ms < later.achieved.ms
    assert f"drive delay {1e3 * drive:g} ms" in repr(mpc)
    assert linear_controller(mpc).achieved.ms == pytest.approx(mpc.achieved.ms, rel=1e-9)


def test_a_delay_of_whole_samples_is_that_of_as_many_more_of_computing(stand, thor):
    drive = MPCSpec(current_limit_A=9.0, bandwidth_hz=20, compute_delay_samples=1, drive_delay_s=2e-3)
    whole = MPCSpec(current_limit_A=9.0, bandwidth_hz=20, compute_delay_samples=3)
    one, other = (force_mpc(stand, thor, spec) for spec in (drive, whole))
    assert one.achieved.ms == pytest.approx(other.achieved.ms, rel=1e-9)
    np.testing.assert_allclose(one.prediction.F, other.prediction.F)


@pytest.mark.parametrize("single", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_the_c_code_has_the_same_model(single, made, stand, thor, compiler, tmp_path):
    mpc, drive = made
    forces, commands, _ = run(mpc, Stand(stand, thor, drive), np.repeat([0.0, 1500.0, -400.0], 50))
    rows = CompiledMPC(compiler, tmp_path, mpc, single_precision=single).run(
        np.repeat([0.0, 1500.0, -400.0], 50), forces
    )
    np.testing.assert_allclose(rows[:, 0], commands, rtol=0, atol=5e-2 if single else 1e-7)
    header = (tmp_path / "force_mpc_data.h").read_text()
    assert f"compute delay 1 sample + drive delay {1e3 * drive:.4g} ms" in header


@pytest.mark.slow
def test_bounds_of_signals_are_kept_with_a_late_drive(made, stand, thor):
    """The screw's speed, as the plan says: within its bounds but for what the discretisation of samples leaves."""
    _, drive = made
    spec = MPCSpec(
        current_limit_A=9.0, bandwidth_hz=20, compute_delay_samples=COMPUTE, drive_delay_s=drive,
        bounds={"qd": (-0.08, 0.08)},
    )  # fmt: skip
    plant, mpc = Stand(stand, thor, drive), force_mpc(stand, thor, spec)
    state, speeds = mpc.start, []
    for k in range(160):
        result = mpc.step(state, 1500.0 if k > 10 else 0.0, plant.force)
        state = result.state
        plant.step(k, result.command)
        speeds.append(plant.x[1])
    assert 0.07 < np.max(np.abs(speeds)) < 0.08 * 1.02


def test_a_filter_takes_the_delay_that_its_parameters_hold(stand, thor):
    """Its innovations are nothing on a plant of its own, commanded at random."""
    late = thor.with_parameters(Parameter(name="drive_delay_s", value=1.32e-3, unit="s"))
    noise = NoiseModel(sensor_std={"F1": 2.0}, input_noise={"I": 0.1})
    kalman = estimator(stand, late, noise, sample_time_s=TS)
    assert kalman.delay_samples == 1
    plant, state = Stand(stand, thor, 1.32e-3, compute=0), kalman.start
    rng = np.random.default_rng(4)
    for k in range(200):
        current = rng.normal()
        state = kalman.step(state, np.array([current]), np.array([plant.force]))
        plant.step(k, current)
        assert abs(state.innovation[0]) < 1e-8


@pytest.mark.parametrize("other", [{"compute_delay_samples": 1}, {"drive_delay_s": 1e-3}])
def test_the_older_key_is_refused_beside_the_new_ones(other):
    with pytest.raises(ControlError, match="delay_samples"):
        MPCSpec(current_limit_A=9.0, delay_samples=2, **other)
