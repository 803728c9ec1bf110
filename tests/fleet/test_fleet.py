"""One fit per log: against the fit alone, with bad logs among them, taken up again, and on the command line."""

from __future__ import annotations

import json
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext

import polars as pl
import pytest

import seaopt as so
from seaopt.errors import FileError, LogError, ProblemError, SeaoptError
from seaopt.files import write_json
from seaopt.fleet import FleetLog, find_logs, read_fleet, read_manifest
from seaopt.fleet.plan import make_plan
from seaopt.fleet.table import FleetTable
from seaopt.logs import assess_quality, read_table
from tests.fleet.conftest import LOGS, PROBLEM, compare, write_log

IDENTITY = "{robot}_{joint}.csv"


@pytest.fixture(scope="module")
def threads():
    with ThreadPoolExecutor(2) as executor:
        yield executor


@pytest.fixture(scope="module")
def whole(made, threads):
    return so.fit_fleet(made / "stand.toml", [made / "logs/*.csv"], executor=threads, identity=IDENTITY)


def test_a_row_is_the_fit_of_its_log_alone(made, whole):
    assert whole.met and whole.counts == {"met": LOGS, "not met": 0, "failed": 0}
    row = whole.rows.row(by_predicate=pl.col("log").str.ends_with("r1_j2.csv"), named=True)
    log = so.read_log(
        made / "logs/r1_j2.csv", time="time [s]", channels={"I": so.Column(column="I [A]"), "F1": "F1 [N]"}
    )
    experiment = so.Experiment(plant=so.plants.high_impedance(), log=log, outputs=("F1",))
    alone = so.fit([experiment], so.plants.thor().update(J=2e-6, b_r=2e-4).free("J", "b_r"))
    for name in ("J", "b_r"):
        assert row[name] == pytest.approx(alone.parameters[name].value, rel=1e-9)
        assert row[f"{name}_std"] == pytest.approx(alone.parameters[name].std, rel=1e-6)
    assert row["m_k_std"] == pytest.approx(alone.derived["m_k"].std, rel=1e-6)
    assert (row["robot"], row["joint"]) == ("r1", "j2")
    assert row["J"] == pytest.approx(3.31e-6 * 1.06, rel=0.02)


def test_the_spread_over_the_fleet(whole):
    spread = {one.name: one for one in whole.spreads}["J"]
    assert spread.median == pytest.approx(whole.rows["J"].median()) and spread.logs == LOGS
    assert spread.low < spread.median < spread.high
    assert "12 logs, all met" in repr(whole)


def test_one_bad_log_is_a_row_with_its_reason(stand, threads, whole, made):
    logs = stand / "logs"
    (logs / "r3_j0.csv").write_text("no numbers here\n", encoding="utf-8")
    text = (logs / "r0_j0.csv").read_text(encoding="utf-8")
    (logs / "r3_j1.csv").write_text(text[:300], encoding="utf-8")
    (logs / "r3_j2.csv").write_bytes(b"\x89HDF\r\n\x1a\n" + b"\0" * 50)
    paths = [logs / "*.csv", logs / "r3_gone.csv"]
    fleet = so.fit_fleet(stand / "stand.toml", paths, executor=threads, identity=IDENTITY)
    assert not fleet.met and len(fleet.rows) == LOGS + 4
    bad = fleet.rows.filter(pl.col("status") != "met")
    assert all(bad["reason"].str.len_chars() > 10)
    assert {path.rpartition("_")[2] for path in bad["log"]} == {"j0.csv", "j1.csv", "j2.csv", "gone.csv"}
    assert sum(count for _, count, _ in fleet.reasons) == 4
    compare(fleet.rows.filter(pl.col("status") == "met"), whole.rows, (stand, made))


