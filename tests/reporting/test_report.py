from __future__ import annotations

import hashlib
import html
import json
import re
from dataclasses import replace

import numpy as np
import pytest

import seaopt as so
from seaopt.cli.show import show_sections
from seaopt.cli.terminal import Terminal
from seaopt.estimation.result.findings import FitFinding
from seaopt.formatting import MISSING
from seaopt.reporting import judge_results
from seaopt.reporting.figures.panel import Panel
from seaopt.reporting.page.chart import make_chart, make_id


def test_text_from_problems_is_escaped(controller, tmp_path, without_drawing):
    told: list[tuple[str, float]] = []
    title = "<script>alert(1)</script>"
    page = so.write_report([controller], tmp_path / "r.html", title=title, progress=lambda *each: told.append(each))
    assert told == [("figure 1 of 1", 0.0), ("1 figure", 1.0)]
    text = page.read_text(encoding="utf-8")
    assert "<script>alert" not in text
    assert "&lt;script&gt;alert(1)" in text


def test_nothing_or_two_of_a_kind_is_refused(controller, tmp_path, without_drawing):
    with pytest.raises(so.SeaoptError, match="no result"):
        so.write_report([], tmp_path / "r.html")
    with pytest.raises(so.SeaoptError, match="2 results of kind Controller"):
        so.write_report([controller, controller], tmp_path / "r.html")
    assert not list(tmp_path.iterdir())


def test_the_page_says_how_the_papers_form_compares_with_the_fit(stand, stand_log, thor, tmp_path, without_drawing):
    fit = so.fit([so.Experiment(plant=stand, log=stand_log, name="chirp", outputs=("F1",))], thor.free("J", "b_r"))
    page = so.write_report([fit], tmp_path / "r.html").read_text(encoding="utf-8")
    (said,) = [line for line in page.splitlines() if "of F1/I, with k known, has" in line]
    mass = float(said.split("has m_k = ")[1].split()[0])
    assert mass == pytest.approx(0.646 + 3.31e-6 / (0.002 / (6 * 3.141592653589793)) ** 2, rel=5e-4)  # (1), (2)
    assert "not of second order" not in said
    assert (tmp_path / "figures" / "response_chirp.svg").exists()


def test_a_fitted_delay_is_a_row_of_every_table_of_the_fit(fitted, tmp_path, capsys, without_drawing):
    own = replace(fitted.nuisance["chirp"], delay_s=0.00312, std={"delay_s": 2.5e-5})
    fit = replace(fitted, nuisance=dict(fitted.nuisance) | {"chirp": own})
    page = so.write_report([fit], tmp_path / "r.html").read_text(encoding="utf-8")
    for text in (page, fit._repr_html_()):
        (row,) = re.findall(r"<tr><td>chirp\.delay_s</td>.*?</tr>", text)
        cells = [html.unescape(cell) for cell in re.findall(r">([^<>]+)<", row)]
        stds = ["± 2.5e-05", MISSING]
        assert cells == ["chirp.delay_s", "0.00312", *stds, "0.003071 to 0.003169", "1.6 %", "s", "of one log"]
    show_sections(Terminal(), fit)
    for text in (repr(fit), capsys.readouterr().out):
        assert re.search(r"chirp\.delay_s +0\.00312 +± 2\.5e-05 .*1\.6 %(.*s)? +of one log", text)


def test_a_heading_holds_nothing_that_a_reader_does_not_see(controller, tmp_path, without_drawing):
    page = so.write_report([controller], tmp_path / "r.html", title="a\x1b[31m \u202e b \udcff")
    text = page.read_text(encoding="utf-8")
    assert "<h1>a\\x1b[31m \\u202e b \\udcff</h1>" in text and "\u202e" not in text and "\x1b" not in text


def test_every_name_has_its_own_id():
    names = ["a_b", "a-b", "a.b", "a b", "ab", "_a_b", "a__b", "a_b_", "a_2d_b"]
    assert len({make_id(name) for name in names}) == len(names)
    assert all(re.fullmatch(r"[A-Za-z0-9_-]+", make_id(name)) for name in names)


