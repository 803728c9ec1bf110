"""Laws tuned on measured frequency responses: discs against the plants in them, stability against eigenvalues.

The truth is the stand of Orekhov et al., from its equations by SciPy; `bench_measured.judge` closes the loop itself.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import expm

import seaopt as so
from seaopt.bench import Chirp, Noise
from seaopt.control import Gains, Loop, sweep
from seaopt.control.laws.controller import Controller
from seaopt.control.laws.delay import count_response_samples
from seaopt.control.loops.measured.loop import LEFT, DiscLoop, bound_disc, leave_positive, measure_discs
from seaopt.control.loops.measured.plant import sample_measured
from seaopt.control.tuning.tuner import make_task
from seaopt.errors import ControlError, LogError
from seaopt.files import to_json
from seaopt.simulation import Clock

BENCHMARKS = Path(__file__).resolve().parents[3] / "benchmarks"
STAND, THOR = so.plants.high_impedance(), so.plants.thor()
RADIUS = 0.002 / (2 * np.pi * 3.0)
MASS, DAMPING, STIFF = 0.646 + 3.31e-6 / RADIUS**2, 1.31e-4 / RADIUS**2, 655e3
PER_AMPERE = 0.0255 / RADIUS
X = {
    "1": lambda p, c, r: 1.0, "L": lambda p, c, r: p * c, "1 - L": lambda p, c, r: 1.0 - p * c,
    "C_y": lambda p, c, r: c, "P C_r": lambda p, c, r: p * r,
}  # fmt: skip


@pytest.fixture
def bench(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    import bench_measured

    return bench_measured


def respond(f, period, late=0):
    """The true response of held samples from motor force to F1."""
    a = np.zeros((3, 3))
    a[:2] = [[0.0, 1.0, 0.0], [-STIFF / MASS, -DAMPING / MASS, STIFF / MASS]]
    step = expm(a * period)
    z = np.exp(2j * np.pi * np.asarray(f) * period)
    states = np.linalg.solve(z[:, None, None] * np.eye(2) - step[:2, :2], np.tile(step[:2, 2:], (z.size, 1, 1)))
    return states[:, 0, 0] * z**-late


def exact(period, low=0.3, high=120.0, hold="zero", delay_s=0.0, relative=0.0):
    """A response measured without error, at a log's samples."""
    f = np.arange(low, high, 0.25)
    if hold == "zero":
        p = respond(f, period) * np.exp(-2j * np.pi * f * delay_s)
    else:  # a straight line between samples: all images of the continuous plant, by sinc^2
        k = np.arange(-400, 401)[:, None] / period
        s = 2j * np.pi * (f + k)
        plant = STIFF / (MASS * s**2 + DAMPING * s + STIFF)
        p = np.sum(plant * np.exp(-s * delay_s) * np.sinc((f + k) * period) ** 2, axis=0)
    return so.MeasuredResponse(
        name="chirp", plant=STAND, source="I", output="F1", clock=Clock(period=period, hold=hold, delay_s=delay_s),
        frequency_hz=f, response=p * PER_AMPERE, radius=relative * np.abs(p) * PER_AMPERE, confidence=0.95,
        averages=np.full(f.size, 100),
    )  # fmt: skip


def noisy_log(seed, duration_s=40.0, rate_hz=1000.0, noise=1.0):
    parts = (Chirp(amplitude=4.0, f0_hz=0.1, f1_hz=150.0), Noise(std=2.0, band_hz=200.0))
    return so.virtual_log(
        STAND, THOR, parts, duration_s=duration_s, rate_hz=rate_hz, seed=seed,
        sensors=so.Sensors(noise_std={"F1": noise}),
    )  # fmt: skip


@pytest.mark.parametrize("of", list(X))
def test_the_extremes_over_a_disc_are_those_of_many_responses_in_it(of):
    rng = np.random.default_rng(1)
    p, c, c_r = (rng.normal(size=40) + 1j * rng.normal(size=40) for _ in range(3))
    r = 0.3 * rng.uniform(size=40) * np.abs(1.0 + p * c) / np.abs(c)
    least, most = bound_disc(of, p, r, c, c_r)
    angles = np.exp(2j * np.pi * np.linspace(0.0, 1.0, 4001))[:, None]
    edge = p + r * angles
    sizes = np.abs(X[of](edge, c, c_r) / (1.0 + edge * c))
    assert np.allclose(np.max(sizes, axis=0), most, rtol=1e-5)
    holds_zero = least == 0.0  # X has a zero inside, which the edge does not show
    assert np.allclose(np.min(sizes, axis=0)[~holds_zero], least[~holds_zero], rtol=1e-3, atol=1e-5)


