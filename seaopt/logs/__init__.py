"""Raw files to `Log`."""

from seaopt.logs.align import Hold, Linear, Nearest
from seaopt.logs.column import Column, header_unit
from seaopt.logs.contents import Contents, contents
from seaopt.logs.counter import Counter
from seaopt.logs.log import Log
from seaopt.logs.read import read_log, read_table, write_log
from seaopt.logs.table import Table

__all__ = [
    "Column", "Contents", "Counter", "Hold", "Linear", "Log", "Nearest", "Table", "contents", "header_unit", "read_log",
    "read_table", "write_log",
]  # fmt: skip
