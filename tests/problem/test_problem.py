import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

import seaopt as so
from seaopt.problem import json_schema
from seaopt.problem.problem import name_after

ROOT = Path(__file__).resolve().parents[2]
TEXT = so.demo_path().read_text(encoding="utf-8")


@pytest.fixture
def write(tmp_path):
    def _write(text):
        path = tmp_path / "problem.toml"
        path.write_text(text, encoding="utf-8")
        return path

    return _write


def test_the_packaged_problem_is_the_one_in_problems():
    assert (ROOT / "problems" / "thor.toml").read_text(encoding="utf-8") == TEXT


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [("bandwidth_hz = 30", "bandwidth_hz = 3", "bandwidth_hz = 3 is outside 15 to 60"),
     ('[controller]\nplant = "stand"', '[controller]\nplant = "bench"', 'controller.plant = "bench" is not a [plant]')],
)  # fmt: skip
def test_what_only_a_design_needs_keeps_no_fit_from_the_file(write, old, new, said):
    assert TEXT.count(old) == 1
    path = write(TEXT.replace(old, new))
    with pytest.raises(so.SeaoptError, match=re.escape(said)):
        so.read_problem(path)
    problem, good = so.read_problem(path, design=False), so.read_problem(so.demo_path(), design=False)
    assert said in problem.refused and not good.refused and good.spec is not None
    assert problem.parameters == good.parameters and problem.fit_options == good.fit_options
    with pytest.raises(so.SeaoptError, match=re.escape(said)):
        _ = problem.design_plant


def test_a_misspelt_key_of_a_design_is_refused_ahead_of_a_fit(write):
    """A fit of minutes would end ahead of a design that its file does not have."""
    path = write(TEXT.replace("bandwidth_hz = 30", "bandwith_hz = 30"))
    with pytest.raises(so.SeaoptError, match=r'bandwith_hz; did you mean "bandwidth_hz"\? write bandwidth_hz = 30'):
        so.read_problem(path, design=False)


def test_what_a_fit_needs_is_refused_without_a_design_too(write):
    wrong = TEXT.replace("holdout = 0.2", "holdout = 3").replace("bandwidth_hz = 30", "")
    with pytest.raises(so.SeaoptError, match="holdout"):
        so.read_problem(write(wrong), design=False)


def test_a_multisine_in_a_problem_file_drives_the_virtual_log(write):
    """One line of 2 A at 8 Hz for 2 s at 400 Hz: 16 whole periods, an rms of sqrt(2) A."""
    lines = "multisine = { amplitudes = [2.0], frequencies_hz = [8.0] }"
    path = write(
        f"""
schema = 1
[plant.stand]
kind = "high_impedance"
[[experiment]]
name = "line"
plant = "stand"
virtual = {{ seed = 1, duration_s = 2, rate_hz = 400, excitation = {{ {lines} }} }}
"""
    )
    (experiment,) = so.read_problem(path).experiments()
    current = experiment.log["I"]
    assert float((current**2).mean()) == pytest.approx(2.0)
    assert current[100] == pytest.approx(0.0, abs=1e-9)  # a quarter of a second is two periods


def test_what_a_file_leaves_out_of_a_motors_heat_is_among_its_guesses(write):
    plant = '[plant.joint]\nkind = "rotary"\nparts = ["thermal"]\n'
    problem = so.read_problem(write('schema = 1\nguessed = ["N"]\n' + plant + "[parameters]\nR = 0.6\nR_wc = 1.2\n"))
    assert problem.table.guessed == ["N", "R_ca", "C_w", "C_c", "T_max"]
    stated = "R = 0.6\nR_wc = 1.2\nR_ca = 3.0\nC_w = 15\nC_c = 160\nT_max = 110\n"
    assert so.read_problem(write("schema = 1\n" + plant + "[parameters]\n" + stated)).table.guessed == []


