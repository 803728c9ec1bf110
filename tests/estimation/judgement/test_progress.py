"""What a fit tells while it runs."""

import json

import numpy as np
import pytest

import seaopt as so
from seaopt.estimation.result.fit_result import Fit
from seaopt.files import to_json

PLANT = so.plants.rotary(link="locked")
VALUES = PLANT.defaults.update(f_c=0.02, v_s=0.0625, J_m=4e-5)


class Heard(Exception):
    """Ends a fit when it says something."""


def stop_at_remark(note, share=None):
    if share is None:
        raise Heard(note)


def stop_at_cause(note, share=None):
    if "cause" in note:
        raise Heard(note)


def make_experiment(plant, samples, disturbance=0.0):
    """Return a log of the plant with noise, and with a square wave that no model explains."""
    time = np.arange(samples) / 1000.0
    current = 2.0 * np.sin(2 * np.pi * 1.3 * time) + np.sin(2 * np.pi * 0.21 * time)
    run = so.simulate(so.plants.let_stick(PLANT), VALUES, so.Log.from_arrays(time=time, I=current))
    noise = np.random.default_rng(1).normal(0.0, 0.02, time.size)
    torque = run["tau_s"] + noise + disturbance * np.sign(np.sin(2 * np.pi * 0.4 * time))
    return so.Experiment(plant=plant, log=so.Log.from_arrays(time=time, I=current, tau_s=torque))


def test_smoothed_friction_that_makes_a_search_slow_is_advised_to_stick():
    with pytest.raises(Heard) as heard:
        so.fit([make_experiment(PLANT, 40_000)], VALUES.free("b_r"), progress=stop_at_remark)
    (text,) = heard.value.args
    assert "sticks = true" in text
    assert "v_s" in text


@pytest.mark.parametrize(("plant", "samples"), [(so.plants.let_stick(PLANT), 40_000), (PLANT, 4000)])
def test_what_sticks_or_is_short_gets_no_advice(plant, samples):
    so.fit([make_experiment(plant, samples)], VALUES.free("b_r"), diagnostics=False, progress=stop_at_remark)


@pytest.mark.slow
def test_causes_that_are_tried_are_told():
    with pytest.raises(Heard, match="cause"):
        so.fit([make_experiment(so.plants.let_stick(PLANT), 3000, 1.0)], VALUES.free("b_r"), progress=stop_at_cause)


@pytest.mark.slow
def test_a_fit_that_is_read_from_a_file_advises_to_stick_as_a_fresh_one_does():
    params = VALUES.update(v_s=1.2, b_r=2e-4).free("f_c")
    fresh = so.fit([make_experiment(PLANT, 4000)], params)
    read = Fit.from_dict(json.loads(to_json(fresh.to_dict())))
    for result in (fresh, read):
        (cause,) = (finding for finding in result.findings if finding.kind == "cause")
        assert (cause.proposal, cause.preferred) == ("[plant.NAME]\nsticks = true", {})
        said = " ".join(str(result).split("\n\n")[0].split())
        assert "write under [plant.NAME]" in said and said.endswith("sticks = true")
