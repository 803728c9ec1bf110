"""What the summary line says of tests on measured logs (see conftest)."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from tests import conftest


@pytest.mark.parametrize("count", [0, 1, 3])
def test_measured_logs_that_are_left_out_are_counted(count):
    reports = [SimpleNamespace(longrepr=("file", 1, f"Skipped: {conftest.NO_DATA}"))] * count
    reports.append(SimpleNamespace(longrepr=("file", 2, "Skipped: no C compiler")))
    lines = []
    reporter = SimpleNamespace(stats={"skipped": reports}, write_line=lambda line, **_: lines.append(line))
    conftest.pytest_terminal_summary(reporter)
    assert [line.split()[0] for line in lines] == [str(count)] * (count > 0)
