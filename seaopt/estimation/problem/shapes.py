"""Names for the shapes of a fit's arrays. Within a function one letter is one length (jaxtyping)."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

Vector = Float[np.ndarray, " n"]  # one number per unknown
Matrix = Float[np.ndarray, "n n"]
ParameterVector = Float[np.ndarray, " p"]  # of the plants' free parameters alone
ParameterMatrix = Float[np.ndarray, "p p"]
PerOutput = Float[np.ndarray, " ny"]
Signal = Float[np.ndarray, " n"]  # samples of one channel
Parts = list[Float[np.ndarray, "..."]]  # samples of one channel, segment by segment
