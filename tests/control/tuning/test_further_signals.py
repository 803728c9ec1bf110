"""The tuner's problem where a law reads more than the regulated signal: every curve against the loop itself."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import seaopt as so
from seaopt.control.loops.loop import Loop
from seaopt.control.loops.sampled_plant import DigitalPlant
from seaopt.control.loops.transfer_function import TransferFunction
from seaopt.control.tuning.convex_concave import linearise_law
from seaopt.control.tuning.frequencies import place_frequencies
from seaopt.control.tuning.grid import Grid
from seaopt.control.tuning.law_numbers import K_V, SPEED_RATE, LawNumbers
from seaopt.control.tuning.optimisation_problem import Task
from seaopt.control.tuning.tuner import make_task

KNEE = so.plants.rotary(link="pendulum")
VALUES = KNEE.defaults.update(
    J_m=2.4e-5, b_r=1e-4, K_tau=0.0369, N=100.0, eta=0.7, k_s=300.0, J_l=0.25, d_l=0.3, m=4.0, L=0.2
)
LAG = TransferFunction(num=np.array([3e-3, -3e-3]), den=np.array([1.0, -0.8]))


def make_case(structure: str) -> tuple[Task, LawNumbers]:
    """Return the knee's task with a filter that is given, or with a speed loop, and the numbers of a law."""
    spec = so.ControllerSpec(
        measured=("tau_s", "thetad_m"), structure="cascade", bandwidth_hz=15.0, max_noise_gain=45.0,
        prefilter="second_order",
    )  # fmt: skip
    task = make_task(so.plants.rotary(link="locked"), VALUES, spec, {"swing": KNEE})
    numbers = np.array([2.0, 30.0, 0.02, 0.5, 0.005, 0.0, 2e-3, 1.0, 0.0, 0.1, 0.5, 1.0, 0.08, 0.7])
    if structure == "given":
        return replace(task, spec=replace(spec, structure="pid"), further=(LAG,)), numbers
    numbers[[K_V, SPEED_RATE]] = 0.3, 12.0 if structure == "pi" else 0.0
    return task, numbers


@pytest.mark.parametrize("structure", ["given", "p", "pi"])
def test_the_curves_are_those_of_the_loop(structure: str) -> None:
    task, x = make_case(structure)
    grid, law = task.grid(place_frequencies(task)), task.law_of(x)
    response = task.respond(grid, x)
    for row, plant in enumerate(task.plants):
        assert isinstance(plant, DigitalPlant)
        loop = Loop(plant=plant, law=law)
        path = grid.plants.at(row)
        distance = path.add_up(response.c_y, response.c_v, response.c_r)
        np.testing.assert_allclose(distance - 1.0, loop.open_loop(grid.f), rtol=1e-8)
        np.testing.assert_allclose(path.y * response.c_r / distance, loop.tracking(grid.f), rtol=1e-8)
    if structure != "given":
        np.testing.assert_allclose(response.c_v, law.feedback_responses(grid.f)[1], rtol=1e-8)


@pytest.mark.parametrize("structure", ["given", "p", "pi"])
def test_the_law_is_affine_in_its_gains(structure: str) -> None:
    """The linearisation against a change, which for affine functions is exact."""
    task, x = make_case(structure)
    grid = task.grid(place_frequencies(task))
    change = np.array([0.3, 2.0, 1e-3, 0.2, 1e-3, 0.05])[task.gains_tuned]
    moved = x.copy()
    moved[task.gains_tuned] += change
    at, before, after = linearise_law(task, grid, x), task.respond(grid, x), task.respond(grid, moved)
    for name, by in (("c_y", at.by_y), ("c_r", at.by_r), ("c_v", at.by_v)):
        np.testing.assert_allclose(getattr(after, name) - getattr(before, name), change @ by, rtol=1e-7, atol=1e-11)
    distances = [grid.plants.add_up(law.c_y, law.c_v, law.c_r) for law in (before, after)]
    moved_by = grid.plants.change(change @ at.by_y, change @ at.by_v, change @ at.by_r)
    np.testing.assert_allclose(distances[1] - distances[0], moved_by, rtol=1e-7, atol=1e-11)


def test_some_of_the_frequencies_are_of_the_same_plants() -> None:
    task, x = make_case("pi")
    grid = task.grid(place_frequencies(task))
    some = np.array([3, 40, 200])
    part: Grid = grid.at(some)
    for name, curves in task.usage(part, task.respond(part, x)).items():
        np.testing.assert_array_equal(curves, task.usage(grid, task.respond(grid, x))[name][:, some])
