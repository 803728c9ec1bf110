"""The report: one self-contained HTML page of fits, a controller and a certificate, and its figures as files."""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from seaopt.control import Controller, Frontier
from seaopt.control.laws.verdict import list_design_figures
from seaopt.errors import SeaoptError
from seaopt.estimation import Diagnostics, Fit, Ranking, diagnose
from seaopt.estimation.advice.forecasts import Percent
from seaopt.files import write_bytes, write_text
from seaopt.frequency import Survey
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.reporting.comparison import fit_surveys, sentence, survey_figure
from seaopt.reporting.figures import all_figures
from seaopt.reporting.residuals import ranking_figure, residual_figure
from seaopt.reporting.verification import verification_figures, verification_section
from seaopt.robustness import Certificate
from seaopt.robustness.verification.environments import StabilityMap
from seaopt.robustness.verification.large_signal import LargeSignal
from seaopt.robustness.verification.verification import Verification

Result = Fit | Ranking | Controller | Certificate | Verification | StabilityMap | LargeSignal
_CAPTIONS = {
    "time": "Measured and model outputs in the time domain",
    "response": "Frequency response: H1 estimate of the log, the fitted model and the second-order fit (16)",
    "residual": "Residuals and their correlations; shaded: what one lag of a hundred exceeds by chance",
    "ranking": "Residuals of the fits that are compared, octave by octave",
    "loop": "The closed loop on every plant",
    "simulation": "Force and current of each scenario; grey: link 2 is held; yellow: the judged window of a failed run",
    "amplitude": "What is left of the loop at large amplitudes, and where the current saturates",
    "environments": "Stable (blue) or not (orange) against a mass on a spring and a damper; dots: the edge",
}
DPI = 130


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
    results : sequence of Fit, Ranking, Controller, Certificate, Verification, StabilityMap, LargeSignal
        At most one of each, of the last any number; sections of what is not there are left out. A fit that was not
        read from a file has a section of diagnostics. What a certificate has simulated stands for itself.
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
    kinds = (Fit, Ranking, Controller, Certificate, Verification, StabilityMap)
    fit, ranking, controller, certificate, verification, coupled = (_only(results, kind) for kind in kinds)
    large = [item for item in results if isinstance(item, LargeSignal)]
    if not any(isinstance(item, (*kinds, LargeSignal)) for item in results):
        raise SeaoptError(
            "write_report got no result; give a Fit, a Ranking, a Controller, a Certificate or a Verification"
        )
    if certificate is not None:
        controller = controller or certificate.controller
        found = certificate.simulated
        if found is not None:
            verification, coupled = verification or found.verification, coupled or found.environments
            large = large or list(found.large_signal)
    surveys = fit_surveys(fit) if fit is not None else {}
    diagnostics = diagnose(fit) if fit is not None and fit.minimum is not None else None
    figures = all_figures(fit, surveys, controller, _plants(controller, certificate))
    figures |= _leftover_figures(fit, diagnostics, ranking)
    simulated = verification_figures(verification, large, coupled)
    figures |= simulated
    target = Path(path)
    drawn: list[dict[str, str]] = []
    for place, (name, figure) in enumerate(figures.items(), start=1):
        if progress is not None:
            progress(name, place, len(figures))
        svg = rendered(figure, "svg")
        write_bytes(target.parent / "figures" / f"{name}.svg", svg)
        write_bytes(target.parent / "figures" / f"{name}.png", rendered(figure, "png"))
        drawn.append(
            {
                "name": name,
                "kind": name.split("_")[0],
                "caption": _caption(name),
                "svg": _inline(svg.decode(), name),
                "note": _note(name, surveys, fit),
            }
        )
    shown = {item["name"]: item["svg"] for item in drawn if item["name"] in simulated}
    port = certificate.simulated if certificate is not None else None
    section = verification_section(verification, large, coupled, port, shown, number)
    return write_text(
        target, _page(title, fit, diagnostics, ranking, controller, certificate, drawn, verification, section)
    )


def _leftover_figures(fit: Fit | None, diagnostics: Diagnostics | None, ranking: Ranking | None) -> dict[str, Any]:
    """Return the figures of residuals, by file name."""
    found: dict[str, Any] = {}
    if fit is not None and diagnostics is not None:
        found |= {f"residual_{name}": residual_figure(fit, diagnostics, name) for name in diagnostics.outputs}
    if ranking is not None:
        found["ranking"] = ranking_figure(ranking)
    return found


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


def _only(results: Sequence[Result], kind: type) -> Any:
    found = [item for item in results if isinstance(item, kind)]
    if len(found) > 1:
        raise SeaoptError(
            f"write_report got {len(found)} results of kind {kind.__name__}; give one, or write two pages"
        )
    return found[0] if found else None


def _plants(controller: Controller | None, certificate: Certificate | None) -> dict[str, tuple[Plant, ParameterSet]]:
    if certificate is not None:
        return {name: (plant, certificate.parameters) for name, plant in certificate.models.items()}
    if controller is not None and controller.design is not None:
        return {"design plant": controller.design}
    return {}


def write_figure(figure: Any, path: Path | str) -> list[Path]:
    """Write a figure as SVG and PNG, whose suffixes are added to the path."""
    return [write_bytes(f"{path}.{kind}", rendered(figure, kind)) for kind in ("svg", "png")]


def rendered(figure: Any, kind: str) -> bytes:
    """Return a figure as a file of a kind, the same bytes each time."""
    import matplotlib as mpl

    stream = io.BytesIO()
    metadata = {"Date": None} if kind == "svg" else None
    with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": "seaopt", "font.size": 9.0}):
        _lay_out(figure)
        figure.savefig(stream, format=kind, dpi=DPI, metadata=metadata)
    return stream.getvalue()


