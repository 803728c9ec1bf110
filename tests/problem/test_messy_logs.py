"""Problem files proposed for logs as devices and people write them: scalars beside the log, clocks, estimates."""

from __future__ import annotations

import math

import h5py
import numpy as np
import pytest
import scipy.io

import seaopt as so
from seaopt.errors import SeaoptError
from seaopt.problem.proposal import propose
from tests.actuator_logs import drive, knee, write_csv

RATE = 400.0


@pytest.fixture(scope="module")
def held():
    """Return times and channels of a held knee."""
    t, current = drive(6.0, RATE, 2.0)
    return t, knee(current, RATE, locked=True)


def roles_of(proposal):
    return {row.role: row.column for row in proposal.columns if row.role}


def unused_of(proposal):
    return {row.column: row.description for row in proposal.columns if not row.role}


def read_back(folder, proposal):
    """Return the experiments of a proposal's file, read."""
    path = folder / "problem.toml"
    path.write_text(proposal.text, encoding="utf-8")
    return so.read_problem(path).experiments()


def write_v5(path, content):
    scipy.io.savemat(path, {"log": content})


def write_v73(path, content):
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, values in content.items():
            file.create_dataset(f"log/{name}", data=np.atleast_2d(np.asarray(values, float)))
    with path.open("r+b") as stream:
        stream.write(b"MATLAB 7.3 MAT-file, made by a test".ljust(124) + b"\x00\x02IM")


@pytest.mark.parametrize("write", [write_v5, write_v73])
@pytest.mark.parametrize("timed", [True, False])
def test_numbers_beside_the_log_of_a_matlab_file_are_left_out(tmp_path, held, write, timed):
    t, of = held
    content = {"fs": RATE, "K_t": 0.037, "gains": [1.0, 2.0, 3.0], "current": of["I"], "torque_sensor": of["tau_s"]}
    write(tmp_path / "run.mat", content | ({"time": t} if timed else {}))
    answers = {} if timed else {"rate:run.mat": "400"}
    proposal = propose([tmp_path / "run.mat"], answers, tmp_path)
    expected = {"input": "log.current", "tau_s": "log.torque_sensor"} | ({"time": "log.time"} if timed else {})
    assert roles_of(proposal) == expected
    assert "one number" in unused_of(proposal)["log.K_t"] and "3 samples" in unused_of(proposal)["log.gains"]
    (experiment,) = read_back(tmp_path, proposal)
    assert len(experiment.log) == t.size and experiment.log.rate_hz == pytest.approx(RATE)


def test_two_tables_side_by_side_are_brought_to_the_faster_clock(tmp_path, held):
    """A drive at 400 Hz, and a cell at 150 Hz that began 0.1 s later."""
    t, of = held
    slow = np.arange(0.1, 5.9, 1 / 150.0)
    torque = np.interp(slow, t, of["tau_s"])
    fill = [""] * (t.size - slow.size)
    rows = zip(t, of["I"], [*slow, *fill], [*torque, *fill], strict=True)
    text = "t_drive [s],I [A],t_cell [ms],cell [N m]\n" + "".join(
        f"{a:.6f},{b:.9g},{1e3 * c if c != '' else ''},{d}\n" for a, b, c, d in rows
    )
    (tmp_path / "two.csv").write_text(text, encoding="utf-8")
    proposal = propose([tmp_path / "two.csv"], {}, tmp_path)
    assert roles_of(proposal) == {"time": "t_drive [s]", "input": "I [A]", "tau_s": "cell [N m]"}
    (experiment,) = read_back(tmp_path, proposal)
    log = experiment.log
    assert log.rate_hz == pytest.approx(RATE) and log.time[0] >= 0.1 and log.time[-1] <= slow[-1]
    read = np.isfinite(log["tau_s"])
    assert np.count_nonzero(read) == slow.size
    scale = np.std(of["tau_s"])
    np.testing.assert_allclose(log["tau_s"][read], np.interp(log.time[read], t, of["tau_s"]), atol=0.02 * scale)


def test_rows_that_devices_fill_in_turn_are_joined(tmp_path, held):
    t, of = held
    rows = np.arange(t.size)
    current, torque = (np.where(rows % 2 == first, of[name], np.nan) for first, name in ((0, "I"), (1, "tau_s")))
    write_csv(tmp_path / "turns.csv", {"t [s]": t, "I [A]": current, "tau_s [Nm]": torque})
    proposal = propose([tmp_path / "turns.csv"], {}, tmp_path)
    assert "bridge_s" in proposal.text
    (experiment,) = read_back(tmp_path, proposal)
    np.testing.assert_allclose(experiment.log["I"][::2], of["I"][::2], atol=1e-6)
    assert np.all(np.isfinite(experiment.log["I"]))


