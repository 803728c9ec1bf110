"""Certify one controller on every plant, at nominal parameters, over draws, and at the worst that can be found.

The draws are independent of whatever was used in tuning, so that the statement on the probability of failure holds:
with no failure in N draws, it is below epsilon at a confidence of 1 - delta where N >= ln(1/delta)/ln(1/(1 - epsilon)),
and with failures the bound is Clopper's and Pearson's. Draws are made and measured in blocks; only the worst are kept.
"""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import Executor
from dataclasses import replace
from hashlib import sha256
from types import NoneType
from typing import Any

import numpy as np

from seaopt.bench import Sensors
from seaopt.control import Controller
from seaopt.control.laws.delay import Drive, find_drive, find_given_drive_delay, split_delayed, warn_delays
from seaopt.control.loops.measured.figures import measure_discs
from seaopt.control.loops.sampled_plant import DELAYS, DRIVE_DELAY
from seaopt.errors import ControlError, require_type
from seaopt.estimation import Fit
from seaopt.executors import Shared, check_executor
from seaopt.formatting import format_count
from seaopt.frequency import MeasuredResponse
from seaopt.options import check_options, option
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.plants.friction import has_friction, name_states, split_friction
from seaopt.plants.motor.thermal import AMBIENT, find_warm_range
from seaopt.plants.plant import require_plant
from seaopt.progress import Progress, divide, ignore
from seaopt.records import record
from seaopt.robustness.bounds.bracket import Budget
from seaopt.robustness.certificate.certificate import DESIGN_NAMES, NO_MODEL, Certificate
from seaopt.robustness.certificate.compensation import (
    find_compensation_at_draws,
    find_gravity_cases,
    find_nominal_compensation,
    find_ripple_cases,
)
from seaopt.robustness.certificate.friction import find_margins_at_draws, find_nominal_margins
from seaopt.robustness.certificate.impedance import IMPEDANCE_DRAWS, certify_impedance, draw_impedance
from seaopt.robustness.certificate.measured_draws import Loops, measure_draws, search_worst
from seaopt.robustness.certificate.requirement import MIN_FRICTION_MARGIN, Spot
from seaopt.robustness.certificate.requirements import (
    compensation_requirements,
    design_requirements,
    draw_requirements,
    eigenvalue_requirements,
    friction_requirements,
    impedance_requirements,
    measured_requirements,
    plant_requirements,
)
from seaopt.robustness.uncertainty.draws import Plants, Ranges, Source, Uncertainty, check_ranges, combine_uncertainty
from seaopt.robustness.uncertainty.failure_probability import count_failures
from seaopt.robustness.uncertainty.plant_margins import plant_margins
from seaopt.robustness.verification.large_signal import SLOWEST_STUCK, predict_bandwidths
from seaopt.robustness.verification.scenarios import STEP_SHARES
from seaopt.robustness.verification.verification import check_sensors

CONFIDENCE = 1.0 - 1e-6
AMPLITUDES = 9  # looked at for the remark on bandwidth
MOST_DELAY_SAMPLES = 20  # samples
# Seconds that a part takes as a rule: of each draw and plant, or of each plant.
DRAW, SEARCH, BOUND, FRICTION, IMPEDANCE, STEPS, SIMULATIONS = 1.5e-4, 0.3, 0.4, 0.3, 0.05, 1.0, 3.5
CERTIFICATE_STREAM = 0x5EA  # the certificate's own stream of random numbers, whatever the seed


@record
class CertifyOptions:
    """The numbers that `certify`, `certify_schedule`, `certify_mpc` and `tune_certified` take, with their ranges."""

    samples: int = option("Draws.", default=1375, least=1)
    seed: int = option("Of the draws and of simulated noise.", default=1, least=0)
    confidence: float = option("Of the failure probability's bound.", default=CONFIDENCE, above=0.0, below=1.0)
    max_failure_probability: float | None = option("Required of that bound.", default=None, above=0.0, most=1.0)
    min_friction_margin: float | None = option("Slope, N s/m (N m s/rad).", default=None, above=0.0)
    min_rate: float | None = option("Of the schedule's variable, in its unit per second.", default=None, above=0.0)
    runs: int = option("Runs with limits active.", default=100, least=1)
    bound_tolerance: float = option("Share of half the width of a signal's bounds.", default=0.1, least=0.0)
    command_step: float = option("What the command is rounded to, in its unit.", default=0.0, least=0.0)
    rounds: int = option("Of tuning and certifying.", default=6, least=1)


