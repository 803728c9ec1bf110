"""A winding that warms up, against equations written here, closed forms and an integrator of its own."""

import pickle
from dataclasses import replace

import numpy as np
import pytest

import seaopt as so
from seaopt.control.loops.port import port_of
from seaopt.control.loops.sampled_plant import differentiate_linearisation, linearise
from seaopt.errors import PlantError
from seaopt.plants import rate_motor
from seaopt.plants.motor.thermal import find_warm_range, freeze_heat
from seaopt.robustness.verification.environments import attach_environment

HOT = {"R": 0.7, "alpha_cu": 0.0039, "R_wc": 1.3, "R_ca": 3.1, "C_w": 15.0, "C_c": 160.0, "T_ambient": 21.0}
T_MAX = 120.0


def heat_rates(current, rises):
    """Return the network of winding and case, written out again, of the current at each instant."""
    winding, case = rises
    loss = HOT["R"] * (1.0 + HOT["alpha_cu"] * (HOT["T_ambient"] + winding - 25.0)) * current**2
    to_case = (winding - case) / HOT["R_wc"]
    return np.array([(loss - to_case) / HOT["C_w"], (to_case - case / HOT["R_ca"]) / HOT["C_c"]])


def warm_up(currents, step, start=(0.0, 0.0)):
    """Return winding and case above the ambient at each sample of a held current, by four steps of Runge and Kutta."""
    x, rows, h = np.array(start), [], step / 4.0
    for current in currents:
        rows.append(x)
        for _ in range(4):
            k_1 = heat_rates(current, x)
            k_2 = heat_rates(current, x + 0.5 * h * k_1)
            k_3 = heat_rates(current, x + 0.5 * h * k_2)
            x = x + h / 6.0 * (k_1 + 2.0 * k_2 + 2.0 * k_3 + heat_rates(current, x + h * k_3))
    return np.array([*rows, x]).T


def make(link="locked", parts=(), **options):
    plant = so.plants.rotary(link=link, parts=["thermal", *parts], **options)
    return plant, plant.defaults.update(**HOT, T_max=T_MAX)


PLANT, VALUES = make()
RATING = rate_motor(PLANT, VALUES)


def test_the_two_time_constants_are_those_of_the_linearised_plant():
    model = PLANT.linearize(VALUES)
    rows = [list(PLANT.states).index(name) for name in ("rise_winding", "rise_case")]
    slow = np.sort(-1.0 / np.linalg.eigvals(model.A[np.ix_(rows, rows)]).real)
    assert RATING.time_constants_s() == pytest.approx(tuple(slow), rel=1e-12)
    others = [i for i in range(len(PLANT.states)) if i not in rows]
    assert not np.any(model.A[np.ix_(rows, others)])
    assert not np.any(model.A[np.ix_(others, rows)])  # at rest heat and motion do not see each other
    assert not np.any(model.B[rows])


@pytest.mark.parametrize("current", [0.0, 1.0, 3.0])
def test_a_constant_current_ends_where_all_of_its_loss_leaves(current):
    rest = RATING.rises(current, 1e6)
    loss = HOT["R"] * (1.0 + HOT["alpha_cu"] * (HOT["T_ambient"] + rest[0] - 25.0)) * current**2
    assert rest == pytest.approx([loss * (HOT["R_wc"] + HOT["R_ca"]), loss * HOT["R_ca"]], rel=1e-9, abs=1e-12)
    after = warm_up(np.full(100, current), 0.5)[:, -1]
    assert RATING.rises(current, 50.0) == pytest.approx(after, rel=1e-7, abs=1e-12)


