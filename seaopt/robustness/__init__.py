"""One controller, many plants: margins, worst case and Monte Carlo certificate."""

from seaopt.robustness.batch import BatchFigures, batch_figures
from seaopt.robustness.certificate import Certificate, MonteCarlo, Requirement, Worst, certify, failure_bound

__all__ = [
    "BatchFigures", "Certificate", "MonteCarlo", "Requirement", "Worst", "batch_figures", "certify", "failure_bound",
]  # fmt: skip
