"""The program of a stage of predictive control, compiled, on a machine that is written out here: its ring, drained in
odd pieces, is read back and judged.
"""

from __future__ import annotations

import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import seaopt as so
from seaopt.cli.main import app
from seaopt.control import MPCSpec, force_mpc
from seaopt.control.loops.compensation.terms import Compensation, GravityTerm
from seaopt.machine import stepped
from seaopt.machine.ticks import take_ticks
from tests.c_code import CONVERSIONS, STRICT
from tests.machine.test_bringup_command import PLANNED

STAND, THOR = so.plants.high_impedance(), so.plants.thor()
CUT = 8.0  # s of a log that are judged: the fade, a period that is left out, three more

# THOR's stand, M q'' = kF i - b q' - k q, by symplectic Euler, i a tick after the reading.
MACHINE = """#include <stdio.h>
#include <math.h>
#include "force_mpc_stage.h"
#ifndef TICK
#define TICK(force, place) force_mpc_stage_tick(force)
#endif
int main(void)
{
    const double r = 0.002 / (6.0 * 3.14159265358979323846), mass = 3.31e-6 / (r * r) + 0.646, k = 655000.0;
    const double b = 1.31e-4 / (r * r), push = GAIN * 0.0255 / r;
    double q = 0.0, speed = 0.0, sent[8] = {0.0};
    unsigned char bytes[999];
    unsigned long n = 0UL, seed = 1UL;
    uint32_t made = 1U;
    int j;
    FILE *file = fopen("stage.sealog", "wb");
    fwrite(force_mpc_log_header, 1, FORCE_MPC_LOG_HEADER_BYTES, file);
    force_mpc_stage_start();
    while (force_mpc_stage_status == FORCE_MPC_STAGE_PLAYING) {
        double noise = -6.0;
        for (j = 0; j < 12; j++) {
            seed = (seed * 1103515245UL + 12345UL) & 0x7fffffffUL;
            noise += (double)seed / 2147483648.0;
        }
        for (j = 7; j > 0; j--) sent[j] = sent[j - 1];
        sent[0] = TICK(SIGN * (k * q + 2.0 * noise) + ((n >= LOST) ? NAN : 0.0), q);
        for (j = 0; j < 50; j++) {
            speed += 2e-5 * (push * sent[1 + LATE] - b * speed - k * q) / mass;
            q += 2e-5 * speed;
        }
        if ((n++ % 23UL) == 0UL) fwrite(bytes, 1, force_mpc_stage_drain(bytes, sizeof bytes), file);
    }
    for (made = 1U; made > 0U;) {
        made = force_mpc_stage_drain(bytes, sizeof bytes);
        fwrite(bytes, 1, made, file);
    }
    fclose(file);
    printf("%lu %d", n, force_mpc_stage_status);
    return 0;
}
"""