@pytest.mark.parametrize("seed", [1, 2])
def test_the_discs_hold_the_truth(seed):
    measured = so.measure_response(STAND, noisy_log(seed), "F1")
    truth = PER_AMPERE * respond(measured.frequency_hz, 1e-3)
    away = np.abs(truth - measured.response) / measured.radius
    assert np.max(away) <= 1.0
    assert np.median(away) > 0.02  # and are not needlessly large
    assert np.median(measured.radius / np.abs(truth)) < 0.05


@pytest.mark.slow
def test_the_discs_hold_the_truth_as_often_as_stated():
    held = 0
    for seed in range(100, 160):
        measured = so.measure_response(STAND, noisy_log(seed, duration_s=20.0), "F1", confidence=0.5)
        truth = PER_AMPERE * respond(measured.frequency_hz, 1e-3)
        held += bool(np.all(np.abs(truth - measured.response) <= measured.radius))
    assert held >= 30


@pytest.mark.parametrize("of", [*X, "C_v"])
def test_the_extremes_over_two_discs_hold_those_of_many_responses_in_them(of):
    """Of what is read besides, too: of all but the tracking exact, of that a bound that is not far off."""
    rng = np.random.default_rng(2)
    p, other, c, c_v, c_r = (rng.normal(size=30) + 1j * rng.normal(size=30) for _ in range(5))
    whole = np.abs(1.0 + p * c + other * c_v)
    r, r_other = 0.2 * whole / np.abs(c), 0.15 * rng.uniform(size=30) * whole / np.abs(c_v)
    least, most = bound_disc(of, p, r, c, c_r, 1.0 + other * c_v, r_other * np.abs(c_v), c_v)
    at = np.exp(2j * np.pi * np.linspace(0.0, 1.0, 361))
    first, second = (p + r * at[:, None])[:, None], (other + r_other * at[:, None])[None]
    loop = first * c + second * c_v
    sizes = np.abs({
        "1": 1.0, "L": loop, "1 - L": 1.0 - loop, "C_y": c, "C_v": c_v, "P C_r": first * c_r
    }[of] / (1.0 + loop))  # fmt: skip
    high, low = np.max(sizes, axis=(0, 1)), np.min(sizes, axis=(0, 1))
    rounding, far = (1e-3, 1.35) if of == "P C_r" else (1e-3, 1.001)
    assert np.all(high <= most * (1.0 + rounding)) and np.all(most <= far * high)
    assert np.all(least <= low * (1.0 + rounding) + 1e-9)
    holds_zero = least == 0.0
    assert np.all(low[~holds_zero] <= (1.6 if of == "P C_r" else 1.01) * least[~holds_zero] + 1e-3)


@pytest.mark.parametrize("negative", [1.0, -1.0])
def test_below_the_band_a_speed_is_that_of_a_position_at_rest(negative):
    """A speed that is the rate of F1. At the lowest point the true size is 1.04e-3 above that at rest."""
    own = replace(exact(1e-3), output="qd", plant=STAND)
    f = own.frequency_hz
    rate = negative * 2j * np.pi * own.response * f
    (output,) = sample_measured([replace(own, response=rate)], 1.0 / PER_AMPERE, 1e-3, 1).outputs
    slow = np.geomspace(1e-3, 0.29, 40)
    truth = negative * 2j * np.pi * slow * respond(slow, 1e-3, late=1)
    assert output.is_speed and output.static_gain == 0.0
    assert np.max(np.abs(output.response(slow) / truth - 1.0)) < 1.1e-3
    with pytest.raises(ControlError, match="excite lower frequencies"):
        sample_measured([replace(own, output="F1", response=rate)], 1.0, 1e-3, 1)


