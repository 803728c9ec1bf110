"""The certificate as data and JSON: a law, a schedule or predictive control on many plants."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import field, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from seaopt.bench import Sensors
from seaopt.codec import to_content
from seaopt.control import Controller, ForceMPC, LoopFigures, ScheduledController
from seaopt.control.laws.limits import BY_NAME
from seaopt.control.laws.structures import CUSTOM
from seaopt.control.loops.absolute_stability import FrictionMargin
from seaopt.control.loops.compensation.stability import CompensationMargin
from seaopt.control.loops.law import describe_integrators
from seaopt.control.running.fed_back import WEIGHT, split_states
from seaopt.errors import ControlError
from seaopt.estimation import warn_unidentified
from seaopt.files import seal
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.plants.friction import friction_slopes, remembers
from seaopt.progress import Progress, ignore
from seaopt.records import PlotAccessor, Result, Worded, record
from seaopt.robustness.bounds.bracket import Bracket
from seaopt.robustness.bounds.stretch import StretchBound
from seaopt.robustness.certificate.cases import pose
from seaopt.robustness.certificate.compensation import GRAVITY_COMPENSATION, describe_compensation, list_compensation
from seaopt.robustness.certificate.constrained import ConstrainedRuns
from seaopt.robustness.certificate.friction import MarginDraws
from seaopt.robustness.certificate.impedance import CertifiedImpedance
from seaopt.robustness.certificate.requirement import Requirement
from seaopt.robustness.certificate.scheduled import find_common_rate, name_rate_unit, state_assumption, state_proof
from seaopt.robustness.certificate.simulated import (
    NAMED_FAULTS,
    SIMULATION_FAILURES,
    Simulated,
    list_worst_draws,
    require_simulated,
    run_simulations,
    select_simulated,
)
from seaopt.robustness.uncertainty.draws import Plants, Ranges, Source, Varied
from seaopt.robustness.uncertainty.failure_probability import MonteCarlo
from seaopt.robustness.uncertainty.logs import LogVerdict
from seaopt.robustness.uncertainty.plant_margins import PlantMargins
from seaopt.robustness.uncertainty.worst import Worst
from seaopt.robustness.verification.limit_cycles import FoundCycle
from seaopt.robustness.verification.schedule_motion import Motion, describe_motion
from seaopt.robustness.verification.schedule_sweep import Sweep, describe_sweeps
from seaopt.robustness.verification.verification import Verification

ROBUSTNESS_SCHEMA = "seaopt/robustness/3"
UNINFORMATIVE_BOUND = 0.1  # failure probability above which no failure in the draws is noted to say little
NO_NOISE = (
    "simulated without sensor noise, which may dither a joint out of stiction; give certify(sensors=...), or sensors = "
    "{ noise_std = ... } in [robustness]"
)
NO_MODEL = "nothing drawn or simulated: measured points alone, without a model"
_REPORTED = (
    "stable", "bandwidth_hz", "tracking_band_hz", "ms", "mt", "gain_margin_db", "phase_margin_deg", "delay_margin_s",
    "disk_margin", "noise_gain", "spectral_radius",
)  # fmt: skip


@record(eq=False, repr=False)
class Certificate(Result, Worded):
    """The result of `certify`.

    Parameters
    ----------
    requirements : tuple of Requirement
    plants : mapping of name to LoopFigures
        At the nominal parameters. A plant with friction is there twice, as NAME sliding and NAME stuck, here and in
        what follows by plant.
    margins : mapping of name to PlantMargins
        Every margin at the nominal parameters, with the perturbation that exhausts it; empty between the points of a
        schedule.
    worst : mapping of name to Worst
        The worst that the draws, and a search from the worst of them, found: each is a pair (plant, parameters), so
        that `tune(..., robust_to=certificate.worst)` accepts them.
    monte_carlo : MonteCarlo
        Over all plants: a draw fails if it fails on any of them.
    varied : tuple of Varied
        What the draws and the worst cases vary, and how.
    controller : Controller
        What was certified.
    models : mapping of name to Plant
        What it was certified on, at `parameters`: the plants as they are, friction and all.
    simulated : Simulated or None
        The results of `with_simulation`; None where `certify` was told to leave them out.
    steps : Verification, str or None
        The simulated steps that every plant is judged by; the reason where they cannot be simulated, or need not be,
        as there is no model; None between the points of a schedule.
    cycles : mapping of name to tuple of FoundCycle
        Of each model whose friction is not shown to be harmless, or whose play makes some: limit cycles predicted and
        simulated.
    brackets : mapping of name to Bracket
        Proven bounds on the worst case; empty if bounds were not requested.
    friction : mapping of name to FrictionMargin
        Of each model with friction: for how steep a friction stability is shown, between sliding and stuck.
    friction_draws : mapping of name to MarginDraws
        The same over draws, of those models for which it is shown at the nominal parameters, or that have none there.
    compensation : mapping of name to CompensationMargin
        Of each model, where friction is compensated from the speed: for how steep a compensation stability is shown.
    compensation_draws : mapping of name to MarginDraws
        The same over draws, of those models for which it is shown at the nominal parameters.
    impedance : CertifiedImpedance or None
        What the controller's outer loop renders, where it has one.
    logs : tuple of LogVerdict
        What the fit's logs say of the loop; empty without a fit, or where none has what the law reads.
    constrained : ConstrainedRuns or None
        Of predictive control: runs with its limits active; all else is of its linear region.
    place : (str, float) or None
        Of one of a schedule's `places`: the variable and the value at which it stands still.
    schedule : ScheduledController or None
        What was certified, where it is a schedule: `controller` is then that of its first point, and `plants` and
        `worst` are at each plant's worst place.
    places : tuple of Certificate
        Of the law frozen at the schedule's points and between them, ascending.
    stretches : tuple of StretchBound
        What is proved between neighbouring places.
    sweeps : mapping of name to tuple of Sweep
        Of each plant that has the schedule's variable.
    motions : mapping of name to Motion
        Of each plant that moves it.
    remarks : tuple of str
        What is found once, one sentence each: a delay of the fit that the controller does not count on; with friction,
        the bandwidth at amplitudes of use.
    drawn_ms : mapping of name to array, shape (n,)
        Ms of the draws, up to `DRAWS_KEPT` of them, infinite where unstable; empty where it was read from a file.
    """

    plot = PlotAccessor()

    requirements: tuple[Requirement, ...]
    plants: Mapping[str, LoopFigures]
    worst: Mapping[str, Worst]
    monte_carlo: MonteCarlo
    controller: Controller
    models: Plants
    parameters: ParameterSet
    varied: tuple[Varied, ...] = ()
    margins: Mapping[str, PlantMargins] = field(default_factory=dict[str, PlantMargins])
    simulated: Simulated | None = None
    steps: Verification | str | None = None
    cycles: Mapping[str, tuple[FoundCycle, ...]] = field(default_factory=dict[str, tuple[FoundCycle, ...]])
    brackets: Mapping[str, Bracket] = field(default_factory=dict[str, Bracket])
    friction: Mapping[str, FrictionMargin] = field(default_factory=dict[str, FrictionMargin])
    friction_draws: Mapping[str, MarginDraws] = field(default_factory=dict[str, MarginDraws])
    compensation: Mapping[str, CompensationMargin] = field(default_factory=dict[str, CompensationMargin])
    compensation_draws: Mapping[str, MarginDraws] = field(default_factory=dict[str, MarginDraws])
    impedance: CertifiedImpedance | None = None
    logs: tuple[LogVerdict, ...] = ()
    constrained: ConstrainedRuns | None = None
    place: tuple[str, float] | None = None
    schedule: ScheduledController | None = None
    places: tuple[Certificate, ...] = ()
    stretches: tuple[StretchBound, ...] = ()
    sweeps: Mapping[str, tuple[Sweep, ...]] = field(default_factory=dict[str, tuple[Sweep, ...]])
    motions: Mapping[str, Motion] = field(default_factory=dict[str, Motion])
    remarks: tuple[str, ...] = ()
    drawn_ms: Mapping[str, Float[np.ndarray, " n"]] = field(
        default_factory=dict[str, Float[np.ndarray, " n"]], repr=False
    )

    @property
    def met(self) -> bool:
        """Whether every requirement is met."""
        return all(row.met for row in self.requirements)

    @property
    def risk(self) -> float:
        """The probability with which chance makes one of its statements wrong, at most: the sum of their shares of the
        risk. What fitted samples say states none, and is not counted.
        """
        shares = {row.statement: row.risk for row in self.requirements if row.risk is not None}
        return min(sum(shares.values()), 1.0)

    @property
    def unchecked(self) -> dict[str, str]:
        """What applies, requires nothing, and could not be checked, with the reason; of a schedule at one of its places
        at least.
        """
        parts = (each.simulated for each in (self, *self.places))
        return {what: part.left_out[what] for part in parts if part is not None for what in part.unchecked}

    @property
    def fails_by_weight(self) -> bool:
        """Whether what is compensated of a weight fails, which no tuning mends: its loops are without it."""
        broken = {row.name for row in self.requirements if not row.met}
        if GRAVITY_COMPENSATION in broken:
            return True
        drawn = broken & {"monte_carlo_failures", "worst_case"}
        return bool(drawn) and WEIGHT in max(self.worst.values(), key=lambda case: case.severity)[0].outputs

    @property
    def values(self) -> tuple[float, ...]:
        """The values of a schedule's variable at `places`."""
        return tuple(certificate.place[1] for certificate in self.places if certificate.place is not None)

    @property
    def fastest(self) -> float:
        """The largest rate of a schedule's variable at which every plant keeps its judgement in a sweep; or zero."""
        return find_common_rate(self.sweeps)

    @property
    def assumption(self) -> str:
        """The assumption on the motion of a schedule's variable; empty of one law."""
        return "" if self.schedule is None else state_assumption(self.schedule, self.sweeps)

    @property
    def proof(self) -> str:
        """The statement that is proved between a schedule's points, or where none is; empty of one law."""
        return "" if self.schedule is None else state_proof(self.schedule, self.stretches)

    @property
    def linear_models(self) -> dict[str, Plant]:
        """The plants whose loops are measured: one with friction is there sliding and stuck."""
        return split_states(self.controller, self.models, self.parameters, [varied.name for varied in self.varied])

    @property
    def simulated_models(self) -> Plants:
        """The models that are simulated."""
        return select_simulated(self.models, self.place)

    def with_simulation(
        self,
        *,
        sensors: Sensors | None = None,
        command_step: float = 0.0,
        seed: int = 1,
        executor: Executor | None = None,
        progress: Progress = ignore,
    ) -> Certificate:
        """Return the certificate with its controller simulated on the nonlinear plants, at their worst draws too.

        `certify` does this unless it is told not to; here it is done again, with other sensors, say. Each scenario
        that fails is a requirement that is not met. Large signals (on every plant), passivity and coupled stability
        (on the design plant) are not requirements.

        Parameters
        ----------
        sensors : Sensors, optional
            Of the measured output; ideal if left out.
        command_step : float
            What the current is rounded to; 0 for not at all.
        seed : int
            Of noise and random excitations.
        executor : concurrent.futures.Executor, optional
            As in `certify`.
        progress : callable, optional
            Called with what is simulated and the share of it that is done (`seaopt.progress.Progress`).

        Examples
        --------
        >>> import seaopt as so
        >>> stand, thor = so.plants.high_impedance(), so.plants.thor()
        >>> controller = so.tune(stand, thor, so.ControllerSpec(bandwidth_hz=30, current_limit_A=9.0))
        >>> certificate = so.certify(controller, {"stand": stand}, thor, simulations=False)
        >>> coarse = certificate.with_simulation(sensors=so.Sensors(quantisation={"F1": 0.5}))
        >>> coarse.passed, len(coarse.simulated.verification.rows)
        (True, 7)
        """
        if self.schedule is not None or self.constrained is not None:
            whose = "a schedule" if self.schedule is not None else "predictive control"
            raise ControlError(f"{whose} is simulated by certify alone; give certify sensors and command_step")
        if not self.models:
            raise ControlError("nothing can be simulated without a model; design the controller on one")
        simulated = run_simulations(
            self.controller,
            self.simulated_models,
            self.parameters,
            draws=self.list_draws(),
            sensors=sensors,
            command_step=command_step,
            seed=seed,
            steps=self.steps if isinstance(self.steps, Verification) else None,
            executor=executor,
            progress=progress,
        )
        played = (SIMULATION_FAILURES, *NAMED_FAULTS.values())  # which are played again
        kept = (row for row in self.requirements if row.name not in played)
        rows = (replace(row, place=self.place, scope="simulated") for row in require_simulated(simulated))
        return replace(self, simulated=simulated, requirements=(*kept, *rows))

    @property
    def draws(self) -> str:
        """The result of the draws, in one sentence."""
        return str(self.monte_carlo) if self.models else NO_MODEL

    @property
    def runs(self) -> Verification | None:
        """The runs on the nonlinear plants: every scenario after `with_simulation`, else the steps."""
        if self.simulated is not None:
            return self.simulated.verification
        return self.steps if isinstance(self.steps, Verification) else None

    def shows_friction_harmless(self, name: str) -> bool:
        """Tell whether a model has no friction at the nominal parameters, or one that is shown to leave it stable."""
        return name not in self.friction or self.friction[name].shown

    def list_draws(self) -> dict[str, list[ParameterSet]]:
        """Return the worst draws of each plant, of those with friction sliding and stuck, without what is nominal."""
        return list_worst_draws(self.simulated_models, self.parameters, self.varied, self.worst)

    @classmethod
    def from_dict(
        cls,
        content: Mapping[str, Any],
        law: Controller | ScheduledController,
        plants: Plants,
        parameters: Source,
        *,
        ranges: Ranges | None = None,
        others: ParameterSet | None = None,
        plan: ForceMPC | None = None,
    ) -> Certificate:
        """Return the certificate of a robustness.json; linear figures are computed again, nothing is simulated.

        Arguments are those of `certify`; of predictive control, the `plan`, `law` is `linear_controller` of it. Raises
        FileError: a field is missing or malformed, it was edited or written by hand, nothing is required in it, or it
        is of predictive control and there is no plan.
        """
        from seaopt.robustness.certificate import stored  # deferred: it reads these

        posed = pose(law, plants, parameters, ranges or {}, others or ParameterSet())
        return stored.build_certificate(content, law, posed, plan)

    def to_dict(self) -> dict[str, Any]:
        """Return the content of robustness.json (schema seaopt/robustness/3), with its digest."""
        if self.schedule is None:
            return seal({"schema": ROBUSTNESS_SCHEMA} | self.list_content() | {"schedule": None})
        over = self.schedule.over
        written = [
            {"place": {over: value}} | certificate.list_content()
            for value, certificate in zip(self.values, self.places, strict=True)
        ]
        return seal(
            {
                "schema": ROBUSTNESS_SCHEMA,
                "met": self.met,
                "passed": self.met,
                "risk": self.risk,
                "requirements": to_content(self.requirements),
                "plants": _take_worst(written, "plants", lambda plant: plant["worst"]["severity"]),
                "friction": _take_worst(written, "friction", _rank_friction),
                "monte_carlo": to_content(self.monte_carlo),
                "passivity": None,
                "simulation": None,
                "unchecked": self.unchecked,
                "remarks": list(self.remarks),
                "notes": list(self.notes),
                "schedule": {
                    "over": over,
                    "unit": self.schedule.unit,
                    "places": written,
                    "stretches": to_content(self.stretches),
                    "sweeps": to_content(self.sweeps),
                    "motions": to_content(self.motions),
                    "fastest_rate": self.fastest,
                    "rate_unit": name_rate_unit(self.schedule),
                    "proof": self.proof,
                    "assumption": self.assumption,
                },
            }
        )

    def list_content(self) -> dict[str, Any]:
        """Return what a file has of the certificate of one law."""
        return {
            "met": self.met,
            "passed": self.met,
            "risk": self.risk,
            "requirements": to_content(self.requirements),
            "plants": {
                name: {key: getattr(figures, key) for key in _REPORTED}
                | (self.margins[name].to_dict() if name in self.margins else {})
                | {"worst": self._worst_dict(name)}
                for name, figures in self.plants.items()
            },
            "friction": {name: self._friction_dict(name) for name in self._frictions},
            "compensation": list_compensation(self.compensation, self.compensation_draws),
            "monte_carlo": to_content(self.monte_carlo),
            "varied": to_content(self.varied),
            "unchecked": self.unchecked,
            "remarks": list(self.remarks),
            "notes": list(self.notes),
            "impedance": None if self.impedance is None else self.impedance.to_dict(),
            "logs": to_content(self.logs),
            "constrained": None if self.constrained is None else self.constrained.to_dict(),
            "passivity": None if self.simulated is None else self.simulated.passivity_dict(),
            "steps": self.steps.to_dict() if isinstance(self.steps, Verification) else {"left_out": self.steps},
            "simulation": None if self.simulated is None else self.simulated.simulation_dict(),
        }

    @property
    def notes(self) -> tuple[str, ...]:
        """Remarks besides the requirements, one sentence each; of a schedule those of its places, else of its points,
        among them.
        """
        if self.schedule is not None:
            return (*self.remarks, *self._list_schedule_notes(self.schedule))
        return (*(() if self.constrained is None else self.constrained.notes), *self._list_notes())

    def _list_schedule_notes(self, schedule: ScheduledController) -> Iterator[str]:
        unit, over = name_rate_unit(schedule), schedule.over
        yield from (self.proof, self.assumption)
        yield from (f"{name}: {describe_sweeps(sweeps, unit)}" for name, sweeps in self.sweeps.items())
        yield from (f"{name}: {describe_motion(motion, over, unit)}" for name, motion in self.motions.items())
        notes_at = dict(zip(self.values, (certificate.notes for certificate in self.places), strict=True))
        shared = [note for note in next(iter(notes_at.values())) if all(note in notes for notes in notes_at.values())]
        yield from shared
        for value in schedule.points:
            yield from (f"{over} = {value:g}: {note}" for note in notes_at[value] if note not in shared)

    def _list_notes(self) -> Iterator[str]:
        if self.controller.structure == CUSTOM and self.constrained is None:
            yield f"a law of one's own with {describe_integrators(self.controller.law)}"
        yield from self.controller.part_notes
        yield from self.remarks
        yield from warn_unidentified(
            self.parameters, {name for plant in self.models.values() for name in plant.parameters}
        )
        yield from (f"{name}: {self._describe_friction(name)}" for name in self._frictions)
        yield from describe_compensation(self.controller, self.compensation, self.compensation_draws)
        if self._sticks_without_noise:
            yield NO_NOISE
        for varied in self.varied:
            if varied.outside:
                yield (
                    f"the nominal {varied.name} = {varied.value:.4g} lies outside its range of {varied.low:.4g} to "
                    f"{varied.high:.4g}, so that no draw is like the nominal plant"
                )
        draws = self.monte_carlo
        if (
            self.place is None
            and draws.samples
            and not draws.failures
            and draws.failure_probability_bound > UNINFORMATIVE_BOUND
        ):
            yield f"so few draws say little: a failure probability below {draws.failure_probability_bound:.2g}"
        yield from self.controller.spec.lifted_notes
        if self.models and not self.controller.spec.allowed(BY_NAME["max_reference_peak"]):
            yield "the overshoot of steps is not judged: no max_reference_peak is asked for"

    @property
    def _sticks_without_noise(self) -> bool:
        """Whether friction that sticks was simulated with a sensor without noise."""
        runs = self.runs
        if runs is None or any(any(rig.sensors.noise_std.values()) for rig in runs.rigs.values()):
            return False
        return any(each.friction == "sticking" for chosen in runs.scenarios.values() for each in chosen)

    def _worst_dict(self, name: str) -> dict[str, Any]:
        """Return the worst case, the largest Ms and Mt with their parameters, and bounds where there are any."""
        worst = self.worst[name]
        largest = {
            figure: {"value": getattr(at, figure), "parameters": at.parameters}
            for figure, at in zip(("ms", "mt"), worst.largest, strict=True)
        }
        bounds = to_content(self.brackets[name]) if name in self.brackets else {}
        return to_content(worst.witness) | {"largest": largest} | bounds

    @property
    def _frictions(self) -> tuple[str, ...]:
        """The plants with friction, at the nominal parameters or at draws, and those with limit cycles."""
        return tuple(dict.fromkeys((*self.friction, *self.friction_draws, *self.cycles)))

    def _describe_friction(self, name: str) -> str:
        """Return what is said of a plant's friction: its margin, draws and limit cycles."""
        drawn = self.friction_draws.get(name)
        margin = "play" if drawn is None else "friction: none at the nominal parameters"
        parts = (self.friction.get(name, margin), drawn, *self._describe_cycles(name))
        return "; ".join(str(part) for part in parts if part is not None)

    def _friction_dict(self, name: str) -> dict[str, Any]:
        """Return what friction and play do to a plant; a plant with play alone has no sector."""
        margin, cycles = self.friction.get(name), self.cycles.get(name, ())
        stable = True if margin is not None and margin.shown and not cycles else None
        entry: dict[str, Any] = {"sector_stable": stable, "limit_cycles": to_content(cycles)}
        if margin is not None:
            entry |= to_content(margin) | {"draws": None}
        if name in self.friction_draws:
            entry["draws"] = to_content(self.friction_draws[name])
        return entry

    def _describe_cycles(self, name: str) -> tuple[FoundCycle | str, ...]:
        if name not in self.cycles:
            return ()
        if any(cycle.lasts for cycle in self.cycles[name]):
            return ("it oscillates",)  # a requirement that is not met says how
        if self.cycles[name]:
            return self.cycles[name]
        if not isinstance(self.steps, Verification):
            return ("limit cycles are not looked for, as nothing can be simulated",)
        if remembers(self.models[name]):
            return ("no simulated step ends in a limit cycle, and those of bristles are not predicted",)
        flattest, steepest = friction_slopes(self.models[name], self.parameters)
        if np.count_nonzero(steepest - flattest) > 1:
            return ("no simulated step ends in a limit cycle, and with several frictions none can be predicted",)
        return ("no limit cycle is predicted, and no simulated step ends in one",)


def _take_worst(
    written: Sequence[Mapping[str, Any]], key: str, rank: Callable[[Mapping[str, Any]], Any]
) -> dict[str, Any]:
    """Return what the places have under a key, by plant: at its worst place, and which that is."""
    worst: dict[str, Any] = {}
    for name in dict.fromkeys(name for each in written for name in each[key]):
        at = max((each for each in written if name in each[key]), key=lambda each: rank(each[key][name]))
        worst[name] = {"place": at["place"], **at[key][name]}
    return worst


def _rank_friction(entry: Mapping[str, Any]) -> tuple[bool, float]:
    """Return how bad a place's friction is: first whether it is not shown to be harmless, then the least
    slope that is, at the nominal parameters and at draws.
    """
    drawn = entry.get("draws")
    slopes = [] if drawn is None else [drawn["least_slope"]]
    if "slopes" in entry:  # as `FrictionMargin.least_slope`
        slopes.append(min((slope for slope in entry["slopes"] if slope > 0.0), default=0.0))
    return not entry["sector_stable"], -min(slopes, default=np.inf)
