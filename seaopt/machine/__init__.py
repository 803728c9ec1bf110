"""The law on the machine: the stages of its bring-up, and what logs recorded under it say."""

from seaopt.machine.acceptance import Acceptance, accept
from seaopt.machine.bringup.expected import Band
from seaopt.machine.bringup.files import write_bring_up
from seaopt.machine.bringup.plan import BringUp, Stage
from seaopt.machine.bringup.stages import bring_up
from seaopt.machine.causes import Cause
from seaopt.machine.differences.certified import Differences
from seaopt.machine.differences.explanations import Difference
from seaopt.machine.replay import Replay
from seaopt.machine.response.verdicts import Judged, Response

__all__ = [
    "Acceptance", "Band", "BringUp", "Cause", "Difference", "Differences", "Judged", "Replay", "Response", "Stage",
    "accept", "bring_up", "write_bring_up",
]  # fmt: skip
