"""Whatever is asked of `so.tune`, it answers, or refuses in an error that is meant."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
import pytest

import seaopt as so
from seaopt.control.tuning import found_law
from seaopt.control.tuning.convex_concave import improve
from seaopt.control.tuning.frequencies import place_frequencies
from seaopt.control.tuning.starts import make_rest_start
from seaopt.control.tuning.tuner import make_task
from seaopt.errors import InternalError, SeaoptError
from tests.control.tuning.drawn_requests import draw_request

QUICK = (9,)
SLOW = 10  # benchmarks/bench_tune.py --requests 300 answers more


def answer(seed: int) -> None:
    """Tune a drawn request; a refusal is one line, and anything else is a defect, warnings among them."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            controller = draw_request(np.random.default_rng(seed)).tune()
        except SeaoptError as error:
            refusal = str(error)
        else:
            refusal = ""
    assert "\n" not in refusal
    if refusal:
        return
    assert controller.feasible != bool(controller.blocked_by)
    assert all(np.isfinite(value) for value in controller.gains.values())


@pytest.mark.parametrize("seed", QUICK)
def test_what_is_asked_is_answered(seed: int) -> None:
    answer(seed)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(SLOW))
def test_whatever_is_asked_is_answered(seed: int) -> None:
    answer(seed)


SILENT = so.ControllerSpec(
    structure="pd", objective="noise", reference_weights="error", bandwidth_hz=59.0, delay_samples=3,
    sample_rate_hz=500.0, max_noise_gain=False, min_sensitivity_bandwidth_hz=6.0,
)  # fmt: skip


def test_a_law_without_feedback_has_no_noise_and_is_a_start(stand, thor) -> None:
    """With such a delay the scan finds no stable law, and the tuner begins with next to no feedback."""
    task = make_task(stand, thor, SILENT, {})
    grid, start = task.grid(place_frequencies(task)), make_rest_start(task)
    assert start[0] == 0.0 and np.isfinite(improve(task, grid, start)[0])


@pytest.mark.slow
@pytest.mark.parametrize("weights", ["tuned", "error", "measurement"])
def test_from_a_law_without_feedback_the_least_miss_is_found(stand, thor, weights: str) -> None:
    controller = so.tune(stand, thor, replace(SILENT, reference_weights=weights))
    assert not controller.feasible and controller.blocked_by


def test_a_defect_is_reported_with_the_request(monkeypatch: pytest.MonkeyPatch, stand, thor) -> None:
    def fail(*_: object, **__: object) -> None:
        raise ValueError("zero-size array\nto reduction operation")

    monkeypatch.setattr(found_law, "solve_beside", fail)
    with pytest.raises(InternalError, match="zero-size array to reduction operation; please report") as caught:
        so.tune(stand, thor, so.ControllerSpec(bandwidth_hz=31.25))
    assert not isinstance(caught.value, SeaoptError) and isinstance(caught.value.__cause__, ValueError)
    (request,) = caught.value.__notes__
    assert "'bandwidth_hz': 31.25" in request and "high_impedance" in request and "'k': 655000.0" in request


def test_what_the_callers_own_hook_raises_is_no_defect(stand, thor) -> None:
    def stop(note: str, share: float | None = None, /) -> None:
        raise RuntimeError("enough")

    with pytest.raises(RuntimeError, match="enough"):
        so.tune(stand, thor, so.ControllerSpec(bandwidth_hz=30), progress=stop)
