"""The gate in front of a law: spikes, what is no number, outages, in closed loops written here, in Python and in C."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import cont2discrete

from seaopt.control import GateState, MPCSpec, PlausibilityGate, force_mpc, runnable
from seaopt.control.laws.plausibility import largest_step
from seaopt.errors import ControlError
from tests.c_code import CompiledLaw, CompiledMPC

TS, BEGIN = 1e-3, 300
GATE = PlausibilityGate(range_N=(-4000.0, 4000.0), max_step_N=300.0, max_held=50, ramp_per_s=90.0)
STATUS = ("ok", "held", "fault")
REFERENCE = np.repeat([500.0, 600.0], [450, 300])
FIRST = [np.nan, 1e4, -np.inf, 3000.0, 10.0, 20.0]  # no number, out of range twice, in range and wrong, true

FAULTS = {  # readings from sample 300 on; None: as it is
    "nan": {BEGIN: np.nan},
    "inf": {BEGIN: np.inf, BEGIN + 1: -np.inf},
    "1e308": {BEGIN: 1e308, BEGIN + 1: -1e308},
    "spikes": dict.fromkeys(range(BEGIN, BEGIN + 100, 10), 1e4),
    "spikes within range": dict.fromkeys(range(BEGIN, BEGIN + 100, 10), -3000.0),
    "outage of 20": dict.fromkeys(range(BEGIN, BEGIN + 20), np.nan),
    "outage of 200": dict.fromkeys(range(BEGIN, BEGIN + 200), 1e4),
}


def run(step, start, thor, stand, faults, reference=REFERENCE):
    """Close the stand, by scipy's hold and a sample late, with a step (state, reference, reading) -> current, state."""
    model = stand.linearize(thor)
    a, b, c, _, _ = cont2discrete((model.A, model.B[:, :1], model.C[:1], np.zeros((1, 1))), TS, "zoh")
    x, waiting, state, forces, currents, statuses, readings = np.zeros(2), 0.0, start, [], [], [], []
    for k, wanted in enumerate(reference):
        force = float(c[0] @ x)
        reading = faults.get(k, force)
        current, state, status = step(state, float(wanted), reading)
        x, waiting = a @ x + b[:, 0] * waiting, current
        for into, value in zip((forces, currents, statuses, readings), (force, current, status, reading), strict=True):
            into.append(value)
    return np.array(forces), np.array(currents), statuses, readings


def of_law(law):
    def step(state, reference, reading):
        current, state = law.step(state, reference, reading)
        return current, state, state.status

    return step, law.reset()


def of_mpc(mpc):
    def step(state, reference, reading):
        result = mpc.step(state, reference, reading)
        return result.command, result.state, result.state.gate.status

    return step, mpc.start


@pytest.fixture(scope="module")
def mpc(stand, thor):
    return force_mpc(stand, thor, MPCSpec(current_limit_A=9.0), gate=GATE)


def check(found, clean, name):
    """Short faults leave the force as it was to a few newtons; a long one ends at no current, at the ramp's pace."""
    forces, currents, statuses, _ = found
    assert set(statuses[:BEGIN]) == {"ok"}
    assert np.all(np.isfinite(currents)) and np.max(np.abs(currents)) <= 9.0
    if name != "outage of 200":
        assert set(statuses[BEGIN : BEGIN + 100]) == {"ok", "held"}
        assert statuses[-1] == "ok"
        assert np.max(np.abs(forces - clean)) < 30.0
        return
    first = statuses.index("fault")
    assert first == BEGIN + GATE.max_held
    assert set(statuses[first:]) == {"fault"}  # the sensor is back, and not trusted
    falling = np.abs(currents[first - 1 :])
    assert np.all(np.diff(falling) <= 0.0)
    np.testing.assert_allclose(-np.diff(falling)[:5], GATE.ramp_per_s * TS, rtol=1e-9)
    assert currents[-1] == 0.0 and abs(forces[-1]) < 1.0


