"""What an encoder at the motor alone tells: as many parameters as its transfer function's coefficients, by hand."""

import math

import numpy as np
import pytest

import seaopt as so

KNEE = {"J_m": 1e-4, "b_r": 1e-3, "K_tau": 0.05, "N": 50.0, "k_s": 300.0, "c_s": 0.5, "J_l": 0.1, "d_l": 0.2}
SCREW = {"J": 3e-6, "b_r": 2e-4, "k": 655e3, "m_l": 0.646, "m_2": 5.0, "K_tau": 0.0255}
RADIUS = 0.002 / (2 * math.pi * 3)


def free_link(p):
    below = np.array([p["J_l"], p["c_s"] + p["d_l"], p["k_s"]])
    coupled = np.polymul([p["c_s"], p["k_s"]], [p["J_l"], p["d_l"], 0.0]) / p["N"] ** 2
    return p["K_tau"] * below, np.polyadd(np.polymul([p["J_m"], p["b_r"], 0.0], below), coupled)


def held_link(p):
    gear = p["N"] ** 2
    return np.array([p["K_tau"]]), np.array([p["J_m"], p["b_r"] + p["c_s"] / gear, p["k_s"] / gear])


def screw_and_mass(p):
    """Spring at link 1, which is fixed: (m_l + m_2) x_2'' = -m_l q'' - k (q + x_2), M q'' + b q' - m_2 x_2'' = F_m."""
    below = np.array([p["m_l"] + p["m_2"], 0.0, p["k"]])
    drive = np.array([p["J"], p["b_r"], 0.0]) / RADIUS**2
    behind = np.polymul([p["m_2"], 0.0, 0.0], [p["m_l"], 0.0, p["k"]])
    return p["K_tau"] / RADIUS * below, np.polyadd(np.polymul(drive, below), behind)


def count_told(transfer, values, free):
    """Return the rank and the slopes, by relative changes, of the transfer function's coefficients, the first one 1."""

    def coefficients(log_change):
        above, below = transfer(
            {**values, **{n: values[n] * math.exp(c) for n, c in zip(free, log_change, strict=True)}}
        )
        told = np.concatenate([above, below]) / below[0]
        return np.log(told[told != 0.0])

    step = 1e-6 * np.eye(len(free))
    slopes = np.array([(coefficients(d) - coefficients(-d)) / 2e-6 for d in step]).T
    return int(np.linalg.matrix_rank(slopes, tol=1e-6)), slopes


INERT = ("J_m", "b_r", "k_s", "c_s", "J_l", "d_l")
SLIDE = ("J", "b_r", "k", "m_2", "K_tau")
CASES = {
    "torque known": (so.plants.rotary, {}, free_link, KNEE, "theta_m", INERT),
    "torque unknown": (so.plants.rotary, {}, free_link, KNEE, "theta_m", (*INERT, "K_tau")),
    "gear unknown": (so.plants.rotary, {}, free_link, KNEE, "theta_m", ("J_m", "k_s", "c_s", "J_l", "d_l", "N")),
    "link held": (so.plants.rotary, {"link": "locked"}, held_link, KNEE, "theta_m", ("J_m", "b_r", "k_s", "c_s")),
    "screw": (so.plants.two_link, {"link2": "mass"}, screw_and_mass, SCREW, "q", SLIDE),
}  # fmt: skip


@pytest.fixture(scope="module", params=CASES)
def case(request):
    make, options, transfer, values, output, free = CASES[request.param]
    plant, rng = make(**options), np.random.default_rng(0)
    params = plant.defaults.update(**{name: value for name, value in values.items() if name in plant.parameters})
    t = np.arange(2000) / 500
    current = np.convolve(rng.normal(size=t.size), np.ones(4) / 4, mode="same")
    run = so.simulate(plant, params, so.Log.from_arrays(time=t, I=current))
    noise = 1e-3 * np.std(run[output]) * rng.normal(size=t.size)
    log = so.Log.from_arrays(time=t, I=current, **{output: run[output] + noise})
    fit = so.fit([so.Experiment(plant=plant, log=log, outputs=(output,))], params.free(*free), diagnostics=False)
    found = {name: fit.parameters[name].value for name in free}
    return request.param, fit, free, *count_told(transfer, {**values, **found}, free)


def test_of_a_screw_its_sprung_mass_is_not_told():
    assert count_told(screw_and_mass, SCREW, ("J", "b_r", "k", "m_l", "m_2"))[0] == 4


def test_the_rank_is_that_of_the_coefficients(case):
    name, fit, free, rank, _ = case
    known = fit.identifiability
    assert (known.rank, known.free) == (rank, len(free))
    assert rank == {"torque known": 6, "torque unknown": 6, "gear unknown": 5, "link held": 3}.get(name, 4)
    assert (fit.status == "not_identifiable") == (rank < len(free))


def test_the_directions_change_no_coefficient(case):
    _, fit, free, rank, slopes = case
    assert len(fit.identifiability.unidentifiable) == len(free) - rank
    for direction in fit.identifiability.unidentifiable:
        moved = slopes @ np.array([direction.get(name, 0.0) for name in free])
        assert np.max(np.abs(moved)) < 0.01 * np.max(np.abs(slopes))


def test_it_is_said_in_words(case):
    name, fit, _, _, _ = case
    if name == "torque unknown":
        assert "K_tau" in fit.message
        assert "only in their ratios" in fit.message
        assert fit.derived["antiresonance_hz"].value == pytest.approx(math.sqrt(3000.0) / (2 * math.pi), rel=1e-2)
        assert fit.derived["antiresonance_hz"].std < 0.05
    if name == "link held":
        assert "b_r and c_s enter only together" in fit.message