def test_ratings_end_at_the_largest_temperature():
    hot = T_MAX - HOT["T_ambient"]
    assert RATING.rises(RATING.continuous_A, 1e6)[0] == pytest.approx(hot, rel=1e-9)
    p = VALUES
    loss = hot / (HOT["R_wc"] + HOT["R_ca"])  # closed form
    resistance = HOT["R"] * (1.0 + HOT["alpha_cu"] * (T_MAX - 25.0))
    assert RATING.continuous_A == pytest.approx(np.sqrt(loss / resistance), rel=1e-12)
    per_ampere = p["N"].value * p["eta"].value * p["K_tau"].value
    assert RATING.continuous_effort == pytest.approx(per_ampere * RATING.continuous_A)
    warm = tuple(RATING.rises(2.0, 600.0))
    for duration, start in ((2.0, (0.0, 0.0)), (30.0, warm), (1e6, (0.0, 0.0))):
        peak = RATING.peak_A(duration, start)
        assert RATING.rises(peak, duration, start)[0] == pytest.approx(hot, rel=1e-9)
        if duration < 100:
            end = warm_up(np.full(50, peak), duration / 50, start)[0, -1]
            assert end == pytest.approx(hot, rel=1e-7)
    assert RATING.peak_A(2.0, warm) < RATING.peak_A(2.0)
    assert RATING.peak_A(1e6) == pytest.approx(RATING.continuous_A, rel=1e-6)
    assert RATING.peak_effort(2.0) == pytest.approx(per_ampere * RATING.peak_A(2.0))


@pytest.mark.parametrize(("part", "values", "command", "volts"), [
    ("duty_input", {"V_s": 2.0}, None, 2.0), ("duty_input", {"V_s": 2.0}, 0.5, 1.0), ("voltage_input", {}, 1.5, 1.5)
])  # fmt: skip
def test_a_rating_keeps_to_what_the_voltage_drives(part, values, command, volts):
    """At rest I = V/R(T): of T_max for ever, of the end of a peak for that."""
    plant, params = make(parts=[part])
    rating = rate_motor(plant, params.update(**values), command)
    hot = HOT["R"] * (1.0 + HOT["alpha_cu"] * (T_MAX - 25.0))
    assert rating.continuous_A == pytest.approx(volts / hot, rel=1e-12)
    assert rating.continuous_A < RATING.continuous_A  # which the voltage does not reach
    peak = rating.peak_A(10.0)
    end = HOT["T_ambient"] + warm_up(np.full(40, peak), 0.25)[0, -1]
    assert peak * HOT["R"] * (1.0 + HOT["alpha_cu"] * (end - 25.0)) == pytest.approx(volts, rel=1e-8)
    assert rate_motor(plant, params.update(V_s=1e3) if values else params).peak_A() == pytest.approx(RATING.peak_A())


def test_a_controller_of_a_voltage_states_what_its_limit_allows():
    plant, values = make(parts=["voltage_input"])
    spec = so.ControllerSpec(measured="tau_s", bandwidth_hz=15, command_limit=1.5)
    rating = so.tune(plant, values, spec).rating
    assert rating.continuous_A == pytest.approx(1.5 / (HOT["R"] * (1.0 + HOT["alpha_cu"] * (T_MAX - 25.0))))


def test_a_winding_that_runs_away_is_infinitely_hot():
    """No number holds what exp(rate t) gives here; the current of a peak so long is the continuous one."""
    assert np.max(np.linalg.eigvals(RATING.matrix(50.0)).real) * 1e4 > 710.0
    np.testing.assert_array_equal(RATING.rises(50.0, 1e4), [np.inf, np.inf])
    assert RATING.peak_A(1e7) == pytest.approx(RATING.continuous_A, rel=1e-9)


def test_a_largest_temperature_below_the_air_is_refused_before_it_is_tuned():
    spec = so.ControllerSpec(measured="tau_s", bandwidth_hz=15)
    with pytest.raises(PlantError, match="T_max"):
        so.tune(PLANT, VALUES.update(T_max=20.0), spec)


