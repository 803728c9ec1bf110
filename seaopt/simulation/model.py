"""A plant ready for numbers: fixed parameters put in, free ones left as theta, and whether it is linear."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import field, replace
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np
from jaxtyping import Float

from seaopt.errors import PlantError, suggestion
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.plants.friction import can_stick
from seaopt.plants.memo import memo
from seaopt.records import record
from seaopt.signals import VectorM
from seaopt.simulation.sticking import has_one_joint, separate_jumps


@record(eq=False)
class Model:
    """Expressions of one plant in its free parameters theta, for chosen outputs.

    Parameters
    ----------
    plant : Plant
        The plant.
    free : tuple of str
        Names of theta, in order; parameters of other plants are not among them.
    p : SX
        theta, then the other parameters that are not zero, whose values are `constants`: data to compiled code, so that
        other values need no other code. Zeros are put in, and take their terms out.
    outputs : tuple of str
        The computed outputs, in order.
    linear : bool
        Whether f and h are affine in the state and the input for every theta, and do not depend on time.
    sticks : bool
        Whether friction that jumps is simulated as it is (`seaopt.simulation.sticking`). f and h are then those
        without it, as the plant moves at speed.
    """

    plant: Plant
    free: tuple[str, ...]
    outputs: tuple[str, ...]
    u: Any
    p: Any
    constants: Float[np.ndarray, " nc"]
    f: Any
    h: Any
    linear: bool
    sticks: bool = False
    memory: dict[Any, Any] = field(default_factory=dict, repr=False)  # of `memo`: what is made of the expressions

    @property
    def t(self) -> Any:
        """The time."""
        return self.plant.t

    @property
    def x(self) -> Any:
        """The state."""
        return self.plant.x

    @property
    def theta(self) -> Any:
        """The free parameters."""
        return self.p[: self.np]

    @property
    def by_events(self) -> bool:
        """Whether passes step from one stop or start of a joint to the next: where one joint sticks."""
        return self.sticks and has_one_joint(self.plant)

    @property
    def order(self) -> int:
        """Order of the error of its steps: where one of several joints stops within one, that is found to order two."""
        return 2 if self.sticks and not self.by_events else 4

    @property
    def nx(self) -> int:
        """Number of states."""
        return len(self.plant.states)

    @property
    def nu(self) -> int:
        """Number of inputs; at least 1 (a plant without inputs gets one that does nothing)."""
        return max(len(self.plant.inputs), 1)

    @property
    def reads(self) -> int:
        """How many of the inputs, the last ones, are readings of a log: of its own time, and joined by curves."""
        return len(self.plant.read_inputs)

    @property
    def read_states(self) -> tuple[list[int], list[int], int]:
        """The states that have what a device read of others, these, and the input that keeps them."""
        sampling = self.plant.sampling
        if sampling is None or not sampling.reads:
            return [], [], 0
        states, inputs = list(self.plant.states), list(self.plant.inputs)
        kept, read = ([states.index(name) for name in names] for names in (sampling.reads, sampling.reads.values()))
        return kept, read, inputs.index(sampling.kept_by)

    @property
    def ny(self) -> int:
        """Number of outputs."""
        return len(self.outputs)

    @property
    def np(self) -> int:
        """Number of free parameters."""
        return len(self.free)

    def __reduce__(self) -> tuple[Any, ...]:
        names = [str(symbol) for symbol in ca.vertsplit(self.p)]
        equations = ca.Function("model", [self.t, self.x, self.u, self.p], [self.f, self.h])
        plain = ("plant", "free", "outputs", "constants", "linear", "sticks")
        return _restore_model, (names, equations, {name: getattr(self, name) for name in plain})

    def __copy__(self) -> Model:
        return self  # nothing of a model changes

    def __deepcopy__(self, memory: dict[int, Any]) -> Model:
        return self

    def parameters(self, theta: Float[np.ndarray, " np"]) -> VectorM:
        """Return the values of `p`."""
        return np.concatenate([theta, self.constants])

    def set_samples(self, step: Float[np.ndarray, "... nx w"]) -> None:
        """Put what a device samples into a linear step x+ = step [x; ...] and its derivatives, which come behind it.
        One that reads at some samples alone is taken to read at each.
        """
        if self.plant.sampling is None:
            return
        kept, read, _ = self.read_states
        step[..., kept, :] = step[..., read, :]
        rows, weights = self.plant.sampling.matrix(tuple(self.plant.states))
        step[..., rows, :] = 0.0
        (step[0] if step.ndim == 3 else step)[rows, : self.nx] = weights

    def matrices(self, theta: Float[np.ndarray, " np"]) -> tuple[Float[np.ndarray, "..."], Float[np.ndarray, "..."]]:
        """Return the affine model [f; h] = G [x; u; 1] and its derivatives, for a linear model.

        Returns
        -------
        G : array, shape (nx + ny, nx + nu + 1)
        dG : array, shape (np, nx + ny, nx + nu + 1)
        """
        rows, cols = self.nx + self.ny, self.nx + self.nu + 1
        p = np.append(self.parameters(theta), 0.0)  # room for a number, which an address needs
        g, dg = np.zeros((cols, rows)), np.zeros(self.np * cols * rows + 1)
        buffer, run = _matrices(self).buffer()  # a fraction of a call's time for small matrices
        buffer.set_arg(0, p.data)
        buffer.set_res(0, g.data)
        buffer.set_res(1, dg.data)
        run()
        return g.T.copy(), dg[:-1].reshape(self.np, cols, rows).transpose(0, 2, 1)


def make_model(plant: Plant, params: ParameterSet, free: tuple[str, ...] = (), outputs: tuple[str, ...] = ()) -> Model:
    """Specialise a plant: the parameters outside `free` are held at their values.

    A parameter held at zero, such as f_c, takes its term out, so that a plant is linear exactly when its
    numbers make it so.

    Raises
    ------
    ParameterError
        A parameter has no value.
    PlantError
        An output is unknown.
    """
    chosen = outputs or tuple(plant.outputs)
    for name in chosen:
        if name not in plant.outputs:
            raise PlantError(f'plant {plant.name} has no output "{name}"; {suggestion(name, plant.outputs)}')
    values = {name: parameter.value for name, parameter in plant.complete(params).items()}
    names = tuple(name for name in free if name in values)
    zero = tuple(name for name in values if name not in names and values[name] == 0.0)
    model = _structure(plant, names, chosen, zero)
    fixed = [name for name in values if name not in names and name not in zero]
    return replace(model, constants=np.array([values[name] for name in fixed]))


@lru_cache(maxsize=64)
def _structure(plant: Plant, names: tuple[str, ...], outputs: tuple[str, ...], zero: tuple[str, ...]) -> Model:
    """Return a model without its constants; models that differ in those alone share what is made of it."""
    fixed = [name for name in plant.parameters if name not in names and name not in zero]
    u, p = _choose_symbols(plant, (*names, *fixed))
    rows = [list(plant.outputs).index(name) for name in outputs]
    f, h, levels = plant.dynamics, plant.output[rows], ca.SX(0)
    if plant.sticks and can_stick(plant):
        f, h, levels = separate_jumps(plant)
        h = h[rows]
    if zero:
        none = [ca.DM.zeros(len(zero))]
        f, h, levels = ca.substitute([f, h, levels], [_choose_symbols(plant, zero)[1]], none)
    sticks = not ca.simplify(levels).is_zero()
    return Model(
        plant=plant,
        free=names,
        outputs=outputs,
        u=u,
        p=p,
        constants=np.zeros(len(fixed)),
        f=f,
        h=h,
        linear=not (sticks or (plant.sampling and plant.sampling.reads)) and _is_linear(f, h, plant.t, plant.x, u),
        sticks=sticks,
    )


def _choose_symbols(plant: Plant, names: Sequence[str]) -> tuple[Any, Any]:
    """Return the input's symbol, which may be one that does nothing, and those of parameters."""
    symbols = dict(zip(plant.parameters, ca.vertsplit(plant.p), strict=True)) if plant.parameters else {}
    u = plant.u if plant.u.numel() else ca.SX.sym("no_input")
    return u, ca.vertcat(ca.SX(0, 1), *(symbols[name] for name in names))


