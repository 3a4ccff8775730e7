"""A population of MakeHuman hands whose sizes follow a survey; draws unseen subjects too.

MakeHuman itself changes a hand little but in size: its macro targets for weight and muscle stop at
the wrist. Thickness, finger length and spacing come from its hand targets. Two things it does not
vary at all are added on top: the proportions of the bones and the thickness of the palm.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hand_builder.anatomy import BONE_FACTORS
from hand_builder.makehuman import Phenotype
from hand_builder.shape_space import Template, decode, encode
from hand_builder.subjects import HandSubject, SubjectMaker
from hand_builder.survey import Landmarks, draw_sizes
from handtrack.hand.skeleton import NBONE

Float = NDArray[np.float64]

CHILD_SHARE = 0.2
"""Share of the population aged 10 to 17; the others are 18 to 80."""

CANDIDATES = 16
"""Candidates per subject, of whom the one with the wanted ratio of breadth to length is taken."""

FINGER_DEVIATION = 0.02
"""Standard deviation of a finger's length relative to the hand's, beyond MakeHuman's own."""

BONE_DEVIATION = 0.03
"""Standard deviation of one bone's share in its finger."""

PALM_DEVIATION = 0.07
"""Standard deviation of the palm's relative thickness."""

BUILD_CORRELATION = 0.6
"""Correlation of the palm's thickness with the thickness of the fingers."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Person:
    """Everything that was drawn about one subject."""

    sex: str
    age: float
    """Years."""
    phenotype: Phenotype
    bone_factors: Float
    """Factor of each bone's length, shape (16,)."""
    palm_thickness: float
    """Factor of the palm's thickness."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Subject:
    """One subject of the population."""

    person: Person
    hand: HandSubject
    length: float
    """Hand length [m]."""
    breadth: float
    """Hand breadth [m]."""


def draw_person(rng: np.random.Generator, sex: str, age: float) -> Person:
    """Draws the shape of one person; the size follows later."""

    def slider(deviation: float) -> float:
        return float(np.clip(rng.normal(0.5, deviation), 0.0, 1.0))

    male = sex == "male"
    # Means that bring MakeHuman's slender hands to the survey's breadth.
    finger_length = float(np.clip(rng.normal(-0.5 if male else -0.2, 0.45), -1.0, 1.0))
    if finger_length > 0:
        finger_length *= 0.4  # the lengthening target is about 2.5 times as strong
    spacing = float(np.clip(rng.normal(0.35 if male else 0.1, 0.7), -1.0, 1.0))
    build = float(rng.standard_normal())
    palm_build = (
        BUILD_CORRELATION * build + np.sqrt(1 - BUILD_CORRELATION**2) * rng.standard_normal()
    )
    diameter = float(np.clip(0.45 * build, -1.0, 1.0))
    sliders = (
        ("hands/r-hand-fingers-length", finger_length),
        ("hands/r-hand-fingers-diameter", diameter),
        ("hands/r-hand-fingers-distance", spacing),
        ("arms/r-lowerarm-scale-depth", float(np.clip(0.3 * palm_build, -1, 1))),
        ("arms/r-lowerarm-scale-horiz", float(np.clip(rng.normal(0.0, 0.3), -1, 1))),
    )
    local = tuple((f"{name}-{'incr' if x > 0 else 'decr'}", abs(x)) for name, x in sliders)
    maturity = np.interp(age, [10.0, 18.0, 25.0, 90.0], [0.1875, 0.45, 0.5, 1.0])
    blur = abs(rng.normal(0.0, 0.08))
    fingers = 1.0 + FINGER_DEVIATION * rng.standard_normal(5)
    bones = 1.0 + BONE_DEVIATION * rng.standard_normal(NBONE)
    bones[1:] *= np.repeat(fingers, 3)
    bones[0] = 1.0
    bones *= BONE_FACTORS
    return Person(
        sex=sex,
        age=age,
        phenotype=Phenotype(
            gender=float(1.0 - blur if male else blur),
            age=float(maturity),
            muscle=slider(0.2),
            weight=slider(0.2),
            height=slider(0.12),
            proportions=slider(0.2),
            race=tuple(rng.dirichlet([1.0, 1.0, 1.0])),
            local=local,
        ),
        bone_factors=bones,
        palm_thickness=float(np.clip(1.0 + PALM_DEVIATION * palm_build, 0.8, 1.25)),
    )


class Population:
    """Draws subjects."""

    def __init__(
        self, maker: SubjectMaker, template: Template, landmarks: Landmarks, palm_weight: Float
    ) -> None:
        self._maker = maker
        self._template = template
        self._landmarks = landmarks
        self._palm_weight = palm_weight

    def draw(self, count: int, seed: int) -> list[Subject]:
        """Draws subjects of both sexes from 10 to 80 years.

        Args:
            count: Number of subjects.
            seed: Seed of the draw; another seed gives other subjects.

        Returns:
            Subjects in random order.
        """
        rng = np.random.default_rng(seed)
        sexes = ["male" if male else "female" for male in rng.random(count) < 0.5]
        child = rng.random(count) < CHILD_SHARE
        ages = np.where(child, rng.uniform(10, 18, count), rng.uniform(18, 80, count))
        subjects = []
        for sex, age, size in zip(sexes, ages, draw_sizes(rng, sexes, ages), strict=True):
            candidate = self._best(rng, sex, float(age), ratio=size[1] / size[0])
            subjects.append(_resized(candidate, *size))
        return subjects

    def _best(self, rng: np.random.Generator, sex: str, age: float, ratio: float) -> Subject:
        """The candidate whose breadth to length comes nearest to `ratio`."""
        best, best_miss = None, np.inf
        for _ in range(CANDIDATES):
            person = draw_person(rng, sex, age)
            hand = self._maker.make(person.phenotype)
            segments = np.linalg.norm(np.diff(hand.keypoints[[0, 9, 10, 11, 12]], axis=0), axis=1)
            length = float(segments @ person.bone_factors[[0, 7, 8, 9]])
            miss = abs(self._landmarks.breadth(hand) / length - ratio)
            if miss < best_miss:
                best, best_miss = (person, hand), miss
        assert best is not None
        return self._adjusted(*best)

    def _adjusted(self, person: Person, hand: HandSubject) -> Subject:
        """Applies the bone factors and the palm's thickness of a person."""
        hand = self._with_palm_thickness(hand, person.palm_thickness)
        code = encode(self._template, hand)
        scales = code.scales.copy()
        scales[1:] *= person.bone_factors
        hand = decode(self._template, scales, code.offsets, code.angles)
        return Subject(
            person=person,
            hand=hand,
            length=self._landmarks.length(hand),
            breadth=self._landmarks.breadth(hand),
        )

    def _with_palm_thickness(self, hand: HandSubject, factor: float) -> HandSubject:
        """Scales the palm's depth about the level of the wrist, fading out into the fingers."""
        vertices = hand.vertices.copy()
        vertices[:, 1] *= 1.0 + (factor - 1.0) * self._palm_weight
        return HandSubject(vertices=vertices, keypoints=hand.keypoints)


def _resized(subject: Subject, length: float, breadth: float) -> Subject:
    """Scales a subject so that length times breadth is as wanted, which shares out the miss."""
    factor = float(np.sqrt(length * breadth / (subject.length * subject.breadth)))
    return replace(
        subject,
        hand=subject.hand.scaled(factor),
        length=subject.length * factor,
        breadth=subject.breadth * factor,
    )
