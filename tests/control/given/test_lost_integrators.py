"""Laws given as matrices keep their integrators, whatever their coordinates; against their poles and zeros, by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import tf2ss

import seaopt as so
from seaopt.control import Gains, Law, TransferFunction, parallel_pid, realise
from seaopt.control.given.assessment import assess
from seaopt.control.laws.structures import Notch
from seaopt.control.loops.law import describe_integrators
from seaopt.errors import ControlError
from tests.laws import multiply_out

TS = 1e-3
F = np.geomspace(1e-4, 0.49, 30)  # of the sample rate


def draw_poles(rng, number, slowest=0.985):
    """Return real poles and complex pairs, the pairs side by side."""
    poles = []
    while len(poles) < number:
        if number - len(poles) > 1 and rng.random() < 0.5:
            pole = rng.uniform(0.5, 0.97) * np.exp(1j * rng.uniform(0.02, 1.5))
            poles += [pole, np.conj(pole)]
        else:
            poles.append(rng.uniform(0.2, slowest))
    return np.array(poles, dtype=complex)


def draw_notch(rng, ts):
    """Return numerator and denominator of a notch, by Tustin's rule."""
    w, width, depth = np.tan(np.pi * 10 ** rng.uniform(0.7, 2.3) * ts), 10 ** rng.uniform(-1, 0), rng.uniform(0.02, 0.6)
    num, den = ([1 + k * w + w * w, 2 * (w * w - 1), 1 - k * w + w * w] for k in (2 * depth * width, 2 * width))
    return np.array(num) / den[0], np.array(den) / den[0]


def of_error(a, b, c, d):
    return a, np.hstack([b, -b]), np.ravel(c), np.array([d, -d])


def draw_pid(rng):
    """Return a pid with a notch through scipy's tf2ss, its integrators, and its response."""
    ts = rng.choice([1e-3, 5e-4, 2.5e-4])
    k_p, t_f = 10 ** rng.uniform(-0.3, 1.3), ts * 10 ** rng.uniform(0, 1)
    k_i, k_d = k_p * 10 ** rng.uniform(0, 2), k_p * 10 ** rng.uniform(-2.5, -1.5)
    (top, below), lag, difference = draw_notch(rng, ts), np.array([1.0, -t_f / (t_f + ts)]), np.array([1.0, -1.0])
    sums, rates = np.convolve([0.5, 0.5], lag) * k_i * ts, np.convolve(difference, difference) * k_d / (t_f + ts)
    num, den = k_p * np.convolve(difference, lag) + sums + rates, np.convolve(difference, lag)
    a, b, c, d = tf2ss(np.convolve(num, top), np.convolve(den, below))
    w = np.expm1(2j * np.pi * F)
    value = lambda p: np.polyval(p, 1 + w)  # noqa: E731
    rate = k_d * w / ((t_f + ts) * value(lag))
    response = (k_p + k_i * ts * (w + 2) / (2 * w) + rate) * value(top) / value(below)
    return 1, of_error(a, b, c, d[0, 0]), np.stack([response, -response]), k_i * ts * np.sum(top) / np.sum(below)


def draw_companion(rng, integrators, controllable, flipped, also=()):
    """Return a law of the error in a companion form, of orders 3 to 8, its response, and its last integral's gain."""
    order = int(rng.integers(3 + len(also), 9))
    zeros, poles = draw_poles(rng, order), np.r_[also, draw_poles(rng, order - integrators - len(also))]
    gain = 10 ** rng.uniform(0, 2)
    num, den = gain * np.real(np.poly(zeros)), np.real(np.poly(np.r_[np.ones(integrators), poles]))
    a, b, c = np.eye(order, k=1), (num[1:] - num[0] * den[1:])[:, None], np.eye(1, order)[0]
    a[:, 0] -= den[1:]
    if flipped:
        a, b, c = a[::-1, ::-1], b[::-1], c[::-1]
    if controllable:
        a, b, c = a.T, c[:, None], b[:, 0]
    w = np.expm1(2j * np.pi * F)
    response = gain * np.prod(w + (1 - zeros)[:, None], axis=0) / np.prod(w + (1 - poles)[:, None], axis=0)
    response = response / w**integrators
    last = np.real(gain * np.prod(1 - zeros) / np.prod(1 - poles))
    return integrators, of_error(a, b, c, num[0]), np.stack([response, -response]), last


