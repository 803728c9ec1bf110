"""The tanh of compiled passes against the C library's, which is within an ulp of the truth."""

import ctypes
from importlib.resources import files

import numpy as np
import pytest

from seaopt.simulation.native import load_library

SOURCE = (
    "#include <math.h>\n"
    + files("seaopt.simulation").joinpath("tanh.h").read_text(encoding="utf-8")
    + """
__attribute__((visibility("default"))) void map_tanh(const double *x, double *y, long n) {
    for (long i = 0; i < n; i++) y[i] = seaopt_tanh(x[i]);
}
"""
)


def map_tanh(x: np.ndarray) -> np.ndarray:
    library = load_library(SOURCE, "map_tanh")
    if library is None:
        pytest.skip("no C compiler")
    x = np.ascontiguousarray(x, dtype=float)
    y = np.empty_like(x)
    library.map_tanh(ctypes.c_void_p(x.ctypes.data), ctypes.c_void_p(y.ctypes.data), ctypes.c_long(x.size))
    return y


def test_tanh_is_within_two_ulps_of_one() -> None:
    places = np.arange(641) / 32.0  # and where two polynomials meet
    between = np.nextafter(places[:-1] + 1 / 64, [0.0]), np.nextafter(places[:-1] + 1 / 64, [30.0])
    x = np.concatenate([places, *between, np.linspace(0.0, 21.0, 300_001)])
    for sign in (1.0, -1.0):
        assert np.max(np.abs(map_tanh(sign * x) - np.tanh(sign * x))) < 4.5e-16


def test_tanh_keeps_small_arguments_to_their_last_digits() -> None:
    x = np.concatenate([np.geomspace(1e-300, 0.5, 20_001), -np.geomspace(1e-300, 0.5, 20_001)])
    assert np.max(np.abs(map_tanh(x) / np.tanh(x) - 1.0)) < 2e-15


def test_tanh_of_what_is_no_number_or_has_no_end() -> None:
    y = map_tanh(np.array([0.0, -0.0, np.inf, -np.inf, 1e308, np.nan, 20.0, 19.99999]))
    assert list(y[:5]) == [0.0, 0.0, 1.0, -1.0, 1.0]
    assert np.signbit(y[1])
    assert np.isnan(y[5])
    assert y[6] == 1.0
    odd = np.frombuffer(np.array([0x7FF8_0000_0000_03FF, 0xFFF0_0000_0000_02AB], dtype=np.uint64).tobytes())
    assert np.all(np.isnan(map_tanh(odd)))  # other bits of what is no number lead beyond the places that count
