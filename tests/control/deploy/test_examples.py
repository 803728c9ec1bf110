"""The examples of how the exported C is called: complete, compiled without a warning, and run."""

from __future__ import annotations

import re
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import cont2discrete

import seaopt as so
from seaopt.control import CompensateFriction, PlausibilityGate, add_compensation, export, tune_schedule
from tests.c_code import CONVERSIONS, STRICT

STAND, THOR = so.plants.high_impedance(), so.plants.thor()
SPEC = so.ControllerSpec(bandwidth_hz=25, max_sensitivity=1.6, current_limit_A=9.0)
GATE = PlausibilityGate(range_N=(-4000.0, 4000.0), max_step_N=500.0, max_held=3, ramp_per_s=50.0)
READING, COMMAND = 300.0, 1.25


def run_main(compiler, folder, main, *sources):
    (folder / "main.c").write_text(main)
    flags = [*STRICT, *CONVERSIONS, "-O1"]
    subprocess.run([*compiler, *flags, "main.c", *sources, "-o", "example"], cwd=folder, check=True)
    said = subprocess.run([str(folder / "example")], cwd=folder, capture_output=True, text=True, check=True).stdout
    return np.array(said.split(), dtype=float)


def take_example(header):
    """Return the lines of C of a header's example, each without its remark."""
    lines = re.findall(r"^ \*     (\S.*)$", header, re.MULTILINE)
    return [re.sub(r" \([^()]*(\([^()]*\))?[^()]*\)$", "", line) for line in lines]


@pytest.fixture(scope="module")
def tuned():
    return so.tune(STAND, THOR, SPEC)


@pytest.mark.parametrize("kind", ["pid", "observer", "schedule", "friction", "gate"])
def test_the_example_in_the_header_compiles_and_its_first_command_is_the_one_before(compiler, tmp_path, kind, tuned):
    if kind == "schedule":
        law = tune_schedule(STAND, THOR, SPEC, "k", [5e5, 8e5])
    elif kind in ("observer", "friction"):
        values = THOR.update(f_c=20.0, v_s=5e-3) if kind == "friction" else THOR
        law = so.tune(STAND, values, replace(SPEC, structure="pid_dob") if kind == "observer" else SPEC)
    else:
        law = tuned
    law = add_compensation(law, friction=CompensateFriction(fraction=0.5)) if kind == "friction" else law
    export(law, tmp_path, name="knee", gate=GATE if kind == "gate" else None, allow_infeasible=True)
    declare, begin, reset, step = take_example((tmp_path / "knee.h").read_text())
    main = f"""#include <stdio.h>
#include "knee.h"
int main(void)
{{
    {declare}
    const double reference_N = 0.0, measurement_N = {READING};
    double current_A = {COMMAND}, at_k = 6.0e5;
    (void)at_k;
    {begin}
    {reset}
    {step}
    printf("%.17g\\n", current_A);
    return 0;
}}
"""
    assert run_main(compiler, tmp_path, main, "knee.c") == pytest.approx(COMMAND, rel=1e-9)


CALLS = {
    "first_time_on_the_machine.md": ("force_law", "before_the_first_tick", "in_the_background();", 512),
    "on_the_target.md": ("knee", "start", "", None),
}
WRITE = """#include <stdint.h>
void write_file(const unsigned char *bytes, uint32_t count);
void write_file(const unsigned char *bytes, uint32_t count) { (void)bytes, (void)count; }
"""


@pytest.mark.parametrize("page", list(CALLS))
def test_the_example_of_a_how_to_compiles_and_its_first_command_is_the_one_before(compiler, tmp_path, page, tuned):
    name, start, after, rows = CALLS[page]
    text = (Path(__file__).parents[3] / "docs" / "howto" / page).read_text()
    (block,) = (
        block for block in re.findall(r"```c\n(.*?)```", text, re.DOTALL) if "double every_millisecond" in block
    )
    export(tuned, tmp_path, name=name, log_rows=rows)
    (tmp_path / "write.c").write_text(WRITE)
    main = f"""#include <stdio.h>
{block}
int main(void)
{{
    {start}(0.0, {READING}, {COMMAND});
    printf("%.17g\\n", every_millisecond(0.0, {READING}));
    {after}
    return 0;
}}
"""
    sources = [path.name for path in tmp_path.glob("*.c")]
    assert run_main(compiler, tmp_path, main, *sources) == pytest.approx(COMMAND, rel=1e-9)