def test_at_the_same_rate_a_log_is_what_the_controller_sees():
    (plant,) = sample_measured([exact(1e-3)], 1.0 / PER_AMPERE, 1e-3, 2).outputs
    assert np.allclose(plant.centre, respond(plant.f, 1e-3, late=2), rtol=1e-12)
    assert np.all(plant.radius == 0.0)


@pytest.mark.parametrize("hold", ["zero", "first"])
@pytest.mark.parametrize("period", [2.5e-3, 0.5e-3, 0.7e-3])
def test_at_another_rate_or_hold_the_discs_hold_what_the_controller_sees(period, hold):
    (plant,) = sample_measured([exact(period, hold=hold)], 1.0 / PER_AMPERE, 1e-3, 1).outputs
    truth = respond(plant.f, 1e-3, late=1)
    assert np.all(np.abs(plant.centre - truth) <= plant.radius + 1e-9)
    slow = plant.f < 30.0
    assert np.max(plant.radius[slow] / np.abs(truth[slow])) < 0.05


def test_above_the_band_the_discs_hold_a_plant_that_falls():
    (plant,) = sample_measured([exact(1e-3, high=60.0)], 1.0 / PER_AMPERE, 1e-3, 1).outputs
    f = np.linspace(plant.f[-1] + 0.01, 499.0, 500)
    assert np.all(plant.response(f) == 0.0)
    assert np.all(np.abs(respond(f, 1e-3, late=1)) <= plant.discs(f))


def test_a_delay_that_is_in_the_log_is_not_added_again():
    (plant,) = sample_measured([exact(1e-3, delay_s=1e-3)], 1.0 / PER_AMPERE, 1e-3, 2).outputs
    assert np.allclose(plant.centre, respond(plant.f, 1e-3, late=3), rtol=1e-9)
    older = so.ControllerSpec(delay_samples=1)
    assert count_response_samples(older, exact(1e-3, delay_s=4e-4)) == pytest.approx(0.6)
    with pytest.raises(ControlError, match="delay of 4 ms and delay_samples = 1"):
        count_response_samples(older, exact(1e-3, delay_s=4e-3))


def test_a_response_that_has_not_come_to_rest_is_refused():
    with pytest.raises(ControlError, match="excite lower frequencies"):
        sample_measured([exact(1e-3, low=6.0)], 1.0, 1e-3, 1)


def test_stability_is_that_of_the_eigenvalues():
    plant = sample_measured([exact(1e-3, relative=1e-3)], 1.0 / PER_AMPERE, 1e-3, 1)
    model = so.tune(STAND, THOR, so.ControllerSpec(bandwidth_hz=30)).plant(STAND, THOR)
    rng, found = np.random.default_rng(3), []
    for _ in range(60):
        k_p, k_i, k_d = np.exp(rng.uniform(np.log([0.1, 0.1, 1e-3]), np.log([40.0, 2000.0, 0.4])))
        law = Gains(k_p=k_p, k_i=k_i, k_d=k_d, T_f=2e-3, k_r=1.0 + k_p).law("pid", 1e-3)
        loop, disc = Loop(plant=model, law=law), DiscLoop(plant=plant, law=law)
        stable = loop.is_stable()
        if stable and loop.figures().ms > 20.0:
            continue  # so close to -1 that a disc may reach it
        assert disc.is_stable() == stable
        found.append(stable)
        if stable and loop.figures().ms < 4.0:
            figures, worst = loop.figures(), disc.figures()
            for name in ("ms", "mt", "noise_gain"):
                assert getattr(figures, name) <= getattr(worst, name) <= 1.05 * getattr(figures, name)
            assert worst.disk_margin <= figures.disk_margin
            assert figures.delay_margin_s is None or worst.delay_margin_s <= figures.delay_margin_s
    assert 10 < sum(found) < len(found) - 10


def test_a_law_tuned_on_a_log_alone_keeps_its_limits_on_the_plant(bench):
    controller, measured = bench.tune_on_log(1, 1000.0, 100.0)
    assert controller.feasible
    figures = bench.judge(controller)
    assert bench.keeps(figures, bench.SPEC)
    (own,) = controller.measured
    assert own.stable and own.bandwidth_hz[0] <= figures["bandwidth_hz"] <= own.bandwidth_hz[1]
    assert figures["ms"] <= own.ms and figures["mt"] <= own.mt and figures["noise"] <= own.noise_gain
    assert measured.confidence == own.confidence == 0.95
    again = Controller.from_dict(json.loads(to_json(controller.to_dict())), measured, THOR)
    assert again.feasible and again.measured == controller.measured