def check_numbers(**numbers: Any) -> None:
    """Refuse numbers that are out of the range of `CertifyOptions`."""
    check_options(CertifyOptions(**numbers), ControlError)


def certify(
    controller: Controller,
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
    bounds: Budget | None = None,
    simulations: bool = True,
    sensors: Sensors | None = None,
    command_step: float = 0.0,
    measured: Mapping[str, MeasuredResponse] | None = None,
    executor: Executor | None = None,
    progress: Progress = ignore,
) -> Certificate:
    """Check a controller against plants: at the nominal parameters, over draws, and simulated on the nonlinear plants.

    Everything is computed from the controller's two transfer functions; every loop is closed with the current that
    the controller commands, so that its own eta, K_tau and lead change the loop gain.

    Parameters
    ----------
    controller : Controller
        The law.
    plants : mapping of name to Plant
        Plants on which it must pass. The design plant is certified too, as "design" where it is not among them. One
        with friction is certified twice: sliding, where its friction is flattest, and stuck, where it is steepest.
        Empty for a controller designed on a measured response, which is certified on `measured` alone.
    parameters : Fit or ParameterSet
        A fit's joint distribution, truncated to the bounds; or values, with the prior_std of those that have one.
    ranges : mapping of name to (low, high), optional
        Drawn uniformly instead: parameters; conditions, which are an angle to linearise at (phi, rad) and delay_s,
        seconds besides the controller's; and screw_mode_hz, where the screw's mode is, of plants with that part. Where
        a winding warms up and a voltage or a duty is commanded, T_ambient, which makes R warm, also runs up to T_max.
    others : ParameterSet, optional
        Values of parameters that the fit's plants do not have; the plants' defaults where left out.
    samples : int
        Draws; 1375 without a failure bound the failure probability by 1 % at a confidence of 1 - 1e-6.
    seed : int
        Of the draws. It is combined with the law's coefficients: no draw is one of the tuner's, nor of the certificate
        whose worst cases the law was tuned with.
    confidence : float
        Of the bound (Clopper-Pearson).
    max_failure_probability : float, optional
        Required of that bound, so that too few draws do not pass; if left out, the bound is stated, not required.
    min_friction_margin : float, optional
        Required of every plant with friction, N s/m (N m s/rad): stability is shown for friction curves of this slope,
        counted from the flattest, at the nominal parameters and at up to 100 draws. The larger of this and the
        specification's counts.
    bounds : Budget, optional
        Also bound the worst case from above, with this much work on each plant; not at all if left out. The bounds
        are not a requirement; a plant that this meets and that is worse than the worst case found replaces it.
    simulations : bool
        Play every scenario on the nonlinear plants, with large signals, passivity and environments, as
        `Certificate.with_simulation` does. False plays steps of several sizes alone, which takes a few seconds less.
    sensors, command_step
        Of the simulations, as in `Certificate.with_simulation`; their noise has the draws' seed.
    measured : mapping of name to MeasuredResponse, optional
        Measured frequency responses on which stability, Ms, Mt and disk margin are required too, of every response in
        the discs. Draws and simulations are of the models. Of a controller designed on a measured response the first
        is that one, on which all limits are required; nothing is drawn or simulated.
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
        parameter; or a controller designed on a measured response is given models, or no measured response.

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
    require_type(controller, Controller, "controller", "give a Controller; a ForceMPC to certify_mpc", ControlError)
    require_type(plants, Mapping, "plants", "give a mapping of name to plant", ControlError)
    if not plants and controller.design is not None:
        raise ControlError("certify needs at least one plant; give {name: plant}")
    for name, plant in plants.items():
        require_plant(plant, f"plants: {name}", ControlError)
    check_numbers(
        samples=samples,
        seed=seed,
        confidence=confidence,
        max_failure_probability=max_failure_probability,
        min_friction_margin=min_friction_margin,
    )
    require_type(parameters, (Fit, ParameterSet), "parameters", "give a Fit or a ParameterSet", ControlError)
    if controller.design is None:
        return _certify_points(controller, plants, parameters, measured or {}, seed=seed, confidence=confidence)
    require_type(others, (ParameterSet, NoneType), "others", "give a ParameterSet", ControlError)
    require_type(bounds, (Budget, NoneType), "bounds", "give a Budget", ControlError)
    require_type(simulations, bool, "simulations", "give True or False", ControlError)
    check_executor(executor, ControlError)
    if not simulations and (sensors is not None or command_step):
        raise ControlError("sensors and command_step are of the simulations, which are left out; give simulations=True")
    slopes = (min_friction_margin, controller.spec.level(MIN_FRICTION_MARGIN))
    min_friction_margin = max((slope for slope in slopes if slope is not None), default=None)
    require_type(ranges, (Mapping, NoneType), "ranges", "give a mapping of name to (low, high)", ControlError)
    loops = pose_loops(controller, plants, parameters, ranges or {}, others or ParameterSet(), bounds)
    (design, values), models, unknown = controller.design, loops.models, loops.unknown
    check_sensors(sensors, controller, models)
    nominal, varied = unknown.nominal, unknown.varied()
    names = [row.name for row in varied]
    plants, spots = loops.plants, name_spots(models, unknown)
    figures = {name: controller.close(plant, nominal).figures() for name, plant in plants.items()}
    samples = samples if unknown.size else 0  # nothing is uncertain: there is nothing to draw
    rng = np.random.default_rng([seed, CERTIFICATE_STREAM, _digest(controller)])
    drawing, searching, rubbing, rendering, stepping, simulating = divide(
        progress,
        DRAW * samples * len(plants),
        (SEARCH + BOUND * (bounds is not None)) * len(plants),
        FRICTION * len(plants),
        IMPEDANCE * min(samples, IMPEDANCE_DRAWS) * (controller.outer is not None),
        STEPS * len(models),
        SIMULATIONS * len(models) * simulations,
    )
    loops = Shared(loops)
    failed, drawn, drawn_ms = measure_draws(loops, samples, rng, executor, drawing)
    worst, brackets = search_worst(loops, drawn, executor, searching)
    monte_carlo = count_failures(failed, seed, confidence)
    rubbing("friction at the draws", 0.0)
    friction = find_nominal_margins(controller, models, nominal)
    friction_draws = find_margins_at_draws(loops, friction, samples, rng, min_friction_margin, executor)
    impedance = certify_impedance(controller, models, nominal)
    if impedance is not None and impedance.safe:
        impedance = replace(impedance, draws=draw_impedance(loops, samples, rng, executor, rendering))
    compensation = find_nominal_compensation(controller, models, nominal)
    compensation_draws = find_compensation_at_draws(loops, compensation, samples, rng, executor)
    gravity = find_gravity_cases(loops, samples, rng, executor)
    ripple = find_ripple_cases(loops, samples, rng, executor)
    of_design = values.with_parameters(
        *(nominal[name] for name in nominal if name in {*design.parameters, DRIVE_DELAY})
    )
    requirements = (
        *design_requirements(controller, design, of_design, names),
        *(row for name, spot in spots.items() for row in plant_requirements(controller, spot, figures[name])),
        *draw_requirements(monte_carlo, {spots[name]: one for name, one in worst.items()}, max_failure_probability),
        *friction_requirements(friction, friction_draws, min_friction_margin, controller.command.mechanics.damping),
        *compensation_requirements(controller, compensation, compensation_draws),
        *eigenvalue_requirements(controller, models, gravity, ripple),
        *(row for name, one in (measured or {}).items() for row in measured_requirements(controller, name, one)),
        *impedance_requirements(impedance),
    )
    certificate = Certificate(
        requirements=requirements,
        plants=figures,
        margins={name: plant_margins(controller, plant, nominal) for name, plant in plants.items()},
        worst=worst,
        monte_carlo=monte_carlo,
        controller=controller,
        models=models,
        parameters=nominal,
        varied=varied,
        brackets=brackets,
        friction=friction,
        friction_draws=friction_draws,
        compensation=compensation,
        compensation_draws=compensation_draws,
        impedance=impedance,
        drawn_ms=drawn_ms,
        remarks=(
            *_remark_measured(controller, measured or {}),
            *warn_delays(controller.spec, design, parameters),
            *_remark_amplitude(controller, design, models, nominal),
        ),
    )
    certificate = certificate.with_steps(stepping, executor)
    if simulations:
        certificate = certificate.with_simulation(
            sensors=sensors, command_step=command_step, seed=seed, executor=executor, progress=simulating
        )
    progress(f"{samples} draws, {format_count(monte_carlo.failures, 'failure')}", 1.0)
    return certificate


def pose_loops(
    controller: Controller,
    plants: Plants,
    parameters: Source,
    ranges: Ranges,
    others: ParameterSet,
    bounds: Budget | None = None,
) -> Loops:
    """Return a controller on its plants, the design plant's among them, with what is uncertain of them."""
    assert controller.design is not None
    design, values = controller.design
    seen = {name: controller.see(plant) for name, plant in plants.items()}
    models = add_design(design, seen)
    if len(models) > len(seen):  # the design plant has its own values of what nobody else gives
        missing = (values[name] for name in values if name in design.parameters and name not in others)
        others = others.with_parameters(*missing)
    models = split_delayed(controller.spec, design, models, parameters)
    ranges = _add_warm_winding(ranges, models, parameters, others)
    unknown = combine_uncertainty(parameters, others, ranges, models, find_own_drive(controller, parameters))
    _check_delay(controller, unknown.ranges)
    states = split_states(models, unknown)
    return Loops(controller=controller, models=models, plants=states, unknown=unknown, bounds=bounds)


