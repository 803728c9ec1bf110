"""Which channels an inspection takes as inputs: what holds its value there is no sensor that stopped."""

import shlex

import numpy as np
import pytest

import seaopt as so
from seaopt.logs import assess_quality
from seaopt.signals import Signal


@pytest.mark.parametrize(
    ("name", "inputs", "warned"),
    [
        ("goal", None, False),
        ("duty", None, False),
        ("target", None, True),
        ("target", ["target"], False),
        ("set it", None, True),
    ],
)
def test_steps_of_a_goal_are_no_sensor_that_stopped(name, inputs, warned):
    time = np.arange(4000) / 1000.0
    moving = np.sin(2 * np.pi * 3.0 * time) + 0.01 * np.random.default_rng(1).normal(size=time.size)
    steps = np.where(time < 2.0, moving, np.round(time))  # it moves first, and then stands still for a second at a time
    log = so.Log.from_arrays(time=time, **{name: steps}, theta=np.cumsum(moving) / 1000.0)
    stuck = [finding for finding in assess_quality(log, inputs=inputs).findings if finding.kind == "stuck"]
    assert [finding.channel for finding in stuck] == ([name] if warned else [])
    if warned:
        words = shlex.split(stuck[0].sentence)
        assert words[words.index("--input") + 1] == name


@pytest.mark.parametrize(
    ("name", "unit", "inputs"),
    [
        ("v", "m/s", ("current",)), ("v", "", ("current",)), ("v", "V", ("v",)), ("V", "", ("V",)),
        ("V", "m/s", ("current",)),
    ],
)  # fmt: skip
def test_a_v_is_an_input_where_it_is_a_voltage(name, unit, inputs):
    """A speed v beside a current was taken for the only input."""
    rng = np.random.default_rng(0)
    current = np.convolve(rng.normal(size=2000), np.ones(20) / 20, "same")
    channels = {"current": (current, "A"), name: (np.cumsum(current) * 1e-3, unit)}
    signals = {key: Signal(name=key, values=values, unit=own) for key, (values, own) in channels.items()}
    assert so.Log(time=np.arange(2000) * 1e-3, signals=signals).quality.inputs == inputs
