"""Figures and the HTML report."""

from seaopt.reporting.comparison import experiment_survey
from seaopt.reporting.files import write_frequency_figure, write_frontier_figure, write_quality_figure
from seaopt.reporting.page.report import write_report
from seaopt.reporting.verdict import judge_results

__all__ = [
    "experiment_survey",
    "judge_results",
    "write_frequency_figure",
    "write_frontier_figure",
    "write_quality_figure",
    "write_report",
]