def test_rows_that_devices_fill_in_turn_with_a_lag_are_no_rounded_clock(tmp_path, held):
    """Steps of 0.8 and 1.2 periods are those of rounded stamps, too, but for the rows that each device leaves empty."""
    t, of = held
    rows = np.arange(t.size)
    columns = {
        name: np.where(rows % 2 == first, of[source], np.nan)
        for name, source, first in (("I [A]", "I", 0), ("tau_s [Nm]", "tau_s", 1))
    }
    path = write_csv(tmp_path / "lag.csv", {"t [s]": t + 0.2 * np.mean(np.diff(t)) * (rows % 2), **columns})
    proposal = propose([path], {}, tmp_path)
    assert "rule = { readings = {} }" in proposal.text and "restamp" not in proposal.text
    (experiment,) = read_back(tmp_path, proposal)
    assert np.all(np.isfinite(experiment.log["I"]))
    assert np.count_nonzero(np.isfinite(experiment.log["tau_s"])) == pytest.approx(t.size / 2, abs=2)
    faults = so.read_log(path, time="t [s]", channels={"I": "I [A]", "tau_s": "tau_s [Nm]"}).quality.of("jitter")
    assert faults[0].keys[0]["resample"]["rule"] == {"readings": {}} and "restamp" not in faults[0].sentence


@pytest.mark.parametrize("every", [4, 7])
def test_noise_of_a_sensor_on_a_clock_of_its_own_is_that_of_its_readings(tmp_path, held, every):
    t, of = held
    own, noise = t[::every], np.random.default_rng(0).normal(scale=0.05, size=t[::every].size)
    pad = np.full(t.size - own.size, np.nan)
    columns = {"t_cell [s]": np.append(own, pad), "tau_s [Nm]": np.append(of["tau_s"][::every] + noise, pad)}
    write_csv(tmp_path / "cell.csv", {"t_drive [s]": t, "I [A]": of["I"], **columns})
    text = propose([tmp_path / "cell.csv"], {}, tmp_path).text
    measured = float(text.split("noise_std = { tau_s = ")[1].split(" ")[0])
    assert 0.03 < measured < 0.3  # of lines between them: 0.002


def test_two_clocks_of_a_matlab_file_are_brought_together(tmp_path, held):
    t, of = held
    slow = np.arange(0.1, 5.9, 1 / 150.0)
    content = {"t_cell": slow, "cell_torque": np.interp(slow, t, of["tau_s"]), "t_drive": t, "iq": of["I"], "Kt": 0.03}
    write_v5(tmp_path / "two.mat", content)
    proposal = propose([tmp_path / "two.mat"], {}, tmp_path)
    assert roles_of(proposal) == {"time": "log.t_drive", "input": "log.iq", "tau_s": "log.cell_torque"}
    (experiment,) = read_back(tmp_path, proposal)
    assert experiment.log.rate_hz == pytest.approx(RATE)
    assert np.count_nonzero(np.isfinite(experiment.log["tau_s"])) == pytest.approx(slow.size, abs=2)


def test_a_sensor_of_a_faster_clock_loses_no_readings_without_a_word(tmp_path, held):
    """Of a cell that began late the samples are fewer, and yet twice as fast: lines go through all."""
    t, of = held
    fast = np.arange(4.0, 5.9, 0.5 / RATE)
    content = {"t_cell": fast, "cell_torque": np.interp(fast, t, of["tau_s"]), "t_drive": t, "iq": of["I"]}
    write_v5(tmp_path / "two.mat", content)
    proposal = propose([tmp_path / "two.mat"], {}, tmp_path)
    assert roles_of(proposal) == {"time": "log.t_drive", "input": "log.iq", "tau_s": "log.cell_torque"}
    assert "linear = {}" in proposal.text and "readings" not in proposal.text
    (experiment,) = read_back(tmp_path, proposal)
    assert np.all(np.isfinite(experiment.log["tau_s"]))


def test_a_torque_that_is_a_constant_times_the_current_is_no_sensor(tmp_path, held):
    """A drive reports 0.1095 times its current, to four digits; the transducer's name says less."""
    t, of = held
    columns = {"t [s]": t, "iq [A]": of["I"], "joint_torque [N m]": np.round(0.1095 * of["I"], 4),
               "transducer [N m]": of["tau_s"], "theta_m [rad]": of["theta_m"]}  # fmt: skip
    proposal = propose([write_csv(tmp_path / "drive.csv", columns)], {}, tmp_path)
    assert roles_of(proposal)["tau_s"] == "transducer [N m]"
    assert "0.1095 times iq [A]" in unused_of(proposal)["joint_torque [N m]"]
    del columns["transducer [N m]"]
    alone = propose([write_csv(tmp_path / "alone.csv", columns)], {}, tmp_path)
    assert "tau_s" not in roles_of(alone)


