"""Virtual experiments for tests: a plant with known parameters on a bench, and sensors with noise."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from seaopt.bench import PAPER_STAND, Excitation, Sensors, virtual_log
from seaopt.estimation import Experiment
from seaopt.logs import Log
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant

NOISE = 0.01  # of an output's standard deviation, where no noise is given


def virtual_experiment(
    plant: Plant,
    truth: ParameterSet,
    *,
    excitation: Excitation = PAPER_STAND,
    duration_s: float = 20.0,
    rate_hz: float = 400.0,
    seed: int = 1,
    noise_std: Mapping[str, float] | None = None,
    name: str = "virtual",
) -> Experiment:
    """Return an experiment of a plant whose true parameters are known, as a test of a fit needs one.

    Parameters
    ----------
    plant : Plant
        What is on the bench.
    truth : ParameterSet
        Its true parameters.
    excitation : tuple of Chirp, Noise, Multisine
        What drives its first input; the paper's chirp and noise if left out (2 A and 1 A).
    duration_s, rate_hz : float
        Length (s) and sample rate (Hz).
    seed : int
        Of the noise; the same seed gives the same log.
    noise_std : mapping of output to float, optional
        Which outputs are measured, and their noise in their units; if left out those that may be regulated, all if
        none may, with a hundredth of their standard deviation.
    name : str
        Of the experiment.

    Raises
    ------
    SeaoptError
        A parameter has no value, or an output is not the plant's.

    Examples
    --------
    >>> import seaopt as so
    >>> bench = virtual_experiment(so.plants.high_impedance(), so.plants.thor(), duration_s=5)
    >>> bench.outputs, len(bench.log)
    (('F1', 'F2'), 2000)
    """

    def record_log(sensors: Sensors) -> Log:
        return virtual_log(plant, truth, excitation, duration_s=duration_s, rate_hz=rate_hz, seed=seed, sensors=sensors)

    if noise_std is None:
        ideal = record_log(Sensors())
        regulated = plant.sensing.regulated if plant.sensing is not None else ()
        noise_std = {output: NOISE * float(np.std(ideal[output])) for output in regulated or plant.outputs}
    log = record_log(Sensors(noise_std=noise_std))
    return Experiment(plant=plant, log=log, name=name, outputs=tuple(noise_std))
