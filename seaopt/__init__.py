"""Series elastic actuators: from raw bench logs to a certified force controller.

The names below are in the order of the data path: parameters and plants, logs, simulation, fit, controller,
certificate, report. Each loads its package when it is first used.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from seaopt import plants, testing
    from seaopt.bench import Sensors, virtual_log
    from seaopt.control import Controller, ControllerSpec, assess, corners, export, tune
    from seaopt.errors import SeaoptError
    from seaopt.estimation import (
        Experiment,
        Fit,
        Huber,
        MultipleShooting,
        OutputError,
        PredictionError,
        SoftL1,
        bootstrap,
        compare,
        design_experiment,
        diagnose,
        fit,
        profile,
    )
    from seaopt.fleet import fit_fleet
    from seaopt.frequency import MeasuredResponse, h1, measure_response
    from seaopt.logs import Column, Log, contents, read_log, write_log
    from seaopt.machine import accept, bring_up
    from seaopt.parameters import Parameter, ParameterSet
    from seaopt.plants import Plant
    from seaopt.problem import demo_path, read_problem
    from seaopt.reporting import write_report
    from seaopt.robustness import Certificate, certify, verify
    from seaopt.simulation import simulate

__version__ = "0.2.0"

_NAMES = {  # by package
    "parameters": "Parameter ParameterSet",
    "plants": "Plant plants",
    "logs": "Column Log contents read_log write_log",
    "simulation": "simulate",
    "bench": "Sensors virtual_log",
    "frequency": "h1 MeasuredResponse measure_response",
    "estimation": "Experiment Huber SoftL1 OutputError MultipleShooting PredictionError Fit fit "
    "diagnose compare profile bootstrap design_experiment",
    "control": "ControllerSpec Controller corners tune assess export",
    "robustness": "Certificate certify verify",
    "problem": "demo_path read_problem",
    "reporting": "write_report",
    "fleet": "fit_fleet",
    "machine": "bring_up accept",
    "testing": "testing",
    "errors": "SeaoptError",
}
_HOME = {name: f"seaopt.{package}" for package, names in _NAMES.items() for name in names.split()}
__all__ = [  # noqa: RUF022  (in the order of the data path)
    "Parameter", "ParameterSet", "Plant", "plants", "Column", "Log", "contents", "read_log", "write_log",
    "simulate", "Sensors", "virtual_log", "h1", "MeasuredResponse", "measure_response",
    "Experiment", "Huber", "SoftL1", "OutputError", "MultipleShooting",
    "PredictionError", "Fit", "fit", "diagnose", "compare", "profile", "bootstrap", "design_experiment",
    "ControllerSpec", "Controller", "corners", "tune", "assess", "export", "Certificate", "certify", "verify",
    "demo_path", "read_problem", "write_report", "fit_fleet", "bring_up", "accept", "testing", "SeaoptError",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'seaopt' has no attribute {name!r}")
    home = import_module(_HOME[name])
    value = home if name in ("plants", "testing") else getattr(home, name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*__all__, "__version__"])
