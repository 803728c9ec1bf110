"""Draw the figures of the documentation: python docs/figures.py"""

from __future__ import annotations

import shutil
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure

import seaopt as so
from seaopt.bench import PAPER_STAND
from seaopt.control import (
    CompensateFriction,
    Frontier,
    Gains,
    Impedance,
    MPCSpec,
    NoiseModel,
    Notch,
    SampledLoop,
    add_compensation,
    close_loop,
    command_of,
    estimator,
    force_mpc,
    passive_region,
    run_loop,
    sample,
    sweep,
    tune_schedule,
)
from seaopt.control.laws.realisation import realise, runnable
from seaopt.control.loops.port import hold_response, port_of
from seaopt.estimation import Limits, design_experiment
from seaopt.reporting.figures.impedance import region_panel
from seaopt.reporting.figures.panel import compose_sheet
from seaopt.reporting.figures.simulation import (
    amplitude_panel,
    environment_panels,
    saturation_panel,
)
from seaopt.robustness.verification.environments import coupled_stability
from seaopt.robustness.verification.large_signal import large_signal

FOLDER = Path(__file__).resolve().parent / "figures"
COLOURS = {"unlumped": "#0072b2", "lumped": "#d55e00"}
F = np.geomspace(0.1, 300, 1500)


def new(titles: list[str], ylabel: str, xlabel: str = "frequency [Hz]"):
    figure = Figure(figsize=(8.5, 3.0), layout="constrained")
    axes = figure.subplots(1, len(titles), squeeze=False)[0]
    for axis, title in zip(axes, titles, strict=True):
        axis.set_title(title, fontsize="medium")
        axis.set_xlabel(xlabel)
        axis.grid(visible=True, which="both", color="#e4e4e4", linewidth=0.5)
        axis.spines[["top", "right"]].set_visible(False)
    axes[0].set_ylabel(ylabel)
    return figure, axes


def save(figure: Figure, name: str) -> None:
    FOLDER.mkdir(exist_ok=True)
    with rc_context({"svg.hashsalt": "seaopt", "svg.fonttype": "none"}):
        figure.savefig(FOLDER / f"{name}.svg", metadata={"Date": None})


def decibel(model, row: int, column: int = 0):
    value = model(2j * np.pi * F)
    return 20 * np.log10(np.maximum(np.abs(value[row, column] if value.ndim == 3 else value), 1e-9))


def force_responses(make, name: str) -> None:
    figure, axes = new(["F1/I", "F2/I"], "magnitude [dB re N/A]")
    for drive, colour in COLOURS.items():
        for spring, style in (("link1", "-"), ("link2", "--")):
            model = make(drive=drive, spring=spring).linearize(so.plants.thor())
            for row, axis in enumerate(axes):
                label = f"{drive}, spring at {spring}"
                axis.semilogx(F, decibel(model, row), color=colour, linestyle=style, linewidth=1.3, label=label)
                axis.set_ylim(-40, 80)
    axes[0].legend(frameon=False, fontsize="x-small", loc="lower left")
    save(figure, name)


def impulse() -> None:
    figure, axes = new(["link 2 and sprung mass", "screw"], "speed [m/s]", "time [ms]")
    time = np.arange(400) / 20e3
    force = np.where(time < 1e-3, 1000.0, 0.0)
    log = so.Log.from_arrays(time=time, I=np.zeros(400), Fe2=force)
    for drive, colour in COLOURS.items():
        plant = so.plants.two_link(link1="fixed", link2="mass", drive=drive)
        run = so.simulate(plant, plant.defaults, log)
        axes[0].plot(1e3 * time, run["v_2"], color=colour, label=f"{drive}: link 2")
        axes[0].plot(1e3 * time, run["v_2"] + run["qd"], color=colour, linestyle="--", label=f"{drive}: sprung mass")
        axes[1].plot(1e3 * time, run["qd"], color=colour, label=f"{drive}: nut along the screw")
    for axis in axes:
        axis.legend(frameon=False, fontsize="x-small")
    save(figure, "two_link")


