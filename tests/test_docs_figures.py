"""Figures in the documentation's text, computed again from the gains or the specification printed beside them."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm

import seaopt as so
from seaopt.control import Gains, close_loop, sample
from seaopt.control.laws.passivity import passivity
from seaopt.control.laws.realisation import realise, runnable
from seaopt.control.loops.loop import Loop
from seaopt.control.tuning.tuner import disturbance
from tests.pages import DOCS, read_page, unbroken

UNITS = {"s": 1.0, "ms": 1e-3}
PERIOD = 1e-3


def printed_gains(text):
    """Return the gains of a sentence: `k_p = 3.18, ..., T_f = 1 ms`."""
    (sentence,) = re.findall(r"k_p = [^\n]*", text)
    found = re.findall(r"(k_p|k_i|k_d|k_r|T_f) = ([\d.]+)(?: (ms|s)\b)?", sentence)
    return {name: float(value) * UNITS.get(unit, 1.0) for name, value, unit in found}


def cells(text, head):
    """Return the rows of the table whose head begins with a word."""
    lines = text.splitlines()
    start = next(i for i, line in enumerate(lines) if line.startswith(f"| {head}"))
    rows = []
    for line in lines[start + 2 :]:
        if not line.startswith("|"):
            break
        rows.append([cell.strip() for cell in line.strip("|").split("|")])
    return rows


def numbers(text):
    """Return the numbers of a cell; a name's own digits and a unit's are not among them."""
    found = re.findall(r"(?<![\w_])[−-]?\d+\.?\d*(?:e-\d+)?", text)
    return [float(value.replace("−", "-")) for value in found]


@pytest.fixture(scope="module")
def stand_matrices(thor):
    """The paper's unlumped actuator with both links held, from motor force; and its port, from its equations."""
    value = {name: thor[name].value for name in ("m_l", "k", "J", "l", "N_p", "b_r")}
    r = value["l"] / (2 * np.pi * value["N_p"])
    return value["k"], value["J"] / r**2, value["b_r"] / r**2, value["m_l"]


def law_response(gains, f):
    """C_y of a pid by its definition in the design: k_p + k_i Tustin + k_d filtered difference."""
    q = np.exp(-2j * np.pi * f * PERIOD)
    lag = gains["T_f"] / (gains["T_f"] + PERIOD)
    difference = (1 - q) / (gains["T_f"] + PERIOD) / (1 - lag * q)
    return gains["k_p"] + gains["k_i"] * PERIOD / 2 * (1 + q) / (1 - q) + gains["k_d"] * difference


def impedance(matrices, gains, delay, f):
    """Z = F2/v at link 2 with link 1 held, the law taken as linear with its hold and delay.

    F1 = k x_l, m_l xdd_l = F2 - F1, M (xdd_l - xdd_2) = F_m - b (xd_l - xd_2) - F2 and F_m = -C F1.
    """
    k, mass, damping, sprung = matrices
    s = 2j * np.pi * f
    hold = -np.expm1(-s * PERIOD) / (s * PERIOD)
    feedback = k * law_response(gains, f) * hold * np.exp(-s * delay * PERIOD)
    motor = mass * s**2 + damping * s
    # x_l over x_2, then F2 = (m_l s^2 + k) x_l; positive against the motion that causes it.
    ratio = motor / (motor + feedback + sprung * s**2 + k)
    return (sprung * s**2 + k) * ratio / s


PASSIVE_EDGES = ([160.26, 160.33], [85.2, 160, 351], [60.0, 160, 223, 406], [29.2, 160, 338])


def test_the_table_of_passive_bands_follows_from_the_gains(stand_matrices):
    text = read_page("theory/passivity.md")
    gains = printed_gains(text)
    f = np.unique(np.concatenate([np.geomspace(0.05, 499.9, 200_000), np.linspace(160.0, 160.6, 20_001)]))
    rows = cells(text, "delay")
    assert [numbers(row[1]) for row in rows] == list(PASSIVE_EDGES)  # the table's sentences, as numbers
    for row, edges in zip(rows, PASSIVE_EDGES, strict=True):
        used = gains | ({"k_d": 0.0} if "k_d = 0" in row[0] else {})
        z = impedance(stand_matrices, used, numbers(row[0])[0], f)
        np.testing.assert_allclose(f[1:][np.diff(np.sign(z.real)) != 0], edges, rtol=2e-3)
        if row[2]:
            least, *place = numbers(row[2])
            assert z.real.min() == pytest.approx(least, rel=0.1)
            assert not place or f[np.argmin(z.real)] == pytest.approx(place[0], abs=0.5)


def simulate(matrices, gains, per_effort, tracking):
    """Return force over what 9 A hold: half again as much is asked for, and from 1.5 s half of it."""
    k, mass, damping, _ = matrices
    block = np.array([[0, 1, 0], [-k / mass, -damping / mass, 1 / mass], [0, 0, 0]])
    step = expm(block * PERIOD)
    law = realise(Gains(**gains).law("pid", PERIOD), per_effort=per_effort, command_limit=9.0, tracking_time_s=tracking)
    limit = 9.0 / per_effort
    x, late, state, forces = np.zeros(2), 0.0, law.reset(), []
    for i in range(6000):
        force = k * x[0]
        current, state = law.step(state, (1.5 if i < 1500 else 0.5) * limit, force)
        x = step[:2, :2] @ x + step[:2, 2] * late
        late = current / per_effort
        forces.append(force / limit)
    return law.tracking_time_s, np.array(forces)


