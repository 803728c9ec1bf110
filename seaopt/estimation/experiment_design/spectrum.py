r"""Spectra: which powers at which frequencies tell most of the parameters of a linear plant, and with which phases.

In the periodic steady state of a multisine :math:`u = \sum_k a_k \sin(\omega_k t + \varphi_k)` the sensitivities of
the outputs are sines too, so that over whole periods of n samples the Fisher information is linear in the powers
:math:`P_k = a_k^2/2` (Goodwin and Payne, Dynamic System Identification, 1977, Sec. 6.4),

.. math:: F = \sum_k P_k F_k, \qquad
          F_k = n \sum_o \sigma_o^{-2} \Re\left(\frac{\partial H_o}{\partial\theta}
                \frac{\partial H_o}{\partial\theta}^{*}\right)(e^{i\omega_k T}),

and every measure of its inverse is convex in them. Limits on the mean square of the input or of any response
:math:`|H_m|` are linear. H is the response of the sampled plant, its derivatives are exact. Constant offsets of the
sensors are orthogonal to every line and take nothing from F.

Phases do not change F. They decide the peaks, and are found from Schroeder's (IEEE Trans. Inf. Theory 16, 1970) by
minimising norms of rising order of all limited signals together (Guillaume et al., IEEE Trans. Instrum. Meas. 40,
1991).
"""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
from jaxtyping import Complex, Float, Int

from seaopt.errors import EstimationError
from seaopt.estimation.problem.shapes import ParameterMatrix
from seaopt.executors import solve_ipopt
from seaopt.frequency.sampled import sampled_signals
from seaopt.records import record
from seaopt.simulation import Clock, Model, linearise

ORDERS = (2, 8, 32)  # half the orders of the norms that become the peak
SINGULAR = 1e-11  # eigenvalues of the normalised information below this part of the largest are zero
Lines = Float[np.ndarray, " K"]  # one number per line of a spectrum
Harmonics = Int[np.ndarray, " K"]  # multiples of rate/n
Signals = Complex[np.ndarray, "m K"]  # the lines of m signals


@record(eq=False)
class Spectrum:
    """The information and the motion that a unit mean square of the input brings at each of K frequencies."""

    harmonics: Harmonics  # multiples of rate/n
    information: Float[np.ndarray, "K p p"]  # Fisher information of a unit mean square at each line
    gains: Signals  # responses of the limited signals


