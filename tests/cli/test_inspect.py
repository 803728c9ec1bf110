"""`seaopt inspect` as a user runs it."""

from __future__ import annotations

import json
import shlex
from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

import seaopt as so
from seaopt.bench import PAPER_STAND
from seaopt.cli.inspect import inspect_log
from seaopt.errors import SeaoptError
from seaopt.problem.proposal.survey import survey_log
from tests.actuator_logs import write_csv


@pytest.fixture(scope="module")
def folder(tmp_path_factory, stand, thor):
    path = tmp_path_factory.mktemp("inspect")
    sensors = so.Sensors(noise_std={"F1": 2.0, "F2": 2.0}, saturation={"F1": 300.0})
    log = so.virtual_log(stand, thor, PAPER_STAND, duration_s=10, rate_hz=400, seed=1, sensors=sensors)
    arrays = log.to_arrays()
    arrays["F2"][100:130] = np.nan
    arrays = {name: np.delete(values, slice(2000, 2100)) for name, values in arrays.items()}
    units = {"I": "A", "F1": "N", "F2": "N"}
    so.write_log(so.Log.from_arrays(units=units, **arrays), path / "bad.csv")
    so.write_log(so.Log.from_arrays(**arrays), path / "bare.csv")
    (path / "twice.csv").write_text("time [s],F1 [N]\n0,1\n0.1,2\n0.1,3\n0.05,4\n0.2,5\n", encoding="utf-8")
    (path / "still.csv").write_text("time [s],F1 [N]\n0,1\n0,2\n0,3\n", encoding="utf-8")
    return path


@pytest.fixture
def inspect(folder, monkeypatch, capsys):
    """Return a call of what the command does; `seaopt` is the command itself."""

    def run(name, *, out=None, **options):
        monkeypatch.chdir(folder)
        inspect_log(Path(name), folder=Path(out) if out else None, **options)
        return capsys.readouterr().out

    return run


def test_what_is_to_be_looked_at_is_said_and_the_exit_code_is_0(seaopt):
    done = seaopt("inspect", "bad.csv")
    assert (done.returncode, done.stderr) == (0, "")
    for words in (
        "3900 samples", "1 gap, 100 samples lost", "F2 lacks 30 samples", "F1 is flat at its largest value, 300 N",
        "the outputs respond to I between",
    ):  # fmt: skip
        assert words in done.stdout


@pytest.mark.parametrize("options", [(), ("--quiet",), ("--json",)])
def test_errors_in_a_log_exit_1(seaopt, options):
    done = seaopt("inspect", "twice.csv", *options)
    assert (done.returncode, done.stderr) == (1, "")
    assert ('"error"' if options == ("--json",) else "3 errors") in done.stdout
    assert seaopt("inspect", "twice.csv", "--list").returncode == 0


def test_json_stands_alone_on_stdout(seaopt):
    arguments = ["--time", "time [s]", "--channel", "cur=I", "--unit", "cur=mA", "--input", "cur", "--json"]
    done = seaopt("inspect", "bare.csv", *arguments)
    content = json.loads(done.stdout)
    assert done.returncode == 0 and content["schema"] == "seaopt/quality/1"
    assert content["inputs"] == ["cur"] and list(content["channels"]) == ["cur"]
    assert content["channels"]["cur"]["unit"] == "A"


def test_the_columns_alone_are_listed(seaopt):
    done = seaopt("inspect", "bare.csv", "--list")
    assert done.returncode == 0 and done.stdout.startswith("bare.csv: CSV")
    assert "time [s]" in done.stdout


def test_bad_input_exits_2(seaopt):
    done = seaopt("inspect", "nothing.csv")
    assert (done.returncode, done.stdout) == (2, "")
    assert "no such file" in done.stderr and done.stderr.count("\n") == 1


def test_figures_of_the_json_are_those_put_in(inspect):
    content = json.loads(inspect("bad.csv", json=True))
    assert content["channels"]["F1"]["rails"][0]["clear"]
    assert content["gaps"] == {"count": 1, "samples_lost": 100, "longest_samples": 100}
    assert content["channels"]["F2"]["missing"] == 30


