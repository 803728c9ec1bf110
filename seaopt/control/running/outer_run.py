r"""An impedance's outer loop and the force law behind it as one law, so that what runs a law runs both.

With :math:`s` the state of the outer loop's filtered speed (`seaopt.control.loops.outer_loop`), the force law's
reference is :math:`\sigma K_v x_0 - \sigma (K_v + D_v \rho) x - \sigma D_v s`, :math:`\rho` the filter's rate. Put into
the force law it gives a law of the reference x_0 and of the link's position beside what it measures itself. The
integrators, the limit of the command and its anti-windup are the force law's.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from seaopt.control.laws.controller import Controller
from seaopt.control.laws.realisation import RunnableLaw, runnable
from seaopt.control.loops.outer_loop import OuterLoop


def enclose_law(law: RunnableLaw, outer: OuterLoop, place: int | None = None) -> RunnableLaw:
    """Return the law of x_0, of what a force law measures and of the link's position, that both loops make. `law`: of
    one measured signal or several. `place`: which of the measured signals is the link's position; it is one more, the
    last, where none of them is.
    """
    n = law.c.size
    by_position = outer.direction * (outer.stiffness + outer.damping * outer.rate)
    by_speed = -outer.direction * outer.damping
    a = np.zeros((n + 1, n + 1))
    a[:n, :n], a[:n, n], a[n, n] = law.a, law.b_reference * by_speed, outer.pole
    at, read = (law.measured, law.measured + 1) if place is None else (place, law.measured)
    measured, direct = np.zeros((n + 1, read)), np.zeros(read)
    measured[:n, : law.measured], direct[: law.measured] = law.b_measurement.reshape(n, law.measured), law.d_measurement
    measured[:n, at] += law.b_reference * by_position
    measured[n, at] = (1.0 - outer.pole) * outer.rate
    direct[at] += law.d_reference * by_position
    by_reference = outer.direction * outer.stiffness
    added = law.compensation
    if added is not None and added.gravity is not None:  # of the force law's reference: here it moves x_0
        added = replace(added, gravity=added.gravity.scaled(1.0 / by_reference))
    return replace(
        law,
        a=a,
        b_measurement=measured,
        c=np.append(law.c, law.d_reference * by_speed),
        b_reference=np.append(law.b_reference * by_reference, 0.0),
        d_reference=law.d_reference * by_reference,
        d_measurement=direct,
        anti_windup=np.append(law.anti_windup, 0.0),
        compensation=added,
    )


def enclose_controller(controller: Controller, position: str) -> tuple[RunnableLaw, tuple[str, ...]]:
    """Return the law of a controller with its outer loop, and the outputs that it reads. `controller`: with an outer
    loop; its law may read the link's position itself. `position`: the output that is the link's position.
    """
    assert controller.outer is not None
    signals = controller.signals
    place = signals.index(position) if position in signals else None
    law = enclose_law(runnable(controller), controller.outer, place)
    return law, signals if place is not None else (*signals, position)
