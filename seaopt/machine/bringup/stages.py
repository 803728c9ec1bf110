"""Bring-up: the stages in which a law goes onto its machine, a fraction of its bandwidth first, each as certified."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from seaopt.bench import Sensors
from seaopt.control import Controller, ControllerSpec, ForceMPC, ScheduledController
from seaopt.errors import ControlError, SeaoptError, require_number, require_type
from seaopt.estimation import Fit
from seaopt.machine.acceptance import FULL, hash_source, list_draws
from seaopt.machine.bringup.expected import (
    BARELY,
    MOVES,
    SEED,
    enclose_link,
    expect,
    expect_outer,
    find_noise,
    split_limits,
)
from seaopt.machine.bringup.plan import BringUp, Stage
from seaopt.machine.response.verdicts import find_friction
from seaopt.machine.stepped import Source, Spec, change_plan, limit_spec, stand
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.progress import Progress, ignore
from seaopt.robustness import Certificate, certify, linear_controller, tune_certified

FRACTIONS = 0.25, 0.5  # what the stages before the last ask for
UPWARDS = (1.0, 1.3, 1.7)  # times a stage's bandwidth: what is tried in turn
NOISE_ROOM = 0.75  # of a stage's limit of its command, that noise alone may take
DRAWS = 60
SAME_SIZE = 0.05  # relative, between references that are one experiment
SAME = "stage_{} would be the same experiment, and is left out ({})"
STEP_PERIODS = 6.0  # of the bandwidth, that the band of a step lasts
OF_A_STAGE = (  # options of predictive control that a stage may have otherwise
    "bandwidth_hz", "min_sensitivity_bandwidth_hz", "current_limit_A", "command_limit", "largest_force_N",
)  # fmt: skip


def bring_up(
    controller: Source,
    plants: Mapping[str, Plant],
    uncertainty: Fit | ParameterSet,
    *,
    ranges: Mapping[str, tuple[float, float]] | None = None,
    samples: int = 1375,
    fractions: Sequence[float] = FRACTIONS,
    share: float = 0.5,
    bias: float = 0.0,
    limits: Mapping[str, float] | None = None,
    sensors: Sensors | None = None,
    link: tuple[Plant, ParameterSet] | None = None,
    certificate: Certificate | None = None,
    tune_stage: Callable[[float], Source] | None = None,
    certify_stage: Callable[[Any], Certificate] | None = None,
    keep_stage: Callable[[Stage], object] | None = None,
    seed: int = SEED,
    progress: Progress = ignore,
) -> BringUp:
    """Plan the stages in which a controller's law goes onto its machine.

    Parameters
    ----------
    controller : Controller, ScheduledController or ForceMPC
        The full law, as tuned. The stages before it are slower laws; of a schedule they stand at its first point, and
        the full law has a stage at each of its points.
    plants : mapping of name to Plant
        As in `certify`.
    uncertainty : Fit or ParameterSet
        What it was tuned and certified with.
    ranges, samples
        As in `certify`.
    fractions : sequence of float
        Of the bandwidth, of each stage before the full law. Where none can be had there, the nearest above is taken;
        where there is none, the same law with that fraction of its effort.
    share : float
        Of each limit that the reference's excitation may take with the full law; in the stages before, times their
        fraction, or as much as moves the motor against twice its dry friction.
    bias : float
        The reference's mean, in its unit.
    limits : mapping of str to float, optional
        Largest magnitudes of outputs of the design plant, and of that of `link`: force and travel.
    sensors : Sensors, optional
        Noise and rounding of what the law reads, which the peaks that are expected then contain.
    link : (Plant, ParameterSet), optional
        The plant whose link the law's outer loop moves, with its values, as in `accept`: the full law then has a
        reference for that loop, too.
    certificate : Certificate, optional
        Of the full law, where there is one: what `certify` returned for this very controller.
    tune_stage, certify_stage : callable, optional
        How the law at a fraction of the bandwidth is tuned, and how a stage's law is certified, where more than plants
        and ranges count.
    keep_stage : callable, optional
        Called with each stage as soon as it is planned: the next may take minutes; and again with one whose note then
        says that the next is left out.
    seed : int
        Of phases and draws.
    progress : callable, optional
        As in `certify`.

    Returns
    -------
    BringUp

    Raises
    ------
    ControlError
        The controller does not know its design plant, nothing is limited, the certificate is of another law, or an
        argument is out of range.

    Examples
    --------
    >>> import seaopt as so
    >>> stand, thor = so.plants.high_impedance(), so.plants.thor()
    >>> controller = so.tune(stand, thor, so.ControllerSpec(bandwidth_hz=30, current_limit_A=9.0))
    >>> plan = so.bring_up(controller, {"stand": stand}, thor, samples=20, fractions=(0.5,))
    >>> [(stage.name, stage.controller.spec.bandwidth_hz) for stage in plan.stages]
    [('stage_1', 15.0), ('full', 30)]
    """
    require_type(
        controller, (Controller, ScheduledController, ForceMPC), "controller", "give what tune returned", ControlError
    )
    if stand(controller, None).design is None:
        raise ControlError("the controller does not know its design plant; read it with Controller.from_dict")
    for fraction in fractions:
        if not 0.0 < require_number(fraction, "fractions", ControlError) < 1.0:
            raise ControlError(f"fractions has {fraction:g}, which is not between 0 and 1; give such as (0.25, 0.5)")
    if not 0.0 < require_number(share, "share", ControlError) <= 1.0:
        raise ControlError(f"share = {share:g} is not between 0 and 1; give the part of each limit to use: 0.5")
    if certificate is not None:
        _require_same_law(controller, certificate)

    def certify_one(law: Any) -> Certificate:
        full = law is controller  # else no curve of which nothing is required, and what takes long until it fails
        return certify(
            law, plants, uncertainty, ranges=ranges, samples=samples, seed=seed, large_signals=full, thorough=full
        )

    def tune_one(fraction: float) -> Source:
        assert controller.design is not None
        if isinstance(controller, ForceMPC):
            return change_plan(controller, slow_down(controller.spec, fraction))
        options: dict[str, Any] = {"ranges": ranges, "samples": samples, "seed": seed + 1}
        if isinstance(controller, ScheduledController):
            bands = [fraction * band for band in controller.bandwidths_hz]
            options |= {"over": controller.over, "points": controller.points, "bandwidths_hz": bands}
        spec = slow_down(controller.spec, fraction)
        return tune_certified(controller.design[0], uncertainty, spec, plants, **options).controller

    certifying, tuning = certify_stage or certify_one, tune_stage or tune_one
    of_law, of_link = split_limits(stand(controller, None), limits or {}, link)
    options: dict[str, Any] = {"share": share, "bias": bias, "limits": of_law, "seed": seed, "sensors": sensors}
    inside = {name: ends for name, ends in (ranges or {}).items() if name != controller.over}

    def draw(law: Controller) -> list[dict[str, float]]:
        drawn = list_draws(law, uncertainty, inside, DRAWS, seed)
        return [{name: value for name, value in each.items() if name != controller.over} for each in drawn]

    draws = draw(stand(controller, None))
    stages, count = list[Stage](), len(fractions) + len(controller.points)

    def keep(stage: Stage, at: int | None = None) -> None:
        stages[len(stages) if at is None else at :] = [stage]
        if keep_stage is not None:
            keep_stage(stage)

    def tell(text: str) -> None:
        progress(f"stage {len(stages) + 1} of {count}, {text}", len(stages) / count)

    for number, fraction in enumerate(sorted(fractions), start=1):
        part = options | {"share": share * fraction, "most": share, "place": controller.points[0]}
        part["name"] = f"stage_{number}"
        law, judged, note = _find_stage(controller, fraction, tuning, certifying, tell, part)
        expected = _expect_stage(law, draws, part)
        if stages and is_same_experiment(stages[-1], expected):
            same = SAME.format(number, note or f"the law at {fraction:g} of the bandwidth")
            keep(replace(stages[-1], note="; ".join(filter(None, (stages[-1].note, same)))), at=-1)
            continue
        if judged is None:
            tell("certifying the law with less effort")
            judged = certifying(law)
        keep(_make_stage(f"stage_{number}", law, judged, note, expected, part))
    if certificate is None:
        tell("certifying the law itself")
        certificate = certifying(controller)
    for number, place in enumerate(controller.points, start=1):
        name = FULL if len(controller.points) == 1 else f"{FULL}_{number}"
        part = options | {"most": share, "place": place, "name": name}
        stage = _make_stage(name, controller, certificate, "", _expect_stage(controller, draws, part), part)
        outer = stage.controller.outer
        at = None if controller.over is None or place is None else (controller.over, place)
        enclosed = enclose_link(stage.controller, link, at)
        if outer is not None and link is not None and enclosed is None:
            stage = replace(stage, outer_unstable=True)
        if outer is not None and enclosed is not None:
            part = options | {"most": share, "bias": 0.0, "limits": of_link, "name": f"{name} with its outer loop"}
            stage = replace(stage, around=expect_outer(stage.controller, outer, enclosed, draw(enclosed), part))
        keep(stage)
    return BringUp(stages=tuple(stages))


def _require_same_law(source: Source, certificate: Certificate) -> None:
    """Raise ControlError where a certificate is of another law."""
    require_type(certificate, Certificate, "certificate", "give what certify returned", ControlError)
    law = linear_controller(source) if isinstance(source, ForceMPC) else source
    certified = certificate.controller if certificate.schedule is None else certificate.schedule
    ours, theirs = hash_source(law), hash_source(certified)
    if ours != theirs:
        raise ControlError(
            f"certificate = that of law {theirs}, {certified.spec.bandwidth_hz:g} Hz: the controller is law {ours}, "
            f"{source.spec.bandwidth_hz:g} Hz; give what certify(controller, ...) returns, or leave it out, and it is "
            "certified"
        )


def slow_down(spec: Spec, fraction: float) -> Spec:
    """Return a specification at a fraction of its bandwidth."""
    changes: dict[str, Any] = {"bandwidth_hz": fraction * spec.bandwidth_hz}
    if isinstance(spec, ControllerSpec):
        low, high = spec.bandwidth_range_hz
        changes["bandwidth_range_hz"] = min(low, fraction * spec.bandwidth_hz), high
    least = spec.min_sensitivity_bandwidth_hz
    if isinstance(least, float | int) and least:
        changes["min_sensitivity_bandwidth_hz"] = fraction * least
    return replace(spec, **changes)


def lower_effort(source: Source, fraction: float) -> Source:
    """Return a law with a fraction of the limit of its command. Raises ControlError: it has none."""
    limit = source.controllers[0].command_limit if isinstance(source, ScheduledController) else source.command_limit
    if limit is None:
        raise ControlError("the command has no limit to lower; give current_limit_A (command_limit)")
    if isinstance(source, ForceMPC):
        return change_plan(source, replace(limit_spec(source.spec, fraction * limit), largest_force_N=None))
    if isinstance(source, ScheduledController):
        lower = (replace(each, spec=limit_spec(each.spec, fraction * limit)) for each in source.controllers)
        return replace(source, controllers=tuple(lower))
    return replace(source, spec=limit_spec(source.spec, fraction * limit))


def _find_stage(
    source: Source,
    fraction: float,
    tuning: Callable[[float], Source],
    certifying: Callable[[Any], Certificate],
    tell: Callable[[str], None],
    options: Mapping[str, Any],
) -> tuple[Source, Certificate | None, str]:
    """Return the law of a stage, its certificate, None where it has none yet, and in what it is another one than
    planned.
    """
    asked = source.spec.bandwidth_hz
    for factor in UPWARDS:
        part = fraction * factor
        if part >= 0.95:
            break
        try:
            tell(f"tuning at {part * asked:.3g} Hz")
            law = tuning(part)
            if not law.met:
                continue
            tell(f"certifying at {part * asked:.3g} Hz")
            judged = certifying(law)
        except SeaoptError:
            continue
        if judged.met:
            note = "" if factor == 1.0 else f"{part * asked:.3g} Hz is the nearest to {asked * fraction:.3g} Hz"
            return law, judged, note
    own = stand(source, options["place"])
    part, above = _reach_friction(own, fraction, options["most"]), ""
    if part > fraction:
        above = f", not {100.0 * fraction:g} %, which its reference takes to move the motor"
    noise = find_noise(own, options) / (NOISE_ROOM * own.command_limit) if own.command_limit else 0.0
    if part < noise < 1.0:
        part, above = noise, f", not {100.0 * fraction:g} %, beside which the noise of what it reads has no room"
    lower = lower_effort(source, part)
    note = (
        f"the full law with {100.0 * part:.3g} % of its effort{above}: none near {fraction:g} of its bandwidth is "
        "certified"
    )
    return lower, None, note


def _reach_friction(controller: Controller, fraction: float, share: float) -> float:
    """Return the fraction of a law's effort, or the least above it, of whose limit a share moves the motor against dry
    friction; the fraction itself where all of it would not.
    """
    dry, limit = find_friction(controller), controller.command_limit
    if not dry or limit is None:
        return fraction
    needed = (times * dry * abs(controller.per_effort) / (share * limit) for times in (MOVES, BARELY))
    return max(fraction, next((part for part in needed if part < 1.0), fraction))


def _expect_stage(source: Source, draws: Sequence[Mapping[str, float]], options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the fields of what a law is to do, standing at its place."""
    controller = stand(source, options["place"])
    count = round(STEP_PERIODS / controller.spec.bandwidth_hz / controller.sample_time_s)
    return expect(controller, draws, options, count)


def is_same_experiment(stage: Stage, expected: Mapping[str, Any]) -> bool:
    """Tell whether a law would do what that of a stage does: it is the same law, under about the same reference."""
    before, after = stage.excitation, expected["excitation"]
    laws = stage.controller.law, expected["controller"].law
    matrices = ([law.a, law.b, law.c, law.d] for law in laws)
    if not all(np.array_equal(*pair) for pair in zip(*matrices, strict=True)):
        return False
    sizes = [np.array([each.bias, each.amplitude]) for each in (before, after)]
    return np.array_equal(before.lines, after.lines) and np.allclose(*sizes, rtol=SAME_SIZE)


def _make_stage(
    name: str,
    source: Source,
    certificate: Certificate,
    note: str,
    expected: Mapping[str, Any],
    options: Mapping[str, Any],
) -> Stage:
    place = options["place"]
    required = certificate.requirements
    return Stage(
        name=name, source=source, requirements=required, certificate=certificate, note=note, place=place, **expected
    )
