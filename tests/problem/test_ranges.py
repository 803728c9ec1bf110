"""Remarks on ranges that may stand."""

from __future__ import annotations

import pytest

import seaopt as so
from seaopt.problem.references import guess_remarks, range_remarks


@pytest.mark.parametrize(
    ("ranges", "words"),
    [
        ({"I_p": (0.3, 0.4), "delay_s": (0.0, 1e-3), "phi": (-0.5, 0.5)}, []),
        ({"phi": (-3.0, 3.0)}, ["is in rad: -171.9 to 171.9 degrees, beyond a right angle"]),
    ],
)
def test_an_angle_that_may_be_in_degrees_is_told(swing, thor, ranges, words):
    found = range_remarks(ranges, {"swing": swing}, thor)
    assert len(found) == len(words)
    for sentence, part in zip(found, words, strict=True):
        assert part in sentence


@pytest.mark.parametrize(("low", "high", "outside"), [(78.0, 82.0, False), (60.0, 75.0, True), (85.0, 90.0, True)])
def test_the_nominal_screw_mode_is_at_80_hz(thor, low, high, outside):
    plant = so.plants.high_impedance(parts=["screw_mode"])
    assert bool(range_remarks({"screw_mode_hz": (low, high)}, {"stand": plant}, thor)) == outside


def test_guesses_of_which_nothing_is_drawn_are_named_with_ranges(stand, thor):
    known = thor.prior(J=1e-7)  # which is drawn
    (text,) = guess_remarks(["N_p", "unit of F1", "J", "k", "eta"], {"k": (6e5, 7e5)}, {"stand": stand}, known)
    n_p = thor["N_p"].value
    assert "the certificate does not vary N_p and eta, guesses" in text
    assert (
        f"parameters = {{ N_p = [{0.5 * n_p:.3g}, {2 * n_p:.3g}], eta = [0.5, {min(2.0, thor['eta'].max):.3g}] }}"
        in text
    )
    assert not guess_remarks(["unit of F1", "J"], {}, {"stand": stand}, known)


def test_a_guess_of_nothing_is_named_without_a_range_and_one_below_zero_with_its_ends_in_order(stand, thor):
    plant = so.plants.moving_output()
    (text,) = guess_remarks(["b_r"], {}, {"stand": stand}, thor.update(b_r=0.0))
    assert text.startswith("the certificate does not vary b_r, a guess") and "parameters" not in text
    (text,) = guess_remarks(["b_r", "g"], {}, {"swing": plant}, thor.update(b_r=0.0, g=-10.0))
    assert "the certificate does not vary b_r and g" in text and text.endswith("parameters = { g = [-20, -5] }")
