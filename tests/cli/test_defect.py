"""A defect of seaopt on the command line: what it came upon, the request to report, and an exit code of its own."""

from __future__ import annotations

import sys

import pytest

from seaopt.cli import main
from seaopt.errors import InternalError


def test_a_defect_is_printed_with_the_request_and_exits_70(monkeypatch, capsys):
    def fail(**_):
        raise InternalError.of(ValueError("two\nlines"), "tune", "specification: {'bandwidth_hz': 31.25}")

    command_line = sys.modules["seaopt.cli.main"]  # whose name in the package is that of the function
    monkeypatch.setattr(command_line, "app", fail)
    with pytest.raises(SystemExit) as caught:
        main()
    first, second = capsys.readouterr().err.splitlines()
    assert caught.value.code == 70
    assert first.startswith("seaopt: tune came upon a defect of seaopt, ValueError: two lines; please report it")
    assert second == "specification: {'bandwidth_hz': 31.25}"
