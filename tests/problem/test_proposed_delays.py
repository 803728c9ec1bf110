"""One actuator has one delay: of several logs of a drive, those that do not show it have it free, too."""

from __future__ import annotations

import numpy as np
import pytest

import seaopt as so
from seaopt.problem.proposal import propose
from tests.problem.test_proposal import knee_log


def spoil(signals):
    """Drown the outputs, so that no phase of them tells a delay."""
    rng = np.random.default_rng(1)
    for name in ("theta_m", "tau_s"):
        signals[name] = signals[name] + 3.0 * np.std(signals[name]) * rng.normal(size=signals[name].size)
    return signals


@pytest.mark.parametrize("order", [("shows.csv", "drowned.csv"), ("drowned.csv", "shows.csv")])
def test_a_delay_that_one_log_shows_is_fitted_of_each(tmp_path, order):
    knee_log(tmp_path / "shows.csv", late=8)
    alone = knee_log(tmp_path / "drowned.csv", late=8, change=spoil)
    assert "# delay_s" in alone.text
    text = propose([tmp_path / name for name in order], {}, tmp_path).text
    (tmp_path / "knee.toml").write_text(text, encoding="utf-8")
    delays = [experiment.delay_s for experiment in so.read_problem(tmp_path / "knee.toml").experiments()]
    assert len(delays) == 2 and all(delay.free for delay in delays)
    assert all(delay.value == pytest.approx(0.008, abs=2e-3) for delay in delays)
    assert "shows.csv shows it, and the drive is the same" in text


def test_a_measured_current_has_no_part_in_the_delay_of_a_command(tmp_path):
    knee_log(tmp_path / "shows.csv", late=8)
    knee_log(tmp_path / "drowned.csv", late=8, change=spoil)
    measured = (tmp_path / "drowned.csv").read_text().replace("cmd_current", "measured_current", 1)
    (tmp_path / "measured.csv").write_text(measured)
    text = propose([tmp_path / name for name in ("shows.csv", "measured.csv")], {}, tmp_path).text
    assert text.count("\ndelay_s = ") == 1 and "# delay_s" in text