def test_a_short_peak_is_heat_in_the_winding_alone():
    """Over a hundredth of the short time constant nothing leaves: C_w d(rise)/dt = R (1 + a rise) I^2."""
    duration = 0.01 * RATING.time_constants_s()[0]
    slope, rise = RATING.slope / RATING.resistance, T_MAX - HOT["T_ambient"]
    adiabatic = np.sqrt(HOT["C_w"] * np.log1p(slope * rise) / (RATING.slope * duration))
    assert RATING.peak_A(duration) == pytest.approx(adiabatic, rel=0.01)


@pytest.mark.parametrize("make_plant", [
    lambda: so.plants.rotary(link="free", parts=["thermal"]),
    lambda: so.plants.high_impedance(parts=["thermal"]),
])  # fmt: skip
def test_heat_and_motion_are_simulated_together(make_plant):
    plant = make_plant()
    values = so.plants.thor().update(**{}) if "J" in plant.parameters else plant.defaults
    values = plant.complete(values).update(**HOT)
    times = np.arange(0.0, 2.0, 1e-3)
    current = 3.0 * np.sin(2 * np.pi * 5.0 * times) + 1.0
    run = so.simulate(plant, values, so.Log.from_arrays(time=times, I=current))
    held = so.simulate(freeze_heat(plant), values, so.Log.from_arrays(time=times, I=current))
    for name in freeze_heat(plant).outputs:
        scale = np.max(np.abs(held[name]))
        assert np.max(np.abs(run[name] - held[name])) <= 1e-5 * scale  # the motion is that without heat
    rises = warm_up(current, 1e-3)[:, :-1]
    assert run["T_winding"] - HOT["T_ambient"] == pytest.approx(rises[0], abs=2e-4)
    assert run["T_case"] - HOT["T_ambient"] == pytest.approx(rises[1], abs=2e-4)


@pytest.mark.parametrize("inductive", [False, True])
def test_a_warm_winding_takes_less_current_and_energy_balances(inductive):
    """Locked, V I = heat in winding, case and air + what the spring stores and friction takes."""
    plant, values = make(parts=["voltage_input", *(["inductance"] if inductive else [])])
    times = np.arange(0.0, 40.0, 2e-3)
    volts = np.full(times.size, 5.0)
    run = so.simulate(plant, values, so.Log.from_arrays(time=times, V=volts))
    winding, case, current = run["T_winding"] - HOT["T_ambient"], run["T_case"] - HOT["T_ambient"], run["I"]
    resistance = HOT["R"] * (1.0 + HOT["alpha_cu"] * (run["T_winding"] - 25.0))
    late = times > 5.0  # at rest by then: Ohm's law of the warm winding
    emf = values["K_tau"].value * np.gradient(run["theta_m"], times)
    assert current[late] == pytest.approx((5.0 - emf[late]) / resistance[late], rel=1e-4)
    assert current[-1] < 0.85 * np.max(current)
    stored = HOT["C_w"] * winding[-1] + HOT["C_c"] * case[-1]
    left = np.trapezoid(case / HOT["R_ca"], times)
    spring = 0.5 * values["k_s"].value * run["deflection"][-1] ** 2
    given = np.trapezoid(volts * current, times)
    rubbed = np.trapezoid(values["b_r"].value * np.gradient(run["theta_m"], times) ** 2, times)
    rubbed += np.trapezoid(values["c_s"].value * np.gradient(run["deflection"], times) ** 2, times)
    assert given == pytest.approx(stored + left + spring + rubbed, rel=2e-3)


