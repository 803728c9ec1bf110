"""One invocation: a problem, a folder of results, and the stages that read and write them."""

from __future__ import annotations

import json
import platform
import shlex
import sys
from collections.abc import Callable, Iterable
from concurrent.futures import Executor
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

from seaopt import __version__
from seaopt.cli.progress import LABELS, LEAST_SHARE, show_progress
from seaopt.cli.provenance import FILES, ROBUSTNESS, digest_fit_of, digest_sources
from seaopt.cli.show import show_results, show_verdicts
from seaopt.cli.terminal import Amount, Terminal, spell_call
from seaopt.control import Controller, ControllerSpec, ForceMPC, ScheduledController
from seaopt.control import read_law as read_given_law
from seaopt.control.frontier.rows import FRONTIER_SCHEMA
from seaopt.control.laws.delay import DELAY_KEYS, settle_delays, warn_delays
from seaopt.control.laws.stored import CONTROLLER_SCHEMA
from seaopt.control.laws.structures import CUSTOM
from seaopt.control.mpc.stored import describe_mpc
from seaopt.errors import ProblemError, SeaoptError
from seaopt.estimation import Experiment, Fit, ModelledOutputs, compare_with_log, warn_unidentified
from seaopt.estimation.fit import SCALED
from seaopt.estimation.result.findings import state_guesses
from seaopt.estimation.result.fit_result import FIT_SCHEMA
from seaopt.estimation.result.trials import HypothesisTrial
from seaopt.executors import Processes
from seaopt.files import CONTENT, check_folder, read_json, to_json, write_json, write_text
from seaopt.logs import Log, write_log
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.problem import Problem, Stages, read_problem
from seaopt.problem.explained import adopt, find_explanation, say_adopted, say_unexplained
from seaopt.problem.problem import WRITE_ONE
from seaopt.problem.stages import (
    assess_problem,
    can_design,
    certify_problem,
    check_mpc_file,
    design_mpc,
    fit_problem,
    read_law,
    score_problem,
    simulate_experiment,
    sweep_problem,
    tune_problem,
)
from seaopt.progress import Progress, count_off, divide
from seaopt.reporting import write_frontier_figure, write_report
from seaopt.reporting.responses import FRF_SCHEMA, estimate_responses
from seaopt.reporting.sections import judge
from seaopt.reporting.sections.data import Commands, Step, Verdict
from seaopt.reporting.sections.verdict import UNMET, doubt_design, judge_expectations, judge_joint, name_guesses
from seaopt.robustness import Certificate, JointTuning, linear_controller
from seaopt.robustness.certificate.certificate import ROBUSTNESS_SCHEMA
from seaopt.testing.expectations import list_expectations

T = TypeVar("T")
SCHEMAS = {
    "fit": FIT_SCHEMA,
    "frf": FRF_SCHEMA,
    "tune": CONTROLLER_SCHEMA,
    "sweep": FRONTIER_SCHEMA,
    "certify": ROBUSTNESS_SCHEMA,
}
OWN_LAW = "; as a law of your own it is taken by seaopt certify PROBLEM --controller FILE -o DIR"
EXPLAINED = "explained.toml"  # lines that a problem file lacks
READING = 0.1  # share of the time of a fit
# What a law of the user's own states itself, so that the problem's specification does not ask for it.
OF_THE_LAW = (
    "structure", "notch", "prefilter", "link_feedforward", "reference_weights", "sample_rate_hz", *DELAY_KEYS,
)  # fmt: skip
PARALLEL = ("tune", "sweep", "certify")  # stages that several processes can share


