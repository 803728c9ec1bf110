"""What the documentation shows is what works: the blocks of each page run in order, as pasted, from a clean start."""

from __future__ import annotations

import contextlib
import io
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from dataclasses import dataclass
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from click.exceptions import UsageError
from typer.main import get_command

import seaopt as so
from seaopt.cli import main
from seaopt.cli.main import app
from seaopt.control import passive_region
from seaopt.control.deploy.export import export
from seaopt.control.laws.passivity import passivity
from seaopt.simulation.native import find_compiler
from tests.pages import blocks, list_pages, read_page, unbroken

SLOW = {  # whole certificates, sweeps, searches for causes, bootstrap, reports: 1 to 20 s of processor time each
    "howto/cascade.md", "howto/choose_bandwidth.md", "howto/compensation.md", "howto/figures.md", "howto/friction.md",
    "howto/impedance.md", "howto/many_logs.md", "howto/measured_response.md", "howto/read_certificate.md",
    "howto/report.md", "howto/rotary_and_encoders.md", "theory/certificate.md", "theory/diagnostics.md",
    "theory/free_law.md", "theory/mpc.md", "theory/tuning.md", "theory/verification.md", "tutorial/ten_minutes.md",
}  # fmt: skip


@dataclass
class Run:
    """What the blocks of a page left: their names, and what each printed."""

    names: dict
    printed: list[str]
    after: list[dict]  # the names after each block: a later one may use some of them for something else

    def __getitem__(self, name):
        return self.names[name]


def run(page):
    """Run the Python of a page in the current folder."""
    found = Run({}, [], [])
    for number, code in enumerate(blocks(page, "python")):
        with contextlib.redirect_stdout(io.StringIO()) as out:
            exec(compile(code, f"{page}, block {number + 1}", "exec"), found.names)
        found.printed.append(out.getvalue())
        found.after.append(dict(found.names))
    return found


def check_plants(found):
    assert found["bench"].outputs == ("speed",)


def check_own_plant(found):
    so.testing.assert_recovered(found["fit"], found["truth"], sigmas=4)


def check_on_the_target(found):
    assert 0.8 < found["command"] <= 9.0
    assert found["currents_A"].shape == (100,)


def check_passivity(found):
    assert found["port"].holds((0.1, 60.0))
    assert found["passive"]


def check_experiment_design(found):
    ratio = found["design"].against(found["PAPER_STAND"]).ratio
    assert ratio["J"] > 2.5 and ratio["b_r"] > 2.0


def check_diagnostics(found):
    assert found["ranking"].preferred == "unlumped" and found["ranking"].decisive
    assert found["diagnose"](found["fits"]["unlumped"]).met
    said = [found["ranking"].sentences[0], *found["diagnose"](found["fits"]["lumped"]).sentences[:2]]
    shown = " ".join(read_page("theory/diagnostics.md").replace(">", " ").split())
    for sentence in said:  # the numbers may move in their last digits
        assert sentence.split(":")[0] in shown


def check_mpc(found):
    assert found["run"].whiteness_p["F1"] > 0.01
    assert found["loop"].overshoot < 0.03 and found["loop"].settling_time_s(0.05) < 0.04


def check_log_quality(found):
    eta = {name: found[name].parameters["eta"] for name in ("masked", "declared", "biased")}
    assert len(found["clipped"]) == 2
    assert abs(eta["masked"].value - 1) < 3 * eta["masked"].std
    assert eta["declared"].value == pytest.approx(eta["masked"].value)
    assert eta["biased"].value < 1 - 10 * eta["biased"].std
    assert found["again"].rate_hz == 200


def check_reading_logs(found):
    shown = re.search(r"```text\n(chirp.csv:.*?)```", read_page("howto/reading_logs.md"), flags=re.DOTALL)
    assert shown is not None and found.printed[1] == shown[1]
    np.testing.assert_allclose(found["log"]["F1"][:-1], found["t"][:-1] + 0.0035, atol=1e-9)


def check_margins(found):
    assert found["disk"].alpha > 0.8


