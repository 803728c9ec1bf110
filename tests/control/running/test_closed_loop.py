"""The sampled loop against scipy's DOP853 and plain NumPy, sample by sample."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.signal import cont2discrete

import seaopt as so
from seaopt.control.laws.realisation import realise, runnable
from seaopt.control.running.closed_loop import LoopState, SampledLoop, at_rest, run_loop
from seaopt.control.running.force_run import close_loop
from seaopt.control.running.sampled_loop import largest_command
from seaopt.errors import SimulationError
from seaopt.simulation import native
from tests.laws import law_of, scaled

TS = 1e-3
# k_p = 3, k_i = 2, k_d = 0.03, T_f = 1 ms and unit feedforward, written out: (1 - q)(1 - q/2)
NUM_R, NUM_Y, DEN = [19.001, -35.9995, 16.9995], [18.001, -34.4995, 16.4995], [1.0, -1.5, 0.5]
LAW = law_of(NUM_Y, DEN, reference=(NUM_R, DEN))
GAIN = 1 / 240.3318


def law(limit=9.0, **changes):
    options = {"per_effort": GAIN, "command_limit": limit, **changes}
    return realise(LAW, **options)


@pytest.fixture
def no_compiler(monkeypatch):
    monkeypatch.setenv("SEAOPT_COMPILER", "none")
    native.load_library.cache_clear()
    yield
    native.load_library.cache_clear()


def swing_by_hand(params):
    """Return the unlumped swing's right-hand side and F1, written from the paper: M qdd = F_m - ... - F2."""
    p = {name: item.value for name, item in params.items()}
    r = p["l"] / (2 * np.pi * p["N_p"])
    m, b = p["J"] / r**2, p["b_r"] / r**2

    def rate(t, x, current):
        q, qd, phi, phid = x
        arm, slope = p["L_a"] * np.cos(phi), -p["L_a"] * np.sin(phi)
        f1 = p["k"] * (q + p["L_a"] * np.sin(phi))
        push = p["K_tau"] / r * current - b * qd - p["f_c"] * np.tanh(qd / p["v_s"])
        # In qdd, phidd and F2: m_l xdd_l = F2 - F1, M qdd = push - F2, I_p phidd = -F2 arm - m g L sin - d phid.
        rows = [[p["m_l"], p["m_l"] * arm, -1], [m, 0, 1], [0, p["I_p"], arm]]
        right = [-f1 - p["m_l"] * slope * phid**2, push, -p["m"] * p["g"] * p["L"] * np.sin(phi) - p["d"] * phid]
        qdd, phidd, _ = np.linalg.solve(rows, right)
        return [qd, qdd, phid, phidd]

    return rate, lambda x: p["k"] * (x[0] + p["L_a"] * np.sin(x[2]))


def hard_case(swing, thor, friction, sensors, step):
    """0.4 s with friction, the pendulum's sine, two samples of delay and saturation with anti-windup."""
    loop = SampledLoop(plant=swing, law=law(3.0), measured="F1", delay_samples=2, sensors=sensors, command_step=step)
    reference = np.where(np.arange(400) < 200, 120.0, -60.0)
    start = np.array([1e-4, 0.0, 0.8, -1.0])
    start[0] -= 0.0725 * np.sin(0.8)
    state = at_rest(loop, 1, start)
    params = thor.update(f_c=friction, d=0.05)
    run = run_loop(loop, [params], reference, start=state, seed=5)
    assert np.max(np.abs(run.current)) == pytest.approx(3.0)
    return loop, reference, start, run, swing_by_hand(params)


def held(rate, x, current):
    return solve_ivp(rate, (0, TS), x, args=(current,), method="DOP853", rtol=1e-10, atol=1e-13).y[:, -1]


