"""The reference's prefilter: its equations, the law behind it sample by sample, and what a tune wins with it."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import bilinear, cont2discrete, lfilter

import seaopt as so
from seaopt.control import Gains, Prefilter
from seaopt.control.tuning.tuner import disturbance
from seaopt.errors import ControlError, FileError
from seaopt.files import to_json
from seaopt.problem import read_problem
from seaopt.robustness.uncertainty.batch import batch_figures

TS = 1e-3
FIRST = Prefilter(corner_hz=35.0)
SECOND = Prefilter(order="second_order", corner_hz=35.0, damping=0.6)


def by_scipy(prefilter):
    """Return the prefilter's numerator and denominator in powers of 1/z, the rule prewarped at its corner."""
    w = 2 * np.pi * prefilter.corner_hz
    rate = w / np.tan(w * TS / 2) / 2
    if prefilter.damping is None:
        return bilinear([w], [1, w], rate)
    return bilinear([w**2], [1, 2 * prefilter.damping * w, w**2], rate)


@pytest.mark.parametrize("prefilter", [FIRST, SECOND], ids=["first", "second"])
def test_the_law_is_that_of_the_filtered_reference(prefilter):
    """Sample by sample by the law's written equation; the integral is of the error to the last bit."""
    numbers = {"k_p": 2.0, "k_i": 5.0, "k_d": 0.03, "T_f": 2e-3, "k_r": 2.6, "c": 0.4}
    ref, meas = np.random.default_rng(1).normal(size=(2, 400))
    seen = lfilter(*by_scipy(prefilter), ref)
    e, weighted = seen - meas, 0.4 * seen - meas
    integral = np.cumsum(5.0 * TS / 2 * (e + np.r_[0.0, e[:-1]]))
    expected = 2.6 * seen - 2.0 * meas + integral + 0.03 * lfilter([1, -1], [2e-3 + TS, -2e-3], weighted)
    law = Gains(**numbers, prefilter=prefilter).law("pid", TS).balanced()
    x, out = np.zeros(law.c.size), np.zeros(400)
    for k, inputs in enumerate(np.column_stack([ref, meas])):
        out[k] = law.c @ x + law.d @ inputs
        x = law.a @ x + law.b @ inputs
    np.testing.assert_allclose(out, expected, atol=1e-11 * np.max(np.abs(expected)))
    assert law.integrators == 1 and law.b[0, 0] == -law.b[0, 1]


SLOW = [Prefilter(corner_hz=2.0), Prefilter(order="second_order", corner_hz=3.0, damping=0.5)]


