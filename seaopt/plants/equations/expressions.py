r"""Expressions as text, such as ``(tau - mgL*sin(theta)) / I_p``, as CasADi expressions: parsed, never executed.

    sum        = term {("+" | "-") term}
    term       = factor {("*" | "/") factor}
    factor     = ["-" | "+"] factor | power
    power      = operand [("^" | "**") factor]
    operand    = number | name | function "(" condition {"," condition} ")" | "(" condition ")"
    condition  = sum [("<" | "<=" | ">" | ">=" | "==" | "!=") sum]

A power binds closer than the sign before it and takes the sign behind it, and a chain of powers starts at its right:
-x^2 is -(x^2), 2^-1 is 0.5, 2^3^2 is 2^9. A condition stands only as the first argument of `if_else`. The parser
climbs precedences (V. R. Pratt, Top down operator precedence, POPL 1973) and builds the expression as it reads.

Length and nesting are limited, so that no text takes long or exhausts a stack. What is a constant and no finite number
(1/0, log(-1), 1e400) is refused where it stands; 0^0 is 1, as in C. What depends on symbols is looked at where they
have values.
"""

from __future__ import annotations

import math
import operator
import re
from collections.abc import Callable, Mapping
from typing import Any

import casadi as ca

from seaopt.errors import PlantError, suggestion
from seaopt.formatting import printable
from seaopt.records import record

MAX_LENGTH = 10_000  # characters
MAX_DEPTH = 60  # brackets, signs and powers inside each other
SHOWN = 50  # characters of a line that an excerpt shows on either side of a mistake

CONSTANTS: Mapping[str, float] = {"pi": math.pi}
# With the fewest and the most arguments (None: any number).
FUNCTIONS: Mapping[str, tuple[Callable[..., Any], int, int | None]] = {
    "sin": (ca.sin, 1, 1),
    "cos": (ca.cos, 1, 1),
    "tan": (ca.tan, 1, 1),
    "tanh": (ca.tanh, 1, 1),
    "exp": (ca.exp, 1, 1),
    "log": (ca.log, 1, 1),
    "sqrt": (ca.sqrt, 1, 1),
    "abs": (ca.fabs, 1, 1),
    "min": (ca.fmin, 2, None),
    "max": (ca.fmax, 2, None),
    "atan2": (ca.atan2, 2, 2),
    "if_else": (ca.if_else, 3, 3),
}
RESERVED = frozenset({*CONSTANTS, *FUNCTIONS})
_REMEDIES = {"sign": 'smooth the jump, as in "tanh(v/v_s)"', "pow": 'write a power as "x^2"', "ln": 'write "log(x)"'}

_COMPARISONS: Mapping[str, Callable[[Any, Any], Any]] = {
    "<": operator.lt,
    "<=": operator.le,
    ">": operator.gt,
    ">=": operator.ge,
    "==": operator.eq,
    "!=": operator.ne,
}
_ARITHMETIC: Mapping[str, Callable[[Any, Any], Any]] = {
    "+": operator.add,
    "-": operator.sub,
    "*": operator.mul,
    "/": operator.truediv,
    "^": operator.pow,
    "**": operator.pow,
}
_COMPARISON, _SUM, _TERM, _SIGN, _POWER = 1, 2, 3, 4, 5
_BINDING = {
    **dict.fromkeys(_COMPARISONS, _COMPARISON), **dict.fromkeys("+-", _SUM), **dict.fromkeys("*/", _TERM),
    **dict.fromkeys(("^", "**"), _POWER),
}  # fmt: skip
_TOKEN = re.compile(
    r"(?P<number>(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?)"
    r"|(?P<name>[^\W\d]\w*)|(?P<sign>\*\*|[<>=!]=|[-+*/^(),<>])|(?P<other>\S)"
)


@record
class Token:
    """A number, a name or a sign of a text, and where it starts; at the end of the text one of kind "end"."""

    kind: str
    text: str
    start: int


Explain = Callable[[str], str | None]  # why a name may not stand in a text; None of a name that is not known at all