@pytest.mark.parametrize("friction", [0.0, 30.0])
def test_the_nonlinear_swing_is_dop853s(swing, thor, friction):
    loop, reference, x, run, (rate, force) = hard_case(swing, thor, friction, so.Sensors(), 0.0)
    memory, waiting, forces, currents = loop.law.reset(), [0.0, 0.0], [], []
    for k in range(400):
        forces.append(force(x))
        current, memory = loop.law.step(memory, reference[k], forces[-1])
        waiting.append(current)
        currents.append(waiting.pop(0))
        x = held(rate, x, currents[-1])
    np.testing.assert_allclose(run.current[0], currents, atol=1e-4)
    np.testing.assert_allclose(run.outputs["F1"][0], forces, atol=1e-5 * np.max(np.abs(forces)))
    np.testing.assert_allclose(run.end.x[0], x, rtol=1e-5, atol=1e-8)


def test_noise_and_rounding_are_numpys(swing, thor):
    """Each sample from the run's own states: a quantiser makes a step of any difference, and whole runs part."""
    sensors = so.Sensors(noise_std={"F1": 0.7}, quantisation={"F1": 0.25}, offset={"F1": 1.5}, saturation={"F1": 150.0})
    loop, reference, _, run, (rate, force) = hard_case(swing, thor, 30.0, sensors, 0.01)
    noise = 0.7 * np.random.default_rng(5).normal(size=400)
    memory, waiting, currents = loop.law.reset(), [0.0, 0.0], []
    for k in range(400):
        reading = np.clip(force(run.states[0, k]) + noise[k] + 1.5, -150.0, 150.0)
        current, memory = loop.law.step(memory, reference[k], 0.25 * np.round(reading / 0.25))
        waiting.append(0.01 * np.round(current / 0.01))
        currents.append(waiting.pop(0))
    np.testing.assert_allclose(run.current[0], currents, atol=1e-9)
    ends = np.array([held(rate, run.states[0, k], currents[k]) for k in range(0, 399, 7)])
    scale = np.max(np.abs(run.states[0]), axis=0)
    assert np.max(np.abs(ends - run.states[0, 1:400:7]) / scale) < 2e-7


@pytest.mark.parametrize("delay", [0, 1, 3])
def test_without_limits_it_is_the_linear_loop(stand, thor, delay):
    """scipy's zero-order hold, the difference equation of the law and a queue."""
    loop = SampledLoop(plant=stand, law=law(None), measured="F1", delay_samples=delay)
    n = 300
    run = run_loop(loop, [thor], np.full(n, 50.0), rtol=1e-9)
    model = stand.linearize(thor)
    a, b, c, _, _ = cont2discrete((model.A, model.B * GAIN, model.C[:1], np.zeros((1, 1))), TS, "zoh")
    x, queue, forces = np.zeros(2), [0.0] * delay, []
    e, u = [0.0, 0.0], [0.0, 0.0]
    num_r, num_y = np.array(NUM_R), np.array(NUM_Y)
    y = [0.0, 0.0]
    for _ in range(n):
        forces.append((c @ x)[0])
        e, y = [50.0, *e], [forces[-1], *y]
        u = [1.5 * u[0] - 0.5 * u[1] + num_r @ e[:3] - num_y @ y[:3], *u]
        queue.append(u[0])
        x = a @ x + b[:, 0] * queue.pop(0)
    np.testing.assert_allclose(run.outputs["F1"][0], forces, rtol=1e-6, atol=1e-6)


def delayed(params, delay_s):
    return params.with_parameters(so.Parameter(name="delay_s", value=delay_s, unit="s"))


