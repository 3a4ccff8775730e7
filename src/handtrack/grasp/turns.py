"""Single rotations in plain numbers: control needs a few every step, and NumPy takes long over one.

Quaternions are w x y z; they need not be of unit length.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

Numbers = Sequence[float]


def product(first: Numbers, second: Numbers) -> tuple[float, float, float, float]:
    """The rotation `second` and then `first`, like the product of their matrices."""
    a, b, c, d = first
    w, x, y, z = second
    return (
        a * w - b * x - c * y - d * z,
        a * x + b * w + c * z - d * y,
        a * y - b * z + c * w + d * x,
        a * z + b * y - c * x + d * w,
    )


def inverse(quat: Numbers) -> tuple[float, float, float, float]:
    """The rotation back."""
    w, x, y, z = quat
    return w, -x, -y, -z


def rotated(quat: Numbers, vector: Numbers) -> tuple[float, float, float]:
    """A vector, turned."""
    square = sum([q * q for q in quat])
    _, x, y, z = product(product(quat, (0.0, *vector)), inverse(quat))
    return x / square, y / square, z / square


def rotation_vector(quat: Numbers) -> tuple[float, float, float]:
    """Axis times angle [rad] of a rotation, the angle within half a turn."""
    w, x, y, z = quat
    if w < 0.0:  # the same rotation
        w, x, y, z = -w, -x, -y, -z
    sine = math.sqrt(x * x + y * y + z * z)
    rate = 2.0 * math.atan2(sine, w) / sine if sine > 1e-9 * w else 2.0 / w
    return rate * x, rate * y, rate * z
