"""Wrong types at the doors, as a user without a type checker passes them (so not under the tests' own)."""

from __future__ import annotations

import json
import subprocess
import sys

CODE = """
import json, numpy as np, seaopt as so
stand, thor = so.plants.high_impedance(), so.plants.thor()
log = so.Log.from_arrays(time=np.arange(50) / 400, I=np.sin(np.arange(50)), F1=np.cos(np.arange(50)))
bench = so.Experiment(plant=stand, log=log)
tries = {
    "sigma": lambda: so.Experiment(plant=stand, log=log, sigma=2.0),
    "list": lambda: so.fit(bench, thor.free("J")),
    "one fit": lambda: so.compare(so.fit([bench], thor.free("J"), method=so.OutputError(search=False))),
    "text bandwidth": lambda: so.ControllerSpec(bandwidth_hz="30"),
    "float delay": lambda: so.ControllerSpec(compute_delay_samples=1.0),
    "robust_to": lambda: so.tune(stand, thor, so.ControllerSpec(), ["swing"]),
}
out = {}
for name, attempt in tries.items():
    try:
        attempt()
        out[name] = "accepted"
    except so.SeaoptError as error:
        out[name] = str(error)
print(json.dumps(out))
"""


def test_wrong_types_are_seaopt_errors():
    done = subprocess.run([sys.executable, "-c", CODE], capture_output=True, text=True, check=True)
    found = json.loads(done.stdout)
    words = {
        "sigma": "sigma = 2.0",
        "list": "list of experiments",
        "one fit": "put them in brackets",
        "text bandwidth": "bandwidth_hz = '30'",
        "float delay": "delay_samples = 1.0",
        "robust_to": "robust_to is a list",
    }
    for name, part in words.items():
        assert part in found[name], found
