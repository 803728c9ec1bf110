"""Certify predictive control: its linear region as any law, and with its limits active by runs on nonlinear plants.

While no limit is active the plan's first command is linear in state and reference, so that the controller is a law, and
its loop has margins, worst cases and draws as every other's (`certify`). Where the program's constraints are active
there is no such law: `constrained` simulates that.
"""

from __future__ import annotations

from concurrent.futures import Executor
from dataclasses import replace
from types import NoneType
from typing import Any

from seaopt.bench import Sensors
from seaopt.control import Controller, ControllerSpec, ForceMPC, Law, MPCSpec, assess
from seaopt.control.laws.delay import DELAY_KEYS
from seaopt.control.laws.structures import CUSTOM
from seaopt.control.mpc.spec import MPC_BANDWIDTH_TOLERANCE, MPC_LIMITS
from seaopt.errors import ControlError, require_type
from seaopt.formatting import format_count
from seaopt.parameters import ParameterSet
from seaopt.progress import Progress, divide, ignore
from seaopt.robustness.certificate.certificate import Certificate
from seaopt.robustness.certificate.certify import CONFIDENCE, STEPS, certify, check_numbers, find_own_drive
from seaopt.robustness.certificate.constrained import ConstrainedRuns, run_constrained
from seaopt.robustness.certificate.requirement import DrawnAt, Requirement, require_at_most
from seaopt.robustness.uncertainty.draws import Plants, Ranges, Source, combine_uncertainty
from seaopt.robustness.verification.verification import check_sensors

CONSTRAINED_FAILURES, CONSTRAINED_PROBABILITY = "constrained_failures", "constrained_failure_probability"
LINEAR_RUN, CONSTRAINED_RUN = 8.0, 0.35  # seconds that a part takes as a rule: all of the linear region, one run


def linear_controller(mpc: ForceMPC) -> Controller:
    """Return a predictive controller's law while no limit is active, as a controller with the same limits of its loop.

    It has no limit of the command: what the plan does with one is no part of it.

    Examples
    --------
    >>> import seaopt as so
    >>> from seaopt.control import MPCSpec, force_mpc
    >>> spec = MPCSpec(current_limit_A=9.0, bandwidth_hz=20)
    >>> controller = linear_controller(force_mpc(so.plants.high_impedance(), so.plants.thor(), spec))
    >>> controller.structure, controller.feasible
    ('custom', True)
    """
    law = mpc.law  # its integrator apart: rounding leaves that pole on either side of the unit circle
    split = Law.from_state_space(law.a, law.b, law.c, law.d, law.sample_time_s)
    return assess(split, *mpc.design, linear_spec(mpc.spec))


def linear_spec(spec: MPCSpec) -> ControllerSpec:
    """Return the limits of a predictive controller's loop while no limit of its plan is active, as those of a law."""
    levels: dict[str, Any] = {
        limit.name: getattr(spec, limit.name)
        for limit in MPC_LIMITS
        if limit.has_field and limit.name != "bandwidth_hz"
    }
    return ControllerSpec(
        structure=CUSTOM,
        measured=spec.measured,
        bandwidth_hz=spec.bandwidth_hz,
        bandwidth_range_hz=(min(15.0, spec.bandwidth_hz), max(60.0, spec.bandwidth_hz)),
        sample_rate_hz=spec.sample_rate_hz,
        min_filter_samples=False,
        bandwidth_tolerance=MPC_BANDWIDTH_TOLERANCE,
        **levels,
        **{name: getattr(spec, name) for name in DELAY_KEYS},
    )


