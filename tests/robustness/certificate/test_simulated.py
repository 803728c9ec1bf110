"""A certificate with its simulations: what fails is named, what cannot be had is said, and a file reads back."""

from __future__ import annotations

import json
import sys
from dataclasses import replace

import numpy as np
import pytest

import seaopt as so
from seaopt.codec import to_content
from seaopt.control import MPCSpec, force_mpc
from seaopt.control.running import closed_loop
from seaopt.errors import ControlError, FileError
from seaopt.files import to_json
from seaopt.reporting.sections import judge
from seaopt.reporting.sections.data import Commands
from seaopt.robustness import run_simulations, verify
from seaopt.robustness.verification import impedance_steps, large_signal, limit_cycles, scenarios, verification
from tests.laws import scaled
from tests.words import flatten

SPEC = so.ControllerSpec(bandwidth_hz=30, max_sensitivity=1.6, max_noise_gain=25, current_limit_A=9.0)
CELL = so.Sensors(noise_std={"F1": 1.0}, quantisation={"F1": 0.5})


@pytest.fixture(scope="module")
def controller(stand, swing, thor):
    return so.tune(stand, thor, SPEC, robust_to={"swing": swing, "light": (swing, thor.update(I_p=0.3))})


@pytest.fixture(scope="module")
def linear(controller, stand, swing, thor):
    plants = {"stand": stand, "swing": swing}
    return so.certify(controller, plants, thor, ranges={"I_p": (0.3, 0.5)}, samples=50, simulations=False)


@pytest.fixture(scope="module")
def certificate(linear):
    return linear.with_simulation(sensors=CELL, command_step=0.01, seed=4)


def test_every_plant_and_the_worst_draw_are_played(certificate, linear):
    assert certificate.passed
    rows = certificate.simulated.verification.rows
    assert {(row.plant, row.draw) for row in rows} == {("stand", "nominal"), ("swing", "nominal"), ("swing", "1")}
    assert next(row for row in rows if row.plant == "swing" and row.draw == "1").parameters == pytest.approx(
        linear.worst["swing"].parameters
    )
    named = {item.where for item in certificate.requirements if item.name == "simulation_failures"}
    assert named == {"stand: 7 runs", "swing: 20 runs"}


def test_large_signals_are_swept_on_every_plant(certificate, controller, swing, thor):
    """On the swing too: small ones reach as far as the linear loop follows, large ones less far."""
    stand, found = certificate.simulated.large_signal
    assert (stand.plant, found.plant) == ("stand", "swing")
    f = np.linspace(20.0, 60.0, 4001)
    follows = f[np.abs(controller.close(swing, thor).tracking(f)) >= np.sqrt(0.5)]
    assert found.bandwidth_hz[0] == pytest.approx(follows[-1], rel=0.02)
    assert found.bandwidth_hz[0] > found.bandwidth_hz[3] > found.bandwidth_hz[4]
    assert not found.saturated[0].any() and found.saturated[4].any()
    written = certificate.to_dict()["simulation"]["large_signal"]
    assert [item["plant"] for item in written] == ["stand", "swing"]
    assert "bandwidth on swing" in flatten(repr(certificate))


def test_simulations_print_every_part(certificate):
    """Runs, sweeps of every plant, the port and its environments, each in a section; of a sweep a row per amplitude."""
    text, simulated = repr(certificate.simulated), certificate.simulated
    assert text.startswith("met      Simulation: 27 runs passed")
    for title in ("Simulated runs", "Bandwidth against amplitude on swing", "Passivity at link 2", "Coupled stability"):
        assert text.count(f"\n{title}") == 1
    sweep = repr(simulated.large_signal[1])
    assert sweep in text and all(f"  {amplitude:.4g}  " in sweep for amplitude in simulated.large_signal[1].amplitude_N)
    assert f"{np.count_nonzero(simulated.environments.stable[0])}" in repr(simulated.environments)
    missing = replace(simulated, passivity=None, left_out={"passivity": "there is no port"})
    assert "note     no passivity: there is no port" in repr(missing)


