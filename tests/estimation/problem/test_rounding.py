"""Intervals of fits to coarse encoders, and the covariance of rounding errors against those of rounded signals."""

import numpy as np
import pytest
from scipy.signal import chirp, cont2discrete, dlsim

import seaopt as so
from seaopt.errors import EstimationError
from seaopt.estimation.problem.rounding import Rounding, equate

RATE_HZ, N, K_TAU = 500.0, 50.0, 0.07
TRUTH = {"J_m": 4e-5, "b_r": 1e-3, "k_s": 300.0}


@pytest.mark.parametrize("noise", [0.0, 0.15, 0.3])
@pytest.mark.parametrize("steps", [0.2, 3.0, 40.0])
def test_the_covariance_is_that_of_rounded_signals(steps, noise):
    rng, q, t = np.random.default_rng(3), 0.7, np.arange(400) / 400
    y = 0.5 * steps * q * np.sin(2 * np.pi * 2.3 * t)
    influence = np.stack([np.sin(2 * np.pi * 2.3 * t), np.cos(5.0 * t), np.ones(400)])
    moved = []
    for phase in rng.uniform(0.0, q, 4000):
        read = np.round((y + phase + noise * q * rng.normal(size=400)) / q) * q - phase
        moved.append(influence @ (read - y))
    rounding = Rounding.of(q, float(q * np.hypot(noise, 1.0 / np.sqrt(12.0))), 3)
    assert rounding is not None
    rounding.add(influence, y - q * np.round(y / q))
    expected = rounding.multiply(influence @ influence.T)
    size = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(
        np.cov(np.array(moved).T) / np.outer(size, size), expected / np.outer(size, size), atol=0.1
    )


def test_under_noise_of_half_a_step_nothing_is_left_of_it():
    assert Rounding.of(1.0, float(np.hypot(0.51, 1.0 / np.sqrt(12.0))), 1) is None
    assert Rounding.of(0.0, 0.1, 1) is None


def fit_encoder(seed, steps, noise=0.0, stated=False):
    """Return a fit of a held joint's motor angle, in so many steps over its swing, with noise of so many before it."""
    log, step = record(seed, steps, noise)
    plant = so.plants.rotary(link="locked")
    known = plant.defaults.update(K_tau=K_TAU, N=N, c_s=0.0, f_c=0.0)
    start = known.update(**{name: 1.2 * value for name, value in TRUTH.items()}).free(*TRUTH)
    told = {"theta_m": step} if stated else {}
    return so.fit([so.Experiment(plant=plant, log=log, outputs=("theta_m",), quantisation=told)], start)


def record(seed, steps, noise=0.0):
    """Return the log of such a joint, and the step."""
    rng, t = np.random.default_rng(seed), np.arange(round(10.0 * RATE_HZ)) / RATE_HZ
    current = chirp(t, 0.1, 10.0, 30.0, phi=rng.uniform(0, 360)) * rng.uniform(0.8, 1.2)
    J_m, b_r, k_s = TRUTH.values()
    a = np.array([[0.0, 1.0], [-k_s / N**2 / J_m, -b_r / J_m]])
    held = cont2discrete((a, np.array([[0.0], [K_TAU / J_m]]), np.eye(2), np.zeros((2, 1))), 1.0 / RATE_HZ)
    angle = dlsim((*held[:2], np.array([[1.0, 0.0]]), np.zeros((1, 1)), 1.0 / RATE_HZ), current)[1][:, 0]
    step = 2.0 * np.max(np.abs(angle)) / steps
    read = angle + rng.uniform(0, step) + noise * step * rng.normal(size=t.size)
    return so.Log.from_arrays(time=t, I=current, theta_m=np.round(read / step) * step), step


def test_ten_steps_of_an_encoder_leave_intervals_that_hold():
    """Errors that follow the swing moved J_m and k_s by three times the std that white ones have, all fits met."""
    fits = [fit_encoder(seed, 10) for seed in range(8)]
    for name in ("J_m", "k_s"):
        off = np.array([fit.parameters[name].value - TRUTH[name] for fit in fits])
        z, of_noise = (
            off / np.array([getattr(fit.parameters[name], std) for fit in fits]) for std in ("total_std", "std")
        )
        assert np.sqrt(np.mean(of_noise**2)) > 2.0
        assert 0.5 < np.sqrt(np.mean(z**2)) < 1.4
        assert np.all(np.abs(z) < 2.5)


