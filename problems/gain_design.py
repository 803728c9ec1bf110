"""Gains from a log: fit, see what each bandwidth costs, take nine tenths of the largest, certify, export.

    python problems/gain_design.py [LOG.csv] [FOLDER]

The log has the columns "time [s]", "I [A]", "F1 [N]" and "F2 [N]"; without one, a virtual log of the bench is taken.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import seaopt as so
from seaopt.bench import PAPER_STAND
from seaopt.control import corners, sweep

STAND, SWING = so.plants.high_impedance(), so.plants.moving_output()
GUESS = so.plants.thor().update(J=1.5e-6, b_r=4e-4, eta=0.7).free("J", "b_r", "eta")
BANDWIDTHS_HZ = range(15, 61, 5)
SPEC = so.ControllerSpec(measured="F1", max_sensitivity=1.6, max_noise_gain=25, current_limit_A=9.0)
LEG = {"I_p": (0.2, 0.6)}  # kg m^2: nobody weighed it


def record() -> so.Log:
    """Return a virtual log, where there is no bench at hand."""
    truth, cells = so.plants.thor().update(eta=0.95), so.Sensors(noise_std={"F1": 2.0, "F2": 2.0})
    return so.virtual_log(STAND, truth, PAPER_STAND, duration_s=60, rate_hz=400, seed=1, sensors=cells)


def design(log: so.Log, folder: Path) -> tuple[so.Fit, so.Controller, so.Certificate] | None:
    """Return fit, controller and certificate of a log; the gains are in `folder` if all three are met.

    None if no bandwidth can be had.
    """
    fit = so.fit([so.Experiment(plant=STAND, log=log, outputs=("F1", "F2"), name="bench")], GUESS)
    plants = {"robust_to": {"swing": SWING}, "draws": corners(LEG)}
    frontier = sweep(STAND, fit, SPEC, BANDWIDTHS_HZ, **plants)
    possible = [row.bandwidth_hz for row in frontier.rows if row.feasible]
    if not possible:
        print(fit, frontier, f"no bandwidth from {BANDWIDTHS_HZ[0]} to {BANDWIDTHS_HZ[-1]} Hz can be had", sep="\n\n")
        return None
    chosen = max(0.9 * max(possible), BANDWIDTHS_HZ[0])  # not below the range of the specification
    controller = so.tune(STAND, fit, replace(SPEC, bandwidth_hz=chosen), **plants)
    certificate = so.certify(controller, {"stand": STAND, "swing": SWING}, fit, ranges=LEG, samples=1375)
    print(fit, frontier, controller, certificate, sep="\n\n")
    if is_met(fit, controller, certificate):
        so.export(controller, folder, name="knee")
    else:
        print("\nnot exported: fit, controller or certificate is not met")
    return fit, controller, certificate


def is_met(fit: so.Fit, controller: so.Controller, certificate: so.Certificate) -> bool:
    """Tell whether the gains may be used: a certificate alone knows nothing of the fit."""
    return fit.met and controller.feasible and certificate.passed


if __name__ == "__main__":
    log = so.read_log(sys.argv[1], time="time [s]") if len(sys.argv) > 1 else record()
    results = design(log, Path(sys.argv[2] if len(sys.argv) > 2 else "out/gain_design"))
    sys.exit(0 if results is not None and is_met(*results) else 1)
