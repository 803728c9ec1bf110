"""The plants against the paper's printed transfer functions and the equations of motion written out by hand."""

from __future__ import annotations

import math

import casadi as ca
import control
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import seaopt as so
from seaopt.errors import PlantError

FREQUENCIES = 2 * np.pi * np.geomspace(0.05, 500, 60)


def positive(low, high):
    return st.floats(math.log(low), math.log(high)).map(math.exp)


ACTUATORS = st.fixed_dictionaries(
    {
        "m_l": positive(0.1, 10),
        "k": positive(1e4, 1e7),
        "l": positive(5e-4, 2e-2),
        "N_p": positive(1, 10),
        "K_tau": positive(5e-3, 0.2),
        "J": positive(1e-7, 1e-4),
        "b_r": positive(1e-6, 1e-2),
        "eta": positive(0.3, 1.0),
    }
)


def response(plant, params, output, s):
    row = list(plant.outputs).index(output)
    return plant.linearize(params)(s, squeeze=False)[row, 0]


def printed(values, s):
    """(6)-(8) and (13)-(15), per ampere: F_m = eta K_tau / r I (3)."""
    r = values["l"] / (2 * math.pi * values["N_p"])
    m_l, k = values["m_l"], values["k"]
    m_k, b_m = m_l + values["J"] / r**2, values["b_r"] / r**2
    force = values["eta"] * values["K_tau"] / r
    den = m_k * s**2 + b_m * s + k
    return {
        ("lumped", "F1"): force * k / den,
        ("lumped", "F2"): force * (m_k * s**2 + k) / den,
        ("unlumped", "F1"): force * k / den,
        ("unlumped", "F2"): force * (m_l * s**2 + k) / den,
        ("lumped", "F1/F2"): k / (m_k * s**2 + k),
        ("unlumped", "F1/F2"): k / (m_l * s**2 + k),
    }


@given(ACTUATORS)
@pytest.mark.parametrize("drive", ["lumped", "unlumped"])
def test_high_impedance_is_the_papers(drive, values):
    plant = so.plants.high_impedance(drive=drive)
    params = so.plants.thor().update(**values)
    s = 1j * FREQUENCIES
    expected = printed(values, s)
    found = {output: response(plant, params, output, s) for output in ("F1", "F2")}
    # (7) writes the damper's force as part of F2: F2 = F_m - b_m s x, which is (m_k s^2 + k)/den times F_m.
    np.testing.assert_allclose(found["F1"], expected[drive, "F1"], rtol=1e-9)
    np.testing.assert_allclose(
        found["F2"], expected[drive, "F2"], rtol=1e-9, atol=1e-9 * abs(expected[drive, "F2"]).max()
    )
    ratio = found["F1"] / found["F2"]
    keep = np.abs(found["F2"]) > 1e-4 * np.abs(found["F2"]).max()  # beside the zero of F2
    np.testing.assert_allclose(ratio[keep], expected[drive, "F1/F2"][keep], rtol=1e-6)


def test_spring_at_link_2_sees_the_rotary_inertia_alone():
    """Both links fixed: F1/F_m = k/(M s^2 + b_m s + k), M and not m_k (the housing does not move)."""
    params, s = so.plants.thor(), 1j * FREQUENCIES
    r = 0.002 / (6 * math.pi)
    big_m, b_m = 3.31e-6 / r**2, 1.31e-4 / r**2
    expected = 0.0255 / r * 655e3 / (big_m * s**2 + b_m * s + 655e3)
    plant = so.plants.high_impedance(spring="link2")
    for output in ("F1", "F2"):
        np.testing.assert_allclose(response(plant, params, output, s), expected, rtol=1e-9)


def test_the_lumped_mirror(thor):
    """Lumped, spring at link 2: link 1 feels what link 2 feels with the spring at link 1 (docs/theory/plants.md)."""
    s = 1j * FREQUENCIES
    mirror, paper = so.plants.high_impedance("lumped", "link2"), so.plants.high_impedance("lumped", "link1")
    f1, f2 = (response(mirror, thor, output, s) for output in ("F1", "F2"))
    expected = printed({name: item.value for name, item in thor.items()}, s)
    np.testing.assert_allclose(f2, expected["lumped", "F1"], rtol=1e-9)
    np.testing.assert_allclose(f1, response(paper, thor, "F2", s), rtol=1e-9)
    np.testing.assert_allclose(f1 / f2, 1 / expected["lumped", "F1/F2"], rtol=1e-7)


