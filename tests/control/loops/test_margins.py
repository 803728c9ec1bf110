"""Margins with their witnesses, peaks with proof, and the traps: against NumPy alone, python-control where right."""

from __future__ import annotations

from functools import cache

import control
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import cont2discrete, tf2ss

import seaopt as so
from seaopt.control import DigitalPlant, Loop
from seaopt.control.loops import peaks
from seaopt.control.loops.margins import margins, nu_gap
from seaopt.errors import ControlError
from tests.blocks import of_one_input
from tests.control.loops.test_loop import loop_of
from tests.laws import law_of, measurement_matrices

INTEGRATING = [("pid", 22, 1.6), ("pid_dob", 22, 1.6), ("pid_dob", 30, 2.0)]
ONE = law_of([1.0])


@cache
def known(structure):
    """A loop on the stand and its margins, found once."""
    loop = loop_of(structure)
    return loop, margins(loop)


def gained(factor):
    return law_of([factor])


def modal(modes, ts=1e-3, delay=0, law=ONE):
    """A sum of second-order modes (hz, zeta, gain) behind a hold, under a law."""
    n = 2 * len(modes)
    a, b, c = np.zeros((n, n)), np.zeros((n, 1)), np.zeros((1, n))
    for k, (hz, zeta, gain) in enumerate(modes):
        w = 2 * np.pi * hz
        a[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = [[0, w], [-w, -2 * zeta * w]]
        b[2 * k + 1], c[0, 2 * k] = w, gain
    a, b, c, _, _ = cont2discrete((a, b, c, np.zeros((1, 1))), ts)
    plant = DigitalPlant(
        a=a, b=b[:, 0], c=c, d=np.zeros(1), sample_time_s=ts, delay_samples=delay, static_gain=sum(m[2] for m in modes)
    )
    return Loop(plant=plant, law=law)


def independent(loop, f):
    """L in NumPy alone, from matrices and coefficients."""
    z, plant = np.exp(2j * np.pi * f * loop.plant.sample_time_s), loop.plant
    rhs = np.broadcast_to(plant.b[:, None].astype(complex), (f.size, plant.b.size, 1))
    x = np.linalg.solve(z[:, None, None] * np.eye(plant.b.size) - plant.a, rhs)[..., 0]
    value = lambda c: sum(v * z**-i for i, v in enumerate(c))  # noqa: E731
    c_y = loop.law.transfer_functions()[1]
    return (x @ plant.c[0] + plant.d[0]) * z**-plant.delay_samples * value(c_y.num) / value(c_y.den)


def poles_of(loop, factor=1.0, extra=0):
    """The poles with a (complex) factor and extra samples of delay in the loop."""
    plant = DigitalPlant(
        a=loop.plant.a, b=loop.plant.b, c=loop.plant.c, d=loop.plant.d, sample_time_s=1.0,
        delay_samples=loop.plant.delay_samples + extra, static_gain=1.0,
    )  # fmt: skip
    a, b, (c,), (d,) = of_one_input(plant.block)
    ac, bc, cc, dc = measurement_matrices(loop.law)
    inner = 1.0 + factor * d * dc
    u_x, u_k = -factor * dc * c / inner, -factor * cc / inner
    closed = np.block([
        [a + np.outer(b, u_x), np.outer(b, u_k)],
        [np.outer(bc, c + d * u_x), ac + np.outer(bc, d * u_k)],
    ])  # fmt: skip
    return np.linalg.eigvals(closed)


@pytest.mark.parametrize("name", ["stand", "swing"])
@pytest.mark.parametrize("kind", ["symmetric", "S-based", "T-based"])
def test_a_disk_margins_witness_puts_a_pole_on_the_circle(name, kind, request, thor):
    loop = loop_of("pid", request.getfixturevalue(name), thor)
    found = margins(loop).disks[kind]
    poles = poles_of(loop, found.perturbation)
    z = np.exp(2j * np.pi * found.frequency_hz * 1e-3)
    assert np.min(np.abs(poles - z)) < 1e-7
    f, skew = found.perturbation, found.skew
    delta = 2 * (f - 1) / ((1 + skew) * f + (1 - skew))
    assert abs(delta) == pytest.approx(found.alpha, rel=1e-9)


@given(st.floats(0, 2 * np.pi), st.sampled_from(["symmetric", "S-based", "T-based"]))
@settings(max_examples=25)
def test_every_perturbation_inside_the_disk_is_survived(angle, kind):
    loop, whole = known("pid")
    found = whole.disks[kind]
    delta = 0.999 * found.alpha * np.exp(1j * angle)
    f = (2 + (1 - found.skew) * delta) / (2 - (1 + found.skew) * delta)
    assert np.max(np.abs(poles_of(loop, f))) < 1.0


@pytest.mark.parametrize("name", ["stand", "swing"])
def test_gain_and_delay_margins_are_where_stability_ends(name, request, thor):
    loop = loop_of("pid", request.getfixturevalue(name), thor)
    found = margins(loop)
    factor = 10 ** (found.gain_up_db / 20)
    assert (
        np.max(np.abs(poles_of(loop, factor * (1 - 1e-6)))) < 1.0 < np.max(np.abs(poles_of(loop, factor * (1 + 1e-6))))
    )
    assert found.gain_down_db is None
    whole = int(found.delay_s / 1e-3)
    assert np.max(np.abs(poles_of(loop, extra=whole))) < 1.0 < np.max(np.abs(poles_of(loop, extra=whole + 1)))


def test_a_gain_margin_downwards():
    """A double integrator with lag needs its gain: raising and lowering it both end stability."""
    ts = 1e-2
    a, b = np.array([[1, ts], [0, 1]]), np.array([ts**2 / 2, ts])
    plant = DigitalPlant(
        a=a, b=b, c=np.array([[1.0, 0]]), d=np.zeros(1), sample_time_s=ts, delay_samples=0, static_gain=np.inf
    )
    lead = law_of(np.convolve([40.0, -38.4], [1.0, -0.995]), np.convolve([1.0, -0.4], [1.0, -1.0]))
    loop = Loop(plant=plant, law=lead)
    found = margins(loop)
    for db in (found.gain_up_db, found.gain_down_db):
        assert np.max(np.abs(poles_of(loop, 10 ** (db / 20)))) == pytest.approx(1.0, abs=1e-9)
    assert found.gain_down_db < 0 < found.gain_up_db
    assert loop.figures().gain_margin_db == pytest.approx(min(found.gain_up_db, -found.gain_down_db))


@cache
def tune_integrating(structure, bandwidth_hz, ms):
    spec = so.ControllerSpec(
        bandwidth_hz=bandwidth_hz, max_sensitivity=ms, structure=structure, reference_weights="error"
    )
    return so.tune(so.plants.high_impedance(), so.plants.thor(), spec)


@pytest.mark.parametrize(
    ("name", "structure", "bandwidth_hz", "ms"),
    [("stand", *law) for law in INTEGRATING]
    + [("swing", *law) for law in INTEGRATING if law[0] == "pid_dob"],  # that pid, not made for the swing, is unstable
)
def test_an_integrator_is_no_crossing(structure, bandwidth_hz, ms, name, request, thor):
    """-1/L at 0 Hz was rounding over infinity: 1.5e-7 to 1.5e-8 of pid_dob on the stand, up to 1.6e-4 on the swing."""
    loop = tune_integrating(structure, bandwidth_hz, ms).close(request.getfixturevalue(name), thor)
    found = margins(loop)
    assert found.gain_down_db is None
    assert found.gain_up_db == pytest.approx(loop.figures().gain_margin_db)
    top = 10 ** (found.gain_up_db / 20)
    for factor in (1e-4, 1e-2, 0.1, 0.5, 1.0, 0.999 * top):
        assert np.max(np.abs(poles_of(loop, factor))) < 1.0
    for factor in (1e-9, 1e-6):  # a double integrator is known to the root of rounding
        assert np.max(np.abs(poles_of(loop, factor))) < 1.0 + (1e-5 if structure == "pid_dob" else 0.0)
    assert np.max(np.abs(poles_of(loop, 1.001 * top))) > 1.0


@pytest.mark.parametrize("num", [[1.0, -1.0], [1.0, 1.0], [1.0, 0.0, -1.0]])
def test_a_zero_on_the_circle_is_no_crossing(num):
    """At z = 1, at z = -1 and at both; python-control's factors are the others."""
    for gain in np.linspace(-0.3, 0.3, 13):
        loop = modal([(20, 0.7, 1.0)], law=law_of(gain * np.array(num)))
        for hz, factor in margins(loop).gain_crossings:
            value = independent(loop, np.array([hz]))[0]
            assert value == pytest.approx(-1.0 / factor, rel=1e-6)
            assert abs(value) > 1e-6


@pytest.mark.skipif(not hasattr(control, "disk_margins"), reason="python-control has disk_margins from 0.10.2 on")
def test_an_unstable_loop_that_python_control_calls_comfortable(stand, thor):
    """python-control's disk margins of this unstable loop, from the same S - T, look good; there are none."""
    loop = loop_of("pd", stand, thor, k_p=400.0, k_d=3.0)
    assert np.max(np.abs(poles_of(loop))) > 1.5
    f = np.geomspace(0.1, 499.9, 20_000)
    s = 1 / (1 + independent(loop, f))
    assert 2 / np.abs(2 * s - 1).max() > 0.5
    model = control.ss(loop.plant.a, loop.plant.b[:, None], loop.plant.c, loop.plant.d[:, None], 1e-3)
    c_y = loop.law.transfer_functions()[1]
    law = control.ss(control.tf(c_y.num, c_y.den, 1e-3))
    open_loop = model * control.ss(control.tf([1], [1, 0], 1e-3)) * law
    assert control.disk_margins(open_loop, 2 * np.pi * f)[0] > 0.5
    found = margins(loop)
    assert (found.gain_up_db, found.gain_down_db, found.phase_deg, found.delay_s, found.disks) == (0, 0, 0, 0, {})


@pytest.mark.parametrize("zeta", [1e-3, 1e-5])
@pytest.mark.parametrize("hz", [3.21, 77.123, 431.7])
def test_a_light_mode_between_grid_points(zeta, hz):
    """The peak lies on a line zeta wide; a dense grid laid about the mode itself finds the same."""
    loop = modal([(20.0, 0.7, 1.0), (hz, zeta, 0.4 * zeta)])
    f = hz + 40 * zeta * hz * np.linspace(-1, 1, 100_001)
    open_loop = independent(loop, f)
    s, t = np.abs(1 / (1 + open_loop)), np.abs(open_loop / (1 + open_loop))
    figures = loop.figures()
    base = np.geomspace(1e-3, 499.9, 100_000)
    wide = independent(loop, base)
    assert figures.ms == pytest.approx(max(s.max(), np.abs(1 / (1 + wide)).max()), rel=1e-6)
    assert figures.mt == pytest.approx(max(t.max(), np.abs(wide / (1 + wide)).max()), rel=1e-6)


def test_several_crossings_are_all_there():
    loop = modal([(5.0, 0.5, 1.5), (15.0, 0.02, 0.08), (33.0, 0.02, 0.05), (60.0, 0.03, 0.07)], law=gained(1.0))
    f = np.concatenate([np.linspace(0.01, 90.0, 72_000), np.linspace(90.0, 499.9, 40_000)[1:]])
    open_loop = independent(loop, f)
    dense = f[np.flatnonzero(np.diff(np.sign(np.abs(open_loop) - 1)))]
    found = margins(loop)
    np.testing.assert_allclose([hz for hz, _ in found.phase_crossings], dense, atol=2e-3)
    assert len(dense) >= 5
    turns = np.flatnonzero(np.diff(np.sign(open_loop.imag)))
    turns = turns[open_loop.real[turns] < 0]
    assert len(found.gain_crossings) >= len(turns) >= 1
    for k in turns:
        assert min(abs(hz - f[k]) for hz, _ in found.gain_crossings) < (2e-3 if f[k] < 90 else 1.1e-2)


def test_a_response_near_nyquist_is_not_cut_off():
    """The loop comes nearest to -1 at the Nyquist frequency itself, where L is real."""
    loop = modal([(5.0, 0.7, 1.0), (499.0, 0.3, 0.5)], law=gained(0.9))
    nyquist = independent(loop, np.array([500.0]))[0].real
    f = np.linspace(0.01, 500.0, 200_001)
    s = np.abs(1 / (1 + independent(loop, f)))
    assert loop.figures().ms == pytest.approx(s.max(), rel=1e-8)
    if nyquist < 0:
        assert any(hz == pytest.approx(500.0) for hz, _ in margins(loop).gain_crossings)


def test_no_feedback_has_no_crossings():
    loop = modal([(10.0, 0.5, 1.0)], law=gained(0.0))
    figures = loop.figures()
    assert (figures.ms, figures.mt) == (pytest.approx(1.0), pytest.approx(0.0, abs=1e-12))
    assert (figures.gain_margin_db, figures.phase_margin_deg, figures.crossover_hz) == (None, None, None)


def test_laws_with_denominators_of_their_own_share_an_integrator():
    """C_r over (1 - q) alone and C_y over (1 - q)(1 - q/2): the integrator is one, and the loop is stable."""
    loop = modal([(10.0, 0.7, 1.0)])
    reference = [0.02], [1.0, -1.0]
    law = law_of([0.02, -0.01], np.convolve([1.0, -1.0], [1.0, -0.5]), reference)
    figures = Loop(plant=loop.plant, law=law).figures()
    same = Loop(plant=loop.plant, law=law_of(*reference)).figures()
    assert figures.stable
    assert figures.reference_peak == pytest.approx(same.reference_peak, rel=1e-8)


@given(st.floats(0.3, 3.0))
@settings(max_examples=10)
def test_gain_takes_itself_off_the_gain_margins(factor):
    scaled = loop_of("pd", k_p=3.2 * factor, k_d=0.033 * factor)
    shift = 20 * np.log10(factor)
    assert margins(scaled).gain_up_db == pytest.approx(known("pd")[1].gain_up_db - shift, abs=1e-8)


@given(st.floats(0.1, 10.0))
@settings(max_examples=10)
def test_figures_scale_with_time(scale):
    """A plant and a clock that are both slower have the same peaks at frequencies slower as much."""
    modes = [(12.0, 0.3, 1.0), (90.0, 0.02, 0.02)]
    base = modal(modes, delay=1)
    slow = modal([(hz / scale, zeta, gain) for hz, zeta, gain in modes], ts=1e-3 * scale, delay=1)
    a, b = base.figures(), slow.figures()
    assert (b.ms, b.mt, b.disk_margin) == (pytest.approx(a.ms), pytest.approx(a.mt), pytest.approx(a.disk_margin))
    assert b.delay_margin_s == pytest.approx(a.delay_margin_s * scale, rel=1e-7)
    assert b.crossover_hz == pytest.approx(a.crossover_hz / scale, rel=1e-7)


@given(st.data())
@settings(max_examples=25)
def test_peaks_of_random_loops_are_at_least_any_grids(data):
    """Against a dense grid in NumPy: never below it, and above it by no more than the grid's step explains."""
    count = data.draw(st.integers(1, 3))
    modes = [
        (data.draw(st.floats(0.5, 480.0)), data.draw(st.floats(1e-3, 1.0)), data.draw(st.floats(0.01, 0.4)))
        for _ in range(count)
    ]
    loop = modal(modes, delay=data.draw(st.integers(0, 2)), law=gained(data.draw(st.floats(0.01, 2.0))))
    figures = loop.figures()
    poles = poles_of(loop)
    assert figures.stable == (np.max(np.abs(poles)) < 1.0) or abs(np.max(np.abs(poles)) - 1) < 1e-9
    if not figures.stable:
        return
    at, width = np.abs(np.angle(poles)), np.maximum(1 - np.abs(poles), 1e-9)
    theta = np.concatenate(
        [np.linspace(1e-6, np.pi, 4000), *(c + w * np.linspace(-9, 9, 1001) for c, w in zip(at, width, strict=True))]
    )
    f = np.clip(theta, 1e-6, np.pi) / (2 * np.pi * 1e-3)
    open_loop = independent(loop, f)
    s = 1 / (1 + open_loop)
    for found, curve in ((figures.ms, s), (figures.mt, 1 - s), (2 / figures.disk_margin, 2 * s - 1)):
        assert found >= np.abs(curve).max() * (1 - 1e-9)
        assert found == pytest.approx(np.abs(curve).max(), rel=1e-3)


def test_the_nu_gap_is_near_one_though_the_loop_is_fine(stand, swing, thor):
    """Vinnicombe's gap from the definition on a dense grid; the controller survives the plant all the same."""
    bench, moving = loop_of("pid", stand, thor), loop_of("pid", swing, thor)
    f = np.geomspace(1e-3, 499.9, 200_000)
    l1, l2 = independent(bench, f), independent(moving, f)
    chord = np.abs(l1 - l2) / np.sqrt((1 + np.abs(l1) ** 2) * (1 + np.abs(l2) ** 2))
    gap, at = nu_gap(bench, moving)
    assert gap == pytest.approx(chord.max(), rel=1e-3)
    assert gap > 0.9
    assert at == pytest.approx(f[chord.argmax()], rel=1e-2)
    assert moving.figures().ms < 1.5
    assert nu_gap(bench, bench)[0] == 0.0


def test_a_nu_gap_across_the_winding_is_one():
    """P and -P: 1 + P2~ P1 = 1 - |P|^2 passes through zero, the winding differs or the gap is reached: never small."""
    a, b = modal([(10.0, 0.5, 2.0)]), modal([(10.0, 0.5, -2.0)])
    assert nu_gap(a, b)[0] > 0.79
    with pytest.raises(ControlError, match="sample time"):
        nu_gap(a, modal([(10.0, 0.5, 2.0)], ts=2e-3))


def rational(num, den, ts=1e-3):
    """A continuous transfer function behind a hold, under a law of 1."""
    a, b, c, d = (np.atleast_2d(block) for block in tf2ss(num, den))
    a, b, c, d, _ = cont2discrete((a, b, c, d), ts)
    gain = num[-1] / den[-1] if den[-1] else np.inf
    plant = DigitalPlant(a=a, b=b[:, 0], c=c, d=d[0], sample_time_s=ts, delay_samples=0, static_gain=gain)
    return Loop(plant=plant, law=ONE)


@pytest.mark.parametrize(
    ("first", "second", "truth"),
    [
        (([1.0], [1.0, -1e-3]), ([1.0], [1.0, 1e-3]), 2e-3 / (1 + 1e-6)),
        (([1.0], [1e4, 0.0]), ([1.0], [1e8, 0.0, 0.0]), 1 / np.sqrt(2)),
        (([1.0], [1.0, 0.0]), ([1.0], [1.0, 0.0, 0.0]), 1 / np.sqrt(2)),
        (([1.0], [1e8, 0.0, 0.0]), ([1.0], [1e4, 0.0]), 1 / np.sqrt(2)),
        (([5.0], [1.0, 0.0]), ([5.0], [1.0, 1e-5]), 1e-5 / np.hypot(5.0, 1e-5)),
        (([0.5], [1.0, -1.0]), ([0.5], [1.0, 1.0]), 1.0),
    ],
)
def test_the_nu_gap_of_plants_whose_gap_is_known(first, second, truth):
    """Of a/(s - e) and a/(s + e) it is 2 a e/(a^2 + e^2) if a > e (Vinnicombe, 2001, 1.3); the others by hand."""
    assert nu_gap(rational(*first), rational(*second))[0] == pytest.approx(truth, rel=2e-3)


def test_a_delay_in_the_plant_is_pythons_exact_one(stand, thor):
    """A fraction of a sample: simulate the continuous plant at 100 times the rate with the late command."""
    from seaopt.control import command_of, sample
    from seaopt.control.loops.sampled_plant import conditions

    delay = conditions((stand,))["delay_s"]
    late = sample(
        stand, thor.with_parameters(type(delay)(name="delay_s", value=1.37e-3, unit="s")), "F1",
        command_of(stand, thor, "F1").per_effort, 1e-3, 0,
    )  # fmt: skip
    fine = sample(stand, thor, "F1", command_of(stand, thor, "F1").per_effort, 1e-5, 0)
    u = np.random.default_rng(0).normal(size=40)
    x, y = np.zeros(2), []
    for k in range(40 * 100):
        if k % 100 == 0:
            y.append(fine.c @ x)
        command = (k - 137) // 100
        x = fine.a @ x + fine.b * (u[command] if command >= 0 else 0.0)
    z, found = np.zeros(late.b.size), []
    for value in u:
        found.append(late.c @ z + late.d * value)
        z = late.a @ z + late.b * value
    np.testing.assert_allclose(found, y, rtol=1e-8, atol=1e-10)


def test_an_angle_is_linearised_where_the_plant_rests(swing, thor):
    """At phi = 0.4 the motor holds the pendulum: python's own equilibrium, Jacobian by differences of the equations."""
    import casadi as ca
    from scipy.optimize import fsolve

    from seaopt.control.loops.sampled_plant import conditions, linearise
    from seaopt.parameters import Parameter

    f = ca.Function("f", [swing.x, swing.u, swing.p], [swing.dynamics])
    h = ca.Function("h", [swing.x, swing.u, swing.p], [swing.output])
    p = swing.complete(thor).vector
    names = list(swing.states)
    k = names.index("phi")
    params = thor.with_parameters(Parameter(name="phi", value=0.4, unit="rad"))
    assert "phi" in conditions((swing,))
    force = -4 * 9.81 * 0.3 * np.tan(0.4) / 0.0725  # F L_a cos(phi) = -m g L sin(phi)
    q = force / 655e3 - 0.0725 * np.sin(0.4)
    x0 = np.zeros(len(names))
    x0[k], x0[names.index("q")] = 0.4, q
    current = float(fsolve(lambda i: float(np.array(f(x0, i, p)).ravel()[names.index("qd")]), 0.0)[0])
    assert np.abs(np.array(f(x0, current, p))).max() < 1e-6
    a, _, c, _ = linearise(swing, np.array(p)[:, None], {"phi": np.array([0.4])}, "F1", 1.0)
    for i in range(len(names)):
        step = np.zeros(len(names))
        step[i] = 1e-6
        ends = [np.array(f(x0 + s * step, current, p)).ravel() for s in (1, -1)]
        np.testing.assert_allclose(
            a[0][:, i], (ends[0] - ends[1]) / 2e-6, rtol=1e-4, atol=1e-3 * np.abs(a).max() * 1e-3
        )
        ends = [np.array(h(x0 + s * step, current, p)).ravel()[0] for s in (1, -1)]
        assert c[0][0][i] == pytest.approx((ends[0] - ends[1]) / 2e-6, rel=1e-4, abs=1e-2)
    assert params["phi"].value == 0.4


def velocity(hz, zeta, gain, ts=1e-3, delay=1):
    """A light mode under feedback of its own speed that undoes a share `gain` of its damping."""
    w = 2 * np.pi * hz
    a, b, c = np.array([[0, w], [-w, -2 * zeta * w]]), np.array([[0.0], [w]]), np.array([[0.0, 1.0]])
    a, b, c, _, _ = cont2discrete((a, b, c, np.zeros((1, 1))), ts)
    plant = DigitalPlant(a=a, b=b[:, 0], c=c, d=np.zeros(1), sample_time_s=ts, delay_samples=delay, static_gain=0.0)
    law = gained(-gain * 2 * zeta)
    return Loop(plant=plant, law=law)


@pytest.mark.parametrize("zeta", [1e-2, 1e-3, 1e-5])
@pytest.mark.parametrize(("hz", "gain"), [(0.1, 0.3), (1.0, 0.3), (1.0, 0.8), (30.0, 0.3), (400.0, 0.8)])
def test_a_crossing_next_to_a_light_mode_is_one(hz, zeta, gain):
    """The factor that takes the damping away, by bisection on NumPy's eigenvalues; the pole is 6e-9 to 0.03 away."""
    loop = velocity(hz, zeta, gain, delay=int(hz < 100))
    low, high = 1.0, 100.0
    assert np.max(np.abs(poles_of(loop, high))) > 1.0 > np.max(np.abs(poles_of(loop)))
    for _ in range(40):
        middle = np.sqrt(low * high)
        low, high = (middle, high) if np.max(np.abs(poles_of(loop, middle))) < 1.0 else (low, middle)
    found = margins(loop)
    assert 10 ** (found.gain_up_db / 20) == pytest.approx(low, rel=1e-5)
    assert found.gain_up_db == pytest.approx(loop.figures().gain_margin_db, rel=1e-12)
    assert any(abs(f - hz) < 0.2 * hz for f, _ in found.gain_crossings)


@pytest.mark.parametrize("hz", [0.1, 1.0, 30.0, 400.0])
def test_an_undamped_mode_is_no_crossing(hz):
    """On the circle to rounding: 1 + L has no zero there for any factor but none at all."""
    loop = velocity(hz, 0.0, 0.0, delay=int(hz < 100))
    law = gained(1e-3)
    loop = Loop(plant=loop.plant, law=law)
    found = margins(loop)
    up, down = (1e9 if x is None else 10 ** (x / 20) for x in (found.gain_up_db, found.gain_down_db))
    assert found.disks
    assert down == 1e9
    for factor in np.geomspace(1e-3, 0.999 * min(up, 1e6), 50):
        assert np.max(np.abs(poles_of(loop, factor))) < 1.0
    assert up == 1e9 or np.max(np.abs(poles_of(loop, 1.001 * up))) > 1.0


@pytest.mark.parametrize(
    ("hz", "zeta", "shift"), [(77.123, 1e-3, 1.0), (77.123, 1e-4, 1.0003), (3.21, 1e-5, 1.00001), (431.7, 1e-3, 1.002)]
)
def test_the_nu_gap_of_two_light_modes_is_that_of_a_grid_laid_about_them(hz, zeta, shift):
    a, b = (
        modal([(20.0, 0.7, 0.3), mode], delay=1, law=gained(0.2))
        for mode in ((hz, zeta, 3 * zeta), (hz * shift, 1.5 * zeta, 3 * zeta))
    )
    f = np.concatenate([np.geomspace(0.01, 499.9, 20_000), hz * (1 + 60 * zeta * np.linspace(-1, 1, 100_001))])
    l1, l2 = independent(a, f), independent(b, f)
    chord = np.abs(l1 - l2) / np.sqrt((1 + np.abs(l1) ** 2) * (1 + np.abs(l2) ** 2))
    gap, at = nu_gap(a, b)
    assert gap == pytest.approx(chord.max(), rel=1e-6)
    assert gap >= chord.max() * (1 - 1e-9)
    assert at == pytest.approx(f[chord.argmax()], rel=0.01 * zeta + 1e-7)


def test_peaks_that_are_not_proved_are_not_stated(monkeypatch):
    """With no round allowed, nothing is proved."""
    monkeypatch.setattr(peaks, "MAX_PROOF_ROUNDS", 0)
    with pytest.raises(ControlError, match="cannot be stated"):
        modal([(20.0, 0.7, 1.0)]).figures()
