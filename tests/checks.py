"""Certificates without some of their checks, which take most of the time."""

from __future__ import annotations

import pytest

from seaopt.robustness.certificate import certify
from seaopt.robustness.certificate.cases import Check


def leave_out(patch: pytest.MonkeyPatch, *checks: Check) -> None:
    """Let certificates have none of these checks."""
    patch.setattr(certify, "CHECKS", tuple(check for check in certify.CHECKS if check not in checks))
