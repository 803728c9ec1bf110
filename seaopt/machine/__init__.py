"""The law on the machine: what logs recorded under it say."""

from seaopt.machine.acceptance import Acceptance, accept
from seaopt.machine.differences import Difference, Differences
from seaopt.machine.replay import Cause, Replay
from seaopt.machine.response import Judged, Response

__all__ = ["Acceptance", "Cause", "Difference", "Differences", "Judged", "Replay", "Response", "accept"]
