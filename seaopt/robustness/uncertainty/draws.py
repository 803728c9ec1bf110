"""Parameter draws: the fit's joint distribution, truncated to the bounds, and the declared ranges.

A range may name a parameter of a plant, a condition (`seaopt.control.loops.sampled_plant`: an angle such as phi,
delay_s), or ``screw_mode_hz``: the frequency of the screw's mode, which its effective mass m_n sets, all else being
nominal, on the first plant that has the part; the other plants get that mass.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import field, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from seaopt.control.loops.sampled_plant import conditions
from seaopt.errors import ControlError, suggestion
from seaopt.estimation import Fit
from seaopt.parameters import Parameter, ParameterSet
from seaopt.plants import Plant, state_space
from seaopt.records import record
from seaopt.units import factor

MAX_REJECTION = 200
LEVEL = 0.999  # of the fit's distribution that the worst case is looked for in
SCREW_MODE, SCREW_MASS = "screw_mode_hz", "m_n"


@record
class Varied:
    """One thing that is drawn, SI.

    Parameters
    ----------
    name, unit : str
    value : float or None
        Nominal; None where there is none (`screw_mode_hz`).
    std : float or None
        Of a Gaussian, correlated as in the fit and cut at `low` and `high`; None of a uniform range.
    low, high : float

    """

    name: str
    unit: str
    value: float | None
    std: float | None
    low: float
    high: float

    @property
    def outside(self) -> bool:
        """Whether the nominal value lies outside a range."""
        return self.std is None and self.value is not None and not self.low <= self.value <= self.high

    def __str__(self) -> str:
        unit = "" if self.unit == "-" else f" {self.unit}"
        if self.std is None:
            return f"{self.name} {self.low:.4g} to {self.high:.4g}{unit}"
        return f"{self.name} {self.value:.5g} +- {self.std:.2g}{unit}"


@record(eq=False)
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
    screw : (frequencies, masses)
        Which effective mass m_n puts the screw's mode where, ascending in frequency; for a range of screw_mode_hz.
    absent : mapping of name to Parameter
        What a range may name that `nominal` has no value of: the plants' defaults, and conditions.

    """

    nominal: ParameterSet
    names: tuple[str, ...]
    covariance: Float[np.ndarray, "n n"]
    ranges: Mapping[str, tuple[float, float]]
    screw: tuple[Float[np.ndarray, " m"], Float[np.ndarray, " m"]] = (np.empty(0), np.empty(0))
    absent: Mapping[str, Parameter] = field(default_factory=dict[str, Parameter])

    @property
    def size(self) -> int:
        """Number of coordinates: of the Gaussian part, then of the ranges."""
        return len(self.names) + len(self.ranges)

    def varied(self) -> tuple[Varied, ...]:
        """Return what is drawn and how, the Gaussian part first."""
        stds, known = np.sqrt(np.diag(self.covariance)), {**self.absent, **self.nominal}
        found = [
            Varied(name=name, unit=item.unit, value=item.value, std=float(std), low=item.min, high=item.max)
            for name, std in zip(self.names, stds, strict=True)
            for item in (self.nominal[name],)
        ]
        for name, (low, high) in self.ranges.items():
            item = known.get(name)
            unit, value = ("Hz", None) if item is None else (item.unit, item.value)
            found.append(Varied(name=name, unit=unit, value=value, std=None, low=low, high=high))
        return tuple(found)

    def draw(self, count: int, rng: np.random.Generator) -> Float[np.ndarray, "n k"]:
        """Return `count` draws as coordinates; Gaussian draws outside a bound are drawn again.

        A coordinate of the Gaussian part is in standard deviations along a principal axis of the correlation; one of a
        range runs from -1 to 1.

        Raises
        ------
        ControlError
            The bounds leave next to nothing of the distribution.

        """
        width = len(self.names)
        kept = np.empty((0 if width else count, width))
        for _ in range(MAX_REJECTION):
            if len(kept) >= count:
                break
            fresh = rng.normal(size=(count, width))
            kept = np.vstack([kept, fresh[self.inside(fresh)]])
        if len(kept) < count:
            raise ControlError(
                f"fewer than 1 in {MAX_REJECTION} draws of {', '.join(self.names)} lie inside their bounds; "
                "widen the bounds or measure more"
            )
        return np.hstack([kept[:count], rng.uniform(-1.0, 1.0, (count, len(self.ranges)))])

    def inside(self, coordinates: Float[np.ndarray, "n k"]) -> Bool[np.ndarray, " n"]:
        """Tell which points of the Gaussian part lie inside the parameters' bounds."""
        low = np.array([self.nominal[name].min for name in self.names])
        high = np.array([self.nominal[name].max for name in self.names])
        values = self._gaussian(coordinates)
        return np.all((values >= low) & (values <= high), axis=1)

    def values(self, coordinates: Float[np.ndarray, "n k"]) -> dict[str, Float[np.ndarray, " n"]]:
        """Return the parameters and conditions at the coordinates, by name."""
        out = dict(zip(self.names, self._gaussian(coordinates).T, strict=True))
        for (name, (low, high)), t in zip(self.ranges.items(), coordinates[:, len(self.names) :].T, strict=True):
            value = 0.5 * (low + high) + 0.5 * (high - low) * t
            if name == SCREW_MODE:
                out[SCREW_MASS] = np.interp(value, self.screw[0], self.screw[1])
            else:
                out[name] = value
        return out

    def slopes(self, coordinates: Float[np.ndarray, "n k"]) -> dict[str, Float[np.ndarray, "n k"]]:
        """Return the derivatives of `values` with respect to the coordinates, by name."""
        count, width = coordinates.shape
        out: dict[str, Float[np.ndarray, "n k"]] = {}
        for name, row in zip(self.names, self.factor(), strict=True):
            out[name] = np.zeros((count, width))
            out[name][:, : row.size] = row
        for i, (name, (low, high)) in enumerate(self.ranges.items(), start=len(self.names)):
            slope = np.full(count, 0.5 * (high - low))
            if name == SCREW_MODE:
                steps = np.diff(self.screw[1]) / np.diff(self.screw[0])
                value = 0.5 * (low + high) + slope * coordinates[:, i]
                slope *= steps[np.clip(np.searchsorted(self.screw[0], value) - 1, 0, steps.size - 1)]
            own = SCREW_MASS if name == SCREW_MODE else name
            out[own] = np.zeros((count, width))
            out[own][:, i] = slope
        return out

    def bounds(
        self, coordinates: Float[np.ndarray, "n k"]
    ) -> Iterator[tuple[Float[np.ndarray, " k"], Float[np.ndarray, " n"]]]:
        """Give each finite bound of the Gaussian part: its outward normal, and each point's distance from it."""
        values = self._gaussian(coordinates)
        for j, (name, row) in enumerate(zip(self.names, self.factor(), strict=True)):
            item, std = self.nominal[name], float(np.linalg.norm(row))
            if std == 0.0:
                continue
            normal = np.concatenate([row, np.zeros(len(self.ranges))]) / std
            if np.isfinite(item.max):
                yield normal, (item.max - values[:, j]) / std
            if np.isfinite(item.min):
                yield -normal, (values[:, j] - item.min) / std

    def factor(self) -> Float[np.ndarray, "g g"]:
        """Return the covariance's factor, coordinates to parameters: standard deviations times the correlation's root.

        Of the correlation, whose entries are alike: the eigenvalues of a covariance in m, N/m and kg m^2 span so many
        decades that the small ones would be rounding.
        """
        std = np.sqrt(np.diag(self.covariance))
        scale = np.where(std > 0.0, std, 1.0)
        values, vectors = np.linalg.eigh(self.covariance / scale / scale[:, None])
        return std[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))

    def _gaussian(self, coordinates: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "n g"]:
        mean = np.array(self.nominal.values_of(self.names))
        return mean + coordinates[:, : mean.size] @ self.factor().T


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
    check_ranges(ranges, plants)
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
    nominal = nominal.with_parameters(*others.values())
    nominal, scale = _in_plant_units(nominal, plants)
    factors = np.array([scale.get(name, 1.0) for name in every])
    whole *= factors[:, None] * factors
    _check_inside(ranges, nominal)
    screw = _screw_masses(plants, nominal, ranges[SCREW_MODE]) if SCREW_MODE in ranges else (np.empty(0), np.empty(0))
    return Uncertainty(
        nominal=nominal, names=tuple(every[i] for i in used), covariance=whole[np.ix_(used, used)],
        ranges={name: (float(low), float(high)) for name, (low, high) in ranges.items()}, screw=screw,
        absent={name: item for plant in plants.values() for name, item in plant.defaults.items()}
        | conditions(tuple(plants.values())),
    )  # fmt: skip