@pytest.mark.parametrize("delay_s", [0.0, 0.4e-3, 1e-3, 2.7e-3])
def test_a_delay_of_any_length_is_two_pieces_of_a_sample(stand, thor, delay_s):
    """The older command for what is left of the delay, the newer one for the rest: two exact holds."""
    loop = SampledLoop(plant=stand, law=law(None), measured="F1", delay_samples=1, longest_delay_s=2.7e-3)
    run = run_loop(loop, [delayed(thor, delay_s), delayed(thor, 1.1e-3)], np.full(200, 50.0), rtol=1e-9)
    model = stand.linearize(thor)
    whole, rest = int(delay_s / TS + 1e-9), delay_s - TS * int(delay_s / TS + 1e-9)
    held = lambda t: cont2discrete((model.A, model.B * GAIN, model.C[:1], np.zeros((1, 1))), t, "zoh")[:3]  # noqa: E731
    (a1, b1, c), (a2, b2, _) = held(max(rest, 1e-15)), held(TS - rest)
    x, memory, commands, forces = np.zeros(2), loop.law.reset(), [0.0] * (whole + 2), []
    for _ in range(200):
        forces.append((c @ x)[0])
        current, memory = loop.law.step(memory, 50.0, forces[-1])
        commands.append(current / GAIN)
        older, newer = commands[-3 - whole], commands[-2 - whole]
        x = a2 @ (a1 @ x + b1[:, 0] * older) + b2[:, 0] * newer
    np.testing.assert_allclose(run.outputs["F1"][0], forces, rtol=1e-6, atol=1e-6)


def test_the_interpreter_gives_the_compiled_numbers(thor, no_compiler):
    runs = []
    for compiled in (False, True):
        if compiled:
            native.load_library.cache_clear()
            with pytest.MonkeyPatch.context() as patch:
                patch.delenv("SEAOPT_COMPILER")
                if native.find_compiler() is None:
                    pytest.skip("no compiler here")
                runs.append(_noisy(so.plants.moving_output(), thor))
        else:
            runs.append(_noisy(so.plants.moving_output(), thor))
    np.testing.assert_allclose(runs[0].outputs["F1"], runs[1].outputs["F1"], atol=1e-7)
    np.testing.assert_allclose(runs[0].end.z, runs[1].end.z, atol=1e-7)
    np.testing.assert_allclose(runs[0].peaks["F2"], runs[1].peaks["F2"], atol=1e-7)
    assert runs[0].error == pytest.approx(runs[1].error, rel=1e-3)


def _noisy(plant, thor):
    loop = SampledLoop(
        plant=plant, law=law(), measured="F1", delay_samples=1, sensors=so.Sensors(noise_std={"F1": 1.0}),
        longest_delay_s=1.3e-3,
    )  # fmt: skip
    return run_loop(loop, [delayed(thor, 1.3e-3), thor.update(f_c=20.0)], np.full(300, 80.0), seed=3)


def test_a_batch_is_its_runs_one_by_one(swing, thor):
    loop = SampledLoop(plant=swing, law=law(), measured="F1", delay_samples=1)
    sets = [thor.update(I_p=value) for value in (0.2, 0.36, 0.6)]
    together = run_loop(loop, sets, np.full(200, 60.0))
    for k, params in enumerate(sets):
        alone = run_loop(loop, [params], np.full(200, 60.0))
        np.testing.assert_allclose(together.outputs["F1"][k], alone.outputs["F1"][0], rtol=1e-9)


def test_runs_are_printed_short(stand, thor):
    run = close_loop(lambda state, r, y: (0.01 * (r - y), state), None, stand, thor, np.full(50, 10.0))
    assert repr(run).startswith("ForceRun of 50 samples, 0.049 s: reference to 10 N, force up to")
    loop = SampledLoop(plant=stand, law=law(), measured="F1", delay_samples=1)
    whole = run_loop(loop, [thor, thor], np.full(50, 10.0))
    assert repr(whole).startswith("LoopRun of 2 runs of 50 samples, from 0 to 0.049 s: largest magnitudes F1 ")
    for text in (repr(run), repr(whole)):
        assert len(text) < 400 and "\n" not in text and "array" not in text


def test_a_run_goes_on_where_another_ended(swing, thor):
    loop = SampledLoop(plant=swing, law=law(), measured="F1", delay_samples=2)
    whole = run_loop(loop, [thor], np.full(200, 60.0))
    first = run_loop(loop, [thor], np.full(120, 60.0))
    second = run_loop(loop, [thor], np.full(80, 60.0), start=first.end, start_s=0.12)
    np.testing.assert_allclose(second.outputs["F1"][0], whole.outputs["F1"][0, 120:], rtol=1e-9)
    assert second.time[-1] == pytest.approx(whole.time[-1])


