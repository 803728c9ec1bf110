"""A law on the nonlinear plant that it was designed for, under the reference that a log or a stage has."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from seaopt.bench import Sensors
from seaopt.control import Controller, run_loop, runnable
from seaopt.control.running.closed_loop import LoopRun
from seaopt.parameters import ParameterSet
from seaopt.robustness.verification.scenarios import build_loop

RTOL = 1e-4  # of the integration: a hundredth of what a disc tells


def run_design(
    controller: Controller,
    sets: Sequence[ParameterSet],
    reference: Float[np.ndarray, " n"],
    *,
    sensors: Sensors | None = None,
    seed: int = 0,
    noise_gain: float | Float[np.ndarray, " runs"] = 1.0,
    rate: float = 1.0,
    sticks: bool = False,
) -> LoopRun:
    """Return the runs of a law, with its terms and without its guards, on its design plant with each of some values.
    `sensors`: the errors of what it reads, with noise of `seed` times `noise_gain`; without them it reads the true
    outputs. `rate`: at which the same numbers are stepped, over that which they were made for. `sticks`: whether dry
    friction jumps at rest, in place of its smoothed curve.
    """
    assert controller.design is not None
    seen, values = controller.see(controller.design[0]), [controller.delay(each) for each in sets]
    law = runnable(controller, gate=False, heat=False, outer=controller.outer is not None)
    slowed = replace(law, sample_time_s=law.sample_time_s / rate)
    completed = [seen.complete(each) for each in values]
    loop = build_loop(controller, seen, completed, slowed, sensors=sensors or Sensors(), sticks=sticks)
    return run_loop(loop, values, reference, rtol=RTOL, seed=seed, noise_gain=noise_gain)
