"""Feedforward of the link's motion, against THOR's swing from its equations of motion, with a loop closed by hand."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm

import seaopt as so
from seaopt.control import LinkFeedforward, runnable, sweep
from seaopt.control.deploy.export import export
from seaopt.control.loops.compensation.link_feedforward import (
    FollowedBand,
    LinkEffect,
    LinkPath,
    model_link_path,
)
from seaopt.control.loops.loop import Loop
from seaopt.control.tuning.frequencies import place_frequencies
from seaopt.control.tuning.tuner import make_task
from seaopt.errors import ControlError, FileError
from seaopt.files import to_json
from seaopt.problem import read_problem
from seaopt.robustness import Budget
from tests.c_code import CompiledLaw
from tests.control.tuning import test_measured

TS, DELAY = 1e-3, 1
SPEC = so.ControllerSpec(bandwidth_hz=30, max_sensitivity=1.6, max_noise_gain=25, min_sensitivity_bandwidth_hz=6)


@pytest.fixture(scope="module")
def fed():
    """Return a controller with feedforward, of the fraction that the tuner finds."""
    spec = replace(SPEC, link_feedforward=LinkFeedforward())
    return so.tune(so.plants.high_impedance(), so.plants.thor(), spec, {"swing": so.plants.moving_output()})


def sample_swing(**changes):
    """Return A, B of the swing under a motor force at 1 kHz, states q, phi and rates; and the rows of F1 and x_2."""
    thor = so.plants.thor().update(**changes)
    k, m_l, I_p, m, L, L_a, J, b_r = (thor[name].value for name in ("k", "m_l", "I_p", "m", "L", "L_a", "J", "b_r"))
    r = thor["l"].value / (2 * np.pi * thor["N_p"].value)
    mass = np.array([[J / r**2 + m_l, m_l * L_a], [m_l * L_a, I_p + m_l * L_a**2]])
    stiffness = k * np.outer([1.0, L_a], [1.0, L_a]) + np.diag([0.0, m * 9.81 * L])
    a = np.zeros((5, 5))
    a[:2, 2:4] = np.eye(2)
    a[2:4, :2] = -np.linalg.solve(mass, stiffness)
    a[2:4, 2:4] = -np.linalg.solve(mass, np.diag([b_r / r**2, 0.0]))
    a[2:4, 4] = np.linalg.solve(mass, [1.0, 0.0])
    held = expm(a * TS)
    return held[:4, :4], held[:4, 4], np.array([[k, k * L_a, 0.0, 0.0], [0.0, L_a, 0.0, 0.0]])


def close_by_hand(controller, f, inertia, damping, **changes):
    """Return F1/F_ref and S of the swing from the gains and the numbers of the path alone."""
    a, b, rows = sample_swing(**changes)
    q = np.exp(-2j * np.pi * f * TS)
    p, p_x = np.array([rows @ np.linalg.solve(z * np.eye(4) - a, b) for z in 1 / q]).T * q**DELAY
    g, s = controller.gains, (1 - q) / (1 + q)
    rate = (1 - q) / (g["T_f"] + TS - q * g["T_f"])
    integral = g["k_i"] * TS / 2 * (1 + q) / (1 - q)
    c_r, c_y = g["k_r"] + integral + g["c"] * g["k_d"] * rate, g["k_p"] + integral + g["k_d"] * rate
    w, slow = (np.tan(np.pi * hz * TS) for hz in (controller.link.corner_hz, controller.link.high_pass_hz))
    filters = w**2 / (s**2 + np.sqrt(2) * w * s + w**2) * s / (s + slow)
    s = s * 2 / TS
    path = controller.link.fraction * (inertia * s**2 + damping * s) * filters
    one = 1 + p * c_y - p_x * path
    return p * c_r / one, 1 / one


def find_band(f, tracking):
    """Return the widest band in which abs(F/F_ref) stays within 3 dB of 1."""
    inside = (np.abs(tracking) > np.sqrt(0.5)) & (np.abs(tracking) < np.sqrt(2.0))
    edges = np.flatnonzero(np.diff(np.r_[False, inside, False].astype(int)))
    return max(((f[low], f[high - 1]) for low, high in edges.reshape(-1, 2)), key=lambda band: band[1] - band[0])


def test_the_path_is_the_drives_inertia_and_damping(fed):
    """The screw turns against the link's motion: J/r^2 and b_r/r^2 with r = l/(2 pi N_p)."""
    r = 2e-3 / (2 * np.pi * 3)
    assert (fed.link.measured, fed.link.unit, fed.link.is_speed) == ("x_2", "m", False)
    assert -fed.link.inertia == pytest.approx(3.31e-6 / r**2, rel=1e-6)
    assert -fed.link.damping == pytest.approx(1.31e-4 / r**2, rel=1e-6)


