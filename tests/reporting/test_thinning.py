"""Series drawn with few points keep their extremes, and every point is a sample."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from seaopt.reporting.figures.thinning import break_at, describe_thinning, thin_series


@given(st.integers(2, 5000), st.integers(1, 300), st.integers(0, 2**32 - 1))
def test_least_and_largest_of_every_stretch_are_drawn_in_order(count, stretches, seed):
    values = np.random.default_rng(seed).normal(size=count)
    time = np.arange(count) / 400.0
    at, drawn = thin_series(time, values, stretches)
    assert at.size == drawn.size <= max(2 * stretches + 2, count) and np.all(np.diff(at) > 0.0)
    assert at[0] == time[0] and at[-1] == time[-1]
    np.testing.assert_array_equal(values[np.rint(at * 400.0).astype(int)], drawn)
    assert drawn.min() == values.min() and drawn.max() == values.max()
    if count > 2 * stretches:
        edges = np.linspace(0, count, stretches + 1).astype(int)
        expected = {values[0], values[-1]}
        for first, last in pairwise(edges):
            expected |= {values[first:last].min(), values[first:last].max()}
        assert {*drawn} == expected


def test_missing_samples_do_not_hide_others():
    values = np.sin(np.arange(10_000.0))
    values[::3] = np.nan
    values[4000:6000] = np.nan
    time, drawn = thin_series(np.arange(10_000.0), values, 100)
    assert np.nanmax(drawn) == np.nanmax(values)
    inside = (time >= 4000) & (time < 6000)
    assert np.isnan(drawn[inside]).all() and inside.any() and not np.isnan(drawn[~inside][1:-1]).any()


def test_no_line_joins_what_a_gap_parts():
    time, values = break_at(np.array([0.0, 1.0, 9.0, 10.0]), np.arange(4.0), np.array([2]))
    np.testing.assert_array_equal(time, [0.0, 1.0, 5.0, 9.0, 10.0])
    assert np.isnan(values[2]) and values[3] == 2.0


def test_captions_say_how_a_series_was_thinned():
    assert describe_thinning(1000) == ""
    assert "2001 samples" in describe_thinning(2001) and "min-max" in describe_thinning(2001)
