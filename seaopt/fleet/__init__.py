"""Many actuators: the same fit over many logs, and what their parameters do over time."""

from seaopt.fleet.drift import Alarm, Drift, find_drift
from seaopt.fleet.logs import FleetLog, find_logs, read_manifest
from seaopt.fleet.result import Fleet, Spread
from seaopt.fleet.run import fit_fleet

__all__ = [
    "Alarm", "Drift", "Fleet", "FleetLog", "Spread", "find_drift", "find_logs", "fit_fleet", "read_manifest",
]  # fmt: skip