def test_noise_of_a_tenth_of_a_step_leaves_intervals_that_hold():
    """It does not make rounding white: the errors of 40 steps of swing are uniform ones, and follow the motion."""
    fits = [fit_encoder(seed, 40, 0.1) for seed in range(10)]
    assert all(fit.met for fit in fits)
    off = np.array([[fit.parameters[name].value / TRUTH[name] - 1.0 for name in TRUTH] for fit in fits])
    z = off / [[fit.parameters[name].total_std / TRUTH[name] for name in TRUTH] for fit in fits]
    assert np.count_nonzero(np.abs(z) < 1.96) >= 27  # of 30
    assert np.all(np.sqrt(np.mean(z**2, axis=0)) > 0.4)  # nor much too wide


def test_a_fine_encoder_s_intervals_stay_as_they_were():
    fit = fit_encoder(0, 400)
    for name in TRUTH:
        assert fit.parameters[name].total_std < 1.5 * fit.parameters[name].std


def test_a_step_that_decides_is_proposed_with_its_line_and_taken_from_it():
    fit = fit_encoder(3, 10)
    (note,) = (finding for finding in fit.findings if finding.kind == "quantisation")
    step = record(3, 10)[1]
    assert note.severity == "note" and note.where == "experiment.theta_m"
    assert note.proposal == f"[[experiment]]\nquantisation = {{ theta_m = {step:.6g} }}"
    assert note.proposal.splitlines()[1] in note.text
    stated = fit_encoder(3, 10, stated=True)
    assert not any(finding.kind == "quantisation" for finding in stated.findings)
    for name in TRUTH:
        assert stated.parameters[name].value == pytest.approx(fit.parameters[name].value, rel=1e-9)
        assert stated.parameters[name].total_std <= fit.parameters[name].total_std * (1.0 + 1e-9)


def test_a_step_that_acts_as_white_noise_is_not_worth_a_word():
    assert not any(finding.kind == "quantisation" for finding in fit_encoder(1, 2000).findings)


@pytest.mark.parametrize("noise", [0.0, 0.1])
def test_intervals_of_a_stated_step_are_those_of_logs_that_begin_elsewhere_on_it(noise):
    """The same motion on 40 places of the steps: estimates scatter as each of their fits says."""
    log, step = record(2, 20, noise)
    rng, plant = np.random.default_rng(5), so.plants.rotary(link="locked")
    known = plant.defaults.update(K_tau=K_TAU, N=N, c_s=0.0, f_c=0.0, **TRUTH)
    motion = so.simulate(plant, known, log)["theta_m"]
    found, stds = [], []
    for place in rng.uniform(0.0, step, 40):
        read = np.round((motion + place + noise * step * rng.normal(size=motion.size)) / step) * step
        moved = so.Log.from_arrays(time=log.time, I=log["I"], theta_m=read)
        bench = so.Experiment(plant=plant, log=moved, outputs=("theta_m",), quantisation={"theta_m": step})
        fit = so.fit([bench], known.free(*TRUTH))
        found.append([fit.parameters[name].value for name in TRUTH])
        stds.append([fit.parameters[name].total_std for name in TRUTH])
    ratio = np.sqrt(np.mean(np.square(stds), axis=0)) / np.std(found, axis=0)
    assert np.all((ratio > 0.75) & (ratio < 1.45)), ratio


def test_a_step_that_the_readings_do_not_have_is_refused():
    log, step = record(0, 40)
    plant = so.plants.rotary(link="locked")
    with pytest.raises(
        EstimationError,
        match=rf"^experiment bench: quantisation of theta_m = {0.7 * step:.6g} rad, .* are {step:.6g} rad apart; "
        rf"write quantisation = {{ theta_m = {step:.6g} }}, or leave it out$",
    ):
        so.Experiment(plant=plant, log=log, name="bench", outputs=("theta_m",), quantisation={"theta_m": 0.7 * step})
    so.Experiment(plant=plant, log=log, outputs=("theta_m",), quantisation={"theta_m": 0.5 * step})
    with pytest.raises(EstimationError, match="quantisation names"):
        so.Experiment(plant=plant, log=log, outputs=("theta_m",), quantisation={"theta_l": step})


