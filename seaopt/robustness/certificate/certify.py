"""Certify a law, a schedule or predictive control on every plant: nominal, over draws, at the worst case, simulated.

The draws are independent of whatever was used in tuning, so that the statement on the probability of failure holds:
with no failure in N draws, it is below epsilon at a confidence of 1 - delta where N >= ln(1/delta)/ln(1/(1 - epsilon)),
and with failures the bound is Clopper's and Pearson's. Draws are made and measured in blocks; only the worst are kept.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import replace
from functools import partial
from types import NoneType
from typing import Any

import numpy as np

from seaopt.bench import Sensors
from seaopt.control import Controller, ForceMPC, ScheduledController
from seaopt.errors import ControlError, require_type
from seaopt.estimation import Fit
from seaopt.executors import Shared, check_executor
from seaopt.formatting import format_count
from seaopt.frequency import MeasuredResponse
from seaopt.options import check_options
from seaopt.parameters import ParameterSet
from seaopt.plants.plant import require_plant
from seaopt.progress import Progress, divide, ignore, prefix
from seaopt.robustness.bounds.bracket import Budget
from seaopt.robustness.certificate.cases import (
    CONFIDENCE,
    ENDED,
    Cases,
    CertifyOptions,
    Check,
    CheckContext,
    Subject,
    ask,
    count_seconds,
    digest_laws,
    pose,
)
from seaopt.robustness.certificate.certificate import NO_MODEL, Certificate
from seaopt.robustness.certificate.compensation import COMPENSATION
from seaopt.robustness.certificate.constrained import CONSTRAINED
from seaopt.robustness.certificate.friction import FRICTION
from seaopt.robustness.certificate.impedance import IMPEDANCE
from seaopt.robustness.certificate.limits import LOGS, MEASURED, NOMINAL
from seaopt.robustness.certificate.linear_region import linear_controller
from seaopt.robustness.certificate.measured_draws import DRAWS
from seaopt.robustness.certificate.scheduled import JOINT_DRAWS, STRETCHES, SWEEPS
from seaopt.robustness.certificate.simulated import SIMULATIONS, STEPS
from seaopt.robustness.uncertainty.draws import Plants, Ranges, Source
from seaopt.robustness.verification.verification import check_sensors

CHECKS = (NOMINAL, DRAWS, FRICTION, IMPEDANCE, COMPENSATION, MEASURED, STEPS, SIMULATIONS, CONSTRAINED, LOGS)
SCHEDULE_CHECKS = (STRETCHES, JOINT_DRAWS, SWEEPS)  # of a schedule as a whole, after those at each of its values
CERTIFICATE_STREAM = 0x5EA  # the certificate's own stream of random numbers, whatever the seed


def certify(
    subject: Subject,
    plants: Plants,
    parameters: Source,
    *,
    ranges: Ranges | None = None,
    others: ParameterSet | None = None,
    samples: int = 1375,
    seed: int = 1,
    confidence: float = CONFIDENCE,
    max_failure_probability: float | None = None,
    min_friction_margin: float | None = None,
    min_rate: float | None = None,
    runs: int = 100,
    bound_tolerance: float = 0.1,
    bounds: Budget | None = None,
    simulations: bool = True,
    large_signals: bool = True,
    thorough: bool = True,
    sensors: Sensors | None = None,
    command_step: float = 0.0,
    measured: Mapping[str, MeasuredResponse] | None = None,
    executor: Executor | None = None,
    progress: Progress = ignore,
) -> Certificate:
    """Check a law against plants: at the nominal parameters, over draws, and simulated on the nonlinear plants.

    Everything is computed from the law's transfer functions; every loop is closed with the current that the law
    commands, so that its own eta, K_tau and lead change the loop gain. A schedule is certified so with its variable
    standing still, at its points and between them, and in sweeps; predictive control in its linear region, and with its
    limits active by simulated runs.

    Parameters
    ----------
    subject : Controller, ScheduledController or ForceMPC
        The law, the gains over a variable, or predictive control as `force_mpc` made it.
    plants : mapping of name to Plant
        Plants on which it must pass. The design plant is certified too, as "design" where it is not among them. One
        with friction is certified twice: sliding, where its friction is flattest, and stuck, where it is steepest.
        Empty for a controller designed on a measured response, which is certified on `measured` alone.
    parameters : Fit or ParameterSet
        A fit's joint distribution, truncated to the bounds; or values, with the prior_std of those that have one. The
        logs of a fit judge the law too: none may show an Ms over the limit, or a loop that is unstable.
    ranges : mapping of name to (low, high), optional
        Drawn uniformly instead: parameters, but for what a schedule is over; conditions, which are an angle to
        linearise at (phi, rad) and delay_s, seconds besides the controller's; and screw_mode_hz, where the screw's mode
        is, of plants with that part. Where a winding warms up and a voltage or a duty is commanded, T_ambient, which
        makes R warm, also runs up to T_max.
    others : ParameterSet, optional
        Values of parameters that the fit's plants do not have; the plants' defaults where left out.
    samples : int
        Draws; 1375 without a failure bound the failure probability by 1 % at a confidence of 1 - 1e-6. A schedule's are
        spread evenly over the points and the values between them.
    seed : int
        Of the draws. It is combined with the law's coefficients: no draw is one of the tuner's, nor of the certificate
        whose worst cases the law was tuned with.
    confidence : float
        Of the bound (Clopper-Pearson).
    max_failure_probability : float, optional
        Required of that bound, so that too few draws or runs do not pass; if left out, it is stated, not required.
    min_friction_margin : float, optional
        Required of every plant with friction, N s/m (N m s/rad): stability is shown for friction curves of this slope,
        counted from the flattest, at the nominal parameters and at up to 100 draws. The larger of this and the
        specification's counts.
    min_rate : float, optional
        Of a schedule: required of the fastest sweep that keeps its judgement, and reached by a plant that moves the
        variable itself, in the variable's unit per second; if left out, the rates are stated, not required.
    runs, bound_tolerance
        Of predictive control: draws with limits active, each on every plant, and by how much a bounded signal may leave
        its bounds in them, as a share of half their width: a wrong model, and noise, make the estimate of it wrong. 100
        runs without a failure bound the probability of one by 13 % at the confidence of 1 - 1e-6 (4.5 % at 0.99); one
        takes about a third of a second on each plant.
    bounds : Budget, optional
        Also bound the worst case from above, with this much work on each plant; not at all if left out. The bounds
        are not a requirement; a plant that this meets and that is worse than the worst case found replaces it.
    simulations : bool
        Play every scenario on the nonlinear plants, with large signals, passivity and environments, as
        `Certificate.with_simulation` does, of a schedule at its points and in sweeps. False plays steps of several
        sizes alone, which takes a few seconds less; so does predictive control, as exported, beside its runs.
    large_signals : bool
        With the simulations, sweep amplitudes for the curve of bandwidth against them, of which nothing is required.
    thorough : bool
        False leaves out friction margins at draws that are not asked for, and all that takes long (the impedance,
        simulations, the fit's logs) once a requirement is not met: the certificate is met or not either way, and says
        less of it.
    sensors, command_step
        Of the simulations, as in `Certificate.with_simulation`; their noise has the draws' seed.
    measured : mapping of name to MeasuredResponse, optional
        Measured frequency responses on which stability, Ms, Mt and disk margin are required too, of every response in
        the discs; of a schedule with the law where each was taken. Draws and simulations are of the models. Of a
        controller designed on a measured response the first is that one, on which all limits are required; nothing is
        drawn or simulated.
    executor : concurrent.futures.Executor, optional
        Where parts of the work are done (`seaopt.executors`); here, if left out. The result is the same, bit for bit.
    progress : callable, optional
        Called with what is done and the share of it that is done (`seaopt.progress.Progress`).

    Returns
    -------
    Certificate
        A draw fails if a plant is unstable there, or breaks the specification's Ms or Mt.

    Raises
    ------
    ControlError
        There is no plant, a plant lacks the measured output, a range is empty, or the fit does not identify a
        parameter; the variable of a schedule has a range, or is estimated by the fit; or a controller designed on a
        measured response is given models, or no measured response.

    Examples
    --------
    >>> import seaopt as so
    >>> params, swing = so.plants.thor(), so.plants.moving_output()
    >>> spec = so.ControllerSpec(bandwidth_hz=30, max_sensitivity=1.6, reserve=0.05)  # room for what I_p may be
    >>> controller = so.tune(so.plants.high_impedance(), params, spec, robust_to={"swing": swing})
    >>> certificate = so.certify(controller, {"swing": swing}, params, ranges={"I_p": (0.3, 0.5)}, samples=100)
    >>> certificate.passed, certificate.monte_carlo.failures, list(certificate.plants)
    (True, 0, ['design', 'swing'])
    >>> certificate.simulated.passed
    True
    """
    law = _take_law(subject)
    require_type(plants, Mapping, "plants", "give a mapping of name to plant", ControlError)
    if not plants and law.design is not None:
        raise ControlError("certify needs at least one plant; give {name: plant}")
    for name, plant in plants.items():
        require_plant(plant, f"plants: {name}", ControlError)
    options = CertifyOptions(
        samples=samples,
        seed=seed,
        confidence=confidence,
        max_failure_probability=max_failure_probability,
        min_friction_margin=min_friction_margin,
        min_rate=min_rate,
        runs=runs,
        bound_tolerance=bound_tolerance,
        command_step=command_step,
    )
    check_options(options, ControlError)
    if min_rate is not None and not isinstance(subject, ScheduledController):
        raise ControlError(f"min_rate = {min_rate:g} is of a schedule's variable, and this law has none; leave it out")
    require_type(parameters, (Fit, ParameterSet), "parameters", "give a Fit or a ParameterSet", ControlError)
    require_type(others, (ParameterSet, NoneType), "others", "give a ParameterSet", ControlError)
    require_type(bounds, (Budget, NoneType), "bounds", "give a Budget", ControlError)
    for name, value in (("simulations", simulations), ("large_signals", large_signals), ("thorough", thorough)):
        require_type(value, bool, name, "give True or False", ControlError)
    require_type(sensors, (Sensors, NoneType), "sensors", "give Sensors", ControlError)
    require_type(ranges, (Mapping, NoneType), "ranges", "give a mapping of name to (low, high)", ControlError)
    check_executor(executor, ControlError)
    if not simulations and (sensors is not None or command_step):
        raise ControlError("sensors and command_step are of the simulations, which are left out; give simulations=True")
    if law.design is None:
        _check_responses(law, plants, measured or {})
    else:
        check_sensors(sensors, law, {"design": law.design[0], **plants})
    others, certified = others or ParameterSet(), subject if isinstance(subject, ScheduledController) else law
    posed = pose(certified, plants, parameters, ranges or {}, others, bounds)
    make = partial(
        CheckContext,
        subject=subject,
        source=parameters,
        supplement=others,
        options=options,
        simulations=simulations and not isinstance(subject, ForceMPC),
        large_signals=large_signals,
        thorough=thorough,
        sensors=sensors,
        executor=executor,
    )
    contexts = _list_contexts(subject, posed, make, options)
    if isinstance(subject, ScheduledController):
        return _certify_schedule(replace(contexts[-1], place=None, measured=measured or {}, places=contexts), progress)
    certificate = _certify_cases(replace(contexts[0], measured=measured or {}), CHECKS, progress)
    draws = certificate.monte_carlo
    progress(f"{draws.samples} draws, {format_count(draws.failures, 'failure')}", 1.0)
    return certificate


def _take_law(subject: Any) -> Controller:
    """Return the law of a subject: of predictive control in its linear region, of a schedule at its first point."""
    if isinstance(subject, ForceMPC):
        return linear_controller(subject)
    if isinstance(subject, ScheduledController):
        return subject.controllers[0]
    kinds = "give a Controller, a ScheduledController or a ForceMPC"
    require_type(subject, Controller, "subject", kinds, ControlError)
    return subject


def _check_responses(law: Controller, plants: Plants, measured: Mapping[str, MeasuredResponse]) -> None:
    """Refuse models, or no response, of a controller that was designed on a measured response, and responses alone of
    one that feeds back what no response tells.
    """
    terms = law.compensation
    if not plants and (law.link is not None or (terms is not None and terms.gravity is not None)):
        reads = "compensate.gravity" if law.link is None else "link_feedforward"
        raise ControlError(
            f"{reads} reads the motion of a link, of which a measured response says nothing; name the plant whose link "
            "moves in plants of [robustness]"
        )
    if not plants and terms is not None and (terms.ripple is not None or (terms.friction and terms.friction.reads)):
        raise ControlError(
            f"compensate.{'friction' if terms.ripple is None else 'ripple'} feeds the motor's motion back, most "
            "steeply at rest, and a response is measured where friction slides; name a model of the plant in plants "
            "of [robustness]"
        )
    if plants:
        raise ControlError(
            f"the controller was designed on a measured response, and plants names {', '.join(plants)}; to certify it "
            "on models too give its with_model, whose design plant is the model of what was measured"
        )
    if not measured:
        raise ControlError(
            "the controller was designed on a measured response, or does not know its design plant; give the response "
            'it was designed on first: measured={"frf:chirp": response}'
        )


def _list_contexts(
    subject: Subject, posed: Mapping[float | None, Cases], make: Callable[..., CheckContext], options: CertifyOptions
) -> list[CheckContext]:
    """Return what is to be measured of a law, or at each place of a schedule. Points are simulated where the design
    plant holds the variable: a law that is frozen is not what runs on one that moves it.
    """
    if not isinstance(subject, ScheduledController):
        (cases,) = posed.values()
        rng = np.random.default_rng([options.seed, CERTIFICATE_STREAM, digest_laws(cases.controller)])
        return [make(shared=Shared(cases), drawing=rng, rng=rng, steps=bool(cases.models))]
    drawing = np.random.default_rng([options.seed, digest_laws(*subject.controllers)])
    standing = subject.over not in subject.design[0].states
    return [
        make(
            shared=Shared(cases),
            options=replace(options, samples=-(-options.samples // len(posed))),
            drawing=drawing,
            rng=rng,
            place=(subject.over, value),
            point=value in subject.points,
            steps=standing and value in subject.points,
        )
        for (value, cases), rng in zip(posed.items(), drawing.spawn(len(posed)), strict=True)
        if value is not None
    ]


def _certify_schedule(whole: CheckContext, progress: Progress) -> Certificate:
    """Certify a schedule at each of its places, between them, and where responses were measured."""
    contexts, schedule, of_responses = whole.places, whole.schedule, ask((MEASURED,), whole, ignore)
    seconds = [count_seconds(CHECKS, context) for context in contexts]
    *parts, joining = divide(progress, *seconds, count_seconds(SCHEDULE_CHECKS, whole))
    places, broken = list[Certificate](), False
    for context, part in zip(contexts, parts, strict=True):
        assert context.place is not None
        hook = prefix(part, f"{schedule.over} = {context.place[1]:.4g}")
        places.append(_certify_cases(replace(context, broken=broken), CHECKS, hook))
        broken = broken or not places[-1].met or places[-1].monte_carlo.failures > 0
    found = {"places": (*places,)}
    joint = _certify_cases(replace(whole, found=found, broken=broken), SCHEDULE_CHECKS, joining)
    progress(f"{format_count(len(places), 'value')} of {schedule.over}", 1.0)
    of_places = (row for certificate in places for row in certificate.requirements)
    return replace(
        joint,
        controller=schedule.controllers[0],
        schedule=schedule,
        requirements=(*of_places, *of_responses.requirements, *joint.requirements),
        remarks=(*of_responses.remarks, *joint.remarks),
    )


def _certify_cases(context: CheckContext, checks: Sequence[Check], progress: Progress) -> Certificate:
    """Ask each check that applies to the cases of one law, or of a schedule as a whole."""
    cases, evidence = context.cases, ask(checks, context, progress)
    steps = NO_MODEL if not cases.models else ENDED if context.steps and ENDED in evidence.remarks else None
    none: dict[str, Any] = {"plants": {}, "margins": {}, "steps": steps}
    return Certificate(
        requirements=tuple(evidence.requirements),
        controller=cases.controller,
        models=cases.models,
        parameters=cases.unknown.nominal,
        varied=cases.unknown.varied(),
        place=context.place,
        remarks=evidence.remarks,
        **none | dict(evidence.fields),
    )