def choose_harmonics(n: int, rate_hz: float, band_hz: tuple[float, float], lines: int) -> Harmonics:
    """Return at most `lines` log-spaced multiples of rate_hz/n in a band. Raises EstimationError: it has none."""
    low, high = band_hz
    first, last = max(int(np.ceil(low * n / rate_hz - 1e-9)), 1), min(int(high * n / rate_hz + 1e-9), (n - 1) // 2)
    if not 0.0 < low < high or first > last:
        raise EstimationError(
            f"band_hz = [{low:g}, {high:g}] holds no multiple of 1/duration = {rate_hz / n:g} Hz below half the sample "
            "rate; give [low, high] with 0 < low < high, or a longer duration"
        )
    return np.unique(np.round(np.geomspace(first, last, lines)).astype(int))


def make_spectrum(
    model: Model,
    theta: Float[np.ndarray, " np"],
    clock: Clock,
    multiples: Harmonics,
    *,
    n: int,
    sigma: Float[np.ndarray, " nm"],
    channel: int,
    signals: list[int],
) -> Spectrum:
    """Return the spectrum of a plant, linearised at rest where it is not linear. `model`, `theta`, `clock`: the plant,
    its free parameters and the hold; `multiples`: the lines, in multiples of 1/(n period); `n`: samples; `sigma`: noise
    of the first nm outputs, those that are measured; `channel`: the input that is excited; `signals`: limited signals:
    -1 is the input, then the outputs, then the states.
    """
    nx = model.nx
    response = sampled_signals(linearise(model), theta, clock, multiples / (n * clock.period), channel)
    slopes = response[1:, :, nx : nx + sigma.size] / sigma
    information = n * np.einsum("iko,jko->kij", slopes, slopes.conj()).real
    order = np.concatenate([response[0, :, nx:], response[0, :, :nx], np.ones((multiples.size, 1))], axis=1)
    return Spectrum(harmonics=multiples, information=information, gains=order[:, signals].T)


def optimal_powers(
    information: Float[np.ndarray, "K p p"],
    budget: Float[np.ndarray, "m K"],
    *,
    weight: ParameterMatrix | None,
    prior: ParameterMatrix | None = None,
) -> Lines:
    """Return the powers that minimise trace(W F^-1), or -log det F, within linear limits. `information`: F = sum_k P_k
    information[k] + prior; `budget`: budget @ P <= 1; not negative, and no column zero; `weight`: W; None for the
    determinant; `prior`: information from elsewhere. Raises EstimationError: some direction of the parameters shows at
    no line.
    """
    k, p = information.shape[:2]
    even = np.full(k, 1.0 / np.max(np.sum(budget, axis=1)))
    before = np.zeros((p, p)) if prior is None else prior
    root = _inverse_root(np.einsum("k,kij->ij", even, information) + before)
    normal = np.einsum("ai,k,kij,jb->kab", root.T, even, information, root)
    q = ca.SX.sym("q", k)
    total = ca.reshape(ca.mtimes(ca.DM(normal.reshape(k, p * p).T), q), p, p) + ca.DM(root.T @ before @ root)
    cost = _cost(total, None if weight is None else root.T @ weight @ root, p)
    nlp = {"x": q, "f": cost, "g": ca.mtimes(ca.DM(budget * even), q)}
    options = {"print_time": False, "ipopt.print_level": 0, "ipopt.sb": "yes", "ipopt.tol": 1e-9, "error_on_fail": True}
    solver = ca.nlpsol("powers", "ipopt", nlp, options)
    try:
        solution = solve_ipopt(solver, x0=np.full(k, 0.9), lbx=0.0, ubg=1.0)
    except RuntimeError as error:
        raise EstimationError("the powers were not found; use fewer lines, or narrow band_hz") from error
    return np.maximum(np.array(solution["x"]).ravel(), 0.0) * even


def _cost(total: Any, weight: ParameterMatrix | None, p: int) -> Any:
    """Return the criterion of an information matrix as an expression, near 1 at the start."""
    upper = ca.chol(0.5 * (total + total.T))
    if weight is None:
        return -2.0 * ca.sum1(ca.log(ca.diag(upper)))
    values, vectors = np.linalg.eigh(weight / np.trace(weight))
    half = vectors * np.sqrt(np.maximum(values, 0.0))
    return ca.sumsqr(_substitute_forward(upper, ca.DM(half), p))


def _substitute_forward(upper: Any, right: Any, p: int) -> Any:
    """Return (R')^-1 B by forward substitution: |.|^2 is then trace(B' (R'R)^-1 B)."""
    rows: list[Any] = []
    for i in range(p):
        row = right[i, :]
        for j in range(i):
            row -= upper[j, i] * rows[j]
        rows.append(row / upper[i, i])
    return ca.vertcat(*rows)


def _inverse_root(matrix: ParameterMatrix) -> ParameterMatrix:
    """Return S with S' M S = 1. Raises EstimationError: M is singular."""
    size = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    values, vectors = np.linalg.eigh(matrix / np.outer(size, size))
    if not np.all(np.isfinite(values)) or values[0] <= SINGULAR * values[-1]:
        raise EstimationError(
            "no line shows every free parameter by itself; fix one, give it a prior, or measure another output"
        )
    return vectors / np.sqrt(values) / size[:, None]


def schroeder_phases(powers: Lines) -> Lines:
    """Return Schroeder's phases, -2 pi sum_(j<k) (k - j) P_j / sum P: a line's delay grows with the power before it."""
    share = np.concatenate([[0.0], np.cumsum(powers)[:-1]]) / np.sum(powers)
    return -2.0 * np.pi * np.cumsum(share)


def low_peak_phases(lines: Signals, multiples: Harmonics, n: int, start: Lines) -> Lines:
    """Return phases that make the largest of m periodic signals over n samples small. `lines`: signal m is Im sum_k
    lines[m, k] exp(i (phase_k + 2 pi places_k t/n)); `multiples`: harmonics; `n`: samples; `start`: first phases.
    """
    from scipy.optimize import minimize  # deferred: 0.3 s

    phases = start
    for order in ORDERS:
        solution = minimize(
            lambda x, q: _log_norm(x, lines, multiples, n, q),
            phases,
            args=(order,),
            jac=True,
            method="L-BFGS-B",
            options={"maxiter": 40},
        )
        phases = np.asarray(solution.x)
    return phases


def _log_norm(phases: Lines, lines: Signals, multiples: Harmonics, n: int, q: int) -> tuple[float, Lines]:
    """Return log of the 2q-norm of all signals, and its gradient."""
    turned = lines * np.exp(1j * phases)
    y = periodic(turned, multiples, n)
    peak = float(np.max(np.abs(y)))
    power = (y / peak) ** (2 * q)
    total = float(np.sum(power))
    pull = np.fft.fft(power / np.where(y == 0.0, 1.0, y), axis=1)[:, multiples] / total
    return np.log(peak) + np.log(total) / (2 * q), np.sum((turned * pull.conj()).real, axis=0)


def periodic(lines: Signals, multiples: Harmonics, n: int) -> Float[np.ndarray, "m n"]:
    """Return the signals Im sum_k lines[m, k] exp(2 pi i places_k t/n) over one period of n samples."""
    bins = np.zeros((lines.shape[0], n), dtype=complex)
    bins[:, multiples] = lines
    return np.fft.ifft(bins, axis=1).imag * n
