"""The logs of a fleet: which ones, where they lie, and whose they are.

A log is named by its path: a local file, or an address that fsspec opens (``s3://bucket/run.csv``). Whose it is comes
from a pattern that the end of the path matches, ``{robot}/{actuator}/{run}.csv``, or from the columns of a manifest.
"""

from __future__ import annotations

import glob
import hashlib
import os
import re
import tempfile
from collections.abc import Generator, Iterable, Mapping
from contextlib import contextmanager
from dataclasses import field
from pathlib import Path
from typing import Any

from seaopt.errors import FileError, LogError, SeaoptError
from seaopt.files import check_name, check_regular, describe_os_error, exists
from seaopt.formatting import join_words
from seaopt.records import record

_ADDRESS = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+://")
_PLACE = re.compile(r"\{([A-Za-z_]\w*)\}")
_CHUNK = 1 << 20


@record
class FleetLog:
    """A log of a fleet.

    Parameters
    ----------
    path : str
        Absolute, or an address.
    identity : mapping of name to text
        Whose log it is, and of when.
    """

    path: str
    identity: Mapping[str, str] = field(default_factory=dict[str, str])


def find_logs(names: Iterable[str | Path], identity: str | None = None) -> tuple[FleetLog, ...]:
    """Return the logs that names, patterns and addresses stand for, each once, in order of their paths.

    Parameters
    ----------
    names : iterable of str or Path
        Files; patterns with ``*``, ``?`` and ``**`` (any folders); addresses of either kind.
    identity : str, optional
        What the end of every path looks like, with names of columns in braces, each for a part of one folder's or the
        file's name.

    Raises
    ------
    LogError
        A name stands for no file or for a folder, or a path does not look like `identity`.

    Examples
    --------
    >>> from pathlib import Path
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     for name in ("knee", "hip"):
    ...         _ = Path(folder, f"r7_{name}.csv").write_text("t,I")
    ...     logs = find_logs([f"{folder}/*.csv"], identity="{robot}_{joint}.csv")
    >>> [dict(log.identity) for log in logs]
    [{'robot': 'r7', 'joint': 'hip'}, {'robot': 'r7', 'joint': 'knee'}]
    """
    names = [names] if isinstance(names, str | Path) else names
    paths = sorted({path for name in names for path in _expand(str(name))})
    if not paths:
        raise LogError("no logs are given; name files, or a pattern such as 'logs/**/*.csv'")
    pattern = None if identity is None else _compile_identity(identity)
    return tuple(FleetLog(path=path, identity=_identify(path, pattern, identity)) for path in paths)


def read_manifest(path: Path | str, column: str = "log") -> tuple[FleetLog, ...]:
    """Return the logs that a CSV file lists, with its other columns as their identities.

    Parameters
    ----------
    path : Path or str
        A CSV file with a header.
    column : str
        The one with the logs: paths, relative to the manifest's folder, or addresses.

    Raises
    ------
    FileError
        It cannot be read, or has no such column.
    LogError
        A log is listed twice, or is not named.
    """
    import polars as pl

    source = Path(path)
    check_regular(source)
    check_name(source, "rename the manifest, or its folder")
    try:
        table = pl.read_csv(source, infer_schema=False)
    except OSError as error:
        raise FileError(f"{source}: cannot be read ({describe_os_error(error)})") from error
    except pl.exceptions.PolarsError as error:
        raise FileError(f"{source}: is no manifest ({str(error).splitlines()[0]}); give a CSV file") from error
    if column not in table.columns:
        raise FileError(f'{source}: has no column "{column}", but {join_words(table.columns)}; name the logs there')
    logs: dict[str, FleetLog] = {}
    for number, row in enumerate(table.iter_rows(named=True), start=2):
        name = row.pop(column)
        if not name:
            raise LogError(f"{source}: line {number} names no log; fill it in, or delete the line")
        log_path = name if _ADDRESS.match(name) else _absolute(source.parent / name)
        if log_path in logs:
            raise LogError(f"{source}: lists {name} twice; delete one of the lines")
        logs[log_path] = FleetLog(path=log_path, identity={key: value or "" for key, value in row.items()})
    if not logs:
        raise LogError(f"{source}: lists no logs")
    return tuple(logs.values())


