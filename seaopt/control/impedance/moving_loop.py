r"""The sampled loop of an impedance controller on a link that moves, against an environment.

The link with its environment is an inertia on a spring and a damper, :math:`F_e = -(m \dot v + d v + k x)`, sampled
exactly behind the hold. The closed loop's matrix is affine in the gains, :math:`M = M_0 + K_v M_K + D_v M_D`, so that
maps of them are batches of eigenvalues.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Complex, Float

from seaopt.control.impedance.link import ControlledLink, Load
from seaopt.control.loops.outer_loop import POSITION, SPEED, Impedance, OuterLoop
from seaopt.control.loops.sampled_plant import hold
from seaopt.control.systems.block import REFERENCE, Block, connect, make_plant
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
    a, b, c, d = (part[0] for part in held)
    plant = make_plant(a, b, c, d, link.delay_samples)
    return _assemble(link, velocity_filter_s, replace(plant, outputs=(*plant.outputs[:-1], POSITION)))


def _assemble(link: ControlledLink, velocity_filter_s: float, plant: Block) -> MovingLoop:
    """Return the loop of a sampled plant that tells what the law reads and the position."""
    outer = link.speed_filter(velocity_filter_s)
    loop = connect([plant, link.law.block, outer.block], [REFERENCE], [POSITION, SPEED])
    drive, (position, speed) = loop.b[:, 0], loop.c
    return MovingLoop(
        fixed=loop.a,
        by_stiffness=-link.direction * np.outer(drive, position),
        by_damping=-link.direction * np.outer(drive, speed),
        reference=drive,
        position=position,
        outer=outer,
    )
