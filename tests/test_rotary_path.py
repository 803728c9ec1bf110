"""A rotary actuator and the ball screw that moves like it go the whole way and come to the same figures.

With a lead of 2 pi metres a screw travels as far as its motor turns, so that a screw with N^2 J_m, N^2 b_r, N K_tau,
N f_c and v_s/N, spring at link 2, is the rotary one with x_2 = -theta_l: every figure of the linear path, which has
references of its own, is one for the rotary path, in N m and rad.
"""

from __future__ import annotations

import re
from dataclasses import fields, replace
from html import unescape

import numpy as np
import pytest

import seaopt as so
from seaopt.bench import Chirp, Noise
from seaopt.control import MPCSpec, export, force_mpc, passivity
from seaopt.control.laws.friction import describe_friction
from seaopt.control.loops.loop import LoopFigures
from seaopt.control.running.equilibrium import equilibrium
from seaopt.estimation import Limits, Multisines, design_experiment
from seaopt.frequency import survey
from seaopt.robustness import coupled_stability
from seaopt.robustness.bounds.bracket import Budget
from seaopt.robustness.verification.large_signal import large_signal
from seaopt.robustness.verification.verification import verify
from tests.words import check_words

N = 100.0
ROTARY = {"J_m": 2.4e-5, "b_r": 3e-4, "K_tau": 0.0369, "N": N, "k_s": 300.0, "eta": 0.7, "f_c": 0.0, "v_s": 1.0}
LINEAR = {
    "J": N**2 * ROTARY["J_m"], "b_r": N**2 * ROTARY["b_r"], "K_tau": N * ROTARY["K_tau"], "k": ROTARY["k_s"],
    "eta": ROTARY["eta"], "l": 2 * np.pi, "N_p": 1.0, "v_s": ROTARY["v_s"] / N, "f_c": 0.0,
}  # fmt: skip
FRICTION = 0.004  # N m at the motor


SHANK = {"J_l": 0.25, "d_l": 0.3, "m": 4.0, "L": 0.2}
PENDULUM = {"I_p": 0.25, "d": 0.3, "m": 4.0, "L": 0.2, "L_a": 1.0}


class Path:
    """One of the two: its plants and values, the name of its link's inertia, and how large its friction is."""

    def __init__(self, stand, swing, values, link, scale):
        self.stand, self.swing, self.link, self.scale = stand, swing, link, scale
        self.params, self.measured = swing.defaults.update(**values), stand.sensing.regulated[0]

    def rubbing(self):
        return self.params.update(f_c=FRICTION * self.scale)


@pytest.fixture(scope="module")
def paths():
    stand, swing = (make(spring="link2") for make in (so.plants.high_impedance, so.plants.moving_output))
    linear = Path(stand, swing, LINEAR | PENDULUM, "I_p", N)
    return linear, Path(so.plants.rotary("locked"), so.plants.rotary("pendulum"), ROTARY | SHANK, "J_l", 1.0)


@pytest.fixture(scope="module")
def controllers(paths):
    return [tune(path, path.params) for path in paths]


def tune(path, params, **asked):
    options = {"bandwidth_hz": 15.0, "max_sensitivity": 1.6, "current_limit_A": 9.0}
    spec = so.ControllerSpec(measured=path.measured, **options | asked)
    return so.tune(path.stand, params, spec, robust_to={"swing": path.swing})


def certify(path, controller, params, **options):
    plants = {"stand": path.stand, "swing": path.swing}
    return so.certify(
        controller, plants, params, samples=20, ranges={path.link: (0.15, 0.5)}, **options, simulations=False
    )


def test_the_controller_is_the_same(controllers):
    linear, rotary = controllers
    assert rotary.feasible and rotary.gains == pytest.approx(linear.gains, rel=1e-6)
    for field in fields(LoopFigures):
        one, other = getattr(linear.achieved, field.name), getattr(rotary.achieved, field.name)
        assert other == (None if one is None else pytest.approx(one, rel=1e-6)), field.name
    assert rotary.command.per_effort == pytest.approx(linear.command.per_effort, rel=1e-12)
    assert rotary.command.effort_unit == "N m"
    check_words(repr(rotary), unescape(rotary._repr_html_()))


@pytest.mark.slow
@pytest.mark.parametrize("structure", ["pd", "pid_dob"])
def test_other_structures_are_the_same(paths, structure):
    linear, rotary = (tune(path, path.params, structure=structure) for path in paths)
    assert rotary.feasible == linear.feasible and rotary.gains == pytest.approx(linear.gains, rel=1e-4)


