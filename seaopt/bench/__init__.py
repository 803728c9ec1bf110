"""Virtual test stand and excitations."""

from seaopt.bench.excitation import PAPER_STAND, PAPER_SWING, Chirp, Excitation, Multisine, Noise, excite, scale
from seaopt.bench.virtual import Sensors, virtual_log

__all__ = [
    "PAPER_STAND", "PAPER_SWING", "Chirp", "Excitation", "Multisine", "Noise", "Sensors", "excite", "scale",
    "virtual_log",
]  # fmt: skip
