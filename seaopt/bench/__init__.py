"""Virtual test stand and excitations."""

from seaopt.bench.excitation import PAPER_STAND, PAPER_SWING, Chirp, Excitation, Noise, excite
from seaopt.bench.virtual import Sensors, virtual_log

__all__ = ["PAPER_STAND", "PAPER_SWING", "Chirp", "Excitation", "Noise", "Sensors", "excite", "virtual_log"]
