"""Tune a controller until it is certified, by a cutting-set loop between tuner and certificate.

The tuner keeps its limits on a few plants; the certificate looks for the worst of infinitely many. What it finds goes
back into the few, and so on, until nothing worse is found or the few alone cannot be met together (Mutapcic, Boyd,
Optimization Methods and Software 24(3), 2009, for the convex case, where this ends at the optimum). If the few cannot
be met, neither can all: a bandwidth that the tuner calls out of reach is so, as far as the tuner is right.

Every round certifies with draws of its own, on a controller that has seen none of them. The chance that some round's
certificate is wrong is no more than the sum of the rounds' chances: each is made at 1 - (1 - confidence)/rounds, so
that the one which passes holds at `confidence`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import replace
from functools import partial
from types import NoneType
from typing import Any, Literal

import numpy as np

from seaopt.control import Controller, ControllerSpec, ScheduledController, tune, tune_schedule
from seaopt.control.laws.delay import settle_delays
from seaopt.control.tuning.tuner import name_design
from seaopt.errors import ControlError, require_type
from seaopt.estimation import Fit
from seaopt.formatting import format_count, format_percent, format_table, format_values, html_text
from seaopt.frequency import MeasuredResponse
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.progress import Progress, divide, ignore, prefix
from seaopt.records import Result, record
from seaopt.robustness.certificate.cases import CONFIDENCE, check_numbers
from seaopt.robustness.certificate.certificate import Certificate
from seaopt.robustness.certificate.certify import certify
from seaopt.robustness.certificate.requirement import MIN_FRICTION_MARGIN
from seaopt.robustness.certificate.retuning.relief import Relief, find_relief
from seaopt.robustness.certificate.retuning.reserve import MOST_RESERVE, NEAR, Look, look_at_draws, raise_reserve
from seaopt.robustness.uncertainty.draws import Plants, Ranges, Source
from seaopt.robustness.uncertainty.severity import UNSTABLE
from seaopt.robustness.uncertainty.worst import place_values

MOST_ROUNDS = 6
TUNING, CERTIFYING = 1.0, 2.0  # of the time of a round
SAME_WITNESS = 1e-6  # witnesses that differ by less than this share in every parameter are one
Witnesses = Mapping[str, tuple[Plant, ParameterSet] | MeasuredResponse]


@record(eq=False)
class Round:
    """One round: the controller, the number of plants that it was tuned on, and its certificate.

    Parameters
    ----------
    number : int
        From 1.
    plants : int
        Number of plants on which the tuner kept its limits, the design plant included.
    controller : Controller or ScheduledController
    certificate : Certificate or None
        None if the controller misses its limits on those plants already; of one that fails what takes long is left out.
    added : tuple of str
        Witnesses that the next round keeps its limits on too.
    """

    number: int
    plants: int
    controller: Controller | ScheduledController
    certificate: Certificate | None
    added: tuple[str, ...] = ()


@record(eq=False)
class JointTuning(Result):
    """The result of `tune_certified`.

    Parameters
    ----------
    status : str
        "certified"; "infeasible": the limits cannot be met on the witnesses together; "stuck": the certificate fails
        on plants where the tuner met its limits, or on a requirement that it does not treat; "terms": what the law
        feeds back besides uses so much more of a limit than the law alone that no reserve makes room; "rounds": there
        were too few.
    controller : Controller or ScheduledController
        Of the last round.
    certificate : Certificate or None
        Of that controller, as in its round; None if it is infeasible.
    rounds : tuple of Round
    robust_to : mapping of name to (plant, parameters) or MeasuredResponse
        Every plant besides the design plant on which the last controller had to keep its limits.
    relief : Relief, optional
        Of one law that breaks its limits with what it compensates: what would do.
    """

    status: Literal["certified", "infeasible", "stuck", "terms", "rounds"]
    controller: Controller | ScheduledController
    certificate: Certificate | None
    rounds: tuple[Round, ...]
    robust_to: Witnesses
    relief: Relief | None = None

    @property
    def met(self) -> bool:
        """Whether it is certified."""
        return self.status == "certified"

    @property
    def explanation(self) -> str:
        """One line: why it is not certified, and where its terms are why what would do; empty if it is."""
        return "; ".join(filter(None, (self._refusal, "" if self.relief is None else str(self.relief))))

    @property
    def _refusal(self) -> str:
        if self.status == "certified":
            return ""
        if self.certificate is None:
            law = self.controller
            return law.explanation if isinstance(law, Controller) else law.remedy
        broken = next(row for row in self.certificate.requirements if not row.met)
        if self.status == "rounds":
            more = "" if self.certificate.fails_by_weight else "; give more rounds, or a larger reserve"
            few = "1 round was" if len(self.rounds) == 1 else f"{len(self.rounds)} rounds were"
            return f"{few} too few: {broken}{more}"
        if self.status == "terms":
            more = "what is compensated takes more of a limit than a reserve of"
            remedy = "" if self.relief else "compensate less"
            return f"{more} {format_percent(MOST_RESERVE)} makes room for: {replace(broken, remedy=remedy)}"
        if not _list_over(self.certificate):
            return f"draws keep Ms, Mt and stability, and tuning again for them mends nothing else: {broken}"
        return f"no witness is left that the tuner has not met: {broken}"

    @property
    def summary(self) -> str:
        """Whether it is certified, and in how many rounds."""
        count = format_count(len(self.rounds), "round")
        return f"certified in {count}" if self.status == "certified" else f"NOT certified ({self.status}, {count})"

    def __repr__(self) -> str:
        table = format_table(map(_list_cells, self.rounds), ("round", "plants", "failures", "worst case, of its limit"))
        explanation = [self.explanation] if self.explanation else []
        return "\n  ".join([f"Joint tuning: {self.summary}", *table, *explanation])

    _repr_html_ = html_text


def tune_certified(
    plant: Plant | MeasuredResponse,
    parameters: Source,
    spec: ControllerSpec,
    plants: Plants,
    *,
    ranges: Ranges | None = None,
    robust_to: Witnesses | None = None,
    over: str | None = None,
    points: Sequence[float] = (),
    bandwidths_hz: Sequence[float] | None = None,
    draws: Sequence[Mapping[str, float]] = (),
    others: ParameterSet | None = None,
    measured: Mapping[str, MeasuredResponse] | None = None,
    samples: int = 1375,
    seed: int = 1,
    confidence: float = CONFIDENCE,
    rounds: int = MOST_ROUNDS,
    complete: Callable[[Any], Any] | None = None,
    executor: Executor | None = None,
    progress: Progress = ignore,
) -> JointTuning:
    """Tune, certify, and tune again with the worst cases found, until the certificate passes (`JointTuning`).

    Parameters
    ----------
    plant : Plant or MeasuredResponse
        The design plant; of a response nothing is drawn but on `plants`, which are models.
    parameters : Fit or ParameterSet
        A fit, or values with the prior_std of those that have one.
    spec : ControllerSpec
        Bandwidth and limits.
    plants : mapping of name to Plant
        Plants on which the controller must pass; each is in the first round at the nominal parameters.
    ranges, others, measured, samples
        As in `certify`.
    robust_to : mapping of name to (Plant, ParameterSet) or MeasuredResponse, optional
        More for the first round, such as the ends of the ranges.
    over, points, bandwidths_hz
        Of a schedule, as in `tune_schedule`; one law for all if left out. The worst case of each plant, at whatever
        value of the variable it was found, is kept at all points of the next round.
    draws : sequence of mappings of parameter to value, optional
        As in `tune`, in every round.
    seed : int
        Of the first round; every other has the next one.
    confidence : float
        Of the certificate that passes, over all rounds.
    rounds : int
        Largest number of rounds.
    complete : callable, optional
        Makes what runs of each tuned controller, and what is certified: adds compensation or an outer loop to it.
    executor : concurrent.futures.Executor, optional
        Of the certificates, as in `certify`.
    progress : callable, optional
        Called with what is done and the share of it that is done (`seaopt.progress.Progress`).

    Raises
    ------
    ControlError
        As `tune` and `certify`; or rounds is not 1 or more.

    Examples
    --------
    >>> import seaopt as so
    >>> stand, swing, thor = so.plants.high_impedance(), so.plants.moving_output(), so.plants.thor()
    >>> spec = so.ControllerSpec(bandwidth_hz=30, max_sensitivity=1.6)
    >>> done = tune_certified(stand, thor, spec, {"swing": swing}, ranges={"I_p": (0.15, 0.6)}, samples=100)
    >>> done.status, done.certificate.passed
    ('certified', True)
    """
    require_type(plants, Mapping, "plants", "give a mapping of name to plant", ControlError)
    require_type(others, (ParameterSet, NoneType), "others", "give a ParameterSet", ControlError)
    check_numbers(rounds=rounds, confidence=confidence)
    spec, settled = settle_delays(spec, name_design(plant), parameters)
    fitted = settled.parameters if isinstance(settled, Fit) else settled
    values = (others or ParameterSet()).with_parameters(*fitted.values())
    witnesses = {name: (other, values) for name, other in plants.items() if other is not plant} | dict(robust_to or {})
    share, stated = 1.0 - (1.0 - confidence) / rounds, spec
    outer = None if complete is None else lambda law: complete(law).outer

    def tune_at(bandwidth_hz: float) -> Controller:
        law = tune(plant, values, replace(stated, bandwidth_hz=bandwidth_hz), robust_to, draws=draws, outer=outer)
        return (law if complete is None else complete(law)).with_model

    drawn = {"parameters": parameters, "ranges": ranges or {}, "supplement": others or ParameterSet()}
    look = partial(look_at_draws, plants=plants, **drawn)
    finished: list[Round] = []
    strained: Controller | None = None  # the first law that what it feeds back besides takes beyond a limit at draws
    for number, part in enumerate(divide(progress, *(1.0 for _ in range(rounds))), start=1):
        tuning, certifying = divide(prefix(part, f"round {number}"), TUNING, CERTIFYING)
        options: dict[str, Any] = {"robust_to": witnesses, "draws": draws, "outer": outer, "progress": tuning}
        controller: Controller | ScheduledController
        if over is None or isinstance(plant, MeasuredResponse):
            controller = tune(plant, values, spec, **options)
        else:
            controller = tune_schedule(plant, values, spec, over, points, bandwidths_hz=bandwidths_hz, **options)
        controller = controller if complete is None else complete(controller)
        certificate, certified = None, controller.with_model if isinstance(controller, Controller) else controller
        if controller.met:
            certificate = certify(
                certified,
                plants,
                parameters,
                ranges=ranges,
                others=others,
                measured=measured,
                samples=samples,
                seed=seed + number - 1,
                confidence=share,
                simulations=False,
                thorough=False,
                executor=executor,
                progress=certifying,
            )
        pairs = [pair for pair in witnesses.values() if not isinstance(pair, MeasuredResponse)]
        designs = [] if isinstance(plant, MeasuredResponse) else [(plant, values)]
        added = _list_new_witnesses(certificate, [*designs, *pairs], number)
        plants_met = 1 + len(witnesses)
        made: dict[str, Any] = {"controller": controller, "certificate": certificate}
        over_limits = [] if certificate is None or certificate.passed else _list_over(certificate)
        raised = raise_reserve(spec, over_limits)
        if strained is None and isinstance(certified, Controller) and any(each.needed for each in over_limits):
            strained = certified if certificate is not None and certificate.varied else None
        finished.append(Round(number=number, plants=plants_met, added=(*added,), **made))
        if certificate is None:
            status = "infeasible"
        elif certificate.passed:
            status = "certified"
        elif raised is None:
            status = "terms"
        elif not added:
            status = "stuck"
        elif number == rounds:
            status = "rounds"
        else:
            witnesses, spec = witnesses | added, raised
            continue
        relief = None if status == "certified" or strained is None else find_relief(strained, tune_at, look)
        progress(f"{status} after {format_count(number, 'round')}", 1.0)
        return JointTuning(status=status, rounds=tuple(finished), robust_to=witnesses, relief=relief, **made)
    raise AssertionError("the last round has a status")


def _list_over(certificate: Certificate) -> list[Look]:
    """Return the worst cases that break a limit, beside what the law alone uses there."""
    looks = (
        Look.of_law(part.controller, case)
        for part in certificate.places or (certificate,)
        for case in part.worst.values()
    )
    return [each for each in looks if each.is_over]


def _list_new_witnesses(
    certificate: Certificate | None, tuned_on: Sequence[tuple[Plant, ParameterSet]], number: int
) -> dict[str, tuple[Plant, ParameterSet]]:
    """Return the worst case of every plant, by name, and where its Ms and Mt are largest if that is near a limit, as
    what mends one of them brings up the other; none that the tuner knows, and none where draws keep the limits. Of
    friction it is the draw with the least margin, where that is not what is asked.
    """
    if certificate is None or certificate.passed:
        return {}
    cases = [
        (name, worst[0], place_values(worst[0], worst[1], each.parameters), each.parameters)
        for name, worst in (certificate.worst.items() if _list_over(certificate) else ())
        for each in (worst.witness, *worst.largest)
        if each is worst.witness or each.severity > NEAR
    ]
    for each in certificate.places or (certificate,):
        least = each.controller.spec.level(MIN_FRICTION_MARGIN)
        for name, draws in each.friction_draws.items():
            if least is not None and draws.least_slope < least:
                plant = each.models[name]
                values = place_values(plant, each.parameters, draws.parameters)
                cases.append((f"{name}'s friction", plant, values, draws.parameters))
    return {
        f"{name}, round {number}: {format_values(drawn, missing='nominal')}": (plant, values)
        for name, plant, values, drawn in cases
        if not any(plant is other and _agree(values, at, drawn) for other, at in tuned_on)
    }


def _agree(values: ParameterSet, other_values: ParameterSet, names: Iterable[str]) -> bool:
    """Tell whether two sets have the same values of some parameters."""
    return all(
        name in other_values and np.isclose(values[name].value, other_values[name].value, rtol=SAME_WITNESS, atol=0.0)
        for name in names
    )


def _list_cells(entry: Round) -> tuple[str, str, str, str]:
    """Return a row of the table of rounds."""
    if entry.certificate is None:
        return str(entry.number), str(entry.plants), "–", "limits not met on these plants"
    name, worst = max(entry.certificate.worst.items(), key=lambda pair: pair[1].severity)
    size = "unstable" if worst.severity >= UNSTABLE else f"{worst.severity:.4f}"
    failures, values = str(entry.certificate.monte_carlo.failures), format_values(worst.parameters, missing="nominal")
    return str(entry.number), str(entry.plants), failures, f"{size} on {name} at {values}"