def test_a_supply_is_no_input(tmp_path, held):
    """A servo logs its supply in volts: it never comes near zero."""
    t, of = held
    columns = {"timestamp": t, "position": of["theta_m"], "input_volts": 7.4 + 0.05 * np.abs(of["I"]),
               "goal_position": of["I"]}  # fmt: skip
    proposal = propose([write_csv(tmp_path / "servo.csv", columns)], {}, tmp_path)
    assert roles_of(proposal)["input"] == "goal_position"
    assert "supply" in unused_of(proposal)["input_volts"]


def test_a_temperature_in_degrees_is_no_charge(tmp_path, held):
    t, of = held
    path = write_csv(
        tmp_path / "warm.csv",
        {"t [s]": t, "I [A]": of["I"], "tau [N m]": of["tau_s"], "case [C]": 30 + t, "T_w [C]": 20 + 0.1 * t**2},
    )
    unused = unused_of(propose([path], {}, tmp_path))
    assert unused["case [C]"] == unused["T_w [C]"] == "not used: not a signal of the actuator"
    assert so.logs.read_table(path).signals["case"].unit == "degC"


def test_round_brackets_that_are_names_are_no_units(tmp_path, held):
    """As an oscilloscope writes them: msr is a counter, and no milli-steradian."""
    t, of = held
    columns = {"Time[usec]": 1e6 * t, "CH1(msr)": np.arange(t.size) % 50, "CH2(iq_ad)": of["I"],
               "CH3(torque_cell)": of["tau_s"], "CH4(vel_ta)": np.gradient(of["theta_m"])}  # fmt: skip
    roles = roles_of(propose([write_csv(tmp_path / "scope.csv", columns)], {}, tmp_path))
    assert roles == {"time": "Time[usec]", "input": "CH2(iq_ad)", "tau_s": "CH3(torque_cell)"}


def test_columns_can_be_named_by_their_roles(tmp_path, held):
    """Names that say nothing, and one that says the wrong thing."""
    t, of = held
    columns = {
        "n": np.arange(t.size),
        "stamp_b": 1e3 * t,
        "a1": of["I"],
        "force_x": 1e3 * of["tau_s"],
        "a2": of["theta_m"],
    }
    path = write_csv(tmp_path / "bare.csv", columns)
    named = {"time": "stamp_b", "I": "a1", "tau_s": "force_x", "theta_m": "a2"}
    proposal = propose([path], {}, tmp_path, columns=named, units={"tau_s": "mN m", "time": "ms"})
    assert roles_of(proposal) == {"time": "stamp_b", "input": "a1", "tau_s": "force_x", "theta_m": "a2"}
    assert not {"roles", "unit of force_x", "unit of stamp_b", "role of a1"} & set(proposal.guessed)
    (experiment,) = read_back(tmp_path, proposal)
    np.testing.assert_allclose(experiment.log["tau_s"], of["tau_s"], rtol=1e-6, atol=1e-9)
    assert experiment.log.rate_hz == pytest.approx(RATE)


def test_a_current_in_steps_of_its_converter_is_asked_for_their_size(tmp_path, held):
    """Not as an angle's steps of a turn; headers as a German drive writes them."""
    t, of = held
    steps = np.round(of["I"] / 0.01)
    columns = {"t [s]": t, "Stromsollwert (Inkr.)": steps, "Motorlage (Inkr.)": np.round(1e3 * of["theta_m"])}
    path = write_csv(tmp_path / "log.csv", columns | {"Federmoment [N cm]": 100 * of["tau_s"]})
    answers = {"counts:Stromsollwert (Inkr.)": "0.01", "counts:Motorlage (Inkr.)": f"{2000 * np.pi}"}
    proposal = propose([path], answers, tmp_path)
    assert 'One step of "Stromsollwert (Inkr.)", in A' in [question.text for question in proposal.questions]
    (experiment,) = read_back(tmp_path, proposal)
    np.testing.assert_allclose(experiment.log["I"], 0.01 * steps, rtol=1e-9)
    np.testing.assert_allclose(experiment.log["theta_m"], of["theta_m"], atol=6e-4)
    assert "counts of Stromsollwert (Inkr.)" in propose([path], {}, tmp_path).guessed


