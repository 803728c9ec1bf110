"""A problem with what its fit found the model to lack, and the lines that say so in its file."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from typing import Any

from seaopt.documents import check_table
from seaopt.errors import ProblemError
from seaopt.estimation import Fit
from seaopt.estimation.judgement.second_log import FAR
from seaopt.estimation.result.trials import HypothesisTrial, spell_hold, state_sticking
from seaopt.problem.problem import Problem
from seaopt.problem.reading import make_problem
from seaopt.problem.schema import ProblemTable

PART = 0.5  # of the residual's excess: what leaves less of it may be true, beside more
DIGITS = 6  # of the values from which the changed problem's fit starts: a wave number has to hold over all waves


def find_explanation(fit: Fit) -> HypothesisTrial | None:
    """Return the hypothesis that explains what the fit leaves; None where there is none, or the logs leave a choice."""
    adopted = next((trial for trial in fit.hypotheses if trial.outcome == "adopted"), None)
    tied = any(trial.outcome == "tied" for trial in fit.hypotheses)
    return None if tied else adopted


def say_unexplained(trials: Sequence[HypothesisTrial]) -> str:
    """Return in words why nothing was added to a problem whose fit tried these."""
    if not trials:
        return "nothing was tried: no residual asks for more than the model has, or it explains too little"
    as_good = [trial for trial in trials if trial.outcome in ("adopted", "tied")]
    if as_good:
        named = ((trial, ", ".join((*trial.parts, *(["held"] if trial.holds else [])))) for trial in as_good)
        effects = "; or ".join(f"{trial.effect} ({names})" for trial, names in named)
        return f"nothing is added, for several causes explain the logs: {effects}; add the one you expect"
    decided = [trial for trial in trials if trial.outcome != "undecided"]
    left = [trial.effect for trial in trials if trial.outcome == "undecided"]
    stiff = f"; not decided, as it takes too many integration steps, is whether {'; or '.join(left)}" if left else ""
    if not decided:
        return f"nothing explains the logs{stiff}"
    best, count = min(decided, key=lambda trial: trial.excess), len(decided)
    listed = ", ".join(f'"{part}"' for part in best.parts)
    more = (
        "; where three effects or more are there these may be some of them: add the parts that you know the actuator "
        f"to have to parts = [{listed}], and fit again; or"
        if best.excess < PART * best.excess_before
        else ";"
    )
    return (
        f"nothing explains the logs: of {count} causes and pairs that were tried the best, {best.effect}, leaves "
        f"{best.excess:.3g} times the sensor's noise of {best.excess_before:.3g}{more} look for what is not among "
        f"them, such as a bench that shakes, another load, or a wrong unit{stiff}"
    )


def say_adopted(trial: HypothesisTrial) -> str:
    """Return in words what a hypothesis that is added to a problem makes of its residual."""
    before, after = f"{trial.excess_before:.3g}", f"{trial.excess:.3g}"
    if trial.excess > FAR:
        return (
            f"the best cause found is that {trial.effect}; the residual falls from {before} to {after} times its "
            "sensor's noise, so that more is missing"
        )
    return f"explained: {trial.effect}: the residual is {after} times its sensor's noise in place of {before}"


def adopt(problem: Problem, trial: HypothesisTrial, starts: Collection[str] = ()) -> tuple[Problem, str]:
    """Return the problem with a hypothesis that was tried, and the lines of its file that are then other ones. The
    parts go to every plant that is fitted, and its fit starts from the refit's values. `starts`: the experiments that
    do not begin in the state that they state, with which free it was tried. Raises SeaoptError: a plant does not take
    the parts.
    """
    content = problem.table.model_dump(by_alias=True, exclude_unset=True, mode="json")
    fitted = [table.plant for table in problem.table.experiment if table.use == "fit"]
    lines: list[str] = []
    for name in dict.fromkeys(fitted) if trial.parts else ():
        plant = content["plant"][name]
        plant["parts"] = list(dict.fromkeys([*plant.get("parts", []), *trial.parts]))
        listed = ", ".join(f'"{part}"' for part in plant["parts"])
        plant |= dict.fromkeys(("sticks",) if state_sticking(trial.parts) else (), False)
        lines += [f"[plant.{name}]", f"parts = [{listed}]", *state_sticking(trial.parts)]
    values: Mapping[str, Any] = {
        **{name: {"value": _round(value), "free": True} for name, value in trial.frees.items()},
        **{name: _round(value) for name, value in trial.fixed.items()},
    }
    content["parameters"] = {**content.get("parameters", {}), **values}
    if values:
        lines += ["[parameters]", *(f"{name} = {_write(value)}" for name, value in values.items())]
    for experiment, row in zip(problem.table.experiment, content["experiment"], strict=True):
        changed = ['initial_state = "estimate"'] if experiment.name in starts else []
        row |= {"initial_state": "estimate"} if changed else {}
        if experiment.name in trial.holds:
            samples, first = trial.holds[experiment.name]
            row["held"] = {"samples": samples, "first": first}
            changed.append(spell_hold(trial.holds[experiment.name]))
        lines += ["[[experiment]]", f'name = "{experiment.name}"', *changed] if changed else []
    table = check_table(ProblemTable, content, problem.source, error=ProblemError)
    made = make_problem(table, problem.source, problem.folder)
    start = {name: value for name, value in trial.parameters.items() if name in made.parameters}
    return replace(made, parameters=made.parameters.update(**start)), "\n".join(lines)


def _round(value: float) -> float:
    return float(f"{value:.{DIGITS}g}")


def _write(value: Any) -> str:
    return f"{{ value = {value['value']:g}, free = true }}" if isinstance(value, dict) else f"{value:g}"
