"""The sampled delay margin against eigenvalues of the loop with delay as states, densely scanned, in NumPy alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm

import seaopt as so
from seaopt.parameters import Parameter
from seaopt.plants import Plant
from seaopt.robustness import plant_margins
from seaopt.robustness.uncertainty.delay_margin import sampled_delay_margin
from tests.laws import law_of, scaled

TS = 1e-3


def modes(*shapes):
    """Second-order modes (hz, zeta, static gain) side by side."""
    scale = Parameter(name="s", value=1.0, unit="-")

    def f(t, x, u, p):
        out = {}
        for i, (hz, zeta, gain) in enumerate(shapes):
            w, q, v = 2 * np.pi * hz, getattr(x, f"q{i}"), getattr(x, f"v{i}")
            out |= {f"q{i}": w * v, f"v{i}": w * (gain * p.s * u.I - q - 2 * zeta * v)}
        return out

    return Plant(
        name="modes", states={f"{k}{i}": "N" for i in range(len(shapes)) for k in "qv"}, inputs={"I": "A"},
        outputs={"F1": "N"}, parameters={"s": scale}, f=f,
        h=lambda t, x, u, p: {"F1": p.s * sum(getattr(x, f"q{i}") for i in range(len(shapes)))},
    )  # fmt: skip


def radii(shapes, law, delays):
    """Spectral radii under u = -law y with delays in seconds, the controller's among them: every command a state."""
    n, count = 2 * len(shapes), len(delays)
    block, c = np.zeros((n + 1, n + 1)), np.zeros(n)
    for i, (hz, zeta, gain) in enumerate(shapes):
        w = 2 * np.pi * hz
        block[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] = w * np.array([[0, 1], [-1, -2 * zeta]])
        block[2 * i + 1, n], c[2 * i] = w * gain, 1.0
    whole = np.floor(delays / TS + 1e-12).astype(int)
    full = expm(block * TS)
    newer = expm(block * (TS - (delays - whole * TS))[:, None, None])[:, :n, n]
    chain = whole.max() + 1  # commands waiting; those that no delay reaches are zero eigenvalues
    drive = np.zeros((count, n, chain + 1))  # the newer command acts at the end of the period, the older before
    rows = np.arange(count)
    drive[rows, :, whole], drive[rows, :, whole + 1] = newer, full[:n, n] - newer
    big = np.zeros((count, n + chain, n + chain))
    big[:, :n, :n] = full[:n, :n] - law * drive[:, :, :1] * c
    big[:, :n, n:] = drive[:, :, 1:]
    big[:, n, :n] = -law * c
    big[:, range(n + 1, n + chain), range(n, n + chain - 1)] = 1.0
    return np.max(np.abs(np.linalg.eigvals(big)), axis=1)


@pytest.fixture(scope="module")
def base(stand, thor):
    return so.tune(stand, thor, so.ControllerSpec(bandwidth_hz=30, max_sensitivity=1.6))


def closed(base, plant, gain):
    spec = so.ControllerSpec(bandwidth_hz=30, measured="F1")
    return replace(
        base,
        law=law_of([gain]),
        command=replace(base.command, per_effort=1.0),
        spec=spec,
        design=(plant, plant.defaults),
    )


LOOPS = {
    "several crossings": ([(5.0, 0.5, 1.5), (15.0, 0.02, 0.06), (33.0, 0.02, 0.05)], 0.9),
    "the hold decides": ([(300.0, 0.3, 0.8), (20.0, 0.4, 0.6)], 0.8),
    **{
        f"a mode at {hz:g} Hz that barely crosses, {law:+g}": ([(hz, 0.01, 0.02 * peak / np.sinc(hz * TS))], law)
        for hz, peak, law in [
            (30.0, 1.003, 1), (90.0, 1.001, 1), (90.0, 1.003, -1), (140.0, 1.001, 1), (140.0, 1.006, -1)
        ]
    },
}  # fmt: skip


@pytest.mark.parametrize("name", list(LOOPS))
def test_it_is_where_a_dense_scan_first_finds_an_eigenvalue_outside(name, base):
    shapes, law = LOOPS[name]
    plant = modes(*shapes)
    controller = closed(base, plant, law)
    edge = plant_margins(controller, plant, plant.defaults).sampled_delay_s
    assert edge is not None
    assert np.max(radii(shapes, law, TS + np.linspace(0.0, edge * (1 - 1e-7), 400))) < 1.0
    assert radii(shapes, law, np.array([TS + edge * (1 + 1e-7)]))[0] > 1.0


def test_a_loop_that_no_delay_disturbs_has_none(base):
    plant = modes((30.0, 0.01, 0.0199))
    figures = plant_margins(closed(base, plant, 1.0), plant, plant.defaults)
    assert figures.margins.phase_deg is None
    assert figures.sampled_delay_s is None


def test_a_delay_that_is_there_stays(base):
    """The margin is of what comes on top."""
    shapes, law = LOOPS["several crossings"]
    plant = modes(*shapes)
    controller = closed(base, plant, law)
    alone = sampled_delay_margin(controller, plant, plant.defaults, 1.0)
    late = plant.defaults.with_parameters(Parameter(name="delay_s", value=0.7e-3, unit="s"))
    assert sampled_delay_margin(controller, plant, late, 1.0) == pytest.approx(alone - 0.7e-3, rel=1e-9)


def test_a_slow_loops_margin_of_seconds_is_found(base):
    """An integral of 0.1 rad/s: a quarter of its period, 15 s, is 15,700 samples; the closed form is pi/2 / 0.1 s."""
    plant = modes((300.0, 0.7, 1.0))
    law = law_of([5e-5, 5e-5], [1.0, -1.0])
    controller = replace(closed(base, plant, 1.0), law=law)
    figures = plant_margins(controller, plant, plant.defaults)
    assert figures.searched_delay_s == pytest.approx(20.0)
    assert figures.sampled_delay_s == pytest.approx(np.pi / 2 / 0.1, rel=1e-3)
    beyond = plant_margins(replace(controller, law=scaled(law, 0.5)), plant, plant.defaults)
    assert beyond.sampled_delay_s is None
    assert beyond.margins.delay_s > beyond.searched_delay_s == pytest.approx(20.0)