@pytest.mark.parametrize("order", [("plain", "bristled"), ("bristled", "plain")])
def test_a_default_that_differs_among_plants_is_asked_for(write, order):
    """In whatever order they stand; a value in the file is that of both."""
    text = {"plain": '[plant.plain]\nkind = "rotary"\n',
            "bristled": '[plant.bristled]\nkind = "rotary"\nparts = ["lugre"]\n'}  # fmt: skip
    both = "schema = 1\n" + "".join(text[name] for name in order)
    with pytest.raises(so.errors.ProblemError, match=r"parameters\.f_c is missing"):
        so.read_problem(write(both))
    assert so.read_problem(write(both + "[parameters]\nf_c = 0.03\n")).parameters["f_c"].value == 0.03
    for name, default in (("plain", 0.0), ("bristled", 0.02)):
        assert so.read_problem(write("schema = 1\n" + text[name])).parameters["f_c"].value == default


def test_values_units_bounds_and_priors(write):
    path = write(
        """
schema = 1
[parameters]
k = { value = 655, unit = "N/mm", prior_std = 3 }
J = { value = 2e-6, free = true, min = 1e-7, max = 1e-4 }
L_a = 0.08
[plant.stand]
kind = "high_impedance"
"""
    )
    problem = so.read_problem(path)
    k, j = problem.parameters["k"], problem.parameters["J"]
    assert (k.value, k.prior_std, k.free) == (655e3, 3e3, True)
    assert (j.free, j.min, j.max) == (True, 1e-7, 1e-4)
    assert problem.parameters["L_a"].value == 0.08  # kept though no plant of the file uses it
    assert problem.parameters["m_l"].value == 0.646  # the plant's default


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("bandwidth_hz = 30", "bandwith_hz = 30", 'unknown key controller.bandwith_hz; did you mean "bandwidth_hz"'),
        (
            "bandwidth_hz = 30",
            "bandwidth_hz = 30\nzzz = 1",
            r"controller\.zzz; \[controller\] has \d+ keys, none of them named alike: type seaopt schema problem",
        ),
        ("bandwidth_hz = 30", "bandwidth_hz = 80", "bandwidth_hz = 80 is outside 15 to 60"),
        ("bandwidth_hz = 30\n", "", "controller.bandwidth_hz is missing"),
        ('unit = "kg m^2", free', 'unit = "kg m^3", free', "kg m\\^3"),
        ('unit = "kg m^2", free', 'unit = "flurb", free', "flurb"),
        ("value = 1.5e-6", "value = 1.5e-9", "J = 1.5e-09 kg m\\^2 is outside its bounds"),
        ("value = 1.5e-6", "value = 0", "J = 0 kg m\\^2 is outside its bounds .*; give it a positive value$"),
        ("J   =", "JJ  =", 'unknown parameter "JJ"'),
        ('kind = "high_impedance"', 'kind = "high"', "plant.stand"),
        ('drive = "unlumped"', 'drive = "unlumpt"', "unlumpt"),
        ('structure = "pid"', 'structure = "pida"', "controller.structure = 'pida'"),
        ('drive = "unlumped"', 'drave = "unlumped"', "drave"),
        ('plant = "swing"\nvirtual', 'plant = "swung"\nvirtual', "swung"),
        ('robust_to = ["swing"]', 'robust_to = ["swong"]', 'did you mean "swing"'),
        ("schema = 1", "schema = 2", "schema"),
        ("schema = 1", "schema = 1\n[[[", "not valid TOML"),
        ("seed = 1,", "seed = 'x',", "seed"),
        ("f0_hz = 0.01", "f0_hz = 0.01, f2_hz = 3", "f2_hz"),
        ("samples = 1375", "samples = 0", "samples"),
        ("bandwidth_hz = 30", 'bandwidth_hz = "30"', "bandwidth_hz"),
        ("delay_samples = 1", "delay_samples = true", "delay_samples"),
        ("delay_samples = 1", "delay_samples = 5000", "from 0 to 1000"),
        ('measured = "F1"', 'measured = "F9"', 'did you mean "F1"|F9'),
        ("I_p = [0.2, 0.6]", "I_q = [0.2, 0.6]", "I_q"),
        ("I_p = [0.2, 0.6]", "I_p = [0.6, 0.2]", "robustness.parameters.I_p: .*empty"),
        ("I_p = [0.2, 0.6]", "eta = [0.5, 3.0]", r"robustness.parameters.eta = \[0.5, 3\] leaves the bounds \[0, 2\]"),
        ("I_p = [0.2, 0.6]", "J = [1e-9, 1e-6]", r"J = \[1e-09, 1e-06\] kg m\^2 leaves .* change min and max"),
        ("value = 0.7, free = true", "value = 2.5, free = true", r"eta = 2.5 is outside its bounds \[0, 2\]"),
        ("I_p = [0.2, 0.6]", "I_p = 0.3", r"robustness.parameters.I_p = 0.3 is not a range; give \[low, high\]"),
        ("I_p = [0.2, 0.6]", 'I_p = "0.2..0.6"', r"I_p = '0.2..0.6' is not a range; give \[low, high\]"),
        ("I_p = [0.2, 0.6]", "I_p = [0.2]", r"I_p = \[0.2\] is not a range; give \[low, high\]"),
        ("I_p = [0.2, 0.6]", "I_p = [0.2, 0.4, 0.6]", r"I_p = \[0.2, 0.4, 0.6\] is not a range; give \[low, high\]"),
        (
            "bandwidth_hz = 30",
            "bandwidth_hz = 30\nbandwidth_range_hz = 50",
            r"range_hz = 50 is not a range; give \[low",
        ),
        ("I_p = [0.2, 0.6]", "phi = [-30, 30]", r"parameters.phi: .* = \[-30, 30\] is more than half a turn; .* rad"),
        ("I_p = [0.2, 0.6]", "delay_s = [0, 0.5]", r"reaches 500 sample times .* at most 20 \(0.02 s\)"),
    ],
)
def test_mistakes_are_one_clear_line(write, old, new, words):
    assert old in TEXT
    with pytest.raises(so.SeaoptError, match=words) as raised:
        so.read_problem(write(TEXT.replace(old, new, 1)))
    assert "\n" not in str(raised.value)
    assert "problem.toml" in str(raised.value)


