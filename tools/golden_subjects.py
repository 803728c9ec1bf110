"""What `golden.py` writes down: figures of problems, laws, schedules, draws and recoveries, by way of public names.

A subject returns what JSON can hold. It is made anew each time, in a folder of its own, from files of the repository
and seeds; what depends on the clock, the machine or the version is left out.
"""

from __future__ import annotations

import ctypes
import json
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

import seaopt as so
from seaopt.control import (
    CompensateFriction,
    CompensateGravity,
    CompensateRipple,
    Impedance,
    MPCSpec,
    Notch,
    SampledLoop,
    ScheduledController,
    add_compensation,
    add_impedance,
    force_mpc,
    run_loop,
    runnable,
    tune_schedule,
)
from seaopt.control.deploy.export import export
from seaopt.robustness.uncertainty.draws import combine_uncertainty

ROOT = Path(__file__).resolve().parents[1]
# Of a result: what the clock, the machine or the version say, and digests, which change with every key.
LEFT_OUT = {"provenance", "made_from", "digest", "wall_s", "real_time_factor", "version"}
SAMPLES, KEPT = 2000, 25  # of a law's run, and every how many of its commands are written down
UNUSED, RESET = (300, 301, 302, 900), 1200  # samples with a number that is none, and the one before which it is reset
PLACES = 25
NAN = float("nan")
STRICT = ["-std=c99", "-O2", "-ffp-contract=off", "-shared", "-fPIC"]

STAND, SWING, THOR = so.plants.high_impedance(), so.plants.moving_output(), so.plants.thor()
KNEE, HELD = so.plants.rotary(link="pendulum"), so.plants.rotary(link="locked")
KNEE_VALUES = KNEE.defaults.update(N=50.0, k_s=300.0, J_l=0.3, d_l=0.5, m=4.0, L=0.2, f_c=0.0)
SPEC = so.ControllerSpec(bandwidth_hz=30, max_sensitivity=1.6, max_noise_gain=25, current_limit_A=9.0)
OF_KNEE = so.ControllerSpec(measured="tau_s", bandwidth_hz=15, max_sensitivity=1.6, current_limit_A=8.0)


def run_problem(name: str, arguments: Sequence[str] = ()) -> dict[str, Any]:
    """Return exit code, results and what is said of a problem file that is run whole."""
    with tempfile.TemporaryDirectory() as folder:
        done = call("run", str(ROOT / "problems" / f"{name}.toml"), "-o", folder, *arguments)
        results = {path.stem: strip(json.loads(path.read_text())) for path in sorted(Path(folder).glob("*.json"))}
    said = done["stdout"].replace(folder, "OUT").replace(f"{ROOT}/", "")  # stderr tells times
    return {"exit": done["exit"], "stdout": said} | results


def call(*arguments: str) -> dict[str, Any]:
    """Return exit code and both streams of the command line."""
    command = [sys.executable, "-m", "seaopt", *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=ROOT)  # noqa: S603
    said = {"stdout": done.stdout.splitlines(), "stderr": done.stderr.splitlines()}
    return {"exit": done.returncode} | {name: " / ".join(lines) for name, lines in said.items()}


def strip(content: Any) -> Any:
    """Return a result without what depends on clock, machine and version."""
    if isinstance(content, dict):
        return {key: strip(value) for key, value in content.items() if key not in LEFT_OUT}
    return [strip(value) for value in content] if isinstance(content, list) else content


