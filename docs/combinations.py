"""Write docs/reference/combinations.md: which parts go together, each tuned, certified, simulated and exported in one
run: `python docs/combinations.py`.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory

from typer.testing import CliRunner

from seaopt.cli.main import app
from seaopt.control import export, export_mpc, read_law
from seaopt.errors import ControlError, SeaoptError
from seaopt.problem import Problem, read_problem
from seaopt.problem.stages import assess_problem, certify_problem, design_mpc, tune_problem
from seaopt.robustness import JointTuning, linear_controller

PAGE = Path(__file__).resolve().parent / "reference" / "combinations.md"
FILE = """
schema = 1
title = "leg"
[parameters]
N = 100
K_tau = 0.0369
eta = 0.7
J_m = { value = 2.4e-5, prior_std = 1e-6 }
b_r = 4e-4
f_c = COULOMB
v_s = 1.0
k_s = 280
J_l = 0.25
d_l = 0.1
m = 4.0
L = 0.2
[plant.stand]
kind = "rotary"
link = "locked"
PARTS
[plant.swing]
kind = "rotary"
link = "pendulum"
PARTS
EXPERIMENT
[controller]
plant = "PLANT"
measured = MEASURED
STRUCTURE
sample_rate_hz = 1000
compute_delay_samples = 1
current_limit_A = 9.0
CONTROLLER
SCHEDULE
TABLES
[robustness]
plants = [CERTIFIED]
samples = 6
constrained_runs = 1
ROBUSTNESS
"""
TUNED = "bandwidth_hz = 16\nrobust_to = [ROBUST_TO]"
LIMITS = f"{TUNED}\nmax_sensitivity = 1.7\nmax_noise_gain = 60"
SCHEDULE = '[controller.schedule]\nover = "k_s"\npoints = [280, 320]'
EXPERIMENT = """[[experiment]]
name = "chirp"
plant = "stand"
virtual = { seed = 1, duration_s = 40, rate_hz = 1000, noise_std = { tau_s = 0.01, theta_m = 1e-4 }, excitation = { chirp = { amplitude = 2.0, f0_hz = 0.1, f1_hz = 150 }, noise = { std = 1.0, band_hz = 200 } } }
"""
OWN = {  # a PI at 1 kHz
    "sample_time_s": 1e-3, "compute_delay_samples": 1,
    "reference": {"num": [1.004, -0.996], "den": [1.0, -1.0]}, "measurement": {"num": [0.504, -0.496], "den": [1.0, -1.0]},
}  # fmt: skip
BOTH = '["tau_s", "thetad_m"]'
LAWS: Mapping[str, Mapping[str, str]] = {
    "`pid`": {"STRUCTURE": f'structure = "pid"\n{LIMITS}'},
    "`pid_dob`": {"STRUCTURE": f'structure = "pid_dob"\n{LIMITS}'},
    "`cascade`": {"STRUCTURE": f'structure = "cascade"\n{LIMITS}', "MEASURED": BOTH},
    "schedule of `pid`": {"STRUCTURE": f'structure = "pid"\n{LIMITS}', "SCHEDULE": SCHEDULE},
    "schedule of `pid_dob`": {"STRUCTURE": f'structure = "pid_dob"\n{LIMITS}', "SCHEDULE": SCHEDULE},
    "schedule of `cascade`": {"STRUCTURE": f'structure = "cascade"\n{LIMITS}', "SCHEDULE": SCHEDULE, "MEASURED": BOTH},
    "predictive control": {"STRUCTURE": f'structure = "mpc"\n{TUNED}', "LINKED": ""},
    "`pid` designed on `frf:`": {
        "STRUCTURE": f'structure = "pid"\n{LIMITS}', "PLANT": "frf:chirp", "EXPERIMENT": EXPERIMENT, "CERTIFIED": "",
    },
    "`cascade` designed on `frf:`": {
        "STRUCTURE": f'structure = "cascade"\n{LIMITS}', "MEASURED": BOTH, "PLANT": "frf:chirp", "EXPERIMENT": EXPERIMENT,
        "CERTIFIED": "",
    },
    "a law of your own": {"STRUCTURE": f'structure = "pid"\n{LIMITS}'},
}  # fmt: skip
PARTS: Mapping[str, Mapping[str, str]] = {
    "nothing else": {},
    "`notch`": {"CONTROLLER": "notch = true"},
    "`prefilter`": {"CONTROLLER": 'prefilter = "second_order"'},
    "`link_feedforward`": {"CONTROLLER": "link_feedforward = true", "ROBUST_TO": "LINKED", "CERTIFIED": '"swing"'},
    "friction, from the reference": {"CONTROLLER": "compensate = { friction = { fraction = 0.4 } }", "COULOMB": "0.002"},
    "friction, from the speed": {
        "CONTROLLER": 'compensate = { friction = { fraction = 0.4, from = "speed" } }', "COULOMB": "0.002", "CERTIFIED": '"swing"',
    },
    "weight of the link": {"CONTROLLER": 'compensate = { gravity = { plant = "swing", fraction = 0.8 } }', "CERTIFIED": '"swing"'},
    "`[impedance]`": {"TABLES": '[impedance]\nplant = "swing"\nstiffness = 30\ndamping = 2.0'},
    "`[controller.gate]`": {"TABLES": "[controller.gate]\nrange_N = [-300, 300]"},
    "`derate`": {"CONTROLLER": "derate = true", "PARTS": 'parts = ["thermal"]'},
    "another plant in `robust_to`": {"ROBUST_TO": '"swing"', "CERTIFIED": '"swing"'},
    "`frf:` in `robust_to`": {"ROBUST_TO": '"frf:chirp"', "EXPERIMENT": EXPERIMENT},
    "plants to certify on": {"CERTIFIED": '"swing"'},
    "`retune`": {"ROBUSTNESS": "retune = 2", "CERTIFIED": '"swing"'},
    "`seaopt tune --sweep`": {},
}  # fmt: skip
DEFAULTS = {"LINKED": '"swing"', "PLANT": "stand", "MEASURED": '"tau_s"', "ROBUST_TO": "", "CERTIFIED": '"stand"', "COULOMB": "0", "ROBUSTNESS": "retune = 0"}
HEAD = """# What goes with what