def test_heat_is_fitted_from_a_log_of_temperatures():
    """Cold start, steps of current for 15 minutes at 2 Hz; the log is made by this file's own integrator."""
    plant = so.plants.winding()
    values = plant.defaults.update(**HOT, T_max=T_MAX)
    rng = np.random.default_rng(5)
    times = np.arange(0.0, 900.0, 0.5)
    levels = np.repeat(rng.uniform(0.5, 4.0, 30), 60)
    rises = warm_up(levels, 0.5)[:, :-1]
    noise = rng.normal(0.0, 0.1, rises.shape)
    log = so.Log.from_arrays(
        time=times, I=levels,
        T_winding=HOT["T_ambient"] + rises[0] + noise[0], T_case=HOT["T_ambient"] + rises[1] + noise[1],
    )  # fmt: skip
    guess = values.update(R_wc=2.0, R_ca=5.0, C_w=30.0, C_c=100.0).free("R_wc", "R_ca", "C_w", "C_c")
    fit = so.fit([so.Experiment(plant=plant, log=log, offset=False, initial_state="rest")], guess)
    assert fit.met
    for name in ("R_wc", "R_ca", "C_w", "C_c"):
        assert abs(fit.parameters[name].value - HOT[name]) < 4.0 * fit.parameters[name].std < 0.02 * HOT[name]


def test_what_cannot_be_is_one_line():
    cold = so.plants.rotary()
    with pytest.raises(PlantError, match="thermal"):
        rate_motor(cold, cold.defaults)
    with pytest.raises(PlantError, match="T_max"):
        rate_motor(PLANT, VALUES.update(T_ambient=130.0))
    with pytest.raises(PlantError, match="duration_s"):
        RATING.peak_A(0.0)
    with pytest.raises(PlantError, match="cool"):
        RATING.peak_A(5.0, (200.0, 10.0))
    with pytest.raises(PlantError, match="current that heats"):
        so.plants.wrapped(so.plants.rotary(parts=["voltage_input"]), ["thermal"])


def test_no_motor_is_rated_by_defaults_that_nobody_gave():
    with pytest.raises(PlantError, match="R, R_wc, R_ca, C_w, C_c and T_max of the winding are not given"):
        rate_motor(PLANT, so.plants.rotary(link="locked").defaults)
    with pytest.raises(PlantError, match="C_c of the winding is not given"):
        rate_motor(PLANT, so.ParameterSet(one for name, one in VALUES.items() if name != "C_c"))


@pytest.mark.usefixtures("without_causes")
def test_a_fit_names_what_of_the_motors_heat_is_a_guess():
    cold = so.plants.rotary(link="locked").defaults.free("k_s")
    time = np.arange(400) * 1e-3
    log = so.simulate(PLANT, VALUES, so.Log.from_arrays(time=time, I=np.sin(40.0 * time)))
    experiment = so.Experiment(plant=PLANT, log=log, outputs=("tau_s",))
    guess = [one for one in so.fit([experiment], cold).findings if one.kind == "guess"]
    assert [one.where for one in guess] == ["on 6 guesses: R, R_wc, R_ca, C_w, C_c, T_max"]
    assert not [one for one in so.fit([experiment], VALUES.free("k_s")).findings if one.kind == "guess"]


def test_a_plant_with_heat_pickles_and_its_held_partner_has_heat():
    plant = so.plants.moving_output(parts=["thermal", "duty_input"])
    again = pickle.loads(pickle.dumps(plant))
    assert again.winding.rises == plant.winding.rises
    values = plant.complete(so.plants.thor())
    assert rate_motor(again, again.defaults).continuous_A == rate_motor(plant, plant.defaults).continuous_A
    held = plant.port.held()
    assert [name for name in plant.states if name not in ("phi", "phid")] == list(held.states)
    assert values["T_max"].unit == "degC"