def _add_warm_winding(
    ranges: Ranges, models: Plants, parameters: Source, others: ParameterSet
) -> dict[str, tuple[float, float]]:
    """Return the ranges with the temperatures of every winding that changes its loop, and those given for the air."""
    fitted = parameters.parameters if isinstance(parameters, Fit) else parameters
    values = others.with_parameters(*fitted.values())
    warm = [ends for plant in models.values() if (ends := find_warm_range(plant, values)) is not None]
    if not warm:
        return dict(ranges)
    check_ranges(ranges, models)
    lows, highs = zip(*warm, *([ranges[AMBIENT]] if AMBIENT in ranges else []), strict=True)
    return {**ranges, AMBIENT: (min(lows), max(highs))}


def _remark_measured(controller: Controller, measured: Mapping[str, MeasuredResponse]) -> tuple[str, ...]:
    """Say on which measured points the law was judged, and under what assumptions."""
    spec = controller.spec
    plants = {name: spec.see_response(one, controller.command) for name, one in measured.items()}
    return tuple(str(measure_discs(plant, controller.law, spec.bandwidth_hz)) for plant in plants.values())


def find_own_drive(controller: Controller, source: Source) -> Drive | None:
    """Return a certificate's delay of the drive: the fit's or the parameters', or else what the law counts on."""
    assert controller.design is not None
    counted = Drive(delay_s=controller.drive_delay_s)
    has_own = DRIVE_DELAY in (source.parameters if isinstance(source, Fit) else source)
    stated = isinstance(source, Fit) or has_own or find_given_drive_delay(controller.spec) is not None
    drive = find_drive(controller.spec, controller.design[0], source) if stated else counted
    return drive if drive.delay_s or counted.delay_s or has_own else None


