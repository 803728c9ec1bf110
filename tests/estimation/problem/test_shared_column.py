"""One column as several channels: of two outputs the noise is one, so that the second adds nothing that is known."""

import numpy as np
import pytest

import seaopt as so


@pytest.fixture(scope="module")
def log(thor):
    """With the spring at link 2 both forces are the same."""
    plant = so.plants.high_impedance(spring="link2")
    sensors = so.Sensors(noise_std={"F1": 2.0})
    return plant, so.virtual_log(plant, thor, so.bench.PAPER_STAND, duration_s=8, rate_hz=400, seed=1, sensors=sensors)


def test_two_outputs_of_one_column_are_as_one(log, thor):
    plant, recorded = log
    both = so.Log.from_arrays(time=recorded.time, I=recorded["I"], F1=recorded["F1"], F2=recorded["F1"])
    params = thor.update(J=3e-6, b_r=2e-4).free("J", "b_r")
    fits = [
        so.fit([so.Experiment(plant=plant, log=both, outputs=outputs)], params) for outputs in (("F1",), ("F1", "F2"))
    ]
    for name in ("J", "b_r"):
        alone, twice = (fit.parameters[name] for fit in fits)
        assert twice.value == pytest.approx(alone.value, rel=1e-9)
        assert twice.std == pytest.approx(alone.std, rel=1e-3)
    assert any("F1 and F2 are the same samples" in note for note in fits[1].experiments[0].notes)
    assert not any("same samples" in note for note in fits[0].experiments[0].notes)


def test_a_problem_file_shares_a_column(log, thor, tmp_path):
    _, recorded = log
    rows = zip(recorded.time, recorded["I"], recorded["F1"], strict=True)
    (tmp_path / "a.csv").write_text("t [s],I [A],F [N]\n" + "".join(f"{t:.6f},{i:.9g},{f:.9g}\n" for t, i, f in rows))
    path = tmp_path / "p.toml"
    path.write_text("""
schema = 1
[parameters]
J = { value = 3e-6, free = true }
[plant.stand]
kind = "high_impedance"
spring = "link2"
[[experiment]]
name = "shake"
plant = "stand"
log = "a.csv"
time = "t [s]"
inputs = { I = "I [A]" }
outputs = { F1 = { column = "F [N]", shared = true }, F2 = { column = "F [N]", shared = true } }
""")
    (one,) = so.read_problem(path).experiments()
    assert np.array_equal(one.log["F1"], one.log["F2"])
    assert any("same samples" in note for note in one.notes)


def test_an_input_that_is_an_output_too_is_noted(log):
    _, recorded = log
    servo = so.plants.wrapped(so.plants.high_impedance(), ["voltage_input"])
    same = so.Log.from_arrays(time=recorded.time, V=recorded["I"], I=recorded["I"])
    one = so.Experiment(plant=servo, log=same, outputs=("I",))
    assert any("V and I are the same samples: as an input it is taken for exact" in note for note in one.notes)
