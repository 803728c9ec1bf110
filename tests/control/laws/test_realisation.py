"""The law as it runs, against scipy's filters, rational arithmetic, and observers and conditioning written by hand."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from scipy.signal import bilinear, cont2discrete, lfilter

import seaopt as so
from seaopt.control import Gains, Law, TransferFunction
from seaopt.control.laws.realisation import realise, runnable
from seaopt.errors import ControlError
from tests.laws import multiply_out

TS = 1e-3
GAINS = {"k_p": 3.2, "k_i": 1.3, "k_d": 0.033, "T_f": 1e-3, "k_r": 4.2}


def product(*factors):
    out = np.ones(1)
    for factor in factors:
        out = np.convolve(out, factor)
    return out


def tf(num, den):
    return TransferFunction(num=np.asarray(num, dtype=float), den=np.asarray(den, dtype=float))


def run_law(structure="pid", limit=None, **gains):
    return realise(Gains(**GAINS | gains).law(structure, TS).balanced(), command_limit=limit)


@pytest.fixture(scope="module")
def signals():
    return np.random.default_rng(0).normal(size=(2, 1500))


@pytest.fixture(scope="module")
def tuned():
    spec = so.ControllerSpec(
        bandwidth_hz=30, max_sensitivity=1.6, max_reference_peak=1.3, max_noise_gain=25, current_limit_A=9.0
    )
    return so.tune(so.plants.high_impedance(), so.plants.thor(), spec)


@pytest.mark.parametrize("structure", ["pd", "pid"])
@pytest.mark.parametrize("weights", [{}, {"c": 0.0}, {"k_r": 1.7, "c": 0.4}])
def test_without_saturation_it_is_scipys_filter(structure, weights, signals):
    r, y = signals
    c_r, c_y = multiply_out(structure, TS, **GAINS | weights)
    expected = lfilter(c_r.num, c_r.den, r) - lfilter(c_y.num, c_y.den, y)
    found, _ = run_law(structure, **weights).run(r, y)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12 * np.abs(expected).max())


def test_any_order_and_two_denominators_are_scipys_filters(signals):
    """A notch, a pole pair and an integrator in C_y; C_r shares two poles and has one of its own."""
    r, y = signals[:, :200]  # beyond, the rounded denominator's pole at 1 drifts in the filter
    notch = [1.0, -1.6, 0.7]
    c_y = tf(product([1, -0.9], [1, -0.4], [1, 0.3], [1, -1.8, 0.95]), product([1, -1], [1, -0.5], [1, -0.3], notch))
    c_r = tf(product([2, -1.9], [1, 0.2]), product([1, -1], [1, -0.5], [1, -0.2]))
    law = realise(Law.from_transfer_functions(c_r, c_y, TS))
    assert law.c.size == 6  # one integrator, 0.5 shared, 0.3, 0.2 and the notch's two
    expected = lfilter(c_r.num, c_r.den, r) - lfilter(c_y.num, c_y.den, y)
    np.testing.assert_allclose(law.run(r, y)[0], expected, rtol=0, atol=1e-12 * np.abs(expected).max())


def test_a_double_integrator_is_exact(signals):
    """Coefficients in double put a double pole at 1 only nearly there; the law has it there, as rationals show."""
    r = signals[0][:400]
    factors, numerator = ([1, -0.95], [1, -0.95]), ([1, -0.99], [1, -0.98], [1, -0.5], [1, -0.4])
    c = tf(product(*numerator), product([1, -1], [1, -1], *factors))
    found, _ = realise(Law.from_transfer_functions(c, c, TS)).run(r, np.zeros(r.size))
    stages = [float_to_fractions(a) for a in ([1, -1], [1, -1], *factors)]
    exact = [Fraction(float(v)) for v in r]
    for top, bottom in zip([float_to_fractions(a) for a in numerator], stages, strict=True):
        out = []
        for k, value in enumerate(exact):
            before = exact[k - 1] if k else 0
            out.append(rounded(top[0] * value + top[1] * before - bottom[1] * (out[-1] if out else 0)))
        exact = out
    expected = np.array([float(v) for v in exact])
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-11 * np.abs(expected).max())


def float_to_fractions(values):
    return [Fraction(str(v)) for v in values]


def rounded(value):
    return Fraction(round(value * 10**40), 10**40)


@pytest.mark.parametrize("ts", [1e-3, 2.5e-4])
@pytest.mark.parametrize("q_hz", [1.0, 10.0, 60.0])
def test_a_pid_with_observer_and_notch_keeps_its_weak_integral(ts, q_hz):
    """C_y = (C N + Q/P)/(1 - Q) of order seven against its factors; k_i is 1e-14 of the numerator's coefficients."""
    w, w0 = 2 * np.pi * q_hz, 2 * np.pi * 80
    q = bilinear([w**2], [1, 1.4 * w, w**2], 1 / ts)
    inverse = bilinear(w**2 * np.array([294.65 / 655e3, 11636 / 655e3, 1]), [1, 1.4 * w, w**2], 1 / ts)[0]
    notch = bilinear([1, 0.2 * w0, w0**2], [1, 1.2 * w0, w0**2], 1 / ts)
    c = multiply_out("pid", ts, **GAINS)[1]
    den = product(c.den, notch[1], q[1] - q[0])
    num = product(c.num, notch[0], q[1]) + product(inverse, c.den, notch[1])
    c_y = tf(num / den[0], den / den[0])
    law = Law.from_transfer_functions(c_y, c_y, ts)
    assert (law.c.size, law.integrators) == (6, 2)
    f = np.geomspace(1e-3, 0.45, 40) / ts
    z = np.exp(-2j * np.pi * f * ts)
    value = lambda p: np.polynomial.polynomial.polyval(z, p)  # noqa: E731
    whole = value(q[0]) / value(q[1])
    expected = (value(c.num) / value(c.den) * value(notch[0]) / value(notch[1]) + value(inverse) / value(q[1])) / (
        1 - whole
    )
    np.testing.assert_allclose(
        Law.from_transfer_functions(c_y, c_y, ts).measurement_response(f), expected, rtol=1e-3
    )  # a lost integral shows as 0.05 and more


