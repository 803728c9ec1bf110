"""Rows of the certificate that the loop's figures do not have: the passive band and the disk margin, by hand."""

from __future__ import annotations

import json
import sys
from dataclasses import replace

import numpy as np
import pytest

import seaopt as so
from seaopt.cli import main
from seaopt.control import assess, ideal_pid
from seaopt.errors import FileError
from seaopt.files import seal, to_json
from seaopt.robustness.certificate.simulated import SIMULATIONS, STEPS
from seaopt.robustness.certificate.stored import read_requirements
from tests.checks import leave_out
from tests.words import flatten

BAND = (1.0, 60.0)
QUIET = so.ControllerSpec(bandwidth_hz=30, max_sensitivity=1.6, objective="noise", passive_band_hz=BAND)


def cosine_by_hand(controller, params, f):
    """Return Re Z/abs(Z) from M q'' = F_m - b q' - F2, F1 = k (q + x2), F2 = F1 + m_l (q'' + x2''), hold and delay."""
    p = {name: item.value for name, item in params.items()}
    radius, ts = p["l"] / (2 * np.pi * p["N_p"]), controller.sample_time_s
    mass, b, s = p["J"] / radius**2, p["b_r"] / radius**2, 2j * np.pi * f
    q = np.exp(-s * ts)
    law = np.polyval(controller.measurement.num[::-1], q) / np.polyval(controller.measurement.den[::-1], q)
    law = law * q**controller.compute_delay_samples * (1 - q) / (s * ts)
    z = (p["m_l"] * s**2 + p["k"]) * (mass * s + b) / ((mass + p["m_l"]) * s**2 + b * s + p["k"] * (1 + law))
    return np.real(z) / np.abs(z)


@pytest.fixture(autouse=True)
def without_steps(monkeypatch):
    """Let certificates have no simulated steps: what is looked at here is linear."""
    leave_out(monkeypatch, STEPS)


@pytest.fixture(scope="module")
def quiet(stand, thor):
    return so.tune(stand, thor, QUIET)


@pytest.fixture(scope="module")
def loud(stand, thor):
    """Return the law of a controller that was not asked to be passive, under a specification that asks for it."""
    return replace(so.tune(stand, thor, replace(QUIET, passive_band_hz=None)), spec=QUIET)


def row_of(controller, plants, params, name):
    certificate = so.certify(controller, plants, params, simulations=False)
    (row,) = [item for item in certificate.requirements if item.name == name]
    return row, certificate


def by_hand(controller, params):
    f = np.linspace(*BAND, 200_001)
    cosine = cosine_by_hand(controller, params, f)
    return cosine.min(), f[np.argmin(cosine)]


def test_a_passive_band_that_is_kept(quiet, stand, thor):
    row, certificate = row_of(quiet, {"stand": stand}, thor, "passive_band_hz")
    assert row.met and certificate.passed
    assert (row.limit, row.value) == (0.0, pytest.approx(by_hand(quiet, thor)[0], rel=1e-6))


def test_a_passive_band_that_is_broken_names_figure_limit_and_frequency(loud, stand, thor):
    row, certificate = row_of(loud, {"stand": stand}, thor, "passive_band_hz")
    least, at_hz = by_hand(loud, thor)
    assert least < -0.01
    assert not row.met and not certificate.passed
    assert (row.limit, row.value) == (0.0, pytest.approx(least, rel=1e-6))
    assert f"Re Z/|Z| at {at_hz:.3g}" in row.where
    words = f"passive_band_hz {row.value:.4g}, limit ≥ 0: design plant: Re Z/|Z| at "
    assert words in flatten(repr(certificate))
    again = next(item for item in certificate.to_dict()["requirements"] if item["name"] == "passive_band_hz")
    assert (again["met"], again["value"]) == (False, row.value)


def test_the_port_is_the_design_plants_at_the_parameters_certified(quiet, stand, thor):
    """A softer spring and another motor inertia than tuned for; only the swing is certified."""
    other = thor.update(J=1.5e-6, k=3e5)
    row, _ = row_of(quiet, {"swing": so.plants.moving_output()}, other, "passive_band_hz")
    assert row.value == pytest.approx(by_hand(quiet, other)[0], rel=1e-6)
    assert row.plant == "design plant"


def test_what_no_band_is_asked_of_has_no_row(loud, stand, thor):
    free = replace(loud, spec=replace(QUIET, passive_band_hz=None))
    assert "passive_band_hz" not in {
        item.name for item in so.certify(free, {"stand": stand}, thor, simulations=False).requirements
    }


