"""Coupled stability against a NumPy calculation from the equations, and against the passive band."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import cont2discrete

import seaopt as so
from seaopt.control.laws.passivity import passivity
from seaopt.errors import ControlError
from seaopt.robustness.verification.environments import (
    SPRING,
    attach_environment,
    close_on_environment,
    coupled_stability,
)
from tests.laws import scaled
from tests.words import flatten


@pytest.fixture(scope="module")
def controller(limited_controller):
    return limited_controller


@pytest.fixture(scope="module")
def found(controller, stand, thor):
    return coupled_stability(controller, stand, thor, points=15)


def by_hand(controller, thor, m_2, k_e, d_e):
    """Return the closed loop's poles from the paper's equations: own hold, own queue, own polynomials."""
    p = {name: item.value for name, item in thor.items()}
    r = p["l"] / (2 * np.pi * p["N_p"])
    big, b = p["J"] / r**2, p["b_r"] / r**2
    # M qdd = F_m - b qd - F2,  m_2 xdd = -F2 - k_e x - d_e xd,  F2 = k (q + x) + m_l (qdd + xdd)
    inertia = np.array([[big + p["m_l"], p["m_l"]], [p["m_l"], m_2 + p["m_l"]]])
    stiffness = np.array([[p["k"], p["k"]], [p["k"], p["k"] + k_e]])
    h = np.linalg.inv(inertia)
    a = np.block([[np.zeros((2, 2)), np.eye(2)], [-h @ stiffness, -h @ np.diag([b, d_e])]])
    drive = np.concatenate([[0, 0], h[:, 0] * p["K_tau"] / r * controller.command.per_effort])
    read = np.array([[p["k"], p["k"], 0.0, 0.0]])
    phi, gamma, *_ = cont2discrete((a, drive[:, None], read, np.zeros((1, 1))), 1e-3, "zoh")
    num, den = controller.measurement.num, controller.measurement.den
    n = den.size - 1
    # States: plant, the waiting command, the last n readings and commands; F_m = -(num y) - (den[1:] F_m before).
    size = 5 + 2 * n
    closed = np.zeros((size, size))
    command = np.zeros(size)
    command[:4] = -num[0] * read[0]
    command[5 : 5 + n], command[5 + n :] = -num[1 : n + 1], -den[1:]
    closed[:4, :4], closed[:4, 4] = phi, gamma[:, 0]
    closed[4] = command
    closed[5, :4], closed[5 + n] = read[0], command
    for i in range(1, n):
        closed[5 + i, 5 + i - 1] = closed[5 + n + i, 5 + n + i - 1] = 1.0
    return np.linalg.eigvals(closed)


@pytest.mark.parametrize("case", [(0.3, 1e3, 0.0), (5.0, 3e5, 0.0), (0.464, 10.0, 5.0), (80.0, 1e6, 100.0)])
def test_the_map_is_the_calculation_by_hand(controller, stand, thor, case):
    expected = by_hand(controller, thor, *case)
    largest = expected[np.argmax(np.abs(expected))]
    coupled = attach_environment(stand)
    one = close_on_environment(controller, coupled, coupled.complete(thor), *case)
    assert one.spectral_radius == pytest.approx(np.abs(largest), abs=1e-8)
    if one.spectral_radius > 1 + 1e-6:
        assert one.frequency_hz == pytest.approx(abs(np.angle(largest)) / (2e-3 * np.pi), rel=1e-6)


def test_an_actuators_own_k_e_stays_its_own(controller, stand, thor):
    """The back EMF of a probe may well be called k_e (V s/rad), and another of its parameters d_e."""
    probe = stand.port.probe()
    own = {"k_e": so.Parameter(name="k_e", value=0.5, unit="V s/rad"), "d_e": "m", SPRING.name: "rad"}

    def f(t, x, u, p):  # on top of the probe's: 300 N s/m times k_e = 0.5, by a screw of 1/(2 pi N_p) m
        rates = dict(probe.f(t, x, u, p))
        return rates | {"qd": rates["qd"] - 300.0 * p.k_e * x.qd + 0.0 * p.d_e * getattr(p, SPRING.name)}

    def make(k_e):
        changed = replace(probe, parameters={**probe.parameters, **own}, f=f)
        plant = replace(stand, ports=(replace(stand.port, probe=lambda: changed),))
        params = thor.with_parameters(*so.ParameterSet.of(k_e=(k_e, "V s/rad"), d_e=(1.0, "m")).values())
        params = params.with_parameters(so.Parameter(name=SPRING.name, value=1.0, unit="rad"))
        coupled = attach_environment(plant)
        return close_on_environment(controller, coupled, coupled.complete(params), 5.0, 3e5, 10.0).spectral_radius

    without = attach_environment(stand)
    expected = close_on_environment(controller, without, without.complete(thor), 5.0, 3e5, 10.0).spectral_radius
    assert make(0.0) == pytest.approx(expected, rel=1e-12)
    assert abs(make(0.5) - expected) > 1e-6


def test_every_point_of_the_map_is_its_own_loop(controller, stand, thor, found):
    coupled = attach_environment(stand)
    values = coupled.complete(thor)
    for d, m, k in ((0, 3, 4), (1, 7, 12), (3, 14, 0)):
        one = close_on_environment(controller, coupled, values, found.mass[m], found.stiffness[k], found.damping[d])
        assert found.spectral_radius[d, m, k] == pytest.approx(one.spectral_radius, abs=1e-9)


def test_the_boundary_is_where_a_pole_crosses_the_circle(controller, thor, found):
    edge = found.boundary[0]
    assert len(edge) > 10
    for m_2, k_e in edge[::7]:
        assert np.max(np.abs(by_hand(controller, thor, m_2, k_e, 0.0))) == pytest.approx(1.0, abs=1e-7)


def test_what_grows_swings_where_the_port_is_not_passive(controller, stand, thor, found):
    """Colgate and Hogan, both ways: undamped environments grow in the bands where Re Z < 0, and nowhere else."""
    bands = passivity(controller, stand, thor).bands_hz
    coupled = attach_environment(stand)
    seen = []
    for m_2, k_e in [(m, k) for m in found.mass[::2] for k in found.stiffness[::2]]:
        one = close_on_environment(controller, coupled, coupled.complete(thor), float(m_2), float(k_e), 0.0)
        if one.doubling_s is not None:
            seen.append(one.frequency_hz)
    assert len(seen) > 5
    for f in seen:
        assert not any(low * 1.02 < f < high * 0.98 for low, high in bands), f


def test_a_passive_loop_is_stable_against_everything(controller, stand, thor):
    """k_p alone, without delay's reach: 20 times slower sampling makes it passive nowhere; gains of zero everywhere."""
    silent = replace(controller, law=scaled(controller.law, 1.0, 0.0))
    assert passivity(silent, stand, thor).violated_hz is None
    assert coupled_stability(silent, stand, thor, points=8).everywhere