def play(compiler, folder: Path, **faults):
    """Return how many ticks a stage's program ran on a machine, its status at the end, and the path of its log."""
    faults = {"SIGN": 1.0, "GAIN": 1.0, "LATE": 0, "LOST": "100000000UL"} | faults
    (folder / "machine.c").write_text(MACHINE)
    files = ["force_mpc_stage.c", "force_mpc_log.c"]
    for file in files:
        done = subprocess.run(
            [*compiler, *STRICT, *CONVERSIONS, "-O2", "-c", file, "-o", "checked.o"],
            cwd=folder, capture_output=True, text=True, check=False,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
    files = [path.name for path in folder.glob("*.c")]  # all that is there, with the one program
    stated = [f"-D{name}={value}" for name, value in faults.items()]
    command = [*compiler, "-std=c99", "-O2", "-ffp-contract=off", *stated, *files, "-lm", "-o", "machine"]
    subprocess.run(command, cwd=folder, check=True)
    ticks, status = subprocess.check_output("./machine", cwd=folder, text=True).split()
    return int(ticks), int(status), folder / "stage.sealog"


@pytest.fixture(scope="module")
def plan():
    return so.bring_up(
        force_mpc(STAND, THOR, MPCSpec(current_limit_A=9.0, bandwidth_hz=20, preview_samples=3)),
        {"stand": STAND},
        THOR,
        samples=5,
        fractions=(),
        limits={"F1": 900.0},
    )


@pytest.fixture(scope="module")
def stage(plan, tmp_path_factory):
    folder = tmp_path_factory.mktemp("planned")
    so.machine.write_bring_up(plan, folder)
    return folder / "full"


def test_a_right_machine_is_accepted_by_the_log_that_its_ring_made(compiler, stage, plan):
    (full,) = plan.stages
    ticks, status, path = play(compiler, stage)
    log, reference = so.read_log(path), full.excitation.reference
    assert (ticks, status) == (reference.size, 1) and np.allclose(log["reference"], reference, atol=1e-4)
    assert not [note for note in log.notes if "ring" in note]
    assert [log.signals[name].unit for name in full.channels] == ["N", "N", "A"]
    result = so.accept(full.source, [log.between(0.0, CUT)])  # its preview goes beyond the last row
    assert result.met and result.replays[0].largest < 1e-9, result


def test_a_log_of_a_ring_that_was_full_is_of_the_law_between_its_gaps(compiler, stage, plan):
    log, law = so.read_log(play(compiler, stage)[2]), plan.stages[0].source
    row, other = np.arange(len(log)), force_mpc(STAND, THOR, replace(law.spec, bandwidth_hz=15))
    for kept, stretches in (((row % 700 < 512) & (row < 3000), 5), (row % 2000 < 90, 9)):
        columns = {name: np.round(log[name][kept], 4) for name in ("reference", "F1", "I")}
        cut = so.Log.from_arrays(time=log.time[kept], **columns, units={"reference": "N", "F1": "N", "I": "A"})
        result = so.accept(law, [cut])
        (replayed,), (said,) = result.replays, result.left_out.values()
        assert replayed.met and replayed.stretches == stretches, result
        assert ("rows are missing, so that no period" in said) == (stretches == 9), said
        assert not so.accept(other, [cut]).replayed


@pytest.mark.parametrize(("preview", "rows"), [(25, 50), (25, 75), (45, 60)])
def test_a_stretch_is_of_a_law_whose_preview_is_as_long_as_much_of_it(preview, rows):
    """A third of the rows has fewer references ahead than the law takes."""
    law = force_mpc(STAND, THOR, MPCSpec(current_limit_A=9.0, bandwidth_hz=20, preview_samples=preview))
    time, state, made = np.arange(400) * law.spec.sample_time_s, law.start, list[float]()
    reference = 100.0 * np.sin(2.0 * np.pi * (1.0 + 2.0 * time) * time)
    read = 0.7 * np.roll(reference, 5) + np.random.default_rng(1).normal(size=time.size)
    for k, force in enumerate(read.tolist()):
        result = law.step(state, reference[k : k + preview + 1], force, [force])
        made, state = [*made, result.command], result.state
    log = so.Log.from_arrays(
        time=time, reference=reference, F1=read, I=np.array(made), units={"reference": "N", "F1": "N", "I": "A"}
    )
    ticks = take_ticks(stepped.stand(law, None), log).take(slice(300, 300 + rows))
    assert stepped.play(stepped.make_setting(law, ticks)).met
    other = force_mpc(STAND, THOR, replace(law.spec, bandwidth_hz=15))
    assert not stepped.play(stepped.make_setting(other, ticks)).met


@pytest.mark.slow
@pytest.mark.parametrize(("fault", "size"), [({"GAIN": 0.5}, 0.5), ({"LATE": 2}, 2e-3)])
def test_a_machine_with_a_fault_is_refused_and_the_fault_named(compiler, stage, plan, fault, size):
    law = plan.stages[0].source
    result = so.accept(law, [so.read_log(play(compiler, stage, **fault)[2]).between(0.0, CUT)])
    found = result.differences.found[0]
    assert result.replayed and not result.met, result
    assert found.kind == "delay" if "LATE" in fault else {"gain", "K_tau"} & {found.name, *found.alike}, found
    assert found.value == pytest.approx(size, rel=0.03)


def test_a_sign_that_is_turned_stops_the_stage_and_is_said(compiler, stage, plan):
    full = plan.stages[0]
    ticks, status, path = play(compiler, stage, SIGN=-1.0)
    log = so.read_log(path)
    assert status == 2 and len(log) == ticks < 1000 and abs(log["F1"][-1]) > full.stop["F1"] > abs(log["F1"][-2])
    assert "the loop ran away" in " ".join(str(so.accept(full.source, [log])).split())  # where lines end is the path's


def test_a_stage_stops_where_readings_are_no_numbers(compiler, stage):
    ticks, status, path = play(compiler, stage, LOST="400UL")
    assert (ticks, status) == (404, 2)  # three are bridged
    np.testing.assert_array_equal(so.read_log(path)["status"][-5:], [0, 1, 1, 1, 1])


@pytest.mark.slow
def test_a_law_that_is_not_told_what_follows_is_named(compiler, stage, plan, tmp_path):
    for file in stage.glob("*.[ch]"):
        text = file.read_text().replace("ahead, FORCE_MPC_PREVIEW + 1", "ahead, 1")
        (tmp_path / file.name).write_text(text)
    log = so.read_log(play(compiler, tmp_path)[2]).between(0.0, 1.5)
    (row,) = so.accept(plan.stages[0].source, [log]).replays
    assert not row.met and (row.causes[0].kind, row.causes[0].what) == ("part", "preview"), row
    assert row.causes[0].explains


def test_what_the_terms_read_is_given_and_logged(compiler, plan, tmp_path):
    full, weight = plan.stages[0], {"low": -1e-3, "high": 1e-3, "reads": "q", "unit": "m", "fraction": 1.0}
    terms = Compensation(sample_time_s=1e-3, gravity=GravityTerm(coefficients=(4.0, 150.0), **weight))
    law = replace(full.source, compensation=terms)
    weighed = replace(full, source=law, controller=replace(full.controller, compensation=terms))
    so.machine.write_bring_up(replace(plan, stages=(weighed,)), tmp_path)
    _, status, path = play(compiler, tmp_path / "full", TICK="force_mpc_stage_tick")
    log = so.read_log(path)
    assert (
        status == 1 and log.signals["q"].unit == "m" and np.std(log["F1"] - 655e3 * log["q"]) == pytest.approx(2, 0.1)
    )
    (row,) = so.accept(law, [log.between(0.0, 3.0)]).replays
    assert row.met and row.largest < 1e-9


@pytest.mark.slow
def test_a_stage_of_a_folder_is_accepted_by_its_own_log(compiler, tmp_path):
    def seaopt(command, *arguments):
        stated = [command, str(tmp_path / "stand.toml"), *map(str, arguments), "-o", str(tmp_path / "out")]
        return CliRunner().invoke(app, stated)

    (tmp_path / "stand.toml").write_text(PLANNED)
    assert seaopt("tune").exit_code == 0 and seaopt("certify").exit_code == 0
    done = seaopt("bringup", "--limit", "F1=900", "--tare", "2:50")
    assert done.exit_code == 0 and "full/force_mpc_log.c does" in " ".join(done.output.split()), done.output
    folder = tmp_path / "out" / "bringup"
    assert (folder / "full" / "force_mpc_tare.c").is_file()
    done = seaopt("accept", play(compiler, folder / "stage_1")[2], "--stage", "stage_1")
    assert done.exit_code == 0, done.output
    other = seaopt("accept", play(compiler, folder / "full")[2], "--stage", "stage_1")
    assert other.exit_code == 1 and "it is the law of" in " ".join(other.output.split()), other.output
