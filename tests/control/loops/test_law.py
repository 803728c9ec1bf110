"""The law as a state space: against rational arithmetic, python-control, loops put together here, and simulations."""

from __future__ import annotations

import math
from dataclasses import replace
from fractions import Fraction

import control
import numpy as np
import pytest
from scipy.signal import cont2discrete

import seaopt as so
from seaopt.control import (
    DisturbanceObserver,
    Gains,
    Law,
    Loop,
    Notch,
    Prefilter,
    SampledLoop,
    command_of,
    realise,
    run_loop,
    sample,
)
from seaopt.control.laws.structures import Nominal
from seaopt.errors import ControlError
from tests.laws import law_of, multiply_out

RATES = (100.0, 1000.0, 2000.0, 4000.0, 20000.0)
NOTCH = Notch(frequency_hz=30.0, width=0.3, depth=0.2)
SLOW = {"k_p": 0.3, "k_i": 3.0, "k_d": 0.0, "T_f": 0.02, "k_r": 1.3}
FAST = {"k_p": 3.2, "k_i": 60.0, "k_d": 0.033, "T_f": 1e-3, "k_r": 3.0, "c": 0.4}


def gains_at(rate_hz, thor, stand, T_q=None, delay=1, **changes):
    """Return gains with an observer, and the plant that they are for."""
    gain = command_of(stand, thor, "F1").per_effort
    plant = sample(stand, thor, "F1", gain, 1 / rate_hz, delay)
    slow = rate_hz < 500
    observer = DisturbanceObserver(nominal=Nominal.of(plant), T_q=T_q or (0.08 if slow else 0.02))
    return Gains(**{**(SLOW if slow else FAST), "observer": observer, **changes}), plant


def evaluate(polynomial, q):
    return sum(Fraction(float(value)) * q**i for i, value in enumerate(polynomial))


def exact_responses(gains, rate_hz, from_one):
    """Return C_r and C_y at z = 1 + from_one in rational numbers, by the equations of `structures`."""
    ts, q = Fraction(1 / rate_hz), 1 / (1 + Fraction(from_one))
    k_p, k_i, k_d, T_f, k_r, c = (Fraction(getattr(gains, name)) for name in ("k_p", "k_i", "k_d", "T_f", "k_r", "c"))
    rate = (1 - q) / (T_f + ts - T_f * q)
    whole = k_i * ts / 2 * (1 + q) / (1 - q)
    ahead, back = k_r + whole + c * k_d * rate, k_p + whole + k_d * rate
    if gains.observer is not None:
        T_q, nominal = Fraction(gains.observer.T_q), gains.observer.nominal
        lag = ts / (T_q + ts - T_q * q)
        kept = evaluate(nominal.kept, q) / evaluate(nominal.kept, 1)
        inverse = Fraction(1)
        for part in nominal.inverse:
            inverse *= evaluate(part.num, q) / evaluate(part.den, q)
        ahead, back = (value / (1 - lag**2 * kept) for value in (ahead, back + lag**2 * inverse))
    if gains.notch is not None:
        over, under = gains.notch.biquad(1 / rate_hz)
        ahead, back = (value * evaluate(over, q) / evaluate(under, q) for value in (ahead, back))
    if gains.prefilter is not None:
        s, w = (1 - q) / (1 + q), Fraction(math.tan(math.pi * gains.prefilter.corner_hz / rate_hz))
        zeta = gains.prefilter.damping
        ahead *= w / (s + w) if zeta is None else w**2 / (s**2 + 2 * Fraction(zeta) * w * s + w**2)
    return float(ahead), float(back)


@pytest.mark.parametrize("rate_hz", RATES)
@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"T_q": 3.0},
        {"k_i": 0.0, "notch": Notch(frequency_hz=30, width=0.3, depth=0.2)},
        {"prefilter": Prefilter(corner_hz=25.0)},
        {"prefilter": Prefilter(order="second_order", corner_hz=15.0, damping=0.5)},
    ],
)
def test_it_is_the_written_law_in_rational_numbers(rate_hz, changes, thor, stand):
    """At real z from 1 + 1e-7 to 4, where a rational function is as well known by its values as on the circle."""
    gains, _ = gains_at(rate_hz, thor, stand, **changes)
    raw = gains.law("pid_dob", 1 / rate_hz)
    points = np.geomspace(1e-7, 3.0, 12)
    expected = np.array([exact_responses(gains, rate_hz, float(point)) for point in points]).T * [[1], [-1]]
    for law in (raw, raw.balanced()):
        np.testing.assert_allclose(law.evaluate(points.astype(complex)).real, expected, rtol=3e-10)
    assert raw.balanced().c.size <= raw.c.size


