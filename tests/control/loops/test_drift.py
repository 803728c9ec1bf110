"""A link that nothing holds: the loop's figures without its drift, against the eigenvalues of the whole."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from scipy.linalg import expm

import seaopt as so
from seaopt.control.loops.drift import leave_out_drift
from seaopt.control.loops.sampled_plant import sample

PERIOD = 1e-3


def sample_whole(plant, params, output):
    """Return the exact sampled matrices of the whole plant, from its own linearisation."""
    whole = plant.linearize(params)
    n, row = whole.nstates, list(plant.outputs).index(output)
    block = expm(PERIOD * np.block([[whole.A, whole.B[:, :1]], [np.zeros((1, n + 1))]]))
    return block[:n, :n], block[:n, n], whole.C[row], whole.D[row, 0]


def respond(a, b, c, d, f):
    z = np.exp(2j * np.pi * f * PERIOD)
    return np.array([c @ np.linalg.solve(one * np.eye(b.size) - a, b) + d for one in z])


FREE = {
    "gear": (so.plants.rotary(link="free"), "tau_s", 1),
    "lumped gear": (so.plants.rotary(link="free", drive="lumped", spring="link1"), "tau_s", 1),
    "a screw and a mass": (so.plants.two_link(link1="fixed", link2="mass"), "F1", 1),
    # Where both are, how far they are apart, and how fast both go: of six states three are left.
    "a screw and two masses": (so.plants.two_link(link1="mass", link2="mass"), "F1", 3),
}


@pytest.mark.parametrize("name", FREE)
def test_only_the_drift_is_left_out(name):
    plant, output, level = FREE[name]
    params = plant.complete(plant.defaults)
    rest = leave_out_drift(plant, output)
    assert len(rest.states) == len(plant.states) - level
    a, b, c, d = sample_whole(plant, params, output)
    ours = sample(plant, params, output, 1.0, PERIOD, 0)
    f = np.geomspace(0.1, 400.0, 60)
    np.testing.assert_allclose(ours.response(f), respond(a, b, c, d, f), rtol=1e-6, atol=1e-12)
    # Of every loop, whatever the law, the poles but those at one.
    for gain in (0.0, 1e-3):
        whole, less = (
            np.linalg.eigvals(m - gain * np.outer(v, w)) for m, v, w in ((a, b, c), (ours.a, ours.b, ours.c))
        )
        order = np.argsort(np.abs(whole - 1.0))
        assert np.all(np.abs(whole[order[:level]] - 1.0) < 1e-6)
        remaining = list(whole[order[level:]])
        for pole in less:
            nearest = int(np.argmin(np.abs(np.array(remaining) - pole)))
            assert abs(remaining.pop(nearest) - pole) < 1e-6


def test_what_is_held_or_fed_back_stays():
    free, pendulum = so.plants.rotary(link="free"), so.plants.rotary(link="pendulum")
    assert leave_out_drift(free, "theta_l") is free  # a loop on the angle
    assert leave_out_drift(pendulum, "tau_s") is pendulum  # gravity
    bristles = so.plants.rotary(link="free", parts=("lugre",))
    assert leave_out_drift(bristles, "tau_s") is bristles
    stand = so.plants.high_impedance()
    assert leave_out_drift(stand, "F1") is stand


def hold_mass(stiffness):
    """Return a mass on a motor's spring, held by another spring whose stiffness is a parameter."""
    return so.Plant(
        name="cart", states={"y": "m", "v": "m/s", "x": "m", "w": "m/s"}, inputs={"F": "N"},
        outputs={"spring": "N", "x": "m"},
        parameters={
            name: so.Parameter(name=name, value=value, unit=unit)
            for name, value, unit in (("k", 1e4, "N/m"), ("k_e", stiffness, "N/m"), ("c", 5.0, "N s/m"))
        },
        f=lambda t, x, u, p: {
            "y": x.v, "v": u.F - p.c * x.v - p.k * (x.y - 2.0 * x.x),
            "x": x.w, "w": p.k * (x.y - 2.0 * x.x) - p.k_e * ca.sin(x.x),
        },
        h=lambda t, x, u, p: {"spring": p.k * (x.y - 2.0 * x.x), "x": x.x},
    )  # fmt: skip


def test_a_spring_that_starts_at_nothing_holds():
    plant = hold_mass(0.0)
    assert leave_out_drift(plant, "spring") is plant


@pytest.mark.parametrize(("structure", "damping"), [pytest.param("pd", 0.0, marks=pytest.mark.slow), ("pid", 0.1)])
def test_a_free_joint_is_tuned_and_certified(structure, damping):
    locked, free = so.plants.rotary(link="locked"), so.plants.rotary(link="free")
    params = so.ParameterSet.of(
        N=(100.0, "1"), K_tau=(0.0369, "N m/A"), eta=(0.7, "1"), J_m=(1.5e-5, "kg m^2"), b_r=(4e-4, "N m s"),
        k_s=(280.0, "N m/rad"), J_l=(0.6, "kg m^2"), d_l=(damping, "N m s/rad"),
    )  # fmt: skip
    spec = so.ControllerSpec(
        structure=structure, measured="tau_s", bandwidth_hz=15, max_sensitivity=1.7, max_noise_gain=45
    )
    controller = so.tune(locked, params, spec, robust_to={"free": free})
    assert controller.feasible
    figures = controller.close(free, params).figures()
    assert figures.stable
    assert figures.ms < 1.7 * 1.001
    plants = {"locked": locked, "free": free}
    certificate = so.certify(controller, plants, params, samples=10, simulations=structure == "pd")
    assert certificate.passed, certificate