@pytest.mark.parametrize("changes", [{}, {"J": 3.6e-6, "b_r": 1.18e-4}, {"J": 3.0e-6, "I_p": 0.5}])
def test_the_swing_follows_from_three_hertz(fed, changes):
    """With the parameters of the model, and with others behind the same law: band and Ms by hand."""
    r = 2e-3 / (2 * np.pi * 3)
    f = np.unique(np.r_[np.geomspace(0.05, 499.0, 6000), np.linspace(0.5, 60.0, 12000)])
    tracking, s = close_by_hand(fed, f, -3.31e-6 / r**2, -1.31e-4 / r**2, **changes)
    figures = fed.close(so.plants.moving_output(), so.plants.thor().update(**changes)).figures()
    assert figures.stable
    assert figures.tracking_band_hz == pytest.approx(find_band(f, tracking), rel=2e-3)
    assert figures.ms == pytest.approx(np.max(np.abs(s)), rel=1e-3)
    assert 2.0 < figures.tracking_band_hz[0] < 4.0
    if not changes:
        assert fed.feasible and figures.ms <= 1.6
        bare = so.tune(so.plants.high_impedance(), so.plants.thor(), SPEC, {"swing": so.plants.moving_output()})
        assert bare.close(so.plants.moving_output(), so.plants.thor()).figures().tracking_band_hz[0] > 10.0


def weigh_by_hand(controller):
    """Return the band of the swing, and the larger integral of abs(S) over ln f up to 30 Hz, of the swing and of the
    stand, on which the path does nothing: k/(M s^2 + b s + k), held.
    """
    r, g = 2e-3 / (2 * np.pi * 3), controller.gains
    f = np.unique(np.r_[np.geomspace(0.1, 30.0, 6000), np.geomspace(0.05, 499.0, 6000), 30.0])
    link = controller.link or LinkPath(
        measured="", unit="", inertia=0.0, damping=0.0, is_speed=False, fraction=0.0, corner_hz=30.0, high_pass_hz=3.0
    )
    tracking, s = close_by_hand(replace(controller, link=link), f, -3.31e-6 / r**2, -1.31e-4 / r**2)
    k, M, b = 655e3, 3.31e-6 / r**2, 1.31e-4 / r**2
    held = expm(np.array([[0.0, 1.0, 0.0], [-k / M, -b / M, 1.0 / M], [0.0, 0.0, 0.0]]) * TS)
    q = np.exp(-2j * np.pi * f * TS)
    p = np.array([k * np.linalg.solve(z * np.eye(2) - held[:2, :2], held[:2, 2])[0] for z in 1 / q]) * q**DELAY
    c_y = g["k_p"] + g["k_i"] * TS / 2 * (1 + q) / (1 - q) + g["k_d"] * (1 - q) / (g["T_f"] + TS - q * g["T_f"])
    counted = (f >= 0.1) & (f <= 30.0)
    sizes = [np.abs(each[counted]) for each in (s, 1 / (1 + p * c_y))]
    return find_band(f, tracking), max(np.trapezoid(size, np.log(f[counted])) for size in sizes)


def test_what_it_costs_is_said_beside_the_law_without(fed, stand, swing, thor):
    """Against the law tuned without it from scratch, both weighed by hand; and a file keeps what is said."""
    (band, size), (bare_band, bare_size) = map(weigh_by_hand, (fed, so.tune(stand, thor, SPEC, {"swing": swing})))
    effect = fed.link.effect
    (followed,) = effect.bands
    assert effect.cost == pytest.approx(size / bare_size - 1.0, abs=2e-3) and effect.cost > 0.1
    assert followed.plant == "swing"
    assert followed.band_hz == pytest.approx(band, rel=2e-3)
    assert followed.without_hz == pytest.approx(bare_band, rel=5e-3)
    (note,) = (note for note in fed.notes if "without it" in note)
    assert f"is {100 * effect.cost:.2g} % larger than without it, and swing follows from 2.97 to 34.5 Hz" in note
    assert "leave" not in note
    again = so.Controller.from_dict(json.loads(to_json(fed.to_dict())), stand, thor)
    assert again.link.effect == effect and note in again.notes


