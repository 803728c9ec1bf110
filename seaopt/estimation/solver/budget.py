"""What a judgement may spend on refits, counted so that the same log has the same answer on any machine.

It is counted in evaluations, of which no more are made than the whole allows (`EvaluationBudget.enforce`): a search
that comes to its end keeps what it has. Parts of the whole are asked before a refit begins. In them an evaluation takes
its integration steps, and about as long as one for the residual of each sample and its sums; one that takes many times
what the fit's last one took counts for more. Where each counted for what it takes, the search would end before it came
to bristles that are the cause: they need three to nine times the fit's, and two of six such actuators were not
explained.
"""

from __future__ import annotations

from contextlib import AbstractContextManager

from seaopt.estimation.problem.fit_problem import FitProblem, count_evaluations, count_work, limit_evaluations
from seaopt.estimation.problem.shapes import Vector
from seaopt.records import record

# Evaluations that a fit counts for at least, however soon it was there: three times as many let each of 20 hypotheses
# be looked at from its starts, 27 in all, for one round of four iterations, and the best be settled.
EVALUATIONS = 40
FINE = 8.0  # times what an evaluation at the fit's minimum takes: up to there one counts as one
OUT_OF_PROPORTION = 20.0  # times that: a refit that takes more is left


@record
class EvaluationBudget:
    """Evaluations that may be made from where it was begun, and what one at the fit's minimum takes (`count_work`)."""

    evaluations: float
    unit: int
    evaluations_before: int
    work_before: int

    @classmethod
    def begin(cls, evaluations: float, unit: int) -> EvaluationBudget:
        """Return a budget from here on."""
        return cls(evaluations=evaluations, unit=unit, evaluations_before=count_evaluations(), work_before=count_work())

    def part(self, evaluations: float) -> EvaluationBudget:
        """Return a budget from here on that is a part of this one: of at most so many, or all that may be made."""
        return EvaluationBudget.begin(min(evaluations, self.evaluations - self.made), self.unit)

    def enforce(self, leaving: float = 0.0) -> AbstractContextManager[None]:
        """Refuse evaluations inside beyond this budget, and the last `leaving` of it."""
        return limit_evaluations(self.evaluations - self.made - leaving)

    @property
    def made(self) -> int:
        """Evaluations that were made."""
        return count_evaluations() - self.evaluations_before

    @property
    def spent(self) -> float:
        """Evaluations that were made, or what they took where that is more."""
        return max(self.made, (count_work() - self.work_before) / (FINE * self.unit))

    @property
    def left(self) -> float:
        """Evaluations that may still be made."""
        return self.evaluations - self.spent

    @property
    def share(self) -> float:
        """The part that is spent, 1 at most."""
        return min(self.spent / self.evaluations, 1.0) if self.evaluations > 0.0 else 1.0

    def allows(self, problem: FitProblem, z: Vector) -> bool:
        """Tell whether an evaluation at z is in proportion to the fit's."""
        return problem.count_work(z) <= OUT_OF_PROPORTION * self.unit
