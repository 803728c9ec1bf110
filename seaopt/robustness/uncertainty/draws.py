"""The uncertainty of the parameters, and draws of it: the fit's joint distribution and the declared ranges.

A range may name a parameter of a plant, a condition (`seaopt.control.loops.sampled_plant`: an angle such as phi,
delay_s), or the frequency of a mode that a plant declares, such as ``screw_mode_hz``: one parameter sets it, the
screw's effective mass m_n, all else being nominal, on the first plant that has the mode; the other plants get that
value.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import field, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from seaopt.codec import OrInfinite, OrMinusInfinite
from seaopt.control.laws.delay import Drive
from seaopt.control.loops.sampled_plant import DRIVE_DELAY, conditions
from seaopt.errors import ControlError, suggestion
from seaopt.estimation import Fit
from seaopt.estimation.result.covariance import take_root
from seaopt.parameters import Parameter, ParameterSet
from seaopt.plants import PARTS, Mode, Plant, state_space
from seaopt.plants.friction import leave_out_waves
from seaopt.records import record
from seaopt.units import factor

MAX_REJECTION = 200
LEVEL = 0.999  # probability of the part of the fit's distribution in which the worst case is searched
Points = Float[np.ndarray, "n k"]  # draws as coordinates, a row each
Column = Float[np.ndarray, " n"]  # a quantity, an entry per draw
Plants = Mapping[str, Plant]
Ranges = Mapping[str, tuple[float, float]]
Source = Fit | ParameterSet  # of the parameters


@record
class Varied:
    """One quantity that is drawn, in SI units."""

    name: str
    unit: str
    value: float | None  # nominal; None where there is none (a mode's frequency)
    std: float | None  # of a Gaussian, correlated as in the fit and cut at `low` and `high`; None for a uniform range
    low: OrMinusInfinite
    high: OrInfinite

    @property
    def outside(self) -> bool:
        """Whether the nominal value lies outside a range."""
        return self.std is None and self.value is not None and not self.low <= self.value <= self.high

    def __str__(self) -> str:
        unit = "" if self.unit == "-" else f" {self.unit}"
        if self.std is None:
            return f"{self.name} {self.low:.4g} to {self.high:.4g}{unit}"
        return f"{self.name} {self.value:.5g} ± {self.std:.2g}{unit}"


@record(eq=False)
class ModeMap:
    """Which values of a parameter put a mode where, ascending in frequency."""

    parameter: str
    frequency_hz: Column
    value: Column

    def values_at(self, frequency_hz: Column) -> Column:
        """Return the parameter's values that put the mode at frequencies."""
        return np.interp(frequency_hz, self.frequency_hz, self.value)

    def slopes_at(self, frequency_hz: Column) -> Column:
        """Return the derivatives of `values_at`."""
        steps = np.diff(self.value) / np.diff(self.frequency_hz)
        return steps[np.clip(np.searchsorted(self.frequency_hz, frequency_hz) - 1, 0, steps.size - 1)]


