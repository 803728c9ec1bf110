"""The reference that a bring-up gives the full law's outer loop, played on a machine of the tests' own."""

from __future__ import annotations

import json
import math
import subprocess
from dataclasses import replace

import numpy as np
import pytest

import seaopt as so
from seaopt.formatting import format_number
from seaopt.machine.bringup.files import write_bring_up
from seaopt.machine.response.periods import Played
from tests.machine.conftest import KNEE, make_knee
from tests.machine.test_bringup import MAIN
from tests.machine.test_outer_loop import Quiet, make_log, run, take_link


@pytest.fixture(scope="module")
def certificate(impedance):
    """Return that of a law alone: what its outer loop is given does not depend on it."""
    plants = {"stand": impedance.design[0], "knee": so.plants.rotary()}
    return so.certify(impedance, plants, impedance.design[1], samples=2, simulations=False)


def plan_outer(law, link, certificate, **limits):
    plants = {"stand": law.design[0], "knee": link[0]}
    noise = so.Sensors(noise_std={"tau_s": 0.02, "theta_l": 1e-5})  # that of `run`
    options = {"fractions": (), "limits": {"tau_s": 40.0, **limits}, "sensors": noise}
    options["certificate"] = replace(certificate, controller=law)  # as if it were certified
    return so.bring_up(law, plants, link[1], link=link, **options)


@pytest.mark.parametrize("stiffness", [20.0, 0.0])
def test_the_full_law_has_a_reference_for_its_outer_loop_whose_log_is_accepted(
    impedance, damping, certificate, stiffness, compiler, tmp_path
):
    law = impedance if stiffness else damping
    plan = plan_outer(law, take_link(), certificate, theta_l=0.06)
    write_bring_up(plan, tmp_path)
    folder = tmp_path / "full"
    table = so.read_log(folder / "outer_reference.csv")
    unit = table.signal("reference").unit
    assert unit == ("rad" if stiffness else "N m")
    main = MAIN.replace('"reference.h"', '"outer_reference.h"').replace("STAGE_", "OUTER_").replace("stage_", "outer_")
    (folder / "main.c").write_text(main)
    flags = ["-Wall", "-Wextra", "-Werror", "-std=c99", "-pedantic"]
    subprocess.run([*compiler, *flags, "main.c", "outer_reference.c", "-o", "play"], cwd=folder, check=True)
    played = subprocess.run([str(folder / "play")], capture_output=True, text=True, check=True).stdout
    played = np.array(played.split(), dtype=float)[:-1]
    np.testing.assert_allclose(played, table["reference"], atol=1e-6 * np.max(np.abs(played)))

    rows = run(law, table["reference"], stiffness=stiffness)
    around = plan.stages[-1].around
    period = around.excitation.waves.shape[1]
    peaks = np.max(np.abs(rows[2 * period : -period]), axis=0)
    for name, column in (("tau_s", 2), ("theta_l", 3), ("I", 4)):
        assert peaks[column] == pytest.approx(around.excitation.peaks[name], rel=0.1), name
    assert 0.9 < peaks[3] / 0.03 < 1.1  # half of the travel; with damping alone the link is where it began
    result = so.accept(law, [make_log(rows, unit=unit)], link=take_link())
    assert result.met and result.enclosed and not result.response.missing, result
    text = " ".join(repr(plan).split())
    what = "x_0" if stiffness else "the force that the damping is added to"
    assert f"as {what}, {format_number(np.max(np.abs(played)), 3)} {unit} at most" in text
    assert "tau_s, theta_l and I; the reference is what was played" in text and "link_moved" not in text
    assert json.loads((tmp_path / "bringup.json").read_text())["stages"][-1]["outer"]["reference"]["unit"] == unit


