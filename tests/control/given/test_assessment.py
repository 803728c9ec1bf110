"""Laws of one's own: against difference equations, python-control and dense matrices, and through every later stage."""

from __future__ import annotations

import json

import control
import numpy as np
import pytest

import seaopt as so
from seaopt.control import Law, assess, command_of, drive_pid, ideal_pid, parallel_pid, read_law
from seaopt.errors import ControlError, FileError
from seaopt.robustness.certificate.simulated import STEPS
from tests.c_code import CompiledLaw
from tests.checks import leave_out
from tests.laws import law_of

TS = 1e-3
SPEC = so.ControllerSpec(bandwidth_hz=20, max_sensitivity=1.8, max_noise_gain=40.0)


def run_law(law, r, y):
    x, out = np.zeros(law.c.size), []
    for sample in np.stack([r, y], axis=1):
        out.append(law.c @ x + law.d @ sample)
        x = law.a @ x + law.b @ sample
    return np.array(out)


@pytest.fixture
def signals():
    rng = np.random.default_rng(4)
    return np.cumsum(rng.normal(size=300)), np.cumsum(rng.normal(size=300))


@pytest.mark.parametrize("integral", ["trapezoid", "backward", "forward"])
@pytest.mark.parametrize(("b", "c", "ahead", "T_f"), [(1.0, 1.0, 0.0, 2e-3), (0.4, 0.0, 1.0, 0.0)])
def test_the_parallel_form_is_its_difference_equation(signals, integral, b, c, ahead, T_f):
    k_p, k_i, k_d = 1.7, 42.0, 0.03
    law = parallel_pid(k_p=k_p, k_i=k_i, k_d=k_d, T_f=T_f, sample_time_s=TS, b=b, c=c, feedforward=ahead,
                       integral=integral)  # fmt: skip
    total, rate, error_before, moved_before, out = 0.0, 0.0, 0.0, 0.0, []
    for r, y in zip(*signals, strict=True):
        error, moved = r - y, c * r - y
        summed = {"trapezoid": 0.5 * (error + error_before), "backward": error, "forward": error_before}[integral]
        total += k_i * TS * summed
        rate = (T_f * rate + k_d * (moved - moved_before)) / (T_f + TS)
        out.append(k_p * (b * r - y) + total + rate + ahead * r)
        error_before, moved_before = error, moved
    np.testing.assert_allclose(run_law(law, *signals), out, atol=1e-9 * np.max(np.abs(out)))


