"""What a log's frequency responses show, against the truth of virtual logs and the paper's equations."""

from __future__ import annotations

import numpy as np
import pytest

import seaopt as so
from seaopt.errors import LogError
from seaopt.frequency import survey
from seaopt.plants import modes


def test_the_papers_stand_gives_the_masses_it_was_made_with(stand, stand_log, thor):
    """The published parameters, 164 s at 400 Hz; (1) and (4) give m_k and b_m."""
    found = survey(stand, stand_log, outputs=("F1", "F2"))
    first, second = found.pairs
    drive = found.drive(first, thor)
    r = thor["l"].value / (2 * np.pi * thor["N_p"].value)
    assert drive.m_k.value == pytest.approx(thor["m_l"].value + thor["J"].value / r**2, rel=5e-4)
    assert drive.b_m.value == pytest.approx(thor["b_r"].value / r**2, rel=2e-3)
    assert drive.efficiency.value == pytest.approx(1.0, abs=1e-3)
    assert found.drive(second, thor) is None  # (14) has a zero
    assert first.second_order.natural_frequency_hz.value == pytest.approx(7.50, abs=0.01)
    assert first.misfit(found.model(first, thor)) < 2.0
    assert first.misfit(found.model(first, thor.update(J=2e-6))) > 20.0
    zeta, natural = first.second_order.damping_ratio.value, first.second_order.natural_frequency_hz.value
    assert first.peak.frequency_hz == pytest.approx(natural * np.sqrt(1 - 2 * zeta**2), rel=0.03)
    assert first.good_band_hz[0] < 0.2 and first.good_band_hz[1] > 40.0


def test_efficiency_is_kept_and_the_mean_throws_it_away(stand, thor):
    from seaopt.bench import PAPER_STAND

    log = so.virtual_log(stand, thor.update(eta=0.95), PAPER_STAND, duration_s=164, rate_hz=400, seed=3)
    found = survey(stand, log, outputs=("F1",))
    drive = found.drive(found.pairs[0], thor)
    assert drive.efficiency.value == pytest.approx(0.95, abs=1e-3)
    assert drive.m_k_averaged.value / drive.m_k.value == pytest.approx(2 / 1.95, rel=1e-3)


def test_a_swinging_output_peaks_where_its_poles_say_and_is_not_of_second_order(swing, thor):
    from seaopt.bench import PAPER_SWING

    sensors = so.Sensors(noise_std={"F1": 2.0})
    log = so.virtual_log(swing, thor, PAPER_SWING, duration_s=60, rate_hz=400, seed=4, sensors=sensors)
    found = survey(swing, log, outputs=("F1",))
    (pair,) = found.pairs
    resonance = max(item.frequency_hz for item in modes(swing, thor).resonances)
    assert pair.peak.frequency_hz == pytest.approx(resonance, abs=0.3)
    assert found.drive(pair, thor) is None
    assert pair.second_order.misfit > 10 * pair.misfit(found.model(pair, thor))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda t, i, f: (t, np.ones(t.size), f), "I is constant or absent"),
        (lambda t, i, f: (np.delete(t, range(900, 950)), np.delete(i, range(900, 950)), np.delete(f, range(900, 950))),
         "2 segments between gaps"),
        (lambda t, i, f: (t[:200], i[:200], f[:200]), "200 samples are too few"),
        (lambda t, i, f: (t, i, np.where(t < 0.1, np.nan, f)), "40 samples of F1 are missing"),
    ],
)  # fmt: skip
def test_bad_logs_are_refused(stand, short_log, change, words):
    time, current, force = change(short_log.time, short_log["I"], short_log["F1"])
    log = so.Log.from_arrays(time=time, I=current, F1=force)
    with pytest.raises(LogError, match=words) as caught:
        survey(stand, log)
    assert "\n" not in str(caught.value)


def test_a_two_mass_drive_shows_its_published_resonance(recorded):
    """HoriFujimotoLab/FdiTools, multisine: antiresonance 53.8 Hz and resonance 76.2 Hz seen in its own FRF."""
    from scipy.io import loadmat

    content = loadmat(recorded("twomass") / "MultisineTypeA.mat", variable_names=["iq_adx", "theta_mx"])
    current, angle = (np.ravel(content[name]).astype(float) for name in ("iq_adx", "theta_mx"))
    estimate = so.h1(current, np.gradient(angle, 1 / 2500), 1 / 2500, stretch_s=2.0)
    near = (estimate.frequency_hz > 40) & (estimate.frequency_hz < 100)
    size, f = np.abs(estimate.response[near]), estimate.frequency_hz[near]
    used = estimate.coherence[near] > 0.8
    assert f[used][np.argmax(size[used])] == pytest.approx(76.2, abs=2.5)
