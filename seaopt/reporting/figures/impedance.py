"""The map of stiffness and damping that may be rendered at the link."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from seaopt.control import Impedance, ImpedanceRegion
from seaopt.reporting.figures.panel import BLUE, GREEN, LIMIT, SKY, VERMILION, Panel, draw_level

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def region_panel(region: ImpedanceRegion, specified: Impedance | None = None) -> Panel:
    """Draw where stiffness and damping at the link are passive, where the link alone is stable, and what is asked."""

    def draw(axis: Axes) -> None:
        d, k = np.meshgrid(region.damping, region.stiffness)
        margin = np.clip(region.margin, -1.0, 1.0)
        if np.any(region.passive):
            axis.contourf(d, k, margin, levels=[0.0, np.inf], colors=[SKY], alpha=0.5)
            axis.contour(d, k, margin, levels=[0.0], colors=[BLUE], linewidths=1.3)
            axis.plot([], [], color=BLUE, linewidth=1.3, label="passive inside")
        if np.any(region.stable) and not np.all(region.stable):
            axis.contour(d, k, region.free_radius, levels=[1.0], colors=[VERMILION], linewidths=1.1, linestyles="--")
            axis.plot([], [], color=VERMILION, linewidth=1.1, linestyle="--", label="stable alone inside")
        if region.critical.stiffness.size:
            axis.plot(region.critical.damping, region.critical.stiffness, color=GREEN, linewidth=1.3, label="critical")
        if region.spring is not None and region.spring <= region.stiffness[-1]:
            draw_level(axis, region.spring, "the spring", style=":")
        for impedance, marker, label in ((region.stiffest, "^", "stiffest"), (specified, "D", "asked")):
            if impedance is not None:
                point = [impedance.damping], [impedance.stiffness]
                axis.plot(*point, marker, color=LIMIT, markersize=6, label=label)
        axis.set_xlim(region.damping[0], region.damping[-1])
        axis.set_ylim(region.stiffness[0], region.stiffness[-1])

    return Panel(
        name="impedance_region",
        title="What may be rendered at the link",
        draw=draw,
        x=f"damping D_v [{region.called.damping}]",
        y=(f"stiffness K_v [{region.called.stiffness}]",),
        heights=(1.3,),
        hover="",
        caption="Inside, no passive linear environment makes the sampled loop unstable; everywhere else one does: "
        f"{'; '.join(region.describe())}.",
    )
