"""Where a report comes from: program, machine, date, command, and the files it was made of, with their hashes."""

from __future__ import annotations

import hashlib
import os
import platform
from collections.abc import Iterable, Iterator, Sequence
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path

from seaopt.estimation import Experiment
from seaopt.reporting.sections.data import Section, Table

PACKAGES = {name: name for name in ("numpy", "scipy", "casadi", "matplotlib")} | {"python-control": "control"}


def describe_provenance(
    experiments: Iterable[Experiment], files: Sequence[Path | str], command: str, logs: Sequence[Path | str] = ()
) -> Section:
    """Return what a report made now is made with, and of which files: problem `files`, `logs`, and those of the logs of
    `experiments`.
    """
    rows = [
        ("written", datetime.now(tz=UTC).strftime("%Y-%m-%d %H:%M:%S UTC")),
        ("command", command),
        ("seaopt", version("seaopt")),
        ("Python", f"{platform.python_version()} ({platform.python_implementation()})"),
        ("libraries", ", ".join(f"{name} {version(package)}" for name, package in PACKAGES.items())),
        ("machine", f"{platform.platform()}, {platform.machine()}, {os.cpu_count() or 1} processors"),
    ]
    sources = (*_hash_files(files, "problem file"), *_hash_files(logs, "log"), *_list_logs(experiments))
    return Section(
        title="What made this report",
        part="provenance",
        tables=(
            Table(head=("", ""), rows=tuple(row for row in rows if row[1])),
            Table(head=("file", "use", "SHA-256"), rows=sources, label="Files"),
        ),
        remarks=("The page is complete in this one file. Without scripts its figures cannot be zoomed.",),
    )


def _hash_files(files: Sequence[Path | str], use: str) -> Iterator[tuple[str, ...]]:
    for file in map(Path, files):
        if file.is_file():
            yield str(file), use, hashlib.sha256(file.read_bytes()).hexdigest()


def _list_logs(experiments: Iterable[Experiment]) -> list[tuple[str, ...]]:
    """Return each log's file, or that it has none, with its channels."""
    sources: dict[tuple[str, str], list[str]] = {}
    for experiment in experiments:
        for name, signal in experiment.log.signals.items():
            origin = signal.origin
            column = "" if not origin.column or origin.column == name else f" from {origin.column}"
            conversion = f" ({origin.conversion})" if origin.conversion else ""
            key = (origin.file or experiment.log.source, origin.sha256 or "no file")
            sources.setdefault(key, []).append(f"{experiment.name}: {name}{column}{conversion}")
    return [(file, "; ".join(uses), digest) for (file, digest), uses in sources.items()]