def _restore_model(names: list[str], equations: Any, plain: dict[str, Any]) -> Model:
    """Return a pickled model, in its plant's symbols."""
    plant = plain["plant"]
    u, p = _choose_symbols(plant, names)
    f, h = equations(plant.t, plant.x, u, p)
    return Model(u=u, p=p, f=f, h=h, **plain)


def fill_parameters(model: Model, p: Any) -> Any:
    """Return the plant's vector of parameters from the model's; zeros are put in."""
    values = dict(zip(map(str, ca.vertsplit(model.p)), ca.vertsplit(p), strict=True)) if model.p.numel() else {}
    return ca.vertcat(*(values.get(name, ca.SX(0)) for name in model.plant.parameters))


@memo
def depends_on_time(model: Model) -> bool:
    """Tell whether f or h depends on the time itself."""
    return bool(ca.depends_on(ca.vertcat(model.f, model.h), model.t))


def linearise(model: Model) -> Model:
    """Return the model linearised at zero state and input."""
    if model.linear:
        return model
    return replace(_linearise_equations(model), constants=model.constants)


@memo
def _linearise_equations(model: Model) -> Model:
    point = ca.vertcat(model.x, model.u)
    both = ca.vertcat(model.f, model.h)
    slope, constant = ca.substitute(
        [ca.jacobian(both, point), both], [point, model.t], [ca.DM.zeros(point.numel()), ca.DM(0)]
    )
    rows: Any = ca.mtimes(slope, point) + constant
    return replace(model, f=rows[: model.nx], h=rows[model.nx :], linear=True, memory={})


def _is_linear(f: Any, h: Any, t: Any, x: Any, u: Any) -> bool:
    both, point = ca.vertcat(f, h), ca.vertcat(x, u)
    return not ca.depends_on(both, t) and not ca.depends_on(ca.jacobian(both, point), ca.vertcat(t, point))


@memo
def _matrices(model: Model) -> Any:
    """Return the CasADi function p -> G and its derivatives, see `Model.matrices`."""
    both, point = ca.vertcat(model.f, model.h), ca.vertcat(model.x, model.u)
    origin = ca.DM.zeros(point.numel())
    slope, constant = ca.substitute([ca.jacobian(both, point), both], [point], [origin])
    g = ca.densify(ca.horzcat(slope, constant))
    dg = ca.densify(ca.jacobian(ca.vec(g), model.theta))
    return ca.Function("matrices", [model.p], [g, dg])
