"""Shared fixtures. Functions and records that have arrays are checked while the tests run (jaxtyping and beartype).

Types without arrays are what basedpyright proves in `make types`, strictly; shapes it does not know. A check of one
call costs about 0.1 ms, more than most functions here: see `check_calls`. SEAOPT_TYPES=0 leaves all out, and
SEAOPT_TYPES=all checks every function, for a fifth more of the tests' time.
"""

from __future__ import annotations

import dataclasses
import functools
import gc
import inspect
import os
import re
import sys
import tempfile
from collections import defaultdict
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from types import CodeType, FunctionType, ModuleType, SimpleNamespace
from typing import Any, Literal, get_args, get_type_hints

os.environ.setdefault("SEAOPT_CACHE_DIR", tempfile.mkdtemp(prefix="seaopt-tests-"))
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # threads cost these small problems more than they bring

import jaxtyping
import pytest
from beartype import BeartypeConf, FrozenDict, beartype
from hypothesis import settings

gc.set_threshold(10_000)  # new objects between collections: the default takes a tenth of the tests' time

# A whole number is a float, and choices are strings: the tests give wrong ones on purpose, to see seaopt's own errors.
CHOICES = (
    ("unlumped", "lumped"),
    ("link1", "link2"),
    ("fixed", "mass", "pendulum"),
    ("free", "locked", "pendulum"),
    ("double", "float"),
    ("zero", "first"),
    ("split", "error"),
    ("auto", "declared", "none"),
    ("pd", "pid", "pid_dob", "cascade", "custom"),
    ("P", "PI"),
    ("first_order", "second_order"),
    ("error", "measurement"),
    ("disturbance", "noise"),
)
PARTS = (
    "stribeck", "load_friction", "load_stribeck", "load_square", "lugre", "hysteresis", "backlash", "hardening",
    "spring_damping", "screw_mode", "droop", "falling_torque", "friction_drift", "friction_direction", "back_driving",
    "cogging", "stand", "current_loop", "load_cell", "sensor_filter", "command_delay",
    "measurement_delay", "voltage_input", "duty_input", "supply_input", "supply_sag", "inductance", "position_servo",
    "servo_integral", "servo_limit", "servo_hold", "servo_sample", "servo_delay", "deflection_sensor", "thermal",
)  # fmt: skip
OVERRIDES = FrozenDict({Literal[choices]: str for choices in (*CHOICES, PARTS)})
checker = ModuleType("seaopt_type_checker")
checker.check = beartype(conf=BeartypeConf(is_pep484_tower=True, hint_overrides=OVERRIDES))
sys.modules["seaopt_type_checker"] = checker

CHECKED = os.environ.get("SEAOPT_TYPES", "shapes")
EVERY = 200
NAME = re.compile(r"[A-Za-z_]\w*")
Key = tuple[str, str, CodeType]
left: defaultdict[Key, list[int]] = defaultdict(lambda: [0])  # calls of a function until one that is checked
begun: list[list[int]] = []  # those of this test
made: dict[Key, FunctionType] = {}  # checks of functions inside others: making one takes longer than many calls


def make_checked(function):
    """Return a function that checks its arguments once; those that jaxtyping makes do so again with the result."""
    function.__annotations__ = {name: resolve(hint, function) for name, hint in function.__annotations__.items()}
    return checker.check(function)


def bind(checked, function):
    """Return the check of a function as one of another that has the same code: of one made anew inside a function."""
    given = checked.__kwdefaults__ or {}
    (name,) = [name for name, value in given.items() if value is checked.__wrapped__]
    again = FunctionType(checked.__code__, checked.__globals__, closure=checked.__closure__)
    again.__kwdefaults__ = given | {name: function}
    return again


def resolve(hint, function):
    """Return an annotation as a type; Any where its names are known to type checkers alone."""
    one = SimpleNamespace(__annotations__={"hint": hint})
    try:
        return get_type_hints(one, function.__globals__, include_extras=True)["hint"]
    except NameError:
        return Any


def has_arrays(function) -> bool:
    """Tell whether a function takes or returns arrays of stated shapes, alone or in other types."""
    names = {name for hint in function.__annotations__.values() for name in NAME.findall(str(hint))}
    return any(is_of_arrays(function.__globals__.get(name)) for name in names)


