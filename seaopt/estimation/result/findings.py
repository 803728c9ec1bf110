"""The parts of a fit besides its parameters: findings, outputs, figures, and the unknowns of each experiment."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import field
from typing import Any, Literal

import numpy as np

from seaopt.codec import Key, OrInfinite, OrMinusInfinite, OrNaN
from seaopt.estimation.problem.shapes import Signal
from seaopt.parameters import QUANTILE
from seaopt.records import PlotAccessor, Worded, record

Severity = Literal["error", "warning", "note"]
SEVERITIES: tuple[Severity, ...] = ("error", "warning", "note")
GUESS = "guess"  # kind of the finding that names unverified values


@record
class FitFinding:
    """A fault of a fit, or a remark, for its user."""

    json_keys = (
        *("severity", "kind", "where", "text", "preferred"),
        Key(field="together", name="together", omit_none=True),
        Key(field="proposal", name="proposal", omit_none=True),
        Key(field="python", name="python", omit_none=True),
        Key(field="sticks", name="sticks", omit_none=True),
        Key(field="rate_hz", name="rate_hz", omit_none=True),
    )

    severity: Severity  # error: do not use the fit; warning: look at it; note: for information
    # for programs: "bound", "budget", "cause", "command", "delay", "event", "excess", "explained", "fixed", "guess",
    # "held_out", "initial", "noise", "quantisation", "range", "residual", "rough", "samples", "sharp", "starts",
    # "step", "unjudged", "unsearched"
    kind: str
    where: str  # EXPERIMENT.OUTPUT, an experiment, a parameter, or empty
    text: str  # with the remedy
    # value and std of what a "cause" frees, by name
    preferred: Mapping[str, tuple[float, float]] = field(default_factory=dict[str, tuple[float, float]])
    together: tuple[str, ...] | None = None  # of those, what the "cause" that is named first frees
    # what adds a "cause" that a part brings, lets friction jump, states a "quantisation" or frees an "initial" state:
    # lines of a problem file
    # (for a plant NAME, or an experiment), and calls
    proposal: str | None = None
    python: str | None = None
    sticks: bool | None = None  # whether a "cause" is friction that is smoothed where it jumps at rest
    rate_hz: float | None = None  # at which a "command" was held, that the log has only in part


@record
class SilentEffect:
    """An effect that the logs of a fit cannot tell: other values of some parameters follow them as well with it."""

    effect: str  # in words
    part: str  # that would bring it; "" where the plant has it
    parameter: str  # that is its size
    unit: str
    size: float  # that actuators have; where the parameter is there, how much more
    shifts: Mapping[str, float]  # by how much each parameter that it touches would be more, per unit of it, in SI
    seen: float  # standard deviations by which such a size would change the residuals


def state_guesses(guessed: Sequence[str]) -> str:
    """Return the guesses that a result rests on, in words; "" where there are none."""
    count = "1 guess" if len(guessed) == 1 else f"{len(guessed)} guesses"
    return f"on {count}: {', '.join(guessed)}" if guessed else ""


def order_findings(findings: Iterable[FitFinding]) -> tuple[FitFinding, ...]:
    """Return findings with the errors first, and the notes last; of each severity a cause first, as it is the cure."""
    return tuple(sorted(findings, key=lambda each: (SEVERITIES.index(each.severity), each.kind != "cause")))


def find_guesses(guessed: Sequence[str]) -> tuple[FitFinding, ...]:
    """Return a warning that names the guesses, or nothing where there are none."""
    if not guessed:
        return ()
    text = (
        "the stated uncertainties exclude these values, and an error in them biases the fit; measure each, give its "
        "value, and take its name out of guessed = [...]"
    )
    return (FitFinding(severity="warning", kind=GUESS, where=state_guesses(guessed), text=text),)


def find_sharp_friction(experiment: str) -> FitFinding:
    """Return a note that an experiment was fitted with friction that jumps in place of its sharply smoothed curve."""
    return FitFinding(
        severity="note",
        kind="sharp",
        where=experiment,
        text="its friction is smoothed too sharply to be simulated in time, and was fitted as it jumps at rest; write "
        "sticks = true (so.plants.let_stick), or give a larger smoothing speed",
    )


def find_unjudged() -> FitFinding:
    """Return the error of a fit whose judgement has not ended: nobody is to take it for met."""
    return FitFinding(
        severity="error",
        kind="unjudged",
        where="",
        text="it is not judged: what it leaves was still looked into as it was written; let the fit run to its end",
    )


def find_unsearched(*, asked: bool) -> FitFinding:
    """Return a note that nobody has looked for what the model lacks; an error where the fit left what `asked` for it,
    as intervals then lack the values that another cause would give.
    """
    left_out = "what the model may lack was not looked for, as causes = false leaves that out"
    return FitFinding(
        severity="error" if asked else "note",
        kind="unsearched",
        where="",
        text=f"{left_out}, and what the fit leaves asks for it: values may be off by more than their intervals; fit "
        "with causes = true"
        if asked
        else f"{left_out}; nothing that the fit leaves asks for it",
    )


def find_ended_search(evaluations: float) -> FitFinding:
    """Return a note that the search for causes has made all evaluations that it may, before all causes were tried."""
    return FitFinding(
        severity="note",
        kind="budget",
        where="",
        text=f"the search for causes was ended by its budget of {evaluations:.0f} evaluations: causes that are not "
        "named, and pairs of them, may not have been tried; mend what is named, and fit again",
    )


def find_ended_start() -> FitFinding:
    """Return a note that a search from another start has made all evaluations that it may, before its end."""
    return FitFinding(
        severity="note",
        kind="budget",
        where="",
        text="a search from another start was ended by its budget of evaluations: whether it ends elsewhere is not "
        "known; a fit from other values of your own tells",
    )


def find_energy(fit_percent: float) -> float:
    """Return the share of an output's energy that a fit percent stands for."""
    return max(1.0 - (1.0 - fit_percent / 100.0) ** 2, 0.0)


