"""Designs against closed forms of the literature, independent simulation, and the scatter of fits."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.signal import cont2discrete, dlsim, freqz

import seaopt as so
from seaopt.bench import PAPER_STAND, PAPER_SWING, Chirp, Noise, excite
from seaopt.errors import EstimationError
from seaopt.estimation import Chirps, Limits, Multisines, design_experiment, expected_covariance
from seaopt.estimation.experiment_design.spectrum import (
    choose_harmonics,
    low_peak_phases,
    make_spectrum,
    optimal_powers,
    schroeder_phases,
)
from seaopt.simulation import Clock, make_model

NOISE = {"F1": 2.0, "F2": 2.0}
LAG = so.Plant(
    name="lag", states={"z": "N"}, inputs={"u": "A"}, outputs={"y": "N"}, parameters={"K": "N/A", "tau": "s"},
    f=lambda t, x, u, p: {"z": (p.K * u.u - x.z) / p.tau}, h=lambda t, x, u, p: {"y": x.z},
)  # fmt: skip
GUESS = so.ParameterSet.of(K=(3.0, "N/A"), tau=(0.5, "s"))


def lines_of(plant, params, *, n, rate_hz, sigma, count=400, band_hz=(0.02, 20.0)):
    names = params.free_names
    model = make_model(plant, params, names, tuple(sigma))
    places = choose_harmonics(n, rate_hz, band_hz, count)
    theta = np.array(params.values_of(names))
    return make_spectrum(
        model, theta, Clock(period=1 / rate_hz), places, n=n, sigma=np.array([*sigma.values()]), channel=0, signals=[-1]
    )


def design(plant, params, **options):
    limits = Limits(**{"duration_s": 40, "rate_hz": 100, "rms": 1.0, **options.pop("limits", {})})
    return design_experiment(plant, params, limits, **{"sigma": {"y": 0.1}, **options})


# Powers, phases and information, each by itself


@pytest.mark.slow
def test_the_lags_d_optimal_line_is_at_one_over_root_three_tau():
    """H = K/(1 + i w tau): det F of one line is x^2/(1 + x^2)^4 with x = w tau, largest at 1/sqrt(3)."""
    found = design(LAG, GUESS.free("K", "tau"), criterion="D", signal=Multisines(lines=400))
    (part,) = found.excitation
    powers = np.array(part.amplitudes) ** 2 / 2
    middle = np.exp(np.average(np.log(part.frequencies_hz), weights=powers))
    assert 2 * np.pi * middle * 0.5 == pytest.approx(1 / np.sqrt(3), rel=0.02)
    assert np.ptp(part.frequencies_hz) < 0.05  # neighbours of that line, on multiples of 1/40 Hz


@pytest.mark.parametrize(("criterion", "x"), [("tau", 1.0), ("K", 0.0)])
def test_one_parameter_of_the_lag_alone(criterion, x):
    """|dH/dtau| is largest at w = 1/tau, |dH/dK| at zero frequency: there the lowest candidate, 4/40 s."""
    (part,) = design(LAG, GUESS.free(criterion), criterion=criterion, signal=Multisines(lines=200)).excitation
    strongest = part.frequencies_hz[int(np.argmax(part.amplitudes))]
    assert strongest == pytest.approx(max(x / (2 * np.pi * 0.5), 0.1), abs=0.03)


def test_information_of_the_lag_is_the_closed_form():
    """Each line's is n Re(s s*)/sigma^2 with s = [1, -K iw/(1 + iw tau)]/(1 + iw tau); sampled fast."""
    found = lines_of(LAG, GUESS.free("K", "tau"), n=400_000, rate_hz=10_000, sigma={"y": 0.1}, count=7)
    w = 2 * np.pi * found.harmonics / 40
    lag = 1 / (1 + 0.5j * w)
    slopes = np.stack([lag, -3.0 * 1j * w * lag**2])
    expected = 400_000 / 0.1**2 * np.einsum("ik,jk->kij", slopes, slopes.conj()).real
    np.testing.assert_allclose(found.information, expected, rtol=1e-4, atol=1e-4 * np.max(expected))