@pytest.mark.parametrize("rate_hz", RATES)
def test_two_integrators_are_two_and_pull_at_the_error_alone(rate_hz, thor, stand):
    gains, _ = gains_at(rate_hz, thor, stand, T_q=0.3)
    law = gains.law("pid_dob", 1 / rate_hz).balanced()
    assert law.integrators == 2
    np.testing.assert_array_equal(law.a[:2, :2], [[1.0, 1.0], [0.0, 1.0]])
    assert law.b[1, 0] == -law.b[1, 1]
    alone = replace(gains, k_i=0.0, k_r=1.0 + gains.k_p).law("pid_dob", 1 / rate_hz).balanced()
    assert alone.integrators == 1
    assert alone.b[0, 0] == -alone.b[0, 1]
    assert np.max(np.abs(law.poles[2:])) < 1.0


@pytest.mark.parametrize("rate_hz", RATES)
def test_the_loop_rests_at_its_reference(rate_hz, thor, stand):
    """The stand by scipy's hold, a sample late, sample by sample: 500 N to 1e-9, and in the product's simulation."""
    gains, plant = gains_at(rate_hz, thor, stand)
    law = gains.law("pid_dob", 1 / rate_hz).balanced()
    radius = np.max(np.abs(Loop(plant=plant, law=law).eigenvalues()))
    count = int(np.log(1e-13) / np.log(radius))
    gain = command_of(stand, thor, "F1").per_effort
    running = realise(law, per_effort=gain)
    model = stand.linearize(thor)
    a, b, c, _, _ = cont2discrete((model.A, model.B[:, :1], model.C[:1], np.zeros((1, 1))), 1 / rate_hz, "zoh")
    x, waiting, state = np.zeros(2), 0.0, running.reset()
    for _ in range(count):
        current, state = running.step(state, 500.0, float(c[0] @ x))
        x, waiting = a @ x + b[:, 0] * waiting, current
    assert float(c[0] @ x) == pytest.approx(500.0, rel=1e-9)
    loop = SampledLoop(plant=stand, law=running, measured="F1", delay_samples=1)
    force = run_loop(loop, [thor], np.full(count, 500.0)).outputs["F1"][0]
    assert force[-1] == pytest.approx(500.0, rel=1e-9)


@pytest.mark.parametrize("rate_hz", RATES)
def test_poles_are_those_of_the_observers_own_block_diagram(rate_hz, thor, stand):
    """u = v + Q u - (Q/P_n) y with every filter on its own states: more modes, but those of the loop among them.

    On a plant with half as much inertia again: on its own the loop has those of Q twice, known to the root of rounding.
    """
    gains, _ = gains_at(rate_hz, thor, stand)
    gain = command_of(stand, thor, "F1").per_effort
    plant = sample(stand, thor.update(J=1.5 * thor["J"].value), "F1", gain, 1 / rate_hz, 1)
    ts, observer = 1 / rate_hz, gains.observer
    z = control.tf([1, 0], [1], ts)
    back = sum(
        control.ss(part)
        for part in (
            control.tf([gains.k_p], [1], ts), gains.k_i * ts / 2 * (z + 1) / (z - 1),
            gains.k_d * (z - 1) / ((gains.T_f + ts) * z - gains.T_f),
        )
    )  # fmt: skip
    lag = control.ss(ts * z / ((observer.T_q + ts) * z - observer.T_q))
    kept = control.ss(control.tf(observer.nominal.kept, [1.0, *np.zeros(observer.nominal.kept.size - 1)], ts))
    inverse = control.ss([], [], [], [[1.0]], ts)
    for part in observer.nominal.inverse:
        size = max(part.num.size, part.den.size)
        inverse = inverse * control.ss(control.tf(*(np.pad(p, (0, size - p.size)) for p in (part.num, part.den)), ts))
    law = control.feedback(control.ss([], [], [], [[1.0]], ts), lag * lag * kept, 1) * (back + lag * lag * inverse)
    model = control.ss(plant.a, plant.b[:, None], plant.c, plant.d[:, None], ts)
    late = control.ss(control.tf([1], [1, 0], ts))
    expected = control.feedback(model * late * law, control.ss([], [], [], [[1.0]], ts)).poles()
    found = Loop(plant=plant, law=gains.law("pid_dob", ts).balanced()).eigenvalues()
    large = found[np.abs(found) > 0.05]  # those of the delays are zero, to a root of rounding
    distance = np.min(np.abs(large[:, None] - expected), axis=1)
    assert large.size >= 5
    assert np.max(distance) < 1e-8
    ours = Loop(plant=plant, law=gains.law("pid_dob", ts)).eigenvalues()
    assert np.max(np.abs(ours)) == pytest.approx(np.max(np.abs(found)), abs=1e-10)