@cache
def make_laws() -> dict[str, so.Controller]:
    """Return a controller of each kind that runs from one state space."""
    tune = so.tune
    dry = THOR.update(f_c=100.0)
    slow = so.ControllerSpec(bandwidth_hz=20, max_sensitivity=1.6, current_limit_A=9.0)
    with_friction = tune(STAND, dry, slow)
    knee = tune(HELD, KNEE_VALUES, OF_KNEE)
    ripple = CompensateRipple(cycles=(1, 3), cos=(0.02, 0.01), sin=(0.0, 0.03), fraction=1.0)
    cascade = {"measured": ("tau_s", "thetad_m"), "structure": "cascade"}
    return {
        "pid": tune(STAND, THOR, SPEC, {"swing": SWING}),
        "pd": tune(STAND, THOR, change(SPEC, structure="pd")),
        "pid_dob": tune(STAND, THOR, change(SPEC, structure="pid_dob", bandwidth_hz=25)),
        "notch": tune(STAND, THOR, change(SPEC, notch=Notch())),
        "prefilter": tune(STAND, THOR, change(SPEC, prefilter="first_order")),
        "quiet": tune(STAND, THOR, change(SPEC, objective="noise")),
        "cascade": tune(HELD, KNEE_VALUES, change(OF_KNEE, **cascade)),
        "friction_by_reference": add_compensation(with_friction, friction=CompensateFriction(fraction=0.9)),
        "friction_by_speed": add_compensation(
            with_friction, friction=CompensateFriction(fraction=0.9, source="speed", speed=0.004)
        ),
        "gravity_and_ripple": add_compensation(
            knee, gravity=CompensateGravity(fraction=0.8), ripple=ripple, link=(KNEE, KNEE_VALUES)
        ),
        "impedance": add_impedance(knee, KNEE, KNEE_VALUES, Impedance(stiffness=20.0, damping=1.0), name="knee"),
    }


def change(spec: so.ControllerSpec, **changes: Any) -> so.ControllerSpec:
    """Return a specification with other values."""
    return replace(spec, **changes)


def run_law(name: str) -> dict[str, Any]:
    """Return gains and figures of a law, its commands in Python, and whether compiled C and the loop agree."""
    controller = make_laws()[name]
    law = runnable(controller)
    further = 0 if law.compensation is None else len(law.compensation.reads)
    references, readings = make_signals(1.2 * law.force_limit_N, law.measured, further)
    state, commands = law.reset(), np.zeros(SAMPLES)
    for k in range(SAMPLES):
        if k == RESET:
            state = law.reset()
        measured = readings[k, : law.measured]
        reading = float(measured[0]) if law.measured == 1 else measured
        commands[k], state = law.step(state, float(references[k]), reading, readings[k, law.measured :].tolist())
    limit = law.command_limit
    said = strip(controller.to_dict())
    return {
        "gains": said["gains"], "achieved": said["achieved"], "feasible": said["feasible"],
        "commands": commands[::KEPT], "total": float(np.sum(np.abs(commands))),
        "saturated": int(np.sum(np.abs(commands) >= limit)),
        "c_agrees": agrees(run_c(controller, references, readings), commands, limit),
        "step": run_step(controller), "recovery": find_recovery(controller),
    }  # fmt: skip


def make_signals(size: float, measured: int, further: int) -> tuple[np.ndarray, np.ndarray]:
    """Return references and readings that saturate a law about half of the time, some of them not numbers."""
    rng = np.random.default_rng(7)
    slow = np.cumsum(rng.normal(size=(SAMPLES, 1 + measured + further)), axis=0) / 15.0
    values = size * (slow - slow.mean(axis=0)) + 0.02 * size * rng.normal(size=slow.shape)
    values[:, 1] = values[:, 0] + 0.04 * size * rng.normal(size=SAMPLES)  # near the reference, or it winds up for good
    values[:, 2:] *= 1e-3 / size  # motion, in m and rad
    values[list(UNUSED), [0, 1, 1, 0]] = NAN
    return values[:, 0], values[:, 1:]


def agrees(found: np.ndarray | None, expected: np.ndarray, limit: float) -> Any:
    """Tell whether compiled C commands the same; as always where there is no compiler to ask."""
    return True if found is None else bool(np.max(np.abs(found - expected)) <= 1e-10 * limit)


def run_c(controller: Any, references: np.ndarray, readings: np.ndarray) -> np.ndarray | None:
    """Return the commands of exported C; None without a compiler."""
    compiler = shutil.which("gcc") or shutil.which("cc")
    if compiler is None:
        return None
    with tempfile.TemporaryDirectory() as folder:
        export(controller, folder, name="law", allow_infeasible=True)
        library = f"{folder}/law.so"
        subprocess.run([compiler, *STRICT, f"{folder}/law.c", "-o", library, "-lm"], check=True)  # noqa: S603
        code = ctypes.CDLL(library)
    inputs = [ctypes.c_double] * (1 + readings.shape[1])
    code.law_step.argtypes, code.law_step.restype = [ctypes.c_void_p, *inputs], ctypes.c_double
    memory, out = ctypes.create_string_buffer(8192), np.zeros(len(references))
    code.law_init(memory)
    for k, (reference, row) in enumerate(zip(references, readings, strict=True)):
        if k == RESET:
            code.law_init(memory)
        out[k] = code.law_step(memory, float(reference), *map(float, row))
    return out