def rotary() -> None:
    plant = so.plants.rotary()
    model = plant.linearize(plant.defaults)
    figure, axes = new(["torques", "angles"], "magnitude [dB]")
    for row, (output, unit) in enumerate(plant.outputs.items()):
        axis = axes[0] if unit == "N m" else axes[1]
        axis.semilogx(F, decibel(model, row), linewidth=1.3, label=f"{output}/I")
    for axis in axes:
        axis.legend(frameon=False, fontsize="x-small")
    save(figure, "rotary")


def parts() -> None:
    figure, axes = new(["F1/I on the stand with parts"], "magnitude [dB re N/A]")
    for names in ((), ("screw_mode",), ("current_loop", "load_cell"), ("screw_mode", "current_loop", "load_cell")):
        plant = so.plants.high_impedance(parts=names)
        model = plant.linearize(plant.defaults)
        axes[0].semilogx(F, decibel(model, 0), linewidth=1.3, label=", ".join(names) or "none")
    axes[0].legend(frameon=False, fontsize="x-small")
    save(figure, "parts")


def estimates(excitation, covariance, axis, colour: str, label: str) -> None:
    """Fit 40 logs that differ in noise; draw the estimates and the expected 95 % ellipse, in 1e-6 of the truth."""
    plant, truth, noise = so.plants.high_impedance(), so.plants.thor().free("J", "b_r", "eta"), {"F1": 2.0, "F2": 2.0}
    found = []
    for seed in range(40):
        log = so.virtual_log(
            plant, truth, excitation, duration_s=10, rate_hz=400, seed=seed, sensors=so.Sensors(noise_std=noise)
        )
        experiment = so.Experiment(plant=plant, log=log, outputs=("F1", "F2"), sigma=noise)
        fit = so.fit([experiment], truth, method=so.OutputError(search=False))
        found.append([1e6 * (fit.parameters[name].value / truth[name].value - 1) for name in ("J", "b_r")])
    size = np.array([truth["J"].value, truth["b_r"].value])
    root = np.linalg.cholesky(covariance.matrix[:2, :2] / np.outer(size, size))
    turn = np.linspace(0, 2 * np.pi, 200)
    ellipse = 1e6 * np.sqrt(5.991) * root @ np.array([np.cos(turn), np.sin(turn)])
    axis.plot(*np.array(found).T, ".", color=colour, markersize=4, label=label)
    axis.plot(*ellipse, color=colour, linewidth=1.0)


def experiment_design() -> None:
    plant, truth, noise = so.plants.high_impedance(), so.plants.thor().free("J", "b_r", "eta"), {"F1": 2.0, "F2": 2.0}
    limits = Limits(duration_s=10, rate_hz=400, rms=np.sqrt(3.0))
    design = design_experiment(plant, truth, limits, sigma=noise)
    paper = design.against(PAPER_STAND)
    figure, axes = new(["what one line tells", "40 fits each, and the expected 95 %"], "information, largest = 1")
    for name, colour in zip(("J", "b_r", "eta"), ("#0072b2", "#009e73", "#cc79a7"), strict=True):
        step = 1e-4 * truth[name].value
        up, down = (
            plant.linearize(truth.update(**{name: truth[name].value + d}))(2j * np.pi * F) for d in (step, -step)
        )
        told = np.sum(np.abs(up[:2, 0] - down[:2, 0]) ** 2, axis=0)
        axes[0].semilogx(F, told / np.max(told), color=colour, linewidth=1.3, label=name)
    (part,) = design.excitation
    power = np.array(part.amplitudes) ** 2 / np.sum(np.array(part.amplitudes) ** 2)
    axes[0].vlines(part.frequencies_hz, 0, power, color="k", linewidth=2.0, label="power, share")
    axes[0].set_xlim(0.1, 100)
    axes[0].legend(frameon=False, fontsize="x-small", loc="upper right")
    estimates(paper.excitation, paper.covariance, axes[1], "#d55e00", "paper's excitation")
    estimates(design.excitation, design.covariance, axes[1], "#0072b2", "design")
    axes[1].set_xlabel("error of J [1e-6 of its value]")
    axes[1].set_ylabel("error of b_r [1e-6 of its value]")
    axes[1].legend(frameon=False, fontsize="x-small", loc="upper left")
    axes[1].set_ylim(-500, 650)
    save(figure, "experiment_design")


