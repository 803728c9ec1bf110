"""A user's own plant: what is refused, and how."""

from __future__ import annotations

import pickle

import casadi as ca
import numpy as np
import pytest

import seaopt as so
from seaopt.errors import ParameterError, PlantError
from seaopt.plants.memo import memo
from seaopt.plants.parts import list_dead_times, wrapped

GOOD = {
    "name": "cart",
    "states": {"x": "m", "v": "m/s"},
    "inputs": {"F": "N"},
    "outputs": {"x": "m"},
    "parameters": {"m": "kg", "c": "N s/m"},
    "f": lambda t, x, u, p: {"x": x.v, "v": (u.F - p.c * x.v) / p.m},
    "h": lambda t, x, u, p: {"x": x.x},
}


def build(**changes):
    return so.Plant(**{**GOOD, **changes})


@pytest.mark.parametrize("rotary_first", [False, True])
def test_defaults_of_built_in_plants_are_plausible(rotary_first):
    """A fit does not question a fixed value that is its default."""
    declared = so.plants.known_parameters(rotary_first=rotary_first).values()
    ranges = {each.name: (each.value, *each.plausible) for each in declared if each.plausible is not None}
    assert len(ranges) > 40 and not {name for name, (value, low, high) in ranges.items() if not low <= value <= high}


def test_a_plant_in_a_few_lines():
    model = build().linearize(so.ParameterSet.of(m=(2.0, "kg"), c=(4.0, "N s/m")))
    np.testing.assert_allclose(np.sort(model.poles().real), [-2.0, 0.0])


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"parameters": {"m": "", "c": "N s/m"}}, '"m" in parameters has no unit'),
        ({"parameters": {"m": "kg", "c": "N s/m", "x": "m"}}, '"x" is in states and in parameters'),
        ({"h": lambda t, x, u, p: {"x": p.m}}, '"x" depends on no state'),
        ({"f": lambda t, x, u, p: {"x": x.v, "v": p.c}}, '"v" is driven by nothing'),
        ({"f": lambda t, x, u, p: {"x": x.v}}, 'returns nothing for "v"'),
        ({"f": lambda t, x, u, p: {"x": x.v, "v": u.F, "w": 0}}, 'returns "w"'),
        ({"inputs": {"my force": "N"}}, '"my force"'),
        ({"outputs": {"energy": "J"}}, "rename the output"),
        ({"f": lambda t, x, u, p: {"x": x.v, "v": -p.c * x.v}}, '"v" is driven by nothing'),
        ({"f": lambda t, x, u, p: {"x": ca.vertcat(x.v, u.F), "v": u.F}}, "the shape"),
        ({"f": lambda t, x, u, p: {"x": x.v, "v": u.F if x.v > 0 else 0}}, "ca.if_else"),
    ],
)
def test_mistakes_are_named(changes, words):
    with pytest.raises(PlantError, match=words):
        build(**changes)


def test_an_unknown_unit_is_refused():
    with pytest.raises(so.SeaoptError, match="blorp"):
        build(parameters={"m": "blorp", "c": "N s/m"})


def test_a_missing_value_is_named():
    with pytest.raises(ParameterError, match='"c" of plant cart has no value'):
        build().linearize(so.ParameterSet.of(m=(2.0, "kg")))


def test_printing_says_names_and_units():
    text = repr(build())
    assert "x [m], v [m/s]" in text
    assert "m [kg]" in text
    assert build()._repr_html_().startswith("<pre>")


def test_unknown_kind_and_option_are_refused():
    from seaopt.plants import plant_of_kind

    with pytest.raises(PlantError, match="did you mean"):
        plant_of_kind("high_impedanse")
    with pytest.raises(PlantError, match="drife"):
        plant_of_kind("high_impedance", drife="lumped")


def test_units_of_values_are_converted_or_refused(stand, thor):
    from seaopt.errors import UnitError

    millimetres = so.ParameterSet.of(k=(655.0, "N/mm"))
    np.testing.assert_allclose(stand.linearize(millimetres).A, stand.linearize(thor).A)
    with pytest.raises(UnitError, match="parameter k of plant"):
        stand.linearize(so.ParameterSet.of(k=(655e3, "kg")))


def test_a_misspelt_symbol_is_named():
    with pytest.raises(PlantError, match='f uses "mass"; known: m, c'):
        build(f=lambda t, x, u, p: {"x": x.v, "v": u.F / p.mass})


def test_parameters_are_completed_once():
    """Completing again changes nothing; another plant sees what was given; a change has to be completed again."""
    stand, swing = so.plants.high_impedance(), so.plants.moving_output()
    late = so.Parameter(name="delay_s", value=0.2, unit="ms")
    given = so.plants.thor().with_parameters(so.Parameter(name="l", value=2.0, unit="mm"), late)
    values = stand.complete(given)
    assert stand.complete(values) is values
    assert list(values) == list(stand.parameters)
    assert values.vector[list(values).index("l")] == pytest.approx(2e-3)
    assert swing.complete(values).given is given
    assert "delay_s" not in values.drop_conditions().given
    assert not isinstance(values.update(J=1e-6), type(values))


def test_a_result_is_computed_once_for_each_plant():
    counted = []

    @memo
    def count_states(plant: so.Plant) -> int:
        counted.append(plant)
        return len(plant.states)

    plants = so.plants.high_impedance(), so.plants.moving_output()
    assert [count_states(plant) for plant in (*plants, *plants)] == [2, 4, 2, 4]
    assert counted == [*plants]


def test_dead_times_are_those_of_the_parts():
    plant = so.plants.high_impedance()
    assert list_dead_times(wrapped(plant, ["load_cell", "command_delay"])) == ("T_c",)


def test_an_error_has_its_plant_as_a_field():
    with pytest.raises(PlantError) as raised:
        build(f=lambda t, x, u, p: {"x": x.v})
    error = pickle.loads(pickle.dumps(raised.value))
    assert (error.plant, error.reason) == ("cart", 'f returns nothing for "v"; add its equation')
    assert str(error) == f"plant cart: {error.reason}"