def test_peaks_between_samples_are_seen(thor):
    """A free ringing at 160 Hz, six samples a period: the largest of the samples is not the top."""
    plant = so.plants.two_link("fixed", "mass")
    silent = realise(law_of([0.0], sample_time_s=3.1e-3), per_effort=GAIN)
    params = plant.defaults.update(m_2=1e6, b_r=0.0, J=1e-3)
    loop = SampledLoop(plant=plant, law=silent, measured="F1", delay_samples=1)
    state = at_rest(loop, 1, np.array([0.0, 0.0, 1e-4, 0.0]))
    run = run_loop(loop, [params], np.zeros(30), start=state)
    assert run.peaks["F1"][0] == pytest.approx(65.5, rel=1e-2)


def test_stiff_friction_takes_smaller_steps_or_is_refused(stand, thor):
    loop = SampledLoop(plant=stand, law=law(), measured="F1", delay_samples=1)
    smooth = run_loop(loop, [thor.update(f_c=50.0)], np.full(100, 80.0))
    sharp = run_loop(loop, [thor.update(f_c=50.0, v_s=3e-6)], np.full(100, 80.0))
    assert sharp.substeps > smooth.substeps
    with pytest.raises(SimulationError, match="smooth the friction"):
        run_loop(loop, [thor.update(f_c=500.0, v_s=1e-9)], np.full(100, 80.0))


@pytest.mark.parametrize("speed", [400.0, 2000.0])
def test_bristles_that_slip_fast_are_no_loop_that_runs_away(speed):
    """They settle at a rate of sigma_0 |v|/f_c, here 20 and 100 in a sample: too long steps lose them at once."""
    plant = so.plants.rotary(link="locked", parts=["lugre"])
    params = plant.defaults.update(
        N=50.0, K_tau=0.03, J_m=2e-5, b_r=6e-5, f_c=0.006, k_s=250.0, c_s=0.3, sigma_0=0.3, sigma_1=1e-4, eta=1.0
    )
    loop = SampledLoop(plant=plant, law=realise(LAW, per_effort=1 / 1.5, command_limit=9.0), measured="tau_s",
                       delay_samples=1)  # fmt: skip
    x = np.array([-60.0, speed, -0.02])
    start = at_rest(loop, 1, x)
    run = run_loop(loop, [params], np.zeros(40), start=start)

    def rate(t, x, current):
        theta, v, z = x
        slip = v - 0.3 * abs(v) * z / 0.006
        spring = (250.0 * theta + 0.3 * v) / 50.0
        push = 0.03 * current - 6e-5 * v - (0.3 * z + 1e-4 * slip) - spring / 50.0
        return [v, push / 2e-5, slip]

    paths = [x]
    for current in run.current[0]:
        paths.append(
            solve_ivp(rate, (0, TS), paths[-1], args=(current,), method="LSODA", rtol=1e-10, atol=1e-13).y[:, -1]
        )
    scale = np.max(np.abs(paths), axis=0)
    assert np.max(np.abs(run.states[0] - paths[:-1]) / scale) < 1e-4


@pytest.mark.parametrize("damping", [0.1, 0.5])
def test_a_stiff_draw_beside_a_soft_one_does_not_run_away(stand, thor, damping):
    """Steps that do for the first plant leave the numbers on the second: b/J = 3e4 and 1.5e5 per second."""
    loop = SampledLoop(plant=stand, law=law(None), measured="F1", delay_samples=1)
    stiff = thor.update(b_r=damping)
    run = run_loop(loop, [thor, stiff], np.full(300, 80.0))
    model = stand.linearize(stiff)
    a, b, c, _, _ = cont2discrete((model.A, model.B, model.C[:1], np.zeros((1, 1))), TS, "zoh")
    x, memory, waiting, forces = np.zeros(2), loop.law.reset(), 0.0, []
    for _ in range(300):
        forces.append((c @ x)[0])
        current, memory = loop.law.step(memory, 80.0, forces[-1])
        x, waiting = a @ x + b[:, 0] * waiting, current
    np.testing.assert_allclose(run.outputs["F1"][1], forces, rtol=1e-4, atol=1e-4)


