"""The virtual test stand: a log of any plant, as sensors would record it."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import fields

import numpy as np

from seaopt.bench.excitation import Excitation, excite
from seaopt.errors import SeaoptError, SimulationError, require_memory, require_seed, suggestion
from seaopt.logs import Log
from seaopt.options import option
from seaopt.parameters import ParameterSet
from seaopt.plants import CompletedParameters, Plant
from seaopt.plants.sensors.deflection import evaluate_weights
from seaopt.records import record
from seaopt.signals import Signal, VectorN
from seaopt.simulation import simulate


@record(keywords=True)
class Sensors:
    """Errors of the sensors of each output, by name; what is left out is ideal.

    An output that is computed from encoders (`deflection_sensor`) has their errors besides its own.
    """

    noise_std: Mapping[str, float] = option(
        "White Gaussian noise, in the output's unit.", default_factory=dict[str, float], least=0.0
    )
    offset: Mapping[str, float] = option("A constant that is added.", default_factory=dict[str, float])
    quantisation: Mapping[str, float] = option(
        "The step that readings are rounded to.", default_factory=dict[str, float], least=0.0
    )
    saturation: Mapping[str, float] = option(
        "Readings are clipped to plus and minus this.", default_factory=dict[str, float], least=0.0
    )

    @property
    def names(self) -> tuple[str, ...]:
        """Whose errors these are."""
        return tuple(dict.fromkeys(name for each in fields(self) for name in getattr(self, each.name)))

    @property
    def erring(self) -> set[str]:
        """Those whose readings are off, clipped or rounded, besides noise."""
        return {*self.offset, *self.saturation, *self.quantisation}

    def refuse_negative(self, names: Collection[str], error: type[SeaoptError]) -> None:
        """Refuse what cannot be negative, of these."""
        for kind in ("noise_std", "quantisation", "saturation"):
            for name in names:
                value = getattr(self, kind).get(name, 0.0)
                if not value >= 0.0:
                    raise error(f"{kind} of {name} = {value:g} is negative; give zero or more")

    def of(self, names: Collection[str]) -> Sensors:
        """Return the errors of these alone."""
        return Sensors(
            **{
                each.name: {name: value for name, value in getattr(self, each.name).items() if name in names}
                for each in fields(self)
            }
        )

    def read(self, name: str, values: VectorN, rng: np.random.Generator) -> VectorN:
        """Return what the sensor of one output records."""
        out = values + self.offset.get(name, 0.0) + self.noise_std.get(name, 0.0) * rng.normal(size=values.size)
        limit, step = self.saturation.get(name), self.quantisation.get(name)
        if limit is not None:
            out = np.clip(out, -limit, limit)
        return step * np.floor(out / step + 0.5) if step else out

    def convert(self, name: str, value: float) -> float:
        """Return one reading of a value that has its noise: offset added, clipped, rounded to the nearest step."""
        limit, step = self.saturation.get(name), self.quantisation.get(name)
        reading = value + self.offset.get(name, 0.0)
        if limit is not None:
            reading = min(max(reading, -limit), limit)
        return step * math.floor(reading / step + 0.5) if step else reading

    def combine_errors(self, plant: Plant, params: CompletedParameters, name: str) -> tuple[float, float]:
        """Return noise (std) and rounding (step) of an output, of those encoders included that it is computed from.

        Several roundings are as one of a step that has the same variance, the step's square over 12.
        """
        weights = {**evaluate_weights(plant, params, name), name: 1.0}
        noise, step = (
            math.hypot(*(weight * errors.get(source, 0.0) for source, weight in weights.items()))
            for errors in (self.noise_std, self.quantisation)
        )
        return noise, step


def virtual_log(
    plant: Plant,
    params: ParameterSet,
    excitation: Excitation,
    *,
    duration_s: float,
    rate_hz: float,
    seed: int,
    sensors: Sensors | None = None,
    initial_state: Mapping[str, float] | None = None,
    input_name: str | None = None,
) -> Log:
    """Record a virtual experiment.

    Parameters
    ----------
    plant, params
        The actuator on the bench and its true parameters.
    excitation : tuple of Chirp, Noise, Multisine
        Summed, held between samples, fed to one input.
    duration_s, rate_hz : float
        Length and sample rate.
    seed : int
        Of the excitation's noise and the sensors'; the same seed gives the same log.
    sensors : Sensors, optional
        Ideal ones if left out.
    initial_state : mapping, optional
        At rest at zero where left out.
    input_name : str, optional
        The input that is excited; the plant's first if left out. The others are zero.

    Returns
    -------
    Log
        The inputs and every output of the plant.

    Examples
    --------
    >>> import seaopt as so
    >>> from seaopt.bench import PAPER_STAND
    >>> log = virtual_log(so.plants.high_impedance(), so.plants.thor(), PAPER_STAND, duration_s=1, rate_hz=400, seed=1)
    >>> len(log), sorted(log.signals)
    (400, ['F1', 'F2', 'I', 'q'])
    """
    devices = sensors if sensors is not None else Sensors()
    for name in devices.names:
        if name not in plant.outputs:
            raise SimulationError(f'sensor of "{name}": no such output; {suggestion(name, plant.outputs)}')
    devices.refuse_negative(devices.names, SimulationError)
    excited = input_name if input_name is not None else next(iter(plant.inputs))
    if excited not in plant.inputs:
        raise SimulationError(f'input "{excited}" is not one of the plant; {suggestion(excited, plant.inputs)}')
    per_sample = 4.0 * (len(plant.states) + len(plant.outputs))  # of numbers, as measured, where all is at its largest
    argument = f"duration_s = {duration_s:g} at rate_hz = {rate_hz:g}"
    require_memory(per_sample * duration_s * rate_hz, argument, SimulationError)
    streams = np.random.default_rng(require_seed(seed, SimulationError)).spawn(1 + len(plant.outputs))
    time, drive = excite(excitation, duration_s=duration_s, rate_hz=rate_hz, rng=streams[0])
    inputs = {name: drive if name == excited else np.zeros(time.size) for name in plant.inputs}
    commanded = Log(
        time=time,
        signals={name: Signal(name=name, values=values, unit=plant.inputs[name]) for name, values in inputs.items()},
        source=f"virtual {plant.name}",
    )
    truth = simulate(plant, params, commanded, initial_state=initial_state)
    signals = dict(commanded.signals)
    values, computed = plant.complete(params), plant.sensing.from_encoders if plant.sensing is not None else ()
    for name, stream in sorted(zip(plant.outputs, streams[1:], strict=True), key=lambda pair: pair[0] in computed):
        reading = truth[name]
        for encoder, weight in evaluate_weights(plant, values, name).items():
            if encoder in plant.outputs:
                reading = reading + weight * (signals[encoder].values - truth[encoder])
        signals[name] = Signal(name=name, values=devices.read(name, reading, stream), unit=plant.outputs[name])
    return Log(time=time, signals=signals, source=f"virtual {plant.name}, seed {seed}")
