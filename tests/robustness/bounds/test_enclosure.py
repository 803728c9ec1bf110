"""Taylor models against sampled evaluations: arithmetic, CasADi functions, rest, and the sampled plant."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from scipy.linalg import expm

import seaopt as so
from seaopt.errors import ControlError
from seaopt.plants import jacobians, state_space
from seaopt.robustness import combine_uncertainty
from seaopt.robustness.bounds.enclosure import enclose
from seaopt.robustness.bounds.impulse import enclose_plant
from seaopt.robustness.bounds.region import Boxes, build_region
from seaopt.robustness.bounds.taylor import build_basis, make_constant, make_linear

OVER = build_basis(2, 3)
E = np.random.default_rng(0).uniform(-1.0, 1.0, (4000, 2))
E[:4] = [[-1, -1], [-1, 1], [1, -1], [1, 1]]


def polynomial(model, e):
    """Return the model's polynomial at coordinates, written out."""
    powers = np.prod(e[:, None, :] ** model.basis.powers, axis=2)
    return np.tensordot(powers, model.a, axes=(1, 0))


def variable(centre, slopes):
    return make_linear(np.array([centre]), np.array(slopes)[:, None], OVER)


def encloses(model, values):
    """Return whether values at the coordinates E lie inside the model."""
    miss = np.abs(values - polynomial(model, E)[:, 0])
    return bool(np.all(miss <= model.r[0] + 1e-13 * (1.0 + np.abs(values))))


def test_monomials_are_all_there_once():
    assert build_basis(3, 4).powers.shape == (35, 3)
    assert len({tuple(row) for row in build_basis(3, 4).powers}) == 35
    assert build_basis(2, 3).index_of(0, 1, 1) == next(k for k, row in enumerate(OVER.powers) if tuple(row) == (1, 2))
    assert build_basis(0, 5).powers.shape == (1, 0)


def test_what_stays_within_the_degree_is_exact():
    x, y = variable(1.0, [0.5, 0.2]), variable(-2.0, [0.1, 0.7])
    product = (x * y - 3.0) * x
    assert product.r[0] < 1e-13
    at_x, at_y = 1.0 + E @ [0.5, 0.2], -2.0 + E @ [0.1, 0.7]
    np.testing.assert_allclose(polynomial(product, E)[:, 0], (at_x * at_y - 3.0) * at_x, rtol=1e-12)


FUNCTIONS = {
    "sin": ca.sin, "cos": ca.cos, "tanh": ca.tanh, "exp": ca.exp, "log": ca.log, "sqrt": ca.sqrt, "atan": ca.atan,
    "abs": ca.fabs, "sign": ca.sign, "square": lambda x: x**2, "inverse": lambda x: 1.0 / x, "cube": lambda x: x**3,
    "power": lambda x: x**1.7, "inverse cube": lambda x: x**-3, "abs about zero": lambda x: ca.fabs(x - 1.3),
    "largest": lambda x: ca.fmax(x, 3.0 - x**2), "least": lambda x: ca.fmin(2.0, x * x),
}  # fmt: skip


@pytest.mark.parametrize("name", FUNCTIONS)
@pytest.mark.parametrize("slopes", [[0.3, 0.1], [1.1, -0.5], [1e-4, 0.0]])
def test_functions_hold_their_values(name, slopes):
    x = ca.SX.sym("x")
    function = ca.Function("f", [x], [ca.densify(FUNCTIONS[name](x))])
    (entry,) = enclose(function, [[variable(1.7, slopes)]])[0]
    values = np.array(function((1.7 + E @ np.array(slopes))[None])).ravel()
    assert encloses(entry, values)
    if slopes[0] == 1e-4:
        assert entry.r[0] < 1e-12  # of the fourth order in the width


def test_zero_in_a_denominator_holds_everything():
    assert variable(0.1, [0.3, 0.0]).reciprocal().r[0] == np.inf
    assert (variable(0.1, [0.3, 0.0]).reciprocal() * variable(1.0, [0.0, 0.0])).r[0] == np.inf


def test_an_unknown_instruction_is_named():
    x = ca.SX.sym("x")
    with pytest.raises(ControlError, match="erf"):
        enclose(ca.Function("f", [x], [ca.erf(x)]), [[variable(0.0, [1.0, 0.0])]])
    assert enclose(ca.Function("f", [x], [ca.erf(x)]), [[0.5]])[0][0] == pytest.approx(0.5204998778)


def test_matrix_products_hold_their_values():
    rng = np.random.default_rng(1)
    centre, slopes = rng.normal(size=(2, 1, 3, 3)), 0.3 * rng.normal(size=(2, 2, 1, 3, 3))
    a, b = (make_linear(c, s, OVER) for c, s in zip(centre, slopes, strict=True))
    product = a @ b @ a
    at = [c + np.tensordot(E, s, axes=(1, 0)) for c, s in zip(centre, slopes, strict=True)]
    miss = np.abs(at[0] @ at[1] @ at[0] - polynomial(product, E))
    assert np.all(miss <= product.r + 1e-12)
    cube = a @ a @ a
    np.testing.assert_array_equal((cube @ make_constant(np.eye(3)[None], OVER)).a, cube.a)


