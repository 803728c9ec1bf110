"""The contents of a file: columns, lengths and units, without the data."""

from __future__ import annotations

from pathlib import Path

from seaopt.errors import LogError, require_type
from seaopt.formatting import format_table, html_text
from seaopt.logs.formats import Field, open_source
from seaopt.records import record

MAX_ROWS = 200  # that are printed


@record
class Contents:
    """The columns of a file, without their data.

    Parameters
    ----------
    path : str
    format : str
    fields : tuple of Field
        Name, kind, length, unit and clock of each column; the name is what `Column(column=...)` takes.
    notes : tuple of str
        Remarks on how the file was read.
    law : str
        Hash of the law that wrote it, of a log that the exported C wrote.
    """

    path: str
    format: str
    fields: tuple[Field, ...]
    notes: tuple[str, ...]
    law: str = ""

    def __repr__(self) -> str:
        rows = [
            (
                field.name,
                field.kind,
                "" if field.length is None else str(field.length),
                field.unit or "",
                field.clock or "",
            )
            for field in self.fields[:MAX_ROWS]
        ]
        lines = [f"{self.path}: {self.format}, {len(self.fields)} columns"]
        lines += format_table(rows, ("column", "kind", "samples", "unit", "clock"))
        lines += [f"... and {len(self.fields) - MAX_ROWS} more"] if len(self.fields) > MAX_ROWS else []
        return "\n".join([*lines, *self.notes])

    _repr_html_ = html_text


def contents(path: str | Path) -> Contents:
    r"""List what a file holds, whatever its format; no data are loaded.

    Raises
    ------
    LogError
        The file is missing, damaged, or of no known format.

    Examples
    --------
    >>> import tempfile, pathlib
    >>> file = pathlib.Path(tempfile.mkdtemp()) / "chirp.csv"
    >>> _ = file.write_text("Zeit [ms];Strom [mA];Text\n0,0;100;a\n2,5;150;b\n")
    >>> for field in contents(file).fields:
    ...     print(field.name, field.kind, field.unit)
    Zeit [ms] float64 ms
    Strom [mA] float64 mA
    Text text None
    """
    require_type(path, (str, Path), "path", "give a path", LogError)
    source = open_source(Path(path))
    return Contents(path=str(path), format=source.format, fields=source.fields, notes=source.notes, law=source.law)
