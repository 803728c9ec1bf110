r"""Public records of nonlinear identification, by plants of a few lines: free-simulation error on the official split.

    python benchmarks/yardsticks.py emps|ced|silverbox FOLDER

FOLDER holds the files of nonlinearbenchmark.org: DATA_EMPS.mat and DATA_EMPS_PULSES.mat; DATAUNIF.MAT; SNLS80mV.mat.
Parameters are fitted on the training record alone. Of a test record the model is shown the readings that the official
loader (GerbenBeintema/nonlinear_benchmarks) grants for the initial state: 20 of EMPS, 50 of Silverbox. The drives' test
is the last fifth of the records whose first 400 samples train: they are simulated from their beginning, and the 4
readings that are granted are not used. The error is the RMS of what follows, in the units of Champneys et al., arXiv
2405.10779, whose figures for black boxes are printed beside.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from scipy.io import loadmat

import seaopt as so
from seaopt.plants import Friction

CORNER = 1e-2  # ticks/s: |omega| is rounded over this
SILVERBOX_HZ, DRIVES_S = 610.35, 0.02
DRIVE_GAIN = 35.15  # N/V, of EMPS, where its file does not say


@dataclass(frozen=True, kw_only=True)
class Test:
    """A record, how many of its first readings the model is shown, and from which sample on it is judged."""

    log: so.Log
    shown: int
    judged: int


@dataclass(frozen=True, kw_only=True)
class Yardstick:
    """A plant, its start, how its files are read, the factor to the published unit, and the published figures."""

    plant: Callable[[], so.Plant]
    start: so.ParameterSet
    read: Callable[[Path], tuple[list[so.Log], dict[str, Test]]]
    holds: tuple[str, ...]
    scale: float
    unit: str
    published: str


def read_columns(path: Path, *names: str) -> list[np.ndarray]:
    """Return the columns of a MAT file."""
    content = loadmat(path)
    return [np.asarray(content[name], dtype=float).ravel() for name in names]


def make_log(period: float, **channels: np.ndarray) -> so.Log:
    """Return a log from time zero."""
    n = len(next(iter(channels.values())))
    return so.Log.from_arrays(time=period * np.arange(n), **channels)


def read_emps(folder: Path) -> tuple[list[so.Log], dict[str, Test]]:
    """Return the trapezoids, and the test with pulses on them."""
    logs = []
    for name in ("DATA_EMPS.mat", "DATA_EMPS_PULSES.mat"):
        t, volts, q = read_columns(folder / name, "t", "vir", "qm")
        gain = float(np.ravel(loadmat(folder / name).get("gtau", DRIVE_GAIN))[0])
        logs.append(make_log(t[1] - t[0], F=gain * volts, q=q))
    return logs[:1], {"pulses": Test(log=logs[1], shown=20, judged=20)}


def read_ced(folder: Path) -> tuple[list[so.Log], dict[str, Test]]:
    """Return the first 400 samples of both records; the tests are the last 100."""
    low_u, high_u, low, high = read_columns(folder / "DATAUNIF.MAT", "u11", "u12", "z11", "z12")
    logs = {"low": make_log(DRIVES_S, u=low_u, y=low), "high": make_log(DRIVES_S, u=high_u, y=high)}
    train = [log.between(0.0, 399.5 * DRIVES_S) for log in logs.values()]
    return train, {f"{name}_amplitude": Test(log=log, shown=400, judged=404) for name, log in logs.items()}


def read_silverbox(folder: Path) -> tuple[list[so.Log], dict[str, Test]]:
    """Return three quarters of the multisines; the tests are the last quarter, and the arrow whole and cut."""
    columns = read_columns(folder / "SNLS80mV.mat", "V1", "V2")
    split = 40650 + (127400 - 40650) * 3 // 4

    def cut(begin: int, end: int) -> so.Log:
        return make_log(1.0 / SILVERBOX_HZ, **dict(zip("uy", (column[begin:end] for column in columns), strict=True)))

    tests = {"multisine": cut(split, 127400), "arrow": cut(100, 40575), "arrow_without_extrapolation": cut(100, 32100)}
    return [cut(40650, split)], {name: Test(log=log, shown=50, judged=50) for name, log in tests.items()}


def make_positioner() -> so.Plant:
    """Return a mass with viscous friction, and Coulomb friction that sticks; O is the force at rest."""
    return so.Plant(
        name="EMPS",
        states={"q": "m", "v": "m/s"},
        inputs={"F": "N"},
        outputs={"q": "m"},
        parameters={"M": "kg", "F_v": "N s/m", "F_c": "N", "O": "N"},
        f=lambda t, x, u, p: {"q": x.v, "v": (u.F - p.F_v * x.v - u.rub - p.O) / p.M},
        h=lambda t, x, u, p: {"q": x.q},
        friction={
            "rub": Friction(
                velocity=lambda x, p: x.v, force=lambda v, p: p.F_c * ca.tanh(v / 1e-3), jump=lambda speed, p: p.F_c
            )
        },
        sticks=True,
    )


def make_belt() -> so.Plant:
    """Return motors that drive a pulley by an elastic belt; the counter of its pulses does not tell the direction."""
    return so.Plant(
        name="coupled drives",
        states={"motor": "-", "stretch": "s", "pulley": "-"},
        inputs={"u": "V"},
        outputs={"y": "-"},
        parameters={"K": "1/V/s", "b": "1/s", "k_m": "1/s^2", "k_p": "1/s^2", "c": "s"},
        f=lambda t, x, u, p: {
            "motor": p.K * u.u - p.b * x.motor - p.k_m * (x.stretch + p.c * (x.motor - x.pulley)),
            "stretch": x.motor - x.pulley,
            "pulley": p.k_p * (x.stretch + p.c * (x.motor - x.pulley)),
        },
        h=lambda t, x, u, p: {"y": ca.sqrt(x.pulley**2 + CORNER**2)},
    )


def make_duffing() -> so.Plant:
    """Return a mass on a hardening spring, by its frequency and damping ratio; the force's zero and the sensor's."""
    return so.Plant(
        name="Silverbox",
        states={"x": "V", "v": "V/s"},
        inputs={"u": "V"},
        outputs={"y": "V"},
        parameters={"w": "1/s", "zeta": "-", "g": "-", "a_2": "1/V", "a_3": "1/V^2", "o": "V"},
        f=lambda t, x, u, p: {
            "x": x.v,
            "v": p.w**2 * (p.g * u.u - x.x - p.a_2 * x.x**2 - p.a_3 * x.x**3) - 2 * p.zeta * p.w * x.v,
        },
        h=lambda t, x, u, p: {"y": x.x + p.o},
    )


YARDSTICKS = {
    "emps": Yardstick(
        plant=make_positioner,
        start=so.ParameterSet.of(
            M=(50.0, "kg"), F_v=(100.0, "N s/m"), F_c=(10.0, "N"), O=(0.0, "N")
        ).free("M", "F_v", "F_c", "O").bound(F_c=(0.0, np.inf)),
        read=read_emps, holds=("zero",), scale=1e3, unit="mm",
        published="LSTM 74, RNN 89, OLSTM 111, FIR-MLP 121, GRU 220",
    ),
    "ced": Yardstick(
        plant=make_belt,
        start=so.ParameterSet.of(
            K=(30.0, "1/V/s"), b=(15.0, "1/s"), k_m=(300.0, "1/s^2"), k_p=(100.0, "1/s^2"), c=(0.01, "s")
        ).free("K", "b", "k_m", "k_p", "c").bound(K=(0.0, np.inf), c=(0.0, 1.0)),
        read=read_ced, holds=("zero",), scale=1.0, unit="ticks/s",
        published="low / high: ARX .291/.331, pNARX .100/.141, GP-NARX .102/.089, RNN .096/.235, FIR-MLP .122/.095",
    ),
    "silverbox": Yardstick(
        plant=make_duffing,
        start=so.ParameterSet.of(
            w=(2 * np.pi * 60, "1/s"), zeta=(0.05, "-"), g=(0.8, "-"),
            a_2=(0.0, "1/V"), a_3=(1.0, "1/V^2"), o=(0.0, "V"),
        ).free("w", "zeta", "g", "a_2", "a_3", "o"),
        read=read_silverbox, holds=("zero", "first"), scale=1e3, unit="mV",
        published="multisine / arrow / without: GRU 1.49/2.80/.95, LSTM 1.50/2.68/.96, OLSTM 1.51/2.38/1.08",
    ),
}  # fmt: skip


def hide(log: so.Log, output: str, shown: int) -> so.Log:
    """Return a log whose output is missing after the readings that may be used."""
    values = np.where(np.arange(len(log)) < shown, log[output], np.nan)
    return so.Log.from_arrays(**{**log.to_arrays(), output: values})


def run(yardstick: Yardstick, folder: Path) -> tuple[so.Fit, str, dict[str, float]]:
    """Fit the training record; return the fit, the hold of the input that explains it best, and the tests' errors."""
    plant = yardstick.plant()
    (output,) = plant.outputs
    train, tests = yardstick.read(folder)
    period = train[0].period
    delay = so.Parameter(name="delay", value=0.5 * period, unit="s", min=0.0, max=5.0 * period, free=True)

    def make_experiment(log: so.Log, name: str, hold: Any, **options: Any) -> so.Experiment:
        return so.Experiment(plant=plant, log=log, name=name, hold=hold, offset=False, **options)

    fits = {
        hold: so.fit(
            [make_experiment(log, f"train_{i}", hold, delay_s=delay) for i, log in enumerate(train)], yardstick.start
        )
        for hold in yardstick.holds
    }
    hold, fit = min(fits.items(), key=lambda pair: pair[1].aic)
    errors = {}
    for name, test in tests.items():
        left = (
            fit.predict(make_experiment(hide(test.log, output, test.shown), name, hold)).model[output]
            - test.log[output]
        )
        errors[name] = yardstick.scale * float(np.sqrt(np.mean(left[test.judged :] ** 2)))
    return fit, hold, errors


def main() -> None:
    """Print a record's errors beside the published ones."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("record", choices=YARDSTICKS)
    parser.add_argument("folder", type=Path)
    options = parser.parse_args()
    yardstick, started = YARDSTICKS[options.record], time.process_time()
    fit, hold, errors = run(yardstick, options.folder)
    print(fit)
    print(f"hold {hold}; {time.process_time() - started:.1f} s of processor time")
    for name, error in errors.items():
        print(f"{name}: {error:.4g} {yardstick.unit} in free simulation")
    print(f"published, {yardstick.unit}: {yardstick.published}")


if __name__ == "__main__":
    main()
