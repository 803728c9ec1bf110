"""What no log of a held spring tells, and which values it touches: logs of actuators that are integrated here."""

from __future__ import annotations

import math

import numpy as np
import pytest

import seaopt as so
from seaopt.estimation.judgement.hypotheses import _find_level
from tests.actuator_logs import drive, integrate

RATE_HZ = 400.0
ROTARY = {"J_m": 2.4e-5, "b_r": 1.5e-4, "f_c": 0.02, "v_s": 5.0, "N": 100.0, "K_tau": 0.05, "k_s": 300.0}
SCREW = {"m_l": 0.646, "k": 655e3, "l": 0.002, "N_p": 3.0, "K_tau": 0.0255, "J": 3.31e-6, "b_r": 1.31e-4, "f_c": 60.0,
         "v_s": 2e-3}  # fmt: skip


def record(
    *,
    linear=False,
    give=0.0,
    driving=0.0,
    driven=0.0,
    damping=0.0,
    hardening=0.0,
    play=0.0,
    make_current=None,
    droop=0.0,
):
    """Return the log of a motor on a held spring, in series with a stand that gives by a share of the spring; friction
    grows by shares of the spring's effort, where the motor drives it and where it drives the motor. `damping` is a
    damper's across a gear's spring, which hardens by a cubic stiffness, behind a play of twice `play`. A current of its
    own is made of the times; of each a share `droop` times its square makes no torque.
    """
    p = SCREW if linear else ROTARY
    t, current = drive(6.0, RATE_HZ, 2.5, seed=1, top_hz=25.0)
    current = current if make_current is None else make_current(t)
    lead = p["l"] / (2 * math.pi * p["N_p"]) if linear else 1.0
    ratio, spring = (1.0, p["k"]) if linear else (p["N"], p["k_s"])
    inertia = p["J"] / lead**2 + p["m_l"] if linear else p["J_m"]
    stiffness = spring / (1.0 + give)

    def pull(place):
        stretch = place / ratio - np.clip(place / ratio, -play, play)
        return (stiffness * stretch + hardening * stretch**3) / ratio

    def rates(x, ampere):
        place, speed = x
        effort = pull(place)
        level = p["f_c"] + 0.5 * (driving + driven) * abs(effort)
        rub = level * math.tanh(speed / p["v_s"]) + p["b_r"] / lead**2 * speed
        rub += damping / ratio**2 * speed
        rub += 0.5 * (driving - driven) * effort  # where it slides: more against the spring than with it
        push = p["K_tau"] / lead * ampere * (1.0 - droop * ampere**2)
        return speed, (push - rub - effort) / inertia

    place, speed = integrate(rates, 2, current, 1.0 / RATE_HZ, 4)
    noise, effort = np.random.default_rng(2), pull(place) * ratio + damping * speed / ratio
    if linear:
        pushed = np.array([rates(x, u)[1] for x, u in zip(zip(place, speed, strict=True), current, strict=True)])
        readings = {"F1": (effort, 1.0), "F2": (effort + p["m_l"] * pushed, 1.0), "q": (place, 1e-7)}
    else:
        readings = {"tau_s": (effort, 0.02), "theta_m": (place, 1e-3)}
    noisy = {name: values + noise.normal(scale=std, size=t.size) for name, (values, std) in readings.items()}
    return so.Log.from_arrays(time=t, I=current, **noisy)


def fit(log, *, linear=False, parts=(), free=None, **given):
    plant = so.plants.high_impedance(parts=parts) if linear else so.plants.rotary(link="locked", parts=parts)
    names = free or (("J", "b_r", "f_c", "k", "eta") if linear else ("J_m", "b_r", "f_c", "k_s", "eta"))
    params = plant.defaults.update(**(SCREW if linear else ROTARY), **given).free(*names)
    starts = {"c_e": 0.03, "k_3": 0.0, "g_b": 0.005}
    added = {name: value for name, value in starts.items() if name in plant.parameters}
    params = params.update(**added).free(*added)
    outputs = tuple(name for name in log.signals if name != "I")
    return so.fit([so.Experiment(plant=plant, log=log, outputs=outputs, initial_state="rest")], params)


def follow(result, part, size):
    """Return the values with an effect of a size, along the direction that the residual does not show."""
    (silent,) = (each for each in result.silent if each.part == part)
    assert silent.seen < 1.0
    return {name: result.parameters[name].value + shift * size for name, shift in silent.shifts.items()}


