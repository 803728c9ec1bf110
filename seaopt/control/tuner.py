r"""Place a bandwidth under limits on several plants at once.

The loop gains of all plants are affine in (k_p, k_i, k_d) at a given filter, so that every limit is a smooth function
of four numbers on a set of frequencies:

.. math::
    |1 + L_i|^2 \ge M_s^{-2}, \qquad |L_i|^2 \le M_t^2 |1 + L_i|^2 \qquad \text{(every plant } i\text{)} \\
    |P C_r|^2 \le M_r^2 |1 + L|^2, \quad |C_y|^2 \le N^2 |1 + L|^2, \quad
    |1 + L|^2 \ge 2 \; (f \le f_s), \quad |P C_r|^2 \ge \tfrac12 |1 + L|^2 \; (f \le f_b) \quad \text{(design plant)}

with equality of the last at :math:`f_b`. A coarse scan finds starts; from the best, an interior-point method (IPOPT,
exact CasADi derivatives) minimises the objective with one slack for all limits, so that a problem without solution
still ends in the controller that misses them least. The result is then measured by `Loop.figures`, which does not use
the grid; frequencies where a limit is broken between points are added, and the last step repeated. What is returned
as feasible has been measured to be so.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np
from jaxtyping import Complex, Float

from seaopt.control.controller import Controller
from seaopt.control.digital import DigitalPlant, sample
from seaopt.control.law import Gains
from seaopt.control.loop import Loop, LoopFigures
from seaopt.control.spec import ControllerSpec
from seaopt.errors import ControlError
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant

LOWEST_HZ = 0.1
INTEGRAL_RAD_S = 2 * np.pi * 0.05  # k_i / (1 + k_p) at least, so that the integral does something
BANDWIDTH_TOLERANCE = 0.005
STARTS = 3
ROUNDS = 5


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Task:
    """A specification with the plants it is to hold for; the first is the design plant."""

    spec: ControllerSpec
    plants: tuple[DigitalPlant, ...]
    names: tuple[str, ...]
    k_ff: float


def current_per_force(plant: Plant, params: ParameterSet) -> float:
    """Return r/(eta K_tau) of (2) and (3), A/N; one over the torque constant where the plant has no screw.

    Raises
    ------
    ControlError
        The plant's parameters do not say what force a current makes.

    """
    complete = plant.complete(params)
    if all(name in complete for name in ("l", "N_p", "K_tau", "eta")):
        lead, ratio, torque, eta = complete.values_of(("l", "N_p", "K_tau", "eta"))
        if torque * eta <= 0.0 or ratio <= 0.0:
            raise ControlError(f"K_tau = {torque:g}, eta = {eta:g}, N_p = {ratio:g}: all must be positive")
        return lead / (2 * np.pi * ratio) / (eta * torque)
    raise ControlError(
        f"plant {plant.name} has no l, N_p, K_tau, eta that say what force a current makes; "
        "use a plant with the actuator's parameters"
    )


def tune(
    plant: Plant,
    params: ParameterSet,
    spec: ControllerSpec,
    robust_to: Mapping[str, Plant | tuple[Plant, ParameterSet]] | None = None,
) -> Controller:
    """Tune a digital force controller.

    Parameters
    ----------
    plant, params
        The design plant, the test stand as a rule, and its parameters.
    spec : ControllerSpec
        Bandwidth and limits.
    robust_to : mapping of name to Plant or (Plant, ParameterSet), optional
        Plants that must be stable and meet Ms and Mt too, driven by the same current.

    Returns
    -------
    Controller
        With `feasible` False, and the limits that block in `active_constraints`, when the limits cannot all be met;
        it is then the controller found that misses them least.

    Raises
    ------
    ControlError
        The measured output does not respond to the motor at 0 Hz, or the plant is unstable without control.

    Examples
    --------
    >>> import seaopt as so
    >>> spec = so.ControllerSpec(bandwidth_hz=30, max_sensitivity=1.6)
    >>> controller = so.tune(so.plants.high_impedance(), so.plants.thor(), spec)
    >>> controller.feasible, round(controller.achieved.bandwidth_hz)
    (True, 30)

    """
    task = _task(plant, params, spec, robust_to or {})
    frequencies = _frequencies(task)
    candidates = [_polish(task, frequencies, start) for start in _scan(task, frequencies)[:STARTS]]
    measured = [(x, _measured(task, x)) for x in candidates]
    x, figures = min(measured, key=lambda found: _rank(task, *found))
    return _controller(task, x, figures, plant, params)


def _task(
    plant: Plant, params: ParameterSet, spec: ControllerSpec,
    robust_to: Mapping[str, Plant | tuple[Plant, ParameterSet]],
) -> Task:  # fmt: skip
    gain = current_per_force(plant, params)
    if not isinstance(robust_to, Mapping):
        raise ControlError(f"robust_to is a {type(robust_to).__name__}; give a mapping of name to plant")
    names = ("design plant", *robust_to)
    pairs = [(plant, params), *(p if isinstance(p, tuple) else (p, params) for p in robust_to.values())]
    plants = tuple(
        sample(model, values, spec.measured, gain, spec.sample_time_s, spec.delay_samples) for model, values in pairs
    )
    static = plants[0].static_gain
    if not np.isfinite(static) or abs(static) < 1e-6:
        raise ControlError(
            f"measured = {spec.measured}: the static gain of {plant.name} from motor force is {static:g}, which "
            "feedforward cannot invert; tune on the stand and name this plant in robust_to"
        )
    for name, sampled in zip(names, plants, strict=True):
        if np.max(np.abs(np.linalg.eigvals(sampled.a))) > 1.0 + 1e-9:
            raise ControlError(f"plant {name} is unstable without control, which the tuner does not treat")
    return Task(spec=spec, plants=plants, names=names, k_ff=1.0 / static)


def _gains(task: Task, x: Float[np.ndarray, " 4"]) -> Gains:
    return Gains(
        k_p=float(x[0]), k_i=float(x[1]), k_d=float(x[2]), T_f=float(x[3]), k_ff=task.k_ff,
        derivative=task.spec.derivative,
    )  # fmt: skip


def _loop(task: Task, x: Float[np.ndarray, " 4"], plant: int = 0) -> Loop:
    reference, measurement = _gains(task, x).transfer_functions(task.spec.structure, task.spec.sample_time_s)
    return Loop(plant=task.plants[plant], reference=reference, measurement=measurement)


def _frequencies(task: Task) -> Float[np.ndarray, " m"]:
    """Return a logarithmic grid, finer about lightly damped plant modes, with f_b in it.

    Steps there are zeta f / 4, or as small as 80 points allow; what falls between is found and added by `_polish`.
    """
    nyquist = 0.5 / task.spec.sample_time_s
    points = [np.geomspace(LOWEST_HZ, 0.999 * nyquist, 220), [task.spec.bandwidth_hz]]
    for plant in task.plants:
        poles = np.log(np.linalg.eigvals(plant.a).astype(complex)) / plant.sample_time_s
        for pole in poles[poles.imag > 0]:
            f, zeta = abs(pole) / (2 * np.pi), -pole.real / abs(pole)
            if zeta < 0.2:
                reach = max(4 * zeta, 0.02) * f
                points.append(np.linspace(f - reach, f + reach, int(min(2 * reach / max(zeta * f / 4, 1e-4), 80))))
    grid = np.unique(np.concatenate([np.asarray(p) for p in points]))
    return grid[(grid >= LOWEST_HZ) & (grid < nyquist)]


def _limits(spec: ControllerSpec) -> dict[str, float]:
    """Return the peak limits with the reserve taken off; infinite where none is imposed."""
    keep = 1.0 - spec.reserve
    given = {
        "ms": spec.max_sensitivity, "mt": spec.max_complementary, "reference_peak": spec.max_reference_peak,
        "noise_gain": spec.max_noise_gain,
    }  # fmt: skip
    return {name: np.inf if value is None else max(value * keep, 1e-6) for name, value in given.items()}


def _scan(task: Task, f: Float[np.ndarray, " m"]) -> list[Float[np.ndarray, " 4"]]:
    """Return starts, best first: a coarse grid of gains ranked by how far they miss bandwidth and limits."""
    spec, limits = task.spec, _limits(task.spec)
    ts, low = spec.sample_time_s, f <= spec.bandwidth_hz
    coarse = np.unique(np.concatenate([np.arange(0, f.size, 3), [int(np.searchsorted(f, spec.bandwidth_hz))]]))
    f, low = f[coarse], low[coarse]
    target = int(np.searchsorted(f, spec.bandwidth_hz))
    responses = [plant.response(f) for plant in task.plants]
    scored: list[tuple[float, Float[np.ndarray, " 4"]]] = []
    q = np.exp(-2j * np.pi * f * ts)
    k_p, k_d = (g.ravel()[:, None] for g in np.meshgrid(np.geomspace(0.03, 100, 15), np.geomspace(2e-4, 1.0, 15)))
    for t_f in np.array([0.3, 1.0, 3.0]) * ts:
        derivative = (1 - q) / (t_f + ts - q * t_f)
        for rate in (1.0, 10.0) if spec.structure == "pid" else (0.0,):
            k_i = np.maximum(rate, 1.5 * INTEGRAL_RAD_S) * (1 + k_p) if rate else 0.0 * k_p
            c_y = k_p + k_i * ts / 2 * (1 + q) / (1 - q) + k_d * derivative
            c_r = c_y + task.k_ff - (k_d * derivative if spec.derivative == "measurement" else 0.0)
            miss = np.zeros(k_p.size)
            for i, p in enumerate(responses):
                distance = np.abs(1 + p * c_y)
                miss += np.maximum(0.0, np.log(1 / np.min(distance, axis=1) / min(limits["ms"], 4.0))) * 3
                turn = np.unwrap(np.angle(1 + p * c_y), axis=1)
                miss += 10.0 * (np.abs(turn[:, -1] - turn[:, 0]) > 1.5 * np.pi)
                if i == 0:
                    t_r = np.abs(p * c_r) / distance
                    miss += 3.0 * np.abs(np.log(t_r[:, target] * np.sqrt(2)))
                    miss += np.maximum(0.0, np.log(0.7 / np.min(t_r[:, low], axis=1))) * 2
                    if np.isfinite(limits["noise_gain"]):
                        miss += np.maximum(0.0, np.log(np.max(np.abs(c_y) / distance, axis=1) / limits["noise_gain"]))
            order = np.argsort(miss)[:6]
            for k in order:
                x = np.array([k_p[k, 0], k_i[k, 0], k_d[k, 0], t_f])
                scored.append((float(miss[k]), x))
    scored.sort(key=lambda item: item[0])
    distinct: list[Float[np.ndarray, " 4"]] = []
    for _, x in scored:
        far = all(np.max(np.abs(np.log((x + 1e-9) / (other + 1e-9)))) > 0.5 for other in distinct)
        if far and _stable(task, x):
            distinct.append(x)
        if len(distinct) == STARTS:
            break
    return distinct or [np.array([0.01, 0.0, 1e-4, ts])]  # next to no feedback: stable as the plants are


@lru_cache(maxsize=16)
def _program(plants: int, m: int, feedback_only: bool) -> tuple[Any, Any]:
    """Return the IPOPT solver and the constraint function for `plants` plants on `m` frequencies."""
    x = ca.MX.sym("x", 4)  # k_p, k_i, k_d, T_f in the scales s
    t, slack = ca.MX.sym("t"), ca.MX.sym("slack")
    data = {
        name: ca.MX.sym(name, rows, cols)
        for name, rows, cols in (
            ("pr", m, plants), ("pi", m, plants), ("cos", m, 1), ("sin", m, 1), ("ts", 1, 1), ("kff", 1, 1),
            ("s", 4, 1), ("limit", 4, 1), ("low", m, 1), ("slow", m, 1), ("at", m, 1), ("quad", m, 1), ("mode", 1, 1),
        )
    }  # fmt: skip
    gains = x * data["s"]
    k_p, k_i, k_d, t_f = (gains[i] for i in range(4))
    c, s, ts = data["cos"], data["sin"], data["ts"]
    # q = c - j s. Tustin: (1 + q)/(1 - q) = -j s/(1 - c). D = (1 - q)/(a - q b) with a = T_f + T_s, b = T_f.
    a, b = t_f + ts, t_f
    dr, di, er, ei = 1 - c, s, a - b * c, b * s
    size = er**2 + ei**2
    d_re, d_im = (dr * er + di * ei) / size, (di * er - dr * ei) / size
    cy_re, cy_im = k_p + k_d * d_re, -k_i * ts / 2 * s / (1 - c) + k_d * d_im
    cr_re, cr_im = data["kff"] + cy_re, cy_im
    if feedback_only:
        cr_re, cr_im = cr_re - k_d * d_re, cr_im - k_d * d_im
    ms, mt, mr, noise = (data["limit"][i] for i in range(4))  # squares of the limits' inverses
    rows: list[Any] = []
    bandwidth = energy = t_r = ca.MX()
    for i in range(plants):
        p_re, p_im = data["pr"][:, i], data["pi"][:, i]
        l_re, l_im = p_re * cy_re - p_im * cy_im, p_re * cy_im + p_im * cy_re
        distance = (1 + l_re) ** 2 + l_im**2
        rows += [ms - distance, (l_re**2 + l_im**2) * mt - distance]
        rows.append(ca.dot(data["quad"], 1 / ca.sqrt(distance)) - t)
        if i == 0:
            t_r = (p_re**2 + p_im**2) * (cr_re**2 + cr_im**2) / distance
            rows += [t_r * mr - 1, (cy_re**2 + cy_im**2) / distance * noise - 1]
            rows += [data["slow"] * (2 / distance - 1), data["low"] * (1 - 2 * t_r)]
            bandwidth = ca.dot(data["at"], t_r) - 0.5
            energy = (cy_re**2 + cy_im**2) / distance
    relaxed = [row if row.numel() == 1 else row - slack for row in rows]
    integral = INTEGRAL_RAD_S * (1 + k_p) - k_i
    smooth_noise = ca.sumsqr(energy) ** 0.25  # an L8 norm in place of the peak
    objective = data["mode"] * smooth_noise * 0.05 + (1 - data["mode"]) * t + 1e3 * slack
    g = ca.vertcat(bandwidth, *relaxed, integral / data["s"][1])
    names = list(data)
    nlp = {
        "x": ca.vertcat(x, t, slack),
        "p": ca.vertcat(*(ca.vec(data[name]) for name in names)),
        "f": objective,
        "g": g,
    }
    options = {
        "print_time": False, "ipopt": {"print_level": 0, "sb": "yes", "max_iter": 150, "tol": 1e-7,
        "acceptable_tol": 1e-5, "mu_init": 1e-2, "max_wall_time": 20.0},
        "error_on_fail": False, "show_eval_warnings": False,
    }  # fmt: skip
    return ca.nlpsol("tune", "ipopt", nlp, options), names


def _solve(task: Task, f: Float[np.ndarray, " m"], start: Float[np.ndarray, " 4"]) -> Float[np.ndarray, " 4"]:
    """Minimise the objective from `start` on the frequencies f."""
    spec, limits, pid = task.spec, _limits(task.spec), task.spec.structure == "pid"
    solver, names = _program(len(task.plants), f.size, spec.derivative == "measurement")
    ts, w = spec.sample_time_s, 2 * np.pi * f * spec.sample_time_s
    p: Any = np.column_stack([plant.response(f) for plant in task.plants])
    inside = f <= spec.bandwidth_hz
    logs = np.log(f / LOWEST_HZ)
    quad = np.zeros(f.size)
    k = int(np.count_nonzero(inside))
    quad[: k - 1] += 0.5 * np.diff(logs[:k])
    quad[1:k] += 0.5 * np.diff(logs[:k])
    scale = np.maximum(np.abs(start), [0.1, 0.1, 1e-4, 0.1 * ts])
    data = {
        "pr": p.real, "pi": p.imag, "cos": np.cos(w), "sin": np.sin(w), "ts": ts, "kff": task.k_ff, "s": scale,
        "limit": [limits[name] ** -2.0 for name in ("ms", "mt", "reference_peak", "noise_gain")],
        "low": (f < 0.97 * spec.bandwidth_hz).astype(float),
        "slow": (f <= spec.sensitivity_bandwidth_limit_hz).astype(float),
        "at": (f == spec.bandwidth_hz).astype(float), "quad": quad, "mode": float(spec.objective == "noise"),
    }  # fmt: skip
    vector = ca.vertcat(*(ca.vec(ca.DM(data[name])) for name in names))
    top = [np.inf, np.inf if pid else 0.0, np.inf, 4.0 / (2 * np.pi * spec.bandwidth_hz) / scale[3]]
    count = int(solver.size_out("g")[0])
    lower = np.full(count, -np.inf)
    lower[0] = 0.0
    upper = np.zeros(count)
    if not pid:
        upper[-1] = np.inf
    x0 = np.concatenate([start / scale, [logs[k - 1], 0.1]])
    found = solver(x0=x0, p=vector, lbg=lower, ubg=upper, lbx=[0, 0, 0, 0, 0, 0], ubx=[*top, np.inf, np.inf])
    return np.array(found["x"]).ravel()[:4] * scale


def _polish(task: Task, f: Float[np.ndarray, " m"], start: Float[np.ndarray, " 4"]) -> Float[np.ndarray, " 4"]:
    """Solve, measure, add the frequencies where a limit is broken between points, and repeat.

    An unstable outcome is not taken: the last stable gains, at worst the start, are returned.
    """
    x, limits = start, _limits(task.spec)
    for _ in range(ROUNDS):
        trial = np.maximum(_solve(task, f, x), 0.0)
        if not np.all(np.isfinite(trial)) or not _stable(task, trial):
            return x
        x = trial
        added: list[float] = []
        for i in range(len(task.plants)):
            loop = _loop(task, x, i)
            dense = loop.grid()
            dense = dense[dense >= LOWEST_HZ]
            s, open_loop = np.abs(loop.sensitivity(dense)), np.abs(loop.open_loop(dense))
            for curve, limit in ((s, limits["ms"]), (s * open_loop, limits["mt"])):
                top = int(np.argmax(curve))
                if curve[top] > limit * (1 + 1e-4) and np.min(np.abs(f - dense[top])) > 1e-4 * dense[top]:
                    added.append(float(dense[top]))
        if not added:
            break
        f = np.unique(np.concatenate([f, added]))
    return x


def _stable(task: Task, x: Float[np.ndarray, " 4"]) -> bool:
    """Tell whether every plant's loop is stable, by its eigenvalues."""
    return all(np.max(np.abs(_loop(task, x, i).eigenvalues())) < 1.0 for i in range(len(task.plants)))


