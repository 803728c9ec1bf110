"""What a result was made from: digests of what its stage reads of a problem, and of the results before it.

Each stage counts only what can change its result, so that a result stays good while the file asks something else of it:
a controller through new draws of its certificate, a fit through plants that no experiment has.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from seaopt.problem import Problem
from seaopt.problem.schema import ControllerTable
from seaopt.robustness.uncertainty.draws import find_modes

FILES = {
    "fit": "fit.json",
    "frf": "frf.json",
    "tune": "controller.json",
    "sweep": "frontier.json",
    "certify": "robustness.json",
}


def digest(path: Path) -> str:
    """Return the SHA-256 of a file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def digest_sources(problem: Problem, stage: str, folder: Path) -> dict[str, str]:
    """Return digests of what a stage reads: of the problem, and of the results before it in the folder, by file.

    Parameters
    ----------
    problem : Problem
        As read from its file.
    stage : str
        One of `FILES`.
    folder : Path
        Where the results are; what is not there has no digest.

    """
    read, earlier = _READ_BY_STAGE[stage]
    out = {"problem": hashlib.sha256(json.dumps(read(problem), sort_keys=True).encode()).hexdigest()}
    for before in earlier:
        path = folder / FILES[before]
        if path.exists() and (before != "fit" or problem.table.experiment):
            out[path.name] = digest(path)
    return out


def _read_by_fit(problem: Problem) -> dict[str, Any]:
    """Return what a fit reads: experiments, their plants and these plants' parameters."""
    table = problem.table.model_dump(mode="json", include={"experiment", "fit", "plant", "parameters"})
    plants = {experiment.plant for experiment in problem.table.experiment}
    names = {name for plant in plants for name in problem.plants[plant].parameters}.union(problem.parameters.free_names)
    table["plant"] = {name: plant for name, plant in table["plant"].items() if name in plants}
    table["parameters"] = {name: value for name, value in table["parameters"].items() if name in names}
    return table


def _read_by_tune(problem: Problem) -> dict[str, Any]:
    return _read_by_design(problem, problem.robustness.retune)


def _read_by_sweep(problem: Problem) -> dict[str, Any]:
    return _read_by_design(problem, 0)


def _read_by_design(problem: Problem, retune: int) -> dict[str, Any]:
    """Return what a design reads: [controller], its plants and values; of [robustness] what has a part in tuning."""
    asked, robustness = _controller(problem), problem.robustness
    ranges = bool(asked.robust_to or asked.draws or retune)
    plants = {asked.plant, *asked.robust_to}
    modes = find_modes(problem.certified_plants())
    if retune or (
        ranges and not modes.keys().isdisjoint(problem.ranges)
    ):  # a mode's first plant says what puts it there
        plants |= problem.certified_plants().keys()
    out = problem.table.model_dump(mode="json", include={"controller"})
    out["plant"] = {name: problem.table.plant[name].model_dump(mode="json") for name in sorted(plants)}
    known = dict.fromkeys(name for each in sorted(plants) for name in problem.plants[each].parameters)
    out["values"] = {name: problem.parameters[name].value for name in known}
    if ranges:
        out["ranges"] = robustness.model_dump(mode="json")["parameters"]
    if asked.draws or retune:
        out["parameters"], out["seed"] = problem.table.model_dump(mode="json")["parameters"], robustness.seed
    if retune:
        out |= {"retune": retune, "samples": robustness.samples, "certified": list(problem.certified_plants())}
    return out


def _read_by_certify(problem: Problem) -> dict[str, Any]:
    """Return what a certificate reads besides the controller: plants, parameters, and [robustness] but for tuning's."""
    table, plants = problem.table.model_dump(mode="json"), problem.certified_plants()
    robustness = problem.robustness.model_dump(mode="json", exclude={"retune"})
    sources = {"parameters": table["parameters"], "plant": {name: table["plant"][name] for name in plants}}
    return sources | {"robustness": robustness, "design": _controller(problem).plant}


def _controller(problem: Problem) -> ControllerTable:
    assert problem.table.controller is not None  # whoever designs has asked for it before
    return problem.table.controller


_READ_BY_STAGE: dict[str, tuple[Callable[[Problem], dict[str, Any]], tuple[str, ...]]] = {
    "fit": (_read_by_fit, ()),
    "frf": (_read_by_fit, ()),
    "tune": (_read_by_tune, ("fit",)),
    "sweep": (_read_by_sweep, ("fit",)),
    "certify": (_read_by_certify, ("fit", "tune")),
}
