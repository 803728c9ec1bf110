"""Arguments of a wrong type are refused as any other bad input is: by a SeaoptError of one line."""

from __future__ import annotations

import subprocess
import sys
from functools import cache
from pathlib import Path

import numpy as np

import seaopt as so
from seaopt.control import MPCSpec, PlausibilityGate, force_mpc, runnable
from seaopt.errors import SeaoptError
from seaopt.logs import assess_quality
from seaopt.plants.plant import fill_vector
from seaopt.robustness import tune_certified

ROOT = Path(__file__).parents[1]
T = np.arange(20) / 100
LOG = so.Log.from_arrays(time=T, I=np.sin(T), F1=np.cos(T))
NOISE = np.random.default_rng(0).normal(size=(2, 900))
LONG = so.Log.from_arrays(time=np.arange(900) / 100, I=NOISE[0], F1=NOISE[1])
PLANT, THOR = so.plants.high_impedance(), so.plants.thor()

GATE = {"range_N": (-1.0, 1.0), "max_step_N": 1.0, "max_held": 1, "ramp_per_s": 1.0}
SPEC = so.ControllerSpec(bandwidth_hz=30)
STILL = so.Plant(
    name="still", states={}, inputs={"I": "A"}, outputs={"F1": "N"},
    parameters={"gain": so.Parameter(name="gain", value=1.0, unit="N/A")},
    f=lambda t, x, u, p: {}, h=lambda t, x, u, p: {"F1": p.gain * u.I},
)  # fmt: skip


@cache
def tuned():
    return so.tune(PLANT, THOR, SPEC)


def experiment(**changes):
    return so.Experiment(**{"plant": PLANT, "log": LOG, **changes})