def test_gains_are_those_of_scipys_sampled_plant(stand, thor):
    """F1 per ampere of the stand, held at 400 Hz: cont2discrete and freqz."""
    lines = lines_of(stand, thor.free("J"), n=4000, rate_hz=400, sigma={"F1": 2.0}, count=30, band_hz=(1, 150))
    model = make_model(stand, thor.free("J"), ("J",), ("F1",))
    places, theta = lines.harmonics, np.array([thor["J"].value])
    found = make_spectrum(model, theta, Clock(period=1 / 400), places, n=4000, sigma=np.ones(1), channel=0, signals=[0])
    r, m_k, b_m, k = 0.002 / (6 * np.pi), 0.646 + 3.31e-6 / (0.002 / (6 * np.pi)) ** 2, 1.31e-4, 655e3
    num, den, _ = cont2discrete(([0.0255 / r * k], [m_k, b_m / r**2, k]), 1 / 400)
    _, expected = freqz(num.ravel(), den, 2 * np.pi * places / 4000)
    np.testing.assert_allclose(found.gains[0], expected, rtol=1e-6)


def test_powers_meet_the_equivalence_theorem(stand, thor):
    """D-optimal: tr(F^-1 F_k) rms^2 is nowhere above the number of parameters (Kiefer and Wolfowitz 1960)."""
    lines = lines_of(
        stand, thor.free("J", "b_r", "eta"), n=65_600, rate_hz=400, sigma=NOISE, count=80, band_hz=(0.1, 150)
    )
    powers = optimal_powers(lines.information, np.ones((1, lines.harmonics.size)) / 3.0, weight=None)
    inverse = np.linalg.inv(np.einsum("k,kij->ij", powers, lines.information))
    worth = 3.0 * np.einsum("ij,kji->k", inverse, lines.information)
    assert np.max(worth) == pytest.approx(3.0, rel=1e-4)
    np.testing.assert_allclose(worth[powers > 0.01], 3.0, rtol=1e-3)


@pytest.mark.filterwarnings("ignore:Values in x were outside bounds")  # an older scipy's line search
@pytest.mark.parametrize("seed", range(4))
def test_powers_are_those_of_scipys_slsqp(seed):
    """Five random lines of rank one, three parameters, two budgets: the sum of variances."""
    rng = np.random.default_rng(seed)
    rows = rng.normal(size=(5, 3, 2))
    information = np.einsum("kir,kjr->kij", rows, rows)
    budget = rng.uniform(0.2, 1.0, size=(2, 5))
    cost = lambda p: np.trace(np.linalg.inv(np.einsum("k,kij->ij", p, information)))  # noqa: E731
    limits = {"type": "ineq", "fun": lambda p: 1.0 - budget @ p}
    start = np.full(5, 0.9 / np.max(budget.sum(axis=1)))
    best = minimize(cost, start, constraints=limits, bounds=[(1e-9, None)] * 5, method="SLSQP", options={"ftol": 1e-12})
    powers = optimal_powers(information, budget, weight=np.eye(3))
    assert np.all(budget @ powers <= 1 + 1e-7)
    assert cost(powers) == pytest.approx(best.fun, rel=1e-5)


def test_phases_lower_the_crest_factor():
    """31 equal lines: Schroeder's phases give 1.7 to 1.9; the search gets below 1.5."""
    places, n = np.arange(1, 32), 1024
    lines = np.full((1, 31), np.sqrt(2 / 31), dtype=complex)
    crest = lambda phases: np.max(np.abs(  # noqa: E731
        np.sin(2 * np.pi * np.outer(np.arange(n), places) / n + phases) @ lines[0].real))  # fmt: skip
    start = schroeder_phases(np.ones(31))
    assert crest(start) < 2.0
    assert crest(low_peak_phases(lines, places, n, start)) < 1.5


# Expected standard deviations


def test_a_static_gain_is_known_as_well_as_the_line_through_the_origin():
    """y = a u + offset: var a = sigma^2/(sum u^2 - n mean(u)^2), by hand."""
    plant = so.Plant(
        name="line", states={"z": "m"}, inputs={"u": "A"}, outputs={"y": "N"}, parameters={"a": "N/A"},
        f=lambda t, x, u, p: {"z": -x.z + u.u}, h=lambda t, x, u, p: {"y": p.a * u.u + 0 * x.z},
    )  # fmt: skip
    params = so.ParameterSet.of(a=(2.5, "N/A")).free("a")
    drive = (Chirp(amplitude=2.0, f0_hz=0.05, f1_hz=3.0),)
    _, u = excite(drive, duration_s=10, rate_hz=50, rng=np.random.default_rng(0))
    options = {"sigma": {"y": 0.3}, "duration_s": 10, "rate_hz": 50, "initial_state": "rest"}
    found = expected_covariance(plant, params, drive, **options).std("a")
    assert found == pytest.approx(0.3 / np.sqrt(np.sum((u - u.mean()) ** 2)), rel=1e-9)
    known = expected_covariance(plant, params, drive, **options, offset=False).std("a")
    assert known == pytest.approx(0.3 / np.sqrt(np.sum(u**2)), rel=1e-9)


