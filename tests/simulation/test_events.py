"""Passes from event to event: against a block whose motion between events is known in closed form."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.optimize import brentq

from seaopt.simulation import Clock, Point, Segment, Weights, make_model, run_passes
from tests.simulation.test_sticking_passes import BLOCK, FREE, VALUES

PERIOD, N = 2e-3, 1000


def move_block(theta, x, v, drive, delay):
    """Return places at samples, and how often it stopped for good and turned: harmonic motion about (F -+ f_c)/k."""
    (m, k, f_c), places, stops, turns = theta, [], 0, 0
    w = math.sqrt(k / m)
    late = round(delay / PERIOD - 0.5)  # a whole sample less
    first = delay - late * PERIOD
    for i in range(len(drive)):
        places.append(x)
        for force, length in ((drive[max(i - late - 1, 0)], first), (drive[max(i - late, 0)], PERIOD - first)):
            left = length
            while left > 0.0:
                if v == 0.0 and abs(force - k * x) <= f_c:
                    break
                sign = math.copysign(1.0, v if v != 0.0 else force - k * x)
                centre = (force - sign * f_c) / k

                def speed(t, x=x, v=v, centre=centre):
                    return v * math.cos(w * t) - (x - centre) * w * math.sin(w * t)

                grid = np.linspace(0.0, left, 9)[1:]
                end = next((t for t in grid if sign * speed(t) < 0.0), None)
                t = left if end is None else brentq(speed, max(end - left / 8, 1e-12), end, xtol=1e-18, rtol=1e-15)
                x, v = centre + (x - centre) * math.cos(w * t) + v / w * math.sin(w * t), speed(t)
                if end is not None:
                    v = 0.0
                    held = abs(force - k * x) <= f_c
                    stops, turns = stops + held, turns + (not held)
                left -= t
    return np.array(places), stops, turns


@pytest.fixture(scope="module")
def drive():
    """Return a force that turns the block, holds it and lets it go, over and over."""
    t = PERIOD * np.arange(N)
    return (9.0 * np.sin(2 * np.pi * 1.3 * t) + 5.0 * np.sin(2 * np.pi * 4.1 * t + 1.0)) * np.minimum(1.0, 0.3 + t)


def run_block(theta, x0, drive, delay, substeps=1):
    clock = Clock(period=PERIOD, delay_s=delay, delay_free=True)
    point = Point(theta=np.array(theta), offset=np.zeros(1), gain=np.ones(1), clock=clock, substeps=substeps)
    model = make_model(BLOCK, VALUES, FREE, ("x",))
    segment = Segment(u=(drive,), y=(np.zeros(drive.size),))
    return run_passes(model, segment, point, np.array(x0), Weights.plain(1), outputs=True, columns=True)


THETA, START, DELAY = (2.0, 800.0, 3.0), (0.01, 0.05), 0.7e-3


def test_a_block_moves_as_in_closed_form(drive):
    places, stops, turns = move_block(THETA, *START, drive, DELAY)
    assert stops >= 3 and turns >= 10
    size = np.max(np.abs(places))
    assert np.max(np.abs(run_block(THETA, START, drive, DELAY).outputs[:, 0] - places)) < 1e-7 * size
    assert np.max(np.abs(run_block(THETA, START, drive, DELAY, 4).outputs[:, 0] - places)) < 1e-9 * size


def test_derivatives_are_those_of_the_closed_form(drive):
    """Of parameters, the delay and a start in motion, over stops and turns; their count stays."""
    columns = run_block(THETA, START, drive, DELAY, 2).columns[:, 0]
    numbers = [*THETA, DELAY, *START]
    counts = move_block(THETA, *START, drive, DELAY)[1:]
    for column, value in enumerate(numbers, start=1):
        step, sides = 1e-6 * value, []
        for way in (-1, 1):
            moved = list(numbers)
            moved[column - 1] += way * step
            places, *found = move_block(moved[:3], *moved[4:], drive, moved[3])
            assert tuple(found) == counts
            sides.append(places)
        expected = (sides[1] - sides[0]) / (2 * step)
        assert np.max(np.abs(expected)) > 0.0
        assert np.max(np.abs(columns[:, column] - expected)) < 1e-5 * np.max(np.abs(expected))