def verification() -> None:
    stand, swing, params = so.plants.high_impedance(), so.plants.moving_output(), so.plants.thor()
    spec = so.ControllerSpec(bandwidth_hz=30.0, max_sensitivity=1.6, max_noise_gain=25, current_limit_A=9.0)
    controller = so.tune(stand, params, spec, robust_to={"swing": swing})
    found = [
        replace(large_signal(controller, plant, params), plant=name)
        for name, plant in (("stand", stand), ("swing", swing))
    ]
    drawn = [panel for sweep in found for panel in (amplitude_panel(sweep), saturation_panel(sweep))]
    save(compose_sheet(drawn), "large_signal")
    save(compose_sheet(environment_panels(coupled_stability(controller, stand, params))), "environments")


GAINS = Gains(k_p=3.18, k_i=1.31, k_d=0.0328, T_f=1.01e-3, k_r=4.18)  # 30 Hz on the stand


def anti_windup() -> None:
    """Step to half again what 9 A can hold, and at 1.5 s to half of it."""
    plant, params = so.plants.high_impedance(), so.plants.thor()
    gain = command_of(plant, params, "F1").per_effort
    a, b, c, _ = sample(plant, params, "F1", gain, 1e-3, 1).delayed()
    time = np.arange(4000) * 1e-3
    figure, axes = new(["force", "current"], "F1 over what 9 A hold", "time [s]")
    axes[1].set_ylabel("current [A]")
    roots = {"k_r/k_i = 3.2 s": None, "sqrt(T_i T_d) = 0.16 s": 0.158, "none": 1e9}
    for (label, tracking), colour in zip(roots.items(), ("#0072b2", "#d55e00", "#777777"), strict=True):
        law = realise(GAINS.law("pid", 1e-3), per_effort=gain, command_limit=9.0, tracking_time_s=tracking)
        x, state, forces, currents = np.zeros(b.size), law.reset(), [], []
        for t in time:
            force = float(c @ x)
            current, state = law.step(state, (1.5 if t < 1.5 else 0.5) * law.force_limit_N, force)
            x = a @ x + b * current / gain
            forces.append(force / law.force_limit_N)
            currents.append(current)
        axes[0].plot(time, forces, color=colour, linewidth=1.3, label=label)
        axes[1].plot(time, currents, color=colour, linewidth=1.0)
    axes[0].legend(frameon=False, fontsize="x-small", title="tracking time", title_fontsize="x-small")
    save(figure, "anti_windup")


def passivity() -> None:
    plant, params = so.plants.high_impedance(), so.plants.thor()
    port = port_of(plant, params, "F1", command_of(plant, params, "F1").per_effort)
    f = np.geomspace(0.1, 499, 2000)
    c_y = GAINS.law("pid", 1e-3).measurement_response(f)
    figure, axes = new(["port impedance", "cosine of its angle"], "|Z| [N s/m]")
    axes[1].set_ylabel("Re Z / |Z|")
    without = np.zeros(f.size, dtype=complex)
    laws = {
        "no control": without,
        "pid, held, one sample late": c_y * hold_response(f, 1e-3, 1),
        "the same, two samples late": c_y * hold_response(f, 1e-3, 2),
    }
    for (label, law), colour in zip(laws.items(), ("#777777", "#0072b2", "#d55e00"), strict=True):
        z = port.response(f).impedance(law)
        axes[0].loglog(f, np.abs(z), color=colour, linewidth=1.3, label=label)
        axes[1].semilogx(f, z.real / np.abs(z), color=colour, linewidth=1.3)
    axes[1].axhline(0.0, color="k", linewidth=0.6)
    axes[0].legend(frameon=False, fontsize="x-small")
    save(figure, "passivity")