def test_the_certificate_without_is_as_it_was(linear):
    assert linear.simulated is None
    assert (linear.to_dict()["simulation"], linear.to_dict()["passivity"]) == (None, None)


def test_simulating_again_replaces(certificate, linear):
    again = certificate.with_simulation(seed=5)
    assert len(again.requirements) == len(certificate.requirements) == len(linear.requirements)
    kept = [row.where for row in linear.requirements if row.name == "simulation_failures"]
    assert kept == ["stand: 4 runs", "swing: 8 runs"]  # the steps, which every certificate has


def refuse_to_simulate(*args, **keywords):
    raise AssertionError("reading a result must not simulate")


@pytest.fixture
def no_simulation(monkeypatch):
    for module, names in (
        (scenarios, ("run_loop",)), (verification, ("play",)), (limit_cycles, ("run_loop",)),
        (impedance_steps, ("play",)), (large_signal, ("run_loop",)),
    ):  # fmt: skip
        for name in names:
            monkeypatch.setattr(module, name, refuse_to_simulate)


def test_robustness_json_reads_back(certificate, controller, stand, swing, thor, no_simulation):
    content = json.loads(to_json(certificate.to_dict()))
    assert content["passivity"]["environments"]["fixed_stable"] is True
    assert content["simulation"]["sensors"]["quantisation"] == {"F1": 0.5}
    read = so.Certificate.from_dict(content, controller, {"stand": stand, "swing": swing}, thor)
    again = json.loads(to_json(read.to_dict()))
    assert again["simulation"] == content["simulation"] and again["steps"] == content["steps"]
    assert again["passivity"] == content["passivity"]
    del content["simulation"]["sensors"]
    with pytest.raises(FileError, match="certify again"):
        so.Certificate.from_dict(content, controller, {"stand": stand, "swing": swing}, thor)


def test_a_run_that_fails_is_a_requirement_with_its_witness(controller, stand, thor):
    """At 11 times the gain the limit of 9 A holds the loop in a limit cycle near 84 Hz (verification.md)."""
    wild = replace(controller, law=scaled(controller.law, 12.0))
    found = so.certify(wild, {"stand": stand}, thor, simulations=False).with_simulation(seed=3)
    (failed,) = [item for item in found.requirements if item.name == "simulation_failures"]
    assert (failed.met, failed.value, failed.limit) == (False, 7.0, 0.0)  # the same failure in every run, once
    assert failed.plant == "stand" and "draw nominal, seed 3: unstable" in failed.where
    assert failed.cause == "unstable" and "(the loop is unstable in its last phase)" in " ".join(repr(found).split())
    assert failed.cause == json.loads(to_json(to_content(failed)))["cause"]
    assert not any("e-" in row.where and "allowed" in row.where for row in found.requirements)
    assert repr(found).startswith("not met") and "simulation_failures 7, limit ≤ 0" in repr(found)


def test_what_cannot_be_had_is_said(stand, thor):
    unlimited = so.tune(stand, thor, so.ControllerSpec(bandwidth_hz=30))
    found = run_simulations(unlimited, {"stand": stand}, thor)
    assert found.large_signal == ()
    assert "current_limit_A" in found.left_out["large signals"]
    closed = replace(unlimited, design=(replace(stand, ports=()), thor))
    found = run_simulations(closed, {"stand": stand}, thor)
    assert found.passivity_dict() is None
    assert "no port at link 2" in found.left_out["passivity"]
    assert "no port at link 2" in found.simulation_dict()["left_out"]["environments"]
    assert found.unchecked == ()  # none of them applies


