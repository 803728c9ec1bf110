"""A pendulum on a measured log: the direct-drive swing-up of ../shared/data/ak80, fitted on its first half.

Torque and angle are measured; inertia, gravity torque and friction of the joint are fitted. A swing-up reaches every
angle, so that nothing is linear here, and friction is Coulomb and viscous.

    python problems/ak80.py [data_measured.csv]
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import casadi as ca

import seaopt as so

DATA = Path(__file__).resolve().parents[2] / "shared" / "data" / "ak80" / "data_measured.csv"


def pendulum() -> so.Plant:
    """Return a pendulum driven by a torque: inertia, gravity torque m g L, viscous and Coulomb friction."""
    return so.Plant(
        name="pendulum",
        states={"theta": "rad", "omega": "rad/s"},
        inputs={"tau": "N m"},
        outputs={"theta": "rad"},
        parameters={"I_p": "kg m^2", "mgL": "N m", "d": "N m s/rad", "tau_c": "N m", "v_s": "rad/s"},
        f=lambda t, x, u, p: {
            "theta": x.omega,
            "omega": (u.tau - p.mgL * ca.sin(x.theta) - p.d * x.omega - p.tau_c * ca.tanh(x.omega / p.v_s)) / p.I_p,
        },
        h=lambda t, x, u, p: {"theta": x.theta},
        derived=lambda p: {"natural_frequency_hz": (ca.sqrt(p.mgL / p.I_p) / (2 * ca.pi), "Hz")},
    )


def fit(path: Path, holdout: float = 0.0) -> so.Fit:
    """Fit the pendulum to the log, `holdout` of which is kept back at its end."""
    channels: dict[str, Any] = {
        "tau": so.Column(column="torque", unit="N m"),
        "theta": so.Column(column="position", unit="rad"),
    }
    log = so.read_log(path, time=so.Column(column="time", unit="s"), channels=channels)
    guess = so.ParameterSet.of(
        I_p=(0.3, "kg m^2"), mgL=(3.0, "N m"), d=(0.1, "N m s/rad"), tau_c=(0.1, "N m"), v_s=(0.1, "rad/s")
    )
    names = ("I_p", "mgL", "d", "tau_c")
    bounded = guess.bound(**dict.fromkeys(names, (0.0, 100.0))).free(*names)
    bench = so.Experiment(plant=pendulum(), log=log, name="swing-up", hold="first", offset=False)
    return so.fit([bench], bounded, holdout=holdout)


def main() -> None:
    """Print the fit and check what is known of the pendulum."""
    path = Path(sys.argv[1]) if len(sys.argv) > 1 else DATA
    if not path.exists():
        print(f"{path} is not there; give the path of data_measured.csv")
        raise SystemExit(2)
    result = fit(path, holdout=0.5)
    print(result)


if __name__ == "__main__":
    main()