def test_the_table_of_tracking_times_follows_from_the_gains(stand_matrices, thor):
    text = read_page("howto/on_the_target.md")
    gains = printed_gains(text)
    per_effort = thor["l"].value / (2 * np.pi * thor["N_p"].value * thor["K_tau"].value)
    integral, derivative = gains["k_p"] / gains["k_i"], gains["k_d"] / gains["k_p"]
    rules = (None, integral, np.sqrt(integral * derivative), 1e9)
    for row, rule in zip(cells(text, "tracking time"), rules, strict=True):
        tracking, force = simulate(stand_matrices, gains, per_effort, rule)
        after = force[1500:]
        settled = np.flatnonzero(np.abs(after - 0.5) > 0.01)[-1] + 1  # ms
        if row[0] != "none":
            assert tracking == pytest.approx(numbers(row[0])[0], abs=6e-3)
        assert after.min() == pytest.approx(numbers(row[1])[0], abs=6e-3)
        assert settled == numbers(row[2])[0] if row[2].endswith("ms") else settled >= 4500
        assert force.max() == pytest.approx(float(re.findall(r"first swing to ([\d.]+)", text)[0]), abs=6e-3)


def test_what_a_passive_band_costs_the_quiet_law(stand, thor):
    text = unbroken("theory/passivity.md")
    quiet = so.ControllerSpec(bandwidth_hz=30, max_sensitivity=1.6, objective="noise")
    ends, noise = [], []
    for band in (None, (1.0, 60.0)):
        law = so.tune(stand, thor, replace(quiet, passive_band_hz=band))
        ends.append(passivity(law, stand, thor).violated_hz)
        noise.append(law.achieved.noise_gain)
        assert f"{law.gains['k_i'] / (1 + law.gains['k_p']):.2f} (1 + k_p) per second" in text
    assert f"{noise[0]:.1f} N/N, is passive up to {ends[0]:.1f} Hz only" in text
    assert f"up to {ends[1]:.1f} Hz, for a noise gain of {noise[1]:.1f} N/N" in text


def test_what_late_samples_cost(stand, thor):
    spec = so.ControllerSpec(bandwidth_hz=50, max_sensitivity=1.6, max_noise_gain=60, compute_delay_samples=1)
    law = so.tune(stand, thor, spec)
    ms = [
        Loop(plant=sample(stand, thor, "F1", law.command.per_effort, 1e-3, late), law=law.law).figures().ms
        for late in (1, 2, 3)
    ]
    text = "has Ms {:.2f} as stated, {:.2f} with 2 samples and {:.2f} with 3.".format(*ms)
    assert text in unbroken("theory/tuning.md")


def test_the_pid_beside_mixed_sensitivity_synthesis(stand, thor):
    text = unbroken("theory/tuning.md")
    spec = so.ControllerSpec(bandwidth_hz=30, max_sensitivity=1.6, max_noise_gain=60)
    for name, weights in (("pid", "tuned"), ('pid, `"error"`', "error")):
        law = so.tune(stand, thor, replace(spec, reference_weights=weights))
        a, integral = law.achieved, disturbance(law.close(stand, thor), 30.0)
        figures = f"{a.ms:.2f} | {a.noise_gain:.1f} | {a.sensitivity_bandwidth_hz:.1f} Hz | {integral:.2f}"
        assert f"| {name} | {a.bandwidth_hz:.1f} Hz | {figures} |" in text
    law = so.tune(stand, thor, replace(spec, bandwidth_hz=27.2, max_noise_gain=44.5))
    assert f"the pid has an integral of {disturbance(law.close(stand, thor), 27.2):.2f};" in text


@pytest.mark.slow
@pytest.mark.parametrize("bandwidth_hz", [20.0, 30.0])
def test_feedback_of_the_error_cannot_have_what_the_page_says(bandwidth_hz, monkeypatch):
    """One more than tests/control/tuning/test_reference_weights.py, which has what the tuned weights can."""
    monkeypatch.syspath_prepend(str(DOCS.parent / "benchmarks"))
    from bench_tune_friction import ISSUE, Case

    case = Case(ISSUE, bandwidth_hz)
    spec = replace(case.spec, reference_weights="error", bandwidth_range_hz=(bandwidth_hz, 1.01 * bandwidth_hz))
    assert not so.tune(so.plants.high_impedance(), so.plants.thor().update(**ISSUE), spec).feasible


def test_the_steps_of_the_pid_beside_predictive_control(stand, swing, thor):
    spec = so.ControllerSpec(bandwidth_hz=30, max_sensitivity=1.6, current_limit_A=9.0)
    law = runnable(so.tune(stand, thor, spec, robust_to={"swing": swing}))
    for force in (500.0, 1000.0, 2000.0):
        run = close_loop(law.step, law.reset(), stand, thor, np.where(np.arange(500) < 10, 0.0, force))
        times = " | ".join(f"{1e3 * run.settling_time_s(band):.0f} ms" for band in (0.05, 0.02))
        assert f"| {force:g} N | pid | {100 * run.overshoot:.1f} % | {times} |" in unbroken("theory/mpc.md")


@pytest.mark.slow
def test_the_table_of_the_paper_is_what_its_script_computes(monkeypatch):
    monkeypatch.syspath_prepend(str(DOCS.parent / "problems"))
    import orekhov2015

    printed = cells(read_page("evidence/orekhov2015.md"), "what")
    computed = orekhov2015.rows()
    assert [row[0] for row in printed] == [row.what for row in computed]
    for cell, row in zip(printed, computed, strict=True):
        assert [float(cell[1]), float(cell[2])] == [row.printed, pytest.approx(row.computed, rel=1e-4)]