def test_figures_of_an_earlier_page_are_removed(controller, certificate, tmp_path, without_drawing):
    figures = tmp_path / "figures"
    so.write_report([controller, certificate], tmp_path / "r.html")
    before = {path.name for path in figures.iterdir()}
    (figures / "mine.svg").write_text("mine")
    so.write_report([controller], tmp_path / "r.html")
    after = {path.name for path in figures.iterdir()}
    assert after == {"loop.svg", "loop.png", "r.json", "mine.svg"} < before | {"mine.svg"}


@pytest.fixture
def without_files(monkeypatch):
    """Let reports write the page alone: figures beside it take half of the time."""
    monkeypatch.setattr("seaopt.reporting.page.report.FILED", ())


def test_a_log_with_gaps_and_missing_samples_is_drawn(stand, short_log, thor, tmp_path, without_files):
    keep = np.r_[0:3000, 4000:8000]
    force = short_log["F1"][keep].copy()
    force[100:110] = np.nan
    log = so.Log.from_arrays(time=short_log.time[keep], I=short_log["I"][keep], F1=force)
    fit = so.fit([so.Experiment(plant=stand, log=log, name="gappy")], thor.free("J"))
    text = so.write_report([fit], tmp_path / "r.html").read_text(encoding="utf-8")
    for name in ("outputs", "residuals", "spectrum", "log-gappy-channel-F1"):
        assert re.search(rf'<figure class="chart" id="fig-{name}', text), name
    assert ">gap</button>" in text and "fig-response" not in text  # a frequency response takes one stretch


def test_a_fit_has_diagnostics_and_a_ranking_says_why(short_log, thor, tmp_path, without_drawing, without_causes):
    fits = {
        drive: so.fit(
            [so.Experiment(plant=so.plants.high_impedance(drive=drive), log=short_log, name="chirp", outputs=("F2",))],
            thor.free("J", "b_r"), holdout=0.2,
        )
        for drive in ("unlumped", "lumped")
    }  # fmt: skip
    ranking = so.compare(fits)
    page = so.write_report([fits["lumped"], ranking], tmp_path / "r.html").read_text(encoding="utf-8")
    assert "chirp.F2: the residual follows I" in page
    assert "unlumped is preferred, with very strong evidence against lumped" in page
    for name in ("time_chirp", "ranking"):
        assert (tmp_path / "figures" / f"{name}.svg").exists()
    alone = so.write_report([ranking], tmp_path / "alone.html").read_text(encoding="utf-8")
    assert "Which model" in alone and 'id="parameters"' not in alone


def test_findings_of_a_fit_stand_in_the_report(stand, short_log, thor, tmp_path, without_drawing):
    swapped = so.Log.from_arrays(time=short_log.time, I=short_log["I"], F1=short_log["F2"], F2=short_log["F1"])
    bench = so.Experiment(plant=stand, log=swapped, name="chirp", outputs=("F1", "F2"))
    fit = so.fit([bench], thor.free("J", "b_r"))
    assert fit.errors
    read = so.Fit.from_dict(fit.to_dict(), (bench,))  # a report of a stored fit says the same
    for number, each in enumerate((fit, read)):
        page = so.write_report([each], tmp_path / f"{number}.html").read_text(encoding="utf-8")
        section = page.split('id="findings-heading"')[1].split("</ul>")[0]
        assert section.count("<li>") == len(fit.findings) - len(fit.errors) + len(fit.notes)
        why = page.split("<h3>Why</h3>")[1].split("</ul>")[0]
        assert why.count("<li>") == len(fit.errors) and "F1 and F2 are swapped" in why
        for text in (page, repr(each)):  # beside the standard deviations
            assert text.lower().count("hold only if the model is right") == 1
    clean = so.fit([so.Experiment(plant=stand, log=short_log, outputs=("F1",))], thor.free("J"))
    assert not clean.findings
    page = so.write_report([clean], tmp_path / "clean.html").read_text(encoding="utf-8")
    assert "<h3>Why</h3>" not in page and '<b class="error">' not in page.split('id="findings"')[1]
    assert not clean.caveat and "only if the model is right" not in page + repr(clean)