def _in_plant_units(nominal: ParameterSet, plants: Mapping[str, Plant]) -> tuple[ParameterSet, dict[str, float]]:
    """Return the values in the plants' units, and what each was multiplied by."""
    scale: dict[str, float] = {}
    for plant in plants.values():
        own = plant.complete(nominal)
        shared = [name for name in own if name in nominal]
        scale |= {name: factor(nominal[name].unit, own[name].unit) for name in shared if name not in scale}
        nominal = nominal.with_parameters(*(own[name] for name in shared))
    return nominal, scale


def _check_inside(ranges: Mapping[str, tuple[float, float]], nominal: ParameterSet) -> None:
    """Refuse ranges beyond the given parameters' own bounds, which may be narrower than the plant's."""
    known = dict(nominal)
    for name, (low, high) in ranges.items():
        item = known.get(name)
        if item is not None and (low < item.min or high > item.max):
            raise ControlError(
                f"range of {name} = [{low:g}, {high:g}] leaves the bounds [{item.min:g}, {item.max:g}] of the given "
                "parameters; keep inside them, or widen them"
            )


def check_ranges(ranges: Mapping[str, tuple[float, float]], plants: Mapping[str, Plant]) -> None:
    """Refuse ranges that are empty, leave a parameter's bounds or name nothing.

    Raises
    ------
    ControlError
        As said.

    """
    extra = conditions(tuple(plants.values()))
    parameters = {name: plant.defaults.get(name) for plant in plants.values() for name in plant.parameters}
    known = [*parameters, *extra, *([SCREW_MODE] if SCREW_MASS in parameters else [])]
    if not isinstance(ranges, Mapping):
        raise ControlError(f"ranges is a {type(ranges).__name__}; give a mapping of name to (low, high)")
    for name, given in ranges.items():
        if name not in known:
            what = 'add parts = ["screw_mode"] to one' if name == SCREW_MODE else suggestion(str(name), known)
            raise ControlError(f'range of "{name}": no plant has it; {what}')
        low, high = _ends(name, given)
        if not (np.isfinite(low) and np.isfinite(high)):
            raise ControlError(f"range of {name} = [{low:g}, {high:g}] is not finite; give [low, high]")
        if not low <= high:
            raise ControlError(f"range of {name} = [{low:g}, {high:g}] is empty; give [low, high]")
        item = extra.get(name) or parameters.get(name)
        if item is not None and item.unit == "rad" and name in extra and max(-low, high) > np.pi:
            raise ControlError(
                f"range of {name} = [{low:g}, {high:g}] is more than half a turn; angles are in rad, "
                f"30 deg is {np.radians(30):.4g}"
            )
        if item is not None and (low < item.min or high > item.max):
            raise ControlError(
                f"range of {name} = [{low:g}, {high:g}] leaves the bounds [{item.min:g}, {item.max:g}]; "
                "keep inside them"
            )
    if SCREW_MODE in ranges and SCREW_MASS in ranges:
        raise ControlError(f"ranges of {SCREW_MODE} and {SCREW_MASS} say the same thing; keep one")


