"""The numbers that certifying takes, with their units and ranges; the arguments of `certify` and its kin."""

from __future__ import annotations

from typing import Any

from seaopt.errors import ControlError
from seaopt.options import check_options, option
from seaopt.records import record

CONFIDENCE = 1.0 - 1e-6


@record
class CertifyOptions:
    """What `certify`, `certify_schedule`, `certify_mpc` and `tune_certified` take besides plants and ranges."""

    samples: int = option("Draws.", default=1375, least=1)
    seed: int = option("Of the draws and of simulated noise.", default=1, least=0)
    confidence: float = option("Of the failure probability's bound.", default=CONFIDENCE, above=0.0, below=1.0)
    max_failure_probability: float | None = option("Required of that bound.", default=None, above=0.0, most=1.0)
    min_friction_margin: float | None = option("Slope, N s/m (N m s/rad).", default=None, above=0.0)
    min_rate: float | None = option("Of the schedule's variable, in its unit per second.", default=None, above=0.0)
    runs: int = option("Runs with limits active.", default=100, least=1)
    bound_tolerance: float = option("Share of half the width of a signal's bounds.", default=0.1, least=0.0)
    current_step_A: float = option("What the command is rounded to, in its unit.", default=0.0, least=0.0)
    rounds: int = option("Of tuning and certifying.", default=6, least=1)


def check_numbers(**numbers: Any) -> None:
    """Refuse numbers that are out of the range of `CertifyOptions`."""
    check_options(CertifyOptions(**numbers), ControlError)
