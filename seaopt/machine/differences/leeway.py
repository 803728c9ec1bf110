r"""By how much a machine that was certified may be off its model's response, so that a fault beside it is told.

A machine with a fault is not the nominal one besides: its friction or efficiency is another within what was certified.
Over the draws of the certificate the response's deviation is, to first order,

.. math:: \Delta \log G = \sum_i z_i\, s_i(f), \qquad z = V c,

with z the drawn values beyond the nominal ones, s what each adds, and c coordinates along the principal axes of the
draws, in which these are not correlated. A cause of the size :math:`\theta` is judged with the c that go best with it,

.. math:: \chi^2(\theta) = \min_c \sum_k |\hat G_k - G_k(\theta) \exp(\sum_i c_i d_{ik})|^2/s_k^2
          + \tfrac12 \sum_i c_i^2/\sigma_i^2,

none of them further from zero than the draws go.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Complex, Float

from seaopt.records import record

FELT = 1e-6  # of the largest spread along an axis: one below is none


@record(eq=False)
class Leeway:
    """Directions in which the logarithm of certified machines' responses differs, and how far."""

    directions: Complex[np.ndarray, "d m"]
    std: Float[np.ndarray, " d"]
    low: Float[np.ndarray, " d"]
    high: Float[np.ndarray, " d"]


@record(eq=False)
class Spread:
    """The values that the draws of a certificate have beyond the nominal ones, each in units of its own spread."""

    names: tuple[str, ...]
    nominal: tuple[float, ...]
    sizes: tuple[float, ...]
    beyond: Float[np.ndarray, "j n"]

    @property
    def places(self) -> list[dict[str, float]]:
        """One value each, beyond the nominal one by its spread."""
        return [{name: at + size} for name, at, size in zip(self.names, self.nominal, self.sizes, strict=True)]

    def leave(self, slopes: Complex[np.ndarray, "n m"], *names: str) -> Leeway:
        """Return the leeway of all values but those whose size is sought. `slopes`: what each place adds to the
        logarithm of the response.
        """
        kept = [i for i, each in enumerate(self.names) if each not in names]
        if not kept:
            none = np.zeros(0)
            return Leeway(directions=slopes[kept], std=none, low=none, high=none)
        axes, along = self.find_axes(kept)
        return Leeway(
            directions=axes @ slopes[kept],
            std=np.sqrt(np.mean(along**2, axis=0)),
            low=np.minimum(np.min(along, axis=0), 0.0),
            high=np.maximum(np.max(along, axis=0), 0.0),
        )

    def find_axes(self, kept: Sequence[int]) -> tuple[Float[np.ndarray, "d k"], Float[np.ndarray, "j d"]]:
        """Return the principal axes of some of the values, and where along them each draw is."""
        left, spreads, axes = np.linalg.svd(self.beyond[:, kept], full_matrices=False)
        felt = spreads > FELT * spreads[0]
        return axes[felt], (left * spreads)[:, felt]

    def move(self, beyond: Float[np.ndarray, " n"]) -> dict[str, float]:
        """Return values so far beyond the nominal ones, in units of their spread."""
        parts = zip(self.names, self.nominal, self.sizes, beyond.tolist(), strict=True)
        return {name: at + size * far for name, at, size, far in parts}


def take_spread(draws: Sequence[Mapping[str, float]], nominal: Mapping[str, float]) -> Spread:
    """Return the spread of draws in the values that vary. `nominal`: of the model; of what it does not name, the mean
    of the draws.
    """
    table = {name: np.array([draw[name] for draw in draws]) for name in (draws[0] if draws else ())}
    at = {name: nominal.get(name, float(np.mean(column))) for name, column in table.items()}
    sizes = {name: float(np.sqrt(np.mean((column - at[name]) ** 2))) for name, column in table.items()}
    names = tuple(name for name, size in sizes.items() if size > 0.0)
    columns = [(table[name] - at[name]) / sizes[name] for name in names]
    return Spread(
        names=names,
        nominal=tuple(at[name] for name in names),
        sizes=tuple(sizes[name] for name in names),
        beyond=np.array(columns).reshape(len(names), len(draws)).T,
    )
