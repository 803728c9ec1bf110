"""Figures, words and the HTML report; each is loaded when it is first used, for a printed result needs little of it."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from seaopt.reporting.comparison import experiment_survey as experiment_survey
    from seaopt.reporting.files import write_frequency_figure as write_frequency_figure
    from seaopt.reporting.files import write_frontier_figure as write_frontier_figure
    from seaopt.reporting.files import write_quality_figure as write_quality_figure
    from seaopt.reporting.page.report import write_report as write_report
    from seaopt.reporting.sections.verdict import judge_results as judge_results

_HOME = {
    "experiment_survey": "comparison",
    "judge_results": "sections.verdict",
    "write_frequency_figure": "files",
    "write_frontier_figure": "files",
    "write_quality_figure": "files",
    "write_report": "page.report",
}
__all__ = [
    "experiment_survey", "judge_results", "write_frequency_figure", "write_frontier_figure",
    "write_quality_figure", "write_report",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'seaopt.reporting' has no attribute {name!r}")
    return getattr(import_module(f"seaopt.reporting.{_HOME[name]}"), name)
