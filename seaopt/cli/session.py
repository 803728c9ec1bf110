"""One invocation: a problem, a folder of results, and the stages that read and write them."""

from __future__ import annotations

import sys
from collections.abc import Callable, Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.table import Table

from seaopt.control import Controller, tune
from seaopt.errors import ProblemError
from seaopt.estimation import Experiment, Fit, fit
from seaopt.files import read_json, to_json, write_json
from seaopt.logs import Log, write_log
from seaopt.parameters import ParameterSet
from seaopt.problem import Problem, read_problem
from seaopt.reporting import verdict, write_report
from seaopt.robustness import Certificate, certify
from seaopt.simulation import simulate

LABELS = {
    "simulate": "simulating",
    "fit": "fitting the logs",
    "tune": "tuning the controller",
    "certify": "certifying",
    "report": "writing the report",
}


class Session:
    """Runs stages for one problem and one folder; later stages read earlier ones' JSON where they did not run."""

    def __init__(self, problem: Path, folder: Path) -> None:
        if folder.exists() and not folder.is_dir():
            raise ProblemError(f"{folder}: is a file; give a folder for the results with -o")
        self.problem: Problem = read_problem(problem)
        self.folder = folder
        self.results: dict[str, Any] = {}
        self.written: list[Path] = []
        self._experiments: tuple[Experiment, ...] | None = None
        self._console = Console(stderr=True)

    def planned(self) -> list[str]:
        """Return the stages that the problem has what it takes for."""
        stages = ["fit"] if self.problem.table.experiment else []
        if self.problem.spec is not None:
            stages += ["tune", "certify"]
        if not stages:
            raise ProblemError(f"{self.problem.source}: has no [[experiment]] and no [controller]; add one of them")
        return [*stages, "report"]

    def run(self, stage: str) -> None:
        """Run one stage and write its result."""
        stages: dict[str, Callable[[Callable[[str], None]], None]] = {
            "simulate": self._simulate, "fit": self._fit, "tune": self._tune, "certify": self._certify,
            "report": self._report,
        }  # fmt: skip
        with self._progress(LABELS[stage]) as tell:
            stages[stage](tell)

    @contextmanager
    def _progress(self, label: str) -> Generator[Callable[[str], None]]:
        columns = (
            SpinnerColumn(finished_text="[green]✓[/]"), TextColumn("{task.description:<24}"),
            BarColumn(bar_width=16), TimeElapsedColumn(), TextColumn("{task.fields[note]}", style="dim"),
        )  # fmt: skip
        with Progress(*columns, console=self._console, transient=False) as progress:
            task = progress.add_task(label, total=None, note="")
            yield lambda note: progress.update(task, note=note)
            progress.update(task, total=1, completed=1)

    def experiments(self) -> tuple[Experiment, ...]:
        """Return the problem's experiments, read or made once."""
        if self._experiments is None:
            self._experiments = self.problem.experiments()
        return self._experiments

    def parameters(self) -> Fit | ParameterSet:
        """Return the fit of this run or of the folder; the file's own values if it has no experiments."""
        if "fit" not in self.results and self.problem.table.experiment:
            path = self.folder / "fit.json"
            if not path.exists():
                raise ProblemError(f"{path}: no such file; run seaopt fit {self.problem.source} -o {self.folder} first")
            self.results["fit"] = Fit.from_dict(read_json(path, "seaopt/fit/1"), ())
        return self.results.get("fit", self.problem.parameters)

    def values(self) -> ParameterSet:
        """Return the parameter values to design with, the file's for what the fit does not have."""
        found = self.parameters()
        if isinstance(found, ParameterSet):
            return found
        return self.problem.parameters.with_parameters(*found.parameters.values())

    def controller(self) -> Controller:
        """Return the controller of this run or of the folder."""
        if "tune" not in self.results:
            path = self.folder / "controller.json"
            if not path.exists():
                raise ProblemError(
                    f"{path}: no such file; run seaopt tune {self.problem.source} -o {self.folder} first"
                )
            content = read_json(path, "seaopt/controller/1")
            self.results["tune"] = Controller.from_dict(content, self.problem.design_plant, self.values())
        return self.results["tune"]

    def _write(self, name: str, content: dict[str, Any]) -> None:
        self.written.append(write_json(self.folder / name, content))

    def _simulate(self, tell: Callable[[str], None]) -> None:
        if not self.problem.table.experiment:
            raise ProblemError(f"{self.problem.source}: has no [[experiment]] to simulate; add one")
        runs: dict[str, Log] = {}
        for experiment in self.experiments():
            tell(experiment.name)
            runs[experiment.name] = simulate(
                experiment.plant, self.problem.parameters, experiment.log, hold=experiment.hold
            )
            self.written.append(write_log(runs[experiment.name], self.folder / f"simulation_{experiment.name}.csv"))
        self.results["simulate"] = runs

    def _fit(self, tell: Callable[[str], None]) -> None:
        if not self.problem.table.experiment:
            raise ProblemError(f"{self.problem.source}: has no [[experiment]] to fit; add one")
        tell("reading logs")
        experiments = self.experiments()
        result = fit(
            experiments,
            self.problem.parameters,
            callback=lambda iteration, cost: tell(f"iteration {iteration}, cost {cost:.6g}"),
            **self.problem.fit_options,
        )
        tell(f"{result.samples} samples, {result.iterations} iterations, {result.status.replace('_', ' ')}")
        self.results["fit"] = result
        self._write("fit.json", result.to_dict())

    def _tune(self, tell: Callable[[str], None]) -> None:
        design, values = self.problem.design_plant, self.values()
        spec = self.problem.spec
        assert spec is not None
        tell(f"{spec.structure}, {spec.bandwidth_hz:g} Hz")
        result = tune(design, values, spec, self.problem.robust_to(values))
        self.results["tune"] = result
        self._write("controller.json", result.to_dict())

    def _certify(self, tell: Callable[[str], None]) -> None:
        controller, source = self.controller(), self.parameters()
        table = self.problem.robustness
        tell(f"{table.samples} draws")
        plants = self.problem.certified_plants()
        result = certify(
            controller, plants, source, ranges=self.problem.ranges, samples=table.samples, seed=table.seed,
            others=self.problem.parameters,
        )  # fmt: skip
        self.results["certify"] = result
        self._write("robustness.json", result.to_dict())

    def _report(self, tell: Callable[[str], None]) -> None:
        results: list[Any] = []
        if self.problem.table.experiment:
            found = self.parameters()
            if isinstance(found, Fit) and not found.experiments:
                path = self.folder / "fit.json"
                self.results["fit"] = found = Fit.from_dict(read_json(path, "seaopt/fit/1"), self.experiments())
            results.append(found)
        if self.problem.spec is not None and ("tune" in self.results or (self.folder / "controller.json").exists()):
            results.append(self.controller())
            path = self.folder / "robustness.json"
            if "certify" not in self.results and path.exists():
                self.results["certify"] = Certificate.from_dict(
                    read_json(path, "seaopt/robustness/1"), self.controller(), self.problem.certified_plants(),
                    self.values(),
                )  # fmt: skip
            results += [self.results["certify"]] if "certify" in self.results else []
        tell("figures")
        page = write_report(results, self.folder / "report.html", title=self.problem.title)
        self.results["report"] = page
        self.written.append(page)

    def met(self, stages: list[str]) -> bool:
        """Tell whether everything that these stages require is met."""
        return all(good for stage in stages for good, _ in self._verdict(stage))

    def _verdict(self, stage: str) -> list[tuple[bool, str]]:
        found = self.results.get(stage)
        return verdict(
            found if stage == "fit" else None,
            found if stage == "tune" else None,
            found if stage == "certify" else None,
        )

    def show(self, as_json: bool, stages: list[str]) -> None:
        """Print the results of the stages on stdout."""
        if as_json:
            contents = {stage: self._json(stage) for stage in stages if stage != "report" or len(stages) == 1}
            only = next(iter(contents.values())) if len(contents) == 1 else contents
            sys.stdout.write(to_json(only))
            return
        console = Console(soft_wrap=True)
        for stage in stages:
            if stage in ("fit", "tune", "certify"):
                console.print(repr(self.results[stage]), highlight=False, markup=False)
        table = Table(show_header=False, box=None, padding=(0, 1))
        for stage in stages:
            for good, text in self._verdict(stage):
                table.add_row("[green]met[/]" if good else "[red]not met[/]", text)
        if table.row_count:
            console.print(table)
        if self.written:
            console.print("wrote " + ", ".join(str(path) for path in self.written), highlight=False, markup=False)

    def _json(self, stage: str) -> dict[str, Any]:
        found = self.results[stage]
        if stage == "simulate":
            return {"schema": "seaopt/simulation/1", "files": [str(path) for path in self.written]}
        return {"schema": "seaopt/report/1", "file": str(found)} if stage == "report" else found.to_dict()
