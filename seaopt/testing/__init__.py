"""For users' own pytest checks: assertions, virtual experiments, and a plugin that tests problem files.

Each name loads its module when it is first used, so that pytest starts as quickly with the plugin as without.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from seaopt.testing.assertions import assert_certified as assert_certified
    from seaopt.testing.assertions import assert_predicts as assert_predicts
    from seaopt.testing.assertions import assert_recovered as assert_recovered
    from seaopt.testing.expectations import Expectation as Expectation
    from seaopt.testing.expectations import list_expectations as list_expectations
    from seaopt.testing.virtual import virtual_experiment as virtual_experiment

__all__ = [  # noqa: RUF022  (in the order of use)
    "assert_recovered", "assert_predicts", "assert_certified", "virtual_experiment", "Expectation",
    "list_expectations",
]  # fmt: skip
_HOME = {"virtual_experiment": "virtual", "Expectation": "expectations", "list_expectations": "expectations"}


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module 'seaopt.testing' has no attribute {name!r}")
    module = import_module(f"seaopt.testing.{_HOME.get(name, 'assertions')}")
    globals()[name] = value = getattr(module, name)
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
