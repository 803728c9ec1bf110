"""Margins of predictive control while no limit is active: against loops of scipy and python-control written here."""

from __future__ import annotations

from dataclasses import replace

import control
import numpy as np
import pytest
from scipy.signal import cont2discrete

import seaopt as so
from seaopt.control import MPCSpec, close_loop, force_mpc
from seaopt.control.loops.loop import Loop
from seaopt.errors import ControlError
from tests.words import flatten

TS, F_C, V_S = 1e-3, 50.0, 1e-3
F = np.geomspace(0.01, 499.0, 4000)
Z = np.exp(2j * np.pi * F * TS)


@pytest.fixture(scope="module")
def rubbing(thor):
    return thor.update(f_c=F_C, v_s=V_S)


def made(plant, params, **options):
    return force_mpc(plant, params, MPCSpec(**{"current_limit_A": 9.0, "bandwidth_hz": 15.0, **options}))


@pytest.fixture(scope="module")
def mpc(stand, rubbing):
    return made(stand, rubbing)


def stand_with(params, damping):
    """Return a, b, c of F1/F_m = k/(M s^2 + b s + k), the screw's own damping and more, held over a sample."""
    v = {name: params[name].value for name in params}
    r = v["l"] / (2 * np.pi * v["N_p"])
    mass, b = v["J"] / r**2, v["b_r"] / r**2 + damping
    a = np.array([[0.0, 1.0], [-v["k"] / mass, -b / mass]])
    return cont2discrete((a, np.array([[0.0], [1.0 / mass]]), np.array([[v["k"], 0.0]]), np.zeros((1, 1))), TS)[:3]


def state_spaces(mpc, params, damping):
    """Return plant with its delay, C_y and C_r as python-control's state spaces."""
    a, b, c = stand_with(params, damping)
    law = mpc.law
    plant = control.ss(a, b, c, 0, TS)
    late = control.ss(control.tf([1.0], [1.0, *[0.0] * mpc.compute_delay_samples], TS))
    back = control.ss(law.a, -law.b[:, 1:], law.c[None], -law.d[1], TS)
    ahead = control.ss(law.a, law.b[:, :1], law.c[None], law.d[0], TS)
    return plant * late, back, ahead


def find_radius(mpc, params, damping):
    """Return the closed loop's largest eigenvalue."""
    plant, back, _ = state_spaces(mpc, params, damping)
    return np.max(np.abs(control.feedback(plant * back, 1).poles()))


def close_by_hand(mpc, params, damping):
    """Return abs(S), abs(T) and abs(F/F_ref) over F."""
    p, c_y, c_r = (part(Z) for part in state_spaces(mpc, params, damping))
    s = 1.0 / (1.0 + p * c_y)
    return np.abs(s), np.abs(p * c_y * s), np.abs(p * c_r * s)


def test_sliding_and_stuck_margins_are_those_of_the_two_plants(mpc, rubbing):
    assert list(mpc.loops) == ["design plant sliding", "design plant stuck"]
    for loop, damping in zip(mpc.loops.values(), (0.0, F_C / V_S), strict=True):
        figures = loop.figures()
        s, t, tracking = close_by_hand(mpc, rubbing, damping)
        assert find_radius(mpc, rubbing, damping) == pytest.approx(figures.spectral_radius, rel=1e-6)
        assert figures.ms == pytest.approx(np.max(s), rel=1e-3)
        assert figures.mt == pytest.approx(np.max(t), rel=1e-3)
        assert figures.reference_peak == pytest.approx(np.max(tracking), rel=1e-3)
        assert figures.bandwidth_hz == pytest.approx(F[np.argmax(tracking < np.sqrt(0.5))], rel=3e-3)
    for verdict in mpc.verdicts:
        assert verdict.met
    assert mpc.feasible and not mpc.explanation
    text = flatten(repr(mpc))
    assert 0 < text.index("design plant sliding: bandwidth") < text.index("design plant stuck: bandwidth")


def test_what_is_shown_holds_for_every_slope_in_between(mpc, rubbing):
    """A constant slope of the sector is a friction too: all loops are stable, up to what is said to be shown."""
    assert mpc.friction.shown and mpc.friction.factor > 2.0
    slopes = np.concatenate([[0.0], np.geomspace(1.0, mpc.friction.slopes[0], 30)])
    assert mpc.friction.slopes[0] == pytest.approx(mpc.friction.factor * F_C / V_S, rel=1e-9)
    assert all(find_radius(mpc, rubbing, slope) < 1.0 for slope in slopes)
    assert any(str(mpc.friction) in note for note in mpc.notes)


def test_it_comes_to_its_reference_against_friction(mpc, stand, rubbing):
    run = close_loop(mpc.command, mpc.start, stand, rubbing, np.full(1500, 1000.0))
    assert run.force[-200:] == pytest.approx(1000.0, abs=10.0)
    assert run.overshoot < 0.1


