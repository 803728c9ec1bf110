"""The quality of a log, as the command shows and writes it."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table as Grid

from seaopt.errors import LogError, SeaoptError
from seaopt.files import to_json, write_json
from seaopt.logs import Column, Counter, Hold, Linear, Quality, quality, read_table
from seaopt.logs.align import Rule
from seaopt.logs.quality import CHANNEL_HEAD, channel_row

WIDTH = 200  # columns: a narrower terminal wraps the table, and cuts nothing off
RULES: dict[str, Rule] = {"hold": Hold(), "linear": Linear()}
STYLES = {"error": "bold red", "warning": "yellow", "note": "dim"}


def inspect_log(
    path: Path, *, time: str | None = None, channels: Sequence[str] = (), inputs: Sequence[str] = (),
    units: Sequence[str] = (), align: str | None = None, counter: str | None = None, folder: Path | None = None,
    json: bool = False,
) -> None:  # fmt: skip
    """Read a log as it is, print what is wrong with it, and write quality.json and the figure if asked.

    Raises
    ------
    SeaoptError
        The log cannot be read, or an option is malformed.

    """
    if folder is not None and folder.exists() and not folder.is_dir():
        raise LogError(f"{folder}: is a file; give a folder for the results with -o")
    given, known = _pairs("--channel", channels), _pairs("--unit", units)
    for name in known:
        if name != "time" and name not in given:
            raise SeaoptError(f"--unit {name}={known[name]}: name its column too, --channel {name}=COLUMN")
    if "time" in known and time is None:
        raise SeaoptError(f"--unit time={known['time']}: name its column too, --time COLUMN")
    clock = Column(column=time, unit=known.get("time")) if time is not None else None
    columns = {name: Column(column=column, unit=known.get(name)) for name, column in given.items()}
    table = read_table(path, time=clock, channels=columns or None, align=_rule(align), counter=_counter(counter))
    found = quality(table, inputs=list(inputs) or None)
    written: list[Path] = []
    if folder is not None:
        from seaopt.reporting import write_quality_figure

        written = [write_json(folder / "quality.json", found.to_dict())]
        written += write_quality_figure(table, found, folder / "quality")
    if json:
        sys.stdout.write(to_json(found.to_dict()))
        return
    _show(found, written)


def _rule(align: str | None) -> Rule | None:
    if align is None:
        return None
    if align not in RULES:
        raise SeaoptError(f'--align "{align}" is not known; give {" or ".join(RULES)}')
    return RULES[align]


def _counter(given: str | None) -> Counter | None:
    if given is None:
        return None
    ((column, count),) = _pairs("--counter", [given]).items()
    if not count.isdecimal():
        raise SeaoptError(f'--counter "{given}": "{count}" is not how many samples a count stands for; give 1 or more')
    return Counter(column=column, samples_per_count=int(count))


def _pairs(option: str, given: Sequence[str]) -> dict[str, str]:
    found: dict[str, str] = {}
    for item in given:
        name, sign, value = item.partition("=")
        if not sign or not name.strip() or not value.strip():
            raise SeaoptError(f'{option} "{item}" is no pair; write {option} NAME=VALUE')
        if name.strip() in found:
            raise SeaoptError(f'{option} names "{name.strip()}" twice; keep one')
        found[name.strip()] = value.strip()
    return found


def _show(found: Quality, written: list[Path]) -> None:
    console = Console(soft_wrap=True)
    plain: dict[str, Any] = {"highlight": False, "markup": False}
    console.print(f"{found.source}: {found.summary}", **plain)
    for note in found.notes:
        console.print(note, style="dim", **plain)
    grid = Grid(box=None, pad_edge=False, collapse_padding=True, header_style="dim")
    for number, title in enumerate(CHANNEL_HEAD):
        grid.add_column(title, justify="left" if number < 2 else "right", no_wrap=True)
    for item in found.channels.values():
        grid.add_row(*channel_row(item))
    Console(width=max(console.width, WIDTH)).print(grid)
    for item in found.findings:
        console.print(f"{item.severity:<8}", style=STYLES[item.severity], end=" ", **plain)
        console.print(item.sentence, **plain)
    if not found.findings:
        console.print("nothing to remark", **plain)
    if written:
        console.print("wrote " + ", ".join(str(path) for path in written), **plain)
