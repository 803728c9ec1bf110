"""Disturbance observer and notch, against their definitions; scenarios; what no controller can do."""

from __future__ import annotations

import control
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import bilinear, lfilter

import seaopt as so
from seaopt.control import Controller, DisturbanceObserver, Gains, Notch, command_of, corners, draw, sample
from seaopt.control.laws.structures import Nominal
from seaopt.control.tuning.feasibility import sensitivity_possible
from seaopt.errors import ControlError
from seaopt.robustness import place_value
from tests.control.loops.test_loop import independent

TS = 1e-3


def digital(plant, params, delay=1):
    return sample(plant, params, "F1", command_of(plant, params, "F1").per_effort, TS, delay)


def test_the_observer_is_the_written_one(stand, thor):
    """Sample by sample: F_m = v - Q(F_meas/P_n - F_m), Q F_m from past outputs alone."""
    plant = digital(stand, thor)
    gains = Gains(
        k_p=2.0,
        k_i=5.0,
        k_d=0.03,
        T_f=2e-3,
        k_r=3.0,
        observer=DisturbanceObserver(nominal=Nominal.of(plant), T_q=5e-3),
    )
    q, q_over_p = gains.observer.filters(TS)
    assert q.num[0] == 0.0
    rng = np.random.default_rng(1)
    ref, meas = rng.normal(size=(2, 300))
    e, out = ref - meas, np.zeros(300)
    integral = np.cumsum(5.0 * TS / 2 * (e + np.r_[0.0, e[:-1]]))
    rate = lfilter([1, -1], [2e-3 + TS, -2e-3], e)
    v = ref + 2.0 * e + integral + 0.03 * rate - lfilter(q_over_p.num, q_over_p.den, meas)
    for k in range(300):
        out[k] = v[k] + lfilter(q.num, q.den, out[: k + 1])[k]
    c_r, c_y = gains.law("pid_dob", TS).transfer_functions()
    np.testing.assert_allclose(lfilter(c_r.num, c_r.den, ref) - lfilter(c_y.num, c_y.den, meas), out, rtol=1e-6)


@pytest.mark.parametrize("options", [{}, {"parts": ("screw_mode",)}, {"drive": "lumped", "spring": "link2"}])
def test_the_nominal_inverse_is_stable_and_exact(thor, options):
    """Q/P_n times the plant, from its matrices, is Q; and Q is 1 at 0 Hz."""
    stand = so.plants.high_impedance(**options)
    plant = digital(stand, stand.complete(thor), delay=2)
    observer = DisturbanceObserver(nominal=Nominal.of(plant), T_q=4e-3)
    q, q_over_p = observer.filters(TS)
    f = np.geomspace(0.5, 490, 60)
    z = np.exp(2j * np.pi * f * TS)
    p = (
        np.array([plant.c[0] @ np.linalg.inv(x * np.eye(len(plant.b)) - plant.a) @ plant.b + plant.d[0] for x in z])
        / z**2
    )
    np.testing.assert_allclose(q_over_p.response(f, TS) * p, q.response(f, TS), rtol=1e-6, atol=1e-9)
    assert np.abs(np.roots(q_over_p.den)).max() < 1
    assert q.num.sum() / q.den.sum() == pytest.approx(1.0)


def test_the_notch_is_scipys_bilinear_transform():
    notch, w = Notch(frequency_hz=80.0, width=0.3, depth=0.1), 2 * np.pi * 80.0
    prewarped = w / np.tan(w * TS / 2) / 2
    num, den = bilinear([1, 2 * 0.1 * 0.3 * w, w**2], [1, 2 * 0.3 * w, w**2], prewarped)
    found, under = notch.biquad(TS)
    np.testing.assert_allclose(found / under[0], num, rtol=1e-9)
    np.testing.assert_allclose(under / under[0], den, rtol=1e-9)


