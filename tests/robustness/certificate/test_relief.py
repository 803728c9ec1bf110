"""What must give where an outer loop or a term takes a law beyond its limits, against matrices written elsewhere."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

import seaopt as so
from seaopt.control import Impedance, add_impedance
from seaopt.errors import ControlError
from seaopt.robustness import tune_certified
from seaopt.robustness.certificate.retuning.relief import Relief, find_relief
from seaopt.robustness.certificate.retuning.reserve import Look, look_at_draws, raise_reserve
from tests.control.running.test_fed_back import HELD, KNEE, VALUES, close_by_hand, weigh
from tests.hand_loops import find_peaks

MASSES = (2.7, 3.2)
SHARE = 1.5  # of the weight, which the outer loop holds
ASKED = Impedance(stiffness=80.0, damping=4.0, velocity_filter_s=5e-3)


@pytest.fixture(scope="module")
def force():
    spec = so.ControllerSpec(measured="tau_s", bandwidth_hz=15, max_sensitivity=1.6, reserve=0.01)
    return so.tune(HELD, VALUES, spec, {"knee": KNEE})


@pytest.fixture(scope="module")
def look():
    return partial(
        look_at_draws, plants={"knee": KNEE}, parameters=VALUES, ranges={"m": MASSES}, supplement=so.ParameterSet()
    )


def use_limits(loop):
    """Return the share of Ms and Mt that a loop uses, by its sensitivity at the command."""
    ms, mt = find_peaks(loop, lambda response: response[0, 0], lambda response: 1.0 - response[0, 0])
    return max(ms / 1.6, mt / 1.3)


def test_a_softer_impedance_keeps_the_limits_and_a_stiffer_one_does_not(force, look):
    law = add_impedance(force, KNEE, VALUES, ASKED)
    found = find_relief(law, lambda _: replace(law, met=False), look)
    assert found.compensated is None and found.bandwidth_hz is None and 0.0 < found.rendered < 1.0

    def use(share):
        around = replace(ASKED, stiffness=share * ASKED.stiffness, damping=share * ASKED.damping)
        return max(use_limits(close_by_hand(law, around=around, share=0.0, m=mass)) for mass in (*MASSES, 2.95))

    assert use(found.rendered) <= 1.0 + 1e-4
    assert use(found.rendered + 0.01) > 1.0
    assert f"{100 * found.rendered:.0f} % of the impedance's stiffness and damping" in str(found)


def test_a_lower_bandwidth_that_keeps_the_limits_is_found_past_one_without_such_a_law(force, look):
    """As where no damping is critical at the first one tried: that one does not do, and the next is tried."""
    asked, softer = replace(force.spec, bandwidth_hz=24.0), replace(ASKED, stiffness=20.0, damping=1.0)

    def tune_at(band):
        if band > 16.0:
            raise ControlError("stiffness = 80 has no critically damped impedance")
        return add_impedance(force, KNEE, VALUES, softer)

    found = find_relief(replace(add_impedance(force, KNEE, VALUES, ASKED), spec=asked), tune_at, look)
    assert found.tried_hz == (19.2, 15.6) and found.bandwidth_hz == 15.6
    assert str(found).endswith("or with a bandwidth of 15.6 Hz")
    assert max(use_limits(close_by_hand(force, around=softer, share=0.0, m=mass)) for mass in (*MASSES, 2.95)) <= 1.0


def test_a_look_says_what_the_law_alone_uses(force, look):
    """Of law and outer loop, without what is compensated, at one draw: the reserve asked leaves these as much room as
    is used beyond it.
    """
    law = weigh(add_impedance(force, KNEE, VALUES, ASKED), SHARE)
    knee = look(law)["knee"]
    mass = knee.worst.parameters["m"]
    assert knee.worst.severity == pytest.approx(
        use_limits(close_by_hand(law, around=ASKED, share=SHARE, m=mass)), rel=1e-5
    )
    assert knee.alone == pytest.approx(use_limits(close_by_hand(law, around=ASKED, share=0.0, m=mass)), rel=1e-5)
    assert (1.0 - knee.needed) * knee.worst.severity < knee.alone < knee.worst.severity


def test_what_helps_is_said_and_what_does_not_where_it_was_tried():
    none = Relief(compensated=0.0, rendered=0.0, bandwidth_hz=None, tried_hz=(12.0, 9.75))
    with_ = "draws do not keep the limits with"
    assert (
        str(none)
        == f"{with_} less compensation, or with a softer impedance, or with a bandwidth of 12 and 9.75 Hz alone"
    )
    assert str(replace(none, compensated=None, tried_hz=())) == f"{with_} a softer impedance alone"
    both = str(replace(none, compensated=0.62, bandwidth_hz=12.0))
    assert both == "draws keep the limits with 62 % of what is compensated, or with a bandwidth of 12 Hz"


def tune_completed(complete, **options):
    spec = so.ControllerSpec(measured="tau_s", bandwidth_hz=15, max_sensitivity=1.6)
    options |= {"samples": 20, "rounds": 2, "complete": complete}
    return tune_certified(HELD, VALUES, spec, {"knee": KNEE}, **options)


def test_terms_that_need_more_than_a_reserve_can_give_are_named():
    """Of more than the whole weight, with which the link falls over."""
    done = tune_completed(lambda law: weigh(law, 1.1), ranges={"m": MASSES})
    assert done.status == "terms" and len(done.rounds) == 1 and done.rounds[0].added
    assert done.explanation.startswith("what is compensated takes more of a limit than a reserve of")
    assert "no witness" not in done.explanation and "larger reserve" not in done.explanation
    assert done.relief is not None and str(done.relief) in done.explanation
    assert done.relief.rendered is None and 0.5 < done.relief.compensated < 1.0
    mass = done.certificate.worst["knee"].parameters["m"]
    assert np.max(np.abs(close_by_hand(done.controller, share=1.1, m=mass).poles())) > 1.0
    kept = close_by_hand(done.controller, share=1.1 * done.relief.compensated, m=mass)
    assert np.max(np.abs(kept.poles())) < 1.0 and use_limits(kept) <= 1.0 + 1e-4


def test_without_draws_no_share_is_advised():
    """Nothing is looked at where nothing is uncertain, and whatever is tried seems to keep its limits there."""
    done = tune_completed(lambda law: weigh(law, 1.1))
    assert done.status == "terms" and not done.certificate.varied and done.relief is None
    assert "compensate less" in done.explanation and "robust_to" not in done.explanation


def test_an_outer_loop_that_no_law_keeps_its_limits_with_is_said_before_any_draw():
    """Of a quarter of the damping, around which the force law's Ms is 1.8 times its limit."""
    around = replace(ASKED, damping=1.0)
    done = tune_completed(lambda law: add_impedance(law, KNEE, VALUES, around), ranges={"m": MASSES})
    assert done.status == "infeasible" and done.certificate is None and "Hz is possible" in done.explanation
    assert use_limits(close_by_hand(done.controller, around=around, share=0.0)) > 1.05


