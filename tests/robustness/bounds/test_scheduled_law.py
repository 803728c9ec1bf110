"""A scheduled law enclosed over its variable, against the law that is made of the gains at single values."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import seaopt as so
from seaopt.control.loops.compensation.link_feedforward import LinkPath
from seaopt.control.loops.outer_loop import OuterLoop
from seaopt.errors import ControlError
from seaopt.robustness.bounds.impulse import ImpulseTransfer
from seaopt.robustness.bounds.scheduled_law import ScheduledLaw
from seaopt.robustness.bounds.taylor import build_basis, make_constant, make_linear
from tests.control.scheduling.test_step_order import LAWS, TS, make_table

LOW, HIGH, HALF = 0.1, 0.6, 0.25
PLANT = so.Plant(
    name="two signals",
    states={"x": "m"}, inputs={"F": "N"}, outputs={"y": "N", "z": "rad", "w": "rad"}, parameters={"k": "1/s"},
    f=lambda t, x, u, p: {"x": u.F - p.k * x.x}, h=lambda t, x, u, p: {"y": x.x, "z": 2 * x.x, "w": 3 * x.x},
)  # fmt: skip
LINKS = tuple(
    LinkPath(
        measured="w", unit="rad", inertia=scale * 0.3, damping=0.5, fraction=0.8, corner_hz=40.0 * scale,
        high_pass_hz=0.5, is_speed=False,
    )
    for scale in (1.0, 1.3, 1.5)
)  # fmt: skip


@cache
def tune_any():
    return so.tune(so.plants.high_impedance(), so.plants.thor(), so.ControllerSpec(bandwidth_hz=30))


def enclose(table, signals, outer=None):
    """Return the numerators of every C_y, their denominator, and the law of single values, from LOW to HIGH."""
    middle = replace(tune_any(), law=table.law(0.35), reads=signals, outer=outer)
    law = ScheduledLaw.of(table, LOW, HIGH, middle, PLANT, "k")
    over, count = build_basis(1, 6), 2
    one, nothing = make_constant(np.ones((count, 1)), over), make_constant(np.zeros((count, 1)), over)
    reads = len(law.at(0.35).signals)
    sampled = ImpulseTransfer(
        heads=(one,) * reads, tails=(nothing,) * reads, denominator=one, whole=np.zeros(count, dtype=int)
    )
    centre = np.array([LOW + 0.5 * HALF, HIGH - 0.5 * HALF])
    value = make_linear(centre, np.full((1, count), 0.5 * HALF), over)
    return law.extend(sampled, value), law, centre


def evaluate(model, box, e, w):
    """Return a polynomial whose coefficients are models, and what its remainders leave open."""
    powers = e ** np.arange(model.a.shape[0])
    size = np.polynomial.polynomial.polyval(np.abs(w), model.r[box])
    return np.polynomial.polynomial.polyval(w, powers @ model.a[:, box]), size


@pytest.mark.parametrize("outer", [False, True])
@pytest.mark.parametrize("name", [*LAWS, "link"])
def test_the_law_of_every_value_is_enclosed(name, outer):
    gains, speed = LAWS.get(name, ({}, None))
    table = make_table(gains, speed, LINKS if name == "link" else ())
    signals = {"link": ("y", "w")}.get(name, ("y",) if speed is None else ("y", "z"))
    around = OuterLoop(
        stiffness=20.0, damping=3.0, velocity_filter_s=4e-3, direction=1.0, sample_time_s=TS, place_unit="rad",
        position="w",
    )  # fmt: skip
    found, law, centre = enclose(table, signals, around if outer else None)
    assert len(found.heads) == len(signals) + (outer and name != "link")
    w = np.exp(2j * np.pi * np.geomspace(1e-3, 499.0, 60) * TS) - 1.0
    for box, e in ((0, -1.0), (0, 0.3), (1, 0.0), (1, 1.0)):
        exact = law.at(centre[box] + 0.5 * HALF * e).law
        z = (1.0 + w)[:, None, None]
        inner = np.linalg.solve(
            z * np.eye(exact.a.shape[0]) - exact.a, np.broadcast_to(exact.b[:, 1:], (w.size, *exact.b[:, 1:].shape))
        )
        expected = -(exact.c @ inner + exact.d[1:])
        below, open_below = evaluate(found.denominator, box, e, w)
        for k, head in enumerate(found.heads):
            above, left = evaluate(head, box, e, w)
            gap = np.abs(above - expected[:, k] * below)
            assert np.all(gap <= left + np.abs(expected[:, k]) * open_below + 1e-9 * np.abs(above))
            assert np.all(left <= 0.05 * np.max(np.abs(above)))


def test_a_stretch_across_a_point_is_refused():
    middle = replace(tune_any(), reads=("y",))
    with pytest.raises(ControlError, match=r"0\.5 to 0\.9"):
        ScheduledLaw.of(make_table({}, None), 0.5, 0.9, middle, PLANT, "k")