def test_a_plant_that_loses_band_is_named_beside_one_that_wins():
    bands = (
        FollowedBand(plant="swing", band_hz=(4.0, 32.0), without_hz=(8.0, 32.0)),
        FollowedBand(plant="light", band_hz=(24.0, 36.0), without_hz=(16.0, 36.0)),
        FollowedBand(plant="heavy", band_hz=None, without_hz=None),
    )
    said = LinkEffect(objective="noise", cost=-0.031, bands=bands).describe()
    assert said == (
        "the noise gain is 3.1 % smaller than without it, and swing follows from 4 to 32 Hz, without it from 8 to 32 "
        "Hz; light follows from 24 to 36 Hz, without it from 16 to 36 Hz"
    )
    nothing = LinkEffect(objective="disturbance", cost=0.05, bands=bands[1:]).describe()
    assert nothing.endswith("without it from 16 to 36 Hz: no more of the band, so leave link_feedforward out")


SAME, NOWHERE = ((12.0, 36.0), (12.0, 36.0)), (None, None)
HARDLY_MORE, HARDLY_LESS = ((12.0, 36.00000001), (12.0, 36.0)), ((12.00000001, 36.0), (12.0, 36.0))
MORE = ((11.8, 36.0), (12.0, 36.0))  # 0.024 octaves


@pytest.mark.parametrize(
    ("cost", "bands", "leave"),
    [
        (-0.05, [SAME], False),
        (-0.12, [NOWHERE], False),
        (1e-12, [SAME], False),
        (0.05, [SAME], True),
        (0.12, [NOWHERE], True),
        (0.14, [HARDLY_MORE], True),
        (0.14, [SAME, HARDLY_LESS], True),
        (0.14, [SAME, MORE], False),
    ],
)
def test_it_is_said_to_be_left_out_where_it_costs_and_wins_nothing(cost, bands, leave):
    followed = [FollowedBand(plant=f"arm {i}", band_hz=band, without_hz=bare) for i, (band, bare) in enumerate(bands)]
    said = LinkEffect(objective="disturbance", cost=cost, bands=tuple(followed)).describe()
    assert said.endswith("no more of the band, so leave link_feedforward out") == leave
    assert "arm 0" in said and "arm 1" not in said


def test_a_path_that_wins_no_band_is_said_to_be_left_out(stand, swing, thor):
    """A lag of 2 Hz leaves of the path what is of no use to 30 Hz: by hand the swing follows less of the band."""
    asked = LinkFeedforward(fraction=0.3, corner_hz=2.0, high_pass_hz=0.2)
    law = so.tune(stand, thor, replace(SPEC, link_feedforward=asked), {"swing": swing})
    bare = so.tune(stand, thor, SPEC, {"swing": swing})
    assert np.divide(*weigh_by_hand(law)[0]) > np.divide(*weigh_by_hand(bare)[0])
    assert law.met and law.link.effect.cost > 0.0 and law.link.effect.bands[0].octaves_won < 0.0
    assert any(note.endswith("no more of the band, so leave link_feedforward out") for note in law.notes)


