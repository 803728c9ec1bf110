"""Certificates, verifications, sweeps and bootstraps are the same, bit for bit, whatever does their parts."""

from __future__ import annotations

import pickle
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import seaopt as so
from seaopt.control import (
    CompensateFriction,
    CompensateGravity,
    CompensateRipple,
    Impedance,
    MPCSpec,
    add_compensation,
    add_impedance,
    force_mpc,
    sweep,
    tune_schedule,
)
from seaopt.control.frontier import frontier
from seaopt.estimation import bootstrap
from seaopt.executors import Processes, Shared, _restore
from seaopt.files import to_json
from seaopt.progress import ignore
from seaopt.robustness import Budget
from seaopt.robustness.certificate import measured_draws
from seaopt.robustness.certificate.cases import Cases
from seaopt.robustness.certificate.measured_draws import measure_draws
from seaopt.robustness.uncertainty.draws import combine_uncertainty
from seaopt.robustness.verification import schedule_sweep

STAND, SWING, THOR = so.plants.high_impedance(), so.plants.moving_output(), so.plants.thor()
SPEC = so.ControllerSpec(bandwidth_hz=30, max_sensitivity=1.6, max_noise_gain=25, current_limit_A=9.0)


class Apart(Executor):
    """Works as another process does, on copies of what it is given, and in the opposite order."""

    _max_workers = 3

    def __init__(self):
        self.waiting = []

    def submit(self, fn, /, *args, **kwargs):
        future = Late(self)
        self.waiting.append((future, pickle.dumps((fn, args, kwargs))))
        return future

    def work(self):
        while self.waiting:
            future, packed = self.waiting.pop()
            fn, args, kwargs = pickle.loads(packed)
            future.set_result(pickle.loads(pickle.dumps(fn(*args, **kwargs))))


class Late(Future):
    """Is worked on when its result is asked for."""

    def __init__(self, executor):
        super().__init__()
        self.executor = executor

    def result(self, timeout=None):
        self.executor.work()
        return super().result(timeout)


# Copies divide the work as three processes do, and no executor at all as one.
EXECUTORS = [
    pytest.param(Apart, id="copies"),
    pytest.param(lambda: ThreadPoolExecutor(3), id="threads", marks=pytest.mark.slow),
    pytest.param(lambda: Processes(2), id="2 processes", marks=pytest.mark.slow),
]
MORE = [
    *EXECUTORS,
    *(pytest.param(lambda n=n: Processes(n), id=f"{n} processes", marks=pytest.mark.slow) for n in (1, 3)),
]


@pytest.fixture(scope="module")
def controller():
    """Return a law that was tuned on the stand, as one of the moving output: the plant with the most to simulate."""
    return replace(so.tune(STAND, THOR, SPEC), design=(SWING, THOR))


def certify(controller, executor):
    """Return all that a certificate says."""
    ranges = {"I_p": (0.3, 0.5), "k": (0.95 * THOR["k"].value, 1.05 * THOR["k"].value)}
    found = so.certify(
        controller, {"swing": SWING}, THOR, ranges=ranges, samples=40, bounds=Budget(boxes=1),
        sensors=so.Sensors(noise_std={"F1": 1.0}), executor=executor,
    )  # fmt: skip
    assert found.worst["swing"][0] is SWING  # a plant comes back as the caller's own
    return to_json(found.to_dict()), {name: ms.tobytes() for name, ms in found.drawn_ms.items()}


@pytest.fixture(scope="module")
def certified(controller):
    return certify(controller, None)


@pytest.mark.parametrize("make", MORE)
def test_a_certificate(controller, certified, make):
    with make() as executor:
        assert certify(controller, executor) == certified


@cache
def compensate_friction():
    """Return a law that compensates friction, and the values of its plant."""
    values = THOR.update(f_c=100.0)
    tuned = so.tune(STAND, values, so.ControllerSpec(bandwidth_hz=20, max_sensitivity=1.6, reserve=0.05))
    return add_compensation(tuned, friction=CompensateFriction(fraction=0.9, source="speed")), values


def certify_friction(executor):
    law, values = compensate_friction()
    ranges = {"f_c": (20.0, 120.0), "K_tau": (0.024, 0.027), "I_p": (0.3, 0.5)}
    found = so.certify(
        law, {"stand": STAND, "swing": SWING}, values, ranges=ranges, samples=5, simulations=False, executor=executor
    )  # fmt: skip
    assert found.friction_draws["stand"].samples == found.compensation_draws["stand"].samples == 5
    return found


@cache
def render_knee():
    """Return a law that holds its link's weight and renders an impedance, its plant and the values."""
    knee, held = so.plants.rotary(link="pendulum"), so.plants.rotary(link="locked")
    values = knee.defaults.update(N=50.0, k_s=300.0, J_l=0.3, d_l=0.5, m=4.0, L=0.2, f_c=0.0)
    law = so.tune(held, values, so.ControllerSpec(measured="tau_s", bandwidth_hz=15, max_sensitivity=1.6))
    ripple = CompensateRipple(cycles=(1,), cos=(0.0,), sin=(0.5 * law.command.per_effort,), fraction=1.0)
    law = add_compensation(law, gravity=CompensateGravity(fraction=0.8), ripple=ripple, link=(knee, values))
    return add_impedance(law, knee, values, Impedance(stiffness=20.0, damping=1.0), name="knee"), knee, values


