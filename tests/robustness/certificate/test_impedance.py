"""What a certificate requires of an impedance, and what a problem file asks for."""

from __future__ import annotations

import json

import pytest

import seaopt as so
from seaopt.control import Impedance, add_impedance, critical_impedance
from seaopt.files import to_json
from seaopt.problem.stages import tune_problem
from seaopt.robustness import Certificate

HELD, FREE = so.plants.rotary("locked"), so.plants.rotary()
VALUES = FREE.defaults.update(N=100.0, K_tau=0.0369, eta=0.7, J_m=2.4e-5, b_r=1e-4, k_s=300.0, J_l=0.25, d_l=0.3)
PROBLEM = """
schema = 1
[parameters]
N = 100
K_tau = 0.0369
eta = 0.7
J_m = 2.4e-5
b_r = 1e-4
k_s = 300
J_l = 0.25
d_l = 0.3
[plant.stand]
kind = "rotary"
link = "locked"
[plant.free]
kind = "rotary"
[controller]
plant = "stand"
measured = "tau_s"
bandwidth_hz = 15
[impedance]
plant = "PLANT"
stiffness = 40
damping = DAMPING
velocity_filter_s = 0.005
"""


@pytest.fixture(scope="module")
def force():
    return so.tune(HELD, VALUES, so.ControllerSpec(measured="tau_s", bandwidth_hz=15, reserve=0.05))


def certify(force, damping):
    impedance = Impedance(stiffness=40.0, damping=damping, velocity_filter_s=5e-3)
    controller = add_impedance(force, FREE, VALUES, impedance, name="free")
    return so.certify(controller, {"free": FREE}, VALUES, samples=5, simulations=False)


def find(certificate, name):
    (row,) = [row for row in certificate.requirements if row.name == name]
    return row


def test_a_passive_impedance_is_certified(force):
    certificate = certify(force, 2.0)
    assert find(certificate, "impedance_stable").met
    row = find(certificate, "impedance_damper")
    assert row.met and row.value < row.limit == pytest.approx(0.3)
    assert "40 N m/rad and 2 N m s/rad at the link of free" in repr(certificate)


def test_one_that_is_not_fails_and_names_what_breaks_it(force):
    certificate = certify(force, 12.0)
    assert not certificate.passed
    row = find(certificate, "impedance_damper")
    assert not row.met and row.value > 0.3
    assert "makes it oscillate" in row.where


def test_it_is_in_the_json_and_read_again(force):
    certificate = certify(force, 2.0)
    content = json.loads(to_json(certificate.to_dict()))
    assert content["impedance"]["plant"] == "free"
    assert content["impedance"]["region"]["stiffest"]["stiffness"] > 40.0
    read = Certificate.from_dict(content, certificate.controller, {"free": FREE}, VALUES)
    assert read.impedance is not None
    assert read.impedance.rendering.needed_damper == pytest.approx(content["impedance"]["needed_damper"])


def write(folder, plant="free", damping="2.0"):
    path = folder / "knee.toml"
    path.write_text(PROBLEM.replace("PLANT", plant).replace("DAMPING", damping))
    return path


def test_a_problem_file_asks_for_it(tmp_path):
    problem = so.read_problem(write(tmp_path, damping='"critical"'))
    controller = tune_problem(problem, problem.parameters)
    expected = critical_impedance(controller, FREE, problem.parameters, 40.0, velocity_filter_s=5e-3)
    assert controller.outer.impedance == expected
    assert controller.outer.plant == "free"
    assert list(problem.certified_plants()) == ["stand", "free"]


def test_a_held_link_or_a_missing_controller_is_refused(tmp_path):
    with pytest.raises(so.SeaoptError, match=r'impedance.plant = "stand" holds its link'):
        so.read_problem(write(tmp_path, plant="stand"))
    path = write(tmp_path)
    text = path.read_text()
    start, end = text.index("[controller]"), text.index("[impedance]")
    path.write_text(text[:start] + text[end:])
    with pytest.raises(so.SeaoptError, match=r"no \[controller\]"):
        so.read_problem(path)