def test_a_prior_adds_its_information():
    drive = (Noise(std=1.0, band_hz=5.0),)
    options = {"sigma": {"y": 0.5}, "duration_s": 5, "rate_hz": 20}
    free = expected_covariance(LAG, GUESS.free("K"), drive, **options).std("K")
    with_prior = expected_covariance(LAG, GUESS.prior(K=0.05), drive, **options).std("K")
    assert with_prior == pytest.approx((free**-2 + 0.05**-2) ** -0.5, rel=1e-9)


def test_expected_std_is_that_of_a_fit(stand, thor):
    """The white covariance that a fit of one such log reports; the paper's chirp."""
    params, chirp = thor.free("J", "b_r", "eta"), PAPER_STAND[:1]
    expected = expected_covariance(stand, params, chirp, sigma=NOISE, duration_s=20, rate_hz=400, seed=1)
    log = so.virtual_log(stand, thor, chirp, duration_s=20, rate_hz=400, seed=1, sensors=so.Sensors(noise_std=NOISE))
    fit = so.fit([so.Experiment(plant=stand, log=log, outputs=("F1", "F2"), sigma=NOISE)], params)
    for name in expected.names:
        assert expected.std(name) == pytest.approx(fit.white_covariance.std(name), rel=2e-3)


# Designs of the two experiments


@pytest.fixture(scope="module")
def stand_design(stand, thor):
    limits = Limits(duration_s=164, rate_hz=400, rms=np.sqrt(3.0))
    return design_experiment(stand, thor.free("J", "b_r", "eta"), limits, sigma=NOISE)


def test_the_stand_is_known_twice_as_well_as_after_the_papers_excitation(stand_design):
    """Equal rms: J and b_r at least twice; eta is a static gain, which nothing tells 1.5 times as well (see below)."""
    ratio = stand_design.against(PAPER_STAND).ratio
    assert ratio["J"] > 2.5
    assert ratio["b_r"] > 2.0
    assert ratio["eta"] > 1.1
    assert stand_design.peaks["I"] < stand_design.against(PAPER_STAND).peaks["I"]


def test_no_excitation_of_that_rms_tells_eta_twice_as_well(stand, thor):
    """With all else known, var eta >= sigma^2/(n rms^2 max_w sum_o |H_o|^2): the paper's std is within 2 of that."""
    response = stand.linearize(thor)(2j * np.pi * np.geomspace(0.01, 150, 20_000))
    gain = np.max(np.sum(np.abs(response[:2, 0]) ** 2, axis=0))
    bound = 2.0 / np.sqrt(65_600 * 3.0 * gain)
    paper = expected_covariance(
        stand, thor.free("J", "b_r", "eta"), PAPER_STAND, sigma=NOISE, duration_s=164, rate_hz=400
    )
    assert bound < paper.std("eta") < 2.0 * bound


def test_peaks_are_kept_to(stand, thor):
    """4 A and 500 N bind; the sampled plant is simulated by scipy, the fit's own path by `simulate`."""
    limits = Limits(duration_s=20, rate_hz=400, rms=1.7, peak=4.0, peaks={"F1": 500.0, "q": 1e-3})
    found = design_experiment(stand, thor.free("J", "b_r", "eta"), limits, sigma=NOISE)
    log = so.virtual_log(stand, thor, found.excitation, duration_s=20, rate_hz=400, seed=0)
    assert np.max(np.abs(log["I"])) <= 4.0
    assert np.max(np.abs(log["F1"])) == pytest.approx(500.0, rel=1e-3)
    assert np.max(np.abs(so.simulate(stand, thor, log)["q"])) <= 1e-3
    assert np.sqrt(np.mean(log["I"] ** 2)) <= 1.7
    system = stand.linearize(thor)
    sampled = cont2discrete((system.A, system.B, system.C, system.D), 1 / 400)
    _, y, _ = dlsim(sampled, log["I"])
    assert np.max(np.abs(y[:, 0])) <= 500.0 * (1 + 1e-6)
    assert found.peaks["F1"] == pytest.approx(np.max(np.abs(y[:, 0])), rel=1e-6)
    assert "of 500" in repr(found)


