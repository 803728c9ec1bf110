r"""Second-order form of a measured frequency response, and the parameters that the source paper extracts from it.

Orekhov et al. (IROS 2015) fit the H1 estimate of F1/F_m on the stand with

.. math:: \frac{K}{s^2 + a s + b} = \frac{2166}{s^2 + 39.53 s + 2279} \qquad (16)

and read it as :math:`k/(m_k s^2 + b_m s + k)`, equation (13), with k known: :math:`k/m_k` is the mean of K and b, and
:math:`b_m = a m_k`. K/b is the static gain, 0.950 there: an efficiency that the mean throws away. With
:math:`k/m_k = b` it is kept, as eta.

The fit is least squares on the complex response, each frequency weighted by the estimate's variance. The model is
sampled as the log was: input held or a straight line between samples, and delayed. It starts from iterated linear least
squares (Levy, IRE Trans. AC-4, 1959; Sanathanan and Koerner, IEEE TAC 8(1), 1963), so that no guess is needed.

Neighbouring lines of a Hann-windowed estimate are correlated, 4/9 one line apart and 1/36 two: a parameter that
averages over lines has 1 + 2 (4/9 + 1/36) = 35/18 of the variance that independent lines would give.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache, lru_cache
from typing import Any

import numpy as np
from jaxtyping import Bool, Complex, Float, Int

from seaopt.codec import OrNaN
from seaopt.errors import LogError
from seaopt.frequency.response import ComplexLines, FrequencyResponse, Lines
from seaopt.frequency.sampled import sampled_response
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.records import record
from seaopt.simulation import Clock, Model, make_model
from seaopt.units import LINEAR, Mechanics

MIN_COHERENCE = 0.8  # lines of less coherence are not fitted
MIN_LINES = 8  # the fewest lines that a fit is made of
HANN_LINES = 35.0 / 18.0
LEVY_STEPS = 20  # of the linear iteration
DELAYS = 41  # tried when the delay is unknown, half a sample apart


@record
class Uncertain:
    """A figure with its standard deviation."""

    value: OrNaN
    std: OrNaN
    unit: str

    def __str__(self) -> str:
        return f"{self.value:.5g} ± {self.std:.2g} {self.unit}".rstrip(" -")


@record
class DriveEstimate:
    """Parameters that a second-order form implies for an actuator with both links fixed and k known.

    Parameters
    ----------
    m_k, b_m : Uncertain
        Sprung mass (kg) and damping (N s/m) with k/m_k = b; of a rotary one inertia (kg m^2) and N m s/rad.
    efficiency : Uncertain
        Static gain of F1/F_m, eta.
    m_k_averaged, b_m_averaged : Uncertain
        The paper's: k/m_k is the mean of K and b, which assumes a static gain of 1.
    K : Uncertain
        Of F1/F_m, as printed in (16).
    """

    m_k: Uncertain
    b_m: Uncertain
    efficiency: Uncertain
    m_k_averaged: Uncertain
    b_m_averaged: Uncertain
    K: Uncertain


@record(eq=False)
class SecondOrder:
    """K/(s^2 + a s + b) with a delay, fitted to a frequency response.

    Parameters
    ----------
    values : array, shape (4,)
        K (output unit over input unit times 1/s^2), a (1/s), b (1/s^2), delay (s).
    covariance : array, shape (4, 4)
        Of `values`; zero for a delay that was given.
    clock : Clock
        Period, hold and delay of the log.
    unit : str
        Output unit over input unit.
    band_hz : (low, high)
        The first and last frequency that was fitted.
    lines : int
        Frequencies fitted.
    misfit : float
        Root mean square of the residual in standard deviations of the estimate: 1 where the form explains the log.
    """

    json_keys = (
        *("K", "a", "b", "delay_s", "static_gain", "natural_frequency_hz", "damping_ratio"),
        *("band_hz", "lines", "misfit", "values", "covariance", "clock", "unit"),
    )

    values: Float[np.ndarray, "4"]
    covariance: Float[np.ndarray, "4 4"]
    clock: Clock
    unit: str
    band_hz: tuple[float, float]
    lines: int
    misfit: float

    @property
    def K(self) -> Uncertain:
        """Numerator, output unit over input unit times 1/s^2."""
        return self._figure(lambda v: v[0], f"{self.unit}/s^2")

    @property
    def a(self) -> Uncertain:
        """Damping, 1/s."""
        return self._figure(lambda v: v[1], "1/s")

    @property
    def b(self) -> Uncertain:
        """Square of the natural frequency, 1/s^2."""
        return self._figure(lambda v: v[2], "1/s^2")

    @property
    def delay_s(self) -> Uncertain:
        """Delay of the input besides the hold, s."""
        return self._figure(lambda v: v[3], "s")

    @property
    def static_gain(self) -> Uncertain:
        """K/b, output unit over input unit."""
        return self._figure(lambda v: v[0] / v[2], self.unit)

    @property
    def natural_frequency_hz(self) -> Uncertain:
        """Undamped natural frequency; NaN where b is negative."""
        return self._figure(lambda v: np.sqrt(v[2]) / (2 * np.pi) if v[2] > 0.0 else np.nan, "Hz")

    @property
    def damping_ratio(self) -> Uncertain:
        """Damping ratio a/(2 sqrt(b)); NaN where b is negative."""
        return self._figure(lambda v: v[1] / (2 * np.sqrt(v[2])) if v[2] > 0.0 else np.nan, "-")

    def response(self, f: Lines) -> ComplexLines:
        """Return the response from input samples to output samples at frequencies in Hz."""
        return sampled_response(_form(), self.values[:3], self.clock, f)[0][:, 0]

    def drive(self, k: float, force_per_input: float, k_std: float = 0.0, called: Mechanics = LINEAR) -> DriveEstimate:
        """Return the actuator's parameters that the form implies.

        Parameters
        ----------
        k, k_std : float
            Stiffness and its standard deviation, N/m.
        force_per_input : float
            Motor force over input, K_tau/r in N/A by (3); 1 where the input is the force.
        called : Mechanics
            The actuator's units.

        Examples
        --------
        Equation (16) itself, with the paper's k:

        >>> printed = SecondOrder(values=np.array([2166, 39.53, 2279, 0]), covariance=np.zeros((4, 4)),
        ...     clock=Clock(period=1 / 400), unit="N/N", band_hz=(0.1, 60), lines=600, misfit=1)
        >>> drive = printed.drive(655000, 1.0)
        >>> round(drive.m_k_averaged.value, 1), round(drive.b_m_averaged.value), round(drive.efficiency.value, 3)
        (294.7, 11650, 0.95)
        """
        whole = np.zeros((5, 5))
        whole[:4, :4], whole[4, 4] = self.covariance, k_std**2
        point = np.append(self.values, k)

        def figure(of: Callable[[Any], Any], unit: str) -> Uncertain:
            return _propagate(of, point, whole, unit)

        return DriveEstimate(
            m_k=figure(lambda v: v[4] / v[2], called.inertia),
            b_m=figure(lambda v: v[1] * v[4] / v[2], called.damping),
            efficiency=figure(lambda v: v[0] / force_per_input / v[2], "-"),
            m_k_averaged=figure(lambda v: 2 * v[4] / (v[0] / force_per_input + v[2]), called.inertia),
            b_m_averaged=figure(lambda v: 2 * v[1] * v[4] / (v[0] / force_per_input + v[2]), called.damping),
            K=figure(lambda v: v[0] / force_per_input, "1/s^2"),
        )

    def _figure(self, of: Callable[[Any], Any], unit: str) -> Uncertain:
        return _propagate(of, self.values, self.covariance, unit)

    def __repr__(self) -> str:
        return (
            f"SecondOrder {self.K.value:.5g}/(s^2 + {self.a.value:.4g} s + {self.b.value:.5g}) {self.unit}\n"
            f"  K = {self.K}, a = {self.a}, b = {self.b}\n"
            f"  static gain {self.static_gain}, natural frequency {self.natural_frequency_hz}, "
            f"damping ratio {self.damping_ratio}\n"
            f"  {self.lines} lines from {self.band_hz[0]:.3g} to {self.band_hz[1]:.3g} Hz, misfit {self.misfit:.3g} std"
        )


def second_order(
    estimate: FrequencyResponse, clock: Clock, *, unit: str = "-", use: Bool[np.ndarray, " m"] | None = None
) -> SecondOrder:
    """Fit K/(s^2 + a s + b) to an H1 estimate, without a guess.

    Parameters
    ----------
    estimate : FrequencyResponse
        From `h1`.
    clock : Clock
        The log's period and hold and the input's delay; the delay is estimated too where ``clock.delay_free``.
    unit : str
        Output unit over input unit.
    use : bool array, shape (m,), optional
        The frequencies to fit; all coherent ones if left out, see `coherent_lines`.

    Returns
    -------
    SecondOrder
        Standard deviations come from the estimate's variance, enlarged by the misfit where that is above 1.

    Raises
    ------
    LogError
        Fewer than 8 frequencies are coherent.

    Examples
    --------
    >>> import seaopt as so
    >>> from seaopt.bench import PAPER_STAND
    >>> plant, truth = so.plants.high_impedance(), so.plants.thor()
    >>> log = so.virtual_log(plant, truth, PAPER_STAND, duration_s=20, rate_hz=400, seed=1,
    ...                      sensors=so.Sensors(noise_std={"F1": 2.0}))
    >>> form = second_order(so.h1(log["I"], log["F1"], log.period), Clock(period=log.period), unit="N/A")
    >>> abs(form.b.value - 655000 / 295.2) < 3 * form.b.std
    True
    """
    chosen = np.flatnonzero(coherent_lines(estimate) if use is None else use)
    if chosen.size < MIN_LINES:
        raise LogError(
            f"{chosen.size} frequencies have a coherence above {MIN_COHERENCE:g} and a second-order fit takes "
            f"{MIN_LINES}; excite more, or use a longer log"
        )
    f, measured = estimate.frequency_hz[chosen], estimate.response[chosen]
    sigma = np.maximum(estimate.relative_std[chosen], 1e-9) * np.abs(measured)
    start = _start(f, measured, sigma, clock)
    values, slopes, residual = _refine(estimate, chosen, sigma, clock, start)
    count = slopes.shape[1]
    misfit = float(np.sqrt(residual @ residual / max(residual.size - count, 1)))
    covariance = np.zeros((4, 4))
    covariance[:count, :count] = _invert(slopes.T @ slopes) * HANN_LINES * max(1.0, misfit) ** 2
    return SecondOrder(
        values=values,
        covariance=covariance,
        clock=replace(clock, delay_s=float(values[3]), delay_free=False),
        unit=unit,
        band_hz=(float(f[0]), float(f[-1])),
        lines=int(f.size),
        misfit=misfit,
    )


def coherent_lines(estimate: FrequencyResponse) -> Bool[np.ndarray, " m"]:
    """Return which lines have a coherence above 0.8; never the first, beside the mean that windows are rid of."""
    lines = estimate.coherence > MIN_COHERENCE
    lines[0] = False
    return lines


@cache
def _form() -> Model:
    """Return K/(s^2 + a s + b) as a plant: exact sampling and its derivatives come with it."""
    plant = Plant(
        name="second order",
        states={"w": "m", "wd": "m/s"},
        inputs={"u": "m/s^2"},
        outputs={"y": "m"},
        parameters={"K": "-", "a": "-", "b": "-"},
        f=lambda t, x, u, p: {"w": x.wd, "wd": u.u - p.a * x.wd - p.b * x.w},
        h=lambda t, x, u, p: {"y": p.K * x.w},
    )
    return make_model(plant, ParameterSet.of(K=(1.0, "-"), a=(1.0, "-"), b=(1.0, "-")), ("K", "a", "b"))


def _start(f: Lines, measured: ComplexLines, sigma: Lines, clock: Clock) -> Float[np.ndarray, "4"]:
    """Return K, a, b and the delay by linear least squares; the best of several delays where it is unknown."""
    s = 2j * np.pi * f
    delays = clock.delay_s + (0.5 * clock.period * np.arange(DELAYS) if clock.delay_free else np.zeros(1))
    hold = np.sinc(f * clock.period) * np.exp(-0.5 * s * clock.period)
    if clock.hold == "first":
        hold = np.sinc(f * clock.period) ** 2 + 0j
    forms = [(*_fit_linear(s, measured, sigma, hold * np.exp(-s * delay)), float(delay)) for delay in delays]
    _, form, delay = min(forms, key=lambda candidate: candidate[0])
    return np.append(form, delay)


def _fit_linear(
    s: ComplexLines, measured: ComplexLines, sigma: Lines, hold: ComplexLines
) -> tuple[float, Float[np.ndarray, "3"]]:
    """Return the cost and K, a, b of the best step of K - a s G - b G = s^2 G, weighted by the step before it."""
    g, scatter = measured / hold, sigma / np.abs(hold)
    scale = float(np.sqrt(np.abs(s[0]) * np.abs(s[-1])))
    p = s / scale
    denominator = p**2 + p + 1.0
    best: tuple[float, Float[np.ndarray, "3"]] = (np.inf, np.array([np.abs(g[0]), 1.0, 1.0]))
    for _ in range(LEVY_STEPS):
        weight = 1.0 / (scatter * np.abs(denominator))
        columns = np.stack([np.ones_like(p), -p * g, -g], axis=1) * weight[:, None]
        form, *_ = np.linalg.lstsq(_stack(columns), _stack(p**2 * g * weight), rcond=None)
        denominator = p**2 + form[1] * p + form[2]
        residual = (form[0] / denominator - g) / scatter
        cost = float(np.vdot(residual, residual).real)
        if cost < best[0]:
            best = (cost, form)
    return best[0], best[1] * np.array([scale**2, scale, scale**2])


def _stack(values: Complex[np.ndarray, "m ..."]) -> Float[np.ndarray, "n ..."]:
    """Return real parts above imaginary parts."""
    return np.concatenate([np.real(values), np.imag(values)])


def _refine(
    estimate: FrequencyResponse,
    chosen: Int[np.ndarray, " m"],
    sigma: Lines,
    clock: Clock,
    start: Float[np.ndarray, "4"],
) -> tuple[Float[np.ndarray, "4"], Float[np.ndarray, "n c"], Float[np.ndarray, " n"]]:
    """Return the least-squares values, and derivatives and residuals there, in standard deviations."""
    from scipy.optimize import least_squares  # deferred: 0.3 s

    solve: Any = least_squares
    count = 4 if clock.delay_free else 3

    @lru_cache(maxsize=1)
    def evaluate(*x: float) -> Complex[np.ndarray, "m n"]:
        """Return residuals and derivatives, in standard deviations; the solver takes them one after the other."""
        moved = replace(clock, delay_s=x[3]) if clock.delay_free else clock

        def both(f: Lines) -> Complex[np.ndarray, "m n"]:
            response, slopes = sampled_response(_form(), np.array(x[:3]), moved, f)
            return np.column_stack([response[:, 0], slopes[:, :, 0].T])

        columns = estimate.expected(both)[chosen]
        columns[:, 0] -= estimate.response[chosen]
        return columns / sigma[:, None]

    size = np.append(np.abs(start[:3]), clock.period)[:count]
    low = np.append(np.full(3, -np.inf), 0.0)[:count]
    solution = solve(
        lambda x: _stack(evaluate(*x.tolist())[:, 0]),
        start[:count],
        jac=lambda x: _stack(evaluate(*x.tolist())[:, 1:]),
        bounds=(low, np.inf),
        x_scale=np.maximum(size, 1e-300),
        method="trf",
        xtol=1e-9,
        ftol=1e-9,
        gtol=1e-9,
    )
    values = np.append(start[:3], clock.delay_s)
    values[:count] = solution.x
    return values, np.asarray(solution.jac), np.asarray(solution.fun)


def _invert(information: Float[np.ndarray, "c c"]) -> Float[np.ndarray, "c c"]:
    """Return the inverse of an information matrix, scaled to a unit diagonal first."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(information), 1e-300))
    return np.linalg.pinv(information * np.outer(scale, scale), hermitian=True) * np.outer(scale, scale)


def _propagate(
    of: Callable[[Any], Any], point: Float[np.ndarray, " n"], covariance: Float[np.ndarray, "n n"], unit: str
) -> Uncertain:
    """Return a function of uncertain values, its variance by central differences."""
    step = 1e-6 * np.maximum(np.abs(point), 1e-12)
    slope = np.array([(of(point + d) - of(point - d)) / (2 * d.max()) for d in np.diag(step)])
    return Uncertain(value=float(of(point)), std=float(np.sqrt(max(slope @ covariance @ slope, 0.0))), unit=unit)
