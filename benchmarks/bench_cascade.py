"""What a speed loop of the motor inside a force loop wins and costs, on the rotary knee of problems/knee.toml.

    python benchmarks/bench_cascade.py [SEEDS]

At the same Ms, Mt, reference peak, bandwidth and noise gain on the torque, each law with the least disturbance that a
long global search finds (scipy's differential evolution): a PID, and the same with the motor's speed fed back, which
the drive computes from its encoder by the difference over one sample. Limits and objective are computed here, by NumPy
alone, on the stand and with the shank free, friction sliding and stuck; what is found `seaopt.control.assess` measures.
"""

from __future__ import annotations

import sys

import numpy as np
from scipy.linalg import expm
from scipy.optimize import differential_evolution, minimize

import seaopt as so
from seaopt.control import assess, cascade_pid, parallel_pid

TS, BANDWIDTH = 1e-3, 15.0
STAND, SWING = so.plants.rotary(link="locked"), so.plants.rotary(link="pendulum")
VALUES = SWING.defaults.update(
    J_m=2.4e-5, b_r=1e-4, K_tau=0.0369, N=100.0, eta=0.7, k_s=300.0, f_c=0.005, v_s=1.0, J_l=0.25, d_l=0.3, m=4.0, L=0.2
)
MS, MT, PEAK, NOISE = 1.6, 1.3, 1.3, 45.0
RESERVE = 0.995  # as the tuner's: limits are kept with this much to spare
SENSORS = {"tau_s": 0.02, "theta_m": 2 * np.pi / 8192 / np.sqrt(12.0)}  # N m; rad: an encoder of 8192 steps, rounding
F = np.unique(np.concatenate([np.geomspace(0.1, 499.0, 500), np.linspace(0.5, 60.0, 240), [BANDWIDTH, 5.0, 3.0]]))
Q = np.exp(-2j * np.pi * F * TS)
LOW = [1e-2, 1e-1, 1e-5, TS, 0.0, 0.0, 0.0]
HIGH = [30.0, 1e3, 0.5, 2e-2, 2.0, 1.0, 1.0]  # k_p, k_i, k_d, T_f, k_v, k_r/(1 + k_p), c; of effort


def sample(free: bool, slope: float) -> np.ndarray:
    """Return torque and motor position per effort at F, one command late, with a friction of this slope."""
    v = {name: VALUES[name].value for name in VALUES}
    k, n, inertia, damping = v["k_s"], v["N"], v["J_m"], v["b_r"] + slope
    a = np.array([[0.0, 1.0], [-k / n**2 / inertia, -damping / inertia]])
    b, c = np.array([0.0, 1.0 / n / inertia]), np.array([[k / n, 0.0], [1.0, 0.0]])
    if free:
        stiffness, load = k + v["m"] * 9.81 * v["L"], v["J_l"]
        more = np.array([[0.0, 0.0, 0.0, 1.0], [k / n / load, 0.0, -stiffness / load, -v["d_l"] / load]])
        a = np.vstack([np.hstack([a, [[0.0, 0.0], [k / n / inertia, 0.0]]]), more])
        b, c = np.append(b, [0.0, 0.0]), np.hstack([c, [[-k, 0.0], [0.0, 0.0]]])
    size = b.size
    block = expm(np.block([[a, b[:, None]], [np.zeros((1, size + 1))]]) * TS)
    inner = 1.0 / Q[:, None, None] * np.eye(size) - block[:size, :size]
    return (np.linalg.solve(inner, np.broadcast_to(block[:size, size:], (F.size, size, 1)))[:, :, 0] @ c.T).T * Q


STEEPEST = VALUES["f_c"].value / VALUES["v_s"].value
PLANTS = [sample(free, slope) for free in (False, True) for slope in (0.0, STEEPEST)]  # the first is the design plant
WEIGHTS = np.where(BANDWIDTH + 1e-9 >= F, np.gradient(np.log(F)), 0.0)