def test_the_missing_damping_is_what_the_passive_band_says(controller, stand, thor):
    """An environment that brings -min Re Z is stable with everything else; with half of it something is not."""
    needed = -passivity(controller, stand, thor).least_damping_N_s_per_m
    assert needed > 1.0
    enough, little = (
        coupled_stability(controller, stand, thor, dampings_N_s_per_m=(share * needed,), points=12)
        for share in (1.05, 0.5)
    )
    assert enough.everywhere
    assert not little.everywhere


def test_it_says_what_it_found(found):
    content = json.loads(json.dumps(found.to_dict(), allow_nan=False))
    assert content["stable_everywhere"] is False
    assert content["worst"]["doubling_s"] > 0.0
    text = flatten(repr(found))
    unstable = np.count_nonzero(~found.stable)
    assert f"Unstable against {unstable} of {found.stable.size} environments, and stable with link 2 fixed." in text
    assert f"whose oscillation at {found.worst.frequency_hz:.4g} Hz doubles in" in text


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"masses_kg": (0.0, 1.0)}, "masses_kg"),
        ({"stiffnesses_N_per_m": (5.0, 1.0)}, "stiffnesses"),
        ({"dampings_N_s_per_m": ()}, "dampings"),
        ({"points": 1}, "points"),
    ],
)
def test_bad_input(controller, stand, thor, options, words):
    with pytest.raises(ControlError, match=words):
        coupled_stability(controller, stand, thor, **options)


def test_a_plant_without_port(controller, stand, thor):
    with pytest.raises(ControlError, match="states no probe"):
        coupled_stability(controller, replace(stand, ports=(replace(stand.port, probe=None),)), thor)
