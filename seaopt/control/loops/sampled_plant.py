r"""A plant as a digital controller sees it: sampled through a zero-order hold, one input to one output, with delay.

Besides parameters, a plant has conditions, which stand in the same `ParameterSet` under these names:

a state of the plant (``phi``)
    It is linearised at rest there, the first input and the other states being what keeps it at rest, instead of at
    zero.
``drive_delay_s``
    Seconds from a command to its effect: the drive's delay, which no program adds or can take away.
``delay_s``
    Seconds of delay besides the controller's whole samples and the drive's. With :math:`w` whole samples and a rest
    :math:`\tau` in both together, the older of two commands acts for :math:`\tau` and the newer for what is left of a
    period: :math:`x^+ = e^{AT} x + [\Gamma(T) - \Gamma(T - \tau)] u_{k-w-1} + \Gamma(T - \tau) u_{k-w}` with
    :math:`\Gamma(t) = \int_0^t e^{As} ds\, B` (Astrom, Wittenmark, Computer-Controlled Systems, 3rd ed., 2.3).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from threading import get_ident
from typing import Any

import casadi as ca
import numpy as np
from jaxtyping import Complex, Float, Inexact

from seaopt.control.loops.drift import take_linear
from seaopt.control.systems.block import Block, make_plant
from seaopt.errors import ControlError, UnitError, suggestion
from seaopt.parameters import Parameter, ParameterSet
from seaopt.plants import CompletedParameters, Plant
from seaopt.plants.friction import SLIDING, friction_states, remembers, rest_jacobians
from seaopt.plants.memo import memo
from seaopt.plants.motor.thermal import freeze_heat
from seaopt.plants.plant import DRIVE_DELAY, dynamics_function, refuse_samples
from seaopt.records import record
from seaopt.signals import ComplexM, MatrixNN, VectorM, VectorN
from seaopt.simulation.direct_call import DirectCall
from seaopt.units import factor

PerPlant = Float[np.ndarray, " k"]
ValueColumns = Float[np.ndarray, "np k"]  # a column for each plant
Matrices = Inexact[np.ndarray, "k n n"]
Vectors = Inexact[np.ndarray, "k n"]
LinearPlants = tuple[  # a, b, c, d from one input; c and d have a row for each output
    Matrices, Vectors, Inexact[np.ndarray, "k y n"], Inexact[np.ndarray, "k y"]
]
SampledPlants = tuple[  # with more states, of commands on their way
    Inexact[np.ndarray, "k m m"], Inexact[np.ndarray, "k m"], Inexact[np.ndarray, "k y m"], Inexact[np.ndarray, "k y"]
]
Measured = str | tuple[str, ...]  # one output by its name, or several, the regulated one first

DELAY = "delay_s"
DELAYS = (DELAY, DRIVE_DELAY)
MAPPED = (1, 32, 128, 512)  # plants in one call of CasADi; what is left of a block is padded
REACH, DEGREE = 0.125, 10  # of the exponential's Taylor polynomial: 0.125^11 / 11! = 3e-18
NEWTON_STEPS = 30


@record(eq=False)
class DigitalPlant:
    """x+ = a x + b u, y = c x + d u at a sample time, and whole samples of delay before u.

    Parameters
    ----------
    a, b, c, d
        Matrices, shapes (n, n), (n,), (y, n) and (y,): a row for each output that a law reads, the regulated one first.
    sample_time_s : float
        Seconds.
    delay_samples : int
        From measurement to output, besides the hold.
    static_gain : float
        y/u at 0 Hz, from the continuous plant; infinite where it has an integrator.
    """

    a: MatrixNN
    b: VectorN
    c: Float[np.ndarray, "y n"]
    d: Float[np.ndarray, " y"]
    sample_time_s: float
    delay_samples: int
    static_gain: float

    @property
    def nyquist_hz(self) -> float:
        """Half the sample rate."""
        return 0.5 / self.sample_time_s

    def response(self, f: VectorM) -> ComplexM:
        """Return P(z) z^-delay at frequencies in Hz, of the regulated output."""
        return self.responses(f)[0]

    def responses(self, f: VectorM) -> Complex[np.ndarray, "y m"]:
        """Return P(z) z^-delay at frequencies in Hz, of every output."""
        z = np.exp(2j * np.pi * f * self.sample_time_s)
        x = np.linalg.solve(z[:, None, None] * np.eye(self.b.size) - self.a, self.b[None, :, None])[..., 0]
        return np.array([(x @ c + d) * z**-self.delay_samples for c, d in zip(self.c, self.d, strict=True)])

    @property
    def block(self) -> Block:
        """The plant from the command to every output, with the delay as states."""
        return make_plant(self.a, self.b, self.c, self.d, self.delay_samples)


def sample(
    plant: Plant, params: ParameterSet, measured: Measured, gain: float, sample_time_s: float, delay_samples: int
) -> DigitalPlant:
    """Return the digital plant from motor force to a measured force, linearised at rest.

    Parameters
    ----------
    plant, params
        The plant; its first input is what the controller commands. `params` may hold conditions too.
    measured : str or tuple of str
        The output that is fed back; or several, the regulated one first.
    gain : float
        A/N: the current that the controller commands for a motor force.
    sample_time_s : float
        Seconds.
    delay_samples : int
        Whole samples of delay.

    Raises
    ------
    ControlError
        The plant has no such output, or cannot rest where it is to be linearised.
    """
    linear, delay_s = linearise_sets(plant, [plant.complete(params)], measured, gain)
    return sample_linear(linear, delay_s, sample_time_s, delay_samples)[0]


def linearise_sets(
    plant: Plant, sets: Sequence[CompletedParameters], measured: Measured, gain: float
) -> tuple[LinearPlants, PerPlant]:
    """Return what `linearise` does at k sets of parameters with the same conditions among them, and their delays (s).
    Raises ControlError: the plant has no such output, or cannot rest where it is to be linearised.
    """
    places = [read_conditions(plant, values) for values in sets]
    at = {name: np.array([conditions_there[name] for conditions_there in places]) for name in places[0]}
    linear = linearise(plant, np.column_stack([values.vector for values in sets]), at, measured, gain)
    return linear, np.zeros(len(sets)) + find_delay(plant, at)


def sample_linear(
    plants: LinearPlants, delay_s: PerPlant, sample_time_s: float, delay_samples: int
) -> list[DigitalPlant]:
    """Return the digital plants of k linear ones and their delays, seconds besides the whole samples."""
    return [
        DigitalPlant(
            a=a,
            b=b,
            c=c,
            d=d,
            sample_time_s=sample_time_s,
            delay_samples=delay_samples,
            static_gain=_compute_static_gain(*(block[k] for block in plants)),
        )
        for k, (a, b, c, d) in enumerate(zip(*hold(*plants, sample_time_s, delay_s), strict=True))
    ]


def sample_matrices(linear: Sequence[Any], delay_s: float, sample_time_s: float, delay_samples: int) -> DigitalPlant:
    """Return the digital plant of the matrices of one linear one."""
    a, b, c, d = (part[None] for part in linear)
    return sample_linear((a, b, c, d), np.array([delay_s]), sample_time_s, delay_samples)[0]


def static_gain(plant: Plant, params: CompletedParameters, output: str) -> float:
    """Return an output of a constant unit of the first input, linearised at rest; infinite where it integrates.
    Bristles slide, which at rest carry a part of the input. Raises ControlError: the plant has no such output, or
    cannot rest where it is to be linearised.
    """
    at = {name: np.array([value]) for name, value in read_conditions(plant, params).items()}
    return _compute_static_gain(
        *(part[0] for part in linearise(_let_slide(plant), params.vector[:, None], at, output, 1.0))
    )


def conditions(plants: tuple[Plant, ...]) -> dict[str, Parameter]:
    """Return what a plant's `ParameterSet` may hold besides its parameters."""
    described = {DELAY: "delay besides the controller's and the drive's", DRIVE_DELAY: "from a command to its effect"}
    delays = [Parameter(name=name, value=0.0, unit="s", min=0.0, description=text) for name, text in described.items()]
    states = [Parameter(name=name, value=0.0, unit=unit) for plant in plants for name, unit in plant.states.items()]
    return {parameter.name: parameter for parameter in delays + states}


