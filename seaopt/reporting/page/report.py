"""The report: one self-contained HTML page of fits, a controller and a certificate, and its figures as files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from markupsafe import Markup

from seaopt.control import Controller, ForceMPC, ScheduledController, Scorecard, scorecard
from seaopt.control.deploy.export import export
from seaopt.control.impedance.scorecard import HEADS
from seaopt.errors import FileError, SeaoptError, require_type
from seaopt.estimation import Diagnostics, Fit, Ranking, diagnose
from seaopt.files import read_json, write_json, write_text
from seaopt.formatting import format_count, format_figure, format_number
from seaopt.frequency import Survey
from seaopt.progress import Progress, count_off, ignore
from seaopt.records import record
from seaopt.reporting.comparison import fit_surveys, response_panels, sentence
from seaopt.reporting.drawing import write_figure
from seaopt.reporting.figures import certificate as certificates
from seaopt.reporting.figures import fit as fits
from seaopt.reporting.figures import log as logs
from seaopt.reporting.figures import loop as loops
from seaopt.reporting.figures import simulation as simulations
from seaopt.reporting.figures.impedance import region_panel
from seaopt.reporting.figures.panel import Panel, compose_sheet
from seaopt.reporting.figures.ranking import evidence_panel, octave_panels
from seaopt.reporting.figures.schedule import schedule_panels
from seaopt.reporting.page.chart import Chart, make_chart
from seaopt.reporting.page.provenance import describe_provenance
from seaopt.reporting.page.render import render_template
from seaopt.reporting.sections import describe
from seaopt.reporting.sections.html import render_section
from seaopt.reporting.sections.verdict import UNMET, judge_results
from seaopt.robustness import Certificate, ScheduleCertificate
from seaopt.robustness.verification.environments import StabilityMap
from seaopt.robustness.verification.judgement import Outcome
from seaopt.robustness.verification.large_signal import LargeSignal
from seaopt.robustness.verification.verification import Verification, describe_witness

Result = (
    Fit
    | Ranking
    | Controller
    | ForceMPC
    | Certificate
    | Verification
    | StabilityMap
    | ScheduledController
    | ScheduleCertificate
    | LargeSignal
)
KINDS = (
    Fit, Ranking, Controller, ForceMPC, Certificate, Verification, StabilityMap, ScheduledController,
    ScheduleCertificate,
)  # fmt: skip
# Parts with figures as files.
FILED = (
    "controller",
    "schedule",
    "fit",
    "ranking",
    "certificate",
    "amplitude",
    "contact",
)
FIGURES_SCHEMA = "seaopt/figures/1"
LAW_NAME = "force_law"  # of the C header that can be copied


@record(eq=False)
class Material:
    """What a report is made of; what was not given is None or empty."""

    fit: Fit | None
    ranking: Ranking | None
    controller: Controller | None
    mpc: ForceMPC | None
    certificate: Certificate | None
    verification: Verification | None
    coupled: StabilityMap | None
    large: tuple[LargeSignal, ...]
    surveys: Mapping[str, Survey]
    diagnostics: Diagnostics | None
    schedule: ScheduledController | None = None
    swept: ScheduleCertificate | None = None


@record(eq=False)
class Plate:
    """Panels that stand together on the page, and in one file: the section's part that they belong to, and a text."""

    name: str
    part: str
    heading: str
    panels: tuple[Panel, ...]
    text: str = ""


@record(eq=False)
class DrawnPlate:
    """A plate with its charts, for the page."""

    name: str
    heading: str
    charts: tuple[Chart, ...]
    text: str


