r"""Impacts: a blow on a link, and a link that is caught.

Between a moment before and one after, positions stay and finite forces do nothing. With the kinetic energy
:math:`T = \tfrac12 \dot y^\top H(y) \dot y` Lagrange's equations integrate over that moment to

.. math:: H (\dot y^+ - \dot y^-) = \hat Q

with the generalised impulses :math:`\hat Q`. A blow P (N s) along an output :math:`x_2(y)` has
:math:`\hat Q = (\partial x_2/\partial y)^\top P`. A coordinate j that is caught stops, :math:`\dot y_j^+ = 0`; its
impulse acts on j alone, so that the momenta of the others o stay:

.. math:: \dot y_o^+ = \dot y_o^- + H_{oo}^{-1} H_{oj} \dot y_j^-, \qquad
          \hat Q_j = H_{jo} (\dot y_o^+ - \dot y_o^-) - H_{jj} \dot y_j^-

Of the unlumped actuator with the spring at link 1 and its pendulum caught this is
:math:`\dot q^+ = \dot q^- + \tfrac{m_l}{M + m_l} \dot x_2`: the sprung mass, which moved with the nut, has to turn the
screw. H is the second derivative of the plant's declared `energy` by the rates.

A link held at :math:`x_2 = x_c` is the same plant as one held at 0 with q counted from another zero: all that the
spring knows is :math:`\delta = q + x_2 - x_1`. So a plant without that link takes over with :math:`q + x_2` in
the place of q. Which states are the link's, and which coordinate of the drive the spring adds to its motion, by which
ratio (1 for q, -N for a motor behind a gear), the plant's port says.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import casadi as ca
import numpy as np

from seaopt.errors import PlantError, suggestion
from seaopt.plants.memo import memo
from seaopt.plants.plant import CompletedParameters, Plant, agree, evaluate, output_function
from seaopt.plants.roles import Port
from seaopt.signals import VectorM, VectorN

State = VectorN
HeldState = VectorM


def strike(plant: Plant, params: CompletedParameters, state: State, output: str, impulse: float) -> State:
    """Return the state after a blow along an output, a position such as x_2. `state`: before the blow. `output`: the
    position that is struck. `impulse`: N s (N m s along an angle), positive along the output. Raises PlantError: the
    plant has no such output or no energy, or the output depends on more than positions.
    """
    inertia, slope = (np.array(block) for block in _inertia(plant, output)(state, params.vector))
    after = state.copy()
    rates = _find_pairs(plant)[1]
    after[rates] += np.linalg.solve(inertia, slope.ravel() * impulse)
    return after


def catch(plant: Plant, params: CompletedParameters, state: State, port: Port) -> tuple[HeldState, float, float]:
    """Return the state of the plant with a port held after its moving link is stopped there, the drive's coordinate
    counted from where it is held; what stops the link along its coordinate (N m s of a pendulum, N s of a mass); and
    the kinetic energy (J) lost. Raises PlantError: the port does not move, or the plant declares no energy.
    """
    motion, coordinate, rate = _read_motion(plant, port)
    inertia = np.array(_inertia(plant, motion)(state, params.vector)[0])
    places, rates = _find_pairs(plant)
    names = list(plant.states)
    link = places.index(names.index(coordinate))
    moving = [k for k in range(len(places)) if k != link]
    before, after = state[rates], state[rates].copy()
    after[link] = 0.0
    coupling = inertia[moving][:, [link]].ravel()
    after[moving] += np.linalg.solve(inertia[moving][:, moving], coupling * before[link])
    impulse = float(inertia[link] @ (after - before))
    loss = 0.5 * float(before @ inertia @ before - after @ inertia @ after)
    moved = state.copy()
    moved[rates] = after
    moved += offset(plant, params, state, port)
    return moved[[k for k, name in enumerate(names) if name not in (coordinate, rate)]], impulse, loss


def release(
    plant: Plant, params: CompletedParameters, port: Port, caught: HeldState, link: Mapping[str, float]
) -> State:
    """Return the state of a plant after the link at a port, `caught` so far, is let go at the position `link`, such as
    {"phi": 0.3}; zero where left out, as its rate is: the reverse of `catch`. Raises PlantError: the port does not
    move, or `link` names no state of its link.
    """
    _, *link_states = _read_motion(plant, port)
    for name in link:
        if name not in link_states:
            raise PlantError(
                f'link = {{"{name}": ...}} is not a state of the link of {plant.name}; {suggestion(name, link_states)}'
            )
    remaining = iter(caught)
    after = np.array(
        [link.get(name, 0.0) if name in link_states else next(remaining) for name in plant.states], dtype=float
    )
    return after - offset(plant, params, after, port)


def offset(plant: Plant, params: CompletedParameters, state: State, port: Port) -> State:
    """Return what a plant's state has to move by for its spring to stay as it is when the port goes to zero."""
    out = np.zeros(len(plant.states))
    if port.motion is not None and port.drive is not None:
        ratio = evaluate(port.ratio, params)
        out[list(plant.states).index(port.drive)] = ratio * position(plant, params, state, port.motion)
    return out