@pytest.mark.slow
def test_a_certificate_of_a_voltage_looks_at_the_winding_cold_and_hot():
    plant, values = make(parts=["voltage_input"])
    assert find_warm_range(PLANT, VALUES) is None  # a current is commanded
    assert find_warm_range(plant, values) == (HOT["T_ambient"], T_MAX)
    cold, hot = (HOT["R"] * (1.0 + HOT["alpha_cu"] * (T - 25.0)) for T in (HOT["T_ambient"], T_MAX))
    spec = so.ControllerSpec(measured="tau_s", bandwidth_hz=15, command_limit=24.0, max_sensitivity=1.6)
    controller = so.tune(plant, values, spec)
    gain = controller.close(plant, values).plant.static_gain
    warm = controller.close(plant, values.update(T_ambient=T_MAX)).plant.static_gain
    assert warm == pytest.approx(gain * cold / hot, rel=1e-9)
    # What is uncertain of R itself stays so, a range or a standard deviation; and the plant need not be the design's.
    uncertain = values.with_parameters(replace(values["R"], prior_std=0.1))
    certificate = so.certify(controller, {"elbow": plant}, uncertain, samples=20, simulations=False)
    assert {row.name: (row.low, row.high) for row in certificate.varied if row.std is None} == {
        "T_ambient": (HOT["T_ambient"], T_MAX)
    }
    assert [row.std for row in certificate.varied if row.name == "R"] == [0.1]
    without = so.plants.rotary(link="locked", parts=["voltage_input"])
    on_cold = so.tune(without, values, spec)
    given = {"R": (0.69, 0.71), "T_ambient": (-20.0, 40.0)}
    other = so.certify(on_cold, {"stand": without, "elbow": plant}, values, samples=20, ranges=given, simulations=False)
    assert {row.name: (row.low, row.high) for row in other.varied} == {"R": (0.69, 0.71), "T_ambient": (-20.0, T_MAX)}


def test_the_probe_of_a_port_warms_up_too():
    """At 85 degC the probe is that of a winding of so much more resistance."""
    ambient, parts = 85.0, ["voltage_input"]
    plant = so.plants.rotary(link="free", parts=[*parts, "thermal"])
    without = so.plants.rotary(link="free", parts=parts)
    values = plant.defaults.update(T_ambient=ambient)
    by_hand = without.defaults.update(R=values["R"].value * (1.0 + values["alpha_cu"].value * (ambient - 25.0)))
    one, other = (port_of(plant, values, "tau_s", 1.0), port_of(without, by_hand, "tau_s", 1.0))
    for name in ("a", "motor", "force", "read"):
        assert getattr(one, name) == pytest.approx(getattr(other, name), rel=1e-12, abs=1e-12)
    assert "rise_winding" in plant.port.probe().states
    assert list(attach_environment(plant).states) == list(attach_environment(without).states)


@pytest.mark.slow
def test_loops_of_a_commanded_current_are_those_without_heat():
    cold = so.plants.rotary(link="locked")
    spec = so.ControllerSpec(measured="tau_s", bandwidth_hz=15, current_limit_A=9.0)
    with_heat, without = so.tune(PLANT, VALUES, spec), so.tune(cold, VALUES, spec)
    assert with_heat.gains == without.gains
    assert with_heat.achieved == without.achieved
    rubbing = VALUES.update(f_c=0.05)
    margins = [so.tune(plant, rubbing, spec).friction for plant in (PLANT, cold)]
    assert margins[0].least_slope == margins[1].least_slope


def test_derivatives_of_loops_leave_heat_out_too():
    """Where they look for the worst case, as for a resistance that is hot: the same at a hundredth of a step."""
    plant, values = make(link="pendulum", parts=["voltage_input"])
    p, step = plant.complete(values).vector[:, None], 1e-5
    along = np.zeros_like(p)
    along[list(plant.parameters).index("R")] = 1.0
    base, slopes = differentiate_linearisation(plant, p, {}, along, {}, "tau_s", 1.0)
    before, after = (linearise(plant, p + sign * step * along, {}, "tau_s", 1.0) for sign in (-1.0, 1.0))
    for one, slope, low, high in zip(base, slopes, before, after, strict=True):
        assert one.shape == low.shape
        scale = np.max(np.abs(one)) + 1e-12
        assert np.max(np.abs((high - low) / (2.0 * step) - slope)) < 1e-5 * scale
