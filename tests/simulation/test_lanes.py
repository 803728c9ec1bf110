"""Operations on numbers in lanes, as kernels make them, against CasADi's interpreter."""

import ctypes
from importlib.resources import files

import casadi as ca
import numpy as np
import pytest

from seaopt.simulation.integrator import write_in_lanes
from seaopt.simulation.native import load_library

PROBE = """
__attribute__((visibility("default"))) void probe(const double *x, double *r) {
    lanes at[2], out[ROWS];
    memcpy(at, x, sizeof at);
    operations(at, out);
    memcpy(r, out, sizeof out);
}
"""


def read_header(name: str) -> str:
    return files("seaopt.simulation").joinpath(name).read_text(encoding="utf-8")


def test_operations_in_lanes_are_casadis():
    x, y = ca.SX.sym("x"), ca.SX.sym("y")
    values = [
        x + y, x - y, x * y, x / y, -x, x * x, x + x, 1.0 / x, ca.tanh(x), ca.sin(x), ca.cos(x), ca.tan(x), ca.exp(x),
        ca.log(y), ca.sqrt(y), ca.fabs(x), y**x, y**0.3, ca.sign(x), ca.atan(x), ca.atan2(x, y), ca.fmin(x, y),
        ca.fmax(x, y), ca.floor(x), ca.ceil(x), x < y, x <= y, ca.eq(x, y), ca.ne(x, y), ca.logic_not(x),
        ca.logic_and(x, y), ca.logic_or(x, y), ca.if_else(x < y, ca.sinh(x), ca.cosh(y)), ca.copysign(y, x),
        ca.SX(2.5), ca.if_else(x > 0.0, x, -3.0 * x),
    ]  # fmt: skip
    function = ca.Function("operations", [ca.vertcat(x, y)], [ca.vertcat(*values)])
    code = write_in_lanes(function)
    assert code
    head = f"#include <math.h>\n#include <string.h>\n#define ROWS {len(values)}\n"
    library = load_library(head + "".join(map(read_header, ("sums.h", "tanh.h", "lanes.h"))) + code + PROBE, "probe")
    if library is None:
        pytest.skip("no C compiler")
    points = np.array([[-1.7, 0.0, 0.4, 3.0], [0.8, 2.0, 0.4, 1e-3]])
    results = np.empty((len(values), 4))
    library.probe(ctypes.c_void_p(points.ctypes.data), ctypes.c_void_p(results.ctypes.data))
    assert results == pytest.approx(np.array(function.map(4)(points)), rel=1e-14, abs=1e-15)


def test_what_lanes_have_not_is_left_to_casadi():
    x = ca.SX.sym("x")
    assert write_in_lanes(ca.Function("operations", [x], [ca.erf(x)])) == ""