def parse(text: str, symbols: Mapping[str, Any], key: str, explain: Explain = lambda name: None) -> Any:
    r"""Return the scalar CasADi expression that a text, of at most 10,000 characters, stands for in the grammar above.
    `symbols`: what it may name, besides the functions and `pi`. `key`: what the text is, for messages, such as
    "f.omega". `explain`: why a name that is not among the symbols may not stand here; None where it is not known.
    Raises PlantError: the text is not in the grammar, names what is not known, is too long, or is no finite number; a
    note of the error shows the place in the text.
    """
    if len(text) > MAX_LENGTH:
        raise PlantError(f"{key} has {len(text)} characters; give at most {MAX_LENGTH}, or use definitions")
    return _Parser(text, symbols, key, explain).read_all()


def list_names(text: str) -> list[str]:
    """Return the names in a text, functions among them, each once."""
    names = (match["name"] for match in _TOKEN.finditer(text[:MAX_LENGTH]))
    return list(dict.fromkeys(name for name in names if name is not None))


class _Parser:
    """Reads one text from left to right."""

    def __init__(self, text: str, symbols: Mapping[str, Any], key: str, explain: Explain) -> None:
        self.text, self.symbols, self.key, self.explain = text, symbols, key, explain
        self.tokens = [
            Token(kind=str(match.lastgroup), text=match[str(match.lastgroup)], start=match.start(str(match.lastgroup)))
            for match in _TOKEN.finditer(text)
        ]
        self.tokens.append(Token(kind="end", text="", start=len(text.rstrip())))
        self.at = 0
        self.conditions: set[int] = set()  # where expressions start that are comparisons

    @property
    def next(self) -> Token:
        """The token that is read next."""
        return self.tokens[self.at]

    def read_all(self) -> Any:
        """Return the whole text's expression."""
        if self.next.kind == "end":
            raise self.error(self.next, 'is empty; give an expression, or "0"')
        value = self.read_number(0, 0)
        if self.next.text == ")":
            raise self.error(self.next, "closes no bracket; take it out, or open one before")
        if self.next.kind != "end":
            raise self.error(self.next, f"expected an operator before {_quote(self.next)}")
        return value

    def take(self) -> Token:
        """Return the next token, and move on."""
        token = self.next
        self.at += 1
        return token

    def read_number(self, binding: int, depth: int) -> Any:
        """Return an expression that is a number and no comparison."""
        start = self.at
        value = self.read(binding, depth)
        if start in self.conditions:
            raise self.error(
                self.tokens[start], "a comparison is no number; it stands only first in if_else(a > b, then, else)"
            )
        return value

    def read(self, binding: int, depth: int) -> Any:
        """Return the expression that starts here, as far as operators bind closer than `binding`."""
        if depth > MAX_DEPTH:
            raise self.error(self.next, f"is nested more than {MAX_DEPTH} deep; use definitions")
        start = self.at
        value = self.read_operand(depth)
        while _BINDING.get(self.next.text, 0) > binding:
            sign = self.take()
            strength = _BINDING[sign.text]
            if start in self.conditions:
                what = "compare two numbers at a time" if strength == _COMPARISON else "a comparison is no number"
                raise self.error(sign, f"{what}; write if_else(a > b, then, else)")
            # What stands behind a power is a factor of its own, so that powers start at their right.
            right = self.read_number(_SIGN, depth + 1) if strength == _POWER else self.read_number(strength, depth)
            if strength == _COMPARISON:
                value = ca.SX(_COMPARISONS[sign.text](value, right))
                self.conditions.add(start)
            else:
                value = self.check_finite(_ARITHMETIC[sign.text](value, right), sign)
        return value

    def read_operand(self, depth: int) -> Any:
        """Return a number, a name, a function of its arguments, a bracket, or one of them with its sign."""
        start, token = self.at, self.take()
        if token.kind == "number":
            return self.read_literal(token)
        if token.kind == "name":
            return self.read_call(token, depth) if self.next.text == "(" else self.find(token)
        if token.text in ("-", "+"):
            value = self.read_number(_SIGN, depth + 1)
            return -value if token.text == "-" else value
        if token.text == "(":
            value = self.read(0, depth + 1)
            if start + 1 in self.conditions:
                self.conditions.add(start)
            self.close(token)
            return value
        if token.kind == "other" or token.text == "!=":
            raise self.error(token, f"{_quote(token)} is not part of an expression; take it out")
        raise self.error(token, f"expected a number, a name or a bracket instead of {_quote(token)}")

    def read_literal(self, token: Token) -> Any:
        """Return a number, refusing what a float cannot hold."""
        value = float(token.text)
        digits = token.text.lower().partition("e")[0]
        if not math.isfinite(value) or (value == 0.0 and digits.strip("0.")):
            size = "large" if value else "small"
            raise self.error(token, f"{token.text[:20]} is too {size} for a number; change its exponent")
        return ca.SX(value)

    def read_call(self, name: Token, depth: int) -> Any:
        """Return a function of the arguments that follow its name."""
        if name.text not in FUNCTIONS:
            if name.text in self.symbols or name.text in CONSTANTS or self.explain(name.text):
                raise self.error(name, f"{_quote(name)} is not a function; write a product with *")
            remedy = _REMEDIES.get(name.text) or suggestion(name.text, FUNCTIONS)
            raise self.error(name, f"unknown function {_quote(name)}; {remedy}")
        function, fewest, most = FUNCTIONS[name.text]
        opening = self.take()
        first, values = self.at, list[Any]()
        while self.next.text != ")" or values:
            conditional = name.text == "if_else" and not values
            values.append(self.read(0, depth + 1) if conditional else self.read_number(0, depth + 1))
            if self.next.text != ",":
                break
            self.take()
        self.close(opening)
        if len(values) < fewest or (most is not None and len(values) > most):
            takes = str(fewest) if most == fewest else f"{fewest} or more"
            raise self.error(name, f"{name.text} takes {takes} argument{'s' * (fewest > 1)}, and has {len(values)}")
        if name.text == "if_else" and first not in self.conditions:
            raise self.error(self.tokens[first], "the first argument of if_else compares; write if_else(a > b, ...)")
        if most is None:
            value = values[0]
            for another in values[1:]:
                value = function(value, another)
        else:
            value = function(*values)
        return self.check_finite(value, name)

    def close(self, opening: Token) -> None:
        """Take the bracket that closes another one."""
        if self.next.kind == "end":
            raise self.error(opening, "this bracket is never closed; add )")
        if self.next.text != ")":
            raise self.error(self.next, f"expected an operator or ) before {_quote(self.next)}")
        self.take()

    def find(self, name: Token) -> Any:
        """Return what a name stands for."""
        if name.text in self.symbols:
            return ca.SX(self.symbols[name.text])
        if name.text in CONSTANTS:
            return ca.SX(CONSTANTS[name.text])
        if name.text in FUNCTIONS:
            raise self.error(name, f"{name.text} is a function; give its argument in brackets")
        reason = self.explain(name.text)
        if reason is not None:
            raise self.error(name, f"{_quote(name)} {reason}")
        raise self.error(name, f"unknown name {_quote(name)}; {suggestion(name.text, self.symbols)}")

    def check_finite(self, value: Any, token: Token) -> Any:
        """Refuse a constant that is no finite number, also one that CasADi has drawn into a product or a sum."""
        parts = (value, *(value.dep(index) for index in range(value.n_dep())))
        for part in parts:
            if part.is_constant() and not math.isfinite(float(part)):
                raise self.error(token, f"the result of {_quote(token)} is {float(part)}; it must be a finite number")
        return value

    def error(self, token: Token, what: str) -> PlantError:
        """Return an error at a token, with the line of the text and a caret below it as a note."""
        first = self.text.rfind("\n", 0, token.start) + 1
        line, column = self.text[first:].split("\n", 1)[0], token.start - first
        row = self.text.count("\n", 0, token.start) + 1
        where = f"column {column + 1}" if "\n" not in self.text.strip() else f"line {row}, column {column + 1}"
        error = PlantError(f"{self.key}, {where}: {what}")
        cut = max(0, column - SHOWN)
        before = f"{self.key} = " + "..." * (cut > 0) + printable(line[cut:column].replace("\t", " "))
        after = printable(line[column : column + SHOWN].replace("\t", " ")) + "..." * (len(line) > column + SHOWN)
        error.add_note(f"    {before}{after}\n    {' ' * len(before)}^")
        return error


def _quote(token: Token) -> str:
    return f'"{token.text[:SHOWN]}"' if token.kind != "end" else "the end"
