"""Actuators as they are: five kinds with physics that a fitted model may lack, and the logs that they would give.

A kind is written in seaopt's parameters, an effect as what it changes in `actuator.c`; `Actuator.record` plays a
current on it and returns readings with noise, quantisation and a jittering clock. Nothing of seaopt is used here.
"""

from __future__ import annotations

import ctypes
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import numpy as np

SOURCE = Path(__file__).with_name("actuator.c")
RATE_HZ, SUBSTEPS = 500.0, 200  # steps of 10 us
GRAVITY = 9.81
ASYMMETRY = 0.4  # of friction, at size 1


@dataclass(frozen=True, kw_only=True)
class Kind:
    """Parameters by seaopt's names, the largest current (A), and the sensors' standard deviations and steps."""

    values: Mapping[str, float]
    current: float
    noise: Mapping[str, float]
    step: Mapping[str, float]
    chirp_hz: tuple[float, float] = (0.1, 30.0)

    @property
    def linear(self) -> bool:
        """Whether it is a ball screw on the stand of Orekhov et al. 2015."""
        return "l" in self.values


def _rotary(*, torque: float, current: float, chirp_hz: tuple[float, float] = (0.1, 30.0), **values: float) -> Kind:
    return Kind(
        values={"eta": 1.0, "c_s": 0.0, "J_l": 0.25, "d_l": 0.3, "m": 2.5, "L": 0.2, "g": GRAVITY} | values,
        current=current,
        noise={"tau_s": torque, "theta_m": 1e-4, "theta_l": 2e-5},
        step={"tau_s": torque, "theta_m": 2 * np.pi / 16384, "theta_l": 2 * np.pi / 65536},
        chirp_hz=chirp_hz,
    )


