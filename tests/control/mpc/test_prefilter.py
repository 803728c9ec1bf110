"""A prefilter around predictive control: SciPy's filter of the reference before the same plan, and the C code."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import bilinear, freqz, lfilter

import seaopt as so
from seaopt.control import MPCSpec, Prefilter, force_mpc
from seaopt.errors import ControlError
from tests.c_code import CompiledMPC

PLANT = so.plants.rotary(link="locked")
VALUES = PLANT.defaults
ASKED = {
    "current_limit_A": 8.0,
    "measured": "tau_s",
    "bandwidth_hz": 10.0,
    "max_sensitivity": 2.0,
    "max_complementary": False,
}
SECOND = Prefilter(order="second_order", corner_hz=18.0, damping=0.8)


def low_pass(corner_hz, damping=None):
    """Return a low-pass by SciPy's bilinear transformation, its corner kept."""
    w = 2000.0 * np.tan(np.pi * corner_hz * 1e-3)
    return bilinear([w], [1.0, w], 1e3) if damping is None else bilinear([w * w], [1.0, 2 * damping * w, w * w], 1e3)


def play(mpc, references, readings):
    state, commands, ahead = mpc.start, [], 1 + mpc.spec.preview_samples
    for k, reading in enumerate(readings.tolist()):
        command, state = mpc.command(state, references[k : k + ahead], reading)
        commands.append(command)
    return np.array(commands)


@pytest.mark.parametrize(
    ("prefilter", "expected"), [("first_order", low_pass(20.0)), (SECOND, low_pass(18.0, 0.8))], ids=["first", "second"]
)
@pytest.mark.parametrize("preview", [0, 12])
def test_it_is_the_plan_of_the_filtered_reference_in_python_and_in_c(prefilter, expected, preview, compiler, tmp_path):
    mpc = force_mpc(PLANT, VALUES, MPCSpec(**ASKED, prefilter=prefilter, preview_samples=preview))
    bare = replace(mpc, spec=replace(mpc.spec, prefilter=None))
    rng, n = np.random.default_rng(4), 450
    largest = 1.5 * abs(mpc.static_gain) * 8.0
    references = np.append(np.repeat(rng.uniform(-largest, largest, 6), 75), np.zeros(preview))
    references[n:] = references[n - 1]
    readings = 0.4 * lfilter(*low_pass(8.0), references)[:n] + 0.02 * largest * rng.normal(size=n)
    commands = play(mpc, references, readings)
    np.testing.assert_allclose(commands, play(bare, lfilter(*expected, references), readings), atol=1e-9)
    assert 0.02 < np.mean(np.abs(commands) > 7.9) < 0.9
    found = CompiledMPC(compiler, tmp_path, mpc).run([references[k : k + 1 + preview] for k in range(n)], readings)
    np.testing.assert_allclose(found[:, 0], commands, rtol=0.0, atol=1e-12 * 8.0)


@pytest.mark.parametrize("prefilter", ["first_order", "second_order", SECOND])
def test_the_bandwidth_holds_with_it_and_the_reference_peaks_less(prefilter):
    plain, shaped = (force_mpc(PLANT, VALUES, MPCSpec(**ASKED, prefilter=each)) for each in (None, prefilter))
    assert shaped.achieved.bandwidth_hz == pytest.approx(10.0, rel=0.02)
    assert shaped.achieved.reference_peak < plain.achieved.reference_peak + 1e-9
    assert any("without it the bandwidth is 1" in note for note in shaped.notes)
    f = np.array([1.0, 8.0, 40.0])
    stated = shaped.spec.reference_filter
    expected = freqz(*low_pass(stated.corner_hz, stated.damping), f, fs=1e3)[1]
    inner = shaped.unlimited().reference_response(f) / shaped.per_effort
    np.testing.assert_allclose(shaped.law.reference_response(f), inner * expected, rtol=1e-9)
    np.testing.assert_allclose(
        shaped.law.feedback_responses(f) * shaped.per_effort, shaped.unlimited().feedback_responses(f)
    )


def test_one_that_is_too_slow_or_not_known_is_refused():
    with pytest.raises(ControlError, match="raise its corner"):
        force_mpc(PLANT, VALUES, MPCSpec(**ASKED, prefilter=Prefilter(corner_hz=0.5)))
    with pytest.raises(ControlError, match="third_order"):
        MPCSpec(**ASKED, prefilter="third_order")