def check_verification(found):
    page, verification = unbroken("theory/verification.md"), found["verification"]
    assert verification.passed and found["from_an_angle"].passed
    for row in (*verification.rows, *found["from_an_angle"].rows):
        assert row.scenario in page
    low, high = verification.follows_hz["swing"]
    assert f"tracks references between {low:.1f} and {high:.1f} Hz" in page
    swept = found["swept"]
    assert " | ".join(f"{force:.0f} N" for force in swept.amplitude_N) in page
    assert " | ".join(f"{hz:.1f} Hz" for hz in swept.bandwidth_hz) in page
    environments = found["environments"]
    assert not environments.everywhere and environments.fixed_stable
    worst = environments.worst
    assert f"a free link of {worst.m_2:.2f} kg an oscillation at {worst.frequency_hz:.0f} Hz" in page
    port = passivity(found["controller"], found["stand"], found["thor"])
    assert f"passive up to {port.violated_hz:.0f} Hz" in page
    assert f"A damping of {-port.least_damping_N_s_per_m:.1f} N s/m" in page


def check_tuning(found):
    """The laws of the page, and the integrals that it states of them."""
    assert found["controller"].feasible
    assert [round(row.bandwidth_hz) for row in found["frontier"].rows] == [20, 30, 40]
    assert found.printed[1].split() == ["pid_dob", "1.0", "pid", "1.53"]
    assert "is 1.00\nwith it and 1.53 without;" in read_page("theory/tuning.md")


def check_log_to_parameters(found):
    so.testing.assert_recovered(found["fit"], found["truth"], sigmas=4)
    assert abs(found["fit"].nuisance["bench"].delay_s - 1.5e-3) < 2e-5


def check_friction(found):
    assert not found["without"].met and found["controller"].feasible
    so.testing.assert_recovered(found["fit"], found["truth"], sigmas=4)


def check_rotary_and_encoders(found):
    so.testing.assert_recovered(found["fit"], found["truth"], sigmas=4)
    ratios = found["ratios"]
    assert ratios.status == "not_identifiable"
    assert ratios.derived["resonance_hz"].std < 0.01 < ratios.derived["reflected_inertia"].std


def check_many_logs(found):
    assert found["fleet"].met and found["law"].feasible
    assert found["chi_square"] > 100


def check_band_weighting(found):
    so.testing.assert_recovered(found["fit"], found["real"].defaults, sigmas=4)


def check_choose_bandwidth(found):
    assert found["controller"].feasible and not found["too_much"].feasible
    assert found["largest"] == 40


def check_read_certificate(found):
    assert not found["certificate"].passed and found["better"].passed


