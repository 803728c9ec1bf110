r"""A plant: named states, inputs, outputs and parameters, and its equations in CasADi SX.

.. math:: \dot x = f(t, x, u, p), \qquad y = h(t, x, u, p)

`f` and `h` are functions of the time and three namespaces whose attributes are CasADi symbols; they return a
mapping from state (output) names to expressions. They are called once, when the plant is made.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import field, replace
from types import SimpleNamespace
from typing import Any, final

import casadi as ca
import numpy as np
from jaxtyping import Float

from seaopt.errors import ParameterError, PlantError, SeaoptError, UnitError, require_number, require_type, suggestion
from seaopt.formatting import html_text, join_words
from seaopt.parameters import Parameter, ParameterSet
from seaopt.plants.equations.declaration import (
    check_bristles,
    check_loads,
    check_names,
    check_roles,
    check_structure,
    evaluate_equations,
    stack_rows,
)
from seaopt.plants.equations.stored_equations import store_plant
from seaopt.plants.memo import keep_last, memo
from seaopt.plants.roles import (
    Actuation,
    Expression,
    Friction,
    Mode,
    Port,
    Reading,
    Recipe,
    Sampling,
    Sensing,
    SeriesSpring,
    Winding,
)
from seaopt.records import record
from seaopt.signals import VectorN, VectorX
from seaopt.units import factor, unit_after

Equations = Callable[[Any, Any, Any, Any], Mapping[str, Any]]
Derived = Callable[[Any], Mapping[str, tuple[Any, str]]]
Energy = Callable[[Any, Any], Any]
DRIVE_DELAY = "drive_delay_s"  # among parameters: seconds from a command to its effect
Matrices = tuple[
    Float[np.ndarray, "nx nx"], Float[np.ndarray, "nx nu"], Float[np.ndarray, "ny nx"], Float[np.ndarray, "ny nu"]
]


@record(eq=False)
class Plant:
    r"""States, inputs, outputs and parameters with units, and the equations that connect them.

    Parameters
    ----------
    name : str
        For errors and reports.
    states, inputs, outputs : mapping of name to SI unit
        In the order of the vectors x, u and y.
    parameters : mapping of name to unit or `Parameter`
        A unit alone declares a parameter whose value the user must give; a `Parameter` brings a default.
    f, h : callables ``(t, x, u, p) -> mapping``
        Time derivatives of the states and the outputs, as CasADi expressions of the namespaces' attributes.
    derived : callable ``p -> {name: (expression, unit)}``, optional
        Figures of interest that follow from the parameters; a fit reports them with their uncertainty.
    optional_inputs : collection of names
        Inputs that a log may leave out; they are then zero (external forces).
    energy : callable ``(x, p) -> expression``, optional
        Kinetic and potential energy, J, of a mechanical plant whose states come as pairs of a coordinate and its rate,
        the coordinate first; states of filters around it may follow.
    actuation, sensing, spring, ports, friction, mode, winding : roles, optional
        What a controller commands and what effort that makes, what is measured, the elastic element, where the world
        touches it (the port that is loaded and looked at first), friction by name, a mode that ranges may name, and the
        winding that warms up:
        `seaopt.plants.roles`.
    sticks : bool
        Simulate and fit friction that declares its `jump` as it is, a joint at rest standing still; else as its
        smoothed curve.
    sampling : Sampling, optional
        States that hold what was sampled; f is zero for them.
    clock : str, optional
        The optional input that is the time since a log's beginning, s: counted where the log has no such channel.
    followed : mapping of name to Reading, optional
        States that f and h take by another name, ``u.NAME``, among the inputs: it is the state's own value, but where a
        log with a channel of that state drives a fit (`follow_readings`).
    recipe : Recipe, optional
        How it is made with other parts.
    drive_offset_s : float
        Of one actuator whose drive was found as fast here and as slow there: what this one's delay is beyond that of
        the others, the parameters' ``drive_delay_s``, s.

    Raises
    ------
    PlantError
        A name is used twice or is not an identifier, a parameter has no unit, an equation is missing or unknown,
        an output depends on nothing, a state is never driven, or a role names what the plant does not have.

    Examples
    --------
    A mass on a spring, pushed by a force:

    >>> import seaopt as so
    >>> plant = so.Plant(
    ...     name="mass and spring",
    ...     states={"x": "m", "v": "m/s"}, inputs={"F": "N"}, outputs={"x": "m"},
    ...     parameters={"m": "kg", "k": "N/m", "c": "N s/m"},
    ...     f=lambda t, x, u, p: {"x": x.v, "v": (u.F - p.k * x.x - p.c * x.v) / p.m},
    ...     h=lambda t, x, u, p: {"x": x.x},
    ... )
    >>> model = plant.linearize(so.ParameterSet.of(m=(2.0, "kg"), k=(50.0, "N/m"), c=(1.0, "N s/m")))
    >>> [round(float(abs(pole)), 6) for pole in model.poles()]
    [5.0, 5.0]
    """

    name: str
    states: Mapping[str, str]
    inputs: Mapping[str, str]
    outputs: Mapping[str, str]
    parameters: Mapping[str, str | Parameter]
    f: Equations
    h: Equations
    derived: Derived | None = None
    optional_inputs: frozenset[str] = frozenset()
    energy: Energy | None = None
    actuation: Actuation | None = field(default=None, repr=False)
    sensing: Sensing | None = field(default=None, repr=False)
    spring: SeriesSpring | None = field(default=None, repr=False)
    ports: tuple[Port, ...] = field(default=(), repr=False)
    friction: Mapping[str, Friction] = field(default_factory=dict[str, Friction], repr=False)
    mode: Mode | None = field(default=None, repr=False)
    winding: Winding | None = field(default=None, repr=False)
    sticks: bool = False
    sampling: Sampling | None = field(default=None, repr=False)
    clock: str | None = None
    followed: Mapping[str, Reading] = field(default_factory=dict[str, Reading], repr=False)
    recipe: Recipe | None = field(default=None, repr=False)
    drive_offset_s: float = field(default=0.0, repr=False)
    t: Any = field(init=False, repr=False)
    x: Any = field(init=False, repr=False)
    u: Any = field(init=False, repr=False)
    p: Any = field(init=False, repr=False)
    dynamics: Any = field(init=False, repr=False)
    output: Any = field(init=False, repr=False)
    memory: dict[Any, Any] = field(init=False, repr=False, default_factory=dict)

    def __post_init__(self) -> None:
        check_names(self)
        put = object.__setattr__
        spaces: list[SimpleNamespace] = []
        for key, names in (("x", self.states), ("u", self.inputs), ("p", self.parameters)):
            symbols = {name: ca.SX.sym(name) for name in names}
            spaces.append(SimpleNamespace(**symbols))
            put(self, key, ca.vertcat(*symbols.values()) if symbols else ca.SX(0, 1))
        x, u, p = spaces
        _add_readings(self, x, u)
        for name, friction in self.friction.items():
            check_loads(self, name, friction, spaces)
            setattr(u, name, friction.force_at(x, u, p))
        put(self, "t", ca.SX.sym("t"))
        for key, what, names in (("dynamics", "f", self.states), ("output", "h", self.outputs)):
            expressions = evaluate_equations(self, what, getattr(self, what), self.t, *spaces)
            put(self, key, stack_rows(self, what, expressions, names))
        check_structure(self)
        check_roles(self)
        check_bristles(self, spaces)

    @property
    def symbols(self) -> tuple[Any, Any, Any, Any]:
        """The symbols t, x, u and p, of which `dynamics` and `output` are expressions."""
        return self.t, self.x, self.u, self.p

    @property
    def port(self) -> Port | None:
        """The port that is loaded, struck, held and looked at: the first; None without any."""
        return self.ports[0] if self.ports else None

    @property
    def moves(self) -> bool:
        """Whether a link moves: at some port, the world does not hold the plant."""
        return any(port.motion is not None for port in self.ports)

    @property
    def defaults(self) -> ParameterSet:
        """The parameters that have a default value."""
        return ParameterSet(default for default in self.parameters.values() if isinstance(default, Parameter))

    @property
    def read_inputs(self) -> tuple[str, ...]:
        """The inputs that are readings of a log: the last ones, of a plant that follows them."""
        return tuple(name for name in self.followed if name in self.inputs)

    def parameter_unit(self, name: str) -> str:
        """Return the SI unit of a parameter."""
        default = self.parameters[name]
        return default.unit if isinstance(default, Parameter) else default

    def complete(self, params: ParameterSet) -> CompletedParameters:
        """Return the plant's own parameters in its units and order: from `params`, else the defaults.

        Public functions do this once; what is complete for this plant is returned as it is. Raises ParameterError: a
        parameter has neither a value in `params` nor a default, or one that the plant cannot have. Raises UnitError: a
        value's unit has another dimension than the plant's.
        """
        require_type(params, ParameterSet, f"params of plant {self.name}", "give a ParameterSet", ParameterError)
        if isinstance(params, CompletedParameters):
            if params.plant is self:
                return params
            params = params.given
        missing = {
            name: unit_after(unit)
            for name, unit in self.parameters.items()
            if name not in params and not isinstance(unit, Parameter)
        }
        if missing:
            names = join_words([f'"{name}"' for name in missing])
            units = join_words([f"{name} in{unit}" if unit else name for name, unit in missing.items()])
            what, have = ("parameter", "has") if len(missing) == 1 else ("parameters", "have")
            raise ParameterError(f"{what} {names} of plant {self.name} {have} no value, and no default; give {units}")
        completed: list[Parameter] = []
        for name, default in self.parameters.items():
            unit = self.parameter_unit(name)
            if name in params:
                completed.append(_keep_bounds(_convert_unit(params[name], unit, self.name), default, self.name))
            elif isinstance(default, Parameter):
                completed.append(default)
        return CompletedParameters(self, params, completed)

    def derived_values(self) -> dict[str, tuple[Any, str]]:
        """Return the derived figures as {name: (expression of p, unit)}; empty where none are declared."""
        if self.derived is None:
            return {}
        return dict(self.derived(name_parameters(self, self.p)))

    def stored_energy(self) -> Any:
        """Return the energy (J) as an expression of x and p. Raises PlantError: the plant declares none."""
        if self.energy is None:
            raise PlantError(f"plant {self.name} declares no energy; give energy=lambda x, p: ... when it is made")
        x, _, p = name_symbols(self, *self.symbols[1:])
        return ca.SX(self.energy(x, p))

    def linearize(
        self, params: ParameterSet, x: Mapping[str, float] | None = None, u: Mapping[str, float] | None = None
    ) -> Any:
        """Return the continuous-time `control.StateSpace` at an operating point, signals named.

        Parameters
        ----------
        params : ParameterSet
            Values of the plant's parameters.
        x, u : mapping of name to float, optional
            Operating point; what is left out is zero.

        Returns
        -------
        control.StateSpace
            From `inputs` to `outputs`, states named as the plant's.
        """
        import control  # deferred: it imports matplotlib

        a, b, c, d = state_space(self, params, x, u)
        return control.ss(
            a, b, c, d, states=list(self.states), inputs=list(self.inputs), outputs=list(self.outputs), name=self.name
        )

    def __reduce__(self) -> tuple[Any, ...]:
        return _restore_plant, (store_plant(self),)

    def __copy__(self) -> Plant:
        return self  # nothing of a plant changes

    def __deepcopy__(self, memory: dict[int, Any]) -> Plant:
        return self

    def __repr__(self) -> str:
        def format_names(units: Mapping[str, Any]) -> str:
            return ", ".join(f"{name} [{unit if isinstance(unit, str) else unit.unit}]" for name, unit in units.items())

        return (
            f"Plant {self.name}\n  states      {format_names(self.states)}\n  inputs      {format_names(self.inputs)}\n"
            f"  outputs     {format_names(self.outputs)}\n  parameters  {format_names(self.parameters)}"
        )

    _repr_html_ = html_text


def share_drive(made: Plant, plant: Plant) -> Plant:
    """Return a plant that was made of another, behind the same drive."""
    return replace(made, drive_offset_s=plant.drive_offset_s) if plant.drive_offset_s else made


def extend(
    plant: Plant,
    *,
    find_inputs: Callable[[Any, Any, Any], Any] = lambda x, u, p: u,
    find_parameters: Callable[[Any], Any] = lambda p: p,
    rates: Equations = lambda t, x, u, p: {},
    readings: Equations = lambda t, x, u, p: {},
    added: Iterable[Parameter] = (),
    **fields: Any,
) -> Plant:
    """Return a plant inside another one: what it sees as its inputs follows from those of the other by (x, u, p), and
    its parameters by p. `rates` and `readings`, of what the other sees, go beside its own or in their place, `added`
    beside its parameters, and `fields` in the place of its own.
    """
    inputs, own = keep_last(find_inputs), keep_last(find_parameters)

    def widen(equations: Equations, more: Equations) -> Equations:
        return lambda t, x, u, p: {**equations(t, x, inputs(x, u, p), own(p)), **more(t, x, u, p)}

    parameters = {**plant.parameters, **{parameter.name: parameter for parameter in added}}
    fields = {"parameters": parameters, **fields}
    return replace(plant, f=widen(plant.f, rates), h=widen(plant.h, readings), **fields)


def _restore_plant(content: Mapping[str, Any]) -> Plant:
    return Plant(**content)


@final
class CompletedParameters(ParameterSet):
    """A plant's own parameters, all of them, in its units and order, as `Plant.complete` makes them.

    A function that takes these relies on its caller for completion. A change gives a plain `ParameterSet`, which is to
    be completed again; of what else was given it has the drive's delay alone.

    Attributes
    ----------
    plant : Plant
        Whose parameters they are.
    given : ParameterSet
        What was completed; it may hold conditions and other plants' parameters too.
    vector : array, shape (np,)
        The values.
    """

    __slots__ = ("given", "plant", "vector")

    def __init__(self, plant: Plant, given: ParameterSet, parameters: Iterable[Parameter]) -> None:
        super().__init__(parameters)
        self.plant, self.given = plant, given
        self.vector: Float[np.ndarray, " np"] = np.array([parameter.value for parameter in self.values()], dtype=float)

    def drop_conditions(self) -> CompletedParameters:
        """Return the same parameters, and of what else is given only the drive's delay, which is there everywhere."""
        return self.plant.complete(self.with_parameters())

    def with_parameters(self, *parameters: Parameter) -> ParameterSet:
        """Return a plain set, the drive's delay kept, in which `parameters` replace those of the same name."""
        late = [self.given[DRIVE_DELAY]] if DRIVE_DELAY in self.given else []
        return super().with_parameters(*late, *parameters)

    @property
    def by_attribute(self) -> SimpleNamespace:
        """The values as attributes, for a role's expression."""
        return SimpleNamespace(**{name: parameter.value for name, parameter in self.items()})


