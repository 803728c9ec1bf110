"""A law tuned from its neighbour's: what a search of everything has, in the time of one of its last steps."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import seaopt as so
from seaopt.control import Notch
from seaopt.control.tuning import solution
from seaopt.errors import ControlError
from seaopt.plants.friction import friction_states

LIMITS = {"max_sensitivity": 1.6, "max_complementary": 1.3, "max_noise_gain": 25.0}
RUBS = {"f_c": 60.0, "v_s": 5e-3}
MOVED = ({"bandwidth_hz": 21.0}, {"bandwidth_hz": 19.0}, {"max_sensitivity": 1.55}, {"max_noise_gain": 22.0})


def integrate_sensitivity(controller: so.Controller, plants: list[so.Plant], params: so.ParameterSet) -> float:
    """Return the objective: the integral of |S| over ln f up to the bandwidth, of the plant where it is most."""
    f = np.geomspace(0.1, controller.spec.bandwidth_hz, 4000)
    values = [np.abs(controller.close(plant, params).sensitivity(f)) for plant in plants]
    return max(float(np.trapezoid(value, np.log(f))) for value in values)


@pytest.fixture
def no_scan(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fail where gains are scanned."""

    def fail(*_: object) -> None:
        raise AssertionError("gains were scanned")

    monkeypatch.setattr(solution, "find_starts", fail)


CASES = [("pid", RUBS, moved) for moved in MOVED] + [("pd", {}, MOVED[0]), ("pid_dob", {}, MOVED[2])]
SLOW = [("pid", {}, moved) for moved in MOVED] + [("pid_dob", RUBS, moved) for moved in MOVED]


@pytest.fixture(scope="module")
def neighbours(stand, thor):
    """Return a function that gives the law of a structure, and of friction, before a limit is moved."""

    @cache
    def tune(structure: str, rubs: tuple[tuple[str, float], ...]) -> so.Controller:
        spec = so.ControllerSpec(structure=structure, bandwidth_hz=20.0, **LIMITS)
        return so.tune(stand, thor.update(**dict(rubs)), spec)

    return tune


@pytest.mark.parametrize(
    ("structure", "rubs", "moved"), [*CASES, *(pytest.param(*case, marks=pytest.mark.slow) for case in SLOW)]
)
def test_a_moved_limit_has_the_law_of_a_whole_search(structure, rubs, moved, stand, thor, neighbours, request):
    params, neighbour = thor.update(**rubs), neighbours(structure, tuple(rubs.items()))
    spec = neighbour.spec
    asked = replace(spec, **moved)
    whole = so.tune(stand, params, asked)
    request.getfixturevalue("no_scan")
    near = so.tune(stand, params, asked, near=neighbour)
    assert near.met and whole.met
    plants = list(friction_states(stand).values()) if rubs else [stand]
    ends = [integrate_sensitivity(law, plants, params) for law in (near, whole)]
    assert ends[0] < (1.0 + spec.reserve) * ends[1]  # the tuner's own resolution


@pytest.fixture(scope="module")
def controller(stand, thor):
    """Return a law of 30 Hz."""
    return so.tune(stand, thor, so.ControllerSpec(bandwidth_hz=30.0, **LIMITS))


def test_where_the_neighbours_valley_has_no_law_everything_is_searched(controller, stand, swing, thor):
    asked = replace(controller.spec, bandwidth_hz=60.0)
    whole = so.tune(stand, thor, asked, {"swing": swing})
    near = so.tune(stand, thor, asked, {"swing": swing}, near=controller)
    assert not whole.met
    assert near.gains == whole.gains


@pytest.mark.parametrize("changes", [{"structure": "pd"}, {"measured": "F2"}, {"notch": Notch()}])
def test_a_neighbour_of_other_parts_is_refused(changes, controller, stand, thor):
    with pytest.raises(ControlError, match="near is a law of other parts"):
        so.tune(stand, thor, replace(controller.spec, **changes), near=controller)
