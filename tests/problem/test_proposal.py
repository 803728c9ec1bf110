"""Problem files proposed for logs of the tests' own simulator: roles, units, plants, and what a fit makes of them."""

from __future__ import annotations

import math
import tomllib

import numpy as np
import pytest

import seaopt as so
from seaopt.logs.quality.spectra import compute_spectra
from seaopt.logs.reading.vocabulary import is_m_open, read_header, split_words
from seaopt.problem import json_schema
from seaopt.problem.proposal import propose
from seaopt.problem.proposal.questions import name_entry
from seaopt.problem.proposal.survey import regress, slow_sign, survey_log
from seaopt.problem.proposal.traits import fit_delay
from tests.actuator_logs import KNEE, SCREW, drive, knee, screw, write_csv

RATE = 400.0


@pytest.fixture(scope="module")
def logs():
    """Return short logs: times, and channels of a knee free and held, of a servo's, of a bridge's, and of a screw."""
    t, current = drive(4.0, RATE, 2.0)
    goal = 3.0 * np.sin(2 * math.pi * (0.5 + 0.6 * t) * t)
    firmware = knee(goal, RATE, current=lambda u, angle, speed: 2.0 * (u - angle))
    bridge = knee(current / 5.0, RATE, current=lambda u, angle, speed: (24.0 * u - 0.037 * speed) / 1.5)
    return {
        "t": t, "free": knee(current, RATE), "held": knee(current, RATE, locked=True), "servo": firmware, "goal": goal,
        "bridge": bridge, "duty": current / 5.0, "screw": screw(current, RATE),
    }  # fmt: skip


def degrees(values):
    return np.degrees(values)


def steps(values):
    return np.round(values * 4096 / (2 * math.pi))


