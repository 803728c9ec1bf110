"""The report: one self-contained HTML page of fits, a controller and a certificate, and its figures as files."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, get_args, get_type_hints

from markupsafe import Markup

from seaopt.control import Controller, ForceMPC, Frontier, Passivity, ScheduledController, Scorecard, scorecard
from seaopt.control.deploy.export import export
from seaopt.errors import FileError, SeaoptError, require_type
from seaopt.estimation import Diagnostics, Fit, Ranking, diagnose
from seaopt.files import read_json, write_json, write_text
from seaopt.formatting import format_count
from seaopt.logs import Quality
from seaopt.progress import Progress, count_off, ignore
from seaopt.records import record
from seaopt.reporting.comparison import fit_surveys, response_panels
from seaopt.reporting.drawing import write_figure
from seaopt.reporting.figures import certificate as certificates
from seaopt.reporting.figures import fit as fits
from seaopt.reporting.figures import loop as loops
from seaopt.reporting.figures import simulation as simulations
from seaopt.reporting.figures.frontier import frontier_panels
from seaopt.reporting.figures.impedance import region_panel
from seaopt.reporting.figures.log import log_panels
from seaopt.reporting.figures.panel import Panel, compose_sheet
from seaopt.reporting.figures.ranking import evidence_panel, octave_panels
from seaopt.reporting.figures.schedule import schedule_panels
from seaopt.reporting.page.chart import make_chart
from seaopt.reporting.page.provenance import describe_provenance
from seaopt.reporting.page.render import render_parts, render_template
from seaopt.reporting.responses import Responses
from seaopt.reporting.sections import describe, summarise
from seaopt.reporting.sections.data import Section
from seaopt.reporting.sections.kinds.responses import compare_with_fit
from seaopt.reporting.sections.kinds.verification import describe_drawings
from seaopt.reporting.sections.verdict import UNMET, describe_expectations, judge_results
from seaopt.robustness import Certificate
from seaopt.robustness.verification.environments import StabilityMap
from seaopt.robustness.verification.large_signal import LargeSignal
from seaopt.robustness.verification.verification import Verification

Result = (
    Fit
    | Ranking
    | Controller
    | ForceMPC
    | Certificate
    | Verification
    | StabilityMap
    | ScheduledController
    | LargeSignal
    | Frontier
    | Quality
    | Responses
)
PARTS = {
    "expectations": "What the problem file expects",
    "controller": "Controller",
    "schedule": "Schedule",
    "mpc": "Predictive control",
    "frontier": "Bandwidths",
    "fit": "How well the model fits",
    "diagnostics": "Diagnostics",
    "ranking": "Which model",
    "certificate": "What is certified",
    "simulation": "Simulation of the nonlinear plants",
    "amplitude": "Bandwidth against amplitude",
    "contact": "Contact with an environment",
    "parameters": "Parameters",
    "logs": "Quality of the logs",
    "responses": "Frequency responses",
    "bringup": "Bring-up",
    "acceptance": "On the machine",
    "findings": "Findings",
    "provenance": "Provenance",
}
# with figures as files
FILED = ("controller", "schedule", "frontier", "fit", "ranking", "certificate", "amplitude", "contact")
# Where results stand that have no figures here, by their names: those of the machine are made above this package.
BESIDES = {"Quality": "logs", "Responses": "responses", "BringUp": "bringup", "Acceptance": "acceptance"}
FIGURES_SCHEMA = "seaopt/figures/1"
LAW_NAME = "force_law"  # of the C header that can be copied


@record(eq=False)
class Material:
    """The results that a report is made of, those that there are."""

    fit: Fit | None = None
    ranking: Ranking | None = None
    controller: Controller | None = None
    mpc: ForceMPC | None = None
    certificate: Certificate | None = None
    verification: Verification | None = None
    coupled: StabilityMap | None = None
    schedule: ScheduledController | None = None
    frontier: Frontier | None = None
    large: tuple[LargeSignal, ...] = ()
    passivity: Passivity | None = None
    diagnostics: Diagnostics | None = None
    besides: tuple[Any, ...] = ()


KINDS: dict[str, type[Any]] = {  # of what may be given, those of which there is one at most
    name: kind
    for name, hint in get_type_hints(Material).items()
    if name != "large" and (kind := get_args(hint)[0]) in get_args(Result)
}


@record(eq=False)
class Plate:
    """Panels that stand together on the page, and in one file: the part that they belong to, a heading and a text."""

    name: str
    part: str
    panels: Sequence[Panel]
    heading: str = ""
    text: str = ""


def write_report(
    results: Sequence[Any],
    path: Path | str,
    *,
    title: str = "Series elastic actuator",
    progress: Progress = ignore,
    files: Sequence[Path | str] = (),
    command: str = "",
    expectations: Sequence[tuple[bool, str]] = (),
) -> Path:
    """Write an HTML page that needs no network and no other file; its figures also stand beside it as SVG and PNG.

    Parameters
    ----------
    results : sequence of Fit, Ranking, Controller, ForceMPC, Certificate, Verification, StabilityMap, LargeSignal
        And ScheduledController, Frontier, Quality, Responses, BringUp, Acceptance. At most one of each, of LargeSignal
        any number; sections without a result are left out. A fit that was not read from a file has a section of
        diagnostics. A certificate's simulations need not be listed.
    path : path
        The page; figures go to the folder ``figures`` beside it, with a list of them; those of an earlier page of that
        name which this one does not have are removed.
    title : str
        Heading of the page.
    progress : callable, optional
        Called before each group of figures is drawn, which takes the most time (`seaopt.progress.Progress`).
    files : sequence of path
        What the results were made of, besides the logs: named with their hashes.
    command : str
        What was typed to make the report, to be stated in it.
    expectations : sequence of (bool, str)
        Of a problem file: whether each is met, and what to say of it.

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
    require_type(title, str, "title", "give the page's heading")
    for result in results:
        if type(result).__name__ not in BESIDES:
            require_type(
                result,
                get_args(Result),
                "results",
                "give what fit, tune, certify, verify or compare returned",
            )
    material, target = _sort_results(results), Path(path)
    plates = list(_list_plates(material))
    drawn: dict[str, list[dict[str, Any]]] = {}
    figures: list[Path] = []
    for plate in count_off(plates, "figure", progress):
        if plate.part in FILED:
            figures += write_figure(compose_sheet(plate.panels, final=True), target.parent / "figures" / plate.name)
        charts = [make_chart(panel) for panel in plate.panels]
        drawn.setdefault(plate.part, []).append({"heading": plate.heading, "text": plate.text, "charts": charts})
    page = write_text(target, _render(material, drawn, title, files, command, expectations))
    _list_figures(target, figures)
    progress(format_count(len(plates), "figure"), 1.0)
    return page


