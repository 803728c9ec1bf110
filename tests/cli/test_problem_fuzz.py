"""Every number of a problem file replaced by what nobody should write: exit code 0, 1 or 2, no traceback, no hang."""

from __future__ import annotations

import json
import random
import re
import signal
import tomllib
import warnings

import numpy as np
import pytest

from seaopt.cli.main import INTERRUPTED
from seaopt.control.mpc.spec import MPCSpec
from seaopt.errors import ControlError, EstimationError
from seaopt.estimation.problem.band import design_filter

VALUES = (
    "0x" + "F" * 4000, str(2**63 - 1), "1e300", "-1e300", "1e-300", "1000000", "7.5", "-1", "0", "nan", "inf", '""',
    "[]", "{}", "true", f'"{"x" * 20_000}"', '"a\\u001bb\\u0000"', "[" * 50 + "]" * 50,
)  # fmt: skip
NOWHERE_RIGHT = (*VALUES[:1], '""', "[]", "{}", *VALUES[-3:])
DESIGN = """
schema = 1
parameters = { J = 3.31e-6, b_r = 1.31e-4, eta = 0.95 }
plant = { stand = { kind = "high_impedance" }, swing = { kind = "moving_output" } }
[controller]
plant = "stand"
bandwidth_hz = 30
bandwidth_range_hz = [20.0, 40.0]
sample_rate_hz = 1000
current_limit_A = 12
step_N = 100
reserve = 0.1
max_sensitivity = 1.8
max_complementary = 1.5
min_disk_margin = 0.3
max_noise_gain = 10.0
max_reference_peak = 2.0
max_droop_db = 2.0
min_filter_samples = 1
draws = 2
notch = { frequency_hz = 40.0, width = 0.5, depth = 0.3 }
prefilter = { order = "second_order", corner_hz = 80.0, damping = 0.7 }
[robustness]
samples = 20
seed = 1
retune = 0
max_failure_probability = 0.5
bound_tolerance = 0.5
current_step_A = 0.01
parameters = { b_r = [1e-4, 2e-4], J = [3e-6, 4e-6] }
sensors = { noise_std = { F1 = 1.0 }, offset = { F1 = 1.0 }, quantisation = { F1 = 0.1 }, saturation = { F1 = 9000.0 } }
"""
PREDICTIVE = """
schema = 1
parameters = { J = 3.31e-6, b_r = 1.31e-4, eta = 0.95 }
plant.stand.kind = "high_impedance"
controller = { plant = "stand", structure = "mpc", bandwidth_hz = 20, sample_rate_hz = 500, current_limit_A = 12 }
[mpc]
current_slew_A_per_s = 1e4
decay = 0.8
horizon_s = 0.05
moves = 6
largest_force_N = 100
preview_samples = 0
max_iterations = 60
bounds = { F1 = [-5e3, 5e3] }
"""
BENCH = """
schema = 1
plant.stand.kind = "high_impedance"
[parameters]
J = { value = 2e-6, free = true, min = 1e-8, max = 1e-4, prior_std = 1e-6 }
b_r = { value = 4e-4, free = true }
[[experiment]]
name = "recorded"
plant = "stand"
log = "log.csv"
time = { column = "t", unit = "s" }
inputs = { I = { column = "I", unit = "A", scale = 1.0, offset = 0.0 } }
outputs = { F1 = { column = "F1", unit = "N" } }
sigma = { F1 = 2.0 }
delay_s = 0.0
drift = 1
shots = 1
slice_s = [0.0, 2.0]
resample = { rate_hz = 200 }
decimate = 1
saturation = { F1 = [-9e3, 9e3] }
gain = { F1 = 1.0 }
initial_state = { q = 0.0 }
[[experiment]]
name = "made"
plant = "stand"
delay_s = { value = 0.001, free = true, min = 0.0, max = 0.01 }
[experiment.virtual]
seed = 1
duration_s = 2
rate_hz = 200
excitation = { chirp = { amplitude = 1, f0_hz = 0.5, f1_hz = 40 }, noise = { std = 1, band_hz = 50 }, \
multisine = { frequencies_hz = [1.0, 2.0], amplitudes = [1.0, 0.5] } }
noise_std = { F1 = 1.0 }
offset = { F1 = 1.0 }
quantisation = { F1 = 0.1 }
saturation = { F1 = 9e3 }
truth = { J = 3.3e-6 }
[fit]
holdout = 0.2
band_hz = [1.0, 50.0]
"""
RUNS = [
    (DESIGN, "tune"), (DESIGN, "certify"), (DESIGN, "report"), (PREDICTIVE, "tune"),
    (BENCH, "simulate"), (BENCH, "fit"), (BENCH, "frf"),
]  # fmt: skip


