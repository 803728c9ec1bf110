"""A plant of one's own on a measured log: the two-mass drive of ../shared/data/twomass.

Motor, flexible coupling and load, driven by a multisine; the log holds the motor current and both angles. Only ratios
to the motor inertia can be seen when neither torque nor inertia is known: J_m = 1 fixes the scale and everything else
is over J_m. The rigid mode drifts (friction that a linear plant does not have), so residuals are weighted to
11-250 Hz, the band of the excitation.

A tenth of the motion in that band is left over, and the antiresonance comes out 2.7 % high. That is not noise: all but
1 % of what is left, by energy, comes back in each of the 20 periods, four fifths of it at the resonance. Nor is it
friction: the load's own torque balance there, from the two angles alone, closes little better with a Coulomb term. It
closes with a spring that softens and a damping that grows with its twist; with both in the plant the misfit halves.

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
PERIOD = 2500  # samples in a period of the multisine
RATE_HZ = 2500.0
SETTLED = 2  # periods, of a second each, after which the response repeats
UNITS = {
    "J_m": "-", "J_l": "-", "k": "1/s^2", "c": "1/s", "d_m": "1/s", "d_l": "1/s", "K": "1/(A s^2)", "k_3": "1/s^2",
    "c_2": "1/s",
}  # fmt: skip
LINEAR = {"J_l": 0.5, "k": 1e5, "c": 1.0, "d_m": 1.0, "d_l": 1.0, "K": 1.0}


def drive(soft: bool = False) -> so.Plant:
    """Return the two-mass drive: angles of motor and load, joined by a spring with damping.

    A soft coupling has a cubic term k_3 in its torque, and a damping that grows with the square of the twist, c_2.
    """

    def motion(t: Any, x: Any, u: Any, p: Any) -> dict[str, Any]:
        twist, rate = x.theta_m - x.theta_l, x.omega_m - x.omega_l
        torque = p.k * twist + p.c * rate
        if soft:
            torque += p.k_3 * twist**3 + p.c_2 * twist**2 * rate
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
        parameters={name: unit for name, unit in UNITS.items() if soft or name not in ("k_3", "c_2")},
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
    """Fit the linear drive to the log, from a guess that is off by factors of two to ten."""
    guess = so.ParameterSet.of(J_m=1.0, **{name: (value, UNITS[name]) for name, value in LINEAR.items()})
    positive = dict.fromkeys(LINEAR, (0.0, np.inf))
    experiment = so.Experiment(plant=drive(), log=read(path), name="multisine", hold="first")
    return so.fit([experiment], guess.bound(**positive).free(*positive), band_hz=BAND_HZ)


def fit_soft(linear: so.Fit) -> so.Fit:
    """Fit the drive with a soft coupling to four periods of the same log, from the linear drive."""
    # A damping that the linear drive left at its bound starts from the guess again, as a start of zero has no scale.
    start = {name: (linear.parameters[name].value or guess, UNITS[name]) for name, guess in LINEAR.items()}
    soft = so.ParameterSet.of(J_m=1.0, **start, k_3=(-1e5, UNITS["k_3"]), c_2=(500.0, UNITS["c_2"]))
    bounded = soft.bound(**dict.fromkeys((*LINEAR, "c_2"), (0.0, np.inf))).free(*LINEAR, "k_3", "c_2")
    log = linear.experiments[0].log.between(SETTLED, SETTLED + 4)
    experiment = so.Experiment(plant=drive(soft=True), log=log, name="multisine", hold="first")
    return so.fit([experiment], bounded, band_hz=BAND_HZ, method=so.OutputError(search=False))


def spectra(values: np.ndarray) -> np.ndarray:
    """Return the spectrum of each settled period in the band, free of what drifts from one period to the next."""
    rows = values.reshape(-1, PERIOD)
    ends = np.append(values[::PERIOD], 2 * values[-1] - values[-2])
    line = ends[:-1, None] + np.diff(ends)[:, None] * np.arange(PERIOD) / PERIOD
    bins = slice(int(BAND_HZ[0]), int(BAND_HZ[1]) + 1)  # a period is a second: bins are Hz
    return np.fft.rfft((rows - line)[SETTLED:], axis=1)[:, bins]


def leftover(result: so.Fit, output: str) -> tuple[float, float]:
    """Return the shares of the residual's energy in the band that repeat each period, and that lie at 72 to 82 Hz."""
    predicted = result.predict(result.experiments[0])
    residual = spectra(predicted.measured[output] - predicted.model[output])
    total = float(np.mean(np.sum(np.abs(residual) ** 2, axis=1)))
    repeated = np.abs(residual.mean(axis=0)) ** 2
    near = slice(72 - int(BAND_HZ[0]), 83 - int(BAND_HZ[0]))
    return float(np.sum(repeated)) / total, float(np.sum(repeated[near])) / total