def test_results_are_written_when_asked(inspect, folder):
    assert "wrote" in inspect("bad.csv", out="made")
    assert json.loads((folder / "made" / "quality.json").read_text(encoding="utf-8"))["source"] == "bad.csv"
    assert (folder / "made" / "quality.svg").stat().st_size > 5000
    assert (folder / "made" / "quality.png").stat().st_size > 5000


def test_a_broken_clock_is_a_finding_and_can_be_drawn(inspect):
    out = inspect("twice.csv", out="twice")
    assert "1 row of 5 with the time of the row ahead" in out
    assert "1 row of 5 with a time before" in out


def test_a_counter_opens_the_gap_that_it_shows(inspect, recorded):
    file = str(recorded("formats") / "acqtools" / "Wmsr2_loss.csv")
    shown = json.loads(inspect(file, json=True))
    opened = json.loads(inspect(file, counter="CH1(msr)=2", json=True))
    assert (shown["gaps"]["count"], opened["gaps"]["count"]) == (0, 1)
    assert [item["kind"] for item in shown["findings"] if item["severity"] == "error"] == ["gap"]


@pytest.mark.parametrize(
    ("name", "options", "words"),
    [
        ("bad.csv", {"channels": ["F1"]}, "NAME=VALUE"),
        ("bad.csv", {"channels": ["F1=F1 [N]", "F1=F2 [N]"]}, "twice"),
        ("bad.csv", {"channels": ["F1=F1 [kN]"]}, 'no column "F1 \\[kN\\]"'),
        ("bad.csv", {"units": ["F1=N"]}, "name its column too"),
        ("bad.csv", {"inputs": ["cur"]}, 'inputs names "cur"'),
        ("bad.csv", {"out": "bad.csv"}, "is a file"),
        ("bad.csv", {"align": "nearest"}, "give hold or linear"),
        ("bad.csv", {"counter": "n=two"}, "how many samples"),
        ("still.csv", {}, "never increases"),
    ],
)
def test_bad_options_are_refused(inspect, name, options, words):
    with pytest.raises(SeaoptError, match=words):
        inspect(name, **options)


ROWS = "0,1\n1,2\n2,4\n3,1\n"


@pytest.mark.parametrize(("step", "unit", "other"), [(0.0025, "s", "ms"), (2.5, "ms", "s"), (2500.0, "us", "s")])
def test_a_clock_called_time_without_unit_has_that_of_the_size_of_its_steps_and_says_so(tmp_path, step, unit, other):
    path = tmp_path / "bare.csv"
    rows = "".join(f"{step * at:.6g},{at % 3}\n" for at in range(40))
    path.write_text("time,F1 [N]\n" + rows, encoding="utf-8")
    inspect_log(path, folder=tmp_path)
    report = json.loads((tmp_path / "quality.json").read_text(encoding="utf-8"))
    assert report["rate_hz"] == pytest.approx(400.0)
    assert f"{unit} was assumed" in report["notes"][0]
    assert f"seaopt inspect {path} --time time --unit time={other}" in report["notes"][0]
    inspect_log(path, units=[f"time={unit}"], folder=tmp_path)
    assert json.loads((tmp_path / "quality.json").read_text(encoding="utf-8"))["rate_hz"] == pytest.approx(400.0)