@pytest.mark.slow
def test_the_certificate_is_the_same(paths, controllers):
    """Draws, the worst case from below and above, and steps of several sizes."""
    first, second = (
        certify(path, controller, path.params, bounds=Budget(boxes=2))
        for path, controller in zip(paths, controllers, strict=True)
    )
    assert second.monte_carlo.failures == first.monte_carlo.failures
    assert [(row.name, row.met) for row in second.requirements] == [(row.name, row.met) for row in first.requirements]
    for one, other in zip(first.requirements, second.requirements, strict=True):
        assert other.value == pytest.approx(one.value, rel=1e-4, abs=1e-9), one.name
    check_words(repr(second), repr(second.runs))


def test_the_scenarios_are_the_same(paths, controllers):
    runs = [
        verify(controller, {"stand": path.stand, "swing": path.swing}, path.params)
        for path, controller in zip(paths, controllers, strict=True)
    ]
    played = [{(row.plant, row.scenario): row for row in verification.rows} for verification in runs]
    # Along x a pendulum swings by its sine, and its lever arm vanishes at 90 degrees; about the axis it does not.
    assert {key for key in played[0] if key[1] != "fall through 90 deg"} == set(played[1])
    for key, other in played[1].items():
        one = played[0][key]
        assert one.passed == other.passed
        for name in ("peak_force_N", "peak_command", "peak_energy_J", "final_error_N", "settling_s"):
            a, b = getattr(one, name), getattr(other, name)
            wanted = None if a is None else pytest.approx(a, rel=1e-4, abs=1e-6)
            assert b == wanted or key[0] != "stand", (key, name)
    assert {row.scenario for row in runs[1].rows} >= {"impact", "payload", "contact"}
    check_words(repr(runs[1]))


