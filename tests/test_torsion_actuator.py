"""The judge of the published torsion actuator against the package, and the figures of its page."""

from __future__ import annotations

import importlib.util
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import seaopt as so
from seaopt.control import Law, passivity, scorecard
from tests.pages import read_page

SCRIPT = Path(__file__).parents[1] / "problems" / "torsion_actuator.py"


@pytest.fixture(scope="module")
def script():
    spec = importlib.util.spec_from_file_location("torsion_actuator", SCRIPT)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def rows(script):
    return script.compare()


def test_the_judge_agrees_with_the_package(script):
    controller = script.tune(30.0, 400.0)
    found = script.judge(script.of_tuned(controller.law), script.run_tuned(controller))
    achieved = controller.achieved
    for name in ("bandwidth_hz", "ms", "noise_gain", "reference_peak"):
        assert found[name] == pytest.approx(getattr(achieved, name), rel=2e-3)
    assert found["phase_margin_deg"] == pytest.approx(achieved.phase_margin_deg, rel=1e-2)
    assert found["radius"] == pytest.approx(achieved.spectral_radius, rel=1e-9)
    port = passivity(controller, *controller.design)
    assert found["passive_to_hz"] == pytest.approx(port.violated_hz, rel=2e-3)


def test_the_page_states_what_comes_out(rows):
    lines = [line for line in read_page("evidence/torsion_actuator.md").splitlines() if line.startswith("| ")][1:]
    assert len(lines) == len(rows) == 6
    for line, row in zip(lines, rows.values(), strict=True):
        cells = [cell.strip() for cell in line.strip("|").split("|")][1:]
        stated = [
            float(value) for cell in cells for value in re.findall(r"\d+\.?\d*", cell)[: 1 if "%" not in cell else 5]
        ]
        expected = [
            row["bandwidth_hz"], row["reference_peak"], row["ms"], row["phase_margin_deg"], row["noise_gain"],
            row["passive_to_hz"], 100 * row["overshoot"],
        ]  # fmt: skip
        assert stated[:7] == pytest.approx(expected, rel=0.02, abs=0.06)
        assert row["ends"] == pytest.approx(20.0, abs=0.31)
    tuned = [row for name, row in rows.items() if name.startswith("tuned")]
    assert all(row["feasible"] for row in tuned)


def test_published_laws_hold_the_torque(script, rows):
    for name in script.PUBLISHED:
        assert rows[name]["radius"] < 1.0
    law = script.read_matrices(*script.PUBLISHED["cascaded PID"])
    z = np.exp(2j * np.pi * np.array([3.0]) * script.PERIOD)
    outer = 16.0 + 7.0 * script.PERIOD / (1 - 1 / z)
    inner = 0.045 + 0.012 * script.PERIOD / (1 - 1 / z)
    slow = (1 + 1 / z) / ((1 + 1 / z) + 2.0 / (1600.0 * script.PERIOD) * (1 - 1 / z))  # Tustin's 1/(1 + s/1600)
    expected = 100.0 * np.concatenate([outer * inner, -outer * inner, -inner * slow])
    assert law.respond(z)[0] == pytest.approx(expected, rel=1e-9)
    assert so.read_problem(script.PROBLEM).spec is not None


def test_the_cascade_is_assessed_with_its_encoder(script):
    """The package reads the motor's angle and takes differences, half a sample later than the judge's speed."""
    problem = so.read_problem(script.PROBLEM)
    law = script.read_matrices(*script.PUBLISHED["cascaded PID"])
    spec = replace(problem.spec, measured=("tau_s", "thetad_m"), passive_band_hz=None)
    given = Law.from_state_space(law.a, law.b, law.c, law.d, script.PERIOD)
    controller = so.assess(given, problem.design_plant, problem.parameters, spec)
    found, judged = controller.achieved, script.judge(law, script.run_law(law))
    assert not controller.feasible
    assert found.bandwidth_hz == pytest.approx(95.3, abs=0.05)
    assert found.ms == pytest.approx(3.53, abs=0.005)
    assert found.phase_margin_deg == pytest.approx(16.4, abs=0.05)
    late = 360.0 * 65.6 * 0.5 * script.PERIOD  # half a sample at the crossover, of the inner loop's share of it
    assert 0.0 < judged["phase_margin_deg"] - found.phase_margin_deg < late
    score = scorecard({"cascade": controller})["cascade"]
    assert score.passive_to_hz == pytest.approx(113.5, abs=0.1)
    system = controller.close(*controller.design).system().block
    z = np.exp(1j * np.linspace(0.0, np.pi, 20_001)[1:])
    inner = z[:, None, None] * np.eye(len(system.a)) - system.a
    x = np.linalg.solve(inner, np.broadcast_to(system.b[:, 2:3] + 0j, (z.size, len(system.a), 1)))[:, :, 0]
    gain = np.abs(x @ system.c[1] + system.d[1, 2])
    assert np.max(gain) == pytest.approx(found.noise_gain, rel=1e-3)
    assert score.noise_rms == pytest.approx(float(np.sqrt(np.mean(gain**2))), rel=1e-3)