@pytest.mark.slow
def test_where_peaks_bind_the_better_of_multisine_and_chirp_is_returned(stand, thor):
    """At 400 N a chirp, whose peak is 1.4 times its rms, may be larger than two lines, whose peak is twice theirs."""
    limits = Limits(duration_s=10, rate_hz=400, rms=np.sqrt(3.0), peaks={"F1": 400.0})
    kinds = (None, Multisines(), Chirps())
    cost = lambda found: sum((std / thor[name].value) ** 2 for name, std in found.std.items())  # noqa: E731
    either, multisine, chirp = (
        cost(design_experiment(stand, thor.free("J", "b_r", "eta"), limits, sigma=NOISE, signal=kind)) for kind in kinds
    )
    assert either == pytest.approx(min(multisine, chirp), rel=1e-9)


def test_the_best_chirp_lies_between(stand, thor):
    """Better than the paper's excitation, and no better than the multisine but for the grid of its lines."""
    limits, params = Limits(duration_s=20, rate_hz=400, rms=np.sqrt(3.0)), thor.free("J", "b_r", "eta")
    best = design_experiment(stand, params, limits, sigma=NOISE)
    chirp = design_experiment(stand, params, limits, sigma=NOISE, signal=Chirps())
    paper = best.against(PAPER_STAND).covariance
    relative = lambda covariance: sum((covariance.std(name) / thor[name].value) ** 2 for name in covariance.names)  # noqa: E731
    assert relative(best.covariance) < 1.02 * relative(chirp.covariance)
    assert relative(chirp.covariance) < 0.5 * relative(paper)


def test_spread_leaves_power_everywhere(stand, thor, stand_design):
    """A tenth of the power over 0.1 to 100 Hz, at a price below a tenth in std."""
    limits = Limits(duration_s=164, rate_hz=400, rms=np.sqrt(3.0))
    signal = Multisines(lines=40, band_hz=(0.1, 100), spread=0.1)
    found = design_experiment(stand, thor.free("J", "b_r", "eta"), limits, sigma=NOISE, signal=signal)
    (part,) = found.excitation
    assert part.frequencies_hz[0] < 0.11 and part.frequencies_hz[-1] > 95 and len(part.amplitudes) >= 38
    assert min(part.amplitudes) ** 2 / 2 == pytest.approx(0.3 / 40, rel=0.1)
    assert all(found.std[name] < 1.1 * std for name, std in stand_design.std.items())


def scatter(plant, truth, excitation, seeds, **log):
    """Return the standard deviation of fits to logs of one excitation that differ in noise."""
    values = []
    for seed in seeds:
        record = so.virtual_log(plant, truth, excitation, seed=seed, sensors=so.Sensors(noise_std=NOISE), **log)
        experiment = so.Experiment(plant=plant, log=record, outputs=("F1", "F2"), sigma=NOISE)
        fit = so.fit([experiment], truth, method=so.OutputError(search=False), diagnostics=False)
        values.append([fit.parameters[name].value for name in truth.free_names])
    return dict(zip(truth.free_names, np.std(values, axis=0, ddof=1), strict=True))


@pytest.mark.slow
@pytest.mark.parametrize("own", [True, False])
def test_fits_scatter_as_expected_on_the_stand(stand, thor, own):
    """40 seeds: a standard deviation is then known within 11 %; three of those. Design and paper."""
    truth = thor.free("J", "b_r", "eta")
    found = design_experiment(stand, truth, Limits(duration_s=10, rate_hz=400, rms=np.sqrt(3.0)), sigma=NOISE)
    other = found.against(PAPER_STAND)
    excitation, covariance = (found.excitation, found.covariance) if own else (other.excitation, other.covariance)
    spread = scatter(stand, truth, excitation, range(40), duration_s=10, rate_hz=400)
    for name, value in spread.items():
        assert value == pytest.approx(covariance.std(name), rel=0.35)


@pytest.fixture(scope="module")
def swing_design(swing, thor):
    """Return the truth and the design for a nonlinear plant, at most 0.1 rad."""
    truth = thor.update(d=2.0).free("I_p", "d")
    limits = Limits(duration_s=10, rate_hz=400, rms=3.5, peaks={"phi": 0.1})
    return truth, design_experiment(swing, truth, limits, sigma=NOISE)


