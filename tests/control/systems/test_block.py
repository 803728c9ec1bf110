"""Blocks connected by name, against loops written out by hand and python-control's `interconnect`."""

import control
import numpy as np
import pytest

from seaopt.control.systems.block import Block, add_up, connect, make_delay, subtract_last


def draw(rng, n, inputs, outputs, direct=1.0):
    return Block(
        a=0.5 * rng.normal(size=(n, n)), b=rng.normal(size=(n, len(inputs))), c=rng.normal(size=(len(outputs), n)),
        d=direct * 0.2 * rng.normal(size=(len(outputs), len(inputs))), inputs=inputs, outputs=outputs,
    )  # fmt: skip


def respond(block, z):
    x = np.linalg.solve(z * np.eye(len(block.a)) - block.a, block.b)
    return block.c @ x + block.d


@pytest.mark.parametrize("seed", range(5))
def test_a_loop_with_feedthrough_is_what_its_equations_say(seed):
    rng = np.random.default_rng(seed)
    plant = draw(rng, 3, ("u", "w"), ("y1", "y2"))
    law = draw(rng, 2, ("r", "y1", "y2"), ("u",))
    joined = connect([plant, law], ["r", "w"], ["y2", "u"])
    for z in np.exp(1j * np.array([0.1, 1.0, 3.0])) * 1.3:
        p, k = respond(plant, z), respond(law, z)
        # Of (u, y1, y2): u = k (r, y1, y2) and y = p (u, w).
        left = np.eye(3) - np.block([[np.zeros((1, 1)), k[:, 1:]], [p[:, :1], np.zeros((2, 2))]])
        right = np.block([[k[:, :1], np.zeros((1, 1))], [np.zeros((2, 1)), p[:, 1:]]])
        u, _, y2 = np.linalg.solve(left, right)
        np.testing.assert_allclose(respond(joined, z), [y2, u], rtol=1e-10, atol=1e-12)


def test_without_feedthrough_it_is_what_python_control_makes_of_it():
    rng = np.random.default_rng(3)
    plant, law = draw(rng, 3, ("u", "w"), ("y1", "y2"), 0.0), draw(rng, 2, ("r", "y1", "y2"), ("u",))
    joined = connect([plant, law], ["r", "w"], ["y2", "u"])
    systems = [
        control.ss(b.a, b.b, b.c, b.d, 1.0, inputs=list(b.inputs), outputs=list(b.outputs), name=name)
        for name, b in (("plant", plant), ("law", law))
    ]
    expected = control.interconnect(systems, inplist=["law.r", "plant.w"], outlist=["plant.y2", "law.u"])
    for z in np.exp(1j * np.array([0.1, 1.0, 3.0])) * 1.3:
        np.testing.assert_allclose(respond(joined, z), expected(z), rtol=1e-10, atol=1e-12)


def test_what_is_put_in_under_a_name_adds_to_the_outputs_of_that_name():
    gain = Block(
        a=np.zeros((0, 0)), b=np.zeros((0, 1)), c=np.zeros((1, 0)), d=np.array([[-3.0]]), inputs=("y",), outputs=("u",)
    )
    unit = Block(
        a=np.zeros((0, 0)), b=np.zeros((0, 1)), c=np.zeros((1, 0)), d=np.array([[1.0]]), inputs=("u",), outputs=("y",)
    )
    loop = connect([gain, unit], ["y", "u"], ["y", "u"])  # y = u + n, u = -3 y + w
    np.testing.assert_allclose(loop.d, np.array([[1.0, 1.0], [-3.0, 1.0]]) / 4.0)


def test_in_series_no_state_is_fed_by_what_stands_behind_it_not_even_by_rounding():
    rng = np.random.default_rng(5)
    for _ in range(200):
        front, middle = draw(rng, 2, ("r",), ("m",), 30.0), draw(rng, 1, ("m",), ("n",), 30.0)
        behind = draw(rng, 3, ("n", "y"), ("u",), 30.0)
        joined = connect([behind, front, middle], ["r", "y"], ["u"])
        assert np.array_equal(joined.a[:3, :3], behind.a)
        assert np.array_equal(joined.c[:, :3], behind.c)
        assert not joined.a[3:, :3].any()
        assert not joined.a[3:5, 5:].any()


def test_sums_and_differences_of_signals():
    rng = np.random.default_rng(6)
    joined = connect([subtract_last("x", "v", 0.9, 4.0), add_up("u", {"v": 2.0, "w": -3.0})], ["x", "w"], ["u"])
    x, w, state, out = rng.normal(size=20), rng.normal(size=20), np.zeros(1), []
    for given in zip(x, w, strict=True):
        out.append(float((joined.c @ state + joined.d @ given)[0]))
        state = joined.a @ state + joined.b @ given
    np.testing.assert_allclose(out, 8.0 * (x - 0.9 * np.concatenate([[0.0], x[:-1]])) - 3.0 * w, rtol=1e-13, atol=1e-13)


@pytest.mark.parametrize("samples", [0, 1, 3])
def test_a_delay_gives_back_what_went_in_so_many_samples_before(samples):
    delay, x, out = make_delay(samples), np.zeros(samples), []
    for k in range(8):
        out.append(float((delay.c @ x + delay.d @ [k + 1.0])[0]))
        x = delay.a @ x + delay.b @ [k + 1.0]
    assert out == [0.0] * samples + [k + 1.0 for k in range(8 - samples)]


def test_a_stack_is_connected_system_by_system():
    rng = np.random.default_rng(7)
    plants = [draw(rng, 3, ("u",), ("y",)) for _ in range(4)]
    law = draw(rng, 2, ("r", "y"), ("u",))
    matrices = {name: np.stack([getattr(plant, name) for plant in plants]) for name in "abcd"}
    stack = Block(**matrices, inputs=("u",), outputs=("y",))
    whole = connect([stack, law], ["r"], ["y"])
    for k, plant in enumerate(plants):
        each = connect([plant, law], ["r"], ["y"])
        for m in "abcd":
            np.testing.assert_allclose(getattr(whole, m)[k], getattr(each, m), rtol=1e-13, atol=1e-15)