def test_a_result_in_place_of_the_problem_is_not_to_be_corrected_nor_made_a_problem_of(tmp_path):
    path = tmp_path / "controller.json"
    path.write_text("{}", encoding="utf-8")
    with pytest.raises(so.SeaoptError, match=r"controller\.json: is a result, and no problem file") as raised:
        so.read_problem(path)
    assert f"-o {tmp_path}" in str(raised.value) and "seaopt new" not in str(raised.value)


@pytest.mark.parametrize("log", ["/etc/passwd", "../secret.csv"])
def test_logs_stay_in_the_folder(write, log):
    experiment = f"""[[experiment]]
name = "a"
plant = "stand"
log = "{log}"
time = "t [s]"
inputs = {{ I = "I [A]" }}
outputs = {{ F1 = "F1 [N]" }}
"""
    with pytest.raises(so.SeaoptError, match="leaves the problem file's folder"):
        so.read_problem(write('schema = 1\n[plant.stand]\nkind = "high_impedance"\n' + experiment))


def test_an_experiment_from_a_csv(write, tmp_path, stand, thor, short_log):
    lines = ["time [s],cur,F1 [N]"]
    lines += [
        f"{t:.6f},{1e3 * i:.9g},{f:.9g}"
        for t, i, f in zip(short_log.time, short_log["I"], short_log["F1"], strict=True)
    ]
    (tmp_path / "chirp.csv").write_text("\n".join(lines), encoding="utf-8")
    path = write(
        """
schema = 1
[parameters]
J = { value = 1e-6, free = true }
[plant.stand]
kind = "high_impedance"
[[experiment]]
name = "chirp"
plant = "stand"
log = "chirp.csv"
time = "time [s]"
inputs = { I = { column = "cur", unit = "mA" } }
outputs = { F1 = { column = "F1 [N]", sigma = 2.0 } }
slice_s = [1.0, 15.0]
"""
    )
    problem = so.read_problem(path)
    fit = so.fit(problem.experiments(), problem.parameters, **problem.fit_options)
    assert fit.parameters["J"].value == pytest.approx(3.31e-6, rel=1e-3)
    assert fit.outputs["chirp"]["F1"].sigma == 2.0