def test_a_slow_reference_is_followed_sample_by_sample(fed):
    """The stored law on the sampled swing, 5 Hz: within 3 dB, which no law without the path comes to."""
    a, b, rows = sample_swing()
    law, n = fed.law, 20_000
    x, z, waiting = np.zeros(4), np.zeros(law.c.size), [0.0] * DELAY
    reference, force = np.sin(2 * np.pi * 5.0 * TS * np.arange(n)), np.zeros(n)
    for step in range(n):
        seen = rows @ x
        inputs, force[step] = np.r_[reference[step], seen], seen[0]
        waiting.append(float(law.c @ z + law.d @ inputs))
        z = law.a @ z + law.b @ inputs
        x = a @ x + b * waiting.pop(0)
    late = slice(n // 2, n)
    size = np.abs(2 * np.mean(force[late] * np.exp(-2j * np.pi * 5.0 * TS * np.arange(n))[late]))
    loop = fed.close(so.plants.moving_output(), so.plants.thor())
    assert size == pytest.approx(abs(loop.tracking(np.array([5.0]))[0]), rel=5e-3)
    assert np.sqrt(0.5) < size < np.sqrt(2.0)


def test_nothing_happens_where_the_link_is_held(fed):
    stand, thor = so.plants.high_impedance(), so.plants.thor()
    loop = fed.close(stand, thor)
    assert fed.signals == ("F1", "x_2") and "x_2" not in stand.outputs
    alone = replace(fed.law, b=fed.law.b[:, :2], d=fed.law.d[:2])
    bare = Loop(plant=replace(loop.plant, c=loop.plant.c[:1], d=loop.plant.d[:1]), law=alone.balanced()).figures()
    figures = loop.figures()
    for name in ("ms", "mt", "bandwidth_hz", "noise_gain", "reference_peak"):
        assert getattr(figures, name) == pytest.approx(getattr(bare, name), rel=1e-6)


def test_the_certificate_plays_the_law_on_the_swing(fed):
    swing, params = so.plants.moving_output(), so.plants.thor().prior(J=1e-10)
    certificate = so.certify(fed, {"swing": swing}, params, ranges={"I_p": (0.359, 0.361)}, samples=40)
    assert certificate.passed and certificate.simulated.passed
    assert {row.plant for row in certificate.simulated.verification.rows} == {"design", "swing"}


def test_the_exported_c_reads_the_link(fed, compiler, tmp_path):
    rng = np.random.default_rng(3)
    reference, signals = rng.normal(size=300), rng.normal(size=(300, 2)) * [1.0, 1e-6]
    expected, _ = runnable(fed).run(reference, signals)
    found = CompiledLaw(compiler, tmp_path, fed, "double").run(reference, signals)
    np.testing.assert_allclose(found, expected, atol=1e-9 * np.max(np.abs(expected)))


@pytest.mark.slow
def test_a_sweep_places_the_path_at_every_bandwidth(stand, swing, thor):
    spec = replace(SPEC, link_feedforward=LinkFeedforward())
    frontier = sweep(stand, thor, spec, [20.0, 30.0], {"swing": swing})
    assert [row.feasible for row in frontier.rows] == [True, True]
    assert [one.link.high_pass_hz for one in frontier.controllers] == [2.0, 3.0]
    for one in frontier.controllers:
        assert one.close(swing, thor).figures().ms <= 1.6 * (1 + 1e-6)


def test_it_is_stored_and_checked(fed):
    content = json.loads(to_json(fed.to_dict()))
    again = so.Controller.from_dict(content, so.plants.high_impedance(), so.plants.thor())
    assert again.link == fed.link and again.feasible
    content["blocks"]["link_feedforward"]["inertia"] *= 1.001
    with pytest.raises(FileError, match="law is not what gains"):
        so.Controller.from_dict(content, so.plants.high_impedance(), so.plants.thor())


@pytest.mark.parametrize(
    ("name", "value"), [("fraction", 0.5), ("corner_hz", 100.0), ("high_pass_hz", 1.0), ("measured", "phi")]
)
def test_a_specification_that_asks_for_another_path_is_refused(fed, name, value):
    content = json.loads(to_json(fed.to_dict()))
    content["spec"]["link_feedforward"][name] = value
    with pytest.raises(FileError, match=rf"spec\.link_feedforward\.{name}"):
        so.Controller.from_dict(content, so.plants.high_impedance(), so.plants.thor())


@pytest.mark.parametrize(
    ("asked", "robust", "words"),
    [
        (LinkFeedforward(), False, r'robust_to = \["swing"\]'),
        (LinkFeedforward(measured="q"), True, r'measured = "x_2"'),
        (LinkFeedforward(measured="F2"), True, r'measured = "x_2"'),
    ],
)
def test_what_is_no_motion_of_a_link_is_refused(stand, swing, thor, asked, robust, words):
    with pytest.raises(ControlError, match=words):
        so.tune(stand, thor, replace(SPEC, link_feedforward=asked), {"swing": swing} if robust else {})


@pytest.mark.parametrize("changes", [{"fraction": -0.1}, {"corner_hz": 600.0}, {"high_pass_hz": -1.0}])
def test_numbers_out_of_range_are_refused(changes):
    with pytest.raises(ControlError, match=rf"link_feedforward\.{next(iter(changes))}"):
        replace(SPEC, link_feedforward=LinkFeedforward(**changes))


def test_the_angle_serves_as_the_position(stand, swing, thor, fed):
    """The lever arm is in the numbers: 0.0725 m per radian."""
    spec = replace(SPEC, link_feedforward=LinkFeedforward(measured="phi", fraction=fed.link.fraction))
    controller = so.tune(stand, thor, spec, {"swing": swing})
    assert controller.link.inertia == pytest.approx(0.0725 * fed.link.inertia, rel=1e-9)
    band, other = (one.close(swing, thor).figures().tracking_band_hz for one in (controller, fed))
    assert band == pytest.approx(other, rel=1e-3)


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("link_feedforward = true", LinkFeedforward()),
        ('link_feedforward = { measured = "x_2", fraction = 0.5, high_pass_hz = 0 }',
         LinkFeedforward(measured="x_2", fraction=0.5, high_pass_hz=0.0)),
    ],
)  # fmt: skip
def test_a_problem_file_asks_for_it(tmp_path, line, expected):
    controller = f'[controller]\nplant = "stand"\nbandwidth_hz = 30\n{line}\n'
    (tmp_path / "problem.toml").write_text(f'schema = 1\n[plant.stand]\nkind = "high_impedance"\n{controller}')
    assert read_problem(tmp_path / "problem.toml").spec.link_feedforward == expected