@pytest.mark.parametrize(
    ("header", "unit"),
    [
        *[(name, "ms") for name in ("Zeit/ms", "Zeit [ms]", "t_ms", "t/ms", "Zeit ms", "log/Zeit/ms")],
        *[(name, "us") for name in ("timestamp_us", "t/\u00b5s", "time_usec")],
        *[(name, "s") for name in ("Time (s)", "Time/s", "time_sec")],
    ],
)  # fmt: skip
def test_a_name_and_a_unit_are_the_clock_however_they_are_joined(tmp_path, header, unit):
    """Even where a counter is named like a time, too; a unit that is given goes before that of the name."""
    path, step = tmp_path / "log.csv", {"s": 0.0025, "ms": 2.5, "us": 2500.0}[unit]
    rows = "".join(f"{7 * at};{step * at:.6g};{at % 3}\n".replace(".", ",") for at in range(40))
    path.write_text(f"clock;{header};Strom/A\n" + rows, encoding="utf-8")
    inspect_log(path, folder=tmp_path)
    report = json.loads((tmp_path / "quality.json").read_text(encoding="utf-8"))
    assert report["rate_hz"] == pytest.approx(400.0)
    assert not any("assumed" in note for note in report["notes"])
    log = so.read_log(path, channels={"I": "Strom/A"})
    assert log.rate_hz == pytest.approx(400.0)
    if "[" not in header and "(" not in header:
        inspect_log(path, time=header, units=["time=s"], folder=tmp_path)
        report = json.loads((tmp_path / "quality.json").read_text(encoding="utf-8"))
        assert report["rate_hz"] == pytest.approx(1.0 / step)


def test_a_column_that_runs_on_is_the_clock_to_type(tmp_path):
    """Milliseconds in a column whose name says nothing, behind one that does not run on."""
    path = tmp_path / "bare.csv"
    rows = "".join(f"{at % 7},{2.5 * at}\n" for at in range(40))
    path.write_text("b,a\n" + rows, encoding="utf-8")
    with pytest.raises(SeaoptError, match="--time a --unit time=ms"):
        inspect_log(path)
    with pytest.raises(SeaoptError, match=r'column = "a", unit = "ms" \(--unit time=ms\)'):
        inspect_log(path, time="a")


def test_a_clock_that_is_not_clear_is_the_command_to_type(tmp_path):
    path = tmp_path / "a log.csv"
    path.write_text("my stamp,F1 [N]\n" + ROWS, encoding="utf-8")
    with pytest.raises(SeaoptError) as raised:
        inspect_log(path)
    command = f"seaopt inspect '{path}' --time 'my stamp' --unit time=ms"
    assert command in str(raised.value) and "\n" not in str(raised.value)
    inspect_log(path, time="my stamp", units=["time=s"])
    with pytest.raises(SeaoptError, match="--unit time=ms"):
        inspect_log(path, time="my stamp")
    inspect_log(path, rate_hz=10.0, folder=tmp_path)
    assert json.loads((tmp_path / "quality.json").read_text(encoding="utf-8"))["rate_hz"] == 10.0


@pytest.mark.parametrize("header", ["F1 [N],tick(ms)", "F1 [N],tick_ms"])
def test_the_command_to_type_has_the_unit_of_the_column_s_name(tmp_path, header):
    path = tmp_path / "ticks.csv"
    path.write_text(f"{header}\n5,0\n6,1\n4,2\n7,3\n", encoding="utf-8")
    with pytest.raises(SeaoptError) as raised:
        inspect_log(path)
    column, unit = shlex.split(str(raised.value).rpartition(" --time ")[2])[::2]
    assert (column, unit) == (header.split(",")[1], "time=ms")
    inspect_log(path, time=column, units=[unit], folder=tmp_path)
    assert json.loads((tmp_path / "quality.json").read_text(encoding="utf-8"))["rate_hz"] == 1000.0


def test_a_clock_that_new_takes_is_taken(tmp_path, capsys):
    path, t = tmp_path / "log.csv", 0.002 * np.arange(400)
    rows = zip(5000.0 + 1e3 * t, 1e3 * np.sin(15.0 * t), 3.0 * np.sin(15.0 * t - 0.2), strict=True)
    path.write_text("\n".join(["uptime_ms,cur_mA,tau_Nm", *(f"{a:.0f},{b:.1f},{c:.3f}" for a, b, c in rows)]))
    assert survey_log(path).clock.name == "uptime_ms"
    inspect_log(path)
    assert "500 Hz" in capsys.readouterr().out