def test_the_step_of_a_reading_is_the_experiment_s(write, tmp_path, short_log):
    rows = zip(short_log.time, short_log["I"], (0.5 * (short_log["F1"] / 0.5).round()), strict=True)
    lines = ["time [s],I [A],F1 [N]", *(f"{t:.6f},{i:.9g},{f:.9g}" for t, i, f in rows)]
    (tmp_path / "chirp.csv").write_text("\n".join(lines), encoding="utf-8")
    text = """
schema = 1
[plant.stand]
kind = "high_impedance"
[[experiment]]
name = "chirp"
plant = "stand"
log = "chirp.csv"
time = "time [s]"
inputs = { I = "I [A]" }
outputs = { F1 = "F1 [N]" }
quantisation = { F1 = 0.5 }
"""
    (experiment,) = so.read_problem(write(text)).experiments()
    assert experiment.quantisation == {"F1": 0.5}
    with pytest.raises(so.SeaoptError, match=r"readings are 0\.5 N apart"):
        so.read_problem(write(text.replace("0.5 }", "0.3 }"))).experiments()


def test_json_schema_is_one():
    schema = json_schema()
    assert schema["type"] == "object"
    assert "schema" in schema["properties"]
    json.dumps(schema)


@pytest.mark.parametrize(("table", "older"), [("controller", "feasible"), ("certificate", "passed")])
def test_the_json_schema_knows_the_older_names_of_what_is_expected(table, older):
    jsonschema = pytest.importorskip("jsonschema")
    schema = jsonschema.Draft202012Validator(json_schema())
    content = {"schema": 1, "plant": {"stand": {"kind": "high_impedance"}}}
    for name in ("met", older):
        schema.validate(content | {"expect": {table: {name: False}}})
    assert not schema.is_valid(content | {"expect": {table: {"fine": False}}})


def test_import_is_light():
    """`import seaopt` loads no plotting library, no reader, no optimiser."""
    heavy = ("matplotlib", "polars", "control", "pydantic", "scipy", "casadi")
    code = f"import sys, seaopt; print([m for m in {heavy} if m in sys.modules])"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.strip() == "[]"


def test_a_servo_without_its_gain_is_asked_for_it(write):
    text = 'schema = 1\n[plant.joint]\nkind = "rotary"\nparts = ["position_servo", "deflection_sensor"]\n[parameters]\n'
    with pytest.raises(
        so.SeaoptError, match=r"k_p \(.*g_s.*\) and k_n \(.*N m/rad\).*give k_p = \.\.\., k_n = "
    ) as raised:
        so.read_problem(write(text))
    assert "\n" not in str(raised.value)
    assert so.read_problem(write(text + "k_p = 40\nk_n = 300\n")).parameters["k_p"].value == 40.0
    joint = so.plants.rotary(parts=["position_servo", "deflection_sensor"])
    with pytest.raises(so.errors.ParameterError, match=r'"k_p" and "k_n" .* give k_p and k_n in N m/rad'):
        joint.complete(joint.defaults)


def test_a_file_names_springs_and_friction_that_remember(write):
    text = (
        'schema = 1\n[plant.joint]\nkind = "rotary"\nlink = "locked"\nparts = ["lugre", "hysteresis"]\n[parameters]\n'
    )

    def complete(content):
        problem = so.read_problem(write(content))
        return problem.plants["joint"].complete(problem.parameters)

    values = complete(text + 'k_h = { value = 60, free = true }\nsigma_0 = { value = 9, unit = "N m/rad" }\n')
    assert {"z_f", "z_h"} <= set(values.plant.states)
    assert values["k_h"].unit == "N m/rad"
    for wrong, named in (('sigma_0 = { value = 9, unit = "N/m" }', "sigma_0"), ("f_c = 0.0", "f_c")):
        with pytest.raises(so.SeaoptError, match=named) as raised:
            complete(text + wrong + "\n")
        assert "\n" not in str(raised.value)


