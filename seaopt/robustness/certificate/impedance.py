"""What is certified of an impedance that a controller renders at the link of one of its plants."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from seaopt.control import Controller, ImpedanceRegion, Rendering, passive_region, render
from seaopt.errors import ControlError, suggestion
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.records import record


@record(eq=False)
class CertifiedImpedance:
    """An impedance at a link, as it is rendered, and what could be.

    Parameters
    ----------
    plant : str
        Whose link it is.
    rendering : Rendering
        The pair that is asked for.
    region : ImpedanceRegion
        Every pair with the same filter.

    """

    plant: str
    rendering: Rendering
    region: ImpedanceRegion

    def to_dict(self) -> dict[str, Any]:
        """Return both, for robustness.json."""
        return {"plant": self.plant} | self.rendering.to_dict() | {"region": self.region.to_dict()}

    def lines(self) -> list[str]:
        """Return the findings, one line each."""
        asked, called = self.rendering.impedance, self.rendering.called
        head = f"{asked.stiffness:.4g} {called.stiffness} and {asked.damping:.4g} {called.damping} at the link of "
        return [f"{head}{self.plant}: {'; '.join(self.rendering.describe())}", *self.region.describe()]


def certify_impedance(
    controller: Controller, models: Mapping[str, Plant], parameters: ParameterSet
) -> CertifiedImpedance | None:
    """Measure the impedance of a controller's outer loop at the nominal parameters; None where it has none.

    Raises
    ------
    ControlError
        The plant that the outer loop names is not among the models, or no model has a link that moves.

    """
    outer = controller.outer
    if outer is None:
        return None
    moving = [name for name, plant in models.items() if plant.port is not None and plant.port.motion is not None]
    name = outer.plant or next(iter(moving), "")
    if name not in moving:
        raise ControlError(
            f'the impedance is rendered at the link of plant "{name}", which is not one of the certified plants whose '
            f"link moves; {suggestion(name, moving)}"
        )
    impedance = outer.impedance
    return CertifiedImpedance(
        plant=name, rendering=render(controller, models[name], parameters, impedance),
        region=passive_region(
            controller, models[name], parameters, velocity_filter_s=impedance.velocity_filter_s
        ),
    )  # fmt: skip
