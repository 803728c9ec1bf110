"""Records whose fields are arrays with a row per draw, box or arc: some of the rows, and several records as one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from typing import Any, TypeVar

import numpy as np

Rows = TypeVar("Rows")


def take_rows(rows: Rows, index: Any) -> Rows:
    """Return the rows at an index: of whole numbers, a mask, or a slice."""
    kind: Any = type(rows)
    return kind(**{each.name: getattr(rows, each.name)[index] for each in fields(kind)})


def join_rows(parts: Sequence[Rows]) -> Rows:
    """Return the rows of several records in one."""
    kind: Any = type(parts[0])
    return kind(**{each.name: np.concatenate([getattr(part, each.name) for part in parts]) for each in fields(kind)})
