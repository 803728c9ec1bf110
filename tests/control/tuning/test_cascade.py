"""The tuned cascade: against a judge of its own, through files and C, and what it refuses."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import seaopt as so
from seaopt.control import Controller, cascade_pid, sweep
from seaopt.errors import ControlError, FileError
from seaopt.files import to_json

STAND, SWING = so.plants.rotary(link="locked"), so.plants.rotary(link="pendulum")
VALUES = SWING.defaults.update(
    J_m=2.4e-5, b_r=1e-4, K_tau=0.0369, N=100.0, eta=0.7, k_s=300.0, f_c=0.005, v_s=1.0, J_l=0.25, d_l=0.3, m=4.0, L=0.2
)
SPEC = so.ControllerSpec(
    measured=("tau_s", "thetad_m"), structure="cascade", bandwidth_hz=15.0, max_sensitivity=1.6, max_complementary=1.3,
    max_reference_peak=1.3, max_noise_gain=45.0,
)  # fmt: skip


@pytest.fixture(scope="module")
def tuned() -> Controller:
    return so.tune(STAND, VALUES, SPEC, {"swing": SWING})


def step_by_hand(controller: Controller, samples: int) -> np.ndarray:
    """Return the torque after a step of the reference: drive and actuator, written down sample by sample."""
    from scipy.linalg import expm

    g, ts, v = controller.gains, 1e-3, {name: VALUES[name].value for name in VALUES}
    k, n, inertia = v["k_s"], v["N"], v["J_m"]
    a = np.array([[0.0, 1.0], [-k / n**2 / inertia, -v["b_r"] / inertia]])
    block = expm(ts * np.block([[a, np.array([[0.0], [1.0 / n / inertia]])], [np.zeros((1, 3))]]))
    state, waiting, before, summed, slope, inner = np.zeros(2), 0.0, 0.0, 0.0, 0.0, 0.0
    errors, torques = (0.0, 0.0), np.zeros(samples)
    weighted = 0.0
    for i in range(samples):
        torque = torques[i] = k / n * state[0]
        error, speed = 1.0 - torque, (state[0] - before) / ts
        summed += 0.5 * ts * (error + errors[0])
        slope = (g["T_f"] * slope + g["c"] - torque - weighted) / (g["T_f"] + ts)
        asked = g["k_r"] - g["k_p"] * torque + g["k_i"] * summed + g["k_d"] * slope
        missing = asked - g["k_v"] * speed
        inner += 0.5 * ts * (missing + errors[1]) / g.get("T_v", np.inf)
        state = block[:2, :2] @ state + block[:2, 2] * waiting
        waiting, before = g["k_ff"] + missing + inner, state[0] * 0.0 + torque * n / k
        errors, weighted = (error, missing), g["c"] - torque
    return torques


@pytest.mark.parametrize("speed_loop", ["P", "PI"])
def test_the_law_is_the_drive_that_its_gains_describe(speed_loop: str, tuned: Controller) -> None:
    """A step, simulated by hand with integrals that are summed up, against the sampled loop."""
    controller = (
        tuned if speed_loop == "P" else so.tune(STAND, VALUES, replace(SPEC, speed_loop="PI"), {"swing": SWING})
    )
    assert controller.feasible and ("T_v" in controller.gains) == (speed_loop == "PI")
    loop, samples = controller.close(STAND, VALUES), 400
    system = loop.system()
    x, torque = np.zeros(len(system.a)), np.zeros(samples)
    for i in range(samples):
        torque[i] = system.c[2] @ x + system.d[2, 1]
        x = system.a @ x + system.b[:, 1]
    np.testing.assert_allclose(torque, step_by_hand(controller, samples), atol=1e-9)


def test_it_rejects_twice_as_much_as_a_pid_at_the_same_limits(tuned: Controller) -> None:
    from seaopt.control.tuning.tuner import disturbance

    pid = so.tune(STAND, VALUES, replace(SPEC, measured="tau_s", structure="pid"), {"swing": SWING})
    assert tuned.feasible and pid.feasible
    mine, other = (max(disturbance(one.close(p, VALUES), 15.0) for p in (STAND, SWING)) for one in (tuned, pid))
    assert mine < 0.55 * other
    assert tuned.achieved.noise_gain <= 45.0 and tuned.achieved.other_noise_gains[0] > 0.0


def test_the_encoders_noise_gain_is_a_limit(tuned: Controller) -> None:
    asked = 0.6 * tuned.achieved.other_noise_gains[0]
    quieter = so.tune(STAND, VALUES, replace(SPEC, max_other_noise_gain=asked), {"swing": SWING})
    assert quieter.feasible
    assert quieter.achieved.other_noise_gains[0] <= asked
    assert quieter.gains["k_v"] < tuned.gains["k_v"]
    assert f"{asked:g} N m/rad" in {row[0]: row[2] for row in quieter.list_achieved()}["other signals' noise gain"]


def test_its_p_form_is_the_drives(tuned: Controller) -> None:
    g = tuned.gains
    law = cascade_pid(
        k_v=g["k_v"], k_p=g["k_p"] / g["k_v"], k_i=g["k_i"] / g["k_v"], k_d=g["k_d"] / g["k_v"], T_f=g["T_f"],
        b=g["k_r"] / g["k_p"], c=g["c"], feedforward=g["k_ff"], sample_time_s=1e-3,
    )  # fmt: skip
    f = np.geomspace(0.01, 499.0, 50)
    np.testing.assert_allclose(tuned.law.responses(f), law.differenced(2).responses(f), rtol=1e-6)


def test_it_is_read_again_and_refused_where_a_gain_is_another(tuned: Controller) -> None:
    content = json.loads(to_json(tuned.to_dict()))
    again = Controller.from_dict(content, STAND, VALUES)
    assert again.feasible and again.signals == ("tau_s", "theta_m") and dict(again.gains) == dict(tuned.gains)
    with pytest.raises(FileError, match="is not what gains"):
        Controller.from_dict(
            content | {"gains": content["gains"] | {"k_v": 1.01 * content["gains"]["k_v"]}}, STAND, VALUES
        )
    with pytest.raises(FileError, match="k_v"):
        Controller.from_dict(
            content | {"gains": {k: v for k, v in content["gains"].items() if k != "k_v"}}, STAND, VALUES
        )


def test_a_sweep_of_cascades(tuned: Controller) -> None:
    rows = sweep(STAND, VALUES, SPEC, [15.0]).rows
    assert rows[0].feasible and rows[0].without_sticking is not None
    with pytest.raises(ControlError, match="free_law"):
        sweep(STAND, VALUES, SPEC, [15.0], free_law=True)


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"measured": "tau_s"}, "reads the regulated output and the motor's speed"),
        ({"measured": ("tau_s", "theta_m")}, r'give measured = \["tau_s", "thetad_m"\]'),
        ({"passive_band_hz": (1.0, 20.0)}, "passive_band_hz is not yet a limit"),
        ({"min_friction_margin": 0.1}, "min_friction_margin is not yet a limit"),
        ({"structure": "pid"}, 'give structure = "cascade"'),
    ],
)
def test_what_it_cannot_do_is_said(changed: dict[str, object], said: str) -> None:
    with pytest.raises(ControlError, match=said):
        so.tune(STAND, VALUES, replace(SPEC, **changed))  # pyright: ignore[reportArgumentType]


def test_its_certificate_and_its_step_are_drawn(tuned: Controller, tmp_path: Path) -> None:
    from seaopt.reporting.figures.loop import step_response

    torque, effort = step_response(tuned.close(STAND, VALUES), 2000)
    assert torque[-1] == pytest.approx(1.0, abs=0.02) and effort[-1] == pytest.approx(1.0, abs=0.02)
    certificate = so.certify(tuned, {"swing": SWING}, VALUES, samples=20, simulations=False)
    assert {"design plant sliding", "design plant stuck", "swing sliding", "swing stuck"} <= set(certificate.plants)
    assert all(one.stable for one in certificate.plants.values())
