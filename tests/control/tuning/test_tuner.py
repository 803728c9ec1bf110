"""The tuner's claims, recomputed; what it cannot do, said."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

import seaopt as so
from seaopt.control import Controller, Notch, Prefilter
from seaopt.control.tuning.convex_concave import solve_qp
from seaopt.control.tuning.law_numbers import T_F
from seaopt.control.tuning.starts import make_rest_start
from seaopt.control.tuning.tuner import make_task
from seaopt.errors import ControlError, FileError
from seaopt.plants.friction import take_sliding
from tests.control.loops.test_loop import independent
from tests.words import flatten

LIMITS = {"max_sensitivity": 1.6, "max_complementary": 1.3, "max_reference_peak": 1.3, "max_noise_gain": 60}


def tuned(stand, swing, thor, **spec):
    return so.tune(stand, thor, so.ControllerSpec(**{**LIMITS, **spec}), robust_to={"swing": swing})


@pytest.fixture(scope="module")
def controller(stand, thor):
    """Return a controller of 30 Hz, its limits those that nobody asked for."""
    return so.tune(stand, thor, so.ControllerSpec(bandwidth_hz=30))


@pytest.mark.parametrize("structure", [pytest.param("pd", marks=pytest.mark.slow), "pid"])
@pytest.mark.parametrize("bandwidth", [15, 30, 45, 60])
def test_thor_from_15_to_60_hz(stand, swing, thor, structure, bandwidth):
    """Every limit, recomputed in NumPy alone on both plants, at Ms 1.6 with the swing plant in robust_to."""
    controller = tuned(stand, swing, thor, structure=structure, bandwidth_hz=bandwidth)
    assert controller.feasible
    f = np.unique(np.r_[np.geomspace(1e-3, 499.9, 20_000), np.linspace(5, 90, 20_000), bandwidth])
    loops = {name: controller.close(plant, thor) for name, plant in (("stand", stand), ("swing", swing))}
    for loop in loops.values():
        open_loop, _, _ = independent(loop, f)
        s = 1 / (1 + open_loop)
        assert np.abs(s).max() <= 1.6
        assert np.abs(open_loop * s).max() <= 1.3
        assert np.abs(loop.eigenvalues()).max() < 1
    open_loop, tracking, noise = independent(loops["stand"], f)
    assert np.abs(tracking).max() / abs(tracking[0]) <= 1.3
    assert np.abs(noise).max() <= 60
    below = f[np.flatnonzero(np.abs(tracking) < abs(tracking[0]) / np.sqrt(2))[0]]
    assert below == pytest.approx(bandwidth, rel=0.005)
    slow = np.abs(1 / (1 + open_loop))[f <= bandwidth / 5]
    assert slow.max() <= np.sqrt(0.5) * 1.001
    gains = controller.gains
    if structure == "pid":
        assert gains["k_i"] / (1 + gains["k_p"]) >= 2 * np.pi * 0.05 * 0.999
    else:
        assert gains["k_i"] == 0.0


@pytest.mark.slow
def test_it_is_as_good_as_a_long_global_search(stand, thor):
    """scipy's differential evolution over the same four numbers, penalised, a hundred times the time."""
    from scipy.optimize import differential_evolution

    from seaopt.control.tuning.tuner import disturbance

    spec = so.ControllerSpec(
        structure="pd", reference_weights="error", bandwidth_hz=30, **{**LIMITS, "max_noise_gain": 25}
    )
    task = make_task(stand, thor, spec, {})

    def cost(v):
        x = np.array([np.exp(v[0]), 0.0, np.exp(v[1]), 0.0, 0.0, 0.0, np.exp(v[2]), 1, 0, 1, 1, 1, 1, 1])
        loop = task.loop(x)
        f = np.geomspace(0.1, 499, 200)
        open_loop, tracking, noise = independent(loop, np.r_[f, 30.0])
        s = 1 / np.abs(1 + open_loop)
        miss = max(
            s.max() / 1.6,
            (np.abs(open_loop) * s).max() / 1.3,
            np.abs(tracking).max() / 1.3,
            np.abs(noise).max() / 25,
            1,
        )
        miss += 20 * abs(abs(tracking[-1]) * np.sqrt(2) - 1)
        if np.abs(loop.eigenvalues()).max() >= 1:
            return 1e3
        return disturbance(loop, 30.0) * (1 + 10 * (miss - 1))

    best = differential_evolution(
        cost, [(-2, 4), (-8, 0), (-9, -4)], seed=1, maxiter=40, popsize=10, polish=False, tol=1e-8
    )
    controller = so.tune(stand, thor, spec)
    assert controller.feasible
    assert disturbance(controller.close(stand, thor), 30.0) <= 1.03 * best.fun