def respond(x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return C_r and C_y of torque and of motor position."""
    k_p, k_i, k_d, T_f, k_v, share, c = x
    integral, rate = k_i * TS / 2 * (1 + Q) / (1 - Q), k_d * (1 - Q) / (T_f + TS - T_f * Q)
    return share * (1.0 + k_p) + integral + c * rate, k_p + integral + rate, k_v * (1 - Q) / TS


def judge(x: np.ndarray) -> tuple[float, float]:
    """Return the largest usage of a limit and the objective, the integral of abs(S) over ln f, of the worst plant."""
    c_r, c_y, c_v = respond(x)
    used, objective = 2 * np.pi * 0.05 * (1.0 + x[0]) / x[1], 0.0
    for number, (torque, position) in enumerate(PLANTS):
        distance = 1.0 + torque * c_y + position * c_v
        s, turn = 1.0 / distance, np.unwrap(np.angle(distance))
        if turn[-1] - turn[0] < -0.3 * np.pi:  # an encirclement
            return 1e3, 1e3
        used = max(used, np.max(np.abs(s)) / (RESERVE * MS), np.max(np.abs(1.0 - s)) / (RESERVE * MT))
        objective = max(objective, float(np.abs(s) @ WEIGHTS))
        if number < 2:  # the stand, sliding and stuck
            tracking = np.abs(torque * c_r * s)
            used = max(used, np.max(tracking) / (RESERVE * PEAK), np.max(np.abs(c_y * s)) / (RESERVE * NOISE))
            if number == 0:
                used = max(used, np.max(np.abs(s[F <= BANDWIDTH / 5])) * np.sqrt(2.0))
                used = max(used, np.max(10 ** (-1 / 20) / tracking[F <= BANDWIDTH / 3]))
                used = max(used, np.max(np.sqrt(0.5) / tracking[F < 0.97 * BANDWIDTH]))
                used = max(used, 1.0 + 3.0 * abs(np.log(tracking[F == BANDWIDTH][0] * np.sqrt(2.0))))
                later = (F > 1.03 * BANDWIDTH) & (F < 3.0 * BANDWIDTH)
                used = max(used, np.max(tracking[later] * np.sqrt(2.0) * (F[later] / BANDWIDTH) ** 0.25))
    return used, objective


def merit(x: np.ndarray) -> float:
    """Return the logarithm of the objective with a price on what is broken."""
    used, objective = judge(x)
    return float(np.log(objective) + 300.0 * max(0.0, used - 1.0))


def search(seed: int, largest_k_v: float) -> np.ndarray:
    """Return the best numbers found."""
    scaled = [(np.log(low), np.log(high)) for low, high in zip(LOW[:4], HIGH[:4], strict=True)]
    bounds = [*scaled, (0.0, largest_k_v), (0.0, 1.0), (0.0, 1.0)]

    def unpack(z: np.ndarray) -> np.ndarray:
        return np.concatenate([np.exp(z[:4]), z[4:]])

    found = differential_evolution(
        lambda z: merit(unpack(z)), bounds, seed=seed, maxiter=400, popsize=12, tol=1e-8, polish=False
    )
    fine = minimize(lambda z: merit(unpack(np.clip(z, *np.transpose(bounds)))), found.x, method="Nelder-Mead",
                    options={"maxiter": 4000, "xatol": 1e-7, "fatol": 1e-9})  # fmt: skip
    return unpack(np.clip(fine.x, *np.transpose(bounds)))


def measure(x: np.ndarray, objective: float) -> str:
    """Return a line on a law, as `assess` measures it."""
    k_p, k_i, k_d, T_f, k_v, share, c = x
    b = share * (1.0 + k_p) / k_p
    limits = {"bandwidth_hz": BANDWIDTH, "max_sensitivity": MS, "max_complementary": MT, "max_reference_peak": PEAK,
              "max_noise_gain": NOISE}  # fmt: skip
    if k_v:
        law = cascade_pid(k_v=k_v, k_p=k_p / k_v, k_i=k_i / k_v, k_d=k_d / k_v, T_f=T_f, b=b, c=c,
                          sample_time_s=TS)  # fmt: skip
        spec = so.ControllerSpec(measured=("tau_s", "thetad_m"), **limits)
    else:
        law = parallel_pid(k_p=k_p, k_i=k_i, k_d=k_d, T_f=T_f, b=b, c=c, sample_time_s=TS)
        spec = so.ControllerSpec(measured="tau_s", **limits)
    controller = assess(STAND, VALUES, law, spec, {"swing": SWING})
    a = controller.achieved
    _, c_y, c_v = respond(x)
    s = 1.0 / (1.0 + PLANTS[0][0] * c_y + PLANTS[0][1] * c_v)
    power = (np.abs(c_y * s) * SENSORS["tau_s"]) ** 2 + (np.abs(c_v * s) * SENSORS["theta_m"]) ** 2
    noise = np.sqrt(np.trapezoid(power, F) / 500.0)
    gains = f"k_p {k_p:.3g}, k_i {k_i:.3g}, k_d {k_d:.3g}, T_f {1e3 * T_f:.3g} ms, k_v {k_v:.3g}"
    other = f", {a.other_noise_gains[0]:.4g} N m/rad" if k_v else ""
    return (
        f"{'cascade' if k_v else 'pid':8s} integral of |S| {objective:.4f}, Ms {a.ms:.3f}, "
        f"noise gain {a.noise_gain:.3g}"
        f"{other}, sensitivity bandwidth {a.sensitivity_bandwidth_hz:.3g} Hz, bandwidth {a.bandwidth_hz:.4g} Hz, "
        f"delay margin {a.delay_margin_ms:.3g} ms, effort noise {noise:.3g} N m rms; {gains}"
        + ("" if controller.feasible else f"; misses {', '.join(controller.active_constraints)}")
    )


def main() -> None:
    """Print the best of each law."""
    seeds = int(sys.argv[1]) if len(sys.argv) > 1 else 3
    for largest in (0.0, HIGH[4]):
        best = min((search(seed, largest) for seed in range(seeds)), key=merit)
        used, objective = judge(best)
        print(measure(best, objective), f"(largest usage {used:.4f})")
    spec = so.ControllerSpec(measured="tau_s", bandwidth_hz=BANDWIDTH, max_sensitivity=MS, max_complementary=MT,
                             max_reference_peak=PEAK, max_noise_gain=NOISE)  # fmt: skip
    tuned = so.tune(STAND, VALUES, spec, {"swing": SWING})
    g = tuned.gains
    x = np.array([g["k_p"], g["k_i"], g["k_d"], g["T_f"], 0.0, g["k_r"] / (1.0 + g["k_p"]), g["c"]])
    print("tuned pid by so.tune: integral of |S|", round(judge(x)[1], 4), "feasible", tuned.feasible)


if __name__ == "__main__":
    main()
