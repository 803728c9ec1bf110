"""problems/knee.toml, a rotary knee with friction, on its own virtual logs."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

import seaopt as so

KNEE = Path(__file__).resolve().parents[2] / "problems" / "knee.toml"
TRUTH = {"J_m": 2.4e-5, "b_r": 5e-5, "f_c": 0.005, "k_s": 300.0, "J_l": 0.25, "d_l": 0.3}


def test_short_logs_of_the_knee_are_fitted_and_tuned(tmp_path):
    """The file as it is, with logs of a few seconds: the truth within its interval, and every limit met."""
    text = KNEE.read_text(encoding="utf-8").replace("duration_s = 30", "duration_s = 3")
    path = tmp_path / "knee.toml"
    path.write_text(text.replace("duration_s = 20", "duration_s = 3"), encoding="utf-8")
    problem = so.read_problem(path)
    fit = so.fit(problem.experiments(), problem.parameters, **problem.fit_options)
    assert fit.met, fit.verdict
    so.testing.assert_recovered(fit, problem.parameters.update(**TRUTH), sigmas=4)
    controller = so.tune(
        problem.design_plant, fit.parameters, problem.spec, robust_to=problem.robust_to(fit.parameters)
    )
    assert controller.feasible, controller.explanation
    assert controller.command.effort_unit == "N m"


@pytest.mark.slow
def test_the_knee_runs_with_everything_met(tmp_path):
    command = [sys.executable, "-m", "seaopt", "run", str(KNEE), "-o", str(tmp_path)]
    run = subprocess.run(command, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stdout + run.stderr
    stored = {name: json.loads((tmp_path / f"{name}.json").read_text(encoding="utf-8")) for name in
              ("fit", "controller", "robustness")}  # fmt: skip
    assert stored["fit"]["met"] and stored["controller"]["feasible"] and stored["robustness"]["passed"]
    for name, value in TRUTH.items():
        fitted = stored["fit"]["parameters"][name]
        assert abs(fitted["value"] - value) < 4 * fitted["std"]