def find_delay(plant: Plant, at: Mapping[str, Any]) -> Any:
    """Return the delay (s) besides the controller's samples where a plant's conditions are, numbers or arrays."""
    late = at.get(DELAY, 0.0) + at.get(DRIVE_DELAY, 0.0)
    return np.maximum(late + plant.drive_offset_s, 0.0) if plant.drive_offset_s else late


def whole_samples(delay_s: float, sample_time_s: float) -> tuple[int, float]:
    """Return a delay as whole samples and the rest in seconds."""
    whole = math.floor(delay_s / sample_time_s + 1e-9)
    remainder = delay_s - whole * sample_time_s
    return whole, remainder if remainder > 1e-9 * sample_time_s else 0.0


def add_drive_delay(params: ParameterSet, drive_delay_s: float) -> ParameterSet:
    """Return parameters with a drive's delay among their conditions, where they have none yet."""
    if DRIVE_DELAY in _list_given(params) or not drive_delay_s:
        return params
    return params.with_parameters(Parameter(name=DRIVE_DELAY, value=drive_delay_s, unit="s", min=0.0))


def drop_drive_delay(params: ParameterSet) -> ParameterSet:
    """Return parameters without a drive's delay, where samples count it already."""
    stated = _list_given(params)
    if DRIVE_DELAY not in stated:
        return params
    return ParameterSet(parameter for name, parameter in stated.items() if name != DRIVE_DELAY)


