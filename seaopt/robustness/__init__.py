"""One controller, many plants: margins, worst case and Monte Carlo certificate."""

from seaopt.robustness.batch import BatchFigures, batch_figures
from seaopt.robustness.bracket import Bracket, Budget, bracket
from seaopt.robustness.certificate import Certificate, MonteCarlo, Requirement
from seaopt.robustness.certify import certify, failure_bound
from seaopt.robustness.draws import Uncertainty, check_ranges, placed, uncertainty
from seaopt.robustness.environments import StabilityMap, coupled_stability
from seaopt.robustness.joint import JointTuning, Round, tune_certified
from seaopt.robustness.judgement import Outcome
from seaopt.robustness.large_signal import LargeSignal, large_signal
from seaopt.robustness.nominal import PlantMargins, plant_margins
from seaopt.robustness.scenarios import Phase, Scenario, default_scenarios
from seaopt.robustness.simulated import Simulated, simulated
from seaopt.robustness.verification import Verification, verify
from seaopt.robustness.worst import Witness, Worst

__all__ = [
    "BatchFigures", "Bracket", "Budget", "Certificate", "JointTuning", "LargeSignal", "MonteCarlo", "Outcome", "Phase",
    "PlantMargins", "Requirement", "Round", "Scenario", "Simulated", "StabilityMap", "Uncertainty", "Verification",
    "Witness", "Worst", "batch_figures", "bracket", "certify", "check_ranges", "coupled_stability", "default_scenarios",
    "failure_bound", "large_signal", "placed", "plant_margins", "simulated", "tune_certified", "uncertainty", "verify",
]  # fmt: skip