def test_friction_that_is_none_is_not_touched(monkeypatch):
    """A value of zero, on its bound, was named as touched by what moves it by 1e-17."""
    monkeypatch.setitem(ROTARY, "f_c", 0.0)
    result = fit(record(), free=("J_m", "b_r", "f_c", "k_s", "eta"))
    assert abs(result.parameters["f_c"].value) < 3.0 * result.parameters["f_c"].std
    assert {part: set(shifts) for part, shifts in ((each.part, each.shifts) for each in result.silent)} == {
        "stand": {"k_s"}, "back_driving": {"J_m", "b_r", "eta"},
    }  # fmt: skip


@pytest.mark.parametrize("linear", [False, True])
def test_a_stand_in_series_is_said_to_touch_the_stiffness(linear):
    result = fit(record(linear=linear, give=0.04), linear=linear)
    name, truth = ("k", SCREW["k"]) if linear else ("k_s", ROTARY["k_s"])
    assert result.met
    assert result.parameters[name].value == pytest.approx(truth / 1.04, rel=2e-3)
    values = follow(result, "stand", 0.04 / truth)
    assert values.keys() == {name}
    assert values[name] == pytest.approx(truth, rel=3e-3)
    assert f"told from such a log: {name} where the stand is compliant" in repr(result)


@pytest.mark.parametrize("linear", [False, True])
def test_back_driving_is_said_to_touch_all_that_scales_with_it(linear):
    """Shares of 0.13 and 0.03 are 0.08 with 0.05 beside it."""
    result = fit(record(linear=linear, driving=0.13, driven=0.03), linear=linear, parts=("load_friction",))
    truth = SCREW if linear else ROTARY
    assert result.met
    values = follow(result, "back_driving", 0.05)
    inertia = "J" if linear else "J_m"
    assert result.parameters["eta"].value == pytest.approx(1.0 / 1.05, rel=5e-3)
    assert values.keys() == {inertia, "b_r", "f_c", "eta", "c_e"}
    for name, value in values.items():
        expected = {"eta": 1.0, "c_e": 0.08}.get(name) or truth[name]
        assert value == pytest.approx(expected, rel=0.01), name


@pytest.mark.parametrize(("part", "shape"), [("hardening", {"hardening": 2e4}), ("backlash", {"play": 0.01})])
def test_back_driving_is_said_of_springs_that_are_not_straight(part, shape):
    """The transmission rubs by what the spring pulls with, not by what a straight one would."""
    result = fit(record(driving=0.13, driven=0.03, **shape), parts=("load_friction", part))
    assert result.met
    values = follow(result, "back_driving", 0.05)
    assert values.keys() == {"J_m", "b_r", "f_c", "eta", "c_e"}
    for name, value in values.items():
        expected = {"eta": 1.0, "c_e": 0.08}.get(name) or ROTARY[name]
        assert value == pytest.approx(expected, rel=0.02), name


def test_a_fixed_damping_of_the_spring_is_said_to_touch_the_motors():
    """With the other end held a damper c across the spring is c/N^2 at the motor: angles do not tell which it is."""
    damper = 0.4
    log = record(damping=damper)
    angle = so.Log.from_arrays(time=log.time, I=log["I"], theta_m=log["theta_m"])
    names = ("J_m", "b_r", "f_c")
    result = fit(angle, free=names)
    assert result.met
    values = follow(result, "", damper)
    assert result.parameters["b_r"].value == pytest.approx(ROTARY["b_r"] + damper / ROTARY["N"] ** 2, rel=2e-3)
    assert values.keys() == {"b_r"}
    assert values["b_r"] == pytest.approx(ROTARY["b_r"], rel=3e-3)
    assert "told from such a log: b_r where the spring is damped" in " ".join(repr(result).split())
    right = fit(angle, free=names, c_s=damper)
    assert right.met
    assert right.parameters["b_r"].value == pytest.approx(ROTARY["b_r"], rel=3e-3)
    assert "b_r where the spring is damped more" in " ".join(repr(right).split())


@pytest.mark.parametrize(("least", "touched"), [(0.0, ("eta",)), (-2.5, ("J_m", "b_r", "f_c", "k_s"))])
def test_a_motor_that_droops_is_said_to_touch_all_that_scales_where_commands_have_one_size(least, touched):
    """A tenth less of torque at the one current that there is: no other log of such commands is another. A torque that
    is measured leaves it to the efficiency; without one all that scales with torques is less.
    """

    def switch(t):
        return np.where(t * (1.0 + t) % 2.0 < 1.0, 2.5, least)

    log = record(make_current=switch, droop=0.1 / 2.5**2)
    if "eta" not in touched:
        channels = {name: log[name] for name in ("I", "theta_m")}
        log = so.Log.from_arrays(time=log.time, **channels)
    result = fit(log, free=("J_m", "b_r", "f_c", "k_s", *(["eta"] if "eta" in touched else [])))
    values = follow(result, "droop", 0.1 / 2.5**2)
    assert result.met
    assert values.keys() == set(touched)
    for name, value in values.items():
        assert value == pytest.approx({"eta": 1.0}.get(name) or ROTARY[name], rel=0.02), name
    assert "where the motor's torque droops at large currents" in " ".join(repr(result).split())


