"""A process that is held up for seconds tunes the same law: nothing in it ends by a clock."""

from __future__ import annotations

import time

import casadi as ca
import pytest

import seaopt as so
from seaopt.control.tuning import interior_point

SPEC = so.ControllerSpec(structure="pd", bandwidth_hz=30, max_sensitivity=1.6, max_noise_gain=25)
HELD_UP_S = 6.0


class Pause(ca.Callback):
    """Counts the iterations of a program, and sleeps in one of them."""

    def __init__(self, program):
        super().__init__()
        self.sizes, self.calls, self.at = {k: program[k].numel() for k in "xgp"}, 0, 0
        self.construct("pause", {})

    def get_n_in(self):
        return ca.nlpsol_n_out()

    def get_sparsity_in(self, number):
        return ca.Sparsity.dense({"f": 1, **self.sizes}[ca.nlpsol_out(number).removeprefix("lam_")])

    def eval(self, _):
        self.calls += 1
        if self.calls == self.at:
            time.sleep(HELD_UP_S)
        return [0]


@pytest.mark.slow
def test_a_process_that_is_held_up_tunes_the_same_law(stand, thor, monkeypatch):
    pauses, solver = [], ca.nlpsol

    def build(name, kind, program, options):
        pauses.append(Pause(program))
        return solver(name, kind, program, options | {"iteration_callback": pauses[-1]})

    monkeypatch.setattr(ca, "nlpsol", build)
    interior_point._build_program.cache_clear()
    law = so.tune(stand, thor, SPEC)
    count, pauses[0].calls, pauses[0].at = pauses[0].calls, 0, 4
    again = so.tune(stand, thor, SPEC)
    interior_point._build_program.cache_clear()
    assert (pauses[0].calls, again.gains, len(pauses)) == (count, law.gains, 1)
