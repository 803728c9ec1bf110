"""The report: one self-contained HTML page of fits, a controller and a certificate, and its figures as files."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from seaopt.control import Controller, ForceMPC, Frontier
from seaopt.control.laws.verdict import join_labels, list_design_figures
from seaopt.errors import SeaoptError, require_type
from seaopt.estimation import Diagnostics, Fit, Ranking, diagnose
from seaopt.files import write_text
from seaopt.formatting import format_number
from seaopt.frequency import Survey
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.reporting.comparison import fit_surveys, sentence, survey_figure
from seaopt.reporting.drawing import inline_svg, write_figure
from seaopt.reporting.figures import all_figures
from seaopt.reporting.residuals import ranking_figure, residual_figure
from seaopt.reporting.templates import render_template
from seaopt.reporting.verification import render_verification, verification_figures
from seaopt.robustness import Certificate
from seaopt.robustness.verification.environments import StabilityMap
from seaopt.robustness.verification.large_signal import LargeSignal
from seaopt.robustness.verification.verification import Verification

Result = Fit | Ranking | Controller | ForceMPC | Certificate | Verification | StabilityMap | LargeSignal
_CAPTIONS = {
    "time": "Measured and model outputs in the time domain",
    "response": "Frequency response: H1 estimate of the log, the fitted model and the second-order fit (16)",
    "residual": "Residuals and their correlations; shaded: what one lag of a hundred exceeds by chance",
    "ranking": "Residuals of the fits that are compared, octave by octave",
    "loop": "The closed loop on every plant",
    "simulation": "Force or torque, and what is commanded, of each scenario; grey: link 2 is held; yellow: the "
    "judged window of a failed run",
    "bandwidth": "Bandwidth against amplitude",
    "amplitude": "What is left of the loop at large amplitudes, and where the command saturates",
    "environments": "Stable (blue) or not (orange) against a mass on a spring and a damper; dots: the edge",
}


def write_report(
    results: Sequence[Result],
    path: Path | str,
    *,
    title: str = "Series elastic actuator",
    progress: Callable[[str, int, int], None] | None = None,
) -> Path:
    """Write an HTML page, and its figures beside it as SVG and PNG.

    Parameters
    ----------
    results : sequence of Fit, Ranking, Controller, ForceMPC, Certificate, Verification, StabilityMap, LargeSignal
        At most one of each, of the last any number; sections without a result are left out. A fit that was not
        read from a file has a section of diagnostics. A certificate's simulations need not be listed.
    path : path
        The page; figures go to the folder ``figures`` beside it.
    title : str
        Heading of the page.
    progress : callable, optional
        Called before each figure is drawn, which takes the most time, with its name, its number from 1 and how many
        there are.

    Returns
    -------
    Path
        The page.

    Raises
    ------
    SeaoptError
        There is nothing to report, or two results of a kind.
    FileError
        The folder cannot be written.

    Examples
    --------
    >>> import tempfile, seaopt as so
    >>> controller = so.tune(so.plants.high_impedance(), so.plants.thor(), so.ControllerSpec(bandwidth_hz=30))
    >>> so.write_report([controller], tempfile.mkdtemp() + "/report.html").name
    'report.html'

    """
    require_type(results, Sequence, "results", "give a list of results")
    require_type(path, (str, Path), "path", "give the page to write")
    kinds = (Fit, Ranking, Controller, ForceMPC, Certificate, Verification, StabilityMap)
    fit, ranking, controller, mpc, certificate, verification, coupled = (_select(results, kind) for kind in kinds)
    large = [result for result in results if isinstance(result, LargeSignal)]
    if not any(isinstance(result, (*kinds, LargeSignal)) for result in results):
        raise SeaoptError(
            "write_report got no result; give a Fit, a Ranking, a Controller, a Certificate or a Verification"
        )
    if certificate is not None:
        controller = controller or certificate.controller
        simulation, verification = certificate.simulated, verification or certificate.runs
        if simulation is not None:
            coupled = coupled or simulation.environments
            large = large or list(simulation.large_signal)
    surveys = fit_surveys(fit) if fit is not None else {}
    diagnostics = diagnose(fit) if fit is not None and fit.minimum is not None else None
    figures = all_figures(fit, surveys, controller, _plants(controller, certificate))
    figures |= _draw_residuals(fit, diagnostics, ranking)
    simulated = verification_figures(verification, large, coupled)
    figures |= simulated
    target = Path(path)
    sections: list[dict[str, str]] = []
    for place, (name, figure) in enumerate(figures.items(), start=1):
        if progress is not None:
            progress(name, place, len(figures))
        svg, _ = write_figure(figure, target.parent / "figures" / name)
        sections.append(
            {
                "name": name,
                "kind": name.split("_")[0],
                "caption": _caption(name),
                "svg": inline_svg(svg.read_text(encoding="utf-8"), name),
                "note": _note(name, surveys, fit),
            }
        )
    svgs = {section["name"]: section["svg"] for section in sections if section["name"] in simulated}
    port = certificate.simulated if certificate is not None else None
    page = render_template(
        "report.html.jinja", title=title, fit=fit, diagnostics=diagnostics, ranking=ranking, controller=controller,
        certificate=certificate, figures=sections, verdict=verdict(fit, controller, certificate, verification, mpc),
        mpc=mpc,
        swinging=_swings(certificate), forces=_describe_forces(controller),
        limited=[] if controller is None else list_design_figures(controller.spec, controller.design_loop),
        simulated=render_verification(verification, large, coupled, port, svgs),
    )  # fmt: skip
    return write_text(target, page)


def _draw_residuals(fit: Fit | None, diagnostics: Diagnostics | None, ranking: Ranking | None) -> dict[str, Any]:
    """Return the figures of residuals, by file name."""
    figures: dict[str, Any] = {}
    if fit is not None and diagnostics is not None:
        figures |= {f"residual_{name}": residual_figure(fit, diagnostics, name) for name in diagnostics.outputs}
    if ranking is not None:
        figures["ranking"] = ranking_figure(ranking)
    return figures


def write_frequency_figure(
    surveys: Mapping[str, Survey],
    path: Path | str,
    *,
    given: ParameterSet | None = None,
    fitted: Mapping[str, tuple[Survey, Fit]] | None = None,
) -> list[Path]:
    """Draw frequency responses of experiments to SVG and PNG.

    Parameters
    ----------
    surveys : mapping of experiment to Survey
        At least one.
    path : path
        Without suffix; ``.svg`` and ``.png`` are added.
    given : ParameterSet, optional
        Values before a fit: the plant's model is drawn with them.
    fitted : mapping of experiment to (Survey, Fit), optional
        Surveys under a fit's delays and gains, and the fit: the model is drawn as fitted.

    Returns
    -------
    list of Path
        The two files.

    Raises
    ------
    FileError
        The folder cannot be written.

    """
    return write_figure(survey_figure(surveys, given, fitted), path)


def write_frontier_figure(frontier: Frontier, path: Path | str) -> list[Path]:
    """Draw a sweep of bandwidths to SVG and PNG.

    Parameters
    ----------
    frontier : Frontier
        Of `seaopt.control.sweep`.
    path : path
        Without suffix; ``.svg`` and ``.png`` are added.

    Returns
    -------
    list of Path
        Both files.

    """
    from seaopt.reporting.frontier import frontier_figure

    return write_figure(frontier_figure(frontier), path)


def _select(results: Sequence[Result], kind: type) -> Any:
    matches = [result for result in results if isinstance(result, kind)]
    if len(matches) > 1:
        raise SeaoptError(
            f"write_report got {len(matches)} results of kind {kind.__name__}; give one, or write two pages"
        )
    return matches[0] if matches else None


def _plants(controller: Controller | None, certificate: Certificate | None) -> dict[str, tuple[Plant, ParameterSet]]:
    if certificate is not None:
        return {name: (plant, certificate.parameters) for name, plant in certificate.linear_models.items()}
    if controller is not None and controller.design is not None:
        return {"design plant": controller.design}
    return {}


def _caption(name: str) -> str:
    kind, _, rest = name.partition("_")
    return _CAPTIONS[kind] + (f": {rest}" if rest else "")


def _note(name: str, surveys: Mapping[str, Survey], fit: Fit | None) -> str:
    """Return what a figure of frequency responses shows, in words; nothing for other figures."""
    kind, _, experiment = name.partition("_")
    return sentence(surveys[experiment], fit, experiment) if kind == "response" and fit is not None else ""


def _swings(certificate: Certificate | None) -> bool:
    """Tell whether some plant's -3 dB bandwidth says nothing: its tracking band does not start at 0 Hz."""
    plants = certificate.plants.values() if certificate is not None else ()
    return any(figures.tracking_band_hz is not None and figures.tracking_band_hz[0] > 1.0 for figures in plants)


