"""Figures and the HTML report."""

from seaopt.reporting.report import verdict, write_report

__all__ = ["verdict", "write_report"]
