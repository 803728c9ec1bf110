r"""What moves a plant besides its inputs, and what its sensors add: the noise that a Kalman filter weighs.

Each input of the plant is the known one plus a white noise plus a random walk, sampled every T:

.. math:: u_k + w_k + d_k, \qquad w_k \sim N(0, s_w^2 / T), \qquad d_{k+1} = d_k + N(0, s_d^2 T)

so that the densities :math:`s_w` and :math:`s_d` do not depend on the sample time, and a noise identified on a log at
one rate serves a filter at another. Sensor noise is white from sample to sample, at any rate.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

from seaopt.errors import ControlError, suggestion
from seaopt.estimation import Fit
from seaopt.options import option
from seaopt.plants import Plant
from seaopt.records import record


@record
class NoiseModel:
    """Standard deviations by name of output and input.

    Raises
    ------
    ControlError
        A value is not a number, is negative, or a sensor's is zero.
    """

    sensor_std: Mapping[str, float] = option("White noise of the measured output, in its unit.", least=0.0)
    input_noise: Mapping[str, float] = option(
        "White noise of the command: standard deviation of its mean over a second, A s^(1/2) for a current. Over one "
        "sample of T seconds it is this over the root of T.",
        default_factory=dict[str, float],
        least=0.0,
    )
    input_drift: Mapping[str, float] = option(
        "Random walk of the command: standard deviation of its change over a second, A s^(-1/2); above zero.",
        default_factory=dict[str, float],
        least=0.0,
    )
    offset: Mapping[str, float] = option(
        "Known offset of the sensor, subtracted before anything else.", default_factory=dict[str, float]
    )

    def __post_init__(self) -> None:
        for field in ("sensor_std", "input_noise", "input_drift", "offset"):
            levels = getattr(self, field)
            if not isinstance(levels, Mapping):
                raise ControlError(f"noise: {field} = {levels!r}; give a mapping of name to value")
            for name, value in levels.items():
                if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
                    raise ControlError(f"noise: {field} of {name} = {value!r} is not a number; give one")
                if field != "offset" and value < 0.0:
                    raise ControlError(f"noise: {field} of {name} = {value:g} is negative; give zero or more")
        for name, value in self.sensor_std.items():
            if value == 0.0:
                raise ControlError(f"noise: sensor_std of {name} = 0; every sensor has some, give its resolution")

    @classmethod
    def from_fit(
        cls,
        fit: Fit,
        *,
        experiment: str = "",
        input_noise: Mapping[str, float] | None = None,
        input_drift: Mapping[str, float] | None = None,
    ) -> NoiseModel:
        """Return the sensors of one of a fit's experiments: residuals' sigma and offsets; the inputs' noise is given.

        Where something besides the input moves the plant the residuals contain that too: `estimate_noise` separates
        them.

        Parameters
        ----------
        fit : Fit
            With outputs, as `fit` returns it.
        experiment : str
            Its name; the first if left out.
        input_noise, input_drift : mapping, optional
            As in `NoiseModel`.

        Raises
        ------
        ControlError
            The fit has no such experiment.
        """
        name = experiment or next(iter(fit.outputs), "")
        if name not in fit.outputs:
            raise ControlError(f'the fit has no experiment "{name}"; {suggestion(name, fit.outputs)}')
        return cls(
            sensor_std={output: scores.rms_residual for output, scores in fit.outputs[name].items()},
            input_noise=dict(input_noise or {}),
            input_drift=dict(input_drift or {}),
            offset=dict(fit.nuisance[name].offset),
        )

    def check(self, plant: Plant, outputs: tuple[str, ...]) -> None:
        """Refuse names that the plant lacks, and a measured output without a sensor."""
        for field in ("sensor_std", "offset", "input_noise", "input_drift"):
            names = plant.inputs if field.startswith("input") else plant.outputs
            for name in getattr(self, field):
                if name not in names:
                    raise ControlError(f'noise: {field} names "{name}"; {suggestion(name, names)}')
        for name in outputs:
            if name not in self.sensor_std:
                raise ControlError(f"noise: sensor_std has nothing for the measured output {name}; give its noise")