def check_held(plant: Plant, partner: Plant) -> None:
    """Refuse a plant that is not another with its first port held. It is compared with the one that the port makes;
    where the port makes none, only the names of the states tell. Raises PlantError: the states are not the same but for
    the link's.
    """
    port = plant.port
    if port is not None and port.held is not None:
        same = _is_same(port.held(), partner)
    else:
        link = (port.coordinate, port.rate) if port is not None else ()
        same = bool(link) and list(partner.states) == [name for name in plant.states if name not in link]
    if not same:
        raise PlantError(
            f"{partner.name} is not {plant.name} with a link fixed; give two plants with the same drive, spring and "
            "parts"
        )


def _is_same(first: Plant, second: Plant) -> bool:
    """Tell whether two plants have the same names, and agree where they can be compared."""
    names = [(list(plant.states), list(plant.inputs), set(plant.parameters)) for plant in (first, second)]
    return names[0] == names[1] and agree(first, second)


def _read_motion(plant: Plant, port: Port) -> tuple[str, str, str]:
    if port.motion is None or port.coordinate is None or port.rate is None:
        raise PlantError(
            f"the port of {plant.name} does not move, or does not say how; give motion, coordinate and rate"
        )
    return port.motion, port.coordinate, port.rate


def _find_pairs(plant: Plant) -> tuple[list[int], list[int]]:
    """Return where the coordinates and their rates stand in x: pairs, before the states of filters."""
    count = 0
    while 2 * count + 1 < len(plant.states):
        if not ca.is_equal(plant.dynamics[2 * count], plant.x[2 * count + 1]):
            break
        count += 1
    return list(range(0, 2 * count, 2)), list(range(1, 2 * count, 2))


@memo
def _inertia(plant: Plant, output: str) -> Any:
    """Return the CasADi function (x, p) -> (H, d output/dy)."""
    if output not in plant.outputs:
        raise PlantError(f'plant {plant.name} has no output "{output}"; {suggestion(output, plant.outputs)}')
    places, rates = _find_pairs(plant)
    position = plant.output[list(plant.outputs).index(output)]
    if ca.depends_on(position, ca.vertcat(plant.x[rates], plant.u)):
        raise PlantError(f"output {output} of {plant.name} depends on more than positions; name a position")
    hessian = ca.hessian(plant.stored_energy(), plant.x)[0]
    slope = ca.jacobian(position, plant.x[places])
    results = [ca.densify(hessian[rates, rates]), ca.densify(slope)]
    return ca.Function("inertia", [plant.x, plant.p], results)


def position(plant: Plant, params: CompletedParameters, state: State, output: str) -> float:
    """Return an output of a state without inputs."""
    values = output_function(plant)(0.0, state, np.zeros(len(plant.inputs)), params.vector)
    return float(np.array(values).ravel()[list(plant.outputs).index(output)])