def test_a_loop_that_runs_away_is_left_where_it_does(stand, thor):
    """An unstable loop without limit: the largest eigenvalue says when the largest float is passed, or its 1e-7th."""
    wild = realise(scaled(LAW, 100.0), per_effort=GAIN)
    loop = SampledLoop(plant=stand, law=wild, measured="F1", delay_samples=1)
    run = run_loop(loop, [thor, thor.update(J=3.4e-6)], np.full(2000, 50.0))
    model = stand.linearize(thor)
    a, b, c, _, _ = cont2discrete((model.A, model.B * GAIN, model.C[:1], np.zeros((1, 1))), TS, "zoh")
    n = wild.c.size
    whole = np.block([
        [a, b, np.zeros((2, n))], [-wild.d_measurement * c, np.zeros((1, 1)), wild.c[None]],
        [-np.outer(wild.b_measurement, c), np.zeros((n, 1)), wild.a],
    ])  # fmt: skip
    rate = np.log(np.max(np.abs(np.linalg.eigvals(whole))))
    force = run.outputs["F1"][0]
    lost = np.flatnonzero(~np.isfinite(force))[0]
    left = np.log(np.finfo(float).max) - np.log(np.abs(force[lost // 2]))
    assert left - 16 < rate * (lost - lost // 2) < left + 1
    assert run.substeps < 64


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"measured": "F9"}, "F9"),
        ({"measured": "F2", "delay_samples": 0}, "without delay"),
        ({"command_step": -1.0}, "command_step"),
        ({"longest_delay_s": -1.0}, "longest_delay_s"),
        ({"sensors": so.Sensors(noise_std={"F1": -1.0})}, "negative"),
    ],
)
def test_bad_loops(stand, changes, words):
    with pytest.raises(SimulationError, match=words):
        SampledLoop(**{"plant": stand, "law": law(), "measured": "F1", "delay_samples": 1, **changes})


def test_bad_runs(stand, thor):
    loop = SampledLoop(plant=stand, law=law(), measured="F1", delay_samples=1)
    for options, words in (
        ({"params": []}, "no parameters"),
        ({"reference": np.ones((3, 5))}, "shape"),
        ({"external": {"Fe3": np.ones(5)}}, "Fe3"),
        ({"params": [delayed(thor, 1e-3)]}, "longest of all runs"),
        ({"start": LoopState(x=np.zeros((2, 2)), z=np.zeros((2, 3)))}, "2 runs"),
    ):
        with pytest.raises(SimulationError, match=words):
            run_loop(loop, **{"params": [thor], "reference": np.ones(5), **options})


def test_the_largest_command_is_a_whole_step():
    assert largest_command(9.0, 0.07) == pytest.approx(8.96)
    assert largest_command(9.0, 0.0) == 9.0


def test_a_motor_that_friction_holds_against_its_cogging_stands_still():
    """Nothing is commanded, and the push is a third of the friction: what moves is rounding, which has no accuracy."""
    plant = so.plants.rotary(link="locked", parts=("cogging",))
    params = plant.defaults.update(J_m=3e-5, b_r=2e-4, K_tau=0.06, N=60.0, k_s=250.0, f_c=0.02, b_g=0.006, n_g=42.0)
    controller = so.tune(plant, params, so.ControllerSpec(measured="tau_s", bandwidth_hz=20, max_sensitivity=1.7))
    loop = SampledLoop(plant=plant, law=runnable(controller), measured="tau_s", delay_samples=1, sticks=True)
    run = run_loop(loop, [params], np.zeros(100))
    assert np.max(np.abs(run.states[..., list(plant.states).index("theta_m")])) < 1e-8