def impedance() -> None:
    knee = so.plants.rotary("pendulum")
    values = knee.defaults.update(
        N=100.0, K_tau=0.0369, eta=0.7, J_m=2.4e-5, b_r=1e-4, k_s=300.0, J_l=0.25, d_l=0.3, m=4.0, L=0.2
    )
    spec = so.ControllerSpec(measured="tau_s", bandwidth_hz=15, max_sensitivity=1.6, max_noise_gain=45)
    force = so.tune(so.plants.rotary("locked"), values, spec)
    region = passive_region(force, knee, values, velocity_filter_s=0.005)
    asked = Impedance(stiffness=50.0, damping=1.5, velocity_filter_s=0.005)
    save(compose_sheet([region_panel(region, asked)]), "impedance")


def disturbed(duration_s: float, seed: int):
    """Return a log of the stand moved by 0.1 A of unknown current noise a sample, and what really happened."""
    plant, truth, rng = so.plants.high_impedance(), so.plants.thor(), np.random.default_rng(seed)
    log = so.virtual_log(plant, truth, PAPER_STAND, duration_s=duration_s, rate_hz=400, seed=seed)
    moved = so.Log.from_arrays(time=log.time, I=log["I"] + 0.1 * rng.normal(size=len(log)))
    real = so.simulate(plant, truth, moved)
    return so.Log.from_arrays(time=log.time, I=log["I"], F1=real["F1"] + 2.0 * rng.normal(size=len(log))), real


def state_estimator() -> None:
    plant, truth = so.plants.high_impedance(), so.plants.thor()
    log, real = disturbed(20, 1)
    noise = NoiseModel(sensor_std={"F1": 2.0}, input_noise={"I": 0.005})
    run = estimator(plant, truth, noise, sample_time_s=log.period).run(log)
    figure, axes = new(["error of the spring's rate", "autocorrelation of the innovations"], "[mm/s]", "time [s]")
    part = slice(6000, 6160)
    difference = np.gradient(log["F1"], log.time) / truth["k"].value
    for values, style, label in (
        (difference, {"color": "#c0c0c0", "linewidth": 1.0}, "F1 differenced, over k"),
        (run["spring_rate"], {"color": "#0072b2", "linewidth": 1.2}, "Kalman filter, and twice its std"),
    ):
        axes[0].plot(log.time[part], 1e3 * (values - real["qd"])[part], label=label, **style)
    for sign in (-2, 2):
        axes[0].axhline(sign * 1e3 * run.std["spring_rate"], color="#0072b2", linewidth=0.7, linestyle=":")
    for label, colour, params in (
        ("the plant", "#0072b2", truth), ("J 5 % too large", "#d55e00", truth.update(J=1.05 * truth["J"].value))
    ):  # fmt: skip
        found = estimator(plant, params, noise, sample_time_s=log.period).run(log).innovations["F1"][100:]
        rho = [float(np.mean(found[lag:] * found[: found.size - lag]) / np.mean(found**2)) for lag in range(1, 41)]
        axes[1].plot(np.arange(1, 41), rho, ".-", color=colour, markersize=4, linewidth=0.8, label=label)
    for sign in (-1, 1):
        axes[1].axhline(sign * 2.576 / np.sqrt(len(log)), color="k", linewidth=0.7, linestyle=":")
    axes[1].set_xlabel("lag [samples]")
    for axis in axes:
        axis.legend(frameon=False, fontsize="x-small")
    save(figure, "state_estimator")


