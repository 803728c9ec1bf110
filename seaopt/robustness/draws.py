"""Parameter draws: the fit's joint distribution, truncated to the bounds, and the declared ranges."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from seaopt.errors import ControlError, suggestion
from seaopt.estimation import Fit
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant

MAX_REJECTION = 200


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Uncertainty:
    """What is not known of the parameters.

    Parameters
    ----------
    nominal : ParameterSet
        Fitted or given values, with bounds.
    names : tuple of str
        The uncertain ones of the Gaussian part, with `covariance`, shape (n, n).
    ranges : mapping of name to (low, high)
        Uniform, independent of the rest.

    """

    nominal: ParameterSet
    names: tuple[str, ...]
    covariance: Float[np.ndarray, "n n"]
    ranges: Mapping[str, tuple[float, float]]

    def draw(self, count: int, rng: np.random.Generator) -> dict[str, Float[np.ndarray, " n"]]:
        """Return `count` draws by name; Gaussian draws outside a bound are drawn again.

        Raises
        ------
        ControlError
            The bounds leave next to nothing of the distribution.

        """
        out: dict[str, Float[np.ndarray, " n"]] = {}
        if self.names:
            mean = np.array(self.nominal.values_of(self.names))
            low = np.array([self.nominal[name].min for name in self.names])
            high = np.array([self.nominal[name].max for name in self.names])
            values, vectors = np.linalg.eigh(self.covariance)
            root = vectors * np.sqrt(np.maximum(values, 0.0))
            kept = np.empty((0, mean.size))
            for _ in range(MAX_REJECTION):
                fresh = mean + rng.normal(size=(count, mean.size)) @ root.T
                kept = np.vstack([kept, fresh[np.all((fresh >= low) & (fresh <= high), axis=1)]])
                if len(kept) >= count:
                    break
            else:
                raise ControlError(
                    f"fewer than 1 in {MAX_REJECTION} draws of {', '.join(self.names)} lie inside their bounds; "
                    "widen the bounds or measure more"
                )
            out |= dict(zip(self.names, kept[:count].T, strict=True))
        for name, (low_end, high_end) in self.ranges.items():
            out[name] = rng.uniform(low_end, high_end, count)
        return out


def uncertainty(
    source: Fit | ParameterSet,
    others: ParameterSet,
    ranges: Mapping[str, tuple[float, float]],
    plants: Mapping[str, Plant],
) -> Uncertainty:
    """Return what is not known: the fit's covariance (or prior_stds, of a ParameterSet) and the ranges.

    `others` has the values of parameters that `source` does not; those with a prior_std are uncertain too.

    Raises
    ------
    ControlError
        The fit leaves a parameter undetermined, or a range is empty or names nothing.

    """
    known = {name for plant in plants.values() for name in plant.parameters}
    for name, (low, high) in ranges.items():
        if name not in known:
            raise ControlError(f'range of "{name}": no plant has it; {suggestion(name, known)}')
        if not low <= high:
            raise ControlError(f"range of {name} = [{low:g}, {high:g}] is empty; give [low, high]")
        bounds = [plant.defaults[name] for plant in plants.values() if name in plant.defaults]
        if any(low < item.min or high > item.max for item in bounds):
            raise ControlError(
                f"range of {name} = [{low:g}, {high:g}] leaves the bounds [{bounds[0].min:g}, {bounds[0].max:g}]; "
                "keep inside them"
            )
    if isinstance(source, Fit):
        nominal, names, matrix = source.parameters, source.covariance.names, source.covariance.matrix
        if source.status not in ("converged", "not_identifiable"):
            raise ControlError(f"the fit has not converged ({source.message}); nothing can be certified from it")
        for name in names:
            if not np.isfinite(source.covariance.std(name)) and name not in ranges:
                raise ControlError(
                    f"parameter {name} is not identifiable in the fit, so nothing can be certified; "
                    "fix it, give it a prior_std, or give its range"
                )
        known_within = [item for item in nominal.values() if item.prior_std is not None and item.name not in names]
        others = others.subset(name for name in others if name not in nominal).with_parameters(*known_within)
    else:
        if any(item.std is not None for item in source.values()):
            raise ControlError(
                "the parameters come from a fit, whose covariance they do not carry; give the Fit itself"
            )
        nominal, names, matrix = ParameterSet(), (), np.zeros((0, 0))
        others = others.with_parameters(*source.values())
    stds = {name: item.prior_std for name, item in others.items() if item.prior_std is not None}
    whole = np.zeros((len(names) + len(stds),) * 2)
    whole[: len(names), : len(names)] = matrix
    whole[len(names) :, len(names) :] = np.diag(np.square(list(stds.values())))
    every = (*names, *stds)
    used = [i for i, name in enumerate(every) if name not in ranges and name in known and np.isfinite(whole[i, i])]
    return Uncertainty(
        nominal=nominal.with_parameters(*others.values()), names=tuple(every[i] for i in used),
        covariance=whole[np.ix_(used, used)], ranges=dict(ranges),
    )  # fmt: skip
