from __future__ import annotations

from fractions import Fraction

import casadi as ca
import numpy as np
import pytest

import seaopt as so
from seaopt.bench import PAPER_STAND, PAPER_SWING, Chirp, Multisine, Noise, excite, scale
from seaopt.control.running.loop_kernel import _describe_device
from seaopt.control.tuning.corners import draw
from seaopt.errors import ControlError, EstimationError, SimulationError
from seaopt.estimation.experiment_design.excitation_search import Limits


def test_the_papers_stand_experiment():
    """164 s at 400 Hz: chirp of 2 A from 0.01 to 150 Hz and 1 A of noise that ends at 150 Hz."""
    rng = np.random.default_rng(0)
    time, current = excite(PAPER_STAND, duration_s=164, rate_hz=400, rng=rng)
    assert time.size == 65_600
    assert np.std(current) == pytest.approx(np.sqrt(2.0**2 / 2 + 1.0), rel=0.02)
    spectrum = np.abs(np.fft.rfft(Noise(std=1.0, band_hz=150).samples(time, rng)))
    frequency = np.fft.rfftfreq(time.size, 1 / 400)
    assert np.max(spectrum[frequency > 150]) < 1e-9 * np.max(spectrum)


def test_the_chirp_sweeps_exponentially():
    """Instantaneous frequency by zero crossings, against f0 (f1/f0)^(t/T)."""
    time = np.arange(0, 10, 1e-4)
    signal = Chirp(amplitude=1.0, f0_hz=1.0, f1_hz=100.0).samples(time, np.random.default_rng(0))
    crossings = time[1:][np.diff(np.sign(signal)) > 0]
    middle, frequency = 0.5 * (crossings[1:] + crossings[:-1]), 1 / np.diff(crossings)
    np.testing.assert_allclose(frequency[20:-50], 100 ** (middle[20:-50] / 10), rtol=0.02)


def test_the_lines_of_a_multisine_are_where_and_as_large_as_asked():
    """A discrete Fourier transform over one period gives a_k exp(i (phi_k - pi/2)) at f_k, nothing elsewhere."""
    lines = Multisine(amplitudes=(1.0, 0.5), frequencies_hz=(0.2, 7.0), phases_rad=(0.3, -1.1))
    _, current = excite((lines,), duration_s=10, rate_hz=100, rng=np.random.default_rng(0))
    spectrum = np.fft.rfft(current) * 2 / current.size
    np.testing.assert_allclose(
        spectrum[[2, 70]], np.array([1.0, 0.5]) * np.exp(1j * (np.array([0.3, -1.1]) - np.pi / 2))
    )
    assert np.max(np.abs(np.delete(spectrum, [2, 70]))) < 1e-12


def test_a_scaled_excitation_is_so_many_times_as_large():
    parts = (*PAPER_STAND, Multisine(amplitudes=(1.0,), frequencies_hz=(3.0,)))
    drive = lambda what: excite(what, duration_s=2, rate_hz=400, rng=np.random.default_rng(5))[1]  # noqa: E731
    np.testing.assert_allclose(drive(scale(parts, 0.25)), 0.25 * drive(parts), atol=1e-12)


def test_a_multisine_needs_as_many_phases_as_lines():
    with pytest.raises(SimulationError, match="2 amplitudes, 1 frequencies"):
        Multisine(amplitudes=(1.0, 2.0), frequencies_hz=(3.0,))


def test_841_newtons_are_3_5_amperes(thor):
    """The paper gives 841 N as 3 A; at K_tau/r it is 3.5 A."""
    r = thor["l"].value / (2 * np.pi * 3)
    assert 841 / (thor["K_tau"].value / r) == pytest.approx(3.5, abs=0.005)
    assert PAPER_SWING[0].std == 3.5


def test_same_seed_same_log(swing, thor):
    make = lambda seed: so.virtual_log(swing, thor, PAPER_SWING, duration_s=1, rate_hz=400, seed=seed)  # noqa: E731
    np.testing.assert_array_equal(make(3)["F1"], make(3)["F1"])
    assert not np.array_equal(make(3)["F1"], make(4)["F1"])