def name_silent(*currents):
    """Return the effects that no log of such currents tells, of a fit without a torque."""
    plant = so.plants.rotary(link="locked")
    logs = [record(make_current=lambda t, make=make: make(t)) for make in currents]
    logs = [so.Log.from_arrays(time=log.time, I=log["I"], theta_m=log["theta_m"]) for log in logs]
    params = plant.defaults.update(**ROTARY).free("J_m", "b_r", "f_c", "k_s")
    experiments = [so.Experiment(plant=plant, log=log, outputs=("theta_m",), initial_state="rest") for log in logs]
    return {each.part for each in so.fit(experiments, params).silent}


def test_a_second_size_of_the_commands_tells_a_droop_and_a_log_at_rest_does_not():
    def switch(t, size):
        return np.where(t * (1.0 + t) % 2.0 < 1.0, size, -size)

    assert "droop" in name_silent(lambda t: switch(t, 2.5))
    assert "droop" in name_silent(lambda t: switch(t, 2.5), np.zeros_like)
    assert "droop" not in name_silent(lambda t: switch(t, 2.5), lambda t: switch(t, 1.2))


@pytest.mark.parametrize("rows", [500, 5000])
@pytest.mark.parametrize(("spikes", "spike"), [(0, 0.0), (1, 5.0), (6, 5.0), (1, 200.0), (6, 60.0)])
@pytest.mark.parametrize("noise", [0.0, 0.02])
def test_a_size_is_found_beside_spikes_and_noise(rows, spikes, spike, noise):
    wave = np.where(np.arange(rows) % 100 < 50, 2.5, 0.0)
    sizes = np.abs(wave + noise * np.random.default_rng(1).normal(size=rows))
    sizes[:: rows // 6][:spikes] = spike
    assert _find_level(sizes) == pytest.approx(2.5, rel=0.02)
    assert _find_level(np.append(sizes, np.nan)) == pytest.approx(2.5, rel=0.02)
    assert _find_level(np.abs(2.5 * np.sin(np.arange(rows)))) == 0.0
    assert _find_level(np.concatenate([sizes, 0.5 * sizes])) == 0.0
    assert _find_level(np.zeros(rows)) == _find_level(np.zeros(0)) == 0.0


def test_a_log_without_its_optional_current_has_no_size_of_it():
    """An actuator that is shaken from outside, with its motor off."""
    plant = so.plants.rotary("pendulum", external=True)
    params = plant.defaults.update(f_c=0.0)
    t, push = drive(4.0, RATE_HZ, 2.0, seed=3, top_hz=8.0)
    log = so.Log.from_arrays(time=t, tau_e=push)
    run, noise = so.simulate(plant, params, log), np.random.default_rng(4)
    measured = {name: run[name] + noise.normal(scale=1e-4, size=t.size) for name in ("theta_m", "theta_l")}
    log = so.Log.from_arrays(time=t, tau_e=push, **measured)
    experiment = so.Experiment(plant=plant, log=log, outputs=tuple(measured), initial_state="rest")
    result = so.fit([experiment], params.free("J_m", "J_l", "b_r"))
    assert result.parameters["J_l"].value == pytest.approx(params["J_l"].value, rel=0.02)
    assert "droop" not in {each.part for each in result.silent}


def test_what_a_log_does_tell_is_not_named():
    log = record()
    assert [each.part for each in fit(log).silent] == ["stand", "back_driving"]
    assert [each.part for each in fit(log, free=("J_m", "b_r", "f_c", "eta")).silent] == ["back_driving"]
    assert [each.part for each in fit(log, free=("J_m", "b_r", "f_c", "k_s")).silent] == ["stand"]


def test_forces_alone_do_not_tell_a_stand_from_another_inertia():
    """F = k I K/r/(M s^2 + b s + k): with k given, M and b take what the stand takes from it."""
    plant = so.plants.high_impedance()
    log = record(linear=True)
    log = so.Log.from_arrays(time=log.time, **{name: log[name] for name in ("I", "F1")})
    params = plant.defaults.update(**SCREW).free("J", "b_r")
    result = so.fit([so.Experiment(plant=plant, log=log, outputs=("F1",), initial_state="rest")], params)
    silent = next((each for each in result.silent if each.part == "stand"), None)
    assert silent is None or silent.shifts.keys() >= {"J"}


def test_they_are_kept_in_its_file():
    result = fit(record())
    assert so.Fit.from_dict(result.to_dict(), ()).silent == result.silent
    assert result.silent