@pytest.mark.parametrize("plant", ["stand", "swing"])
def test_jacobians_hold_casadis(plant, thor, request):
    plant = request.getfixturevalue(plant)
    names = ["J", "b_r", "eta", "I_p", "L_a"]
    nominal = plant.complete(thor).vector
    over = build_basis(len(names), 4)
    entries = [
        make_linear(np.array([value]), 0.2 * value * (np.array(names) == name)[:, None], over)
        if name in names
        else value
        for name, value in zip(plant.parameters, nominal, strict=True)
    ]
    x, u = [0.0] * len(plant.states), [0.0] * len(plant.inputs)
    models = [entry for block in enclose(jacobians(plant), [x, u, entries]) for entry in block]
    rng = np.random.default_rng(3)
    for e in rng.uniform(-1.0, 1.0, (50, len(names))):
        scale = {name: 1.0 + 0.2 * step for name, step in zip(names, e, strict=True)}
        p = [value * scale.get(name, 1.0) for name, value in zip(plant.parameters, nominal, strict=True)]
        blocks = jacobians(plant)(x, u, p)
        for model, value in zip(models, np.concatenate([np.array(b).ravel(order="F") for b in blocks]), strict=True):
            if isinstance(model, float):
                assert value == pytest.approx(model, rel=1e-12)
            else:
                middle = polynomial(model, e[None])[0, 0]
                assert abs(value - middle) <= model.r[0] + 1e-11 * abs(value)


@pytest.mark.parametrize(
    ("parts", "ranges"),
    [
        ((), {"I_p": (0.3, 0.5), "eta": (0.9, 1.0)}),
        ((), {"I_p": (0.3, 0.5), "phi": (0.1, 0.5)}),
        ((), {"eta": (0.9, 1.0), "delay_s": (1.1e-3, 1.9e-3)}),
        (("current_loop",), {"current_loop_hz": (100.0, 400.0), "I_p": (0.3, 0.5)}),
    ],
)
def test_the_sampled_plant_holds_exponentials(parts, ranges, robust_controller, thor):
    """P(z) of every draw, by scipy's exponential, lies in the quotient of the models."""
    plant = so.plants.moving_output(parts=parts)
    controller = robust_controller
    unknown = combine_uncertainty(thor, so.ParameterSet(), ranges, {"swing": plant})
    within = build_region(plant, unknown)
    boxes = Boxes(centre=np.full((1, 2), 0.2), radius=np.full((1, 2), 0.5))
    enclosed = enclose_plant(controller, plant, within, boxes)
    period, gain = controller.sample_time_s, controller.command.per_effort
    for e in np.random.default_rng(5).uniform(-1.0, 1.0, (30, 2)):
        values = {name: float(column[0]) for name, column in within.evaluate(0.2 + 0.5 * e[None]).items()}
        drawn = thor.update(**{k: v for k, v in values.items() if k in thor})
        drawn = plant.complete(drawn).update(**{k: v for k, v in values.items() if k in plant.parameters})
        a, b, c, d = _at_angle(plant, drawn, values.get("phi", 0.0))
        b, c, d = b[:, :1] * gain, c[:1], d[0, 0] * gain
        late = values.get("delay_s", 0.0)
        whole = int(late / period)
        rest = late - whole * period

        def gamma(t, a=a, b=b):
            n = len(a)
            return expm(np.block([[a, b], [np.zeros((1, n + 1))]]) * t)[:n, n:]

        newer, every = gamma(period - rest), gamma(period)
        for theta in (0.0, 1e-3, 0.1, 2.0):
            z = np.exp(1j * theta)
            w = z - 1.0
            inner = np.linalg.inv(z * np.eye(len(a)) - expm(a * period)) if theta else -np.linalg.inv(
                expm(a * period) - np.eye(len(a))
            )  # fmt: skip
            through = d * (z**-1 if rest > 0.0 else 1.0)
            exact = (c @ inner @ (newer + (every - newer) / z))[0, 0] + through
            powers = w ** np.arange(enclosed.denominator.r.shape[1])
            (head, off_head), (tail, off_tail), (below, off_below) = (
                (polynomial(model, e[None])[0, 0] @ powers, model.r[0] @ np.abs(powers))
                for model in (enclosed.heads[0], enclosed.tails[0], enclosed.denominator)
            )
            miss = abs(exact * below - (head + tail / z))
            assert enclosed.whole[0] == whole
            assert miss <= off_head + off_tail + abs(exact) * off_below + 1e-9 * abs(exact * below)


def _at_angle(plant, params, phi):
    """Return the linear plant at rest at an angle: the spring's torque on the link balances its weight."""
    if not phi:
        return state_space(plant, params)
    p = {name: item.value for name, item in params.items()}
    stretch = -p["m"] * p["g"] * p["L"] * np.sin(phi) / (p["k"] * p["L_a"] * np.cos(phi))
    ratio = p["l"] / (2 * np.pi * p["N_p"])
    x = {"q": stretch - p["L_a"] * np.sin(phi), "phi": phi}
    return state_space(plant, params, x=x, u={"I": p["k"] * stretch * ratio / (p["eta"] * p["K_tau"])})
