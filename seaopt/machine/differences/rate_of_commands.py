r"""The rate at which a law is stepped, told by what the machine made of its logged commands.

Law and log go by ticks, the machine by seconds. Where the command is at its limit in every period there is no response
to read the rate off, but the commands are known all the same: the model's readings under them, held for the ticks of
another rate, are off from the logged ones by

.. math:: \rho = \frac{\sum |y - G_T u - M x_0 - m|^2}{\sum |y - \bar y|^2}

over stretches of some rows, each from a state :math:`x_0` and a mean m of its own. At the right rate little is left,
whatever the limit does; machines of values that are usual are nearer than those at another usual rate.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from seaopt.control import Controller
from seaopt.errors import SeaoptError
from seaopt.machine.differences.explanations import USUAL_RATES
from seaopt.machine.differences.size_fit import Difference
from seaopt.machine.stepped import list_powers
from seaopt.machine.ticks import Ticks
from seaopt.plants.friction import take_sliding

ROWS, STRETCHES = 1000, 6  # of a stretch, and how many
LITTLE = 0.05  # of the readings' energy, that the right rate leaves at most
LESS = 0.1  # of what the log's own rate leaves


def find_rate(controller: Controller, ticks: Ticks) -> Difference | None:
    """Return the usual rate at which the commands of a log explain its readings, where that of its clock does not; None
    where none does, or the controller does not know its plant.
    """
    if controller.design is None:
        return None
    whole = ticks.take(np.flatnonzero(ticks.complete))
    own = measure_left(controller, whole, 1.0)
    left = {rate: measure_left(controller, whole, rate) for rate in USUAL_RATES}
    rate = min(left, key=lambda each: left[each])
    if left[rate] > min(LITTLE, LESS * own):
        return None
    value = rate / controller.sample_time_s
    explains = 1.0 - left[rate] / own
    return Difference(
        kind="rate", name="law", value=value, low=None, high=None, unit="Hz", explains=explains, size=rate
    )  # fmt: skip


def measure_left(controller: Controller, ticks: Ticks, rate: float) -> float:
    """Return what a model at a rate leaves of the readings' energy; infinite where it cannot be sampled so."""
    from scipy.signal import fftconvolve  # deferred: 0.3 s

    assert controller.design is not None
    plant, values = controller.design
    try:
        model = controller.plant(take_sliding(plant, values), values, rate=rate)
    except SeaoptError:
        return np.inf
    rows = min(ROWS, len(ticks))
    starts = np.unique(np.linspace(0, len(ticks) - rows, STRETCHES).astype(int))
    late, left, energy = model.delay_samples, 0.0, 0.0
    effort = np.concatenate([np.zeros(late), ticks.command / controller.per_effort])[: len(ticks)]
    for start in starts:
        part = slice(start, start + rows)
        for c, d, values_read in zip(model.c, model.d, ticks.measured[part].T, strict=True):
            modes = list_powers(c, model.a, rows)
            answer = fftconvolve(np.concatenate([[d], modes[:-1] @ model.b]), effort[part])[:rows]
            off = _leave_state(values_read - answer, modes)
            left, energy = left + float(off @ off), energy + rows * float(np.var(values_read))
    return left / energy if energy and np.isfinite(left) else np.inf


def _leave_state(off: Float[np.ndarray, " n"], modes: Float[np.ndarray, "n m"]) -> Float[np.ndarray, " n"]:
    """Return what is left of values without what a state at the first row and a mean add to them."""
    table = np.column_stack([modes, np.ones(off.size)])
    size = np.linalg.norm(table, axis=0)
    table = table / np.where(size > 0.0, size, 1.0)
    return off - table @ np.linalg.lstsq(table, off, rcond=1e-10)[0]
