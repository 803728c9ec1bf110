"""What the tuner knows of its plants, of their friction, and of a law, at frequencies, as arrays."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Complex, Float, Inexact, Int

from seaopt.control.laws.limits import LimitCurve
from seaopt.control.laws.spec import ControllerSpec
from seaopt.control.laws.structures import SpeedLoop
from seaopt.control.loops.absolute_stability import LOWEST_ANGLE, limit_feedback
from seaopt.control.loops.friction_loop import FrictionLoop
from seaopt.control.loops.measured.loop import bound_disc
from seaopt.control.loops.transfer_function import Frequencies, Response, TransferFunction
from seaopt.plants import Plant
from seaopt.plants.friction import Friction
from seaopt.records import record

Curve = Float[np.ndarray, " m"]  # over frequency
Usage = Float[np.ndarray, "k m"]  # of a limit, a row for each plant
Responses = Complex[np.ndarray, "n m"]
ComplexArray = Complex[np.ndarray, "..."]
Values = Float[np.ndarray, " n"]
Indices = Int[np.ndarray, " c"]

FRICTION = "min_friction_margin"
MARGIN_RESERVE = 0.02  # of the slope asked: the test gives its margin to a hundredth, and looks between angles
LEAST_RESPONSE = 1e-6  # of what is to be above a level: discs around zero have none


@record(eq=False)
class Path:
    """A sum over the signals that a law reads, affine in it: fixed + y C_y + v C_v + r C_r, C_v of a speed loop, and r
    what an outer loop takes off the reference; None where no outer loop is closed. Or the radii around these.
    """

    fixed: Inexact[np.ndarray, "..."]
    y: Inexact[np.ndarray, "..."]
    v: Inexact[np.ndarray, "..."]
    r: ComplexArray | None = None

    def add_constant(self, c_v: ComplexArray, c_r: ComplexArray) -> ComplexArray:
        """Return the sum without the regulated signal."""
        constant = self.fixed + self.v * c_v
        return constant if self.r is None else constant + self.r * c_r

    def add_up(self, c_y: ComplexArray, c_v: ComplexArray, c_r: ComplexArray) -> ComplexArray:
        """Return the sum of a law."""
        return self.add_constant(c_v, c_r) + self.y * c_y

    def change(self, by_y: ComplexArray, by_v: ComplexArray, by_r: ComplexArray) -> ComplexArray:
        """Return the change of the sum with those of C_y, C_v and C_r."""
        change = self.y * by_y + self.v * by_v
        return change if self.r is None else change + self.r * by_r

    def at(self, index: Any) -> Path:
        """Return some of the frequencies, or rows and frequencies."""
        return Path(
            fixed=self.fixed[index], y=self.y[index], v=self.v[index], r=None if self.r is None else self.r[index]
        )

    @property
    def alone(self) -> Path:
        """The sum of the force law alone."""
        return self if self.r is None else replace(self, r=None)


def stack_paths(paths: Sequence[Path]) -> Path:
    """Return the paths of plants as rows of one."""
    parts = ("fixed", "y", "v") if paths[0].r is None else ("fixed", "y", "v", "r")
    return Path(**{part: np.array([getattr(path, part) for path in paths]) for part in parts})


def feed_back(
    signals: Inexact[np.ndarray, "... y m"],
    start: float,
    further: Sequence[TransferFunction | SpeedLoop],
    f: Frequencies,
    ts: float,
    *,
    sizes: bool = False,
) -> Path:
    """Return a number and a weighted sum over the signals fed back, of one row per signal: the regulated one, and those
    that further paths feed back; of radii their `sizes`.
    """
    y = signals[..., 0, :]
    v = np.zeros_like(y)
    fixed = v + start
    for row, path in enumerate(further, start=1):
        if isinstance(path, SpeedLoop):
            v = signals[..., row, :]
        else:
            filtered = path.response(f, ts)
            fixed = fixed + signals[..., row, :] * (np.abs(filtered) if sizes else filtered)
    return Path(fixed=fixed, y=y, v=v)


@record(eq=False)
class Grid:
    """The plants' responses, the parts of a law and the limits' levels at m frequencies."""

    f: Frequencies
    q: Response  # exp(-j omega T_s)
    # shape (plants, m): the command per effort asked, 1 + L, with P as y; the first is the design plant
    plants: Path
    discs: Path  # radii of the discs around the plants that are measured; zeros of models
    rows: tuple[int, ...]  # which of the task's plants they are
    kept: Response  # kept, inverse: the nominal plant's parts; zeros without an observer
    inverse: Response
    # the loop with link 2 held and the force on it, of a `PassivityCondition`, in the passive band; 1 elsewhere
    port: Path
    force: Path
    unit: Response  # G_22/abs(G_22) there; zero elsewhere
    # shapes (frictions, m) and (frictions, signals, m): 1 + plants C and weights C of a `FeedbackLimit` for each plant
    # with friction of which a margin is aimed at
    friction: Path
    friction_size: Path
    levels: Mapping[str, Curve]  # of every limit that is looked at

    @property
    def reads_more(self) -> bool:
        """Whether the loop has a path besides that of the regulated signal."""
        return bool(np.any(self.plants.v) or np.any(self.plants.fixed != 1.0))

    @property
    def in_discs(self) -> bool:
        """Whether a plant is measured."""
        return bool(np.any(self.discs.y))

    def at(self, index: Int[np.ndarray, " k"]) -> Grid:
        """Return some of the frequencies."""
        paths = ("plants", "discs", "port", "force", "friction", "friction_size")
        return replace(
            self,
            **{name: getattr(self, name)[..., index] for name in ("f", "q", "kept", "inverse", "unit")},
            **{name: getattr(self, name).at((..., index)) for name in paths},
            levels={name: level[index] for name, level in self.levels.items()},
        )


@record(eq=False)
class LawResponse:
    """Laws at a grid's frequencies: C_y and C_r of one or of n, and C_v of a speed loop, of each or the same of all."""

    c_y: Complex[np.ndarray, "*n m"]
    c_r: Complex[np.ndarray, "*n m"]
    c_v: Complex[np.ndarray, "*v m"]


