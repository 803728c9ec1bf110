"""The reference's weights, on actuators with friction: by the benchmark's own equations, and a long search."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import control
import numpy as np
import pytest
from scipy.linalg import expm

import seaopt as so
from seaopt.control.tuning.convex_concave import linearise_law
from seaopt.control.tuning.frequencies import place_frequencies
from seaopt.control.tuning.starts import find_starts
from seaopt.control.tuning.tuner import make_task

# The integral of |S| of the best law that scipy's differential evolution finds in k_p, k_i, k_d, T_f, c and k_r, run to
# its convergence (16 to 31 s) on the benchmark's own equations: bench_tune_friction.py --cases 0 --times 60. Two seeds
# agree to five digits, and keep the tuner's reserve.
SEARCHED = {10.0: 1.6346, 15.0: 2.0144, 20.0: 2.2754, 25.0: 2.4730, 30.0: 2.6372, 40.0: 2.9301}
BENCHMARKS = Path(__file__).resolve().parents[3] / "benchmarks"


@pytest.fixture
def bench(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    import bench_tune_friction

    return bench_tune_friction


@pytest.mark.parametrize(
    "bandwidth_hz", [f if f in (10.0, 20.0, 40.0) else pytest.param(f, marks=pytest.mark.slow) for f in SEARCHED]
)
def test_the_actuator_with_friction_has_every_bandwidth(bench, bandwidth_hz):
    """Sliding and stuck from the equations of motion; the objective against that of a differential evolution."""
    case = bench.Case(bench.ISSUE, bandwidth_hz)
    controller = case.tune()
    judge, law = bench.Judge(case), bench.of_controller(controller)
    usage, stable, value = judge.judge(law[None])
    assert controller.feasible and stable[0]
    assert usage[0] <= 1 + 1e-4
    assert judge.radius(law) < 1
    assert controller.achieved.bandwidth_hz == pytest.approx(bandwidth_hz, rel=0.005)
    assert value[0] <= 1.02 * SEARCHED[bandwidth_hz]


@pytest.mark.slow
def test_neighbours_of_an_impossible_bandwidth_are_named(bench):
    """Below its resonance this actuator needs the weights: without them only what is well above it is possible."""
    case = bench.Case(bench.ISSUE, 25.0)
    stand, params = so.plants.high_impedance(), so.plants.thor().update(**bench.ISSUE)
    spec = replace(case.spec, reference_weights="error", max_noise_gain=40.0, bandwidth_range_hz=(20.0, 46.0))
    controller = so.tune(stand, params, spec)
    assert not controller.feasible
    possible = controller.possible
    assert possible.nearest_hz and possible.largest_hz == controller.largest_bandwidth_hz >= max(possible.nearest_hz)
    assert f"{possible.nearest_hz[0]:.4g} Hz" in controller.explanation
    assert "possible" in controller.explanation and controller.explanation.endswith("(tuned, not certified)")
    for f in possible.nearest_hz:
        assert so.tune(stand, params, replace(spec, bandwidth_hz=f)).feasible


@pytest.mark.slow
def test_what_misses_its_limits_misses_them_least(bench):
    """With feedback of the error nothing near 10 Hz is good: 4.28 of the worst limit is the least that can be had.

    So says a differential evolution in k_p, k_i, k_d and T_f on the benchmark's equations, a missed bandwidth counting
    ten times (8 s, seed 1).
    """
    case = bench.Case(bench.ISSUE, 10.0)
    stand, params = so.plants.high_impedance(), so.plants.thor().update(**bench.ISSUE)
    controller = so.tune(stand, params, replace(case.spec, reference_weights="error"))
    judge, law = bench.Judge(case), bench.of_controller(controller)[None]
    usage, stable, _ = judge.judge(law)
    p, (c_y, c_r) = judge.p[0][judge.at], (c[0, judge.at] for c in judge.law(law))
    miss = abs(np.log(np.sqrt(2.0) * abs(p * c_r / (1.0 + p * c_y))))
    assert not controller.feasible and stable[0]
    assert judge.radius(law[0]) < 1.0
    assert max(usage[0], 1.0 + 10.0 * miss) <= 1.02 * 4.277


@pytest.mark.slow
def test_where_nothing_is_possible_the_least_miss_is_named(bench):
    case = bench.Case(bench.ISSUE, 25.0)
    spec = replace(case.spec, max_noise_gain=1.2, bandwidth_range_hz=(20.0, 30.0))
    controller = so.tune(so.plants.high_impedance(), so.plants.thor().update(**bench.ISSUE), spec)
    possible = controller.possible
    assert not controller.feasible and possible.nearest_hz == () and possible.largest_hz is None
    assert 6.0 <= possible.closest_hz <= 60.0 and possible.missed_by > 0.0  # the range has no say in what is found
    assert f"at {possible.closest_hz:.4g} Hz, where the least is missing, " in controller.explanation
    assert controller.achieved.stable and controller.gains["k_i"] >= 2 * np.pi * 0.05 * (1 + controller.gains["k_p"])


@pytest.mark.parametrize("structure", ["pd", "pid", "pid_dob"])
def test_the_static_gain_is_one(stand, thor, structure):
    """By the law's matrices and the plant's own static gain, 1 from effort to F1."""
    controller = so.tune(stand, thor, so.ControllerSpec(structure=structure, bandwidth_hz=25, max_noise_gain=60))
    gains = controller.gains
    law, z = controller.law, np.exp(2j * np.pi * 1e-5 * controller.sample_time_s)
    c_r, c_y = (law.c @ np.linalg.solve(z * np.eye(law.c.shape[-1]) - law.a, law.b) + law.d).ravel()[:2] * [1.0, -1.0]
    assert abs(c_r / (1 + c_y)) == pytest.approx(1.0, abs=1e-4)
    if gains["k_i"] == 0.0:
        assert gains["k_r"] == pytest.approx(1.0 + gains["k_p"], rel=1e-12)
    assert 0.0 <= gains["k_r"] <= 1.0 + gains["k_p"] and 0.0 <= gains["c"] <= 1.0


def test_starts_have_the_bandwidth_and_the_law_is_affine(bench):
    """The closed form against the law itself, and the linearisation against a change, exactly."""
    case = bench.Case(bench.ISSUE, 20.0)
    params = so.plants.thor().update(**bench.ISSUE)
    task = make_task(so.plants.high_impedance(), params, case.spec, {})
    grid = task.grid(place_frequencies(task))
    starts = find_starts(task, grid, 3)
    assert max(abs(task.miss(grid, task.respond(grid, x))) for x in starts) < 1e-9
    assert any(x[3] > 0.0 for x in starts)
    x, change = starts[0], np.array([0.3, 2.0, 1e-3, 0.2, 1e-3])
    moved = x.copy()
    moved[task.gains_tuned] += change
    law, after = linearise_law(task, grid, x), task.respond(grid, moved)
    np.testing.assert_allclose(after.c_r - law.law.c_r, change @ law.by_r, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(after.c_y - law.law.c_y, change @ law.by_y, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("reference_weights", ["tuned", "measurement"])
def test_a_slow_integral_is_left_no_more_than_it_takes_away(stand, swing, thor, reference_weights):
    """THOR with a light drive, sample by sample from its equation of motion: within 2 % after 80 periods.

    The objective makes the integral as slow as it may be, and the weights alone would leave it 11 % of a step.
    """
    params = thor.update(J=2.6e-6, b_r=1.2e-4, k=450e3, I_p=0.76, m=3.5)
    spec = so.ControllerSpec(
        bandwidth_hz=20, max_sensitivity=1.5, max_noise_gain=27, reference_weights=reference_weights
    )
    controller = so.tune(stand, params, spec, {"swing": swing})
    assert controller.feasible
    ts, g, r = 1e-3, controller.gains, 2e-3 / (2 * np.pi * 3)
    inertia, damping = 2.6e-6 / r**2 + 0.646, 1.2e-4 / r**2
    a = expm(ts * np.array([[0.0, 1.0, 0.0], [-450e3 / inertia, -damping / inertia, 1 / inertia], [0.0, 0.0, 0.0]]))
    x, late, total, before, slope, force = np.zeros(2), 0.0, 0.0, 0.0, 0.0, np.zeros(5001)
    last = None
    for step in range(force.size):
        force[step] = y = 450e3 * x[0]
        error, rate = 1.0 - y, g["c"] - y
        total += 0.5 * ts * (error + before)
        slope = (g["T_f"] * slope + rate - (0.0 if last is None else last)) / (g["T_f"] + ts)
        before, last = error, rate
        x = a[:2, :2] @ x + a[:2, 2] * late
        late = g["k_r"] - g["k_p"] * y + g["k_i"] * total + g["k_d"] * slope
    assert np.mean(np.abs(force[4000:] - 1.0)) < 0.02
    assert abs(force[4000] - 1.0) < 0.02 < 1.0 - g["k_r"] / (1.0 + g["k_p"])


def test_the_limit_on_a_slow_integral_hides_no_law(stand, thor):
    """Far from active here, it led to none where it was kept throughout: 27.6 and 32.2 Hz were named instead.

    That the limits are kept is judged on frequencies of the test's own, on python-control's loop from the gains.
    """
    params = thor.update(m_l=0.66002, k=496805.0, J=4.8437580e-06, b_r=5.38105e-05, I_p=0.249429)
    spec = so.ControllerSpec(
        bandwidth_hz=31.708939762846857, sample_rate_hz=2000, compute_delay_samples=0, max_sensitivity=2.1443225,
        max_noise_gain=45.385258, max_complementary=1.40447057, max_reference_peak=False, max_droop_db=False,
        min_filter_samples=False,
    )  # fmt: skip
    controller = so.tune(stand, params, spec)
    assert controller.feasible
    g, ts = controller.gains, 5e-4
    integral, rate = control.tf([ts / 2, ts / 2], [1, -1], ts), control.tf([1, -1], [g["T_f"] + ts, -g["T_f"]], ts)
    c_y = g["k_p"] + g["k_i"] * integral + g["k_d"] * rate
    omega = 2 * np.pi * np.geomspace(1e-2, 999.0, 20_000)
    plant = control.c2d(stand.linearize(params)[0, 0] * controller.command.per_effort, ts)
    p, c = (part(np.exp(1j * omega * ts)) for part in (plant, c_y))
    for size, allowed in ((1.0, 2.1443225), (p * c, 1.40447057), (c, 45.385258)):
        assert np.max(np.abs(size / (1.0 + p * c))) <= allowed
    assert np.all(np.abs(control.feedback(plant * c_y, 1).poles()) < 1.0)