def write_report(
    results: Sequence[Result],
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
        And ScheduledController, ScheduleCertificate. At most one of each, of LargeSignal any number; sections without a
        result are left out. A fit that was not read from a file has a section of diagnostics. A certificate's
        simulations need not be listed.
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
    require_type(title, str, "title", "give the page's heading")
    for result in results:
        require_type(
            result, (*KINDS, LargeSignal), "results", "give what fit, tune, certify, verify or compare returned"
        )
    material, target = _sort_results(results), Path(path)
    plates = list_plates(material)
    drawn: dict[str, list[DrawnPlate]] = {}
    figures: list[Path] = []
    for plate in count_off(plates, "figure", progress):
        if plate.part in FILED:
            figures += write_figure(compose_sheet(plate.panels), target.parent / "figures" / plate.name)
        charts = tuple(make_chart(panel) for panel in plate.panels)
        drawn.setdefault(plate.part, []).append(
            DrawnPlate(name=plate.name, heading=plate.heading, charts=charts, text=plate.text)
        )
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


def _sort_results(results: Sequence[Result]) -> Material:
    """Return the results by their kind, with what a certificate brings besides."""
    fit, ranking, controller, mpc, certificate, verification, coupled, schedule, swept = (
        _select(results, kind) for kind in KINDS
    )
    large = tuple(result for result in results if isinstance(result, LargeSignal))
    if not results:
        raise SeaoptError(
            "write_report got no result; give a Fit, a Ranking, a Controller, a Certificate or a Verification"
        )
    if certificate is not None:
        controller = certificate.controller if controller is None else controller
        simulation, verification = certificate.simulated, certificate.runs if verification is None else verification
        if simulation is not None:
            coupled = coupled or simulation.environments
            large = large or simulation.large_signal
    return Material(
        fit=fit,
        ranking=ranking,
        controller=controller,
        mpc=mpc,
        certificate=certificate,
        verification=verification,
        coupled=coupled,
        large=large,
        surveys=fit_surveys(fit) if fit is not None else {},
        diagnostics=diagnose(fit) if fit is not None and fit.minimum is not None else None,
        schedule=schedule if swept is None else swept.schedule,
        swept=swept,
    )


def _select(results: Sequence[Result], kind: type) -> Any:
    matches = [result for result in results if isinstance(result, kind)]
    if len(matches) > 1:
        raise SeaoptError(
            f"write_report got {len(matches)} results of kind {kind.__name__}; give one, or write two pages"
        )
    return matches[0] if matches else None


def list_plates(material: Material) -> list[Plate]:
    """Return every figure that the results allow, in the order of the page."""
    return [
        *_plates_of_controller(material),
        *_plates_of_schedule(material),
        *_plates_of_fit(material),
        *_plates_of_certificate(material),
        *_plates_of_simulation(material),
        *_plates_of_parameters(material),
        *_plates_of_logs(material),
    ]


def _plates_of_controller(material: Material) -> list[Plate]:
    controller, certificate = material.controller, material.certificate
    if controller is None or (controller.design is None and (certificate is None or not certificate.models)):
        return []
    plants = certificates.plants_of(certificate) if certificate is not None else None
    panels = tuple(loops.LOOP_PANELS[name](controller, plants) for name in loops.MAIN)
    return [Plate(name="loop", part="controller", heading="The loop on every plant" if plants else "", panels=panels)]


def _plates_of_schedule(material: Material) -> list[Plate]:
    if material.schedule is None:
        return []
    panels = schedule_panels(material.schedule, material.swept)
    return [Plate(name="schedule", part="schedule", heading="", panels=tuple(panels))]


def _plates_of_fit(material: Material) -> list[Plate]:
    fit, plates = material.fit, list[Plate]()
    for experiment in fit.experiments if fit is not None else ():
        assert fit is not None
        name, prediction = experiment.name, fit.predict(experiment)
        panels = [fits.outputs_panel(prediction), fits.residuals_panel(prediction), fits.spectrum_panel(prediction)]
        plates.append(Plate(name=f"time_{name}", part="fit", heading=f"{name} in time", panels=tuple(panels)))
        if name in material.surveys:
            responses = response_panels(experiment, material.surveys[name], _models(material))
            text = sentence(material.surveys[name], fit, name)
            plates.append(
                Plate(
                    name=f"response_{name}",
                    part="fit",
                    heading=f"{name} in frequency",
                    panels=tuple(responses),
                    text=text,
                )
            )
    if material.diagnostics is not None:
        for name in material.diagnostics.outputs:
            panels = [fits.autocorrelation_panel(material.diagnostics, name)]
            panels.append(fits.input_correlation_panel(material.diagnostics, name))
            plates.append(
                Plate(name=f"residual_{name}", part="diagnostics", heading=f"What {name} leaves", panels=tuple(panels))
            )
    if material.ranking is not None:
        panels = [evidence_panel(material.ranking), *octave_panels(material.ranking)]
        plates.append(Plate(name="ranking", part="ranking", heading="", panels=tuple(panels)))
    return plates


def _models(material: Material) -> dict[str, Fit]:
    """Return the fits that are drawn over measured responses: those that are compared, or the only one."""
    if material.ranking is not None:
        return {f"model, {row.name}": material.ranking.fits[row.name] for row in material.ranking.rows}
    return {} if material.fit is None else {"model, fitted": material.fit}


def _plates_of_certificate(material: Material) -> list[Plate]:
    certificate = material.certificate
    if certificate is None:
        return []
    panels = [certificates.worst_panel(certificate)] if certificate.models else []
    if certificate.drawn_ms:
        panels.append(certificates.draws_panel(certificate))
    panels.append(certificates.requirements_panel(certificate))
    if certificate.friction or certificate.friction_draws:
        panels.append(certificates.friction_panel(certificate))
    return [Plate(name="certificate", part="certificate", heading="", panels=tuple(panels))]


def _plates_of_simulation(material: Material) -> list[Plate]:
    plates: list[Plate] = []
    played = material.verification
    for name in dict.fromkeys(row.plant for row in played.rows) if played is not None else ():
        assert played is not None
        panels = [simulations.simulation_panel(played, row) for row in played.worst() if row.plant == name]
        plates.append(
            Plate(name=f"simulation_{name}", part="simulation", heading=f"Runs on {name}", panels=tuple(panels))
        )
    if material.large:
        panels = [simulations.bandwidth_panel(material.large)]
        plates.append(Plate(name="bandwidth", part="amplitude", heading="", panels=tuple(panels)))
        panels = [
            each
            for sweep in material.large
            for each in (simulations.amplitude_panel(sweep), simulations.saturation_panel(sweep))
        ]
        plates.append(Plate(name="amplitude", part="amplitude", heading="", panels=tuple(panels)))
    if material.coupled is not None:
        panels = simulations.environment_panels(material.coupled)
        simulated = material.certificate.simulated if material.certificate is not None else None
        if simulated is not None and simulated.passivity is not None and material.controller is not None:
            panels.insert(0, certificates.impedance_panel(material.controller))
        plates.append(Plate(name="environments", part="contact", heading="", panels=tuple(panels)))
    rendered = None if material.certificate is None else material.certificate.impedance
    if rendered is not None:
        panels = [region_panel(rendered.region, rendered.rendering.impedance)]
        plates.append(
            Plate(
                name="impedance_region",
                part="contact",
                heading="Stiffness and damping at the link",
                panels=tuple(panels),
                text=". ".join(rendered.lines()) + ".",
            )
        )
    return plates


def _plates_of_parameters(material: Material) -> list[Plate]:
    fit = material.fit
    if fit is None:
        return []
    panels: list[Panel] = []
    for make in (fits.parameters_panel, fits.correlation_panel):
        try:
            panels.append(make(fit))
        except SeaoptError:  # nothing is free, or nothing is known of it
            continue
    return [Plate(name="parameters", part="parameters", heading="", panels=tuple(panels))] if panels else []


def _plates_of_logs(material: Material) -> list[Plate]:
    plates: list[Plate] = []
    for one in material.fit.experiments if material.fit is not None else ():
        panels = tuple(
            replace(panel, name=f"log_{one.name}_{panel.name}", link=f"{one.name}, {panel.link}")
            for panel in logs.log_panels(one.log, one.log.quality)
        )
        plates.append(Plate(name=f"log_{one.name}", part="logs", heading=one.name, panels=panels))
    return plates


def _render(
    material: Material,
    drawn: Mapping[str, Sequence[DrawnPlate]],
    title: str,
    files: Sequence[Path | str],
    command: str,
    expectations: Sequence[tuple[bool, str]],
) -> str:
    """Return the page."""
    fit, controller, certificate = material.fit, material.controller, material.certificate
    experiments = fit.experiments if fit is not None else ()
    runs = material.verification
    apart = runs if certificate is None or runs is not certificate.runs else None  # else the certificate speaks of them
    judged = judge_results(
        fit=fit,
        controller=material.schedule if controller is None else controller,
        mpc=material.mpc,
        certificate=material.swept if certificate is None else certificate,
        verification=apart,
        expectations=expectations,
    )
    sound = fit is None or fit.met
    return render_template(
        "page.html.jinja",
        title=title,
        verdicts=judged,
        glance=list_figures(material),
        expectations=expectations,
        described=describe_parts(
            controller,
            material.schedule,
            material.swept,
            material.mpc,
            fit,
            certificate,
            *(e.log.quality for e in experiments),
        ),
        doubt="" if sound else UNMET,
        plates=drawn,
        fit=fit,
        diagnostics=material.diagnostics,
        ranking=material.ranking,
        controller=controller,
        certificate=certificate,
        verification=material.verification,
        large=material.large,
        coupled=material.coupled,
        simulated=None if certificate is None else certificate.simulated,
        card=_score(controller),
        card_heads=HEADS,
        header=None if controller is None else write_header(controller, fit_met=sound),
        failures=[] if material.verification is None else list_failed_runs(material.verification),
        provenance=describe_provenance(experiments, files, command),
    )


def describe_parts(*results: object) -> dict[str, list[Markup]]:
    """Return the sections of results, those that there are, by the part of the page where they stand."""
    parts: dict[str, list[Markup]] = {}
    for section in (each for result in results if result is not None for each in describe(result)):
        parts.setdefault(section.part, []).append(Markup(render_section(section)))  # noqa: S704 - escaped there
    return parts


def _score(controller: Controller | None) -> Scorecard | None:
    """Return the score of a controller on its design plant; None where that has no port, or is not known."""
    if controller is None or controller.design is None:
        return None
    try:
        return scorecard({controller.structure: controller})
    except SeaoptError:
        return None


def list_figures(material: Material) -> list[tuple[str, str, str]]:
    """Return what to see at a glance: a name, a figure with its unit, and what it is compared with."""
    figures: list[tuple[str, str, str]] = []
    if material.fit is not None and material.fit.outputs:
        name, output, one = min(
            ((name, output, one) for name, row in material.fit.outputs.items() for output, one in row.items()),
            key=lambda each: each[2].fit_percent,
        )
        figures.append(("fit", f"{one.fit_percent:.2f} %", f"least of the outputs: {name}.{output}"))
    controller, certificate = material.controller, material.certificate
    if controller is not None:
        a, spec = controller.achieved, controller.spec
        ms = spec.level("max_sensitivity")
        figures += [
            ("bandwidth", format_figure(a.bandwidth_hz, "Hz", 3), f"asked {spec.bandwidth_hz:g} Hz"),
            ("Ms", format_number(a.ms, 3), "" if ms is None else f"at most {ms:g}"),
            ("phase margin", format_figure(a.phase_margin_deg, "deg", 3), "design plant"),
            ("noise gain", format_figure(a.noise_gain, controller.command.gain_unit, 3), "design plant"),
        ]
    if certificate is not None and certificate.models:
        worst = max(certificate.worst.values(), key=lambda one: one.ms)
        level = certificate.controller.spec.level("max_sensitivity")
        allowed = "" if level is None else f", at most {level:g}"
        draws = certificate.monte_carlo
        figures.append(
            (
                "worst Ms found",
                format_number(worst.ms, 3),
                f"on {format_count(len(certificate.plants), 'plant')}{allowed}",
            )
        )
        if draws.samples:
            figures.append(("draws failed", f"{draws.failures} of {draws.samples}", "all plants together"))
    if material.verification is not None:
        failed, count = len(material.verification.failures), len(material.verification.rows)
        figures.append(("runs failed", f"{failed} of {count}", "simulated, nonlinear"))
    return figures


def list_failed_runs(verification: Verification) -> list[str]:
    """Return what failed in simulation: the same kind of fault on a plant once, with its first run and a count."""
    kinds: dict[tuple[str, str], list[Outcome]] = {}
    for row in verification.failures:
        kinds.setdefault((row.plant, row.faults[0].kind if row.faults else row.reason), []).append(row)
    return [
        f"{row.plant}, {row.scenario}, draw {row.draw}: {row.reason}{describe_witness(row)}"
        + (f" (and {format_count(len(more), 'more such run')})" if more else "")
        for row, *more in kinds.values()
    ]


def write_header(controller: Controller, *, fit_met: bool = True) -> tuple[bool, str]:
    """Return the C header of the gains, and True; or False, and why there is none."""
    try:
        with TemporaryDirectory() as folder:
            paths = export(controller, folder, name=LAW_NAME, allow_infeasible=True, fit_met=fit_met)
            return True, next(path for path in paths if path.name.endswith("_gains.h")).read_text(encoding="utf-8")
    except SeaoptError as error:
        return False, str(error)
