"""The best of all linear laws: against closed forms, and never above what is tuned."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import brentq

import seaopt as so
from seaopt.control import DigitalPlant, bound_free_law, sweep
from seaopt.control.frontier import free_law
from seaopt.control.tuning.feasibility import sensitivity_possible
from seaopt.errors import ControlError

BENCHMARKS = Path(__file__).resolve().parents[3] / "benchmarks"
STAND, THOR = so.plants.high_impedance(), so.plants.thor()
LIFTED = {
    "max_sensitivity": False, "max_complementary": False, "max_reference_peak": False, "max_droop_db": False,
    "min_sensitivity_bandwidth_hz": False,
}  # fmt: skip


def delayed_gain(samples, rate_hz, gain=1.0):
    """A gain whose answer comes some samples late, one at least."""
    return DigitalPlant(
        a=np.zeros((1, 1)), b=np.array([gain]), c=np.ones((1, 1)), d=np.zeros(1), sample_time_s=1.0 / rate_hz,
        delay_samples=samples - 1, static_gain=gain,
    )  # fmt: skip


def test_one_sample_late_it_is_the_integral_of_bode_filled_like_water():
    """The least of the integral of |S| dlnf where the integral of ln |S| over all frequencies is zero, |S| <= Ms.

    That is |S| = min(Ms, c f) where it counts and Ms elsewhere; a sensitivity of any such size exists (an outer
    function), and with an answer one sample late nothing else is asked of it.
    """
    rate, ms, band = 200.0, 1.3, 30.0
    spec = so.ControllerSpec(
        structure="pd",
        bandwidth_hz=band,
        sample_rate_hz=rate,
        compute_delay_samples=0,
        **{**LIFTED, "max_sensitivity": ms},
    )
    f = np.linspace(0.1, band, 20_001)

    def area(c):
        return np.trapezoid(np.log(np.minimum(ms, c * f)), f) + (rate / 2 - (band - 0.1)) * np.log(ms)

    c = brentq(area, 1e-6, 10.0)
    least = np.trapezoid(np.minimum(ms, c * f) / f, f)
    found = bound_free_law(delayed_gain(1, rate), spec, functions=60)
    assert found.status == "optimal" and found.missed < 0.05
    assert 0.98 * least < found.bound < 1.08 * least


@pytest.mark.parametrize("late", [1, pytest.param(3, marks=pytest.mark.slow)])
def test_what_a_delay_rules_out_is_impossible(late):
    """Caratheodory and Schur decide it in closed form: `sensitivity_possible`, tested against Bode's integral."""
    rate, ms = 400.0, 1.2
    slow = [f for f in np.geomspace(1.0, 75.0, 400) if sensitivity_possible(f, ms, 1.0 / rate, late)][-1]
    answers: list[str] = []
    for share in (0.9, 1.1):
        spec = so.ControllerSpec(
            structure="pd",
            bandwidth_hz=80.0,
            bandwidth_range_hz=(15.0, 90.0),
            sample_rate_hz=rate,
            compute_delay_samples=0,
            **{**LIFTED, "max_sensitivity": ms, "min_sensitivity_bandwidth_hz": share * slow},
        )
        answers.append(bound_free_law(delayed_gain(late, rate), spec).status)
    assert answers == ["optimal", "impossible"]


@pytest.mark.slow
def test_the_least_noise_of_an_integral_is_the_inverse_of_the_gain():
    """S is zero at 0 Hz, so that Q is 1/P there; and Q = 1/P(0) at all frequencies keeps all limits."""
    spec = so.ControllerSpec(
        bandwidth_hz=30.0, objective="noise", **{**LIFTED, "max_sensitivity": 2.2, "min_sensitivity_bandwidth_hz": 5.0}
    )
    found = bound_free_law(delayed_gain(2, 1000.0, gain=4.0), spec)
    assert found.bound == pytest.approx(0.25, rel=1e-3)


def measured_by(spec, controller, plant=STAND, params=THOR):
    """What the objective of a controller is, by NumPy alone."""
    law, ts = controller.law, spec.sample_time_s
    f = np.geomspace(0.1, spec.bandwidth_hz, 2001)
    if spec.objective == "noise":
        f = np.concatenate([np.geomspace(1e-3, 0.5 / ts, 20_001), f])
    z = np.exp(2j * np.pi * f * ts)
    states = np.linalg.solve(
        z[:, None, None] * np.eye(len(law.a)) - law.a, np.tile(law.b[:, 1:] + 0j, (z.size, 1, 1))
    )[:, :, 0]  # fmt: skip
    c_y = -(states @ law.c + law.d[1])
    p = controller.plant(plant, params).response(f)
    s = 1.0 / (1.0 + p * c_y)
    return float(np.max(np.abs(c_y * s)) if spec.objective == "noise" else np.trapezoid(np.abs(s), np.log(f)))


@pytest.mark.slow
def test_no_tuned_law_is_better_than_the_bound():
    spec = so.ControllerSpec(bandwidth_hz=30, max_sensitivity=1.6, max_noise_gain=25)
    tuned = so.tune(STAND, THOR, spec)
    own = measured_by(spec, tuned)
    plant = tuned.plant(STAND, THOR)
    found = bound_free_law(plant, spec)
    assert found.status == "optimal" and 0.8 * own < found.bound <= own
    assert found.reached == pytest.approx(found.bound, rel=5e-3) and found.missed < 0.01
    fewer = bound_free_law(plant, spec, functions=12)
    assert fewer.bound >= found.bound * (1.0 - 1e-3)
    assert bound_free_law(plant, spec, [tuned.law], functions=1).bound <= own * 1.001