@pytest.mark.slow
def test_a_plant_that_cannot_be_simulated_has_not_passed(controller, linear, stand, thor, monkeypatch):
    monkeypatch.setattr(closed_loop, "MAX_LOOP_SUBSTEPS", 16)  # with 512 it is refused as well, 15 s later
    stand = replace(stand, friction={"F_f": replace(stand.friction["F_f"], jump=None)})  # a curve is all there is
    stuck = replace(linear, parameters=thor.update(f_c=500.0, v_s=1e-9), models={"stand": stand}, worst={})
    found = stuck.with_simulation()
    (row,) = [item for item in found.requirements if item.name == "simulation_failures"]
    assert not row.met and row.cause == "not simulated"
    assert (row.plant, row.draw.number) == ("stand", "nominal") and row.scenario
    assert "smooth the friction" in row.where and f"stand, {row.scenario}, draw nominal" in row.where
    assert found.simulated.verification is None
    assert found.simulated.simulation_dict()["passed"] is False


@pytest.mark.parametrize("kind", ["noise_std", "offset", "quantisation", "saturation"])
def test_a_sensor_of_nothing_that_is_read_is_refused(controller, linear, stand, thor, kind):
    """Its errors would be in no run, and the certificate would count them."""
    wrong = so.Sensors(**{kind: {"F_1": 500.0}})
    mpc = force_mpc(stand, thor, MPCSpec(current_limit_A=9.0, bandwidth_hz=20))
    for certify in (
        lambda: so.certify(controller, {"stand": stand}, thor, sensors=wrong),
        lambda: linear.with_simulation(sensors=wrong),
        lambda: verify(controller, {"stand": stand}, thor, sensors=wrong),
        lambda: so.certify(mpc, {"stand": stand}, thor, sensors=wrong),
    ):
        with pytest.raises(ControlError, match=f'{kind} of "F_1".*F1'):
            certify()


def test_a_controller_without_its_design_plant_is_refused(controller, stand, thor):
    with pytest.raises(ControlError, match="design plant"):
        run_simulations(replace(controller, design=None), {"stand": stand}, thor)


def test_what_breaks_is_said_and_the_rest_is_had(controller, stand, thor, monkeypatch):
    def broken(*_, **__):
        raise np.linalg.LinAlgError("Singular matrix")

    module = sys.modules["seaopt.robustness.certificate.simulated"]  # the package's name of it is the function
    monkeypatch.setattr(module, "passivity", broken)
    monkeypatch.setattr(module, "large_signal", broken)
    monkeypatch.setattr(module, "verify", lambda *_, **__: None)
    found = run_simulations(controller, {"stand": stand}, thor)
    assert "Singular matrix" in found.left_out["passivity"]
    assert found.passivity_dict() is None
    assert set(found.left_out) == {"passivity", "large signals on stand"}
    assert found.environments is not None
    assert set(found.unchecked) == set(found.left_out)


def test_what_applies_and_could_not_be_checked_stands_beside_the_verdict(
    controller, stand, thor, monkeypatch, tmp_path
):
    """It was a note below a certificate that is met, as of a plant to which it does not apply."""

    def broken(*_, **__):
        raise np.linalg.LinAlgError("Singular matrix")

    monkeypatch.setattr(sys.modules["seaopt.robustness.certificate.simulated"], "large_signal", broken)
    found = so.certify(controller, {"stand": stand}, thor, samples=5)
    verdict = judge(found, Commands())
    assert verdict.met and verdict.text.endswith("large signals on stand NOT CHECKED")
    assert "Singular matrix" in str(verdict.reasons[-1]) and flatten(repr(found)).count("Singular matrix") == 1
    content = json.loads(to_json(found.to_dict()))
    assert "Singular matrix" in content["unchecked"]["large signals on stand"]
    assert content["simulation"]["unchecked"] == ["large signals on stand"]
    page = so.write_report([controller, found], tmp_path / "report.html").read_text()
    assert "not checked" in page and "NOT CHECKED" in page
    again = so.Certificate.from_dict(content, controller, {"stand": stand}, thor)
    assert again.unchecked == found.unchecked