@pytest.mark.slow
@pytest.mark.parametrize("rate", [400.0, 1000.0, 2000.0])
def test_laws_tuned_on_logs_keep_their_limits_on_the_plant(bench, rate):
    for seed in range(200, 204):
        controller, _ = bench.tune_on_log(seed, rate, 164.0)
        assert controller.feasible
        assert bench.keeps(bench.judge(controller), bench.SPEC)


@pytest.mark.slow
def test_wide_discs_cost():
    spec = so.ControllerSpec(bandwidth_hz=30, max_sensitivity=1.6)
    narrow, wide = (so.tune(exact(1e-3, relative=r), THOR, spec) for r in (1e-3, 0.015))
    assert narrow.feasible and wide.feasible
    grid = np.geomspace(0.1, 30.0, 400)
    sizes = [
        float(np.trapezoid(np.abs(Loop(plant=sampled(), law=one.law).sensitivity(grid)), np.log(grid)))
        for one in (narrow, wide)
    ]
    assert sizes[0] < sizes[1]


@pytest.mark.slow
def test_too_wide_discs_are_not_feasible():
    assert not so.tune(exact(1e-3, relative=0.2), THOR, so.ControllerSpec(bandwidth_hz=30)).feasible


def sampled():
    return so.tune(STAND, THOR, so.ControllerSpec(bandwidth_hz=30)).plant(STAND, THOR)


def test_beside_a_model_the_limits_hold_on_the_discs_too():
    spec = so.ControllerSpec(bandwidth_hz=30, max_sensitivity=1.6)
    other = replace(exact(1e-3, relative=0.02), response=1.4 * exact(1e-3).response)  # 40 % more gain than the model
    alone, both = so.tune(STAND, THOR, spec), so.tune(STAND, THOR, spec, {"frf:chirp": other})
    plant = both.spec.see_response(other, both.command)
    assert measure_discs(plant, alone.law, 30.0).ms > 1.6
    assert both.feasible and measure_discs(plant, both.law, 30.0).ms <= 1.6
    assert "frf:chirp" in both.robust_to
    passed, failed = (
        so.certify(one, {"stand": STAND}, THOR, simulations=False, measured={"frf:chirp": other})
        for one in (both, alone)
    )
    assert passed.passed and not failed.passed
    rows = [row for row in failed.requirements if row.plant == "frf:chirp"]
    assert {row.name for row in rows if not row.met} >= {"max_sensitivity"}


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"passive_band_hz": (1.0, 5.0)}, "passive_band_hz takes a model"),
        ({"measured": "F2"}, "measured at the output F1"), ({"min_friction_margin": 1.0}, "takes a model"),
    ],
)  # fmt: skip
def test_what_takes_a_model_is_refused(change, said):
    with pytest.raises(ControlError, match=said):
        make_task(exact(1e-3), THOR, so.ControllerSpec(**{"bandwidth_hz": 30.0, **change}), {})


def test_a_log_without_excitation_or_confidence_is_refused():
    log = noisy_log(1, duration_s=10.0)
    with pytest.raises(LogError, match="confidence"):
        so.measure_response(STAND, log, "F1", confidence=1.0)
    with pytest.raises(LogError, match="coherent"):
        so.measure_response(STAND, noisy_log(1, duration_s=10.0, noise=1e4), "F1")


def test_what_is_left_of_a_measured_loop_is_positive_and_smooth():
    at, step = np.array([0.5, LEFT, -0.1]), 1e-6
    assert leave_positive(at)[:2] == pytest.approx(at[:2])
    assert leave_positive(at)[2] > 0
    slopes = (leave_positive(LEFT + np.array([0.0, step])) - leave_positive(LEFT - np.array([step, 0.0]))) / step
    assert slopes == pytest.approx([1.0, 1.0], abs=1e-4)


def test_a_schedule_whose_design_plant_is_measured_is_not_swept():
    with pytest.raises(ControlError, match="over = k: a measured response stands at one value"):
        sweep(exact(1e-3), THOR, so.ControllerSpec(), [20], over="k", points=[5e5, 6e5])