def test_an_outer_loop_is_tuned_with_in_every_round():
    """One around which the law that is tuned without breaks Mt at draws."""
    around = replace(ASKED, stiffness=120.0, damping=6.0)
    done = tune_completed(lambda law: add_impedance(law, KNEE, VALUES, around), ranges={"m": MASSES})
    spec = so.ControllerSpec(measured="tau_s", bandwidth_hz=15, max_sensitivity=1.6)
    alone = so.tune(HELD, VALUES, spec, {"knee": KNEE})
    for mass in (*MASSES, 2.95):
        assert use_limits(close_by_hand(alone, around=around, share=0.0, m=mass)) > 1.01
        assert use_limits(close_by_hand(done.controller, around=around, share=0.0, m=mass)) <= 1.0 + 1e-4
    over = {row.name for row in done.certificate.requirements if not row.met}
    assert over <= {"impedance_damper", "impedance_draws"}


@pytest.mark.parametrize(
    ("asked", "alone", "reserve"),
    [(0.0, 0.9, 0.101), (0.0, 0.8, None), (0.16, 0.9, 0.16), (0.16, 1.0, 0.16), (0.16, 0.8, None), (0.3, 0.8, 0.3)],
)
def test_a_reserve_is_raised_no_further_than_its_most_and_never_takes_one_that_was_asked(
    force, look, asked, alone, reserve
):
    """Of what uses a limit just whole, with a law that alone uses a share of it: the rest and a thousandth."""
    case = look(add_impedance(force, KNEE, VALUES, ASKED))["knee"]
    raised = raise_reserve(
        replace(force.spec, reserve=asked), [Look(worst=case.worst, alone=alone * case.worst.severity)]
    )
    assert raised is None if reserve is None else raised.reserve == pytest.approx(reserve)
