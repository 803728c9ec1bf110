"""The ring of log rows beside the exported law: compiled, pushed and drained at random, read back as a log."""

from __future__ import annotations

import json
import subprocess
from dataclasses import replace

import numpy as np
import pytest

import seaopt as so
from seaopt.control.deploy.export import export
from seaopt.control.deploy.target import hash_law
from seaopt.control.laws.plausibility import Agreement, PlausibilityGate
from seaopt.control.laws.realisation import runnable
from seaopt.errors import ControlError, LogError
from seaopt.files import to_json
from seaopt.logs import contents
from seaopt.plants.motor.heat_guard import HeatGuard
from tests.c_code import CompiledLog
from tests.schedules import tune_knee

HOT = {"a_11": 0.985, "a_12": 0.01, "a_21": 0.001, "a_22": 0.9989, "b_1": 0.02, "b_2": 1e-5}
CLOSED = "reference", "F1", "I"


def play(log, count, rng, burst):
    """Push rows and drain some of them in turn, at random; return what was pushed, whether it fitted, and the bytes."""
    values, fitted, drained = 100.0 * rng.normal(size=(count, 3)), [], b""
    status = rng.integers(0, 3, count)
    while len(fitted) < count:
        for _ in range(rng.integers(0, burst)):
            if len(fitted) < count:
                fitted.append(log.push(int(status[len(fitted)]), *values[len(fitted)]))
        drained += log.drain(int(rng.integers(0, 12 * log.row_bytes)))
    return values, status, np.array(fitted, dtype=bool), drained + log.drain(1 << 16)


@pytest.mark.parametrize("precision", ["double", "float"])
@pytest.mark.parametrize(("rows", "burst"), [(64, 8), (8, 14), (2, 4)])
def test_what_is_pushed_is_read_and_what_did_not_fit_is_counted(rows, burst, precision, compiler, tuned, tmp_path):
    log, rng = CompiledLog(compiler, tmp_path, tuned, rows, precision), np.random.default_rng(rows)
    values, status, fitted, drained = play(log, 2000, rng, burst)
    assert log.overruns == np.sum(~fitted) and (rows == 64) == fitted.all()
    table = so.read_log(log.file(tmp_path / "run.sealog", drained))
    np.testing.assert_array_equal(table.time, 1e-3 * np.flatnonzero(fitted))
    expected = values[fitted].astype(np.float32 if precision == "float" else float)
    np.testing.assert_array_equal(np.column_stack([table[name] for name in CLOSED]), expected)
    np.testing.assert_array_equal(table["status"], status[fitted])
    assert [table.signals[name].unit for name in CLOSED] == ["N", "N", "A"]
    said = [note for note in table.notes if "the ring was full" in note]
    missed = int(np.sum(np.diff(np.flatnonzero(fitted)) - 1))  # those after the last row stand in no row
    assert bool(said) == (missed > 0) and all(f"{missed} ticks were not logged" in note for note in said)


THREADS = """
#include <pthread.h>
#include <sched.h>
#include <stdio.h>
#include <string.h>
#include "law_log.h"
#define ENOUGH 5000UL
static law_log ring;
static volatile int enough = 0, done = 0;
static volatile unsigned long ticks = 0;
static void *produce(void *unused)
{
    unsigned long k;
    for (k = 0; !enough; k++) {
        if (!law_log_push(&ring, (int)(k % 3), (double)k, -(double)k, 0.5 * (double)k) && k % 5 == 0) sched_yield();
    }
    ticks = k;
    done = 1;
    return unused;
}
int main(void)
{
    static unsigned char bytes[64 * LAW_LOG_ROW_BYTES];
    unsigned long rows = 0, torn = 0, lost = 0, seed = 1, last = 0;
    pthread_t thread;
    law_log_init(&ring);
    pthread_create(&thread, NULL, produce, NULL);
    for (;;) {
        const int over = done;
        uint32_t size, at;
        seed = seed * 1103515245UL + 12345UL;
        size = law_log_drain(&ring, bytes, (uint32_t)((seed >> 16) % sizeof bytes));
        for (at = 0; at < size; at += LAW_LOG_ROW_BYTES) {
            uint32_t head[2];
            double values[3];
            memcpy(head, bytes + at, 8);
            memcpy(values, bytes + at + 8, 24);
            torn += values[0] != head[0] || values[1] != -values[0] || values[2] != 0.5 * values[0] || head[1] >> 16 != head[0] % 3;
            torn += (rows + lost > 0) && head[0] - last != 1 + (head[1] & 65535U);
            lost += head[1] & 65535U;
            last = head[0];
            rows++;
        }
        enough = rows >= ENOUGH;
        if (over && ring.pushed == ring.drained) break;
    }
    pthread_join(thread, NULL);
    printf("%lu %lu %lu %lu\\n", torn, rows, (unsigned long)ring.overruns, ticks);
    return 0;
}
"""  # noqa: E501


