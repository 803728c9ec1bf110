"""Fits against NIST's certified values: Statistical Reference Datasets, nonlinear regression.

www.itl.nist.gov/div898/strd. A regression y = f(x; b) is a plant without memory: x is its input, y its output, and the
clock counts the observations. Each set is fitted from both of NIST's starting points, the first far away, the second
near. NIST certifies eleven digits of the values and of their standard errors, which divide by n - p.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

import seaopt as so

TABLES = Path(__file__).parent / "nist"


def cubic_over_cubic(x, b1, b2, b3, b4, b5, b6, b7):
    return (b1 + b2 * x + b3 * x**2 + b4 * x**3) / (1 + b5 * x + b6 * x**2 + b7 * x**3)


def seasons(x, b1, b2, b3, b4, b5, b6, b7, b8, b9):
    def wave(period, cosine, sine):
        return cosine * ca.cos(2 * math.pi * x / period) + sine * ca.sin(2 * math.pi * x / period)

    return b1 + wave(12, b2, b3) + wave(b4, b5, b6) + wave(b7, b8, b9)


MODELS = {
    # lower difficulty
    "Misra1a": lambda x, b1, b2: b1 * (1 - ca.exp(-b2 * x)),
    "Misra1b": lambda x, b1, b2: b1 * (1 - (1 + b2 * x / 2) ** (-2)),
    "Chwirut2": lambda x, b1, b2, b3: ca.exp(-b1 * x) / (b2 + b3 * x),
    "DanWood": lambda x, b1, b2: b1 * x**b2,
    "Lanczos3": lambda x, b1, b2, b3, b4, b5, b6: b1 * ca.exp(-b2 * x) + b3 * ca.exp(-b4 * x) + b5 * ca.exp(-b6 * x),
    # average
    "ENSO": seasons,
    "Hahn1": cubic_over_cubic,
    "Kirby2": lambda x, b1, b2, b3, b4, b5: (b1 + b2 * x + b3 * x**2) / (1 + b4 * x + b5 * x**2),
    "MGH17": lambda x, b1, b2, b3, b4, b5: b1 + b2 * ca.exp(-x * b4) + b3 * ca.exp(-x * b5),
    "Roszman1": lambda x, b1, b2, b3, b4: b1 - b2 * x - ca.atan(b3 / (x - b4)) / math.pi,
    # higher
    "BoxBOD": lambda x, b1, b2: b1 * (1 - ca.exp(-b2 * x)),
    "Eckerle4": lambda x, b1, b2, b3: b1 / b2 * ca.exp(-0.5 * ((x - b3) / b2) ** 2),
    "MGH09": lambda x, b1, b2, b3, b4: b1 * (x**2 + x * b2) / (x**2 + x * b3 + b4),
    "MGH10": lambda x, b1, b2, b3: b1 * ca.exp(b2 / (x + b3)),
    "Rat42": lambda x, b1, b2, b3: b1 / (1 + ca.exp(b2 - b3 * x)),
    "Rat43": lambda x, b1, b2, b3, b4: b1 / (1 + ca.exp(b2 - b3 * x)) ** (1 / b4),
    "Thurber": cubic_over_cubic,
}
STARTS = {"far": 0, "near": 1}
PATIENT = so.OutputError(max_iterations=1000)  # MGH10 follows a narrow valley for 300


@dataclass(frozen=True, slots=True, kw_only=True)
class Certified:
    """One of NIST's tables: starts, values and standard errors by parameter, and the observations."""

    names: tuple[str, ...]
    starts: np.ndarray
    values: np.ndarray
    errors: np.ndarray
    residual_sum_of_squares: float
    x: np.ndarray
    y: np.ndarray


def read(name):
    rows = [line.split() for line in (TABLES / f"{name}.txt").read_text().splitlines() if not line.startswith("#")]
    parameters = [row for row in rows if len(row) == 5]
    numbers = np.array([row[1:] for row in parameters], dtype=float)
    (total,) = (float(row[1]) for row in rows if row[0] == "residual_sum_of_squares")
    data = np.array([row for row in rows if len(row) == 2 and row[0] != "residual_sum_of_squares"], dtype=float)
    return Certified(
        names=tuple(row[0] for row in parameters), starts=numbers[:, :2].T, values=numbers[:, 2], errors=numbers[:, 3],
        residual_sum_of_squares=total, x=data[:, 1], y=data[:, 0],
    )  # fmt: skip