@record(eq=False)
class Uncertainty:
    """The uncertainty of the parameters: a Gaussian part, and ranges.

    Parameters
    ----------
    nominal : ParameterSet
        Fitted or given values, with bounds.
    names : tuple of str
        The uncertain parameters of the Gaussian part, with `covariance`, shape (n, n).
    ranges : mapping of name to (low, high)
        Uniform, independent of the rest.
    modes : mapping of name to ModeMap
        For every range of a mode's frequency, which values of its parameter put it where.
    absent : mapping of name to Parameter
        What a range may name besides `nominal`: the plants' defaults, and conditions.
    """

    nominal: ParameterSet
    names: tuple[str, ...]
    covariance: Float[np.ndarray, "n n"]
    ranges: Ranges
    modes: Mapping[str, ModeMap] = field(default_factory=dict[str, ModeMap])
    absent: Mapping[str, Parameter] = field(default_factory=dict[str, Parameter])

    @property
    def size(self) -> int:
        """Number of coordinates: of the Gaussian part, then of the ranges."""
        return len(self.names) + len(self.ranges)

    def varied(self) -> tuple[Varied, ...]:
        """Return what is drawn and how, the Gaussian part first."""
        stds, parameters = np.sqrt(np.diag(self.covariance)).tolist(), {**self.absent, **self.nominal}
        quantities = [
            (name, std, parameters[name].min, parameters[name].max) for name, std in zip(self.names, stds, strict=True)
        ]
        quantities += [(name, None, low, high) for name, (low, high) in self.ranges.items()]
        varied: list[Varied] = []
        for name, std, low, high in quantities:
            unit, value = (parameters[name].unit, parameters[name].value) if name in parameters else ("Hz", None)
            varied.append(Varied(name=name, unit=unit, value=value, std=std, low=low, high=high))
        return tuple(varied)

    def draw(self, count: int, rng: np.random.Generator) -> Points:
        """Return `count` draws as coordinates; Gaussian draws outside a bound are drawn again.

        Coordinates of the Gaussian part are standard deviations along the principal axes of the correlation; those of
        the ranges run from -1 to 1. Raises ControlError: the bounds leave almost nothing of the distribution.
        """
        width = len(self.names)
        kept, tries = np.empty((0 if width else count, width)), 0
        while len(kept) < count and tries < MAX_REJECTION:
            fresh, tries = rng.normal(size=(count, width)), tries + 1
            kept = np.vstack([kept, fresh[self.inside(fresh)]])
        if len(kept) < count:
            raise ControlError(
                f"fewer than 1 in {MAX_REJECTION} draws of {', '.join(self.names)} lie inside their bounds; "
                "widen the bounds or measure more"
            )
        return np.hstack([kept[:count], rng.uniform(-1.0, 1.0, (count, len(self.ranges)))])

    def inside(self, coordinates: Points) -> Bool[np.ndarray, " n"]:
        """Return which points of the Gaussian part lie inside the parameters' bounds."""
        bounds = [self.nominal[name] for name in self.names]
        low, high = np.array([each.min for each in bounds]), np.array([each.max for each in bounds])
        values = self._gaussian_values(coordinates)
        return np.all((values >= low) & (values <= high), axis=1)

    def values(self, coordinates: Points) -> dict[str, Column]:
        """Return the parameters and conditions at the coordinates, by name."""
        out = dict(zip(self.names, self._gaussian_values(coordinates).T, strict=True))
        for (name, (low, high)), t in zip(self.ranges.items(), coordinates[:, len(self.names) :].T, strict=True):
            value = 0.5 * (low + high) + 0.5 * (high - low) * t
            mode = self.modes.get(name)
            out[name if mode is None else mode.parameter] = value if mode is None else mode.values_at(value)
        return out

    def list_draws(self, count: int, rng: np.random.Generator) -> list[dict[str, float]]:
        """Return `count` draws, each as values of the parameters and conditions by name."""
        values = self.values(self.draw(count, rng))
        return [{name: float(column[k]) for name, column in values.items()} for k in range(count)]

    def slopes(self, coordinates: Points) -> dict[str, Points]:
        """Return the derivatives of `values` with respect to the coordinates, by name."""
        count, width = coordinates.shape
        out: dict[str, Points] = {}
        for name, row in zip(self.names, self.factor(), strict=True):
            out[name] = np.zeros((count, width))
            out[name][:, : row.size] = row
        for i, (name, (low, high)) in enumerate(self.ranges.items(), start=len(self.names)):
            slope = np.full(count, 0.5 * (high - low))
            mode = self.modes.get(name)
            if mode is not None:
                slope *= mode.slopes_at(0.5 * (low + high) + slope * coordinates[:, i])
            varied = name if mode is None else mode.parameter
            out[varied] = np.zeros((count, width))
            out[varied][:, i] = slope
        return out

    def bounds(self, coordinates: Points) -> Iterator[tuple[Float[np.ndarray, " k"], Column]]:
        """Yield each finite bound of the Gaussian part: its outward normal, and each point's distance from it."""
        values = self._gaussian_values(coordinates)
        for j, (name, row) in enumerate(zip(self.names, self.factor(), strict=True)):
            parameter, std = self.nominal[name], float(np.linalg.norm(row))
            if std == 0.0:
                continue
            normal = np.concatenate([row, np.zeros(len(self.ranges))]) / std
            if np.isfinite(parameter.max):
                yield normal, (parameter.max - values[:, j]) / std
            if np.isfinite(parameter.min):
                yield -normal, (values[:, j] - parameter.min) / std

    def factor(self) -> Float[np.ndarray, "g g"]:
        """Return the covariance's factor, coordinates to parameters."""
        return take_root(self.covariance)

    def _gaussian_values(self, coordinates: Points) -> Float[np.ndarray, "n g"]:
        mean = np.array(self.nominal.values_of(self.names))
        return mean + coordinates[:, : mean.size] @ self.factor().T


