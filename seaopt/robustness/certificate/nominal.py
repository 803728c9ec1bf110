"""What a plant's loop is at nominal parameters beyond its figures: margins, sampled delay margin, gap to the design."""

from __future__ import annotations

from typing import Any

from seaopt.control import Controller
from seaopt.control.loops.margins import Margins, margins, nu_gap
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.records import record
from seaopt.robustness.uncertainty.delay_margin import LONGEST_DELAY, sampled_delay_margin

SEARCHED = 3.0  # how far beyond the classical delay margin, and two samples, the sampled one is looked for


@record
class PlantMargins:
    """Margins of a plant's loop.

    Parameters
    ----------
    margins : Margins
        Gain, phase and delay both ways, every crossing, and disk margins with their witnesses.
    sampled_delay_s : float or None
        The smallest extra delay that makes the loop unstable when the plant is sampled with that delay in it; None:
        none as long as was looked for, `searched_delay_s`. The classical `margins.delay_s` takes the delay for a phase,
        which is exact for whole samples only.
    searched_delay_s : float
        How far it was looked for: three times the classical margin and two samples, up to 20,000 samples. A delay
        that long is beyond what the loop's model means.
    nu_gap, nu_gap_hz : float and float or None
        Vinnicombe's gap of this plant's loop gain to the design plant's. It says little here: see docs/margins.md.

    """

    margins: Margins
    sampled_delay_s: float | None
    searched_delay_s: float
    nu_gap: float
    nu_gap_hz: float | None

    def to_dict(self) -> dict[str, Any]:
        """Return the fields as they stand in robustness.json."""
        found = self.margins
        return {
            "gain_margin_up_db": found.gain_up_db,
            "gain_margin_down_db": found.gain_down_db,
            "sampled_delay_margin_s": self.sampled_delay_s,
            "disk_margins": {
                kind: {
                    "alpha": item.alpha, "frequency_hz": item.frequency_hz,
                    "perturbation": [item.perturbation.real, item.perturbation.imag],
                    "gain_range": list(item.gain_range), "phase_deg": item.phase_deg,
                }
                for kind, item in found.disks.items()
            },
            "nu_gap": self.nu_gap,
        }  # fmt: skip


def plant_margins(controller: Controller, plant: Plant, params: ParameterSet) -> PlantMargins:
    """Return the margins of a controller on a plant; the controller knows its design plant."""
    loop = controller.close(plant, params)
    found = margins(loop)
    assert controller.design is not None
    gap, gap_hz = nu_gap(controller.close(*controller.design), loop)
    period = controller.sample_time_s
    reach = min(SEARCHED * ((found.delay_s or 0.0) + 2 * period), LONGEST_DELAY * period)
    exact = sampled_delay_margin(controller, plant, params, reach) if found.disks else 0.0
    return PlantMargins(margins=found, sampled_delay_s=exact, searched_delay_s=reach, nu_gap=gap, nu_gap_hz=gap_hz)
