"""Free delays where the input reaches an output at once, on responses of a fine lifted simulation by scipy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import butter, cont2discrete, dlsim, lfilter

import seaopt as so

M, B, K, G, RATE, FINE = 2.0, 300.0, 5e4, 10.0, 400.0, 10


def drive() -> so.Plant:
    """Return a mass on a spring, and the force at its back, which feels the input at once."""
    return so.Plant(
        name="drive", states={"q": "m", "v": "m/s"}, inputs={"I": "A"}, outputs={"F1": "N", "F2": "N"},
        parameters={"M": "kg", "b": "N s/m", "G": "N/A"},
        f=lambda t, x, u, p: {"q": x.v, "v": (p.G * u.I - p.b * x.v - K * x.q) / p.M},
        h=lambda t, x, u, p: {"F1": K * x.q, "F2": p.G * u.I - p.b * x.v},
    )  # fmt: skip


def log_of(samples_late: float, seed: int) -> so.Log:
    """Return a log whose input is so many samples late; at a sample, the input up to then is in force."""
    rng = np.random.default_rng(seed)
    current = 3.0 * lfilter([0.3], [1.0, -0.7], rng.normal(size=1500))
    late = round(samples_late * FINE)
    u = np.concatenate([np.full(late, current[0]), np.repeat(current, FINE)])[: current.size * FINE]
    a = np.array([[0.0, 1.0], [-K / M, -B / M]])
    system = cont2discrete((a, np.array([[0.0], [G / M]]), np.eye(2), np.zeros((2, 1))), 1.0 / (RATE * FINE))
    _, _, x = dlsim(system, u)
    sampled, force = x[::FINE], G * u[::FINE]
    if samples_late % 1.0:  # between samples the older one is still in force
        assert np.array_equal(u[::FINE][4:], current[4 - int(samples_late) - 1 : current.size - int(samples_late) - 1])
    outputs = (
        np.column_stack([K * sampled[:, 0], force - B * sampled[:, 1]]) + rng.normal(size=(current.size, 2)) * 0.05
    )
    return so.Log.from_arrays(time=np.arange(current.size) / RATE, I=current, F1=outputs[:, 0], F2=outputs[:, 1])


@pytest.mark.parametrize(
    ("samples_late", "start"),
    [(0.0, 1.9), *(pytest.param(2.0, start, marks=pytest.mark.slow) for start in (0.0, 4.0)), (2.3, 1.9)],
)
def test_a_delay_is_found_across_the_jumps_of_an_output_with_feedthrough(samples_late, start):
    delay = so.Parameter(name="delay_s", value=start / RATE, unit="s", free=True, min=0.0, max=0.05)
    experiment = so.Experiment(plant=drive(), log=log_of(samples_late, 1), delay_s=delay)
    truth = so.ParameterSet.of(M=(M, "kg"), b=(B, "N s/m"), G=(G, "N/A"))
    fit = so.fit([experiment], truth.update(M=1.5, b=200.0).free("M", "b"), diagnostics=False)
    assert fit.status == "converged"
    assert fit.nuisance["experiment"].delay_s * RATE == pytest.approx(samples_late, abs=5e-3)
    so.testing.assert_recovered(fit, truth, sigmas=4)


def log_of_lines(samples_late: float, seed: int) -> so.Log:
    """Return a log whose input, straight lines between its samples, is so many samples late: a tenth is exact."""
    rng = np.random.default_rng(seed)
    current = 3.0 * lfilter([0.3], [1.0, -0.7], rng.normal(size=1500))
    fine = np.arange(current.size * FINE) / FINE - samples_late
    a, c, d = np.array([[0.0, 1.0], [-K / M, -B / M]]), np.array([[K, 0.0], [0.0, -B]]), np.array([[0.0], [G]])
    system = cont2discrete((a, np.array([[0.0], [G / M]]), c, d), 1.0 / (RATE * FINE), method="foh")
    _, y, _ = dlsim(system, np.interp(fine, np.arange(current.size), current))
    outputs = y[::FINE] + rng.normal(size=(current.size, 2)) * 0.05
    return so.Log.from_arrays(time=np.arange(current.size) / RATE, I=current, F1=outputs[:, 0], F2=outputs[:, 1])


@pytest.mark.parametrize(
    ("samples_late", "start"), [(0.0, 1.9), pytest.param(2.0, 4.0, marks=pytest.mark.slow), (2.7, 0.2)]
)
def test_a_delay_of_an_input_of_straight_lines_is_found(samples_late, start):
    delay = so.Parameter(name="delay_s", value=start / RATE, unit="s", free=True, min=0.0, max=0.05)
    experiment = so.Experiment(plant=drive(), log=log_of_lines(samples_late, 1), delay_s=delay, hold="first")
    truth = so.ParameterSet.of(M=(M, "kg"), b=(B, "N s/m"), G=(G, "N/A"))
    fit = so.fit([experiment], truth.update(M=1.5, b=200.0).free("M", "b"), diagnostics=False)
    assert fit.status == "converged" and not fit.errors
    own = fit.nuisance["experiment"]
    assert own.std["delay_s"] * RATE < 2e-3
    assert own.delay_s == pytest.approx(samples_late / RATE, abs=4 * own.std["delay_s"] + 1e-9)
    so.testing.assert_recovered(fit, truth, sigmas=4)


def test_a_wrong_known_delay_of_straight_lines_is_named():
    experiment = so.Experiment(plant=drive(), log=log_of_lines(1.3, 1), delay_s=0.0, hold="first")
    truth = so.ParameterSet.of(M=(M, "kg"), b=(B, "N s/m"), G=(G, "N/A"))
    fit = so.fit([experiment], truth.update(M=1.5, b=200.0).free("M", "b"))
    assert not fit.met
    said = next(one.text for one in fit.findings if one.kind == "cause")
    assert float(said.split("a delay of ")[1].split(" ms")[0]) == pytest.approx(1.3e3 / RATE, rel=0.01)


@pytest.mark.slow
def test_a_delay_at_its_bound_is_an_error_where_the_log_wants_it_beyond():
    delay = so.Parameter(name="delay_s", value=0.0, unit="s", free=True, min=0.0, max=1.5 / RATE)
    experiment = so.Experiment(plant=drive(), log=log_of(2.3, 1), outputs=("F1",), delay_s=delay)
    truth = so.ParameterSet.of(M=(M, "kg"), b=(B, "N s/m"), G=(G, "N/A"))
    fit = so.fit([experiment], truth.free("M", "b"))
    assert ("experiment.delay_s", "error") in [(f.where, f.severity) for f in fit.findings if f.kind == "bound"]
    assert not fit.met


def test_a_delay_that_is_a_period_off_is_carried_on():
    """Noise of 22 to 26 Hz nearly repeats itself after 17 samples: 5 samples late there is a minimum, too."""
    rng = np.random.default_rng(4)
    b, a = butter(2, (22.0, 26.0), "bandpass", fs=RATE)
    current = 3.0 * lfilter(b, a, 10.0 * rng.normal(size=1500))
    plant = np.array([[0.0, 1.0], [-K / M, -B / M]]), np.array([[0.0], [G / M]])
    system = cont2discrete((*plant, np.array([[K, 0.0]]), np.zeros((1, 1))), 1.0 / RATE)
    force = dlsim(system, np.concatenate([np.zeros(22), current])[: current.size])[1][:, 0]
    log = so.Log.from_arrays(
        time=np.arange(current.size) / RATE, I=current, F1=force + 0.02 * np.std(force) * rng.normal(size=force.size)
    )
    delay = so.Parameter(name="delay_s", value=5.0 / RATE, unit="s", free=True, min=0.0, max=0.1)
    experiment = so.Experiment(plant=drive(), log=log, outputs=("F1",), delay_s=delay)
    truth = so.ParameterSet.of(M=(M, "kg"), b=(B, "N s/m"), G=(G, "N/A"))
    found = so.fit([experiment], truth.free("G"), method=so.OutputError(search=False), diagnostics=False)
    assert found.nuisance["experiment"].delay_s * RATE == pytest.approx(22.0, abs=0.1)


def fit_in_coloured_noise(clean, plant, seed):
    """Return how many stds a delay is off in noise of a pole at 0.9, and how many as for white noise."""
    truth = so.ParameterSet.of(M=(M, "kg"), b=(B, "N s/m"), G=(G, "N/A")).free("M")
    delay = so.Parameter(name="delay_s", value=2.4 / RATE, unit="s", free=True, min=0.0, max=0.05)
    noise = 5.0 * lfilter([np.sqrt(0.19)], [1.0, -0.9], np.random.default_rng(1000 + seed).normal(size=len(clean)))
    log = so.Log.from_arrays(time=clean.time, I=clean["I"], F1=clean["F1"] + noise)
    bench = [so.Experiment(plant=plant, log=log, outputs=("F1",), delay_s=delay)]
    own, plain = (
        so.fit(bench, truth, method=so.OutputError(search=False), diagnostics=on).nuisance["experiment"]
        for on in (True, False)
    )
    return tuple((each.delay_s - 2.3 / RATE) / each.std["delay_s"] for each in (own, plain))


@pytest.mark.usefixtures("without_causes")
@pytest.mark.parametrize("logs", [4, pytest.param(30, marks=pytest.mark.slow)])
def test_the_std_of_a_delay_allows_for_coloured_noise(logs):
    """Of 30 logs the delays scatter as their stds say, which for white noise do not; of 4 none is far off."""
    clean, plant = log_of(2.3, 1), drive()
    apart, white = np.array([fit_in_coloured_noise(clean, plant, seed) for seed in range(logs)]).T
    assert np.all(np.abs(apart) < 4.0) and np.all(np.abs(white) > 1.3 * np.abs(apart))
    if logs == 30:
        assert np.std(apart) == pytest.approx(1.0, abs=0.3)
        assert np.std(white) > 1.3


def two_logs(late):
    """Return the fit of two logs of one plant whose delays are 2.3 and so many samples."""
    delay = so.Parameter(name="delay_s", value=2.0 / RATE, unit="s", free=True, min=0.0, max=0.05)
    truth = so.ParameterSet.of(M=(M, "kg"), b=(B, "N s/m"), G=(G, "N/A"))
    experiments = [
        so.Experiment(plant=drive(), log=log_of(samples, seed), outputs=("F1",), delay_s=delay, name=name)
        for name, samples, seed in (("one", 2.3, 1), ("other", late, 2))
    ]
    return so.fit(experiments, truth.update(M=1.5).free("M"))


def test_logs_of_one_plant_that_contradict_each_other_in_their_delay_are_a_finding():
    assert not two_logs(2.3).findings
    (said,) = two_logs(3.3).findings
    assert (said.kind, said.severity) == ("delay", "warning") and "contradicts" in said.text


def test_an_ill_determined_delay_is_not_the_controllers():
    fit = two_logs(2.3)
    one, other = (replace(fit.nuisance[name], delay_s=d, std={"delay_s": std}) for name, d, std in
                  (("one", 2.3e-3, 1e-6), ("other", 8.7e-3, 0.27e-3)))  # fmt: skip
    assert replace(fit, nuisance={"one": one, "other": other}).delay_s(drive()) == 2.3e-3
    known = replace(other, std={"delay_s": 5e-5})  # a longer one that is known counts
    assert replace(fit, nuisance={"one": one, "other": known}).delay_s(drive()) == 8.7e-3
    given = replace(one, delay_s=0.0, std={})  # where nothing else was fitted, it is all there is
    assert replace(fit, nuisance={"one": given, "other": other}).delay_s(drive()) == 8.7e-3
