"""Crossings and minima of a curve, on curves whose own are known."""

from __future__ import annotations

import math

import numpy as np
import pytest

from seaopt.control.systems.crossings import add_minima, find_crossings

GRID = np.array([0.0, 1.0, 3.0])


def test_the_zero_of_a_parabola():
    assert find_crossings(lambda f: f**2 - 2.0, GRID) == pytest.approx([math.sqrt(2.0)], abs=1e-9)


def test_the_minimum_between_two_points():
    assert add_minima(lambda f: (f - 0.7) ** 2, GRID) == pytest.approx([0.0, 0.7, 1.0, 3.0], abs=1e-6)
