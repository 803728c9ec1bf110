"""Figures of results as files, for the command line."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from seaopt.control import Frontier
from seaopt.estimation import Fit
from seaopt.frequency import Survey
from seaopt.logs import Log, Quality, RawLog
from seaopt.parameters import ParameterSet
from seaopt.reporting.comparison import survey_panels
from seaopt.reporting.drawing import write_figure
from seaopt.reporting.figures.frontier import frontier_panels
from seaopt.reporting.figures.log import log_panels
from seaopt.reporting.figures.panel import compose_sheet

FRONTIER_COLUMNS = 3


def write_frequency_figure(
    surveys: Mapping[str, Survey],
    path: Path | str,
    *,
    given: ParameterSet | None = None,
    fitted: Mapping[str, tuple[Survey, Fit]] | None = None,
) -> list[Path]:
    """Draw frequency responses of experiments to SVG and PNG; return both files.

    Parameters
    ----------
    surveys : mapping of experiment to Survey
        At least one.
    path : path
        Without suffix; ``.svg`` and ``.png`` are added.
    given : ParameterSet, optional
        Values before a fit: the plant's model is drawn with them.
    fitted : mapping of experiment to (Survey, Fit), optional
        Surveys under a fit's delays and gains, and the fit: the model is drawn as fitted.

    Raises
    ------
    FileError
        The folder cannot be written.
    """
    return write_figure(compose_sheet(survey_panels(surveys, given, fitted), final=True), path)


def write_frontier_figure(frontier: Frontier, path: Path | str) -> list[Path]:
    """Draw a sweep of bandwidths to SVG and PNG; return both files.

    Parameters
    ----------
    frontier : Frontier
        Of `seaopt.control.sweep`.
    path : path
        As of `write_frequency_figure`.
    """
    return write_figure(compose_sheet(frontier_panels(frontier), FRONTIER_COLUMNS, final=True), path)


def write_quality_figure(data: Log | RawLog, quality: Quality, path: Path | str) -> list[Path]:
    """Draw a quality report to SVG and PNG; return both files.

    Parameters
    ----------
    data : Log or RawLog
        What the report was made of.
    quality : Quality
        The report.
    path : path
        As of `write_frequency_figure`.

    Raises
    ------
    FileError
        The folder cannot be written.
    """
    return write_figure(compose_sheet(log_panels(data, quality), final=True), path)
