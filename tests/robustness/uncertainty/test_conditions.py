"""Runs of a draw with conditions: at rest at an angle, late, against DOP853 and the law's difference equation."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import seaopt as so
from seaopt.control import Gains
from seaopt.control.laws.realisation import runnable
from seaopt.control.loops.port import port_of
from seaopt.control.running.equilibrium import equilibrium
from seaopt.errors import ControlError
from seaopt.robustness import batch_figures
from seaopt.robustness.verification.playback import Rig, play
from seaopt.robustness.verification.scenarios import Phase, Scenario, default_scenarios
from seaopt.robustness.verification.verification import verify
from tests.blocks import of_one_input
from tests.control.running.test_closed_loop import swing_by_hand
from tests.laws import scaled

STEP = Scenario(name="step", phases=(Phase(duration_s=0.12, force_N=30.0), Phase(duration_s=0.28)))
TS = 1e-3


@pytest.fixture(scope="module")
def controller(limited_controller):
    return limited_controller


@pytest.fixture(scope="module")
def proportional(controller):
    """Return the controller with a law that does not integrate: it rests at a reference other than the force."""
    law = Gains(k_p=3.0, k_i=0.0, k_d=0.03, T_f=1e-3, k_r=4.0)
    return replace(controller, law=law.law("pd", TS))


def at(params, **conditions):
    units = {"phi": "rad", "delay_s": "s", "q": "m"}
    return params.with_parameters(*(so.Parameter(name=n, value=v, unit=units[n]) for n, v in conditions.items()))


def resting_by_hand(params, phi):
    """Return states, force and current: F1 L_a cos(phi) = -m g L sin(phi), F1 = k (q + L_a sin(phi)) = F_m."""
    p = {name: item.value for name, item in params.items()}
    force = -p["m"] * p["g"] * p["L"] * math.sin(phi) / (p["L_a"] * math.cos(phi))
    radius = p["l"] / (2 * math.pi * p["N_p"])
    state = np.array([force / p["k"] - p["L_a"] * math.sin(phi), 0.0, phi, 0.0])
    return state, force, force * radius / (p["eta"] * p["K_tau"])


class Difference:
    """C_r and C_y over one common history, without limit: at rest, everything before the first sample is constant."""

    def __init__(self, controller, reference, measurement, current):
        tfs = controller.reference, controller.measurement
        self.num, self.den = [tf.num for tf in tfs], [tf.den for tf in tfs]
        assert np.allclose(*self.den)
        self.gain = controller.command.per_effort
        self.r, self.y = ([value] * 12 for value in (reference, measurement))
        self.u = [current / self.gain] * 12

    def __call__(self, reference, measurement):
        self.r, self.y = [reference, *self.r], [measurement, *self.y]
        (num_r, num_y), den = self.num, self.den[0]
        force = num_r @ self.r[: num_r.size] - num_y @ self.y[: num_y.size] - den[1:] @ self.u[: den.size - 1]
        self.u = [force / den[0], *self.u]
        return self.gain * self.u[0]


def by_hand(params, law, references, start, current, late_s, waiting):
    """Return states and forces at the samples: the older command for what is left of the delay, then the newer one."""
    rate, force = swing_by_hand(params)
    options = {"method": "DOP853", "rtol": 1e-11, "atol": 1e-14}
    commands, x, states, forces = [current] * (waiting + 1), start, [], []
    for reference in references:
        states.append(x)
        forces.append(force(x))
        commands.append(law(reference, forces[-1]))
        older, newer = commands[-waiting - 2], commands[-waiting - 1]
        for command, lasting in ((older, late_s), (newer, TS - late_s)):
            if lasting > 0.0:
                x = solve_ivp(rate, (0, lasting), x, args=(command,), **options).y[:, -1]
    return np.array(states), np.array(forces)


@pytest.mark.parametrize(("phi", "delay_s"), [(0.5, 0.37e-3), (-1.1, 1.6e-3)])
@pytest.mark.parametrize("law", ["controller", "proportional"])
def test_a_draw_is_played_where_it_rests_and_as_late_as_it_is(request, swing, thor, law, phi, delay_s):
    one = request.getfixturevalue(law)
    drawn = thor.update(I_p=0.25, d=0.05, f_c=20.0)
    x, force, current = resting_by_hand(drawn, phi)
    sums = [tf.num.sum() for tf in (one.reference, one.measurement)]
    start = force if law == "controller" else (current / one.command.per_effort * one.measurement.den.sum()
                                               + sums[1] * force) / sums[0]  # fmt: skip
    trace = play(Rig(controller=one, plant=swing), STEP, [thor, at(drawn, phi=phi, delay_s=delay_s)])
    references = start + np.where(np.arange(400) < 120, 30.0, 0.0)
    np.testing.assert_allclose(trace.reference[1], references, atol=1e-6)
    whole = int(delay_s / TS)
    states, forces = by_hand(
        drawn, Difference(one, start, force, current), references, x, current, delay_s - whole * TS, 1 + whole
    )
    assert np.max(np.abs(trace.current)) < 9.0
    np.testing.assert_allclose(trace.outputs["F1"][1], forces, atol=1e-4)
    np.testing.assert_allclose(trace.outputs["phi"][1], states[:, 2], atol=1e-6)
    assert np.ptp(states[:, 2]) > 0.005


def test_conditions_have_units(controller, stand, swing, thor):
    """0.4 ms and 40 degrees, in the linear loop, at the port, in the batch and in the simulation."""
    small = at(thor, phi=math.radians(40), delay_s=0.4e-3)
    given = thor.with_parameters(
        so.Parameter(name="delay_s", value=0.4, unit="ms"), so.Parameter(name="phi", value=40.0, unit="deg")
    )
    figures = [controller.close(swing, params).figures() for params in (given, small)]
    assert figures[0].ms == pytest.approx(figures[1].ms, rel=1e-9)
    assert batch_figures(controller, swing, given, {"I_p": np.array([0.36])}).ms[0] == pytest.approx(figures[1].ms)
    assert [port_of(stand, params, "F1", 1.0).delay_s for params in (given, small)] == pytest.approx([4e-4, 4e-4])
    traces = [play(Rig(controller=controller, plant=swing), STEP, [params]) for params in (given, small)]
    np.testing.assert_allclose(traces[0].outputs["F1"], traces[1].outputs["F1"], rtol=1e-9)
    for value, unit, words in ((-1e-4, "s", "negative"), (1.0, "m", "dimension")):
        wrong = thor.with_parameters(so.Parameter(name="delay_s", value=value, unit=unit))
        with pytest.raises(ControlError, match=words):
            controller.close(swing, wrong)


def test_nothing_moves_until_something_happens(controller, proportional, swing, thor):
    still = Scenario(name="still", phases=(Phase(duration_s=2.0),))
    for phi in np.linspace(-1.2, 1.2, 13):  # speeds are rounding then, which no number of steps makes smaller
        trace = play(Rig(controller=controller, plant=swing), still, [at(thor, phi=phi, delay_s=0.2e-3)])
        assert np.ptp(trace.outputs["phi"][0]) < 1e-9
        assert trace.substeps == 4  # as guessed
    for law in (controller, proportional):
        trace = play(Rig(controller=law, plant=swing), still, [at(thor, phi=0.9, delay_s=0.2e-3), thor])
        assert np.ptp(trace.outputs["phi"][0]) < 1e-9
        assert np.ptp(trace.current[0]) < 1e-7
        assert trace.equilibrium.force == pytest.approx([resting_by_hand(thor, 0.9)[1], 0.0], rel=1e-9)
        assert not np.any(trace.current[1])


def test_small_steps_there_are_the_linear_loops(controller, swing, thor):
    """Of the plant that the linear figures speak of: x+ = a x + b u with the drawn angle and delay."""
    drawn = at(thor.update(I_p=0.2), phi=0.8, delay_s=0.4e-3)
    phases = (Phase(duration_s=0.3, force_N=0.05),)
    trace = play(Rig(controller=controller, plant=swing), Scenario(name="s", phases=phases), [drawn])
    plant = controller.close(swing, drawn).plant
    a, b, (c,), (d,) = of_one_input(plant.block)
    law, x, forces = Difference(controller, 0.0, 0.0, 0.0), np.zeros(b.size), []
    for _ in range(300):
        forces.append(float(c @ x))
        x = a @ x + b * law(0.05, forces[-1]) / controller.command.per_effort
    assert d == 0.0
    np.testing.assert_allclose(trace.outputs["F1"][0] - trace.equilibrium.force[0], forces, atol=3e-5)


def test_the_fall_is_dop853s_and_its_energy_is_the_work_done(controller, swing, thor):
    """It starts where the scenario says, whatever the draw; E by hand, W the integral of (F_m - b q' - f_c tanh) q'."""
    drawn = thor.update(f_c=20.0, d=0.05)
    (fall,) = [item for item in default_scenarios(controller, swing) if item.name == "fall through 90 deg"]
    short = replace(fall, phases=(Phase(duration_s=1.5),))
    trace = play(Rig(controller=controller, plant=swing), short, [at(drawn, phi=0.5, delay_s=0.3e-3)])
    rate, _ = swing_by_hand(drawn)
    p = {name: item.value for name, item in drawn.items()}
    radius = p["l"] / (2 * np.pi * p["N_p"])
    mass, b = p["J"] / radius**2, p["b_r"] / radius**2

    def powered(t, z, current):
        speed, turning = z[1], z[3]
        motor = p["eta"] * p["K_tau"] / radius * current - b * speed - p["f_c"] * np.tanh(speed / p["v_s"])
        return [*rate(t, z[:4], current), motor * speed - p["d"] * turning**2]

    def stored(q, speed, phi, turning):
        sprung = speed + p["L_a"] * np.cos(phi) * turning
        kinetic = mass * speed**2 + p["m_l"] * sprung**2 + p["I_p"] * turning**2
        spring = p["k"] * (q + p["L_a"] * np.sin(phi)) ** 2
        return 0.5 * (kinetic + spring) + p["m"] * p["g"] * p["L"] * (1 - np.cos(phi))

    angle = math.radians(120)
    z = np.array([-p["L_a"] * math.sin(angle), 0.0, angle, 0.0, 0.0])
    law = runnable(controller)
    memory, waiting, rows = law.reset(), [0.0, 0.0], []
    for _ in range(1500):
        rows.append(z)
        current, memory = law.step(memory, 0.0, p["k"] * (z[0] + p["L_a"] * np.sin(z[2])))
        waiting.append(current)
        for command, lasting in ((waiting[-3], 0.3e-3), (waiting[-2], 0.7e-3)):
            z = solve_ivp(powered, (0, lasting), z, args=(command,), rtol=1e-9, atol=1e-12).y[:, -1]
    q, speed, phi, turning, work = np.array(rows).T
    assert np.max(np.abs(trace.current)) == 9.0  # where it is fastest the current saturates
    np.testing.assert_allclose(trace.outputs["phi"][0], phi, atol=1e-5)
    energy = stored(q, speed, phi, turning)
    np.testing.assert_allclose(energy - energy[0], work, atol=1e-6)
    np.testing.assert_allclose(trace.outputs["energy"][0], energy, atol=1e-4)
    assert phi.min() < math.pi / 2 and np.ptp(energy) > 0.1


def test_every_scenario_of_a_draw_that_rests_at_an_angle(controller, stand, swing, thor):
    drawn = [at(thor.update(I_p=i), phi=phi, delay_s=0.2e-3) for i, phi in ((0.2, 0.6), (0.6, -0.6))]
    verification = verify(controller, {"swing": swing}, thor, draws={"swing": drawn}, partners={"swing": stand})
    assert verification.passed, verification
    rows = [row for row in verification.rows if row.draw == "1"]
    assert len(rows) == 10
    assert rows[0].parameters == {"I_p": 0.2, "phi": 0.6, "delay_s": 0.2e-3}
    for row in rows:
        first = math.radians(120) if row.scenario.startswith("fall") else 0.6
        assert verification.replay(row).outputs["phi"][0, 0] == pytest.approx(first) or row.scenario == "contact"


def test_a_link_is_held_and_let_go_at_the_drawn_angle(controller, stand, swing, thor):
    phases = (Phase(duration_s=0.2, held=True), Phase(duration_s=0.5))
    rig = Rig(controller=controller, plant=swing, partner=stand)
    trace = play(rig, Scenario(name="hold", phases=phases), [at(thor, phi=0.6)])
    assert np.all(np.isnan(trace.outputs["phi"][0, :200]))
    np.testing.assert_allclose(trace.outputs["phi"][0, 200:], 0.6, atol=1e-9)
    np.testing.assert_allclose(trace.outputs["F1"][0], resting_by_hand(thor, 0.6)[1], rtol=1e-9)


def test_a_loop_that_is_unstable_at_the_angle_alone_fails_there(controller, swing, thor):
    """Beyond 90 degrees a constant force holds the pendulum on top of its swing: stable nowhere."""
    drawn = at(thor, phi=2.0)
    assert not controller.close(swing, drawn).figures().stable
    verification = verify(controller, {"swing": swing}, thor, draws={"swing": [drawn]}, scenarios=[STEP])
    steps = {row.draw: row for row in verification.rows}
    assert steps["nominal"].passed and not steps["1"].passed
    assert steps["1"].reason.startswith("unstable: the linear loop's spectral radius is ")


def test_what_the_motor_cannot_hold_is_named(controller, swing, thor):
    verification = verify(controller, {"swing": swing}, thor, draws={"swing": [at(thor, phi=1.51)]}, scenarios=[STEP])
    current = abs(resting_by_hand(thor, 1.51)[2])
    assert current > 9.0
    assert (
        f"to rest at phi = 1.51 takes {-current:.4g} A, above the limit of 9 A; narrow its range"
        in verification.failures[0].reason
    )
    assert [row.draw for row in verification.failures] == ["1"]


def test_the_certificates_worst_draw_is_played_there(controller, swing, thor):
    ranges = {"I_p": (0.2, 0.5), "phi": (0.3, 0.8), "delay_s": (0.0, 2e-4)}
    _, drawn = certified = so.certify(
        controller, {"swing": swing}, thor, ranges=ranges, samples=50, simulations=False
    ).worst["swing"]
    worst = certified.parameters
    verification = verify(controller, {"swing": swing}, thor, draws={"swing": [drawn]}, scenarios=[STEP])
    assert verification.rows[1].parameters == pytest.approx(worst)
    again = verification.replay(verification.rows[1])
    values = thor.update(I_p=worst["I_p"])
    assert again.outputs["F1"][0, 0] == pytest.approx(resting_by_hand(values, worst["phi"])[1])


def test_a_law_whose_reference_does_nothing_is_refused(controller, swing, thor):
    deaf = replace(controller, law=scaled(controller.law, 0.0, 1.0))
    loop = Rig(controller=deaf, plant=swing).loop(held=False)
    assert runnable(deaf).integrators
    with pytest.raises(ControlError, match="blocked at 0 Hz"):
        equilibrium(loop, [swing.complete(at(thor, phi=0.3))])


def test_a_limit_cycle_at_the_angle_is_where_the_describing_function_says(controller, swing, thor):
    """1 + N(A) L = 0 with L of the drawn angle and delay, N(A) = 2/pi (asin s + s sqrt(1 - s^2)), s = limit/A."""
    drawn = at(thor, phi=0.7, delay_s=0.4e-3)
    law = Gains(k_p=27.0, k_i=0.0, k_d=0.27, T_f=1e-3, k_r=28.0)
    wild = replace(controller, law=law.law("pd", TS))
    loop = wild.close(swing, drawn)
    assert not loop.figures().stable
    f = np.linspace(20, 200, 200_001)
    gain = loop.open_loop(f)
    k = np.flatnonzero((gain.imag[:-1] * gain.imag[1:] < 0) & (gain.real[:-1] < -1))[0]
    needed, s = -1 / gain.real[k], np.linspace(1e-4, 1, 100_001)
    motor = 9.0 / wild.command.per_effort / np.interp(needed, 2 / np.pi * (np.arcsin(s) + s * np.sqrt(1 - s**2)), s)
    force = np.abs(loop.plant.response(f[k : k + 1]))[0] * needed * motor
    kick = Scenario(name="kick", phases=(Phase(duration_s=0.1, force_N=200.0), Phase(duration_s=3.0)))
    row = verify(wild, {"swing": swing}, thor, scenarios=[kick], draws={"swing": [drawn]}).rows[1]
    assert "sustains itself" in row.reason
    assert row.limit_cycle_hz == pytest.approx(f[k], rel=0.015)
    assert row.limit_cycle_N == pytest.approx(force, rel=0.05)


def test_conditions_of_the_nominal_values_are_in_the_worst_case(controller, swing, thor):
    there = at(thor, phi=0.9)
    certificate = so.certify(
        controller, {"swing": swing}, there, ranges={"I_p": (0.3, 0.4)}, samples=20, simulations=False
    )
    worst = certificate.worst["swing"]
    assert worst.ms >= certificate.plants["swing"].ms
    again = controller.close(swing, at(thor.update(**worst.parameters), phi=0.9)).figures()
    assert worst.ms == pytest.approx(again.ms, rel=1e-9)
