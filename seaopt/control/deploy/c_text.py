"""Text of C and MATLAB files: names that C takes, numbers that read back as they are, comments, and templates."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from functools import cache
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from seaopt.control.laws.command import Command
from seaopt.errors import ControlError

if TYPE_CHECKING:
    from jinja2 import Environment

Precision = Literal["double", "float"]
Writer = Callable[[float], str]  # of a number as C has it
LARGEST_NUMBER = {"double": np.finfo(np.float64).max, "float": np.finfo(np.float32).max}
LONGEST_NAME = 25  # C99 promises 31 characters of an external name, and ours end in _reset
RESERVED = (
    # Keywords of C99 (ISO/IEC 9899:1999, 6.4.1), C11, C23 and C++ that could begin a file; headers of C23 (7.1.2).
    "auto break case char const continue default do double else enum extern float for goto if inline int long register "
    "restrict return short signed sizeof static struct switch typedef union unsigned void volatile while bool true "
    "false nullptr constexpr typeof alignas alignof thread_local static_assert asm class delete export friend mutable "
    "namespace new operator private protected public template this throw try catch typename using virtual wchar_t main "
    "assert complex ctype errno fenv inttypes iso646 limits locale math setjmp signal stdalign stdarg stdatomic "
    "stdbit stdbool stdckdint stddef stdint stdio stdlib stdnoreturn string tgmath threads time uchar wchar wctype"
)


def check_prefix(name: str) -> str:
    """Return a name that files and names in C begin with; one that C does not take as it is is refused."""
    if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", name):
        raise ControlError(
            f'name = "{name}" cannot begin a name in C; give a letter, then letters, digits and underscores: force_law'
        )
    return identifier(name)


def identifier(name: str) -> str:
    """Return a name that C takes, made of one that it may not take."""
    made = re.sub(r"[^A-Za-z0-9]+", "_", name).strip("_")
    if not made or made[0].isdigit() or len(made) > LONGEST_NAME:
        raise ControlError(
            f'name = "{name}" cannot begin a name in C; give a letter and up to {LONGEST_NAME - 1} letters or digits'
        )
    if made.lower() in RESERVED.split():
        raise ControlError(f'name = "{name}" is a keyword or a header of C; give another, such as {made}_law')
    return made


def strip_markup(text: str) -> str:
    """Return text without what would begin or end a comment."""
    return re.sub(r"[^\w .,:;+()<>=/-]", "", str(text), flags=re.ASCII).replace("//", "").strip("/")


def literal(precision: Precision) -> Writer:
    """Return what writes a number as a C literal that reads back as itself (in float: as the nearest float)."""
    if precision == "double":
        return lambda value: repr(float(value))

    def single(value: float) -> str:
        text = repr(float(str(np.float32(value))))
        return f"{text}f"

    return single


def render(template: str, context: Mapping[str, Any]) -> str:
    """Return a template of this package filled in."""
    return _make_environment().get_template(template).render(context)


@cache
def _make_environment() -> Environment:
    """Return what keeps the templates that it has compiled."""
    from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape

    return Environment(
        autoescape=select_autoescape(default=False),
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        undefined=StrictUndefined,
        loader=PackageLoader("seaopt.control.deploy"),
    )


def name_unit(command: Command) -> str:
    """Return the unit of the reference as a part of names in C."""
    return re.sub("[^A-Za-z0-9]+", "_per_", command.reference_unit.replace(" ", "")).strip("_")
