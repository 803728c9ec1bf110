"""What is left in the residuals may move the estimates: closed forms of a regression, and coverage over many logs."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import maximum_filter1d
from scipy.signal import lfilter

import seaopt as so
from seaopt.estimation import Huber, Squares
from seaopt.estimation.problem.noise_floor import measure_floors
from seaopt.estimation.result.model_error import ENVELOPE_S, INDEPENDENT, PARTS, _measure_envelope, estimate_model_error
from seaopt.estimation.result.widening import widen

N, PERIOD = 16_000, 1e-3
SUM = so.Plant(
    name="sum", states={"z": "-"}, inputs={"u": "-", "w": "-"}, outputs={"y": "-"}, parameters={"a": "-", "b": "-"},
    f=lambda t, x, u, p: {"z": u.u - x.z}, h=lambda t, x, u, p: {"y": p.a * u.u + p.b * u.w + 0 * x.z},
)  # fmt: skip


def smooth(rng, seconds=0.05):
    values = lfilter([1.0], [1.0, -np.exp(-PERIOD / seconds)], rng.normal(size=N + 2000))[2000:]
    return values / np.std(values)


def regress(u, w, y, **options):
    """Return the fit of y = a u + b w, and its model error."""
    log = so.Log.from_arrays(time=np.arange(u.size) * PERIOD, u=u, w=w, y=y)
    bench = so.Experiment(plant=SUM, log=log, initial_state="rest", offset=False, name="log", **options)
    params = so.ParameterSet.of(a=(1.0, "-"), b=(1.0, "-")).free("a", "b")
    fit = so.fit([bench], params, method=so.OutputError(search=False), diagnostics=False)
    minimum = fit.minimum
    residuals = minimum.residuals()
    floors = measure_floors(minimum.problem, residuals, minimum.z)
    error = estimate_model_error(minimum.problem, minimum.z, residuals, floors, fit.covariance.matrix)
    return fit, error


@pytest.fixture(scope="module")
def signals():
    rng = np.random.default_rng(3)
    return smooth(rng), smooth(rng), rng.normal(size=N)


def test_nothing_missing_leaves_nothing(signals):
    """White noise of 0.5: no halves differ, no share of the residual is a model's, and the interval is that of 1/N."""
    u, w, e = signals
    fit, error = regress(u, w, 2.0 * u + 3.0 * w + 0.5 * e)
    assert error.excess["log.y"] == pytest.approx(1.0, abs=0.02)
    assert not np.any(error.halves) and not np.any(error.few_values)
    exact = 0.5**2 * np.linalg.inv(np.array([[u @ u, u @ w], [u @ w, w @ w]]))
    total = fit.covariance.matrix + error.matrix
    assert np.sqrt(np.diag(total)) == pytest.approx(np.sqrt(np.diag(exact)), rel=0.2)


def test_the_least_share_is_for_residuals_that_are_more_than_noise(signals):
    """A noise of 1e-4 tells a of 2 to 4e-7: a clock's error is more, and 0.02 % stands where a drift is missing."""
    u, w, e = signals
    for missing in (0.0, 1e-3):
        fit, error = regress(u, w, (2.0 + missing * np.sign(np.arange(N) - N / 2)) * u + 3.0 * w + 1e-4 * e)
        assert (error.excess["log.y"] > 1.5) is (missing > 0.0)
        total = float(np.sqrt((fit.covariance.matrix + error.colour)[0, 0]))
        assert total == pytest.approx(2.0 * (2e-4 if missing else 2e-5), rel=0.01)