def _lay_out(figure: Any) -> None:
    """Lay a figure out, once, and leave it without an engine: for one, even an idle one, `savefig` draws twice."""
    engine = figure.get_layout_engine()
    if engine is not None:
        figure.set_dpi(DPI)
        engine.execute(figure)
        figure.set_layout_engine(None)


def _inline(svg: str, name: str) -> str:
    """Return the <svg> element alone, its ids made unique in the page."""
    body = re.sub(r'(<image\b[^>]*?)\sid="[^"]*"', r"\1", svg[svg.index("<svg") :])  # named after what they show, twice
    body = re.sub(r'\bid="', f'id="{name}-', body)
    body = re.sub(r'(xlink:href|href)="#', rf'\1="#{name}-', body)
    body = body.replace("url(#", f"url(#{name}-")
    return re.sub(
        r'(<svg[^>]*?)\swidth="[^"]*"',
        r"\1",
        re.sub(r'(<svg[^>]*?)\sheight="[^"]*"', r"\1", body, count=1),
        count=1,
    )


def _caption(name: str) -> str:
    kind, _, rest = name.partition("_")
    return _CAPTIONS[kind] + (f": {rest}" if rest else "")


def _note(name: str, surveys: Mapping[str, Survey], fit: Fit | None) -> str:
    """Return what a figure of frequency responses shows, in words; nothing for other figures."""
    kind, _, experiment = name.partition("_")
    return sentence(surveys[experiment], fit) if kind == "response" and fit is not None else ""


def number(value: Any, digits: int = 4) -> str:
    """Return a number for people: few digits, a dash where there is none."""
    if value is None:
        return "–"
    if isinstance(value, (bool, np.bool_)):
        return "yes" if value else "no"
    if not np.isfinite(value):
        return "∞" if value > 0 else "–"
    return f"{value:.{digits}g}"


def _interval(value: tuple[float, float] | None) -> str:
    return f"{number(value[0], 6)} to {number(value[1], 6)}" if value and np.all(np.isfinite(value)) else "unknown"


def _percent(value: Percent) -> str:
    held = "" if value.held_out is None else f" ({number(value.held_out)})"
    return number(value.used) + held


def _swinging(certificate: Certificate | None) -> bool:
    """Tell whether some plant's -3 dB bandwidth says nothing: its tracking band does not start at 0 Hz."""
    plants = certificate.plants.values() if certificate is not None else ()
    return any(item.tracking_band_hz is not None and item.tracking_band_hz[0] > 1.0 for item in plants)


def _forces(controller: Controller | None) -> str:
    slow = controller.force_limit(0.01) if controller is not None else None
    if controller is None or slow is None:
        return ""
    band = controller.spec.bandwidth_hz
    fast = number(controller.force_limit(band))
    return (
        f"The current limit of {controller.spec.current_limit_A:g} A allows a reference of {number(slow)} N at rest "
        f"and {fast} N at {band:g} Hz, whatever the gains."
    )


def _band(value: tuple[float, float] | None) -> str:
    return "–" if value is None else f"{number(value[0], 3)} to {number(value[1])}"


def _page(
    title: str, fit: Fit | None, diagnostics: Diagnostics | None, ranking: Ranking | None,
    controller: Controller | None, certificate: Certificate | None, figures: Any, verification: Verification | None,
    simulated: str,
) -> str:  # fmt: skip
    from jinja2 import Environment

    environment = Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True)
    environment.filters["number"] = number
    environment.filters["band"] = _band
    environment.filters["interval"] = _interval
    environment.filters["percent"] = _percent
    template = environment.from_string(
        files("seaopt.reporting").joinpath("report.html.jinja").read_text(encoding="utf-8")
    )
    return template.render(
        title=title, fit=fit, diagnostics=diagnostics, ranking=ranking, controller=controller, certificate=certificate,
        figures=figures, verdict=verdict(fit, controller, certificate, verification), swinging=_swinging(certificate),
        forces=_forces(controller), simulated=simulated,
        limited=[] if controller is None else list_design_figures(controller.spec, controller.achieved),
    )  # fmt: skip


def _played(certificate: Certificate) -> str:
    found = certificate.simulated.verification if certificate.simulated is not None else None
    return "" if found is None else f", {len(found.rows)} simulations passed"


def verdict(
    fit: Fit | None, controller: Controller | None, certificate: Certificate | None,
    verification: Verification | None = None,
) -> list[tuple[bool, str]]:  # fmt: skip
    """Return one line a stage: whether it is met, and what to say."""
    lines: list[tuple[bool, str]] = []
    if fit is not None:
        lines.append((fit.ok, f"Fit: {fit.status.replace('_', ' ')} – {fit.message}"))
    if controller is not None:
        what = "every limit met" if controller.feasible else "not met: " + ", ".join(controller.active_constraints)
        lines.append((controller.feasible, f"Controller at {controller.spec.bandwidth_hz:g} Hz: {what}"))
    if certificate is not None:
        mc = certificate.monte_carlo
        broken = [f"{item.name} ({item.where})" for item in certificate.requirements if not item.met]
        what = (
            f"passed – {mc.failures} failures in {mc.samples} draws, failure probability below "
            f"{mc.failure_probability_bound:.3g}{_played(certificate)}"
            if certificate.passed
            else "failed – " + "; ".join(broken)
        )
        lines.append((certificate.passed, f"Certificate: {what}"))
    if verification is not None:
        failed = dict.fromkeys(f"{row.scenario} on {row.plant}" for row in verification.failures)
        what = "failed – " + ", ".join(failed) if failed else f"{len(verification.rows)} runs passed"
        lines.append((verification.passed, f"Simulation: {what}"))
    return lines
