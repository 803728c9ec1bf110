"""Which channels an inspection takes as inputs: what holds its value there is no sensor that stopped."""

import numpy as np
import pytest

import seaopt as so
from seaopt.logs import assess_quality


@pytest.mark.parametrize(
    ("name", "inputs", "warned"),
    [("goal", None, False), ("duty", None, False), ("target", None, True), ("target", ["target"], False)],
)
def test_steps_of_a_goal_are_no_sensor_that_stopped(name, inputs, warned):
    time = np.arange(4000) / 1000.0
    moving = np.sin(2 * np.pi * 3.0 * time) + 0.01 * np.random.default_rng(1).normal(size=time.size)
    steps = np.where(time < 2.0, moving, np.round(time))  # it moves first, and then stands still for a second at a time
    log = so.Log.from_arrays(time=time, **{name: steps}, theta=np.cumsum(moving) / 1000.0)
    stuck = [finding for finding in assess_quality(log, inputs=inputs).findings if finding.kind == "stuck"]
    assert [finding.channel for finding in stuck] == ([name] if warned else [])
    if warned:
        assert f"--input {name}" in stuck[0].sentence
