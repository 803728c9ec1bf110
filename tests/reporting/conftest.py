"""What the tests of figures and of the report share: one small fit, controller and certificate."""

from __future__ import annotations

import pytest

import seaopt as so
from seaopt.bench import PAPER_SWING

NOISE = {"F1": 2.0, "F2": 2.0}


@pytest.fixture(scope="session")
def fitted(stand, swing, short_log, thor) -> so.Fit:
    """Return a fit of J, b_r and eta to 20 s of the stand and 10 s of the swing, J with a prior."""
    log = so.virtual_log(
        swing, thor, PAPER_SWING, duration_s=10, rate_hz=400, seed=3, sensors=so.Sensors(noise_std=NOISE)
    )
    start = thor.free("J", "b_r", "eta")
    benches = [
        so.Experiment(plant=stand, log=short_log, name="chirp", outputs=("F1", "F2")),
        so.Experiment(plant=swing, log=log, name="swing", outputs=("F1",)),
    ]
    return so.fit(benches, start)


@pytest.fixture(scope="session")
def controller(stand, swing, thor) -> so.Controller:
    spec = so.ControllerSpec(bandwidth_hz=30, max_sensitivity=1.6, max_noise_gain=25, current_limit_A=9.0)
    return so.tune(stand, thor, spec, robust_to={"swing": swing})


@pytest.fixture(scope="session")
def certificate(controller, stand, swing, fitted) -> so.Certificate:
    """Return a certificate over 200 draws of which some fail: the swing's inertia goes below what was tuned for."""
    plants = {"stand": stand, "swing": swing}
    return so.certify(controller, plants, fitted, ranges={"I_p": (0.15, 0.6)}, samples=200)