Each law (column) was tried with each part (row) by `python docs/combinations.py`, which writes this page from one run. A tick: the law was tuned (a law of your own: measured), certified, simulated with
steps of several sizes and exported as C. Whether its certificate is met depends on limits, draws and plants. A number: it is refused, for the reason below the table. Tests refuse again what is refused
here, and run the whole table.

- A law of your own is what it is: notch, prefilter and link feedforward of `[controller]` are not used.
- A law designed on `frf:` is simulated on the plants that it is certified on. What no response tells, heat, friction and the largest step of a reading, is of the model of the plant that was measured.
- What feeds back the motion of motor or link on a law designed on `frf:`, friction compensated from the speed or the weight of the link, is shown to be stable on models: name them in `[robustness] plants`.
- A sweep of predictive control has its linear region, in which no limit is active.
- A sweep is run, and nothing of it is exported.
- The impedance has a number for its damping: `"critical"` is refused where something in the loop swings more slowly than the link.

"""


def write_file(law: str, part: str) -> str:
    """Return the problem file of a combination."""
    text, keys = FILE, [*dict.fromkeys((*LAWS[law], *PARTS[part], *DEFAULTS, "CONTROLLER", "SCHEDULE", "TABLES"))]
    for key in [*keys, "ROBUST_TO", "LINKED", "PARTS", "EXPERIMENT", "ROBUSTNESS"]:
        text = text.replace(key, PARTS[part].get(key, LAWS[law].get(key, DEFAULTS.get(key, ""))))
    return text


def try_combination(law: str, part: str, folder: Path) -> str:
    """Return why a combination is refused; empty where it works."""
    path = folder / "leg.toml"
    path.write_text(write_file(law, part), encoding="utf-8")
    if "sweep" in part and "own" not in law:
        done = CliRunner().invoke(app, ["tune", str(path), "-o", str(folder / "out"), "--sweep", "16:18:2"])
        if isinstance(done.exception, SeaoptError):
            return tell(str(done.exception), folder)
        return tell(done.stderr, folder) if done.exit_code == 2 else ""
    try:
        run_stages(read_problem(path), law, part, folder)
    except SeaoptError as error:
        return tell(str(error), folder)
    return ""


def run_stages(problem: Problem, law: str, part: str, folder: Path) -> None:
    """Tune, certify, simulate and export a combination."""
    source, subject = problem.parameters, None
    if "own" in law:
        if "sweep" in part or "retune" in part:
            raise ControlError("a law of your own is given: nothing of it is tuned")
        (folder / "own.json").write_text(json.dumps(OWN))
        controller = assess_problem(problem, read_law(folder / "own.json"), source)
    elif problem.mpc is not None:
        subject = design_mpc(problem, source)
        controller = linear_controller(subject)
    else:
        tuned = tune_problem(problem, source)
        controller = tuned.controller if isinstance(tuned, JointTuning) else tuned
    certificate = certify_problem(problem, controller, source, simulations=False)
    for place in certificate.places or (certificate,):
        if place.models and isinstance(place.steps, str):  # why none could be simulated
            raise ControlError(place.steps)
    if subject is not None:
        export_mpc(subject, folder / "c")
    else:
        export(controller, folder / "c", allow_infeasible=True)


def tell(text: str, folder: Path) -> str:
    """Return a message in one line, without the file's name."""
    line = " ".join(text.replace(str(folder), "").split())
    return re.sub(r"^(seaopt: )?(/?leg[.]toml: )*", "", line)


def try_row(part: str, folder: Path) -> list[str]:
    """Return for each law why the part is refused beside it; empty where it works."""
    return [try_combination(law, part, folder) for law in LAWS]


def compose_page(rows: Mapping[str, list[str]]) -> str:
    """Return the page of what was found for each part."""
    reasons: dict[str, int] = {}
    lines = [f"| | {' | '.join(LAWS)} |", f"|---|{':-:|' * len(LAWS)}"]
    for part, found in rows.items():
        cells = ["✓" if not reason else str(reasons.setdefault(reason, len(reasons) + 1)) for reason in found]
        lines.append(f"| {part} | {' | '.join(cells)} |")
    return HEAD + "\n".join(lines) + "\n\n" + "\n".join(f"{n}. {text}" for text, n in reasons.items()) + "\n"


if __name__ == "__main__":
    with TemporaryDirectory() as scratch:
        PAGE.write_text(compose_page({part: try_row(part, Path(scratch)) for part in PARTS}), encoding="utf-8")