def is_of_arrays(hint) -> bool:
    """Tell whether a type is one of jaxtyping's, or holds one."""
    if isinstance(hint, type):
        return hint.__module__ == "jaxtyping"
    return any(map(is_of_arrays, get_args(hint)))


def check_calls(function):
    """Check a function's first call in each test, then one in `EVERY`; a class's constructor's.

    Checking each call takes half of the tests' time. What is defined inside a function counts as one function.
    """
    if inspect.isclass(function):
        if dataclasses.is_dataclass(function) and "__init__" in vars(function):
            function.__init__ = check_calls(function.__init__)
        return function
    if inspect.isgeneratorfunction(function):  # checked where it is first advanced, among somebody else's shapes
        return function
    if CHECKED != "all" and not has_arrays(function):
        return function
    key = (function.__module__, function.__qualname__, function.__code__)  # constructors of records may have equal code
    wait, checked = left[key], None

    def check(*args, **kwargs):
        nonlocal checked
        wait[0] = EVERY - 2
        begun.append(wait)
        if checked is None:
            before = made.get(key)
            checked = make_checked(function) if before is None else bind(before, function)
            if before is None and checked is not function and "<locals>" in function.__qualname__:
                made[key] = checked
        with shapes_of_one_call():
            return checked(*leave_out_defaults(function, args, kwargs), **kwargs)

    call = write_counter(*describe_parameters(function.__code__))(wait, function, check)
    call.__defaults__, call.__kwdefaults__ = function.__defaults__, function.__kwdefaults__
    return functools.wraps(function)(call)


def leave_out_defaults(function, args: tuple, kwargs: dict[str, Any]) -> tuple:
    """Return what is given by position, without the defaults at its end, and take those out of what is given by name:
    one may be of another type, as the mark of a field that is made anew for each record.
    """
    for name, value in (function.__kwdefaults__ or {}).items():
        if kwargs.get(name, function) is value:
            del kwargs[name]
    defaults, most = function.__defaults__ or (), function.__code__.co_argcount
    if len(args) == most:  # else more follow
        while defaults and args[-1] is defaults[-1]:
            args, defaults = args[:-1], defaults[:-1]
    return args


def describe_parameters(code: CodeType) -> tuple[str, str]:
    """Return a function's parameters, as they are taken and as they are handed on."""
    names, named = list(code.co_varnames), code.co_argcount + code.co_kwonlyargcount
    first, more = names[: code.co_argcount], names[code.co_argcount : named]
    rest = names[named:]
    starred = f"*{rest.pop(0)}" if code.co_flags & inspect.CO_VARARGS else ""
    doubled = f"**{rest.pop(0)}" if code.co_flags & inspect.CO_VARKEYWORDS else ""
    bare, slash = ("*" if more and not starred else ""), ("/" if code.co_posonlyargcount else "")
    alone = code.co_posonlyargcount
    taken = (*first[:alone], slash, *first[alone:], starred or bare, *more, doubled)
    given = (*first, starred, *(f"{name}={name}" for name in more), doubled)
    return ", ".join(filter(None, taken)), ", ".join(filter(None, given))


@cache
def write_counter(taken: str, given: str) -> Callable[..., FunctionType]:
    """Return what makes the call of a function that is checked when its wait is over. With the function's parameters in
    place of ``*args, **kwargs`` a call that is not checked costs a third; calls take a tenth of the tests' time.
    """
    lines = (
        "def make(_wait, _function, _check):",
        f"    def call({taken}):",
        "        if _wait[0] > 0:",
        "            _wait[0] -= 1",
        f"            return _function({given})",
        f"        return _check({given})",
        "    return call",
    )
    made_here: dict[str, Any] = {}
    exec("\n".join(lines), made_here)
    return made_here["make"]


def pytest_collection_finish() -> None:
    """Keep the garbage collector from what collection made, which stays: it would walk all of it again and again."""
    gc.freeze()


def pytest_runtest_setup() -> None:
    """Count calls anew, so that what a test checks does not depend on the tests before it."""
    for wait in begun:
        wait[0] = 0
    begun.clear()


shapes_of_one_call = partial(jaxtyping.jaxtyped, "context")
jaxtyping.jaxtyped = lambda typechecker: check_calls
if CHECKED != "0":  # long tests make calls that the quick ones have had checked
    jaxtyping.install_import_hook("seaopt", "seaopt_type_checker.check")