def test_what_nothing_drives_is_left_out():
    assert run_law(k_i=0.0).c.size == 1
    assert run_law(k_d=0.0).c.size == 1
    assert run_law(k_i=0.0, k_d=0.0).c.size == 0
    assert run_law("pd", k_d=0.0).run(np.ones(3), np.ones(3))[0] == pytest.approx([1.0, 1.0, 1.0])


def test_a_law_may_leave_the_reference_out(signals):
    c_y = multiply_out("pid", TS, **GAINS)[1]
    law = realise(Law.from_transfer_functions(tf([0.0], c_y.den), c_y, TS))
    r, y = signals[:, :200]
    expected = -lfilter(c_y.num, c_y.den, y)
    np.testing.assert_allclose(law.run(r, y)[0], expected, rtol=0, atol=1e-12 * np.abs(expected).max())
    assert law.tracking_time_s == pytest.approx(3.2 / 1.3, rel=1e-3)


def test_a_state_takes_single_precision():
    """Rounding every matrix to single leaves the response within 1e-6 of itself: no companion form of high order."""
    poles = product([1, -1], [1, -0.99], [1, -0.97], [1, -0.9], [1, -1.9, 0.92])
    c = tf(product([1, -0.995], [1, -0.98], [1, -0.95], [1, -0.8], [1, -0.3], [1, 0.2]), poles)
    law = realise(Law.from_transfer_functions(c, c, TS))
    single = lambda x: np.float32(x).astype(float)  # noqa: E731
    rounded_law = replace(
        law, a=single(law.a), b_reference=single(law.b_reference), b_measurement=single(law.b_measurement),
        c=single(law.c), d_reference=float(single(law.d_reference)), d_measurement=float(single(law.d_measurement)),
    )  # fmt: skip
    z = np.exp(2j * np.pi * np.geomspace(0.1, 499, 200) * TS)
    responses = [
        np.array([x.c @ np.linalg.solve(v * np.eye(x.c.size) - x.a, x.b_reference) + x.d_reference for v in z])
        for x in (law, rounded_law)
    ]
    np.testing.assert_allclose(responses[1], responses[0], rtol=2e-5)