def combine_uncertainty(
    source: Source, supplement: ParameterSet, ranges: Ranges, plants: Plants, drive: Drive | None = None
) -> Uncertainty:
    """Combine a fit's covariance, of noise and model, (or prior_stds) and the declared ranges into one description.

    `supplement` has the values of parameters that `source` lacks; those with a prior_std are uncertain too. `drive` has
    the drive's delay, which is uncertain as the fit of one experiment left it, together with the parameters.

    Raises
    ------
    ControlError
        The fit leaves a parameter of these plants undetermined, or a range is empty or names nothing.
    """
    from scipy.linalg import block_diag  # deferred: scipy is slow to load

    plant_names = {name for plant in plants.values() for name in plant.parameters} | {DRIVE_DELAY}
    check_ranges(ranges, plants)
    if isinstance(source, Fit):
        covariance = source.total_covariance if drive is None else drive.take_covariance(source)
        nominal, names, matrix = source.parameters, covariance.names, covariance.matrix
        if source.status not in ("converged", "not_identifiable"):
            raise ControlError(
                f"the fit has not converged ({source.message}), so nothing can be certified; fit again (seaopt fit "
                "PROBLEM), and mend what that names"
            )
        for name in names:
            if name in plant_names and name not in ranges and not np.isfinite(covariance.std(name)):
                raise ControlError(
                    f"parameter {name} is not identifiable in the fit, so nothing can be certified; "
                    "fix it, give it a prior_std, or give its range"
                )
        with_prior = [p for p in nominal.values() if p.prior_std is not None and p.name not in names]
        supplement = supplement.subset(name for name in supplement if name not in nominal).with_parameters(*with_prior)
    else:
        if any(p.std is not None for p in source.values()):
            raise ControlError(
                "the parameters come from a fit, whose covariance they do not carry; give the Fit itself"
            )
        nominal, names, matrix = ParameterSet(), (), np.zeros((0, 0))
        supplement = supplement.with_parameters(*source.values())
    stds = {name: p.prior_std for name, p in supplement.items() if p.prior_std is not None}
    whole = np.asarray(block_diag(matrix, np.diag(np.square(list(stds.values())))))
    uncertain = (*names, *stds)
    used = [
        i for i, name in enumerate(uncertain) if name not in ranges and name in plant_names and np.isfinite(whole[i, i])
    ]
    nominal = nominal.with_parameters(*supplement.values())
    if drive is not None:
        nominal = nominal.with_parameters(Parameter(name=DRIVE_DELAY, value=drive.delay_s, unit="s", min=0.0))
    nominal, scale = _in_plant_units(nominal, plants)
    factors = np.array([scale.get(name, 1.0) for name in uncertain])
    whole *= factors[:, None] * factors
    _check_inside(ranges, nominal)
    ranged = {name: plant for name, plant in find_modes(plants).items() if name in ranges}
    modes = {name: _tabulate_mode(plant, nominal, ranges[name]) for name, plant in ranged.items()}
    return Uncertainty(
        nominal=nominal,
        names=tuple(uncertain[i] for i in used),
        covariance=whole[used][:, used],
        ranges={name: (float(low), float(high)) for name, (low, high) in ranges.items()},
        modes=modes,
        absent={name: default for plant in plants.values() for name, default in plant.defaults.items()}
        | conditions(tuple(plants.values())),
    )


def _in_plant_units(nominal: ParameterSet, plants: Plants) -> tuple[ParameterSet, dict[str, float]]:
    """Return the values in the plants' units, and what each was multiplied by."""
    scale: dict[str, float] = {}
    for plant in plants.values():
        complete = plant.complete(nominal)
        shared = [name for name in complete if name in nominal]
        scale |= {name: factor(nominal[name].unit, complete[name].unit) for name in shared if name not in scale}
        nominal = nominal.with_parameters(*(complete[name] for name in shared))
    return nominal, scale


def _check_inside(ranges: Ranges, nominal: ParameterSet) -> None:
    """Refuse ranges beyond the given parameters' own bounds, which may be narrower than the plant's."""
    for name, (low, high) in ranges.items():
        if name in nominal and (low < nominal[name].min or high > nominal[name].max):
            raise ControlError(
                f"range of {name} = [{low:g}, {high:g}] leaves the bounds [{nominal[name].min:g}, "
                f"{nominal[name].max:g}] of the given parameters; keep inside them, or widen them"
            )


