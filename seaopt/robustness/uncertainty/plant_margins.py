"""The margins of one controller on one plant: the classical ones, disks, and the exact delay of a sampled loop."""

from __future__ import annotations

from typing import Any

from seaopt.control import Controller
from seaopt.control.loops.margins import Margins, margins, nu_gap
from seaopt.control.running.fed_back import close_terms
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.records import record
from seaopt.robustness.uncertainty.delay_margin import LONGEST_DELAY, sampled_delay_margin

SEARCHED_DELAYS = 3.0  # how far beyond the classical delay margin, and two samples, the sampled one is looked for


@record
class PlantMargins:
    """Margins of a plant's loop.

    Parameters
    ----------
    margins : Margins
        Gain, phase and delay both ways, every crossing, and disk margins with their witnesses.
    sampled_delay_s : float or None
        The smallest extra delay that makes the loop unstable when the plant is sampled with that delay in it; None:
        none up to `searched_delay_s`. The classical `margins.delay_s` treats the delay as a phase,
        which is exact for whole samples only.
    searched_delay_s : float
        The end of the search: three times the classical margin and two samples, up to 20,000 samples. A delay
        that long is beyond what the loop's model means.
    nu_gap, nu_gap_hz : float and float or None
        Vinnicombe's gap of this plant's loop gain to the design plant's. It says little here: docs/theory/margins.md.
    """

    margins: Margins
    sampled_delay_s: float | None
    searched_delay_s: float
    nu_gap: float
    nu_gap_hz: float | None

    def to_dict(self) -> dict[str, Any]:
        """Return the fields as they stand in robustness.json."""
        return {
            "gain_margin_up_db": self.margins.gain_up_db,
            "gain_margin_down_db": self.margins.gain_down_db,
            "sampled_delay_margin_s": self.sampled_delay_s,
            "disk_margins": {
                kind: {
                    "alpha": disk.alpha,
                    "frequency_hz": disk.frequency_hz,
                    "perturbation": [disk.perturbation.real, disk.perturbation.imag],
                    "gain_range": list(disk.gain_range),
                    "phase_deg": disk.phase_deg,
                }
                for kind, disk in self.margins.disks.items()
            },
            "nu_gap": self.nu_gap,
        }


def plant_margins(controller: Controller, plant: Plant, params: ParameterSet) -> PlantMargins:
    """Measure the margins of a controller on a plant, with what its terms feed back; it knows its design plant."""
    loop, whole = controller.close(plant, params), close_terms(controller, plant)
    classical = margins(whole.close(plant, params))
    assert controller.design is not None
    design, values = controller.design
    gap, gap_hz = nu_gap(controller.close(design, values), loop)
    period = controller.sample_time_s
    reach = min(SEARCHED_DELAYS * ((classical.delay_s or 0.0) + 2 * period), LONGEST_DELAY * period)
    exact = sampled_delay_margin(whole, plant, params, reach) if classical.disks else 0.0
    return PlantMargins(margins=classical, sampled_delay_s=exact, searched_delay_s=reach, nu_gap=gap, nu_gap_hz=gap_hz)
