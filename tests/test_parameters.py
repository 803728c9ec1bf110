from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

import seaopt as so
from seaopt.errors import ParameterError, UnitError


def test_changes_return_new_sets(thor):
    changed = thor.update(J=2e-6).free("J", "b_r").bound(J=(1e-7, 1e-4)).prior(k=3000)
    assert thor.free_names == ()
    assert changed.free_names == ("k", "J", "b_r")
    assert changed["J"].value == 2e-6
    assert changed["k"].prior_std == 3000
    assert changed.fix().free_names == ()


def test_values_with_units_are_converted(thor):
    assert thor.update(l=(2.0, "mm"))["l"].value == pytest.approx(0.002)
    with pytest.raises(UnitError, match='"N" is not one of m'):
        thor.update(l=(2.0, "N"))


@pytest.mark.parametrize("value", [-1.0, math.nan, math.inf])
def test_values_outside_bounds_are_refused(thor, value):
    with pytest.raises(ParameterError, match="J"):
        thor.update(J=value)


def test_unknown_names_get_a_suggestion(thor):
    with pytest.raises(ParameterError, match='did you mean "K_tau"'):
        thor.update(Ktau=1.0)
    with pytest.raises(ParameterError, match="given twice"):
        so.ParameterSet([thor["J"], thor["J"]])


def test_printing_shows_value_unit_and_state(thor):
    text = repr(thor.free("J"))
    assert "3.31e-06" in text
    assert "kg m^2" in text
    assert "free" in text
    assert "<table>" in thor._repr_html_()


@given(st.floats(-1e6, 1e6), st.floats(0.001, 1e6))
def test_interval_is_centred(value, std):
    item = so.Parameter(name="a", value=value, unit="-", free=True, std=std)
    low, high = item.ci95
    assert low < value < high
    assert high - low == pytest.approx(2 * 1.959964 * std, rel=1e-6)


def test_a_set_is_a_mapping_for_unknown_names_too(thor):
    assert thor.get("nope") is None and thor.get("nope", thor["J"]) is thor["J"]
    with pytest.raises(KeyError) as caught:
        thor["nope"]
    assert str(caught.value).startswith('parameter "nope" is not in this set')
    assert 'with_parameters(so.Parameter(name="nope", value=..., unit="..."))' in str(caught.value)


def test_a_wrong_unit_names_its_parameter():
    with pytest.raises(so.SeaoptError, match=r"parameter J: .*kg m"):
        so.plants.thor().update(J=(2e-6, "N m"))
