"""Angles and vectors of the ground plane, by hand and as complex numbers."""

import numpy as np
import pytest

from cosim.base.plane import turned_by, wrapped


@pytest.mark.parametrize(
    ("angle", "same"), [(0, 0), (np.pi, np.pi), (-np.pi, np.pi), (1.5 * np.pi, -0.5 * np.pi), (-7, 2 * np.pi - 7)]
)
def test_wrapped(angle, same):
    assert wrapped(np.array([angle]))[0] == pytest.approx(same, abs=1e-12)


def test_what_is_ahead_of_a_body_that_faces_north_is_north_of_it():
    np.testing.assert_allclose(turned_by(np.pi / 2, np.array([[3.0, 1.0]])), [[-1.0, 3.0]], atol=1e-15)


def test_turned_by_as_complex_numbers():
    rng = np.random.default_rng(3)
    angle, xyz = rng.uniform(-9, 9, (50, 1)), rng.normal(size=(50, 4, 3))
    found = turned_by(angle, xyz)
    z = (xyz[..., 0] + 1j * xyz[..., 1]) * np.exp(1j * angle)
    np.testing.assert_allclose(found[..., 0] + 1j * found[..., 1], z, atol=1e-12)
    np.testing.assert_allclose(turned_by(-angle, found), xyz[..., :2], atol=1e-12)