def certify_link(executor):
    law, knee, values = render_knee()
    ranges = {"m": (3.0, 5.0), "k_s": (250.0, 350.0)}
    found = so.certify(law, {"knee": knee}, values, ranges=ranges, samples=5, simulations=False, executor=executor)
    assert found.impedance.draws.samples == 5
    assert {"gravity_compensation", "ripple_compensation"} < {row.name for row in found.requirements}
    return found


@cache
def tune_points():
    spec = so.ControllerSpec(structure="pd", bandwidth_hz=20, max_sensitivity=1.6, max_noise_gain=25)
    return tune_schedule(STAND, THOR, spec, "k", [5e5, 6e5])


def certify_points(executor):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(schedule_sweep, "PULSE_PERIODS", 1.0)
        found = so.certify(
            tune_points(), {"stand": STAND}, THOR, ranges={"J": (3.2e-6, 3.4e-6)}, samples=20, executor=executor
        )  # fmt: skip
    assert found.places[0].worst["stand"][0] is STAND
    assert len(found.sweeps["stand"]) > 1
    return found


@cache
def design_plan():
    return force_mpc(STAND, THOR, MPCSpec(current_limit_A=9.0, bandwidth_hz=20))


def certify_plan(executor):
    ranges = {"J": (2e-6, 5e-6)}
    return so.certify(
        design_plan(), {"stand": STAND}, THOR, ranges=ranges, samples=20, runs=2,
        sensors=so.Sensors(noise_std={"F1": 1.0}), executor=executor,
    )  # fmt: skip


@cache
def certify_here(certify_one):
    return to_json(certify_one(None).to_dict())


@pytest.mark.slow
@pytest.mark.parametrize("certify_one", [certify_plan, certify_friction, certify_link, certify_points])
@pytest.mark.parametrize("make", EXECUTORS)
def test_other_certificates(certify_one, make):
    with make() as executor:
        assert to_json(certify_one(executor).to_dict()) == certify_here(certify_one)


@pytest.fixture(scope="module")
def swept():
    return sweep_bandwidths(None)


def sweep_bandwidths(executor):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(frontier, "CHAIN", 2)
        spec = so.ControllerSpec(structure="pd", max_sensitivity=1.6, max_noise_gain=25)
        return to_json(sweep(STAND, THOR, spec, [20, 30, 60], executor=executor).to_dict())


@pytest.mark.parametrize("make", EXECUTORS)
def test_a_sweep(swept, make):
    with make() as executor:
        assert sweep_bandwidths(executor) == swept


@cache
def fit_stand():
    rng = np.random.default_rng(1)
    drive = so.Log.from_arrays(time=np.arange(400) / 400, I=rng.normal(size=400))
    force = so.simulate(STAND, THOR, drive)["F1"] + rng.normal(size=400)
    log = so.Log.from_arrays(time=drive.time, I=drive["I"], F1=force)
    return so.fit([so.Experiment(plant=STAND, log=log, outputs=("F1",))], THOR.free("J", "b_r"))


def draw_bootstrap(executor):
    return bootstrap(fit_stand(), draws=20, seed=3, refit=True, executor=executor).draws.tobytes()


@pytest.fixture(scope="module")
def drawn():
    return draw_bootstrap(None)


@pytest.mark.parametrize("make", EXECUTORS)
def test_a_bootstrap(drawn, make):
    with make() as executor:
        assert draw_bootstrap(executor) == drawn


@pytest.mark.parametrize("make", [Apart, lambda: ThreadPoolExecutor(2)], ids=["copies", "threads"])
def test_draws_in_several_blocks(controller, monkeypatch, make):
    monkeypatch.setattr(measured_draws, "DRAWS_PER_BLOCK", 70)
    monkeypatch.setattr(measured_draws, "DRAW_BLOCK", 30)
    unknown = combine_uncertainty(THOR, so.ParameterSet(), {"I_p": (0.1, 2.0)}, {"swing": SWING})
    plants = {"stand": STAND, "swing": SWING}
    loops = Shared(Cases(controller=controller, models=plants, plants=plants, unknown=unknown, bounds=None))

    def measure(executor):
        return measure_draws(loops, 200, np.random.default_rng(1), executor, ignore)

    alone = measure(None)
    with make() as executor:
        apart = measure(executor)
    assert np.array_equal(apart[0], alone[0]) and np.any(alone[0])
    for one, other in zip(apart[1:], alone[1:], strict=True):
        assert {name: values.tobytes() for name, values in one.items()} == {k: v.tobytes() for k, v in other.items()}


def test_what_is_shared_is_restored_once():
    packed = pickle.dumps(Shared({"plant": STAND}))
    one, other = pickle.loads(packed), pickle.loads(packed)
    assert one is other and one.value["plant"] is not STAND
    assert pickle.dumps(one) == packed
    _restore.cache_clear()
