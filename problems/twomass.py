"""A plant of one's own on a measured log: the two-mass drive of ../shared/data/twomass.

Motor, flexible coupling and load, driven by a multisine; the log holds the motor current and both angles. Only ratios
to the motor inertia can be seen when neither torque nor inertia is known: J_m = 1 fixes the scale and everything else
is over J_m. The rigid mode drifts (friction that a linear plant does not have), so residuals are weighted to
11-250 Hz, the band of the excitation.

Run it with the file's path, or from a checkout with the shared data beside it:

    python problems/twomass.py [MultisineTypeA.mat]
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import scipy.io

import seaopt as so

DATA = Path(__file__).resolve().parents[2] / "shared" / "data" / "twomass" / "MultisineTypeA.mat"
BAND_HZ = (11.0, 250.0)


def drive() -> so.Plant:
    """Return the two-mass drive: angles of motor and load, joined by a spring with damping."""

    def motion(t: Any, x: Any, u: Any, p: Any) -> dict[str, Any]:
        torque = p.k * (x.theta_m - x.theta_l) + p.c * (x.omega_m - x.omega_l)
        motor = (p.K * u.I - p.d_m * x.omega_m - torque) / p.J_m
        return {
            "theta_m": x.omega_m, "omega_m": motor,
            "theta_l": x.omega_l, "omega_l": (torque - p.d_l * x.omega_l) / p.J_l,
        }  # fmt: skip

    def frequencies(p: Any) -> dict[str, Any]:
        locked, joined = p.k / p.J_l, p.k * (1 / p.J_m + 1 / p.J_l)
        return {
            "antiresonance_hz": (ca.sqrt(locked) / (2 * ca.pi), "Hz"),
            "resonance_hz": (ca.sqrt(joined) / (2 * ca.pi), "Hz"),
        }

    return so.Plant(
        name="two-mass drive",
        states={"theta_m": "rad", "omega_m": "rad/s", "theta_l": "rad", "omega_l": "rad/s"},
        inputs={"I": "A"},
        outputs={"theta_m": "rad", "theta_l": "rad"},
        parameters={
            "J_m": "-",
            "J_l": "-",
            "k": "1/s^2",
            "c": "1/s",
            "d_m": "1/s",
            "d_l": "1/s",
            "K": "1/(A s^2)",
        },
        f=motion,
        h=lambda t, x, u, p: {"theta_m": x.theta_m, "theta_l": x.theta_l},
        derived=frequencies,
    )


def read(path: Path) -> so.Log:
    """Read the MAT file: time in microseconds, the load's angle with its sign flipped."""
    raw = scipy.io.loadmat(path, variable_names=["time", "iq_adx", "theta_mx", "theta_my"])
    column = {name: np.asarray(raw[name], dtype=float).ravel() for name in ("time", "iq_adx", "theta_mx", "theta_my")}
    return so.Log.from_arrays(
        time=column["time"], I=column["iq_adx"], theta_m=column["theta_mx"], theta_l=-column["theta_my"],
        units={"time": "us", "I": "A", "theta_m": "rad", "theta_l": "rad"}, source=str(path),
    )  # fmt: skip


def fit(path: Path) -> so.Fit:
    """Fit the drive to the log, from a guess that is off by factors of two to ten."""
    start = so.ParameterSet.of(
        J_m=1.0,
        J_l=(0.5, "-"),
        k=(1e5, "1/s^2"),
        c=(1.0, "1/s"),
        d_m=(1.0, "1/s"),
        d_l=(1.0, "1/s"),
        K=(1.0, "1/(A s^2)"),
    )
    positive = dict.fromkeys(("J_l", "k", "c", "d_m", "d_l", "K"), (0.0, np.inf))
    experiment = so.Experiment(plant=drive(), log=read(path), name="multisine", hold="first")
    return so.fit([experiment], start.bound(**positive).free(*positive), band_hz=BAND_HZ)


def main() -> None:
    """Print the fit and check what is known of the drive."""
    path = Path(sys.argv[1]) if len(sys.argv) > 1 else DATA
    if not path.exists():
        print(f"{path} is not there; give the path of MultisineTypeA.mat")
        raise SystemExit(2)
    result = fit(path)
    print(result)
    resonance, antiresonance = result.derived["resonance_hz"].value, result.derived["antiresonance_hz"].value
    assert abs(resonance / 76.2 - 1) < 0.01, resonance
    assert abs(antiresonance / 53.8 - 1) < 0.03, antiresonance
    print(f"resonance {resonance:.2f} Hz (76.2 seen in the FRF), antiresonance {antiresonance:.2f} Hz (53.8)")


if __name__ == "__main__":
    main()
