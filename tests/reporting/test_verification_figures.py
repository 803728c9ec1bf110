"""The report's section of simulations: what it says and shows."""

from __future__ import annotations

import re

import pytest

import seaopt as so
from seaopt.errors import SeaoptError
from seaopt.robustness.environments import coupled_stability
from seaopt.robustness.large_signal import large_signal
from seaopt.robustness.scenarios import Phase, Scenario
from seaopt.robustness.verification import verify


def test_the_page_names_what_failed_and_shows_every_figure(stand, swing, thor, tmp_path):
    spec = so.ControllerSpec(bandwidth_hz=30.0, max_sensitivity=1.6, max_noise_gain=25, current_limit_A=9.0)
    controller = so.tune(stand, thor, spec)
    knock = Scenario(
        name="<knock>", phases=(Phase(duration_s=0.1), Phase(duration_s=0.8, impulse_Ns=1.0)), max_force_N=5.0
    )
    found = verify(controller, {"stand": stand, "swing": swing}, thor, scenarios=[knock])
    large = large_signal(controller, stand, thor, amplitudes_N=(20.0, 500.0), frequencies_hz=(20.0, 30.0, 40.0))
    coupled = coupled_stability(controller, stand, thor, points=4, dampings_N_s_per_m=(0.0, 50.0, 100.0))
    page = so.write_report([controller, found, large, coupled], tmp_path / "r.html").read_text(encoding="utf-8")
    assert {item.name for item in (tmp_path / "figures").glob("*.png")} == {
        "loop.png", "simulation_swing.png", "amplitude.png", "environments.png",
    }  # fmt: skip
    assert page.count("<svg") == 4
    assert "&lt;knock&gt;" in page and "<knock>" not in re.sub(r"<svg.*?</svg>", "", page, flags=re.DOTALL)
    assert "Simulation: failed" in page and "are allowed" in page
    assert "Not played: &lt;knock&gt; on stand" in page
    with pytest.raises(SeaoptError, match="2 results of kind Verification"):
        so.write_report([found, found], tmp_path / "s.html")
