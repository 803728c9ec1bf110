"""The port impedance against the equations of motion, the PID rule, power in a simulation, and attached masses."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from scipy.linalg import expm

import seaopt as so
from seaopt.control import Gains, TransferFunction, command_of
from seaopt.control.laws.passivity import passivity, passivity_rows
from seaopt.control.loops.port import hold_response, port_of
from seaopt.errors import ControlError
from seaopt.plants import high_impedance, moving_output, two_link
from tests.laws import law_of, measurement_matrices
from tests.words import flatten

TS = 1e-3
F = np.geomspace(0.01, 499, 60)
S = 2j * np.pi * F


def figures(params):
    r = params["l"].value / (2 * np.pi * params["N_p"].value)
    return params["J"].value / r**2, params["b_r"].value / r**2, params["k"].value, params["m_l"].value


@lru_cache(maxsize=1)
def tuned():
    spec = so.ControllerSpec(
        bandwidth_hz=30, max_sensitivity=1.6, max_reference_peak=1.3, max_noise_gain=25, reference_weights="error"
    )
    return so.tune(high_impedance(), so.plants.thor(), spec)


def controller_of(sample_time_s=TS, delay_samples=1, **gains):
    law = Gains(**{"k_p": 3.0, "k_i": 1.0, "k_d": 0.03, "T_f": sample_time_s, "k_r": 4.0, **gains})
    return replace(
        tuned(), law=law.law("pid", sample_time_s), sample_time_s=sample_time_s, compute_delay_samples=delay_samples
    )


IMPEDANCES = {  # each from the equations of motion of design.md, link 1 at rest, F_m = -c F1
    ("unlumped", "link1"): lambda m, b, k, m_l, c, s: (
        (m_l * s**2 + k) * (m * s + b) / ((m + m_l) * s**2 + b * s + k * (1 + c))
    ),
    ("lumped", "link1"): lambda m, b, k, m_l, c, s: (
        ((m + m_l) * s**2 + k) * b / ((m + m_l) * s**2 + b * s + k * (1 + c))
    ),
    ("unlumped", "link2"): lambda m, b, k, m_l, c, s: k * (m * s + b) / (m * s**2 + b * s + k * (1 + c)),
}


@pytest.mark.parametrize(("drive", "spring"), list(IMPEDANCES))
@pytest.mark.parametrize("kind", ["stand", "swing", "two masses"])
def test_the_impedance_is_that_of_the_equations(drive, spring, kind, thor):
    make = {"stand": high_impedance, "swing": moving_output, "two masses": lambda **o: two_link("mass", "mass", **o)}
    plant = make[kind](drive=drive, spring=spring)
    c = 3.2 + 1.3 / S + 0.03 * S
    found = port_of(plant, thor, "F1", command_of(plant, thor, "F1").per_effort).response(F).impedance(c)
    np.testing.assert_allclose(found, IMPEDANCES[drive, spring](*figures(thor), c, S), rtol=1e-9)


def test_a_mass_at_the_port_has_the_sign_of_a_mass(thor):
    """Without damping, slowly moved, the spring holds the sprung mass still and the rotor is what moves: M = J/r^2."""
    params = thor.update(b_r=1e-12)
    f = np.array([0.1])
    z = port_of(high_impedance(), params, "F1", 1.0).response(f).impedance(np.zeros(1, dtype=complex))
    np.testing.assert_allclose(z, 2j * np.pi * f * figures(params)[0], rtol=1e-3)


def test_the_loop_is_the_sampled_one_at_low_frequency(thor, stand):
    """G_11 with hold and delay is the zero-order-hold plant but for its images: to 1 % at 30 Hz."""
    controller = controller_of(delay_samples=2)
    f = np.geomspace(0.1, 30, 20)
    g = port_of(stand, thor, "F1", controller.command.per_effort).response(f).motor_to_read[0]
    np.testing.assert_allclose(g * hold_response(f, TS, 2), controller.plant(stand, thor).response(f), rtol=0.01)


def power(controller, params, f_hz, periods, steps=20):
    """Return twice the mean power per speed squared that a sampled loop takes from a sinusoidal motion of link 2.

    State q, qd and the oscillator x, v; stepped exactly by steps a sample, the last command held; the law by hand.
    """
    m, b, k, m_l = figures(params)
    w = 2 * np.pi * f_hz
    a = np.zeros((5, 5))
    a[0, 1], a[2, 3], a[3, 2] = 1.0, 1.0, -(w**2)
    a[1] = np.array([-k, -b, -k + m_l * w**2, 0.0, 1.0]) / (m + m_l)
    hop = expm(a * controller.sample_time_s / steps)
    x, inputs, outputs, late = (
        np.array([0.0, 0, 0, 1.0, 0]),
        np.zeros(3),
        np.zeros(3),
        [0.0] * controller.compute_delay_samples,
    )
    num, den = controller.measurement.num, controller.measurement.den
    samples = round(periods / f_hz / controller.sample_time_s)
    taken = []
    for sample in range(2 * samples):
        inputs[1:], outputs[1:] = inputs[:-1].copy(), outputs[:-1].copy()
        inputs[0] = k * (x[0] + x[2])
        outputs[0] = num @ inputs[: num.size] - den[1:] @ outputs[1 : den.size]
        late.append(-outputs[0])
        x[4] = late.pop(0)
        for _ in range(steps):
            qdd = a[1] @ x
            if sample >= samples:
                taken.append((k * (x[0] + x[2]) + m_l * (qdd - w**2 * x[2])) * x[3])
            x = hop @ x
    return 2 * np.mean(taken)


@pytest.mark.parametrize(("f_hz", "tolerance"), [(5.0, 0.01), (20.0, 0.01), (50.0, 0.02), (100.0, 0.06)])
def test_the_real_part_is_the_power_that_a_sampled_loop_takes(f_hz, tolerance, thor, stand):
    """Simulated with its sampler, hold and delay; at 100 Hz the loop gives power away. Tolerances are of abs(Z)."""
    controller = controller_of(k_i=20.0)
    f = np.array([f_hz])
    law = controller.law.measurement_response(f) * hold_response(f, TS, 1)
    z = port_of(stand, thor, "F1", controller.command.per_effort).response(f).impedance(law)[0]
    taken = power(controller, thor, f_hz, periods=2 * f_hz)
    assert taken == pytest.approx(z.real, abs=tolerance * abs(z))
    assert (taken < 0) == (f_hz == 100.0)


@pytest.mark.parametrize("k_p", [0.5, 3.0, 10.0])
def test_an_undelayed_pid_is_passive_up_to_the_rule(k_p, thor, stand):
    """k_i <= b_m (1 + k_p)/M at 1 MHz without delay: from there on the low end of the band breaks."""
    m, b, _, _ = figures(thor)
    rule = b * (1 + k_p) / m
    for factor in (0.5, 0.998, 1.002, 2.0):
        law = controller_of(1e-6, 0, k_p=k_p, k_i=factor * rule, k_d=0.05, T_f=1e-6)
        assert (passivity(law, stand, thor, low_hz=0.1, high_hz=1.0).violated_hz is None) == (factor < 1.0)


def test_the_rule_has_m_k_where_there_is_no_sprung_mass(thor, stand):
    """Continuous PID, m_l = 0: Re Z changes sign at k_i = b_m (1 + k_p)/m_k to rounding."""
    params = thor.update(m_l=0.0)
    port = port_of(stand, params, "F1", command_of(stand, params, "F1").per_effort)
    m_k, b, _, _ = figures(params)
    rule, f = b * 4.0 / m_k, np.array([1e-3, 1e-2])
    for k_i, sign in ((rule * (1 - 1e-6), 1), (rule * (1 + 1e-6), -1)):
        z = port.response(f).impedance(3.0 + k_i / (2j * np.pi * f))
        assert (np.sign(z.real) == sign).all()


def attached(controller, params, mass, stiffness, damping=0.0):
    """Return the spectral radius with a mass, a spring and a damper to ground on link 2, in NumPy alone."""
    m, b, k, m_l = figures(params)
    inertia = np.array([[m + m_l, m_l], [m_l, mass + m_l]])
    stiff = np.array([[k, k], [k, k + stiffness]])
    damp = np.diag([b, damping])
    a = np.zeros((5, 5))
    a[:2, 2:4] = np.eye(2)
    a[2:4, :2], a[2:4, 2:4] = -np.linalg.solve(inertia, stiff), -np.linalg.solve(inertia, damp)
    a[2:4, 4] = np.linalg.solve(inertia, [1.0, 0.0])
    hop = expm(a * controller.sample_time_s)
    ac, bc, cc, dc = measurement_matrices(controller.law)
    n, d = bc.size, controller.compute_delay_samples
    assert d == 1
    closed = np.zeros((4 + d + n, 4 + d + n))  # plant, the command on its way, law
    read = np.array([k, k, 0, 0])
    closed[:4, :4], closed[:4, 4] = hop[:4, :4], hop[:4, 4]
    closed[4, :4], closed[4, 5:] = -dc * read, -cc
    closed[5:, :4], closed[5:, 5:] = np.outer(bc, read), ac
    return np.abs(np.linalg.eigvals(closed)).max()


def test_with_the_missing_damping_every_mass_and_spring_is_stable(thor, stand):
    found = passivity(tuned(), stand, thor)
    short = -found.least_damping_N_s_per_m
    assert short > 0
    for mass in np.geomspace(1e-3, 1e4, 15):
        for stiffness in (0.0, *np.geomspace(1e2, 1e9, 15)):
            assert attached(tuned(), thor, mass, stiffness, 1.02 * short) < 1 + 1e-9, (mass, stiffness)


def test_a_loop_that_breaks_the_rule_is_unstable_with_the_right_spring(thor, stand):
    """k_i at twice the rule: stable by itself, and not with a spring that meets Z where Re Z is negative."""
    m, b, _, _ = figures(thor)
    controller = controller_of(k_i=2 * b * 4.0 / m, k_d=0.06)
    found = passivity(controller, stand, thor)
    assert controller.close(stand, thor).figures().stable
    assert found.violated_hz == found.low_hz
    f = np.array([found.least_hz])
    law = controller.law.measurement_response(f) * hold_response(f, TS, 1)
    z = port_of(stand, thor, "F1", controller.command.per_effort).response(f).impedance(law)[0]
    w = 2 * np.pi * found.least_hz
    mass, stiffness = (-z.imag / w, 0.0) if z.imag < 0 else (1e-3, z.imag * w)
    assert attached(controller, thor, mass, stiffness) > 1 + 1e-6


def test_bands_are_those_of_a_dense_calculation(thor, stand):
    found = passivity(tuned(), stand, thor)
    f = np.linspace(0.5, 499, 200_001)
    s = 2j * np.pi * f
    q = np.exp(-s * TS)
    c = np.polyval(tuned().measurement.num[::-1], q) / np.polyval(tuned().measurement.den[::-1], q)
    z = IMPEDANCES["unlumped", "link1"](*figures(thor), c * q * (1 - q) / (s * TS), s)
    edges = f[np.flatnonzero(np.diff(np.sign(z.real)))]
    given = [edge for band in found.bands_hz for edge in band if 0.5 < edge < 499]
    np.testing.assert_allclose(given, edges, atol=0.003)
    assert found.violated_hz == pytest.approx(edges[0], abs=0.003)
    assert found.least_damping_N_s_per_m == pytest.approx(z.real.min(), rel=1e-6)
    assert found.least_hz == pytest.approx(f[np.argmin(z.real)], abs=0.01)
    assert found.limit_hz == pytest.approx(np.sqrt(655e3 / 0.646) / 2 / np.pi, rel=1e-9)


def test_a_violation_between_grid_points_is_found(thor, stand):
    """A resonance of the law 1e-3 Hz wide at 12.3456 Hz."""
    pole = np.exp((-2 * np.pi * 5e-4 + 2j * np.pi * 12.3456) * TS)
    den = np.array([1.0, -2 * pole.real, abs(pole) ** 2])
    law = TransferFunction(num=3.0 * den + np.array([0.0, 3e-5, -3e-5]), den=den)
    controller = replace(tuned(), law=law_of(law.num, law.den))
    found = passivity(controller, stand, thor, high_hz=60.0)
    f = np.linspace(12.33, 12.36, 100_001)
    s = 2j * np.pi * f
    q = np.exp(-s * TS)
    c = np.polyval(law.num[::-1], q) / np.polyval(law.den[::-1], q)
    z = IMPEDANCES["unlumped", "link1"](*figures(thor), c * q * (1 - q) / (s * TS), s)
    negative = f[z.real < 0]
    assert 0 < negative.size < 50_000
    assert found.violated_hz == pytest.approx(negative[0], abs=1e-6)
    assert [band[0] for band in found.bands_hz] == pytest.approx([0.01, negative[-1]], abs=1e-6)


def test_rows_are_the_condition_for_any_gains(thor, stand):
    spec = so.ControllerSpec(compute_delay_samples=2)
    q = np.exp(-S * TS)
    basis = np.column_stack([np.ones(F.size), TS / 2 * (1 + q) / (1 - q), (1 - q) / (2 * TS - TS * q)])
    rows, least = passivity_rows(stand, thor, spec, command_of(stand, thor, "F1").per_effort, basis, F)
    m, b, k, m_l = figures(thor)
    for theta in np.random.default_rng(1).normal(size=(20, 3)) * [5.0, 200.0, 0.1]:
        c = basis @ theta * q**2 * (1 - q) / (S * TS)
        z = IMPEDANCES["unlumped", "link1"](m, b, k, m_l, c, S)
        expected = z.real / np.abs(z) * np.abs(1 + k / ((m + m_l) * S**2 + b * S + k) * c)
        np.testing.assert_allclose(rows @ theta - least, expected, rtol=1e-6, atol=1e-9)


def test_the_port_wears_the_plants_parts(thor):
    """A load cell and a current loop are lags in the loop, and leave the port's own force alone."""
    plant = high_impedance(parts=("current_loop", "load_cell"))
    c = np.full(F.size, 3.0 + 0j)
    found = port_of(plant, thor, "F1", command_of(plant, thor, "F1").per_effort).response(F).impedance(c)
    lag = 1 / (1 + 1j * F / 500.0)
    np.testing.assert_allclose(found, IMPEDANCES["unlumped", "link1"](*figures(thor), c * lag**2, S), rtol=1e-9)


