"""Series elastic actuators: from raw bench logs to a certified force controller.

The names below are in the order of the data path: parameters and plants, logs, simulation, fit, controller,
certificate, report. Each loads its package when it is first used.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from seaopt import plants as plants
    from seaopt import testing as testing
    from seaopt.bench import Sensors as Sensors
    from seaopt.bench import virtual_log as virtual_log
    from seaopt.control import Controller as Controller
    from seaopt.control import ControllerSpec as ControllerSpec
    from seaopt.control import assess as assess
    from seaopt.control import corners as corners
    from seaopt.control import export as export
    from seaopt.control import tune as tune
    from seaopt.errors import SeaoptError as SeaoptError
    from seaopt.estimation import Experiment as Experiment
    from seaopt.estimation import Fit as Fit
    from seaopt.estimation import Huber as Huber
    from seaopt.estimation import MultipleShooting as MultipleShooting
    from seaopt.estimation import OutputError as OutputError
    from seaopt.estimation import PredictionError as PredictionError
    from seaopt.estimation import SoftL1 as SoftL1
    from seaopt.estimation import bootstrap as bootstrap
    from seaopt.estimation import compare as compare
    from seaopt.estimation import design_experiment as design_experiment
    from seaopt.estimation import diagnose as diagnose
    from seaopt.estimation import fit as fit
    from seaopt.estimation import profile as profile
    from seaopt.fleet import fit_fleet as fit_fleet
    from seaopt.frequency import MeasuredResponse as MeasuredResponse
    from seaopt.frequency import h1 as h1
    from seaopt.frequency import measure_response as measure_response
    from seaopt.logs import Column as Column
    from seaopt.logs import Log as Log
    from seaopt.logs import contents as contents
    from seaopt.logs import read_log as read_log
    from seaopt.logs import write_log as write_log
    from seaopt.machine import accept as accept
    from seaopt.machine import bring_up as bring_up
    from seaopt.parameters import Parameter as Parameter
    from seaopt.parameters import ParameterSet as ParameterSet
    from seaopt.plants import Plant as Plant
    from seaopt.problem import demo_path as demo_path
    from seaopt.problem import read_problem as read_problem
    from seaopt.reporting import write_report as write_report
    from seaopt.robustness import Certificate as Certificate
    from seaopt.robustness import certify as certify
    from seaopt.robustness import verify as verify
    from seaopt.simulation import simulate as simulate

__version__ = "0.2.0"

_HOME = {
    "Parameter": "seaopt.parameters",
    "ParameterSet": "seaopt.parameters",
    "Plant": "seaopt.plants",
    "plants": "seaopt.plants",
    "Column": "seaopt.logs",
    "Log": "seaopt.logs",
    "contents": "seaopt.logs",
    "read_log": "seaopt.logs",
    "write_log": "seaopt.logs",
    "simulate": "seaopt.simulation",
    "Sensors": "seaopt.bench",
    "virtual_log": "seaopt.bench",
    "h1": "seaopt.frequency",
    "MeasuredResponse": "seaopt.frequency",
    "measure_response": "seaopt.frequency",
    "Experiment": "seaopt.estimation",
    "Huber": "seaopt.estimation",
    "SoftL1": "seaopt.estimation",
    "OutputError": "seaopt.estimation",
    "MultipleShooting": "seaopt.estimation",
    "PredictionError": "seaopt.estimation",
    "Fit": "seaopt.estimation",
    "fit": "seaopt.estimation",
    "diagnose": "seaopt.estimation",
    "compare": "seaopt.estimation",
    "profile": "seaopt.estimation",
    "bootstrap": "seaopt.estimation",
    "design_experiment": "seaopt.estimation",
    "ControllerSpec": "seaopt.control",
    "Controller": "seaopt.control",
    "corners": "seaopt.control",
    "tune": "seaopt.control",
    "assess": "seaopt.control",
    "export": "seaopt.control",
    "Certificate": "seaopt.robustness",
    "certify": "seaopt.robustness",
    "verify": "seaopt.robustness",
    "demo_path": "seaopt.problem",
    "read_problem": "seaopt.problem",
    "write_report": "seaopt.reporting",
    "fit_fleet": "seaopt.fleet",
    "bring_up": "seaopt.machine",
    "accept": "seaopt.machine",
    "testing": "seaopt.testing",
    "SeaoptError": "seaopt.errors",
}
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
