r"""The force on a motor that its measured motion shows and the model lacks, without a simulation that goes elsewhere.

With the states x of a log, and their rates from differences, the equations of the plant without dry friction leave

.. math:: e = (f_{\dot q}(x, u, p) - \ddot q) / g,

the force against the motion, q the motor's position and g what a unit of force does to its acceleration. Parameters
that are off, and dry friction, make of e a sum of what stands in f: of the states, the speed's sign and the inputs.
That is taken out by least squares.
"""

from __future__ import annotations

import casadi as ca
import numpy as np
from jaxtyping import Bool, Float

from seaopt.estimation.problem.experiment import FEWEST_READ
from seaopt.estimation.problem.fit_experiment import FitExperiment
from seaopt.estimation.problem.shapes import Vector
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.plants.friction import friction_matrices, remove_friction
from seaopt.plants.memo import memo
from seaopt.plants.plant import dynamics_function
from seaopt.records import record
from seaopt.simulation.simulate import input_samples


@record(eq=False)
class MissingForce:
    """The force at each sample of which all is measured, with the motor's position, by its state's name, and speed."""

    state: str
    position: Float[np.ndarray, " n"]
    speed: Float[np.ndarray, " n"]
    force: Float[np.ndarray, " n"]


def find_missing_force(experiment: FitExperiment, params: ParameterSet, rows: slice, z: Vector) -> MissingForce | None:
    """Return the force over some rows of a log, at parameters and the other unknowns `z`; None where the log does not
    have all states or their integrals, or the motor stands still.
    """
    data, plant, period = experiment.data, experiment.data.plant, experiment.period
    state = plant.sensing.motor_position if plant.sensing is not None else None
    rates, measured = _pair_rates(plant), [name for name in plant.states if data.reads(name)]
    if state not in measured or state not in rates:
        return None
    x = {name: data.read(name)[rows] for name in measured}
    x |= {rates[name]: np.gradient(x[name], period) for name in measured if name in rates and rates[name] not in x}
    if x.keys() != plant.states.keys():
        return None
    moving = list(plant.states).index(rates[state])
    time = data.log.time[rows]
    late = time - experiment.point(z).clock.delay_s - (0.5 * period if data.hold == "zero" else 0.0)
    u = np.stack([np.interp(late, time, channel[rows]) for channel in input_samples(plant, data.log)])
    states, p = np.stack([x[name] for name in plant.states]), plant.complete(params).vector
    pushed = dynamics_function(remove_friction(plant)).map(time.size)(states, u, np.repeat(p[:, None], time.size, 1))
    effect = friction_matrices(plant)(np.zeros(len(states)), np.zeros(len(u)), p)[0]
    acceleration = np.gradient(x[rates[state]], period)
    acceleration[1:-1] = np.diff(x[state], 2) / period**2
    force = (np.array(pushed)[moving] - acceleration) / float(effect[moving, 0])
    there = _find_whole(np.stack([data.log[name][rows] for name in measured]))
    if np.count_nonzero(there) < FEWEST_READ:
        return None
    position, speed, force = x[state][there], x[rates[state]][there], force[there]
    regressors = np.column_stack([np.ones(force.size), np.sign(speed), states.T[there], u.T[there]])
    regressors /= np.maximum(np.max(np.abs(regressors), axis=0), 1e-300)
    force -= regressors @ np.linalg.lstsq(regressors, force, rcond=1e-9)[0]
    return MissingForce(state=state, position=position, speed=speed, force=force) if np.ptp(position) else None


def _find_whole(values: Float[np.ndarray, "states n"]) -> Bool[np.ndarray, " n"]:
    """Return the samples at which all are measured, and their neighbours, of which differences are."""
    missing = ~np.all(np.isfinite(values), axis=0)
    return ~(missing | np.append(missing[1:], False) | np.append(False, missing[:-1]))


@memo
def _pair_rates(plant: Plant) -> dict[str, str]:
    """Return the state that is the rate of another one, by that."""
    rows, symbols = ca.vertsplit(plant.dynamics), dict(zip(plant.states, ca.vertsplit(plant.x), strict=True))
    return {
        name: rate
        for name, row in zip(plant.states, rows, strict=True)
        for rate, symbol in symbols.items()
        if ca.is_equal(row, symbol, 1)
    }