def run_step(controller: so.Controller) -> dict[str, Any]:
    """Return a simulated step that saturates on the way, of the law's own design plant, in the compiled loop."""
    reference = np.zeros(1500)
    reference[50:700] = 0.8 * runnable(controller).force_limit_N
    run = simulate(controller, reference)
    regulated = controller.spec.regulated
    return {"force": run.outputs[regulated][0, ::KEPT], "command": run.current[0, ::KEPT], "peak": run.peaks[regulated]}


def find_recovery(controller: so.Controller) -> float:
    """Return how long the force takes from a reference out of reach, held for half a second, to 5 % around zero."""
    reach = runnable(controller).force_limit_N
    reference = np.zeros(4000)
    reference[100:600] = 3.0 * reach
    force = simulate(controller, reference).outputs[controller.spec.regulated][0]
    outside = np.flatnonzero(np.abs(force[600:]) > 0.05 * reach)
    return float(outside[-1] + 1 if outside.size else 0) * controller.sample_time_s


def simulate(controller: so.Controller, reference: np.ndarray) -> Any:
    """Return a run of the sampled loop on the design plant."""
    plant, values = controller.design
    loop = SampledLoop(plant=plant, law=runnable(controller), measured=controller.signals, delay_samples=1)
    return run_loop(loop, [values], reference)


def run_schedule() -> dict[str, Any]:
    """Return gains and commands of a schedule."""
    problem = so.read_problem(ROOT / "problems" / "lever_knee.toml")
    spec = so.ControllerSpec(measured="tau", bandwidth_hz=30, max_sensitivity=1.6, reserve=0.03, current_limit_A=5.0)
    schedule: ScheduledController = tune_schedule(
        problem.plants["stand"], problem.parameters, spec, "phi", (0.0, 0.4, 0.65), {"swing": problem.plants["swing"]}
    )
    table = schedule.table
    places = np.linspace(-0.05, 0.7, PLACES)
    law = schedule.runnable()
    references, readings = make_signals(40.0, 2, 0)
    readings[:, 1] = np.linspace(-0.1, 0.75, SAMPLES)
    state, commands = law.reset(place=float(readings[0, 1])), np.zeros(SAMPLES)
    for k in range(SAMPLES):
        if k == RESET:
            state = law.reset(place=float(readings[k, 1]))
        commands[k], state = law.step(state, float(references[k]), *map(float, readings[k]))
    return {
        "gains": [table.interpolate(float(place)) for place in places],
        "commands": commands[::KEPT], "total": float(np.sum(np.abs(commands))),
    }  # fmt: skip


def run_mpc() -> dict[str, Any]:
    """Return figures and commands of predictive control."""
    mpc = force_mpc(STAND, THOR, MPCSpec(bandwidth_hz=25, current_limit_A=6.0))
    references, readings = make_signals(900.0, 1, 0)
    references = np.nan_to_num(references)  # which it refuses; readings that are not numbers it predicts
    state, commands = mpc.start, np.zeros(400)
    for k in range(commands.size):
        commands[k], state = mpc.command(state, float(references[k]), float(readings[k, 0]))
    return {"commands": commands[::5], "law": mpc.law.responses(np.geomspace(0.1, 400.0, 12)).view(float)}


def certify_mpc() -> dict[str, Any]:
    """Return the certificate of predictive control that is read with noise, on two plants, and one that fails."""
    mpc = force_mpc(STAND, THOR, MPCSpec(bandwidth_hz=25, current_limit_A=6.0, bounds={"F1": (-600.0, 600.0)}))
    known = THOR.with_parameters(*(replace(THOR[name], prior_std=0.02 * THOR[name].value) for name in ("k", "b_r")))
    plants, cell = {"stand": STAND, "swing": SWING}, so.Sensors(noise_std={"F1": 1.0}, quantisation={"F1": 0.5})
    options: dict[str, Any] = {"samples": 40, "sensors": cell, "command_step": 1e-3}
    fine = so.certify(mpc, plants, known, ranges={"I_p": (0.2, 0.6)}, runs=3, **options)
    poor = so.certify(mpc, {"stand": STAND}, known, ranges={"k": (2e5, 4e5)}, runs=2, bound_tolerance=0.0, **options)
    return {"fine": state_worst(strip(fine.to_dict())), "poor": state_worst(strip(poor.to_dict()))}