@record
class OutputFit:
    """Scores of one output of one experiment.

    Parameters
    ----------
    fit_percent : float
        ``100 (1 - norm(y - yhat) / norm(y - mean(y)))`` over the samples used.
    holdout_fit_percent : float or None
        The same over the samples kept back; None if there are none.
    band_fit_percent : float or None
        The same for the signals filtered to the fit's band; None without one.
    one_step_fit_percent : float or None
        The same for the prediction one sample ahead, of a prediction-error fit; None otherwise.
    rms_residual : float
        Of the samples used, unfiltered, in `unit`.
    sigma : float
        The standard deviation that residuals were weighted with (of the filtered residual, with a band).
    unit : str
        The output's.
    whiteness_p : float
        Ljung-Box p-value of the weighted residual; small means coloured.
    explained : float or None
        Share of the output's energy (in the fit's band) that the model accounts for; None without diagnostics.
    explainable : float or None
        The share that some model of the inputs could account for, by coherence and by a flexible predictor; None where
        the log is too short to tell.
    excess : float or None
        How many times the noise of its sensor the residual is: 1 where nothing is missing; None without diagnostics.
    spread : float or None
        Standard deviation of what was measured, in `unit`; None in older files.

    """

    fit_percent: OrNaN
    holdout_fit_percent: float | None
    rms_residual: OrNaN
    sigma: OrNaN
    unit: str
    whiteness_p: OrNaN
    band_fit_percent: float | None = None
    one_step_fit_percent: float | None = None
    explained: float | None = None
    explainable: float | None = None
    excess: float | None = None
    spread: float | None = None


@record
class DerivedFigure:
    """A figure that follows from the parameters, or is an experiment's own, with its std from the covariances."""

    json_keys = ("value", "unit", "std", "model_std", "ci95", "known")

    value: float
    unit: str
    std: OrInfinite
    model_std: OrInfinite = 0.0

    @property
    def total_std(self) -> OrInfinite:
        """The standard deviation of noise and model together."""
        return math.hypot(self.std, self.model_std)

    @property
    def ci95(self) -> tuple[OrMinusInfinite, OrInfinite]:
        """The 95 % interval, of noise and model together."""
        return (self.value - QUANTILE * self.total_std, self.value + QUANTILE * self.total_std)

    @property
    def known(self) -> OrInfinite:
        """Half the width of the 95 % interval over the value."""
        return QUANTILE * self.total_std / abs(self.value) if self.value else math.inf


