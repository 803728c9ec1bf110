"""Draw the README's picture from the path that the README shows: python docs/readme_figure.py"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure

import seaopt as so
from seaopt.bench import PAPER_STAND
from seaopt.robustness import batch_figures, combine_uncertainty

TARGET = Path(__file__).resolve().parent / "figures" / "readme.svg"
BLUE, ORANGE, GREY = "#0072b2", "#d55e00", "#666666"
DRAWS = 1375


def main() -> None:
    stand, swing = so.plants.high_impedance(), so.plants.moving_output()
    guess = so.plants.thor().update(J=1e-6, b_r=4e-4).free("J", "b_r", "eta")
    noise = so.Sensors(noise_std={"F1": 2.0, "F2": 2.0})
    log = so.virtual_log(stand, so.plants.thor(), PAPER_STAND, duration_s=164, rate_hz=400, seed=1, sensors=noise)
    bench = so.Experiment(plant=stand, log=log, outputs=("F1", "F2"))
    fit = so.fit([bench], guess)
    spec = so.ControllerSpec(measured="F1", bandwidth_hz=30, max_sensitivity=1.6, max_noise_gain=25)
    controller = so.tune(stand, fit, spec, robust_to={"swing": swing})

    figure = Figure(figsize=(9.0, 2.7), layout="constrained", facecolor="white")
    axes = figure.subplots(1, 3)
    draw_fit(axes[0], fit, bench)
    draw_tracking(axes[1], controller, fit.parameters, {"test stand": stand, "output swings": swing})
    draw_certificate(axes[2], controller, swing, fit)
    for axis in axes:
        axis.spines[["top", "right"]].set_visible(False)
        axis.tick_params(labelsize="small")
    with rc_context({"svg.hashsalt": "seaopt", "svg.fonttype": "none"}):
        figure.savefig(TARGET, metadata={"Date": None})


def draw_fit(axis, fit: so.Fit, bench: so.Experiment) -> None:
    """Draw 0.3 s of the log, and the model of all 164 s over it."""
    run = fit.predict(bench)
    start = np.searchsorted(run.time, 60.0)
    part = slice(start, start + 120)
    time = 1e3 * (run.time[part] - run.time[start])
    axis.plot(time, run.measured["F1"][part], ".", color=GREY, markersize=3, label="load cell")
    axis.plot(time, run.model["F1"][part], color=BLUE, linewidth=1.2, label="model")
    axis.set_title(f"fit: {fit.outputs['experiment']['F1'].fit_percent:.1f} % of 164 s", fontsize="medium")
    axis.set_xlabel("time [ms]")
    axis.set_ylabel("F1 [N]")
    axis.legend(frameon=False, fontsize="x-small", loc="lower left")


def draw_tracking(axis, controller: so.Controller, values: so.ParameterSet, plants: dict[str, so.Plant]) -> None:
    """Draw how one controller follows its reference on each plant."""
    f = np.geomspace(0.5, 150, 250)
    for (name, plant), colour in zip(plants.items(), (BLUE, ORANGE), strict=True):
        gain = np.abs(controller.close(plant, values).tracking(f))
        axis.semilogx(f, 20 * np.log10(gain), color=colour, linewidth=1.2, label=name)
    reached = controller.achieved.bandwidth_hz
    axis.axhline(-3.0, color=GREY, linewidth=0.8, linestyle=":")
    axis.axvline(reached, color=GREY, linewidth=0.8, linestyle=":")
    axis.set_ylim(-30, 10)
    axis.set_title(f"tune: {reached:.0f} Hz, one law for both", fontsize="medium")
    axis.set_xlabel("frequency [Hz]")
    axis.set_ylabel("|F1/F_ref| [dB]")
    axis.legend(frameon=False, fontsize="x-small", loc="lower left")


def draw_certificate(axis, controller: so.Controller, plant: so.Plant, fit: so.Fit) -> None:
    """Draw the peak of the sensitivity on every draw of what the fit, and a payload of unknown inertia, leave open."""
    unknown = combine_uncertainty(fit, so.ParameterSet(), {"I_p": (0.3, 0.45)}, {"swing": plant})
    points = unknown.draw(DRAWS, np.random.default_rng(1))
    figures = batch_figures(controller, plant, unknown.nominal, unknown.values(points))
    axis.hist(figures.ms, bins=20, color=BLUE, histtype="stepfilled")
    limit = controller.spec.max_sensitivity
    axis.axvline(limit, color=ORANGE, linewidth=1.2, label=f"limit {limit:g}")
    over = np.count_nonzero(~(figures.ms <= limit))  # an unstable draw has none
    axis.set_title(f"certify: {over} of {DRAWS} draws over Ms {limit:g}", fontsize="medium")
    axis.set_xlabel("Ms, the output swinging")
    axis.set_ylabel("draws")
    axis.legend(frameon=False, fontsize="x-small", loc="upper center")


if __name__ == "__main__":
    main()