def test_beside_a_limit_that_nothing_keeps_the_others_are_kept():
    """An ankle whose bristles hold the motor when it sticks: any integral makes 1/P(0) = 1 + N^2 sigma_0/k_s there."""
    plant = so.plants.rotary(link="locked", parts=["lugre", "stribeck"])
    values = plant.defaults.update(
        J_m=6.78e-5, b_r=3.48e-5, K_tau=0.0932, N=80.0, k_s=588.0, f_c=0.0287, v_s=1.94, sigma_0=141.0, sigma_1=0.0086
    )
    spec = so.ControllerSpec(measured="tau_s", compute_delay_samples=4, **{**LIMITS, "max_noise_gain": 25.0})
    controller = so.tune(plant, values, spec)
    assert not controller.feasible
    at_rest = 1.0 + 80.0**2 * 141.0 / 588.0
    (blocked,) = controller.blocked_by
    assert blocked.startswith(f"max_noise_gain {at_rest:.4g} of 25 (design plant stuck), where any integral makes")
    assert f"give max_noise_gain = {np.ceil(1.01 * at_rest):.0f}" in blocked
    assert controller.possible is None  # at no bandwidth would it be kept
    eased = so.tune(plant, values, replace(spec, max_noise_gain=np.ceil(1.01 * at_rest)))
    assert eased.feasible
    for one in (controller, eased):
        f = np.unique(np.r_[np.geomspace(1e-3, 499.9, 20_000), np.linspace(20, 40, 20_000)])
        open_loop, tracking, _ = independent(one.close(take_sliding(plant, values), values), f)
        below = f[np.flatnonzero(np.abs(tracking) < abs(tracking[0]) / np.sqrt(2))[0]]
        assert below == pytest.approx(30.0, rel=0.005)
        assert np.abs(1 / (1 + open_loop)).max() <= 1.6


@pytest.mark.parametrize("samples", [3.0, 30.0, 1e9])
def test_a_filter_may_be_asked_to_be_slower_than_the_bandwidth(samples, stand, thor):
    """Then there is one filter to choose; the ends of its range had crossed."""
    task = make_task(stand, thor, so.ControllerSpec(bandwidth_hz=60, min_filter_samples=samples), {})
    low, high = task.bounds(make_rest_start(task))
    assert np.all(low <= high) and low[T_F] == pytest.approx(samples * 1e-3)


def test_noise_objective_is_quieter(stand, swing, thor):
    loud, quiet = (tuned(stand, swing, thor, bandwidth_hz=30, objective=o) for o in ("disturbance", "noise"))
    assert quiet.feasible
    assert quiet.achieved.noise_gain < loud.achieved.noise_gain


def test_derivative_on_the_measurement(stand, swing, thor):
    controller = tuned(
        stand, swing, thor, bandwidth_hz=30, reference_weights="measurement", max_noise_gain=200,
        max_complementary=False, max_droop_db=False, min_filter_samples=False,
    )  # fmt: skip
    assert controller.feasible
    assert controller.gains["c"] == 0.0
    assert controller.achieved.bandwidth_hz == pytest.approx(30, rel=0.005)


def test_efficiency_changes_the_loop_gain(controller, stand, thor):
    """The controller commands current: a plant with 20 % less efficiency has 20 % less loop gain."""
    f = np.array([1.0, 10.0, 100.0])
    strong, weak = (controller.close(stand, thor.update(eta=eta)).open_loop(f) for eta in (1.0, 0.8))
    np.testing.assert_allclose(weak, 0.8 * strong)


