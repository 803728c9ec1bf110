"""Read and check a problem file: from TOML to the objects that it stands for."""

from __future__ import annotations

import shlex
import tomllib
from collections.abc import Mapping
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from typing import Any

from seaopt.control import ControllerSpec
from seaopt.documents import check_table, has_unknown_key
from seaopt.errors import FileError, PlantError, ProblemError, SeaoptError, require_type
from seaopt.files import check_regular, exists, parse_file, parse_text
from seaopt.plants import Plant, plant_of_kind
from seaopt.problem.bench_tables import AnyPlant, EquationsTable, PlantTable
from seaopt.problem.equations import make_plant, order_plants
from seaopt.problem.option_tables import make_record
from seaopt.problem.parameters import make_parameters, name_guesses
from seaopt.problem.predictive import make_mpc_spec
from seaopt.problem.problem import Problem
from seaopt.problem.references import check_references
from seaopt.problem.schema import ProblemTable
from seaopt.robustness.certificate.linear_region import linear_spec

OF_DESIGN = ("controller", "impedance", "mpc", "robustness", "expect")  # tables that a fit does not read


def demo_path() -> Path:
    """Return the path of the THOR problem that comes with the package."""
    return Path(str(files("seaopt.problem").joinpath("thor.toml")))


def read_problem(path: Path | str, *, design: bool = True) -> Problem:
    """Read and check a problem file.

    Parameters
    ----------
    path : path
        The file.
    design : bool
        False: of a file in which only what a design needs is wrong ([controller], [impedance], [mpc], [robustness],
        [expect]), read the rest, which a fit needs; `Problem.refused` then says what is wrong. A key that nothing
        reads is refused all the same.

    Raises
    ------
    ProblemError
        The file is missing or not TOML, a key is unknown or missing, or a value is out of range; the message names
        the file, the key, the value and the remedy.
    SeaoptError
        The plants, the parameters or the controller specification are refused.

    Examples
    --------
    >>> import seaopt as so
    >>> problem = so.read_problem(so.demo_path())
    >>> problem.title, list(problem.plants)
    ('THOR linear SEA', ['stand', 'swing'])
    """
    require_type(path, (str, Path), "path", "give the path of a problem file", ProblemError)
    source = Path(path)
    content = _read_toml(source)
    try:
        return _make(content, str(path))
    except SeaoptError as error:
        if design or has_unknown_key(error):
            raise
        refused = str(error)
    fitted = {key: value for key, value in content.items() if key not in OF_DESIGN}
    return replace(_make(fitted, str(path)), refused=refused)


def check_problem(text: str, target: Path) -> None:
    """Refuse the text of a problem file that is to be written, where the other commands would not take it."""
    content = parse_text(text, target, tomllib.loads, "TOML", remedy="rename the log", error=ProblemError)
    _make(content, str(target))


def _make(content: Mapping[str, Any], source: str) -> Problem:
    table = check_table(ProblemTable, content, source, error=ProblemError)
    return make_problem(table, source, Path(source).parent)


def make_problem(table: ProblemTable, source: str, folder: Path) -> Problem:
    """Make the objects of a validated problem file, its logs relative to `folder`. Raises as `read_problem`."""
    try:
        plants = _make_plants(table.plant)
        parameters = make_parameters(table, plants)
        check_references(table, plants, parameters)
        table = name_guesses(table, plants)
        mpc = make_mpc_spec(table)
        spec = _make_spec(table) if mpc is None else linear_spec(mpc)
    except SeaoptError as error:
        raise type(error)(f"{source}: {error}") from error
    return Problem(
        title=table.title,
        source=source,
        folder=folder,
        parameters=parameters,
        plants=plants,
        table=table,
        spec=spec,
        mpc=mpc,
    )


def _make_plants(tables: Mapping[str, AnyPlant]) -> dict[str, Plant]:
    """Return the plants of a file in its order; those that others hold or probe with are made first."""
    plants: dict[str, Plant] = {}
    for name in order_plants(tables):
        table = tables[name]
        try:
            stated = isinstance(table, EquationsTable)
            plants[name] = make_plant(name, table, plants) if stated else _make_plant_of_kind(table)
        except SeaoptError as error:
            text = error.reason if isinstance(error, PlantError) and error.plant == name else str(error)
            raise type(error)(f"plant.{name}: {text}") from error
    return {name: plants[name] for name in tables}


def _make_plant_of_kind(table: PlantTable) -> Plant:
    options = table.model_extra or {}
    equations = ", ".join(name for name in ("f", "h", "states", "outputs") if name in options)
    if equations:
        raise ProblemError(f"a plant has either a kind or {equations} of its own; take one out")
    return plant_of_kind(table.kind, **options)


def _make_spec(table: ProblemTable) -> ControllerSpec | None:
    if table.controller is None:
        return None
    limits: dict[str, Any] = {}
    if table.robustness is not None and table.robustness.min_friction_margin is not None:
        designed, certified = table.controller.min_friction_margin, table.robustness.min_friction_margin
        limits["min_friction_margin"] = max(designed or 0.0, certified)  # what is certified is designed for
    return make_record(ControllerSpec, table.controller, **limits)


def _read_toml(source: Path) -> dict[str, Any]:
    try:
        check_regular(source)
    except FileError as error:
        problem = shlex.quote(str(next(iter(sorted(source.glob("*.toml"))), "problem.toml")))
        folder = f" -o {shlex.quote(str(source))}" if any(source.glob("fit.json")) else ""
        raise ProblemError(f"{error}, the problem's: seaopt run {problem}{folder}") from error
    if source.suffix.lower() == ".json" and exists(source):
        folder = shlex.quote(str(source.parent))
        raise ProblemError(
            f"{source}: is a result, and no problem file; give that, and the folder of results by -o {folder}"
        )
    # What is there under another suffix is likely the log itself, which must not be offered as the file to write.
    is_log = source.suffix.lower() != ".toml"
    remedy = "write one from a log: " + shlex.join(
        ["seaopt", "new", str(source)] if is_log and exists(source) else ["seaopt", "new", "LOG", "-o", str(source)]
    )
    return parse_file(source, tomllib.loads, "TOML", remedy=remedy, error=ProblemError)
