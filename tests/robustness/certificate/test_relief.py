"""What must give where an outer loop or a term takes a law beyond its limits, against matrices written elsewhere."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

import seaopt as so
from seaopt.control import Impedance, add_impedance
from seaopt.robustness.certificate.retuning.relief import Relief, find_relief
from seaopt.robustness.certificate.retuning.reserve import look_at_draws
from tests.control.running.test_fed_back import HELD, KNEE, TS, VALUES, close_by_hand

MASSES = (2.7, 3.2)
ASKED = Impedance(stiffness=80.0, damping=4.0, velocity_filter_s=5e-3)


@pytest.fixture(scope="module")
def force():
    spec = so.ControllerSpec(measured="tau_s", bandwidth_hz=15, max_sensitivity=1.6, reserve=0.01)
    return so.tune(HELD, VALUES, spec, {"knee": KNEE})


@pytest.fixture(scope="module")
def look():
    return partial(
        look_at_draws, plants={"knee": KNEE}, parameters=VALUES, ranges={"m": MASSES}, others=so.ParameterSet()
    )


def use_limits(loop):
    """Return the share of Ms and Mt that a loop uses, by its sensitivity at the command."""
    s = loop(np.exp(2j * np.pi * np.geomspace(1e-2, 499.0, 20_000) * TS))[0, 0]
    return max(np.max(np.abs(s)) / 1.6, np.max(np.abs(1.0 - s)) / 1.3)


def test_a_softer_impedance_keeps_the_limits_and_a_stiffer_one_does_not(force, look):
    law = add_impedance(force, KNEE, VALUES, ASKED)
    found = find_relief(law, lambda _: replace(law, met=False), look)
    assert found.compensated == 0.0 and found.bandwidth_hz is None and 0.0 < found.rendered < 1.0

    def use(share):
        around = replace(ASKED, stiffness=share * ASKED.stiffness, damping=share * ASKED.damping)
        return max(use_limits(close_by_hand(law, around=around, share=0.0, m=mass)) for mass in (*MASSES, 2.95))

    assert use(found.rendered) <= 1.0 + 1e-4
    assert use(found.rendered + 1 / 64) > 1.0
    assert f"{100 * found.rendered:.2g} % of the impedance's stiffness and damping" in str(found)


def test_a_look_says_what_the_law_alone_uses(force, look):
    """Of both, at one draw: the reserve asked leaves the law alone as much room as is used beyond it."""
    law = add_impedance(force, KNEE, VALUES, ASKED)
    knee = look(law)["knee"]
    mass = knee.worst.parameters["m"]
    assert knee.worst.severity == pytest.approx(
        use_limits(close_by_hand(law, around=ASKED, share=0.0, m=mass)), rel=1e-3
    )
    assert knee.alone == pytest.approx(use_limits(close_by_hand(law, share=0.0, m=mass)), rel=1e-3)
    assert (1.0 - knee.needed) * knee.worst.severity < knee.alone < knee.worst.severity


def test_what_helps_is_said():
    none = Relief(compensated=0.0, rendered=0.0, bandwidth_hz=None)
    assert "does not keep the limits" in str(none)
    both = str(replace(none, compensated=0.625, bandwidth_hz=12.0))
    assert both == "draws keep the limits with 62 % of what is compensated, or with a bandwidth of 12 Hz"
