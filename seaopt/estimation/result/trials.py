"""Hypotheses about what a fitted model lacks, as they were tried."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import field
from typing import Literal

from seaopt.codec import OrInfinite
from seaopt.records import record

Outcome = Literal["adopted", "tied", "tried", "undecided"]
Hold = tuple[int, int]  # over how many rows of a log a command is held, and a row from which on


def state_sticking(parts: Iterable[str]) -> list[str]:
    """Return the line of a problem file that bristles need: they hold by themselves, not as friction that jumps."""
    return ["sticks = false"] if "lugre" in parts else []


def spell_parts(parts: Iterable[str]) -> list[str]:
    """Return the lines of a plant's table in a problem file that give it parts."""
    named = list(dict.fromkeys(parts))
    listed = ", ".join(f'"{part}"' for part in named)
    return [f"parts = [{listed}]", *state_sticking(named)]


def spell_parameters(frees: Mapping[str, float], fixed: Mapping[str, float]) -> list[str]:
    """Return the lines of [parameters] that a part's parameters take."""
    rows = [f"{name} = {{ value = {value:g}, free = true }}" for name, value in frees.items()]
    return [*rows, *(f"{name} = {value:g}" for name, value in fixed.items())]


def spell_holds(holds: Mapping[str, Hold]) -> list[str]:
    """Return the lines of a problem file that hold the commands of its experiments."""
    rows = ((f'name = "{name}"', spell_hold(hold)) for name, hold in holds.items())
    return [line for each in rows for line in ("[[experiment]]", *each)]


def spell_hold(hold: Hold) -> str:
    """Return the line of an experiment that holds its command."""
    samples, first = hold
    return f"held = {{ samples = {samples}, first = {first} }}"


@record
class HypothesisTrial:
    """What a refit with one or two more effects left of the residual."""

    effect: str  # that the model would lack, in words
    parts: tuple[str, ...]  # that bring it, of `seaopt.plants.PARTS`
    # adopted: it removes the excess, and nothing explains the logs better; tied: it removes it as well; tried: it does
    # not; undecided: its refit was left before its minimum, for an evaluation would take more than 20 times as many
    # integration steps as the fit's, or more than can be made in a sample
    outcome: Outcome
    # how many times its sensor's noise the residual is, of the output where it is most: of the fit, and with the
    # effect; infinite where nothing was simulated
    excess_before: OrInfinite
    excess: OrInfinite
    frees: Mapping[str, float]  # the parts' parameters, in SI units: what the refit gave,
    fixed: Mapping[str, float]  # and what was chosen for it
    parameters: Mapping[str, float]  # every free one of the refit
    evaluations: int  # that it took
    proposal: str = ""  # lines of a problem file that add it; NAME stands for the plant's
    python: str = ""  # the same as a call
    holds: Mapping[str, Hold] = field(default_factory=dict[str, Hold])  # of the experiments' commands
