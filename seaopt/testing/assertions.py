"""Assertions for users' own pytest checks; each message is a table of what was found and what was asked."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from seaopt.errors import SeaoptError, require_number, require_type, suggestion
from seaopt.estimation import Experiment, Fit
from seaopt.parameters import Parameter, ParameterSet
from seaopt.robustness import Certificate
from seaopt.units import unit_after


def assert_recovered(
    fit: Fit, truth: ParameterSet | Mapping[str, float], *, sigmas: float = 3.0, within: float | None = None
) -> None:
    """Assert that a fit found the true values of its free parameters.

    Parameters
    ----------
    fit : Fit
        What `seaopt.fit` returned.
    truth : ParameterSet or mapping of name to value (SI)
        True values; only the fit's free parameters are compared, and all of them must be there.
    sigmas : float
        Allowed distance, in the fit's own standard deviations.
    within : float, optional
        Allowed relative distance, besides.

    Raises
    ------
    AssertionError
        The fit is not met, or a parameter is too far off; the message is a table of all of them.
    SeaoptError
        `truth` lacks a free parameter, the fit has none, or a limit is no positive number.

    Examples
    --------
    >>> import seaopt as so
    >>> from seaopt.testing import virtual_experiment
    >>> stand, thor = so.plants.high_impedance(), so.plants.thor()
    >>> fit = so.fit([virtual_experiment(stand, thor)], thor.update(J=2e-6).free("J", "b_r"))
    >>> assert_recovered(fit, thor, sigmas=3, within=0.05)
    """
    require_type(fit, Fit, "fit", "give what seaopt.fit returned")
    require_type(truth, (ParameterSet, Mapping), "truth", 'give the true values: thor(), or {"J": 3.31e-6}')
    _require_positive(sigmas, "sigmas")
    if within is not None:
        _require_positive(within, "within")
    if not fit.covariance.names:
        raise SeaoptError('the fit estimated no parameter, so that there is nothing to compare; free one: .free("J")')
    rows: list[str] = []
    failed = not fit.met
    for name in fit.covariance.names:
        if name not in truth:
            raise SeaoptError(f'truth has no "{name}", which the fit estimated; {suggestion(name, truth)}')
        expected, fitted = truth[name], fit.parameters[name]
        true = expected.value if isinstance(expected, Parameter) else require_number(expected, f'truth["{name}"]')
        std, error = math.nan if fitted.total_std is None else fitted.total_std, abs(fitted.value - true)
        distance = error / std if std > 0.0 else math.inf
        relative = error / abs(true) if true else math.inf
        good = distance <= sigmas and math.isfinite(std) and (within is None or relative <= within)
        failed |= not good
        rows.append(
            f"  {name:<12} fitted {fitted.value:.6g} ± {std:.2g}{unit_after(fitted.unit)}, true {true:.6g}: "
            f"{distance:.1f} std, {relative:.2%} off{'' if good else '   <-- TOO FAR'}"
        )
    if failed:
        limit = f"{sigmas:g} std" + (f" and {within:.2%}" if within is not None else "")
        raise AssertionError("\n".join([f"fit {fit.verdict}; allowed {limit}:", *rows]))


def assert_predicts(fit: Fit, experiment: Experiment, fit_percent: float | Mapping[str, float]) -> None:
    """Assert that a fit predicts an experiment that it has not seen.

    Parameters
    ----------
    fit : Fit
        What `seaopt.fit` returned.
    experiment : Experiment
        Another log: its initial state and offsets are estimated from it, nothing else.
    fit_percent : float or mapping of output to float
        At least this much of each output, ``100 (1 - norm(y - yhat)/norm(y - mean(y)))``, or of those named.

    Raises
    ------
    AssertionError
        An output is predicted worse than that.
    SeaoptError
        An output is named that the experiment does not measure, none is, or a limit is no finite number.

    Examples
    --------
    >>> import seaopt as so
    >>> from seaopt.testing import virtual_experiment
    >>> bench, other = (virtual_experiment(so.plants.high_impedance(), so.plants.thor(), seed=n) for n in (1, 2))
    >>> assert_predicts(so.fit([bench], so.plants.thor().free("J", "b_r")), other, fit_percent=95)
    """
    require_type(fit, Fit, "fit", "give what seaopt.fit returned")
    require_type(experiment, Experiment, "experiment", "give an Experiment")
    score = fit.predict(experiment)
    percents = score.fit_percent
    limits: Mapping[str, Any] = (
        fit_percent if isinstance(fit_percent, Mapping) else dict.fromkeys(percents, fit_percent)
    )
    if not limits:
        raise SeaoptError("fit_percent names no output, so that there is nothing to compare; give 95, or {'F1': 95}")
    for name, least in limits.items():
        _require_finite(least, f'fit_percent["{name}"]')
        if name not in percents:
            raise SeaoptError(
                f'fit_percent names "{name}", which {experiment.name} does not measure; {suggestion(name, percents)}'
            )
    rows = [
        f"  {name}: fit {percents[name]:.2f} %, asked for {least:g} %, rms residual {score.rms_residual[name]:.3g}"
        f"{unit_after(score.units[name])}{'' if percents[name] >= least else '   <-- TOO LOW'}"
        for name, least in limits.items()
    ]
    if not all(percents[name] >= least for name, least in limits.items()):
        remark = "" if fit.met else f"; the fit is not met: {fit.verdict}"
        raise AssertionError("\n".join([f"{experiment.name} is not predicted{remark}:", *rows]))


def assert_certified(certificate: Certificate, *, failure_probability: float | None = None) -> None:
    """Assert that a certificate passed.

    Parameters
    ----------
    certificate : Certificate
        What `seaopt.certify` returned.
    failure_probability : float, optional
        The stated bound on it must be no larger, too.

    Raises
    ------
    AssertionError
        A requirement is not met; the message lists each with its figure, limit and place.

    Examples
    --------
    >>> import seaopt as so
    >>> stand, thor = so.plants.high_impedance(), so.plants.thor()
    >>> controller = so.tune(stand, thor, so.ControllerSpec(bandwidth_hz=30))
    >>> certificate = so.certify(controller, {"stand": stand}, thor, ranges={"eta": (0.9, 1.0)}, samples=500)
    >>> assert_certified(certificate, failure_probability=0.03)
    """
    require_type(certificate, Certificate, "certificate", "give what seaopt.certify returned")
    if failure_probability is not None:
        _require_positive(failure_probability, "failure_probability")
    broken = [f"  {row}" for row in certificate.requirements if not row.met]
    draws = certificate.monte_carlo
    if failure_probability is not None and not draws.failure_probability_bound <= failure_probability:
        broken.append(
            f"  the failure probability may be {draws.failure_probability_bound:.3g}, "
            f"must be ≤ {failure_probability:g} ({draws.failures} failures in {draws.samples} draws)"
        )
    if broken:
        raise AssertionError("\n".join(["the controller is not certified:", *broken]))


def _require_finite(value: Any, argument: str) -> float:
    number = require_number(value, argument)
    if not math.isfinite(number):
        raise SeaoptError(f"{argument} = {number} is not finite; give a finite number")
    return number


def _require_positive(value: Any, argument: str) -> None:
    if not _require_finite(value, argument) > 0.0:
        raise SeaoptError(f"{argument} = {value} is not positive; give a positive number")