def test_a_second_run_fits_what_is_new_failed_or_changed(stand, threads):
    problem, logs, out = stand / "stand.toml", stand / "logs", stand / "out"
    (logs / "r0_j3.csv").write_text("junk", encoding="utf-8")

    def run():
        return so.fit_fleet(problem, [logs / "*.csv"], out, executor=threads, identity=IDENTITY)

    first = run()
    assert (first.unchanged, first.counts["failed"]) == (0, 1)
    again = run()
    assert again.unchanged == LOGS - 1
    compare(first.rows, again.rows)
    write_log(logs / "r0_j3.csv", 3)
    write_log(logs / "r0_j0.csv", 0, J=5e-6)
    write_log(logs / "r9_j0.csv", 9)
    third = run()
    assert third.unchanged == LOGS - 2 and third.met and len(third.rows) == LOGS + 1
    assert third.rows["J"][0] == pytest.approx(5e-6, rel=0.05)
    assert pl.read_parquet(out / "fleet").equals(third.rows)
    problem.write_text(PROBLEM.replace("value = 2e-4", "value = 3e-4"), encoding="utf-8")
    assert run().unchanged == 0
    assert len(pl.read_parquet(out / "fleet")) == LOGS + 1


def test_drift_stays_in_fleet_json_until_a_log_changes(stand, threads):
    so.fit_fleet(stand / "stand.toml", [stand / "logs/r0_*.csv"], stand / "out", executor=threads)
    path = stand / "out" / "fleet.json"
    write_json(path, json.loads(path.read_text()) | {"drift": {"alarms": []}})
    so.fit_fleet(stand / "stand.toml", [stand / "logs/r0_*.csv"], stand / "out", executor=threads)
    assert json.loads(path.read_text())["drift"] == {"alarms": []}
    so.fit_fleet(stand / "stand.toml", [stand / "logs/r0_j0.csv"], stand / "out", executor=threads)
    assert "drift" not in json.loads(path.read_text())


def test_other_logs_of_the_table_stay_and_identities_are_renewed(stand, threads):
    problem, logs, out = stand / "stand.toml", stand / "logs", stand / "out"
    so.fit_fleet(problem, [logs / "r0_*.csv"], out, executor=threads)
    fleet = so.fit_fleet(problem, [logs / "r0_j0.csv", logs / "r1_*.csv"], out, executor=threads, identity=IDENTITY)
    assert (len(fleet.rows), fleet.unchanged) == (5, 1)
    assert fleet.rows["robot"].to_list() == ["r0", "r1", "r1", "r1", "r1"]
    assert len(pl.read_parquet(out / "fleet")) == 8


def test_what_tuning_asks_does_not_fit_again(stand, threads):
    problem, out = stand / "stand.toml", stand / "out"
    so.fit_fleet(problem, [stand / "logs/r0_j0.csv"], out, executor=threads)
    text = PROBLEM + '[controller]\nplant = "stand"\nmeasured = "F1"\nbandwidth_hz = 30\n'
    problem.write_text(text, encoding="utf-8")
    assert so.fit_fleet(problem, [stand / "logs/r0_j0.csv"], out, executor=threads).unchanged == 1


def test_free_values_of_a_log_have_columns(stand, threads):
    own = (
        PROBLEM
        + "delay_s = { value = 0.0, free = true, max = 0.01 }\nparameters = { eta = { value = 0.9, free = true } }\n"
    )
    (stand / "stand.toml").write_text(own, encoding="utf-8")
    fleet = so.fit_fleet(stand / "stand.toml", [stand / "logs/r0_j0.csv"], executor=threads)
    row = fleet.rows.row(0, named=True)
    assert abs(row["delay_s"]) < 4 * row["delay_s_std"] + 1e-4 and row["eta_std"] > 0
    assert fleet.units["eta"] == "-" and row["fit_status"] == "converged"


def test_the_slice_of_the_experiment_is_every_log_s(stand, threads):
    (stand / "stand.toml").write_text(PROBLEM + "slice_s = [0.0, 1.0]\n", encoding="utf-8")
    fleet = so.fit_fleet(stand / "stand.toml", [stand / "logs/r0_j0.csv"], executor=threads)
    assert fleet.rows["samples"][0] == pytest.approx(400, abs=1)


