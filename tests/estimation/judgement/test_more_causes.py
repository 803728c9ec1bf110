"""Causes that leave their trace in motion: magnets, a spring or a joint that slips, a supply, a servo's firmware.

The logs are of a motor on a held spring that is integrated here.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

import seaopt as so
from seaopt.estimation.judgement.traces.ripple_search import find_ripple
from seaopt.estimation.problem.fit_problem import pose_problem
from seaopt.estimation.problem.losses import Squares
from seaopt.estimation.problem.residual_statistics import compute_experiment_residuals
from tests.actuator_logs import drive, integrate

RATE_HZ = 400.0
TRUTH = {"J_m": 2.4e-5, "b_r": 1.5e-4, "f_c": 0.02, "v_s": 5.0, "N": 100.0, "K_tau": 0.05, "k_s": 300.0, "c_s": 0.0}
DUTY = {"R": 0.8, "V_s": 24.0}
SERVO = {"k_p": 0.25, "k_d": 0.006, "g_s": 1.0}  # A per rad of the motor, and per rad/s
STEPS = 4


def record(
    *, cog=(0.0, 0.0, 0.0), slip=(0.0, 1.0), bristle=0.0, sag=None, late=None, seconds=6.0, rest_s=0.0, steps=STEPS
):
    """Return a log. `cog`: sine, cosine and wave number; `slip`: stiffness and limit of a spring that slips; `bristle`:
    stiffness of what the joint bends by; `sag`: the supply's resistance, the input then being a duty; `late`: samples
    of the firmware's own between which its command stands still, the input then being a goal; `rest_s`: in front.
    """
    p, (a, b, wave), (k_h, y_h) = TRUTH, cog, slip
    _, chirp = drive(seconds, RATE_HZ, 2.5, seed=1, top_hz=25.0)
    chirp = np.concatenate([np.zeros(round(rest_s * RATE_HZ)), chirp])
    t = np.arange(chirp.size) / RATE_HZ
    inputs = chirp if sag is None and late is None else chirp / 8.0 if sag is not None else 3.0 * chirp
    held = [0.0, 0]  # the servo's command, and the steps that it has stood for

    def command(u, angle, speed):
        if sag is not None:
            duty = min(max(u, -1.0), 1.0)
            return (DUTY["V_s"] * duty - p["K_tau"] * speed) / (DUTY["R"] + sag * duty**2)
        return u if late is None else held[0]

    def rates(x, u):
        angle, speed, z, bend = x
        turn = speed / p["N"]
        moves = 0.0 if abs(z) >= y_h and z * turn > 0.0 else turn
        effort = p["k_s"] * angle / p["N"] + k_h * z
        level, bent = p["f_c"], 0.0
        if bristle:
            bent = speed - bristle * abs(speed) / level * bend
            dry = bristle * bend
        else:
            dry = level * math.tanh(speed / p["v_s"])
        rub = dry + p["b_r"] * speed + a * math.sin(wave * angle) + b * math.cos(wave * angle)
        push = p["K_tau"] * command(u, angle, speed) - rub - effort / p["N"]
        return speed, push / p["J_m"], moves, bent

    if late is None:
        angle, _, z, _ = integrate(rates, 4, inputs, 1.0 / RATE_HZ, steps)
    else:
        angle, _, z = _serve(rates, inputs, held, late)
    noise = np.random.default_rng(2)
    effort = p["k_s"] * angle / p["N"] + k_h * z
    return so.Log.from_arrays(
        time=t,
        **{"duty" if sag is not None else "goal" if late is not None else "I": inputs},
        tau_s=effort + noise.normal(scale=0.02, size=t.size),
        theta_m=angle + noise.normal(scale=1e-3, size=t.size),
    )


def _serve(rates, goals, held, late):
    """Return angle, speed and slip of a motor whose firmware runs `late` times slower than the integration's steps."""
    h, x, rows, step = 1.0 / RATE_HZ / 10, [0.0] * 4, [], 0
    for goal in goals:
        rows.append(x[:3])
        for _ in range(10):
            if step % late == 0:
                held[0] = SERVO["g_s"] * (SERVO["k_p"] * (goal - x[0]) - SERVO["k_d"] * x[1])
            step += 1
            k1 = rates(x, goal)
            k2 = rates([c + h * d for c, d in zip(x, k1, strict=True)], goal)
            x = [c + 0.5 * h * (d + e) for c, d, e in zip(x, k1, k2, strict=True)]
    return np.array(rows).T


def fit(log, *, parts=(), **values):
    plant = so.plants.rotary(link="locked", parts=parts)
    stated = (
        [so.Parameter(name="k_p", value=1.0, unit=plant.parameter_unit("k_p"))] if "position_servo" in parts else []
    )
    own = TRUTH | {name: value for name, value in (DUTY | SERVO).items() if name in plant.parameters}
    params = plant.defaults.with_parameters(*stated).update(**own).update(J_m=2.8e-5, k_s=270.0, f_c=0.017, **values)
    experiment = so.Experiment(plant=plant, log=log, outputs=("tau_s", "theta_m"), initial_state="rest")
    return so.fit([experiment], params.free("J_m", "b_r", "f_c", "k_s"))


