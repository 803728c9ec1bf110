"""The classical step of Runge and Kutta, of order four."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any


def runge_kutta_step(rate: Callable[[Any, Any], Any], t: Any, x: Any, h: Any) -> Any:
    """Return x after a step of Runge's and Kutta's fourth order with the rate (t, x) -> dx/dt."""
    k1 = rate(t, x)
    k2 = rate(t + h / 2, x + h / 2 * k1)
    k3 = rate(t + h / 2, x + h / 2 * k2)
    k4 = rate(t + h, x + h * k3)
    return x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