def test_friction_at_the_motor_is_friction_at_the_screw(paths):
    """Margins in slopes of either side's friction, predicted and simulated amplitudes, steps that stick."""
    margins, amplitudes, sweeps, texts = [], [], [], []
    for path in paths:
        params = path.rubbing()
        controller = tune(path, params)
        margins.append(controller.friction.least_slope / path.scale**2)
        velocities = np.array([0.01, 0.1, 1.0]) / path.scale * N
        name = next(iter(path.stand.friction))
        amplitudes.append(describe_friction(path.stand, params, name, velocities) / path.scale**2)
        sweeps.append(large_signal(controller, path.stand, params, frequencies_hz=(4.0, 12.0)))
        texts += [repr(controller), repr(sweeps[-1])]
    assert margins[1] == pytest.approx(margins[0], rel=1e-4)
    np.testing.assert_allclose(amplitudes[1], amplitudes[0], rtol=1e-6)
    np.testing.assert_allclose(sweeps[1].amplitude_N, sweeps[0].amplitude_N, rtol=1e-4)
    np.testing.assert_allclose(np.abs(sweeps[1].gain), np.abs(sweeps[0].gain), rtol=1e-3, atol=1e-4)
    check_words(*texts[len(texts) // 2 :])


@pytest.mark.slow
def test_port_and_environments_are_the_same(paths, controllers):
    grid = {"masses_kg": (0.01, 10.0), "stiffnesses_N_per_m": (1.0, 1e5), "dampings_N_s_per_m": (0.0, 0.1), "points": 4}
    ports, maps = [], []
    for path, controller in zip(paths, controllers, strict=True):
        ports.append(passivity(controller, path.stand, path.params))
        maps.append(coupled_stability(controller, path.stand, path.params, **grid))
    np.testing.assert_allclose(ports[1].bands_hz, ports[0].bands_hz, rtol=1e-6)
    assert ports[1].least_damping_N_s_per_m == pytest.approx(ports[0].least_damping_N_s_per_m, rel=1e-6)
    np.testing.assert_allclose(maps[1].spectral_radius, maps[0].spectral_radius, rtol=1e-8)
    assert maps[1].fixed_stable == maps[0].fixed_stable
    bounded = paths[1].params.with_parameters(replace(paths[1].swing.defaults["J_l"], value=0.25, min=0.1, max=1.0))
    own = coupled_stability(controllers[1], paths[1].swing, bounded, points=3)
    assert own.mass[-1] == 10.0  # kg m^2: the link's own bounds are not the environment's
    check_words(repr(ports[1]), repr(maps[1]), repr(own))


def test_predictive_control_is_the_same(paths):
    laws = [force_mpc(path.stand, path.params, MPCSpec(current_limit_A=9.0, measured=path.measured, bandwidth_hz=15.0))
            for path in paths]  # fmt: skip
    units = dict(zip(laws[1].kalman.names, laws[1].kalman.units, strict=True))
    assert (units["spring_deflection"], units["tau_s"], units["thetad_m"]) == ("rad", "N m", "rad/s")
    steps = [law.step(law.start, reference_N=5.0, measurement_N=0.1) for law in laws]
    assert steps[1].command == pytest.approx(steps[0].command, rel=1e-6)
    check_words(repr(laws[1]).replace("ForceMPC", ""))


def test_the_exported_code_has_the_same_numbers(controllers, tmp_path):
    texts = []
    for number, controller in enumerate(controllers):
        export(controller, tmp_path / str(number))
        texts.append({path.name: path.read_text(encoding="utf-8") for path in (tmp_path / str(number)).iterdir()})
    for name in ("force_law.c", "force_law_gains.h"):
        numbers = [[float(x) for x in re.findall(r"-?\d+\.\d+(?:e-?\d+)?", text[name])] for text in texts]
        np.testing.assert_allclose(numbers[1], numbers[0], rtol=1e-4, atol=1e-9)
    assert "/* A/(N m) */" in texts[1]["force_law_gains.h"] and "reference_Nm" in texts[1]["force_law.h"]
    check_words(*(text.replace("force_law", "") for text in texts[1].values()))


def test_a_fit_and_its_design_are_the_same(paths):
    """Two free parameters from a wrong start, on the same torque; what to record next."""
    found, designs = [], []
    names = (("J", "b_r"), ("J_m", "b_r"))
    for path, free in zip(paths, names, strict=True):
        sensors = so.Sensors(noise_std={path.measured: 0.05})
        excitation = (Noise(std=1.0, band_hz=40.0),)
        log = so.virtual_log(path.stand, path.params, excitation, duration_s=5, rate_hz=500, seed=3, sensors=sensors)
        start = path.params.update(**{name: 3.0 * path.params[name].value for name in free}).free(*free)
        fit = so.fit([so.Experiment(plant=path.stand, log=log, outputs=(path.measured,))], start)
        found.append([(fit.parameters[name].value, fit.parameters[name].std) for name in free])
        limits = Limits(rms=1.0, duration_s=5.0, rate_hz=500.0)
        signal = Multisines(lines=10)
        designs.append(design_experiment(path.stand, fit.parameters.free(*free), limits, sigma={path.measured: 0.05},
                                         signal=signal))  # fmt: skip
    np.testing.assert_allclose(np.array(found[1]) * N**2, found[0], rtol=1e-3)
    assert repr(designs[1]).count("\n") == repr(designs[0]).count("\n")
    check_words(repr(designs[1]))


def test_a_raised_shank_rests_where_gravity_is_held(controllers, paths):
    from seaopt.control.laws.realisation import runnable
    from seaopt.control.running.closed_loop import SampledLoop

    knee, params = paths[1].swing, paths[1].params
    raised = params.with_parameters(so.Parameter(name="theta_l", value=0.5, unit="rad"))
    loop = SampledLoop(plant=knee, law=runnable(controllers[1]), measured="tau_s", delay_samples=1)
    rest = equilibrium(loop, [knee.complete(raised)])
    torque = 4.0 * 9.81 * 0.2 * np.sin(0.5)
    assert rest.force[0] == pytest.approx(torque, rel=1e-9)
    assert rest.rest_command[0] == pytest.approx(torque / (N * 0.7 * 0.0369), rel=1e-9)
    check_words(repr(rest))


def test_the_second_order_reading_of_a_locked_joint(paths):
    """(16) in kg m^2 and N m s/rad: of the torque alone, and close to the truth on a chirp without friction."""
    path = paths[1]
    log = so.virtual_log(path.stand, path.params, (Chirp(amplitude=1.0, f0_hz=0.05, f1_hz=60.0),), duration_s=60,
                         rate_hz=500, seed=1, sensors=so.Sensors(noise_std={"tau_s": 0.02}))  # fmt: skip
    measured = survey(path.stand, log, outputs=("tau_s", "theta_m"))
    torque, angle = measured.pairs
    drive = measured.drive(torque, path.params)
    assert drive.m_k.unit == "kg m^2" and drive.b_m.unit == "N m s/rad"
    assert drive.m_k.value == pytest.approx(N**2 * ROTARY["J_m"], rel=0.01)
    assert drive.efficiency.value == pytest.approx(ROTARY["eta"], rel=0.01)
    assert measured.drive(angle, path.params) is None