def _list_given(params: ParameterSet) -> ParameterSet:
    """Return all that was given, which completed parameters keep beside them."""
    return params.given if isinstance(params, CompletedParameters) else params


def read_conditions(plant: Plant, params: ParameterSet) -> dict[str, float]:
    """Return the conditions among parameters, in SI units. Raises ControlError: one is not finite, or no such unit."""
    params = _list_given(params)
    values: dict[str, float] = {}
    for name, condition in conditions((plant,)).items():
        if name not in params:
            continue
        try:
            values[name] = params[name].value * factor(params[name].unit, condition.unit)
        except UnitError as error:
            raise ControlError(f"{name} = {params[name].value:g} {params[name].unit}: {error}") from error
        if not (np.isfinite(values[name]) and values[name] >= condition.min):
            raise ControlError(f"{name} = {values[name]:g} {condition.unit} is not finite or negative; give another")
    return values


def linearise(
    plant: Plant, p: ValueColumns, at: Mapping[str, PerPlant], measured: Measured, gain: float
) -> LinearPlants:
    """Return (a, b, c, d) from motor force to what is measured of k plants, one column of parameters each. Raises
    ControlError: the plant has no such output, or cannot rest where it is to be linearised. Raises PlantError: the
    plant holds samples.
    """
    refuse_samples(plant)
    plant = take_linear(plant, measured)
    blocks = _evaluate_jacobians(plant, *_solve_rest(_let_slide(plant), p, at), p)
    return _pick(blocks, find_rows(plant, measured), gain)


def _pick(blocks: tuple[Float[np.ndarray, "k _ _"], ...], rows: list[int], gain: float) -> LinearPlants:
    """Return the part of (a, b, c, d) that is from the first input, in units of 1/gain, to some outputs."""
    a, b, c, d = blocks
    return a, b[:, :, 0] * gain, c[:, rows], d[:, rows, 0] * gain


def list_names(measured: Measured) -> tuple[str, ...]:
    """Return what is measured as names, the regulated output first."""
    return (measured,) if isinstance(measured, str) else measured


def find_signals(plant: Plant, measured: Measured) -> tuple[str, ...]:
    """Return the outputs that a law reads for what is measured: of a motor's speed that is no output, its position.
    `plant`: the design plant, whose `sensing` states which position has which speed. `measured`: the regulated output,
    and what else is measured. Raises ControlError: the plant has no such output, and no encoder for it.
    """
    sensing, encoders = plant.sensing, dict[str | None, str]()
    if sensing is not None and sensing.motor_position is not None and sensing.motor_position in plant.outputs:
        encoders = {sensing.motor_speed: sensing.motor_position}
    names = list_names(measured)
    signals = tuple(name if name in plant.outputs else encoders.get(name, name) for name in names)
    find_rows(plant, signals)  # refuses a name that is neither
    return signals


