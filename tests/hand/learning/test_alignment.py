"""First poses of scans that lie anywhere."""

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from handtrack.hand.learning.alignment import first_pose
from handtrack.hand.learning.posed_template import PosedTemplate, Template
from handtrack.hand.shape import HandShape


@pytest.mark.parametrize("pose", ["rest", "bent"])
@pytest.mark.parametrize("size", [0.8, 1.1])
def test_a_scan_from_anywhere_is_found_with_its_size(
    template: Template, poses: dict[str, NDArray], scan_of: Callable, pose: str, size: float
) -> None:
    made = scan_of(HandShape(scale=size), pose, seed=int(100 * size))
    found, factor = first_pose(template, template.shape(), made.scan(), poses[pose])
    laid = PosedTemplate(template, template.shape(factor), found[None]).vertices[0]
    # Fingers are bent by 3 degrees more or less than asked: the hand is found, not fitted.
    assert np.linalg.norm(laid - made.vertices, axis=1).mean() < 0.009
    assert factor == pytest.approx(size, rel=0.07)
