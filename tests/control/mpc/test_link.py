"""A link's motion fed forward beside predictive control: Tustin's rule and matrices written here, compiled C."""

from __future__ import annotations

import json
import pickle
from dataclasses import replace

import numpy as np
import pytest
from scipy import signal
from scipy.linalg import expm

import seaopt as so
from seaopt.control import Controller, LinkFeedforward, MPCSpec, force_mpc
from seaopt.control.mpc.export import collect_code
from seaopt.control.mpc.stored import read_code
from seaopt.errors import ControlError, SeaoptError
from seaopt.files import to_json
from seaopt.problem.stages import design_mpc, tune_problem
from seaopt.robustness import feed_link_forward, linear_controller
from seaopt.robustness.verification import playback
from tests.control.mpc.test_terms import FROM_SPEED, GATE, GRAVITY, LIMIT_A, TS, WEIGHT, draw_rows, run_c
from tests.control.mpc.test_terms import read as read_file

MASS, DAMPING, PER_AMPERE = 50.0**2 * 2.4e-5, 50.0**2 * 4e-4, 50.0 * 0.7 * 0.0369  # of the motor, seen at the link
BANDWIDTH, FRACTION = 15.0, 0.3
LINK = f"link_feedforward = {{ fraction = {FRACTION} }}\n"


def read(folder, options=LINK, terms="", **changes):
    return read_file(folder, terms, options, **changes)


def plan(folder, options=LINK, terms=""):
    problem = read(folder, options, terms)
    return design_mpc(problem, problem.parameters)


def make_filter(fraction=FRACTION, corner=BANDWIDTH, slow=0.1 * BANDWIDTH):
    """Return numerator and denominator of the effort per link angle: each corner warped by itself, Tustin's rule."""
    fast_w, slow_w = (2.0 / TS * np.tan(np.pi * f * TS) for f in (corner, slow))
    num, den = fraction * fast_w**2 * np.array([MASS, DAMPING, 0.0]), [1.0, np.sqrt(2.0) * fast_w, fast_w**2]
    if slow:
        num, den = np.convolve(num, [1.0, 0.0]), np.convolve(den, [1.0, slow_w])
    return signal.bilinear(num, den, 1.0 / TS)


def test_the_path_is_of_the_drive_of_the_first_plant_whose_link_moves(tmp_path):
    link = plan(tmp_path).link
    assert (link.measured, link.unit, link.is_speed, link.fraction) == ("theta_l", "rad", False, FRACTION)
    assert link.inertia == pytest.approx(MASS, rel=1e-6) and link.damping == pytest.approx(DAMPING, rel=1e-6)
    assert (link.corner_hz, link.high_pass_hz) == (BANDWIDTH, 0.1 * BANDWIDTH)


@pytest.mark.parametrize("terms", ["", f"{GRAVITY}, {FROM_SPEED}"])
def test_in_c_and_python_the_sum_of_plan_and_link_is_within_limits(terms, compiler, tmp_path):
    """The link begins at rest where it is first read; what is no number leaves what is added."""
    mpc = plan(tmp_path, f"{LINK}{GATE}\n[mpc]\ncurrent_slew_A_per_s = 800", terms)
    rows, state, commands = draw_rows(3), mpc.start, []
    rows[:, 2] = 1.0 + 0.1 * rows[:, 2]
    assert mpc.reads == (("theta_m", "theta_l") if terms else ("theta_l",))
    found = run_c(compiler, tmp_path / "code", mpc, rows, first=1 if terms else 2)
    for wanted, motor, link, reading in rows.tolist():
        command, state = mpc.command(state, wanted, reading, (motor, link) if terms else (link,))
        commands.append(command)
    np.testing.assert_allclose(found, commands, rtol=0.0, atol=1e-10 * LIMIT_A)
    assert 0.02 < np.mean(np.abs(commands) > LIMIT_A * (1 - 1e-9)) < 0.9 and np.max(np.abs(commands)) <= LIMIT_A
    assert np.max(np.abs(np.diff(commands, prepend=0.0))) < 0.8 + 1e-12