def predictive_control() -> None:
    plant, truth = so.plants.high_impedance(), so.plants.thor()
    spec = {"bandwidth_hz": 30, "max_sensitivity": 1.6, "current_limit_A": 9.0}
    robust = {"swing": so.plants.moving_output()}
    law = runnable(so.tune(plant, truth, so.ControllerSpec(**spec), robust_to=robust))
    mpc = force_mpc(plant, truth, MPCSpec(current_limit_A=9.0))
    slow = force_mpc(plant, truth, MPCSpec(current_limit_A=9.0, current_slew_A_per_s=500.0))
    figure, axes = new(["F1 [N]", "current [A]"], "", "time [ms]")
    reference = np.where(np.arange(90) < 10, 0.0, 1000.0)
    for label, colour, step, start in (
        ("pid", "#d55e00", law.step, law.reset()),
        ("MPC", "#0072b2", mpc.command, mpc.start),
        ("MPC, 500 A/s", "#009e73", slow.command, slow.start),
    ):
        run = close_loop(step, start, plant, truth, reference)
        axes[0].plot(1e3 * run.time, run.force, color=colour, linewidth=1.3, label=label)
        axes[1].step(1e3 * run.time, run.current, color=colour, linewidth=1.3, label=label, where="post")
    axes[0].plot(1e3 * run.time, reference, color="k", linewidth=0.7, linestyle=":")
    axes[0].legend(frameon=False, fontsize="x-small", loc="lower right")
    save(figure, "mpc")


def compensation() -> None:
    """A slow sine with the link held, and zero torque while the link is driven, with friction compensated and not."""
    held, free = so.plants.rotary(link="locked"), so.plants.rotary(link="free", external=True)
    values = free.defaults.update(
        N=100.0, K_tau=0.0369, eta=0.7, J_m=2.4e-5, b_r=1e-4, f_c=0.01, v_s=1.0, k_s=300.0, J_l=0.25, d_l=0.3
    )
    spec = so.ControllerSpec(
        measured="tau_s", bandwidth_hz=15, max_sensitivity=1.6, max_noise_gain=45, current_limit_A=9.0
    )
    controller = so.tune(held, values, spec)
    time = np.arange(8000) * 1e-3
    slow, driven = 5.0 * np.sin(0.5 * np.pi * time), {"tau_e": 3.0 * np.sin(np.pi * time)}
    figure, axes = new(["5 N m at 0.25 Hz, link held", "zero torque, link driven at 0.5 Hz"], "error [N m]", "time [s]")
    asked = {
        "none": None,
        "from the reference": CompensateFriction(),
        "from the speed": CompensateFriction(source="speed"),
    }
    for (name, friction), colour in zip(asked.items(), ("#777777", "#0072b2", "#d55e00"), strict=True):
        law = runnable(add_compensation(controller, friction=friction))
        for axis, plant, reference, external in ((axes[0], held, slow, {}), (axes[1], free, 0.0 * time, driven)):
            loop = SampledLoop(plant=plant, law=law, measured="tau_s", delay_samples=1)
            error = run_loop(loop, [values], reference, external=external).outputs["tau_s"][0] - reference
            if axis is axes[0] or name != "from the reference":
                axis.plot(time[4000:], error[4000:], color=colour, linewidth=1.2, label=name)
    axes[0].legend(frameon=False, fontsize="x-small", title="compensated", title_fontsize="x-small")
    save(figure, "compensation")


