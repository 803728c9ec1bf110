"""The law on the machine: what logs recorded under it say."""

from seaopt.machine.acceptance import Acceptance, accept
from seaopt.machine.replay import Cause, Replay

__all__ = ["Acceptance", "Cause", "Replay", "accept"]
