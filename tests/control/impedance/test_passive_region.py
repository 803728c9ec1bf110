"""The passive region of an impedance against closed forms, an independent simulator and the theorems on springs."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import seaopt as so
from seaopt.control import Impedance, ImpedanceRegion, Law, passive_region, passivity, render
from seaopt.control.impedance.link import ControlledLink, Load, find_link
from seaopt.control.impedance.moving_loop import close_link
from seaopt.control.impedance.region import needed_damper
from seaopt.control.impedance.rendering import find_breaking
from seaopt.control.impedance.sampled_port import SampledPort
from seaopt.control.loops.port import PortModel
from tests.sampled_links import find_radius

FREE, HELD = so.plants.rotary(), so.plants.rotary("locked")
KNEE = FREE.defaults.update(
    N=100.0, K_tau=0.0369, eta=0.7, J_m=2.4e-5, b_r=1e-4, k_s=300.0, J_l=0.25, d_l=0.3, f_c=0.0, c_s=0.0
)
SPEC = so.ControllerSpec(measured="tau_s", bandwidth_hz=15, max_sensitivity=1.6)


@pytest.fixture(scope="module")
def controller() -> so.Controller:
    return so.tune(HELD, KNEE, SPEC)


@pytest.fixture(scope="module")
def region(controller: so.Controller) -> ImpedanceRegion:
    return passive_region(controller, FREE, KNEE)


def make_rigid_link(sample_time_s: float, delay_samples: int) -> ControlledLink:
    """Return a motor that pushes a bare mass, its effort being its reference: a haptic display."""
    law = Law(
        a=np.zeros((0, 0)), b=np.zeros((0, 2)), c=np.zeros(0), d=np.array([1.0, 0.0]), sample_time_s=sample_time_s
    )
    a = np.array([[0.0, 1.0], [0.0, 0.0]])
    push = np.array([0.0, 1.0])
    port = PortModel(a=a, motor=push, force=push, read=np.array([[0.0, 0.0, 1.0, 0.0]]), speed=1, position=0, mass=1.0)
    return ControlledLink(port=port, load=Load(inertia=1.0), law=law, delay_samples=delay_samples, direction=1.0)


@pytest.mark.parametrize(("stiffness", "damping", "filter_s", "delay"), [
    (1000.0, 0.0, 0.0, 0), (1000.0, 2.0, 0.0, 0), (1000.0, -0.3, 0.0, 0), (500.0, 1.5, 4e-3, 0), (200.0, 1.0, 1e-3, 2),
])  # fmt: skip
def test_a_rigid_link_needs_the_damper_of_colgate_and_schenkel(
    stiffness: float, damping: float, filter_s: float, delay: int
) -> None:
    period = 1e-3
    q = np.exp(-1j * np.linspace(1e-4, np.pi, 200_001))
    h = (stiffness + damping * (1 - q) / (filter_s + period - filter_s * q)) * q**delay
    expected = float(np.max(period / 2 / (1 - np.real(q)) * np.real((1 - q) * h)))
    if not filter_s and not delay:
        assert expected == pytest.approx(stiffness * period / 2 + abs(damping), rel=1e-6)
    port = SampledPort(link=make_rigid_link(period, delay), velocity_filter_s=filter_s)
    impedance = Impedance(stiffness=stiffness, damping=damping, velocity_filter_s=filter_s)
    assert needed_damper(port, impedance) == pytest.approx(expected, rel=1e-3)


@pytest.mark.slow
def test_the_map_agrees_with_eigenvalues_against_environments(controller: so.Controller) -> None:
    rng = np.random.default_rng(3)
    link = find_link(controller, FREE, KNEE)
    port = SampledPort(link=link, velocity_filter_s=2e-3)
    theta = port.angles()
    per_effort = controller.command.per_effort
    loads = [(0.02 * ratio, 0.3, stiffness) for ratio in (0.05, 1.0, 5.0, 30.0) for stiffness in (0.0, 30.0, 4e3, 2e4)]
    counts = {True: 0, False: 0}
    for _ in range(25):
        impedance = Impedance(
            stiffness=rng.uniform(0, 300), damping=rng.uniform(-0.5, 5), velocity_filter_s=2e-3
        )  # fmt: skip
        gains = (impedance.stiffness, impedance.damping, 2e-3)
        passive = port.worst(impedance, 0.3, theta)[0] > 0.0
        counts[passive] += 1
        if passive:
            radii = [find_radius(KNEE, controller.law, controller.compute_delay_samples, per_effort, gains, load)
                     for load in loads]  # fmt: skip
            assert max(radii) <= 1.0 + 1e-9
            continue
        found = find_breaking(link, link.outer(impedance), port.find_failing_hz(impedance, 0.3))
        assert found is not None
        load = (0.25 + found.inertia, 0.3, found.stiffness)
        radius = find_radius(KNEE, controller.law, controller.compute_delay_samples, per_effort, gains, load)
        assert radius == pytest.approx(found.spectral_radius, abs=1e-9)
        assert radius > 1.0
    assert min(counts.values()) > 3


def test_without_an_outer_loop_it_is_the_passivity_of_the_force_loop(controller: so.Controller) -> None:
    rendering = render(controller, FREE, KNEE, Impedance(stiffness=0.0, damping=0.0))
    port = passivity(controller, FREE, KNEE)
    assert rendering.needed_damper == pytest.approx(-port.least_damping_N_s_per_m, rel=1e-3)


def link_of_gain(gain: float, sample_time_s: float, spring_damper: float, controller: so.Controller) -> ControlledLink:
    """Return the knee's link under u = (1 + k_p) F_ref - k_p F, without delay."""
    law = Law(
        a=np.zeros((0, 0)), b=np.zeros((0, 2)), c=np.zeros(0), d=np.array([1.0 + gain, -gain]),
        sample_time_s=sample_time_s,
    )  # fmt: skip
    values = KNEE.update(c_s=spring_damper, b_r=1e-3)
    return replace(find_link(controller, FREE, values), law=law, delay_samples=0)