def _measured(task: Task, x: Float[np.ndarray, " 4"]) -> list[LoopFigures]:
    return [_loop(task, x, i).figures() for i in range(len(task.plants))]


def _used(task: Task, figures: list[LoopFigures]) -> list[tuple[str, float]]:
    """Return each peak limit that is imposed, with the plant where it holds for all, and how much of it is used."""
    spec, design = task.spec, figures[0]
    peaks = [
        (limit, f"{limit} ({name})", value)
        for name, item in zip(task.names, figures, strict=True)
        for limit, value in (("max_sensitivity", item.ms), ("max_complementary", item.mt))
    ]
    peaks += [
        (limit, limit, value)
        for limit, value in (
            ("max_reference_peak", design.reference_peak),
            ("max_noise_gain", design.noise_gain),
        )
    ]
    imposed = [(label, value, getattr(spec, limit)) for limit, label, value in peaks]
    return [(label, value / allowed) for label, value, allowed in imposed if allowed is not None]


def _broken(task: Task, figures: list[LoopFigures], slack: float = 1e-6) -> list[str]:
    """Return the limits that the measured figures break, with the plant that breaks them."""
    spec, design = task.spec, figures[0]
    out = [f"stability ({name})" for name, item in zip(task.names, figures, strict=True) if not item.stable]
    out += [label for label, used in _used(task, figures) if used > 1 + slack]
    reached = design.bandwidth_hz
    if reached is None or abs(reached / spec.bandwidth_hz - 1) > BANDWIDTH_TOLERANCE:
        out.append("bandwidth_hz")
    if design.sensitivity_bandwidth_hz < spec.sensitivity_bandwidth_limit_hz * (1 - 1e-3):
        out.append("min_sensitivity_bandwidth_hz")
    return out