import seaopt as so  # noqa: E402
from seaopt.bench import PAPER_STAND  # noqa: E402
from seaopt.simulation.native import find_compiler  # noqa: E402
from tests import simulated_logs  # noqa: E402
from tests.checks import leave_out_hypotheses  # noqa: E402

settings.register_profile("seaopt", deadline=None, max_examples=25, derandomize=True)
settings.load_profile("seaopt")

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"
NO_DATA = f"measured logs are not at {DATA}"


@pytest.fixture(scope="session")
def compiler() -> list[str]:
    """Return the command of a C compiler, or skip."""
    found = find_compiler()
    if found is None:
        pytest.skip("no C compiler on this machine")
    return found


@pytest.fixture(scope="session")
def data() -> Path:
    """Return the folder of measured logs, or skip."""
    if not DATA.is_dir():
        pytest.skip(NO_DATA)
    return DATA


@pytest.fixture(scope="session")
def simulated(tmp_path_factory) -> Callable[[str], Path]:
    """Return a function that gives a folder of simulated logs, laid out as the one of measured logs of its name."""
    root = tmp_path_factory.mktemp("simulated")

    @cache
    def write(name: str) -> Path:
        getattr(simulated_logs, f"write_{name}")(root / name)
        return root / name

    return write


@pytest.fixture(params=["measured", "simulated"])
def recorded(request, simulated) -> Callable[[str], Path]:
    """Return a function that gives a folder of logs: measured, skipped where there is none, and then simulated."""
    if request.param == "simulated":
        return simulated
    data = request.getfixturevalue("data")
    return lambda name: data / name


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Say how many tests were left out for want of the measured logs."""
    count = sum(NO_DATA in str(report.longrepr) for report in terminalreporter.stats.get("skipped", []))
    if count:
        terminalreporter.write_line(
            f"{count} test{'s' if count > 1 else ''} on measured logs left out: ../shared/data is not there "
            "(the same kinds of log were simulated)",
            yellow=True,
        )


@pytest.fixture(scope="session")
def thor() -> so.ParameterSet:
    return so.plants.thor()


@pytest.fixture(scope="session")
def stand() -> so.Plant:
    return so.plants.high_impedance()


@pytest.fixture(scope="session")
def swing() -> so.Plant:
    return so.plants.moving_output()


@pytest.fixture(scope="session")
def stand_log(stand, thor) -> so.Log:
    """Return the paper's 164 s experiment with 2 N noise, 65,600 samples."""
    sensors = so.Sensors(noise_std={"F1": 2.0, "F2": 2.0}, offset={"F1": 3.0})
    return so.virtual_log(stand, thor, PAPER_STAND, duration_s=164, rate_hz=400, seed=11, sensors=sensors)


@pytest.fixture(scope="session")
def short_log(stand, thor) -> so.Log:
    sensors = so.Sensors(noise_std={"F1": 2.0, "F2": 2.0}, offset={"F1": 3.0})
    return so.virtual_log(stand, thor, PAPER_STAND, duration_s=20, rate_hz=400, seed=12, sensors=sensors)


@pytest.fixture
def without_hypotheses(monkeypatch):
    """Let fits try no part that the model may lack."""
    leave_out_hypotheses(monkeypatch)


@pytest.fixture
def without_causes(monkeypatch, without_hypotheses):
    """Let fits look for nothing that explains a misfit better, neither a part nor a wrong value."""
    monkeypatch.setattr("seaopt.estimation.judgement.judge.find_causes", lambda *_, **__: [])


@pytest.fixture
def without_drawing(monkeypatch):
    """Let reports have empty figures: drawing takes most of their time."""
    from seaopt.reporting.page.chart import Chart

    def leave_empty(panel):
        return Chart(
            name=panel.name,
            title=panel.title,
            caption=panel.caption,
            link="",
            svg="<svg></svg>",
            axes="",
            hover="",
            key=(),
        )

    monkeypatch.setattr("seaopt.reporting.drawing.render_figure", lambda figure, kind: b"<svg></svg>")
    monkeypatch.setattr("seaopt.reporting.page.report.make_chart", leave_empty)
    monkeypatch.setattr("seaopt.reporting.page.report.compose_sheet", lambda panels, **_: SimpleNamespace(axes=()))
