"""Loop figures against python-control and plain NumPy: own hold, own delay, own polynomials."""

from __future__ import annotations

import control
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import cont2discrete

import seaopt as so
from seaopt.control import DigitalPlant, Gains, Loop, command_of, sample
from seaopt.control.loops.response import find_zeros
from tests.blocks import of_one_input
from tests.laws import law_of, measurement_matrices


def loop_of(structure="pid", plant=None, params=None, delay=1, ts=1e-3, **gains):
    plant, params = plant or so.plants.high_impedance(), params or so.plants.thor()
    law = Gains(**{"k_p": 3.2, "k_i": 1.3, "k_d": 0.033, "T_f": 1e-3, "k_r": 1.0 + gains.get("k_p", 3.2), **gains})
    digital = sample(plant, params, "F1", command_of(plant, params, "F1").per_effort, ts, delay)
    return Loop(plant=digital, law=law.law(structure, ts))


def test_the_sampled_plant_is_scipys_zero_order_hold(swing, thor):
    model = swing.linearize(thor)
    gain = command_of(swing, thor, "F1").per_effort
    found = sample(swing, thor, "F1", gain, 1e-3, 1)
    a, b, c, d, _ = cont2discrete((model.A, model.B * gain, model.C[:1], model.D[:1] * gain), 1e-3, "zoh")
    np.testing.assert_allclose(found.a, a, rtol=1e-10, atol=1e-14)
    np.testing.assert_allclose(found.b, b[:, 0], rtol=1e-9, atol=1e-16)
    np.testing.assert_allclose(found.c, c)
    assert found.static_gain == pytest.approx(1.0)
    assert found.d == d[0, 0]


def test_the_law_is_the_written_one():
    """Run the definition sample by sample: trapezoidal integral, filtered difference, weights of the reference."""
    ts = 1e-3
    rng = np.random.default_rng(0)
    ref, meas = rng.normal(size=(2, 200))
    for k_r, c in ((3.9, 1.0), (3.9, 0.0), (1.7, 0.4)):
        law = Gains(k_p=3.0, k_i=20.0, k_d=0.03, T_f=2e-3, k_r=k_r, c=c)
        e, integral, rate, out = ref - meas, 0.0, 0.0, []
        v = c * ref - meas
        for k in range(200):
            before_e, before_v = (e[k - 1], v[k - 1]) if k else (0.0, 0.0)
            integral += 20.0 * ts / 2 * (e[k] + before_e)
            rate = (2e-3 * rate + (v[k] - before_v)) / (2e-3 + ts)
            out.append(k_r * ref[k] - 3.0 * meas[k] + integral + 0.03 * rate)
        from scipy.signal import lfilter

        c_r, c_y = law.law("pid", ts).transfer_functions()
        found = lfilter(c_r.num, c_r.den, ref) - lfilter(c_y.num, c_y.den, meas)
        np.testing.assert_allclose(found, out, rtol=1e-9)
        assert c_y.den[0] == 1.0


def independent(loop, f):
    """Return L and F/F_ref in NumPy alone, from matrices and coefficients."""
    z = np.exp(2j * np.pi * f * loop.plant.sample_time_s)
    states = np.linalg.solve(z[:, None, None] * np.eye(len(loop.plant.b)) - loop.plant.a, loop.plant.b[None, :, None])
    p = ((loop.plant.c @ states)[:, 0, 0] + loop.plant.d[0]) * z**-loop.plant.delay_samples
    value = lambda c: sum(v * z**-i for i, v in enumerate(c))  # noqa: E731
    c_r, c_y = (value(tf.num) / value(tf.den) for tf in loop.law.transfer_functions())
    return p * c_y, p * c_r / (1 + p * c_y), c_y / (1 + p * c_y)


CASES = [(structure, name, 1) for structure in ("pd", "pid") for name in ("stand", "swing")]
CASES += [("pid", "stand", 0), ("pd", "swing", 0), ("pd", "stand", 3), ("pid", "swing", 3)]


