"""Where a report comes from: program, machine, date, command, and the files it was made of, with their hashes."""

from __future__ import annotations

import hashlib
import os
import platform
from collections.abc import Iterable, Sequence
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path

from seaopt.estimation import Experiment
from seaopt.records import record

PACKAGES = ("numpy", "scipy", "casadi", "matplotlib", "python-control")
_DISTRIBUTIONS = {"python-control": "control"}


@record
class Source:
    """A file, its SHA-256, and what was taken from it."""

    file: str
    sha256: str
    use: str


@record
class Provenance:
    """Rows of name and value, and the files."""

    rows: tuple[tuple[str, str], ...]
    sources: tuple[Source, ...]


def describe_provenance(experiments: Iterable[Experiment], files: Sequence[Path | str], command: str) -> Provenance:
    """Return what a report made here and now is made with and of.

    Parameters
    ----------
    experiments : iterable of Experiment
        Whose logs name their files.
    files : sequence of path
        Others that were read, such as the problem file.
    command : str
        What was typed; empty where nothing was.

    """
    packages = ", ".join(f"{name} {version(_DISTRIBUTIONS.get(name, name))}" for name in PACKAGES)
    now = datetime.now(tz=UTC)
    rows = [
        ("written", now.strftime("%Y-%m-%d %H:%M:%S UTC")),
        ("command", command),
        ("seaopt", version("seaopt")),
        ("Python", f"{platform.python_version()} ({platform.python_implementation()})"),
        ("libraries", packages),
        ("machine", f"{platform.platform()}, {platform.machine()}, {os.cpu_count() or 1} processors"),
    ]
    return Provenance(
        rows=tuple(row for row in rows if row[1]), sources=(*_hash_files(files), *_list_logs(experiments))
    )


def _hash_files(files: Sequence[Path | str]) -> list[Source]:
    return [
        Source(file=str(file), sha256=hashlib.sha256(Path(file).read_bytes()).hexdigest(), use="problem file")
        for file in files
        if Path(file).is_file()
    ]


def _list_logs(experiments: Iterable[Experiment]) -> list[Source]:
    """Return each log's file, or that it has none, with its channels."""
    sources: dict[tuple[str, str], list[str]] = {}
    for experiment in experiments:
        for name, signal in experiment.log.signals.items():
            origin = signal.origin
            column = "" if not origin.column or origin.column == name else f" from {origin.column}"
            conversion = f" ({origin.conversion})" if origin.conversion else ""
            key = (origin.file or experiment.log.source, origin.sha256)
            sources.setdefault(key, []).append(f"{experiment.name}: {name}{column}{conversion}")
    return [Source(file=file, sha256=digest, use="; ".join(use)) for (file, digest), use in sources.items()]
