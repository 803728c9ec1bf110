"""The cost of a residual: its square, or less where it may be an outlier."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from jaxtyping import Float

from seaopt.errors import EstimationError
from seaopt.records import record
from seaopt.simulation import RobustLoss


@record
class Squares:
    """Plain least squares."""

    kind: ClassVar[RobustLoss] = "square"
    quadratic: ClassVar[bool] = True
    threshold: ClassVar[float] = np.inf

    def slope(self, r: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
        """Return the loss's derivative at each residual, in sigma."""
        return r

    def curvature(self, r: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
        """Return the loss's second derivative at each residual, in sigma."""
        return np.ones_like(r)


@record
class Huber:
    """Squares up to `threshold` sigma, absolute values beyond (Huber 1964): outliers weigh less.

    Parameters
    ----------
    threshold : float
        In sigma; 1.345 keeps 95 % of the efficiency on Gaussian noise.
    """

    kind: ClassVar[RobustLoss] = "huber"
    quadratic: ClassVar[bool] = False
    threshold: float = 1.345

    def __post_init__(self) -> None:
        _check_threshold("Huber", self.threshold)

    def slope(self, r: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
        """Return the loss's derivative at each residual, in sigma."""
        return np.clip(r, -self.threshold, self.threshold)

    def curvature(self, r: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
        """Return the loss's second derivative at each residual, in sigma."""
        return (np.abs(r) <= self.threshold).astype(float)


@record
class SoftL1:
    """Squares near zero that bend smoothly into absolute values: 2 (sqrt(1 + s^2) - 1), s in thresholds.

    Parameters
    ----------
    threshold : float
        In sigma.
    """

    kind: ClassVar[RobustLoss] = "soft_l1"
    quadratic: ClassVar[bool] = False
    threshold: float = 1.345

    def __post_init__(self) -> None:
        _check_threshold("SoftL1", self.threshold)

    def slope(self, r: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
        """Return the loss's derivative at each residual, in sigma."""
        return r / np.sqrt(1.0 + (r / self.threshold) ** 2)

    def curvature(self, r: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
        """Return the loss's second derivative at each residual, in sigma."""
        return (1.0 + (r / self.threshold) ** 2) ** -1.5


def _check_threshold(name: str, value: float) -> None:
    if not 0.0 < value < np.inf:
        raise EstimationError(f"{name}(threshold={value:g}): give a positive number of sigmas")


Loss = Squares | Huber | SoftL1