def test_a_column_that_only_some_logs_have_can_be_named(tmp_path, held):
    t, of = held
    bare = {"t [s]": t, "a1": of["I"], "a2": of["tau_s"]}
    paths = [write_csv(tmp_path / "held.csv", bare), write_csv(tmp_path / "free.csv", bare | {"a3": of["theta_m"]})]
    named = {"I": "a1", "tau_s": "a2", "theta_m": "a3"}
    proposal = propose(paths, {}, tmp_path, columns=named, units={"theta_m": "rad"})
    first, second = read_back(tmp_path, proposal)
    assert (set(first.outputs), set(second.outputs)) == ({"tau_s"}, {"tau_s", "theta_m"})


@pytest.mark.parametrize(
    ("columns", "units", "words"),
    [
        ({"I": "a3"}, {}, 'no column "a3" for I'),
        ({"tau": "a1"}, {}, 'did you mean "tau_s"'),
        ({"time": "a3"}, {}, 'no column "a3" for time'),
        ({"tau_s": "a1"}, {"tau_s": "N"}, "tau_s is in N m"),
        ({"I": "a1"}, {"F1": "N"}, "--channel F1=COLUMN"),
        ({"I": "a1", "tau_s": "a1"}, {}, "a1 is both I and tau_s"),
        ({"I": "a1", "V": "a2"}, {}, "one input"),
    ],
)
def test_a_column_that_is_named_wrong_is_refused(tmp_path, held, columns, units, words):
    t, of = held
    path = write_csv(tmp_path / "bare.csv", {"time [s]": t, "a1": of["I"], "a2": of["tau_s"]})
    with pytest.raises(SeaoptError, match=words) as raised:
        propose([path], {}, tmp_path, columns=columns, units=units)
    assert "\n" not in str(raised.value)


def test_a_clock_of_two_steps_is_resampled_at_its_mean_rate(tmp_path):
    """Steps of 2.7 and 10 ms in turn, without a word on the unit."""
    step = np.tile([2.7e-3, 10e-3, 2.7e-3], 500)
    t = np.cumsum(step)
    columns = {"t": t, "I [A]": np.sin(9 * t) + np.sin(31 * t), "tau_s [N m]": np.cos(9 * t)}
    proposal = propose([write_csv(tmp_path / "two.csv", columns)], {}, tmp_path)
    assert f"resample = {{ rate_hz = {1 / np.mean(step):.3g}" in proposal.text
    (experiment,) = read_back(tmp_path, proposal)
    assert len(experiment.log.segments) == 1


def test_a_log_of_few_samples_is_said_to_be_one(tmp_path):
    t = np.arange(27) / 25e3
    columns = {"t [s]": t, "I [A]": np.sin(2 * math.pi * 4e3 * t), "tau_s [N m]": np.cos(2 * math.pi * 4e3 * t)}
    (note,) = propose([write_csv(tmp_path / "short.csv", columns)], {}, tmp_path).notes
    assert "27 samples" in note


def test_angles_without_units_are_judged_by_how_far_they_move(tmp_path, held):
    """An encoder that began a turn away from zero, in radians."""
    t, of = held
    columns = {"t [s]": t, "iq [A]": of["I"], "theta_m": of["theta_m"], "theta_load": 0.03 * np.sin(t) - 7.5}
    proposal = propose([write_csv(tmp_path / "turned.csv", columns)], {}, tmp_path)
    assert {row.role: row.unit for row in proposal.columns}["theta_l"] == "rad"


def test_noise_and_steps_of_the_sensor_are_written_and_limit_the_noise_gain(tmp_path, held):
    """Noise of 0.3 N m ahead of a converter of 0.5 N m: noise moves the motor by a quarter of the largest effort."""
    t, of = held
    rng = np.random.default_rng(2)
    read = np.round((of["tau_s"] + 0.3 * rng.normal(size=t.size)) / 0.5) * 0.5
    path = write_csv(tmp_path / "coarse.csv", {"t [s]": t, "I [A]": of["I"], "tau_s [N m]": read})
    proposal = propose([path], {"bandwidth_hz": "20"}, tmp_path)
    (tmp_path / "problem.toml").write_text(proposal.text, encoding="utf-8")
    problem = so.read_problem(tmp_path / "problem.toml")
    sensors = problem.robustness.sensors
    assert sensors.quantisation["tau_s"] == pytest.approx(0.5, rel=1e-3)
    assert sensors.noise_std["tau_s"] == pytest.approx(0.3, rel=0.15)
    total = math.hypot(0.3, 0.5 / math.sqrt(12.0))
    low, high = np.quantile(read, [0.01, 0.99])
    assert problem.spec.max_noise_gain == pytest.approx(0.25 * 0.5 * (high - low) / total, rel=0.1)
    assert problem.spec.max_noise_gain < 50