def test_the_other_forms_are_the_parallel_one(signals):
    parallel = parallel_pid(k_p=2.0, k_i=2.0 / 0.05, k_d=2.0 * 0.01, T_f=1e-3, sample_time_s=TS)
    ideal = ideal_pid(K=2.0, T_i=0.05, T_d=0.01, N=10.0, sample_time_s=TS)
    drive = drive_pid(per_effort=4e-3, k_p=8e-3, k_i=0.16, k_d=8e-5, T_f=1e-3, sample_time_s=TS)
    for law in (ideal, drive):
        np.testing.assert_allclose(run_law(law, *signals), run_law(parallel, *signals), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("integrators", [0, 1, 2])
@pytest.mark.parametrize("seed", range(4))
def test_integrators_are_found_in_any_coordinates(integrators, seed):
    rng = np.random.default_rng(10 * seed + integrators)
    slow = rng.normal(size=(4, 4))
    slow *= rng.uniform(0.3, 0.999) / np.max(np.abs(np.linalg.eigvals(slow)))
    a = np.zeros((4 + integrators,) * 2)
    a[:integrators, :integrators] = np.eye(integrators) + np.eye(integrators, k=1)
    a[integrators:, integrators:] = slow
    b, c, d = rng.normal(size=(a.shape[0], 2)), rng.normal(size=a.shape[0]), rng.normal(size=2)
    turn = np.linalg.qr(rng.normal(size=a.shape))[0] @ np.diag(rng.uniform(0.3, 3.0, size=a.shape[0]))
    law = Law.from_state_space(turn @ a @ np.linalg.inv(turn), turn @ b, c @ np.linalg.inv(turn), d, TS)
    assert law.integrators == integrators
    f = np.geomspace(0.05, 490.0, 40)
    z = np.exp(2j * np.pi * f * TS)
    wanted = np.array([c @ np.linalg.solve(point * np.eye(a.shape[0]) - a, b) + d for point in z]).T
    np.testing.assert_allclose(law.responses(f), wanted, rtol=1e-5)


def test_a_slow_lag_is_no_integrator():
    """A pole of 1 000 s beside an integrator: distances from 1 of 1e-6 and of rounding."""
    a, b = np.array([[1.0, 0.3], [0.0, 1.0 - 1e-6]]), np.array([[0.2, -0.2], [1.0, -1.0]])
    law = Law.from_state_space(a, b, np.array([1.0, 0.5]), np.zeros(2), TS)
    assert law.integrators == 1
    assert np.min(np.abs(np.linalg.eigvals(law.remainder[0]) - (1.0 - 1e-6))) < 1e-12


def test_python_control_laws_are_taken_as_they_are():
    f = np.geomspace(0.1, 490.0, 30)
    z = np.exp(2j * np.pi * f * TS)
    error = control.tf([2.0, -1.7], [1.0, -1.0], TS) * control.tf([0.3], [1.0, -0.7], TS)
    for system in (error, control.ss(error)):
        law = Law.from_control(system)
        np.testing.assert_allclose(law.responses(f), [error(z), -error(z)], rtol=1e-9)
        assert law.integrators == 1
        assert law.b[0, 0] == -law.b[0, 1]
    two = control.tf([[[1.0, -0.4], [-2.0, 1.5]]], [[[1.0, -0.6], [1.0, -1.0]]], TS)
    law = Law.from_control(two)
    np.testing.assert_allclose(law.responses(f), [two[0, 0](z), two[0, 1](z)], rtol=1e-9)
    again = Law.from_control(law.to_control())
    np.testing.assert_allclose(again.responses(f), law.responses(f), rtol=1e-9)
    for wrong, words in (
        (control.tf([1.0], [1.0, 1.0]), "sample it first"),
        (control.tf([1.0, 0.0, 0.0], [1.0, -0.5], TS), "higher power of z"),
        (control.ss(-0.5 * np.eye(1), np.ones((1, 3)), np.ones((1, 1)), np.zeros((1, 3))), "sample it first"),
        ("2/(s + 1)", "python-control"),
    ):
        with pytest.raises(ControlError, match=words):
            Law.from_control(wrong)


def test_its_figures_are_those_of_python_control(stand, swing, thor):
    law = ideal_pid(K=2.0, T_i=0.05, T_d=0.01, N=10.0, feedforward=1.0, sample_time_s=TS)
    controller = assess(law, stand, thor, SPEC, {"swing": swing})
    per_effort = command_of(stand, thor, "F1").per_effort
    feedback = control.tf([1.0], [1.0, 0.0], TS) * -law.to_control()[0, 1]  # one sample of delay
    f = np.linspace(0.05, 250.0, 4000)
    z, peaks = np.exp(2j * np.pi * f * TS), {}
    for name, plant in (("design", stand), ("swing", swing)):
        model = plant.linearize(thor)
        held = control.sample_system(model[model.find_output("F1"), model.find_input("I")], TS) * per_effort
        loop = held(z) * feedback(z)
        peaks[name] = np.max(np.abs(1.0 / (1.0 + loop)))
    assert controller.achieved.ms == pytest.approx(peaks["design"], rel=1e-4)
    broken = {limit.name for limit in controller.binding}
    assert ("max_sensitivity" in broken) == (max(peaks.values()) > 1.8)
    assert not controller.feasible
    assert controller.structure == "custom"
    assert not controller.gains


def test_more_bandwidth_than_asked_is_enough(stand, thor):
    tuned = so.tune(stand, thor, SPEC)
    for asked, met in ((15.5, True), (20.0, True), (20.3, False)):
        spec = so.ControllerSpec(bandwidth_hz=asked, max_sensitivity=1.8, max_noise_gain=40.0)
        assert assess(tuned.law, stand, thor, spec).feasible == met
    with pytest.raises(ControlError, match=r"use seaopt\.assess"):
        so.tune(stand, thor, so.ControllerSpec(structure="custom"))
    with pytest.raises(ControlError, match="sample_rate_hz = 1000"):
        assess(tuned.law, stand, thor, so.ControllerSpec(bandwidth_hz=20, sample_rate_hz=2000.0))


def test_a_law_beyond_the_structures_is_certified_and_exported(stand, swing, thor, compiler, tmp_path, monkeypatch):
    """A pid through two lags, a notch and a lead: no structure of the tuner's has its like."""
    leave_out(monkeypatch, STEPS)
    pid = parallel_pid(k_p=1.2, k_i=30.0, k_d=0.012, T_f=2e-3, sample_time_s=TS, feedforward=1.0).to_control()
    shape = control.tf([0.6, -0.2], [1.0, -0.6], TS) * control.tf([1.0, -1.2, 0.75], [1.0, -0.9, 0.45], TS)
    law = Law.from_control(control.ss(shape) * pid)
    lifted = dict.fromkeys(("max_sensitivity", "max_complementary", "max_reference_peak", "max_droop_db"), False)
    spec = so.ControllerSpec(bandwidth_hz=5, bandwidth_range_hz=(1, 60), min_sensitivity_bandwidth_hz=False, **lifted)
    controller = assess(law, stand, thor, spec, {"swing": swing})
    stored = so.Controller.from_dict(json.loads(json.dumps(_plain(controller.to_dict()))), stand, thor)
    np.testing.assert_allclose(stored.law.a, controller.law.a)
    assert stored.feasible == controller.feasible
    certificate = so.certify(controller, {"swing": swing}, thor, samples=50, simulations=False)
    assert certificate.plants["design"].ms == pytest.approx(controller.achieved.ms)
    rng = np.random.default_rng(1)
    r, y = 300.0 * rng.normal(size=200), 300.0 * rng.normal(size=200)
    ran = CompiledLaw(compiler, tmp_path, controller, "double").run(r, y)
    np.testing.assert_allclose(ran, controller.command.per_effort * run_law(law, r, y), atol=1e-9)


def _plain(content):
    from seaopt.files import to_json

    return json.loads(to_json(content))


def test_the_law_comes_first_as_in_certify(stand, thor):
    law = ideal_pid(K=2.0, T_i=0.05, T_d=0.01, N=10.0, sample_time_s=1e-3)
    named = assess(spec=SPEC, params=thor, plant=stand, law=law)
    assert named.achieved == assess(law, stand, thor, SPEC).achieved


def test_a_stored_custom_law_has_no_gains(stand, thor):
    content = _plain(assess(law_of([1.0], [1.0, -0.5]), stand, thor, SPEC).to_dict())
    with pytest.raises(FileError, match="gains"):
        so.Controller.from_dict(content | {"gains": {"k_p": 1.0}}, stand, thor)


LAW_FILES = {
    "pid": "[pid]\nk_p = 1.5\nk_i = 30.0\nk_d = 0.01\nT_f = 0.002\nfeedforward = 1.0\n",
    "drive": 'output = "command"\n[pid]\nk_p = 0.006\nk_i = 0.12\nk_d = 4e-5\nT_f = 0.002\nfeedforward = 0.004\n',
    "fractions": "[reference]\nnum = [5.0, -3.0]\nden = [2.0, -2.0]\n"
    "[measurement]\nnum = [3.0, -1.0]\nden = [2.0, -2.0]\n",
    "space": "[law]\nA = [[1.0]]\nB = [[2.0, -2.0]]\nC = [[0.5]]\nD = [[2.5, -1.5]]\n",
}  # fmt: skip


def read_text(tmp_path, text, head="sample_rate_hz = 1000\ndelay_samples = 2\n"):
    path = tmp_path / "law.toml"
    path.write_text(head + text, encoding="utf-8")
    return read_law(path)


def test_files_say_the_same_law(tmp_path):
    f = np.geomspace(0.1, 400.0, 20)
    given = {name: read_text(tmp_path, text) for name, text in LAW_FILES.items()}
    np.testing.assert_allclose(given["space"].law.responses(f), given["fractions"].law.responses(f), rtol=1e-9)
    np.testing.assert_allclose(
        given["drive"].to_effort(4e-3).responses(f), given["pid"].to_effort(4e-3).responses(f), rtol=1e-9
    )
    assert {one.delays["delay_samples"] for one in given.values()} == {2}
    assert given["space"].law.integrators == 1


@pytest.mark.parametrize(
    ("head", "text", "words"),
    [
        ("sample_rate_hz = 1000\n", LAW_FILES["pid"], "should have compute_delay_samples"),
        ("delay_samples = 1\n", LAW_FILES["pid"], "sample_time_s"),
        ("sample_rate_hz = 1000\ndelay_sampels = 1\n", LAW_FILES["pid"], 'did you mean "delay_samples"'),
        (None, "", "pid"),
        (None, LAW_FILES["pid"] + LAW_FILES["space"], "pid"),
        (None, '[pid]\nform = "ideal"\nk_p = 1.0\n', "ideal form"),
        (None, LAW_FILES["pid"] + "[terms.friction]\nlevel = 1.0\n", "no terms"),
        (None, "[reference]\nnum = [1.0]\nden = [1.0]\n", "both of reference and measurement"),
        (None, "[law]\nA = [[1.0]]\nB = [[2.0]]\nC = [[0.5]]\nD = [[2.5, -1.5]]\n", "law: B is not a matrix of 1 x 2"),
        (None, "[law]\nA = [[nan]]\nB = [[1.0, 1.0]]\nC = [[0.5]]\nD = [[2.5, -1.5]]\n", "finite"),
        (None, LAW_FILES["space"] + LAW_FILES["fractions"].replace("3.0, -1.0", "3.0, -1.1"), "is not what law gives"),
        (
            None,
            "[reference]\nnum = [1.0]\nden = [0.0, 1.0]\n[measurement]\nnum = [1.0]\nden = [1.0]\n",
            "begins with 0",
        ),
        (None, "= 3", "not valid TOML"),
    ],
)
def test_files_that_are_no_law_are_refused(tmp_path, head, text, words):
    with pytest.raises(FileError, match=words):
        read_text(tmp_path, text, *([] if head is None else [head]))
