"""Raw files to `Log`."""

from seaopt.logs.log import Log
from seaopt.logs.read import Column, header_unit, read_log, read_table, write_log
from seaopt.logs.table import Table

__all__ = ["Column", "Log", "Table", "header_unit", "read_log", "read_table", "write_log"]
