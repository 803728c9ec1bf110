"""Raw files to `Log`."""

from seaopt.logs.concatenate import concatenate
from seaopt.logs.log import Log
from seaopt.logs.quality import Quality, quality
from seaopt.logs.read import Column, header_unit, read_log, read_table, write_log
from seaopt.logs.resample import Hold, Linear
from seaopt.logs.table import Table

__all__ = [
    "Column",
    "Hold",
    "Linear",
    "Log",
    "Quality",
    "Table",
    "concatenate",
    "header_unit",
    "quality",
    "read_log",
    "read_table",
    "write_log",
]
