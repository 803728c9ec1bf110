"""When a known error of the integration step holds at another point, too."""

from __future__ import annotations

from dataclasses import replace
from unittest.mock import create_autospec

import numpy as np
import pytest

import seaopt as so
from seaopt.estimation.problem.fit_experiment import FitExperiment
from seaopt.estimation.solver.step_size import (
    STEP_ERROR_SIGMA,
    StepError,
    _choose_steps,
    check_steps,
    measure_step_error,
)


def test_a_step_error_is_measured_again_where_derivatives_are_not_finite(swing, thor):
    """Warnings are errors here: none may reach the user either."""
    log = so.virtual_log(swing, thor, so.bench.PAPER_SWING, duration_s=2, rate_hz=400, seed=1,
                         sensors=so.Sensors(noise_std={"F1": 2.0}))  # fmt: skip
    fit = so.fit(
        [so.Experiment(plant=swing, log=log, name="swing", outputs=("F1",))], thor.free("J"), diagnostics=False
    )
    problem = fit.minimum.problem
    here = problem.evaluate(fit.minimum.z)
    known = check_steps(problem, here, {})
    assert check_steps(problem, here, known)["swing"] is known["swing"]
    for value in (np.inf, -np.inf, np.nan):
        lost = replace(here, hessian=np.full_like(here.hessian, value))
        again = check_steps(problem, lost, known)["swing"]
        assert again is not known["swing"] and again.error == known["swing"].error


def test_a_part_that_is_held_out_whole_has_no_step_error(swing, thor):
    """No sample tells how it begins: a search of two logs with gaps left it at 1e139, and their fit was not met."""
    log = so.virtual_log(swing, thor, so.bench.PAPER_SWING, duration_s=4, rate_hz=400, seed=1,
                         sensors=so.Sensors(noise_std={"F1": 2.0}))  # fmt: skip
    time = log.time + np.where(np.arange(log.time.size) < 1200, 0.0, 0.5)  # 3 s, and 1 s after a gap
    log = so.Log.from_arrays(time=time, **{name: log[name] for name in ("I", "F1")})
    experiment = so.Experiment(plant=swing, log=log, name="swing", outputs=("F1",))
    fit = so.fit([experiment], thor.free("J"), holdout=0.3, diagnostics=False)
    problem, z = fit.minimum.problem, fit.minimum.z.copy()
    (posed,) = problem.experiments
    first, last = posed.segments
    assert first.has_start and not last.has_start
    away = [slot.index for slot in last.initial if slot.index is not None]
    assert away
    z[away] = 1e130
    error = measure_step_error(problem, posed, problem.evaluate(z))
    assert error.output < 1.0 and error.parameter < 1.0


@pytest.mark.parametrize("iterations", [2, 3])
def test_a_search_that_ends_early_states_its_iterations_once(stand, thor, iterations):
    """The count stands in the fit's text; what its verdict says to do can be done in a problem file."""
    log = so.virtual_log(stand, thor, so.bench.PAPER_STAND, duration_s=4, rate_hz=400, seed=12,
                         sensors=so.Sensors(noise_std={"F1": 2.0}))  # fmt: skip
    method = so.OutputError(search=False, max_iterations=iterations)
    start = thor.update(J=3e-5, b_r=1e-2).free("J", "b_r", "eta")
    fit = so.fit([so.Experiment(plant=stand, log=log, name="chirp", outputs=("F1",))], start, method=method)
    assert fit.status == "max_iterations" and fit.iterations == iterations
    assert f"{iterations} iterations" in repr(fit) and f"{iterations} iterations" not in fit.message
    assert "start closer" in fit.message


@pytest.mark.parametrize(("error", "steps"), [(0.02, 16), (0.2, 32)])
def test_sharp_corners_between_events_take_more_steps_only_where_the_error_is_not_tolerated(error, steps):
    experiment = create_autospec(FitExperiment, instance=True)
    experiment.model.by_events, experiment.model.order = True, 4
    assert _choose_steps(16, StepError(output=error), STEP_ERROR_SIGMA, experiment) == steps