def test_the_disk_margin_of_every_plant(quiet, stand, swing, thor):
    """2 over the peak of abs((1 - L)/(1 + L)), on a grid."""
    plants = {"stand": stand, "swing": swing}
    f = np.geomspace(1e-3, 499.0, 40_000)
    for limit in (0.5, 1.9):
        asked = replace(quiet, spec=replace(QUIET, min_disk_margin=limit))
        rows = {item.plant: item for item in so.certify(asked, plants, thor, simulations=False).requirements
                if item.name == "min_disk_margin"}  # fmt: skip
        for name, plant in plants.items():
            gain = quiet.close(plant, thor).open_loop(f)
            margin = 2 / np.max(np.abs((1 - gain) / (1 + gain)))
            assert rows[name].value == pytest.approx(margin, rel=1e-4)
            assert rows[name].met is bool(margin >= limit)
    assert not rows["stand"].met


PROBLEM = """
schema = 1
[plant.stand]
kind = "high_impedance"
[controller]
plant = "stand"
bandwidth_hz = 30
max_sensitivity = 1.6
objective = "noise"
passive_band_hz = [1, 60]
[robustness]
samples = 1
"""


def test_the_command_exits_1(loud, tmp_path, monkeypatch, capsys):
    (tmp_path / "problem.toml").write_text(PROBLEM, encoding="utf-8")
    (tmp_path / "loud.json").write_text(to_json(loud.to_dict()), encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["seaopt", "certify", "problem.toml", "-o", "out", "--controller", "loud.json"])
    leave_out(monkeypatch, SIMULATIONS)
    with pytest.raises(SystemExit) as end:
        main()
    out = capsys.readouterr()
    assert end.value.code == 1, out.err
    assert "not met" in out.out and "passive_band_hz -0." in out.out
    content = json.loads((tmp_path / "out" / "robustness.json").read_text(encoding="utf-8"))
    (row,) = [item for item in content["requirements"] if item["name"] == "passive_band_hz"]
    assert not row["met"] and row["limit"] == 0.0 and row["value"] < 0.0
    assert " Hz, of 1 to 60 Hz" in row["where"]


@pytest.mark.parametrize(("sense", "tolerance", "value", "kept"), [
    ("=", 0.005, 30.1, True), ("=", 0.005, 30.2, False), ("=", 0.005, 29.9, True), ("=", 0.005, 29.8, False),
    ("=", 0.005, np.inf, False), ("≥", 0.02, 60.0, True), ("≥", 0.02, 29.5, True), ("≥", 0.02, 29.3, False),
    ("≤", 0.005, 30.0, False),
    ("≥", 0.6, 30.0, False),
])  # fmt: skip
def test_a_bandwidth_that_is_read_is_judged_on_both_sides(sense, tolerance, value, kept):
    """As it was asked of a tuned law, at least of one that is given, and both with the tolerance that was taken."""
    row = {"name": "bandwidth_hz", "limit": 30.0, "value": value, "met": True, "sense": sense, "tolerance": tolerance}
    if kept:
        assert read_requirements({"requirements": [row]})[0].value == value
        return
    with pytest.raises(FileError, match=r"bandwidth_hz is called met|has the sense|tolerance"):
        read_requirements({"requirements": [row]})


def test_a_law_that_is_given_needs_its_bandwidth_at_least(stand, thor, robust_controller):
    law = ideal_pid(K=2.0, T_i=0.05, T_d=0.01, N=10.0, sample_time_s=1e-3)
    spec = so.ControllerSpec(bandwidth_hz=20, max_sensitivity=2.0, max_droop_db=False, bandwidth_tolerance=0.1)
    rows = {}
    for name, controller in (("given", assess(law, stand, thor, spec)), ("tuned", robust_controller)):
        certificate = so.certify(controller, {"stand": stand}, thor, samples=2, simulations=False)
        (row,) = [row for row in certificate.requirements if row.name == "bandwidth_hz"]
        rows[name] = row.sense, row.tolerance, row.keeps
        again = so.robustness.Certificate.from_dict(seal(certificate.to_dict()), controller, {"stand": stand}, thor)
        assert again.requirements == certificate.requirements
    assert rows == {"given": ("≥", 0.1, True), "tuned": ("=", 0.005, True)}