@contextmanager
def open_local(path: str) -> Generator[tuple[Path, str]]:
    """Yield a local file with a log's content and its SHA-256; what lies elsewhere is fetched, and deleted afterwards.
    Raises FileError: it cannot be read or fetched.
    """
    if not _ADDRESS.match(path):
        local = Path(path)
        check_regular(local)
        yield local, _hash_file(local)
        return
    with tempfile.TemporaryDirectory(prefix="seaopt-") as folder:
        local = Path(folder, path.rpartition("/")[2] or "log")
        try:
            _open_filesystem(path).get_file(path, str(local))
        except SeaoptError:
            raise
        except Exception as error:  # each of fsspec's file systems has its own
            raise FileError(f"{path}: cannot be fetched ({error})") from error
        yield local, _hash_file(local)


def _hash_file(path: Path) -> str:
    digest = hashlib.sha256()
    try:
        with path.open("rb") as stream:
            while chunk := stream.read(_CHUNK):
                digest.update(chunk)
    except (OSError, ValueError) as error:
        raise FileError(f"{path}: cannot be read ({describe_os_error(error)})") from error
    return digest.hexdigest()


def _expand(name: str) -> list[str]:
    """Return the paths that a name stands for."""
    address = _ADDRESS.match(name)
    # A file that is not there is a row of the table, with its reason; one that is there is no pattern.
    if not glob.has_magic(name) or (not address and exists(Path(name))):
        if not address and exists(Path(name)) and Path(name).is_dir():
            raise LogError(f"{name}: is a folder; give its logs: '{name.rstrip('/')}/**/*.csv'")
        return [name if address else _absolute(name)]
    if address:
        files = _open_filesystem(name)
        paths = [files.unstrip_protocol(path) for path in files.glob(name)]
    else:
        paths = [_absolute(path) for path in glob.iglob(name, recursive=True) if not Path(path).is_dir()]  # noqa: PTH207
    if not paths:
        raise LogError(f"{name}: matches no file; check the pattern")
    return paths


def _absolute(path: str | Path) -> str:
    full = os.path.abspath(path)  # noqa: PTH100  (links are kept: the name is the log's identity)
    check_name(full, "the fleet's table cannot name it: rename the log, or its folder", LogError)
    return full


def _open_filesystem(address: str) -> Any:
    """Return fsspec's file system of an address."""
    try:
        import fsspec
    except ImportError as error:
        raise FileError(f"{address}: an address needs the package fsspec: pip install 'seaopt[remote]'") from error
    try:
        return fsspec.core.url_to_fs(address)[0]
    except (ImportError, ValueError) as error:  # a protocol that is not known, or whose package is missing
        raise FileError(f"{address}: cannot be opened ({error})") from error


def _compile_identity(identity: str) -> re.Pattern[str]:
    """Return what the end of a path is matched with."""
    parts = _PLACE.split(identity)
    names = parts[1::2]
    if not names or len(set(names)) < len(names) or "{" in "".join(parts[::2]) or "}" in "".join(parts[::2]):
        raise LogError(
            f'identity = "{identity}" has no names in braces, or one twice; write it as {{robot}}/{{joint}}_{{run}}.csv'
        )
    text = "".join(f"(?P<{part}>[^/]+?)" if i % 2 else re.escape(part) for i, part in enumerate(parts))
    return re.compile(f"(?:^|.*/){text}$")


def _identify(path: str, pattern: re.Pattern[str] | None, identity: str | None) -> dict[str, str]:
    if pattern is None:
        return {}
    match = pattern.match(path.replace(os.sep, "/"))
    if match is None:
        raise LogError(f'{path}: does not end as identity = "{identity}"; correct the pattern, or take a manifest')
    return match.groupdict()