class Session:
    """Runs stages for one problem and one folder; later stages read earlier ones' JSON where they did not run."""

    def __init__(
        self,
        problem: Path,
        folder: Path,
        stretch_s: float | None = None,
        bandwidths_hz: tuple[float, ...] = (),
        *,
        free_law: bool = False,
        workers: int | None = None,
        design: bool = True,
        explain: bool = False,
        causes: bool = True,
    ) -> None:
        check_folder(folder)
        self.problem: Problem = read_problem(problem, design=design)
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ProblemError(f"{folder}: cannot be made ({error.strerror}); give another folder: -o out") from error
        self.folder = folder
        self.stretch_s = stretch_s
        self.bandwidths_hz = bandwidths_hz
        self.free_law = free_law
        self.explain = explain
        self.causes = causes
        self.workers = workers
        self.executor: Executor | None = None
        self._stages = Stages(self.problem)
        self.written: list[Path] = []
        self._said: set[str] = set()
        self._console = Terminal(stderr=True)
        if self.problem.refused:
            self._say_once("warning", [f"{self.problem.refused}; a design refuses this"])
        self._say_once("note", self.problem.notes)

    @property
    def results(self) -> dict[str, Any]:
        """The results that are there, by stage."""
        return self._stages.results

    def plan_stages(self) -> list[str]:
        """Return the stages that the problem has what it takes for."""
        stages = ["fit"] if self.problem.table.experiment else []
        if self.problem.spec is not None:
            stages += ["tune", "certify"]
        if not stages:
            raise ProblemError(
                f"{self.problem.source}: has no [[experiment]] and no [controller]; add one of them, or write a whole "
                "file from a log: seaopt new LOG"
            )
        return [*stages, "report"]

    def explain_stages(self, stages: list[str]) -> None:
        """Say on stderr what a whole run leaves out, and which results in the folder are of an earlier run."""
        source, table = self.problem.source, self.problem.table
        if table.robustness is not None and table.controller is None:
            self.say(f"left out: tuning and certifying: {source} has [robustness] but no [controller]; add one")
        elif table.controller is not None and "tune" not in stages:
            self.say("left out: tuning and certifying: they need a fit that has converged; mend it first")
        for stage in ("fit", "tune", "certify"):
            if stage not in stages and self._path(stage).exists():
                self.say(f"note: {self._path(stage)} is of an earlier run, and no part of this report")

    def say(self, text: str) -> None:
        """Write one line on stderr."""
        self._console.say(text, soft_wrap=True)

    def _say_once(self, kind: str, texts: Iterable[str]) -> None:
        """Write each note or warning on stderr, unless it was written before."""
        for text in texts:
            if text not in self._said:
                self.say(f"{kind}: {text}")
            self._said.add(text)

    def can_design(self) -> bool:
        """Tell whether the fit of this run can be designed with: it converged, or there was none."""
        return "fit" not in self.results or can_design(self.problem, self.results["fit"])

    def run(self, stage: str) -> None:
        """Run one stage and write its result."""
        stages: dict[str, Callable[[Progress], None]] = {
            "simulate": self._simulate, "fit": self._fit, "tune": self._tune, "certify": self._certify,
            "report": self._report, "frf": self._frf, "sweep": self._sweep,
        }  # fmt: skip
        told_from = LEAST_SHARE
        if stage == "fit":  # whether another fit follows is not known
            told_from = 1.0 if self.explain else LEAST_SHARE + READING + (1.0 - READING) * SCALED
        with ExitStack() as stack:
            if self.workers is not None and stage in PARALLEL:
                self.executor = Processes(self.workers)
                stack.callback(self.executor.shutdown, cancel_futures=True)
            try:
                with show_progress(
                    self._console, LABELS[stage], lambda note: self._say_once("note", [note]), told_from=told_from
                ) as tell:
                    stages[stage](tell)
            except KeyboardInterrupt:
                raise KeyboardInterrupt(f"what was finished is in {self.folder}") from None

    def experiments(self) -> tuple[Experiment, ...]:
        """Return the problem's experiments, read or made once."""
        return self._stages.experiments

    def parameters(self) -> Fit | ParameterSet:
        """Return the fit of this run or of the folder; the file's own values if nothing is designed on a model."""
        fitted = self.problem.table.experiment and not (
            self.problem.designs_on_response and not (self.folder / FILES["fit"]).exists()
        )
        if "fit" not in self.results and fitted:
            self.results["fit"] = Fit.from_dict(self._read("fit"))
        return self.results.get("fit", self.problem.parameters)

    def values(self) -> ParameterSet:
        """Return the parameter values to design with, the file's for what the fit does not have."""
        return self.problem.values(self.parameters())

    def warn_of_design(self, plants: Iterable[Plant]) -> None:
        """Name on stderr why an earlier fit is not met, the parameters of plants that the fit cannot tell, and a delay
        that is too short.
        """
        names, source = {name for plant in plants for name in plant.parameters}, self.parameters()
        if isinstance(source, Fit) and not source.met and self._path("fit") not in self.written:
            self._say_once("warning", [f"{self._path('fit')}: {source.verdict}"])
        self._say_once("warning", warn_unidentified(self.values(), names))
        self._spec()

    def _spec(self) -> ControllerSpec:
        """Return the specification with its delay; warn of one that is shorter than the experiments'."""
        assert self.problem.spec is not None  # whoever designs has asked for the design plant before
        design, source = self.problem.design_plant, self.parameters()
        self._say_once("warning", warn_delays(self.problem.spec, design, source))
        return settle_delays(self.problem.spec, design, source)[0]

    def law(self) -> Controller | ScheduledController:
        """Return the law or schedule of this run or of the folder; refuse one for other limits than the problem's."""
        if "tune" not in self.results:
            schedule, law = self.problem.schedule, read_law(self.problem, self.parameters(), self._read("tune"))
            if schedule is None:
                self._check_spec(law.spec)
            elif (law.over, list(law.points)) != (schedule.over, schedule.points):
                raise ProblemError(
                    f"{self._path('tune')}: is over other points than [controller.schedule] of {self.problem.source}; "
                    f"run {self.spell('tune')} again"
                )
            else:
                self._check_spec(replace(law.spec, bandwidth_hz=self._spec().bandwidth_hz))
            self.results["tune"] = law
        return self.results["tune"]

    def plan(self) -> ForceMPC:
        """Return the predictive controller that the problem asks for, designed once."""
        if "mpc" not in self.results:
            self.results["mpc"] = design_mpc(self.problem, self.parameters())
        return self.results["mpc"]

    def take_law(self, path: Path) -> None:
        """Take a law of the user's own in place of a tuned one, and write it as the folder's controller. A controller
        that was tuned there is kept: the law then needs another folder. Of predictive control it is the controller.json
        of the problem's own.
        """
        if self.problem.mpc is not None:
            check_mpc_file(self.problem, self.plan(), path, f"run {self.spell('tune')}, and certify that")
            self._keep(linear_controller(self.plan()))
            return
        given = read_given_law(path)
        controller = assess_problem(self.problem, given, self.parameters())
        target, other = self.folder / FILES["tune"], "give the law another folder: -o DIR"
        if target.exists():
            earlier = read_json(target, SCHEMAS["tune"], remedy=other)
            if earlier.get("structure") != CUSTOM or "mpc" in earlier:
                raise ProblemError(f"{target}: is a controller that was tuned; {other}")
        self._keep(controller)

    def _keep(self, controller: Controller | ScheduledController) -> None:
        """Write what was tuned, or given, as the folder's controller; of predictive control with its plan."""
        plan = {} if self.problem.mpc is None else {"mpc": describe_mpc(self.plan())}
        self.results["tune"] = controller
        self._write("tune", controller.to_dict() | plan)

    def _path(self, stage: str) -> Path:
        return self.folder / FILES[stage]

    def _check_spec(self, stored: ControllerSpec) -> None:
        current = self._spec()
        # What was tuned again for the draws of its certificate may have more of a reserve than the file asks.
        spec = replace(current, reserve=max(current.reserve, stored.reserve)).to_dict()
        stated = OF_THE_LAW if stored.structure == CUSTOM else ()
        for name, value in stored.to_dict().items():
            if name not in stated and value != spec.get(name):
                raise ProblemError(
                    f"{self._path('tune')}: spec.{name} is {value}, and [controller] of {self.problem.source} asks for "
                    f"{spec.get(name)}; correct one of them, or run {self.spell('tune')} again"
                )

    def fit_met(self) -> bool:
        """Tell whether what is designed with is a fit that is met, or no fit at all."""
        source = self.parameters()
        return isinstance(source, ParameterSet) or source.met

    def _write(self, stage: str, content: dict[str, Any]) -> None:
        """Write a result with the digests of what it was made from, and whether its fit is met."""
        versions = {"seaopt": __version__, "python": platform.python_version(), "machine": platform.machine()}
        content = content | {"provenance": content.get("provenance", {}) | versions}
        if stage not in ("fit", "frf"):
            content = content | {"fit_met": self.fit_met(), "guessed": self.problem.table.guessed}
        made_from = digest_sources(self.problem, stage, self.folder)
        path = write_json(self._path(stage), content | {"made_from": made_from})
        self.written = [*(each for each in self.written if each != path), path]

    def _read(self, stage: str, schema: str = "") -> dict[str, Any]:
        """Read an earlier stage's result; one that was edited, or made from something else than is there, is refused. A
        controller made for another [robustness] is taken, as a certificate may ask about it. `schema`: of no stage of
        `SCHEMAS`.
        """
        path, again = self._path(stage), f"run {self.spell(stage)}"
        if not path.exists():
            raise ProblemError(f"{path}: no such file; {again} first")
        content = read_json(path, schema or SCHEMAS[stage], remedy=f"{again} again{OWN_LAW if stage == 'tune' else ''}")
        made_from, expected = content["made_from"], digest_sources(self.problem, stage, self.folder)
        changed = {name for name in {*expected, *made_from} - {CONTENT} if expected.get(name) != made_from.get(name)}
        if changed - {ROBUSTNESS}:
            if stage == "fit" and (lines := self.folder / EXPLAINED).exists():
                again = f"if fit --explain made it, put the lines of {lines} into {self.problem.source}; else {again}"
            raise ProblemError(
                f"{path}: was made from another problem file or earlier result; is {self.problem.source} the file of "
                f"{self.folder}, as it was then? If it was changed on purpose, {again} again, which replaces "
                f"{path.name}"
            )
        if changed:
            note = f"{path}: was tuned for another [robustness] than it is judged by; {again} to tune for this one"
            self._say_once("note", [note])
        return content

    def read_besides(self, stage: str, make: Callable[[dict[str, Any]], T], schema: str = "") -> T | None:
        """Return a result that another stage can do without; None where there is none of this problem."""
        try:
            return make(self._read(stage, schema)) if self._path(stage).exists() else None
        except ProblemError as error:
            self.say(f"left out: {error}")
            return None

    def _simulate(self, tell: Progress) -> None:
        if not self.problem.table.experiment:
            raise ProblemError(f"{self.problem.source}: has no [[experiment]] to simulate; {WRITE_ONE}")
        runs: dict[str, Log] = {}
        tables = {table.name: table for table in self.problem.table.experiment}
        for experiment in count_off(self.experiments(), "experiment", tell):
            name, table = experiment.name, tables[experiment.name]
            runs[name] = simulate_experiment(self.problem, experiment)
            self.written.append(write_log(runs[name], self.folder / f"simulation_{name}.csv"))
            if table.virtual is not None:
                self.written.append(write_log(experiment.log, self.folder / f"virtual_{name}.csv"))
        tell(", ".join(runs), 1.0)
        self.results["simulate"] = runs

    def _fit(self, tell: Progress) -> None:
        if self.explain and not (self.causes and self.problem.fit_options["causes"]):
            raise ProblemError("--explain looks for what the model lacks; leave out --no-causes, and causes = false")
        reading, fitting, again = divide(tell, READING, 1.0 - READING, 1.0 if self.explain else 0.0)
        reading("reading logs", 0.0)
        experiments, start = self.experiments(), self._find_earlier_fit()
        result = fit_problem(
            self.problem, experiments, start=start, causes=self.causes, keep=self._keep_fit, progress=fitting
        )
        if self.explain:
            trial = find_explanation(result)
            if trial is None:
                self.say(say_unexplained(result.hypotheses))
            else:
                self._keep_fit(result)
                result = self._explain(trial, result, again)
        self.results["scores"] = self._keep_fit(result)

    def _find_earlier_fit(self) -> Fit | None:
        """Return the folder's fit where it was made of some of the logs, and of all else as it is."""
        path = self._path("fit")
        try:
            content = read_json(path, SCHEMAS["fit"], remedy="") if path.exists() else {}
            earlier = Fit.from_dict(content) if content else None
        except SeaoptError:  # it is replaced, whatever is wrong with it
            return None
        if earlier is None or earlier.status != "converged":
            return None
        names = {*earlier.nuisance, *content.get("validation", {})}
        more = [table.name for table in self.problem.table.experiment if table.name not in names]
        if not more or content["made_from"].get("problem") != digest_fit_of(self.problem, names):
            return None
        self._say_once("note", [f"goes on from the values of {path}, which is without {', '.join(more)}"])
        return earlier

    def _keep_fit(self, result: Fit) -> list[ModelledOutputs]:
        """Write a fit that stands, judged or not, in place of the one before; return its scores of other logs."""
        lines, scores = self.folder / EXPLAINED, score_problem(self.problem, result, self.experiments())
        if lines not in self.written:
            lines.unlink(missing_ok=True)  # of another fit
        self.results["fit"] = result
        self._write("fit", result.to_dict() | {"validation": {score.name: score.to_dict() for score in scores}})
        return scores

    def _explain(self, trial: HypothesisTrial, before: Fit, tell: Progress) -> Fit:
        """Return the fit of the problem with what explains its logs, which is the problem from here on."""
        starts = [finding.where for finding in before.errors if finding.kind == "initial"]
        self.problem, lines = adopt(self.problem, trial, starts)
        self._stages = Stages(self.problem, fit=before)
        path = self.folder / EXPLAINED
        write_text(path, lines + "\n")
        self.written.append(path)
        self.say(
            f"{say_adopted(trial)}; fitting again with the lines in {path}, which belong into {self.problem.source}"
        )
        result = fit_problem(self.problem, self.experiments(), keep=self._keep_fit, progress=tell)
        return replace(result, hypotheses=(*before.hypotheses, *result.hypotheses))

    def validate(self, log: Path, like: str | None, as_json: bool, amount: Amount = "usual") -> bool:
        """Score the folder's fit on another log, and compare its values with the log's own; print that. `amount`: all
        of what the log has to say, if "verbose". False where the log contradicts the fit.
        """
        fitted = self.parameters()
        if isinstance(fitted, ParameterSet):
            raise ProblemError(f"{self.problem.source}: has no [[experiment]] that is fitted; {WRITE_ONE}")
        experiment, options = self.problem.experiment_like(log, like), self.problem.fit_options
        score = fitted.predict(experiment)
        comparison = compare_with_log(fitted, experiment, options["loss"], options["band_hz"])
        if not fitted.met:
            self.say(f"warning: scored {UNMET}: {fitted.verdict}")
        if as_json:
            content = {"schema": "seaopt/validation/1", "log": str(log)}
            sys.stdout.write(to_json(content | comparison.to_dict() | {"outputs": score.to_dict()}))
            return comparison.met is True
        console = Terminal()
        percents = ", ".join(f"{name} {percent:.2f} %" for name, percent in score.fit_percent.items())
        console.wrap(f"{log}: {percents}")
        if amount != "quiet":
            console.say(repr(score))
            console.say(repr(comparison))
        if amount == "verbose":
            console.say(repr(fitted))
        return comparison.met is True

    def _frf(self, tell: Progress) -> None:
        if not self.problem.table.experiment:
            raise ProblemError(f"{self.problem.source}: has no [[experiment]] to estimate from; {WRITE_ONE}")
        experiments = self.experiments()
        fitted = self.read_besides("fit", Fit.from_dict)
        responses = estimate_responses(experiments, self.problem, fitted, self.stretch_s, tell)
        self.results["frf"] = responses
        self._write("frf", {"schema": SCHEMAS["frf"], **responses.to_dict()})
        self.written += responses.draw(self.folder / "frf")

    def _tune(self, tell: Progress) -> None:
        source = self.parameters()
        design = self.problem.design_plant
        self.warn_of_design([design, *(plant for plant, _ in self.problem.robust_to(source).values())])
        result = tune_problem(self.problem, source, tell, self.executor)
        if isinstance(result, JointTuning):
            self.results["joint"], result = result, result.controller
        self._keep(result)

    def _sweep(self, tell: Progress) -> None:
        source, design = self.parameters(), self.problem.design_plant
        self.warn_of_design([design, *(plant for plant, _ in self.problem.robust_to(source).values())])
        options: dict[str, Any] = {"free_law": self.free_law, "executor": self.executor, "progress": tell}
        result, plans = sweep_problem(self.problem, source, self.bandwidths_hz, **options)
        content, self.results["sweep"] = result.to_dict(), result
        for law, plan in zip(content["controllers"], plans, strict=False):  # of predictive control each with its plan
            law["mpc"] = describe_mpc(plan)
        self._write("sweep", content)
        self.written += write_frontier_figure(result, self.folder / "frontier")

    def _certify(self, tell: Progress) -> None:
        plants = self.problem.certified_plants()
        law = self.law()
        self.warn_of_design(plants.values())
        result = certify_problem(self.problem, law, self.parameters(), tell, self.executor)
        self._say_once("note", self.problem.remarks(self.values()))
        self.results["certify"] = result
        self._write("certify", result.to_dict())

    def _report(self, tell: Progress) -> None:
        self.plan_stages()  # refuses a file that has nothing to report of
        results: list[Any] = []
        alone = not self.results  # of a whole run it is a report of what that made
        if self.problem.table.experiment:
            fitted = self.parameters()
            if isinstance(fitted, Fit):  # a design on measured points needs none
                used = fitted.experiments or self.problem.choose_fitted(self.experiments())
                self.results["fit"] = replace(fitted, experiments=used)
                results.append(self.results["fit"])
        from seaopt.cli.machine import read_besides  # deferred: it reads with a session

        besides = read_besides(self, alone)
        self.results.update(besides)
        results += besides.values()
        tuned = "tune" in self.results or self._path("tune").exists()
        if self.problem.spec is not None and (tuned or not results):  # a report is of something
            law = self.law()
            results.append(law if self.problem.mpc is None else self.plan())
            if "certify" not in self.results and self._path("certify").exists():
                self._read_certificate()
            results += [self.results["certify"]] if "certify" in self.results else []
        page = write_report(
            results,
            self.folder / "report.html",
            title=self.problem.title,
            progress=tell,
            files=[self.problem.source],
            command=spell_call(),
            expectations=self._expected(),
        )
        self.results["report"] = page
        self.written.append(page)

    def certificate(self) -> Certificate | None:
        """Return the folder's certificate; None where there is none of this law and problem."""
        try:
            self._read_certificate()
        except SeaoptError:
            return None
        return self.results["certify"]

    def _read_certificate(self) -> None:
        """Take the folder's certificate."""
        problem, content, law = self.problem, self._read("certify"), self.law()
        plan = None if problem.mpc is None else self.plan()
        options: dict[str, Any] = {"ranges": problem.ranges, "others": problem.parameters, "plan": plan}
        self.results["certify"] = Certificate.from_dict(
            content, law, problem.certified_plants(), self.parameters(), **options
        )

    def met(self, stages: list[str]) -> bool:
        """Tell whether everything that these stages require is met."""
        return all(verdict.met for stage in self._judged(stages) for verdict in self._verdicts(stage))

    def _judged(self, stages: list[str]) -> list[str]:
        """Return what has a verdict: of a report also what the problem file expects."""
        return ["fit", "tune", "certify", "accept", "bringup", "expect"] if "report" in stages else stages

    def _expected(self) -> list[tuple[bool, str]]:
        """Return what came of each expectation of the problem file."""
        expectations = list_expectations(self.problem)
        there = {"fit": None, "scores": [], "tune": None, "certify": None} | self.results
        if expectations and isinstance(there["fit"], Fit):
            there["scores"] = self._stages.scores
        results = Stages(self.problem, **there)  # of which nothing more is made
        return [expectation.check(results) for expectation in expectations]

    def _verdicts(self, stage: str) -> list[Verdict]:
        """Return what to say of a stage that has run; a design on a fit that is not met is not met either."""
        if stage == "expect":
            return judge_expectations(self._expected())
        result = self.results.get(stage)
        if result is None or stage == "simulate":
            return []
        if stage == "frf":
            return [Verdict(met=good, text=text) for good, text in result.verdict()]
        if stage == "sweep":
            mend = Step(text="mend the fit:", copied=(self.spell("fit"),))
            return [] if self.fit_met() else [Verdict(met=False, text=UNMET, next=(mend,))]
        verdicts: list[Verdict] = []
        if stage == "tune":
            joint = self.results.get("joint")
            if joint is not None:
                verdicts.append(judge_joint(joint, certified="certify" in self.results))
            result = result if self.problem.mpc is None else self.plan()
        again = self.spell("run" if self.problem.table.experiment else "tune")
        recipes = {
            table.plant: self.problem.plants[table.plant].recipe
            for table in self.problem.table.experiment
            if table.use == "fit"
        }
        commands = Commands(
            fit=self.spell("fit"),
            tune=self.spell("tune"),
            certify=again,
            plants={name: () if recipe is None else tuple(recipe.parts) for name, recipe in recipes.items()},
        )
        verdict = judge(result, commands)
        assert verdict is not None
        verdicts.append(verdict)
        if stage not in ("fit", "accept", "bringup") and not self.fit_met():
            shown = self._path("fit") in self.written  # with what comes next
            return [doubt_design(verdict, "" if shown else commands.fit) for verdict in verdicts]
        if self.problem.refused:  # a warning that a long fit's progress has left behind
            wrong = f"{self.problem.refused}; a design refuses this"
            verdicts = [replace(each, next=(*each.next, Step(text=wrong))) for each in verdicts]
        guesses = state_guesses(self.problem.table.guessed)
        return [name_guesses(verdict, guesses) for verdict in verdicts]

    def spell(self, command: str) -> str:
        """Return a command on this problem as it is typed."""
        logs = " LOG..." if command == "accept" else ""
        return f"seaopt {command} {shlex.quote(self.problem.source)}{logs} -o {shlex.quote(str(self.folder))}"

    def show(self, as_json: bool, stages: list[str], amount: Amount = "usual") -> None:
        """Print the results of the stages on stdout: verdicts first, then figures, as much as is asked for."""
        if as_json:
            contents = {stage: self._json(stage) for stage in stages if stage != "report" or len(stages) == 1}
            if "expect" in self._judged(stages) and self.problem.table.expect is not None:
                contents["expect"] = {"outcomes": [{"met": met, "text": text} for met, text in self._expected()]}
            sys.stdout.write(to_json(next(iter(contents.values())) if len(contents) == 1 else contents))
            return
        console = Terminal()
        judged = [verdict for name in self._judged(stages) for verdict in self._verdicts(name)]
        show_verdicts(console, judged, verbose=amount == "verbose")
        if amount == "quiet" and judged:
            return
        for stage in stages if amount != "quiet" else ():
            show_results(console, stage, self.results, self.problem, verbose=amount == "verbose")
            for remark in self.problem.remarks(self.values()) if stage == "certify" and amount == "verbose" else ():
                console.say(f"  note: {remark}")
        if self.written:
            console.list_files(self.written)

    def _json(self, stage: str) -> dict[str, Any]:
        if stage == "simulate":
            return {"schema": "seaopt/simulation/1", "files": [str(path) for path in self.written]}
        if stage == "report":
            return {"schema": "seaopt/report/1", "file": str(self.results[stage])}
        return json.loads(self._path(stage).read_text(encoding="utf-8"))