def judged(controller, plants, params):
    """Return Ms, Mt, disk margin of the worst plant and noise gain of the first, and whether all are stable."""
    f = np.unique(np.r_[np.geomspace(1e-3, 499.9, 12_000), np.linspace(5, 120, 12_000)])
    rows, stable = [], True
    for plant in plants:
        loop = controller.close(plant, params)
        open_loop, tracking, noise = independent(loop, f)
        s = 1 / (1 + open_loop)
        rows.append((abs(s).max(), abs(open_loop * s).max(), 2 / abs(2 * s - 1).max(), abs(noise).max()))
        model = control.ss(loop.plant.a, loop.plant.b[:, None], loop.plant.c, loop.plant.d[:, None], TS)
        law = control.ss(control.tf(controller.measurement.num, controller.measurement.den, TS))
        late = control.ss(control.tf([1], [1] + [0] * controller.compute_delay_samples, TS))
        stable &= bool(np.abs(control.feedback(model * late * law, 1).poles()).max() < 1)
        if len(rows) == 1:
            below = f[np.flatnonzero(np.abs(tracking) < abs(tracking[0]) / np.sqrt(2))[0]]
    ms, mt, disk, noise = zip(*rows, strict=True)
    return max(ms), max(mt), min(disk), noise[0], below, stable


@pytest.mark.parametrize(
    ("spec", "robust"),
    [
        ({"structure": "pid_dob", "bandwidth_hz": 30}, False),
        ({"structure": "pid_dob", "bandwidth_hz": 45}, True),
        pytest.param({"structure": "pid", "bandwidth_hz": 60, "notch": Notch()}, False, marks=pytest.mark.slow),
        pytest.param({"structure": "pid", "bandwidth_hz": 60, "notch": Notch()}, True, marks=pytest.mark.slow),
        ({"structure": "pid", "bandwidth_hz": 30, "notch": Notch(frequency_hz=80, width=0.2, depth=0.5)}, True),
        ({"structure": "pd", "bandwidth_hz": 30, "min_disk_margin": 0.9, "objective": "noise"}, True),
    ],
)
def test_structures_keep_their_limits(stand, swing, thor, spec, robust):
    """Every figure again in NumPy alone, poles by python-control's feedback connection."""
    limits = {"max_sensitivity": 1.6, "max_complementary": 1.3, "max_noise_gain": 60}
    controller = so.tune(stand, thor, so.ControllerSpec(**limits, **spec), {"swing": swing} if robust else {})
    assert controller.feasible
    ms, mt, disk, noise, bandwidth, stable = judged(controller, [stand, swing] if robust else [stand], thor)
    assert stable
    assert ms <= 1.6 and mt <= 1.3 and noise <= 60
    assert disk >= spec.get("min_disk_margin", 0.0)
    assert bandwidth == pytest.approx(spec["bandwidth_hz"], rel=0.005)
    again = Controller.from_dict(controller.to_dict(), stand, thor)
    assert repr(again) == repr(controller)


def test_an_observer_rejects_more(stand, thor):
    """On the plant it knows; the reason to have one."""
    limits = {"max_sensitivity": 1.6, "max_complementary": 1.3, "max_noise_gain": 60, "bandwidth_hz": 30}
    limits["reference_weights"] = "error"  # with weights a pid's own integral may be as fast
    plain, observed = (so.tune(stand, thor, so.ControllerSpec(structure=s, **limits)) for s in ("pid", "pid_dob"))
    f = np.geomspace(0.1, 10, 50)
    rejected = [np.abs(1 / (1 + independent(c.close(stand, thor), f)[0])).mean() for c in (plain, observed)]
    assert observed.feasible
    assert rejected[1] < 0.5 * rejected[0]


def test_draws_and_corners_are_kept(stand, swing, thor):
    values = [*corners({"I_p": (0.2, 0.6)}), *draw(thor.prior(k=60e3), 3, 1)]
    spec = so.ControllerSpec(bandwidth_hz=30, max_sensitivity=1.5)
    controller = so.tune(stand, thor, spec, {"swing": swing}, draws=values)
    assert controller.feasible
    assert "swing, I_p = 0.2" in controller.robust_to
    for one in values:
        ms, *_, stable = judged(controller, [swing], swing.complete(thor).update(**one))
        assert stable and ms <= 1.5 * (1 + 1e-6)
    with pytest.raises(ControlError, match='"I_q"'):
        so.tune(stand, thor, spec, {"swing": swing}, draws=[{"I_q": 1.0}])