@pytest.mark.slow
@pytest.mark.parametrize("part", range(4))
def test_no_tuned_law_of_a_dozen_specifications_is_better_than_the_bound(monkeypatch, part):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    import bench_tune as bench

    rng, compared = np.random.default_rng((7, part)), 0
    while compared < 3:
        case = bench.draw(rng)
        controller = so.tune(case.plants[0], case.params, case.spec)
        if not controller.feasible:
            continue
        found = bound_free_law(controller.plant(STAND, case.params), case.spec)
        assert found.status == "optimal"
        assert found.bound <= measured_by(case.spec, controller, STAND, case.params) * (1.0 + 1e-3)
        compared += 1


def draw_plant(rng, rate):
    """A mode and a lag, sampled, some samples late."""
    mode = np.exp(2 * np.pi * rng.uniform(2.0, 40.0) / rate * np.exp(1j * rng.uniform(1.7, 2.9)))
    a = np.array([[mode.real, mode.imag, 0.3], [-mode.imag, mode.real, 0.0], [0.0, 0.0, rng.uniform(0.3, 0.9)]])
    b, c = np.array([0.0, 0.0, 1.0]), np.array([1.0, rng.uniform(-1.0, 1.0), 0.0])
    gain = float(c @ np.linalg.solve(np.eye(3) - a, b))
    return DigitalPlant(
        a=a,
        b=b / gain,
        c=c[None],
        d=np.zeros(1),
        sample_time_s=1.0 / rate,
        delay_samples=int(rng.integers(0, 3)),
        static_gain=1.0,
    )


def integrate_by_hand(plant, spec, functions, x):
    """Return the integral of abs(S) on 40,000 frequencies, of coefficients of Laguerre's functions and exponentials."""
    f, ts = np.geomspace(0.1, spec.bandwidth_hz, 40_001), plant.sample_time_s
    z = np.exp(2j * np.pi * f * ts)
    a = np.exp(-2 * np.pi * min(2.0 * spec.bandwidth_hz, 0.2 / ts) * ts)
    q = sum(x[k] * np.sqrt(1 - a * a) * z * (1 - a * z) ** k / (z - a) ** (k + 1) for k in range(functions))
    for coefficient, corner in zip(x[functions:], np.geomspace(0.01, spec.bandwidth_hz, 12), strict=True):
        pole = np.exp(-2 * np.pi * corner * ts)
        q = q + coefficient * (1 - pole) * z / (z - pole)
    p = (
        np.array([plant.c[0] @ np.linalg.solve(one * np.eye(3) - plant.a, plant.b) for one in z])
        / z**plant.delay_samples
    )
    return np.trapezoid(np.abs(1.0 - p * q), np.log(f))


@pytest.mark.parametrize("seed", [*range(2), *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(2, 12))])
def test_the_bound_is_below_its_own_answer_and_close(monkeypatch, seed):
    rng, solve, answers = np.random.default_rng(seed), free_law._LinearProgram.solve, []
    monkeypatch.setattr(free_law._LinearProgram, "solve", lambda self: answers.append(solve(self)) or answers[-1])
    rate, functions = float(rng.choice([400.0, 1000.0])), 8 if seed < 2 else int(rng.integers(10, 40))
    spec = so.ControllerSpec(
        structure=str(rng.choice(["pd", "pid"])), bandwidth_hz=float(rng.uniform(15.0, 40.0)), sample_rate_hz=rate,
        **{**LIFTED, "max_sensitivity": float(rng.uniform(1.3, 2.0)), "min_sensitivity_bandwidth_hz": 1.0},
    )  # fmt: skip
    plant = draw_plant(rng, rate)
    found = bound_free_law(plant, spec, functions=functions)
    assert found.status == "optimal"
    answer = integrate_by_hand(plant, spec, functions, answers[0][1])
    assert found.bound <= answer * (1.0 + 1e-9)
    assert found.reached == pytest.approx(answer, rel=1e-4)
    assert found.bound >= 0.9 * answer


def test_a_plant_that_grows_has_no_bound_and_no_functions_are_refused():
    growing = DigitalPlant(
        a=np.array([[1.01]]),
        b=np.ones(1),
        c=np.ones((1, 1)),
        d=np.zeros(1),
        sample_time_s=1e-3,
        delay_samples=1,
        static_gain=-100.0,
    )
    assert bound_free_law(growing, so.ControllerSpec(bandwidth_hz=30)).status == "unstable plant"
    with pytest.raises(ControlError, match="functions = 0"):
        bound_free_law(delayed_gain(1, 1000.0), so.ControllerSpec(bandwidth_hz=30), functions=0)


def test_a_sweep_has_the_free_law_beside_each_row():
    spec = so.ControllerSpec(max_sensitivity=1.6, max_noise_gain=25)
    frontier = sweep(STAND, THOR, spec, [25], free_law=True)
    (row,) = frontier.rows
    assert row.free_law.objective == "disturbance" and row.free_law.bound < row.disturbance
    assert "free law" in repr(frontier)
    assert frontier.to_dict()["rows"][0]["free_law"]["bound"] == row.free_law.bound
    assert frontier.plot.disturbance() is not None
