"""Equations as text: against Python's own evaluation of the same text, and whatever text is given."""

from __future__ import annotations

import contextlib
import math
import pickle
import time
from types import SimpleNamespace

import casadi as ca
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from seaopt.errors import PlantError, SeaoptError
from seaopt.plants.equations.expressions import FUNCTIONS, MAX_LENGTH, list_names, parse
from seaopt.plants.equations.stored_equations import store_function

X, Y = 0.7, -1.3
SYMBOLS = {"x": ca.SX.sym("x"), "y": ca.SX.sym("y")}
PYTHON = {name: getattr(math, name) for name in FUNCTIONS if hasattr(math, name)}
PYTHON |= {"abs": math.fabs, "min": min, "max": max, "if_else": lambda c, a, b: a if c else b, "pi": math.pi}


class NotFiniteError(Exception):
    """A constant that is no real number, which Python lets pass where nothing comes of it."""


def value(text, x=X, y=Y):
    try:
        expression = parse(text, SYMBOLS, "f.x")
    except PlantError as error:
        if "finite" in str(error):
            raise NotFiniteError from error
        raise
    function = ca.Function("value", list(SYMBOLS.values()), [expression])
    return float(function(x, y))


def refused(text):
    with pytest.raises(PlantError) as raised:
        parse(text, SYMBOLS, "f.x")
    assert "\n" not in str(raised.value)
    return raised.value


def by_python(text, x):
    return eval(text.replace("^", "**"), {"__builtins__": {}}, {**PYTHON, "x": x, "y": Y})


def combined(inner):
    sign = st.sampled_from(["", "-", "+", "--"])
    operator = st.sampled_from([" + ", "-", "*", " / ", "^", "**", "-", "*"])
    chain = st.lists(st.tuples(sign, inner, operator), min_size=1, max_size=4)
    chains = st.tuples(chain, inner).map(lambda parts: "".join(a + b + c for a, b, c in parts[0]) + parts[1])
    compared = st.tuples(inner, st.sampled_from(["<", "<=", " > ", ">="]), inner).map("".join)
    return st.one_of(
        chains,
        inner.map("({})".format),
        st.tuples(st.sampled_from(["sin", "cos", "tanh", "exp", "log", "sqrt", "abs", "tan"]), inner).map(
            "%s(%s)".__mod__
        ),
        st.tuples(st.sampled_from(["min", "max", "atan2"]), inner, inner).map("%s(%s, %s)".__mod__),
        st.tuples(inner, inner, inner).map("max(%s,%s,%s)".__mod__),
        st.tuples(compared, inner, inner).map("if_else(%s, %s, %s)".__mod__),
    )


LEAVES = st.one_of(st.sampled_from(["x", "y", "pi", "2", ".5", "3.", "1e-1", "0.25E+1"]), st.floats(0.1, 9).map(repr))
TEXTS = st.recursive(LEAVES, combined, max_leaves=12)


@settings(max_examples=200)
@given(TEXTS)
def test_a_text_has_the_value_that_python_gives_it(text):
    """Precedence, associativity and every function, on random texts without brackets that would hide them."""
    try:
        expected, beside = (by_python(text, x) for x in (X, X * (1 + 1e-12)))
    except (ArithmeticError, ValueError, TypeError):  # no real number
        return
    if isinstance(expected, complex) or not abs(expected) < 1e9 or abs(expected - beside) > 1e-6 * abs(expected):
        return
    found = expected
    with contextlib.suppress(NotFiniteError):
        found = value(text)
    assert found == pytest.approx(expected, rel=1e-7, abs=1e-9), text


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("-x^2", -(X**2)), ("2^-1", 0.5), ("2^3^2", 512), ("-2^-2", -0.25), ("x - y - 1", X - Y - 1),
        ("x/y/2", X / Y / 2),
        ("2*-x", -2 * X), ("--x", X), ("x\n\t+ y", X + Y), ("((x))", X), ("min(3, x, 2)", X), ("x**2", X**2),
        ("if_else(x > y, x, 5)", X), ("if_else((x < y), x, 5)", 5), ("if_else(x == x, 1, 2)", 1),
        ("if_else(x != y, 1, 2)", 1), ("0^0", 1), (f"{10**18}", 1e18), ("00.5", 0.5),
    ],
)  # fmt: skip
def test_what_a_text_means(text, expected):
    assert value(text) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("text", "column", "word"),
    [
        ("x + yy", 5, 'did you mean "y"'), ("x + ", 4, "the end"), ("sine(x)", 1, 'did you mean "sin"'),
        ("2x", 2, "operator"),
        ("x y", 3, "operator"), ("(x", 1, "never closed"), ("x)", 2, "closes no"), ("", 1, "empty"),
        ("x(y)", 1, "product"),
        ("sign(x)", 1, "tanh"), ("sin", 1, "brackets"), ("sin(x, y)", 1, "takes 1"), ("min(x)", 1, "2 or more"),
        ("sin()", 1, "takes 1"), ("min(x,)", 7, "expected"), ("x > y", 1, "if_else"), ("(x > y)*2", 8, "if_else"),
        ("if_else(x, 1, 2)", 9, "compares"), ("if_else(0 < x < 1, 1, 2)", 15, "two numbers"),
        ("if_else(x > 0, y > 0, 1)", 16, "comparison"), ("x = 1", 3, "operator"), ("x.real", 2, "operator"),
        ("x!", 2, "!"),
        ("1/0", 2, "inf"), ("log(-1)", 1, "nan"), ("x/(1 - 1)", 2, "finite"), ("sqrt(-1)*0", 1, "nan"),
        ("x*1e308*10", 8, "inf"),
        ("1e400", 1, "too large"), ("1e-400", 1, "too small"), ("9" * 5000, 1, "too large"), ("x;y", 2, ";"),
        ("'x'", 1, "'"),
        ("[x]", 1, "["), ("lambda: x", 1, "lambda"), ("__import__('os')", 1, "__import__"), ("0x10", 2, "operator"),
    ],
)  # fmt: skip
def test_a_mistake_is_pointed_at(text, column, word):
    error = refused(text)
    assert str(error).startswith(f"f.x, column {column}: ") and word in str(error)
    line, caret = error.__notes__[0].splitlines()
    if text and column <= len(text.rstrip()):
        assert line[caret.index("^")] == text[column - 1]