@pytest.mark.parametrize("delay_s", [1e-3, 2.4e-3])
def test_a_plant_that_answers_later_is_kept_too(stand, thor, delay_s):
    """A further delay is a pair of robust_to; the loop's response is recomputed with it as a factor."""
    late = place_value(stand, thor, "delay_s", delay_s, {"stand": stand})
    spec = so.ControllerSpec(bandwidth_hz=20, max_sensitivity=1.8)
    controller = so.tune(stand, thor, spec, {"late": (stand, late)})
    assert controller.feasible
    f = np.geomspace(0.01, 100.0, 4000)
    once = controller.plant(stand, thor).response(f) * controller.law.measurement_response(f)
    turned = np.abs(1 / (1 + once * np.exp(-2j * np.pi * f * delay_s))).max()
    assert 1.0 < turned <= 1.8 * 1.01  # but for the images of a delay of no whole samples


def test_draws_are_of_the_distribution(thor):
    found = np.array([one["k"] for one in draw(thor.prior(k=3000.0), 4000, 2)])
    assert found.mean() == pytest.approx(thor["k"].value, abs=4 * 3000 / np.sqrt(4000))
    assert found.std() == pytest.approx(3000.0, rel=0.05)
    assert draw(thor.prior(k=3000.0), 3, 2) == draw(thor.prior(k=3000.0), 3, 2)


@given(st.floats(1.05, 3.0), st.floats(0.5, 200.0))
@settings(max_examples=30)
def test_one_sample_late_is_bodes_integral(ms, f):
    """The mean of ln|S| over all frequencies is 0 at least: f ln(1/sqrt 2) + (500 - f) ln Ms."""
    least = f * np.log(np.sqrt(0.5)) + (500 - f) * np.log(ms)
    if abs(least) > 1e-6:
        assert sensitivity_possible(f, ms, TS, 1) == (least >= 0)


@pytest.mark.slow
def test_the_delays_bound_is_no_stricter_than_what_is_reached(stand, thor):
    """A design that exists is not called impossible, and one sample more never makes more possible."""
    for delay in (0, 3, 8):
        spec = so.ControllerSpec(bandwidth_hz=20, compute_delay_samples=delay, max_sensitivity=1.8)
        controller = so.tune(stand, thor, spec)
        f = np.geomspace(1e-2, 400, 8000)
        s = np.abs(1 / (1 + independent(controller.close(stand, thor), f)[0]))
        reached = f[np.flatnonzero(s > np.sqrt(0.5))[0]]
        assert sensitivity_possible(0.999 * reached, 1.001 * s.max(), TS, delay + 1)
    allowed = [sensitivity_possible(8.0, 1.6, TS, late) for late in range(1, 60)]
    assert allowed == sorted(allowed, reverse=True)
    assert allowed[0] and not allowed[-1]


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"compute_delay_samples": 60, "bandwidth_hz": 60, "max_sensitivity": 1.6}, "delay allows at most"),
        ({"current_limit_A": 1.0, "step_N": 1000.0}, "takes 4.161 A at rest"),
        ({"current_limit_A": 0.1, "f_c": 100.0}, "no more than the friction"),
    ],
)
def test_what_nothing_can_do_is_refused(stand, thor, changes, words):
    params = thor.update(f_c=changes.pop("f_c", 0.0))
    with pytest.raises(ControlError, match=words) as caught:
        so.tune(stand, params, so.ControllerSpec(**{"bandwidth_hz": 30, **changes}))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"min_disk_margin": 2.0}, "min_disk_margin"),
        ({"step_N": 0.0}, "step_N"),
        ({"notch": Notch(depth=0.0)}, r"notch\.depth"),
        ({"notch": Notch(frequency_hz=600.0)}, r"notch\.frequency_hz"),
    ],
)
def test_bad_additions(changes, words):
    with pytest.raises(ControlError, match=words):
        so.ControllerSpec(bandwidth_hz=30, **changes)