@example(1.0, 2.3e-309, 0.125, 0.0078, 0)  # its integral is next to none: T_s a_1/a_0 overflows
@given(st.floats(0.2, 50.0), st.floats(0.0, 1e3), st.floats(1e-4, 0.2), st.floats(1e-4, 1e-2), st.integers(0, 99))
def test_any_pid_is_scipys_filter(k_p, k_i, k_d, t_f, seed):
    r, y = np.random.default_rng(seed).normal(size=(2, 300))
    gains = {"k_p": k_p, "k_i": k_i, "k_d": k_d, "T_f": t_f, "k_r": 1.0 + k_p}
    c_r, c_y = multiply_out("pid", TS, **gains)
    expected = lfilter(c_r.num, c_r.den, r) - lfilter(c_y.num, c_y.den, y)
    found, _ = run_law(**gains).run(r, y)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-11 * np.abs(expected).max())


def test_a_limit_that_is_not_reached_changes_nothing(signals):
    limited, free = run_law(limit=1e6), run_law()
    np.testing.assert_array_equal(limited.run(*signals)[0], free.run(*signals)[0])


def test_back_calculation_is_the_written_one(signals):
    """Trapezoidal integral, filtered difference, and (sat(u) - u)/(T_t + T_s) on the integral, sample by sample."""
    r, y = signals
    law = run_law(limit=20.0)
    integral, rate, before, out = 0.0, 0.0, 0.0, []
    for ref, meas in zip(r, y, strict=True):
        e = ref - meas
        rate = (GAINS["T_f"] * rate + (e - before)) / (GAINS["T_f"] + TS)
        integral += GAINS["k_i"] * TS / 2 * (e + before)
        u = GAINS["k_r"] * ref - GAINS["k_p"] * meas + integral + GAINS["k_d"] * rate
        sat = np.clip(u, -20.0, 20.0)
        integral += TS / (law.tracking_time_s + TS) * (sat - u)
        out.append(sat)
        before = e
    found, _ = law.run(r, y)
    assert 0.2 < np.mean(np.abs(found) == 20.0) < 0.8
    np.testing.assert_allclose(found, out, rtol=1e-10)


def test_the_default_tracking_time_is_that_of_the_docs():
    assert run_law().tracking_time_s == pytest.approx((1.0 + 3.2) / 1.3 - TS / 2, rel=1e-9)
    assert run_law("pd").tracking_time_s is None
    assert repr(run_law(limit=9.0)) == (
        "RunnableLaw of order 2 (1 of it integrators, tracking time 3.23 s) at 1000 Hz, limited to 9 A"
    )


def test_a_disturbance_observer_sees_the_saturated_command(signals):
    """u = k (r - y) + Q (sat(u) - y/P): with Q of first order the same law, from its two transfer functions alone."""
    r, y = signals
    lam, k = 0.93, 4.0
    q_num, one_minus_q = [0.0, 1 - lam], [1.0, -1.0]  # Q = (1 - lam) q / (1 - lam q)
    c_r, c_y = tf(k * np.array([1.0, -lam]), one_minus_q), tf(k * np.array([1.0, -lam]) + q_num, one_minus_q)
    law = realise(Law.from_transfer_functions(c_r, c_y, TS), command_limit=3.0)
    estimate, out = 0.0, []
    for ref, meas in zip(r, y, strict=True):
        sat = np.clip(k * (ref - meas) + estimate, -3.0, 3.0)
        estimate = lam * estimate + (1 - lam) * (sat - meas)
        out.append(sat)
    found, _ = law.run(r, y)
    assert np.mean(np.abs(found) == 3.0) > 0.2
    np.testing.assert_allclose(found, out, atol=1e-12 * 3)