def test_a_sensitivity_over_its_limit_is_stated_by_how_much(stand, thor):
    """abs(S) may lie along -3 dB: where it first exceeds it says nothing of how nearly it is kept."""
    spec = so.ControllerSpec(
        bandwidth_hz=30, max_sensitivity=1.2, min_sensitivity_bandwidth_hz=20, bandwidth_range_hz=(29, 31)
    )
    controller = so.tune(stand, thor, spec)
    assert not controller.feasible and controller.active_constraints and repr(controller).startswith("not met")
    loop = controller.close(stand, thor)
    reached = np.max(np.abs(loop.sensitivity(np.linspace(0.01, 20.0, 20000))))
    blocked = next(text for text in controller.blocked_by if text.startswith("min_sensitivity_bandwidth_hz"))
    assert re.findall(r"\d+\.?\d*", blocked) == [f"{reached:.4f}", "20", "0.7071"]
    assert blocked in controller.explanation


@pytest.mark.parametrize(("depth", "noted"), [(0.4, False), (1.0, True)])
def test_a_notch_without_effect_is_noted(depth, noted, controller):
    gains = {**controller.gains, "notch_frequency_hz": 100.0, "notch_width": 0.2, "notch_depth": depth}
    assert ("tune without it" in flatten(repr(replace(controller, gains=gains)))) is noted


def test_the_summary_says_where_friction_has_the_bandwidth_placed(stand, thor):
    """Stuck, the plant has a damper of f_c/v_s besides: the same law, on the plant with that b_r, from scratch."""
    rubbing = thor.update(f_c=50.0, v_s=1e-3)
    controller = so.tune(stand, rubbing, so.ControllerSpec(bandwidth_hz=20, max_sensitivity=1.6, max_noise_gain=25))
    r = thor["l"].value / (2 * np.pi * thor["N_p"].value)
    stuck = controller.close(stand, thor.update(b_r=thor["b_r"].value + 50.0 / 1e-3 * r**2)).figures()
    assert f"stuck: bandwidth {stuck.bandwidth_hz:.4g} Hz, Ms {stuck.ms:.4g}" in flatten(repr(controller))
    assert "sliding" not in repr(so.tune(stand, thor, so.ControllerSpec(bandwidth_hz=20)))


def test_json_round_trip(stand, swing, thor, tmp_path):
    from seaopt.files import read_json, write_json

    controller = tuned(stand, swing, thor, bandwidth_hz=30)
    path = write_json(tmp_path / "controller.json", controller.to_dict())
    again = Controller.from_dict(read_json(path, "seaopt/controller/3"), stand, thor)
    assert repr(again) == repr(controller)
    broken = controller.to_dict()
    broken["measurement"] = {"num": [1.0], "den": [2.0]}
    with pytest.raises(FileError, match="den"):
        Controller.from_dict(broken, stand, thor)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"bandwidth_hz": 80}, "outside 15 to 60"),
        ({"bandwidth_hz": 14.9}, "outside 15 to 60"),
        ({"structure": "pdf"}, "structure"),
        ({"max_sensitivity": 0.9}, "max_sensitivity"),
        ({"sample_rate_hz": 100}, "sample_rate_hz"),
        ({"compute_delay_samples": -1}, "delay_samples"),
        ({"min_sensitivity_bandwidth_hz": 40}, "min_sensitivity_bandwidth_hz"),
        ({"current_limit_A": 0}, "current_limit_A"),
        ({"bandwidth_range_hz": (60, 15)}, "bandwidth_range_hz"),
        ({"objective": "speed"}, "objective"),
        ({"compute_delay_samples": 100_000}, "delay_samples"),
        ({"sample_rate_hz": float("inf")}, "sample_rate_hz"),
        ({"sample_rate_hz": 1e300}, "up to 1e\\+06"),
        ({"prefilter": Prefilter(corner_hz=1e-300)}, r"prefilter.corner_hz = 1e-300 is not 0.001 or more"),
        ({"notch": Notch(frequency_hz=1e-300)}, r"notch.frequency_hz = 1e-300 is not 0.001 or more"),
    ],
)
def test_bad_specifications(changes, words):
    with pytest.raises(ControlError, match=words):
        so.ControllerSpec(**{"bandwidth_hz": 30, **changes})