def find_rows(plant: Plant, measured: Measured) -> list[int]:
    """Return which of a plant's outputs are measured, by number. Raises ControlError: the plant has no such output."""
    names = list(plant.outputs)
    for name in list_names(measured):
        if name not in names:
            raise ControlError(
                f'measured = "{name}" is not an output of {plant.name}; {suggestion(name, plant.outputs)}'
            )
    return [names.index(name) for name in list_names(measured)]


def find_rest(plant: Plant, params: CompletedParameters) -> tuple[Float[np.ndarray, " nx"], Float[np.ndarray, " nu"]]:
    """Return states and inputs at rest at the conditions among `params`. Raises ControlError: no rest there."""
    x, u = find_rests(plant, params, {}, 1)
    return x[:, 0], u[:, 0]


def find_rests(
    plant: Plant, params: CompletedParameters, places: Mapping[str, PerPlant], count: int
) -> tuple[Float[np.ndarray, "nx k"], Float[np.ndarray, "nu k"]]:
    """Return what `find_rest` does at `count` places, a column each: of a coordinate by name, before the conditions."""
    fixed_conditions = {name: value for name, value in read_conditions(plant, params).items() if name not in DELAYS}
    at = {name: np.full(count, value) for name, value in fixed_conditions.items()} | dict(places)
    cool = freeze_heat(plant)
    x, u = _solve_rest(_let_slide(cool), np.repeat(params.vector[:, None], count, axis=1), at)
    resting = dict(zip(cool.states, x, strict=True))  # a winding is cold there, though a current flows
    return np.array([resting.get(name, np.zeros(count)) for name in plant.states]), u


def _let_slide(plant: Plant) -> Plant:
    """Return the plant whose rest is that of unbent bristles: at rest they then carry nothing."""
    return friction_states(plant)[SLIDING] if remembers(plant) else plant


def _solve_rest(
    plant: Plant, p: ValueColumns, at: Mapping[str, PerPlant]
) -> tuple[Float[np.ndarray, "nx k"], Float[np.ndarray, "nu k"]]:
    """Return states and inputs at rest, by Newton's method in the first input and the states that are not given."""
    count, names = p.shape[1], list(plant.states)
    x, u = np.zeros((len(names), count)), np.zeros((len(plant.inputs), count))
    fixed = [names.index(name) for name in at if name in names]
    if not fixed or not any(np.any(at[names[i]]) for i in fixed):
        return x, u
    for i in fixed:
        x[i] = at[names[i]]
    loose = [i for i in range(len(names)) if i not in fixed]
    if len(fixed) > 1:
        raise ControlError(f"{', '.join(names[i] for i in fixed)} are both given; a plant rests at one of them")
    slowest = 0
    for _ in range(NEWTON_STEPS):
        (rates,) = _map_columns(plant, dynamics_function, x, u, p)
        a, b, _, _ = _evaluate_jacobians(plant, x, u, p)
        try:
            step = np.linalg.solve(np.concatenate([a[:, :, loose], b[:, :, :1]], axis=2), rates.T[:, :, None])[..., 0].T
        except np.linalg.LinAlgError:
            break
        x[loose] -= step[:-1]
        u[0] -= step[-1]
        size = np.max(np.abs(np.concatenate([x[loose], u[:1]])), axis=0)
        left = np.max(np.abs(step), axis=0) / np.maximum(size, 1e-6)
        if np.all(left <= 1e-12):
            return x, u
        slowest = int(np.argmax(left))
    where = ", ".join(f"{names[i]} = {at[names[i]][slowest]:g}" for i in fixed)
    raise ControlError(f"plant {plant.name} cannot rest at {where}, so it cannot be linearised there; give another")


