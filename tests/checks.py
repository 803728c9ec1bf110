"""Certificates and fits without what takes most of their time and a test says nothing about."""

from __future__ import annotations

import pytest

from seaopt.estimation.judgement.hypothesis_ranking import TriedHypotheses
from seaopt.robustness.certificate import certify
from seaopt.robustness.certificate.cases import Check


def leave_out(patch: pytest.MonkeyPatch, *checks: Check) -> None:
    """Let certificates have none of these checks."""
    patch.setattr(certify, "CHECKS", tuple(check for check in certify.CHECKS if check not in checks))


def leave_out_hypotheses(patch: pytest.MonkeyPatch) -> None:
    """Let fits try no part that the model may lack: most of such a fit's time, and no std depends on it."""
    patch.setattr("seaopt.estimation.judgement.judge.search_hypotheses", lambda *_, **__: TriedHypotheses())