def certify_mpc(
    mpc: ForceMPC,
    plants: Plants,
    parameters: Source,
    *,
    ranges: Ranges | None = None,
    others: ParameterSet | None = None,
    runs: int = 100,
    seed: int = 1,
    confidence: float = CONFIDENCE,
    max_failure_probability: float | None = None,
    bound_tolerance: float = 0.1,
    sensors: Sensors | None = None,
    command_step: float = 0.0,
    executor: Executor | None = None,
    progress: Progress = ignore,
    **linear: Any,
) -> Certificate:
    """Certify a predictive controller: its linear region as `certify` does, its limits by simulated runs.

    Parameters
    ----------
    mpc : ForceMPC
        As `force_mpc` made it.
    plants, parameters, ranges, others, seed, confidence
        As in `certify`. The design plant is certified too.
    runs : int
        Draws with limits active, each on every plant: 100 without a failure bound the probability of one by 13 % at
        the confidence of 1 - 1e-6 (4.5 % at 0.99). One takes about a third of a second on each plant.
    max_failure_probability : float, optional
        Required of the bounds of both, so that too few draws or runs do not pass.
    bound_tolerance : float
        By how much a bounded signal may leave its bounds, as a share of half their width: a wrong model, and noise,
        make the estimate of it wrong.
    sensors, command_step
        As in `certify`: of the runs, and of steps that are simulated in the linear region.
    executor, progress
        As in `certify`; runs are parts, too.
    **linear
        Further keywords of `certify`: samples, min_friction_margin, bounds, measured.

    Returns
    -------
    Certificate
        Its figures are of the linear region, `constrained` has the runs, and `passed` needs both.

    Raises
    ------
    ControlError
        As `certify`, or a number is out of range.

    Examples
    --------
    >>> import seaopt as so
    >>> from seaopt.control import MPCSpec, force_mpc
    >>> stand, thor = so.plants.high_impedance(), so.plants.thor()
    >>> mpc = force_mpc(stand, thor, MPCSpec(current_limit_A=9.0, bandwidth_hz=20))
    >>> certificate = certify_mpc(mpc, {"stand": stand}, thor, ranges={"J": (3.2e-6, 3.4e-6)}, samples=100, runs=2)
    >>> certificate.passed, certificate.constrained.failures
    (True, 0)
    """
    require_type(mpc, ForceMPC, "mpc", "give a ForceMPC", ControlError)
    check_numbers(runs=runs, bound_tolerance=bound_tolerance, command_step=command_step)
    require_type(sensors, (Sensors, NoneType), "sensors", "give Sensors", ControlError)
    real = sensors not in (None, Sensors()) or command_step > 0.0
    linearly, stepping, simulating = divide(
        progress, LINEAR_RUN, STEPS * real, CONSTRAINED_RUN * runs * max(len(plants), 1)
    )
    law = linear_controller(mpc)
    check_sensors(sensors, law, {"design": mpc.design[0], **plants})
    certificate = certify(
        law,
        plants,
        parameters,
        ranges=ranges,
        others=others,
        seed=seed,
        confidence=confidence,
        max_failure_probability=max_failure_probability,
        simulations=False,
        executor=executor,
        progress=linearly,
        **linear,
    )
    if real:
        certificate = certificate.with_steps(
            sensors=sensors, command_step=command_step, seed=seed, executor=executor, progress=stepping
        )
    models, (_, values), others = certificate.models, mpc.design, others or ParameterSet()
    others = others.with_parameters(*(values[name] for name in values if name not in others))
    drive = find_own_drive(law, parameters)
    constrained = run_constrained(
        mpc,
        law,
        models,
        combine_uncertainty(parameters, others, dict(ranges or {}), models, drive),
        runs=runs,
        seed=seed,
        confidence=confidence,
        tolerance=bound_tolerance,
        sensors=sensors or Sensors(),
        command_step=command_step,
        executor=executor,
        progress=simulating,
    )
    requirements = (*certificate.requirements, *_require_runs(constrained, max_failure_probability))
    return replace(certificate, constrained=constrained, requirements=requirements)


def _require_runs(runs: ConstrainedRuns, max_failure_probability: float | None) -> tuple[Requirement, ...]:
    """Return what the runs with limits active require."""
    failures = require_at_most(
        CONSTRAINED_FAILURES,
        float(runs.failures),
        0.0,
        plant=runs.plant,
        scenario="limits active",
        draw=DrawnAt(parameters=runs.parameters, number=runs.run, seed=runs.seed),
        text=runs.text or format_count(runs.runs, "run"),
        remedy=runs.remedy,
    )
    if max_failure_probability is None:
        return (failures,)
    text = f"{format_count(runs.failures, 'failure')} in {format_count(runs.runs, 'run')}"
    bound = runs.failure_probability_bound
    return failures, require_at_most(CONSTRAINED_PROBABILITY, bound, max_failure_probability, text=text)