def test_in_single_precision_a_link_at_rest_is_fed_nothing_and_motion_the_same(compiler, tmp_path):
    """Poles and zeros of its filters lie near 1: with float coefficients 0.35 A were commanded at rest."""
    mpc, t = plan(tmp_path, "link_feedforward = { fraction = 1.0 }\n"), 1e-3 * np.arange(3000)
    rows = np.zeros((t.size, 4))
    rows[:, 2] = 1.0 + np.where(t > 0.5, 0.3 * np.sin(6.0 * np.pi * (t - 0.5)), 0.0)
    double, single = (run_c(compiler, tmp_path / str(each), mpc, rows, first=2, single=each) for each in (False, True))
    assert np.ptp(double) > 1.0 and np.max(np.abs(single[:500])) < 1e-3
    np.testing.assert_allclose(single, double, rtol=0.0, atol=0.02)


def test_within_limits_the_plan_is_the_one_without_and_the_link_is_beside_it(compiler, tmp_path):
    mpc, rows = plan(tmp_path), draw_rows(5)
    rows = rows[np.all(np.abs(rows) < 9e9, axis=1)] * [0.1, 0.0, 0.02, 0.1]
    rows[:, 2] += 0.7
    found = run_c(compiler, tmp_path / "code", mpc, rows, first=2)
    bare, state, planned = replace(mpc, link=None), mpc.start, []
    for wanted, _, _, reading in rows.tolist():
        command, state = bare.command(state, wanted, reading)
        planned.append(command)
    fed = signal.lfilter(*make_filter(), rows[:, 2] - rows[0, 2]) / PER_AMPERE  # a link at rest feeds nothing
    assert np.max(np.abs(found)) < 0.9 * LIMIT_A and np.ptp(fed) > 1.0
    np.testing.assert_allclose(found, np.array(planned) + fed, rtol=0.0, atol=1e-8)


def find_radius(mpc, fraction, slow):
    """Return the largest eigenvalue on the pendulum, of matrices written here: motor, link, the command on its way, the
    plan while no limit is active, and what feeds the link forward.
    """
    rates = np.zeros((5, 5))  # motor at the output, its speed, link, its speed; the command
    rates[0, 1] = rates[2, 3] = 1.0
    rates[1] = np.array([-300.0, -DAMPING, 300.0, 0.0, PER_AMPERE]) / MASS
    rates[3] = np.array([300.0, 0.0, -300.0 - WEIGHT, -0.5, 0.0]) / 0.3
    law, moved = mpc.unlimited(), expm(rates * TS)
    a, b, c, d = signal.tf2ss(*make_filter(fraction, slow=slow))
    torque, link = np.array([300.0, 0.0, -300.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0, 0.0, 0.0])
    n, k = law.c.size, a.shape[0]
    whole = np.zeros((5 + n + k, 5 + n + k))
    whole[:4, :5] = moved[:4]
    whole[4] = np.concatenate([law.d[1] * torque + d[0, 0] / PER_AMPERE * link, law.c, c[0] / PER_AMPERE])
    whole[5 : 5 + n, : 5 + n] = np.column_stack([np.outer(law.b[:, 1], torque), law.a])
    whole[5 + n :, :5], whole[5 + n :, 5 + n :] = np.outer(b[:, 0], link), a
    return np.max(np.abs(np.linalg.eigvals(whole)))


