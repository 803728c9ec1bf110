"""What became of each hypothesis: which removes the excess, which does so as well, and which was only tried.

None is taken that leaves the excess high, unless it takes 98 % of its power. A pair is taken where one effect leaves an
excess and the other takes half of that, or, where one would do, all of it. Those that leave as little are told apart by
their likelihoods where noise alone is left.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from seaopt.estimation.judgement.hypotheses import Change
from seaopt.estimation.problem.fit_problem import Evaluation, FitProblem
from seaopt.estimation.result.trials import HypothesisTrial, Outcome, spell_holds, spell_parameters, spell_parts
from seaopt.estimation.solver.least_squares import find_blocked
from seaopt.plants.plant import name_input
from seaopt.records import record

ASKS = 1.5  # times its noise a residual is before anything is looked for
REMOVED = 3.0  # times its noise that a hypothesis may leave
NEARLY = 1.0 / 7.0  # of the excess that it may leave besides: 98 % of the power is removed
HALF = 0.5  # of the excess power that one has to take
TIED = 1.05  # times the least excess, up to which hypotheses are as good
CHANCE = 10.0  # of log-likelihood, over the colour of the residual, that chance may give
UNDECIDED = 5.0  # of it, from which a refit near noise is neither chance nor sure
LEFT = 1.0  # of them, from which a refit says only that something is missing, and not how far it moves the values


@record(eq=False)
class Refit:
    """A minimum with one or two hypotheses, near enough to be compared."""

    change: Change
    problem: FitProblem
    evaluation: Evaluation
    excess: float
    gain: float  # logarithm of its likelihood over the fit's
    evaluations: int
    undecided: bool = False  # whether it was left because its steps were out of proportion

    @property
    def values(self) -> dict[str, float]:
        """The unknowns at the minimum."""
        return self.problem.unknowns.by_name(self.evaluation.z)

    @property
    def at_minimum(self) -> bool:
        """Whether it has come so near to its minimum that its values are those that the hypothesis gives."""
        unknowns = self.problem.unknowns
        free = ~find_blocked(self.evaluation, unknowns.low, unknowns.high)
        return self.evaluation.distance_squared(free) <= LEFT

    @property
    def frees(self) -> dict[str, float]:
        """What its parts free, with values."""
        searched = {name for hypothesis in self.change.hypotheses for name in hypothesis.searched}
        return {name: self.values[name] for name in self.change.frees if name not in searched}

    @property
    def fixed(self) -> dict[str, float]:
        """What is chosen for its parts, with values."""
        return {
            **{name: self.values[name] for name in self.change.frees if name not in self.frees},
            **self.change.fixed,
        }

    @property
    def proposal(self) -> str:
        """The lines of a problem file that add its parts to a plant NAME, with their parameters."""
        recipe, values = self.change.experiments[0].plant.recipe, spell_parameters(self.frees, self.fixed)
        parts = spell_parts((*(recipe.parts if recipe else ()), *self.change.parts)) if self.change.parts else []
        lines = [*(["[plant.NAME]", *parts] if parts else []), *(["[parameters]", *values] if values else [])]
        return "\n".join([*lines, *spell_holds(self.change.holds)])

    @property
    def python(self) -> str:
        """The calls that add them to a plant and its parameters."""
        given = ", ".join(f"{name}={value:g}" for name, value in {**self.frees, **self.fixed}.items())
        free = ", ".join(f'"{name}"' for name in self.frees)
        lines = [f'plant = so.plants.add_part(plant, "{part}")' for part in self.change.parts]
        if given:
            lines += [f"params = plant.defaults.with_parameters(*params.values()).update({given}).free({free})"]
        of = {e.name: f"  # of {e.name}" if len(self.change.experiments) > 1 else "" for e in self.change.experiments}
        for e in self.change.experiments if self.change.holds else ():
            samples, first = self.change.holds[e.name]
            lines += [f'log = log.hold("{name_input(e.plant)[0]}", samples={samples}, first={first}){of[e.name]}']
        return "\n".join(lines)


@record(eq=False)
class TriedHypotheses:
    """What was tried: the hypotheses that remove the excess, those as good as the best, and a row for each."""

    able: tuple[Refit, ...] = ()
    trials: tuple[HypothesisTrial, ...] = ()
    # All unknowns of a refit that removes a large excess in part, or of one that chance hardly makes so likely: where
    # none is able, the truth is as near to it as to the fit.
    partial: Mapping[str, float] | None = None
    ended: bool = False  # by its budget, before all was tried

    def yield_to_another(self) -> TriedHypotheses:
        """Return the search where another cause explains the logs better, so that none is adopted."""
        rows = (replace(row, outcome="tied") if row.outcome == "adopted" else row for row in self.trials)
        return replace(self, trials=tuple(rows))


def takes_half(before: float, after: float) -> bool:
    """Tell whether a refit takes half of the excess power; of noise alone there is none."""
    return after**2 - 1.0 <= HALF * (before**2 - 1.0)


def rank_refits(refits: Sequence[Refit], first: float, colour: float) -> TriedHypotheses:
    """Return what became of each hypothesis, the best first: of those as good the one with the fewest unknowns.
    `first`, `colour`: of the fit, its excess and how many times more than for white residuals its estimates vary.
    """
    single = [refit for refit in refits if len(refit.change.hypotheses) == 1 and not refit.undecided]
    best_single = min((refit.excess for refit in single), default=np.inf)
    # Two effects are taken where one leaves an excess, and the other takes half of that; where one would do, all of it.
    most = max(REMOVED, NEARLY * first)
    most_of_pair = most if best_single > most else ASKS
    # A delay alone is an experiment's own, which other causes name: what leaves more than it does explains nothing.
    late = [refit for refit in single if refit.change.hypotheses[0].dead_time is not None]
    least_late = min((refit.excess for refit in late), default=np.inf)
    able = [
        refit
        for refit in refits
        if refit.excess <= min(most, TIED * least_late)
        and refit not in late
        and not refit.undecided
        and (takes_half(first, refit.excess) if first > ASKS else refit.gain > CHANCE * colour)
        and (refit in single or (refit.excess <= most_of_pair < best_single and takes_half(best_single, refit.excess)))
    ]
    least = min((refit.excess for refit in able), default=np.inf)
    tied = [refit for refit in able if refit.excess <= TIED * least]
    if least <= ASKS:  # what is left is noise, and tells them apart
        best = max(refit.gain for refit in tied)
        tied = [refit for refit in tied if refit.gain >= best - CHANCE * colour]
    tied.sort(key=lambda refit: (refit.evaluation.z.size, refit.excess))
    others = [refit for refit in refits if refit not in tied]
    others.sort(key=lambda refit: (refit.undecided, refit.excess))
    left: list[Outcome] = ["undecided" if refit.undecided else "tried" for refit in others]
    outcomes: list[Outcome] = [*["adopted" for _ in tied[:1]], *["tied" for _ in tied[1:]], *left]
    ranked = [*tied, *others]
    trials = tuple(_state(refit, outcome, first) for refit, outcome in zip(ranked, outcomes, strict=True))
    return TriedHypotheses(
        able=tuple(tied), trials=trials, partial=None if able else find_partial(refits, first, colour)
    )


def find_partial(refits: Sequence[Refit], first: float, colour: float) -> Mapping[str, float] | None:
    """Return the values of the refit that is as near to the truth as the fit; None where there is no such refit."""
    if first > REMOVED:
        best = min(refits, key=lambda refit: refit.excess, default=None)
        return best.values if best is not None and best.excess < first else None
    best = max(refits, key=lambda refit: refit.gain, default=None)
    return best.values if best is not None and best.gain > UNDECIDED * colour and first <= ASKS else None


def _state(refit: Refit, outcome: Outcome, first: float) -> HypothesisTrial:
    change = refit.change
    return HypothesisTrial(
        effect=change.effect,
        parts=change.parts,
        outcome=outcome,
        excess_before=first,
        excess=refit.excess,
        frees=refit.frees,
        fixed=refit.fixed,
        parameters={name: refit.values[name] for name in refit.problem.shared_names},
        evaluations=refit.evaluations,
        proposal=refit.proposal,
        python=refit.python,
        holds=change.holds,
    )
