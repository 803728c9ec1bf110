"""Random requests of `so.tune`: a plant with its numbers, a specification, and other plants, many of them hostile."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

import seaopt as so
from seaopt.control import LinkFeedforward, Notch, Prefilter

FRICTIONS = ((), (), (), ("stribeck",), ("lugre",))
DELAYS = ((), (), ("current_loop",), ("measurement_delay",), ("load_cell",))
MORE = {"command_delay_s": 1.4e-3, "measurement_delay_s": 0.8e-3}


@dataclass(frozen=True)
class Request:
    """What `so.tune` is given."""

    plant: so.Plant
    params: so.ParameterSet
    spec: so.ControllerSpec
    robust_to: dict[str, so.Plant] = field(default_factory=dict)

    def tune(self) -> so.Controller:
        """Return what comes of it."""
        return so.tune(self.plant, self.params, self.spec, self.robust_to)

    def __str__(self) -> str:
        changed = {
            name: value for name, value in self.spec.to_dict().items()
            if value not in (None, getattr(so.ControllerSpec(), name))
        }  # fmt: skip
        return f"{self.plant.name} {sorted(self.robust_to)} {changed}"


def draw_request(rng: np.random.Generator) -> Request:
    """Draw one; limits are false, tight or loose, and some of these nothing can keep."""
    friction = FRICTIONS[rng.integers(len(FRICTIONS))]
    parts: list[Any] = [*friction, *DELAYS[rng.integers(len(DELAYS))]]
    rubs = bool(friction) or bool(rng.random() < 0.4)
    rotary = bool(rng.random() < 0.5)
    plant, params, swing = (_draw_rotary if rotary else _draw_linear)(rng, parts, rubs)
    measured = "tau_s" if rotary else "F1"
    structure = str(rng.choice(["pd", "pid", "pid", "pid_dob", "cascade"]))
    f_b = float(rng.uniform(8.0, 60.0))
    spec = so.ControllerSpec(
        measured=(measured, "thetad_m" if rotary else "qd") if structure == "cascade" else measured,
        structure=structure, bandwidth_hz=f_b, bandwidth_range_hz=_draw_range(rng, f_b),
        speed_loop=str(rng.choice(["P", "PI"])), notch=_draw_notch(rng, f_b), prefilter=_draw_prefilter(rng, f_b),
        link_feedforward=LinkFeedforward() if swing and rng.random() < 0.15 else None,
        reference_weights=str(rng.choice(["tuned", "error", "measurement"])),
        sample_rate_hz=float(rng.choice([500.0, 1e3, 2e3])), delay_samples=int(rng.integers(0, 4)),
        objective=str(rng.choice(["disturbance", "noise"])), **_draw_limits(rng),
    )  # fmt: skip
    robust_to = {"swing": swing} if spec.link_feedforward is not None or rng.random() < 0.2 else {}
    return Request(plant=plant, params=params, spec=spec, robust_to=robust_to)


def _draw_linear(rng: np.random.Generator, parts: list[Any], rubs: bool) -> tuple[so.Plant, so.ParameterSet, so.Plant]:
    plant, swing = so.plants.high_impedance(parts=parts), so.plants.moving_output(parts=parts)
    thor = so.plants.thor()
    spread = {"J": 0.8, "b_r": 1.0, "k": 0.8, "m_l": 0.5}
    values = {name: thor[name].value * np.exp(rng.uniform(-s, s)) for name, s in spread.items()}
    values |= {"I_p": rng.uniform(0.2, 0.6), "f_c": rng.uniform(10.0, 60.0) if rubs else 0.0}
    return plant, _complete(swing, values), swing


def _draw_rotary(rng: np.random.Generator, parts: list[Any], rubs: bool) -> tuple[so.Plant, so.ParameterSet, so.Plant]:
    plant, swing = (so.plants.rotary(link=link, parts=parts) for link in ("locked", "pendulum"))
    usual = {"J_m": 4e-5, "b_r": 5e-5, "K_tau": 0.06, "N": 90.0, "k_s": 400.0, "J_l": 0.3}
    values = {name: value * np.exp(rng.uniform(-0.6, 0.6)) for name, value in usual.items()}
    values |= {"eta": 0.8, "d_l": 0.3, "m": 4.0, "L": 0.2, "v_s": 1.0}
    values |= {"f_c": rng.uniform(0.003, 0.03) if rubs else 0.0}
    return plant, _complete(swing, values), swing


def _complete(plant: so.Plant, values: dict[str, float]) -> so.ParameterSet:
    values = {name: float(value) for name, value in (values | MORE).items() if name in plant.parameters}
    return plant.defaults.update(**values)


def _draw_range(rng: np.random.Generator, f_b: float) -> tuple[float, float]:
    return [(0.99 * f_b, 1.01 * f_b), (0.5 * f_b, 2.0 * f_b), (5.0, 60.0)][rng.integers(3)]


def _draw_notch(rng: np.random.Generator, f_b: float) -> Notch | None:
    if rng.random() < 0.7:
        return None
    given = {"frequency_hz": float(f_b * rng.uniform(1.3, 3.0)), "width": 0.3, "depth": 0.3}
    return Notch(**{name: value for name, value in given.items() if rng.random() < 0.3})


def _draw_prefilter(rng: np.random.Generator, f_b: float) -> Any:
    if rng.random() < 0.6:
        return None
    order = str(rng.choice(["first_order", "second_order"]))
    return order if rng.random() < 0.7 else Prefilter(order=order, corner_hz=float(f_b * rng.uniform(0.8, 3.0)))


def _draw_limits(rng: np.random.Generator) -> dict[str, Any]:
    """Draw limits: left out, false, tight or loose."""
    ranges = {
        "max_sensitivity": (1.1, 1.4, 2.5), "max_complementary": (1.0, 1.2, 2.0), "min_disk_margin": (1.3, 0.8, 0.3),
        "max_reference_peak": (1.01, 1.1, 2.0), "max_droop_db": (0.1, 0.5, 2.5), "max_noise_gain": (1.0, 20.0, 300.0),
        "max_other_noise_gain": (1e-2, 1.0, 1e4), "min_filter_samples": (3.0, 1.0, 0.1),
    }  # fmt: skip
    limits: dict[str, Any] = {}
    for name, (tight, usual, loose) in ranges.items():
        kind = rng.random()
        if kind < 0.15:
            limits[name] = False
        elif kind < 0.3:
            limits[name] = float(tight + rng.random() * (usual - tight))
        elif kind < 0.5:
            limits[name] = float(usual + rng.random() * (loose - usual))
    if rng.random() < 0.3:
        limits["min_sensitivity_bandwidth_hz"] = [False, 0.0, 1.0, 6.0][rng.integers(4)]
    if rng.random() < 0.1:
        limits["passive_band_hz"] = (1.0, float(rng.uniform(20.0, 100.0)))
    if rng.random() < 0.07:
        limits["min_friction_margin"] = float(10.0 ** rng.uniform(-3.0, 5.0))
    if rng.random() < 0.2:
        limits["reserve"] = [0.0, 0.05][rng.integers(2)]
    return limits
