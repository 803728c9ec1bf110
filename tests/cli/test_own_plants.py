"""`seaopt run` with plants that are not built in: of an installed package, and written in the problem file."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import seaopt as so

PROBLEMS = Path(__file__).resolve().parents[2] / "problems"
MODULE = '''
import seaopt as so


def make_drive(stiffness="linear"):
    """A mass on a spring that a voltage pulls at."""
    assert stiffness == "linear"
    return so.Plant(
        name="drive", states={"x": "m", "w": "m/s"}, inputs={"U": "V"}, outputs={"F": "N", "y": "m"},
        parameters={"m": "kg", "k": "N/m", "c": "N s/m", "K": "N/V"},
        f=lambda t, x, u, p: {"x": x.w, "w": (p.K * u.U - p.k * x.x - p.c * x.w) / p.m},
        h=lambda t, x, u, p: {"F": p.k * x.x, "y": x.x},
        actuation=so.plants.Actuation(input="U", effort=lambda p: p.K),
        sensing=so.plants.Sensing(regulated=("F",)),
        spring=so.plants.SeriesSpring(deflection=lambda x, p: x.x, unit="m", stiffness="k"),
    )
'''
INSTALLED = '[plant.drive]\nkind = "acme_drive"\nstiffness = "linear"\n'
WRITTEN = """
[plant.drive]
states = { x = "m", w = "m/s" }
inputs = { U = "V" }
outputs = { F = "N", y = "m" }
parameters = { m = "kg", k = "N/m", c = "N s/m", K = "N/V" }
definitions = { spring = "k*x" }
f = { x = "w", w = "(K*U - spring - c*w)/m" }
h = { F = "spring", y = "x" }
actuation = { input = "U", effort = "K" }
sensing = { regulated = ["F"] }
spring = { deflection = "x", unit = "m", stiffness = "k" }
"""
HEAD = """schema = 1
[parameters]
m = { value = 1.5, free = true, min = 0.1 }
k = 8e4
c = { value = 200, free = true, min = 0 }
K = 12.5
"""
REST = """
[[experiment]]
name = "noise"
plant = "drive"
virtual = { seed = 3, duration_s = 4, rate_hz = 1000, noise_std = { F = 0.5 }, truth = { m = 2.0, c = 300 }, \
excitation = { noise = { std = 20, band_hz = 200 } } }
[controller]
plant = "drive"
measured = "F"
bandwidth_hz = 20
robust_to = ["drive"]
[robustness]
plants = ["drive"]
parameters = { k = [7.6e4, 8.4e4] }
samples = 30
"""


@pytest.fixture
def acme(tmp_path, monkeypatch):
    """Install a package that offers a plant: its module, and the metadata that pip would write."""
    site = tmp_path / "site-packages"
    metadata = site / "acme_drive-1.0.dist-info"
    metadata.mkdir(parents=True)
    (site / "acme_drive.py").write_text(MODULE, encoding="utf-8")
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: acme-drive\nVersion: 1.0\n", encoding="utf-8")
    (metadata / "entry_points.txt").write_text(
        "[seaopt.plants]\nacme_drive = acme_drive:make_drive\n", encoding="utf-8"
    )
    monkeypatch.syspath_prepend(str(site))


@pytest.mark.slow
@pytest.mark.usefixtures("acme", "without_drawing")
def test_a_plant_of_a_package_and_one_of_the_file_run_alike(folder, seaopt):
    results = {}
    for name, plant in (("installed", INSTALLED), ("written", WRITTEN)):
        (folder / f"{name}.toml").write_text(HEAD + plant + REST, encoding="utf-8")
        out = seaopt("run", f"{name}.toml", "-o", name)
        assert out.returncode == 0, out.stdout + out.stderr
        assert (folder / name / "report.html").is_file()
        results[name] = [json.loads((folder / name / f"{stage}.json").read_text()) for stage in
                         ("fit", "controller", "robustness")]  # fmt: skip
    (fit, controller, robustness), (own_fit, own_controller, own_robustness) = results.values()
    assert own_fit["met"] and own_fit["parameters"]["m"]["value"] == pytest.approx(2.0, rel=0.02)
    for name in ("m", "c"):
        assert own_fit["parameters"][name]["value"] == pytest.approx(fit["parameters"][name]["value"], rel=1e-6)
    assert own_controller["gains"] == pytest.approx(controller["gains"], rel=1e-4)
    assert own_robustness["passed"] and robustness["passed"]


def test_the_place_of_a_mistake_is_shown(folder, seaopt):
    (folder / "wrong.toml").write_text(HEAD + WRITTEN.replace("c*w)/m", "cc*w)/m") + REST, encoding="utf-8")
    out = seaopt("fit", "wrong.toml")
    message, line, caret = out.stderr.splitlines()
    assert out.returncode == 2 and not out.stdout
    assert message.startswith("seaopt: wrong.toml: plant.drive: f.w, column 17: ")
    assert line[caret.index("^") :].startswith("cc*w") and line.lstrip().startswith("f.w = ")


def test_a_terminal_does_not_obey_an_equation(folder, seaopt):
    escape = WRITTEN.replace('"k*x"', '"k*x + \\u001b]0;title\\u0007"')
    (folder / "wrong.toml").write_text(HEAD + escape + REST, encoding="utf-8")
    out = seaopt("fit", "wrong.toml")
    assert out.returncode == 2 and "\x1b" not in out.stderr and "definitions.spring, column 7" in out.stderr


def test_what_is_not_used_is_noted(folder, seaopt):
    text = HEAD + "b = 1.0\n" + WRITTEN.replace('K = "N/V"', 'K = "N/V", b = "-"') + REST[: REST.index("[controller]")]
    (folder / "odd.toml").write_text(text, encoding="utf-8")
    assert "note: plant.drive.parameters.b is not used" in seaopt("simulate", "odd.toml").stderr


@pytest.mark.slow
def test_the_pendulum_of_the_problem_file_is_fitted_tuned_and_certified(folder, seaopt):
    truth = {"I_p": 0.2, "mgL": 3.7, "d": 0.02, "tau_c": 0.12}
    out = seaopt("run", PROBLEMS / "pendulum.toml", "-o", "out")
    assert out.returncode == 0, out.stdout
    fit = json.loads((folder / "out" / "fit.json").read_text())
    for name, value in truth.items():
        found = fit["parameters"][name]
        assert abs(found["value"] - value) < 4 * found["std"] and found["value"] == pytest.approx(value, rel=2e-3)
    frequency = fit["derived"]["natural_frequency_hz"]["value"]
    assert frequency == pytest.approx((3.7 / 0.2) ** 0.5 / 6.283185, rel=1e-3)
    assert json.loads((folder / "out" / "robustness.json").read_text())["passed"]


def test_the_problem_in_problems_is_valid():
    problem = so.read_problem(PROBLEMS / "pendulum.toml")
    assert problem.notes == [] and list(problem.plants["pendulum"].friction) == ["tau_f"]
