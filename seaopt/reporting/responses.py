"""Frequency responses of a problem's experiments, measured and modelled."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from seaopt.codec import check_agrees, from_content
from seaopt.errors import FileError, LogError
from seaopt.estimation import Experiment, Fit
from seaopt.frequency import Pair, SecondOrder, Survey
from seaopt.frequency.survey import StoredSurvey
from seaopt.parameters import ParameterSet
from seaopt.problem import Problem
from seaopt.progress import Progress, count_off
from seaopt.records import record
from seaopt.reporting.comparison import experiment_survey, view_sensors
from seaopt.reporting.files import write_frequency_figure

FRF_SCHEMA = "seaopt/frf/1"
AGREES = 1e-6  # of misfits, which are computed again, on this machine and another
FILE, ESTIMATE_AGAIN = "frf.json", "estimate them again: seaopt frf"


@record(eq=False)
class StoredResponses:
    """What frf.json has of each experiment."""

    experiments: Mapping[str, StoredSurvey]


@record(eq=False)
class Responses:
    """Surveys of the experiments under the file's values and, where DIR has a fit, under its own."""

    surveys: Mapping[str, Survey]
    guess: ParameterSet
    fitted: Mapping[str, tuple[Survey, Fit]]

    def to_dict(self) -> dict[str, Any]:
        """Return the content of frf.json, without its schema."""
        content: dict[str, Any] = {}
        for name, survey in self.surveys.items():
            content[name] = survey.to_dict(self.guess)
            for row, pair in zip(content[name]["pairs"], survey.pairs, strict=True):
                row["fitted_misfit"] = self.fitted_misfit(name, pair)
        return {"experiments": content}

    @classmethod
    def from_dict(cls, content: Mapping[str, Any], problem: Problem, fit: Fit | None = None) -> Responses:
        """Return the responses of a frf.json; nothing is estimated. `problem`: whose logs they are of. `fit`: to lay
        beside them. Raises FileError: a field is missing or malformed, or contradicts another.
        """
        stored = from_content(StoredResponses, content, FILE, remedy=ESTIMATE_AGAIN)
        tables = {table.name: table for table in problem.table.experiment}
        unknown = [name for name in stored.experiments if name not in tables]
        if unknown:
            raise FileError(f"{FILE}: {problem.source} has no experiment {unknown[0]}; {ESTIMATE_AGAIN}")
        plants = {name: problem.plants[tables[name].plant] for name in stored.experiments}
        surveys = {name: survey.make(plants[name]) for name, survey in stored.experiments.items()}
        fitted: dict[str, tuple[Survey, Fit]] = {}
        for name, survey in surveys.items():
            if fit is not None and name in fit.nuisance:
                at = fit.nuisance[name]
                clock = replace(survey.clock, delay_s=at.delay_s, delay_free=False)
                fitted[name] = replace(survey, clock=clock, gain=at.gain), fit
        responses = cls(surveys=surveys, guess=problem.parameters, fitted=fitted)
        made = responses.to_dict()
        for name, each in made["experiments"].items():
            for row, written in zip(each["pairs"], content["experiments"][name]["pairs"], strict=True):
                row["fitted_misfit"] = written.get("fitted_misfit")  # of the fit that there was
        check_agrees(content, made, FILE, remedy=ESTIMATE_AGAIN, rtol=AGREES)
        return responses

    def draw(self, path: Path) -> list[Path]:
        """Write the figure as SVG and PNG."""
        return write_frequency_figure(self.surveys, path, given=self.guess, fitted=self.fitted)

    def verdict(self) -> list[tuple[bool, str]]:
        """Return one line per experiment: whether every response is coherent enough for a second-order fit."""
        lines: list[tuple[bool, str]] = []
        for name, survey in self.surveys.items():
            poor = [pair.name for pair in survey.pairs if pair.second_order is None]
            what = f"too little coherence in {', '.join(poor)}; excite more" if poor else "every response is coherent"
            lines.append((not poor, f"{name}: {what}"))
        return lines

    def list_forms(self) -> list[SecondOrder]:
        """Return the second-order fits."""
        pairs = (pair for survey in self.surveys.values() for pair in survey.pairs)
        return [pair.second_order for pair in pairs if pair.second_order is not None]

    def fitted_misfit(self, name: str, pair: Pair) -> float | None:
        """Return how far the model with the fitted values is from a response; None without a fit."""
        if name not in self.fitted:
            return None
        survey, fit = self.fitted[name]
        return pair.misfit(survey.model(pair, fit.parameters))


def estimate_responses(
    experiments: tuple[Experiment, ...], problem: Problem, fit: Fit | None, stretch_s: float | None, progress: Progress
) -> Responses:
    """Estimate the frequency responses of every experiment. Raises LogError: a log does not allow one: nothing is
    excited, it has gaps or missing samples, or is too short.
    """
    surveys: dict[str, Survey] = {}
    fitted: dict[str, tuple[Survey, Fit]] = {}
    for experiment in count_off(experiments, "experiment", progress):
        try:
            surveys[experiment.name] = experiment_survey(experiment, stretch_s=stretch_s)
            if fit is not None and experiment.name in fit.nuisance:
                pairs = surveys[experiment.name].pairs
                fitted[experiment.name] = (replace(view_sensors(experiment, fit), pairs=pairs), fit)
        except LogError as error:
            raise LogError(f"{problem.source}: experiment {experiment.name}: {error}") from error
    progress(", ".join(surveys), 1.0)
    return Responses(surveys=surveys, guess=problem.parameters, fitted=fitted)