def check_tutorial(found):
    """The Python of the page, then its commands as a user types them."""
    assert found["fit"].met and found["controller"].feasible and found["certificate"].passed
    (table,) = blocks("tutorial/ten_minutes.md", "toml")
    Path("problem.toml").write_text(table, encoding="utf-8")
    for text in blocks("tutorial/ten_minutes.md", "sh"):
        command = [sys.executable, "-m", *shlex.split(text)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout + done.stderr
    assert Path("out/report.html").exists() and Path("firmware/knee.c").exists()


def check_elastic_joint(found):
    ratio = found["design"].against((found["Chirp"](amplitude=0.5, f0_hz=0.1, f1_hz=10),)).ratio
    assert ratio["b_r"] > 2.2 and ratio["c_s"] > 1.2 and ratio["k_s"] < 0.5


def check_impedance(found):
    text = read_page("howto/impedance.md")
    stated = re.search(r"passive up to ([\d.]+) N m/rad, .* with a damping of ([\d.]+) N m s/rad", text)
    assert stated is not None
    assert float(stated[1]) == pytest.approx(found["region"].stiffest.stiffness, rel=0.01)
    assert float(stated[2]) == pytest.approx(found["region"].stiffest.damping, rel=0.02)
    assert "takes a damper of 2.569 N m s/rad" in text
    assert found["hard"].needed_damper == pytest.approx(2.569, rel=0.01)
    assert not found["hard"].stable
    assert found["soft"].passive
    assert "take a damper of 0.52 N m s/rad" in text
    assert found["rendering"].needed_damper == pytest.approx(0.52, abs=0.01)
    for filter_s, stiffest in ((None, 163.0), (0.01, 225.0)):
        other = passive_region(found["force"], found["knee"], found["values"], velocity_filter_s=filter_s, points=2)
        assert other.stiffest is not None
        assert other.stiffest.stiffness == pytest.approx(stiffest, rel=0.01)


def check_certificate(found):
    """The worst case of the first block, and the table of its ranges, which is a problem file's."""
    first = found.after[0]
    assert first["worst"].verify(first["controller"])
    (table,) = blocks("theory/certificate.md", "toml")
    assert set(tomllib.loads(table)["robustness"]["parameters"]) == set(first["ranges"])


CHECKS = {
    "evidence/elastic_joint.md": check_elastic_joint,
    "howto/choose_bandwidth.md": check_choose_bandwidth,
    "howto/experiment_design.md": check_experiment_design,
    "howto/friction.md": check_friction,
    "howto/impedance.md": check_impedance,
    "howto/log_quality.md": check_log_quality,
    "howto/log_to_parameters.md": check_log_to_parameters,
    "howto/many_logs.md": check_many_logs,
    "howto/on_the_target.md": check_on_the_target,
    "howto/own_plant.md": check_own_plant,
    "howto/read_certificate.md": check_read_certificate,
    "howto/reading_logs.md": check_reading_logs,
    "howto/rotary_and_encoders.md": check_rotary_and_encoders,
    "theory/band_weighting.md": check_band_weighting,
    "theory/certificate.md": check_certificate,
    "theory/diagnostics.md": check_diagnostics,
    "theory/margins.md": check_margins,
    "theory/mpc.md": check_mpc,
    "theory/passivity.md": check_passivity,
    "theory/plants.md": check_plants,
    "theory/tuning.md": check_tuning,
    "theory/verification.md": check_verification,
    "tutorial/ten_minutes.md": check_tutorial,
}
WITH_PYTHON = [page for page in list_pages() if blocks(page, "python")]


@pytest.mark.parametrize(
    "page", [pytest.param(page, marks=pytest.mark.slow) if page in SLOW else page for page in WITH_PYTHON]
)
def test_the_blocks_of_a_page_run_as_pasted(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    found = run(page)
    if page in CHECKS:
        CHECKS[page](found)


def test_every_check_is_of_a_page_that_runs():
    assert CHECKS.keys() | SLOW <= set(WITH_PYTHON)


@pytest.mark.parametrize("page", [page for page in list_pages() if blocks(page, "toml")])
def test_the_tables_of_a_page_are_toml(page):
    for text in blocks(page, "toml"):
        tomllib.loads(text)


def list_commands():
    """Return the lines of every page that call seaopt, without their comments."""
    for page in (*list_pages(), "../README.md"):
        for text in blocks(page, "sh"):
            for line in text.replace("\\\n", " ").splitlines():
                words = shlex.split(line, comments=True)
                if words and words[0] == "seaopt":
                    yield page, words


@pytest.mark.parametrize(("page", "words"), [pytest.param(*item, id=" ".join(item[1])) for item in list_commands()])
def test_a_command_of_a_page_has_these_options(page, words):
    """It is parsed by the command line itself; what it does is tested where commands are."""
    command, arguments = get_command(app), words[1:]
    if arguments and not arguments[0].startswith("-"):
        assert arguments[0] in command.commands, page
        command, arguments = command.commands[arguments[0]], arguments[1:]
    try:
        command.make_context("seaopt", arguments, resilient_parsing=False)
    except UsageError as error:  # a file of the page that is not here is no fault of the page
        if "does not exist" not in error.format_message():
            raise


@pytest.mark.parametrize("page", list_pages())
def test_code_fits_the_column_of_the_site(page):
    """At 1280 px a line of code is 100 characters long (docs/_static/site.css)."""
    for language in ("python", "toml", "sh", "c"):
        for block in blocks(page, language):
            assert max(map(len, block.splitlines()), default=0) <= 100


def test_the_problem_file_of_the_docs_is_valid(tmp_path, stand, thor, short_log):
    (text,) = blocks("reference/problem_file.md", "toml")
    path = tmp_path / "problem.toml"
    path.write_text(text, encoding="utf-8")
    late = so.simulate(stand, thor, short_log, delay_s=1.2e-3)
    noise = 2 * np.random.default_rng(0).normal(size=(2, len(late)))
    rows = zip(late.time, late["I"], late["F1"] + noise[0], late["F2"] + noise[1], strict=True)
    lines = ["time [s],cur,F1 [N],F2 [N]", *(f"{t:.6f},{1e3 * i:.9g},{a:.9g},{b:.9g}" for t, i, a, b in rows)]
    (tmp_path / "chirp.csv").write_text("\n".join(lines), encoding="utf-8")
    problem = so.read_problem(path)
    fit = so.fit(problem.experiments(), problem.parameters, **problem.fit_options)
    assert fit.status == "converged"
    assert abs(fit.nuisance["chirp"].delay_s - 1.2e-3) < 1e-4
    assert abs(fit.parameters["J"].value / thor["J"].value - 1) < 0.02
    law = so.tune(problem.design_plant, fit, problem.spec, robust_to=problem.robust_to(fit.parameters))
    assert law.feasible and law.compute_delay_samples == 0 and 1.1 < law.delay_samples < 1.3


def test_the_plant_of_the_how_to_as_data_gives_the_same_fit(tmp_path, simulated, monkeypatch):
    """The page's file, and its Python, on a log laid out as the measured one; then the roles that it shows."""
    monkeypatch.chdir(tmp_path)
    problem_file, roles = blocks("howto/own_plant.md", "toml")[:2]
    (tmp_path / "pendulum.toml").write_text(problem_file, encoding="utf-8")
    space: dict = {}
    for code in blocks("howto/own_plant.md", "python"):
        exec(code, space)
        if "virtual_log" in code:
            shutil.copy(simulated("ak80") / "data_measured.csv", tmp_path)
    problem = so.read_problem(tmp_path / "pendulum.toml")
    own = so.fit(problem.experiments(), problem.parameters, **problem.fit_options)
    for name in ("I_p", "mgL", "d", "tau_c"):
        one, other = own.parameters[name], space["fit"].parameters[name]
        assert one.value == pytest.approx(other.value, rel=1e-9) and one.std == pytest.approx(other.std, rel=1e-6)
    text = problem_file.replace('"d*omega + tau_c*tanh(omega/v_s)"', '"d*omega + tau_f"') + roles
    (tmp_path / "pendulum.toml").write_text(text, encoding="utf-8")
    plant = so.read_problem(tmp_path / "pendulum.toml").plants["pendulum"]
    x, u, p = [0.3, 2.0], [0.5], [0.2, 3.0, 0.1, 0.4, 0.1]
    rates = [ca.Function("f", [one.x, one.u, one.p], [one.dynamics])(x, u, p) for one in (plant, space["pendulum"])]
    np.testing.assert_allclose(*map(np.array, rates), rtol=1e-12)
    assert plant.friction["tau_f"].smoothing == "v_s" and list(plant.derived_values()) == ["natural_frequency_hz"]


def test_the_mistake_of_the_how_to_is_shown_as_it_says(tmp_path, monkeypatch, capsys):
    problem_file = blocks("howto/own_plant.md", "toml")[0].replace("mgL*sin", "mgl*sin")
    (tmp_path / "pendulum.toml").write_text(problem_file, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", ["seaopt", "fit", "pendulum.toml"])
    with pytest.raises(SystemExit, match="2"):
        main()
    assert capsys.readouterr().err == blocks("howto/own_plant.md", "text")[0]


def test_the_c_of_the_docs_compiles(tmp_path):
    compiler = find_compiler()
    if compiler is None:
        pytest.skip("no C compiler on this machine")
    spec = so.ControllerSpec(bandwidth_hz=30, max_sensitivity=1.6)
    export(so.tune(so.plants.high_impedance(), so.plants.thor(), spec), tmp_path, name="knee")
    (tmp_path / "main.c").write_text(blocks("howto/on_the_target.md", "c")[0], encoding="utf-8")
    subprocess.run(
        [*compiler, "-Wall", "-Wextra", "-Werror", "-std=c99", "-pedantic", "-c", "main.c"], cwd=tmp_path, check=True
    )
