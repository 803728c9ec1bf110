"""Steps of an impedance's equilibrium position x_0, simulated on the nonlinear plant whose link moves.

What the linear sampled loop says of an impedance leaves out saturation, friction that sticks and the geometry of a
lever. Here the law as exported, with its outer loop, moves the link by a small and a large step and has to bring it to
rest. Friction may hold it short of where it should end, so that only rest is required, and how far it ends is stated.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from seaopt.codec import OrInfinite, OrNaN
from seaopt.control import Controller
from seaopt.control.impedance.link import find_link
from seaopt.control.impedance.moving_loop import close_link
from seaopt.formatting import format_percent
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.plants.friction import can_stick, find_dry_friction
from seaopt.plants.plant import output_function
from seaopt.records import record
from seaopt.robustness.verification.judgement import find_saturated, take_ends
from seaopt.robustness.verification.oscillation import Signal
from seaopt.robustness.verification.playback import Rig, play
from seaopt.robustness.verification.scenarios import NOMINAL_EFFORT, Phase, Scenario

SHARES = (0.05, 0.5)  # of the effort that the current limit holds at rest
FRICTION_SHARES = (0.5, 5.0)  # times the dry friction, where there is no limit
FARTHEST_RAD = 0.3  # that a link which turns is moved
TIME_CONSTANTS, LEAST_SAMPLES, LONGEST_S = 12.0, 200, 20.0
LAST_SHARE = 0.2  # of a run, over which the link has to be at rest
AT_REST = 0.02  # of the step: peak to peak of a link at rest


@record
class ImpedanceStep:
    """A step of x_0 as it was simulated; what is not its size is a share of the step."""

    size: float  # of x_0, m or rad
    moving: OrInfinite  # peak to peak of the link over the last fifth of the run; infinite where it runs away
    end: OrNaN  # where the link ends
    overshoot: OrNaN  # how far it goes beyond that
    saturated: bool  # the command reached its limit

    @property
    def rests(self) -> bool:
        """The link came to rest."""
        return self.moving <= AT_REST

    def describe(self, unit: str) -> str:
        """Return what it did, in one line."""
        if not math.isfinite(self.moving):
            return f"a simulated step of {self.size:.3g} {unit} runs away"
        limit = ", at the command's limit" if self.saturated else ""
        what = (
            f"ends at {format_percent(self.end)} of it and overshoots by {format_percent(self.overshoot)}"
            if self.rests
            else f"goes on moving by {format_percent(self.moving)} of it, peak to peak"
        )
        return f"a simulated step of {self.size:.3g} {unit} {what}{limit}"


def play_impedance_steps(controller: Controller, plant: Plant, params: ParameterSet) -> tuple[ImpedanceStep, ...]:
    """Simulate steps of x_0 with a controller's outer loop; none where it renders no stiffness."""
    outer = controller.outer
    assert outer is not None and plant.port is not None and plant.port.motion is not None
    if not outer.stiffness > 0.0:
        return ()
    motion, completed = str(plant.port.motion), plant.complete(params)
    # A gate that gives its sensor up lets the link hang, which would pass for rest.
    rig = Rig(controller=replace(controller, gate=None), plant=plant)
    samples, farthest = _count_samples(controller, plant, completed), _find_farthest(plant, completed)
    holding, dry = controller.force_limit(0.0), sum(find_dry_friction(plant, completed).values())
    efforts = [NOMINAL_EFFORT[controller.command.mechanics]]  # N or N m, that a step asks for at once
    if holding is not None:
        efforts = [share * holding for share in SHARES]
    elif dry:
        efforts = [share * dry for share in FRICTION_SHARES]
    steps: list[ImpedanceStep] = []
    for effort in efforts:
        size = min(effort / outer.stiffness, farthest)
        push = Phase(duration_s=samples * outer.sample_time_s, force_N=outer.direction * outer.stiffness * size)
        scenario = Scenario(name="step of x_0", phases=(push,), friction="sticking" if can_stick(plant) else "smooth")
        run = play(rig, scenario, [params])
        saturated = find_saturated(run.current, rig.law.command_limit) > 0.0
        steps.append(_measure(run.outputs[motion][0], size, saturated))
    return tuple(steps)


def _measure(path: Signal, size: float, saturated: bool) -> ImpedanceStep:
    if not np.all(np.isfinite(path)):
        return ImpedanceStep(size=size, moving=np.inf, end=np.nan, overshoot=np.nan, saturated=saturated)
    last = take_ends(path, [path.size], path.size - int((1.0 - LAST_SHARE) * path.size))
    end = float(np.mean(last))
    return ImpedanceStep(
        size=size,
        moving=float(np.ptp(last)) / size,
        end=end / size,
        overshoot=max(float(np.max(path)) - end, 0.0) / size,
        saturated=saturated,
    )


def _find_farthest(plant: Plant, params: ParameterSet) -> float:
    """Return how far the link is moved at most: a link that turns by `FARTHEST_RAD`."""
    assert plant.port is not None
    coordinate = plant.port.coordinate
    if coordinate is None or plant.states[coordinate] != "rad":
        return np.inf
    x = np.zeros(len(plant.states))
    x[list(plant.states).index(coordinate)] = FARTHEST_RAD
    outputs = output_function(plant)(0.0, x, np.zeros(len(plant.inputs)), plant.complete(params).vector)
    return abs(float(outputs[list(plant.outputs).index(str(plant.port.motion))]))


def _count_samples(controller: Controller, plant: Plant, params: ParameterSet) -> int:
    """Return how many samples the slowest mode of the linear loop takes to end."""
    assert controller.outer is not None
    loop = close_link(find_link(controller, plant, params), controller.outer.velocity_filter_s)
    radius = float(loop.radius(controller.outer.stiffness, controller.outer.damping))
    longest = int(LONGEST_S / controller.sample_time_s)
    if not radius < 1.0:
        return longest
    slow = -1.0 / math.log(max(radius, math.exp(-1.0)))
    return int(np.clip(TIME_CONSTANTS * slow, LEAST_SAMPLES, longest))