def evaluate(expression: Expression, params: CompletedParameters) -> float:
    """Return the value of a role's expression of the parameters."""
    return float(expression(params.by_attribute))


def describe_parameters(expression: Expression, params: CompletedParameters) -> str:
    """Return the parameters that a role's expression depends on, with their values."""
    symbols = dict(zip(params, ca.vertsplit(params.plant.p), strict=True))
    value = ca.SX(expression(SimpleNamespace(**symbols)))
    used = [parameter for name, parameter in params.items() if ca.depends_on(value, symbols[name])]
    return ", ".join(f"{parameter.name} = {parameter.value:g}{unit_after(parameter.unit)}" for parameter in used)


def find_range(plant: Plant, params: ParameterSet) -> float | None:
    """Return the largest magnitude of the first input that acts; None if not stated, PlantError if not positive."""
    if plant.actuation is None or plant.actuation.largest is None:
        return None
    expression, values = plant.actuation.largest, plant.complete(params)
    largest = evaluate(expression, values)
    if not 0.0 < largest < math.inf:
        raise PlantError(
            f"actuation.largest is {largest:g}, which must be positive and finite; check "
            f"{describe_parameters(expression, values) or 'its actuation'}",
            plant=plant.name,
        )
    return largest


def name_input(plant: Plant) -> tuple[str, str]:
    """Return name and unit of the first input, which is what a controller commands."""
    return next(iter(plant.inputs.items()))