def test_a_manifest_names_logs_and_whose_they_are(stand, threads):
    (stand / "list.csv").write_text("actuator,log,when\nknee,logs/r0_j0.csv,2026-01-01\nhip,logs/r0_j1.csv,\n")
    logs = read_manifest(stand / "list.csv")
    assert logs[0] == FleetLog(path=str(stand / "logs/r0_j0.csv"), identity={"actuator": "knee", "when": "2026-01-01"})
    fleet = so.fit_fleet(stand / "stand.toml", logs, executor=threads)
    assert fleet.rows["actuator"].to_list() == ["knee", "hip"] and fleet.met


def test_logs_lie_at_addresses(stand, threads):
    fsspec = pytest.importorskip("fsspec")
    memory = fsspec.filesystem("memory")
    for name in ("r0_j0", "r0_j1"):
        memory.pipe(f"/bucket/{name}.csv", (stand / f"logs/{name}.csv").read_bytes())
    logs = ["memory://bucket/*.csv", "memory://bucket/gone.csv", (stand / "logs/r0_j0.csv").as_uri()]
    fleet = so.fit_fleet(stand / "stand.toml", logs, executor=threads)
    assert fleet.counts == {"met": 3, "not met": 0, "failed": 1}
    rows = {row["log"]: row for row in fleet.rows.iter_rows(named=True)}
    local = next(row["J"] for path, row in rows.items() if path.startswith("file://"))
    assert [row["J"] for path, row in rows.items() if path.endswith("/r0_j0.csv")] == [local, local]
    assert "cannot be fetched" in rows["memory://bucket/gone.csv"]["reason"]


@pytest.mark.parametrize(
    ("change", "error"),
    [
        ({"logs": []}, LogError),
        ({"logs": ["logs"]}, LogError),
        ({"logs": ["logs/*.mat"]}, LogError),
        ({"identity": "{robot}.mat"}, LogError),
        ({"identity": "robot"}, LogError),
        ({"identity": "{status}.csv"}, LogError),
        ({"like": "other"}, ProblemError),
        ({"time_limit_s": 0.0}, SeaoptError),
        ({"logs": [FleetLog(path="/a"), "b.csv"]}, LogError),
    ],
)
def test_what_is_refused(made, threads, monkeypatch, change, error):
    monkeypatch.chdir(made)
    options = {"logs": ["logs/r0_*.csv"], "executor": threads} | change
    with pytest.raises(error):
        so.fit_fleet("stand.toml", options.pop("logs"), **options)


def test_a_template_of_several_files_is_refused(stand, threads):
    text = PROBLEM.replace('F1 = "F1 [N]"', 'F1 = { column = "F1 [N]", file = "logs/r0_j1.csv" }')
    (stand / "stand.toml").write_text(text, encoding="utf-8")
    with pytest.raises(ProblemError, match="several files"):
        so.fit_fleet(stand / "stand.toml", [stand / "logs/r0_j0.csv"], executor=threads)


def test_two_at_one_table_is_refused(stand, threads):
    problem = so.read_problem(stand / "stand.toml")
    table = FleetTable(stand / "out", {"log": pl.String}, make_plan(problem, None, None, "another"))
    try:
        with pytest.raises(FileError, match="another fleet"):
            so.fit_fleet(stand / "stand.toml", [stand / "logs/r0_j0.csv"], stand / "out", executor=threads)
    finally:
        table.close()
    assert so.fit_fleet(stand / "stand.toml", [stand / "logs/r0_j0.csv"], stand / "out", executor=threads).met


