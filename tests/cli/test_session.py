"""What stages say, refuse and take from each other, asked in this process: quicker than the command."""

from __future__ import annotations

import pytest

import seaopt as so
from seaopt.cli.main import run
from seaopt.cli.session import Session

BENCH = """
schema = 1
[parameters]
J = { value = 3e-6, free = true, min = 1e-8, max = 1e-4 }
[plant.stand]
kind = "high_impedance"
[[experiment]]
name = "lines"
plant = "stand"
[experiment.virtual]
seed = 1
duration_s = 2
rate_hz = 400
noise_std = { F1 = 2.0 }
truth = { J = 3.31e-6 }
excitation = { multisine = { amplitudes = [1.0, 1.0], frequencies_hz = [5.0, 15.0] } }
"""


@pytest.fixture
def write(tmp_path):
    def _write(text, name="problem.toml"):
        path = tmp_path / name
        path.write_text(text, encoding="utf-8")
        return path

    return _write


def test_a_run_without_a_controller_says_what_it_left_out(write, tmp_path, capsys):
    path = write(BENCH + "[robustness]\nparameters = { f_c = [0.0, 0.01] }\n")
    run(path, tmp_path / "out")
    told = " ".join(capsys.readouterr().err.split())
    assert f"left out: tuning and certifying: {path} has [robustness] but no [controller]; add one" in told
    for stage in ("tune", "certify"):
        with pytest.raises(so.SeaoptError, match=r"has no \[controller\]; add one to tune or certify"):
            Session(path, tmp_path / "out").run(stage)
