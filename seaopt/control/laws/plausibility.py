r"""A gate in front of a running law: readings that cannot be true are bridged, a sensor that stays wrong is a fault.

A reading is plausible if it is a number within its range and no further from the last plausible one than the plant
moves in the time since: with h readings refused in between, `max_step_N` (h + 1), so that a force that really has
moved is believed again as soon as it can have got there. The first reading is judged by its jump from the measurement
that the law was reset with; where none was given, as in predictive control, it is judged by its range alone. Up to
`max_held` readings in a row that are not plausible are replaced by the last that was. One more is a fault: from then on
the law stands still, the command goes to zero at `ramp_per_s`, and stays there until the law is reset, for a sensor
that comes back is not one to trust.

The most that a sampled plant can move between two samples while the effort stays within :math:`\pm F` is

.. math:: F \sum_k |h_{k+1} - h_k| , \qquad h \text{ its response to an effort of one at one sample,}

reached by an effort that has the signs of these terms. A link that the world pushes moves further: `of_controller`
takes a factor for that.

Where the law is given the encoders on either side of the spring, too, a reading y may have to agree with what they say
of it, :math:`\hat y = \sum_i w_i \theta_i`: for :math:`y = \hat y + T \dot{\hat y}` (T the spring's damping over its
stiffness), all read at rest as zero, with Gaussian noise of std :math:`\sigma_y` and :math:`\sigma_i`,

.. math:: |y - \hat y| \le z \sigma + \epsilon + T \dot y_{max} + \rho |\hat y| , \qquad
          \sigma^2 = \sigma_y^2 + \sum_i (1 + \rho)^2 w_i^2 \sigma_i^2 ,

fails in one sample of 1e8 at most, :math:`2 Q(z) = 10^{-8}`, z = 5.73, if the parameters are within z std of their
values: :math:`\rho` is by how much :math:`\hat y` changes there, :math:`\epsilon` the bound of both zeros, and no
believed reading moves faster than `max_step_N` a sample.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from statistics import NormalDist
from typing import Annotated, Any

import casadi as ca
import numpy as np
from jaxtyping import Float

from seaopt.codec import Constraints
from seaopt.control.loops.compensation.terms import Compensation
from seaopt.control.loops.outer_loop import OuterLoop
from seaopt.control.loops.sampled_plant import DigitalPlant
from seaopt.errors import ControlError, require_number
from seaopt.formatting import format_percent, join_words
from seaopt.options import check_options, option
from seaopt.parameters import Parameter, ParameterSet
from seaopt.plants import Plant
from seaopt.records import record

SETTLED = 1e-12  # of the largest term: a response below it is over
MOST_TERMS = 200_000
LARGEST, MOST_HELD = 1e15, 1_000_000  # what float and unsigned long of every target hold, and what follows from it
FALSE_ALARMS = 1e-8  # per sample, of a disagreement: of Gaussian noise, the model within its intervals
SIGMAS = NormalDist().inv_cdf(1.0 - 0.5 * FALSE_ALARMS)
MOST_SHARE = 0.5
PLACES, LINEAR = 12, 1e-9  # random states that tell the weights of encoders; relative error of an effort that is linear


def is_number(value: float) -> bool:
    """Tell whether a running law takes a number: finite, and so small that no later command overflows."""
    return bool(-LARGEST <= value <= LARGEST)


@record
class GateState:
    """The last plausible reading (NaN: none yet), how many in a row were not, and whether that became a fault.

    A measurement that is known before the first reading is one that the first must be near.
    """

    measurement: float = math.nan
    held: int = 0
    fault: bool = False
    disagrees: bool = False  # the last that was refused might have been true but for the encoders

    @property
    def status(self) -> str:
        """Tell "ok", "held" or "fault"."""
        return "fault" if self.fault else "held" if self.held else "ok"


@record(keywords=True)
class GateSpec:
    """The options of a gate: which readings a running law is to believe, and what it does about the others.

    Raises ControlError: a value is out of range.
    """

    range_N: tuple[float, float] = option(
        "Range of the sensor, in units of what is measured; readings outside are not believed."
    )
    max_step_N: float | None = option(
        "Largest change of a reading in a sample; where left out, that of the design plant times margin.",
        default=None,
        above=0.0,
    )
    max_held: int = option(
        "Readings in a row that are bridged; one more is a fault, and the command goes to zero.",
        default=5,
        least=0,
        most=MOST_HELD,
    )
    ramp_s: float = option(
        "Time in which the command goes from its limit to zero at a fault.", default=0.1, unit="s", above=0.0
    )
    margin: float = option(
        "Factor on the design plant's largest step, for what the world does to it.", default=3.0, above=0.0
    )
    agreement: bool = option(
        "Whether a reading must agree with the encoders through the spring; the law is given these, too.", default=False
    )
    zero: float = option(
        "How far the reading may be from what the encoders say at rest: the bounds of both zeros.",
        default=0.0,
        least=0.0,
    )

    def __post_init__(self) -> None:
        check_options(self, ControlError)


@record
class Agreement:
    """What encoders on either side of the spring say of a reading, and how far it may be from that."""

    reads: Annotated[tuple[str, ...], Constraints(min_length=1)]  # the outputs that the encoders are
    weights: tuple[float, ...]  # of each, in the unit of the reading
    limit: float  # of the difference, with nothing deflected
    share: Annotated[float, Constraints(ge=0.0, le=MOST_SHARE)]  # of what the encoders say, besides
    units: tuple[str, ...] = ()  # of the encoders

    def __post_init__(self) -> None:
        if len(self.weights) != len(self.reads):
            raise ControlError("should have a weight of each encoder")
        for name, value in (("limit", self.limit), *(("weights", abs(weight)) for weight in self.weights)):
            if not 1.0 / LARGEST < value < LARGEST:
                raise ControlError(
                    f"agreement: {name} of {value:g} should be between {1.0 / LARGEST:g} and {LARGEST:g}; give the "
                    "sensors their noise, and the spring its stiffness"
                )

    @property
    def numbers(self) -> tuple[float, ...]:
        """All of them, as the compiled loop takes them."""
        return self.limit, self.share, *self.weights

    def holds(self, measurement: float, encoders: Sequence[float]) -> bool:
        """Tell whether a reading is near enough; an encoder that is no number disagrees."""
        if not all(map(is_number, encoders)):
            return False
        through = sum(weight * reading for weight, reading in zip(self.weights, encoders, strict=True))
        return abs(measurement - through) <= self.limit + self.share * abs(through)

    def describe(self, unit: str) -> str:
        """Return how far a reading may be from what."""
        share = format_percent(self.share, 2)
        return f"{self.limit:.4g} {unit} and {share} of what the spring carries by {join_words(self.reads)}"

    @classmethod
    def of_plant(
        cls,
        plant: Plant,
        params: ParameterSet,
        regulated: str,
        noise: Mapping[str, float],
        *,
        rate: float = 0.0,
        zero: float = 0.0,
    ) -> Agreement:
        """Return the check of a plant whose spring is linear; of its parameters the std count, of noise and of the
        model, or that of a prior. `noise`: std of the sensor's noise and of the encoders'. `rate`: how fast the reading
        moves at most, per second, where the spring is damped. `zero`: how far it may be from what the encoders say at
        rest. Raises ControlError: the plant has no force sensor, or no encoders beside it, a noise is missing, the
        spring is not linear, or its stiffness is hardly known.

        >>> import seaopt as so
        >>> known = so.plants.thor().prior(k=3000.0)
        >>> check = Agreement.of_plant(so.plants.high_impedance(), known, "F1", {"F1": 2.0, "q": 1e-6})
        >>> print(f"{check.limit:.1f} N and {100 * check.share:.1f} %")
        12.1 N and 2.6 %
        """
        names = find_encoders(plant, regulated)
        if missing := [name for name in (regulated, *names) if name not in noise]:
            raise ControlError(
                f"agreement: the noise of {join_words(missing)} is not known; it takes a log with {regulated} and "
                f"{join_words(names)}, or their noise_std in [robustness.sensors]"
            )
        for name in (regulated, *names):
            if not 0.0 <= require_number(noise[name], f"agreement: noise of {name}", ControlError) < math.inf:
                raise ControlError(f"agreement: noise of {name} = {noise[name]:g} is no std; give a finite one")
        weights, lag = _weigh(plant, params, regulated, names)
        share, latest = 0.0, abs(lag)
        for parameter in _list_uncertain(plant, params, (regulated, *names)):
            std = parameter.prior_std if parameter.total_std is None else parameter.total_std
            if not (std and math.isfinite(std)):
                raise ControlError(f"agreement: {parameter.name} is not known; fit it, or give it a prior_std")
            parts, late = [0.0], [0.0]
            least = getattr(plant.parameters[parameter.name], "min", -math.inf) + 1e-6 * abs(parameter.value)
            for end in (max(parameter.value - SIGMAS * std, least), parameter.value + SIGMAS * std):
                moved = replace(parameter, value=end, min=-math.inf, max=math.inf)
                varied, lead = _weigh(plant, params.with_parameters(moved), regulated, names)
                part = float(varied @ weights / (weights @ weights)) - 1.0
                if np.max(np.abs(varied - (1.0 + part) * weights)) > 1e-6 * np.max(np.abs(weights)):
                    raise ControlError(
                        f"agreement: {parameter.name} has a std, and changes what one encoder says against the other; "
                        "give its value"
                    )
                parts.append(abs(part))
                late.append(abs(lead - lag))
            share, latest = share + max(parts), latest + max(late)
        if share >= MOST_SHARE:
            raise ControlError(
                f"agreement: the std of the spring is {format_percent(share / SIGMAS, 2)} of it, with which hardly "
                "anything disagrees; fit its stiffness, or give it a smaller prior_std"
            )
        spread = math.hypot(noise[regulated], *((1.0 + share) * weights * [noise[name] for name in names]))
        limit = SIGMAS * spread + zero + latest * rate
        units = tuple(plant.outputs[name] for name in names)
        rounded = tuple(float(f"{weight:.12g}") for weight in weights)  # the same on every machine
        return cls(reads=names, weights=rounded, limit=limit, share=share, units=units)


def find_encoders(plant: Plant, regulated: str) -> tuple[str, ...]:
    """Return the outputs of a plant that are encoders on either side of its spring. Raises ControlError: it has none,
    or the regulated output is made of them.
    """
    sensing = plant.sensing
    named = () if sensing is None else (sensing.motor_position, sensing.link_position)
    names = tuple(name for name in named if name is not None and name in plant.outputs)
    if sensing is None or not names:
        raise ControlError(f"agreement: {plant.name} has no encoder among its outputs beside {regulated}; leave it out")
    if regulated in sensing.from_encoders:
        raise ControlError(
            f"agreement: {regulated} of {plant.name} is computed from the encoders, so that there is no force to "
            "compare them with; leave it out, or measure a force"
        )
    return tuple(dict.fromkeys(names))


def _list_uncertain(plant: Plant, params: ParameterSet, outputs: Sequence[str]) -> list[Parameter]:
    """Return the parameters of some outputs that have a std, of a fit or of a prior."""
    rows = plant.output[[list(plant.outputs).index(name) for name in outputs]]
    names = [name for i, name in enumerate(plant.parameters) if ca.depends_on(rows, plant.p[i])]
    every = [params[name] for name in names if name in params]
    return [each for each in every if each.free or each.prior_std or each.total_std]


def _weigh(
    plant: Plant, params: ParameterSet, regulated: str, names: tuple[str, ...]
) -> tuple[Float[np.ndarray, " e"], float]:
    """Return how much the regulated output moves with each encoder, and by how many seconds it leads them."""
    outputs = list(plant.outputs)
    read = plant.output[[outputs.index(name) for name in names]]
    rates = ca.jtimes(read, plant.x, plant.dynamics)
    both = ca.vertcat(plant.output[outputs.index(regulated)], read, rates)
    look = ca.Function("look", [plant.t, plant.x, plant.u, plant.p], [both])
    p, rng, sizes = plant.complete(params).vector, np.random.default_rng(1), (len(plant.states), len(plant.inputs))
    rows = [look(0.0, *(rng.normal(size=size) for size in sizes), p).full().ravel() for _ in range(PLACES)]
    effort, readings = np.array(rows)[:, 0], np.array(rows)[:, 1:]
    solution = np.linalg.lstsq(readings, effort, rcond=None)[0]
    weights, damping = np.split(solution, 2)
    lag = float(damping @ weights / (weights @ weights)) if np.any(weights) else math.nan
    error = np.max(np.abs(readings @ np.concatenate([weights, lag * weights]) - effort))
    if not error <= LINEAR * np.max(np.abs(effort)):
        raise ControlError(
            f"agreement: {regulated} of {plant.name} is no fixed multiple of {join_words(names)}: the spring is not "
            "linear, something moves between it and a sensor, or a sensor lags; leave it out"
        )
    return weights, lag


@record
class PlausibilityGate:
    """Which readings a running law believes, and what it does about the others.

    Parameters
    ----------
    range_N : (low, high)
        Of the sensor, in units of the measured effort.
    max_step_N : float
        Largest change from one sample to the next.
    max_held : int
        Readings in a row that are bridged.
    ramp_per_s : float
        How fast the command goes to zero at a fault.
    agreement : Agreement, optional
        With which encoders a reading must agree.

    Raises
    ------
    ControlError
        A value is out of range.

    Examples
    --------
    >>> gate = PlausibilityGate(range_N=(-2000, 2000), max_step_N=100, max_held=2, ramp_per_s=50)
    >>> state = GateState(measurement=10.0)
    >>> for reading in (20.0, 1e4, float("nan"), float("nan")):
    ...     used, state = gate.screen(state, reading)
    ...     print(used, state.status)
    20.0 ok
    20.0 held
    20.0 held
    20.0 fault
    """

    range_N: tuple[float, float]
    max_step_N: float
    max_held: int
    ramp_per_s: float
    agreement: Agreement | None = None

    def __post_init__(self) -> None:
        ends: Any = self.range_N
        if not isinstance(ends, tuple | list) or len(ends) != 2:
            raise ControlError(f"range_N = {ends!r} is not a range; give (low, high)")
        low, high = (require_number(end, "range_N", ControlError) for end in ends)
        if not -LARGEST < low < high < LARGEST:
            raise ControlError(f"range_N = ({low:g}, {high:g}) is not a range; give finite low < high")
        for name in ("max_step_N", "ramp_per_s"):
            value = require_number(getattr(self, name), name, ControlError)
            if not 1.0 / LARGEST < value < LARGEST:  # which a target's `float` holds, too
                raise ControlError(
                    f"{name} = {value:g} is not between {1.0 / LARGEST:g} and {LARGEST:g}; give such a number"
                )
        limit: Any = self.max_held
        if isinstance(limit, bool) or not isinstance(limit, int | np.integer) or not 0 <= limit <= MOST_HELD:
            raise ControlError(f"max_held = {limit!r} is not a number of samples; give 0, 1, ... up to {MOST_HELD}")

    def start(self, measurement: float) -> GateState:
        """Return the state in which the first reading must be near a measurement at rest. Raises ControlError: it is
        not within the range itself.
        """
        low, high = self.range_N
        if not low <= measurement <= high:
            raise ControlError(
                f"measurement = {measurement:g} is not within range_N = ({low:g}, {high:g}); give the force at rest"
            )
        return GateState(measurement=measurement)

    @property
    def reads(self) -> tuple[str, ...]:
        """The encoders that it reads."""
        return () if self.agreement is None else self.agreement.reads

    def screen(self, state: GateState, measurement: float, encoders: Sequence[float] = ()) -> tuple[float, GateState]:
        """Return the reading to use, and the next state; NaN where there was none yet. `encoders`: of `reads`."""
        if state.fault:
            return state.measurement, state
        low, high = self.range_N
        moved = abs(measurement - state.measurement) if math.isfinite(state.measurement) else 0.0
        near = low <= measurement <= high and moved <= self.max_step_N * (state.held + 1)
        agrees = self.agreement is None or self.agreement.holds(measurement, encoders)
        if near and agrees:
            return measurement, GateState(measurement=measurement)
        refused = state.held + 1
        return state.measurement, replace(state, held=refused, fault=refused > self.max_held, disagrees=near)

    def ramp(self, command: float, sample_time_s: float) -> float:
        """Return the command a sample later, at a fault."""
        step = self.ramp_per_s * sample_time_s
        return math.copysign(max(abs(command) - step, 0.0), command)

    @classmethod
    def of_controller(
        cls, controller: Any, *, noise: Mapping[str, float] | None = None, **options: Any
    ) -> PlausibilityGate:
        """Return a gate with the step that the design plant makes at most, times a margin for what the world does.

        Parameters
        ----------
        controller : Controller or ForceMPC
            With its design plant and a current limit.
        noise : mapping of str to float, optional
            Std of what is measured and of the encoders, for an agreement.
        **options
            Fields of `GateSpec`: range_N, and where they differ from its defaults max_step_N, max_held, ramp_s, margin,
            agreement, zero.

        Raises
        ------
        ControlError
            The controller has no current limit or no design plant, or the plant does not come to rest by itself; or
            there is no agreement to ask for (`Agreement.of_plant`).

        Examples
        --------
        >>> import seaopt as so
        >>> spec = so.ControllerSpec(bandwidth_hz=30, max_sensitivity=1.6, current_limit_A=9.0)
        >>> controller = so.tune(so.plants.high_impedance(), so.plants.thor(), spec)
        >>> gate = PlausibilityGate.of_controller(controller, range_N=(-4000.0, 4000.0))
        >>> print(f"{gate.max_step_N:.0f} N, {gate.ramp_per_s:.0f} A/s")
        473 N, 90 A/s
        """
        if not hasattr(controller, "command_limit"):
            raise ControlError(f"controller = {controller!r:.80}: give a Controller, or a ForceMPC")
        spec, limit = GateSpec(**options), controller.command_limit
        if limit is None:
            raise ControlError("the controller has no current limit (or command_limit); give its specification one")
        largest = spec.max_step_N
        if largest is None:
            model = controller.design or getattr(controller, "measured_on", None)
            if model is None:
                raise ControlError("the controller has no design plant to compute the largest step of; give max_step_N")
            plant = controller.close(*model).plant
            largest = spec.margin * largest_step(plant, limit / controller.per_effort)
        agreement = None
        if spec.agreement:
            plans = hasattr(controller, "prediction")  # predictive control, whose step compares no signals
            if controller.design is None or plans:
                raise ControlError("agreement: it is of a law that knows its design plant; leave it out")
            plant, values = controller.design
            rate = largest / controller.sample_time_s
            agreement = Agreement.of_plant(plant, values, controller.signals[0], noise or {}, rate=rate, zero=spec.zero)
        return cls(
            range_N=spec.range_N,
            max_step_N=largest,
            max_held=spec.max_held,
            ramp_per_s=limit / spec.ramp_s,
            agreement=agreement,
        )

    def describe(self, unit: str) -> str:
        """Return in one line which readings are believed."""
        (low, high), agreement = self.range_N, self.agreement
        near = "" if agreement is None else f" and are within {agreement.describe(unit)}"
        return (
            f"Readings from {low:g} to {high:g} {unit} that move by up to {self.max_step_N:.4g} {unit} a sample{near} "
            f"are believed, {self.max_held} others in a row are bridged"
        )


def list_further(
    terms: Compensation | None, gate: PlausibilityGate | None, outer: OuterLoop | None = None
) -> tuple[str, ...]:
    """Return the outputs that the terms of a law read besides its signals, then those that gate and outer loop do."""
    read = () if terms is None else terms.reads
    positions = () if outer is None else (outer.position,)
    return tuple(dict.fromkeys((*read, *(() if gate is None else gate.reads), *positions)))


def largest_step(plant: DigitalPlant, effort_limit: float) -> float:
    """Return how far an output moves at most in a sample, the effort limited. Raises ControlError: it never rests."""
    if np.max(np.abs(np.linalg.eigvals(plant.a)), initial=0.0) >= 1.0:
        raise ControlError("the plant does not come to rest by itself, so that no step is the largest; give max_step_N")
    x, row, before = plant.b, plant.c[0], float(plant.d[0])
    total = largest = abs(before)
    for _ in range(MOST_TERMS):
        now = float(row @ x)
        total += abs(now - before)
        largest, before, x = max(largest, abs(now)), now, plant.a @ x
        if np.linalg.norm(row) * np.linalg.norm(x) <= SETTLED * largest:
            break
    return effort_limit * (total + abs(before))
