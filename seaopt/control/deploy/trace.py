"""Python code that computes with numbers, written down as C: operations are recorded in the order they are done."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.lib.mixins import NDArrayOperatorsMixin

from seaopt.control.deploy.c_text import Writer

SIGNS = {np.add: "+", np.subtract: "-", np.multiply: "*", np.true_divide: "/"}


@dataclass(frozen=True, slots=True)
class Term(NDArrayOperatorsMixin):
    """A number in the C code: its name, and the trace that it belongs to."""

    trace: Trace
    text: str

    def __array_ufunc__(self, ufunc: Any, _method: str, *sides: Any, **_out: Any) -> Term:  # `out`: of +=
        if ufunc is np.negative:
            return self.trace.keep(f"-{self.text}", [self.text])
        return self.trace.combine(sides[0], SIGNS[ufunc], sides[1])


@dataclass(slots=True)
class Trace:
    """The operations so far, each a constant of C with the names that it is made of."""

    number: Writer
    lines: dict[str, tuple[str, list[str]]] = field(default_factory=dict)

    def combine(self, left: Any, sign: str, right: Any) -> Term:
        """Record an operation."""
        texts = [self.write(side) for side in (left, right)]
        return self.keep(f"{texts[0]} {sign} {texts[1]}", texts)

    def keep(self, expression: str, parts: list[str]) -> Term:
        """Record an expression under a name of its own."""
        name = f"t{len(self.lines) + 1}"
        self.lines[name] = (expression, parts)
        return Term(self, name)

    def choose(self, first: Any, sign: str, other: Any) -> Term:
        """Record the first of two numbers where it compares so with the other, else that."""
        texts = [self.write(side) for side in (first, other)]
        return self.keep(f"({texts[0]} {sign} {texts[1]}) ? {texts[0]} : {texts[1]}", texts)

    def write(self, value: Any) -> str:
        """Return a term or a number as C has it."""
        return value.text if isinstance(value, Term) else self.number(float(value))

    def list_needed(self, results: Iterable[str]) -> list[str]:
        """Return the lines that some results need, in order."""
        needed = set(results)
        for name in reversed(self.lines):
            if name in needed:
                needed.update(self.lines[name][1])
        return [f"const real {name} = {text};" for name, (text, _) in self.lines.items() if name in needed]
