"""Assertions for users' own pytest checks; each message is a table of what was found and what was asked."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from seaopt.errors import SeaoptError, suggestion
from seaopt.estimation import Experiment, Fit
from seaopt.parameters import ParameterSet
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
        `truth` lacks a free parameter.

    Examples
    --------
    >>> import seaopt as so
    >>> from seaopt.testing import virtual_experiment
    >>> stand, thor = so.plants.high_impedance(), so.plants.thor()
    >>> fit = so.fit([virtual_experiment(stand, thor)], thor.update(J=2e-6).free("J", "b_r"))
    >>> assert_recovered(fit, thor, sigmas=3, within=0.05)

    """
    rows: list[str] = []
    failed = not fit.met
    for name in fit.covariance.names:
        if name not in truth:
            raise SeaoptError(f'truth has no "{name}", which the fit estimated; {suggestion(name, truth)}')
        expected = truth[name]
        true = expected if isinstance(expected, (int, float)) else expected.value
        fitted = fit.parameters[name]
        std = fitted.std if fitted.std is not None else np.nan
        error = fitted.value - true
        distance = abs(error) / std if std > 0.0 else np.inf
        relative = abs(error) / abs(true) if true else np.inf
        good = distance <= sigmas and np.isfinite(std) and (within is None or relative <= within)
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
        An output is named that the experiment does not measure.

    Examples
    --------
    >>> import seaopt as so
    >>> from seaopt.testing import virtual_experiment
    >>> bench, other = (virtual_experiment(so.plants.high_impedance(), so.plants.thor(), seed=n) for n in (1, 2))
    >>> assert_predicts(so.fit([bench], so.plants.thor().free("J", "b_r")), other, fit_percent=95)

    """
    score = fit.predict(experiment)
    found = score.fit_percent
    asked = dict(fit_percent) if isinstance(fit_percent, Mapping) else dict.fromkeys(found, fit_percent)
    for name in asked:
        if name not in found:
            raise SeaoptError(
                f'fit_percent names "{name}", which {experiment.name} does not measure; {suggestion(name, found)}'
            )
    rows = [
        f"  {name}: fit {found[name]:.2f} %, asked for {least:g} %, rms residual {score.rms_residual[name]:.3g}"
        f"{unit_after(score.units[name])}{'' if found[name] >= least else '   <-- TOO LOW'}"
        for name, least in asked.items()
    ]
    if not all(found[name] >= least for name, least in asked.items()):
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
    broken = [
        f"  {row.name} = {row.value:.4g}, must be {row.sense} {row.limit:.4g} ({row.where})"
        for row in certificate.requirements
        if not row.met
    ]
    draws = certificate.monte_carlo
    if failure_probability is not None and not draws.failure_probability_bound <= failure_probability:
        broken.append(
            f"  the failure probability may be {draws.failure_probability_bound:.3g}, "
            f"must be ≤ {failure_probability:g} ({draws.failures} failures in {draws.samples} draws)"
        )
    if broken:
        raise AssertionError("\n".join(["the controller is not certified:", *broken]))
