r"""Bounds of a plant's outputs and states over the horizon: rows of the quadratic program, softened exactly.

With :math:`\xi`, :math:`\mu` counted from the target (see `prediction`), a bounded signal of the sampled plant is

.. math:: y_{ij} = g_i (u_s + \hat d) + c_i \xi_j + d_i \mu_j, \qquad
          \xi_j = A^j \xi_0 + \sum_{l<j} A^{j-1-l} (b\, W_l + b'\, W_{l-1})\, \theta

with g its static gain. It is held within :math:`[l_i, h_i]` at some samples j of the horizon, close together where it
begins: what comes between two of them comes to a closer one as the horizon moves. Over half the width of the bounds,

.. math:: y_{ij} - s_i \le h_i, \qquad y_{ij} + s_i \ge l_i, \qquad s_i \ge 0, \qquad
          J + \omega \sum_i s_i + \tfrac{\epsilon}{2} \sum_i s_i^2

so that the program has a solution whatever the state: no command can undo a speed that is there already. The penalty is
exact (Kerrigan and Maciejowski, UKACC Control 2000): where :math:`\omega` is above the sum of a signal's multipliers,
its slack is zero as long as a plan without it exists.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

from seaopt.control.mpc.estimator import Estimator
from seaopt.control.mpc.force_plant import ForcePlant, spread_knots
from seaopt.errors import ControlError, suggestion
from seaopt.records import record
from seaopt.signals import VectorK

BOUND_SAMPLES = 12  # of the horizon at which a bounded signal is held
SLACK_UNIT = 0.1  # of a slack, in half widths: the solver's tolerance grows with the penalty of one unit


@record(eq=False)
class OutputBounds:
    """Bounded signals over the horizon, each in units of half the width of its bounds."""

    names: tuple[str, ...]  # outputs and states of the plant
    middle: VectorK  # middle, half: centre and half width of the bounds, in the signals' units
    half: VectorK
    static: VectorK  # value at rest per unit of command, over `half`
    # from the state's distance to its target, and the last command's, to the signal at m samples, signal by signal
    free: Float[np.ndarray, "km nx1"]
    forced: Float[np.ndarray, "km n"]  # the same of the knots, in units of the limit of the command

    @property
    def samples(self) -> int:
        """At how many samples of the horizon each signal is held."""
        return len(self.free) // len(self.names) if self.names else 0

    def rows(self) -> Float[np.ndarray, "r nv"]:
        """Return the rows of the program, over knots and slacks: upper ends, lower ends, slacks."""
        k, n = len(self.names), self.forced.shape[1]
        slack = SLACK_UNIT * np.repeat(np.eye(k), self.samples, axis=0)  # one column per signal
        return np.block([[self.forced, -slack], [self.forced, slack], [np.zeros((k, n)), np.eye(k)]])

    def limits(
        self, start: Float[np.ndarray, " nx1"], at_rest: float, wide: float
    ) -> tuple[Float[np.ndarray, " r"], Float[np.ndarray, " r"]]:
        """Return lower and upper ends of these rows. `start`: the state's distance from its target, and the last
        command's. `at_rest`: the command that reaches the plant at rest, with its disturbance.
        """
        k = len(self.names)
        base = np.repeat(self.static * at_rest - self.middle / self.half, self.samples) + self.free @ start
        none = np.full(base.size, wide)
        return (np.concatenate([-none, -1.0 - base, np.zeros(k)]), np.concatenate([1.0 - base, none, np.full(k, wide)]))

    def admissible_rest(self, drift: float, least: float, most: float) -> tuple[float, float]:
        """Return the commands at rest, least and largest, that keep the bounds; within the ends of the command. Where
        no command keeps them all, it is the one that breaks them least.
        """
        if not self.names:
            return least, most
        moves = np.abs(self.static) > 0.0
        ends = (self.middle[moves] / self.half[moves] + np.array([[-1.0], [1.0]])) / self.static[moves] - drift
        low = float(np.clip(np.max(np.min(ends, axis=0), initial=least), least, most))
        high = float(np.clip(np.min(np.max(ends, axis=0), initial=most), least, most))
        middle = 0.5 * (low + high)
        return (low, high) if low <= high else (middle, middle)


def bound_outputs(
    bounds: Mapping[str, tuple[float, float]],
    kalman: Estimator,
    plant: ForcePlant,
    W: Float[np.ndarray, "samples n"],
    limit: float,
) -> OutputBounds:
    """Return the rows of bounds by name. `bounds`: of outputs and states of the plant, deflection and rate of its
    spring, in their units. `W`: from the knots to the command at each sample of the horizon. `limit`: of the command,
    the unit of the knots. Raises ControlError: a name is not one of the estimates.
    """
    nx, N = plant.b.size, len(W)
    available = [name for name, row in zip(kalman.names, kalman.G, strict=True) if np.any(row[:nx])]
    for name in bounds:
        if name not in available:
            raise ControlError(
                f'bounds of "{name}": not an output or state of {kalman.plant.name}; {suggestion(name, available)}'
            )
    rows = [kalman.names.index(name) for name in bounds]
    C, D = kalman.G[rows][:, :nx], kalman.H[rows, 0]
    direct = (D != 0.0)[:, None]
    ends = np.array(list(bounds.values()), dtype=float).reshape(-1, 2)
    half = 0.5 * (ends[:, 1] - ends[:, 0])
    states, at = list(plant.respond(N)), np.unique(spread_knots(N, min(BOUND_SAMPLES, N))).tolist()
    # A signal that the command reaches at once is held at j, with mu_j; another one sample later.
    free = [np.where(direct, C @ states[j][0], C @ states[j + 1][0]) for j in at]
    forced = [np.where(direct, C @ states[j][1] + np.outer(D, np.eye(N)[j]), C @ states[j + 1][1]) @ W for j in at]
    return OutputBounds(
        names=tuple(bounds),
        middle=ends.mean(axis=1),
        half=half,
        static=(C @ plant.rest_state + D) / half,
        free=(np.stack(free, axis=1) / half[:, None, None]).reshape(-1, nx + 1),
        forced=(limit * np.stack(forced, axis=1) / half[:, None, None]).reshape(-1, W.shape[1]),
    )
