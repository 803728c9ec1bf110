"""Critically damped impedances against the closed form of a delay, and against an exhaustive search."""

from __future__ import annotations

import numpy as np
import pytest

import seaopt as so
from seaopt.control import critical_impedance, render
from seaopt.control.impedance.critical_damping import scan_critical
from seaopt.control.impedance.link import find_link
from seaopt.control.impedance.moving_loop import close_link
from tests.control.impedance.test_passive_region import FREE, HELD, KNEE, make_rigid_link


@pytest.fixture(scope="module")
def controller() -> so.Controller:
    spec = so.ControllerSpec(measured="tau_s", structure="pd", bandwidth_hz=25, sample_rate_hz=2000.0)
    return so.tune(HELD, KNEE, spec)


def test_a_rigid_link_with_a_delay_has_the_closed_form() -> None:
    """K = m p^2 e^(-x) (1 - x), D = m p e^(-x) (2 - x), x = p tau, of a continuous loop with nothing but a delay."""
    period, delay = 1e-4, 40
    scan = scan_critical(make_rigid_link(period, delay), 0.0)
    tau = (delay + 0.5) * period
    x = scan.rate * tau
    slow = x > 0.01
    assert scan.stiffness[slow] == pytest.approx((scan.rate**2 * np.exp(-x) * (1 - x))[slow], rel=0.03)
    late = tau + 0.5 * period  # the backward difference is half a sample late
    assert np.max(scan.stiffness) == pytest.approx(0.0791 / late**2, rel=0.03)
    assert scan.rate[-1] * late == pytest.approx(2.0 - np.sqrt(2.0), rel=0.03)


@pytest.mark.parametrize("stiffness", [5.0, 20.0, 60.0, 150.0])
def test_the_damping_is_that_of_a_search(stiffness: float, controller: so.Controller) -> None:
    """The least damping with which the link does not overshoot: steps at every damping of a fine grid."""
    found = critical_impedance(controller, FREE, KNEE, stiffness, velocity_filter_s=1e-3)
    loop = close_link(find_link(controller, FREE, KNEE), 1e-3)
    rows = found.damping * np.linspace(0.9, 1.1, 41)
    a, drive = loop.matrix(np.full(rows.size, stiffness), rows), loop.block.b[:, 0] * stiffness
    ends = np.linalg.solve(np.eye(drive.size) - a, np.broadcast_to(drive[:, None], (rows.size, drive.size, 1)))
    x, most = np.zeros((rows.size, drive.size, 1)), np.zeros(rows.size)
    for _ in range(6000):
        x = a @ x + drive[:, None]
        most = np.maximum(most, x[:, :, 0] @ loop.block.c[0])
    damping = rows[np.argmax(most <= (ends[:, :, 0] @ loop.block.c[0]) * (1.0 + 1e-8))]
    assert damping == pytest.approx(found.damping, rel=0.04)
    assert render(controller, FREE, KNEE, found).overshoot < 1e-4


def test_too_stiff_a_link_is_refused(controller: so.Controller) -> None:
    with pytest.raises(so.SeaoptError, match="has no critically damped impedance"):
        critical_impedance(controller, FREE, KNEE, 1e6)
