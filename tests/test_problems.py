"""The scripts in problems/, on the real logs."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

PROBLEMS = Path(__file__).resolve().parents[1] / "problems"


def test_twomass_resonances(data):
    """Resonance within 1 % of 76.2 Hz and antiresonance within 3 % of 53.8 Hz, both seen in the FRF."""
    path = data / "twomass" / "MultisineTypeA.mat"
    if not path.exists():
        pytest.skip(f"{path} is absent")
    sys.path.insert(0, str(PROBLEMS))
    try:
        import twomass
    finally:
        sys.path.pop(0)
    fit = twomass.fit(path)
    assert fit.derived["resonance_hz"].value == pytest.approx(76.2, rel=0.01)
    assert fit.derived["antiresonance_hz"].value == pytest.approx(53.8, rel=0.03)
    assert all(item.band_fit_percent > 85 for item in fit.outputs["multisine"].values())


def test_twomass_says_what_is_missing():
    out = subprocess.run(
        [sys.executable, PROBLEMS / "twomass.py", "no.mat"], capture_output=True, text=True, check=False
    )
    assert out.returncode == 2
    assert "is not there" in out.stdout