@pytest.mark.parametrize("stiffness", [20.0, 0.0])
def test_what_follows_a_step_with_the_outer_loop_is_that_of_the_machine(
    impedance, damping, certificate, stiffness, monkeypatch
):
    law = impedance if stiffness else damping
    around = plan_outer(law, take_link(), certificate).stages[-1].around
    monkeypatch.setattr(np.random, "default_rng", lambda seed: Quiet())
    size = 0.99 * around.step_size
    rows = run(law, np.full(len(around.step.at), size), stiffness=stiffness)
    follows = rows[:, 3 if stiffness else 2] / size
    np.testing.assert_allclose(follows, around.step.nominal, atol=3e-3 * np.max(np.abs(follows)))
    assert np.max(np.abs(rows[:, 4])) == pytest.approx(0.99 * 9.0, rel=2e-3)


def test_with_dry_friction_six_sets_of_phases_move_the_motor_and_are_accepted(impedance, certificate):
    knee, values = take_link()
    link = knee, values.update(f_c=0.005, v_s=1.0)
    around = plan_outer(impedance, link, certificate).stages[-1].around
    assert len(around.excitation.waves) == 6 and not around.still
    assert around.friction == pytest.approx(KNEE["N"] * 0.005, rel=0.01)
    rows = run(impedance, around.excitation.reference, dry=0.005)
    period = around.excitation.waves.shape[1]
    effort = rows[period:-period, 4] * KNEE["N"] * KNEE["eta"] * KNEE["K_tau"]
    assert 0.5 * np.ptp(effort) == pytest.approx(around.effort, rel=0.1) and around.effort >= 2.0 * around.friction
    result = so.accept(impedance, [make_log(rows)], link=link)
    assert result.met and result.enclosed and not result.response.needs_phases, result
    assert np.all(np.max(np.abs(rows), axis=0)[[2, 3, 4]] < [around.stop[name] for name in ("tau_s", "theta_l", "I")])


def test_without_the_plant_of_the_link_there_is_no_such_reference(impedance, certificate):
    plants = {"stand": impedance.design[0], "knee": so.plants.rotary()}
    options = {"fractions": (), "limits": {"tau_s": 40.0}, "certificate": certificate}
    plan = so.bring_up(impedance, plants, impedance.design[1], **options)
    assert plan.stages[-1].around is None and "over the stiffness, 20 N m/rad" in " ".join(repr(plan).split())


def test_an_outer_loop_that_is_not_stable_on_its_link_is_not_to_be_closed(certificate):
    """A stiffness of the link as large as its spring's is more than the law follows."""
    plan = plan_outer(make_knee(300.0), take_link(), certificate)
    text = " ".join(repr(plan).split())
    assert plan.stages[-1].around is None and plan.to_dict()["stages"][-1]["outer_unstable"]
    assert "DO NOT CLOSE ITS OUTER LOOP: by the model it is not stable with the link as in knee" in text
    assert "over the stiffness" not in text


def test_rows_that_the_outer_loops_filter_forgets_in_are_counted_and_how_long_to_record_is_that_of_its_own_reference(
    impedance, certificate
):
    around = plan_outer(impedance, take_link(), certificate).stages[-1].around
    period = around.excitation.waves.shape[1]
    played = Played(period_s=77.0, lasts_s=777.0, outer=Played(period_s=period * 1e-3, lasts_s=12 * period * 1e-3))
    log = make_log(run(impedance, around.excitation.reference[: 3 * period // 2]))
    result = so.accept(impedance, [log], link=take_link(), played=played)
    text, (why,) = " ".join(repr(result).split()), result.left_out.values()
    assert result.replayed and result.response is None
    assert f"of {period * 1e-3:.3g} s each" in why and f"{12 * period * 1e-3:.4g} s" in why and "77" not in why
    rows = math.ceil(35.0 / math.log(6.0 / 5.0))  # of a filter of 5 ms by backward differences
    assert f"Of knee the first {rows} rows are left out" in text
    assert result.to_dict()["replay"]["logs"][0]["begins"] == rows