@pytest.mark.parametrize("prefilter", SLOW, ids=["first", "second"])
def test_its_poles_are_among_those_of_every_stated_radius(stand, thor, prefilter):
    """Of the whole loop, filter, pid, delay and plant by hand, stepped from each state alone."""
    g = {"k_p": 2.0, "k_i": 60.0, "k_d": 0.03, "T_f": 2e-3, "k_r": 2.6, "c": 0.4}
    num, den = by_scipy(prefilter)
    model = stand.linearize(thor)
    row = list(stand.outputs).index("F1")
    a, b, c, *_ = cont2discrete((model.A, model.B[:, :1], model.C[[row]], model.D[[row], :1]), TS, "zoh")
    n, per_effort, share = len(a), so.control.command_of(stand, thor, "F1").per_effort, TS / (g["T_f"] + TS)
    order = len(den) - 1

    def step(x):
        """Return the next state, of plant, waiting command, sum, two filters of the difference and prefilter."""
        plant, waiting, total, slow_r, slow_y, low_pass = (*np.split(x, [n, n + 1, n + 2, n + 3, n + 4]),)
        force, seen = (c @ plant)[0], low_pass[0]  # transposed direct form, the reference zero
        rate = (g["c"] * (seen - slow_r[0]) - (force - slow_y[0])) * share / TS
        half = g["k_i"] * TS / 2 * (seen - force)
        effort = g["k_r"] * seen - g["k_p"] * force + total[0] + half + g["k_d"] * rate
        return np.concatenate([
            a @ plant + b[:, 0] * waiting, [effort * per_effort, total[0] + 2 * half],
            slow_r + share * (seen - slow_r), slow_y + share * (force - slow_y),
            np.append(low_pass[1:], 0.0) - den[1:] * seen,
        ])  # fmt: skip

    radius = np.max(np.abs(np.linalg.eigvals(np.column_stack([step(x) for x in np.eye(n + 4 + order)]))))
    assert radius == pytest.approx(np.max(np.abs(np.roots(den))), rel=1e-9) and num.size  # it is the slowest of all
    spec = so.ControllerSpec(bandwidth_hz=5, bandwidth_range_hz=(0.5, 60), compute_delay_samples=1)
    law = Gains(**g, prefilter=prefilter).law("pid", TS).balanced()
    controller = so.assess(law, stand, thor, spec)
    certificate = so.certify(
        controller, {"stand": stand}, thor, ranges={"k": (6.4e5, 6.6e5)}, samples=10, simulations=False
    )
    stored = so.Controller.from_dict(json.loads(to_json(controller.to_dict())), stand, thor)
    stated = (
        controller.achieved, stored.close(stand, thor).figures(), certificate.plants["stand"],
        certificate.worst["stand"].witness, batch_figures(controller, stand, thor, {}),
    )  # fmt: skip
    assert [float(np.max(one.spectral_radius)) for one in stated] == pytest.approx([radius] * 5, rel=1e-8)


def evaluate(controller, plant, params, f):
    """Return F/F_ref and S from the gains alone, on the plant by scipy's hold, one sample late."""
    gains, q = controller.gains, np.exp(-2j * np.pi * f * TS)
    model = plant.linearize(params)
    row = list(plant.outputs).index("F1")
    a, b, c, d, _ = cont2discrete((model.A, model.B[:, :1], model.C[[row]], model.D[[row], :1]), TS, "zoh")
    p = np.array([(c @ np.linalg.solve(z * np.eye(len(a)) - a, b) + d)[0, 0] for z in 1 / q])
    p = p * q * controller.command.per_effort
    rate = (1 - q) / (gains["T_f"] + TS - q * gains["T_f"])
    integral = gains["k_i"] * TS / 2 * (1 + q) / (1 - q)
    w, s = np.tan(np.pi * gains["prefilter_corner_hz"] * TS), (1 - q) / (1 + q)
    zeta = gains.get("prefilter_damping")
    low_pass = w / (s + w) if zeta is None else w**2 / (s**2 + 2 * zeta * w * s + w**2)
    c_r = low_pass * (gains["k_r"] + integral + gains["k_d"] * gains["c"] * rate)
    c_y = gains["k_p"] + integral + gains["k_d"] * rate
    return p * c_r / (1 + p * c_y), 1 / (1 + p * c_y), c_y, low_pass


