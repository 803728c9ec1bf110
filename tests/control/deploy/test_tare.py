"""The exported tare, compiled: its zero and bound at rest, and what it refuses."""

from __future__ import annotations

import ctypes
import subprocess

import numpy as np
import pytest

from seaopt.control.deploy.export import export
from seaopt.control.deploy.target import Tare
from seaopt.control.laws.plausibility import SIGMAS
from seaopt.errors import ControlError
from tests.c_code import CONVERSIONS, STRICT

NOISE, LIMIT, COUNT = 2.0, 50.0, 500
BUSY, DONE, MOVED, BEYOND = range(4)
DRIVER = """
#include "law_tare.h"
int run(const double *readings, unsigned long count, double *out)
{
    law_tare tare;
    unsigned long k;
    law_tare_init(&tare);
    for (k = 0; k < count; k++) law_tare_add(&tare, readings[k]);
    out[0] = tare.zero;
    out[1] = tare.bound;
    out[2] = LAW_TARE_BOUND;
    return tare.status;
}
"""


@pytest.fixture(scope="module")
def tare(compiler, tuned, tmp_path_factory):
    """Return a call that gives readings to the compiled tare: status, zero, bound, the largest bound."""
    folder = tmp_path_factory.mktemp("tare")
    export(tuned, folder, name="law", tare=Tare(noise=NOISE, limit=LIMIT, duration_s=0.5))
    (folder / "driver.c").write_text(DRIVER)
    flags = [*STRICT, *CONVERSIONS, "-O2", "-shared", "-fPIC"]
    command = [*compiler, *flags, folder / "driver.c", folder / "law_tare.c", "-o", folder / "tare.so"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    library, pointer = ctypes.CDLL(str(folder / "tare.so")), ctypes.POINTER(ctypes.c_double)

    def call(readings):
        given, out = np.ascontiguousarray(readings, dtype=float), np.zeros(3)
        count = ctypes.c_ulong(given.size)
        return (library.run(given.ctypes.data_as(pointer), count, out.ctypes.data_as(pointer)), *out.tolist())

    return call


def test_at_rest_the_zero_is_the_mean_and_within_its_bound(tare):
    rng, errors = np.random.default_rng(1), []
    for _ in range(1000):
        readings = -23.0 + NOISE * rng.normal(size=COUNT)
        status, zero, bound, most = tare(readings)
        assert status == DONE and zero == pytest.approx(np.mean(readings), abs=1e-12)
        assert abs(zero + 23.0) <= bound <= most
        errors.append(zero + 23.0)
    assert most == pytest.approx(5 * SIGMAS * NOISE / np.sqrt(COUNT), rel=1e-12)
    assert np.std(errors) == pytest.approx(NOISE / np.sqrt(COUNT), rel=0.1)


def test_what_creeps_unseen_is_within_the_bound(tare):
    """A steady drift, so slow that it is tared at times: the zero is near the force as it is at the end."""
    rng, tared = np.random.default_rng(2), 0
    for drift in np.linspace(0.0, 6.0, 400):
        truth = 5.0 + drift * np.arange(COUNT) / (COUNT - 1)
        status, zero, bound, _ = tare(truth + NOISE * rng.normal(size=COUNT))
        assert status in (DONE, MOVED)
        tared += status == DONE
        assert status == MOVED or abs(zero - truth[-1]) <= bound
    assert 50 < tared < 350


def change(readings, where, value):
    return np.where(np.arange(COUNT) == where, value, readings)


@pytest.mark.parametrize(
    ("move", "expected"),
    [
        (lambda x, t: x + 15.0 * (t > 0.7), MOVED),
        (lambda x, t: x + 10.0 * t, MOVED),
        (lambda x, t: x + 5.0 * np.sin(40.0 * t), MOVED),
        (lambda x, t: 2.0 * x, MOVED),
        (lambda x, t: change(x, 7, np.nan), MOVED),
        (lambda x, t: change(x, 0, np.inf), MOVED),
        (lambda x, t: change(x, 400, 40.0), MOVED),
        (lambda x, t: x + 55.0, BEYOND),
        (lambda x, t: x - 55.0, BEYOND),
        (lambda x, t: x[:-1], BUSY),
        (lambda x, t: np.concatenate([x, x + 100.0]), DONE),  # done is done
    ],
)
def test_what_moves_or_is_too_far_is_not_tared(move, expected, tare):
    readings = NOISE * np.random.default_rng(3).normal(size=COUNT)
    status, zero, bound, _ = tare(move(readings, np.linspace(0.0, 1.0, COUNT)))
    assert status == expected
    assert (zero == 0.0 and bound == 0.0) or expected == DONE


def test_numbers_out_of_range_are_refused(tuned, tmp_path):
    for name in ("noise", "limit", "duration_s"):
        with pytest.raises(ControlError, match=f"tare: {name} = 0 is not positive"):
            Tare(**{"noise": NOISE, "limit": LIMIT, "duration_s": 1.0, name: 0.0})
        for value in (1e-320, np.nan):
            with pytest.raises(ControlError, match=f"tare: {name} = {value:g} is not positive, between 1e-15 and 1e"):
                Tare(**{"noise": NOISE, "limit": LIMIT, "duration_s": 1.0, name: value})
    with pytest.raises(ControlError, match=r"duration_s = 1e\+14 is 1e\+17 samples; give 1.07374e\+06 at most"):
        export(tuned, tmp_path, tare=Tare(noise=NOISE, limit=LIMIT, duration_s=1e14))
    with pytest.raises(ControlError, match=r"duration_s = 0\.05 is 50 samples; average 100 at least"):
        export(tuned, tmp_path, tare=Tare(noise=NOISE, limit=LIMIT, duration_s=0.05))