CASES = {
    "older order": lambda: so.assess(PLANT, THOR, tuned().law, SPEC),
    "complex channel": lambda: so.Log.from_arrays(time=[0, 1], I=[1j, 2]),
    "masked channel": lambda: so.Log.from_arrays(time=[0, 1], I=np.ma.array([1, 2], mask=[0, 1])),
    "units": lambda: so.Log.from_arrays(time=[0, 1], I=[1, 2], units={"I": 3}),
    "channel": lambda: LOG[3],
    "between": lambda: LOG.between("a", "b"),
    "resample": lambda: LOG.resample(rate_hz="x"),
    "bridge": lambda: LOG.resample(rate_hz=100, bridge_s=float("nan")),
    "path": lambda: so.read_log(None),
    "paths": lambda: so.read_log([3]),
    "column": lambda: so.Column(column=None),
    "scale": lambda: so.Column(column="I", scale="x"),
    "unit": lambda: so.Column(column="I", unit=3),
    "where": lambda: so.Column(column="I", where="x"),
    "plant": lambda: experiment(plant=None),
    "log": lambda: experiment(log="x.csv"),
    "name": lambda: experiment(name=3),
    "outputs": lambda: experiment(outputs=3),
    "outputs in lists": lambda: experiment(outputs=[["F1"]]),
    "outputs twice": lambda: experiment(outputs=("F1", "F1")),
    "sigma": lambda: experiment(sigma={"F1": "x"}),
    "offset": lambda: experiment(offset={"F1": "x"}),
    "gain": lambda: experiment(gain={"F1": "x"}),
    "initial state": lambda: experiment(initial_state=3),
    "drift": lambda: experiment(drift="x"),
    "saturation": lambda: experiment(saturation={"F1": ("a", "b")}),
    "delay of nan": lambda: experiment(delay_s=float("nan")),
    "delay": lambda: experiment(delay_s="x"),
    "hold": lambda: experiment(hold="second"),
    "value": lambda: THOR.update(J="x"),
    "no value": lambda: THOR.update(J=None),
    "parameter": lambda: THOR[3],
    "free": lambda: THOR.free(3),
    "set": lambda: so.ParameterSet(["x"]),
    "complex parameter": lambda: so.Parameter(name="a", value=1j, unit="m"),
    "bound": lambda: so.Parameter(name="a", value=1.0, unit="m", min="x"),
    **{
        f"gate {name} = {value!r}": lambda name=name, value=value: PlausibilityGate(**{**GATE, name: value})
        for name, values in {
            "range_N": (5.0, None, "ab", (1.0,), ("a", "b"), (0.0, True)),
            "max_step_N": ("1", None, True),
            "ramp_per_s": ("1", None, 1j),
            "max_held": (2.5, 2.0, float("nan"), float("inf"), "2", None, True),
        }.items()
        for value in values
    },
    "gate of no controller": lambda: PlausibilityGate.of_controller(None, range_N=(-1.0, 1.0)),
    "parameters": lambda: PLANT.linearize(None),
    "state": lambda: fill_vector("state", {"q": "m"}, {"q": "x"}),
    "simulated plant": lambda: so.simulate(None, THOR, LOG),
    "simulated log": lambda: so.simulate(PLANT, THOR, None),
    "simulated delay": lambda: so.simulate(PLANT, THOR, LOG, delay_s="x"),
    "problem": lambda: so.read_problem(None),
    "experiments as text": lambda: so.fit("ab", THOR),
    "experiments of text": lambda: so.fit(["ab"], THOR),
    "no experiments": lambda: so.fit(None, THOR),
    "start that is no fit": lambda: so.fit([experiment(log=LONG)], THOR, start=THOR),
    "experiment of a plant without states": lambda: so.fit([experiment(plant=STILL)], so.ParameterSet()),
    "tuned plant": lambda: so.tune(None, THOR, SPEC),
    "tuned spec": lambda: so.tune(PLANT, THOR, None),
    "tuned parameters": lambda: so.tune(PLANT, None, SPEC),
    "tuned for no plant": lambda: so.tune(PLANT, THOR, SPEC, robust_to={"other": None}),
    "tuned at no draws": lambda: so.tune(PLANT, THOR, SPEC, draws=3),
    "tuned without states": lambda: so.tune(STILL, so.ParameterSet(), SPEC),
    "tuned for a plant without states": lambda: so.tune(PLANT, THOR, SPEC, robust_to={"still": STILL}),
    "tuned at a number": lambda: so.tune(PLANT, THOR, SPEC, draws=[3]),
    "tuned at a text": lambda: so.tune(PLANT, THOR, SPEC, draws=[{"J": "x"}]),
    "tuned for half a pair": lambda: so.tune(PLANT, THOR, SPEC, robust_to={"other": (PLANT,)}),
    "swept bandwidths": lambda: so.control.sweep(PLANT, THOR, SPEC, None),
    "swept bandwidth": lambda: so.control.sweep(PLANT, THOR, SPEC, [None]),
    "run with no gate": lambda: runnable(tuned(), gate="x"),
    "run with a limit": lambda: runnable(tuned(), command_limit="x"),
    **{
        f"reset at {name} = 'x'": lambda name=name: runnable(tuned(), gate=PlausibilityGate(**GATE)).reset(
            **{name: "x"}
        )
        for name in ("reference", "measurement", "command")
    },
    "swept plant": lambda: so.control.sweep(None, THOR, SPEC, [20.0]),
    "swept spec": lambda: so.control.sweep(PLANT, THOR, None, [20.0]),
    "predictive plant": lambda: force_mpc(None, THOR, MPCSpec(current_limit_A=9.0)),
    "predictive plant without states": lambda: force_mpc(STILL, so.ParameterSet(), MPCSpec(current_limit_A=9.0)),
    "predictive parameters": lambda: force_mpc(PLANT, None, MPCSpec(current_limit_A=9.0)),
    "predictive spec": lambda: force_mpc(PLANT, THOR, SPEC),
    "predictive gate": lambda: force_mpc(PLANT, THOR, MPCSpec(current_limit_A=9.0), gate="x"),
    "predictive noise": lambda: MPCSpec(current_limit_A=9.0, noise="x"),
    "certified controller": lambda: so.certify(None, {"stand": PLANT}, THOR),
    "certified plants": lambda: so.certify(tuned(), None, THOR),
    "certified plant": lambda: so.certify(tuned(), {"stand": None}, THOR),
    "certified parameters": lambda: so.certify(tuned(), {"stand": PLANT}, None),
    **{
        f"certified with {name} = {value!r}": lambda name=name, value=value: so.certify(
            tuned(), {"stand": PLANT}, THOR, samples=5, **{name: value}
        )
        for name, value in {
            "min_friction_margin": "5",
            "confidence": "a",
            "max_failure_probability": "a",
            "others": 3,
            "bounds": 3,
            "ranges": 3,
        }.items()
    },
    **{
        f"tuned and certified with {name} = {value!r}": lambda name=name, value=value: tune_certified(
            **{"plant": PLANT, "parameters": THOR, "spec": SPEC, "plants": {"stand": PLANT}, name: value}
        )
        for name, value in {"plant": None, "plants": None, "rounds": "a", "confidence": "a", "others": 3}.items()
    },
    "certified without states": lambda: so.certify(tuned(), {"still": STILL}, THOR),
    "report": lambda: so.write_report(None, "report.html"),
    "report of nothing": lambda: so.write_report([None], "report.html"),
    "report of one": lambda: so.write_report(tuned(), "report.html"),
    "report of others besides": lambda: so.write_report([tuned(), "junk", 42], "report.html"),
    "report's title": lambda: so.write_report([tuned()], "report.html", title=None),
    "recovery of no fit": lambda: so.testing.assert_recovered("fit", THOR),
    "prediction of no fit": lambda: so.testing.assert_predicts("fit", experiment(), 95),
    "certificate that is none": lambda: so.testing.assert_certified("certificate"),
    "report's page": lambda: so.write_report([tuned()], None),
    "quality": lambda: assess_quality(None),
}
# With what the error says, which is what to write.
SAID = {
    "sigma = 2.0": lambda: experiment(sigma=2.0),
    "list of experiments": lambda: so.fit(experiment(log=LONG), THOR.free("J")),
    "put them in brackets": lambda: so.compare(
        so.fit([experiment(log=LONG)], THOR.free("J"), method=so.OutputError(search=False))
    ),
    "bandwidth_hz = '30'": lambda: so.ControllerSpec(bandwidth_hz="30"),
    "delay_samples = 1.0": lambda: so.ControllerSpec(compute_delay_samples=1.0),
    "robust_to is a list": lambda: so.tune(PLANT, THOR, SPEC, ["swing"]),
}
# Lists in the places of tuples: what is meant is clear.
TAKEN = {
    "outputs in a list": lambda: experiment(outputs=["F1"]),
    "band in a list": lambda: so.fit([experiment(log=LONG, outputs=["F1"])], THOR.free("J"), band_hz=[1, 40]),
}


def list_bare_errors():
    """Return the cases that do not end in a SeaoptError of one line, and what should be taken and is not."""
    bare = []
    for name, case in TAKEN.items():
        try:
            case()
        except Exception as error:
            bare.append(f"{name}: {error!r}")
    for name, case in (CASES | SAID).items():
        try:
            case()
        except SeaoptError as error:
            bare += [name] if "\n" in str(error) or (name in SAID and name not in str(error)) else []
        except Exception as error:
            bare.append(f"{name}: {error!r}")
        else:
            bare.append(f"{name}: taken")
    return bare


def test_a_wrong_type_is_a_seaopt_error():
    """In a process of its own: the tests' checks of types would see it first."""
    code = "import tests.test_wrong_types as cases; print(cases.list_bare_errors())"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, cwd=ROOT)
    assert (done.returncode, done.stdout) == (0, "[]\n"), done.stderr
