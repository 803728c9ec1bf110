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
    assert found["k_p"][0] == f"{controller.gains['k_p']:.5g} N/N"
    assert found["k_p"][1] == f"{controller.gains['k_p'] * controller.command.per_effort:.5g} A/N"
    assert found["Ms"] == [f"{controller.achieved.ms:.4g}", "at most 1.6"]
    assert found["Mt"][1] == "at most 1.3"
    assert found["noise gain"][1] == ""
    assert found["bandwidth"] == ["30 Hz", "30 Hz"]


def test_a_certificate_shows_plants_draws_and_requirements(certificate):
    shown = certificate._repr_html_()
    assert "Certificate: passed" in shown and "<pre>" not in shown
    found = rows(shown)
    assert "varied: " in shown and "I_p 0.3 to 0.5" in shown
    (plant,) = [row for row in found if row[:2] == ["swing", "yes"]]
    assert plant[2] == f"{certificate.plants['swing'].ms:.4g}"
    assert plant[-1].startswith("I_p = ")
    assert ["samples", "20"] in found and ["failures", "0"] in found
    assert len([row for row in found if row[-1] in ("yes", "NO")]) == len(certificate.requirements)


def test_what_is_not_met_comes_first_and_is_escaped(certificate):
    broken = replace(certificate.requirements[-1], met=False, where="<b>swing</b>")
    shown = replace(certificate, passed=False, requirements=(*certificate.requirements, broken))._repr_html_()
    assert "FAILED" in shown and "&lt;b&gt;swing" in shown
    below = rows(shown)
    place = next(i for i, row in enumerate(below) if row[0] == "requirement")
    assert below[place + 1][1] == "<b>swing</b>"


def test_worst_case_and_draws_show_themselves(certificate):
    worst = certificate.worst["swing"]
    found = dict(rows(worst._repr_html_()))
    assert float(found["I_p"]) == pytest.approx(worst.parameters["I_p"], rel=1e-4)
    assert re.match(r"1\.\d+ at [\d.]+ Hz", found["Ms"])
    drawn = dict(rows(certificate.monte_carlo._repr_html_()))
    assert drawn["samples"] == "20"
    assert float(drawn["failure probability bound"]) == pytest.approx(1.0 - 1e-6 ** (1 / 20), rel=1e-5)
