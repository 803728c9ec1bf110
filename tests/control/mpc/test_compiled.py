"""Steps by the exported C against `ForceMPC.step`, with every part around the plan."""

import numpy as np
import pytest

from seaopt.control.mpc.compiled import make_stepper
from seaopt.errors import ControlError
from tests.control.deploy.test_derating import LIMIT_A
from tests.control.mpc.test_guarded_mpc import make
from tests.control.mpc.test_link import LINK, plan
from tests.control.mpc.test_terms import FROM_SPEED, GATE, GRAVITY, draw_rows


def compare(mpc, references, readings, places):
    """Take the same steps in both; return them, the compiled ones first."""
    native, here = make_stepper(mpc), make_stepper(mpc, mpc.start)
    assert native.__qualname__ != here.__qualname__
    ahead, both = mpc.spec.preview_samples, ([], [])
    for k, (reading, place) in enumerate(zip(readings, places, strict=True)):
        known = references[k : k + 1 + ahead] if ahead else float(references[k])
        for made, step in zip(both, (native, here), strict=True):
            made.append(step(known, float(reading), place))
    found, wanted = (np.array(made, dtype=float) for made in both)
    np.testing.assert_allclose(found[:, 0], wanted[:, 0], rtol=0.0, atol=1e-12 * LIMIT_A)
    np.testing.assert_allclose(found[:, 1], wanted[:, 1], rtol=0.0, atol=1e-12 * np.max(np.abs(wanted[:, 1])))
    assert np.array_equal(found[:, [2, 3, 5]], wanted[:, [2, 3, 5]])
    # Of rows that are broken as much, rounding decides which is first.
    assert np.mean(found[:, 4] != wanted[:, 4]) < 0.01
    return found


def test_references_are_read_as_python_reads_them(compiler):
    """A column of a table was read along its row; of more than may be known, or of what is no number, all was taken."""
    mpc = make(preview_samples=3)
    native, here = make_stepper(mpc), make_stepper(mpc, mpc.start)
    table = np.column_stack([np.full(4, 100.0), np.full(4, -900.0)])
    for known in (table[:, 0], table[::2, 0], [100.0, 90], 100):
        assert native(known, 0.0, []).command == pytest.approx(here(known, 0.0, []).command, abs=1e-12 * LIMIT_A)
    for step in (native, here):
        for wrong in (np.full(5, 100.0), [], [100.0, np.nan]):
            with pytest.raises(ControlError, match="reference_N"):
                step(wrong, 0.0, [])


@pytest.mark.parametrize("options", [{}, {"current_slew_A_per_s": 2000.0, "prefilter": "second_order"}])
def test_guarded_steps_are_pythons(options, compiler):
    """Over readings with spikes, what is no number, outages and a fault, as the winding warms up."""
    mpc, rng, n = make(preview_samples=3, **options), np.random.default_rng(6), 1500
    references = np.repeat(rng.uniform(-1.0, 1.0, 15) * 2.0 * abs(mpc.static_gain) * LIMIT_A, 100)
    readings = 0.3 * np.convolve(references, np.full(40, 1.0 / 40.0))[:n] + rng.normal(size=n)
    readings[rng.integers(0, n, 40)] = rng.choice([np.nan, np.inf, -3e15, 700.0], 40)
    readings[500:503], readings[1200:1220] = np.nan, np.nan
    found = compare(mpc, references, np.clip(readings, -250.0, 250.0), [()] * n)
    assert found[-1, 5] and not found[1000, 5] and np.max(found[:, 4]) > 2
    assert np.mean(np.abs(found[:, 0]) > 0.99 * np.max(np.abs(found[:, 0]))) > 0.01


def test_steps_with_terms_and_a_link_fed_back_are_pythons(compiler, tmp_path):
    mpc = plan(tmp_path, f"{LINK}{GATE}\n[mpc]\ncurrent_slew_A_per_s = 800", f"{GRAVITY}, {FROM_SPEED}")
    rows = draw_rows(3)
    found = compare(mpc, rows[:, 0], rows[:, 3], rows[:, 1:3].tolist())
    assert np.mean(np.abs(np.diff(found[:, 0])) > 0.8 - 1e-9) > 0.05  # the slew limit