def test_a_fit_from_a_file_has_no_diagnostics(stand, short_log, thor, tmp_path, without_drawing):
    """They need residuals and the problem, which fit.json does not hold."""
    bench = so.Experiment(plant=stand, log=short_log, name="chirp", outputs=("F1",))
    read = so.Fit.from_dict(so.fit([bench], thor.free("J")).to_dict(), (bench,))
    page = so.write_report([read], tmp_path / "r.html").read_text(encoding="utf-8")
    assert "How well the model fits" in page and 'id="diagnostics"' not in page


def test_what_was_done_to_the_data_stands_in_the_report(stand, thor, short_log, tmp_path, without_drawing):
    limit = 0.6 * np.max(np.abs(short_log["F1"]))
    experiment = so.Experiment(plant=stand, log=short_log, outputs=("F1",), saturation={"F1": (-limit, limit)})
    fit = so.fit([experiment], thor.free("J", "b_r"))
    page = so.write_report([fit], tmp_path / "report.html").read_text(encoding="utf-8")
    assert "at or beyond its declared range" in page


def test_a_drawing_on_the_page_has_the_numbers_of_its_axes():
    """Coordinates are shortened there; the numbers at ticks, and what a chart says of its sides, must not be."""

    def draw(axis):
        axis.plot([0.0, 1.0, 2.0], [0.00012, 0.00018, 0.00031], label="a")
        axis.set_yticks([0.0001, 0.0002, 0.0003], ["0.0001", "0.0002", "0.0003"])

    chart = make_chart(Panel(name="small", title="1.23456", draw=draw))
    assert [f">0.000{k}</text>" in chart.svg for k in (1, 2, 3)] == [True] * 3
    assert 'aria-label="1.23456.' in chart.svg
    (pane,) = json.loads(chart.axes)
    (path,) = re.findall(r'<g id="small-curve0-0">\s*<path d="([^"]*)"', chart.svg)
    points = np.array(re.findall(r"([-\d.]+) ([-\d.]+)", path), dtype=float)
    left, top, right, bottom = pane["box"]
    x, y = pane["x"], pane["y"]
    across = x["low"] + (points[:, 0] - left) / (right - left) * (x["high"] - x["low"])
    up = y["low"] + (bottom - points[:, 1]) / (bottom - top) * (y["high"] - y["low"])
    np.testing.assert_allclose(across, [0.0, 1.0, 2.0], atol=1e-5)
    np.testing.assert_allclose(up, [0.00012, 0.00018, 0.00031], rtol=1e-4)


SECTIONS = [
    "verdict", "controller", "fit", "diagnostics", "certificate", "simulation", "amplitude", "contact", "parameters",
    "logs", "findings", "provenance",
]  # fmt: skip


def test_the_page_has_its_order(fitted, controller, certificate, tmp_path, without_drawing):
    """With its charts, `tests/cli/test_cli.py` looks at a page."""
    problem = tmp_path / "actuator.toml"
    problem.write_bytes(b"schema = 1")
    page = so.write_report(
        [fitted, controller, certificate], tmp_path / "r.html", files=[problem], command="seaopt run actuator.toml"
    )
    text = page.read_text(encoding="utf-8")
    assert re.findall(r'<section id="(\w+)"', text) == SECTIONS
    assert re.findall(r'<li><a href="#(\w+)">', text) == SECTIONS
    assert text.count('<figure class="chart"') == text.count("<figcaption>") > 40
    own = text.split('id="provenance"')[1]
    digest = hashlib.sha256(b"schema = 1").hexdigest()
    assert digest in own and "seaopt run actuator.toml" in own and so.__version__ in own
    header = re.search(r'aria-label="C header">(.*?)</pre>', text, flags=re.DOTALL).group(1)
    written = so.export(controller, tmp_path / "c", name="force_law", allow_infeasible=True)
    assert html.unescape(header) == next(one for one in written if one.name.endswith("_gains.h")).read_text("utf-8")
    assert f"k_p = {controller.gains['k_p']!r}" in text


