"""Frequency responses of a problem's experiments, as the command shows and writes them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from seaopt.cli.terminal import Terminal
from seaopt.errors import LogError
from seaopt.estimation import Experiment, Fit
from seaopt.estimation.result.fit_result import Nuisance
from seaopt.formatting import MISSING, format_number
from seaopt.frequency import DriveEstimate, Pair, SecondOrder, Survey
from seaopt.parameters import ParameterSet
from seaopt.problem import Problem
from seaopt.progress import Progress, count_off
from seaopt.records import record
from seaopt.reporting import experiment_survey, write_frequency_figure

TITLES = ("response", "coherent", "peak", "gain", "f_n", "zeta", "form", "file")

RESPONSES_NOTE = (
    "coherent: band of coherence above 0.8; peak and natural frequency f_n in Hz; gain, f_n and damping ratio zeta: "
    "of the second-order form K/(s² + a s + b), fitted; form, file, fit: how far that form and the model with the "
    "file's and the fitted values lie from H1, in its standard deviations"
)


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
                row["fitted_misfit"] = self._fitted_misfit(name, pair)
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

    def show(self, console: Terminal) -> None:
        """Print a row per response of each experiment, and what those of second order say of the actuator."""
        titles = (*TITLES, "fit") if self.fitted else TITLES
        for name, survey in self.surveys.items():
            console.say(f"\n{name}", style="bold")
            rows = [self._format_cells(name, survey, pair) for pair in survey.pairs]
            console.tabulate(rows, titles, "<<".ljust(len(titles), ">"))
            for pair in survey.pairs:
                drive = survey.drive(pair, self.guess)
                for line in _describe_drive(survey, pair, drive) if drive is not None else ():
                    console.wrap(line, indent=2)
        console.wrap(RESPONSES_NOTE, indent=2, style="dim")

    def _format_cells(self, name: str, survey: Survey, pair: Pair) -> list[str]:
        band, peak, form = pair.good_band_hz, pair.peak, pair.second_order
        figures = (form.static_gain, form.natural_frequency_hz, form.damping_ratio) if form is not None else ()
        misfits = [form.misfit if form is not None else None, pair.misfit(survey.model(pair, self.guess))]
        misfits += [self._fitted_misfit(name, pair)] if self.fitted else []
        return [
            pair.name,
            f"{band[0]:.2g}–{band[1]:.3g}" if band is not None else "none",
            format_number(None if peak is None else peak.frequency_hz, 3),
            *(format_number(figure.value, 3) for figure in figures),
            *([MISSING] * (3 - len(figures))),
            *(format_number(misfit, 3) for misfit in misfits),
        ]

    def _fitted_misfit(self, name: str, pair: Pair) -> float | None:
        if name not in self.fitted:
            return None
        survey, fit = self.fitted[name]
        return pair.misfit(survey.model(pair, fit.parameters))


def estimate_responses(
    experiments: tuple[Experiment, ...], problem: Problem, fit: Fit | None, stretch_s: float | None, progress: Progress
) -> Responses:
    """Estimate the frequency responses of every experiment.

    Raises
    ------
    LogError
        A log does not allow one: nothing is excited, it has gaps or missing samples, or is too short.

    """
    surveys: dict[str, Survey] = {}
    fitted: dict[str, tuple[Survey, Fit]] = {}
    for experiment in count_off(experiments, "experiment", progress):
        try:
            surveys[experiment.name] = experiment_survey(experiment, stretch_s=stretch_s)
            if fit is not None and experiment.name in fit.nuisance:
                fitted[experiment.name] = (_adopt_fit(surveys[experiment.name], fit.nuisance[experiment.name]), fit)
        except LogError as error:
            raise LogError(f"{problem.source}: experiment {experiment.name}: {error}") from error
    progress(", ".join(surveys), 1.0)
    return Responses(surveys=surveys, guess=problem.parameters, fitted=fitted)


def _adopt_fit(survey: Survey, nuisance: Nuisance) -> Survey:
    """Return a survey whose models have a fit's delay and gains."""
    return replace(survey, clock=replace(survey.clock, delay_s=nuisance.delay_s, delay_free=False), gain=nuisance.gain)


def _describe_drive(survey: Survey, pair: Pair, drive: DriveEstimate) -> tuple[str, ...]:
    form, spring = pair.second_order, survey.plant.spring
    assert form is not None and spring is not None
    m_k, b_m = spring.mass, spring.damping
    return (
        f"{pair.name} in second order, per unit of what the motor gives: "
        f"{drive.K.value:.5g}/(s² + {form.a.value:.4g} s + {form.b.value:.5g})",
        f"with k known: {m_k} = {drive.m_k}, {b_m} = {drive.b_m}, efficiency {drive.efficiency}",
        f"K and b averaged, as the paper does: {m_k} = {drive.m_k_averaged}, {b_m} = {drive.b_m_averaged}",
    )