def require_plant(value: Any, argument: str, error: type[SeaoptError]) -> None:
    """Refuse what is no plant that moves: an argument of another type, or a plant without states."""
    require_type(value, Plant, argument, "give a Plant", error)
    if not value.states:
        raise error(f"{argument}: plant {value.name} has no states, so that nothing moves; give it states and f")


@memo
def dynamics_function(plant: Plant) -> Any:
    """Return the CasADi function (x, u, p) -> f at t = 0."""
    dynamics = ca.substitute(plant.dynamics, plant.t, 0.0)
    return ca.Function("dynamics", plant.symbols[1:], [ca.densify(dynamics)])


@memo
def output_function(plant: Plant) -> Any:
    """Return the CasADi function (t, x, u, p) -> h."""
    return ca.Function("output", plant.symbols, [ca.densify(plant.output)])


def agree(first: Plant, second: Plant) -> bool:
    """Tell whether the rates and the outputs that two plants both have are the same at one point, in which states,
    inputs and parameters of one name have one value; what is not finite there is not judged.
    """
    rng, point, values = np.random.default_rng(0), dict[str, float](), list[dict[str, float]]()
    for plant in (first, second):
        groups = (plant.states, plant.inputs, plant.parameters)
        x, u, p = ([point.setdefault(name, rng.uniform(0.5, 1.5)) for name in group] for group in groups)
        rows = np.array(ca.vertcat(dynamics_function(plant)(x, u, p), output_function(plant)(0.0, x, u, p))).ravel()
        names = [*(f"f.{name}" for name in plant.states), *(f"h.{name}" for name in plant.outputs)]
        values.append(dict(zip(names, rows.tolist(), strict=True)))
    return all(
        math.isclose(value, values[1][name], rel_tol=1e-9, abs_tol=1e-12)
        for name, value in values[0].items()
        if name in values[1] and math.isfinite(value)
    )


