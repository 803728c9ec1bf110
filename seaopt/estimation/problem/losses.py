"""What a residual costs: its square, or less where it may be an outlier."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from seaopt.errors import EstimationError
from seaopt.records import record
from seaopt.simulation import RobustLoss


@record
class Linear:
    """Plain least squares."""


@record
class Huber:
    """Squares up to `threshold` sigma, absolute values beyond (Huber 1964): outliers pull less.

    Parameters
    ----------
    threshold : float
        In sigma; 1.345 keeps 95 % of the efficiency on Gaussian noise.

    """

    threshold: float = 1.345

    def __post_init__(self) -> None:
        _check_threshold("Huber", self.threshold)


@record
class SoftL1:
    """Squares near zero that bend smoothly into absolute values: 2 (sqrt(1 + s^2) - 1), s in thresholds.

    Parameters
    ----------
    threshold : float
        In sigma.

    """

    threshold: float = 1.345

    def __post_init__(self) -> None:
        _check_threshold("SoftL1", self.threshold)


def _check_threshold(name: str, value: float) -> None:
    if not 0.0 < value < np.inf:
        raise EstimationError(f"{name}(threshold={value:g}): give a positive number of sigmas")


Loss = Linear | Huber | SoftL1
NAMES: dict[type, RobustLoss] = {Linear: "square", Huber: "huber", SoftL1: "soft_l1"}  # of the passes


def pull_of(loss: Loss, r: Float[np.ndarray, "n ny"]) -> Float[np.ndarray, "n ny"]:
    """Return the loss's derivative at each residual, in sigma."""
    if isinstance(loss, Huber):
        return np.clip(r, -loss.threshold, loss.threshold)
    return r if isinstance(loss, Linear) else r / np.sqrt(1.0 + (r / loss.threshold) ** 2)


def curvature_of(loss: Loss, r: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Return the loss's second derivative at each residual, in sigma."""
    if isinstance(loss, Huber):
        return (np.abs(r) <= loss.threshold).astype(float)
    return np.ones_like(r) if isinstance(loss, Linear) else (1.0 + (r / loss.threshold) ** 2) ** -1.5