def test_a_failure_is_said_once_with_a_count(fitted, controller, certificate, tmp_path, without_drawing):
    row = next(one for one in certificate.requirements if one.name == "max_sensitivity")
    broken = [replace(row, value=1.7 + 0.01 * k, met=False, plant=f"plant {k}") for k in range(12)]
    failed = replace(certificate, requirements=(*broken, row))
    text = so.write_report([failed], tmp_path / "r.html").read_text(encoding="utf-8")
    assert "12 of 13 requirements not met" in text.split("<h3>Why</h3>")[0]
    why = text.split("<h3>Why</h3>")[1].split("</ul>")[0]
    assert why.count("<li>") == 1 and "max_sensitivity 1.81, limit ≤ 1.6 (and 11 more): plant 11" in why
    table = text.split('id="certificate"')[1].split("</table>")[0]
    assert table.count("plant 11") == 1 and "plant 10" not in table
    (judged,) = judge_results(certificate=failed)
    assert not judged.met and judged.text == "Certificate: failed, 12 of 13 requirements not met"


@pytest.mark.parametrize("kind", ["nothing uncertain", "simulated"])
def test_what_a_certificate_says_in_a_line(certificate, kind):
    drawn = certificate.monte_carlo if kind == "simulated" else replace(certificate.monte_carlo, samples=0)
    (judged,) = judge_results(
        certificate=replace(
            certificate,
            requirements=tuple(replace(row, met=True) for row in certificate.requirements),
            monte_carlo=drawn,
        )
    )
    assert judged.met and f"{len(certificate.runs.rows)} simulated runs passed" in judged.text
    assert ("nothing was uncertain" in judged.text) == (kind == "nothing uncertain")


def test_the_page_says_whose_draws_are_simulated_and_what_the_colours_of_runs_mean(
    certificate, tmp_path, without_drawing
):
    page = so.write_report([certificate], tmp_path / "r.html").read_text(encoding="utf-8")
    part = page.split('<section id="simulation"')[1].split("</section>")[0]
    assert "the worst case that the certificate found on its plant: draw 1 on stand and draw 1 on swing." in part
    on_stand, on_swing = part.split("<h3>Runs on stand</h3>")[1].split("<h3>Runs on swing</h3>")
    assert "Grey: link 2 is held." in on_swing and "Grey" not in on_stand
    failed = {row.plant for row in certificate.runs.failures}
    assert [("in yellow" in text) for text in (on_stand, on_swing)] == ["stand" in failed, "swing" in failed]


def test_figures_to_see_first_are_those_of_the_results(certificate, tmp_path, without_drawing):
    page = so.write_report([certificate], tmp_path / "r.html").read_text(encoding="utf-8")
    first = page.split('<dl class="glance">')[1].split("</dl>")[0]
    shown = [re.sub(r"<[^>]+>", "|", entry) for entry in re.findall(r"<div>(.*?)</div>", first)]
    draws, runs = certificate.monte_carlo, certificate.runs
    assert len(shown) == 4 + 2 + 1
    assert f"{draws.failures} of {draws.samples}" in shown[5]
    assert f"{len(runs.failures)} of {len(runs.rows)}" in shown[6]


def test_a_design_on_a_fit_that_is_not_met_is_not_met_on_the_page(fitted, controller, tmp_path, without_drawing):
    finding = FitFinding(severity="error", kind="explained", where="chirp.F1", text="half of it")
    unmet = replace(fitted, findings=(finding,))
    assert not unmet.met and controller.feasible
    text = so.write_report([unmet, controller], tmp_path / "r.html").read_text(encoding="utf-8")
    lines = text.split('class="verdict">')[1].split("</ul>")[0]
    assert '<li class="good">' not in lines and "every limit met, on a fit that is not met" in lines
    header = text.split('aria-label="C header">')[1].split("</pre>")[0]
    assert "the fit that this controller was tuned with is not met" in header
    assert "These gains were found on a fit that is not met" in text


def test_what_a_problem_expects_stands_in_the_verdict_and_in_a_table(controller, tmp_path, without_drawing):
    outcomes = [(True, "expect.a: found 1"), (False, "expect.fit_met: found yes, asked for no")]
    text = so.write_report([controller], tmp_path / "r.html", expectations=outcomes).read_text(encoding="utf-8")
    assert '<li class="bad"><b class="bad">not met</b> Expectations: 1 of 2 met</li>' in text
    table = text.split('<section id="expectations"')[1].split("</table>")[0]
    assert table.count("<tr>") == 3 and "asked for no" in table