@pytest.mark.parametrize("gain", [0.5, 3.0, 10.0])
def test_a_proportional_law_renders_up_to_the_spring_and_no_more(gain: float, controller: so.Controller) -> None:
    """Undelayed, Re Z >= 0 at all frequencies is D <= 0 and K <= k (1 + D (1 + k_p)/b)."""
    link = link_of_gain(gain, 1e-5, 0.0, controller)
    port = SampledPort(link=link, velocity_filter_s=1e-5)
    terms = port.terms(port.angles(), 1e-5)
    assert terms is not None
    damper = 100.0**2 * 1e-3 / (1.0 + gain)
    stiffness = np.linspace(0.0, 400.0, 1601)
    for share in (0.0, -0.1, -0.4):
        passive = terms.least(stiffness, np.full(stiffness.size, share * damper)) > 0.0
        assert np.max(stiffness[passive]) == pytest.approx(300.0 * (1.0 + share), abs=3.0)
        assert np.max(stiffness[passive]) < 300.0 * (1.0 + 1e-3)
    assert not np.any(terms.least(stiffness, np.full(stiffness.size, 0.3 * damper)) > 0.0)


def test_no_causal_law_renders_more_than_the_spring_without_a_damper() -> None:
    values = KNEE.update(d_l=0.0)
    slow = so.ControllerSpec(measured="tau_s", bandwidth_hz=15.0, compute_delay_samples=1, sample_rate_hz=4000.0)
    quick = so.ControllerSpec(
        measured="tau_s", structure="pd", bandwidth_hz=20.0, compute_delay_samples=0, sample_rate_hz=4000.0
    )  # fmt: skip
    for spec in (slow, quick):
        force = so.tune(HELD, values, spec)
        for damper in (1e-5, 1e-4):
            found = passive_region(force, FREE, values, link_damping=damper, points=2).stiffest
            assert found is None or found.stiffness <= 300.0 * (1.0 + 10.0 * damper)


def test_a_damper_parallel_to_the_spring_lets_more_be_rendered(controller: so.Controller) -> None:
    """Against Re Z of the series damped actuator, continuous and by hand."""
    gain, spring_damper = 3.0, 0.5
    link = link_of_gain(gain, 1e-5, spring_damper, controller)
    port = SampledPort(link=link, velocity_filter_s=1e-5)
    terms = port.terms(port.angles(), 1e-6)
    assert terms is not None
    stiffness, damping = (part.ravel() for part in np.meshgrid(
        np.linspace(270.0, 340.0, 15), np.linspace(0.0, 0.6, 13), indexing="ij"
    ))  # fmt: skip
    inertia, damper = 100.0**2 * 2.4e-5, 100.0**2 * 1e-3
    s = 2j * np.pi * np.geomspace(1e-2, 3e3, 20_000)
    spring, motor = 300.0 + spring_damper * s, inertia * s**2 + damper * s
    outer = (1.0 + gain) * (stiffness[:, None] + damping[:, None] * s)
    z = spring / s * (motor + outer) / (motor + (1.0 + gain) * spring)
    expected = np.min(np.real(z), axis=1)
    passive = terms.least(stiffness, damping) > 0.0
    clear = np.abs(expected) > 2e-3
    assert np.array_equal(passive[clear], expected[clear] > 0.0)
    assert np.max(stiffness[passive]) > 310.0  # more than the spring's 300


