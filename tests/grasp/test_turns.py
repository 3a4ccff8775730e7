"""Single rotations in plain numbers, against SciPy's."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from handtrack.grasp.turns import inverse, product, rotated, rotation_vector


def as_rotation(quat) -> Rotation:
    return Rotation.from_quat(quat, scalar_first=True)


def test_products_inverses_and_turned_vectors_are_scipys(rng: np.random.Generator) -> None:
    for _ in range(20):
        first, second = rng.normal(size=(2, 4))
        vector = rng.normal(size=3)
        both = as_rotation(first) * as_rotation(second)
        np.testing.assert_allclose(
            as_rotation(product(first.tolist(), second.tolist())).as_matrix(), both.as_matrix()
        )
        np.testing.assert_allclose(
            as_rotation(inverse(first.tolist())).as_matrix(), as_rotation(first).inv().as_matrix()
        )
        np.testing.assert_allclose(
            rotated(first.tolist(), vector.tolist()), as_rotation(first).apply(vector)
        )
        np.testing.assert_allclose(rotation_vector(first.tolist()), as_rotation(first).as_rotvec())


@pytest.mark.parametrize("angle", [0.0, 1e-15, 1e-9, 1e-4, 1.0, np.pi - 1e-6])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_rotation_vector_is_right_at_any_angle(angle: float, sign: float) -> None:
    axis = np.array([0.6, 0.0, -0.8])
    quat = sign * np.array([np.cos(angle / 2), *(np.sin(angle / 2) * axis)])
    np.testing.assert_allclose(rotation_vector(quat.tolist()), angle * axis, rtol=1e-9, atol=1e-30)
