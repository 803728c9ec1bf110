"""What a result was made from: digests of what its stage reads of a problem, and of the results before it.

Each stage counts only what can change its result, so that a result stays good while the file asks something else of it:
a controller through new draws of its certificate, a fit through plants that no experiment has. A digest of the result
itself tells whether it was edited since.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any

from seaopt.files import check_content, check_regular, digest_content, digest_plain
from seaopt.problem import Problem
from seaopt.robustness.uncertainty.draws import find_modes

FILES = {
    "fit": "fit.json",
    "frf": "frf.json",
    "tune": "controller.json",
    "sweep": "frontier.json",
    "certify": "robustness.json",
    "accept": "acceptance.json",
    "bringup": "bringup/bringup.json",
}
ROBUSTNESS = "[robustness]"  # the digest of what a design took from there


def digest(path: Path) -> str:
    """Return the SHA-256 of a result in a file, as `digest_content`; of its bytes where it is damaged."""
    check_regular(path)
    raw = path.read_bytes()
    try:
        content = json.loads(raw)
        check_content(content)
    except (ValueError, RecursionError):
        content = None
    return digest_content(content) if isinstance(content, dict) else hashlib.sha256(raw).hexdigest()


def digest_sources(problem: Problem, stage: str, folder: Path) -> dict[str, str]:
    """Return digests of what a stage reads: of the problem, and of the results before it in the folder, by file. What a
    design takes from [robustness] is apart, for a certificate may ask a controller about another one. `stage` is one of
    `FILES`; a result that is not in the folder has no digest.
    """
    read, earlier = _READ_BY_STAGE[stage]
    out = {"problem": digest_plain(read(problem))}
    if stage in ("tune", "sweep"):
        out[ROBUSTNESS] = digest_plain(
            _shape_by_robustness(problem, (problem.robustness.retune or 0) if stage == "tune" else 0)
        )
    for before in earlier:
        path = folder / FILES[before]
        if path.exists() and (before != "fit" or problem.table.experiment):
            out[path.name] = digest(path)
    return out


def digest_fit_of(problem: Problem, experiments: Collection[str]) -> str:
    """Return the digest that a fit of some of a problem's experiments has of the problem."""
    return digest_plain(_read_by_fit(problem, experiments))


def _read_by_fit(problem: Problem, of: Collection[str] | None = None) -> dict[str, Any]:
    """Return what a fit reads: experiments, all or those `of` a fit, their plants and these plants' parameters."""
    table = problem.table.model_dump(mode="json", include={"experiment", "fit", "plant", "parameters"})
    table["experiment"] = [each for each in table["experiment"] if of is None or each["name"] in of]
    plants = {each["plant"] for each in table["experiment"]}
    names = {name for plant in plants for name in problem.plants[plant].parameters}.union(problem.parameters.free_names)
    table["plant"] = {name: plant for name, plant in table["plant"].items() if name in plants}
    table["parameters"] = {name: value for name, value in table["parameters"].items() if name in names}
    return table | ({"guessed": problem.table.guessed} if problem.table.guessed else {})


def _read_by_design(problem: Problem) -> dict[str, Any]:
    """Return what a design reads besides [robustness]: [controller], its plants and values."""
    controller = problem.controller_table
    out = problem.table.model_dump(mode="json", include={"controller"})
    names = {name for name in (controller.plant, *controller.robust_to) if name in problem.plants}
    if problem.table.impedance is not None:
        out["impedance"] = problem.table.impedance.model_dump(mode="json")
        names.add(problem.table.impedance.plant)
    if problem.table.mpc is not None:
        out["mpc"] = problem.table.mpc.model_dump(mode="json")
    responses = {
        f"frf:{table.name}": table.model_dump(mode="json")
        for table in problem.table.experiment
        if f"frf:{table.name}" in problem.response_names
    }
    return out | _describe_plants(problem, names) | ({"responses": responses} if responses else {})


def _shape_by_robustness(problem: Problem, retune: int) -> dict[str, Any]:
    """Return what has a part in a design of [robustness], and of the uncertainty that it is asked about."""
    controller, robustness, out = problem.controller_table, problem.robustness, dict[str, Any]()
    if not (controller.robust_to or controller.draws or retune):
        return out
    out["ranges"] = robustness.model_dump(mode="json")["parameters"]
    modes = find_modes(problem.certified_plants())
    if retune or not modes.keys().isdisjoint(problem.ranges):  # a mode's first plant says what puts it there
        out |= _describe_plants(problem, set(problem.certified_plants()))
    if controller.draws or retune:
        out["parameters"], out["seed"] = problem.table.model_dump(mode="json")["parameters"], robustness.seed
    if retune:
        out |= {"retune": retune, "samples": robustness.samples, "certified": list(problem.certified_plants())}
    return out


def _describe_plants(problem: Problem, names: set[str]) -> dict[str, Any]:
    """Return plants and the values of their parameters."""
    plants = problem.with_partners(names)
    used = dict.fromkeys(name for each in sorted(plants) for name in problem.plants[each].parameters)
    return {
        "plant": {name: problem.table.plant[name].model_dump(mode="json") for name in sorted(plants)},
        "values": {name: problem.parameters[name].value for name in used},
    }


def _read_by_certify(problem: Problem) -> dict[str, Any]:
    """Return what a certificate reads besides the controller: plants, parameters, and [robustness] but for tuning's."""
    table, plants = problem.table.model_dump(mode="json"), problem.certified_plants()
    robustness = problem.robustness.model_dump(mode="json", exclude={"retune"})
    read = {name: table["plant"][name] for name in problem.with_partners(plants)}
    sources = {"parameters": table["parameters"], "plant": read}
    return sources | {"robustness": robustness, "design": problem.controller_table.plant}


_READ_BY_STAGE: dict[str, tuple[Callable[[Problem], dict[str, Any]], tuple[str, ...]]] = {
    "fit": (_read_by_fit, ()),
    "frf": (_read_by_fit, ()),
    "tune": (_read_by_design, ("fit",)),
    "sweep": (_read_by_design, ("fit",)),
    "certify": (_read_by_certify, ("fit", "tune")),
    "accept": (_read_by_certify, ("fit",)),  # which state of what law they are
    "bringup": (_read_by_certify, ("fit",)),
}