def test_steps_of_two_encoders_are_their_own(tmp_path):
    t, current = drive(6.0, RATE, 2.0)
    of = knee(current, RATE)
    turn = 2 * math.pi
    columns = {"t [s]": t, "I [A]": of["I"], "motor [rad]": np.round(of["theta_m"] / turn * 4096) / 4096 * turn,
               "link [rad]": np.round(of["theta_l"] / turn * 65536) / 65536 * turn}  # fmt: skip
    proposal = propose([write_csv(tmp_path / "two.csv", columns)], {"N": "100", "k_s": "300"}, tmp_path)
    (tmp_path / "problem.toml").write_text(proposal.text, encoding="utf-8")
    problem = so.read_problem(tmp_path / "problem.toml")
    assert problem.controller_table.measured == "tau_d"
    steps = problem.robustness.sensors.quantisation
    assert steps["theta_m"] == pytest.approx(turn / 4096, rel=1e-3)
    assert "theta_l" not in steps or steps["theta_l"] == pytest.approx(turn / 65536, rel=1e-2)


def test_a_second_log_at_half_the_amplitude_is_offered(tmp_path):
    """Uncommented, the lines read a log of that name, which the fit is scored on."""
    t, current = drive(10.0, RATE, 2.0)
    for name, amplitude in (("run.csv", 1.0), ("run_half.csv", 0.5)):
        of = knee(np.concatenate([np.zeros(8), amplitude * current[:-8]]), RATE, locked=True)
        write_csv(tmp_path / name, {"t [s]": t, "cmd [A]": amplitude * current, "theta_m [rad]": of["theta_m"],
                                    "tau_s [N m]": of["tau_s"]})  # fmt: skip
    text = propose([tmp_path / "run.csv"], {"N": "100", "K_tau": "0.037"}, tmp_path).text
    assert "half the amplitude" in text and "delay_s = {" in text
    head, first, second = text.partition("# [[experiment]]")
    block, blank, rest = (first + second).partition("\n\n")
    assert all(line.startswith("# ") for line in block.splitlines())
    lines = "\n".join(line.removeprefix("# ") for line in block.splitlines())
    (tmp_path / "problem.toml").write_text(head + lines + blank + rest, encoding="utf-8")
    problem = so.read_problem(tmp_path / "problem.toml")
    fitted, scored = problem.experiments()
    assert (scored.name, problem.choose_fitted((fitted, scored))) == ("run_half", (fitted,))
    assert np.std(scored.log["I"]) == pytest.approx(0.5 * np.std(fitted.log["I"]))
    several = propose([tmp_path / "run.csv", tmp_path / "run_half.csv"], {}, tmp_path).text
    assert "half the amplitude" not in several


def test_signals_of_one_sample_less_than_their_time_are_named(tmp_path, held):
    """As where differences were saved beside the time that they were taken of."""
    t, of = held
    write_v5(tmp_path / "run.mat", {"time": t, "iq": of["I"][1:], "tau": of["tau_s"][1:]})
    with pytest.raises(SeaoptError, match=r'log.iq and log.tau have other numbers of samples than "log.time" \(2400\)'):
        propose([tmp_path / "run.mat"], {}, tmp_path)


@pytest.mark.parametrize("names", [("theta_x", "theta_y"), ("theta_y", "theta_x")])
def test_without_a_gear_the_motor_is_what_the_current_moves_at_once(tmp_path, names):
    """Two masses and a shaft: both angles swing alike, and their names do not say which is which."""
    t, current = drive(6.0, 1000.0, 2.0, top_hz=150.0)
    of = knee(current, 1000.0, N=1.0, J_m=1e-3, J_l=2e-3, k_s=100.0, K_tau=0.5, f_c=0.0, b_r=1e-2, d_l=0.02, noise=0.1)
    columns = {"t [s]": t, "iq [A]": of["I"], f"{names[0]} [rad]": of["theta_m"], f"{names[1]} [rad]": of["theta_l"]}
    assert np.std(of["theta_l"]) > 0.8 * np.std(of["theta_m"])
    roles = roles_of(propose([write_csv(tmp_path / "shaft.csv", columns)], {}, tmp_path))
    assert (roles["theta_m"], roles["theta_l"]) == (f"{names[0]} [rad]", f"{names[1]} [rad]")
