"""What is promised of the Python door, line by line as users write it, on a log in a CSV file."""

from __future__ import annotations

import subprocess
import sys
from types import SimpleNamespace

import control
import numpy as np
import pytest
import scipy.signal
from matplotlib.figure import Figure

import seaopt as so

PATH = """
import seaopt as so
plant  = so.plants.high_impedance(drive="unlumped", spring="link1")
params = so.plants.thor().update(J=2e-6).free("J", "b_r", "eta")
log    = so.read_log("chirp.csv", time="time [s]", channels={"I": "current [A]", "F1": "F1 [N]", "F2": "F2 [N]"})
exp    = so.Experiment(plant=plant, log=log, sigma={"F1": 2.0})
fit    = so.fit([exp], params)
ctl    = so.tune(plant, fit.parameters, so.ControllerSpec(measured="F1", bandwidth_hz=30, max_sensitivity=1.6))
cert   = so.certify(ctl, {"swing": so.plants.moving_output()}, fit, samples=1375)
log2   = so.Log.from_arrays(time=t, I=i, F1=f)
score  = fit.predict(other_experiment)
ss     = plant.linearize(params)
run    = so.simulate(plant, params, log)
so.testing.assert_recovered(fit, truth, sigmas=4)
"""
REPORT = """
so.write_report([fit, ctl, cert], "out/report.html")
"""
KINDS = """
import seaopt as so
so.plants.moving_output(drive="lumped"); so.plants.rotary(link="free")
so.plants.two_link(link1="mass", link2="pendulum")
"""


@pytest.fixture(scope="module")
def named(tmp_path_factory, short_log, stand, thor):
    """Return every name that the path leaves, in a folder with chirp.csv."""
    folder = tmp_path_factory.mktemp("surface")
    rows = np.column_stack([short_log.time, *(short_log[name] for name in ("I", "F1", "F2"))])
    np.savetxt(folder / "chirp.csv", rows, delimiter=",", header="time [s],current [A],F1 [N],F2 [N]", comments="")
    t, i = np.arange(4000) / 400, np.sin(np.arange(4000) / 9)
    drive = so.Log.from_arrays(time=t, I=i)
    f = so.simulate(stand, thor, drive)["F1"] + 2 * np.random.default_rng(5).normal(size=t.size) + 7.0
    other = so.Experiment(plant=stand, log=so.Log.from_arrays(time=t, I=i, F1=f), name="other")
    space = {"t": t, "i": i, "f": f, "other_experiment": other, "truth": thor}
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        exec(PATH, space)
    return SimpleNamespace(**{name: value for name, value in space.items() if not name.startswith("_")})


def test_importing_is_clean_and_loads_nothing_heavy():
    heavy = ("numpy", "casadi", "pydantic", "matplotlib", "scipy", "polars")
    code = f"import sys, seaopt; print([name for name in {heavy} if name in sys.modules])"
    found = subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "[]"


def test_no_name_loads_what_takes_half_a_second():
    heavy = ("scipy.signal", "scipy.stats", "scipy.optimize", "matplotlib")
    code = f"import sys, seaopt as so; [getattr(so, n) for n in so.__all__]; print([*filter(sys.modules.get, {heavy})])"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "[]"


def test_a_judged_fit_does_without_scipy():
    """Which takes longer to load than such a fit takes."""
    code = (
        "import sys, numpy as np, seaopt as so\n"
        "from seaopt.bench import PAPER_STAND, Sensors, virtual_log\n"
        "plant, truth = so.plants.high_impedance(), so.plants.thor()\n"
        "log = virtual_log(plant, truth, PAPER_STAND, duration_s=6, rate_hz=400, seed=1,\n"
        "                  sensors=Sensors(noise_std={'F1': 2.0, 'F2': 2.0}))\n"
        "experiment = so.Experiment(plant=plant, log=log, outputs=('F1', 'F2'))\n"
        "print(so.fit([experiment], truth.update(J=2e-6).free('J', 'b_r')).met, 'scipy' in sys.modules)"
    )
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.split() == ["True", "False"]


def test_the_fit_says_what_it_found(named):
    fit = named.fit
    assert fit.met and fit.status == "converged" and fit.identifiability.rank == 3
    assert set(fit.covariance.names) == {"J", "b_r", "eta"} and set(fit.outputs) == {"experiment"}
    assert abs(fit.parameters["J"].value - 3.31e-6) < 4 * fit.parameters["J"].std


def test_the_controller_is_certified_with_its_simulations(named):
    assert named.ctl.feasible and named.ctl.achieved.ms <= 1.6 * (1 + 1e-6)
    assert named.cert.simulated.verification is not None and "design" in named.cert.plants
    assert named.cert.monte_carlo.samples == 1375


def test_the_report_is_written(named, tmp_path, monkeypatch, without_drawing):
    monkeypatch.chdir(tmp_path)
    exec(REPORT, vars(named))
    assert (tmp_path / "out" / "report.html").stat().st_size > 10_000


def test_another_log_is_predicted_from_its_own_start_and_offset(named):
    """Fit percent computed here from the outputs; the noise is 2 N and the offset of that log 7 N."""
    score, f = named.score, named.f
    expected = 100 * (1 - np.linalg.norm(f - score.model["F1"]) / np.linalg.norm(f - np.mean(f)))
    assert score.fit_percent["F1"] == pytest.approx(expected, rel=1e-9)
    assert score.rms_residual["F1"] == pytest.approx(2.0, rel=0.1)
    assert score.own.offset["F1"] == pytest.approx(7.0, abs=0.2)
    assert "other" in repr(score)


def test_plants_controllers_and_loops_become_control_systems(named):
    """The loop closed here by hand: zero-order hold by scipy, F/F_ref = P C_r/(1 + P C_y)."""
    assert list(named.ss.input_labels) == ["I"] and "F1" in named.ss.output_labels
    law, values = named.ctl.to_control(), named.fit.parameters
    period, row = named.ctl.sample_time_s, list(named.plant.outputs).index("F1")
    ss = named.plant.linearize(values)
    held = scipy.signal.cont2discrete((ss.A, ss.B, ss.C[[row]], ss.D[[row]]), period)
    z = np.exp(2j * np.pi * np.array([0.5, 5.0, 30.0, 200.0]) * period)
    effort = named.ctl.command.per_effort
    plant = control.StateSpace(*held[:4], period)
    p = np.array([effort * plant(at) for at in z]) * z**-named.ctl.compute_delay_samples
    reference, measured = (np.array([law(at)[0, column] for at in z]) for column in (0, 1))
    loop = named.ctl.close(named.plant, values).to_control()
    found = np.array([loop(at)[0, 1] for at in z])
    np.testing.assert_allclose(found, p * reference / (1 - p * measured), rtol=1e-6)
    assert loop.dt == period and np.max(np.abs(loop.poles())) < 1


def test_the_other_kinds_are_made_as_they_are_written():
    exec(KINDS, {})


def test_every_object_prints_itself(named):
    for value in (named.plant, named.params, named.log, named.log2, named.fit, named.ctl, named.cert, named.run):
        assert len(str(value)) < 20_000 and "object at 0x" not in str(value)
        assert callable(value._repr_html_)  # with its figures, which take their time


@pytest.mark.parametrize("name", ["fit", "log", "score", "ctl", "cert"])
def test_results_plot_themselves(named, name):
    figure = getattr(named, name).plot()
    assert isinstance(figure, Figure) and figure.axes


def test_single_figures_have_names(named):
    for name in ("step", "bode"):
        assert getattr(named.ctl.plot, name)() is not None
        assert name in dir(named.ctl.plot)