@pytest.mark.parametrize("name", list(FAULTS))
def test_a_pid_bridges_what_is_short_and_stops_at_what_is_long(name, tuned, thor, stand):
    law = runnable(tuned, gate=GATE)
    clean = run(*of_law(runnable(tuned)), thor, stand, {})[0]
    check(run(*of_law(law), thor, stand, FAULTS[name]), clean, name)


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=() if name in ("spikes", "nan", "outage of 200") else pytest.mark.slow)
        for name in FAULTS
    ],
)
def test_predictive_control_does_the_same(name, mpc, thor, stand):
    clean = run(*of_mpc(replace(mpc, gate=None)), thor, stand, {})[0]
    check(run(*of_mpc(mpc), thor, stand, FAULTS[name]), clean, name)


def test_without_a_gate_a_spike_is_taken_for_true(tuned, thor, stand):
    clean, spoilt = (run(*of_law(runnable(tuned)), thor, stand, faults)[0] for faults in ({}, FAULTS["spikes"]))
    assert np.max(np.abs(spoilt - clean)) > 100.0


@pytest.mark.parametrize("precision", ["double", "float"])
def test_the_c_code_of_a_pid_does_what_python_does(precision, compiler, tuned, thor, stand, tmp_path):
    compiled = CompiledLaw(compiler, tmp_path, tuned, precision, gate=GATE)
    for name, faults in FAULTS.items():
        found = run(*of_law(runnable(tuned, gate=GATE)), thor, stand, faults)
        compiled.reset(0.0, 0.0, 0.0)
        assert (compiled.law.status, compiled.law.refused) == (0, 0)
        currents, statuses = [], []
        for reference, reading in zip(REFERENCE, found[3], strict=True):
            currents.append(compiled.step(reference, reading))
            statuses.append(STATUS[compiled.law.status])
        tolerance = 9.0 * (1e-12 if precision == "double" else 1e-5)
        np.testing.assert_allclose(currents, found[1], rtol=0, atol=tolerance, err_msg=name)
        assert statuses == found[2], name


@pytest.mark.slow
def test_the_c_code_of_predictive_control_does_what_python_does(mpc, compiler, thor, stand, tmp_path):
    compiled = CompiledMPC(compiler, tmp_path, mpc)
    for name, faults in {**FAULTS, "first readings": dict(enumerate(FIRST))}.items():
        _, currents, statuses, readings = run(*of_mpc(mpc), thor, stand, faults)
        rows = compiled.run(REFERENCE, readings)
        assert rows[:, 0] == pytest.approx(currents, abs=1e-7), name
        assert [STATUS[int(value)] for value in rows[:, 4]] == statuses, name


def test_an_infinite_measurement_is_predicted_without_a_gate_too(mpc, thor, stand):
    """Once in three samples, both signs: the force goes on to its reference."""
    bare = replace(mpc, gate=None)
    faults = {k: np.inf * (-1) ** k for k in range(100, 400, 3)}
    forces, currents, _, _ = run(*of_mpc(bare), thor, stand, faults)
    assert np.all(np.isfinite(currents))
    assert forces[-1] == pytest.approx(600.0, abs=1.0)


def test_a_force_that_really_has_moved_is_believed_again():
    """A jump of 1000 N at 300 N a sample: refused three times, by then it can be true."""
    state, used = GateState(), []
    for reading in [0.0, *[1000.0] * 5]:
        value, state = GATE.screen(state, reading)
        used.append(value)
    assert used == [0.0, 0.0, 0.0, 0.0, 1000.0, 1000.0]
    assert state == GateState(measurement=1000.0)


def test_the_largest_step_is_reached_by_its_own_input_and_by_no_other(tuned, thor, stand):
    plant = tuned.close(stand, thor).plant
    claimed = largest_step(plant, 5.0)
    h, x = [plant.d[0]], plant.b
    for _ in range(3000):
        h.append(plant.c[0] @ x)
        x = plant.a @ x
    h = np.array(h)
    worst = 5.0 * np.sign(np.diff(h, prepend=0.0))[::-1]
    rng = np.random.default_rng(0)
    for effort in (worst, *rng.choice([-5.0, 5.0], size=(20, worst.size))):
        steps = np.abs(np.diff(np.convolve(h, effort)[: worst.size]))
        assert np.max(steps) <= claimed * (1 + 1e-9)
    last = np.convolve(h, worst)[worst.size - 2 : worst.size]
    assert abs(last[1] - last[0]) == pytest.approx(claimed, rel=1e-4)