def test_the_line_of_a_long_text_is_shown():
    error = refused("x +\n  " + "y + " * 100 + "z + x\n")
    assert str(error).startswith("f.x, line 2, column 403: ")
    line, caret = error.__notes__[0].splitlines()
    assert line[caret.index("^")] == "z" and len(line) < 130


@pytest.mark.parametrize(
    "text",
    ["(" * 200_000 + "x", "-" * 5000 + "x", "x^" * 4000 + "x", "sin(" * 2000, "x" * 1_000_000, "+" * 10_000,
     " " * 10_000,
     "if_else(" * 1000, "min(x, " * 1200, "2*(x+" * 1500, "9" * 1_000_000],
)  # fmt: skip
def test_no_text_exhausts_the_stack_or_takes_long(text):
    start = time.process_time()
    refused(text)
    assert time.process_time() - start < 2.0


def test_a_long_sum_is_read():
    text = "+x" * (MAX_LENGTH // 2)
    assert value(text) == pytest.approx(X * MAX_LENGTH / 2)


PIECES = [*"xy12.e+-*/^()<>=!, \n", "sin(", "if_else(", "max(", "\u00e9", "\x00"]


@settings(max_examples=150)
@given(st.lists(st.sampled_from(PIECES), max_size=30).map("".join) | st.text())
def test_whatever_text_is_read_or_refused(text):
    with contextlib.suppress(SeaoptError):
        assert parse(text, SYMBOLS, "f.x").is_scalar()
    assert len(list_names(text)) <= len(text)


@given(TEXTS, st.integers(0, 80), st.sampled_from("()^*,.<x1 \x00é"))
def test_one_character_amiss(text, place, character):
    changed = text[:place] + character + text[place + 1 :]
    with contextlib.suppress(SeaoptError):
        parse(changed, SYMBOLS, "f.x")


def test_names_that_may_not_stand_here_are_explained():
    with pytest.raises(PlantError, match='"q" is a state, and not for you'):
        parse("x*q", SYMBOLS, "effort", {"q": "is a state, and not for you"}.get)


def test_derivatives_are_those_of_the_mathematics():
    """By central differences, away from the kinks of abs, min, max and if_else."""
    for text in (
        "x^3*y",
        "abs(y)^1.5",
        "tanh(x/0.1)",
        "if_else(x > 0, x^2, -x)",
        "max(x, y)*min(x, y)",
        "atan2(y, x)",
        "2^x",
    ):
        slope = ca.Function("slope", list(SYMBOLS.values()), [ca.jacobian(parse(text, SYMBOLS, "f"), SYMBOLS["x"])])
        assert float(slope(X, Y)) == pytest.approx(
            (value(text, X + 1e-6) - value(text, X - 1e-6)) / 2e-6, rel=1e-6, abs=1e-9
        )


def test_slopes_at_a_switch_are_those_that_the_documentation_states():
    def slope(text, at):
        return float(
            ca.Function("s", list(SYMBOLS.values()), [ca.jacobian(parse(text, SYMBOLS, "f"), SYMBOLS["x"])])(at, 0)
        )

    assert slope("abs(x)", 0.0) == 0.0 and slope("max(x, 0)", 0.0) == 0.5
    assert (slope("if_else(x > 0, x, 0)", 0.0), slope("if_else(x >= 0, x, 0)", 0.0)) == (0.0, 1.0)
    for x in (-1.0, 0.0):
        assert slope("if_else(x > 0, sqrt(x), 0)", x) == slope("if_else(x > 0, log(x), 0)", x) == 0.0
    assert math.isnan(slope("sqrt(max(x, 0))", -1.0))


def test_a_function_stored_as_expressions_survives_pickling():
    again = pickle.loads(pickle.dumps(store_function(lambda x, p: {"v": p.k * x.q}, ["q", "v"], ["k"])))
    assert float(again(SimpleNamespace(q=2.0, v=0.0), SimpleNamespace(k=3.0))["v"]) == 6.0