def differentiate_linearisation(
    plant: Plant,
    p: ValueColumns,
    at: Mapping[str, PerPlant],
    dp: ValueColumns,
    dat: Mapping[str, PerPlant],
    measured: Measured,
    gain: float,
) -> tuple[LinearPlants, LinearPlants]:
    """Return what `linearise` does, and its derivatives along (dp, dat): CasADi's, the rest's own motion included."""
    plant = take_linear(plant, measured)
    sliding = _let_slide(plant)
    rows, names = find_rows(plant, measured), list(plant.states)
    x, u = _solve_rest(sliding, p, at)
    blocks = _evaluate_jacobians(plant, x, u, p)
    dx, du = np.zeros_like(x), np.zeros_like(u)
    fixed = [names.index(name) for name in at if name in names]
    if fixed:  # f(x, u, p) = 0 along the direction: linear in the loose states and the first input
        loose = [i for i in range(len(names)) if i not in fixed]
        for i in fixed:
            dx[i] = dat[names[i]]
        (drift,) = _map_columns(sliding, _drift_function, x, u, p, dp)
        by_x, by_u = (blocks if sliding is plant else _evaluate_jacobians(sliding, x, u, p))[:2]
        moved = drift.T[:, :, None] + by_x[:, :, fixed] @ dx[fixed].T[:, :, None]
        step = np.linalg.solve(np.concatenate([by_x[:, :, loose], by_u[:, :, :1]], axis=2), -moved)[..., 0].T
        dx[loose], du[0] = step[:-1], step[-1]
    derivatives = _stack_blocks(plant, _map_columns(plant, _turn_function, x, u, p, dx, du, dp))
    return _pick(blocks, rows, gain), _pick(derivatives, rows, gain)


def _evaluate_jacobians(
    plant: Plant, x: Float[np.ndarray, "nx k"], u: Float[np.ndarray, "nu k"], p: ValueColumns
) -> tuple[Float[np.ndarray, "k _ _"], ...]:
    """Return A, B, C and D of k plants at rest, where bristles stick."""
    return _stack_blocks(plant, _map_columns(plant, rest_jacobians, x, u, p))


def _stack_blocks(plant: Plant, columns: Sequence[Float[np.ndarray, "_ _"]]) -> tuple[Float[np.ndarray, "k _ _"], ...]:
    """Return matrices as CasADi maps them, side by side, as stacks."""
    nx, nu, ny = len(plant.states), len(plant.inputs), len(plant.outputs)
    shapes = ((nx, nx), (nx, nu), (ny, nx), (ny, nu))
    return tuple(
        block.reshape(rows, -1, width).transpose(1, 0, 2) for block, (rows, width) in zip(columns, shapes, strict=True)
    )


