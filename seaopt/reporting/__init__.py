"""Figures and the HTML report."""

from seaopt.reporting.comparison import experiment_survey
from seaopt.reporting.quality import quality_figure, write_quality_figure
from seaopt.reporting.report import verdict, write_frequency_figure, write_frontier_figure, write_report

__all__ = [
    "experiment_survey",
    "quality_figure",
    "verdict",
    "write_frequency_figure",
    "write_frontier_figure",
    "write_quality_figure",
    "write_report",
]
