"""A tuned controller: the law, what was asked, and what it achieves."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import fields, replace
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from seaopt.codec import to_content
from seaopt.control.laws.command import Command, actuation_notes, limit_notes, name_rates
from seaopt.control.laws.delay import LoopDelays
from seaopt.control.laws.limits import MeasuredLoop, PortFigures
from seaopt.control.laws.plausibility import PlausibilityGate, list_further
from seaopt.control.laws.spec import ControllerSpec
from seaopt.control.laws.stored import (
    CONTROLLER_SCHEMA,
    check_achieved,
    check_friction_margin,
    check_link,
    read_controller,
)
from seaopt.control.laws.structures import LAW_GAINS, DisturbanceObserver, Gains, Prefilter, SpeedLoop
from seaopt.control.laws.verdict import BindingLimit, PossibleBandwidths, list_broken_figures, shorten_blocked
from seaopt.control.loops.absolute_stability import FrictionMargin
from seaopt.control.loops.compensation.link_feedforward import LinkPath, multiply_out
from seaopt.control.loops.compensation.terms import Compensation
from seaopt.control.loops.law import Law, count_filter_samples, find_integral_rate
from seaopt.control.loops.loop import Loop, LoopFigures
from seaopt.control.loops.measured.loop import DiscLoop, MeasuredFigures
from seaopt.control.loops.outer_loop import OuterLoop
from seaopt.control.loops.sampled_plant import DigitalPlant, list_names, sample
from seaopt.control.loops.transfer_function import TransferFunction
from seaopt.estimation import warn_unidentified
from seaopt.formatting import format_percent
from seaopt.frequency import MeasuredResponse
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.plants.friction import falls, find_dry_friction, name_slope_unit, slide_fast, split_friction, take_sliding
from seaopt.plants.motor.heat_guard import HeatGuard
from seaopt.plants.motor.thermal import MotorRating, rate_motor
from seaopt.plants.plant import find_range
from seaopt.plants.sensors.deflection import find_scale
from seaopt.records import PlotAccessor, Result, Worded, record
from seaopt.units import divide_units

if TYPE_CHECKING:
    import control

# Among what controller.json says is achieved:
FRICTION_MARGIN, WITHOUT_PREFILTER = "friction_margin", "bandwidth_without_prefilter_hz"
SLIDING_FAST = "bandwidth_sliding_fast_hz"
SCALE = (5e-3, 5.0)  # by which a reading is off, from and up to: play at rest is no other stiffness
UNFILTERED = 0.1  # of the sample time: a derivative's filter that does next to nothing
ARRIVAL_PERIODS, NOT_ARRIVED = 20.0, 0.05  # of the bandwidth, after which a step is to be nearer than this share
_NOT_ACHIEVED = ("stable", "spectral_radius", "ms_hz")
_UNKNOWN = LoopFigures(stable=False, spectral_radius=np.nan)


class ClosesLoops(LoopDelays):
    """What a law and a plan have in common: the loop around a plant, from what is read to the effort commanded; and
    that neither is scheduled: over nothing, and tuned at no place.
    """

    __slots__ = ()
    over: ClassVar[None] = None
    points: ClassVar[tuple[None]] = (None,)
    law: Any
    per_effort: Any

    @property
    def signals(self) -> tuple[str, ...]:
        """The outputs that are read, the regulated one first."""
        return list_names(self.spec.measured)

    def see(self, plant: Plant) -> Plant:
        """Return a plant with every signal that is read."""
        return plant

    def plant(self, plant: Plant, params: ParameterSet, *, rate: float = 1.0) -> DigitalPlant:
        """Return a plant as this controller sees it: from effort, through its own command per effort. `rate`: at which
        it is stepped, over its own.
        """
        timing, gain = (self.sample_time_s / rate, self.compute_delay_samples), self.per_effort
        return sample(self.see(plant), self.delay(params), self.signals, gain, *timing)

    def close(self, plant: Plant, params: ParameterSet) -> Loop:
        """Return the loop of this controller around a plant, which slides where it has friction; of a plan while no
        limit is active.

        At rest smoothed friction looks like a damper that is gone in motion; `seaopt.plants.friction` has both plants.
        """
        return Loop(plant=self.plant(take_sliding(plant, params), params), law=self.law)


@record(eq=False, repr=False)
class Controller(ClosesLoops, Result, Worded):
    """A law from reference and measured force to an effort, commanded as the input of the plant that makes that effort.

    Parameters
    ----------
    structure : str
        "pd", "pid", "pid_dob", "cascade"; or "custom", of a law that was given (`seaopt.assess`).
    gains : mapping
        For reading; what counts is `law`. Empty of a custom law.
    sample_time_s : float
        Seconds.
    compute_delay_samples : int
        Whole samples from a reading to the command being put out, besides the hold: the user's program.
    drive_delay_s : float
        Seconds from the command to its effect: the drive, on the design plant.
    law : Law
        From (reference, measured) to effort.
    command : Command
        The commanded input for an effort, of the design plant.
    spec : ControllerSpec
        The specification that it was tuned for.
    achieved : LoopFigures
        Of the design plant.
    met : bool
        Whether every limit is met, as measured.
    binding : tuple of BindingLimit
        The limits that are broken; if none is, those that are just met.
    robust_to : tuple of str
        The plants, besides the design plant, that Ms and Mt were kept on.
    design : (Plant, ParameterSet) or None
        The design plant and its parameters.
    observer : DisturbanceObserver or None
        The disturbance observer of a pid_dob, which the law includes.
    blocked_by : tuple of str
        The limits that are broken, each once with its worst figure and its plants, the worst first.
    possible : PossibleBandwidths or None
        Where it is not feasible: the bandwidths that keep the limits; None where none were looked for.
    friction : FrictionMargin or None
        Of the design plant; None where it has no friction.
    measured : tuple of MeasuredFigures
        What the law does on every measured response that it was tuned for. Where the design plant is one, `design` is
        None, and `achieved` is the worst of the responses in its discs.
    outer : OuterLoop or None
        What makes the reference of a stiffness and a damping at the link (`seaopt.control.add_impedance`).
    link : LinkPath or None
        What is fed forward of the link's motion.
    reads : tuple of str
        The outputs that the law reads, one for each of its columns; those of the specification where it is empty.
    compensation : Compensation or None
        What is added to its effort and its reference (`seaopt.control.add_compensation`). The figures and the friction
        margin are those of the law without it; a certificate has those of the loop with it.
    gate : PlausibilityGate or None
        Which readings the exported law believes.
    derate : bool
        The exported law lowers its limit as the winding warms up.
    share : float or None
        Of a schedule, frozen: how its integral winds up there, T_s/(T_t + T_s). An observer sees the limited command
        then (`seaopt.control.scheduling.step_order`).
    designed_on_response : bool
        The design plant is a measured response, and `design` is the plant that was measured.
    measured_on : (Plant, ParameterSet) or None
        Of one without `design`: the model of the plant that was measured, for what no response tells, as its motor's
        heat.
    """

    plot = PlotAccessor()

    structure: str
    gains: Mapping[str, float]
    sample_time_s: float
    compute_delay_samples: int
    drive_delay_s: float
    law: Law
    command: Command
    spec: ControllerSpec
    achieved: LoopFigures
    met: bool
    binding: tuple[BindingLimit, ...]
    robust_to: tuple[str, ...] = ()
    design: tuple[Plant, ParameterSet] | None = None
    observer: DisturbanceObserver | None = None
    blocked_by: tuple[str, ...] = ()
    possible: PossibleBandwidths | None = None
    friction: FrictionMargin | None = None
    measured: tuple[MeasuredFigures, ...] = ()
    outer: OuterLoop | None = None
    link: LinkPath | None = None
    reads: tuple[str, ...] = ()
    compensation: Compensation | None = None
    gate: PlausibilityGate | None = None
    derate: bool = False
    share: float | None = None
    designed_on_response: bool = False
    measured_on: tuple[Plant, ParameterSet] | None = None

    @property
    def signals(self) -> tuple[str, ...]:
        """The outputs that the law reads, the regulated one first; a speed's encoder in its place."""
        return self.reads or list_names(self.spec.measured)

    @property
    def further(self) -> tuple[str, ...]:
        """The outputs that its terms read besides, then those that its gate does."""
        return list_further(self.compensation, self.gate)

    @property
    def renders(self) -> bool:
        """Whether it has an outer loop with a stiffness, so that its reference is a position of the link."""
        return self.outer is not None and self.outer.stiffness > 0.0

    @property
    def speed_loop(self) -> SpeedLoop | None:
        """The signal of a cascade's speed loop; None for another structure."""
        return self.spec.find_speed_loop(self.signals)

    @property
    def design_loop(self) -> MeasuredLoop:
        """The design plant's loop, as limits are judged on it."""
        loop = self.measure("design plant", self.achieved)
        return loop if self.design is None else self._add_friction(loop)

    def measure(self, name: str, figures: LoopFigures, port: PortFigures | None = None) -> MeasuredLoop:
        """Return a design plant's loop, as limits are judged on it.

        Filter and integral are those of the gains where they make the law; of another law they are read off the law.
        """
        gains, ts = self.read_gains(), self.sample_time_s
        filter_samples, integral = count_filter_samples(self.law), find_integral_rate(self.law)
        if gains is not None and gains.makes(self.law, self.spec.structure):
            filter_samples = gains.T_f / ts if gains.k_d else np.inf
            integral = gains.integral_rad_s if self.structure != "pd" and gains.k_i else np.inf
        outputs = {} if self.design is None else self.design[0].outputs
        units = {outputs.get(name, "") for name in self.signals[1:]}  # of what the law reads besides
        unit = units.pop() if len(units) == 1 else ""
        return MeasuredLoop(
            name=name,
            figures=figures,
            port=port,
            filter_samples=filter_samples,
            integral_rad_s=integral,
            gain_unit=self.command.gain_unit,
            other_gain_unit=divide_units(self.command.effort_unit, unit) if unit else "",
        )

    def _add_friction(self, loop: MeasuredLoop) -> MeasuredLoop:
        """Return the design plant's loop with its friction margin and that where it slides fast, if it has friction."""
        assert self.design is not None
        if self.friction is not None:
            unit = name_slope_unit(self.design[0])
            loop = replace(loop, friction_slope=self.friction.least_slope, slope_unit=unit)
        return replace(loop, fast=self.measure_fast(*self.design))

    def measure_fast(self, plant: Plant, params: ParameterSet) -> LoopFigures | None:
        """Return the figures where a plant slides fast; None where no friction falls with the speed before."""
        if not falls(plant, params):
            return None
        return Loop(plant=self.plant(slide_fast(plant), params), law=self.law).figures()

    @property
    def prefilter(self) -> Prefilter | None:
        """The low-pass of the reference, with its numbers; None without one."""
        gains = self.read_gains()
        return None if gains is None else gains.prefilter

    def read_gains(self) -> Gains | None:
        """Return the gains with what else the law is made of; None of a custom law."""
        if not set(LAW_GAINS) <= set(self.gains):
            return None
        return Gains.from_names(self.gains, self.observer, self.speed_loop, self.link)

    @property
    def observer_share(self) -> float | None:
        """The most that its observer takes off abs(S) of the design plant, up to a tenth of the bandwidth; or None."""
        gains, model = self.read_gains(), self.with_model.design
        if gains is None or gains.observer is None or model is None:
            return None
        return gains.weigh_observer(self.close(*model), self.spec.bandwidth_hz)

    @property
    def part_notes(self) -> tuple[str, ...]:
        """What is said of an observer that does next to nothing, and of what feedforward of the link costs."""
        share, effect = self.observer_share, None if self.link is None else self.link.effect
        notes = self.observer.warn(share, self.spec.bandwidth_hz) if self.observer and share is not None else ()
        return notes if effect is None else (*notes, f"link feedforward: {effect.describe()}")

    @property
    def bandwidth_without_prefilter_hz(self) -> float | None:
        """The bandwidth that the same loop has on the design plant where its reference is not filtered.

        None without a prefilter, of a loop that never falls to -3 dB, and of a measured design plant.
        """
        gains = self.read_gains()
        if gains is None or gains.prefilter is None or self.design is None:
            return None
        law = replace(gains, prefilter=None).law(self.spec.structure, self.sample_time_s)
        loop = replace(self.close(*self.design), law=law)
        return loop.figures().bandwidth_hz

    @property
    def bandwidth_sliding_fast_hz(self) -> float | None:
        """The bandwidth on the design plant where it slides fast; that of `achieved` is where friction falls the most.

        None where no friction falls with the speed, of a loop that does not come to -3 dB, and of a measured design
        plant.
        """
        fast = None if self.design is None else self.measure_fast(*self.design)
        return None if fast is None else fast.bandwidth_hz

    @property
    def designs_on_response(self) -> bool:
        """Whether all limits are asked of a measured response."""
        return self.design is None or self.designed_on_response

    @property
    def with_model(self) -> Controller:
        """The same with the model of what was measured as its design plant, where that is a measured response."""
        if self.design is not None or self.measured_on is None:
            return self
        plant, params = self.measured_on
        return replace(self, design=(self.see(plant), params), designed_on_response=True)

    @property
    def judged_on(self) -> str:
        """The plant of `achieved`: the design plant, or the worst in a measured response's discs."""
        return "worst measured" if self.design is None and self.measured else "design plant"

    @property
    def largest_bandwidth_hz(self) -> float | None:
        """The largest bandwidth that is possible where the one asked is not; None where none is known."""
        return None if self.possible is None else self.possible.largest_hz

    @property
    def reference(self) -> TransferFunction:
        """C_r of F_m = C_r F_ref - C_y F_meas: the law multiplied out, for reading."""
        return self.law.transfer_functions()[0]

    @property
    def measurement(self) -> TransferFunction:
        """C_y of F_m = C_r F_ref - C_y F_meas: the law multiplied out, for reading; of the regulated output."""
        return self.law.transfer_functions()[1]

    @property
    def active_constraints(self) -> tuple[str, ...]:
        """The limits that bind, as controller.json has them: NAME, or NAME (PLANT) where it holds for several."""
        return tuple(map(str, self.binding))

    @property
    def explanation(self) -> str:
        """One line: the limits that block, and the bandwidths that are possible; empty where every limit is met."""
        if self.met:
            return ""
        blocked = shorten_blocked(self.blocked_by or self.active_constraints)
        remedy = "" if self.possible is None else f"; {self.possible}"
        return f"{self.spec.bandwidth_hz:g} Hz is blocked by {blocked}{remedy}"

    @property
    def notes(self) -> tuple[str, ...]:
        """Remarks besides the limits, one sentence each."""
        always = (*self.spec.lifted_notes, *map(str, self.measured), *self.part_notes)
        if self.design is None:
            return always
        plant, values = self.design
        notes = [*always, *warn_unidentified(values, None if self.robust_to else plant.parameters)]
        if self.friction is None and self.spec.level("min_friction_margin") is not None:
            notes.append("the design plant has no friction at these values: any min_friction_margin holds on it")
        notes += actuation_notes(plant, self.command)
        notes += self._scale_notes(plant, values)
        notes += limit_notes(self.command, self.spec)
        return (*notes, *self._noise_notes(), *self._rest_notes(), *self._slow_notes())

    def _scale_notes(self, plant: Plant, values: ParameterSet) -> Iterator[str]:
        """Yield by what the regulated reading is off, where firmware computes it with another stiffness."""
        scale = find_scale(plant, plant.complete(values), self.spec.regulated)
        if scale is not None and SCALE[0] < abs(scale - 1.0) and 1.0 / SCALE[1] < scale < SCALE[1]:
            yield (
                f"{self.spec.regulated} reads {scale:.4g} times the spring's {self.command.mechanics.word}, as it is "
                f"computed with another stiffness: {1.0 / scale:.4g} times a reference acts on the link; correct the "
                "firmware's constant, or scale the reference"
            )

    def _noise_notes(self) -> list[str]:
        """Return what is fed forward of the link, and which noise is large because nothing was asked of it."""
        called, notes = self.command.mechanics, list[str]()
        if self.link is not None:
            heard = self.achieved.other_noise_gains
            notes.append(self.link.describe(heard[-1] if heard else None, called))
        T_f = self.gains.get("T_f", np.inf) if self.gains.get("k_d") else np.inf
        if self.spec.level("max_noise_gain") is None and T_f <= UNFILTERED * self.sample_time_s:
            notes.append(
                f"the derivative is hardly filtered (T_f = {T_f:.2g} s), for nothing was asked of it: 1 "
                f"{self.command.reference_unit} of noise on {self.spec.regulated} makes up to "
                f"{self.achieved.noise_gain:.3g} {called.unit} of motor {called.word}; give max_noise_gain"
            )
        return notes

    def _rest_notes(self) -> tuple[str, ...]:
        """Return how far from the reference dry friction may hold a law without an integral."""
        error = self.rest_error
        if not error:
            return ()
        return (
            f"without an integral, friction may hold it {error:.3g} {self.command.reference_unit} from the reference; "
            'structure = "pid" takes that away',
        )

    @property
    def rest_error(self) -> float:
        """How far from the reference dry friction may hold a "pd", in the unit of the reference; 0 with an integral.

        At rest it takes f of the effort, so that y = P(0) (r/P(0) + k_p (r - y) - f).
        """
        if self.structure != "pd" or self.design is None:
            return 0.0
        plant, params = self.design
        friction = sum(find_dry_friction(plant, plant.complete(params)).values())
        static = abs(self.plant(plant, params).static_gain)
        return friction * static / (1.0 + static * self.gains["k_p"])

    def _slow_notes(self) -> tuple[str, ...]:
        """Say that a step is long in arriving, which no limit forbids and friction makes longer."""
        band = self.achieved.bandwidth_hz
        if self.design is None or not self.achieved.stable or not band or not np.isfinite(band):
            return ()
        loop, seconds = self.close(*self.design), ARRIVAL_PERIODS / band
        left = abs(loop.measure_step_left(seconds))
        if not np.isfinite(loop.plant.static_gain) or left < NOT_ARRIVED:
            return ()
        return (
            f"a step of the reference is still {format_percent(left, 2)} off after {seconds:.2g} s, "
            f"{ARRIVAL_PERIODS:.0f} "
            'periods of the bandwidth: the integral is slow, and slower with friction; give objective = "disturbance"',
        )

    @property
    def rating(self) -> MotorRating | None:
        """The thermal rating of the design plant's motor; None without the part "thermal"."""
        model = self.design or self.measured_on
        return None if model is None or model[0].winding is None else rate_motor(*model, self.command_limit)

    @property
    def heat_guard(self) -> HeatGuard | None:
        """The guard that lowers the exported law's limit as the winding warms up; None without a current."""
        rating = self.rating
        return None if rating is None or self.command.unit != "A" else HeatGuard.of_rating(rating, self.sample_time_s)

    @property
    def per_effort(self) -> float:
        """The command for one unit of effort."""
        return self.command.per_effort

    @property
    def command_limit(self) -> float | None:
        """The limit of the command: what is asked for, and no more than the plant's actuation takes; None for none."""
        return self.command.limit(self.spec.limit_asked)

    @property
    def engineering(self) -> dict[str, tuple[float, str]]:
        """The gains as a drive is set, values and units: the command per force error, its integral and its rate."""
        units = name_rates(self.command.unit, self.command.reference_unit, self.command.mechanics)
        scale = self.command.per_effort
        return {name: (scale * value, units[name]) for name, value in self.gains.items() if name in units}

    def see(self, plant: Plant) -> Plant:
        """Return a plant with every signal that the law reads: a link that is held does not move."""
        return plant if self.link is None else self.link.see(plant)

    def to_control(self) -> control.StateSpace:
        """Return the law as python-control's `StateSpace`, from reference and measured to effort, in discrete time."""
        return self.law.to_control()

    def force_limit(self, frequency_hz: float) -> float | None:
        """Return the largest amplitude of F_ref (N) at a frequency that `command_limit` allows on the design plant.

        The motor force per reference is abs(T_r/P), a property of the plant whatever the controller; at rest, 0 Hz,
        it is 1/abs(P). None without a limit.
        """
        if self.command_limit is None or self.design is None:
            return None
        loop = self.close(*self.design)
        if frequency_hz == 0.0:
            return float(self.command_limit / self.command.per_effort * abs(loop.plant.static_gain))
        f = np.array([float(frequency_hz)])
        force = np.abs(loop.law.reference_response(f) * loop.sensitivity(f))[0]
        return float(self.command_limit / self.command.per_effort / force)

    def to_dict(self) -> dict[str, Any]:
        """Return the content of controller.json (schema seaopt/controller/3)."""
        reference, *paths = multiply_out(self.law, self.link)
        friction = {FRICTION_MARGIN: None if self.friction is None else self.friction.least_slope}
        content = {
            "schema": CONTROLLER_SCHEMA,
            "met": self.met,
            "structure": self.structure,
            "gains": self.gains,
            "sample_time_s": self.sample_time_s,
            "compute_delay_samples": self.compute_delay_samples,
            "drive_delay_s": self.drive_delay_s,
            "delay_samples": self.delay_samples,
            "measured": self.signals,
            "blocks": {
                "observer": None if self.observer is None else self.observer.to_dict(self.sample_time_s),
                "link_feedforward": self.link,
                "impedance": self.outer,
            },
            "schedule": None,
            "terms": self.compensation,
            "guards": {"gate": self.gate, "derate": self.derate},
            "law": self.law.to_dict() | ({} if self.share is None else {"share": self.share}),
            "reference": reference,
            "measurement": paths[0] if len(paths) == 1 else paths,
            "command": self.command,
            "spec": self.spec.to_dict() | {"robust_to": self.robust_to},
            "achieved": _list_achieved(self.achieved) | friction | self._prefilter_figures() | self._friction_figures(),
            "feasible": self.met,
            "active_constraints": self.active_constraints,
            "engineering": {name: {"value": value, "unit": unit} for name, (value, unit) in self.engineering.items()},
            "heat": None if self.rating is None else self.rating.to_dict() | {"guard": self.heat_guard},
            "blocked_by": self.blocked_by,
            "largest_bandwidth_hz": self.largest_bandwidth_hz,
            "possible": self.possible,
            "notes": self.notes,
            "measured_responses": self.measured,
        }
        return to_content(content)

    def _prefilter_figures(self) -> dict[str, float | None]:
        """Return what is achieved without the prefilter, where there is one."""
        return {} if self.prefilter is None else {WITHOUT_PREFILTER: self.bandwidth_without_prefilter_hz}

    def _friction_figures(self) -> dict[str, float | None]:
        """Return what is achieved where the design plant slides fast, if friction falls with the speed before."""
        return {SLIDING_FAST: self.bandwidth_sliding_fast_hz} if self.design and falls(*self.design) else {}

    @classmethod
    def read(cls, content: Mapping[str, Any]) -> Controller:
        """Return the controller of a controller.json, without its design plant and what it achieves there."""
        return cls(**read_controller(content), achieved=_UNKNOWN)

    @classmethod
    def from_dict(cls, content: Mapping[str, Any], plant: Plant | MeasuredResponse, params: ParameterSet) -> Controller:
        """Return the controller of a controller.json; what it achieves is computed again on the design plant.

        One that calls itself feasible and breaks a limit there, as it may with other parameters, is not feasible.
        Raises FileError: a field is missing or malformed, or one contradicts the law: gains, reference, measurement,
        achieved.
        """
        controller = cls.read(content)
        spec, command = controller.spec, controller.command
        if isinstance(plant, MeasuredResponse):
            loop = DiscLoop(plant=spec.see_response(plant, command), law=controller.law)
            command = replace(command, largest=find_range(plant.plant, params))
            achieved, model = loop.figures(spec.bandwidth_hz), (plant.plant, params)
            controller = replace(controller, command=command, achieved=achieved, measured_on=model)
        else:
            if controller.link is not None:
                check_link(controller.link, spec, plant)
            plant = controller.see(plant)
            unit = plant.outputs.get(spec.regulated, "")
            unit = "" if unit == command.effort_unit else unit
            command = replace(command, largest=find_range(plant, params), measured_unit=unit)
            design = plant, controller.delay(params)
            controller = replace(controller, command=command, design=design)
            from seaopt.control.laws.friction import find_friction_margin  # deferred: it knows controllers

            figures, friction = controller.close(*design).figures(), find_friction_margin(controller, *design)
            controller = replace(controller, achieved=figures, friction=friction)
        check_achieved(content.get("achieved"), _list_achieved(controller.achieved))
        check_friction_margin(content["achieved"].get(FRICTION_MARGIN), controller.friction)
        check_achieved(content["achieved"], controller._prefilter_figures())
        if SLIDING_FAST in content["achieved"]:  # older files have none
            check_achieved(content["achieved"], controller._friction_figures())
        loops = [controller.design_loop]
        if controller.design is not None:
            states = controller.measure_states()
            if controller.outer is not None:
                from seaopt.control.laws.outer_run import close_outer  # deferred: it knows controllers

                models = split_friction({"": controller.design[0]}, controller.design[1]).values()
                wholes = (close_outer(controller, model, controller.design[1]).figures() for model in models)
                states = {name: states[name].with_margins(whole) for name, whole in zip(states, wholes, strict=True)}
            first, *stuck = (controller.measure(f"design plant{state}", each) for state, each in states.items())
            loops = [controller._add_friction(first), *stuck]
        broken = tuple(list_broken_figures(spec, loops) if controller.met else ())
        controller = replace(controller, met=False, binding=broken) if broken else controller
        return replace(controller, blocked_by=controller.active_constraints) if broken else controller

    def measure_states(self) -> dict[str, LoopFigures]:
        """Return the design plant's figures by its state, " sliding" and " stuck" where it has friction, else ""."""
        assert self.design is not None
        plant, params = self.design
        _, *sticking = split_friction({"": plant}, params).items()
        stuck = {name: Loop(plant=self.plant(model, params), law=self.law).figures() for name, model in sticking}
        return {" sliding" if stuck else "": self.achieved} | stuck


def _list_achieved(figures: LoopFigures) -> dict[str, Any]:
    """Return the figures of the loop that controller.json states."""
    values = {field.name: getattr(figures, field.name) for field in fields(LoopFigures)}
    left_out = _NOT_ACHIEVED if figures.other_noise_gains else (*_NOT_ACHIEVED, "other_noise_gains")
    return {name: value for name, value in values.items() if name not in left_out}