@record
class LogValues:
    """What one log says alone of the values of a fit."""

    plant: str  # its name
    amplitude: OrNaN  # standard deviation of the spring's force or torque, in the output's unit
    excess: OrInfinite  # its residual over its sensor's noise, of the output where that is the largest
    # with stds of noise, of the parameters that it determines with the fit's other values
    values: Mapping[str, tuple[float, OrInfinite]]
    determined: bool  # whether it determines all of them


@record
class Nuisance:
    """An experiment's own unknowns as estimated: delay, gain and offset per output, initial state per segment.

    `drift` has the coefficients of Legendre's polynomials over the log, `noise` the logarithms of the process noise
    over each state's size (of a prediction-error fit), `substeps` how many integration steps each sample took, or as
    exact a number where some took more than others (a linear plant needs one), `plant` the name of the experiment's
    plant, empty in older files, `hold` what its inputs did between samples.
    """

    delay_s: float
    gain: dict[str, float]
    offset: dict[str, float]
    initial_state: tuple[dict[str, float], ...]
    substeps: int = 1
    drift: dict[str, tuple[float, ...]] = field(default_factory=dict[str, tuple[float, ...]])
    noise: dict[str, float] = field(default_factory=dict[str, float])
    std: dict[str, OrInfinite] = field(default_factory=dict[str, float])
    model_std: dict[str, OrInfinite] = field(default_factory=dict[str, float])
    plant: str = ""
    hold: Literal["zero", "first"] = "zero"

    @property
    def fitted(self) -> dict[str, DerivedFigure]:
        """The estimated delay and gains, `delay_s` and `gain.F1`, with standard deviations."""
        values = {"delay_s": self.delay_s, **{f"gain.{name}": gain for name, gain in self.gain.items()}}
        return {
            key: DerivedFigure(
                value=values[key],
                unit="s" if key == "delay_s" else "-",
                std=std,
                model_std=self.model_std.get(key, 0.0),
            )
            for key, std in self.std.items()
        }


@record(eq=False, repr=False)
class ModelledOutputs(Worded):
    """Measured and model outputs of an experiment on its clock; NaN where there is no value.

    `own` has the experiment's own unknowns that the model was simulated with, `band_fit_percent` is None of outputs
    without a band, `units` are the outputs'.
    """

    plot = PlotAccessor()

    time: Signal
    inputs: dict[str, Signal]
    measured: dict[str, Signal]
    model: dict[str, Signal]
    name: str
    own: Nuisance
    band_fit_percent: dict[str, float | None]
    units: dict[str, str]

    @property
    def fit_percent(self) -> dict[str, float]:
        """``100 (1 - norm(y - yhat) / norm(y - mean(y)))`` of each output, over the samples that are there."""
        return {name: self._score(name) for name in self.model}

    @property
    def rms_residual(self) -> dict[str, float]:
        """Root of the mean square of model minus measured, in the output's unit."""
        return {
            name: float(np.sqrt(np.nanmean((model - self.measured[name]) ** 2))) for name, model in self.model.items()
        }

    def _score(self, name: str) -> float:
        good = np.isfinite(self.model[name]) & np.isfinite(self.measured[name])
        y = self.measured[name][good]
        spread = float(np.linalg.norm(y - np.mean(y)))
        return 100.0 * (1.0 - float(np.linalg.norm(y - self.model[name][good])) / max(spread, 1e-300))

    def to_dict(self) -> dict[str, Any]:
        """Return the scores, of each output, as numbers."""
        percents, rms = self.fit_percent, self.rms_residual
        return {
            name: {
                "fit_percent": percents[name],
                "band_fit_percent": self.band_fit_percent.get(name),
                "rms_residual": rms[name],
                "unit": self.units[name],
            }
            for name in self.model
        }
