"""Where a plant rests over boxes of its parameters, enclosed.

At the centre of each box by Newton's method, from zero as `seaopt.control.loops.sampled_plant` does; over the box by
simplified Newton steps on Taylor models, each of which is right to one more degree. That the equations have a solution
next to that polynomial, and only one, is then shown by Krawczyk's test (Computing 4, 1969; Neumaier, Interval Methods
for Systems of Equations, 1990, chapter 5).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float

from seaopt.errors import ControlError
from seaopt.plants import Plant, jacobians
from seaopt.plants.plant import dynamics_function
from seaopt.records import record
from seaopt.robustness.bounds.enclosure import Entry, enclosed, matrix
from seaopt.robustness.bounds.taylor import Basis, Taylor, basis, constant

NEWTON_STEPS, WIDENINGS = 30, 4
SLOPES_DEGREE = 2  # of the models in Krawczyk's test
POINT = basis(0, 0)


@record(eq=False)
class _Equations:
    """A plant at rest: its states but the given one, and its first input, y, such that nothing moves."""

    plant: Plant
    p: Sequence[Entry]
    x: Sequence[Entry]
    loose: tuple[int, ...]
    count: int
    over: Basis

    def at(self, y: Taylor) -> tuple[list[Entry], list[Entry]]:
        """Return all states and inputs."""
        entries = [y[:, k, 0] for k in range(len(self.x))]
        own = dict(zip(self.loose, entries[:-1], strict=True))
        inputs: list[Entry] = [entries[-1], *[0.0] * (len(self.plant.inputs) - 1)]
        return [own.get(k, item) for k, item in enumerate(self.x)], inputs

    def rates(self, y: Taylor) -> Taylor:
        """Return what has to be zero, shape (b, n, 1)."""
        rates = enclosed(dynamics_function(self.plant), [*self.at(y), self.p])
        return matrix(rates[0], len(self.x), self.count, self.over)

    def slopes(self, y: Taylor) -> Taylor:
        """Return its derivatives, shape (b, n, n)."""
        found = enclosed(jacobians(self.plant), [*self.at(y), self.p])
        a, b = (matrix(item, len(self.x), self.count, self.over) for item in found[:2])
        columns = list(self.loose)
        parts = ((a.a, b.a), (a.r, b.r))
        return Taylor(
            self.over, *(np.concatenate([left[..., columns], right[..., :1]], axis=-1) for left, right in parts)
        )

    def lower(self, degree: int) -> _Equations:
        """Return the equations on models of a lower degree."""
        p, x = ([_lower(item, degree) for item in entries] for entries in (self.p, self.x))
        over = basis(self.over.size, degree)
        return _Equations(plant=self.plant, p=p, x=x, loose=self.loose, count=self.count, over=over)

    def centre(self) -> _Equations:
        """Return the equations at the centres of the boxes."""
        p, x = ([_centre(item) for item in entries] for entries in (self.p, self.x))
        return _Equations(plant=self.plant, p=p, x=x, loose=self.loose, count=self.count, over=POINT)


def at_rest(
    plant: Plant, p: Sequence[Entry], given: Mapping[str, Entry], count: int, over: Basis
) -> tuple[list[Entry], list[Entry]]:
    """Return enclosures of the states and inputs at rest; infinite where it is not proven that there is one.

    Raises
    ------
    ControlError
        Two states are given, or the plant cannot rest at the centre of a box.

    """
    names = list(plant.states)
    x: list[Entry] = [given.get(name, 0.0) for name in names]
    fixed = [k for k, item in enumerate(x) if isinstance(item, Taylor) or item != 0.0]
    if not fixed:
        return x, [0.0] * len(plant.inputs)
    if len(fixed) > 1:
        raise ControlError(f"{', '.join(names[k] for k in fixed)} are both given; a plant rests at one of them")
    loose = tuple(k for k in range(len(names)) if k not in fixed)
    equations = _Equations(plant=plant, p=p, x=x, loose=loose, count=count, over=over)
    middle = equations.centre()
    centre = _newton(middle, names[fixed[0]])
    inverse = np.linalg.inv(middle.slopes(constant(centre, POINT)).c)
    y, one = constant(centre, over), np.eye(1)
    for _ in range(over.degree + 1):
        y = y - equations.rates(y).between(inverse, one)
        y = y.with_rest(np.zeros_like(y.r))
    return equations.at(_proven(equations, y, inverse))


def _newton(equations: _Equations, where: str) -> Float[np.ndarray, "b n 1"]:
    y = np.zeros((equations.count, len(equations.x), 1))
    for _ in range(NEWTON_STEPS):
        now = constant(y, POINT)
        try:
            step = np.linalg.solve(equations.slopes(now).c, equations.rates(now).c)
        except np.linalg.LinAlgError:
            break
        y = y - step
        if np.all(np.max(np.abs(step), axis=1) <= 1e-12 * np.maximum(np.max(np.abs(y), axis=1), 1e-6)):
            return y
    raise ControlError(f"plant {equations.plant.name} cannot rest at every {where} of the set")


def _proven(equations: _Equations, y: Taylor, inverse: Float[np.ndarray, "b n n"]) -> Taylor:
    """Return y with a rest that Krawczyk's operator maps into itself; infinite where none was found."""
    first = equations.rates(y).between(inverse, np.eye(1)).size
    one = np.eye(inverse.shape[1])
    low, rough = equations.lower(SLOPES_DEGREE), y.truncated(SLOPES_DEGREE)
    moved, wide = first, first
    for _ in range(WIDENINGS):
        wide = 1.2 * moved + 1e-14 * y.size + 1e-20
        slopes = low.slopes(rough.with_rest(rough.r + wide)).between(inverse, one)
        off = constant(np.broadcast_to(one, inverse.shape).copy(), slopes.basis) - slopes
        moved = first + off.size @ wide
        if np.all(moved <= wide):
            break
    shown = np.all(moved <= wide, axis=1, keepdims=True)
    return y.with_rest(np.where(shown, wide, np.inf))


def _lower(item: Entry, degree: int) -> Entry:
    return item.truncated(degree) if isinstance(item, Taylor) else item


def _centre(item: Entry) -> Entry:
    return constant(item.c, POINT) if isinstance(item, Taylor) else item
