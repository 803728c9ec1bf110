"""A plant with friction, as the tuner keeps a margin on it or looks at how its friction falls."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from seaopt.control.loops.friction_loop import FrictionLoop
from seaopt.plants import Plant
from seaopt.plants.friction import Friction
from seaopt.records import record


@record(eq=False)
class PlantWithFriction:
    """A plant with friction of which a margin is asked, or that grows as it slides."""

    plant: int  # which of the task's plants slides as it does
    model: Plant  # with its friction
    loop: FrictionLoop  # with its friction taken out; its own law does not matter
    flattest: Float[np.ndarray, " p"]  # slope of each friction, N s/m (N m s/rad), which the loop has in it
    multiplier: str = ""  # of the margin aimed at; empty while none is chosen, and then nothing is asked

    def find_fall(self) -> tuple[Friction, float]:
        """Return the friction that falls most with speed, and how steeply."""
        steepest = int(np.argmin(self.flattest))
        return list(self.model.friction.values())[steepest], -float(self.flattest[steepest])