def test_a_temperature_called_t_is_not_the_clock(tmp_path):
    path = tmp_path / "warm.csv"
    rows = "".join(f"{2.5 * at},{at % 3},{20 + at // 30}\n" for at in range(90))
    path.write_text("stamp,I [A],T [C]\n" + rows, encoding="utf-8")
    with pytest.raises(SeaoptError, match="--time stamp --unit time=ms"):
        inspect_log(path)


def test_of_several_clocks_the_one_with_most_samples_is_the_command_to_type(tmp_path):
    """Groups of an MDF file, each with times of its own."""
    mdf = pytest.importorskip("asammdf")
    path = tmp_path / "log.mf4"
    file = mdf.MDF()
    for name, count in (("slow", 40), ("fast", 200)):
        time = np.linspace(0.0, 1.0, count)
        file.append(mdf.Signal(np.sin(time), time, name=name, unit="A"))
    file.save(path, overwrite=True)
    with pytest.raises(SeaoptError, match="holds several clocks") as raised:
        inspect_log(path)
    command = shlex.split(str(raised.value).rpartition("; type ")[2])
    assert command[:3] == ["seaopt", "inspect", str(path)]
    inspect_log(path, time=command[command.index("--time") + 1], align="linear", folder=tmp_path)
    assert json.loads((tmp_path / "quality.json").read_text(encoding="utf-8"))["samples"] == 200


def test_numbers_beside_a_log_are_noted_as_such(tmp_path):
    path = tmp_path / "run.mat"
    savemat(path, {"time": np.arange(50) / 400, "I": np.sin(np.arange(50.0)), "K_t": 0.03})
    inspect_log(path, folder=tmp_path)
    notes = json.loads((tmp_path / "quality.json").read_text(encoding="utf-8"))["notes"]
    assert any("not as long as" in note and "K_t" in note for note in notes) and not any("clocks" in n for n in notes)


def test_of_a_file_without_a_clock_the_rate_is_asked_for(tmp_path):
    path = tmp_path / "wave.csv"
    path.write_text("a,b\n" + "".join(f"{at % 7},{at % 3}\n" for at in range(40)), encoding="utf-8")
    with pytest.raises(SeaoptError, match=r"type seaopt inspect \S+ --rate-hz 1000"):
        inspect_log(path)


def test_units_at_the_end_of_names_are_taken_and_no_output_is_proposed_as_an_input(tmp_path):
    time = np.arange(4000) / 1000
    current = np.random.default_rng(1).normal(size=time.size)
    angle = np.where((time > 2.0) & (time < 2.2), 20.0, 20.0 + 5.0 * np.sin(8.0 * time))
    columns = {"time_s": time, "i_cmd_A": current, "motor_angle_deg": angle, "pos_m": angle}
    write_csv(tmp_path / "log.csv", columns)
    inspect_log(tmp_path / "log.csv", folder=tmp_path)
    quality = json.loads((tmp_path / "quality.json").read_text(encoding="utf-8"))
    units = {name: channel["unit"] for name, channel in quality["channels"].items()}
    assert units == {"i_cmd_A": "A", "motor_angle_deg": "rad", "pos_m": ""}
    assert quality["inputs"] == ["i_cmd_A"]
    assert quality["channels"]["motor_angle_deg"]["high"] == pytest.approx(np.deg2rad(angle.max()))
    assert any("deg of motor_angle_deg" in note for note in quality["notes"])
    stuck = [each["sentence"] for each in quality["findings"] if each["kind"] == "stuck"]
    assert stuck and not any("--input" in sentence for sentence in stuck)


def test_a_column_named_with_its_unit_needs_no_other(tmp_path):
    write_csv(tmp_path / "log.csv", {"time_ms": np.arange(50.0), "i_mA": np.arange(50.0), "theta_m": np.arange(50.0)})
    log = so.read_log(tmp_path / "log.csv", time="time_ms", channels={"I": "i_mA"})
    assert log.signals["I"].unit == "A" and log["I"][-1] == pytest.approx(0.049) and log.period == pytest.approx(1e-3)
    with pytest.raises(SeaoptError, match=r"theta_m.* has no unit"):
        so.read_log(tmp_path / "log.csv", time="time_ms", channels={"q": "theta_m"})