def test_a_motor_that_friction_holds_while_its_current_rises_stands_still():
    """The push changes within a sample and stays below the friction, so that nothing moves. A step holds it with one
    constant force, which leaves a velocity within the step: the place is kept all the same.
    """
    plant = so.plants.rotary(link="locked", parts=("current_loop",))
    params = plant.defaults.update(current_loop_hz=400.0, f_c=0.05, K_tau=0.06)
    controller = so.tune(plant, params, so.ControllerSpec(measured="tau_s", bandwidth_hz=20, max_sensitivity=1.7))
    loop = SampledLoop(plant=plant, law=runnable(controller), measured="tau_s", delay_samples=1, sticks=True)
    reference = 0.1 * 0.05 * 50.0 * np.sin(2 * np.pi * 1.5 * TS * np.arange(300))
    run = run_loop(loop, [params], reference)
    pushed = 0.06 * np.max(np.abs(run.current))  # N m
    assert 0.0 < pushed < 0.05
    assert np.max(np.abs(run.states[..., list(plant.states).index("theta_m")])) == 0.0
    assert run.substeps < 50


def _slipping(rtol):
    """Run 0.4 s of a joint that stands still for a quarter of the time and slips in between."""
    plant = so.plants.rotary(link="locked", parts=("current_loop",))
    params = plant.defaults.update(current_loop_hz=100.0, f_c=0.05, K_tau=0.06)
    controller = so.tune(plant, params, so.ControllerSpec(measured="tau_s", bandwidth_hz=20, max_sensitivity=1.7))
    loop = SampledLoop(plant=plant, law=runnable(controller), measured="tau_s", delay_samples=1, sticks=True)
    return run_loop(loop, [params], 2.0 * np.sin(2 * np.pi * 5 * TS * np.arange(400)), rtol=rtol)


def _time_stepping(current, h):
    """Return [theta_m, thetad_m, I] at the samples by Moreau's steps, of order one: a force of at most f_c in each."""
    inertia, damping, constant, ratio, stiffness, friction, fade = (
        1e-4,
        1e-4,
        0.06,
        50.0,
        300.0,
        0.05,
        2 * np.pi * 100.0,
    )
    angle = speed = amperes = 0.0
    rows = []
    for command in current:
        rows.append((angle, speed, amperes))
        for _ in range(round(TS / h)):
            after = command + (amperes - command) * np.exp(-fade * h)
            push = constant * 0.5 * (amperes + after) - stiffness * angle / ratio**2 - damping * speed
            free = speed + h / inertia * push
            then = np.sign(free) * max(abs(free) - h * friction / inertia, 0.0)
            angle += h * 0.5 * (speed + then) if then * speed > 0.0 else h * then
            speed, amperes = then, after
    return np.array(rows)


def test_short_steps_where_a_joint_slips_alone_are_as_right_as_short_ones_everywhere():
    run = _slipping(1e-6)
    assert run.substeps < 50  # in every sample it takes 96
    assert 0.1 < np.mean(np.abs(run.states[0, :, 1]) < 1e-6) < 0.5
    coarse, fine = (_time_stepping(run.current[0], h) for h in (1e-5, 2e-6))
    size = np.max(np.abs(run.states[0]), axis=0)
    np.testing.assert_allclose(run.states[0] / size, (5.0 * fine - coarse) / 4.0 / size, atol=1e-5)


def test_the_interpreter_takes_short_steps_in_the_same_samples(monkeypatch):
    if native.find_compiler() is None:
        pytest.skip("no compiler here")
    compiled = _slipping(1e-6)
    monkeypatch.setenv("SEAOPT_COMPILER", "none")
    native.load_library.cache_clear()
    interpreted = _slipping(1e-6)
    native.load_library.cache_clear()
    np.testing.assert_allclose(
        interpreted.states, compiled.states, rtol=0.0, atol=1e-12 * np.max(np.abs(compiled.states))
    )
    assert interpreted.error == pytest.approx(compiled.error, rel=1e-6)