def balance(log: so.Log, band_hz: tuple[float, float], *extra: str) -> tuple[float, float]:
    """Close the load's torque balance on the mean period by least squares, with both angles as measured.

    Its acceleration is what twist, rate of twist and its own speed make of it; `extra` may add "coulomb" and "soft".
    No current and no simulation is in it.

    Returns
    -------
    antiresonance_hz, misfit : float
        From the twist's coefficient; the misfit over the acceleration, in the band.

    """
    frequency = np.fft.rfftfreq(PERIOD, 1 / RATE_HZ)

    def derivative(values: np.ndarray, order: int) -> np.ndarray:
        spectrum = np.fft.rfft(values) * (2j * np.pi * frequency) ** order
        return np.fft.irfft(np.where(frequency > 400.0, 0.0, spectrum), PERIOD)

    motor, load = (log[name].reshape(-1, PERIOD)[SETTLED:].mean(axis=0) for name in ("theta_m", "theta_l"))
    twist = motor - load - np.mean(motor - load)
    rate, speed = derivative(twist, 1), derivative(load, 1)
    terms = [twist, rate, speed]
    if "coulomb" in extra:
        terms.append(np.tanh(speed / 0.05))
    if "soft" in extra:
        terms += [twist**3, twist**2 * rate]
    chosen = (frequency >= band_hz[0]) & (frequency <= band_hz[1])
    a = np.stack([np.fft.rfft(term)[chosen] for term in terms], axis=1)
    y = np.fft.rfft(derivative(load, 2))[chosen]
    found = np.linalg.lstsq(np.vstack([a.real, a.imag]), np.concatenate([y.real, y.imag]), rcond=None)[0]
    misfit = float(np.linalg.norm(y - a @ found) / np.linalg.norm(y))
    return float(np.sqrt(found[0]) / (2 * np.pi)), misfit


def main() -> None:
    """Print the fit and check what is known of the drive."""
    path = Path(sys.argv[1]) if len(sys.argv) > 1 else DATA
    if not path.exists():
        print(f"{path} is not there; give the path of MultisineTypeA.mat")
        raise SystemExit(2)
    linear = fit(path)
    soft = fit_soft(linear)
    for title, result in (("linear", linear), ("soft coupling", soft)):
        resonance, antiresonance = (result.derived[name].value for name in ("resonance_hz", "antiresonance_hz"))
        print(f"--- {title}\n{result}")
        print(f"resonance {resonance:.2f} Hz (76.2 seen in the FRF), antiresonance {antiresonance:.2f} Hz (53.8)")
        assert abs(resonance / 76.2 - 1) < 0.01, resonance
        assert abs(antiresonance / 53.8 - 1) < 0.03, antiresonance
    repeats, near = leftover(linear, "theta_l")
    print(f"of the linear drive's residual {repeats:.0%} repeat each period, {near:.0%} at 72 to 82 Hz")
    for band_hz in (BAND_HZ, (60.0, 90.0)):
        for extra in ((), ("coulomb",), ("soft",)):
            seen, misfit = balance(linear.experiments[0].log, band_hz, *extra)
            name = " ".join(extra) or "linear"
            print(f"load's balance, {band_hz[0]:g}-{band_hz[1]:g} Hz, {name}: {seen:.2f} Hz, misfit {misfit:.2%}")
    assert repeats > 0.95
    assert soft.status == "converged"
    assert all(item.band_fit_percent > 94.0 for item in soft.outputs["multisine"].values())


if __name__ == "__main__":
    main()