def check_ranges(ranges: Ranges, plants: Plants) -> None:
    """Check the ranges against the plants.

    Raises
    ------
    ControlError
        A range is empty or not finite, leaves a parameter's bounds, or names nothing that a plant has.
    """
    extra = conditions(tuple(plants.values()))
    parameters = {name: plant.defaults.get(name) for plant in plants.values() for name in plant.parameters}
    modes = {name: _mode(plant).parameter for name, plant in find_modes(plants).items()}
    allowed = [*parameters, *extra, *modes]
    if not isinstance(ranges, Mapping):
        raise ControlError(f"ranges is a {type(ranges).__name__}; give a mapping of name to (low, high)")
    for name, ends in ranges.items():
        if name not in allowed:
            part = str(name).removesuffix("_hz")
            remedy = f'add parts = ["{part}"] to one' if part in PARTS else suggestion(str(name), allowed)
            raise ControlError(f'range of "{name}": no plant has it; {remedy}')
        low, high = _read_ends(name, ends)
        for wrong, what in ((not np.isfinite(high - low), "not finite"), (low > high, "empty")):
            if wrong:
                raise ControlError(f"range of {name} = [{low:g}, {high:g}] is {what}; give [low, high]")
        parameter = extra.get(name) or parameters.get(name)
        if parameter is not None and parameter.unit == "rad" and name in extra and max(-low, high) > np.pi:
            raise ControlError(
                f"range of {name} = [{low:g}, {high:g}] is more than half a turn; angles are in rad, "
                f"30 deg is {np.radians(30):.4g}"
            )
        if parameter is not None and (low < parameter.min or high > parameter.max):
            raise ControlError(
                f"range of {name} = [{low:g}, {high:g}] leaves the bounds [{parameter.min:g}, {parameter.max:g}]; "
                "keep inside them"
            )
    for name, parameter in modes.items():
        if name in ranges and parameter in ranges:
            raise ControlError(f"ranges of {name} and {parameter} both set the mode; keep one")


def _read_ends(name: str, value: Any) -> tuple[float, float]:
    """Return low and high of a value that should be a pair of numbers."""
    ends = list(value) if isinstance(value, (list, tuple, np.ndarray)) else []
    if len(ends) != 2 or any(isinstance(end, bool) or not isinstance(end, (int, float, np.number)) for end in ends):
        raise ControlError(f"range of {name} = {' '.join(repr(value).split())} is not a range; give (low, high)")
    return float(ends[0]), float(ends[1])


def place_value(plant: Plant, params: ParameterSet, name: str, value: float, plants: Plants) -> ParameterSet | None:
    """Return a plant's parameters with what a range may name set to a value; None where the plant does not have it.

    Raises
    ------
    ControlError
        A mode cannot be there.
    """
    values, extra = plant.complete(params), conditions((plant,))
    modes = find_modes(plants)
    if name in modes and _mode(modes[name]).parameter in values:
        table = _tabulate_mode(modes[name], params, (value, value))
        return values.update(**{table.parameter: float(table.values_at(np.array([value]))[0])})
    if name in values:
        return values.update(**{name: value})
    return values.with_parameters(replace(extra[name], value=value)) if name in extra else None


def find_modes(plants: Plants) -> dict[str, Plant]:
    """Return the modes that a range may name, each with the first plant that has it."""
    modes: dict[str, Plant] = {}
    for plant in plants.values():
        if plant.mode is not None:
            modes.setdefault(plant.mode.name, plant)
    return modes


def _mode(plant: Plant) -> Mode:
    assert plant.mode is not None  # of `find_modes`
    return plant.mode


def _tabulate_mode(plant: Plant, nominal: ParameterSet, wanted: tuple[float, float]) -> ModeMap:
    """Tabulate where the values of one parameter put a plant's mode."""
    plant = leave_out_waves(plant)
    mode, complete = _mode(plant), plant.complete(nominal)
    values = complete[mode.parameter].value * np.geomspace(20.0, 0.05, 400)
    row = list(plant.states).index(mode.state)
    frequencies = np.empty(values.size)
    for k, value in enumerate(values):
        poles, vectors = np.linalg.eig(state_space(plant, complete.update(**{mode.parameter: float(value)}))[0])
        part = np.abs(vectors[row] * np.linalg.inv(vectors)[:, row]) * (np.imag(poles) > 0.0)
        frequencies[k] = np.abs(poles[np.argmax(part)]) / (2 * np.pi)
    turns = np.flatnonzero(np.diff(frequencies) <= 0.0)
    start = int(turns[-1]) + 1 if turns.size else 0
    frequencies, values = frequencies[start:], values[start:]
    if wanted[0] < frequencies[0] or wanted[1] > frequencies[-1]:
        raise ControlError(
            f"range of {mode.name} = [{wanted[0]:g}, {wanted[1]:g}] is beyond what {mode.parameter} alone can do, "
            f"{frequencies[0]:.3g} to {frequencies[-1]:.3g} Hz; keep inside, or give ranges of the parameters"
        )
    return ModeMap(parameter=mode.parameter, frequency_hz=frequencies, value=values)


def confidence_radius(dimensions: int) -> float:
    """Return the radius, in standard deviations, of the ball that contains LEVEL of a Gaussian."""
    from scipy.special import gammaincinv

    return float(np.sqrt(2.0 * gammaincinv(0.5 * dimensions, LEVEL))) if dimensions else 0.0
