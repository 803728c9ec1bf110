r"""A score of a force controller on four axes: tracking, apparent impedance, its passivity, noise.

The axes are those of Rampeltshammer, Keemink, Sytsma, van Asseldonk and van der Kooij (Actuators 12(8) 303, 2023), who
compare controllers of series elastic actuators by the tracking with the output locked, the impedance left at the
output, the passivity of that impedance, and what sensor noise becomes. Here all four are of the sampled loop.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from seaopt.codec import to_content
from seaopt.control.laws.controller import Controller
from seaopt.control.laws.passivity import passivity
from seaopt.control.loops.port import hold_response, port_of
from seaopt.errors import ControlError, require_type
from seaopt.formatting import format_number
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.plants.friction import take_sliding
from seaopt.records import Worded, record
from seaopt.units import mechanics_of

LOWEST_HZ, POINTS = 0.1, 600


@record
class Score:
    """What one controller does; figures of the design plant, sliding where it has friction.

    Parameters
    ----------
    bandwidth_hz : float or None
        Of the tracking with the link held.
    reference_peak : float
        Of the tracking, over its static value.
    impedance_1hz : float
        Magnitude of the impedance at the link at 1 Hz, N s/m or N m s/rad; less is more transparent.
    impedance_largest : float
        Its largest from 0.1 Hz to the bandwidth.
    impedance_share : float
        Its root mean square over that band, in logarithmic frequency, of that without control.
    passive_to_hz : float or None
        The frequency up to which the impedance is passive; None where it is up to the Nyquist frequency.
    needed_damping : float
        The damper at the link that makes it passive everywhere; zero where it is.
    noise_gain : float
        Peak over frequency from noise on the regulated signal to effort.
    noise_rms : float
        Root mean square of the effort over that of white noise on the regulated signal.
    unit : str
        Of impedance and damping.
    """

    bandwidth_hz: float | None
    reference_peak: float
    impedance_1hz: float
    impedance_largest: float
    impedance_share: float
    passive_to_hz: float | None
    needed_damping: float
    noise_gain: float
    noise_rms: float
    unit: str

    def to_dict(self) -> dict[str, Any]:
        """Return the figures, for JSON."""
        return to_content(self)

    def cells(self) -> tuple[str, ...]:
        """Return the figures as text, in the order of `HEADS`."""
        whole = "all" if self.passive_to_hz is None else f"{self.passive_to_hz:.3g} Hz"
        return (
            f"{format_number(self.bandwidth_hz, missing='none')} Hz",
            f"{self.reference_peak:.3g}",
            f"{self.impedance_1hz:.3g}",
            f"{self.impedance_largest:.3g}",
            f"{self.impedance_share:.3g}",
            whole,
            f"{self.needed_damping:.3g}",
            f"{self.noise_gain:.3g}",
            f"{self.noise_rms:.3g}",
        )


HEADS = (
    "bandwidth", "peak", "|Z| at 1 Hz", "largest |Z|", "of no control", "passive to", "damper for it", "noise gain",
    "noise rms",
)  # fmt: skip


@record(repr=False)
class Scorecard(Worded):
    """Scores of controllers by name, side by side.

    Parameters
    ----------
    scores : mapping of name to Score
    """

    scores: Mapping[str, Score]

    def __getitem__(self, name: str) -> Score:
        return self.scores[name]

    def to_dict(self) -> dict[str, Any]:
        """Return the scores, for JSON."""
        return to_content(self.scores)

    @property
    def unit(self) -> str:
        """The unit of impedance and damping."""
        return next(iter(self.scores.values())).unit


def scorecard(
    controllers: Mapping[str, Controller], plant: Plant | None = None, parameters: ParameterSet | None = None
) -> Scorecard:
    """Return the `Scorecard` of controllers on four axes: tracking, apparent impedance, its passivity, noise.

    Parameters
    ----------
    controllers : mapping of name to Controller
        Tuned, or laws of one's own (`seaopt.assess`).
    plant, parameters
        The actuator; each controller's own design plant if left out.

    Raises
    ------
    ControlError
        There is no controller, one does not know its design plant, or a plant has no port.

    Examples
    --------
    >>> import seaopt as so
    >>> stand, thor = so.plants.high_impedance(), so.plants.thor()
    >>> controller = so.tune(stand, thor, so.ControllerSpec(bandwidth_hz=30, max_sensitivity=1.6))
    >>> card = scorecard({"pid": controller})
    >>> round(card["pid"].bandwidth_hz), card.unit
    (30, 'N s/m')
    """
    require_type(controllers, Mapping, "controllers", "give {name: controller}", ControlError)
    if not controllers:
        raise ControlError("scorecard got no controller; give {name: controller}")
    scores: dict[str, Score] = {}
    for name, controller in controllers.items():
        require_type(controller, Controller, f"controllers: {name}", "give a Controller", ControlError)
        design = controller.design if plant is None else (plant, parameters or plant.defaults)
        if design is None:
            raise ControlError(
                f"controllers: {name} does not know its design plant; tune it, or give plant and parameters"
            )
        scores[name] = _score(controller, *design)
    return Scorecard(scores=scores)


def _score(controller: Controller, plant: Plant, parameters: ParameterSet) -> Score:
    figures = controller.close(plant, parameters).figures()
    parameters = controller.delay(parameters)
    port = port_of(take_sliding(plant, parameters), parameters, controller.signals, controller.command.per_effort)
    port_passivity = passivity(controller, plant, parameters)
    period = controller.sample_time_s
    top = min(figures.bandwidth_hz or 1.0 / period, 0.49 / period)
    f = np.union1d(np.geomspace(LOWEST_HZ, max(top, 2 * LOWEST_HZ), POINTS), [1.0])
    late = hold_response(f, period, controller.compute_delay_samples)
    response = port.response(f)
    law = -controller.law.responses(f)[1:] * late
    size = np.abs(response.impedance(law))
    share = size / np.abs(response.impedance(np.zeros_like(law)))
    return Score(
        bandwidth_hz=figures.bandwidth_hz,
        reference_peak=figures.reference_peak,
        impedance_1hz=float(size[np.searchsorted(f, 1.0)]),
        impedance_largest=float(np.max(size)),
        impedance_share=float(np.sqrt(np.mean(share**2))),
        passive_to_hz=port_passivity.violated_hz,
        needed_damping=max(-port_passivity.least_damping_N_s_per_m, 0.0) if port_passivity.held_stable else np.inf,
        noise_gain=figures.noise_gain,
        noise_rms=_find_noise_rms(controller, plant, parameters),
        unit=mechanics_of(port.place_unit).damping,
    )


def _find_noise_rms(controller: Controller, plant: Plant, parameters: ParameterSet) -> float:
    """Return the effort's root mean square per unit of white noise on what is measured; infinite where unstable."""
    from scipy.linalg import solve_discrete_lyapunov

    system = controller.close(plant, parameters).system()
    noise = 0 if len(controller.signals) == 1 else 2  # of several signals the inputs are w, reference and noises
    if not np.max(np.abs(system.poles), initial=0.0) < 1.0:
        return np.inf
    block = system.block
    drive, effort = block.b[:, noise], block.c[1]
    covariance: Any = solve_discrete_lyapunov(block.a, np.outer(drive, drive))
    return float(np.sqrt(effort @ covariance @ effort + block.d[1, noise] ** 2))
