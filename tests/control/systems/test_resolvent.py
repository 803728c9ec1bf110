import numpy as np

from seaopt.control.systems.resolvent import Resolvent


def test_the_responses_are_those_of_a_solve_at_each_point():
    """Four states of very different size: back substitution against numpy's own solution, one point at a time."""
    a = np.array([[0, 1, 0, 0], [-3e5, -20, 4e3, 0], [0, 0, -1e3, 5e4], [2e-3, 0, 0, -300.0]])
    b, c = np.array([[0.0, 1.0], [3.0, 0.1], [0.0, 0.0], [1e-3, 0.0]]), np.array([[0.0, 1.0, 0.0, 2e2]])
    s = 1j * np.array([0.1, 3.0, 500.0, -2e5])
    found = Resolvent.of(a, b, c).respond(np.tile(s, 300))  # few points and many are computed in two ways
    for k, point in enumerate(s):
        expected = c @ np.linalg.solve(point * np.eye(4) - a, b)
        np.testing.assert_allclose(found[..., k], expected, rtol=1e-9)
        np.testing.assert_allclose(Resolvent.of(a, b, c).respond(s[k : k + 1])[..., 0], expected, rtol=1e-9)