PLANT = """#include <stdio.h>
#include "force_law_stage.h"
static const double A[2][2] = {{ {a} }}, B[2] = {{ {b} }}, K = {k}, ZERO = {zero};
int main(void)
{{
    double x[2] = {{0.0, 0.0}}, late = 0.0, y[2];
    unsigned char bytes[4096];
    unsigned long n = 0UL;
    FILE *file = fopen("stage.sealog", "wb");
    fwrite(force_law_log_header, 1, FORCE_LAW_LOG_HEADER_BYTES, file);
    force_law_stage_start(ZERO, 0.0);
    while (force_law_stage_status == FORCE_LAW_STAGE_PLAYING) {{
        const double command = force_law_stage_tick(K * x[0] + ZERO + (n == {spike}UL ? 1e5 : 0.0));
        if (n == 0UL) printf("%.17g ", command);
        y[0] = A[0][0] * x[0] + A[0][1] * x[1] + B[0] * late;
        y[1] = A[1][0] * x[0] + A[1][1] * x[1] + B[1] * late;
        x[0] = y[0], x[1] = y[1], late = command, n++;
        fwrite(bytes, 1, force_law_stage_drain(bytes, sizeof bytes), file);
    }}
    fclose(file);
    printf("%lu %d %.17g", n, force_law_stage_status, force_law_stage_tick(ZERO));
    return 0;
}}
"""


@pytest.fixture(scope="module")
def plan(tuned):
    return so.bring_up(tuned, {"stand": STAND}, THOR, samples=20, fractions=(), limits={"F1": 900.0})


@pytest.mark.parametrize("spike", [None, 1500])
def test_a_stage_of_bring_up_is_a_program_that_starts_without_a_kick_plays_logs_and_stops(
    compiler, tmp_path, spike, tuned, plan
):
    """On the paper's stand, discretised by scipy, its sensor off by 40 N, the current in force a sample later."""
    law = tuned
    so.machine.write_bring_up(plan, tmp_path)
    header = (tmp_path / "full" / "force_law_stage.h").read_text()
    assert f" *   I: stop it yourself beyond {plan.stages[0].stop['I']:.4g} A\n" in header and " *   F1" not in header
    p = {name: parameter.value for name, parameter in THOR.items()}
    r = p["l"] / (2.0 * np.pi * p["N_p"])
    m, b = p["m_l"] + p["J"] / r**2, p["b_r"] / r**2
    push = np.array([[0], [p["eta"] * p["K_tau"] / r / m]])
    a, into, *_ = cont2discrete((np.array([[0, 1], [-p["k"] / m, -b / m]]), push, np.eye(2), [[0], [0]]), 1e-3)
    words = {"a": ", ".join(f"{{{row[0]!r}, {row[1]!r}}}" for row in a.tolist()), "k": repr(p["k"]), "zero": "40.0"}
    main = PLANT.format(**words, b=", ".join(map(repr, into[:, 0].tolist())), spike=spike or 10**9)
    sources = ["force_law.c", "force_law_log.c", "force_law_stage.c", "reference.c"]
    first, ticks, status, last = run_main(compiler, tmp_path / "full", main, *sources)
    assert (
        abs(first) < 1e-9 < 0.1 < abs(law.per_effort * np.ravel(law.law.d)[1] * 40.0)
    )  # what a law from zero would command
    reference = plan.stages[0].excitation.reference
    log = so.read_log(tmp_path / "full" / "stage.sealog")
    if spike is not None:
        assert (ticks, status, last) == (spike + 1, 2, 0.0) and len(log) == spike + 1
        return
    assert (ticks, status) == (reference.size, 1) and np.allclose(log["reference"], reference, atol=1e-4)
    result = so.accept(law, [log])
    assert result.replayed and result.response is not None, result
    (part,) = result.response.measured
    truth = law.close(STAND, THOR).open_loop(part.f)
    assert np.allclose(part.loop.value, truth, rtol=1e-3)