def _active(task: Task, figures: list[LoopFigures]) -> list[str]:
    """Return the limits that are met with no more than the reserve and a hundredth to spare."""
    near = 1.0 - task.spec.reserve - 0.01
    out = [label for label, used in _used(task, figures) if used > near]
    if figures[0].sensitivity_bandwidth_hz < 1.01 * task.spec.sensitivity_bandwidth_limit_hz:
        out.append("min_sensitivity_bandwidth_hz")
    return out


def disturbance(loop: Loop, bandwidth_hz: float) -> float:
    """Return the integral over ln f of abs(S) from 0.1 Hz to the bandwidth."""
    f = np.geomspace(LOWEST_HZ, bandwidth_hz, 2000)
    s: Complex[np.ndarray, " m"] = loop.sensitivity(f)
    return float(np.trapezoid(np.abs(s), np.log(f)))


def _rank(task: Task, x: Float[np.ndarray, " 4"], figures: list[LoopFigures]) -> tuple[float, float]:
    """Return what to sort candidates by: limits broken first, then the objective."""
    if task.spec.objective == "noise":
        value = figures[0].noise_gain
    else:
        value = max(disturbance(_loop(task, x, i), task.spec.bandwidth_hz) for i in range(len(task.plants)))
    return float(len(_broken(task, figures))), value


def _controller(
    task: Task, x: Float[np.ndarray, " 4"], figures: list[LoopFigures], plant: Plant, params: ParameterSet
) -> Controller:
    spec, gains = task.spec, _gains(task, x)
    broken = _broken(task, figures)
    reference, measurement = gains.transfer_functions(spec.structure, spec.sample_time_s)
    return Controller(
        structure=spec.structure,
        gains={"k_p": gains.k_p, "k_i": gains.k_i, "k_d": gains.k_d, "T_f": gains.T_f, "k_ff": gains.k_ff},
        sample_time_s=spec.sample_time_s,
        delay_samples=spec.delay_samples,
        reference=reference,
        measurement=measurement,
        current_per_force_A_per_N=current_per_force(plant, params),
        spec=spec,
        achieved=figures[0],
        feasible=not broken,
        active_constraints=tuple(broken or _active(task, figures)),
        robust_to=task.names[1:],
        design=(plant, params),
    )