KINDS = {
    "screw": Kind(
        values={
            "m_l": 0.646, "k": 655e3, "l": 0.002, "N_p": 3.0, "K_tau": 0.0255, "J": 3.31e-6, "b_r": 1.31e-4, "eta": 0.9,
            "f_c": 60.0,
        },
        current=5.0, noise={"F1": 2.0, "F2": 2.0}, step={"F1": 0.5, "F2": 0.5}, chirp_hz=(0.1, 60.0),
    ),
    "ankle": _rotary(J_m=3e-5, b_r=2e-4, K_tau=0.06, N=60.0, k_s=250.0, f_c=0.02, torque=0.05, current=6.0),
    "knee": _rotary(J_m=2.4e-5, b_r=1e-4, K_tau=0.05, N=100.0, k_s=300.0, f_c=0.012, torque=0.06, current=5.0),
    "direct": _rotary(
        J_m=6e-4, b_r=2e-3, K_tau=0.9, N=1.0, k_s=40.0, f_c=0.06, torque=0.01, current=4.0, chirp_hz=(0.1, 80.0)
    ),
    "hip": _rotary(J_m=1.5e-4, b_r=8e-4, K_tau=0.1, N=80.0, k_s=900.0, f_c=0.05, torque=0.15, current=12.0),
}  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Actuator:
    """An actuator of a kind, with its link held or a pendulum, and effects by name and size (1: as in truth.md).

    One that is `smooth` has no dry friction.
    """

    kind: str
    link: str = "locked"
    effects: Mapping[str, float] = field(default_factory=dict)
    delay_s: float = 0.0013
    smooth: bool = False

    @property
    def values(self) -> Mapping[str, float]:
        """The kind's parameters."""
        return {**KINDS[self.kind].values} | ({"f_c": 0.0} if self.smooth else {})

    @property
    def truth(self) -> Mapping[str, float]:
        """The values that a fit looks for: the tangent stiffness, the friction while it is cold.

        Of friction that depends on the direction it is the mean of both: a symmetrical model can have no other.
        """
        of_mean = {"direction": "f_c", "viscous_direction": "b_r"}
        values = dict(self.values)
        for effect, name in of_mean.items():
            values[name] *= 1.0 + 0.5 * ASYMMETRY * self.effects.get(effect, 0.0)
        return values

    def find_truth(self, *, seconds: float, seed: int) -> Mapping[str, float]:
        """Return the truth of a log at full amplitude: a second spring that never gave way in it is one with the first,
        and of the two no log has more than the sum.
        """
        values, p = dict(self.truth), _list_parameters(self)
        if p["hysteresis"]:
            current = self.draw_current(seconds, np.random.default_rng(seed))
            q, phi, *_ = self._play(np.ascontiguousarray(np.round(current, 3)), 1.0 / RATE_HZ, None).T
            if np.max(np.abs(q / p["ratio"] - phi)) < p["give_way"]:
                values["k" if KINDS[self.kind].linear else "k_s"] += p["hysteresis"]
        return values

    def draw_current(self, seconds: float, rng: np.random.Generator) -> np.ndarray:
        """Return a chirp on a multisine, of the largest amplitude."""
        time = np.arange(round(seconds * RATE_HZ)) / RATE_HZ
        return self._largest_current() * _excite(time, KINDS[self.kind].chirp_hz, rng)

    def record(self, *, seconds: float, amplitude: float, seed: int) -> dict[str, np.ndarray]:
        """Return time, current and readings under a chirp on a multisine; the amplitude is a share of the largest."""
        kind, rng = KINDS[self.kind], np.random.default_rng(seed)
        time = np.arange(round(seconds * RATE_HZ)) / RATE_HZ
        current = amplitude * self.draw_current(seconds, rng)
        outputs = self.simulate(current)
        readings = {name: _read(outputs[name], kind.noise[name], kind.step[name], rng) for name in outputs}
        jitter = rng.normal(scale=2e-5, size=time.size)
        return {"time": time + jitter, "I": np.round(current, 3), **readings}

    def _largest_current(self) -> float:
        """Return the drive's own limit, or what swings a pendulum that it could turn over."""
        kind = KINDS[self.kind]
        if self.link == "locked":
            return kind.current
        v = self.values
        weight = v["m"] * v["g"] * v["L"]
        return min(kind.current, (0.4 * weight + 2.0 * v["f_c"] * v["N"]) / (v["eta"] * v["K_tau"] * v["N"]))

    def simulate(self, current: np.ndarray) -> dict[str, np.ndarray]:
        """Return what the sensors would read without noise."""
        kind = KINDS[self.kind]
        q, phi, spring, outside = self._play(np.ascontiguousarray(np.round(current, 3)), 1.0 / RATE_HZ, None).T
        if kind.linear:
            return {"F1": spring, "F2": outside}
        return {"tau_s": spring, "theta_m": q} | ({"theta_l": phi} if self.link == "pendulum" else {})

    def close(
        self, law: Callable[[int, float, float], float], count: int, period: float, wait: int = 0
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the current and the spring's force of a loop: `law` turns the number of a sample, the force and the
        motor's position there into a current, which is put out `wait` samples later.
        """
        current, rows = np.zeros(count + wait), np.zeros((count, 4))

        def tick(i: int) -> None:
            current[i + wait] = law(i, float(rows[i, 2]), float(rows[i, 0]))

        self._play(current, period, tick, rows)
        return current[:count], rows[:, 2]

    def _play(
        self, current: np.ndarray, period: float, tick: Callable[[int], None] | None, rows: np.ndarray | None = None
    ) -> np.ndarray:
        """Return the rows of actuator.c; a tick may change the current."""
        parameters = _list_parameters(self)
        values = np.array([parameters[name] for name in _names()])
        rows = np.zeros((current.size, 4)) if rows is None else rows
        point, kind = ctypes.POINTER(ctypes.c_double), ctypes.CFUNCTYPE(None, ctypes.c_int)
        values_at, current_at, rows_at = (array.ctypes.data_as(point) for array in (values, current, rows))
        substeps = round(SUBSTEPS * RATE_HZ * period)
        called = kind() if tick is None else kind(tick)
        _library().simulate(values_at, current_at, len(rows), ctypes.c_double(period), substeps, rows_at, called)
        return rows


def _list_parameters(actuator: Actuator) -> dict[str, float]:
    """Return the parameters of actuator.c."""
    kind, v = KINDS[actuator.kind], actuator.values
    if kind.linear:
        per = v["l"] / (2 * np.pi * v["N_p"])
        base = {
            "inertia": v["J"] / per**2 + v["m_l"], "carried": v["m_l"], "ratio": 1.0, "stiffness": v["k"],
            "viscous": v["b_r"] / per**2, "force_per_ampere": v["eta"] * v["K_tau"] / per,
        }  # fmt: skip
    else:
        base = {
            "inertia": v["J_m"], "ratio": v["N"], "stiffness": v["k_s"], "viscous": v["b_r"],
            "spring_damping": v["c_s"], "force_per_ampere": v["eta"] * v["K_tau"],
        }  # fmt: skip
        if actuator.link == "pendulum":
            weight = v["m"] * v["g"] * v["L"]
            base |= {"link_inertia": v["J_l"], "link_damping": v["d_l"], "link_weight": weight}
    base |= {"coulomb": v["f_c"], "current_top": kind.current, "delay": actuator.delay_s, "stribeck_speed": 1.0}
    p = dict.fromkeys(_names(), 0.0) | base | {"viscous_back": base["viscous"], "coulomb_back": v["f_c"]}
    for name, size in actuator.effects.items():
        p |= EFFECTS[name](p, size)
    return p


def _top_deflection(p: Mapping[str, float]) -> float:
    """Return the spring's deflection under the largest static force."""
    return p["force_per_ampere"] * p["current_top"] * p["ratio"] / p["stiffness"]


def _give(p: Mapping[str, float], size: float) -> dict[str, float]:
    stand = 25.0 / size * p["stiffness"]
    inertia = stand / (2 * np.pi * 300.0) ** 2  # a frame whose own mode is at 300 Hz
    damping = 0.05 * 2.0 * np.sqrt(stand * inertia)
    return {"link_inertia": inertia, "link_damping": damping, "link_weight": stand, "link_is_stand": 1.0}


# What each changes at size 1; sizes are those that notes/truth.md met on actuators and in published logs.
EFFECTS = {
    "drift": lambda p, size: {"drift": 0.4 * size},
    "droop": lambda p, size: {"droop": 0.13 * size},
    "stribeck": lambda p, size: {"breakaway": 0.65 * size, "stribeck_speed": 0.02 * _top_speed(p)},
    "play": lambda p, size: {"play": 0.02 * size * _top_deflection(p)},
    "hardening": lambda p, size: {"hardening": 0.05 * size * p["stiffness"] / _top_deflection(p) ** 2},
    "hysteresis": lambda p, size: {
        "hysteresis": 0.1 * size * p["stiffness"], "give_way": 0.15 * _top_deflection(p),
    },
    "load": lambda p, size: {"load_driving": 0.08 * size, "load_driven": 0.08 * size},
    "efficiency": lambda p, size: {"load_driving": 0.1 * size, "load_driven": 0.03 * size},
    "direction": lambda p, size: {"coulomb_back": p["coulomb"] * (1 + ASYMMETRY * size)},
    "viscous_direction": lambda p, size: {"viscous_back": p["viscous"] * (1 + ASYMMETRY * size)},
    "lugre": lambda p, size: {
        "bristle": 60.0 * p["coulomb"] / _top_deflection(p) / p["ratio"] / size,
        "bristle_damping": p["viscous"],
    },
    "cogging": lambda p, size: {"cogging": 0.3 * size * p["coulomb"], "cogging_periods": 6 * p["ratio"] / 20.0},
    "current_loop": lambda p, size: {"current_loop": 120.0 / size},
    "sag": lambda p, size: {"sag": 0.03 * size / _top_speed(p)},
    "stand": _give,
}  # fmt: skip


def _top_speed(p: Mapping[str, float]) -> float:
    """Return the motor's speed where the largest current swings the spring at its natural frequency's third."""
    natural = np.sqrt(p["stiffness"] / p["ratio"] ** 2 / p["inertia"])
    return natural / 3.0 * _top_deflection(p) * p["ratio"]


def _excite(time: np.ndarray, band_hz: tuple[float, float], rng: np.random.Generator) -> np.ndarray:
    """Return a chirp on a slower multisine, at most 1."""
    low, high = band_hz
    growth = np.log(high / low)
    chirp = np.sin(2 * np.pi * low * time[-1] / growth * np.expm1(growth * time / time[-1]))
    slow = sum(np.sin(2 * np.pi * (f * time + rng.uniform())) for f in np.geomspace(3 * low, high / 4, 6))
    both = 0.6 * chirp + 0.25 * slow
    return both / np.max(np.abs(both))


def _read(values: np.ndarray, noise: float, step: float, rng: np.random.Generator) -> np.ndarray:
    return step * np.round((values + rng.normal(scale=noise, size=values.size)) / step)


@cache
def _library() -> ctypes.CDLL:
    compiler = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
    if compiler is None:
        raise SystemExit("this benchmark simulates in C: install a C compiler")
    with tempfile.TemporaryDirectory(prefix="truth") as folder:  # what is loaded needs its file no more
        target = Path(folder) / "actuator.so"
        subprocess.run([compiler, "-O2", "-std=c99", "-shared", "-fPIC", "-o", target, SOURCE, "-lm"], check=True)
        return ctypes.CDLL(str(target))


@cache
def _names() -> tuple[str, ...]:
    """Return the parameters' names in the order of actuator.c."""
    array = (ctypes.c_char_p * 64).in_dll(_library(), "parameter_names")
    names = []
    for name in array:
        if name is None:
            return tuple(names)
        names.append(name.decode())
    raise RuntimeError("actuator.c has more parameters than fit here")
