"""What notebooks show: tables with the figures that the objects have, every text escaped."""

from __future__ import annotations

import re
from dataclasses import replace
from xml.etree import ElementTree

import pytest

import seaopt as so


@pytest.fixture(scope="module")
def certificate(without_steps):
    stand, swing, thor = so.plants.high_impedance(), so.plants.moving_output(), so.plants.thor()
    spec = so.ControllerSpec(bandwidth_hz=30, max_sensitivity=1.6, current_limit_A=9.0)
    controller = so.tune(stand, thor, spec, robust_to={"swing": swing}, draws=so.control.corners({"I_p": (0.3, 0.5)}))
    with without_steps():
        return so.certify(controller, {"swing": swing}, thor, ranges={"I_p": (0.3, 0.5)}, samples=20, simulations=False)


@pytest.fixture(autouse=True)
def without_drawing(monkeypatch):
    monkeypatch.setattr("seaopt.reporting.figures.canvas.render_figure", lambda figure, kind: b"<svg/>")


def rows(shown):
    """Return the tables' cells, a list a row; what is no XML is refused, but for images, which HTML leaves open."""
    closed = re.sub(r"(<img\b[^>]*[^/>])>", r"\1/>", shown)
    page = ElementTree.fromstring(f"<div>{closed}</div>")
    return [["".join(cell.itertext()) for cell in row] for row in page.iter("tr")]


def test_a_controller_shows_gains_and_what_is_asked(certificate):
    controller = certificate.controller
    found = {row[0]: row[1:] for row in rows(controller._repr_html_())}
    gain = controller.gains["k_p"]
    assert found["k_p"] == [f"{gain:.5g}", "N/N", f"{gain * controller.command.per_effort:.5g}", "A/N"]
    assert found["Ms"] == [f"{controller.achieved.ms:.4g}", "at most 1.6"]
    assert found["Mt"][1] == "at most 1.3"
    assert found["noise gain"][1] == ""
    assert found["bandwidth"] == ["30 Hz", "30 Hz"]


def test_a_certificate_shows_plants_draws_and_requirements(certificate):
    shown = certificate._repr_html_()
    assert "Certificate: passed" in shown and "<pre>" not in shown and "0 failures in 20 draws" in shown
    found = rows(shown)
    (varied,) = [row for row in found if row[:2] == ["I_p", "uniform"]]
    assert varied[3:5] == ["0.3", "0.5"]
    plant, worst = [row for row in found if row[0] == "swing"][:2]
    assert plant[1] == f"{certificate.plants['swing'].ms:.3f}"
    assert worst[-1].startswith("I_p = ")
    assert len([row for row in found if row[0] in ("met", "not met")]) == len(certificate.requirements)


def test_what_is_not_met_comes_first_and_is_escaped(certificate):
    broken = replace(certificate.requirements[-1], met=False, plant="<b>swing</b>")
    shown = replace(certificate, requirements=(*certificate.requirements, broken))._repr_html_()
    assert "not met" in shown and "&lt;b&gt;swing" in shown
    below = rows(shown)
    place = next(i for i, row in enumerate(below) if row[0] == "verdict")
    assert below[place + 1][0] == "not met" and below[place + 1][-1].startswith("<b>swing</b>")


def test_worst_case_and_draws_show_themselves(certificate):
    worst = certificate.worst["swing"]
    found = dict(rows(worst._repr_html_()))
    assert float(found["I_p"]) == pytest.approx(worst.parameters["I_p"], rel=1e-4)
    assert re.match(r"1\.\d+ at [\d.]+ Hz", found["Ms"])
    drawn = dict(rows(certificate.monte_carlo._repr_html_()))
    assert drawn["samples"] == "20"
    assert float(drawn["failure probability bound"]) == pytest.approx(1.0 - 1e-6 ** (1 / 20), rel=1e-5)
