"""The same whole path with and without a C compiler."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest

import seaopt as so
from seaopt.bench import PAPER_STAND

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


def test_a_compiler_changes_no_fit(stand, thor, monkeypatch):
    """A small part of the next one, in this process."""
    from seaopt.simulation import compiled

    noise = so.Sensors(noise_std={"F1": 2.0, "F2": 2.0})
    log = so.virtual_log(stand, thor, PAPER_STAND, duration_s=1, rate_hz=400, seed=1, sensors=noise)
    bench = so.Experiment(plant=stand, log=log, outputs=("F1", "F2"))
    free = thor.update(J=3e-6).free("J", "b_r")
    fast = so.fit([bench], free, method=so.OutputError(search=False))
    monkeypatch.setattr(compiled.Program, "make", lambda *_, **__: None)
    slow = so.fit([bench], free, method=so.OutputError(search=False))
    for name in ("J", "b_r"):
        assert fast.parameters[name].value == pytest.approx(slow.parameters[name].value, rel=1e-6)
        assert fast.parameters[name].std == pytest.approx(slow.parameters[name].std, rel=1e-6)


@pytest.mark.slow
def test_a_compiler_changes_nothing():
    from seaopt.simulation.native import find_compiler

    if find_compiler() is None:
        pytest.skip("no C compiler to compare with")
    for fast, slow in zip(run(), run(SEAOPT_COMPILER="none"), strict=True):
        np.testing.assert_allclose(fast, slow, rtol=1e-6, atol=1e-12)
