"""What the tuner knows of its plants at frequencies, and of a law there, as arrays."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Complex, Float, Int

from seaopt.control.laws.limits import LimitCurve
from seaopt.control.loops.measured.loop import bound_disc
from seaopt.control.loops.measured.plant import MeasuredPlant
from seaopt.control.loops.sampled_plant import DigitalPlant
from seaopt.records import record

Frequencies = Float[np.ndarray, " m"]
Curve = Float[np.ndarray, " m"]  # over frequency
Usage = Float[np.ndarray, "k m"]  # of a limit, a row for each plant
Response = Complex[np.ndarray, " m"]
Responses = Complex[np.ndarray, "n m"]
ComplexArray = Complex[np.ndarray, "..."]
Values = Float[np.ndarray, " n"]
Indices = Int[np.ndarray, " c"]

LEAST_RESPONSE = 1e-6  # of what is to be above a level: discs around zero have none


@record(eq=False)
class Path:
    """A sum over the signals that a law reads, affine in its feedback: fixed + y C_y + v C_v, C_v of a speed loop."""

    fixed: ComplexArray
    y: ComplexArray
    v: ComplexArray

    def add_up(self, c_y: ComplexArray, c_v: ComplexArray) -> ComplexArray:
        """Return the sum of a law."""
        return self.fixed + self.y * c_y + self.v * c_v

    def change(self, by_y: ComplexArray, by_v: ComplexArray) -> ComplexArray:
        """Return the change of the sum with those of C_y and C_v."""
        return self.y * by_y + self.v * by_v

    def at(self, index: Any) -> Path:
        """Return some of the frequencies, or rows and frequencies."""
        return Path(fixed=self.fixed[index], y=self.y[index], v=self.v[index])


@record(eq=False)
class Grid:
    """Responses at frequencies.

    Parameters
    ----------
    f, q
        Frequencies in Hz, and exp(-j omega T_s).
    p : array, shape (plants, m)
        Plants with hold and delay; the first is the design plant.
    discs : array, shape (plants, m)
        Radii of the discs around them of those that are measured; zeros of models.
    fixed, speed : arrays, shape (plants, m)
        B of the module's docstring without a speed loop, and the speed per command as the law has it; ones and zeros
        where the law reads nothing further.
    rows : tuple of int
        Which of the task's plants they are.
    kept, inverse
        The nominal plant's parts at q; zeros without an observer.
    port, force : Path
        The loop with link 2 held and the force on it, of a `PassivityCondition`, in the passive band; 1 elsewhere.
    unit
        G_22/abs(G_22) there; zero elsewhere.
    friction, friction_size : Path, shapes (frictions, m) and (frictions, signals, m)
        1 + plants C and weights C of a `FeedbackLimit` for each plant with friction of which a margin is aimed at.
    levels : mapping of limit to array, shape (m,)
        Of every limit that is looked at.

    """

    f: Frequencies
    q: Response
    p: Responses
    discs: Float[np.ndarray, "n m"]
    fixed: Responses
    speed: Responses
    rows: tuple[int, ...]
    kept: Response
    inverse: Response
    port: Path
    force: Path
    unit: Response
    friction: Path
    friction_size: Path
    levels: Mapping[str, Curve]

    @property
    def reads_more(self) -> bool:
        """Whether the loop has a path besides that of the regulated signal."""
        return bool(np.any(self.speed) or np.any(self.fixed != 1.0))

    def at(self, index: Int[np.ndarray, " k"]) -> Grid:
        """Return some of the frequencies."""
        return Grid(
            f=self.f[index],
            q=self.q[index],
            p=self.p[:, index],
            discs=self.discs[:, index],
            fixed=self.fixed[:, index],
            speed=self.speed[:, index],
            rows=self.rows,
            kept=self.kept[index],
            inverse=self.inverse[index],
            port=self.port.at(index),
            force=self.force.at(index),
            unit=self.unit[index],
            friction=self.friction.at((..., index)),
            friction_size=self.friction_size.at((..., index)),
            levels={name: level[index] for name, level in self.levels.items()},
        )


@record(eq=False)
class LawResponse:
    """Laws at a grid's frequencies: C_y and C_r of one or of n, C_v of a speed loop, and B on the grid's plants.

    Of n laws C_v and B have a row each, or are the same of all.
    """

    c_y: Complex[np.ndarray, "*n m"]
    c_r: Complex[np.ndarray, "*n m"]
    c_v: Complex[np.ndarray, "*v m"]
    rest: Complex[np.ndarray, "k *v m"]


def use_disc(
    curve: LimitCurve,
    level: Float[np.ndarray, "..."],
    p: ComplexArray,
    discs: Float[np.ndarray, "..."],
    c_y: ComplexArray,
    c_r: ComplexArray,
    rest: ComplexArray,
) -> Float[np.ndarray, "..."]:
    """Return the usage of a limit by the worst of the responses in discs."""
    least, most = bound_disc(curve.of, p, discs, c_y, c_r, rest)
    return level / np.maximum(least, LEAST_RESPONSE) if curve.floor else most / level


def measured_discs(plant: DigitalPlant | MeasuredPlant, f: Frequencies) -> Curve:
    """Return the radii of the discs around a plant's responses; zeros of a model."""
    return plant.discs(f) if isinstance(plant, MeasuredPlant) else np.zeros(f.size)