def _list_figures(page: Path, figures: Sequence[Path]) -> None:
    """Write the names of a page's figures beside them, and remove those that it had before and has no more."""
    folder = page.parent / "figures"
    contents = folder / f"{page.stem}.json"
    names = sorted(figure.name for figure in figures)
    before: set[str] = set()
    with suppress(FileError):  # none, or one that somebody wrote: then nothing is known to be this page's
        before = {str(name) for name in read_json(contents, FIGURES_SCHEMA).get("figures", ())}
    for name in before - set(names):
        if Path(name).name == name and Path(name).suffix in (".svg", ".png"):
            (folder / name).unlink(missing_ok=True)
    if names or before:
        write_json(contents, {"schema": FIGURES_SCHEMA, "figures": names})


def _sort_results(results: Sequence[Any]) -> Material:
    """Return the results by their kind, with what a certificate brings besides."""
    if not results:
        raise SeaoptError(
            "write_report got no result; give a Fit, a Ranking, a Controller, a Certificate or a Verification"
        )
    by_kind: dict[str, Any] = {}
    for name, kind in KINDS.items():
        matches = [result for result in results if isinstance(result, kind)]
        if len(matches) > 1:
            raise SeaoptError(
                f"write_report got {len(matches)} results of kind {kind.__name__}; give one, or write two pages"
            )
        if matches:
            by_kind[name] = matches[0]
    large = tuple(result for result in results if isinstance(result, LargeSignal))
    certificate: Certificate | None = by_kind.get("certificate")
    if certificate is not None and certificate.schedule is not None:
        by_kind["schedule"] = certificate.schedule
    elif certificate is not None:
        brought: dict[str, Any] = {"controller": certificate.controller, "verification": certificate.runs}
        if certificate.simulated is not None:
            brought |= {"coupled": certificate.simulated.environments, "passivity": certificate.simulated.passivity}
            large = large or certificate.simulated.large_signal
        by_kind = brought | by_kind
    if "fit" in by_kind and by_kind["fit"].minimum is not None:
        by_kind["diagnostics"] = diagnose(by_kind["fit"])
    besides = tuple(result for result in results if type(result).__name__ in BESIDES)
    return Material(**by_kind, large=large, besides=besides)


