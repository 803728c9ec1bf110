"""What results are said with: one table for terminal, `repr`, notebook and page, none wider than the terminal."""

from __future__ import annotations

import html
import re
from dataclasses import replace

import pytest

import seaopt as so
from seaopt.cli.show import show_sections, show_verdicts
from seaopt.cli.terminal import Terminal
from seaopt.estimation.result.findings import DerivedFigure
from seaopt.reporting.sections import judge
from seaopt.reporting.sections.data import Item, Mark, Reason, Section, Step, Table, Verdict
from seaopt.reporting.sections.glossary import GLOSSARY, explain_terms
from seaopt.reporting.sections.html import render_section
from seaopt.reporting.sections.html import render_verdict as render_html_verdict
from seaopt.reporting.sections.kinds.fit import describe, spell_cure
from seaopt.reporting.sections.text import Most, join, render_sections, render_table, render_verdict

WORDS = "a limit of the loop on the plant that swings is missed by some draws"


def make_table(columns: int, **options: object) -> Table:
    """Return a table of numbers behind a name, and of words at the end."""
    heads = tuple(f"figure {k}" for k in range(columns))
    rows = tuple((f"row_{r}", *(f"{r}.{k}234" for k in range(columns)), WORDS) for r in range(3))
    return Table(head=("name", *heads, "why"), rows=rows, align="<" + ">" * columns + "<", **options)


@pytest.mark.parametrize("columns", [0, 2, 5, 9, 30])
def test_no_table_is_wider_than_the_terminal_and_no_cell_is_lost(columns):
    lines = join(render_table(make_table(columns))).splitlines()
    assert max(map(len, lines)) <= 80
    text = " ".join(" ".join(lines).split())
    assert all(f"{r}.{k}234" in text for r in range(3) for k in range(columns))
    assert set(WORDS.split()) <= set(text.split())


def test_where_the_width_lacks_what_is_optional_goes_and_an_empty_column_always_does():
    table = Table(
        head=("name", "empty", "value", "meaning"),
        rows=(("J", "–", "3.3e-6", WORDS), ("b_r", "", "1e-4", "")),
        align="<<><",
        optional=("meaning",),
    )
    wide, narrow = (join(render_table(table, width)) for width in (120, 40))
    assert WORDS in wide and "meaning" not in narrow and "3.3e-6" in narrow
    assert "empty" not in wide + narrow


def test_a_long_reason_is_wrapped_and_a_command_stays_on_one_line():
    command = f"seaopt run {'folder/' * 20}problem.toml"
    verdict = Verdict(
        met=False, text="Fit: stalled", reasons=(Reason(what="F1", where=WORDS * 5),), next=(Step.typed("", command),)
    )
    lines = join(render_verdict(verdict)).splitlines()
    assert lines[0] == "not met  Fit: stalled" and lines[-1].strip() == command
    assert f"next: type<pre>{command}</pre>" in render_html_verdict(verdict)
    assert max(map(len, lines[:-1])) <= 80 and "..." not in "".join(lines) and "…" not in "".join(lines)
    assert "".join(WORDS.split()) * 5 in "".join("".join(lines).split())


def test_a_screen_counts_what_it_leaves_out_and_shows_details_only_when_asked():
    section = Section(
        title="A", tables=(make_table(1),), items=tuple(Item(severity="note", text="b") for _ in range(5))
    )
    folded = Section(title="Detail", sentences=("small",), folded=True)
    text = join(render_sections([section, folded], most=Most(rows=2, items=1)))
    assert "and 1 more" in text and "and 4 more" in text and "Detail" not in text
    assert "small" in join(render_sections([folded], most=Most(folded=True)))
    assert render_section(folded).startswith("<details><summary>Detail</summary>")


def test_texts_are_escaped_on_a_page_and_harmless_on_a_terminal():
    section = Section(
        title="<b>", sentences=("a\x1b[31m",), tables=(Table(head=("<i>",), rows=((Mark(text="<u>", style="bad"),),)),)
    )
    page, text = render_section(section), join(render_sections([section]))
    assert not {"<b>", "<i>", "<u>"} & set(page.split()) and '<b class="bad">&lt;u&gt;</b>' in page
    assert "\x1b" not in text + page


