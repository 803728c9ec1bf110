r"""What happens in no time: a blow on a link, and a link that is caught.

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
the place of q.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import casadi as ca
import numpy as np
from jaxtyping import Float

from seaopt.errors import PlantError, suggestion
from seaopt.parameters import ParameterSet
from seaopt.plants.memo import memo
from seaopt.plants.plant import Plant, output_function

State = Float[np.ndarray, " n"]
Held = Float[np.ndarray, " m"]


def struck(plant: Plant, params: ParameterSet, state: State, output: str, impulse: float) -> State:
    """Return the state after a blow along an output, a position such as x_2.

    Parameters
    ----------
    plant, params
        A plant that declares its energy.
    state : array, shape (n,)
        Before the blow.
    output : str
        The position that is struck.
    impulse : float
        N s (N m s along an angle), positive along the output.

    Returns
    -------
    array, shape (n,)

    Raises
    ------
    PlantError
        The plant has no such output or no energy, or the output depends on more than positions.

    Examples
    --------
    >>> import numpy as np, seaopt as so
    >>> plant = so.plants.two_link("fixed", "mass")
    >>> after = struck(plant, plant.defaults, np.zeros(4), "x_2", 1.0)
    >>> round(float(after[3]), 5)  # 10 kg and the 0.646 kg that go along, next to nothing of the screw
    0.09394

    """
    inertia, slope = (np.array(item) for item in _inertia(plant, output)(state, plant.parameter_values(params)))
    after = state.copy()
    rates = _pairs(plant)[1]
    after[rates] += np.linalg.solve(inertia, slope.ravel() * impulse)
    return after


def caught(
    plant: Plant, params: ParameterSet, state: State, held: Plant, output: str = "x_2"
) -> tuple[Held, float, float]:
    """Return the state of `held` after a link of `plant` is stopped where it is.

    Parameters
    ----------
    plant, params
        The plant with the moving link; it declares its energy.
    state : array, shape (n,)
        Before the contact.
    held : Plant
        The same actuator with that link fixed: its states are those of `plant` but for the link's.
    output : str
        The link's position.

    Returns
    -------
    state : array
        Of `held`, q counted from where the link is held.
    impulse : float
        What stops the link, along its coordinate: N m s of a pendulum, N s of a mass.
    loss : float
        Kinetic energy (J) that is lost.

    Raises
    ------
    PlantError
        The two plants are not such a pair.

    """
    _check_pair(plant, held)
    inertia = np.array(_inertia(plant, output)(state, plant.parameter_values(params))[0])
    places, rates = _pairs(plant)
    names = list(plant.states)
    (link,) = (k for k, place in enumerate(places) if names[place] not in held.states)
    others = [k for k in range(len(places)) if k != link]
    before, after = state[rates], state[rates].copy()
    after[link] = 0.0
    coupling = inertia[np.ix_(others, [link])].ravel()
    after[others] += np.linalg.solve(inertia[np.ix_(others, others)], coupling * before[link])
    impulse = float(inertia[link] @ (after - before))
    loss = 0.5 * float(before @ inertia @ before - after @ inertia @ after)
    moved = state.copy()
    moved[rates] = after
    moved[names.index("q")] += position(plant, params, state, output)
    return moved[[names.index(name) for name in held.states]], impulse, loss


def released(
    held: Plant, state: Held, plant: Plant, params: ParameterSet, link: Mapping[str, float], output: str = "x_2"
) -> State:
    """Return the state of `plant` after its link is let go at the position `link`, as the reverse of `caught`.

    Parameters
    ----------
    held, state
        The actuator with the link fixed, and its state.
    plant, params
        The actuator with the link free.
    link : mapping of name to float
        The link's coordinate when it is let go, such as {"phi": 0.3}; zero where left out. Its rate is zero.
    output : str
        The link's position.

    Raises
    ------
    PlantError
        The two plants are not such a pair, or `link` names no state.

    """
    _check_pair(plant, held)
    known = dict(zip(held.states, state, strict=True))
    for name in link:
        if name not in plant.states or name in known:
            raise PlantError(f'link = {{"{name}": ...}} is no state of the link of {plant.name}; '
                             + suggestion(name, [n for n in plant.states if n not in known]))  # fmt: skip
    after = np.array([{**link, **known}.get(name, 0.0) for name in plant.states], dtype=float)
    after[list(plant.states).index("q")] -= position(plant, params, after, output)
    return after


def is_pair(plant: Plant, held: Plant) -> bool:
    """Tell whether `held` is the actuator of `plant` with a link fixed.

    It has the states of `plant` but for one coordinate, other than q, and its rate, and with those at zero the same
    energy.
    """
    left = [name for name in plant.states if name not in held.states]
    if plant.energy is None or held.energy is None or "q" not in held.states or len(left) != 2:
        return False
    if not set(held.states) < set(plant.states) or not set(held.parameters) <= set(plant.parameters):
        return False
    numbers = dict(
        zip((*held.states, *plant.parameters), np.random.default_rng(0).uniform(0.5, 1.5, 999), strict=False)
    )
    energies = [
        float(ca.Function("energy", [item.x, item.p], [item.stored_energy()])(
            [numbers.get(name, 0.0) for name in item.states], [numbers[name] for name in item.parameters]
        ))
        for item in (plant, held)
    ]  # fmt: skip
    return bool(np.isclose(*energies, rtol=1e-9))


def _check_pair(plant: Plant, held: Plant) -> None:
    if not is_pair(plant, held):
        raise PlantError(
            f"{held.name} is not {plant.name} with a link fixed; give two plants with the same drive, spring and parts"
        )


def _pairs(plant: Plant) -> tuple[list[int], list[int]]:
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
    places, rates = _pairs(plant)
    position = plant.output[list(plant.outputs).index(output)]
    if ca.depends_on(position, ca.vertcat(plant.x[rates], plant.u)):
        raise PlantError(f"output {output} of {plant.name} depends on more than positions; name a position")
    hessian = ca.hessian(plant.stored_energy(), plant.x)[0]
    slope = ca.jacobian(position, plant.x[places])
    results = [ca.densify(hessian[rates, rates]), ca.densify(slope)]
    return ca.Function("inertia", [plant.x, plant.p], results)


def position(plant: Plant, params: ParameterSet, state: State, output: str) -> float:
    """Return an output of a state without inputs."""
    values = output_function(plant)(0.0, state, np.zeros(len(plant.inputs)), plant.parameter_values(params))
    return float(np.array(values).ravel()[list(plant.outputs).index(output)])