def test_sensors_do_what_they_say(stand, thor):
    make = lambda **kw: so.virtual_log(  # noqa: E731
        stand, thor, PAPER_STAND, duration_s=10, rate_hz=400, seed=3, sensors=so.Sensors(**kw)
    )["F1"]
    ideal = make()
    noise = make(noise_std={"F1": 2.0}) - ideal
    assert np.std(noise) == pytest.approx(2.0, rel=0.05)
    assert np.mean(make(offset={"F1": 7.0}) - ideal) == pytest.approx(7.0)
    np.testing.assert_allclose(np.mod(make(quantisation={"F1": 0.5}), 0.5), 0.0)
    assert np.max(np.abs(make(saturation={"F1": 100.0}))) == 100.0


def test_swing_angles_stay_small(swing, thor):
    """The paper's noise-only excitation keeps rotations below 10 degrees, once the pendulum has some damping."""
    log = so.virtual_log(swing, thor.update(d=2.0), PAPER_SWING, duration_s=60, rate_hz=400, seed=1)
    assert np.degrees(np.std(log["phi"])) < 10


@pytest.mark.parametrize(
    ("excitation", "options", "words"),
    [
        ((), {}, "excitation is empty"),
        ((Chirp(amplitude=1, f0_hz=5, f1_hz=1),), {}, "f0_hz"),
        ((Noise(std=-1, band_hz=10),), {}, "noise"),
        ((Multisine(amplitudes=(1.0,), frequencies_hz=(200.0,)),), {}, "half the sample rate"),
        (PAPER_STAND, {"sensors": so.Sensors(noise_std={"F9": 1})}, "F9"),
        (PAPER_STAND, {"sensors": so.Sensors(noise_std={"F1": -1})}, "negative"),
        (PAPER_STAND, {"input_name": "V"}, '"V"'),
        (PAPER_STAND, {"duration_s": 0.001}, "lengthen"),
    ],
)
def test_bad_settings(stand, thor, excitation, options, words):
    with pytest.raises(SimulationError, match=words):
        so.virtual_log(stand, thor, excitation, **{"duration_s": 1, "rate_hz": 400, "seed": 1, **options})


@pytest.mark.parametrize("duration_s", [2.5e5, 1e300])
def test_what_does_not_fit_in_memory_is_refused_before_it_is_made(thor, stand, duration_s):
    """100 million samples took 10 GB of a machine that may not have them."""
    with pytest.raises(SimulationError, match=r"duration_s = .* takes about .* GB of memory, and 4 GB is the most"):
        so.virtual_log(stand, thor, PAPER_STAND, duration_s=duration_s, rate_hz=400, seed=1)
    with pytest.raises(SimulationError, match="GB of memory"):
        excite(PAPER_STAND, duration_s=10 * duration_s, rate_hz=400, rng=np.random.default_rng(0))
    with pytest.raises(EstimationError, match="GB of memory"):
        Limits(duration_s=duration_s, rate_hz=400, rms=1.0)


@pytest.mark.parametrize("seed", [-1, True])
def test_what_is_no_seed_is_refused_wherever_one_is_given(thor, stand, seed):
    with pytest.raises(SimulationError, match="not a seed; give a whole number"):
        so.virtual_log(stand, thor, PAPER_STAND, duration_s=1, rate_hz=400, seed=seed)
    with pytest.raises(ControlError, match="not a seed; give a whole number"):
        draw(thor.prior(k=3000.0), 2, seed)


def test_a_value_between_two_steps_reads_as_the_upper_one_in_logs_as_in_loops():
    """Halves are exact in binary; half to even, as NumPy rounds, reads 0.5 and 1.5 steps otherwise."""
    sensors = so.Sensors(quantisation={"F1": 0.5}, offset={"F1": 0.25}, saturation={"F1": 1.25})
    values = np.arange(-16, 17) / 8.0
    step, limit = Fraction(1, 2), Fraction(5, 4)
    clipped = [min(max(Fraction(value) + Fraction(1, 4), -limit), limit) for value in values]
    nearest = [float(step * ((value / step + Fraction(1, 2)) // 1)) for value in clipped]
    device, numbers = _describe_device(sensors, "F1")
    in_loop = [float(device.read(ca.DM(value), ca.DM(numbers))) for value in values]
    assert sensors.read("F1", values, np.random.default_rng(0)).tolist() == nearest
    assert [sensors.convert("F1", value) for value in values] == nearest == in_loop
