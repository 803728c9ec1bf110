"""What the row of a log says, and which files of certificates are refused: of older figures, of another kind of law."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import seaopt as so
from seaopt.control import CompensateGravity, add_compensation
from seaopt.errors import FileError
from seaopt.files import seal
from seaopt.robustness.certificate.limits import describe_log
from seaopt.robustness.certificate.simulated import STEPS
from seaopt.robustness.uncertainty.logs import LogVerdict
from tests.checks import leave_out

FITTED = LogVerdict(
    experiment="chirp", samples="fitted", outcome="undecided", band_hz=(0.8, 151.0), ms=1.7, ms_hz=54.5, ms_least=1.6,
    ms_predicted=1.59, confidence=None, amplitude=1.49, unit="A", at_amplitude=False,
)  # fmt: skip


def test_the_row_of_a_log_says_how_surely_and_where_it_tells():
    said = "fitted, undecided at 54.5 Hz: measured Ms 1.7, predicted 1.59; it tells from 0.8 to 151 Hz"
    assert describe_log(FITTED) == f"{said}; not independent"
    rubbing = replace(FITTED, at_amplitude=True)
    assert describe_log(rubbing) == f"{said}, at its amplitude of 1.49 A rms alone; not independent"
    held = describe_log(replace(FITTED, samples="held out", outcome="confirmed", confidence=0.95))
    assert held.startswith("held out, confirmed at 54.5 Hz: ") and held.endswith("to 151 Hz; at 95 %")
    narrow = describe_log(replace(FITTED, samples="held out", confidence=0.95, asked_hz=(20.0, 160.0)))
    assert narrow.endswith("to 151 Hz; not confirmed at 95 %, which asks for all from 20 to 160 Hz")
    assert ": measured UNSTABLE, predicted" in describe_log(replace(FITTED, outcome="refuted", ms=np.inf))


def test_files_without_what_a_law_feeds_back_or_of_another_kind_are_refused(monkeypatch):
    leave_out(monkeypatch, STEPS)
    held, knee = so.plants.rotary("locked"), so.plants.rotary("pendulum")
    values = knee.defaults.update(
        N=100.0, K_tau=0.0369, eta=0.7, J_m=2.4e-5, b_r=1e-4, k_s=300.0, J_l=0.25, d_l=0.3, m=3.0, L=0.25, f_c=0.0
    )
    plain = so.tune(held, values, so.ControllerSpec(measured="tau_s", bandwidth_hz=15, reserve=0.05))
    law = add_compensation(plain, gravity=CompensateGravity(fraction=0.9), link=(knee, values))
    content = so.certify(law, {"knee": knee}, values, samples=2, simulations=False).to_dict()
    assert so.Certificate.from_dict(content, law, {"knee": knee}, values).plants
    without = so.certify(plain, {"knee": knee}, values, samples=2, simulations=False).to_dict()["plants"]["knee"]
    older = content | {"plants": {"knee": content["plants"]["knee"] | {key: without[key] for key in ("ms", "mt")}}}
    with pytest.raises(FileError, match=r"feed back: it is of an older seaopt, or of another law; certify again"):
        so.Certificate.from_dict(seal(older), law, {"knee": knee}, values)
    reworded = seal(content | {"remarks": ["figures are of the loop that is exported"]})
    assert so.Certificate.from_dict(reworded, law, {"knee": knee}, values).plants
    scheduled = seal(content | {"schedule": {"over": "m"}})
    with pytest.raises(FileError, match=r"is of a schedule, and law is one law; give the law that it is of"):
        so.Certificate.from_dict(scheduled, law, {"knee": knee}, values)