OWN = """states = { v = "rad/s" }
inputs = { I = "A" }
outputs = { v = "rad/s" }
parameters = { J = { unit = "kg m^2", value = 1 } }
f = { v = "I/J" }
h = { v = "v" }
"""
KNEE = 'kind = "rotary"\n'
TRIAL = '[[experiment]]\nname = "e"\nplant = "p"\nlog = "a.csv"\ntime = "t [s]"\ninputs = { I = "I [A]" }\n'


@pytest.mark.parametrize(
    ("text", "named"),
    [
        (OWN + 'parts = ["position_servo"]', "motor_position"),
        (OWN + 'parts = ["voltage_input"]', "speed="),
        (OWN + 'parts = ["deflection_sensor"]', "SeriesSpring"),
        (OWN + 'sensing = { regulated = ["tau"] }', 'sensing.regulated = "tau"'),
        (KNEE + TRIAL + 'outputs = { F1 = "F [N]" }', "outputs names"),
        (KNEE + 'link = "locked"\n' + TRIAL + 'outputs = { theta_l = "F [N]" }', "theta_l"),
        (KNEE + '[controller]\nplant = "p"\nmeasured = "F1"\nbandwidth_hz = 20', "is not an output of plant.p"),
        (KNEE + '[parameters]\nk_s = { value = 300, unit = "N/m" }', "N m/rad"),
        (KNEE + '[parameters]\nf_c = { value = 3, unit = "N" }', "N m"),
        (KNEE + "[parameters]\nK_tau = 0.05\nK_e = 0.06", "give K_tau alone"),
    ],
)
def test_what_a_plant_lacks_is_said_in_one_line(write, text, named):
    with pytest.raises(so.SeaoptError, match=re.escape(named)) as raised:
        so.read_problem(write("schema = 1\n[plant.p]\n" + text + "\n"))
    assert "\n" not in str(raised.value)


def test_a_plants_own_parameter_is_not_that_of_a_built_in_plant(write, monkeypatch):
    """k, N and J of a foreign plant are neither the spring's 655 kN/m nor a gear ratio's or an inertia's bounds."""
    import seaopt.plants.kinds as kinds

    class Entry:
        name, value = "foreign", "foreign:plant"

        @staticmethod
        def load():
            return lambda: so.Plant(
                name="foreign", states={"x": "rad", "v": "rad/s"}, inputs={"U": "V"}, outputs={"T": "N m"},
                parameters={"J": "kg m^2", "k": "N m/rad", "N": "N m/V"},
                f=lambda t, x, u, p: {"x": x.v, "v": (p.N * u.U - p.k * x.x) / p.J},
                h=lambda t, x, u, p: {"T": p.k * x.x},
            )  # fmt: skip

    monkeypatch.setattr(kinds, "entry_points", lambda group: [Entry])
    text = 'schema = 1\n[plant.own]\nkind = "foreign"\n[parameters]\nJ = 0.1\nN = -2.0\n'
    parameters = so.read_problem(write(text + "k = 300.0\nm_l = 0.7\n")).parameters
    values = {name: (item.value, item.unit) for name, item in parameters.items()}
    assert values == {"J": (0.1, "kg m^2"), "k": (300.0, "N m/rad"), "N": (-2.0, "N m/V"), "m_l": (0.7, "kg")}
    with pytest.raises(so.SeaoptError, match=r"parameters\.k is missing"):
        so.read_problem(write(text))


def test_a_parameter_of_another_kind_of_actuator_is_noted(tmp_path):
    """J is a screw's inertia; in a rotary actuator's file J_m would keep its default."""
    path = tmp_path / "elbow.toml"
    path.write_text('schema = 1\n[parameters]\nJ = 4e-5\nk_s = 350\n[plant.elbow]\nkind = "rotary"\n')
    (note,) = so.read_problem(path).notes
    assert "parameters.J " in note and "J_" in note


def test_an_experiment_is_named_after_its_file():
    assert (name_after("knee left.2"), name_after("7")) == ("knee_left_2", "log_7")
