"""The pytest plugin: a file NAME.problem.toml with an [expect] table is tested, each expectation an item.

pytest loads this module in every environment that has seaopt, so that it imports nothing of seaopt but what is needed
when such a file is met or a fixture is asked for. What a file's expectations need is computed once in each process that
has one of them; with xdist, `--dist loadfile` keeps a file's items in one.
"""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from seaopt.bench import Excitation
    from seaopt.estimation import Experiment
    from seaopt.plants import Plant
    from seaopt.problem import Stages
    from seaopt.testing.expectations import Expectation

SUFFIX = ".problem.toml"


def pytest_collect_file(file_path: Path, parent: pytest.Collector) -> ProblemFile | None:
    """Collect problem files that are named as tests are."""
    return ProblemFile.from_parent(parent, path=file_path) if file_path.name.endswith(SUFFIX) else None


class ProblemFile(pytest.File):
    """A problem file; one without [expect] has no items."""

    def collect(self) -> Iterator[ExpectationItem]:
        """Yield an item for each expectation."""
        try:
            if "expect" not in tomllib.loads(self.path.read_text(encoding="utf-8-sig")):
                return
        except (OSError, ValueError) as error:
            raise self.CollectError(f"{self.path}: cannot be read as TOML ({error}); correct that place") from None
        try:
            from seaopt.errors import SeaoptError
            from seaopt.problem import Stages, read_problem
            from seaopt.testing.expectations import list_expectations
        except ImportError as error:
            raise self.CollectError(f"{self.path}: seaopt cannot be imported ({error}); install it again") from None
        try:
            problem = read_problem(self.path)
        except SeaoptError as error:
            raise self.CollectError(str(error)) from None
        results = Stages(problem)
        for expectation in list_expectations(problem):
            yield ExpectationItem.from_parent(self, name=expectation.name, expectation=expectation, results=results)


class NotMetError(Exception):
    """An expectation is not met; the message says what was found, what was asked, and what to do."""


class ExpectationItem(pytest.Item):
    """One expectation of a problem file."""

    def __init__(self, *, expectation: Expectation, results: Stages, **of_item: Any) -> None:
        super().__init__(**of_item)
        self.expectation = expectation
        self.results = results

    def runtest(self) -> None:
        """Compute what it takes, unless another item has, and judge it."""
        met, text = self.expectation.check(self.results)
        if not met:
            raise NotMetError(text)

    def repr_failure(self, excinfo: pytest.ExceptionInfo[BaseException], style: Any = None) -> Any:
        """Return the message alone of what is not met, or cannot be computed."""
        from seaopt.errors import SeaoptError

        if isinstance(excinfo.value, (NotMetError, SeaoptError)):
            return str(excinfo.value)
        return super().repr_failure(excinfo, style)

    def reportinfo(self) -> tuple[Path, None, str]:
        """Return where it stands."""
        return self.path, None, f"expect.{self.name}"


@pytest.fixture(scope="session")
def virtual_experiment() -> Callable[..., Experiment]:
    """Return `seaopt.testing.virtual_experiment`: an experiment of a plant whose true parameters are known."""
    from seaopt.testing import virtual_experiment

    return virtual_experiment


@pytest.fixture(scope="session")
def stand_experiment() -> Experiment:
    """Return 20 s of the paper's first experiment: THOR's actuator on the stand, F1 and F2 with 2 N of noise."""
    from seaopt.bench import PAPER_STAND
    from seaopt.plants import high_impedance

    return _make_thor(high_impedance(), PAPER_STAND, "stand")


@pytest.fixture(scope="session")
def swing_experiment() -> Experiment:
    """Return 20 s of its second: the output swings a pendulum of 4 kg, F1 and F2 with 2 N of noise."""
    from seaopt.bench import PAPER_SWING
    from seaopt.plants import moving_output

    return _make_thor(moving_output(), PAPER_SWING, "swing")


def _make_thor(plant: Plant, excitation: Excitation, name: str) -> Experiment:
    from seaopt.plants import thor
    from seaopt.testing import virtual_experiment

    noise = {"F1": 2.0, "F2": 2.0}
    return virtual_experiment(plant, thor(), excitation=excitation, noise_std=noise, name=name)