def test_what_cannot_be_answered_is_refused(thor, stand):
    with pytest.raises(ControlError, match="states no probe"):
        passivity(tuned(), replace(stand, ports=(replace(stand.port, probe=None),)), thor)
    with pytest.raises(ControlError, match="no port at link 2"):
        passivity(tuned(), replace(stand, ports=()), thor)
    with pytest.raises(ControlError, match="is not a band"):
        passivity(tuned(), stand, thor, low_hz=10.0, high_hz=600.0)
    with pytest.raises(ControlError, match="is not a band within"):
        passivity(tuned(), stand, thor, high_hz=100.0).holds((1.0, 200.0))
    screw = high_impedance(parts=("screw_mode",))
    with pytest.raises(ControlError, match="not affine in the gains"):
        passivity_rows(screw, thor, tuned().spec, 1.0, np.ones((F.size, 1), dtype=complex), F)


def test_what_is_found_says_where(thor, stand):
    found = passivity(tuned(), stand, thor)
    assert found.holds((0.1, 0.99 * found.violated_hz))
    assert not found.holds((0.1, 1.01 * found.violated_hz))
    assert f"Re Z is lowest at {found.least_hz:.4g} Hz: {found.least_damping_N_s_per_m:.4g} N s/m" in flatten(
        repr(found)
    )
    assert set(found.to_dict()) >= {"bands_hz", "violated_hz", "least_hz", "limit_hz"}