def draw_turned(rng, integrators, also=()):
    """Return a law of one to three signals in coordinates of a condition up to 1000, and its response."""
    order, signals = int(rng.integers(3 + len(also), 9)), int(rng.integers(1, 4))
    poles, at = [*also, *draw_poles(rng, order - integrators - len(also))], integrators
    a, b = np.zeros((order, order)), rng.normal(size=(order, 1 + signals))
    a[:at, :at] = np.eye(at) + np.eye(at, k=1)
    while poles:
        pole = poles.pop(0)
        if np.imag(pole):
            poles.pop(0)
            a[at : at + 2, at : at + 2] = [[pole.real, pole.imag], [-pole.imag, pole.real]]
        a[at, at], at = np.real(pole), at + (2 if np.imag(pole) else 1)
    b[:integrators] *= 10 ** rng.uniform(-3, -1, size=(integrators, 1))
    b[:, 1] = -b[:, 0]
    c, d = (
        np.concatenate([np.eye(1, integrators)[0], rng.normal(size=order - integrators)]),
        rng.normal(size=1 + signals),
    )
    inner, (rest, ahead, row) = (
        np.eye(order - integrators),
        (a[integrators:, integrators:], b[integrators:], c[integrators:]),
    )
    w = np.expm1(2j * np.pi * F)
    response = np.array([d + row @ np.linalg.solve((1 + x) * inner - rest, ahead) for x in w]).T
    response = response + sum(b[j][:, None] / w ** (j + 1) for j in range(integrators))
    left, right = (np.linalg.qr(rng.normal(size=(order, order)))[0] for _ in range(2))
    scale = np.geomspace(1.0, 10 ** rng.uniform(0, 3), order)
    turn, back = left * scale @ right, right.T / scale @ left.T
    return (
        integrators,
        (turn @ a @ back, turn @ b, c @ back, d),
        response,
        b[integrators - 1, 0] if integrators else None,
    )