# Name: columns of (t, all logs), what each role should be, the plant, and how the file is written.
CASES = {
    "brackets": (
        lambda t, of: {"time [s]": t, "I [A]": of["held"]["I"], "tau_s [N m]": of["held"]["tau_s"]},
        {"I": ("I [A]", "A"), "tau_s": ("tau_s [N m]", "N m")}, "held", {},
    ),
    "suffixes": (
        lambda t, of: {"t_ms": 1e3 * t, "current_mA": 1e3 * of["free"]["I"],
                       "mot_pos_deg": degrees(of["free"]["theta_m"]), "joint_pos_deg": degrees(of["free"]["theta_l"]),
                       "torque_Nm": of["free"]["tau_s"]},
        {"I": ("current_mA", "mA"), "tau_s": ("torque_Nm", "N m"), "theta_m": ("mot_pos_deg", "deg"),
         "theta_l": ("joint_pos_deg", "deg")}, "free", {},
    ),
    "german": (
        lambda t, of: {"Zeit [ms]": 1e3 * t, "Motorstrom [mA]": 1e3 * of["held"]["I"],
                       "Federmoment [Nm]": of["held"]["tau_s"], "Motorwinkel [Grad]": degrees(of["held"]["theta_m"]),
                       "Temperatur [°C]": 25.0 + t},
        {"I": ("Motorstrom [mA]", "mA"), "tau_s": ("Federmoment [Nm]", "Nm"),
         "theta_m": ("Motorwinkel [Grad]", "Grad")},
        "held", {"delimiter": ";", "decimal": ","},
    ),
    "bare": (
        lambda t, of: {"t": t, "cur": of["held"]["I"], "tau": of["held"]["tau_s"], "theta_m": of["held"]["theta_m"]},
        {"I": ("cur", "A"), "tau_s": ("tau", "N m"), "theta_m": ("theta_m", "rad")}, "held", {},
    ),
    "milliamperes": (
        lambda t, of: {"timestamp": 1e3 * t, "iq": 1e3 * of["held"]["I"], "load_torque": of["held"]["tau_s"]},
        {"I": ("iq", "mA"), "tau_s": ("load_torque", "N m")}, "held", {},
    ),
    "encoders": (
        lambda t, of: {"time_us": 1e6 * t, "motorCurrent": of["free"]["I"],
                       "motorEncoder": steps(of["free"]["theta_m"]), "outputEncoder_rad": of["free"]["theta_l"]},
        {"I": ("motorCurrent", "A"), "theta_m": ("motorEncoder", "rad"), "theta_l": ("outputEncoder_rad", "rad")},
        "free", {"actuator": "rotary"},
    ),
    "unsided": (
        lambda t, of: {"time": t, "amps": of["free"]["I"], "enc1": of["free"]["theta_l"],
                       "enc2": of["free"]["theta_m"]},
        {"I": ("amps", "A"), "theta_m": ("enc2", "rad"), "theta_l": ("enc1", "rad")}, "free", {"actuator": "rotary"},
    ),
    "servo": (
        lambda t, of: {"timestamp [s]": t, "goal_position [rad]": of["goal"],
                       "present_position [rad]": of["servo"]["theta_m"]},
        {"goal": ("goal_position [rad]", "rad"), "theta_m": ("present_position [rad]", "rad")}, "free",
        {"actuator": "rotary"},
    ),
    "duty": (
        lambda t, of: {"t [s]": t, "pwm": np.round(885 * of["duty"]), "theta_m [rad]": of["bridge"]["theta_m"],
                       "tau_s [N m]": of["bridge"]["tau_s"]},
        {"duty": ("pwm", "-"), "theta_m": ("theta_m [rad]", "rad"), "tau_s": ("tau_s [N m]", "N m")}, "free", {},
    ),
    "percent": (
        lambda t, of: {"t [s]": t, "duty [%]": 100 * of["duty"], "theta_m [rad]": of["bridge"]["theta_m"],
                       "theta_l [rad]": of["bridge"]["theta_l"], "v_bus [V]": 24.0 + 0.1 * np.sin(t)},
        {"duty": ("duty [%]", "percent"), "theta_m": ("theta_m [rad]", "rad"), "theta_l": ("theta_l [rad]", "rad")},
        "free", {"actuator": "rotary"},
    ),
    "command": (
        lambda t, of: {"time [s]": t, "tau_cmd [N m]": 3.7 * of["held"]["I"], "tau_meas [N m]": of["held"]["tau_s"],
                       "vel [rad/s]": of["held"]["omega_m"]},
        {"torque": ("tau_cmd [N m]", "A"), "tau_s": ("tau_meas [N m]", "N m")}, "held", {},
    ),
    "two cells": (
        lambda t, of: {"time [s]": t, "I [A]": of["screw"]["I"], "F1 [N]": of["screw"]["F1"],
                       "F2 [N]": of["screw"]["F2"]},
        {"I": ("I [A]", "A"), "F1": ("F1 [N]", "N"), "F2": ("F2 [N]", "N")}, "held", {},
    ),
    "one cell": (
        lambda t, of: {"t_s": t, "Strom_A": of["screw"]["I"], "Kraft_N": of["screw"]["F1"],
                       "motor_angle_rad": of["screw"]["theta_m"]},
        {"I": ("Strom_A", "A"), "F1": ("Kraft_N", "N"), "screw": ("motor_angle_rad", "rad")}, "held",
        {"delimiter": "\t"},
    ),
    "kilonewtons": (
        lambda t, of: {"t [s]": t, "i_cmd [A]": of["screw"]["I"], "i_act [A]": of["screw"]["I"] + 1e-3 * np.sin(99 * t),
                       "loadcell [kN]": 1e-3 * of["screw"]["F1"], "travel [mm]": 1e3 * of["screw"]["q"]},
        {"I": ("i_cmd [A]", "A"), "F1": ("loadcell [kN]", "kN"), "q": ("travel [mm]", "mm")}, "held", {},
    ),
    "no names": (
        lambda t, of: {"x1": t, "ch1": of["held"]["tau_s"], "ch2": of["held"]["I"]},
        {"I": ("ch2", "A"), "tau_s": ("ch1", "N m")}, "held", {},
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_columns_are_told_apart(tmp_path, logs, name):
    columns, expected, place, how = CASES[name]
    style = {key: value for key, value in how.items() if key != "actuator"}
    path = write_csv(tmp_path / "log.csv", columns(logs["t"], logs), **style)
    proposal = propose([path], {}, tmp_path)
    found = {row.column: (row.role, row.unit) for row in proposal.columns if row.role}
    inputs = {"I", "torque", "goal", "duty"}
    assert {column: role for column, (role, _) in found.items() if role not in ("time", "input")} == {
        column: role for role, (column, _) in expected.items() if role not in inputs
    }
    (driven,) = (role for role in expected if role in inputs)
    assert found[expected[driven][0]][0] == "input"
    content = tomllib.loads(proposal.text)
    assert content["experiment"][0]["plant"] == place
    problem = write(tmp_path, proposal.text)
    assert next(iter(problem.plants)) == place
    (experiment,) = problem.experiments()
    check_values(experiment.log, logs, name)
    jsonschema = pytest.importorskip("jsonschema")
    jsonschema.Draft202012Validator(json_schema()).validate(content)


def write(folder, text):
    path = folder / "problem.toml"
    path.write_text(text, encoding="utf-8")
    return so.read_problem(path)


def check_values(log, logs, name):
    """Check that what a fit will read is, in SI, what the simulator had."""
    kind = {"servo": "servo", "duty": "bridge", "percent": "bridge"}.get(name)
    kind = kind or ("screw" if "F1" in log.signals else "free" if "theta_l" in log.signals else "held")
    truth = {**logs[kind], "goal": logs["goal"], "duty": logs["duty"]}
    if name == "command":
        truth["I"] = 3.7 * logs["held"]["I"]
    if name == "one cell":  # the lead that is guessed turns the angle into the nut's place
        truth["q"] = logs["screw"]["theta_m"] * 0.002 / (2 * math.pi)
    if name == "encoders":
        truth["theta_m"] = steps(truth["theta_m"]) * 2 * math.pi / 4096
    if name == "duty":
        truth["duty"] = np.round(885 * truth["duty"]) / 885
    np.testing.assert_allclose(log.time, logs["t"], atol=1e-6)
    for signal in log.signals:
        np.testing.assert_allclose(log[signal], truth[signal], rtol=1e-6, atol=1e-6 * np.ptp(truth[signal]))


@pytest.mark.parametrize(
    ("header", "quantity", "side", "unit"),
    [
        ("tau_s", "torque", "spring", ""), ("theta_m", "angle", "motor", ""), ("theta_m_rad", "angle", "motor", "rad"),
        ("JointAngle_deg", "angle", "link", "deg"), ("t_us", "time", "", "us"),
        ("motor_current", "current", "motor", ""),
        ("cell2_N", "force", "", "N"), ("vel_rad_s", "speed", "", "rad/s"), ("v_bus", "other", "", ""),
        ("pwm_percent", "duty", "", "percent"), ("cmd_A", "current", "", "A"), ("phase_A", "", "", ""),
        ("enc_motor_counts", "angle", "motor", "counts"),
        ("Sollposition", "angle", "", ""), ("/joint_states.position[0]", "angle", "link", ""), ("ch1", "", "", ""),
    ],
)  # fmt: skip
def test_a_header_says_what_it_says(header, quantity, side, unit):
    read = read_header(header)
    assert (read.quantity, read.side, read.unit) == (quantity, side, unit)


@pytest.mark.parametrize(
    "header",
    [
        "motor_vel_act", "speed_ist", "drehzahl_ist", "rpm_act", "joint_velocity_act", "enc_vel", "encoder_speed",
        "vel_x", "acc_x", "enc_vel_m", "motor_vel [rad]", "Drehzahl_Geber", "position_rate", "omega_y",
    ],
)  # fmt: skip
def test_a_speed_is_no_angle_whatever_else_its_name_says(header):
    assert read_header(header).quantity == "speed"


@pytest.mark.parametrize("header", ["motor_act", "motor_ist"])
def test_measured_alone_says_nothing_of_the_quantity(header):
    assert read_header(header).quantity == "" and read_header(header).measured


def test_the_angle_is_used_beside_the_speed(tmp_path, logs):
    held = logs["held"]
    path = write_csv(tmp_path / "a.csv", {
        "t_s": logs["t"], "iq_A": held["I"], "motor_vel_act": held["omega_m"], "motor_pos_act": held["theta_m"],
        "tau_s [Nm]": held["tau_s"],
    })  # fmt: skip
    rows = {row.column: row.role for row in propose([path], {}, tmp_path).columns}
    assert rows["motor_pos_act"] == "theta_m" and rows["motor_vel_act"] == ""


@pytest.mark.slow
def test_a_fit_of_what_was_proposed_recovers_a_knee(tmp_path):
    """With the motor's own figures known; stiffness, inertias, friction and damping come from the log."""
    t, current = drive(10.0, RATE, 2.0)
    held, free = knee(current, RATE, locked=True), knee(current, RATE, seed=9)
    for name, log in (("held", held), ("free", free)):
        columns = {"t_ms": 1e3 * t, "current_mA": 1e3 * log["I"], "torque_Nm": log["tau_s"],
                   "motor_deg": degrees(log["theta_m"])}  # fmt: skip
        if name == "free":
            columns["joint_deg"] = degrees(log["theta_l"])
        write_csv(tmp_path / f"{name}.csv", columns)
    paths = [tmp_path / "held.csv", tmp_path / "free.csv"]
    proposal = propose(paths, {"K_tau": "0.037"}, tmp_path)
    assert not any(line.startswith("N ") and "typical" in line for line in proposal.text.splitlines())
    problem = write(tmp_path, proposal.text)
    assert problem.parameters["N"].value == 100.0  # from the two encoders
    fit = so.fit(problem.experiments(), problem.parameters, **problem.fit_options)
    assert fit.met, fit
    for name in ("J_m", "b_r", "f_c", "k_s", "J_l", "d_l"):
        assert fit.parameters[name].value == pytest.approx(KNEE[name], rel=0.01), name
    assert fit.parameters["eta"].value == pytest.approx(1.0, rel=0.01)


def test_a_fit_of_what_was_proposed_recovers_a_screw(tmp_path):
    t, current = drive(10.0, RATE, 2.0, top_hz=60.0)
    log = screw(current, RATE)
    columns = {"Zeit [s]": t, "Strom [A]": log["I"], "Kraft F1 [N]": log["F1"], "Kraft F2 [N]": log["F2"]}
    path = write_csv(tmp_path / "chirp.csv", columns, delimiter=";", decimal=",")
    known = {"K_tau": "0.0255", "N_p": "3", "k": "655000"}
    problem = write(tmp_path, propose([path], known, tmp_path).text)
    fit = so.fit(problem.experiments(), problem.parameters, **problem.fit_options)
    assert fit.met, fit
    r = SCREW["l"] / (2 * math.pi * SCREW["N_p"])
    truth = {"m_k": SCREW["J"] / r**2 + SCREW["m_l"], "b_m": SCREW["b_r"] / r**2}
    assert fit.parameters["eta"].value == pytest.approx(1.0, rel=0.01)
    assert {name: fit.derived[name].value for name in truth} == pytest.approx(truth, rel=0.01)


@pytest.mark.slow
def test_with_nothing_known_frequencies_are_right(tmp_path, logs):
    """Whatever gear ratio and torque constant are guessed: what a held log tells is the resonance and its damping."""
    t, current = drive(10.0, RATE, 2.0)
    log = knee(current, RATE, locked=True)
    columns = {"t": t, "cur": log["I"], "tau": log["tau_s"], "theta_m": log["theta_m"]}
    problem = write(tmp_path, propose([write_csv(tmp_path / "k.csv", columns)], {}, tmp_path).text)
    fit = so.fit(problem.experiments(), problem.parameters, **problem.fit_options)
    assert fit.met
    stiff, heavy = KNEE["k_s"], KNEE["N"] ** 2 * KNEE["J_m"]
    natural = math.sqrt(stiff / heavy) / (2 * math.pi)
    assert fit.derived["natural_frequency_hz"].value == pytest.approx(natural, rel=2e-3)


def test_a_turned_sensor_and_one_behind_the_gear_are_set_right(tmp_path, logs):
    held, free = logs["held"], logs["free"]
    path = write_csv(tmp_path / "a.csv", {
        "t [s]": logs["t"], "I [A]": held["I"], "tau_s [N m]": held["tau_s"], "theta_m [rad]": -held["theta_m"],
    })  # fmt: skip
    (experiment,) = write(tmp_path, propose([path], {}, tmp_path).text).experiments()
    np.testing.assert_allclose(experiment.log["theta_m"], held["theta_m"], atol=1e-6)
    path = write_csv(tmp_path / "b.csv", {
        "t [s]": logs["t"], "I [A]": free["I"], "motor [rad]": free["theta_m"] / 100.0, "joint [rad]": free["theta_l"],
        "tau_s [N m]": free["tau_s"],
    })  # fmt: skip
    proposal = propose([path], {"N": "100"}, tmp_path)
    (experiment,) = write(tmp_path, proposal.text).experiments()
    np.testing.assert_allclose(experiment.log["theta_m"], free["theta_m"], atol=1e-4)
    assert "behind the gear" in proposal.text


def test_a_noise_limit_is_written_and_grows_with_the_bandwidth_beyond_the_resonance(tmp_path):
    t, current = drive(10.0, RATE, 2.0)
    log = knee(current, RATE, locked=True)
    path = write_csv(tmp_path / "a.csv", {"t [s]": t, "I [A]": log["I"], "tau_s [N m]": log["tau_s"]})
    usual, fast = (write(tmp_path, propose([path], answers, tmp_path).text) for answers in ({}, {"bandwidth_hz": "60"}))
    assert usual.spec.max_noise_gain == 50
    resonance = math.sqrt(KNEE["k_s"] / KNEE["J_m"]) / KNEE["N"] / (2 * math.pi)
    assert fast.spec.max_noise_gain == pytest.approx(50 * (60 / (4 * resonance)) ** 2, rel=0.5)


def test_answers_take_the_place_of_guesses(tmp_path, logs):
    held = logs["held"]
    path = write_csv(tmp_path / "a.csv", {"t [s]": logs["t"], "I [A]": held["I"], "tau_s [N m]": held["tau_s"]})
    guessed = propose([path], {}, tmp_path)
    assert {one.key for one in guessed.guesses} == {one.key for one in guessed.questions}
    answers = {one.key: one.guess for one in guessed.questions} | {"N": "80", "K_tau": "0.04", "k_s": "250", "m": "3"}
    while missing := [one for one in propose([path], answers, tmp_path).questions if one.key not in answers]:
        answers |= {one.key: one.guess for one in missing}
    proposal = propose([path], answers, tmp_path)
    assert not proposal.guesses and proposal.guessed == ("c_s",)  # nobody is asked for it
    assert "guessed: an undamped spring" in next(row for row in proposal.text.splitlines() if row.startswith("c_s "))
    problem = write(tmp_path, proposal.text)
    assert {name: problem.parameters[name].value for name in ("N", "K_tau", "k_s", "m")} == {
        "N": 80.0, "K_tau": 0.04, "k_s": 250.0, "m": 3.0,
    }  # fmt: skip
    assert problem.parameters["k_s"].prior_std == pytest.approx(12.5)
    assert problem.table.controller.robust_to == ["hanging"]
    assert problem.table.robustness.retune > 0 and "J_l" in problem.table.robustness.parameters


def test_what_results_rest_on_and_nobody_knew_is_data(tmp_path, logs):
    held = logs["held"]
    path = write_csv(tmp_path / "a.csv", {"a": logs["t"], "b": held["I"], "tau": held["tau_s"]})
    problem = write(tmp_path, propose([path], {}, tmp_path).text)
    # K_tau is fitted, m is left out and the bandwidth is a wish: nothing rests on a guess of them.
    assert set(problem.table.guessed) == {
        "unit of a", "unit of b", "unit of tau", "role of a", "role of b", "link of a.csv", "N", "k_s", "c_s",
        "sample_rate_hz", "current_limit_A",
    }  # fmt: skip
    known = {"roles": "yes", "unit:a": "s", "N": "100", "k_s": "unknown"}
    problem = write(tmp_path, propose([path], known, tmp_path).text)
    assert set(problem.table.guessed) == {
        "unit of b", "unit of tau", "link of a.csv", "k_s", "c_s", "sample_rate_hz", "current_limit_A",
    }  # fmt: skip
    assert next(line for line in propose([path], known, tmp_path).text.splitlines() if line.startswith("k_s ")).count(
        "guessed: cannot be identified from the log"
    )


@pytest.mark.parametrize(
    ("names", "answers", "roles"),
    [
        (("q_m", "q_l", "tau_s"), {}, ("theta_m", "theta_l", "tau_s")),
        (("pos_m", "q_l", "u"), {"actuator": "rotary"}, ("theta_m", "theta_l", "")),
        (("pos_m", "", "tau"), {}, ("theta_m", None, "tau_s")),
        (("x_m", "", "F1 [N]"), {}, ("q", None, "F1")),
        (("x_m", "", "F1 [N]"), {"m:x_m": "motor"}, ("screw", None, "F1")),
    ],
)
def test_an_m_is_the_motor_beside_a_gear_and_else_asked_for(tmp_path, logs, names, answers, roles):
    free = logs["free"]
    signals = dict(zip(names, (free["theta_m"], free["theta_l"], free["tau_s"]), strict=True))
    columns = {"t": logs["t"], "iq": free["I"], **{name: one for name, one in signals.items() if name}}
    proposal = propose([write_csv(tmp_path / "a.csv", columns)], answers, tmp_path)
    got = {row.column: row.role for row in proposal.columns}
    assert tuple(got.get(name) for name in names) == roles
    assert ("m:x_m" in {one.key for one in proposal.guesses}) == (names[0] == "x_m" and not answers)


def test_reasons_of_guesses_are_true(tmp_path, logs):
    screw = logs["screw"]
    path = write_csv(
        tmp_path / "a.csv", {"t [s]": logs["t"], "I": screw["I"], "F1": screw["F1"], "F2 [foo]": screw["F2"]}
    )
    why = {one.key: one.why for one in propose([path], {}, tmp_path).questions}
    assert why["unit:I"] == "by the size of its numbers" and "size" not in why["unit:F1"]
    assert why["unit:F2 [foo]"].startswith('"foo" is not a known unit')
    path = write_csv(tmp_path / "b.csv", {"a": logs["t"], "b": screw["I"], "c": screw["F1"]})
    assert "unit" not in {one.key: one.why for one in propose([path], {}, tmp_path).questions}["actuator"]


@pytest.mark.filterwarnings("error")
def test_a_column_without_numbers_is_listed_as_such(tmp_path, logs):
    held = logs["held"]
    huge = held["tau_s"].copy()
    huge[[50, 51]] = 1e300, -1e308
    path = write_csv(tmp_path / "a.csv", {
        "t [s]": logs["t"], "I [A]": held["I"], "tau_s [N m]": huge, "theta_m [rad]": np.full(huge.size, np.nan),
    })  # fmt: skip
    rows = {row.column: row.description for row in propose([path], {}, tmp_path).columns}
    assert rows["theta_m [rad]"] == "not used: holds no number"


def test_a_column_that_is_another_but_for_a_factor_is_no_second_sensor(tmp_path, logs):
    screw = logs["screw"]
    columns = {"t_s": logs["t"], "cmd_A": screw["I"], "LoadCell_raw": screw["F1"] / 0.31, "LoadCell_N": screw["F1"]}
    proposal = propose([write_csv(tmp_path / "a.csv", columns)], {}, tmp_path)
    rows = {row.column: row for row in proposal.columns}
    assert rows["cmd_A"].role == "input" and rows["cmd_A"].unit == "A"
    assert rows["LoadCell_N"].role == "F1"
    assert rows["LoadCell_raw"].description == "not used: 3.226 times LoadCell_N"


@pytest.mark.parametrize("encoder_first", [False, True])
def test_the_place_of_the_nut_is_read_where_its_column_says_so_beside_counts(tmp_path, logs, encoder_first):
    """Both are one position: what is stated in mm needs neither the lead nor the counts of a turn."""
    motion = logs["screw"]
    places = {"path [mm]": 1e3 * motion["q"], "encoder": np.round(motion["q"] / 6e-7)}
    places = dict(reversed(places.items())) if encoder_first else places
    columns = {"t [s]": logs["t"], "I [A]": motion["I"], "force [N]": motion["F1"], **places}
    proposal = propose([write_csv(tmp_path / "a.csv", columns)], {"actuator": "linear"}, tmp_path)
    rows = {row.column: row for row in proposal.columns}
    assert rows["path [mm]"].role == "q" and not rows["encoder"].role
    assert rows["encoder"].description == "not used: path [mm] is that already"
    (experiment,) = tomllib.loads(proposal.text)["experiment"]
    assert experiment["outputs"]["q"] == "path [mm]"
    assert not any("encoder" in guess for guess in tomllib.loads(proposal.text)["guessed"])


def test_a_column_that_is_not_used_says_why(tmp_path, logs):
    free, noise = logs["free"], np.random.default_rng(1).normal(size=logs["t"].size)
    columns = {
        "t [s]": logs["t"], "I [A]": free["I"], "I_meas [A]": free["I"] + noise, "tau_s [N m]": free["tau_s"],
        "theta_m [rad]": free["theta_m"], "motor_enc_counts": steps(free["theta_m"] + noise), "F [N]": 9.0 * noise,
        "speed [rad/s]": np.gradient(free["theta_m"], logs["t"]), "temp": 20.0 + noise, "aux": noise**2,
    }  # fmt: skip
    path = write_csv(tmp_path / "a.csv", columns)
    rows = {row.column: row for row in propose([path], {"actuator": "rotary"}, tmp_path).columns}
    assert {name: row.description.removeprefix("not used: ") for name, row in rows.items() if not row.role} == {
        "I_meas [A]": "the input is I [A]", "motor_enc_counts": "theta_m [rad] is that already",
        "F [N]": "no output of an actuator with a gear", "speed [rad/s]": "a speed, which a fit takes from a position",
        "temp": "not a signal of the actuator", "aux": "its name does not say what it is",
    }  # fmt: skip


def test_the_place_of_a_load_on_a_belt_is_named_with_the_plant_that_has_it(tmp_path, logs):
    """A position on the load's side, which neither a held nor a swinging link has."""
    free = logs["free"]
    columns = {
        "t [s]": logs["t"],
        "I [A]": free["I"],
        "MotEnc_cnt": steps(free["theta_m"]),
        "LoadPos_um": free["tau_s"],
    }
    proposal = propose([write_csv(tmp_path / "a.csv", columns)], {"actuator": "linear"}, tmp_path)
    rows = {row.column: row for row in proposal.columns}
    assert 'kind = "two_link" has it as x_2' in rows["LoadPos_um"].description
    assert 'measured = "tau_d", or "F_d" of a screw' in proposal.text


def test_wrong_roles_can_be_put_right(tmp_path, logs):
    held = logs["held"]
    path = write_csv(tmp_path / "a.csv", {"t [s]": logs["t"], "a": held["theta_m"], "b": held["I"], "c": held["tau_s"]})
    answers = {"roles": "no", "role:a": "theta_m", "role:b": "I", "role:c": "tau_s"}
    (experiment,) = write(tmp_path, propose([path], answers, tmp_path).text).experiments()
    for role, values in (("I", held["I"]), ("theta_m", held["theta_m"]), ("tau_s", held["tau_s"])):
        np.testing.assert_allclose(experiment.log[role], values, atol=1e-6)
    with pytest.raises(so.SeaoptError, match="0 columns are inputs"):
        propose([path], answers | {"role:b": "none"}, tmp_path)


@pytest.mark.parametrize(
    ("answer", "text"), [("-3", "not a positive number"), ("many", "not a positive number"), ("nan", "not a positive")]
)
def test_an_answer_that_is_none_is_refused(tmp_path, logs, answer, text):
    held = logs["held"]
    path = write_csv(tmp_path / "a.csv", {"t [s]": logs["t"], "I [A]": held["I"], "tau_s [N m]": held["tau_s"]})
    with pytest.raises(so.SeaoptError, match=text):
        propose([path], {"N": answer}, tmp_path)


def test_names_that_toml_or_a_terminal_would_obey_are_kept_apart(tmp_path, logs):
    held = logs["held"]
    strange = 'cur\x7f"\\ [A]'
    path = tmp_path / "ö 1.csv"
    path.write_text(
        f't [s];"{strange.replace(chr(34), chr(34) * 2)}";tau_s [N m]\n'
        + "\n".join(f"{a:.6f};{b:.6f};{c:.6f}" for a, b, c in zip(logs["t"], held["I"], held["tau_s"], strict=True)),
        encoding="utf-8",
    )
    proposal = propose([path], {}, tmp_path)
    assert "\x7f" not in proposal.text
    (experiment,) = write(tmp_path, proposal.text).experiments()
    np.testing.assert_allclose(experiment.log["I"], held["I"], atol=1e-5)


def test_an_uneven_clock_is_resampled(tmp_path, logs):
    held, rng = logs["held"], np.random.default_rng(3)
    t = logs["t"] + rng.uniform(0.0, 0.3 / RATE, logs["t"].size)
    path = write_csv(tmp_path / "a.csv", {"t [s]": t, "I [A]": held["I"], "tau_s [N m]": held["tau_s"]})
    problem = write(tmp_path, propose([path], {}, tmp_path).text)
    assert problem.table.experiment[0].resample.rate_hz == pytest.approx(RATE, rel=0.01)
    problem.experiments()


def test_a_log_elsewhere_is_refused_with_the_command(tmp_path, logs):
    (tmp_path / "in").mkdir()
    held = logs["held"]
    path = write_csv(tmp_path / "a.csv", {"t [s]": logs["t"], "I [A]": held["I"], "tau_s [N m]": held["tau_s"]})
    with pytest.raises(so.SeaoptError, match=r"seaopt new .*a.csv -o .*problem.toml"):
        propose([path], {}, tmp_path / "in")


@pytest.mark.parametrize(
    ("names", "match"),
    [
        (
            ("t [s]", "F1 [N]", "F2 [N]"),
            r"no column drives a motor, of F1 \[N\] and F2 \[N\]; name it .*, or log its current",
        ),
        (("time", "time2", "x"), "nothing is measured besides the input, x"),
    ],
)
def test_a_log_without_an_input_or_an_output_is_refused(tmp_path, logs, names, match):
    held = logs["held"]
    path = write_csv(tmp_path / "a.csv", dict(zip(names, (logs["t"], held["I"], held["tau_s"]), strict=True)))
    with pytest.raises(so.SeaoptError, match=match):
        propose([path], {}, tmp_path)


def test_a_comma_before_three_digits_is_asked_about(tmp_path, logs):
    held = logs["held"]
    path = write_csv(tmp_path / "a.csv", {"t [s]": logs["t"], "I [A]": held["I"], "tau_s [N m]": held["tau_s"]})
    with pytest.raises(so.SeaoptError, match=r"may be 1\.000 or 1000"):
        propose([path], {"N": "1,000"}, tmp_path)
    assert "N     = 0.125 " in propose([path], {"N": "0,125"}, tmp_path).text


def test_experiments_get_names_of_their_own(tmp_path, logs):
    held = logs["held"]
    columns = {"t [s]": logs["t"], "I [A]": held["I"], "tau_s [N m]": held["tau_s"]}
    paths = [write_csv(tmp_path / name, columns) for name in ("a_b_2.csv", "a_b.csv", "a b.csv", "a.b.csv")]
    problem = write(tmp_path, propose(paths, {}, tmp_path).text)
    assert [one.name for one in problem.table.experiment] == ["a_b_2", "a_b", "a_b_3", "a_b_4"]


@pytest.mark.parametrize("text", ["note\na\nb\n", "t [s],I [A]\n0,1\n1,1\n2,1\n"])
def test_a_log_in_which_nothing_moves_is_refused(tmp_path, text):
    path = tmp_path / "a.csv"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(so.SeaoptError, match=r"no column"):
        propose([path], {}, tmp_path)


def knee_log(path, *, rate=1000.0, late=0, change=lambda signals: signals):
    """Write the log of a held knee whose command takes effect some samples late, and return what is proposed for it."""
    t, command = drive(10.0, rate, 2.0)
    of = knee(np.concatenate([np.zeros(late), command[: command.size - late]]), rate, locked=True)
    signals = {"cmd_current": command, "theta_m": of["theta_m"], "tau_s": of["tau_s"]}
    units = ("time [s]", "cmd_current [A]", "theta_m [rad]", "tau_s [N m]")
    write_csv(path, dict(zip(units, (t, *change(signals).values()), strict=True)))
    return propose([path], {}, path.parent)


def test_a_delay_that_the_phases_show_is_fitted(tmp_path):
    late, prompt = (knee_log(tmp_path / f"{n}.csv", late=n) for n in (8, 0))
    path = tmp_path / "late.toml"
    path.write_text(late.text, encoding="utf-8")
    delay = so.read_problem(path).experiments()[0].delay_s
    assert delay.free and delay.value == pytest.approx(0.008, abs=2e-3) and delay.max >= 0.02
    assert any("late: delay_s is fitted" in note for note in late.notes)
    assert "# delay_s" in prompt.text and not any("late" in note for note in prompt.notes)


def test_outliers_ask_for_a_loss_that_bears_them(tmp_path):
    def spoil(signals):
        signals["tau_s"][[700, 2500, 4100, 6000, 8000]] += 400.0
        return signals

    spoilt, clean = knee_log(tmp_path / "spoilt.csv", change=spoil), knee_log(tmp_path / "clean.csv")
    path = tmp_path / "spoilt.toml"
    path.write_text(spoilt.text, encoding="utf-8")
    assert so.read_problem(path).table.fit.loss == "huber" and any("5 samples are outliers" in n for n in spoilt.notes)
    assert '# loss = "huber"' in clean.text and not clean.notes


def test_a_log_that_excites_nothing_is_said_to_be_one(tmp_path):
    def mute(signals):
        rng = np.random.default_rng(0)
        return {name: rng.normal(size=values.size) for name, values in signals.items()}

    (note,) = knee_log(tmp_path / "a.csv", change=mute).notes
    assert "no output follows cmd_current [A] linearly" in note


def test_a_motor_that_stands_still_time_and_again_is_offered_friction_that_sticks(tmp_path):
    def stick(signals):
        """Hold the motor for a tenth of a second, where an encoder's reading would stay, a dozen times."""
        for start in range(500, 9000, 700):
            signals["theta_m"][start : start + 100] = signals["theta_m"][start]
        return signals

    proposal = knee_log(tmp_path / "sticks.csv", change=stick)
    assert any("theta_m stands still again and again: friction sticks" in note for note in proposal.notes)
    path = tmp_path / "sticks.toml"
    taken = [line.removeprefix("# ") if "f_s =" in line or "parts =" in line or "sticks =" in line else line
             for line in proposal.text.splitlines()]  # fmt: skip
    path.write_text("\n".join(taken), encoding="utf-8")
    problem = so.read_problem(path)
    assert problem.plants["held"].sticks and problem.parameters["f_s"].value > problem.parameters["f_c"].value > 0


def test_names_are_split_and_an_m_may_be_metres_or_the_motor():
    assert split_words("motorPosition_F1") == ["motor", "position", "f1"]
    assert split_words("/joint.tau_cmd") == ["joint", "tau", "cmd"]
    assert [is_m_open(read_header(name)) for name in ("pos_m", "weg_m", "pos [m]")] == [True, False, False]
    assert (name_entry("unit:F1"), name_entry("N")) == ("unit of F1", "N")


def test_a_survey_leaves_texts_out(tmp_path):
    (tmp_path / "a.csv").write_text("t_ms,cur_mA,note\n0,100,a\n2,150,b\n4,120,c\n")
    survey = survey_log(tmp_path / "a.csv")
    assert survey.clock.name == "t_ms" and survey.left_out == {"note": "text"}
    assert [column.header.quantity for column in survey.columns] == ["current"]


def test_columns_are_compared_by_slope_and_by_slow_motion():
    t = np.arange(4000) / 400
    assert slow_sign(np.sin(t), -np.sin(t - 0.1), 400.0) == -1
    assert regress(3.0 * t + 1.0, t) == pytest.approx((3.0, 1.0))


def test_the_delay_of_an_output_is_that_of_its_samples():
    rng = np.random.default_rng(0)
    u = rng.normal(size=8000)
    y = np.concatenate([np.zeros(5), u[:-5]]) + 0.01 * rng.normal(size=8000)
    delay_s, std = fit_delay(compute_spectra({"u": u, "y": y}, [slice(0, 8000)], 0.001), "u", "y", is_command=False)
    assert std < 1e-4 and delay_s == pytest.approx(0.005, abs=3 * std)
