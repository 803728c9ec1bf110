r"""The set of one plant that the bounds hold for, as boxes: the part of an `Uncertainty` that this plant depends on.

The Gaussian part is an ellipsoid, the image :math:`p = \bar p + W y` of a ball. Its shadow on the parameters that the
plant has is an ellipsoid again, whose axes come from the singular values of their rows of W. Coordinates along it are
fractions of its half axes, so that it is the unit ball; those of the ranges run from -1 to 1.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Bool, Float, Int

from seaopt.control.loops.sampled_plant import DELAY, DELAYS, DRIVE_DELAY, conditions, read_conditions
from seaopt.plants import CompletedParameters, Plant
from seaopt.records import record
from seaopt.robustness.bounds.taylor import Taylor, build_basis, make_linear
from seaopt.robustness.uncertainty.draws import Column, Uncertainty, confidence_radius

SMALLEST_AXIS = 1e-12  # half axis, as a fraction of the largest relative one, below which nothing is uncertain
Rows = Float[np.ndarray, "b k"]  # coordinates, a row per box or point
Mask = Bool[np.ndarray, " b"]


@record(eq=False)
class Boxes:
    """Boxes in coordinates: centres and half widths, shapes (b, k)."""

    centre: Rows
    radius: Rows

    def halve(self, axis: Int[np.ndarray, " b"]) -> Boxes:
        """Return the lower halves, each box cut along its own axis, then the upper halves."""
        step = np.zeros_like(self.radius)
        rows = np.arange(axis.size)
        step[rows, axis] = 0.5 * self.radius[rows, axis]
        radius = np.tile(self.radius - step, (2, 1))
        return Boxes(centre=np.vstack([self.centre - step, self.centre + step]), radius=radius)


@record(eq=False)
class Region:
    """The set of plants that differ in what is uncertain."""

    names: tuple[str, ...]  # parameters and conditions that are uncertain
    centre: Column  # their values at the coordinates' origin
    slopes: Float[np.ndarray, "n k"]  # and per coordinate
    low: Column  # physical bounds of those of the Gaussian part, infinite for the others
    high: Column
    ball: int  # this many coordinates, the first ones, lie in a unit ball, the others between -1 and 1
    fixed: dict[str, float]  # conditions that are not uncertain
    nominal: CompletedParameters  # what the plant has where nothing is uncertain
    lead_s: float = 0.0  # the delay besides the one that is uncertain

    @property
    def size(self) -> int:
        """Number of coordinates."""
        return self.slopes.shape[1]

    def cover(self, sample_time_s: float) -> Boxes:
        """Return boxes that cover the set, none of which has a whole number of samples of delay in its interior. Where
        the output has a part that follows the command at once, the sampled plant jumps at such a delay, so that each of
        them is also a box of its own, of no width.
        """
        size = self.size
        boxes = Boxes(centre=np.zeros((1, size)), radius=np.ones((1, size)))
        rows = [row for row, name in enumerate(self.names) if name in DELAYS]
        if not rows:
            return self.cut(boxes)[0]
        (row,) = rows
        axis = int(np.flatnonzero(self.slopes[row])[0])
        middle, half = self.centre[row] + self.lead_s, self.slopes[row, axis]
        first, last = (middle - half) / sample_time_s, (middle + half) / sample_time_s
        inner = np.arange(np.ceil(first - 1e-9), np.floor(last + 1e-9) + 1)
        edges = np.unique(np.concatenate([[first], inner[(inner > first) & (inner < last)], [last]]))
        points = np.concatenate([0.5 * (edges[:-1] + edges[1:]), inner]) * sample_time_s
        widths = np.concatenate([0.5 * np.diff(edges), np.zeros(inner.size)]) * sample_time_s
        centre, radius = np.zeros((points.size, size)), np.ones((points.size, size))
        centre[:, axis], radius[:, axis] = (points - middle) / half, widths / half
        return self.cut(Boxes(centre=centre, radius=radius))[0]

    def cut(self, boxes: Boxes) -> tuple[Boxes, Mask]:
        """Return the boxes cut at the physical bounds, without those outside the set, and which boxes these are."""
        low, high = boxes.centre - boxes.radius, boxes.centre + boxes.radius
        for sign, bound in ((1.0, self.low), (-1.0, -self.high)):
            for row in np.flatnonzero(np.isfinite(bound)):
                slope = sign * self.slopes[row]
                largest = np.maximum(slope * low, slope * high)  # of what each coordinate adds
                room = sign * self.centre[row] - bound[row] + np.sum(largest, axis=1, keepdims=True) - largest
                with np.errstate(divide="ignore", invalid="ignore"):
                    limit = -room / slope
                low = np.where(slope > 0.0, np.maximum(low, limit), low)
                high = np.where(slope < 0.0, np.minimum(high, limit), high)
        nearest = np.clip(0.0, low, high)[:, : self.ball]
        kept = np.all(low <= high, axis=1) & (np.sum(nearest**2, axis=1) <= 1.0)
        return Boxes(centre=0.5 * (low + high)[kept], radius=0.5 * (high - low)[kept]), kept

    def enclose(self, boxes: Boxes, degree: int) -> dict[str, Taylor]:
        """Return the uncertain parameters and conditions over the boxes, as models of a degree."""
        over = build_basis(self.size, degree)
        centre, slopes = self.evaluate(boxes.centre), self.slopes[:, None] * boxes.radius
        return {name: make_linear(centre[name], slopes[row].T, over) for row, name in enumerate(self.names)}

    def evaluate(self, points: Rows) -> dict[str, Float[np.ndarray, " b"]]:
        """Return the uncertain parameters and conditions at points."""
        return dict(zip(self.names, (self.centre + points @ self.slopes.T).T, strict=True))

    def project(self, points: Rows) -> Rows:
        """Return the points, with those outside the ball or the box moved onto its edge."""
        inner = points[:, : self.ball]
        size = np.linalg.norm(inner, axis=1, keepdims=True)
        return np.hstack([inner / np.maximum(size, 1.0), np.clip(points[:, self.ball :], -1.0, 1.0)])

    def contains(self, points: Rows) -> Mask:
        """Tell which points are in the set."""
        values = self.centre + points @ self.slopes.T
        edge = 1.0 + 1e-12
        near = np.all(np.abs(points) <= edge, axis=1) & (np.linalg.norm(points[:, : self.ball], axis=1) <= edge)
        return near & np.all((values >= self.low) & (values <= self.high), axis=1)


def build_region(plant: Plant, unknown: Uncertainty) -> Region:
    """Return the set of what is uncertain of one plant."""
    extra = conditions((plant,))
    taken = {mode.parameter for mode in unknown.modes.values()}
    gaussian = [k for k, name in enumerate(unknown.names) if name in plant.parameters and name not in taken]
    names = [unknown.names[k] for k in gaussian]
    rows = unknown.factor()[gaussian] * confidence_radius(len(unknown.names))
    size = np.linalg.norm(rows, axis=1, keepdims=True)
    left, axes, _ = np.linalg.svd(rows / np.where(size > 0.0, size, 1.0), full_matrices=False)
    uncertain = axes > SMALLEST_AXIS
    half_axes = (left * axes)[:, uncertain] * size
    ends = dict(_convert_range(unknown, name, pair) for name, pair in unknown.ranges.items())
    ends = {name: pair for name, pair in ends.items() if name in plant.parameters or name in extra}
    ends = _merge_delays(plant, unknown, ends)
    pinned = {name: pair[0] for name, pair in ends.items() if pair[0] == pair[1]}
    wide = {name: pair for name, pair in ends.items() if name not in pinned}
    count, ball = len(names), half_axes.shape[1]
    slopes = np.zeros((count + len(wide), ball + len(wide)))
    slopes[:count, :ball] = half_axes
    slopes[count:, ball:] = np.diag([0.5 * (high - low) for low, high in wide.values()])
    middle = [0.5 * (low + high) for low, high in wide.values()]
    nominal = plant.complete(unknown.nominal)
    resting = {name: value for name, value in read_conditions(plant, nominal).items() if name not in ends}
    certain = resting | pinned
    return Region(
        names=(*names, *wide),
        centre=np.array([*unknown.nominal.values_of(tuple(names)), *middle], dtype=float),
        slopes=slopes,
        low=np.array([*(unknown.nominal[n].min for n in names), *[-np.inf] * len(wide)], dtype=float),
        high=np.array([*(unknown.nominal[n].max for n in names), *[np.inf] * len(wide)], dtype=float),
        ball=ball,
        fixed=certain,
        nominal=nominal,
        lead_s=sum(certain.get(name, 0.0) for name in DELAYS) + plant.drive_offset_s,
    )


def _merge_delays(
    plant: Plant, unknown: Uncertainty, ends: Mapping[str, tuple[float, float]]
) -> dict[str, tuple[float, float]]:
    """Return the ranges with one of the delay in all, where a fit's of the drive is uncertain: a range of its own. That
    holds what the joint distribution does, as boxes are to be cut where the delay is a whole number of samples.
    """
    if DRIVE_DELAY in ends:
        first, last = ends[DRIVE_DELAY]
    elif DRIVE_DELAY in unknown.names:
        row, nominal = unknown.names.index(DRIVE_DELAY), unknown.nominal[DRIVE_DELAY].value
        reach = confidence_radius(len(unknown.names)) * float(np.sqrt(unknown.covariance[row, row]))
        first, last = max(nominal - reach, -plant.drive_offset_s, 0.0), nominal + reach
    else:
        return dict(ends)
    low, high = ends.get(DELAY, (0.0, 0.0))
    return {name: pair for name, pair in ends.items() if name != DELAY} | {DRIVE_DELAY: (first + low, last + high)}


def _convert_range(unknown: Uncertainty, name: str, pair: tuple[float, float]) -> tuple[str, tuple[float, float]]:
    """Return a parameter and its range; for a mode's frequency, the parameter that sets it, and its range."""
    mode = unknown.modes.get(name)
    if mode is None:
        return name, (float(pair[0]), float(pair[1]))
    ends = mode.values_at(np.array(pair))
    return mode.parameter, (float(np.min(ends)), float(np.max(ends)))
