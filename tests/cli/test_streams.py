"""Standard streams as shells leave them: closed before the start, or by what reads them."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

COMMAND = [sys.executable, "-m", "seaopt.cli"]
CLOSE = "import os, sys; [os.close(int(one)) for one in sys.argv[1].split(',')]; os.execv(sys.argv[2], sys.argv[2:])"


def run_without(streams, *arguments, cwd):
    """Run the command with streams closed, as a shell's `>&-` does."""
    return subprocess.run(
        [sys.executable, "-c", CLOSE, streams, *COMMAND, *arguments],
        capture_output=True, text=True, check=False, cwd=cwd,
    )  # fmt: skip


@pytest.mark.parametrize(("streams", "arguments"), [("1", ("schema", "problem")), ("0,1,2", ("--version",))])
def test_streams_that_are_closed_are_no_failure(streams, arguments, tmp_path):
    done = run_without(streams, *arguments, cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")


def test_a_pipe_that_is_read_no_further_is_no_verdict(tmp_path):
    reading, writing = os.pipe()
    os.close(reading)
    command = [*COMMAND, "schema", "problem"]
    done = subprocess.run(command, stdout=writing, stderr=subprocess.PIPE, check=False, cwd=tmp_path)
    os.close(writing)
    assert (done.returncode, done.stderr) == (141, b"")