def pendulum_model(p, drive):
    """moving_output written by hand, linear: the design's equations, not the Lagrangian of the code."""
    r = p["l"] / (2 * math.pi * p["N_p"])
    big_m, b_m, k, m_l = p["J"] / r**2, p["b_r"] / r**2, p["k"], p["m_l"]
    force, arm, inertia = p["K_tau"] / r, p["L_a"], p["I_p"]
    weight, damp = p["m"] * p["g"] * p["L"], p["d"]
    # unknowns [qdd, phidd, F2]; F1 = k (q + arm phi)
    rows, rhs_x, rhs_u = [], [], []
    f1 = np.array([k, 0, k * arm, 0])
    if drive == "unlumped":
        rows.append([m_l, m_l * arm, -1.0])  # m_l xdd_l = F2 - F1
        rhs_x.append(-f1)
        rhs_u.append(0.0)
        rows.append([big_m, 0.0, 1.0])  # M qdd = F_m - b_m qd - F2
        rhs_x.append([0, -b_m, 0, 0])
        rhs_u.append(force)
    else:
        rows.append([m_l + big_m, (m_l + big_m) * arm, 0.0])  # m_k xdd_k = F_m - b_m qd - F1
        rhs_x.append(np.array([0, -b_m, 0, 0]) - f1)
        rhs_u.append(force)
        rows.append([0.0, 0.0, 1.0])  # F2 = F_m - b_m qd
        rhs_x.append([0, -b_m, 0, 0])
        rhs_u.append(force)
    rows.append([0.0, inertia, arm])  # I_p phidd = -F2 L_a - m g L phi - d phid
    rhs_x.append([0, 0, -weight, -damp])
    rhs_u.append(0.0)
    inverse = np.linalg.inv(np.array(rows))
    acc, drive_gain = inverse @ np.array(rhs_x), inverse @ np.array(rhs_u)
    a = np.array([[0, 1, 0, 0], acc[0], [0, 0, 0, 1], acc[1]])
    b = np.array([[0], [drive_gain[0]], [0], [drive_gain[1]]])
    c = np.array([f1, acc[2]])
    return control.ss(a, b, c, np.array([[0.0], [drive_gain[2]]]))


@given(ACTUATORS, positive(0.05, 5), positive(0.02, 0.3))
@pytest.mark.parametrize("drive", ["lumped", "unlumped"])
def test_moving_output_is_the_hand_written_pendulum(drive, values, inertia, arm):
    params = so.plants.thor().update(**{**values, "eta": 1.0, "I_p": inertia, "L_a": arm, "d": 0.3})
    expected = pendulum_model({name: item.value for name, item in params.items()}, drive)
    plant = so.plants.moving_output(drive=drive)
    s = 1j * FREQUENCIES
    for row, output in enumerate(("F1", "F2")):
        hand = expected(s, squeeze=False)[row, 0]
        # Seven tonnes of reflected rotor beside a light link: the hand-written inverse loses seven digits.
        np.testing.assert_allclose(response(plant, params, output, s), hand, rtol=1e-8, atol=1e-8 * abs(hand).max())


def test_linearize_names_its_signals(swing, thor):
    model = swing.linearize(thor)
    assert isinstance(model, control.StateSpace)
    assert model.input_labels == ["I"]
    assert model.output_labels == ["F1", "F2", "q", "phi", "x_2"]
    assert model.state_labels == ["q", "qd", "phi", "phid"]


def test_linearize_at_an_angle_differs_by_the_cosine(swing, thor):
    """The lever arm L_a cos(phi) and the weight m g L cos(phi): at 60 degrees the pendulum's stiffness halves."""
    upright, tilted = (swing.linearize(thor, x={"phi": angle}) for angle in (0.0, math.pi / 3))
    assert not np.allclose(upright.A, tilted.A)
    with pytest.raises(PlantError, match="phy"):
        swing.linearize(thor, x={"phy": 1.0})


def test_special_cases_are_the_general_plant(thor):
    general = so.plants.two_link(link1="fixed", link2="pendulum")
    renamed = so.ParameterSet(
        so.Parameter(name=name + "2" if name in ("I_p", "m", "L", "L_a", "d") else name, value=p.value, unit=p.unit)
        for name, p in thor.items()
    )
    a = so.plants.moving_output().linearize(thor)
    b = general.linearize(renamed)
    np.testing.assert_allclose(a.A, b.A)
    np.testing.assert_allclose(a.B[:, 0], b.B[:, 0])


@pytest.mark.parametrize("options", [{"drive": "lumpy"}, {"spring": "middle"}])
def test_unknown_options_are_refused(options):
    with pytest.raises(PlantError, match=next(iter(options.values()))):
        so.plants.high_impedance(**options)
    with pytest.raises(PlantError, match="glued"):
        so.plants.two_link(link1="glued")


def test_published_numbers_agree_with_table_i(thor):
    """Table I and (16): m_k, b_m and r follow from J and b_r; the paper prints 294.9 kg, 11660 N s/m, 1.06e-4 m."""
    plant = so.plants.high_impedance()
    figures = {name: value for name, (value, _) in plant.derived_values().items()}
    numbers = ca.Function("n", [plant.p], list(figures.values()))(plant.complete(thor).vector)
    found = dict(zip(figures, (float(v) for v in numbers), strict=True))
    assert found["m_k"] == pytest.approx(294.9, rel=2e-3)
    assert found["b_m"] == pytest.approx(11660, rel=3e-3)
    assert found["r"] == pytest.approx(1.06e-4, rel=2e-3)
    assert found["natural_frequency_hz"] == pytest.approx(7.50, rel=1e-3)