@pytest.mark.parametrize(("structure", "name", "delay"), CASES)
def test_figures_by_an_independent_calculation(structure, name, delay, request, thor):
    loop = loop_of(structure, request.getfixturevalue(name), thor, delay)
    figures = loop.figures()
    f = np.unique(np.r_[np.geomspace(1e-3, 499.99, 60_000), np.linspace(10, 60, 40_000)])
    open_loop, tracking, noise = independent(loop, f)
    s = 1 / (1 + open_loop)
    assert figures.ms == pytest.approx(np.abs(s).max(), rel=1e-4)
    assert figures.mt == pytest.approx(np.abs(open_loop * s).max(), rel=1e-4)
    assert figures.noise_gain == pytest.approx(np.abs(noise).max(), rel=1e-4)
    static = abs(independent(loop, np.array([1e-5]))[1][0])
    assert figures.reference_peak == pytest.approx(np.abs(tracking).max() / static, rel=1e-4)
    below = f[np.flatnonzero(np.abs(tracking) < static / np.sqrt(2))[0]]
    assert figures.bandwidth_hz == pytest.approx(below, rel=1e-3)
    inside = (np.abs(tracking) > np.sqrt(0.5)) & (np.abs(tracking) < np.sqrt(2))
    edges = np.flatnonzero(np.diff(inside.astype(int)))
    bands = [(f[a], f[b]) for a, b in zip(np.r_[0, edges], np.r_[edges, f.size - 1], strict=True) if inside[a + 1]]
    widest = max(bands, key=lambda band: band[1] - band[0])
    assert figures.tracking_band_hz == pytest.approx(widest, rel=2e-3, abs=2e-3)
    assert figures.disk_margin == pytest.approx(2 / np.abs(2 * s - 1).max(), rel=1e-4)


def test_margins_are_python_controls_on_a_stable_loop(stand, thor):
    loop = loop_of("pid", stand, thor)
    z = control.tf("z")
    z.dt = 1e-3
    plant = control.ss2tf(control.ss(loop.plant.a, loop.plant.b[:, None], loop.plant.c, loop.plant.d[:, None], 1e-3))
    c_y = loop.law.transfer_functions()[1]
    c = control.tf(c_y.num, c_y.den, 1e-3)
    open_loop = plant * c * control.tf([1], [1, 0], 1e-3)
    gm, pm, _, _, wpc, _ = control.stability_margins(open_loop, method="poly")
    figures = loop.figures()
    assert figures.gain_margin_db == pytest.approx(20 * np.log10(gm), rel=1e-3)
    assert figures.phase_margin_deg == pytest.approx(pm, rel=1e-3)
    assert figures.delay_margin_s == pytest.approx(np.radians(pm) / wpc, rel=1e-2)
    assert figures.crossover_hz == pytest.approx(wpc / 2 / np.pi, rel=1e-3)


def test_an_unstable_loop_has_no_margins(stand, thor):
    """python-control's disk_margins reports good ones for such a loop; eigenvalues decide here."""
    figures = loop_of("pd", stand, thor, k_p=400.0, k_d=3.0).figures()
    assert not figures.stable
    assert figures.spectral_radius > 1
    assert (figures.gain_margin_db, figures.phase_margin_deg, figures.delay_margin_s, figures.disk_margin) == (
        0,
        0,
        0,
        0,
    )
    assert np.isinf(figures.ms)


def test_a_light_mode_between_grid_points_is_found():
    """zeta = 1e-5 at 77.123 Hz under unit feedback: the peak of S stands on a line 1e-3 Hz wide."""
    wn, zeta, ts = 2 * np.pi * 77.123, 1e-5, 1e-3
    a, b, c, _, _ = cont2discrete(
        (
            np.array([[0, 1], [-(wn**2), -2 * zeta * wn]]),
            np.array([[0], [wn**2]]),
            np.array([[1e-6, 0]]),
            np.zeros((1, 1)),
        ),
        ts,
    )
    plant = DigitalPlant(a=a, b=b[:, 0], c=c, d=np.zeros(1), sample_time_s=ts, delay_samples=0, static_gain=1e-6)
    loop = Loop(plant=plant, law=law_of([1.0]))
    f = np.linspace(77.12, 77.126, 50_001)
    exact = np.abs(1 / (1 + independent(loop, f)[0])).max()
    assert loop.figures().ms == pytest.approx(exact, rel=1e-4)
    assert exact > 1.02


