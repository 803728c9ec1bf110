"""The noise floor of a residual: against the noise that was put in, filtered, quantised, heavy-tailed or stated."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import butter, lfilter, sosfilt

import seaopt as so
from seaopt.estimation.problem.fit_problem import pose_problem
from seaopt.estimation.problem.losses import Huber, Squares
from seaopt.estimation.problem.noise_floor import _add_shaking, measure_excess, measure_floor, measure_floors
from seaopt.estimation.problem.residual_statistics import compute_residuals

N = 20_000
SUM = so.Plant(
    name="sum", states={"z": "-"}, inputs={"u": "-"}, outputs={"y": "-"}, parameters={"a": "-"},
    f=lambda t, x, u, p: {"z": u.u - x.z}, h=lambda t, x, u, p: {"y": p.a * u.u + 0 * x.z},
)  # fmt: skip
SLOW = np.sin(np.arange(N) * 2e-3)


def pose(error, *, loss=None, band_hz=None, **options):
    """Return a problem whose residual at its start is the error."""
    log = so.Log.from_arrays(time=np.arange(N) * 1e-3, u=SLOW, y=2.0 * SLOW + error)
    bench = so.Experiment(plant=SUM, log=log, initial_state="rest", offset=False, name="log", **options)
    problem = pose_problem(
        (bench,), so.ParameterSet.of(a=(2.0, "-")).free("a"), loss=loss or Squares(), band_hz=band_hz
    )
    return problem, problem.unknowns.start


def floor(error, **options):
    problem, z = pose(error, **options)
    (experiment,) = problem.experiments
    found = measure_floor(experiment, compute_residuals(problem, z)["log"])
    sigma = float(experiment.sigma[0])
    return float(found.noise[0]) * sigma, float(found.rms[0]) * sigma, found


def noise(std, seed=0):
    return np.random.default_rng(seed).normal(scale=std, size=N)


def test_white_noise_is_its_own_floor():
    found, rms, _ = floor(noise(0.3))
    assert found == pytest.approx(0.3, rel=0.02)
    assert rms == pytest.approx(0.3, rel=0.02)


def test_what_changes_slowly_is_excess():
    """A slow error of 1 beside noise of 0.1: the excess is the root of 1 + (0.7/0.1)^2."""
    excess = measure_excess(*pose(noise(0.1) + np.sin(np.arange(N) * 0.01)))
    assert excess["log.y"] == pytest.approx(np.sqrt(1 + 0.5 / 0.01), rel=0.03)


def test_a_coarse_step_that_a_slow_signal_rests_on_is_noise():
    step = 0.5
    quantised = step * np.round(2.0 * SLOW / step) - 2.0 * SLOW
    found, _, floors = floor(quantised)
    assert found == pytest.approx(step / np.sqrt(12), rel=0.02)
    assert floors.excess[0] < 1.1


def test_a_band_has_its_own_part_of_the_noise():
    found, rms, floors = floor(noise(0.3), band_hz=(0.0, 50.0))
    filtered = np.std(sosfilt(butter(4, 50.0, fs=1000.0, output="sos"), noise(0.3)))
    assert found == pytest.approx(filtered, rel=0.05)
    assert floors.excess[0] == pytest.approx(1.0, abs=0.08)
    assert rms < 0.15


def test_outliers_of_a_robust_loss_are_no_excess():
    heavy = np.where(np.random.default_rng(1).uniform(size=N) < 0.03, noise(5.0, 2), noise(0.3))
    _, _, floors = floor(heavy, loss=Huber(), sigma={"y": 0.3})
    assert floors.excess[0] == pytest.approx(1.0, abs=0.05)


def test_coloured_noise_counts_where_it_is_stated_and_a_weight_does_not():
    coloured = lfilter([0.3 * np.sqrt(1 - 0.9**2)], [1.0, -0.9], noise(1.0))
    assert measure_excess(*pose(coloured))["log.y"] > 3.0
    assert measure_excess(*pose(coloured, sigma={"y": 0.3}))["log.y"] == pytest.approx(1.0, abs=0.05)
    slow = noise(0.01) + 0.3 * SLOW
    assert measure_excess(*pose(slow, sigma={"y": 100.0}))["log.y"] > 3.0


def test_the_floor_does_not_depend_on_the_scale_of_the_weights():
    problem, z = pose(noise(0.3) + 0.5 * SLOW)
    other = replace(problem, experiments=tuple(replace(e, sigma=7.0 * e.sigma) for e in problem.experiments))
    assert measure_excess(other, z)["log.y"] == pytest.approx(measure_excess(problem, z)["log.y"], rel=1e-12)


@pytest.mark.parametrize(("between", "shift"), [(4, 0.0), (4, 0.3), (10, 0.0)])
def test_an_output_on_lines_between_slower_readings_has_their_noise(between, shift):
    """Its neighbours are on one line, whose second differences are no noise: a right model had five times it."""
    rows = np.arange(N)
    own = np.arange(-between, N + between, between) + shift
    error = np.random.default_rng(1).normal(scale=0.3, size=own.size)
    excess = measure_excess(*pose(np.interp(rows, own, 2.0 * np.sin(own * 2e-3) + error) - 2.0 * SLOW))
    assert excess["log.y"] == pytest.approx(1.0, abs=0.3)


@pytest.mark.parametrize("shift", [0.0, 0.37])
def test_lines_between_slower_readings_do_not_hide_a_slow_error(shift):
    own = np.arange(-10, N + 10, 10) + shift
    readings = 2.0 * np.sin(own * 2e-3) + 0.1 * np.sin(2 * np.pi * 10.0 * own * 1e-3)
    readings += np.random.default_rng(1).normal(scale=0.01, size=own.size)
    assert measure_excess(*pose(np.interp(np.arange(N), own, readings) - 2.0 * SLOW))["log.y"] > 4.0


def test_a_followed_reading_shakes_the_outputs_with_its_noise():
    """White noise of std s behind g/(p + 1) has g s sqrt(T/2), whatever lies between the samples; where nothing is
    lacking the excess is 1, and what is lacking beside it shows.
    """
    gain, std, period = 30.0, 0.05, 1e-3
    wave = so.plants.Reading(state="s", wave="n", sizes=("g",), friction="")
    plant = so.Plant(
        name="shaken", states={"s": "-", "w": "-"}, inputs={"u": "-"}, outputs={"s": "-", "w": "-"},
        parameters={"a": "-", "g": "-", "n": "-"}, followed={"s_read": wave}, ports=(so.plants.Port(motion="s"),),
        f=lambda t, x, u, p: {"s": p.a * u.u - x.s, "w": p.g * u.s_read - x.w}, h=lambda t, x, u, p: vars(x),
    )  # fmt: skip
    params = so.ParameterSet.of(a=(2.0, "-"), g=(gain, "-"), n=(1.0, "-")).free("a")
    log = so.Log.from_arrays(time=np.arange(N) * period, u=SLOW, s=0.0 * SLOW, w=0.0 * SLOW)
    clean = so.simulate(plant, params, log)
    readings = {"s": clean["s"] + noise(std), "w": clean["w"] + noise(1e-3, seed=1)}

    def measure(**extra):
        columns = {name: channel + extra.get(name, 0.0) for name, channel in readings.items()}
        log = so.Log.from_arrays(time=np.arange(N) * period, u=SLOW, **columns)
        bench = so.Experiment(plant=plant, log=log, initial_state="rest", offset=False, name="log")
        problem = pose_problem((bench,), params, loss=Squares())
        z = problem.unknowns.start
        return problem, measure_floors(problem, compute_residuals(problem, z), z)["log"]

    problem, found = measure()
    (experiment,), z = problem.experiments, problem.unknowns.start
    assert experiment.model.plant.read_inputs == ("s_read",)
    expected = [std, np.hypot(gain * std * np.sqrt(period / 2.0), 1e-3)]
    assert found.noise * experiment.sigma == pytest.approx(expected, rel=0.1)
    assert found.excess == pytest.approx(1.0, abs=0.1)
    lacking = 5.0 * expected[1] * np.sqrt(2.0) * np.sin(np.arange(N) * 0.01)
    assert measure(w=lacking)[1].excess[1] == pytest.approx(np.sqrt(1.0 + 25.0), rel=0.1)
    # A shaken run that overflows makes no noise that would explain what is lacking.
    residuals = compute_residuals(problem, z)["log"]
    for far in (1e308, np.nan):
        broken = _add_shaking(experiment, residuals, replace(found, noise=np.array([far, 1.0])), z)
        assert broken.noise[1] == 1.0


@pytest.mark.parametrize("steps", [7.3, 30.0])
@pytest.mark.parametrize("share", [0.0, 0.05, 0.1, 0.2, 0.4])
def test_a_coarse_step_hides_no_noise_of_a_slow_signal(steps, share):
    """Both add up, though neighbours of a slow signal show little of either; a slow error beside them is excess."""
    step = 4.0 / steps
    total = step * np.hypot(share, 1.0 / np.sqrt(12.0))

    def measure(lacking):
        """Return noise and rms over eight places of the steps."""
        places = step * np.arange(8) / 8.0
        readings = (step * np.round((2.0 * SLOW + lacking + noise(share * step) + at) / step) - at for at in places)
        return np.sqrt(np.mean([np.square(floor(reading - 2.0 * SLOW)[:2]) for reading in readings], axis=0))

    assert measure(0.0) == pytest.approx([total, total], rel=0.015)
    assert measure(step * np.sin(np.arange(N) * 7e-4))[0] == pytest.approx(total, rel=0.03)
