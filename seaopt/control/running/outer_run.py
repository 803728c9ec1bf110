r"""An impedance's outer loop and the force law behind it as one linear law, for the loop that both close.

With :math:`s` the state of the outer loop's filtered speed (`seaopt.control.loops.outer_loop`), the force law's
reference is :math:`\sigma K_v x_0 - \sigma (K_v + D_v \rho) x - \sigma D_v s`, :math:`\rho` the filter's rate. Put into
the force law it gives a law of the reference x_0 and of the link's position beside what it measures itself; without
stiffness, of a force in place of x_0, to which the damping is added.
"""

from __future__ import annotations

import numpy as np

from seaopt.control.laws.controller import Controller
from seaopt.control.loops.law import Law
from seaopt.control.loops.loop import Loop
from seaopt.control.loops.outer_loop import OuterLoop
from seaopt.control.loops.sampled_plant import sample
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant


def enclose_law(law: Law, outer: OuterLoop, place: int | None = None) -> Law:
    """Return the law of x_0, of what a force law measures and of the link's position, that both loops make. `place`:
    which of the measured signals is the link's position; it is one more, the last, where none of them is.
    """
    (n, columns), column = law.b.shape, -1 if place is None else 1 + place
    b, d = np.zeros((n + 1, columns + (place is None))), np.zeros(columns + (place is None))
    b[:n, 1:columns], d[1:columns] = law.b[:, 1:], law.d[1:]
    stiffness, damping, pole, rate = outer.numbers
    drive, through = np.append(law.b[:, 0], 0.0), law.d[0]
    b[:, column] -= (stiffness + damping * rate) * drive
    b[n, column] += (pole - 1.0) * rate
    d[column] -= (stiffness + damping * rate) * through
    b[:, 0], d[0] = outer.per_given * drive, outer.per_given * through
    a = np.block([[law.a, -damping * law.b[:, :1]], [np.zeros((1, n)), np.full((1, 1), pole)]])
    return Law(a=a, b=b, c=np.append(law.c, -damping * through), d=d, sample_time_s=law.sample_time_s)


def enclose(controller: Controller, plant: Plant) -> tuple[Law, tuple[str, ...]]:
    """Return the law of a controller, with its outer loop on a plant whose link moves, and the outputs it reads."""
    signals, outer = controller.signals, controller.outer
    if outer is None or outer.position not in plant.outputs:
        return controller.law, signals
    if outer.position in signals:
        return enclose_law(controller.law, outer, signals.index(outer.position)), signals
    return enclose_law(controller.law, outer), (*signals, outer.position)


def close(controller: Controller, plant: Plant, params: ParameterSet, enclosed: tuple[Law, tuple[str, ...]]) -> Loop:
    """Return the loop of a law in place of a controller's, which reads these outputs of a plant."""
    law, signals = enclosed
    per_effort, waits = controller.command.per_effort, controller.compute_delay_samples
    sampled = sample(controller.see(plant), controller.delay(params), signals, per_effort, law.sample_time_s, waits)
    return Loop(plant=sampled, law=law)