def _ends(name: str, given: Any) -> tuple[float, float]:
    """Return low and high of what should be two numbers."""
    pair = list(given) if isinstance(given, (list, tuple, np.ndarray)) else []
    if len(pair) != 2 or any(isinstance(item, bool) or not isinstance(item, (int, float, np.number)) for item in pair):
        raise ControlError(f"range of {name} = {' '.join(repr(given).split())} is not a range; give (low, high)")
    return float(pair[0]), float(pair[1])


def placed(
    plant: Plant, params: ParameterSet, name: str, value: float, plants: Mapping[str, Plant]
) -> ParameterSet | None:
    """Return a plant's parameters with what a range may name at a value; None where the plant does not have it.

    Raises
    ------
    ControlError
        The screw's mode cannot be there.

    """
    values, extra = plant.complete(params), conditions((plant,))
    if name == SCREW_MODE and SCREW_MASS in values:
        frequencies, masses = _screw_masses(plants, params, (value, value))
        return values.update(**{SCREW_MASS: float(np.interp(value, frequencies, masses))})
    if name in values:
        return values.update(**{name: value})
    return values.with_parameters(replace(extra[name], value=value)) if name in extra else None


def _screw_masses(
    plants: Mapping[str, Plant], nominal: ParameterSet, wanted: tuple[float, float]
) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, " m"]]:
    """Return frequencies of the screw's mode and the masses that give them, ascending in frequency."""
    plant = next(item for item in plants.values() if SCREW_MASS in item.parameters)
    complete = plant.complete(nominal)
    masses = complete[SCREW_MASS].value * np.geomspace(20.0, 0.05, 400)
    place = list(plant.states).index("s")
    found = np.empty(masses.size)
    for k, mass in enumerate(masses):
        values, vectors = np.linalg.eig(state_space(plant, complete.update(**{SCREW_MASS: float(mass)}))[0])
        part = np.abs(vectors[place] * np.linalg.inv(vectors)[:, place]) * (np.imag(values) > 0.0)
        found[k] = np.abs(values[np.argmax(part)]) / (2 * np.pi)
    turns = np.flatnonzero(np.diff(found) <= 0.0)
    start = int(turns[-1]) + 1 if turns.size else 0
    frequencies, masses = found[start:], masses[start:]
    if wanted[0] < frequencies[0] or wanted[1] > frequencies[-1]:
        raise ControlError(
            f"range of {SCREW_MODE} = [{wanted[0]:g}, {wanted[1]:g}] is beyond what {SCREW_MASS} alone can do, "
            f"{frequencies[0]:.3g} to {frequencies[-1]:.3g} Hz; keep inside, or give ranges of k_b and {SCREW_MASS}"
        )
    return frequencies, masses


def radius(dimensions: int) -> float:
    """Return the radius in standard deviations that holds LEVEL of a Gaussian."""
    from scipy.special import gammaincinv

    return float(np.sqrt(2.0 * gammaincinv(0.5 * dimensions, LEVEL))) if dimensions else 0.0