def test_a_new_row_of_a_result_appears_everywhere(fitted, tmp_path, capsys, without_drawing):
    invented = DerivedFigure(value=12.25, unit="N s/m", std=0.5)
    fit = replace(fitted, derived=dict(fitted.derived) | {"invented": invented})
    show_sections(Terminal(), fit)
    page = so.write_report([fit], tmp_path / "r.html").read_text(encoding="utf-8")
    for text in (str(fit), fit._repr_html_(), capsys.readouterr().out, page):
        assert text.count("invented") == 1
        row = re.sub(r"<[^>]*>", " ", text.split("invented")[1].split("derived")[0])
        assert row.split()[:3] == ["12.25", "±", "0.5"] and "N s/m" in row


@pytest.mark.parametrize(
    ("message", "sentence"),
    [
        ("eta cannot be told", "eta cannot be told."),
        ("b_r, eta and J enter only together", "b_r, eta and J enter only together."),
        ("chirp.F1: off", "chirp.F1: off."),
        ("stalled, as steps are", "Stalled, as steps are."),
        ("re-weighted twice", "Re-weighted twice."),
    ],
)
def test_a_name_at_the_start_of_a_sentence_stays_as_it_is_written(fitted, message, sentence):
    (parameters, *_) = describe(replace(fitted, message=message))
    assert parameters.sentences[0] == sentence


def test_a_new_requirement_of_a_certificate_appears_everywhere(certificate, tmp_path, capsys, without_drawing):
    row = replace(certificate.requirements[0], name="invented_limit", value=4.25, limit=3.5, met=False, plant="moon")
    found = replace(certificate, requirements=(row, *certificate.requirements))
    show_verdicts(Terminal(), [judge(found)])
    page = so.write_report([found], tmp_path / "r.html").read_text(encoding="utf-8")
    for text in (str(found), found._repr_html_(), capsys.readouterr().out, page):
        assert {"invented_limit", "4.25", "3.5", "moon"} <= set(re.split(r"[<>\s:,]+", text))


@pytest.mark.parametrize(("band", "bandwidth_hz", "swings"), [((12.8, 19.7), 19.7, False), ((1.2, 14.3), 0.84, True)])
def test_a_reference_that_peaks_is_not_called_a_swinging_output(certificate, band, bandwidth_hz, swings):
    change = {"tracking_band_hz": band, "bandwidth_hz": bandwidth_hz}
    plants = {name: replace(figures, **change) for name, figures in certificate.plants.items()}
    assert ("A swinging output puts a zero" in repr(replace(certificate, plants=plants))) is swings


def test_terms_are_explained_under_the_pointer(fitted, certificate, tmp_path, without_drawing):
    page = so.write_report([fitted, certificate], tmp_path / "r.html").read_text(encoding="utf-8")
    explained = re.findall(r'<abbr title="([^"]+)">([^<]+)</abbr>', page)
    assert {"Ms", "Mt", "disk", "disk margin", "phase °", "noise gain", "std", "whiteness p"} <= {
        term for _, term in explained
    }
    assert all(html.unescape(meaning) == GLOSSARY[term] for meaning, term in explained)
    section = Section(title="", tables=(Table(head=("<Ms>", "Mss"), rows=(("worst Ms", "a"),)),))
    assert re.findall(r"<abbr[^>]*>(\w+)</abbr>", render_section(section)) == ["Ms", "Ms"]


def test_a_term_is_marked_with_its_meaning():
    assert explain_terms("whiteness p") == f'<abbr title="{html.escape(GLOSSARY["whiteness p"])}">whiteness p</abbr>'


def test_a_cure_is_a_line_of_the_problem_file_with_its_place():
    place, delay = spell_cure("chirp.delay_s", 0.004)
    assert place.startswith("[[experiment]] chirp") and delay == "delay_s = { value = 0.004, free = true, max = 0.02 }"
    assert spell_cure("f_c", 12.0) == ["[parameters]", "f_c = { value = 12, free = true }"]
