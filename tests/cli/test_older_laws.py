"""The laws of earlier tunings, as `seaopt accept` finds them in a folder."""

from __future__ import annotations

from typer.testing import CliRunner

from seaopt.cli.machine import _find_others
from seaopt.cli.main import app
from seaopt.cli.session import Session
from seaopt.control import Controller, ForceMPC

PROBLEM = """
schema = 1
title = "planned"
parameters = {{ k = {{ value = {k}, unit = "N/m" }} }}
plant = {{ stand = {{ kind = "high_impedance" }} }}
controller = {{ plant = "stand", structure = "mpc", bandwidth_hz = {hz}, current_limit_A = 9.0 }}
"""


def test_older_predictive_control_is_read_with_its_limits(tmp_path):
    file, out = tmp_path / "stand.toml", tmp_path / "out"
    for bandwidth, folder in ((15, out / "old"), (20, out)):
        file.write_text(PROBLEM.format(hz=bandwidth, k=7e5))
        done = CliRunner().invoke(app, ["tune", str(file), "-o", str(folder)])
        assert done.exit_code == 0, done.output
    others = _find_others(Session(file, out), out, out / "controller.json")
    older = others["old/controller.json"]
    assert isinstance(older, ForceMPC) and older.spec.bandwidth_hz == 15 and older.command_limit == 9.0
    # Of other parameters its plan is not known, and its linear law is.
    file.write_text(PROBLEM.format(hz=20, k=6e5))
    (older,) = _find_others(Session(file, out), out, out / "controller.json").values()
    assert isinstance(older, Controller)
