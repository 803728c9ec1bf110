"""Numbers on the axes against computations of their own: equations of the paper, numpy's FFT, scipy, the data."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from scipy.signal import cont2discrete

import seaopt as so
from seaopt.control import sweep
from seaopt.errors import SeaoptError
from seaopt.reporting.figures.certificate import draws_panel, plants_of, requirements_panel, worst_panel
from seaopt.reporting.figures.loop import LOOP_PANELS, MAIN
from seaopt.reporting.figures.panel import COLOURS, compose_sheet

PERIOD = 1e-3


def lines(axis):
    return {line.get_label(): line for line in axis.lines}


def data(axis, label):
    return np.array(lines(axis)[label].get_data(), dtype=float)


@pytest.fixture(scope="module")
def stand_loop(thor, controller):
    """The stand's F1/F_m by (13) and (1) to (4), held and one sample late, and the law's two transfer functions."""
    value = {name: thor[name].value for name in ("m_l", "k", "J", "l", "N_p", "b_r")}
    r = value["l"] / (2 * np.pi * value["N_p"])
    m_k, b_m, k = value["m_l"] + value["J"] / r**2, value["b_r"] / r**2, value["k"]
    continuous = (np.array([[0.0, 1.0], [-k / m_k, -b_m / m_k]]), np.array([[0.0], [1.0 / m_k]]))
    a, b, *_ = cont2discrete((*continuous, np.array([[k, 0.0]]), np.zeros((1, 1))), PERIOD)
    return a, b[:, 0], k, controller.reference, controller.measurement


def respond(tf, f):
    q = np.exp(-2j * np.pi * f * PERIOD)
    return np.polyval(tf.num[::-1], q) / np.polyval(tf.den[::-1], q)


def plant(loop, f):
    a, b, k, *_ = loop
    z = np.exp(2j * np.pi * f * PERIOD)
    return np.array([k * np.linalg.solve(one * np.eye(2) - a, b)[0] / one for one in z])


def test_the_step_is_that_of_the_difference_equations(controller, stand_loop):
    a, b, k, c_r, c_y = stand_loop
    figure = controller.plot.step(size=20.0, duration_s=0.1)
    upper, lower = figure.axes
    drawn = data(upper, "design plant")
    x, late, forces, efforts = np.zeros(2), 0.0, [0.0] * 20, [0.0] * 20
    parts = []  # what each transfer function gave
    for tf in (c_r, c_y):
        parts.append(([0.0] * 20, tf))
    for _ in range(100):
        force = k * x[0]
        forces.append(force)
        effort = 0.0
        for (past, tf), inputs, sign in zip(parts, ([0.0] * 20 + [20.0] * 200, forces), (1.0, -1.0), strict=True):
            now = len(forces)
            given = [inputs[now - 1 - i] for i in range(len(tf.num))]
            out = float(np.dot(tf.num, given)) - float(np.dot(tf.den[1:], past[::-1][: len(tf.den) - 1]))
            past.append(out)
            effort += sign * out
        efforts.append(effort)
        x, late = a @ x + b * late, effort
    np.testing.assert_allclose(drawn[1], forces[20:], atol=2e-6)
    np.testing.assert_allclose(drawn[0], PERIOD * np.arange(100), atol=1e-12)
    current = data(lower, "design plant")[1]
    np.testing.assert_allclose(current, controller.command.per_effort * np.array(efforts[20:]), rtol=1e-6, atol=1e-8)
    assert upper.get_ylabel() == "F1 [N]" and lower.get_ylabel() == "current [A]"


def test_loops_are_drawn_as_the_papers_plant_and_the_law_make_them(controller, stand_loop):
    *_, c_r, c_y = stand_loop
    magnitude, phase = controller.plot.bode().axes
    f, level = data(magnitude, "design plant")
    loop = plant(stand_loop, f) * respond(c_y, f)
    np.testing.assert_allclose(level, 20 * np.log10(np.abs(loop)), atol=1e-6)
    turned = np.radians(data(phase, "design plant")[1])
    np.testing.assert_allclose(np.exp(1j * turned), loop / np.abs(loop), atol=1e-7)
    assert np.max(np.abs(np.diff(turned))) < np.pi
    values = {
        "sensitivity": 1 / (1 + loop), "complementary": loop / (1 + loop), "nyquist": loop,
        "tracking": plant(stand_loop, f) * respond(c_r, f) / (1 + loop), "noise": respond(c_y, f) / (1 + loop),
    }  # fmt: skip
    for name, expected in values.items():
        drawn = data(getattr(controller.plot, name)(), "design plant")
        if name == "nyquist":
            np.testing.assert_allclose(drawn[0] + 1j * drawn[1], expected, rtol=1e-6)
        elif name == "noise":
            np.testing.assert_allclose(drawn[1], np.abs(expected), rtol=1e-6)
        else:
            np.testing.assert_allclose(drawn[1], 20 * np.log10(np.abs(expected)), atol=1e-6)


def count_hidden(axis):
    """The points behind the legend of a drawn figure, of 200 on every straight piece of a curve within the axes."""
    box = axis.get_legend().get_window_extent()
    hidden = 0
    for line in axis.lines:
        at = line.get_transform().transform(
            np.column_stack([np.asarray(side, dtype=float) for side in line.get_data()])
        )
        pieces = np.linspace(at[:-1], at[1:], 200).reshape(-1, 2)
        hidden += np.count_nonzero(((pieces > box.p0) & (pieces < box.p1)).all(axis=1))
    return hidden


def test_no_legend_hides_a_curve(certificate, controller):
    panels = [LOOP_PANELS[name](controller, plants_of(certificate)) for name in MAIN]
    figure = compose_sheet(
        [*panels, worst_panel(certificate), draws_panel(certificate), requirements_panel(certificate)]
    )
    FigureCanvasAgg(figure).draw()
    with_legend = [axis for axis in figure.axes if axis.get_legend() is not None]
    assert {axis.get_title("left"): count_hidden(axis) for axis in with_legend if count_hidden(axis)} == {}
    assert len(with_legend) == len(panels) + 3


def test_limits_stand_where_they_were_asked(controller):
    sensitivity, tracking = controller.plot.sensitivity(), controller.plot.tracking()
    assert data(sensitivity, "Ms = 1.6")[1, 0] == pytest.approx(20 * np.log10(1.6))
    assert data(tracking, "asked: 30 Hz")[0, 0] == 30.0
    disk = data(controller.plot.nyquist(), "Ms = 1.6")
    np.testing.assert_allclose(np.hypot(disk[0] + 1.0, disk[1]), 1 / 1.6)


def test_outputs_and_residuals_are_the_logs(fitted):
    bench = fitted.experiments[0]
    axis = fitted.plot.outputs("chirp", "F1", span_s=(3.0, 4.5))
    time, values = data(axis, "measured")
    rows = np.flatnonzero((bench.log.time >= 3.0) & (bench.log.time <= 4.5))
    np.testing.assert_allclose(time, bench.log.time[rows])
    np.testing.assert_array_equal(values, bench.log["F1"][rows])
    rest = bench.log["F1"][rows] - data(axis, "model")[1]
    assert np.std(rest) == pytest.approx(2.0, rel=0.1)  # the noise that the log was made with
    figure = fitted.plot.residuals("chirp")
    for axis, name in zip(figure.axes, ("F1", "F2"), strict=True):
        drawn = data(axis, "measured - model")[1]
        whole = bench.log[name] - fitted.predict(bench).model[name]
        assert drawn.size <= 1002 and drawn.max() == whole.max() and drawn.min() == whole.min()
        assert abs(data(axis, "± rms")[1, 0]) == pytest.approx(np.sqrt(np.mean(whole**2)))


def test_the_spectrum_is_welchs(fitted):
    """A Hann window, stretches of an eighth of the log that overlap by half, one-sided, by numpy's FFT."""
    bench = fitted.experiments[0]
    values, n = bench.log["F1"], 1000
    window = np.hanning(n + 1)[:-1]
    stretches = [values[start : start + n] for start in range(0, values.size - n + 1, n // 2)]
    power = np.mean([np.abs(np.fft.rfft(window * (one - one.mean()))) ** 2 for one in stretches], axis=0)
    density = 2.0 * power / (400.0 * np.sum(window**2))
    f, drawn = data(fitted.plot.spectrum("chirp", "F1"), "measured")
    np.testing.assert_allclose(f, np.fft.rfftfreq(n, 1 / 400.0)[1:])
    np.testing.assert_allclose(drawn[:-1] ** 2, density[1:-1], rtol=1e-9)  # the last line is not doubled


def test_a_measured_response_is_that_of_the_equations(fitted, thor):
    """The model drawn lies on (13), held and sampled; H1 near it where the coherence is high."""
    figure = fitted.plot.response("chirp", "F1/I")
    magnitude, _, coherence = figure.axes
    f, level = data(magnitude, "model, fitted")
    found = fitted.parameters
    value = {name: found[name].value for name in ("m_l", "k", "J", "l", "N_p", "b_r", "eta", "K_tau")}
    r = value["l"] / (2 * np.pi * value["N_p"])
    m_k, b_m, k = value["m_l"] + value["J"] / r**2, value["b_r"] / r**2, value["k"]
    a, b, *_ = cont2discrete(
        (np.array([[0, 1], [-k / m_k, -b_m / m_k]]), np.array([[0], [1 / m_k]]), np.eye(2), np.zeros((2, 1))), 1 / 400
    )
    z = np.exp(2j * np.pi * f / 400)
    model = np.array([k * np.linalg.solve(one * np.eye(2) - a, b[:, 0])[0] for one in z])
    np.testing.assert_allclose(level, 20 * np.log10(np.abs(model) * value["eta"] * value["K_tau"] / r), atol=1e-6)
    at, estimate = data(magnitude, "H1 estimate")
    good = (at > 1.0) & (at < 10.0)
    assert np.median(np.abs(np.interp(at, f, level) - estimate)[good]) < 0.2
    assert coherence.get_ylabel() == "coherence [-]" and "dB re N/A" in magnitude.get_ylabel()


def test_the_intervals_and_correlations_are_those_of_the_covariance(fitted):
    drawn = dict(zip(*reversed(data(fitted.plot.parameters(), "95 % interval, fitted")), strict=True))
    axis = fitted.plot.parameters()
    places = dict(zip((text.get_text() for text in axis.get_yticklabels()), axis.get_yticks(), strict=True))
    for name in ("J", "b_r", "eta"):
        one = fitted.parameters[name]
        assert drawn[places[name]] == pytest.approx(100 * 1.959964 * one.std / one.value)
    (image,) = fitted.plot.correlation().images
    matrix, std = fitted.covariance.matrix, np.sqrt(np.diag(fitted.covariance.matrix))
    np.testing.assert_allclose(image.get_array(), matrix / np.outer(std, std))


def test_a_prior_is_drawn_beside_what_was_fitted(stand, short_log, thor):
    known = thor.free("J").with_parameters(replace(thor["b_r"], free=True, prior_std=1e-5))
    fit = so.fit([so.Experiment(plant=stand, log=short_log, outputs=("F1",))], known)
    (width,), _ = data(fit.plot.parameters(), "95 % interval, known before")
    assert width == pytest.approx(100 * 1.959964 * 1e-5 / fit.parameters["b_r"].value)


def test_draws_are_counted_as_the_certificate_counts_them(certificate):
    axis = certificate.plot.draws()
    found = certificate.monte_carlo
    failed = np.zeros(200, dtype=bool)
    for name in ("stand", "swing"):
        ms, share = data(axis, name)
        assert np.all(np.diff(ms) >= 0.0) and share[-1] == 100.0 and ms.size == 200
        over = certificate.drawn_ms[name] > 1.6 * (1 + 1e-6)
        failed |= over
        assert share[ms <= 1.6 * (1 + 1e-6)].max(initial=0.0) == pytest.approx(100 * (1 - over.mean()))
    assert found.over_ms == np.count_nonzero(failed) and found.unstable == 0
    assert data(axis, "swing, worst found")[0, 0] >= data(axis, "swing")[0].max() * (1 - 1e-9)


def test_a_certificate_draws_each_of_its_parts(certificate, thor):
    sensitivity = certificate.plot.sensitivity()
    peak = max(data(sensitivity, "swing, worst")[1])
    assert peak == pytest.approx(20 * np.log10(certificate.worst["swing"].ms), abs=1e-3)
    used = certificate.plot.requirements()
    shares = dict(zip((text.get_text() for text in used.get_yticklabels()), used.get_yticks(), strict=True))
    met = dict(zip(*reversed(data(used, "met")), strict=True))
    most = max(one.noise_gain for name, one in certificate.plants.items() if name == "stand")
    assert met[shares["noise gain"]] == pytest.approx(100 * most / 25.0)
    for sweep_, colour in zip(certificate.simulated.large_signal, COLOURS, strict=False):
        line = lines(certificate.plot.bandwidth())[f"{sweep_.plant}, simulated"]
        np.testing.assert_array_equal(line.get_ydata(), [np.nan if hz is None else hz for hz in sweep_.bandwidth_hz])
        assert line.get_color() == colour
    run = certificate.plot.simulations("stand", "10 % step")
    trace = certificate.runs.replay(next(
        row for row in certificate.runs.worst() if (row.plant, row.scenario) == ("stand", "10 % step")
    ))  # fmt: skip
    drawn = data(run.axes[0], "F1")
    np.testing.assert_array_equal(drawn[1], trace.outputs["F1"][0][: drawn.shape[1]])


def test_the_impedance_is_that_of_the_papers_actuator(controller, thor, stand_loop):
    """Z = (m_l s^2 + k)(M s + b_m)/(m_k s^2 + b_m s + k (1 + C')) of `seaopt.control.laws.passivity`."""
    upper, lower = controller.plot.impedance().axes
    f, size = data(upper, "controlled")
    value = {name: thor[name].value for name in ("m_l", "k", "J", "l", "N_p", "b_r")}
    r, s = value["l"] / (2 * np.pi * value["N_p"]), 2j * np.pi * f
    mass, damping = value["J"] / r**2, value["b_r"] / r**2
    hold = -np.expm1(-s * PERIOD) / (s * PERIOD) * np.exp(-s * PERIOD * controller.compute_delay_samples)
    law = respond(stand_loop[4], f) * hold
    z = (value["m_l"] * s**2 + value["k"]) * (mass * s + damping)
    z /= (value["m_l"] + mass) * s**2 + damping * s + value["k"] * (1 + law)
    np.testing.assert_allclose(size, np.abs(z), rtol=1e-6)
    np.testing.assert_allclose(data(lower, "controlled")[1], z.real / np.abs(z), atol=1e-6)


def test_a_log_is_drawn_with_its_faults(short_log):
    keep = np.r_[0:3000, 4000:8000]
    force = short_log["F1"][keep].copy()
    force[100:110] = np.nan
    log = so.Log.from_arrays(time=short_log.time[keep], I=short_log["I"][keep], F1=force, units={"I": "A", "F1": "N"})
    axis = log.plot.channels("F1")
    time, values = data(axis, "F1")
    assert np.nanmax(values) == np.nanmax(force) and np.nanmin(values) == np.nanmin(force)
    assert np.isnan(values[(time > 7.6) & (time < 9.9)]).all()  # the gap, from 7.5 to 10 s
    assert {patch.get_label() for patch in axis.patches} == {"gap", "missing"}
    assert axis.get_ylabel() == "F1 [N]" and log.plot.spectrum("I").get_ylabel() == "I [A/√Hz]"
    with pytest.raises(so.SeaoptError, match=r"channel = \"F7\".*F1"):
        log.plot.channels("F7")


def test_a_sweep_is_drawn_as_its_rows_say(stand, thor):
    spec = so.ControllerSpec(max_sensitivity=1.6, max_noise_gain=25, current_limit_A=9.0)
    found = sweep(stand, thor, spec, [20, 30])
    axis = found.plot.noise_gain()
    np.testing.assert_array_equal(data(axis, "every limit met"), [[20, 30], [row.noise_gain for row in found.rows]])
    assert len(found.plot().axes) == 6 and "img" in found._repr_html_()


@pytest.mark.slow
def test_fits_that_are_compared_stand_in_one_figure(short_log, thor):
    fits = {
        drive: so.fit(
            [so.Experiment(plant=so.plants.high_impedance(drive=drive), log=short_log, name="chirp", outputs=("F2",))],
            thor.free("J", "b_r"),
        )
        for drive in ("unlumped", "lumped")
    }  # fmt: skip
    ranking = so.compare(fits)
    magnitude = ranking.plot.response("chirp", "F2/I").axes[0]
    lumped = data(magnitude, "lumped")[1]
    unlumped = data(magnitude, "unlumped")[1]
    assert lumped[-1] - unlumped[-1] > 20.0  # (7) is flat where (14) has fallen
    evidence = ranking.plot.evidence().lines[0].get_xdata()
    assert evidence[0] == 0.0 and evidence[1] == ranking.rows[1].effective_bic - ranking.rows[0].effective_bic
    assert "very strong" in ranking._repr_html_() and "img" in ranking._repr_html_()


def every_figure(fitted, controller, certificate):
    objects = (fitted, controller, certificate, fitted.experiments[1].log)
    for one in objects:
        for name in dir(one.plot):
            if name not in ("friction", "simulations", "runs", "environments", "amplitude"):  # not here, or many
                own = {"experiment": "chirp"} if one is fitted and name not in ("parameters", "correlation") else {}
                yield type(one).__name__, name, getattr(one.plot, name)(**own)


def test_every_axis_states_its_unit_and_pyplot_keeps_no_figure(fitted, controller, certificate):
    for kind, name, drawn in every_figure(fitted, controller, certificate):
        figure = drawn if isinstance(drawn, Figure) else drawn.get_figure()
        if name == "correlation":  # names on both sides
            continue
        for axis in figure.axes:
            below = [other for other in axis.get_shared_x_axes().get_siblings(axis) if other.get_xlabel()]
            labels = [one.get_xlabel() for one in below] or [""]
            labels += [] if name in ("parameters", "requirements") else [axis.get_ylabel()]
            for label in labels:
                assert label.endswith("]") and "[" in label, (kind, name, label)
    assert "matplotlib.pyplot" not in sys.modules or not sys.modules["matplotlib.pyplot"].get_fignums()


def test_figures_take_and_return_axes(controller, fitted):
    own = Figure().subplots(1, 2)
    assert controller.plot.sensitivity(ax=own[0]) is own[0] and own[0].lines
    assert controller.plot.bode(ax=own) is own[0].figure
    assert isinstance(controller.plot.tracking(), Axes) and isinstance(fitted.plot(), Figure)
    with pytest.raises(SeaoptError, match="sequence of 2 Axes"):
        controller.plot.bode(ax=own[0])
    with pytest.raises(SeaoptError, match="ax = 3"):
        controller.plot.sensitivity(ax=3)
    with pytest.raises(SeaoptError, match="name one of them"):
        fitted.plot.residuals(ax=own)


def test_what_cannot_be_drawn_says_why(fitted, controller, certificate, stand, thor):
    stored = so.Fit.from_dict(fitted.to_dict())
    with pytest.raises(SeaoptError, match="without its logs"):
        stored.plot.outputs()
    assert len(stored.plot().axes) == 2  # parameters and their correlation need no log
    with pytest.raises(SeaoptError, match=r'"chrp".*chirp'):
        fitted.plot.residuals("chrp")
    with pytest.raises(SeaoptError, match="no two samples"):
        fitted.plot.outputs("chirp", span_s=(30.0, 31.0))
    with pytest.raises(SeaoptError, match=r"no plant of this certificate has friction"):
        certificate.plot.friction()
    with pytest.raises(SeaoptError, match="does not know its design plant"):
        replace(controller, design=None).plot.step()
    alone = replace(certificate, simulated=None, drawn_ms={})
    for figure in (alone.plot.bandwidth, alone.plot.environments, alone.plot.draws):
        with pytest.raises(SeaoptError, match="call"):
            figure()


def test_text_stays_text_in_files(controller, tmp_path):
    figure = controller.plot.sensitivity().get_figure(root=True)
    figure.savefig(tmp_path / "a.svg")
    svg = (tmp_path / "a.svg").read_text(encoding="utf-8")
    assert ">|S| [dB]</text>" in svg and "<image" not in svg
    figure.savefig(tmp_path / "a.pdf")
    assert b"/Type0" in (tmp_path / "a.pdf").read_bytes()  # TrueType, not outlines


def test_a_name_that_looks_like_mathematics_is_shown_as_it_is(short_log):
    log = so.Log.from_arrays(time=short_log.time, **{"$\\foo$": short_log["I"]})
    drawn = log.plot.channels("$\\foo$")
    FigureCanvasAgg(drawn.get_figure()).draw()
    assert drawn.get_ylabel() == "$\\foo$"


def test_nothing_needs_a_display_or_pyplot():
    code = (
        "import sys, seaopt as so\n"
        "c = so.tune(so.plants.high_impedance(), so.plants.thor(), so.ControllerSpec(bandwidth_hz=30))\n"
        "assert 'matplotlib' not in sys.modules\n"
        "c.plot.step().figure.savefig(sys.argv[1])\n"
        "assert 'matplotlib.pyplot' not in sys.modules\n"
    )
    run = subprocess.run(
        [sys.executable, "-c", code, "/dev/null/no.png"], capture_output=True, text=True, check=False, env=headless()
    )
    assert "NotADirectoryError" in run.stderr and "AssertionError" not in run.stderr  # as far as the file itself


def headless():
    import os

    return {name: value for name, value in os.environ.items() if name not in ("DISPLAY", "WAYLAND_DISPLAY")}


def test_notebooks_show_tables_and_figures(fitted, controller, certificate, monkeypatch):
    monkeypatch.setattr("seaopt.reporting.figures.canvas.render_figure", lambda figure, kind: b"<svg/>")
    prediction = fitted.predict(fitted.experiments[1])
    for one in (fitted, controller, certificate, fitted.experiments[1].log, prediction):
        shown = one._repr_html_()
        assert shown.count("<table>") >= 1 and shown.count('<img src="data:image/svg+xml;base64,') == 1
    assert f"{fitted.parameters['J'].value:.6g}" in fitted._repr_html_()
    assert controller.plot.sensitivity()._repr_html_().startswith("<img")


def test_a_figure_is_a_picture_in_a_stored_notebook(controller):
    figure = controller.plot.step()
    assert figure._repr_png_().startswith(b"\x89PNG") and figure.axes[0]._repr_png_().startswith(b"\x89PNG")
