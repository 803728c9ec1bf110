r"""The sampled loop of an impedance controller on a link that moves, against an environment.

The link with its environment is an inertia on a spring and a damper, :math:`F_e = -(m \dot v + d v + k x)`, sampled
exactly behind the hold. The closed loop's matrix is affine in the gains, :math:`M = M_0 + K_v M_K + D_v M_D`, so that
maps of them are batches of eigenvalues.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Complex, Float

from seaopt.control.impedance.link import ControlledLink, Load
from seaopt.control.loops.outer_loop import Impedance, OuterLoop
from seaopt.control.loops.sampled_plant import hold
from seaopt.records import record

Matrix = Float[np.ndarray, "_ _"]
Vector = Float[np.ndarray, " _"]


@record(eq=False)
class MovingLoop:
    """x+ = (fixed + K_v by_stiffness + D_v by_damping) x + reference K_v x_0, link position = position x."""

    fixed: Matrix
    by_stiffness: Matrix
    by_damping: Matrix
    reference: Vector  # the effect of the force law's reference
    position: Vector  # the link's position
    outer: OuterLoop  # the filter of the speed

    def matrix(self, stiffness: Any, damping: Any) -> Float[np.ndarray, "... n n"]:
        """Return the closed loop's matrix, of arrays of gains as a stack."""
        k, d = np.asarray(stiffness, dtype=float), np.asarray(damping, dtype=float)
        return self.fixed + k[..., None, None] * self.by_stiffness + d[..., None, None] * self.by_damping

    def eigenvalues(self, stiffness: Any, damping: Any) -> Complex[np.ndarray, "... n"]:
        """Return the closed loop's eigenvalues."""
        return np.linalg.eigvals(self.matrix(stiffness, damping)).astype(complex)

    def radius(self, stiffness: Any, damping: Any) -> Any:
        """Return the largest magnitude of the closed loop's eigenvalues."""
        return np.max(np.abs(self.eigenvalues(stiffness, damping)), axis=-1)

    def step(self, impedance: Impedance, samples: int) -> Float[np.ndarray, " samples"]:
        """Return the link's position, sample by sample, after a unit step of x_0."""
        a, drive = self._driven(impedance)
        x, path = np.zeros(drive.size), np.empty(samples)
        for k in range(samples):
            path[k] = self.position @ x
            x = a @ x + drive
        return path

    def end(self, impedance: Impedance) -> float:
        """Return the link's position long after a unit step of x_0."""
        a, drive = self._driven(impedance)
        return float(self.position @ np.linalg.solve(np.eye(drive.size) - a, drive))

    def _driven(self, impedance: Impedance) -> tuple[Matrix, Vector]:
        drive = self.reference * (self.outer.direction * impedance.stiffness)
        return self.matrix(impedance.stiffness, impedance.damping), drive


def close_link(link: ControlledLink, velocity_filter_s: float, load: Load | None = None) -> MovingLoop:
    """Return the loop of a link with an outer loop against `load`, which includes the link; the link alone if None."""
    load = link.load if load is None else load
    port, period = link.port, link.sample_time_s
    n = port.motor.size
    # F_e = -(m - m_0) v' - d v - k x, m_0 being the probe's inertia, and v' = a x + b u + force F_e.
    share = 1.0 / (1.0 + (load.inertia - port.mass) * port.force[port.speed])
    taken = -share * ((load.inertia - port.mass) * port.a[port.speed])
    taken[port.speed] -= share * load.damping
    taken[port.place] -= share * load.stiffness
    pushed = -share * (load.inertia - port.mass) * port.motor[port.speed]
    a, b = port.a + np.outer(port.force, taken), port.motor + port.force * pushed
    read = port.read
    c = read[:, :n] + np.outer(read[:, n + 1], taken)
    d = read[:, n] + read[:, n + 1] * pushed
    position = np.zeros(n)
    position[port.place] = 1.0
    rows, direct = np.vstack([c, position]), np.append(d, 0.0)
    held = hold(a[None], b[None], rows[None], direct[None], period, np.array([port.delay_s]))
    plant = tuple(part[0] for part in held)
    for _ in range(link.delay_samples):
        plant = _wait(*plant)
    return _assemble(link, velocity_filter_s, *plant)


def _wait(a: Matrix, b: Vector, c: Matrix, d: Vector) -> tuple[Matrix, Vector, Matrix, Vector]:
    """Return a sampled plant whose input acts one sample later."""
    a = np.block([[a, b[:, None]], [np.zeros((1, b.size + 1))]])
    return a, np.append(np.zeros(b.size), 1.0), np.column_stack([c, d]), np.zeros_like(d)


def _assemble(
    link: ControlledLink, velocity_filter_s: float, a: Matrix, b: Vector, rows: Matrix, direct: Vector
) -> MovingLoop:
    """Return the loop of a sampled plant, whose rows are what the law reads and the position."""
    law, n, through = link.law, b.size, direct[:-1]
    outer = link.speed_filter(velocity_filter_s)
    size = n + law.c.size + 1
    inner, speed = slice(n, size - 1), size - 1
    # Over the states (plant, law, filter of the speed): effort, readings, position.
    effort, read, position = np.zeros(size), np.zeros((through.size, size)), np.zeros(size)
    effort[inner], read[:, :n], position[:n] = law.c, rows[:-1], rows[-1]
    gain = 1.0 / (1.0 - law.d[1:] @ through)
    effort = gain * (effort + law.d[1:] @ read)
    read = read + np.outer(through, effort)
    per_reference = gain * law.d[0]  # of the effort
    matrix, drive = np.zeros((size, size)), np.zeros(size)
    matrix[:n, :n] = a
    matrix[:n] += np.outer(b, effort)
    drive[:n] = b * per_reference
    matrix[inner, inner] = law.a
    matrix[inner] += law.b[:, 1:] @ read
    drive[inner] = law.b[:, 0] + law.b[:, 1:] @ (through * per_reference)
    filtered = outer.rate * position
    filtered[speed] += 1.0
    matrix[speed] = outer.pole * filtered - outer.rate * position
    return MovingLoop(
        fixed=matrix,
        by_stiffness=-link.direction * np.outer(drive, position),
        by_damping=-link.direction * np.outer(drive, filtered),
        reference=drive,
        position=position,
        outer=outer,
    )