def _remark_amplitude(controller: Controller, plant: Plant, models: Plants, nominal: ParameterSet) -> tuple[str, ...]:
    """Say which bandwidth the design plant has at amplitudes of use, where friction makes it depend on them. They are
    shares of the force that the current limit holds at rest, those of the simulated steps.
    """
    name = next(name for name, model in models.items() if model is plant)
    rest, sliding = controller.force_limit(0.0), controller.achieved.bandwidth_hz
    if rest is None or sliding is None or not has_friction(plant, nominal):
        return ()
    low, high = STEP_SHARES[0], STEP_SHARES[-1]
    bands = predict_bandwidths(controller, plant, nominal, rest * np.geomspace(low, high, AMPLITUDES))
    reached = [band for band in bands if band is not None]
    at = f"at {100 * low:g} to {100 * high:g} % of the current"
    if not reached:
        return (f"{name}: bandwidth {sliding:.3g} Hz sliding; below {sliding / SLOWEST_STUCK:.2g} Hz {at}",)
    least = f"{min(reached):.3g}" if len(reached) == len(bands) else f"less than {min(reached):.3g}"
    return (f"{name}: bandwidth {sliding:.3g} Hz sliding; between {least} and {max(reached):.3g} Hz {at}, predicted",)


def _certify_points(
    controller: Controller,
    plants: Plants,
    parameters: Source,
    measured: Mapping[str, MeasuredResponse],
    *,
    seed: int,
    confidence: float,
) -> Certificate:
    """Certify a controller that was designed on a measured response: on measured points, without any model."""
    if plants:
        raise ControlError(
            f"the controller was designed on a measured response, and plants names {', '.join(plants)}; "
            "to certify it on models design it on one: robust_to then takes the response"
        )
    if not measured:
        raise ControlError(
            "the controller was designed on a measured response, or does not know its design plant; give the response "
            'it was designed on first: measured={"frf:chirp": response}'
        )
    requirements = (
        *measured_requirements(controller, *next(iter(measured.items())), "design plant"),
        *(row for name, one in measured.items() for row in measured_requirements(controller, name, one)),
    )
    return Certificate(
        requirements=requirements,
        plants={},
        margins={},
        worst={},
        monte_carlo=count_failures(np.zeros((3, 0), dtype=bool), seed, confidence),
        controller=controller,
        models={},
        parameters=parameters.parameters if isinstance(parameters, Fit) else parameters,
        steps=NO_MODEL,
        remarks=_remark_measured(controller, measured),
    )