def _list_plates(material: Material) -> Iterator[Plate]:
    """Yield every figure that the results allow; figures of a part in the order of the page."""
    controller, certificate, fit = material.controller, material.certificate, material.fit
    of_law = None if certificate is None or certificate.schedule is not None else certificate
    if controller is not None and (controller.design is not None or (of_law is not None and of_law.models)):
        plants = None if of_law is None else certificates.plants_of(of_law)
        panels = [loops.LOOP_PANELS[name](controller, plants) for name in loops.MAIN]
        yield Plate(name="loop", part="controller", heading="The loop on every plant" if plants else "", panels=panels)
    if material.schedule is not None:
        yield Plate(name="schedule", part="schedule", panels=schedule_panels(material.schedule, certificate))
    if material.frontier is not None:
        yield Plate(name="frontier", part="frontier", panels=frontier_panels(material.frontier))
    if fit is not None:
        yield from _list_plates_of_fit(fit, material.ranking, material.diagnostics)
    if material.ranking is not None:
        panels = [evidence_panel(material.ranking), *octave_panels(material.ranking)]
        yield Plate(name="ranking", part="ranking", panels=panels)
    if of_law is not None:
        yield Plate(name="certificate", part="certificate", panels=_list_certificate_panels(of_law))
    yield from _list_plates_of_simulation(material)


def _list_plates_of_fit(fit: Fit, ranking: Ranking | None, diagnostics: Diagnostics | None) -> Iterator[Plate]:
    models = {"model, fitted": fit}
    if ranking is not None:  # the fits that are compared
        models = {f"model, {row.name}": ranking.fits[row.name] for row in ranking.rows}
    surveys = fit_surveys(fit)
    for experiment in fit.experiments:
        name, prediction = experiment.name, fit.predict(experiment)
        panels = [fits.outputs_panel(prediction), fits.residuals_panel(prediction), fits.spectrum_panel(prediction)]
        yield Plate(name=f"time_{name}", part="fit", heading=f"{name} in time", panels=panels)
        if name in surveys:
            yield Plate(
                name=f"response_{name}",
                part="fit",
                heading=f"{name} in frequency",
                panels=response_panels(experiment, surveys[name], models),
                text=" ".join(compare_with_fit(surveys[name], fit, name)),
            )
        panels = [
            replace(panel, name=f"log_{name}_{panel.name}", link=f"{name}, {panel.link}")
            for panel in log_panels(experiment.log, experiment.log.quality)
        ]
        yield Plate(name=f"log_{name}", part="logs", heading=name, panels=panels)
    for name in diagnostics.outputs if diagnostics is not None else ():
        assert diagnostics is not None
        panels = [fits.autocorrelation_panel(diagnostics, name), fits.input_correlation_panel(diagnostics, name)]
        yield Plate(name=f"residual_{name}", part="diagnostics", heading=f"Residuals of {name}", panels=panels)
    panels: list[Panel] = []
    for make in (fits.parameters_panel, fits.correlation_panel):
        with suppress(SeaoptError):  # nothing is free, or nothing is known of it
            panels.append(make(fit))
    if panels:
        yield Plate(name="parameters", part="parameters", panels=panels)


def _list_certificate_panels(certificate: Certificate) -> list[Panel]:
    panels = [certificates.worst_panel(certificate)] if certificate.models else []
    if certificate.drawn_ms:
        panels.append(certificates.draws_panel(certificate))
    panels.append(certificates.requirements_panel(certificate))
    if certificate.friction or certificate.friction_draws:
        panels.append(certificates.friction_panel(certificate))
    return panels


