"""Scenarios of verification: phases with a reference, a blow, another payload, a link held or let go."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import field, replace
from typing import Any

import numpy as np

from seaopt.bench import Chirp, Excitation
from seaopt.control import Controller
from seaopt.control.laws.limits import BY_NAME, STEADY, STEADY_PERIODS
from seaopt.control.laws.outer_run import enclose
from seaopt.control.laws.realisation import RunnableLaw, runnable
from seaopt.control.running.closed_loop import SampledLoop, at_rest, run_loop
from seaopt.control.running.sampled_loop import find_longest_delay
from seaopt.control.scheduling.runnable_schedule import RunnableSchedule
from seaopt.errors import ControlError, suggestion
from seaopt.formatting import format_percent
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.plants.friction import can_hold, can_stick, find_breakaway, find_dry_friction, take_sliding
from seaopt.plants.impacts import strike
from seaopt.records import record
from seaopt.units import LINEAR, ROTARY, Mechanics

DOUBLET, HOLD = "saturating doublet", "saturating hold"
FALL_DEG = 120.0
LIGHTEST_NS, HEAVIEST_NS = 1e-3, 1e4  # range of blows
NOMINAL_EFFORT = {LINEAR: 100.0, ROTARY: 1.0}  # where no limit and no friction sizes the steps
STEP_SHARES = (0.02, 0.1, 0.5)  # of the force that the current limit can hold at rest
LEAST_STEP = 1e-4  # of the force that the current limit can hold at rest: a smaller one is of a run that diverges
WITHIN_LIMIT = "unsaturated step"
UNSATURATED = 0.9  # of the step that just reaches the current limit
FRICTION_STEPS = (0.2, 1.0, 5.0, 25.0)  # times the dry friction, where there is no limit
STUCK_STEPS = (0.1, 0.3, 0.7)  # times the friction that holds a joint at rest
PEAK_GRACE = 1.1  # of the reference peak allowed, for the overshoot of a step
SETTLING_PERIODS = 40.0  # of the bandwidth, until a step is within `SETTLED`
WAITING_PERIODS = 20.0  # of the bandwidth, until friction that sticks lets go of a step of its own size
SETTLED = 0.1  # of a step: how far the force may be off once it has settled
SWINGS = 3.3  # periods of the loop's slowest oscillation that a last phase lasts
LONGEST_S = 20.0
JUDGED_PERIODS = 1.25 * STEADY_PERIODS  # of the bandwidth: after a fifth of settling, eight periods of a tenth of it
LONGEST_SLOW_S = 200.0


@record
class Phase:
    """A part of a scenario; blows, loads and catches at its start are instantaneous.

    Parameters
    ----------
    duration_s : float
        Seconds.
    force_N : float
        Constant part of the reference.
    excitation : tuple of Chirp, Noise, Multisine
        Added to it (amplitudes in N).
    impulse_Ns : float
        A blow on the link at the plant's port, along its motion, at the start.
    scale : mapping of parameter name to float
        Factors on the plant's parameters, from here to the end of the scenario; states go on unchanged, so that a
        payload arrives with the link's speed.
    held : bool
        The link is held where it is: the plant's partner without it takes over.
    """

    duration_s: float
    force_N: float = 0.0
    excitation: Excitation = ()
    impulse_Ns: float = 0.0
    scale: Mapping[str, float] = field(default_factory=dict[str, float])
    held: bool = False

    def __post_init__(self) -> None:
        if not 0.0 < self.duration_s < math.inf:
            raise ControlError(f"phase: duration_s = {self.duration_s:g} is not a duration; give a positive number")
        if self.held and self.impulse_Ns:
            raise ControlError("phase: a link that is held cannot be struck; strike it in a phase with held = False")
        for name, factor in self.scale.items():
            if not factor > 0.0:
                raise ControlError(f"phase: scale of {name} = {factor:g} is not positive; give a positive factor")


@record
class Scenario:
    """A sequence of phases, and its requirements besides those of every scenario.

    Every run must stay finite, and nothing may grow in its last phase.

    Parameters
    ----------
    name : str
    phases : tuple of Phase
    initial_state : mapping of state name to float
        Where every run starts, zero where left out; the drive is then moved so that the spring is relaxed. Without it a
        run starts at rest where its parameters say (phi), zero if they do not.
    about_rest : bool
        Forces are counted from the one that keeps a run at its start; False: from zero.
    quiet : bool
        No oscillation may sustain itself in the last phase.
    final_error : float or None
        Largest mean error over the last fifth of the last phase, N.
    max_overshoot : float or None
        Largest force over the last phase's reference, a step from rest, unless the current limit alone makes it larger.
    settling_s : float or None
        Time of the last phase, a step from rest, until the force stays within a tenth of its reference.
    max_force_N, max_angle_rad : float or None
        Largest peaks of the measured force and of every angle.
    passes : mapping of output name to float
        Values that an output must cross, which shows that the scenario happened.
    on : {"any", "held", "free"}
        Plants that it applies to: every one, those without a link that moves at a port, or those with one.
    friction : {"smooth", "sticking"}
        How dry friction is simulated: as its smoothed curve, or as one that jumps at rest, so that what sticks stands
        still (`seaopt.simulation.sticking`). Bristles are simulated as they are in either.
    """

    name: str
    phases: tuple[Phase, ...]
    initial_state: Mapping[str, float] = field(default_factory=dict[str, float])
    about_rest: bool = True
    quiet: bool = True
    final_error: float | None = None
    max_overshoot: float | None = None
    settling_s: float | None = None
    max_force_N: float | None = None
    max_angle_rad: float | None = None
    passes: Mapping[str, float] = field(default_factory=dict[str, float])
    on: str = "any"
    friction: str = "smooth"

    def __post_init__(self) -> None:
        if not self.phases:
            raise ControlError(f'scenario "{self.name}" has no phases; give at least one')
        for name, words in (("on", ("any", "held", "free")), ("friction", ("smooth", "sticking"))):
            word = getattr(self, name)
            if word not in words:
                raise ControlError(f'scenario "{self.name}": {name} = "{word}" is not known; {suggestion(word, words)}')

    @property
    def is_of_forces_alone(self) -> bool:
        """Whether it begins at rest and asks for forces: nothing is held, struck or loaded."""
        besides = (phase.held or phase.impulse_Ns or phase.scale for phase in self.phases)
        return not (self.initial_state or any(besides))

    def describe_size(self, called: Mechanics = LINEAR) -> str:
        """Return its magnitudes as text: forces (or torques), blows, loads and initial state.

        Examples
        --------
        >>> Scenario(name="knock", phases=(Phase(duration_s=1.0, force_N=50.0), Phase(duration_s=1.0))).describe_size()
        '50 N'
        """
        forces = [abs(phase.force_N) for phase in self.phases if phase.force_N]
        waves = [wave.amplitude for phase in self.phases for wave in phase.excitation if isinstance(wave, Chirp)]
        blows = [abs(phase.impulse_Ns) for phase in self.phases if phase.impulse_Ns]
        loads = {n: f for phase in reversed(self.phases) for n, f in phase.scale.items()}
        quantities = ((forces + waves, called.unit), (blows, called.impulse))
        parts = [f"{max(sizes):.4g} {unit}" for sizes, unit in quantities if sizes]
        parts += [f"{factor:.3g} {name}" for name, factor in loads.items()]
        parts += [f"{name} = {value:.4g}" for name, value in self.initial_state.items()]
        return ", ".join(parts)

    def obstacle(self, plant: Plant, partner: Plant | None) -> str | None:
        """Return why the scenario cannot be played on a plant, or None."""
        free = plant.moves
        if (self.on == "held" and free) or (self.on == "free" and not free):
            return f"it applies to plants whose link is {self.on}"
        if any(phase.held for phase in self.phases) and partner is None:
            return "there is no plant with the same actuator and its link fixed"
        locked = partner if any(phase.held for phase in self.phases) else None
        if self.friction == "sticking" and not all(can_hold(each) for each in (plant, locked) if each is not None):
            return "the plant has no friction that jumps at rest, or that has bristles"
        for name in (name for phase in self.phases for name in phase.scale):
            if name not in plant.parameters:
                return f"the plant has no parameter {name}"
        if any(phase.impulse_Ns for phase in self.phases) and (_struck(plant) is None or plant.energy is None):
            return "the plant has no link that moves, or no energy that tells what a blow does"
        for name in (*self.initial_state, *self.passes):
            if name not in plant.states and name not in plant.outputs:
                return f"the plant has no {name}"
        return None


def _struck(plant: Plant) -> str | None:
    """Return the output along which the link at the port is struck; None where it does not move."""
    return plant.port.motion if plant.port is not None else None


def default_scenarios(controller: Controller, plant: Plant, sets: Sequence[ParameterSet] = ()) -> tuple[Scenario, ...]:
    """Return the scenarios for a plant, sized by the controller's own limits.

    Forces are multiples of two: that of the step that just reaches the current limit (at its first samples, where the
    law differentiates), and that which the limit can hold at rest. Without `current_limit_A` nothing saturates: the
    scenarios of saturation are left out, and the others are of 100 N (1 N m), or of the steps of `step_scenarios`.

    Parameters
    ----------
    controller : Controller
        A controller that knows its design plant.
    plant : Plant
        The plant to verify it on.
    sets : sequence of ParameterSet
        As in `step_scenarios`.

    Raises
    ------
    ControlError
        The controller does not know its design plant.

    Examples
    --------
    >>> import seaopt as so
    >>> spec = so.ControllerSpec(bandwidth_hz=30, max_sensitivity=1.6, current_limit_A=9.0)
    >>> controller = so.tune(so.plants.high_impedance(), so.plants.thor(), spec)
    >>> [scenario.name for scenario in default_scenarios(controller, so.plants.high_impedance())]
    ['2 % step', '10 % step', '50 % step', 'unsaturated step', 'saturating doublet', 'saturating hold', 'chirp']
    """
    step, holding = find_step_limit(controller), controller.force_limit(0.0)
    band = controller.spec.bandwidth_hz
    small = 0.5 * step if step is not None else NOMINAL_EFFORT[controller.command.mechanics]
    tail, lasting = _size_last_phase(controller, plant), max(0.2, 6.0 / band)
    scenarios = list(step_scenarios(controller, plant, sets))

    def add(name: str, *phases: Phase, **limits: Any) -> None:
        scenarios.append(Scenario(name=name, phases=phases, **limits))

    end = Phase(duration_s=tail)
    if step is not None and holding is not None:
        half = 1.5 / band
        there, back = (Phase(duration_s=half, force_N=force) for force in (4.0 * step, -4.0 * step))
        add(DOUBLET, there, back, end)
        # More than the limit holds, then a quarter: an integrator that has wound up overshoots. The force that the
        # limit can hold does not depend on where the plant rests.
        more, quarter = (
            Phase(duration_s=2 * lasting, force_N=1.2 * holding),
            Phase(duration_s=tail, force_N=0.25 * holding),
        )
        add(HOLD, more, quarter, about_rest=False, final_error=0.005 * holding, on="held")
    limit = controller.force_limit(float(band))
    sweep = Chirp(amplitude=0.5 * limit if limit is not None else small, f0_hz=band / 5, f1_hz=1.5 * band)
    add("chirp", Phase(duration_s=2.0, excitation=(sweep,)), end)
    if _struck(plant) is not None and plant.energy is not None:
        blow = _size_blow(controller, plant, 2.0 * small)
        add("impact", Phase(duration_s=0.1), Phase(duration_s=tail, impulse_Ns=blow), on="free")
    push = Phase(duration_s=lasting, force_N=small)
    if plant.port is not None and plant.port.payload:
        heavy, light = (dict.fromkeys(plant.port.payload, factor) for factor in (1.5, 1 / 1.5))
        add("payload", push, Phase(duration_s=lasting, scale=heavy), Phase(duration_s=tail, scale=light), on="free")
    angle = _lever(plant)
    # Let go above the horizontal: the arm L_a cos(phi) vanishes at 90 degrees and changes sign. One that a stiffness
    # pulls on does not fall.
    if angle is not None and not controller.renders:
        start, horizontal = {angle: math.radians(FALL_DEG)}, {angle: math.pi / 2}
        fall = Phase(duration_s=2.0 * tail)
        add("fall through 90 deg", fall, initial_state=start, passes=horizontal, quiet=False, on="free")
    caught = replace(push, held=True)
    add("contact", caught, push, caught, end, on="free")
    return tuple(scenario for scenario in scenarios if scenario.obstacle(plant, plant) is None)


def step_scenarios(controller: Controller, plant: Plant, sets: Sequence[ParameterSet] = ()) -> tuple[Scenario, ...]:
    """Return the steps by which a plant is judged as its user sees it: small, middling and large.

    With a current limit they are 2, 10 and 50 % of the force that it can hold at rest, and the largest step that does
    not saturate; without one a fifth to 25 times the dry friction of the design plant, or 100 N (1 N m) where it has
    none. Where no link moves the force must keep the specification's reference peak with a grace of 10 %, settle, and
    end at its reference; a moving link gives way, so that there the force goes back to zero and only what every
    scenario requires is required.

    Dry friction that can stick is simulated in both ways: each step comes again with friction that sticks; friction
    with bristles sticks by itself, and each step is there once. Where the law has an integral there are steps of 0.1,
    0.3 and 0.7 times the friction besides, in which it has to grow until friction lets go. The time to settle is then
    longer, by `WAITING_PERIODS` for each time that the friction is the step, and the force may end further off, by 2 %
    of the friction, but by no more than a tenth of the step.

    `sets` are the parameters that are played, nominal first; the design's if left out.
    """
    sizes, played = _size_steps(controller), sets or (_require_design(controller)[1],)
    stuck = max(find_breakaway(plant, plant.complete(each)) for each in played) if can_hold(plant) else 0.0
    tail = _size_last_phase(controller, plant)
    steps = [_step(controller, plant, name, force, tail) for name, force in sizes.items()]
    if stuck:
        if not plant.moves and controller.law.integrators:
            least = LEAST_STEP * (controller.force_limit(0.0) or 0.0)
            small = {f"step of {share:g} times the friction": share * stuck for share in STUCK_STEPS}
            sizes |= {name: force for name, force in small.items() if force > least}
        sticking = (_step(controller, plant, name, force, tail) for name, force in sizes.items())
        steps = [*(steps if can_stick(plant) else []), *(_stick(controller, step, stuck) for step in sticking)]
    return tuple(steps)


def make_sticking(scenario: Scenario) -> Scenario:
    """Return a scenario with friction that sticks, under a name that says so; its limits are the same."""
    return replace(scenario, name=f"{scenario.name}, sticking", friction="sticking")


def _step(controller: Controller, plant: Plant, name: str, force: float, tail: float) -> Scenario:
    spec = controller.spec
    lasting = max(0.2, 6.0 / spec.bandwidth_hz)
    if plant.moves:
        return Scenario(name=name, phases=(Phase(duration_s=lasting, force_N=force), Phase(duration_s=tail)))
    settling_s, peak = SETTLING_PERIODS / spec.bandwidth_hz, spec.allowed(BY_NAME["max_reference_peak"])
    return Scenario(
        name=name,
        phases=(Phase(duration_s=lasting), Phase(duration_s=max(tail, 2.0 * settling_s), force_N=force)),
        final_error=STEADY * force,
        settling_s=settling_s,
        max_overshoot=PEAK_GRACE * peak if peak else None,
    )


def _stick(controller: Controller, step: Scenario, friction: float) -> Scenario:
    """Return a step with friction that sticks."""
    sticking = make_sticking(step)
    if step.settling_s is None:
        return sticking
    force = step.phases[-1].force_N
    settling_s = step.settling_s + WAITING_PERIODS / controller.spec.bandwidth_hz * friction / force
    last = replace(step.phases[-1], duration_s=max(step.phases[-1].duration_s, 1.25 * settling_s))
    return replace(
        sticking,
        phases=(*step.phases[:-1], last),
        settling_s=settling_s,
        final_error=min(SETTLED * force, (step.final_error or 0.0) + 0.02 * friction),
    )


def _size_steps(controller: Controller) -> dict[str, float]:
    """Return the forces (N) of steps by name."""
    limit, holding = find_step_limit(controller), controller.force_limit(0.0)
    if limit is not None and holding is not None:
        shares = {f"{format_percent(share)} step": share * holding for share in STEP_SHARES}
        return shares | {WITHIN_LIMIT: UNSATURATED * limit}
    plant, params = _require_design(controller)
    friction = sum(find_dry_friction(plant, plant.complete(params)).values())
    if not friction:
        return {"step": NOMINAL_EFFORT[controller.command.mechanics]}
    return {f"step of {share:g} times the friction": share * friction for share in FRICTION_STEPS}


def list_left_out(controller: Controller, plant: Plant) -> tuple[str, ...]:
    """Return the names of the default scenarios that are left out because the controller has no current limit."""
    if controller.command_limit is not None:
        return ()
    return (DOUBLET,) if plant.moves else (DOUBLET, HOLD)


def find_step_limit(controller: Controller) -> float | None:
    """Return the step of F_ref (N) that just reaches the current limit on the design plant; None without a limit. It is
    that of the loop in which friction slides; one that is unstable, or runs away, reaches the limit with every step,
    and what the limit holds at rest stands for it.
    """
    limit = controller.command_limit
    plant, params = _require_design(controller)
    if limit is None:
        return None
    sliding = take_sliding(plant, params)
    if not controller.close(sliding, params).is_stable():
        return controller.force_limit(0.0)
    loop = build_loop(
        controller, sliding, [params], runnable(controller, command_limit=math.inf, gate=False, heat=False)
    )
    tried = NOMINAL_EFFORT[controller.command.mechanics]
    run = run_loop(loop, [params], np.full(_count_samples(controller, 0.2), tried))
    step, holding = tried * limit / float(np.max(np.abs(run.current))), controller.force_limit(0.0)
    assert holding is not None
    return (
        step if step > LEAST_STEP * holding else holding
    )  # with play it may run away where the loop at rest is stable


def build_loop(
    controller: Controller,
    plant: Plant,
    params: Sequence[ParameterSet],
    law: RunnableLaw | RunnableSchedule | None = None,
    **devices: Any,
) -> SampledLoop:
    """Return a controller's loop on a nonlinear plant, with ideal devices but for those given, as `SampledLoop` has
    them; `law` runs in place of its own, and a schedule's in that of its laws.
    """
    more: dict[str, Any] = {"longest_delay_s": find_longest_delay(plant, params), **devices}
    return SampledLoop(
        plant=plant,
        law=law or runnable(controller, outer=True),
        measured=controller.signals,
        delay_samples=controller.compute_delay_samples,
        link=None if controller.link is None else controller.link.measured,
        **more,
    )


def _require_design(controller: Controller) -> tuple[Plant, ParameterSet]:
    if controller.design is None:
        raise ControlError(
            "the controller does not know its design plant; tune it, or read it with Controller.from_dict"
        )
    return controller.design


def _count_samples(controller: Controller, duration_s: float) -> int:
    return max(2, round(duration_s / controller.sample_time_s))


def _size_blow(controller: Controller, plant: Plant, force: float) -> float:
    """Return the blow (N s) on the link after which the measured force peaks at about `force`; play is nonlinear."""
    link = _struck(plant)
    assert link is not None
    params = plant.complete(_require_design(controller)[1]).drop_conditions()
    loop = build_loop(controller, plant, [params])

    def measure_peak(blow: float) -> float:
        state = strike(plant, params, np.zeros(len(plant.states)), link, blow)
        run = run_loop(loop, [params], np.zeros(_count_samples(controller, 0.1)), start=at_rest(loop, 1, state))
        return float(run.peaks[controller.spec.regulated][0])

    blow, reached = LIGHTEST_NS, measure_peak(LIGHTEST_NS)
    while reached < force and blow < HEAVIEST_NS:
        blow, before = 2.0 * blow, reached
        reached = measure_peak(blow)
        if reached >= force:
            return blow * 2.0 ** (-math.log(reached / force) / math.log(reached / before))
    return blow


def _lever(plant: Plant) -> str | None:
    """Return the angle of a link that pulls on the actuator by a lever arm, which turns its sign; None without one."""
    port = plant.port
    if port is None or port.motion is None or port.coordinate is None:
        return None
    angle = plant.states[port.coordinate] == "rad" and plant.outputs[port.motion] != "rad"
    return port.coordinate if angle else None


def _size_last_phase(controller: Controller, plant: Plant) -> float:
    """Return the duration of a last phase: long enough for the loop's slowest swing, and for slow limit cycles."""
    _, params = _require_design(controller)
    loop = enclose(controller, plant).close(plant, params)
    poles = np.log(loop.eigenvalues() + 1e-300) / controller.sample_time_s
    swinging = np.abs(poles.imag[np.abs(poles.imag) > np.abs(poles.real)])
    slowest = 2 * np.pi / float(np.min(swinging)) if swinging.size else 0.0
    judged = max(np.clip(SWINGS * slowest, 1.0, LONGEST_S), JUDGED_PERIODS / controller.spec.bandwidth_hz)
    return float(min(judged, LONGEST_SLOW_S))
