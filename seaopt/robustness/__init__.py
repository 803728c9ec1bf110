"""One controller, many plants: margins, worst case and Monte Carlo certificate."""

from seaopt.robustness.batch import BatchFigures, batch_figures
from seaopt.robustness.certificate import Certificate, MonteCarlo, Requirement
from seaopt.robustness.certify import certify, failure_bound
from seaopt.robustness.draws import check_ranges, placed
from seaopt.robustness.nominal import PlantMargins, plant_margins
from seaopt.robustness.worst import Witness, Worst

__all__ = [
    "BatchFigures", "Certificate", "MonteCarlo", "PlantMargins", "Requirement", "Witness", "Worst", "batch_figures",
    "certify", "check_ranges", "failure_bound", "placed", "plant_margins",
]  # fmt: skip
