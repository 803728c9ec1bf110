"""Predictive control with gate and heat guard: Python, C, and the equations of heat written in another test."""

import ctypes
import json
import subprocess
from dataclasses import replace

import numpy as np
import pytest

import seaopt as so
from seaopt.control import MPCSpec, PlausibilityGate, export_mpc, force_mpc
from seaopt.control.loops.outer_loop import OuterLoop
from seaopt.control.mpc.export import collect_code
from seaopt.control.mpc.stored import read_code
from seaopt.errors import ControlError
from seaopt.files import to_json
from tests.c_code import STRICT, CompiledMPC
from tests.control.deploy.test_derating import HEAT, LIMIT_A, warm

GATE = PlausibilityGate(range_N=(-300.0, 300.0), max_step_N=60.0, max_held=4, ramp_per_s=300.0)
PLANT = so.plants.rotary(link="locked", parts=["thermal"])
VALUES = PLANT.defaults.update(**HEAT)


def make(**options):
    spec = {"current_limit_A": LIMIT_A, "measured": "tau_s", "bandwidth_hz": 10.0, "max_sensitivity": 2.0}
    mpc = force_mpc(PLANT, VALUES, MPCSpec(**spec | options))
    return force_mpc(PLANT, VALUES, mpc.spec, heat=mpc.heat_guard, gate=GATE)


@pytest.mark.parametrize("slew", [None, 2000.0])
def test_in_c_every_command_is_pythons(slew, compiler, tmp_path):
    """Over readings with spikes, what is no number, outages and a fault, to the limit and back as the winding warms."""
    mpc, rng, n = make(current_slew_A_per_s=slew), np.random.default_rng(6), 3000
    references = np.repeat(rng.uniform(-1.0, 1.0, 30) * 2.0 * abs(mpc.static_gain) * LIMIT_A, 100)
    readings = 0.3 * np.convolve(references, np.full(40, 1.0 / 40.0))[:n] + rng.normal(size=n)
    readings = np.clip(readings, -250.0, 250.0)
    readings[rng.integers(0, n, 40)] = rng.choice([np.nan, np.inf, -3e15, 700.0], 40)
    readings[500:503], readings[2500:2520] = np.nan, np.nan
    found = CompiledMPC(compiler, tmp_path, mpc).run(references, readings)
    state, commands, rises, limits = mpc.start, [], [], []
    for reference, reading in zip(references, readings, strict=True):
        limits.append(min(LIMIT_A, mpc.heat.limit(state.heat)))
        command, state = mpc.command(state, float(reference), float(reading))
        commands.append(command)
        rises.append(state.heat[0])
    np.testing.assert_allclose(found[:, 0], commands, rtol=0.0, atol=1e-12 * LIMIT_A)
    assert state.gate.fault and 0.01 < np.mean(np.abs(commands) >= np.array(limits) * (1 - 1e-9)) < 0.95
    assert min(limits) < 0.7 * LIMIT_A
    np.testing.assert_allclose(np.array(rises) + HEAT["T_ambient"], warm(commands), rtol=2e-3)


DRIVER = """
#include <stddef.h>
#include "force_mpc.h"
void run(const double *in, size_t n, double *out) {
  static force_mpc s;
  force_mpc_reset(&s);
  for (size_t i = 0; i < n; i++, in += 3) out[i] = force_mpc_step(&s, force_mpc_outer(&s, in[0], in[1]), in[2]);
}
"""


def test_in_c_the_outer_loop_asks_what_pythons_does(compiler, tmp_path):
    """Of a link that moves, with positions that fail, which leave the last reference; written here from the formula."""
    mpc, n, rng = make(), 1500, np.random.default_rng(8)
    outer = OuterLoop(
        stiffness=60.0, damping=2.0, velocity_filter_s=4e-3, direction=1.0, sample_time_s=1e-3, place_unit="rad"
    )
    mpc, rows = replace(mpc, outer=outer), np.cumsum(rng.normal(size=(n, 3)), axis=0) * [0.01, 0.01, 0.05]
    rows[:2] = 0.0
    rows[rng.integers(5, n, 40), rng.integers(0, 3, 40)] = rng.choice([np.nan, np.inf, -3e15], 40)
    export_mpc(mpc, tmp_path)
    (tmp_path / "example.c").write_text(DRIVER, encoding="utf-8")
    files = [str(path) for path in tmp_path.glob("*.c")]
    subprocess.run([*compiler, *STRICT, "-shared", "-fPIC", *files, "-o", str(tmp_path / "plan.so")], check=True)
    found, pointer = np.zeros(n), ctypes.POINTER(ctypes.c_double)
    given, made = (array.ctypes.data_as(pointer) for array in (np.ascontiguousarray(rows), found))
    ctypes.CDLL(str(tmp_path / "plan.so")).run(given, ctypes.c_size_t(n), made)
    state, before, asked, commands = mpc.start, outer.reset(0.0), 0.0, []
    for wanted, position, reading in rows.tolist():
        if abs(wanted) <= 1e15 and abs(position) <= 1e15:
            asked, before = outer.step(before, wanted, position)
        command, state = mpc.command(state, asked, reading)
        commands.append(command)
    np.testing.assert_allclose(found, commands, rtol=0.0, atol=1e-12 * LIMIT_A)
    assert np.ptp(commands) > 0.3 * LIMIT_A


def test_a_winding_under_full_command_stays_below_its_largest_temperature_and_the_plan_keeps_the_lower_limit():
    mpc = make()
    state, commands, rises = mpc.start, [], []
    for _ in range(4000):
        result = mpc.step(state, 10.0 * abs(mpc.static_gain) * LIMIT_A, 0.0)
        state = result.state
        assert result.solved
        commands.append(result.command)
        rises.append(state.heat[0])
    assert max(rises) <= HEAT["T_max"] - HEAT["T_ambient"]
    assert commands[-1] < 0.5 * LIMIT_A < commands[100]


def test_numbers_of_its_code_are_read_back_and_a_guard_of_what_is_no_current_is_refused():
    code = collect_code(make())
    assert read_code(json.loads(to_json(code.to_dict()))).to_dict() == code.to_dict()
    driven = so.plants.rotary(link="locked", parts=["duty_input"])
    spec = MPCSpec(command_limit=9.0, measured="tau_s", bandwidth_hz=10, max_sensitivity=2.0)
    with pytest.raises(ControlError, match="guard limits a current"):
        force_mpc(driven, driven.defaults, spec, heat=make().heat)
