"""People in view: where head, shoulders and arms are, and what size."""

from __future__ import annotations

import math

import numpy as np
import pytest

from handtrack.camera.camera import Camera
from handtrack.errors import InputError
from handtrack.synthesis.people import SHOULDER, Person, cloth_folds
from handtrack.synthesis.scenery import DepthScene

CAMERA = Camera(width=320, height=240, fx=160.0, fy=160.0, cx=159.5, cy=119.5)


def drawn(person: Person, **options: object) -> np.ndarray:
    scene = DepthScene(CAMERA)
    person.add_to(scene, **options)  # type: ignore[arg-type]
    return scene.depth


def metres(depth: np.ndarray) -> np.ndarray:
    """Points seen [m], shape (n, 3)."""
    return CAMERA.points(depth)[depth > 0]


def test_a_person_has_the_size_of_an_adult_and_faces_the_camera() -> None:
    points = metres(drawn(Person(chest=(0.0, 0.1, 1.3))))
    x, y, z = points.T
    assert -0.36 < y.min() - 0.1 < -0.30, "top of the head"
    shoulders = points[np.abs(y - 0.14) < 0.02]
    assert 0.44 < np.ptp(shoulders[:, 0]) < 0.52
    head = points[y < 0.0]
    assert 0.14 < np.ptp(head[:, 0]) < 0.18 and abs(head[:, 0].mean()) < 0.005
    # The nose is the nearest point of the head.
    tip = head[head[:, 2].argmin()]
    assert abs(tip[0]) < 0.02 and -0.15 < tip[1] < -0.05
    # Standing upright, alike on both sides.
    assert abs(np.median(x)) < 0.005 and z.min() > 0.8


def test_a_person_turns_to_the_side_and_comes_in_sizes() -> None:
    ahead = metres(drawn(Person(chest=(0.0, 0.1, 1.3))))
    turned = metres(drawn(Person(chest=(0.0, 0.1, 1.3), turn=math.radians(40))))
    nose = turned[turned[:, 1] < 0.0]
    nose = nose[nose[:, 2].argmin()]
    assert nose[0] < -0.03, "to the person's right, which is the picture's left"
    small = metres(drawn(Person(chest=(0.0, 0.1, 1.3), size=0.7)))
    height = 0.1 - ahead[:, 1].min()
    assert 0.1 - small[:, 1].min() == pytest.approx(0.7 * height, abs=0.01)
    for options in ({"size": 0.1}, {"arms": "crossed"}):
        with pytest.raises(InputError, match=next(iter(options))):
            Person(chest=(0.0, 0.0, 1.0), **options)  # type: ignore[arg-type]


def test_arms_hang_rest_on_the_hips_or_go_to_a_raised_hand() -> None:
    hanging = metres(drawn(Person(chest=(0.0, 0.0, 1.3))))
    akimbo = metres(drawn(Person(chest=(0.0, 0.0, 1.3), arms="akimbo")))
    assert np.ptp(hanging[:, 0]) < 0.56 < 0.70 < np.ptp(akimbo[:, 0])
    elbow = np.array([-0.30, 0.15, 1.0])
    raised = metres(drawn(Person(chest=(0.0, 0.0, 1.3)), right_elbow=elbow))
    distance = np.linalg.norm(raised - elbow, axis=1)
    assert distance.min() < 0.055
    # The way from elbow to shoulder is covered; the other arm hangs.
    shoulder = np.array(SHOULDER) * [-1, 1, 1] + [0.0, 0.0, 1.3]
    for share in (0.25, 0.5, 0.75):
        middle = elbow + share * (shoulder - elbow)
        assert np.linalg.norm(raised - middle, axis=1).min() < 0.06
    assert np.percentile(raised[:, 0], 99) == pytest.approx(
        np.percentile(hanging[:, 0], 99), abs=0.02
    )


def test_clothes_are_uneven_by_what_was_asked_for(rng: np.random.Generator) -> None:
    folds = cloth_folds(CAMERA, rng, height=0.004, grain=0.03)
    assert folds.shape == CAMERA.shape and folds.dtype == np.float32
    assert 0.003 < folds.std() < 0.005
    assert np.abs(np.diff(folds, axis=1)).max() < 0.004, "no steps that could be edges"
