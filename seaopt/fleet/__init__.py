"""Many actuators: the same fit over many logs, and what their parameters do over time."""

from seaopt.fleet.actuators import tabulate_actuators, write_actuators
from seaopt.fleet.drift import Alarm, Between, Drift, find_drift
from seaopt.fleet.history import History, order_runs
from seaopt.fleet.logs import FleetLog, find_logs, read_manifest
from seaopt.fleet.page import write_fleet_page
from seaopt.fleet.population import Population, estimate_population
from seaopt.fleet.result import FigureSpread, Fleet
from seaopt.fleet.run import fit_fleet, read_fleet

__all__ = [
    "Alarm",
    "Between",
    "Drift",
    "FigureSpread",
    "Fleet",
    "FleetLog",
    "History",
    "Population",
    "estimate_population",
    "find_drift",
    "find_logs",
    "fit_fleet",
    "order_runs",
    "read_fleet",
    "read_manifest",
    "tabulate_actuators",
    "write_actuators",
    "write_fleet_page",
]