def spun(params, law, delay=1):
    """The eigenvalues of the stand's loop under F_m = -law F1, in NumPy alone."""
    m, b, k, m_l = figures(params)
    block = np.zeros((3, 3))
    block[0, 1] = 1.0
    block[1] = np.array([-k, -b, 1.0]) / (m + m_l)
    step = expm(block * TS)
    big = np.zeros((2 + delay, 2 + delay))
    big[:2, :2], big[:2, -1] = step[:2, :2], step[:2, 2]
    big[2, 0] += -law * k
    for i in range(1, delay):
        big[2 + i, 1 + i] = 1.0
    return np.linalg.eigvals(big)


@pytest.mark.parametrize("gain", [-3.0, -1.05, 0.0, 1.0, 5.0, 10.0, 20.0, 30.0])
def test_a_loop_that_grows_with_the_link_held_is_passive_nowhere(gain, thor, stand):
    """Re Z >= 0 below 26 Hz under k_p = 30 says nothing: an eigenvalue is at 1.027."""
    controller = replace(tuned(), law=law_of([gain]))
    grows = bool(np.max(np.abs(spun(thor, gain))) > 1.0)
    for plant in (stand, moving_output()):  # what link 2 is does not matter
        found = passivity(controller, plant, thor)
        assert found.held_stable is found.to_dict()["held_stable"] is not grows
        assert bool(found.bands_hz) is not grows
        assert ("unstable with link 2 held" in flatten(repr(found))) is grows
        if grows:
            assert not found.holds((1.0, 20.0))
            assert found.violated_hz == found.low_hz


