"""Enclosures of a plant's equilibria over boxes of its parameters, about which the bounds linearise it.

At the centre of each box Newton's method solves for the equilibrium, from zero as `seaopt.control.loops.sampled_plant`
does; over the box simplified Newton steps on Taylor models follow, each of which is right to one more degree. That the
equations have a solution next to that polynomial, and only one, is then proven by Krawczyk's test (Computing 4, 1969;
Neumaier, Interval Methods for Systems of Equations, 1990, chapter 5).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from seaopt.errors import ControlError
from seaopt.plants import Plant, jacobians
from seaopt.plants.plant import dynamics_function
from seaopt.records import record
from seaopt.robustness.bounds.enclosure import Entry, assemble_matrix, enclose
from seaopt.robustness.bounds.taylor import Basis, Taylor, build_basis, make_constant

PROOF_NEWTON_STEPS, WIDENINGS = 30, 4
JACOBIAN_DEGREE = 2  # of the models in Krawczyk's test
POINT_BASIS = build_basis(0, 0)


@record(eq=False)
class _RestEquations:
    """The equations of rest: all states but the prescribed one, and the first input, y, such that nothing moves."""

    plant: Plant
    p: Sequence[Entry]
    x: Sequence[Entry]
    loose: tuple[int, ...]
    count: int
    over: Basis

    def fill(self, y: Taylor) -> tuple[list[Entry], list[Entry]]:
        """Return all states and inputs, with y in their places."""
        entries = [y[:, k, 0] for k in range(len(self.x))]
        solved = dict(zip(self.loose, entries[:-1], strict=True))
        inputs: list[Entry] = [entries[-1], *[0.0] * (len(self.plant.inputs) - 1)]
        return [solved.get(k, prescribed) for k, prescribed in enumerate(self.x)], inputs

    def rates(self, y: Taylor) -> Taylor:
        """Return the states' rates, which have to be zero, shape (b, n, 1)."""
        rates = enclose(dynamics_function(self.plant), [*self.fill(y), self.p])
        return assemble_matrix(rates[0], len(self.x), self.count, self.over)

    def jacobian(self, y: Taylor) -> Taylor:
        """Return the derivatives of the rates with respect to y, shape (b, n, n)."""
        blocks = enclose(jacobians(self.plant), [*self.fill(y), self.p])[:2]
        a, b = (assemble_matrix(block, len(self.x), self.count, self.over) for block in blocks)
        columns = list(self.loose)
        parts = ((a.a, b.a), (a.r, b.r))
        return Taylor(
            self.over, *(np.concatenate([left[..., columns], right[..., :1]], axis=-1) for left, right in parts)
        )

    def truncate(self, degree: int) -> _RestEquations:
        """Return the equations on models of a lower degree."""
        return self._convert(lambda model: model.truncate(degree), build_basis(self.over.size, degree))

    def at_centre(self) -> _RestEquations:
        """Return the equations at the centres of the boxes."""
        return self._convert(lambda model: make_constant(model.c, POINT_BASIS), POINT_BASIS)

    def _convert(self, change: Callable[[Taylor], Taylor], over: Basis) -> _RestEquations:
        p, x = (
            [change(entry) if isinstance(entry, Taylor) else entry for entry in entries] for entries in (self.p, self.x)
        )
        return replace(self, p=p, x=x, over=over)


def enclose_equilibrium(
    plant: Plant, p: Sequence[Entry], prescribed: Mapping[str, Entry], count: int, over: Basis
) -> tuple[list[Entry], list[Entry]]:
    """Return enclosures of the states and inputs at rest; infinite where it is not proven that there is one."""
    names = list(plant.states)
    x: list[Entry] = [prescribed.get(name, 0.0) for name in names]
    fixed = [k for k, state in enumerate(x) if isinstance(state, Taylor) or state != 0.0]
    if not fixed:
        return x, [0.0] * len(plant.inputs)
    if len(fixed) > 1:
        raise ControlError(f"{', '.join(names[k] for k in fixed)} are both given; a plant rests at one of them")
    loose = tuple(k for k in range(len(names)) if k not in fixed)
    equations = _RestEquations(plant=plant, p=p, x=x, loose=loose, count=count, over=over)
    middle = equations.at_centre()
    centre = _solve_centre(middle, names[fixed[0]])
    inverse = np.linalg.inv(middle.jacobian(make_constant(centre, POINT_BASIS)).c)
    y, scalar = make_constant(centre, over), np.eye(1)
    for _ in range(over.degree + 1):
        y = y - equations.rates(y).transform(inverse, scalar)
        y = y.with_remainder(np.zeros_like(y.r))
    return equations.fill(_prove(equations, y, inverse))


def _solve_centre(equations: _RestEquations, where: str) -> Float[np.ndarray, "b n 1"]:
    y = np.zeros((equations.count, len(equations.x), 1))
    for _ in range(PROOF_NEWTON_STEPS):
        current = make_constant(y, POINT_BASIS)
        try:
            step = np.linalg.solve(equations.jacobian(current).c, equations.rates(current).c)
        except np.linalg.LinAlgError:
            break
        y = y - step
        if np.all(np.max(np.abs(step), axis=1) <= 1e-12 * np.maximum(np.max(np.abs(y), axis=1), 1e-6)):
            return y
    raise ControlError(f"plant {equations.plant.name} cannot rest at every {where} of the set")


def _prove(equations: _RestEquations, y: Taylor, inverse: Float[np.ndarray, "b n n"]) -> Taylor:
    """Return y with a remainder that Krawczyk's operator maps into itself; infinite where none is found."""
    first = equations.rates(y).transform(inverse, np.eye(1)).size
    identity = np.eye(inverse.shape[1])
    low, rough = equations.truncate(JACOBIAN_DEGREE), y.truncate(JACOBIAN_DEGREE)
    image, wide = first, first
    for _ in range(WIDENINGS):
        wide = 1.2 * image + 1e-14 * y.size + 1e-20
        slopes = low.jacobian(rough.with_remainder(rough.r + wide)).transform(inverse, identity)
        off = make_constant(np.broadcast_to(identity, inverse.shape).copy(), slopes.basis) - slopes
        image = first + off.size @ wide
        if np.all(image <= wide):
            break
    proven = np.all(image <= wide, axis=1, keepdims=True)
    return y.with_remainder(np.where(proven, wide, np.inf))