def evaluate_path(link, f):
    """Return the path's response by its own formula, corners prewarped."""
    s = 1j * np.tan(np.pi * f * TS)
    w, slow = (np.tan(np.pi * hz * TS) for hz in (link.corner_hz, link.high_pass_hz))
    rate = 2.0 / TS * s
    return -link.fraction * (link.inertia * rate**2 + link.damping * rate) * w**2 / (
        s**2 + np.sqrt(2.0) * w * s + w**2
    ) * s / (s + slow)  # fmt: skip


def test_the_path_is_printed_with_all_its_digits(fed, tmp_path):
    """As controller.json and the MATLAB script have it, from 0.1 Hz to next to the Nyquist frequency."""
    f = np.geomspace(0.1, 499.0, 300)
    q, expected = np.exp(-2j * np.pi * f * TS), evaluate_path(fed.link, f)
    export(fed, tmp_path)
    lines = (line for path in tmp_path.rglob("*.m") for line in path.read_text().splitlines())
    rows = dict(line.split(";")[0].split(" = ", 1) for line in lines if line.startswith("measurement_x_2_"))
    script = [np.array(rows[f"measurement_x_2_{part}"].strip("[]").split(","), dtype=float) for part in ("num", "den")]
    stored = json.loads(to_json(fed.to_dict()))["measurement"][-1]
    for num, den in (script, (stored["num"], stored["den"])):
        found = np.polynomial.polynomial.polyval(q, num) / np.polynomial.polynomial.polyval(q, den)
        np.testing.assert_allclose(found, expected, rtol=1e-6)


@pytest.mark.parametrize(("name", "value"), [("unit", "rad"), ("measured", "x_9")])
def test_a_file_with_another_signal_of_the_link_is_refused(fed, name, value):
    content = json.loads(to_json(fed.to_dict()))
    content["blocks"]["link_feedforward"][name] = value
    content["measured"][-1] = content["blocks"]["link_feedforward"]["measured"]
    with pytest.raises(FileError, match=rf"link_feedforward\.{name}"):
        so.Controller.from_dict(content, so.plants.high_impedance(), so.plants.thor())


def test_a_signal_that_a_moving_plant_lacks_is_refused(fed, swing):
    """It is not taken for zero there: only a link that is held stands still."""
    for link, words in (
        (replace(fed.link, measured="x_9"), "is not an output"),
        (replace(fed.link, unit="rad"), "in m"),
    ):
        with pytest.raises(ControlError, match=words):
            replace(fed, link=link).see(swing)


@pytest.mark.slow
def test_the_worst_case_is_bounded(fed, swing, thor):
    """Ms by hand over the range of I_p: below the bound from above, and the worst case is the worst of them."""
    lax = replace(fed, spec=replace(fed.spec, max_sensitivity=1.7))
    certificate = so.certify(
        lax, {"swing": swing}, thor.prior(J=1e-12), ranges={"I_p": (0.33, 0.4)}, samples=40, bounds=Budget(),
        simulations=False,
    )  # fmt: skip
    r, bracket = 2e-3 / (2 * np.pi * 3), certificate.brackets["swing"]
    f = np.unique(np.r_[np.geomspace(0.05, 499.0, 4000), np.linspace(0.5, 60.0, 4000)])
    by_hand = [
        np.max(np.abs(close_by_hand(fed, f, -3.31e-6 / r**2, -1.31e-4 / r**2, I_p=I_p)[1]))
        for I_p in np.linspace(0.33, 0.4, 8)
    ]
    assert bracket.bounded_stable and max(by_hand) <= bracket.ms_upper <= 1.02 * max(by_hand)
    assert bracket.ms_lower == pytest.approx(max(by_hand), rel=1e-3)
    assert certificate.worst["swing"].parameters["I_p"] == pytest.approx(0.33)


