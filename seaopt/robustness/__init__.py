"""One controller, many plants: margins, worst case and Monte Carlo certificate."""

from seaopt.robustness.bounds.bracket import Bracket, Budget, bracket
from seaopt.robustness.bounds.stretch import StretchBound
from seaopt.robustness.certificate.certificate import Certificate
from seaopt.robustness.certificate.certify import certify
from seaopt.robustness.certificate.constrained import ConstrainedRuns
from seaopt.robustness.certificate.linear_region import feed_link_forward, linear_controller
from seaopt.robustness.certificate.requirement import Requirement
from seaopt.robustness.certificate.retuning.joint import JointTuning, Round, tune_certified
from seaopt.robustness.certificate.simulated import Simulated, run_simulations
from seaopt.robustness.uncertainty.batch import BatchFigures, batch_figures
from seaopt.robustness.uncertainty.draws import Uncertainty, check_ranges, combine_uncertainty, place_value
from seaopt.robustness.uncertainty.failure_probability import MonteCarlo, failure_bound
from seaopt.robustness.uncertainty.plant_margins import PlantMargins, plant_margins
from seaopt.robustness.uncertainty.worst import Witness, Worst
from seaopt.robustness.verification.environments import StabilityMap, coupled_stability
from seaopt.robustness.verification.judgement import Outcome
from seaopt.robustness.verification.large_signal import LargeSignal, large_signal
from seaopt.robustness.verification.scenarios import Phase, Scenario, default_scenarios
from seaopt.robustness.verification.schedule_sweep import Sweep, sweep_schedule
from seaopt.robustness.verification.verification import Verification, verify

__all__ = [
    "BatchFigures", "Bracket", "Budget", "Certificate", "ConstrainedRuns", "JointTuning", "LargeSignal",
    "MonteCarlo", "Outcome", "Phase", "PlantMargins", "Requirement", "Round", "Scenario",
    "Simulated", "StabilityMap", "StretchBound", "Sweep", "Uncertainty", "Verification",
    "Witness", "Worst", "batch_figures", "bracket", "certify", "check_ranges",
    "combine_uncertainty", "coupled_stability", "default_scenarios", "failure_bound", "feed_link_forward",
    "large_signal", "linear_controller", "place_value", "plant_margins", "run_simulations", "sweep_schedule",
    "tune_certified", "verify",
]  # fmt: skip
