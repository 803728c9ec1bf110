"""A servo hub with a flexible link, on the measured log of ../shared/data/flexlink: hub angle and tip deflection.

The usual model takes the link as a rigid rod on a torsional spring: its deflection obeys
alpha'' + c alpha' + k alpha = -theta''. Fitted freely to this log that model wants negative damping, which no link has.
A second plant, the link alone on the measured hub angle, says why: the deflection follows the hub's acceleration 1.4
times as strongly as a rigid rod's would. A beam bends in its first mode, so that its base motion counts for more, and a
model without room for that leans on the damping instead. A uniform cantilever (Euler-Bernoulli, first mode) has
1.14 at the tip, and 1.33 where a gauge at the root was calibrated with a static force at the tip.

    python problems/flexlink.py [folder with data_vm.mat, data_theta.mat and data_alpha.mat]
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import casadi as ca
import scipy.io

import seaopt as so

DATA = Path(__file__).resolve().parents[2] / "shared" / "data" / "flexlink"
CLAMPED_HZ = 2.94  # published for the rigid rod on a spring


def rig() -> so.Plant:
    """Return hub and link: motor voltage in; the link is a rigid rod on a spring, all over the link's inertia.

    mu is the link's inertia over the hub's, K the motor's torque constant over the hub's inertia.
    """

    def motion(t: Any, x: Any, u: Any, p: Any) -> dict[str, Any]:
        spring = p.k * x.alpha + p.c * x.rate
        hub = p.K * u.V - p.d * x.omega - p.f_c * ca.tanh(x.omega / p.v_s) + p.mu * spring
        return {"theta": x.omega, "omega": hub, "alpha": x.rate, "rate": -spring - hub}

    return so.Plant(
        name="flexible link",
        states={"theta": "rad", "omega": "rad/s", "alpha": "rad", "rate": "rad/s"},
        inputs={"V": "V"},
        outputs={"theta": "rad", "alpha": "rad"},
        parameters={
            "K": "rad/(V s^2)", "d": "1/s", "f_c": "rad/s^2", "v_s": "rad/s", "mu": "-", "k": "1/s^2", "c": "1/s",
        },
        f=motion,
        h=lambda t, x, u, p: {"theta": x.theta, "alpha": x.alpha},
        derived=lambda p: {"clamped_hz": (ca.sqrt(p.k) / (2 * ca.pi), "Hz")},
    )  # fmt: skip


def link() -> so.Plant:
    """Return the link alone, driven by the measured hub angle: nothing of motor and friction matters here.

    The states are the tip's angle and v = its rate + c alpha, so that the hub angle is not differentiated.
    """
    return so.Plant(
        name="link on a moving hub",
        states={"tip": "rad", "v": "rad/s"},
        inputs={"theta": "rad"},
        outputs={"alpha": "rad"},
        parameters={"k": "1/s^2", "c": "1/s", "gamma": "-"},
        f=lambda t, x, u, p: {"tip": x.v - p.c * (x.tip - u.theta), "v": -p.k * (x.tip - u.theta)},
        h=lambda t, x, u, p: {"alpha": p.gamma * (x.tip - u.theta)},
        derived=lambda p: {"clamped_hz": (ca.sqrt(p.k) / (2 * ca.pi), "Hz")},
    )


def read(folder: Path) -> so.Log:
    """Read the three files, which share their time column."""
    table = {
        name: scipy.io.loadmat(folder / f"data_{name}.mat")[f"data_{name}"].astype(float)
        for name in ("vm", "theta", "alpha")
    }
    return so.Log.from_arrays(
        time=table["vm"][:, 0], V=table["vm"][:, 1], theta=table["theta"][:, 2], alpha=table["alpha"][:, 1],
        units={"V": "V", "theta": "deg", "alpha": "deg"}, source=str(folder),
    )  # fmt: skip


def fit_rig(log: so.Log, least_damping: float = 0.0) -> so.Fit:
    """Fit hub and link from rest; the link's damping is at least `least_damping` (1/s)."""
    guess = so.ParameterSet.of(
        K=(50.0, "rad/(V s^2)"), d=(30.0, "1/s"), f_c=(10.0, "rad/s^2"), v_s=(0.05, "rad/s"), mu=(1.0, "-"),
        k=(400.0, "1/s^2"), c=(0.5, "1/s"),
    )  # fmt: skip
    positive = dict.fromkeys(("K", "d", "f_c", "mu", "k"), (0.0, 1e4))
    bounded = guess.bound(**positive, c=(least_damping, 1e4)).free(*positive, "c")
    return so.fit([so.Experiment(plant=rig(), log=log, name="rig", offset=False, initial_state="rest")], bounded)


def fit_link(log: so.Log) -> so.Fit:
    """Fit the link alone, damping of either sign."""
    guess = so.ParameterSet.of(k=(400.0, "1/s^2"), c=(0.5, "1/s"), gamma=(1.0, "-"))
    bounded = guess.bound(k=(0.0, 1e5)).free("k", "c", "gamma")
    return so.fit([so.Experiment(plant=link(), log=log, name="link", hold="first")], bounded)


def main() -> None:
    """Print the three fits and check what is known of the link."""
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else DATA
    if not (folder / "data_vm.mat").exists():
        print(f"{folder / 'data_vm.mat'} is not there; give the folder of data_vm.mat")
        raise SystemExit(2)
    log = read(folder)
    bounded, free, alone = fit_rig(log), fit_rig(log, least_damping=-100.0), fit_link(log)
    for title, result in (("damping bounded at zero", bounded), ("damping free", free), ("link alone", alone)):
        print(f"--- {title}\n{result}")
    assert abs(bounded.derived["clamped_hz"].value / CLAMPED_HZ - 1) < 0.02, bounded.derived["clamped_hz"]
    assert bounded.parameters["c"].value >= 0.0
    assert free.parameters["c"].value < 0.0
    assert alone.parameters["c"].value > 0.0
    print(
        f"clamped {bounded.derived['clamped_hz'].value:.2f} Hz as a rigid rod ({CLAMPED_HZ} published); "
        f"the link alone {alone.derived['clamped_hz'].value:.2f} Hz, gamma {alone.parameters['gamma'].value:.2f}"
    )


if __name__ == "__main__":
    main()
