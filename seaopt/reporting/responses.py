"""Frequency responses of a problem's experiments, measured and modelled."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from seaopt.errors import LogError
from seaopt.estimation import Experiment, Fit
from seaopt.frequency import Pair, SecondOrder, Survey
from seaopt.parameters import ParameterSet
from seaopt.problem import Problem
from seaopt.progress import Progress, count_off
from seaopt.records import record
from seaopt.reporting.comparison import experiment_survey, view_sensors
from seaopt.reporting.files import write_frequency_figure


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