@pytest.mark.parametrize("name", ["stand", "swing"])
def test_stability_is_what_a_simulation_shows(name, request, thor):
    """Step the loop sample by sample for gains about the edge of stability."""
    plant = request.getfixturevalue(name)
    for factor in (1.0, 4.0, 7.0, 9.0, 14.0):
        loop = loop_of("pd", plant, thor, k_p=3.2 * factor, k_d=0.033 * factor)
        a, b, (c,), _ = of_one_input(loop.plant.block)
        ac, bc, cc, dc = measurement_matrices(loop.law)
        x, xc = np.full(len(b), 1e-3), np.zeros(len(bc))
        sizes = []
        for _ in range(6000):
            y = c @ x
            u = -(cc @ xc + dc * y)
            x, xc = a @ x + b * u, ac @ xc + bc * y
            sizes.append(np.abs(u))
            if sizes[-1] > 1e12:
                break
        grew = max(sizes[-50:]) > max(sizes[:50])
        assert loop.figures().stable != grew


@given(st.floats(0.3, 2.0), st.integers(0, 3))
@settings(max_examples=10)
def test_margins_scale_as_they_must(factor, extra):
    """A loop gain of x takes x off the gain margin; a sample of delay takes a sample off the delay margin."""
    base = loop_of("pd")
    scaled = loop_of("pd", k_p=3.2 * factor, k_d=0.033 * factor)
    assert scaled.figures().gain_margin_db == pytest.approx(
        abs(base.figures().gain_margin_db - 20 * np.log10(factor)), abs=1e-3
    )
    late = loop_of("pd", delay=1 + extra).figures()
    assert late.delay_margin_s == pytest.approx(base.figures().delay_margin_s - extra * 1e-3, abs=1e-8)


def test_zeros_in_brackets_are_found_to_rounding():
    roots = np.array([2.345, 7.1, 1e-3, 0.0])

    def curve(x, i):
        return (x - roots[i]) * (1 + x**2)

    low, high, every = roots - 0.7, roots + 1.9, np.arange(4)
    found = find_zeros(curve, low, high, curve(low, every), curve(high, every), 1e-15)
    np.testing.assert_allclose(found, roots, rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize(("gains", "returns"), [
    pytest.param({"k_p": 0.9, "k_i": 14.0, "k_d": 0.013, "k_r": 1.75, "c": 0.8}, False, marks=pytest.mark.slow),
    pytest.param(  # lingers from the start
        {"k_p": 1.95, "k_i": 4.45, "k_d": 0.032, "k_r": 2.07, "c": 0.4}, True, marks=pytest.mark.slow
    ),
    ({"k_p": 0.86, "k_i": 20.0, "k_d": 0.079, "k_r": 1.66, "c": 0.65}, True),  # comes back
])  # fmt: skip
def test_a_shoulder_is_where_a_dense_grid_has_it(gains, returns):
    """From 1.03 to 3 times the bandwidth abs(F/F_ref) is to fall below -3 dB by the quarter power of frequency."""
    loop = loop_of(**gains)
    found = loop.figures()
    f = np.linspace(1.03 * found.bandwidth_hz, 3.0 * found.bandwidth_hz, 200_001)
    _, tracking, *_ = independent(loop, f)
    static = abs(independent(loop, np.array([1e-7]))[1][0])
    above = np.abs(tracking) * (f / found.bandwidth_hz) ** 0.25 > np.sqrt(0.5) * static
    assert bool(np.any(above)) == (found.return_hz is not None) == returns
    if returns:
        assert found.return_hz == pytest.approx(f[np.argmax(above)], rel=1e-4)
