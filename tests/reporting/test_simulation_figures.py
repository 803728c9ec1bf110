"""The report's section of simulations: what it says and shows."""

from __future__ import annotations

import re

import numpy as np
import pytest

import seaopt as so
from seaopt.errors import SeaoptError
from seaopt.reporting.figures.panel import draw_panel
from seaopt.reporting.figures.simulation import simulation_panel
from seaopt.robustness.verification.environments import coupled_stability
from seaopt.robustness.verification.large_signal import large_signal
from seaopt.robustness.verification.scenarios import Phase, Scenario
from seaopt.robustness.verification.verification import verify


@pytest.mark.slow
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
        "loop.png", "bandwidth.png", "amplitude.png", "environments.png",
    }  # fmt: skip
    assert page.count('<figure class="chart"') == 6 + 1 + 1 + 2 + 3
    assert "&lt;knock&gt;" in page and "<knock>" not in re.sub(r"<svg.*?</svg>", "", page, flags=re.DOTALL)
    assert re.search(r"Simulation: \d+ of \d+ runs? failed", page) and "are allowed" in page
    assert "not played: &lt;knock&gt; on stand" in page
    assert "<td>1 N s</td>" in page
    assert "swing tracks no reference" in page and page.count("swinging output") == 1  # the stand does not swing
    with pytest.raises(SeaoptError, match="2 results of kind Verification"):
        so.write_report([found, found], tmp_path / "s.html")


def test_a_run_that_failed_is_drawn_whole_and_what_is_cut_is_said(stand, thor):
    """A scenario of 0.1 and 2 s, twice: the title says how much is shown, or the figure goes to 2.1 s."""
    controller = so.tune(stand, thor, so.ControllerSpec(bandwidth_hz=30.0, max_sensitivity=1.6))
    for allowed, end, title in ((1e6, 0.7, "step, 0.7 of 2.1 s"), (1.0, 2.1, "step: FAILED")):
        step = Scenario(
            name="step", phases=(Phase(duration_s=0.1), Phase(duration_s=2.0, force_N=50.0)), max_force_N=allowed
        )
        found = verify(controller, {"stand": stand}, thor, scenarios=[step])
        upper = draw_panel(simulation_panel(found, found.rows[0])).axes[0]
        assert upper.get_title(loc="left") == f"stand, {title}"
        assert upper.lines[0].get_xdata()[-1] == pytest.approx(end, abs=2e-3)
        judged = [patch.get_x() for patch in upper.patches]
        assert judged == ([] if found.passed else pytest.approx([0.5]))  # a fifth of 2 s after 0.1 s


def test_the_table_says_how_large_and_how_far_off(stand, swing, thor):
    """A constant 50 N on the pendulum; the linear loop's own response at the edge of its tracking band."""
    controller = so.tune(stand, thor, so.ControllerSpec(bandwidth_hz=30.0, max_sensitivity=1.6), robust_to={"s": swing})
    step = Scenario(name="step", phases=(Phase(duration_s=4.0, force_N=50.0),))
    found = verify(controller, {"swing": swing}, thor, scenarios=[step], draws={"swing": [thor.update(I_p=0.3)]})
    low = found.follows_hz["swing"][0]
    f = np.array([0.99 * low, 1.01 * low])
    below, above = np.abs(controller.close(swing, thor).tracking(f))
    assert below < 10 ** (-0.15) < above
    (row,) = found.worst()
    error = 50.0 - found.replay(row).outputs["F1"][0, -800:].mean()
    line = next(line for line in repr(found).splitlines() if "step" in line and "passed" in line)
    assert "50 N" in line and f"{error:.3g}" in line.split()
    assert f"swing tracks references between {low:.3g} and " in repr(found)
    assert "Draw 1 on swing: I_p = 0.3" in repr(found)