@memo
def jacobians(plant: Plant) -> Any:
    """Return the CasADi function (x, u, p) -> (A, B, C, D) at t = 0."""
    blocks = [
        ca.densify(ca.jacobian(expression, variable))
        for expression in (plant.dynamics, plant.output)
        for variable in (plant.x, plant.u)
    ]
    blocks = [ca.substitute(block, plant.t, 0.0) for block in blocks]
    return ca.Function("jacobians", plant.symbols[1:], blocks)


def name_parameters(plant: Plant, p: Any) -> SimpleNamespace:
    """Return a vector of a plant's parameters as the namespace that its roles take."""
    return SimpleNamespace(**dict(zip(plant.parameters, ca.vertsplit(p), strict=True)))


def name_symbols(plant: Plant, x: Any, u: Any, p: Any) -> tuple[SimpleNamespace, ...]:
    """Return vectors of states, inputs and parameters as the namespaces that a plant's roles take."""
    vectors = ((plant.states, x), (plant.inputs, u), (plant.parameters, p))
    spaces = tuple(SimpleNamespace(**dict(zip(names, ca.vertsplit(v), strict=True))) for names, v in vectors)
    _add_readings(plant, *spaces[:2])
    return spaces


def _add_readings(plant: Plant, x: SimpleNamespace, u: SimpleNamespace) -> None:
    """Give the inputs the states that stand among them, but for those that are inputs."""
    for name, reading in plant.followed.items():
        if name not in plant.inputs:
            setattr(u, name, getattr(x, reading.state))


