"""Read raw files as `Log`, and find their faults."""

from seaopt.logs.log.alignment import Hold, Linear, Nearest, Readings
from seaopt.logs.log.concatenation import concatenate
from seaopt.logs.log.log import Log
from seaopt.logs.quality.findings import Finding
from seaopt.logs.quality.report import Quality, assess_quality
from seaopt.logs.reading.column import Column
from seaopt.logs.reading.counter import Counter
from seaopt.logs.reading.listing import Contents, contents
from seaopt.logs.reading.reader import read_log, read_table, write_log
from seaopt.signals import RawLog
from seaopt.units import header_unit

__all__ = [
    "Column",
    "Contents",
    "Counter",
    "Finding",
    "Hold",
    "Linear",
    "Log",
    "Nearest",
    "Quality",
    "RawLog",
    "Readings",
    "assess_quality",
    "concatenate",
    "contents",
    "header_unit",
    "read_log",
    "read_table",
    "write_log",
]
