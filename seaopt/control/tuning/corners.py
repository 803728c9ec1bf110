"""Choose parameter values at which a controller must hold while it is tuned: corners of ranges, and draws."""

from __future__ import annotations

import itertools
from collections.abc import Mapping

import numpy as np

from seaopt.control.laws.delay import Drive
from seaopt.control.loops.sampled_plant import DRIVE_DELAY
from seaopt.errors import ControlError, require_seed
from seaopt.estimation import Fit
from seaopt.estimation.result.covariance import take_root
from seaopt.parameters import Parameter, ParameterSet

MOST_CORNERS = 256


def corners(ranges: Mapping[str, tuple[float, float]]) -> list[dict[str, float]]:
    """Return every combination of the ends of ranges.

    Parameters
    ----------
    ranges : mapping of name to (low, high)
        At most eight.

    Raises
    ------
    ControlError
        A range is empty, or there are more than 256 corners.

    Examples
    --------
    >>> corners({"I_p": (0.2, 0.6)})
    [{'I_p': 0.2}, {'I_p': 0.6}]
    """
    for name, (low, high) in ranges.items():
        if not low <= high:
            raise ControlError(f"ranges: {name} = ({low:g}, {high:g}) is empty; give (low, high)")
    if 2 ** len(ranges) > MOST_CORNERS:
        raise ControlError(f"ranges names {len(ranges)} parameters, with too many corners; use draw instead")
    return [dict(zip(ranges, map(float, ends), strict=True)) for ends in itertools.product(*ranges.values())]


def draw(
    parameters: Fit | ParameterSet,
    count: int,
    seed: int,
    ranges: Mapping[str, tuple[float, float]] | None = None,
    drive: Drive | None = None,
) -> list[dict[str, float]]:
    """Draw parameter values: a fit's joint normal distribution, or prior_stds, and uniform ranges.

    Parameters
    ----------
    parameters : Fit or ParameterSet
        Values are kept within their bounds.
    count : int
        How many draws.
    seed : int
        The same seed gives the same draws.
    ranges : mapping of name to (low, high), optional
        Parameters drawn uniformly instead.
    drive : Drive, optional
        Whose delay is drawn with a fit's parameters, as uncertain as the fit left it; `laws.delay.find_drive` finds it.

    Raises
    ------
    ControlError
        Nothing is uncertain.

    Examples
    --------
    >>> import seaopt as so
    >>> [sorted(values) for values in draw(so.plants.thor().prior(k=3000.0), 2, 1, {"I_p": (0.2, 0.6)})]
    [['I_p', 'k'], ['I_p', 'k']]
    """
    rng, uniform = np.random.default_rng(require_seed(seed, ControlError)), dict(ranges or {})
    if isinstance(parameters, Fit):
        values, covariance = parameters.parameters, parameters.total_covariance
        if drive is not None:
            covariance = drive.take_covariance(parameters)
            values = values.with_parameters(Parameter(name=DRIVE_DELAY, value=drive.delay_s, unit="s", min=0.0))
        names, matrix = list(covariance.names), np.asarray(covariance.matrix)
    else:
        values = parameters
        names = [name for name, parameter in values.items() if parameter.prior_std is not None]
        matrix = np.diag([float(values[name].prior_std or 0.0) ** 2 for name in names])
    used = [i for i, name in enumerate(names) if name in values and name not in uniform and np.isfinite(matrix[i, i])]
    if not used and not uniform:
        raise ControlError("parameters has no covariance and no prior_std, and there are no ranges: nothing to draw")
    names, matrix = [names[i] for i in used], matrix[used][:, used]
    mean, root = np.array([values[name].value for name in names]), take_root(matrix)
    out: list[dict[str, float]] = []
    for _ in range(count):
        normal = mean + root @ rng.normal(size=mean.size)
        drawn = {
            name: float(np.clip(value, values[name].min, values[name].max))
            for name, value in zip(names, normal, strict=True)
        }
        out.append(drawn | {name: float(rng.uniform(low, high)) for name, (low, high) in uniform.items()})
    return out