def split_states(models: Plants, unknown: Uncertainty) -> dict[str, Plant]:
    """Return the plants whose loops are measured: one with friction is there sliding and stuck."""
    return split_friction(models, unknown.nominal, [row.name for row in unknown.varied()])


def name_spots(models: Plants, unknown: Uncertainty) -> dict[str, Spot]:
    """Return plant and state behind each name of `split_states`."""
    states = name_states(models, unknown.nominal, [row.name for row in unknown.varied()])
    return {label: Spot(*state) for label, state in states.items()}


def add_design(design: Plant, plants: Plants) -> dict[str, Plant]:
    """Return the plants with the design plant first, by a name that is free, where it is not among them."""
    if any(plant is design for plant in plants.values()):
        return dict(plants)
    name = next((name for name in DESIGN_NAMES if name not in plants), None)
    if name is None:
        taken = '" and "'.join(DESIGN_NAMES)
        raise ControlError(f'plants other than the design plant are called "{taken}"; give one of them another name')
    return {name: design, **plants}


def _check_delay(controller: Controller, ranges: Ranges) -> None:
    """Refuse delays of so many samples that a plant with them is no plant to control."""
    period = controller.sample_time_s
    for name in DELAYS:
        high = ranges[name][1] if name in ranges else 0.0
        if high > MOST_DELAY_SAMPLES * period:
            raise ControlError(
                f"range of {name} reaches {high:g} s, {high / period:.0f} samples; delays are in seconds, and up to "
                f"{MOST_DELAY_SAMPLES} samples ({MOST_DELAY_SAMPLES * period:g} s) are certified"
            )


def _digest(controller: Controller) -> int:
    """Return a law's number for other draws at the same seed; six digits, alike on two machines."""
    coefficients = (
        f"{value:.6g}" for part in (controller.reference, controller.measurement) for value in (*part.num, *part.den)
    )
    return int.from_bytes(sha256(" ".join(coefficients).encode()).digest()[:8], "big")
