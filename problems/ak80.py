"""A pendulum on a measured log: the direct-drive swing-up of ../shared/data/ak80.

Torque and angle are measured; inertia, gravity torque and friction of the joint are fitted. A swing-up reaches every
angle, so that nothing is linear here, and friction is Coulomb and viscous.

Simulated in one go, an error of the measured torque is integrated twice and never forgotten, and small swings show
inertia and gravity torque nearly only as their ratio: the first half alone then gives an inertia a fifth too low. In
short stretches, each with an initial state of its own, the same model and the same log give it within 5 %. What comes
after is a swing through the upright position, where 1 % of torque moves the last angle by half a radian: a prediction
over a horizon says more about the model than one over the whole half.

    python problems/ak80.py [data_measured.csv]
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

import seaopt as so

DATA = Path(__file__).resolve().parents[2] / "shared" / "data" / "ak80" / "data_measured.csv"
HALF_S = 3.0
PIECE_S = 0.5
START = 51  # samples, a tenth of a second: a cubic through them gives angle and speed at a stretch's start
INERTIA = 0.19  # kg m^2, known


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


def read(path: Path) -> so.Log:
    """Read torque and angle."""
    channels: dict[str, Any] = {
        "tau": so.Column(column="torque", unit="N m"),
        "theta": so.Column(column="position", unit="rad"),
    }
    return so.read_log(path, time=so.Column(column="time", unit="s"), channels=channels)


def pieces(log: so.Log, start_s: float, stop_s: float, length_s: float) -> list[so.Log]:
    """Cut the log from start to stop into stretches of one length."""
    edges = np.arange(start_s, stop_s - 0.5 * length_s, length_s)
    return [log.between(edge, edge + length_s - 1e-3) for edge in edges.tolist()]


def fit(path: Path, holdout: float = 0.0) -> so.Fit:
    """Fit the pendulum to the log in one go, `holdout` of which is kept back at its end."""
    return _fitted([read(path)], holdout)


def fit_pieces(log: so.Log, start_s: float, stop_s: float, length_s: float = PIECE_S) -> so.Fit:
    """Fit the pendulum to stretches of the log, each with an initial state of its own."""
    return _fitted(pieces(log, start_s, stop_s, length_s), 0.0)


def _fitted(logs: list[so.Log], holdout: float) -> so.Fit:
    guess = so.ParameterSet.of(
        I_p=(0.3, "kg m^2"), mgL=(3.0, "N m"), d=(0.1, "N m s/rad"), tau_c=(0.1, "N m"), v_s=(0.1, "rad/s")
    )
    names = ("I_p", "mgL", "d", "tau_c")
    bounded = guess.bound(**dict.fromkeys(names, (0.0, 100.0))).free(*names)
    plant = pendulum()
    bench = [so.Experiment(plant=plant, log=log, name="swing-up", hold="first", offset=False) for log in logs]
    return so.fit(bench, bounded, holdout=holdout)


def predict(params: so.ParameterSet, log: so.Log, horizon_s: float) -> tuple[float, float]:
    """Return fit (%) and rms (rad) of the second half's angle, predicted over the horizon from the measured start."""
    measured, model = [], []
    for piece in pieces(log, HALF_S, 2 * HALF_S, horizon_s):
        clock = piece.time - piece.time[0]
        theta, omega = np.polyfit(clock[:START], piece["theta"][:START], 3)[[3, 2]]
        start = {"theta": float(theta), "omega": float(omega)}
        model.append(so.simulate(pendulum(), params, piece, initial_state=start, hold="first")["theta"])
        measured.append(piece["theta"])
    y, error = np.concatenate(measured), np.concatenate(measured) - np.concatenate(model)
    spread = float(np.linalg.norm(y - np.mean(y)))
    return 100 * (1 - float(np.linalg.norm(error)) / spread), float(np.sqrt(np.mean(error**2)))


def main() -> None:
    """Print the fit and check what is known of the pendulum."""
    path = Path(sys.argv[1]) if len(sys.argv) > 1 else DATA
    if not path.exists():
        print(f"{path} is not there; give the path of data_measured.csv")
        raise SystemExit(2)
    log = read(path)
    once, cut, whole = fit(path, holdout=0.5), fit_pieces(log, 0.0, HALF_S), fit_pieces(log, 0.0, 2 * HALF_S)
    cases = {"first half in one go": once, "first half in stretches": cut, "whole log in stretches": whole}
    for title, result in cases.items():
        print(f"{title}: {result.status}")
        print(so.ParameterSet(item for item in result.parameters.values() if item.free))
        for horizon_s in (HALF_S, 1.0, 0.5):
            percent, rms = predict(result.parameters, log, horizon_s)
            print(f"  second half over {horizon_s:g} s: fit {percent:.1f} %, rms {rms:.3f} rad")
    assert abs(cut.parameters["I_p"].value / INERTIA - 1) < 0.1
    assert abs(whole.parameters["I_p"].value / INERTIA - 1) < 0.1
    assert predict(cut.parameters, log, 0.5)[0] > 98.0
    assert predict(cut.parameters, log, 1.0)[0] > 94.0


if __name__ == "__main__":
    main()