def test_parts_are_those_of_a_jackknife_done_by_hand(signals):
    """A slow term is missing: estimates of seven eighths each, solved one by one, scatter as the one step says."""
    u, w, e = signals
    slow = 0.2 * np.sin(np.arange(N) * PERIOD * 2.0) * u
    y = 2.0 * u + 3.0 * w + slow + 0.01 * e
    fit, error = regress(u, w, y)
    x = np.column_stack([u, w])
    without = []
    for k in range(PARTS):
        rows = np.ones(N, dtype=bool)
        rows[k * N // PARTS : (k + 1) * N // PARTS] = False
        without.append(np.linalg.lstsq(x[rows], y[rows], rcond=None)[0])
    v = (PARTS - 1) / PARTS * np.sum((np.array(without) - np.mean(without, axis=0)) ** 2, axis=0)
    b2 = np.diag(fit.covariance.matrix + error.colour)
    assert np.diag(error.parts) == pytest.approx(np.maximum(v - b2, 0.0), rel=1e-6, abs=1e-12)
    assert error.parts[0, 0] > 0.0


def test_halves_by_time_differ_by_a_drift_done_by_hand(signals):
    u, w, e = signals
    drift = np.where(np.arange(N) < N // 2, -0.1, 0.1)
    y = (2.0 + drift) * u + 3.0 * w + 0.01 * e
    fit, error = regress(u, w, y)
    x, late = np.column_stack([u, w]), np.arange(N) >= N // 2
    first, second = (np.linalg.lstsq(x[rows], y[rows], rcond=None)[0] for rows in (~late, late))
    assert np.sqrt(error.halves[0, 0]) == pytest.approx(abs(second - first)[0] / 2, rel=1e-3)
    assert np.sqrt(error.halves[0, 0]) == pytest.approx(0.1, rel=0.02)
    assert widen(fit, error.matrix).parameters["a"].model_std > 0.09


def test_few_values_have_their_closed_form(signals):
    """What slow term of variance q is missing beside noise of 0.1, N/80 q C is what it may move the estimates by."""
    u, w, e = signals
    slow = 0.3 * smooth(np.random.default_rng(9), 0.2)
    _, error = regress(u, w, 2.0 * u + 3.0 * w + slow + 0.1 * e)
    x = np.column_stack([u, w])
    power = float(np.mean((slow - x @ np.linalg.lstsq(x, slow, rcond=None)[0]) ** 2))
    expected = N / INDEPENDENT * power * np.linalg.inv(x.T @ x)
    assert error.few_values == pytest.approx(expected, rel=0.05)


@pytest.mark.parametrize("scale", [1.0, 30.0])
def test_a_term_that_is_left_out_moves_the_estimates_within_their_interval(signals, scale):
    """Of y = a u + b w + c v without v, least squares are off by c (X'X)^-1 X'v: inside, whatever sigma is stated."""
    u, w, e = signals
    v = 0.15 * u + 0.98 * smooth(np.random.default_rng(5))
    fit, error = regress(u, w, 2.0 * u + 3.0 * w + 0.3 * v + 0.02 * e, sigma={"y": 0.02 * scale})
    x = np.column_stack([u, w])
    shift = 0.3 * np.linalg.solve(x.T @ x, x.T @ v)
    wide = widen(fit, error.matrix).parameters
    for name, true, off in zip(("a", "b"), (2.0, 3.0), shift, strict=True):
        assert wide[name].value - true == pytest.approx(off, abs=4 * fit.parameters[name].std)
        assert wide[name].ci95[0] <= true <= wide[name].ci95[1]
    noise = 0.02 * np.sqrt(np.linalg.inv(x.T @ x)[0, 0])
    assert abs(shift[0]) > 50 * noise  # what the noise alone would not have told


def test_the_matrix_is_a_covariance_and_knows_no_scale_of_sigma(signals):
    u, w, e = signals
    y = 2.0 * u + 3.0 * w + 0.1 * u**3 + 0.02 * e
    errors = [regress(u, w, y, sigma={"y": sigma})[1] for sigma in (0.02, 2e-4)]
    for error in errors:
        assert np.linalg.eigvalsh(error.matrix)[0] >= -1e-12 * np.trace(error.matrix)
    assert errors[0].matrix == pytest.approx(errors[1].matrix, rel=0.05)


def test_a_gap_several_logs_and_a_robust_loss_are_taken(signals):
    u, w, e = signals
    y = 2.0 * u + 3.0 * w + 0.1 * e
    y[4000:4100] = np.nan
    logs = [so.Log.from_arrays(time=np.arange(m) * PERIOD, u=u[:m], w=w[:m], y=y[:m]) for m in (N, N // 3)]
    benches = [
        so.Experiment(plant=SUM, log=log, initial_state="rest", offset=True, name=f"log{k}")
        for k, log in enumerate(logs)
    ]
    params = so.ParameterSet.of(a=(1.0, "-"), b=(1.0, "-")).free("a", "b")
    for loss in (Squares(), Huber()):
        fit = so.fit(benches, params, loss=loss)
        assert fit.met
        for parameter in fit.parameters.values():
            assert parameter.total_std < 1.6 * parameter.std


def cover(count):
    """Return how many intervals of linear plants' logs hold the truth, with nothing missing and with a slow term."""
    inside: dict[str, list[bool]] = {"noise": [], "missing": []}
    for seed in range(count):
        rng = np.random.default_rng(seed)
        u, w, e = smooth(rng), smooth(rng), rng.normal(size=N)
        for kind, missing in (("noise", 0.0), ("missing", 0.3)):
            y = 2.0 * u + 3.0 * w + missing * smooth(rng, 0.2) + 0.1 * e
            fit, error = regress(u, w, y)
            wide = widen(fit, error.matrix).parameters
            inside[kind] += [
                wide[name].ci95[0] <= true <= wide[name].ci95[1] for name, true in (("a", 2.0), ("b", 3.0))
            ]
    return {kind: float(np.mean(rows)) for kind, rows in inside.items()}


def test_intervals_hold_over_tens_of_logs():
    shares = cover(15)
    assert shares["noise"] >= 0.85
    assert shares["missing"] >= 0.9


@pytest.mark.slow
def test_intervals_hold_over_hundreds_of_logs():
    shares = cover(200)
    assert shares["noise"] >= 0.93
    assert shares["missing"] >= 0.95


@pytest.mark.parametrize("width", [1, 2, 5, 64, 100, 251])
def test_the_envelope_is_scipys_filter(width):
    values = np.random.default_rng(1).normal(size=200)
    values[20:30] = np.nan
    away = np.nan_to_num(np.abs(values - np.nanmedian(values)))
    envelope = _measure_envelope(values, ENVELOPE_S / width)
    np.testing.assert_array_equal(envelope, maximum_filter1d(away, width))
