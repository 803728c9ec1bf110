r"""Gains at the points of one scheduling variable, and lines between them.

The variable s is a state of the plant that is measured (an angle) or a parameter that is known as it runs (a load).
Between two points every gain is interpolated by itself,

.. math:: g(s) = g_i + t\,(g_{i+1} - g_i), \qquad t = \frac{s - s_i}{s_{i+1} - s_i},

and beyond the ends it stays. The gains are those of `seaopt.control.laws.structures`, of which the law is made at s, in
step order with states that mean the same everywhere (`seaopt.control.scheduling.step_order`); matrices of a balanced
realisation have coordinates of their own at every point, and cannot be interpolated. A corner f is interpolated as the
filter has it, :math:`\tan \pi f T_s`.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache

import numpy as np
from jaxtyping import Float

from seaopt.control.laws.structures import (
    CASCADE,
    INNER_GAINS,
    LAW_GAINS,
    NOTCH_GAINS,
    PREFILTER,
    PREFILTER_DAMPING,
    PREFILTER_ORDERS,
    DisturbanceObserver,
    Gains,
    Nominal,
    SpeedLoop,
    Structure,
)
from seaopt.control.loops.compensation.link_feedforward import LinkPath
from seaopt.control.loops.law import Law
from seaopt.control.scheduling.step_order import INVERSE_GAIN, StepOrder
from seaopt.errors import ControlError
from seaopt.records import record

PerPoint = Float[np.ndarray, " n"]
STRUCTURES = ("pd", "pid", "pid_dob", CASCADE)  # whose gains can be interpolated
CORNERS = {NOTCH_GAINS[0]: "notch_w", PREFILTER: "prefilter_w"}  # tan(pi f T_s) of a frequency in Hz
LINK_NUMBERS = ("inertia", "damping")
MOST_POINTS = 100


@record(eq=False)
class GainTable:
    """Gains at points of a scheduling variable.

    Parameters
    ----------
    over, unit : str
        The variable, and its SI unit.
    points : array, shape (n,)
        Its values, ascending.
    gains : mapping of name to array, shape (n,)
        k_p, k_i, k_d, T_f, k_r and c at these; and those of a notch, a prefilter and a cascade, where there are such.
    structure : {"pd", "pid", "pid_dob", "cascade"}
    sample_time_s : float
        Seconds.
    speed : SpeedLoop, optional
        What a cascade's speed loop reads.
    nominals : tuple of Nominal
        The nominal plant of a pid_dob's observer at each point, the same but for its gain.
    links : tuple of LinkPath
        What is fed forward of the link's motion at each point, of one signal.

    Raises
    ------
    ControlError
        There are fewer than two points or too many, they do not ascend, the gains are not those of the structure, or
        some of them integrate and others do not.

    Examples
    --------
    >>> import numpy as np
    >>> rows = {"k_p": [1.0, 3.0], "k_i": [8.0, 4.0], "k_d": [0.0, 0.0], "T_f": [1e-3] * 2, "k_r": [2.0, 4.0], "c": [1.0] * 2}
    >>> table = GainTable(
    ...     over="phi", unit="rad", points=np.array([0.0, 1.0]), gains={k: np.array(v) for k, v in rows.items()},
    ...     structure="pid", sample_time_s=1e-3,
    ... )
    >>> table.interpolate(0.5)["k_p"], table.interpolate(7.0)["k_p"]
    (2.0, 3.0)

    """  # noqa: E501

    over: str
    unit: str
    points: PerPoint
    gains: Mapping[str, PerPoint]
    structure: Structure
    sample_time_s: float
    speed: SpeedLoop | None = None
    nominals: tuple[Nominal, ...] = ()
    links: tuple[LinkPath, ...] = ()

    def __post_init__(self) -> None:
        check_points(self.over, self.points)
        check_structure(self.structure)
        if unlike := set(self.gains) ^ set(self._list_expected()):
            raise ControlError(
                f"gains of a schedule are {', '.join(sorted(self.gains))}: {', '.join(sorted(unlike))} is missing or "
                f"does not go with the others; give {', '.join(LAW_GAINS)}, and all of a notch, prefilter or cascade"
            )
        for name, values in self.gains.items():
            if np.shape(values) != self.points.shape or not np.all(np.isfinite(values)):
                raise ControlError(f"{name} of a schedule: give {self.points.size} finite numbers, one per point")
        for nominal in self.nominals:
            parts = zip(nominal.inverse, self.nominals[0].inverse[:-1], strict=False)
            same = all(np.array_equal(a.num, b.num) and np.array_equal(a.den, b.den) for a, b in parts)
            if not same or not np.array_equal(nominal.kept, self.nominals[0].kept) or nominal.kept[0]:
                raise ControlError(
                    "the observers of a schedule have different nominal plants, or one that follows the command at "
                    "once, and what they keep would change its meaning from point to point; tune the schedule again"
                )
        if len({(link.measured, link.unit, link.is_speed, link.high_pass_hz > 0.0) for link in self.links}) > 1:
            raise ControlError(
                "link_feedforward of a schedule reads one signal at all points, everywhere with a high-pass or nowhere"
            )
        integrates = np.asarray(self.gains["k_i"]) > 0.0
        if not self.nominals and np.any(integrates) and not np.all(integrates):
            at = ", ".join(f"{value:g}" for value in self.points[~integrates])
            raise ControlError(
                f"k_i is 0 at {self.over} = {at} and not elsewhere: what was integrated would stay in the command "
                'there for ever; use structure = "pd", or other points'
            )

    def _list_expected(self) -> list[str]:
        """Return the gains that go with those that say which parts there are."""
        optional = [name for name in (PREFILTER, PREFILTER_DAMPING) if name in self.gains]
        optional += NOTCH_GAINS if set(NOTCH_GAINS) & set(self.gains) else ()
        inner = () if self.speed is None else (*INNER_GAINS, *(("T_v",) if "T_v" in self.gains else ()))
        return [*LAW_GAINS, *inner, *optional, *(("T_q",) if self.nominals else ())]

    @property
    def order(self) -> StepOrder:
        """What the law is made of, as it runs."""
        return _find_order(self)

    @property
    def states(self) -> tuple[str, ...]:
        """What the law keeps as it runs, by name."""
        return _list_states(self)

    @property
    def columns(self) -> Mapping[str, PerPoint]:
        """The rows of numbers that are interpolated, by the names that `StepOrder` has for them."""
        return _list_columns(self)

    @property
    def integrates(self) -> bool:
        """Whether the law integrates."""
        return self.structure != "pd" and bool(np.any(self.gains["k_i"]))

    def find_stretch(self, value: float) -> tuple[int, float]:
        """Return the point below a value and the share of the way to the next; at the ends beyond them."""
        points = self.points
        inside = min(max(value, float(points[0])), float(points[-1]))
        i = min(max(bisect_right(points, inside) - 1, 0), points.size - 2)
        return i, (inside - float(points[i])) / (float(points[i + 1]) - float(points[i]))

    def interpolate(self, value: float) -> dict[str, float]:
        """Return the gains at a finite value, by name."""
        numbers, per_hz = self.find_numbers(value), np.pi * self.sample_time_s
        return {
            name: float(np.arctan(numbers[CORNERS[name]])) / per_hz if name in CORNERS else numbers[name]
            for name in self.gains
        }

    def find_numbers(self, value: float, **more: PerPoint) -> dict[str, float]:
        """Return the numbers of `columns` at a finite value, and of `more` rows at the points."""
        i, t = self.find_stretch(value)
        return {name: float(row[i] + t * (row[i + 1] - row[i])) for name, row in {**self.columns, **more}.items()}

    def find_gains(self, value: float) -> Gains:
        """Return the gains at a value with what else the law is made of."""
        numbers, observer = self.interpolate(value), None
        if self.nominals:
            nominal = self.nominals[0].scaled(self.find_numbers(value)[INVERSE_GAIN])
            observer = DisturbanceObserver(nominal=nominal, T_q=numbers["T_q"])
        return Gains.from_names(numbers, observer, self.speed, self._find_link(value))

    def _find_link(self, value: float) -> LinkPath | None:
        """Return what is fed forward of the link at a value."""
        if not self.links:
            return None
        (i, t), numbers, per_hz = self.find_stretch(value), self.find_numbers(value), np.pi * self.sample_time_s
        low, high = self.links[i : i + 2]
        fraction = low.fraction + t * (high.fraction - low.fraction)
        per_fraction = 1.0 / fraction if fraction else 0.0
        return replace(
            low,
            fraction=fraction,
            inertia=numbers["link_inertia"] * per_fraction,
            damping=numbers["link_damping"] * per_fraction,
            corner_hz=float(np.arctan(numbers["link_w"])) / per_hz,
            high_pass_hz=float(np.arctan(numbers["link_slow_w"])) / per_hz if low.high_pass_hz else 0.0,
            effect=None,
        )

    def law(self, value: float) -> Law:
        """Return the law while the variable stands at a value."""
        return self.find_gains(value).law(self.structure, self.sample_time_s).balanced()


@lru_cache(maxsize=16)
def _find_order(table: GainTable) -> StepOrder:
    """Return what the law of a table is made of, once."""
    return StepOrder(
        sample_time_s=table.sample_time_s,
        integrates=table.integrates,
        prefilter=PREFILTER_ORDERS[PREFILTER_DAMPING in table.gains] if PREFILTER in table.gains else None,
        notch=NOTCH_GAINS[0] in table.gains,
        speed=table.speed,
        speed_integrates="T_v" in table.gains,
        nominal=table.nominals[0] if table.nominals else None,
        link=("speed" if table.links[0].is_speed else "position") if table.links else None,
        link_high_pass=bool(table.links and table.links[0].high_pass_hz),
    )


@lru_cache(maxsize=16)
def _list_states(table: GainTable) -> tuple[str, ...]:
    """Return the names of what the law of a table keeps, once."""
    return tuple(table.order.find_rest(0.0, [0.0] * table.order.measured))


@lru_cache(maxsize=16)
def _list_columns(table: GainTable) -> Mapping[str, PerPoint]:
    """Return the rows of a table with its corners warped, once."""
    columns = {
        CORNERS.get(name, name): np.tan(np.pi * row * table.sample_time_s) if name in CORNERS else np.asarray(row)
        for name, row in table.gains.items()
    }
    gains, links = [nominal.inverse_gain for nominal in table.nominals], table.links
    columns |= {INVERSE_GAIN: np.array(gains)} if gains else {}
    if links:
        per_hz = np.pi * table.sample_time_s
        columns |= {f"link_{name}": np.array([x.fraction * getattr(x, name) for x in links]) for name in LINK_NUMBERS}
        columns["link_w"] = np.array([np.tan(per_hz * link.corner_hz) for link in links])
        if links[0].high_pass_hz:
            columns["link_slow_w"] = np.array([np.tan(per_hz * link.high_pass_hz) for link in links])
    return columns


def check_structure(structure: str) -> None:
    """Refuse a structure that cannot be scheduled (ControlError)."""
    if structure not in STRUCTURES:
        names = ", ".join(f'"{name}"' for name in STRUCTURES)
        raise ControlError(f'structure = "{structure}" cannot be scheduled; use one of {names}')


def check_points(over: str, points: PerPoint) -> None:
    """Refuse points that no table can have (ControlError): fewer than two or too many, or not ascending."""
    values = np.asarray(points)
    if values.ndim != 1 or not 2 <= values.size <= MOST_POINTS:
        raise ControlError(
            f"points of {over} = {values.tolist()}: give 2 to {MOST_POINTS} values, the ends of its range among them"
        )
    if not np.all(np.isfinite(values)) or not np.all(np.diff(values) > 0.0):
        raise ControlError(
            f"points of {over} = {values.tolist()} do not ascend; give each once: "
            f"points = {np.unique(values[np.isfinite(values)]).tolist()}"
        )
