"""What the documentation shows is what works."""

from __future__ import annotations

import contextlib
import re
import shutil
import subprocess
import tomllib

import casadi as ca
import numpy as np
import pytest

import seaopt as so
from seaopt.cli import main
from seaopt.control.deploy.export import export
from seaopt.control.laws.passivity import passivity
from seaopt.simulation.native import find_compiler
from tests.pages import blocks, read_page, unbroken


def test_the_speed_by_difference_of_the_docs_is_declared():
    space = {}
    exec(blocks("theory/plants.md", "python")[0], space)
    assert space["bench"].outputs == ("speed",)


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
    assert law.feasible and law.delay_samples == 2


def test_the_plant_of_the_how_to_works():
    code = blocks("howto/own_plant.md", "python")[0]
    space: dict = {}
    exec(code, space)
    assert list(space["pendulum"].states) == ["theta", "omega"]


def test_the_plant_of_the_how_to_as_data_gives_the_same_fit(tmp_path, simulated):
    """The page's file, and its Python, on a log laid out as the measured one; then the roles that it shows."""
    problem_file, roles = blocks("howto/own_plant.md", "toml")[:2]
    (tmp_path / "pendulum.toml").write_text(problem_file, encoding="utf-8")
    shutil.copy(simulated("ak80") / "data_measured.csv", tmp_path)
    problem = so.read_problem(tmp_path / "pendulum.toml")
    own = so.fit(problem.experiments(), problem.parameters, **problem.fit_options)
    space: dict = {}
    with contextlib.chdir(tmp_path):
        for code in blocks("howto/own_plant.md", "python"):
            exec(code, space)
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


def test_the_export_of_the_docs_works(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    space: dict = {}
    exec(blocks("howto/on_the_target.md", "python")[0], space)
    assert {path.name for path in (tmp_path / "firmware").iterdir()} >= {"knee.h", "knee.c"}
    assert 0.8 < space["current_A"] <= 9.0
    assert space["currents_A"].shape == (100,)


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


def test_the_passivity_of_the_docs_works():
    space: dict = {}
    for block in blocks("theory/passivity.md", "python"):
        exec(re.sub(r"print\(.*", "", block), space)
    assert space["port"].holds((0.1, 60.0))
    assert space["passive"]


def test_the_design_of_the_how_to_works():
    code = blocks("howto/experiment_design.md", "python")[0]
    space: dict = {}
    exec(re.sub(r"print\(.*", "", code), space)
    ratio = space["design"].against(space["PAPER_STAND"]).ratio
    assert ratio["J"] > 2.5 and ratio["b_r"] > 2.0


@pytest.mark.slow
def test_the_comparison_of_the_diagnostics_page_works(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    page = read_page("theory/diagnostics.md")
    space: dict = {}
    exec(re.sub(r"(?m)^(print|so.write_report)\(.*", "", blocks("theory/diagnostics.md", "python")[0]), space)
    assert space["ranking"].preferred == "unlumped" and space["ranking"].decisive
    assert space["diagnose"](space["fits"]["unlumped"]).ok
    said = [space["ranking"].sentences[0], *space["diagnose"](space["fits"]["lumped"]).sentences[:2]]
    shown = " ".join(page.replace(">", " ").split())
    for sentence in said:  # the numbers may move in their last digits
        assert sentence.split(":")[0] in shown


def test_the_estimator_and_the_controller_of_the_mpc_page_work(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    space: dict = {}
    exec(re.sub(r"(?m)^print\(.*", "", blocks("theory/mpc.md", "python")[0]), space)
    assert space["run"].whiteness_p["F1"] > 0.01
    assert space["loop"].overshoot < 0.03 and space["loop"].settling_time_s(0.05) < 0.04
    assert (tmp_path / "force_mpc" / "force_mpc.h").exists()


def test_the_log_of_the_quality_page_is_clipped_and_masked():
    space: dict = {}
    for code in blocks("howto/log_quality.md", "python"):
        exec(re.sub(r"(?m)^print\(.*", "", code), space)
    eta = {name: space[name].parameters["eta"] for name in ("masked", "declared", "biased")}
    assert len(space["clipped"]) == 2
    assert abs(eta["masked"].value - 1) < 3 * eta["masked"].std
    assert eta["declared"].value == pytest.approx(eta["masked"].value)
    assert eta["biased"].value < 1 - 10 * eta["biased"].std
    assert space["again"].rate_hz == 200


def test_the_certificate_of_the_docs_works():
    """The pages on margins and on the certificate run, and the table of ranges is a problem file's."""
    space: dict = {}
    for page in ("theory/margins.md", "theory/certificate.md"):
        exec(re.sub(r"print\(.*", "", blocks(page, "python")[0]), space)
    assert space["disk"].alpha > 0.8
    assert space["worst"].verify(space["controller"])
    (table,) = blocks("theory/certificate.md", "toml")
    assert set(tomllib.loads(table)["robustness"]["parameters"]) == set(space["ranges"])


def test_the_verification_of_the_docs_works():
    page = unbroken("theory/verification.md")
    space: dict = {}
    for code in blocks("theory/verification.md", "python"):
        exec(re.sub(r"(?m)^print\(", "found = (", code), space)
        found = space.get("found")
        if "verify(" in code:
            assert space["verification"].passed
            for row in space["verification"].rows:
                assert row.scenario in page
            low, high = space["verification"].follows_hz["swing"]
            assert f"tracks references between {low:.1f} and {high:.1f} Hz" in page
        elif "large_signal(" in code:
            assert " | ".join(f"{force:.0f} N" for force in found.amplitude_N) in page
            assert " | ".join(f"{hz:.1f} Hz" for hz in found.bandwidth_hz) in page
        elif "coupled" in code:
            assert not found.everywhere and found.fixed_stable
            worst = found.worst
            assert f"a free link of {worst.m_2:.2f} kg an oscillation at {worst.frequency_hz:.0f} Hz" in page
            port = passivity(space["controller"], space["stand"], space["thor"])
            assert f"passive up to {port.violated_hz:.0f} Hz" in page
            assert f"A damping of {-port.least_damping_N_s_per_m:.1f} N s/m" in page


def test_the_tuner_of_the_docs_works():
    space: dict = {}
    exec(re.sub(r"(?m)^print\(.*", "", blocks("theory/tuning.md", "python")[0]), space)
    assert space["controller"].feasible
    assert [round(row.bandwidth_hz) for row in space["frontier"].rows] == [20, 30, 40]


def test_the_integrals_that_the_tuning_page_states_are_those_of_its_code(capsys):
    first, second = blocks("theory/tuning.md", "python")
    text = read_page("theory/tuning.md")
    lines = [line for line in first.splitlines() if line.startswith(("import", "from", "stand"))]
    exec("\n".join(lines) + "\n" + second, {})
    assert capsys.readouterr().out.split() == ["pid_dob", "1.0", "pid", "1.53"]
    assert "is 1.00\nwith it and 1.53 without;" in text


def test_the_design_of_the_elastic_joint_tells_the_damping_better():
    space: dict = {}
    for code in blocks("evidence/elastic_joint.md", "python"):
        exec(re.sub(r"(?m)^print\(.*", "", code), space)
    ratio = space["design"].against((space["Chirp"](amplitude=0.5, f0_hz=0.1, f1_hz=10),)).ratio
    assert ratio["b_r"] > 2.2 and ratio["c_s"] > 1.2 and ratio["k_s"] < 0.5