@memo
def follow_readings(plant: Plant) -> Plant:
    """Return a plant to which its readings are inputs, the last ones: what sensors have read of its states."""
    more = {name: plant.states[reading.state] for name, reading in plant.followed.items()}
    return replace(plant, inputs={**plant.inputs, **more}) if more else plant


@memo
def _deflection_slope(plant: Plant) -> Any:
    """Return the CasADi function (x, p) -> derivative of the spring's deflection by the states."""
    assert plant.spring is not None
    x, _, p = name_symbols(plant, *plant.symbols[1:])
    slope = ca.jacobian(ca.SX(plant.spring.deflection(x, p)), plant.x)
    return ca.Function("deflection", [plant.x, plant.p], [ca.densify(slope)])


def deflection_row(plant: Plant, params: CompletedParameters) -> VectorX:
    """Return the spring's deflection as a row of weights of the states, at zero."""
    zero = np.zeros(len(plant.states))
    return np.array(_deflection_slope(plant)(zero, params.vector)).ravel()


def refuse_clash(plant: Plant, part: str, names: Iterable[str], replaced: str = "") -> None:
    """Refuse a part of which a name is one of the plant's, but for that of the signal that it replaces."""
    taken = {*plant.states, *plant.outputs, *plant.parameters, *plant.inputs} - {replaced}
    for name in names:
        if name in taken:
            raise PlantError(f'part "{part}" has "{name}", which the plant has, too', plant=plant.name)


