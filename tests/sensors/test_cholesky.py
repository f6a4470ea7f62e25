"""Factor, solution and inverse against NumPy, with and without blocks of zeros."""

import numpy as np
import pytest

from sensors.cholesky import factorise, invert, padded, solve


@pytest.mark.parametrize("n_vehicles", [1, 2, 3, 6, 7])
@pytest.mark.parametrize("share", [0.3, 1.0])
def test_equals_numpy(n_vehicles, share):
    rng, n = np.random.default_rng(n_vehicles), 3 * n_vehicles
    linked = np.triu(rng.random((n_vehicles, n_vehicles)) < share, 1)
    blocks = np.kron(linked | linked.T | np.eye(n_vehicles, dtype=bool), np.ones((3, 3)))
    half = rng.normal(size=(n, n))
    matrix = (half + half.T) * blocks + 4 * n * np.eye(n)
    right = rng.normal(size=n)
    factor = np.zeros((n, padded(n)))
    inverse = np.zeros_like(factor)
    factor[:, :n] = np.triu(matrix)
    factorise(factor)
    upper = np.triu(factor[:, :n])
    np.testing.assert_allclose(upper, np.linalg.cholesky(matrix).T, atol=1e-12)
    solution = right.copy()
    solve(factor, solution)
    np.testing.assert_allclose(solution, np.linalg.solve(matrix, right), atol=1e-13)
    invert(factor, inverse)
    np.testing.assert_allclose(inverse[:, :n], np.linalg.inv(matrix), atol=1e-13)