def test_a_first_reading_that_cannot_be_true_is_refused():
    state, used, statuses = GateState(), [], []
    for reading in FIRST:
        value, state = GATE.screen(state, reading)
        used.append(value)
        statuses.append(state.status)
    assert np.all(np.isnan(used[:3])) and used[3:5] == [3000.0, 3000.0]  # by its range alone
    assert statuses == ["held", "held", "held", "ok", "held", "held"]
    strict, state = replace(GATE, max_held=2), GateState()
    for reading in FIRST[:3]:
        state = strict.screen(state, reading)[1]
    assert state.fault and strict.screen(state, 10.0)[1].fault


def test_a_reset_with_a_measurement_judges_the_first_reading_by_it(tuned):
    law = runnable(tuned, gate=GATE)
    state, statuses, currents = law.reset(reference=10.0, measurement=10.0), [], []
    for reading in FIRST:
        current, state = law.step(state, 10.0, reading)
        currents.append(current)
        statuses.append(state.status)
    assert statuses == ["held", "held", "held", "held", "ok", "ok"]
    assert np.max(np.abs(currents[:5])) < 0.01  # 10 N bridged: not held either, for there was a reading to use
    with pytest.raises(ControlError, match=r"measurement = 5000 .*range_N"):
        law.reset(measurement=5000.0)
    with pytest.raises(ControlError, match="measurement = nan"):
        law.reset(measurement=np.nan)


@pytest.mark.parametrize("precision", ["double", "float"])
@pytest.mark.parametrize("given", [False, True])
def test_the_c_code_starts_as_python_does(precision, given, compiler, tuned, tmp_path):
    compiled, law = CompiledLaw(compiler, tmp_path, tuned, precision, gate=GATE), runnable(tuned, gate=GATE)
    state = law.reset(reference=10.0, measurement=10.0) if given else law.reset()
    if given:
        compiled.reset(10.0, 10.0, 0.0)
    found, expected = [], []
    for reading in [*FIRST, 15.0, 12.0]:
        current, state = law.step(state, 10.0, reading)
        expected.append((state.status, pytest.approx(current, abs=1e-4 if precision == "float" else 1e-11)))
        made = compiled.step(10.0, reading)
        found.append((STATUS[compiled.law.status], made))
    assert found == expected
    compiled.reset(0.0, 1e4, 0.0)  # out of range, which C cannot refuse: as if nothing were known
    assert compiled.law.known == 0


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("range_N", [(1.0, -1.0), (1.0, 1.0), (np.nan, 1.0), (-np.inf, 1.0), (0.0, np.inf), (0.0, 1e300)]),
        ("max_step_N", [0.0, -1.0, np.inf, np.nan, 1e300, 1e-300]),
        ("ramp_per_s", [0.0, -1.0, np.inf, np.nan]),
        ("max_held", [-1, 10**9]),
    ],
)  # fmt: skip
def test_what_no_gate_can_have_is_refused(name, values):
    for value in values:
        with pytest.raises(ControlError, match=f"{name} = .*; give ") as caught:
            replace(GATE, **{name: value})
        assert "\n" not in str(caught.value)


def test_what_cannot_be_is_refused(tuned, thor, stand):
    for change in ({"ramp_s": 0.0}, {"ramp_s": np.nan}, {"margin": -1.0}, {"max_held": -1}):
        with pytest.raises(ControlError, match=f"{next(iter(change))} = "):
            PlausibilityGate.of_controller(tuned, **{"range_N": (-1e3, 1e3), **change})
    bare = replace(tuned, spec=replace(tuned.spec, current_limit_A=None))
    with pytest.raises(ControlError, match="no current limit"):
        PlausibilityGate.of_controller(bare, range_N=(-1e3, 1e3))
