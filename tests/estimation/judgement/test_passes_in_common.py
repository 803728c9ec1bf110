"""The passes of a fit's problem, as parts of those in which more is free, are those that it has alone."""

import numpy as np
import pytest

import seaopt as so
from seaopt.bench import PAPER_STAND, Sensors, virtual_log
from seaopt.estimation.judgement.score_test import free_fixed
from seaopt.estimation.problem.fit_problem import FitProblem, pose_problem
from seaopt.estimation.problem.losses import Squares
from seaopt.simulation import keep_passes
from seaopt.simulation.compiled import Program

STAND = so.plants.high_impedance()


def pose(f_c: float = 60.0, **fields: object) -> FitProblem:
    """Return a fit of a second at 400 Hz, with dry friction or none: the plant is then linear."""
    truth = so.plants.thor().update(f_c=f_c, v_s=5e-3)
    log = virtual_log(STAND, truth, PAPER_STAND, duration_s=1, rate_hz=400, seed=1,
                      sensors=Sensors(noise_std={"F1": 2.0, "F2": 2.0}))  # fmt: skip
    experiment = so.Experiment(plant=STAND, log=log, outputs=("F1", "F2"), **fields)
    return pose_problem((experiment,), truth.update(J=2e-6).free("J", "eta"), loss=Squares())


DELAY = so.Parameter(name="delay_s", value=1e-3, unit="s", free=True, min=0.0)
CASES = {
    "from a free state": pose(),
    "of a linear plant": pose(f_c=0.0),
    "a delay of its own": pose(delay_s=DELAY),
    "from rest, a gain free": pose(
        initial_state="rest", gain={"F1": so.Parameter(name="g", value=1.0, unit="", free=True)}
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_a_part_is_the_pass(name, monkeypatch):
    problem = CASES[name]
    z = problem.unknowns.start
    alone = problem.experiments[0].run(problem.experiments[0].segments[0], z, outputs=True, columns=True)
    with keep_passes():
        freed = free_fixed(problem, z)
        assert freed.units
        monkeypatch.setattr("seaopt.simulation.run.Program.make", lambda *_: pytest.fail("it is simulated again"))
        monkeypatch.setattr("seaopt.simulation.run.interpret_pass", lambda *_, **__: pytest.fail("simulated again"))
        part = problem.experiments[0].run(problem.experiments[0].segments[0], z, outputs=True, columns=True)
    size = np.sqrt(np.einsum("occ->oc", alone.gram))
    assert part.gram == pytest.approx(alone.gram, abs=1e-11 * float(np.max(size)) ** 2)
    assert np.all(np.abs(part.gram - alone.gram) <= 1e-10 * size[:, :, None] * size[:, None, :] + 1e-300)
    assert np.max(np.abs(part.columns - alone.columns) / (np.max(np.abs(alone.columns), axis=0) + 1e-300)) < 1e-9
    assert part.outputs == pytest.approx(alone.outputs, rel=1e-11, abs=1e-9)
    assert (part.count == alone.count).all()


@pytest.mark.parametrize("f_c", [0.0, 60.0])
def test_a_right_model_is_judged_by_one_more_pass(f_c, monkeypatch):
    """With the parameters that were fixed, and with the effects that a log may not show."""
    problem = pose(f_c)
    made: list[tuple[str, ...]] = []
    for name in ("run", "run_parts"):
        real = getattr(Program, name)

        def run(program, *args, real=real, **options):
            made.append(program.model.free)
            return real(program, *args, **options)

        monkeypatch.setattr(Program, name, run)
    so.fit([e.data for e in problem.experiments], problem.params, diagnostics=False)
    bare = len(made)
    made.clear()
    fit = so.fit([e.data for e in problem.experiments], problem.params)
    assert fit.met
    assert len(made) == bare + 1
    assert {"k", "K_tau", "c_t", "d_e"} < set(made[-1])
