"""Assertions for users' own pytest checks."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from seaopt.errors import SeaoptError, suggestion
from seaopt.estimation import Fit
from seaopt.parameters import ParameterSet
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
    In a test of your own: ``so.testing.assert_recovered(fit, {"J": 3.31e-6, "b_r": 1.31e-4}, sigmas=3)``.

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