class _TookLong(BaseException):
    """What ends a run that is not refused: nothing but a time limit catches it."""


def _list_numbers(value, path=()):
    if isinstance(value, dict | list):
        for key, inner in value.items() if isinstance(value, dict) else enumerate(value):
            yield from _list_numbers(inner, (*path, key))
    elif isinstance(value, int | float):
        yield path


def _write_toml(value, path, text):
    """Return a value as TOML, with another text for what is at a path in it."""
    if path == ():
        return text
    inner = lambda key: path[1:] if path and path[0] == key else None  # noqa: E731
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key} = {_write_toml(one, inner(key), text)}" for key, one in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(_write_toml(one, inner(k), text) for k, one in enumerate(value)) + "]"
    return json.dumps(value)


def _run(seaopt, command, limit_s):
    """Return how a command ends, None after a time limit; warnings are errors as in all tests."""

    def stop(*_):
        raise _TookLong

    before = signal.signal(signal.SIGALRM, stop)
    signal.alarm(limit_s)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            result = seaopt(command, "p.toml", "-o", "out")
            return None if result.returncode == INTERRUPTED else result  # IPOPT takes any exception for Ctrl-C
    except _TookLong:
        return None
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def fuzz(seaopt, folder, text, command, count, limit_s, values):
    """Replace numbers, `count` of them; return how often each exit code came, "long" for runs that went on."""
    rng = np.random.default_rng(0)
    table = np.column_stack([np.arange(600) / 200, rng.normal(size=(600, 2))])
    np.savetxt(folder / "log.csv", table, delimiter=",", header="t,I,F1", comments="")
    content, codes = tomllib.loads(text), {}
    cases = [(path, value) for path in _list_numbers(content) for value in values]
    random.Random(0).shuffle(cases)
    for path, value in cases[:count]:
        written = "\n".join(
            f"{key} = {_write_toml(one, path[1:] if path[0] == key else None, value)}" for key, one in content.items()
        )
        (folder / "p.toml").write_text(written, encoding="utf-8")
        case = f"{command}: {'.'.join(map(str, path))} = {value[:30]}"
        try:
            result = _run(seaopt, command, limit_s)
        except Exception as error:
            raise AssertionError(case) from error
        code = result.returncode if result else "long"
        codes[code] = codes.get(code, 0) + 1
        assert code in (0, 1, 2, "long"), case
        if code == 2:
            lines = [line for line in result.stderr.splitlines() if line.startswith("seaopt: ")]
            assert len(lines) == 1 and len(lines[0]) < 2000, case
            assert not re.search(r"[\x00-\x08\x0b-\x1f\x7f]|does not fit in memory", result.stderr), case
    return codes


@pytest.mark.parametrize(("text", "command"), [(DESIGN, "tune"), (PREDICTIVE, "certify"), (BENCH, "simulate")])
def test_a_few_numbers_that_nobody_should_write_are_refused(seaopt, folder, text, command):
    assert set(fuzz(seaopt, folder, text, command, 12, 30, NOWHERE_RIGHT)) == {2}


@pytest.mark.slow
@pytest.mark.parametrize(("text", "command"), RUNS)
def test_numbers_that_nobody_should_write_are_refused(seaopt, folder, text, command):
    codes = fuzz(seaopt, folder, text, command, 10, 5, VALUES)
    assert codes[2] > 0.5 * sum(codes.values())


def test_a_filter_that_never_settles_is_refused():
    with pytest.raises(EstimationError, match="too slow at 200 Hz"):
        design_filter((1e-300, 50.0), 0.005)


def test_a_slew_that_limits_nothing_is_refused():
    with pytest.raises(ControlError, match=r"current_slew_A_per_s = 1e\+300 is not above 0 and up to 1e\+12"):
        MPCSpec(current_limit_A=12.0, current_slew_A_per_s=1e300)