def test_a_log_with_finer_digits_than_its_stated_step_is_refused_when_it_is_read(tmp_path):
    log, step = record(0, 40)
    rows = np.column_stack([log.time, log["I"], np.round(log["theta_m"], 2)])
    np.savetxt(tmp_path / "log.csv", rows, "%.8g", ",", header="t [s],I [A],theta_m [rad]", comments="")
    (tmp_path / "knee.toml").write_text(
        f"""
        schema = 1
        title = "held joint"
        [parameters]
        J_m = {{ value = 4e-5, free = true }}
        [plant.bench]
        kind = "rotary"
        link = "locked"
        [[experiment]]
        name = "chirp"
        plant = "bench"
        log = "log.csv"
        time = "t [s]"
        inputs = {{ I = "I [A]" }}
        outputs = {{ theta_m = "theta_m [rad]" }}
        quantisation = {{ theta_m = {step:.6g} }}
        """
    )
    with pytest.raises(
        EstimationError, match=rf"experiment chirp: .* = {step:.6g} rad, .* 0\.01 rad apart .*finer digits"
    ):
        so.read_problem(tmp_path / "knee.toml").experiments()


def test_readings_of_two_levels_do_not_contradict_a_step():
    log, step = record(0, 40)
    still = log.with_values(log.time, {"I": log["I"], "theta_m": step * (log["theta_m"] > 0.0)}, "a switch")
    plant = so.plants.rotary(link="locked")
    so.Experiment(plant=plant, log=still, outputs=("theta_m",), quantisation={"theta_m": 0.3 * step})


def test_steps_of_two_encoders_are_kept_apart_where_causes_are_looked_for():
    """A delay that is not stated, of two samples: looking for it took one output without its step, and failed."""
    J, b, k, J_l, d, step = 1e-3, 5e-3, 2.0, 2e-3, 4e-3, 2.0 * np.pi / 4096
    rng, t, f = np.random.default_rng(3), np.arange(4000) / RATE_HZ, np.arange(0.3, 8.0, 0.2)
    torque = 0.02 * np.cos(2 * np.pi * np.outer(t, f) + rng.uniform(0, 2 * np.pi, f.size)).sum(axis=1)
    a = np.array([[0, 1, 0, 0], [-k / J, -b / J, k / J, 0], [0, 0, 0, 1], [k / J_l, 0, -k / J_l, -d / J_l]])
    held = cont2discrete((a, np.array([[0], [1 / J], [0], [0]]), np.eye(4)[::2], np.zeros((2, 1))), 1.0 / RATE_HZ)
    angles = dlsim((*held[:4], 1.0 / RATE_HZ), np.concatenate([[0.0, 0.0], torque[:-2]]))[1]
    motor, link = np.round((angles.T + 0.05 * step * rng.normal(size=(2, t.size))) / step) * step
    log = so.Log.from_arrays(time=t, I=torque, theta_m=motor, theta_l=link)
    plant = so.plants.rotary(link="free")
    known = plant.defaults.update(N=1.0, K_tau=1.0, c_s=0.0, f_c=0.0)
    start = known.update(J_m=1.3 * J, b_r=b, k_s=0.8 * k, J_l=J_l, d_l=d).free("J_m", "b_r", "k_s", "J_l", "d_l")
    told = {"theta_m": step, "theta_l": step}
    fit = so.fit([so.Experiment(plant=plant, log=log, outputs=tuple(told), quantisation=told)], start)
    assert not fit.met
    assert any("a delay of 4" in finding.text for finding in fit.findings if finding.kind == "cause")


@pytest.mark.parametrize("noise", [0.0, 0.1])
def test_the_interval_is_that_of_errors_of_one_phase(noise):
    """A motion over a step or two: 95 % of the drawn errors are within it, where 1.96 std would hold nearly all."""
    rng, q, t = np.random.default_rng(11), 0.7, np.arange(300) / 300
    y = 0.9 * q * np.sin(2 * np.pi * 2.3 * t)
    influence = np.stack([np.sin(2 * np.pi * 2.3 * t), np.cos(5.0 * t)])
    moved = []
    for phase in rng.uniform(0.0, q, 6000):
        read = np.round((y + phase + noise * q * rng.normal(size=t.size)) / q) * q - phase
        moved.append(influence @ (read - y))
    rounding = Rounding.of(q, float(q * np.hypot(noise, 1.0 / np.sqrt(12.0))), 2)
    rounding.add(influence, y - q * np.round(y / q))
    variances = np.diag(rounding.multiply(influence @ influence.T))
    half = 1.96 * np.sqrt(equate([rounding], np.eye(2), variances))
    assert np.mean(np.abs(moved) <= half, axis=0) == pytest.approx(0.95, abs=0.015)
    if not noise:
        assert np.mean(np.abs(moved)[:, 0] <= 1.96 * np.sqrt(variances[0])) > 0.99