def test_a_merge_that_was_killed_is_finished(stand, threads):
    out = stand / "out"
    before = so.fit_fleet(stand / "stand.toml", [stand / "logs/r0_*.csv"], out, executor=threads)
    (part,) = (out / "fleet").glob("part-*.parquet")
    names = [part.name, "part-other.parquet"]
    merged = out / ".fleet/merged-part-1.parquet"
    pl.read_parquet(part).write_parquet(merged, metadata={"replaces": json.dumps(names)})
    (out / ".fleet/.seaopt-left").write_bytes(b"half a file")
    assert len(pl.read_parquet(out / "fleet")) == 4  # a reader sees each row once, before and after
    after = so.fit_fleet(stand / "stand.toml", [stand / "logs/r0_*.csv"], out, executor=threads)
    assert after.unchanged == 4 and after.rows.equals(before.rows)
    assert [path.name for path in (out / "fleet").iterdir()] == ["part-1.parquet"]
    assert [path.name for path in (out / ".fleet").iterdir()] == ["lock"]


def test_a_damaged_part_is_named(stand, threads):
    so.fit_fleet(stand / "stand.toml", [stand / "logs/r0_j0.csv"], stand / "out", executor=threads)
    (part,) = (stand / "out/fleet").glob("part-*.parquet")
    part.write_bytes(part.read_bytes()[:-20])
    with pytest.raises(FileError, match=part.name):
        so.fit_fleet(stand / "stand.toml", [stand / "logs/r0_j0.csv"], stand / "out", executor=threads)


def test_a_folder_is_read_back(stand, threads):
    problem, logs, out = stand / "stand.toml", stand / "logs", stand / "out"
    so.fit_fleet(problem, [logs / "r0_j0.csv"], out, executor=threads, identity=IDENTITY)
    fleet = so.fit_fleet(problem, [logs / "r1_j[01].csv"], out, executor=threads, identity=IDENTITY)
    path = out / "fleet.json"
    write_json(path, json.loads(path.read_text()) | {"drift": {"alarms": []}})
    again = read_fleet(out)
    assert again.rows.equals(fleet.rows) and again.to_dict() == fleet.to_dict() and again.drift == {"alarms": []}
    assert (again.fitted, again.free, again.identity) == (fleet.fitted, fleet.free, fleet.identity)
    write_json(path, json.loads(path.read_text()) | {"other_logs": []})
    with pytest.raises(FileError, match="has changed"):
        read_fleet(out)


def test_a_log_with_a_gap_is_met_and_has_the_finding_of_inspect(stand, threads):
    """0.3 s at 400 Hz are 120 steps, of which 119 samples lie inside."""
    log = stand / "logs" / "r0_j0.csv"
    lines = log.read_text().splitlines()
    log.write_text("\n".join(lines[:401] + lines[520:]))
    fleet = so.fit_fleet(stand / "stand.toml", [stand / "logs" / "r0_*.csv"], executor=threads)
    (said,) = [one.sentence for one in assess_quality(read_table(log)).findings if one.kind == "gap"]
    assert fleet.met and fleet.gaps == ((str(log), said),) and said.startswith("1 gap, 119 samples lost")


def test_a_log_much_shorter_than_its_siblings_has_a_finding(stand, threads):
    problem, logs, out = stand / "stand.toml", stand / "logs", stand / "out"
    write_log(logs / "r0_j0.csv", 0, n=190)
    write_log(logs / "r0_j1.csv", 1, n=210)
    fleet = so.fit_fleet(problem, [logs / "r0_*.csv", logs / "r1_*.csv"], out, executor=threads)
    short = [any(one["kind"] == "short" for one in found) for found in fleet.rows["findings"]]
    assert fleet.short == (str(logs / "r0_j0.csv"),)
    assert short == [True] + 7 * [False] and pl.read_parquet(out / "fleet").equals(fleet.rows)
    fleet = so.fit_fleet(problem, [logs / "r0_j0.csv"], out, executor=threads)  # no siblings: it goes again
    assert fleet.unchanged == 1 and "short" not in {one["kind"] for one in fleet.rows["findings"][0]}


@pytest.mark.parametrize("name", ["n" * 300, "n" * 300 + "[a]"])
def test_a_name_that_no_file_can_have_is_a_log_that_is_not_there(name):
    with pytest.raises(so.SeaoptError, match="matches no file") if "[" in name else nullcontext():
        (log,) = find_logs([name])
        assert log.path.endswith(name)