def test_no_row_is_torn_between_two_threads(compiler, tuned, tmp_path):
    export(tuned, tmp_path, name="law", log_rows=16)
    (tmp_path / "threads.c").write_text(THREADS)
    files = [tmp_path / name for name in ("threads.c", "law.c", "law_log.c")]
    built = subprocess.run([*compiler, "-O2", "-pthread", *files, "-o", tmp_path / "run"], check=False)
    if built.returncode:
        pytest.skip("no threads in this compiler's library")
    torn, rows, overruns, ticks = map(int, subprocess.check_output([tmp_path / "run"], text=True).split())
    assert torn == 0 and rows + overruns == ticks and rows >= 5_000 and overruns


def test_a_core_that_reads_a_count_in_pieces_is_refused(compiler, tuned, tmp_path):
    export(tuned, tmp_path, name="law", log_rows=16)
    (tmp_path / "limits.h").write_text("#define UINT_MAX 65535U\n")  # of 16 bit
    command = [*compiler, f"-I{tmp_path}", "-c", tmp_path / "law_log.c", "-o", tmp_path / "law_log.o"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode and "log on one of 32 bit or more" in done.stderr


def test_a_tick_goes_on_after_two_to_the_32(compiler, tuned, tmp_path):
    log = CompiledLog(compiler, tmp_path, tuned, 64)
    log.ring[3] = 2**32 - 5
    for k in range(20):
        log.push(0, k, k, k)
    table = so.read_log(log.file(tmp_path / "run.sealog", log.drain(1 << 14)))
    np.testing.assert_allclose(np.diff(table.time), 1e-3, rtol=1e-6)


@pytest.fixture(scope="module")
def whole(compiler, tuned, tmp_path_factory):
    """Return the header and the rows of 200 ticks under the compiled law, closed about scipy's plant."""
    folder = tmp_path_factory.mktemp("log")
    log, law = CompiledLog(compiler, folder, tuned, 256), runnable(tuned)
    state, rng = law.reset(), np.random.default_rng(8)
    for reference, force in rng.normal(size=(200, 2)) * 30.0:
        current, state = law.step(state, float(reference), float(force))
        log.push(0, reference, force, current)
    return log.header, log.drain(1 << 16), log.row_bytes


def test_bad_files_are_told_from_each_other(whole, tmp_path):
    header, rows, size = whole
    k, path = 20 * size, tmp_path / "run.sealog"
    newer = header.replace(b"SEALOG1", b"SEALOG7")
    two = header + rows
    for content, told in (
        (header[:40], "its header is cut off or damaged"),
        (header.replace(b'"channels"', b'"chamnels"') + rows, "its header is cut off or damaged"),
        (header.replace(b"float64", b"float16") + rows, "its header is cut off or damaged"),
        (header + rows[: size - 1], "has a header and no whole row of 32 bytes"),
        (b"X" + header + rows, "is not a valid log of the target although its name says so"),
        (newer + rows, "is a log of the target that this version does not read"),
        (header + rows[:k] + rows[k + 3 :], r"row 20 \(byte \d+\) does not follow the one before: bytes are missing"),
        (two + two, "row 2.. .* or two logs are in one file"),
        (header + rows[:k] + rows[:k], "row 20 "),
        (header + rows[:6] + b"\7" + rows[7:], "row 0 "),
    ):
        path.write_bytes(content)
        with pytest.raises(LogError, match=told):
            so.read_log(path)
    path.write_bytes(header + rows[:-5])
    table = so.read_log(path)
    assert len(table) == 199 and "its last row is cut off and left out: 27 of 32 bytes are there" in table.notes
    path.write_bytes(header + rows[:k] + rows[k + 3 * size :])
    table = so.read_log(path)
    assert len(table) == 197 and any("3 rows that the ring had are not in the file" in note for note in table.notes)
    assert [field.name for field in contents(path).fields] == ["time", *CLOSED]


def test_rows_that_are_shifted_are_not_read_as_a_log(whole, tmp_path):
    """By a byte too many every tick is 256 after the one before: it was read, with rows that the ring had missing."""
    header, rows, _ = whole
    path = tmp_path / "run.sealog"
    for extra in (b"\7", b"\7\7", b"\0\0", b"\7\7\7", rows[-3:]):
        path.write_bytes(header + extra + rows)
        with pytest.raises(
            LogError, match=r"row 1 \(byte \d+\) is \d+ ticks after .* missing, or too many, between hea"
        ):
            so.read_log(path)
    for lost in (1, 2, 3):
        path.write_bytes(header + rows[lost:])
        with pytest.raises(LogError, match=r"row 1 \(byte \d+\) does not follow"):
            so.read_log(path)
    path.write_bytes(header + rows)
    wanted = so.read_log(path)
    for cut, told in ((0, 1), (5, 2)):  # as fwrite(header, sizeof header) writes it
        path.write_bytes(header + b"\0" + rows[: len(rows) - cut])
        table = so.read_log(path)
        np.testing.assert_array_equal(table["F1"], wanted["F1"][: len(table)])
        assert len(table) == 200 - bool(cut) and len(table.notes) - len(wanted.notes) == told
        assert any("the zero behind its header is left out" in note for note in table.notes)


def test_accept_takes_the_file_as_it_is_and_names_another_law(whole, tuned, tmp_path):
    path = tmp_path / "run.sealog"
    path.write_bytes(whole[0] + whole[1])
    log = so.read_log(path)
    assert log.law == hash_law(runnable(tuned))
    assert so.accept(tuned, [log]).replays[0].met
    gated = replace(tuned, gate=PlausibilityGate(range_N=(-9e3, 9e3), max_step_N=9e3, max_held=5, ramp_per_s=90.0))
    said = so.accept(gated, [log])  # which would have made these commands, too
    assert not said.replays[0].met and "law by the log's header is another" in str(said)
    said = so.accept(gated, [log], others={"old/controller.json": tuned})
    assert "it is the law of old/controller.json" in str(said)


def test_the_hash_is_of_what_the_law_does(tuned, stand, thor):
    again = so.Controller.from_dict(json.loads(to_json(tuned.to_dict())), stand, thor)
    own = hash_law(runnable(tuned))
    assert hash_law(runnable(again)) == own and len(own) == 16
    agreement = Agreement(reads=("q",), weights=(655e3,), limit=12.0, share=0.02)
    gate = PlausibilityGate(range_N=(-9e3, 9e3), max_step_N=9e3, max_held=5, ramp_per_s=90.0, agreement=agreement)
    law = runnable(tuned)
    heat = HeatGuard(**HOT, resistance=0.6, slope=0.002, allowed_rise=80.0, share=0.02, ambient=21.0)
    others = [
        replace(law, anti_windup=1.001 * law.anti_windup, tracking_time_s=law.tracking_time_s / 1.001),
        replace(law, heat=heat),
        replace(law, heat=replace(heat, share=0.03)),
        replace(law, heat=replace(heat, resistance=heat.resistance * 1.01)),
        replace(law, heat=replace(heat, allowed_rise=heat.allowed_rise - 1.0)),
        runnable(tuned, command_limit=8.0),
        runnable(tuned, gate=gate),
        runnable(tuned, gate=replace(gate, agreement=None)),
        replace(runnable(tuned), c=runnable(tuned).c * (1.0 + 1e-15)),
    ]
    assert len({own, *map(hash_law, others)}) == 10
    nearly = replace(law, anti_windup=law.anti_windup * (1.0 + 1e-15), heat=replace(heat, b_1=heat.b_1 * (1.0 + 1e-15)))
    assert hash_law(nearly) == hash_law(replace(law, heat=heat))  # as it is computed again from a file


def test_encoders_and_their_units_are_channels(compiler, tuned, tmp_path):
    agreement = Agreement(reads=("q",), weights=(655e3,), limit=12.0, share=0.02, units=("m",))
    gate = PlausibilityGate(range_N=(-9e3, 9e3), max_step_N=9e3, max_held=5, ramp_per_s=90.0, agreement=agreement)
    content = json.loads(to_json(replace(tuned, gate=gate).to_dict()))  # no design plant that tells units
    log = CompiledLog(compiler, tmp_path, content, 4)
    stated = json.loads(log.header.removeprefix(b"SEALOG1"))
    assert stated["channels"] == [["reference", "N"], ["F1", "N"], ["q", "m"], ["I", "A"]]


@pytest.mark.slow
@pytest.mark.parametrize("precision", ["double", "float"])
def test_a_schedule_logs_its_variable(precision, compiler, tmp_path):
    schedule = tune_knee()
    log = CompiledLog(compiler, tmp_path, schedule, 4, precision)
    channels = json.loads(log.header.removeprefix(b"SEALOG1"))["channels"]
    assert channels[-2] == [schedule.over, schedule.runnable().table.unit]
    assert log.hash.decode() == hash_law(schedule.runnable())


@pytest.mark.parametrize("rows", [0, 1, 3, 100, 1 << 21, True])
def test_rows_are_a_power_of_two(rows, tuned, tmp_path):
    with pytest.raises(ControlError, match=f"log_rows = {rows!r} is not a power of two"):
        export(tuned, tmp_path, log_rows=rows)


def test_nothing_of_it_is_written_unless_asked(tuned, tmp_path):
    assert not [path for path in export(tuned, tmp_path) if "log" in path.stem or "tare" in path.stem]