def _describe_forces(controller: Controller | None) -> str:
    """Return what the limit of the command allows, and what the motor can do without overheating."""
    if controller is None:
        return ""
    slow, band, unit = controller.force_limit(0.0), controller.spec.bandwidth_hz, controller.command.reference_unit
    sentences = [] if controller.rating is None else [f"Motor: {line}." for line in controller.rating.describe()]
    if slow is not None and controller.command_limit is not None:
        sentences.insert(
            0,
            f"The limit of {controller.command.show(controller.command_limit)} allows a reference of "
            f"{format_number(slow)} {unit} at rest and {format_number(controller.force_limit(band))} {unit} at "
            f"{band:g} Hz, whatever the gains.",
        )
    return " ".join(sentences)


def _describe_simulations(certificate: Certificate) -> str:
    return "" if certificate.runs is None else f", {len(certificate.runs.rows)} simulations passed"


def verdict(
    fit: Fit | None, controller: Controller | None, certificate: Certificate | None,
    verification: Verification | None = None, mpc: ForceMPC | None = None,
) -> list[tuple[bool, str]]:  # fmt: skip
    """Return one line per stage: whether it is met, and what to say."""
    lines: list[tuple[bool, str]] = []
    if fit is not None:
        lines.append((fit.met, f"Fit: {fit.verdict}"))
    if controller is not None:
        what = "every limit met" if controller.feasible else "not met: " + join_labels(controller.active_constraints)
        lines.append((controller.feasible, f"Controller at {controller.spec.bandwidth_hz:g} Hz: {what}"))
    if mpc is not None:
        what = "every limit met" if mpc.feasible else f"not met: {join_labels(mpc.broken)}"
        lines.append((mpc.feasible, f"Predictive control at {mpc.spec.bandwidth_hz:g} Hz: {what}"))
    if certificate is not None:
        mc = certificate.monte_carlo
        broken = [f"{row.name} ({row.where})" for row in certificate.requirements if not row.met]
        what = (
            f"passed – {mc.failures} failures in {mc.samples} draws, failure probability below "
            f"{mc.failure_probability_bound:.3g}{_describe_simulations(certificate)}"
            if certificate.passed
            else "failed – " + "; ".join(broken)
        )
        lines.append((certificate.passed, f"Certificate: {what}"))
    if verification is not None:
        failed = dict.fromkeys(f"{row.scenario} on {row.plant}" for row in verification.failures)
        what = "failed – " + ", ".join(failed) if failed else f"{len(verification.rows)} runs passed"
        lines.append((verification.passed, f"Simulation: {what}"))
    return lines
