"""A drive that gives less than was commanded, behind the logged command, beside a smaller gain."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

import seaopt as so
from seaopt.machine.differences.drive_limit import LIMIT, NOISE, limit_drive
from tests.machine.simulator import Machine, multisine
from tests.machine.test_response import LINES

RIGHT = Machine()
REFERENCE = multisine(1000, LINES, 10, 60.0, 3)
RANGES = {"eta": (0.95, 1.05), "b_r": (0.8 * 1.31e-4, 1.2 * 1.31e-4)}


def accept(controller, log):
    return so.accept(controller, [log], uncertainty=so.plants.thor(), ranges=RANGES)


def list_first(result):
    """Return the kinds that are named first: the best, and what the log does not tell from it."""
    best, *others = result.differences.found
    return [best.kind, *(each.kind for each in others if each.untold)]


OTHER = {"per_ampere": 1.03, "damping": 1.15}


@pytest.mark.parametrize(
    ("bias", "share", "factors", "noise"),
    [(0.0, 0.2, {}, 0.5), (0.0, 0.8, OTHER, 0.5), (300.0, 0.5, OTHER, 5.0), (300.0, 0.5, {}, 0.5)],
)
def test_the_limit_of_a_drive_is_named_with_its_size(controller, bench, bias, share, factors, noise):
    """A limit that the command reaches often, and one that only its peaks do."""
    reference = bias + REFERENCE
    machine = replace(RIGHT, **{name: factor * getattr(RIGHT, name) for name, factor in factors.items()})
    command = np.abs(bench.log(machine, reference, noise=0.5)["I"][1000:])
    level = float(np.median(command) + share * np.ptp(command - np.median(command)) / 2.0)
    result = accept(controller, bench.log(replace(machine, drive_limit=level), reference, noise=noise))
    first = result.differences.found[0]
    assert list_first(result) == ["drive limit"] and not result.met
    assert abs(first.value / level - 1.0) < 0.01 * (1.0 + noise), (level, first)
    assert noise < 1.0 or first.low <= level <= first.high, (level, first)
    assert first.high - first.low < 0.3 * level
    assert f"the drive gives at most {first.value:.3g} A" in " ".join(str(result).split())


@pytest.mark.parametrize("late", [0.4, 0.75])
def test_a_loop_that_is_earlier_besides_is_not_simulated(controller, bench, late):
    """Of a limited drive the model is simulated, and no simulated loop is earlier than its ticks."""
    command = np.abs(bench.log(RIGHT, REFERENCE, noise=0.5)["I"][1000:])
    machine = replace(RIGHT, late=late, drive_limit=0.6 * float(np.max(command)))
    result = accept(controller, bench.log(machine, REFERENCE, noise=2.0))
    assert result.replayed and not result.met and result.differences.found


@pytest.mark.parametrize("gain", [0.85, 0.6])
def test_a_smaller_gain_is_no_limit(controller, bench, gain):
    result = accept(controller, bench.log(replace(RIGHT, per_ampere=gain * RIGHT.per_ampere), REFERENCE, noise=0.5))
    (first, *others) = result.differences.found
    assert {"K_tau", "eta", "gain"} <= {first.name, *first.alike}
    assert "drive limit" not in {first.kind, *(each.kind for each in others)}


def test_where_noise_hides_the_distortion_both_are_named(controller, bench):
    level = 0.45 * float(np.max(np.abs(bench.log(RIGHT, REFERENCE, noise=0.1)["I"][1000:])))
    result = accept(controller, bench.log(replace(RIGHT, drive_limit=level), REFERENCE, noise=10.0))
    first, second = result.differences.found
    assert first.kind == "drive limit" and {"eta", "gain"} <= {second.name, *second.alike}
    assert first.low <= level <= first.high
    text = " ".join(str(result).split())
    assert "of what is commanded; or " in text and "told apart by a log at half the amplitude" in text


def test_a_limited_drive_gives_no_more_than_its_limit():
    """The mean of what is left of a noisy command, by sampling it, and without noise exactly."""
    rng = np.random.default_rng(1)
    plant = so.Plant(
        name="drive", states={"x": "A s"}, inputs={"I": "A"}, outputs={"x": "A s"}, parameters={"one": "-"},
        f=lambda t, x, u, p: {"x": p.one * u.I}, h=lambda t, x, u, p: {"x": x.x},
    )  # fmt: skip
    limited = limit_drive(plant, 1e9, 0.5)
    assert [*limited.parameters] == ["one", LIMIT, NOISE]
    rate = ca.Function("f", [*limited.symbols], [limited.dynamics])
    for given in (-7.0, -1.8, 0.3, 2.1):
        sampled = np.mean(np.clip(given + 0.5 * rng.normal(size=1_000_000), -2.0, 2.0))
        assert np.isclose(float(rate(0.0, 0.0, given, [1.0, 2.0, 0.5])), sampled, atol=2e-3)
        assert np.isclose(float(rate(0.0, 0.0, given, [1.0, 2.0, 1e-9])), np.clip(given, -2.0, 2.0), atol=1e-9)
        assert float(rate(0.0, 0.0, given, [1.0, 1e9, 1e-9])) == given