def closed(law, controller, references):
    """Run a law against the paper's stand, discretised by scipy, a sample late; return the force."""
    p = so.plants.thor()
    r = p["l"].value / (2 * np.pi * p["N_p"].value)
    m_k, b_m, k = p["m_l"].value + p["J"].value / r**2, p["b_r"].value / r**2, p["k"].value
    a, b, c, _, _ = cont2discrete(
        (np.array([[0, 1], [-k / m_k, -b_m / m_k]]), np.array([[0], [1 / m_k]]), np.array([[k, 0]]), np.zeros((1, 1))),
        TS,
    )
    x, held, state, forces = np.zeros(2), 0.0, law.reset(), []
    for reference in references:
        force = float(c[0] @ x)
        current, state = law.step(state, float(reference), force)
        x = a @ x + b[:, 0] * held
        held = current / controller.command.per_effort
        forces.append(force)
    return np.array(forces)


def test_after_an_unreachable_reference_the_force_returns_at_once(tuned):
    """1.5 s at half again what 9 A can hold, then half of that: the integral must not have to unwind."""
    law = runnable(tuned)
    limit = law.force_limit_N
    references = np.where(np.arange(3500) < 1500, 1.5 * limit, 0.5 * limit)
    error, wound, free = (
        closed(candidate, tuned, references)[1500:] / limit - 0.5
        for candidate in (
            law, replace(law, anti_windup=0 * law.anti_windup), replace(law, command_limit=np.inf),
        )
    )  # fmt: skip
    late = slice(150, None)
    assert np.abs(wound[late]).max() > 0.05
    assert np.abs(error[late]).max() < 0.01
    assert -error.min() <= -free.min() + 0.01


@pytest.mark.parametrize("k_i", [40.0, 160.0])
def test_a_saturating_step_overshoots_less_with_anti_windup(k_i, tuned):
    gains = Gains(k_p=1.7, k_i=k_i, k_d=0.05, T_f=8e-4, k_r=2.7)
    controller = replace(tuned, law=gains.law("pid", TS))
    law = runnable(controller)
    step = np.full(2000, 0.8 * law.force_limit_N)
    with_it, without = (
        closed(candidate, controller, step).max() / step[0] - 1
        for candidate in (law, replace(law, anti_windup=0 * law.anti_windup))
    )
    assert with_it < 0.8 * without


def test_reset_continues_from_a_current(tuned):
    law = runnable(tuned)
    state = law.reset(reference=700.0, measurement=700.0, command=2.5)
    current, after = law.step(state, 700.0, 700.0)
    assert current == pytest.approx(2.5, rel=1e-12)
    np.testing.assert_allclose(after.x, state.x, rtol=1e-9)
    with pytest.raises(ControlError, match="above the limit of 9 A"):
        law.reset(command=10.0)
    with pytest.raises(ControlError, match="give finite numbers"):
        law.reset(measurement=np.nan)


def test_numbers_that_are_not_finite_hold_the_command(tuned, signals):
    law = runnable(tuned)
    r, y = 100 * signals
    bad = y.copy()
    bad[700:703] = [np.nan, np.inf, 1e308]
    whole, _ = law.run(np.delete(r, slice(700, 703)), np.delete(y, slice(700, 703)))
    found, _ = law.run(r, bad)
    np.testing.assert_array_equal(found[700:703], found[699])
    np.testing.assert_array_equal(np.delete(found, slice(700, 703)), whole)
    _, state = law.run(r[:703], bad[:703])
    assert state.held == 3
    assert law.step(state, 0.0, 0.0)[1].held == 0


@pytest.mark.parametrize(
    ("num", "den", "options", "words"),
    [
        ([1.0, 0.0], [1.0, -1.02], {}, r"pole at \|z\| = 1.02"),
        ([1.0, 0.0], [1.0, 1.0], {}, r"pole at \|z\| = 1 "),
        ([np.nan], [1.0], {}, "not finite"),
        ([1.0, 0.5], np.poly([0.99999, 0.99999, 0.99999]), {}, "too close together"),
        ([1.0], [2.0], {}, r"den\[0\] is not 1"),
        ([1.0], [1.0], {"command_limit": 0.0}, "command_limit = 0 is not positive"),
        ([1.0], [1.0], {"tracking_time_s": -1.0}, "tracking_time_s = -1 is not positive"),
    ],
)
def test_what_cannot_run_is_refused(num, den, options, words):
    with pytest.raises(ControlError, match=words):
        realise(Law.from_transfer_functions(tf(num, den), tf([1.0], [1.0]), TS), **options)