def draw_any(rng, number):
    """Return one law of every kind after the other, of no, one and two integrators."""
    for k in range(number):
        if k % 5 == 0:
            yield draw_pid(rng)
        elif k % 5 == 4:
            yield draw_turned(rng, k // 5 % 3)
        else:
            yield draw_companion(rng, k % 3, controllable=k % 2 == 0, flipped=k // 3 % 2 == 0)


def check_law(integrators, matrices, response, last):
    law = Law.from_state_space(*matrices, TS)
    assert law.integrators == integrators
    size = np.max(np.abs(response[:, ::-1]), axis=1)[:, None]  # of a zero on the circle digits are of what is about it
    np.testing.assert_array_less(np.abs(law.responses(F / TS) - response), 2e-5 * np.abs(response) + 1e-9 * size)
    if integrators:
        assert law.b[integrators - 1, 0] == pytest.approx(last, rel=1e-5)
        assert law.b[integrators - 1, 1] == -law.b[integrators - 1, 0]  # it rests at its reference, to the last bit
    running = realise(law, command_limit=1.0)
    assert running.integrators == integrators and (running.tracking_time_s is None) == (not integrators)


def test_integrators_are_found_in_whatever_form():
    for case in draw_any(np.random.default_rng(0), 45):
        check_law(*case)


@pytest.mark.slow
def test_hundreds_of_laws_keep_their_integrators():
    rng = np.random.default_rng(1)
    for case in draw_any(rng, 300):
        check_law(*case)
    for k in range(400):
        check_law(*draw_turned(rng, k % 3))


@pytest.mark.parametrize("distance", [1e-3, 1e-4, 1e-5])
@pytest.mark.parametrize("integrators", [0, 1])
def test_a_slow_lag_stays_one_in_whatever_form(distance, integrators):
    rng = np.random.default_rng(2)
    for k in range(4):
        turned = draw_turned(rng, integrators, also=(1 - distance,))
        companion = draw_companion(rng, integrators, k % 2 == 0, k // 2 % 2 == 0, also=(1 - distance,))
        for _, matrices, *_ in (turned, companion):
            assert Law.from_state_space(*matrices, TS).integrators == integrators


def draw_slow_companion(rng, k, integrators=0):
    """Return a companion form with two to four real poles or pairs at 1e-5 to 1e-3 from 1."""
    slow = 1 - 10 ** rng.uniform(-5, -3, size=2 + k % 3) * np.exp(1j * (k // 3 % 2) * rng.uniform(0, 1.4))
    slow = np.r_[slow[:1], np.conj(slow[:1]), slow[2:].real] if k // 3 % 2 else slow.real
    return draw_companion(rng, integrators, k % 2 == 0, k // 2 % 2 == 0, also=tuple(slow))[1]


def check_none_is_made(matrices):
    """Rounding moves many slow poles by more than 1e-6, to 1 as well: the law stays as it was given, and is said so."""
    (a, b, c, d), law = matrices, Law.from_state_space(*matrices, TS)
    f = F[F > 0.01]  # below, coefficients of four slow poles have no digits of the response
    z = np.exp(2j * np.pi * f)
    given = np.array([d + c @ np.linalg.solve(x * np.eye(c.size) - a, b) for x in z]).T
    size = np.max(np.abs(given), axis=1)[:, None]
    np.testing.assert_array_less(np.abs(law.responses(f / TS) - given), 1e-2 * np.abs(given) + 1e-4 * size)
    assert law.integrators == 0 and describe_integrators(law).startswith("no integral")


def test_slow_poles_of_a_companion_form_make_no_integrator():
    rng = np.random.default_rng(3)
    for k in range(36):
        check_none_is_made(draw_slow_companion(rng, k))


@pytest.mark.slow
def test_slow_poles_of_many_companion_forms_make_no_integrator():
    rng = np.random.default_rng(4)
    for k in range(180):
        check_none_is_made(draw_slow_companion(rng, k))


def test_an_integrator_beside_slow_poles_is_found_or_none_is_said():
    """Next to two of them coefficients often do not tell it from a third: anti-windup acts on what is an integrator."""
    rng, found = np.random.default_rng(5), []
    for k in range(30):
        law = Law.from_state_space(*draw_companion(rng, 1, k % 2 == 0, k // 2 % 2 == 0, (1 - 1e-3, 1 - 1e-4))[1], TS)
        found.append(law.integrators)
        assert law.integrators == 1 or describe_integrators(law).startswith("no integral")
    assert 0 < sum(found) < 30
    for slow, integrators in ((0.9999, 1), (0.99, 1)):
        tf = TransferFunction(num=np.array([1.0, -0.9, 0.1]), den=np.convolve([1.0, -1.0], [1.0, -slow]))
        assert Law.from_transfer_functions(tf, tf, TS).integrators == integrators
    tf = TransferFunction(num=np.array([1.0, -0.9]), den=np.poly([1.0, 1 - 1e-4, 1 - 1e-5]))
    with pytest.raises(ControlError, match="slow poles are too close together to tell from integrators"):
        Law.from_transfer_functions(tf, tf, TS)


def test_a_leak_that_nothing_shows_is_none():
    """A pole 1e-7 from 1, of 10 000 s: the response is that of the integral, and so is the anti-windup."""
    for leak, integrators in ((1e-7, 1), (1e-9, 1), (1e-5, 0), (-1e-8, 1)):
        law = Law.from_state_space(
            np.array([[1.0 - leak]]), np.array([[2.0, -2.0]]), np.array([0.5]), np.array([3.0, -3.0]), TS
        )
        assert law.integrators == integrators
    rounded = TransferFunction(num=np.array([2.5, -4.0, 1.6]), den=np.array([1.0, -1.4000000001, 0.4]))
    assert Law.from_transfer_functions(rounded, rounded, TS).integrators == 1


def test_two_integrals_that_act_apart_are_one():
    """Of the reference and of the measurement in states of their own: one chain, and no second integral."""
    a, b = np.diag([1.0, 1.0, 0.4]), np.array([[0.5, 0.0], [0.0, -0.5], [1.0, 2.0]])
    turn = np.array([[1.0, 2.0, -1.0], [0.3, 1.0, 0.5], [2.0, -1.0, 1.0]])
    law = Law.from_state_space(
        turn @ a @ np.linalg.inv(turn), turn @ b, np.array([1.0, 1.0, 0.3]) @ np.linalg.inv(turn), np.zeros(2), TS
    )
    assert law.integrators == 1 and law.b[0] == pytest.approx([0.5, -0.5], rel=1e-9)


def test_an_integral_of_the_measurement_alone_keeps_its_tracking_time():
    rng = np.random.default_rng(5)
    own = parallel_pid(k_p=2.0, k_i=30.0, sample_time_s=TS)
    b, d = own.b * [0.0, 1.0], own.d * [0.5, 1.0]
    law = replace(own, a=np.diag([1.0, 0.3]), b=np.vstack([b, [[1.0, -0.4]]]), c=np.array([1.0, 0.2]), d=d)
    turn = rng.normal(size=(2, 2))
    turned = Law.from_state_space(turn @ law.a @ np.linalg.inv(turn), turn @ law.b, law.c @ np.linalg.inv(turn), d, TS)
    assert turned.integrators == 1
    assert realise(turned).tracking_time_s == pytest.approx(realise(law).tracking_time_s, rel=1e-6)


def find_recovery(law):
    """Return the samples until the force is back within 5 % of a reference in reach after 1 s of one out of reach."""
    # 1/(0.01 s + 1)^2 behind its hold and a sample of delay, by hand.
    pole = np.exp(-TS / 0.01)
    running, first, second, held = realise(law, command_limit=1.0), 0.0, 0.0, 0.0
    state = running.reset()
    for k in range(5000):
        if k > 1000 and abs(second - 0.5) < 0.025:
            break
        command, state = running.step(state, 1.5 if k < 1000 else 0.5, second)
        second += (1.0 - pole) * (first - second)
        first, held = pole * first + (1.0 - pole) * held, command
    return k - 1000


@pytest.mark.parametrize("kind", ["tf2ss", "observable", "turned"])
def test_after_a_reference_out_of_reach_the_force_is_back_as_soon(kind):
    rng = np.random.default_rng(7)
    pid = {"k_p": 1.2, "k_i": 40.0, "k_d": 5e-3, "T_f": 2e-3, "k_r": 1.2}
    own = Gains(**pid, notch=(notch := Notch(frequency_hz=20.0, width=0.3, depth=0.2))).law("pid", TS).balanced()
    c_y, (top, below) = multiply_out("pid", TS, **pid)[1], notch.biquad(TS)
    a, b, c, d = tf2ss(np.convolve(c_y.num, top), np.convolve(c_y.den, below))
    a, b, c, d = of_error(a, b, c, d[0, 0])
    if kind == "observable":
        a, b, c = a.T, np.outer(c, [1.0, -1.0]), np.eye(1, c.size)[0]
    elif kind == "turned":
        left, right = (np.linalg.qr(rng.normal(size=a.shape))[0] for _ in range(2))
        turn = left * np.geomspace(1, 1e3, c.size) @ right
        a, b, c = turn @ a @ np.linalg.inv(turn), turn @ b, c @ np.linalg.inv(turn)
    assert find_recovery(Law.from_state_space(a, b, c, d, TS)) == pytest.approx(find_recovery(own), rel=0.2)


def test_a_law_without_an_integral_is_said_to_have_none(stand, thor, tmp_path):
    spec = so.ControllerSpec(bandwidth_hz=5, bandwidth_range_hz=(1, 60), min_sensitivity_bandwidth_hz=False)
    for leak, words in ((1e-4, "no integral"), (0.0, "1 integrator")):
        law = Law.from_state_space(
            np.array([[1.0 - leak]]), np.array([[0.02, -0.02]]), np.array([1.0]), np.array([1.0, -1.0]), TS
        )
        controller = assess(law, stand, thor, spec)
        assert words in repr(controller)
        certificate = so.certify(controller, {"stand": stand}, thor, samples=10, simulations=False)
        assert any(f"with {words}" in note for note in certificate.notes)
        if leak:
            assert "lag of 10 s" in repr(controller)
        so.export(controller, tmp_path, allow_infeasible=True, current_limit_A=9.0, fit_met=True)
        header = (tmp_path / "force_law.h").read_text()
        assert ("no integral that could wind up" in header) == bool(leak)
        assert ("the integral follows it" in header) == (not leak)


def test_poles_that_rounding_puts_outside_the_circle_are_refused_with_the_reason():
    """Three integrators, one more than are told from matrices."""
    rng = np.random.default_rng(0)
    a, b, turn = (
        np.diag([1.0, 1.0, 1.0, 0.5]) + np.diag([1.0, 1.0, 0.0], 1),
        rng.normal(size=(4, 1)),
        rng.normal(size=(4, 4)),
    )
    b, back = np.hstack([b, -b]), np.linalg.inv(turn)
    law = Law.from_state_space(
        turn @ a @ back, turn @ b, np.array([1.0, 0.0, 0.0, 1.0]) @ back, np.array([1.0, -1.0]), TS
    )
    with pytest.raises(ControlError, match="from 1 is not told from a slow lag; give the law as gains"):
        realise(law)