def _map_columns(
    plant: Plant, make: Callable[[Plant], Any], *arguments: Float[np.ndarray, "_ k"]
) -> list[Float[np.ndarray, "_ _"]]:
    """Return a plant's CasADi function at every column, in blocks that CasADi maps over."""
    count = arguments[0].shape[1]
    block = next((size for size in MAPPED if size >= count), MAPPED[-1])
    function = _block_call(plant, make, block, get_ident())
    parts: list[list[Any]] = []
    for start in range(0, count, block):
        columns = [values[:, start : start + block] for values in arguments]
        width = columns[0].shape[1]
        repeated = np.minimum(np.arange(block), width - 1)  # `np.pad` would take longer than the function
        results = function(*(values[:, repeated].ravel(order="F") for values in columns))
        parts.append([values[:, : values.shape[1] // block * width] for values in results])
    return [np.concatenate(pieces, axis=1) for pieces in zip(*parts, strict=True)]


@memo
def _block_call(plant: Plant, make: Callable[[Plant], Any], block: int, _thread: int) -> DirectCall:
    """Return a plant's CasADi function, of dense results, over a block of columns; a thread has one to itself."""
    return DirectCall(make(plant) if block == 1 else make(plant).map(block))


@memo
def _drift_function(plant: Plant) -> Any:
    """Return the CasADi function (x, u, p, dp) -> derivative of f along dp."""
    dp = ca.SX.sym("along", plant.p.shape[0])
    dynamics = ca.substitute(plant.dynamics, plant.t, 0.0)
    return ca.Function("drift", [plant.x, plant.u, plant.p, dp], [ca.densify(ca.jtimes(dynamics, plant.p, dp))])


@memo
def _turn_function(plant: Plant) -> Any:
    """Return the CasADi function (x, u, p, dx, du, dp) -> derivatives of A, B, C and D along (dx, du, dp)."""
    at = [plant.x, plant.u, plant.p]
    along = [ca.SX.sym("along", symbols.shape[0]) for symbols in at]
    blocks = rest_jacobians(plant).call(at)
    slopes = [ca.densify(ca.jtimes(block, ca.vertcat(*at), ca.vertcat(*along))) for block in blocks]
    return ca.Function("turn", [*at, *along], slopes)


def hold(
    a: Matrices,
    b: Vectors,
    c: Inexact[np.ndarray, "k y n"],
    d: Inexact[np.ndarray, "k y"],
    sample_time_s: float,
    delay_s: Inexact[np.ndarray, " k"],
) -> SampledPlants:
    """Return k plants behind a zero-order hold and their delays; earlier commands are states behind the plant's.
    Imaginary parts come through as derivatives do: with 1e-20 of a direction added as one, those of the result are
    1e-20 of its derivative (complex step).
    """
    whole_period, gamma = exponentiate(a, b, np.full(delay_s.size, sample_time_s))
    if not np.any(delay_s):
        return whole_period, gamma, c, d
    whole = np.floor(np.real(delay_s) / sample_time_s + 1e-9).astype(int)
    remainder = delay_s - whole * sample_time_s
    remainder = remainder - np.minimum(np.real(remainder), 0.0)
    newer = exponentiate(a, b, sample_time_s - remainder)[1]
    count, n, chain = a.shape[0], a.shape[1], int(whole.max()) + 1
    rows = np.arange(count)
    drive = np.zeros((count, n, chain + 1), dtype=newer.dtype)  # column i: the command i samples ago
    through = np.zeros((*d.shape, chain + 1), dtype=d.dtype)
    drive[rows, :, whole] = newer
    drive[rows, :, whole + 1] += gamma - newer
    # The output is read before the command changes.
    through[rows, ..., np.where(np.real(remainder) > 0.0, whole + 1, whole)] = d
    big = np.zeros((count, n + chain, n + chain), dtype=drive.dtype)
    late = np.zeros((count, n + chain), dtype=drive.dtype)
    big[:, :n, :n], big[:, :n, n:] = whole_period, drive[:, :, 1:]
    late[:, :n], late[:, n] = drive[:, :, 0], 1.0
    for i in range(1, chain):
        big[:, n + i, n + i - 1] = 1.0
    return big, late, np.concatenate([c, through[..., 1:]], axis=-1), through[..., 0]


@np.errstate(over="ignore", invalid="ignore")  # a plant far off may overflow: the loop is then not stable
def exponentiate(a: Matrices, b: Vectors, t: Inexact[np.ndarray, " k"]) -> tuple[Matrices, Vectors]:
    """Return exp(a t) and the integral of exp(a s) b from 0 to t: Taylor's polynomial, scaled and squared."""
    # scipy.linalg.expm keeps complex steps too, but takes stacks one matrix at a time: 27 times as long at 1375 draws.
    n = a.shape[1]
    block = np.zeros((a.shape[0], n + 1, n + 1), dtype=np.result_type(a, b, t))
    block[:, :n, :n], block[:, :n, n] = a, b
    block *= t[:, None, None]
    norm = np.max(np.sum(np.abs(block), axis=2), axis=1, initial=0.0)
    norm = np.where(np.isfinite(norm), norm, 0.0)
    # Each its own: squared as often as the stiffest of them needs, the others would lose their digits.
    squarings = np.maximum(0, np.ceil(np.log2(np.maximum(norm, 1e-300) / REACH))).astype(int)
    block *= np.ldexp(1.0, -squarings)[:, None, None]
    identity = np.eye(n + 1)
    out = identity + block / DEGREE
    for k in range(DEGREE - 1, 0, -1):
        out = identity + block @ out / k
    for done in range(int(squarings.max(initial=0))):
        live = squarings > done
        out[live] = out[live] @ out[live]
    return out[:, :n, :n], out[:, :n, n]


def _compute_static_gain(a: MatrixNN, b: VectorN, c: Float[np.ndarray, "y n"], d: Float[np.ndarray, " y"]) -> float:
    """Return the first output of a constant unit at rest; infinite where it integrates."""
    with np.errstate(divide="ignore", invalid="ignore"):
        try:
            return float(d[0] - c[0] @ np.linalg.solve(a, b)) if np.linalg.cond(a) < 1e14 else np.inf
        except np.linalg.LinAlgError:
            return np.inf