def test_python_control_gets_it_whole(thor, stand):
    gains, _ = gains_at(1000.0, thor, stand)
    law = gains.law("pid_dob", 1e-3).balanced()
    model = law.to_control()
    assert (model.input_labels, model.output_labels, model.dt) == (["reference", "measured"], ["effort"], 1e-3)
    f = np.geomspace(1e-3, 499.0, 50)
    expected = model(np.exp(2j * np.pi * f * 1e-3))[0]
    np.testing.assert_allclose(law.responses(f), expected, rtol=1e-7)
    np.testing.assert_allclose(law.reference_response(f), expected[0], rtol=1e-7)
    np.testing.assert_allclose(law.measurement_response(f), -expected[1], rtol=1e-7)


def test_multiplied_out_it_is_the_definitions_polynomials():
    gains = {"k_p": 3.2, "k_i": 1.3, "k_d": 0.033, "T_f": 1e-3, "k_r": 2.0, "c": 0.3}
    for structure in ("pd", "pid"):
        law = Gains(**gains).law(structure, 1e-3)
        for found, expected in zip(law.transfer_functions(), multiply_out(structure, 1e-3, **gains), strict=True):
            np.testing.assert_allclose(found.den, expected.den, rtol=1e-13)
            np.testing.assert_allclose(found.num, expected.num, rtol=1e-11)
            assert found.den[0] == 1.0
    again = Law.from_transfer_functions(*law.transfer_functions(), 1e-3)
    f = np.geomspace(1e-2, 499.0, 40)
    np.testing.assert_allclose(again.responses(f), law.responses(f), rtol=1e-8)


def test_a_law_that_is_not_stable_by_itself_closes_a_loop_and_does_not_run():
    law = law_of([1.0, 0.0], [1.0, -1.02])
    assert np.max(np.abs(law.poles)) == pytest.approx(1.02)
    with pytest.raises(ControlError, match=r"pole at \|z\| = 1.02"):
        realise(law)


def test_a_loop_at_4_khz_that_multiplied_out_polynomials_hide_is_found(thor):
    """73 Hz: 60 and 66 Hz are possible, so is this; its figures again from matrices alone."""
    actuator = thor.update(m_l=0.5364, k=1.453e6, J=4.911e-6, b_r=8.493e-5, eta=0.6044, I_p=0.08637)
    stand, swing = so.plants.high_impedance(), so.plants.moving_output()
    spec = so.ControllerSpec(
        bandwidth_hz=73.0, bandwidth_range_hz=(15.0, 100.0), structure="pid_dob", sample_rate_hz=4000.0,
        compute_delay_samples=0, max_sensitivity=1.585, objective="noise",
    )  # fmt: skip
    controller = so.tune(stand, actuator, spec, {"swing": swing})
    assert controller.feasible
    law = controller.law.to_control()
    for plant in (stand, swing):
        model = plant.linearize(actuator)
        drive = model.B[:, :1] * controller.command.per_effort
        a, b, c, d, _ = cont2discrete((model.A, drive, model.C[:1], np.zeros((1, 1))), 1 / 4000.0, "zoh")
        closed = np.block([
            [a + b @ law.D[:, 1:] @ c, b @ law.C],
            [law.B[:, 1:] @ c, law.A],
        ])  # fmt: skip
        assert np.max(np.abs(np.linalg.eigvals(closed))) < 1.0
        z = np.exp(2j * np.pi * np.geomspace(0.05, 1999.0, 20_000) / 4000.0)
        response = (c @ np.linalg.solve(z[:, None, None] * np.eye(len(a)) - a, b[None]) + d)[:, 0, 0]
        inner = z[:, None, None] * np.eye(len(law.A)) - law.A
        c_y = -(law.C @ np.linalg.solve(inner, np.broadcast_to(law.B[:, 1:], (z.size, *law.B[:, 1:].shape))))[:, 0, 0]
        sensitivity = np.abs(1 / (1 + response * (c_y - law.D[0, 1])))
        assert np.max(sensitivity) <= 1.585 * (1 + 1e-6)
