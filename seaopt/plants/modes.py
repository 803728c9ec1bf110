"""Poles, zeros, static gains and resonances of a plant at an operating point, by name."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Complex, Float

from seaopt.formatting import html_text
from seaopt.parameters import ParameterSet
from seaopt.plants.plant import Plant, state_space
from seaopt.records import record
from seaopt.signals import VectorN


@record
class Resonance:
    """A pair of complex poles.

    Parameters
    ----------
    frequency_hz : float
        Undamped natural frequency.
    damping_ratio : float
        Negative where the mode grows.
    states : tuple of str
        The states that take part, the largest first, each scaled by its participation factor.
    """

    frequency_hz: float
    damping_ratio: float
    states: tuple[str, ...]


@record(eq=False)
class Modes:
    """Poles, zeros, static gains and resonances of a linearised plant.

    Parameters
    ----------
    poles : complex array, shape (nx,)
        rad/s, slowest first.
    resonances : tuple of Resonance
        Slowest first.
    zeros : mapping of (output, input) to complex array
        Finite zeros of each transfer function, rad/s.
    dc_gain : mapping of (output, input) to float
        In the output's unit over the input's; infinite where it integrates.
    """

    poles: Complex[np.ndarray, " nx"]
    resonances: tuple[Resonance, ...]
    zeros: Mapping[tuple[str, str], Complex[np.ndarray, " _"]]
    dc_gain: Mapping[tuple[str, str], float]

    def __repr__(self) -> str:
        lines = ["Modes"]
        lines += [
            f"  resonance {mode.frequency_hz:.5g} Hz, damping ratio {mode.damping_ratio:.3g} ({', '.join(mode.states)})"
            for mode in self.resonances
        ]
        lines += [f"  real pole {pole.real:.5g} rad/s" for pole in self.poles if pole.imag == 0.0]
        for (output, source), zeros in self.zeros.items():
            zeros_hz = ", ".join(f"{abs(zero) / 2 / np.pi:.4g}" for zero in zeros if zero.imag >= 0.0) or "none"
            lines.append(f"  {output}/{source}: static gain {self.dc_gain[output, source]:.5g}, zeros at {zeros_hz} Hz")
        return "\n".join(lines)

    _repr_html_ = html_text


def modes(
    plant: Plant, params: ParameterSet, x: Mapping[str, float] | None = None, u: Mapping[str, float] | None = None
) -> Modes:
    """Return poles, zeros, static gains and resonances of a plant linearised at an operating point.

    Parameters
    ----------
    plant, params
        The plant and its parameters.
    x, u : mapping of name to float, optional
        Operating point; what is left out is zero.

    Examples
    --------
    >>> from seaopt.plants import high_impedance, thor
    >>> swinging = modes(high_impedance(), thor())
    >>> round(swinging.resonances[0].frequency_hz, 2), round(swinging.dc_gain["F1", "I"], 1)
    (7.5, 240.3)
    """
    a, b, c, d = state_space(plant, params, x, u)
    eigen: Any = np.linalg.eig(a)
    poles, right = eigen.eigenvalues.astype(complex), eigen.eigenvectors
    left = np.linalg.pinv(right)
    order = np.argsort(np.abs(poles), kind="stable")
    names = list(plant.states)
    resonances: list[Resonance] = []
    for k in order:
        if poles[k].imag > 1e-9 * abs(poles[k]):
            share = np.abs(right[:, k] * left[k])
            ranked = [names[i] for i in np.argsort(-share) if share[i] > 0.1 * share.max()]
            resonances.append(
                Resonance(
                    frequency_hz=float(abs(poles[k]) / (2 * np.pi)),
                    damping_ratio=float(-poles[k].real / abs(poles[k])),
                    states=tuple(ranked),
                )
            )
    pairs = [(i, j, output, source) for i, output in enumerate(plant.outputs) for j, source in enumerate(plant.inputs)]
    return Modes(
        poles=poles[order],
        resonances=tuple(resonances),
        zeros={(output, source): _find_zeros(a, b[:, j], c[i], float(d[i, j])) for i, j, output, source in pairs},
        dc_gain={
            (output, source): _compute_static_gain(a, b[:, j], c[i], float(d[i, j]), poles)
            for i, j, output, source in pairs
        },
    )


def _compute_static_gain(
    a: Float[np.ndarray, "n n"], b: VectorN, c: VectorN, d: float, poles: Complex[np.ndarray, " n"]
) -> float:
    """Return the limit of c (s - a)^-1 b + d at s = 0; a pole there may cancel in one transfer function only."""
    if np.linalg.cond(a) < 1e14:
        return float(d - c @ np.linalg.solve(a, b))
    moving = np.abs(poles)[np.abs(poles) > 1e-6 * np.max(np.abs(poles), initial=0.0)]
    slowest = float(moving.min()) if moving.size else 1.0
    near, nearer = (float(c @ np.linalg.solve(s * np.eye(b.size) - a, b) + d) for s in (1e-3 * slowest, 1e-4 * slowest))
    largest = max(abs(near), abs(nearer))
    if abs(nearer) > 3.0 * abs(near):
        return float(np.sign(nearer)) * np.inf
    return 0.0 if abs(nearer) < 0.3 * abs(near) or largest == 0.0 else nearer


def _find_zeros(a: Float[np.ndarray, "n n"], b: VectorN, c: VectorN, d: float) -> Complex[np.ndarray, " m"]:
    """Return the finite generalised eigenvalues of the system pencil [[A, b], [c, d]] - z diag(1, 0). The pencil is
    scaled first: forces in newtons and strains in metres stand ten decades apart.
    """
    from scipy.linalg import eig

    n = b.size
    if not np.any(b) or (not np.any(c) and d == 0.0):
        return np.zeros(0, dtype=complex)
    scale = max(float(np.max(np.abs(c))), abs(d))
    drive = float(np.max(np.abs(b))) or 1.0
    pencil = np.block([[a, b[:, None] / drive], [c[None] / scale, np.array([[d / scale / drive]])]])
    mass = np.zeros((n + 1, n + 1))
    mass[:n, :n] = np.eye(n)
    pairs: Any = eig(pencil, mass, right=False, homogeneous_eigvals=True)
    alpha, beta = pairs
    size = np.hypot(np.abs(alpha), np.abs(beta))
    finite = np.abs(beta) > 1e-10 * np.where(size > 0.0, size, 1.0) / max(1.0, float(np.max(np.abs(a))))
    zeros = (alpha[finite] / beta[finite]).astype(complex)
    bound = 1e4 * max(1.0, float(np.max(np.abs(np.linalg.eigvals(a)))))
    zeros = zeros[np.abs(zeros) < bound]
    return zeros[np.argsort(np.abs(zeros), kind="stable")]
