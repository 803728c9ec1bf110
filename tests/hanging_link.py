"""An actuator whose link hangs from it, and the force law that is tuned while the link is held."""

from __future__ import annotations

from functools import cache

import seaopt as so

KNEE, HELD = so.plants.rotary(link="pendulum"), so.plants.rotary(link="locked")
VALUES = KNEE.defaults.update(N=50.0, k_s=300.0, J_l=0.3, d_l=0.5, m=4.0, L=0.2, f_c=0.0)


@cache
def tune_held():
    return so.tune(HELD, VALUES, so.ControllerSpec(measured="tau_s", bandwidth_hz=15, max_sensitivity=1.6))
