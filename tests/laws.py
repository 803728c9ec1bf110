"""Laws from polynomials, and scaled, for tests that write a loop's equations themselves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from seaopt.control import Law, TransferFunction


def law_of(num, den=(1.0,), reference=None, sample_time_s=1e-3):
    """Return the law whose C_y is num/den, and whose C_r is `reference`, (num, den), or C_y."""
    measurement = TransferFunction(num=np.asarray(num, dtype=float), den=np.asarray(den, dtype=float))
    top, below = (num, den) if reference is None else reference
    ahead = TransferFunction(num=np.asarray(top, dtype=float), den=np.asarray(below, dtype=float))
    return Law.from_transfer_functions(ahead, measurement, sample_time_s)


def scaled(law, reference, measurement=None):
    """Return a law with other gains on reference and measurement."""
    factors = np.array([reference, reference if measurement is None else measurement])
    return replace(law, b=law.b * factors, d=law.d * factors)


def measurement_matrices(law):
    """Return a, b, c, d of C_y."""
    return law.a, -law.b[:, 1], law.c, -law.d[1]


def multiply_out(structure, sample_time_s, *, k_p, k_i, k_d, T_f, k_r, c=1.0):
    """Return C_r and C_y of a pd or a pid as coefficients in powers of 1/z, by the definition."""
    lag, difference = np.array([1.0, -T_f / (T_f + sample_time_s)]), np.array([1.0, -1.0])
    integrator = difference if structure == "pid" else np.ones(1)
    den = np.convolve(integrator, lag)
    rate = k_d / (T_f + sample_time_s) * np.convolve(integrator, difference)
    whole = k_i * sample_time_s / 2 * np.convolve([1.0, 1.0], lag) if structure == "pid" else 0.0 * den
    num_r, num_y = (np.asarray(gain * den + weight * rate + whole) for gain, weight in ((k_r, c), (k_p, 1.0)))
    return TransferFunction(num=num_r, den=den), TransferFunction(num=num_y, den=den)