def scheduling() -> None:
    """Bandwidth and Ms over the knee's angle, of a schedule and of the fastest law for all angles."""
    problem = so.read_problem(FOLDER.parents[1] / "problems" / "lever_knee.toml")
    stand, swing, asked = problem.plants["stand"], problem.plants["swing"], problem.schedule
    places = [
        problem.parameters.with_parameters(so.Parameter(name=asked.over, value=value, unit="rad"))
        for value in asked.points
    ]
    others = {f"{plant.name} {i}": (plant, here) for i, here in enumerate(places) for plant in (stand, swing)}
    schedule = tune_schedule(stand, problem.parameters, problem.spec, asked.over, asked.points, {"swing": swing})
    one = so.tune(stand, places[-1], replace(problem.spec, bandwidth_hz=22), others)
    figure, axes = new(["bandwidth on the stand", "largest Ms"], "", "joint angle [rad]")
    angles = np.linspace(asked.points[0], asked.points[-1], 24)
    for name, choose, colour in (
        ("schedule, 30 Hz", schedule.at, "#0072b2"), ("one law, 22 Hz with the leg bent", lambda _: one, "#d55e00")
    ):  # fmt: skip
        loops = []
        for angle in angles:
            here = problem.parameters.with_parameters(so.Parameter(name=asked.over, value=float(angle), unit="rad"))
            loops.append([choose(float(angle)).close(plant, here).figures() for plant in (stand, swing)])
        axes[0].plot(angles, [held.bandwidth_hz for held, _ in loops], color=colour, label=name)
        axes[1].plot(angles, [max(held.ms, free.ms) for held, free in loops], color=colour)
    axes[0].set_ylim(0.0, None)
    axes[0].set_ylabel("bandwidth [Hz]")
    axes[1].set_ylabel("Ms [-]")
    axes[1].axhline(1.6, color="#777777", linewidth=0.8, linestyle="--")
    axes[0].legend(frameon=False, fontsize="x-small")
    save(figure, "scheduling")


def thor_frontiers() -> dict[str, Frontier]:
    """Sweep THOR's bandwidth at Ms 1.6, the swinging output in robust_to, as it is and with the screw's mode."""
    limits = {"max_sensitivity": 1.6, "max_complementary": 1.3, "max_reference_peak": 1.3, "max_noise_gain": 60}
    mode = {"parts": ("screw_mode",)}
    stiff = (so.plants.high_impedance(), {"swing": so.plants.moving_output()})
    soft = (
        so.plants.high_impedance(**mode),
        {"swing with mode": so.plants.moving_output(**mode), "stiff stand": stiff[0], "stiff swing": stiff[1]["swing"]},
    )
    asked = {"no mode": (stiff, None), "80 Hz mode": (soft, None), "80 Hz mode, notch": (soft, Notch())}
    found = {}
    for name, ((plant, others), notch) in asked.items():
        spec = so.ControllerSpec(notch=notch, **limits)
        params = plant.complete(so.plants.thor())
        robust_to = {key: (other, params) for key, other in others.items()}
        found[name] = sweep(plant, params, spec, list(np.arange(15.0, 61.0, 5.0)), robust_to)
    return found


def tuning() -> None:
    figure, axes = new(["noise gain [N/N]", "largest Ms", "disturbance"], "", "bandwidth [Hz]")
    for (name, found), colour in zip(thor_frontiers().items(), ("#0072b2", "#d55e00", "#009e73"), strict=True):
        f = [row.bandwidth_hz for row in found.rows]
        for axis, figure_of in zip(axes, ("noise_gain", "ms", "disturbance"), strict=True):
            values = [getattr(row, figure_of) for row in found.rows]
            axis.plot(f, values, color=colour, linewidth=1.0, label=name)
            for x, y, row in zip(f, values, found.rows, strict=True):
                axis.plot(x, y, "o", color=colour, markersize=4, markerfacecolor=colour if row.feasible else "white")
        print(name)  # noqa: T201
        print(found)  # noqa: T201
    axes[0].legend(frameon=False, fontsize="x-small")
    save(figure, "tuning")


def paper() -> None:
    sys.path.insert(0, str(FOLDER.parents[1] / "problems"))
    import orekhov2015

    with tempfile.TemporaryDirectory() as folder:
        orekhov2015.figure_7(so.plants.thor(), Path(folder))
        orekhov2015.figure_9(so.plants.thor(), Path(folder))
        for name in ("fig7.svg", "fig9.svg"):
            shutil.copy(Path(folder) / name, FOLDER)


if __name__ == "__main__":
    paper()
    force_responses(so.plants.high_impedance, "high_impedance")
    force_responses(so.plants.moving_output, "moving_output")
    impulse()
    rotary()
    parts()
    anti_windup()
    passivity()
    impedance()
    compensation()
    scheduling()
    experiment_design()
    state_estimator()
    predictive_control()
    verification()
    tuning()