def use_disc(
    curve: LimitCurve,
    level: Float[np.ndarray, "..."],
    path: Path,
    discs: Path,
    c_y: ComplexArray,
    c_r: ComplexArray,
    c_v: ComplexArray,
) -> Float[np.ndarray, "..."]:
    """Return the usage of a limit by the worst of the responses in discs."""
    reach = discs.fixed + discs.v * np.abs(c_v)
    least, most = bound_disc(curve.of, path.y, discs.y, c_y, c_r, path.add_constant(c_v, c_r), reach, c_v)
    return level / np.maximum(least, LEAST_RESPONSE) if curve.floor else most / level


def use_friction(grid: Grid, law: LawResponse) -> dict[str, np.ndarray]:
    """Return the usage of the friction margins aimed at, of each law one row per plant, where there are any."""
    if not grid.friction.y.size:
        return {}
    c_y, c_v = law.c_y[..., None, :], law.c_v[..., None, :]
    c_r = law.c_r[..., None, :]
    size = np.linalg.norm(grid.friction_size.add_up(c_y[..., None, :], c_v[..., None, :], c_r[..., None, :]), axis=-2)
    return {FRICTION: size / np.maximum(np.abs(grid.friction.add_up(c_y, c_v, c_r)), 1e-300)}


@record(eq=False)
class PlantWithFriction:
    """A plant with friction of which a margin is asked, or that grows as it slides."""

    plant: int  # which of the task's plants slides as it does
    model: Plant  # with its friction
    loop: FrictionLoop  # with its friction taken out; its own law does not matter
    flattest: Float[np.ndarray, " p"]  # slope of each friction, N s/m (N m s/rad), which the loop has in it
    multiplier: str = ""  # of the margin aimed at; empty while none is chosen, and then nothing is asked

    def find_fall(self) -> tuple[Friction, float]:
        """Return the friction that falls most with speed, and how steeply."""
        steepest = int(np.argmin(self.flattest))
        return list(self.model.friction.values())[steepest], -float(self.flattest[steepest])


def weigh_friction(
    aimed: PlantWithFriction, spec: ControllerSpec, count: int, f: Frequencies
) -> tuple[Complex[np.ndarray, "y m"], Complex[np.ndarray, "y y m"]]:
    """Return plants and weights of what a multiplier asks of a law that reads `count` signals; nothing is asked below
    the test's lowest angle.
    """
    slope, slopes = spec.level(FRICTION), aimed.loop.slopes
    assert slope is not None, "it belongs to a specification with a friction margin"
    factor = slope * (1.0 + spec.reserve + MARGIN_RESERVE) / float(np.min(slopes[slopes > 0.0]))
    theta = 2 * np.pi * f * spec.sample_time_s
    tested = theta >= LOWEST_ANGLE
    limit = limit_feedback(aimed.loop, theta[tested], aimed.multiplier, factor)
    plants, weights = np.zeros((count, f.size), dtype=complex), np.zeros((count, count, f.size), dtype=complex)
    plants[:, tested], weights[:, :, tested] = limit.plants, limit.weights
    return plants, weights
