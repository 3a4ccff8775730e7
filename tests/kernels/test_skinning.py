"""Kernel of linear blend skinning (Eq. II.9) against the float64 reference."""

from __future__ import annotations

import numpy as np
import pytest

from oracles.device_arrays import download

FLOAT32 = 2e-6
"""Float32 positions below a metre, through a chain of four rotations [m]."""


@pytest.mark.parametrize("side", ["right", "left"])
@pytest.mark.parametrize("bend", [0.0, 1.0])
def test_vertices_and_normals_equal_the_reference(make_posed, device, side, bend) -> None:
    posed = make_posed(device, side=side, seed=4, bend=bend, turn=2.0)
    vertices, normals = download(posed.vertices), download(posed.normals)
    for row in range(posed.nrow):
        expected, expected_normals = posed.skin(row)
        np.testing.assert_allclose(vertices[row], expected, atol=FLOAT32)
        # Where bones turn a normal against itself its blend is short and rounding counts more.
        np.testing.assert_allclose(normals[row], expected_normals, atol=2e-5)
        np.testing.assert_allclose(np.linalg.norm(normals[row], axis=1), 1.0, atol=1e-6)


def test_rows_of_one_hand_in_one_pose_are_the_same(make_posed, device) -> None:
    posed = make_posed(device, seed=5, row_hand=(0, 0, 0))
    alone = make_posed(device, seed=5, row_hand=(0,))
    np.testing.assert_array_equal(download(posed.vertices)[0], download(alone.vertices)[0])
    np.testing.assert_array_equal(download(posed.normals)[0], download(alone.normals)[0])