def regression(name, names):
    """Return the regression as a plant; its only state follows x and is not seen."""
    return so.Plant(
        name=name, states={"z": "-"}, inputs={"x": "-"}, outputs={"y": "-"}, parameters=dict.fromkeys(names, "-"),
        f=lambda t, x, u, p: {"z": u.x - x.z},
        h=lambda t, x, u, p: {"y": MODELS[name](u.x, *(getattr(p, b) for b in names)) + 0 * x.z},
    )  # fmt: skip


@cache
def fitted(name, start):
    """Return the table and the fit. A log takes nine samples or more: what a set lacks is left unmeasured."""
    table = read(name)
    lacking = max(9 - table.x.size, 0)
    x = np.append(table.x, np.full(lacking, table.x[-1]))
    y = np.append(table.y, np.full(lacking, np.nan))
    log = so.Log.from_arrays(time=np.arange(x.size, dtype=float), x=x, y=y)
    bench = so.Experiment(plant=regression(name, table.names), log=log, hold="zero", initial_state="rest", offset=False)
    given = {b: (value, "-") for b, value in zip(table.names, table.starts[STARTS[start]], strict=True)}
    return table, so.fit([bench], so.ParameterSet.of(**given).free(*table.names), method=PATIENT, diagnostics=False)


FAR = ("Misra1a", "ENSO", "Eckerle4", "MGH17")  # of each difficulty, and the one that fails: the others are slow tests


def sets(*but):
    """Return every set with both starts; `but` are the (name, start, reason) that fail, where MINPACK does not."""
    marks = {(name, "far"): [pytest.mark.slow] for name in MODELS if name not in FAR}
    marks |= {(name, start): [pytest.mark.xfail(reason=reason)] for name, start, reason in but}
    return [pytest.param(name, start, marks=marks.get((name, start), [])) for name in MODELS for start in STARTS]


LOST = (("MGH17", "far", "a step of b5 from 2 to 6 leaves it without effect on any sample; the search stays there"),)


@pytest.mark.parametrize("name", MODELS)
def test_the_tables_are_nists(name):
    """Model and data as written here leave the certified residual sum of squares at the certified values."""
    table = read(name)
    model = np.array([float(MODELS[name](x, *table.values)) for x in table.x])
    assert np.sum((table.y - model) ** 2) == pytest.approx(table.residual_sum_of_squares, rel=1e-7)


@pytest.mark.parametrize(("name", "start"), sets(*LOST))
def test_values_are_nists(name, start):
    """To 1e-6 of the value, or, where NIST's standard error is a tenth of the value or more, 1e-5 of that error.

    The search ends 1e-5 standard deviations from the minimum; of the sets here that matters for Chwirut2, ENSO, Hahn1
    and MGH09, with standard errors of 0.2 to 2.4 times a value.
    """
    table, fit = fitted(name, start)
    found = np.array([fit.parameters[b].value for b in table.names])
    allowed = np.maximum(1e-6 * np.abs(table.values), 1e-5 * table.errors)
    assert np.max(np.abs(found - table.values) / allowed) <= 1.0, f"{fit.status}: {fit.message}"


@pytest.mark.parametrize(("name", "start"), sets(*LOST))
def test_standard_errors_are_nists(name, start):
    table, fit = fitted(name, start)
    n, p = table.x.size, len(table.names)
    errors = [fit.white_covariance.std(b) * np.sqrt(n / (n - p)) for b in table.names]
    np.testing.assert_allclose(errors, table.errors, rtol=1e-4)


@pytest.mark.parametrize(("name", "start"), sets(*LOST))
def test_what_is_found_is_called_found(name, start):
    """Converged; or, for ENSO's b8, whose standard error is 2.4 times its value, poorly identified."""
    _, fit = fitted(name, start)
    assert fit.status == "converged" or (name == "ENSO" and "poorly identified: b8" in fit.message), fit.message