@pytest.mark.parametrize(("fraction", "slow"), [(0.3, 1.5), (1.6, 0.0)])
def test_the_loop_that_the_link_closes_is_certified_and_played(fraction, slow, tmp_path, monkeypatch):
    """Without a high-pass more than all of the drive's effort swings the pendulum up."""
    asked = f"link_feedforward = {{ fraction = {fraction}, high_pass_hz = {slow} }}\n"
    problem = read(tmp_path, asked, f_c=0)
    mpc, runs, play = design_mpc(problem, problem.parameters), [], playback.close_loop
    monkeypatch.setattr(playback, "close_loop", lambda *a, **k: runs.append(play(*a, **k)) or runs[-1])
    certificate = so.certify(mpc, problem.certified_plants(), problem.parameters, samples=3, runs=1)
    (row,) = (row for row in certificate.requirements if row.name == "spectral_radius" and row.plant == "swing")
    assert row.value == pytest.approx(find_radius(mpc, fraction, slow), abs=1e-7)
    assert row.value != pytest.approx(find_radius(mpc, 1e-9, slow), abs=1e-5)
    assert row.met == (fraction < 1.0)
    run = next(run for run in runs if np.ptp(run.outputs["theta_l"]) > 0.1)
    state = mpc.start
    for wanted, place, torque, current in zip(
        run.reference, run.outputs["theta_l"], run.force, run.current, strict=True
    ):
        command, state = mpc.command(state, wanted, torque, (place,))
        assert command == pytest.approx(current, abs=1e-9)


def test_the_fraction_left_out_leaves_ms_on_the_plant_whose_link_swings(stand, swing, thor):
    """Without a high-pass more takes Ms, at the zero of the link, where 1 + L is 1 less the path; with one it helps."""
    mpc = force_mpc(stand, thor, MPCSpec(current_limit_A=9.0, bandwidth_hz=20, max_sensitivity=3.0))
    f = np.geomspace(0.01, 400.0, 20000)

    def find_ms(fed, share):
        law = linear_controller(replace(fed, link=replace(fed.link, fraction=share * fed.link.fraction)))
        return np.max(np.abs(law.close(swing, thor).sensitivity(f)))

    fed = feed_link_forward(mpc, LinkFeedforward(high_pass_hz=0.0), {"swing": (swing, thor)})
    assert 0.1 < fed.link.fraction < 0.6 and fed.link.corner_hz == 20.0
    assert find_ms(fed, 1.0) <= 3.0 < find_ms(fed, 1.3)
    fed = feed_link_forward(mpc, LinkFeedforward(), {"swing": (swing, thor)})
    assert fed.link.fraction == 1.0 and find_ms(fed, 0.7) < 1.9 < 2.1 < find_ms(fed, 1e-9)
    strict = force_mpc(stand, thor, MPCSpec(current_limit_A=9.0, bandwidth_hz=20, max_sensitivity=1.7))
    assert feed_link_forward(strict, LinkFeedforward(high_pass_hz=0.0), {"swing": (swing, thor)}).link.fraction == 0.0


def test_files_and_pickles_keep_it(tmp_path):
    problem = read(tmp_path, LINK, GRAVITY)
    mpc, law = design_mpc(problem, problem.parameters), tune_problem(problem, problem.parameters)
    code, again = collect_code(mpc), pickle.loads(pickle.dumps(mpc))
    assert again.link == mpc.link == law.link and law.signals == ("tau_s", "theta_l")
    assert read_code(json.loads(to_json(code.to_dict()))).to_dict() == code.to_dict()
    assert "link feedforward of theta_l [rad]" in repr(law)
    content = json.loads(to_json(law.to_dict()))
    stored = Controller.from_dict(content, problem.design_plant, problem.parameters)
    assert stored.link == law.link
    assert collect_code(replace(mpc, compensation=None)).parts.keys() == {"terms.h"}
    assert not collect_code(replace(mpc, compensation=None, link=None)).parts


def test_what_cannot_be_fed_forward_is_refused(tmp_path):
    problem = read(tmp_path)
    with pytest.raises(SeaoptError, match="none of stand has a link motion"):
        design_mpc(read(tmp_path, plants="[]"), problem.parameters)
    free = so.plants.rotary(link="free")
    mpc = design_mpc(problem, problem.parameters)
    with pytest.raises(ControlError, match="whose link moves"):
        feed_link_forward(replace(mpc, design=(free, problem.parameters)), LinkFeedforward(), {})