def test_a_broken_limit_is_named_with_the_bandwidth_that_keeps_it(stand, thor):
    fast = made(stand, thor, bandwidth_hz=40.0)
    assert not fast.feasible
    assert set(map(str, fast.broken)) == {"max_sensitivity (design plant)", "max_complementary (design plant)"}
    s, t, _ = close_by_hand(fast, thor, 0.0)
    assert np.max(s) > 1.7 and np.max(t) > 1.3
    assert (
        repr(fast).startswith("not met")
        and f"{fast.possible_hz:.4g} Hz is possible (tuned, not certified)" in fast.explanation
    )
    assert made(stand, thor, bandwidth_hz=fast.possible_hz).feasible
    assert not made(stand, thor, bandwidth_hz=1.03 * fast.possible_hz).feasible


def test_false_lifts_a_limit_and_is_said(stand, thor):
    lifted = made(stand, thor, bandwidth_hz=40.0, max_sensitivity=False, max_complementary=False)
    assert lifted.feasible
    assert [note.split(" = ")[0] for note in lifted.notes] == ["max_sensitivity", "max_complementary"]
    tight = made(stand, thor, max_reference_peak=1.2, max_noise_gain=1.0, min_disk_margin=0.5)
    assert [str(limit) for limit in tight.broken] == ["max_noise_gain"]
    assert {verdict.limit.name for verdict in tight.verdicts} >= {"max_droop_db", "shoulder_hz", "min_disk_margin"}


def test_a_plan_of_few_currents_that_misses_the_bandwidth_is_not_feasible(stand, thor):
    crude = made(stand, thor, bandwidth_hz=20.0, horizon_s=0.2, moves=4)
    _, _, tracking = close_by_hand(crude, thor, 0.0)
    reached = F[np.argmax(tracking < np.sqrt(0.5))]
    assert reached < 0.97 * 20.0
    assert not crude.feasible and "bandwidth_hz" in map(str, crude.broken) and "bandwidth_hz" in crude.explanation
    bandwidth = next(line for line in repr(crude).splitlines() if line.startswith("  Bandwidth"))
    assert float(bandwidth.split()[1]) == pytest.approx(reached, rel=3e-3)
    assert {v.limit.name: v.value for v in crude.verdicts}["bandwidth_hz"] == pytest.approx(reached, rel=3e-3)


def test_every_copy_is_judged_by_its_own_specification(mpc):
    """A controller whose specification is replaced is held against the new one, and none is left unjudged."""
    tightened = replace(mpc, spec=replace(mpc.spec, max_sensitivity=1.1))
    assert mpc.feasible and not tightened.feasible
    assert all(limit.name == "max_sensitivity" for limit in tightened.broken)
    with pytest.raises((TypeError, ValueError)):
        replace(mpc, verdicts=())


@pytest.mark.parametrize(
    "level", [{"max_sensitivity": 0.9}, {"max_complementary": np.nan}, {"min_sensitivity_bandwidth_hz": 20.0}]
)
def test_a_level_that_no_loop_keeps_is_refused(level):
    with pytest.raises(ControlError, match=next(iter(level))):
        MPCSpec(current_limit_A=9.0, bandwidth_hz=15.0, **level)


def test_the_report_has_its_limits(mpc, stand, thor, tmp_path):
    fast = made(stand, thor, bandwidth_hz=40.0)
    for one, words in ((mpc, "design plant stuck"), (fast, "max_sensitivity")):
        page = so.write_report([one], tmp_path / "report.html").read_text(encoding="utf-8")
        assert "Predictive control" in page and words in page and f"{one.achieved.ms:.4g}" in page


def test_the_table_of_limits_has_the_units_of_the_plant_and_the_grace_of_the_bandwidth():
    plant = so.plants.rotary(link="locked")
    text = " ".join(str(made(plant, plant.defaults, measured="tau_s", bandwidth_hz=12.0, max_noise_gain=50.0)).split())
    assert "noise gain" in text and "N m/(N m)" in text and "N/N" not in text
    assert text.count("% grace") == 1 and "= 12 (2 % grace) Hz met" in text


def test_its_loops_are_judged_once(stand, rubbing, monkeypatch):
    """Made, printed and asked for its limits: one measurement for sliding, one for stuck; a copy has its own."""
    counted = []
    measure = Loop.figures
    monkeypatch.setattr(Loop, "figures", lambda loop: counted.append(loop) or measure(loop))
    one = made(stand, rubbing)
    assert one.feasible and one.achieved.stable and "sliding" in str(one)
    assert len(counted) == 2
    other = replace(one, spec=replace(one.spec, max_sensitivity=1.05))
    assert one.feasible and not other.feasible and len(counted) == 4
