"""What docs/howto/reading_logs.md shows is what works."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from tests.pages import read_page


def test_the_page_runs(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    t = np.arange(200) / 100
    rows = "".join(f"{x},{100 * np.sin(x)},{x},a\n" for x in t)
    Path("chirp.csv").write_text("time [s],cur,F1 [N],note\n" + rows)
    Path("motor.csv").write_text("time [s],I [A]\n" + "".join(f"{x},{np.sin(x)}\n" for x in t))
    Path("cell.csv").write_text("time [s],F1 [N]\n" + "".join(f"{x},{x}\n" for x in t + 0.0035))
    page = read_page("howto/reading_logs.md")
    space: dict = {}
    for block in re.findall(r"```python\n(.*?)```", page, flags=re.DOTALL):
        exec(block, space)
    shown = re.search(r"```\n(chirp.csv:.*?)```", page, flags=re.DOTALL)
    assert shown is not None and capsys.readouterr().out == shown[1]
    np.testing.assert_allclose(space["log"]["F1"][:-1], t[:-1] + 0.0035, atol=1e-9)