def check(result, part, **expected):
    """The part is the one that is named, and all values come within 3 %."""
    best = result.hypotheses[0]
    assert (best.parts, best.outcome) == ((part,), "adopted")
    values = {**best.parameters, **best.frees}
    for name, value in ({name: TRUTH[name] for name in ("J_m", "b_r", "f_c", "k_s")} | expected).items():
        assert values[name] == pytest.approx(value, rel=0.03), name


def test_magnets_are_named_with_their_wave_number():
    check(fit(record(cog=(0.006, 0.003, 12.0))), "cogging", a_g=0.006, b_g=0.003, n_g=12.0)


@pytest.mark.slow
def test_magnets_are_named_where_a_long_rest_is_in_front(monkeypatch):
    monkeypatch.setattr("seaopt.estimation.judgement.traces.ripple_search.LONGEST", 2000)
    check(fit(record(cog=(0.006, 0.003, 12.0), rest_s=6.0)), "cogging", a_g=0.006, b_g=0.003, n_g=12.0)


@pytest.mark.slow
def test_a_spring_in_which_something_slips_is_named():
    """Of an element of Maxwell's, which slips all at once; how sharply, the log hardly tells, and it is fixed."""
    result = fit(record(slip=(30.0, 0.02)))
    check(result, "hysteresis", k_h=30.0, y_h=0.02)
    assert result.hypotheses[0].fixed["n_h"] > 3.0


@pytest.mark.slow
def test_how_sharply_it_slips_is_named_in_a_long_log_whose_residual_asks_for_coarse_steps():
    """With them the blunt spring was the minimum, and v_s, which takes 3 % of the residual's power, was named."""
    result = fit(record(slip=(30.0, 0.02), seconds=60.0), parts=("hysteresis",), k_h=30.0, y_h=0.02, n_h=5.3)
    (cause,) = (finding for finding in result.findings if finding.kind == "cause")
    assert cause.preferred["n_h"][0] > 15.0


def test_a_spring_that_hardly_slips_is_as_stiff_as_without_what_slips():
    """Up to most of its deflection both springs are stiff together: the fit's stiffness is that of both."""
    check(fit(record(slip=(30.0, 0.1))), "hysteresis", k_h=30.0, y_h=0.1)


@pytest.mark.slow
def test_a_joint_that_gives_way_before_it_slips_is_named():
    check(fit(record(bristle=0.1)), "lugre", sigma_0=0.1)


def test_bristles_far_stiffer_than_a_travel_tells_are_found():
    """They are stiff where they slip: a refit takes shorter steps as it finds them stiffer."""
    check(fit(record(bristle=1.0, steps=40)), "lugre", sigma_0=1.0)


@pytest.mark.slow
def test_a_supply_that_sags_is_named_with_its_resistance():
    check(fit(record(sag=0.25), parts=("duty_input",)), "supply_sag", R_b=0.25)


@pytest.mark.slow
def test_firmware_that_samples_is_named_as_late_by_half_a_period():
    """It holds each command for 4 ms, half of which is its delay on average: that is roughly what a dead time makes."""
    result = fit(record(late=16), parts=("position_servo",))
    check(result, "servo_delay")
    assert result.hypotheses[0].frees["T_v"] == pytest.approx(0.002, rel=0.15)


def test_a_wave_number_is_found_where_the_model_has_the_motor_elsewhere():
    """A pendulum whose joint hardly comes back: the model wanders by periods, and the measured motor has the force."""
    p, (a, wave), n = TRUTH, (0.008, 30.0), 4000
    _, chirp = drive(n / RATE_HZ, RATE_HZ, 0.6, seed=1, top_hz=5.0)

    def rates(x, ampere):
        angle, speed, link, turn = x
        torque = p["k_s"] * (angle / p["N"] - link)
        rub = p["f_c"] * math.tanh(speed / 0.5) + p["b_r"] * speed + a * math.sin(wave * angle)
        push = p["K_tau"] * ampere - rub - torque / p["N"]
        return speed, push / p["J_m"], turn, (torque - 0.3 * turn - 4.9 * math.sin(link)) / 0.25

    angle, _, link, _ = integrate(rates, 4, chirp, 1.0 / RATE_HZ, 10)
    noise = np.random.default_rng(2)
    readings = {"theta_m": angle + noise.normal(scale=3e-4, size=n), "theta_l": link + noise.normal(scale=3e-5, size=n)}
    log = so.Log.from_arrays(time=np.arange(n) / RATE_HZ, I=chirp, **readings)
    plant = so.plants.rotary(link="pendulum")
    given = TRUTH | {"v_s": 0.5, "J_l": 0.25, "d_l": 0.3, "m": 2.5, "L": 0.2}
    experiment = so.Experiment(plant=plant, log=log, initial_state="rest", offset=False)
    params = plant.defaults.update(**given).free("J_m", "f_c")
    (posed,) = pose_problem((experiment,), params, loss=Squares()).with_each(substeps=10).experiments
    z = np.array([given["J_m"], given["f_c"]])
    left, position = compute_experiment_residuals(posed, z), experiment.read("theta_m")
    assert wave * np.std(left.raw[:, 0]) > 3.0
    assert find_ripple(posed, left, params, position, 0)["n_g"] == pytest.approx(wave, rel=1e-3)