def state_worst(certificate: dict[str, Any]) -> dict[str, Any]:
    """Return a certificate whose worst cases are stated by what is determined: a search ends where the largest Ms and
    Mt are flat, so that they are known to the square of what their parameters are, and what is played there to less.
    """
    for plant in certificate["plants"].values():
        worst = plant["worst"]
        worst |= {name: place(worst[name], 1e-3) for name in ("parameters", "ms_hz")}
        worst |= {name: place(worst[name], 1e-5) for name in ("ms", "mt", "spectral_radius")}
        worst["severity"] = place(worst["severity"], 1e-7)
        for largest in worst["largest"].values():
            largest |= {"value": place(largest["value"], 1e-7), "parameters": place(largest["parameters"], 1e-3)}
    for row in certificate["requirements"]:
        if row["draw"] is not None and row["draw"]["number"] == "":
            row["draw"] = place(row["draw"], 1e-3)
    steps = certificate["steps"]
    steps["rows"] = [row if row["draw"] == "nominal" else place(row, 1e-2) for row in steps["rows"]]
    steps["integration_error"] = steps["integration_error"] < 1e-6
    return certificate


def place(content: Any, within: float) -> Any:
    """Return content with its numbers known to a share of them."""
    if isinstance(content, dict):
        return {key: place(value, within) for key, value in content.items()}
    if isinstance(content, list):
        return [place(value, within) for value in content]
    return {"near": content, "within": within} if isinstance(content, float) else content


def draw_plants() -> dict[str, Any]:
    """Return drawn plants, by their seed."""
    plants = {"stand": STAND, "swing": SWING}
    ranges = {"I_p": (0.2, 0.6), "delay_s": (0.0, 2e-4), "phi": (-0.5, 0.5)}
    known = THOR.with_parameters(
        *(replace(THOR[name], prior_std=0.02 * THOR[name].value) for name in ("k", "J", "b_r"))
    )
    drawn = combine_uncertainty(known, so.ParameterSet(), ranges, plants)
    return {"draws": drawn.list_draws(12, np.random.default_rng(3))}


def refuse() -> dict[str, Any]:
    """Return exit codes, and what is said, of what the command line cannot do."""
    thor = (ROOT / "problems" / "thor.toml").read_text()
    wrong = {
        "key": thor.replace("bandwidth_hz", "bandwith_hz"), "unit": thor.replace('"kg m^2"', '"kg m"'),
        "range": thor.replace("bandwidth_hz = 30", "bandwidth_hz = 300"), "plant": thor.replace('"swing"', '"swin"'),
        "toml": thor + "[", "structure": thor.replace('"pid"', '"pidd"'), "empty": "",
    }  # fmt: skip
    out: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as folder:
        for name, text in wrong.items():
            path = Path(folder) / f"{name}.toml"
            path.write_text(text)
            out[name] = call("run", str(path), "-o", f"{folder}/out")["exit"]
        Path(folder, "log.csv").write_text("time [s],I [A]\n0,1\n")
        out |= {what: call(*words)["exit"] for what, words in {
            "no_fit": ("tune", "problems/thor.toml", "-o", f"{folder}/none"), "no_log": ("inspect", f"{folder}/no.csv"),
            "short_log": ("inspect", f"{folder}/log.csv"), "no_command": ("tun",), "export": ("export", folder),
        }.items()}  # fmt: skip
    return out


LAWS = (
    "pid", "pd", "pid_dob", "notch", "prefilter", "quiet", "cascade", "friction_by_reference", "friction_by_speed",
    "gravity_and_ripple", "impedance",
)  # fmt: skip
SUBJECTS: dict[str, Callable[[], Any]] = {
    **{f"problem_{name}": lambda name=name: run_problem(name) for name in ("thor", "knee", "pendulum")},
    **{f"problem_{name}": lambda name=name: run_problem(name) for name in ("torsion_actuator", "lever_knee")},
    **{f"law_{name}": lambda name=name: run_law(name) for name in LAWS},
    "schedule": run_schedule, "mpc": run_mpc, "certificate_mpc": certify_mpc, "draws": draw_plants, "refusals": refuse,
}  # fmt: skip