def test_the_swing_is_known_twice_as_well(swing, swing_design):
    truth, best = swing_design
    ratio = best.against(PAPER_SWING).ratio
    assert ratio["I_p"] > 2 and ratio["d"] > 2
    log = so.virtual_log(swing, truth, best.excitation, duration_s=10, rate_hz=400, seed=0)
    assert np.max(np.abs(log["phi"])) <= 0.1 * (1 + 1e-6)


@pytest.mark.slow
def test_fits_scatter_as_expected_on_the_swing(swing, swing_design):
    """Over 40 seeds, as on the stand."""
    truth, best = swing_design
    spread = scatter(swing, truth, best.excitation, range(100, 140), duration_s=10, rate_hz=400)
    for name, value in spread.items():
        assert value == pytest.approx(best.std[name], rel=0.35)


@pytest.mark.slow
def test_friction_needs_more_than_the_linear_plant(stand, thor):
    """Linearised, f_c/v_s and b_m are one damping; the samples tell them apart, and better than the paper's."""
    truth = thor.update(f_c=30.0, v_s=5e-3).free("b_r", "f_c")
    limits = Limits(duration_s=10, rate_hz=400, rms=1.7)
    found = design_experiment(stand, truth, limits, sigma=NOISE, signal=Multisines(band_hz=(0.5, 50)))
    ratio = found.against(PAPER_STAND).ratio
    assert ratio["b_r"] > 1.5 and ratio["f_c"] > 1.5
    chirp = design_experiment(stand, truth, limits, sigma=NOISE, signal=Chirps(band_hz=(0.5, 50)))
    assert found.std["f_c"] < 1.05 * chirp.std["f_c"]
    assert found.rms == pytest.approx(1.7, rel=2e-3)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"limits": {"rms": None}}, "nothing bounds"),
        ({"limits": {"rms": -1.0}}, "rms = -1"),
        ({"limits": {"duration_s": 0.01}}, "fewer than 8"),
        ({"limits": {"peaks": {"F9": 1.0}}}, "F9"),
        ({"sigma": {}}, "sigma"),
        ({"sigma": {"z": 1.0}}, '"z"'),
        ({"sigma": {"y": 0.0}}, "not positive"),
        ({"criterion": "E"}, '"E"'),
        ({"input_name": "v"}, '"v"'),
        ({"signal": Multisines(band_hz=(30.0, 20.0))}, "band_hz"),
        ({"signal": Chirps(band_hz=(30.0, 20.0))}, "band_hz"),
        ({"signal": Multisines(spread=1.0)}, "spread"),
    ],
)
def test_bad_settings(options, words):
    with pytest.raises(EstimationError, match=words):
        design(LAG, GUESS.free("K"), **options)


def test_what_cannot_be_told_is_said():
    with pytest.raises(EstimationError, match="no parameter is free"):
        design(LAG, GUESS)
    with pytest.raises(EstimationError, match="J is free, but no plant"):
        design(LAG, so.ParameterSet([*GUESS.values(), *so.plants.thor().free("J").subset(["J"]).values()]))
    product = so.Plant(
        name="product", states={"z": "N"}, inputs={"u": "A"}, outputs={"y": "N"}, parameters={"a": "-", "b": "-"},
        f=lambda t, x, u, p: {"z": p.a * p.b * u.u - x.z}, h=lambda t, x, u, p: {"y": x.z},
    )  # fmt: skip
    with pytest.raises(EstimationError, match="measure another output"):
        design(product, so.ParameterSet.of(a=2.0, b=3.0).free("a", "b"))


def test_a_zero_has_no_relative_variance(swing, thor):
    with pytest.raises(EstimationError, match="d = 0 has no relative variance"):
        design_experiment(swing, thor.free("d"), Limits(duration_s=10, rate_hz=400, rms=1.0), sigma=NOISE)


def test_a_second_log_at_half_the_amplitude_is_proposed(stand_design):
    def samples(excitation):
        return so.bench.excite(excitation, duration_s=2.0, rate_hz=400.0, rng=np.random.default_rng(0))[1]

    np.testing.assert_allclose(samples(stand_design.half), 0.5 * samples(stand_design.excitation))
    assert "half the amplitude" in repr(stand_design)