def refuse_samples(plant: Plant) -> None:
    """Refuse a plant that holds samples where one in continuous time is meant: between samples these stand still."""
    if plant.sampling is not None:
        raise PlantError(f"plant {plant.name} holds samples, which no system in continuous time does; give it without")


def state_space(
    plant: Plant, params: ParameterSet, x: Mapping[str, float] | None = None, u: Mapping[str, float] | None = None
) -> Matrices:
    """Return (A, B, C, D) of a plant at an operating point, as `Plant.linearize` but plain arrays.

    Raises
    ------
    PlantError
        The plant holds samples.
    """
    refuse_samples(plant)
    at = (fill_vector("state", plant.states, x), fill_vector("input", plant.inputs, u), plant.complete(params).vector)
    a, b, c, d = (np.array(block) for block in jacobians(plant)(*at))
    return a, b, c, d


def fill_vector(kind: str, names: Mapping[str, str], values: Mapping[str, float] | None) -> VectorN:
    """Return the vector of `names` with the given values, zero elsewhere. Raises PlantError: an unknown name."""
    if values is not None and not isinstance(values, Mapping):
        raise PlantError(f"{kind}s are given as a {type(values).__name__}; give a mapping of {kind} name to value")
    values = values or {}
    for name in values:
        if name not in names:
            raise PlantError(f'"{name}" is not a {kind} of this plant; {suggestion(name, names)}')
    return np.array([require_number(values.get(name, 0.0), f"{kind} {name}", PlantError) for name in names])


def _convert_unit(parameter: Parameter, unit: str, plant: str) -> Parameter:
    """Return a parameter in another unit of the same dimension."""
    if parameter.unit == unit:
        return parameter
    try:
        scale = factor(parameter.unit, unit)
    except UnitError as error:
        raise UnitError(f"parameter {parameter.name} of plant {plant}: {error}") from error
    stds = {
        name: value * scale
        for name in ("prior_std", "std", "model_std")
        if (value := getattr(parameter, name)) is not None
    }
    low, high = parameter.min * scale, parameter.max * scale
    return replace(parameter, value=parameter.value * scale, unit=unit, min=low, max=high, **stds)


def _keep_bounds(parameter: Parameter, default: str | Parameter, plant: str) -> Parameter:
    """Return a parameter with the plant's bounds where it has none of its own; what is divided by stays above zero."""
    if isinstance(default, str):
        return parameter
    low = default.min if parameter.min == -math.inf else parameter.min
    low = max(low, default.min) if default.min > 0.0 else low
    high = default.max if parameter.max == math.inf else parameter.max
    if (low, high) == (parameter.min, parameter.max):
        return parameter
    if not low <= parameter.value <= high:
        raise ParameterError(
            f"parameter {parameter.name} = {parameter.value:g}{unit_after(parameter.unit)} of plant {plant} is outside "
            f"{low:g} to {high:g}; correct its value, sign or unit"
        )
    return replace(parameter, min=low, max=high)