def test_another_range_may_be_asked_for(stand, thor):
    controller = so.tune(stand, thor, so.ControllerSpec(bandwidth_hz=10, bandwidth_range_hz=(5, 15)))
    assert controller.achieved.bandwidth_hz == pytest.approx(10, rel=0.005)


def test_unknown_output_and_free_mass_are_refused(stand, thor):
    with pytest.raises(ControlError, match='"F3"'):
        so.tune(stand, thor, so.ControllerSpec(measured="F3"))
    free = so.plants.two_link(link2="mass")
    with pytest.raises(ControlError, match="static gain"):
        so.tune(free, so.plants.thor(), so.ControllerSpec())


def test_a_plant_named_design_does_not_replace_the_design_plant(stand, thor):
    controller = so.tune(stand, thor, so.ControllerSpec(bandwidth_hz=30), {"design": (stand, thor.update(J=1e-5))})
    assert controller.robust_to == ("design",)
    assert controller.close(stand, thor).figures().bandwidth_hz == pytest.approx(30, rel=0.005)


def test_the_force_limit_is_the_plants(stand, thor):
    """u/r = T/P whatever the controller: the current of a sine of that force, simulated, peaks at the limit."""
    controller = so.tune(stand, thor, so.ControllerSpec(bandwidth_hz=30, max_sensitivity=1.6, current_limit_A=9.0))
    loop = controller.close(stand, thor)
    p = loop.plant.response(np.array([30.0]))[0]
    t = loop.tracking(np.array([30.0]))[0]
    saturation = 9.0 / controller.command.per_effort
    assert controller.force_limit(30.0) == pytest.approx(saturation * abs(p) / abs(t), rel=1e-9)
    assert controller.force_limit(0.01) == pytest.approx(saturation, rel=1e-3)
    assert controller.force_limit(30) == controller.force_limit(30.0)


@pytest.mark.parametrize(
    "changes",
    [
        {"structure": 5},
        {"feasible": "false"},
        {"delay_samples": 1.7},
        {"sample_time_s": 0.5},
        {"gains": {"k_p": "<b>"}},
        {"gains": 5},
        {"measurement": {"num": [], "den": [1.0]}},
        {"measurement": {"num": [[1.0]], "den": [1.0]}},
    ],
)
def test_a_damaged_controller_json_is_refused(controller, stand, thor, changes):
    with pytest.raises(FileError, match=r"controller\.json"):
        Controller.from_dict({**controller.to_dict(), **changes}, stand, thor)


def test_a_derivative_that_nothing_filters_is_said(controller, stand, thor):
    """The figure is the peak of |C_y S| over frequency, recomputed; a limit, or an objective, takes the note away."""
    unfiltered = {"bandwidth_hz": 30, "min_filter_samples": False}
    free = so.tune(stand, thor, so.ControllerSpec(**unfiltered))
    lifted, note = free.notes
    assert lifted.startswith("min_filter_samples")
    assert "1 N of noise on F1 makes up to " in note and "give max_noise_gain" in note
    _, _, noise = independent(free.close(stand, thor), np.linspace(0.1, 499.9, 20_000))
    assert float(note.split("up to ")[1].split(" N")[0]) == pytest.approx(np.abs(noise).max(), rel=5e-3)
    assert note in flatten(repr(free))
    for spec in ({"max_noise_gain": 25}, {"objective": "noise"}):
        assert so.tune(stand, thor, so.ControllerSpec(**unfiltered, **spec)).notes == (lifted,)
    assert controller.notes == ()


def test_a_program_that_the_solver_refuses_has_no_answer():
    """Ends that have crossed, and what is not finite, are no step; they are not an exception of the solver's either."""
    one, free = np.eye(2), np.full(2, np.inf)
    assert solve_qp(one, np.zeros(2), one, np.full(2, 0.5), np.full(2, 0.4)) is None
    assert solve_qp(one * np.nan, np.zeros(2), one, -free, free) is None
    np.testing.assert_allclose(solve_qp(one, -np.ones(2), one, -free, free), 1.0, atol=1e-3)
