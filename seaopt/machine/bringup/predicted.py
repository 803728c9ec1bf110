"""What certified machines do under a stage's own reference, as acceptance will judge its log.

With dry friction the loop is another one at each amplitude. Where a law compensates friction by what it is asked, under
a reference of the friction's size the machine may break a limit of its law that it keeps at a larger amplitude; such a
log does not tell whether the machine keeps it. The reference is therefore played to the design plant and to draws of
what was certified before it is planned.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from seaopt.bench import Sensors
from seaopt.control import Controller
from seaopt.machine.bringup.excitation import Excitation
from seaopt.machine.differences.comparison import Comparison
from seaopt.machine.response.judged import Prediction
from seaopt.machine.response.periods import shorten
from seaopt.machine.response.verdicts import list_limits, predict_response
from seaopt.machine.ticks import Ticks
from seaopt.robustness.uncertainty.worst import place_values

DRAWN = 20  # draws beside the design plant
MORE, MOST = 1.3, 0.95  # times that a share of the limits is raised, and the largest


def predict_played(
    controller: Controller, excitation: Excitation, draws: Sequence[Mapping[str, float]], sensors: Sensors | None
) -> Prediction:
    """Return what the design plant, and draws of it, do under a reference. `sensors`: the noise of what is read, which
    shakes the motor through its friction.
    """
    assert controller.design is not None
    reference = excitation.reference
    plant, values = controller.design
    ticks = Ticks(
        source="",
        rate_hz=1.0 / controller.sample_time_s,
        reference=reference,
        measured=np.zeros((reference.size, len(controller.signals))),
        further=np.zeros((reference.size, 0)),
        command=np.zeros(reference.size),
    )
    read = () if sensors is None else sensors.of([name for name in controller.signals if name in plant.outputs])
    noise = Sensors(noise_std=read.noise_std) if read and any(read.noise_std.values()) else None
    comparison = Comparison(
        controller=controller, measured=(), logs=[shorten(ticks)], names=controller.signals, shaking=(noise,)
    )
    sets = [values, *(place_values(plant, values, draw) for draw in draws[:DRAWN])]
    return predict_response(controller, comparison.simulate(sets))


def list_broken(controller: Controller, prediction: Prediction) -> list[str]:
    """Return the figures whose limits certified machines break themselves, by what their logs say."""
    turned = ["stability"] if prediction.turned else []
    return turned + [name for name, limit in list_limits(controller).items() if not prediction.peaks[name] <= limit]


def find_share(keeps: Callable[[float], bool], share: float, most: float) -> float | None:
    """Return the least share of the limits, of some that rise from one that is too small, at which a reference `keeps`
    the limits of its law; None where none does. `most`: is tried before any larger one.
    """
    while share < MOST:
        share = min(math.ceil(100.0 * MORE * share) / 100.0, most if share < most else MOST, MOST)
        if keeps(share):
            return share
    return None