def test_an_undamped_pole_is_no_hole(thor, stand):
    """At the pole itself the responses are infinite and Z under feedback is that of the equations."""
    params = thor.update(b_r=0.0)
    m, _, k, m_l = figures(params)
    f = np.sqrt(k / (m + m_l)) / (2 * np.pi) * np.array([1.0, 1.0 + 1e-15, 1.0 - 1e-12, 1.0 + 1e-9, 1.0 + 1e-6, 1.1])
    s = 2j * np.pi * f
    port = port_of(stand, params, "F1", command_of(stand, params, "F1").per_effort)
    c = 3.0 + 0.02 * s
    found = port.response(f).impedance(c)
    np.testing.assert_allclose(found, IMPEDANCES["unlumped", "link1"](m, 0.0, k, m_l, c, s), rtol=1e-6)


def test_an_actuator_without_damping_has_the_bands_of_one_with_hardly_any(thor, stand):
    none, hardly = (passivity(tuned(), stand, thor.update(b_r=b)) for b in (0.0, 1e-12))
    np.testing.assert_allclose(none.bands_hz, hardly.bands_hz, rtol=1e-6)
    assert none.held_stable
    assert none.least_damping_N_s_per_m == pytest.approx(hardly.least_damping_N_s_per_m, rel=1e-6)
