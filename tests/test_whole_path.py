"""The same whole path with and without a C compiler."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest

CODE = """
import json, seaopt as so
from seaopt.bench import PAPER_STAND, PAPER_SWING
noise = so.Sensors(noise_std={"F1": 2.0, "F2": 2.0})
stand, swing, thor = so.plants.high_impedance(), so.plants.moving_output(), so.plants.thor()
logs = [so.virtual_log(p, thor, e, duration_s=10, rate_hz=400, seed=1, sensors=noise)
        for p, e in ((stand, PAPER_STAND), (swing, PAPER_SWING))]
experiments = [so.Experiment(plant=p, log=l, outputs=("F1", "F2")) for p, l in zip((stand, swing), logs)]
fit = so.fit(experiments, thor.update(J=2e-6, b_r=3e-4).free("J", "b_r", "eta", "I_p"))
ctl = so.tune(stand, fit.parameters, so.ControllerSpec(bandwidth_hz=30, max_sensitivity=1.6), {"swing": swing})
cert = so.certify(ctl, {"stand": stand, "swing": swing}, fit, samples=50)
print(json.dumps([[p.value for p in fit.parameters.values()], [fit.covariance.std(n) for n in fit.covariance.names],
                  list(ctl.gains.values()), [cert.plants["swing"].ms, cert.worst["swing"].ms]]))
"""


def run(**environment):
    import json

    out = subprocess.run(
        [sys.executable, "-c", CODE], capture_output=True, text=True, check=True, env={**os.environ, **environment}
    )
    return json.loads(out.stdout)


@pytest.mark.slow
def test_a_compiler_changes_nothing():
    from seaopt.simulation.native import find_compiler

    if find_compiler() is None:
        pytest.skip("no C compiler to compare with")
    for fast, slow in zip(run(), run(SEAOPT_COMPILER="none"), strict=True):
        np.testing.assert_allclose(fast, slow, rtol=1e-6, atol=1e-12)
