"""Tabulate what a bandwidth costs: one tuned controller for each of several, and their figures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from typing import Any

from seaopt.control.laws.controller import Controller
from seaopt.control.laws.delay import settle_delay
from seaopt.control.laws.limits import MeasuredLoop
from seaopt.control.laws.spec import ControllerSpec
from seaopt.control.tuning.optimisation_problem import LawNumbers, Task
from seaopt.control.tuning.tuner import disturbance, make_controller, make_task, solve
from seaopt.errors import ControlError
from seaopt.estimation import Fit
from seaopt.formatting import MISSING, format_figure, format_number, format_table, html_text
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.records import record

FRONTIER_SCHEMA = "seaopt/frontier/1"
MOST_ROWS = 1000


@record
class FrontierRow:
    """One bandwidth; what is not said to be of the worst plant is of the design plant.

    Parameters
    ----------
    bandwidth_hz : float
        Asked.
    feasible : bool
        Whether every limit is met; if not, the figures are those of the controller that misses them least.
    noise_gain : float
        N/N.
    ms, ms_plant : float, str
        Largest Ms of all plants, and whose it is.
    disturbance : float
        Integral over ln f of abs(S) from 0.1 Hz to the bandwidth, worst plant.
    sensitivity_bandwidth_hz : float
        abs(S) stays below -3 dB up to here.
    phase_margin_deg, disk_margin
        As in `LoopFigures`.
    force_limit_N : float or None
        Largest amplitude of the reference at the bandwidth before the current saturates; None without a limit.
    blocked_by : tuple of str
        The limits that are broken.

    """

    bandwidth_hz: float
    feasible: bool
    noise_gain: float
    ms: float
    ms_plant: str
    disturbance: float
    sensitivity_bandwidth_hz: float
    phase_margin_deg: float | None
    disk_margin: float
    force_limit_N: float | None
    blocked_by: tuple[str, ...]


@record(eq=False)
class Frontier:
    """The rows of a sweep, and their controllers."""

    rows: tuple[FrontierRow, ...]
    controllers: tuple[Controller, ...]

    def to_dict(self) -> dict[str, Any]:
        """Return the content of frontier.json (schema seaopt/frontier/1)."""
        rows = [{field.name: getattr(row, field.name) for field in fields(FrontierRow)} for row in self.rows]
        return {
            "schema": FRONTIER_SCHEMA,
            "rows": rows,
            "controllers": [controller.to_dict() for controller in self.controllers],
        }

    def __repr__(self) -> str:
        head = ("Hz", "met", "noise gain", "Ms", "worst", "disturbance", "|S| < -3 dB", "phase margin", "force limit")
        return "\n".join(format_table(map(_cells, self.rows), (*head, "blocked by"), "><>><>>>>"))

    _repr_html_ = html_text


def sweep(
    plant: Plant,
    params: Fit | ParameterSet,
    spec: ControllerSpec,
    bandwidths_hz: Sequence[float],
    robust_to: Mapping[str, Plant | tuple[Plant, ParameterSet]] | None = None,
    *,
    draws: Sequence[Mapping[str, float]] = (),
) -> Frontier:
    """Tune at each of several bandwidths, also starting from the one before; an infeasible row is a result.

    Parameters
    ----------
    plant, params, spec, robust_to, draws
        As `tune`; the specification's own bandwidth is not used.
    bandwidths_hz : sequence of float
        In the specification's range.

    Raises
    ------
    ControlError
        As `tune`; or there is no bandwidth, too many, or one is outside the range.

    Examples
    --------
    >>> import seaopt as so
    >>> from seaopt.control import sweep
    >>> spec = so.ControllerSpec(max_sensitivity=1.6, max_noise_gain=25)
    >>> frontier = sweep(so.plants.high_impedance(), so.plants.thor(), spec, [20, 30])
    >>> [row.feasible for row in frontier.rows], frontier.rows[0].noise_gain <= 25
    ([True, True], True)

    """
    if not 0 < len(bandwidths_hz) <= MOST_ROWS:
        raise ControlError(f"bandwidths_hz has {len(bandwidths_hz)} values; give 1 to {MOST_ROWS}")
    spec = settle_delay(spec, plant, params)
    params = params.parameters if isinstance(params, Fit) else params
    # What is wrong with any row is said before the first is tuned.
    specs = [replace(spec, bandwidth_hz=float(f)) for f in bandwidths_hz]
    task = make_task(plant, params, specs[0], robust_to or {}, draws)
    rows: list[FrontierRow] = []
    controllers: list[Controller] = []
    warm: tuple[LawNumbers, ...] = ()
    for one in specs:
        present = replace(task, spec=one)
        x, loops = solve(present, warm)
        controller = make_controller(present, x, loops, (plant, params))
        rows.append(_row(present, x, loops, controller))
        controllers.append(controller)
        warm = (x,)
    return Frontier(rows=tuple(rows), controllers=tuple(controllers))


def _cells(row: FrontierRow) -> list[str]:
    """Return a row of the table."""
    return [
        f"{row.bandwidth_hz:g}",
        "yes" if row.feasible else "no",
        *(format_number(value) for value in (row.noise_gain, row.ms)),
        row.ms_plant,
        format_number(row.disturbance),
        format_figure(row.sensitivity_bandwidth_hz, "Hz", 3),
        MISSING if row.phase_margin_deg is None else f"{row.phase_margin_deg:.1f} deg",
        format_figure(row.force_limit_N, "N"),
        " and ".join(row.blocked_by),
    ]


def _row(task: Task, x: LawNumbers, loops: list[MeasuredLoop], controller: Controller) -> FrontierRow:
    design, f_b = loops[0].figures, task.spec.bandwidth_hz
    worst = max(loops, key=lambda loop: loop.figures.ms)
    return FrontierRow(
        bandwidth_hz=f_b, feasible=controller.feasible, noise_gain=design.noise_gain, ms=worst.figures.ms,
        ms_plant=worst.name, disturbance=max(disturbance(task.loop(x, i), f_b) for i in range(len(loops))),
        sensitivity_bandwidth_hz=design.sensitivity_bandwidth_hz, phase_margin_deg=design.phase_margin_deg,
        disk_margin=design.disk_margin, force_limit_N=controller.force_limit(f_b),
        blocked_by=controller.blocked_by,
    )  # fmt: skip