@pytest.fixture(scope="module")
def beside_discs():
    """Return a controller tuned on the swing and on the stand's response, known to 3 % at every frequency."""
    response = test_measured.exact(TS, relative=0.03)
    spec = replace(SPEC, link_feedforward=LinkFeedforward())
    robust_to = {"swing": so.plants.moving_output(), "log": response}
    return so.tune(so.plants.high_impedance(), so.plants.thor(), spec, robust_to), response


def test_the_response_of_a_held_link_is_kept_beside_it(beside_discs, stand, swing, thor):
    """By hand: the swing, and random responses in the discs, which the path does not reach."""
    controller, response = beside_discs
    assert controller.feasible and controller.link.fraction > 0.5
    r, f = 2e-3 / (2 * np.pi * 3), np.geomspace(0.05, 499.0, 20_000)
    tracking, s = close_by_hand(controller, f, -3.31e-6 / r**2, -1.31e-4 / r**2)
    assert np.max(np.abs(s)) <= 1.6 and find_band(f, tracking)[0] < 3.5
    (found,) = controller.measured
    rng, f, g = np.random.default_rng(1), response.frequency_hz, controller.gains
    q = np.exp(-2j * np.pi * f * TS)
    c_y = g["k_p"] + g["k_i"] * TS / 2 * (1 + q) / (1 - q) + g["k_d"] * (1 - q) / (g["T_f"] + TS - q * g["T_f"])
    disc = response.radius * np.sqrt(rng.uniform(size=(2000, f.size))) * np.exp(2j * np.pi * rng.uniform(size=f.size))
    s = 1 / (1 + (response.response + disc) * controller.command.per_effort * q * c_y)
    assert found.stable and 0.99 * found.ms < np.max(np.abs(s)) <= found.ms <= 1.6
    certificate = so.certify(controller, {"swing": swing}, thor, measured={"log": response}, simulations=False)
    assert certificate.passed and any("log" in str(row) for row in certificate.requirements)


def test_curves_beside_discs_are_those_of_the_loops(beside_discs, stand, swing, thor):
    """Of models, which have no disc, what the tuner uses of Ms is the loop's own."""
    controller, response = beside_discs
    task = make_task(stand, thor, controller.spec, {"swing": swing, "log": response})
    grid, x = (
        task.grid(place_frequencies(task)),
        np.array([4.0, 2.0, 0.03, 0.5, 0.01, 0, 2e-3, 1, 0, 0.1, 0.5, 1, 1, 1]),
    )
    used = task.usage(grid, task.respond(grid, x))["max_sensitivity"] * grid.levels["max_sensitivity"]
    for row, plant in enumerate(task.plants[:2]):
        np.testing.assert_allclose(
            used[row], np.abs(Loop(plant=plant, law=task.law_of(x)).sensitivity(grid.f)), rtol=1e-6
        )


def test_a_response_of_a_moving_link_is_refused(beside_discs, stand, swing, thor):
    """It does not tell the motion that the law reads; nor may the law be certified on such responses alone."""
    controller, response = beside_discs
    moving = replace(response, plant=swing)
    with pytest.raises(ControlError, match="whose link moves"):
        so.tune(stand, thor, controller.spec, {"swing": swing, "log": moving})
    with pytest.raises(ControlError, match="whose link moves"):
        so.certify(controller, {"swing": swing}, thor, measured={"log": moving})
    alone = replace(controller, design=None, measured_on=(stand, thor))
    with pytest.raises(ControlError, match="link_feedforward reads the motion of a link"):
        so.certify(alone, {}, thor, measured={"log": response})


def test_the_path_has_the_inertia_and_the_damping_of_the_motor_on_the_link():
    swing, thor = so.plants.moving_output(), so.plants.thor()
    per_newton = 0.002 / (2 * np.pi * 3.0 * 0.0255)  # A: F_m = N_p K_tau 2 pi/l I
    path = model_link_path(LinkFeedforward(), swing, thor, "F1", per_newton, 30.0)
    assert path.measured == "x_2"
    assert (path.inertia, path.damping) == pytest.approx((-294.0, -11636.0), rel=1e-4)  # -J/r^2 and -b_r/r^2