def _list_plates_of_simulation(material: Material) -> Iterator[Plate]:
    by_plant: dict[str, list[Panel]] = {}
    if material.verification is not None:
        for row in material.verification.worst():
            panel = simulations.simulation_panel(material.verification, row)
            by_plant.setdefault(row.plant, []).append(panel)
    for name, panels in by_plant.items():
        assert material.verification is not None
        text = describe_drawings(material.verification, name)
        yield Plate(name=f"simulation_{name}", part="simulation", heading=f"Runs on {name}", panels=panels, text=text)
    if material.large:
        yield Plate(name="bandwidth", part="amplitude", panels=[simulations.bandwidth_panel(material.large)])
        makers = simulations.amplitude_panel, simulations.saturation_panel
        panels = [make(sweep) for sweep in material.large for make in makers]
        yield Plate(name="amplitude", part="amplitude", panels=panels)
    if material.coupled is not None:
        panels = simulations.environment_panels(material.coupled)
        if material.passivity is not None and material.controller is not None:
            panels.insert(0, certificates.impedance_panel(material.controller))
        yield Plate(name="environments", part="contact", panels=panels)
    rendered = None if material.certificate is None else material.certificate.impedance
    if rendered is not None:
        yield Plate(
            name="impedance_region",
            part="contact",
            heading="Stiffness and damping at the link",
            panels=[region_panel(rendered.region, rendered.rendering.impedance)],
            text=". ".join(rendered.lines()) + ".",
        )


def _render(
    material: Material,
    drawn: Mapping[str, Sequence[Mapping[str, Any]]],
    title: str,
    files: Sequence[Path | str],
    command: str,
    expectations: Sequence[tuple[bool, str]],
) -> str:
    """Return the page."""
    fit, controller, certificate = material.fit, material.controller, material.certificate
    experiments = fit.experiments if fit is not None else ()
    runs = material.verification
    judged = judge_results(
        fit=fit,
        controller=material.schedule if controller is None else controller,
        mpc=material.mpc,
        certificate=certificate,
        # the certificate speaks of its own runs
        verification=None if certificate is not None and runs is certificate.runs else runs,
        besides=material.besides,
        expectations=expectations,
    )
    first = (fit, controller, certificate, runs, *material.besides)
    results = (
        controller,
        material.schedule,
        material.mpc,
        material.frontier,
        fit,
        material.diagnostics,
        material.ranking,
        certificate,
        runs,
        *material.large,
        material.passivity,
        material.coupled,
        None if material.coupled is None and material.passivity is None else _score(controller),
        *(experiment.log.quality for experiment in experiments),
    )
    sections: list[Section] = [
        *describe_expectations(expectations),
        *(section for result in results if result is not None for section in describe(result)),
        *(
            replace(section, part=BESIDES[type(result).__name__])
            for result in material.besides
            for section in describe(result)
        ),
        describe_provenance(experiments, files, command),
    ]
    described = render_parts(sections, PARTS)
    described.setdefault("findings", [Markup("<p>None.</p>")])
    sound = fit is None or fit.met
    return render_template(
        "page.html.jinja",
        title=title,
        parts=PARTS,
        verdicts=judged,
        glance=[figure for result in first if result is not None for figure in summarise(result)],
        described=described,
        plates=drawn,
        doubt="" if sound else UNMET,
        controller=controller,
        header=None if controller is None else write_header(controller, fit_met=sound),
    )


def _score(controller: Controller | None) -> Scorecard | None:
    """Return the score of a controller on its design plant; None where that has no port, or is not known."""
    if controller is None or controller.design is None:
        return None
    with suppress(SeaoptError):
        return scorecard({controller.structure: controller})
    return None


def write_header(controller: Controller, *, fit_met: bool = True) -> tuple[bool, str]:
    """Return the C header of the gains, and True; or False, and why there is none."""
    try:
        with TemporaryDirectory() as folder:
            paths = export(controller, folder, name=LAW_NAME, allow_infeasible=True, fit_met=fit_met)
            return True, next(path for path in paths if path.name.endswith("_gains.h")).read_text(encoding="utf-8")
    except SeaoptError as error:
        return False, str(error)
