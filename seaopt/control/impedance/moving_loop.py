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
from seaopt.control.loops.sampled_plant import sample_matrices
from seaopt.control.systems.block import REFERENCE, Block, connect
from seaopt.records import record


@record(eq=False)
class MovingLoop:
    """A force loop from its reference to the position and the filtered speed of its link; an outer loop closes it."""

    block: Block
    outer: OuterLoop  # the filter of the speed

    def matrix(self, stiffness: Any, damping: Any) -> Float[np.ndarray, "... n n"]:
        """Return the closed loop's matrix, of arrays of gains as a stack."""
        k, d = (np.asarray(gain, dtype=float)[..., None, None] for gain in (stiffness, damping))
        by_stiffness, by_damping = (-self.outer.direction * self.block.b * row for row in self.block.c)
        return self.block.a + k * by_stiffness + d * by_damping

    def eigenvalues(self, stiffness: Any, damping: Any) -> Complex[np.ndarray, "... n"]:
        """Return the closed loop's eigenvalues."""
        return np.linalg.eigvals(self.matrix(stiffness, damping)).astype(complex)

    def radius(self, stiffness: Any, damping: Any) -> Any:
        """Return the largest magnitude of the closed loop's eigenvalues."""
        return np.max(np.abs(self.eigenvalues(stiffness, damping)), axis=-1)

    def step(self, impedance: Impedance, samples: int) -> Float[np.ndarray, " samples"]:
        """Return the link's position, sample by sample, after a unit step of x_0."""
        a, drive = self._driven(impedance)
        x, path, position = np.zeros(drive.size), np.empty(samples), self.block.c[0]
        for k in range(samples):
            path[k] = position @ x
            x = a @ x + drive
        return path

    def end(self, impedance: Impedance) -> float:
        """Return the link's position long after a unit step of x_0."""
        a, drive = self._driven(impedance)
        return float(self.block.c[0] @ np.linalg.solve(np.eye(drive.size) - a, drive))

    def _driven(self, impedance: Impedance) -> tuple[Float[np.ndarray, "n n"], Float[np.ndarray, " n"]]:
        drive = self.block.b[:, 0] * (self.outer.direction * impedance.stiffness)
        return self.matrix(impedance.stiffness, impedance.damping), drive


def close_link(link: ControlledLink, velocity_filter_s: float, load: Load | None = None) -> MovingLoop:
    """Return the loop of a link with an outer loop against `load`, which includes the link; the link alone if None."""
    load = link.load if load is None else load
    port = link.port
    # F_e = -(m - m_0) v' - d v - k x, m_0 being the probe's inertia, and v' = a x + b u + force F_e.
    share = 1.0 / (1.0 + (load.inertia - port.mass) * port.force[port.speed])
    taken = -share * ((load.inertia - port.mass) * port.a[port.speed])
    taken[port.speed] -= share * load.damping
    taken[port.position] -= share * load.stiffness
    pushed = -share * (load.inertia - port.mass) * port.motor[port.speed]
    a, b, c, d = port.load(taken, pushed)
    rows, direct = np.vstack([c, np.eye(1, port.motor.size, k=port.position)]), np.append(d, 0.0)
    plant = sample_matrices((a, b, rows, direct), port.delay_s, link.sample_time_s, link.delay_samples).block
    plant, outer = replace(plant, outputs=(*plant.outputs[:-1], POSITION)), link.speed_filter(velocity_filter_s)
    blocks = [plant, link.law.block, outer.filter_speed()]
    return MovingLoop(block=connect(blocks, [REFERENCE], [POSITION, SPEED]), outer=outer)