def test_a_damper_at_the_link_lets_more_be_rendered(controller: so.Controller) -> None:
    found = passive_region(controller, FREE, KNEE, link_damping=2.0, points=2).stiffest
    assert found is not None
    assert found.stiffness > 300.0


def test_nothing_is_passive_without_any_damper(controller: so.Controller) -> None:
    region = passive_region(controller, FREE, KNEE, link_damping=0.0, points=4)
    assert region.stiffest is None
    assert not np.any(region.passive)
    assert "nothing at the link takes energy" in repr(region)


def test_the_stiffest_is_on_the_edge(controller: so.Controller, region: ImpedanceRegion) -> None:
    stiffest = region.stiffest
    assert stiffest is not None
    assert render(controller, FREE, KNEE, stiffest).needed_damper == pytest.approx(0.3, rel=1e-3)
    harder = replace(stiffest, stiffness=1.01 * stiffest.stiffness)
    assert not render(controller, FREE, KNEE, harder).passive


def test_passive_gains_are_stable_by_themselves(region: ImpedanceRegion) -> None:
    assert np.all(region.stable[region.passive])
    assert np.any(region.stable & ~region.passive)


@pytest.mark.slow
def test_a_map_takes_less_than_five_seconds(controller: so.Controller) -> None:
    start = time.process_time()
    region = passive_region(controller, FREE, KNEE, points=100)
    assert region.margin.shape == (100, 100)
    assert time.process_time() - start < 5.0


def test_a_linear_actuator_pushes_the_other_way() -> None:
    thor, swing = so.plants.thor(), so.plants.moving_output()
    force = so.tune(so.plants.high_impedance(), thor, so.ControllerSpec(bandwidth_hz=30, max_sensitivity=1.6))
    link = find_link(force, swing, thor)
    assert link.direction == pytest.approx(-1.0, abs=1e-9)
    lever = 0.0725
    assert link.load.inertia == pytest.approx(0.36 / lever**2, rel=1e-9)
    assert link.load.stiffness == pytest.approx(4.0 * 9.81 * 0.3 / lever**2, rel=1e-6)
    rendering = render(force, swing, thor, Impedance(stiffness=20_000.0, damping=2_000.0), link_damping=200.0)
    assert rendering.stable
    assert rendering.passive


def test_a_dict_is_json(region: ImpedanceRegion) -> None:
    content = region.to_dict()
    assert content["units"] == {"stiffness": "N m/rad", "damping": "N m s/rad"}
    assert content["link_damping"] == pytest.approx(0.3)


@pytest.mark.parametrize(("wrong", "text"), [
    ({"stiffness": (5.0, 1.0)}, "stiffness"), ({"damping": (1.0, 1.0)}, "damping"), ({"points": 1}, "points"),
    ({"link_damping": -1.0}, "link_damping"), ({"velocity_filter_s": -1.0}, "velocity_filter_s"),
])  # fmt: skip
def test_bad_arguments_are_refused(wrong: dict[str, Any], text: str, controller: so.Controller) -> None:
    with pytest.raises(so.SeaoptError, match=text):
        passive_region(controller, FREE, KNEE, **wrong)


def test_a_held_link_is_refused(controller: so.Controller) -> None:
    with pytest.raises(so.SeaoptError, match="holds its link"):
        render(controller, HELD, KNEE, Impedance(stiffness=1.0, damping=0.0))
    with pytest.raises(so.SeaoptError, match="stiffness = -1"):
        Impedance(stiffness=-1.0, damping=0.0)


def test_the_free_link_is_that_of_its_own_plant() -> None:
    """Without an outer loop the poles are those of the plant whose link moves, which nothing here has built."""
    thor, stand, swing = so.plants.thor(), so.plants.high_impedance(), so.plants.moving_output()
    spec = so.ControllerSpec(bandwidth_hz=30, max_sensitivity=1.6)
    for held, free, values, asked in ((stand, swing, thor, spec), (HELD, FREE, KNEE, SPEC)):
        force = so.tune(held, values, asked)
        loop = close_link(find_link(force, free, values), 1e-3)
        expected = force.close(free, values).eigenvalues()
        found = loop.eigenvalues(0.0, 0.0)
        for pole in expected:
            assert np.min(np.abs(found - pole)) < 1e-6
