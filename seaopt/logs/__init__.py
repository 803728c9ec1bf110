"""Raw files to `Log`."""

from seaopt.logs.log import Log
from seaopt.logs.read import Column, header_unit, read_log, write_log

__all__ = ["Column", "Log", "header_unit", "read_log", "write_log"]
