"""What a user waits for: import, the stand fit, tune, certify. `make bench`; ratios side by side in one run.

The fit's yardstick is polars reading the CSV of the same log: the time the data needs anyway.
"""

from __future__ import annotations

import subprocess
import sys
import time

import pytest

import seaopt as so
from seaopt.bench import PAPER_STAND

FREE = ("J", "b_r", "eta")


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    stand, thor = so.plants.high_impedance(), so.plants.thor()
    sensors = so.Sensors(noise_std={"F1": 2.0, "F2": 2.0})
    log = so.virtual_log(stand, thor, PAPER_STAND, duration_s=164, rate_hz=400, seed=1, sensors=sensors)
    path = so.write_log(log, tmp_path_factory.mktemp("bench") / "chirp.csv")
    return stand, thor, log, path


def test_import(benchmark):
    def load():
        subprocess.run([sys.executable, "-c", "import seaopt"], check=True)

    benchmark.pedantic(load, rounds=7, warmup_rounds=1)


def test_import_with_every_name(benchmark):
    def load():
        subprocess.run([sys.executable, "-c", "import seaopt as so; [getattr(so, n) for n in so.__all__]"], check=True)

    benchmark.pedantic(load, rounds=5, warmup_rounds=1)


def test_stand_fit_65600_samples(benchmark, bench):
    stand, thor, log, path = bench
    experiment = so.Experiment(plant=stand, log=log, outputs=("F1", "F2"))
    start = thor.update(J=1e-6, b_r=4e-4, eta=0.4).free(*FREE)
    channels = {name: f"{name} [{unit}]" for name, unit in (("I", "A"), ("F1", "N"), ("F2", "N"))}
    ratios = []
    for _ in range(5):
        started = time.perf_counter()
        so.fit([experiment], start)
        middle = time.perf_counter()
        so.read_log(path, time="time [s]", channels=channels)
        ratios.append((middle - started) / (time.perf_counter() - middle))
    print(f"\nfit / reading its CSV: {sorted(ratios)[2]:.2f} (median of 5)")
    result = benchmark.pedantic(lambda: so.fit([experiment], start), rounds=7, warmup_rounds=1)
    assert result.status == "converged"


def test_tune_30_hz(benchmark, bench):
    stand, thor, _, _ = bench
    spec = so.ControllerSpec(bandwidth_hz=30, max_sensitivity=1.6, max_complementary=1.3, max_noise_gain=25)
    robust = {"swing": so.plants.moving_output()}
    assert benchmark.pedantic(lambda: so.tune(stand, thor, spec, robust), rounds=3, warmup_rounds=1).feasible


def test_certify_1375_draws(benchmark, bench):
    stand, thor, _, _ = bench
    controller = so.tune(stand, thor, so.ControllerSpec(bandwidth_hz=30))
    plants = {"stand": stand, "swing": so.plants.moving_output()}
    params = thor.prior(J=1e-9)
    benchmark.pedantic(
        lambda: so.certify(controller, plants, params, samples=1375, simulations=False), rounds=2, warmup_rounds=1
    )
