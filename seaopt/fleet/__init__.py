"""Many actuators: the same fit over many logs, and what their parameters do over time."""

from seaopt.fleet.logs import FleetLog, find_logs, read_manifest
from seaopt.fleet.result import Fleet, Spread
from seaopt.fleet.run import fit_fleet

__all__ = ["Fleet", "FleetLog", "Spread", "find_logs", "fit_fleet", "read_manifest"]
