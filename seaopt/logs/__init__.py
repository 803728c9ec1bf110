"""Raw files to `Log`, and what is wrong with them."""

from seaopt.logs.align import Hold, Linear, Nearest
from seaopt.logs.column import Column, header_unit
from seaopt.logs.concatenate import concatenate
from seaopt.logs.contents import Contents, contents
from seaopt.logs.counter import Counter
from seaopt.logs.findings import Finding
from seaopt.logs.log import Log
from seaopt.logs.quality import Quality, quality
from seaopt.logs.read import read_log, read_table, write_log
from seaopt.logs.table import Table

__all__ = [
    "Column", "Contents", "Counter", "Finding", "Hold", "Linear", "Log", "Nearest", "Quality", "Table", "concatenate",
    "contents", "header_unit", "quality", "read_log", "read_table", "write_log",
]  # fmt: skip