@pytest.mark.slow
@pytest.mark.parametrize(
    ("order", "bandwidth_hz", "weights"), [("first_order", 20.0, "error"), ("second_order", 45.0, "tuned")]
)
def test_it_places_a_bandwidth_that_the_feedback_does_not_have(stand, swing, thor, order, bandwidth_hz, weights):
    """Every limit of the design plant again in NumPy; without it the objective is larger, or there is no law at all."""
    spec = so.ControllerSpec(
        bandwidth_hz=bandwidth_hz, max_sensitivity=1.6, max_noise_gain=25, reference_weights=weights
    )  # fmt: skip
    bare = so.tune(stand, thor, spec, {"swing": swing})
    controller = so.tune(stand, thor, replace(spec, prefilter=order), {"swing": swing})
    assert controller.feasible
    loop = controller.close(stand, thor)
    gained = disturbance(bare.close(stand, thor), bandwidth_hz) / disturbance(loop, bandwidth_hz)
    assert bare.feasible == (bandwidth_hz == 20.0)
    assert gained > 1.4 or not bare.feasible

    f = np.unique(np.r_[np.geomspace(1e-3, 499.0, 8000), np.linspace(5.0, 150.0, 8000)])
    tracking, s, c_y, low_pass = evaluate(controller, stand, thor, f)

    def crossing(size):
        return f[np.flatnonzero(size < size[0] / np.sqrt(2))[0]]

    assert crossing(np.abs(tracking)) == pytest.approx(bandwidth_hz, rel=0.005)
    assert crossing(np.abs(tracking / low_pass)) == pytest.approx(controller.bandwidth_without_prefilter_hz, rel=2e-3)
    assert np.max(np.abs(tracking)) <= 1.3 and np.max(np.abs(s)) <= 1.6 and np.max(np.abs(1 - s)) <= 1.3
    assert np.max(np.abs(c_y * s)) <= 25.0
    assert np.min(np.abs(tracking)[f < bandwidth_hz / 3]) >= 10 ** (-1 / 20)
    _, swinging, _, _ = evaluate(controller, swing, thor, f)
    assert np.max(np.abs(swinging)) <= 1.6 and np.max(np.abs(1 - swinging)) <= 1.3


@pytest.fixture(scope="module")
def filtered():
    """Return a controller with a prefilter of given numbers."""
    spec = so.ControllerSpec(bandwidth_hz=30, max_sensitivity=1.6, prefilter=replace(SECOND, corner_hz=40.0))
    return so.tune(so.plants.high_impedance(), so.plants.thor(), spec)


def test_given_numbers_are_kept_and_stored(filtered):
    assert filtered.feasible
    assert filtered.gains["prefilter_corner_hz"] == pytest.approx(40.0)
    assert filtered.gains["prefilter_damping"] == 0.6
    assert "without it the bandwidth is" in repr(filtered)
    content = json.loads(to_json(filtered.to_dict()))
    assert content["achieved"]["bandwidth_without_prefilter_hz"] == filtered.bandwidth_without_prefilter_hz
    again = so.Controller.from_dict(content, *filtered.design)
    assert again.prefilter == filtered.prefilter
    content["achieved"]["bandwidth_without_prefilter_hz"] *= 1.01
    with pytest.raises(FileError, match="bandwidth_without_prefilter_hz"):
        so.Controller.from_dict(content, *filtered.design)


@pytest.mark.parametrize(("name", "value"), [("corner_hz", 50.0), ("damping", 0.9)])
def test_a_specification_that_gives_other_numbers_is_refused(filtered, name, value):
    content = json.loads(to_json(filtered.to_dict()))
    content["spec"]["prefilter"][name] = value
    with pytest.raises(FileError, match=rf"spec\.prefilter\.{name}"):
        so.Controller.from_dict(content, *filtered.design)


@pytest.mark.parametrize(
    ("prefilter", "words"),
    [
        (Prefilter(order="first_order", damping=0.7), r'order = "second_order"'),
        (Prefilter(corner_hz=600.0), r"prefilter\.corner_hz"),
        (Prefilter(order="second_order", damping=0.0), r"prefilter\.damping"),
    ],
)
def test_what_is_no_prefilter_is_refused(prefilter, words):
    with pytest.raises(ControlError, match=words):
        so.ControllerSpec(bandwidth_hz=30, prefilter=prefilter)


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ('prefilter = "first_order"', Prefilter()),
        ('prefilter = { order = "second_order", corner_hz = 40 }', Prefilter(order="second_order", corner_hz=40.0)),
    ],
)
def test_a_problem_file_asks_for_one(tmp_path, line, expected):
    controller = f'[controller]\nplant = "stand"\nbandwidth_hz = 30\n{line}\n'
    (tmp_path / "problem.toml").write_text(f'schema = 1\n[plant.stand]\nkind = "high_impedance"\n{controller}')
    assert read_problem(tmp_path / "problem.toml").spec.reference_filter == expected
