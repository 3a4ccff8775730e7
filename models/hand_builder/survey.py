"""Hand sizes of the population, and how they are measured on a subject.

Adults: hand length and hand breadth of U.S. Army personnel (1987-88 survey), Greiner, T. M. (1991),
"Hand anthropometry of U.S. Army personnel", NATICK/TR-92/011; the survey itself is Gordon et al.
(1989), NATICK/TR-89/044. Children: the adult sizes times the ratio of the median stature at their
age to that at 19 years, WHO growth reference 5-19 years (de Onis et al. 2007, Bull. WHO
85:660-667); a hand is close to a constant share of stature from ten years on.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hand_builder.subjects import HandSubject

Float = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class SizeStatistics:
    """Mean and standard deviation of hand length and breadth of one sex [m]."""

    length_mean: float
    length_deviation: float
    breadth_mean: float
    breadth_deviation: float


ADULTS: dict[str, SizeStatistics] = {
    "female": SizeStatistics(
        length_mean=0.1805, length_deviation=0.0097, breadth_mean=0.0794, breadth_deviation=0.0038
    ),
    "male": SizeStatistics(
        length_mean=0.1938, length_deviation=0.0098, breadth_mean=0.0904, breadth_deviation=0.0042
    ),
}
"""Greiner (1991), hand length and hand breadth."""

LENGTH_BREADTH_CORRELATION = 0.6
"""Between length and breadth within one sex; an assumption, not a figure of the report."""

EXACT_FROM = 50
"""Adults of one sex from which on the drawn sizes are corrected to the survey's statistics."""

STATURE_AGES = np.arange(10.0, 20.0)
STATURE: dict[str, Float] = {
    "female": np.array([138.6, 145.0, 151.2, 156.4, 159.8, 161.7, 162.5, 162.9, 163.1, 163.2]),
    "male": np.array([137.8, 143.1, 149.1, 156.0, 163.2, 169.0, 172.9, 175.2, 176.1, 176.5]),
}
"""Median stature [cm] at `STATURE_AGES` years (WHO 2007)."""


def growth(sex: str, age: float) -> float:
    """Size of a hand at an age in years relative to the same person as an adult."""
    return float(np.interp(age, STATURE_AGES, STATURE[sex]) / STATURE[sex][-1])


def draw_sizes(rng: np.random.Generator, sexes: list[str], ages: Float) -> Float:
    """Hand lengths and breadths of people.

    The adults of a sex, if there are at least `EXACT_FROM`, get exactly the survey's means,
    deviations and correlation.

    Args:
        rng: Source of the draw.
        sexes: "female" or "male" of each person.
        ages: Ages in years, shape (n,).

    Returns:
        Lengths and breadths [m], shape (n, 2).
    """
    normal = rng.standard_normal((len(sexes), 2))
    sizes = np.empty_like(normal)
    for sex, s in ADULTS.items():
        members = np.array([other == sex for other in sexes], dtype=bool)
        adults = members & (ages >= 18)
        if adults.sum() >= EXACT_FROM:
            centred = normal[adults] - normal[adults].mean(axis=0)
            spread = np.linalg.cholesky(np.cov(centred.T))
            normal[adults] = np.linalg.solve(spread, centred.T).T
        r = LENGTH_BREADTH_CORRELATION
        first, second = normal[members].T
        sizes[members, 0] = s.length_mean + s.length_deviation * first
        sizes[members, 1] = s.breadth_mean + s.breadth_deviation * (
            r * first + np.sqrt(1 - r * r) * second
        )
    factors = [growth(sex, age) for sex, age in zip(sexes, ages, strict=True)]
    return sizes * np.array(factors)[:, None]


@dataclass(frozen=True, slots=True, kw_only=True)
class Landmarks:
    """Vertices at the sides of the palm: heads of the second and fifth metacarpal."""

    radial: int
    ulnar: int

    def length(self, hand: HandSubject) -> float:
        """Hand length [m]: wrist to the tip of the straight middle finger."""
        joints = hand.keypoints[[0, 9, 10, 11, 12]]
        return float(np.linalg.norm(np.diff(joints, axis=0), axis=1).sum())

    def breadth(self, hand: HandSubject) -> float:
        """Hand breadth [m]: across the palm between the two landmarks."""
        return float(hand.vertices[self.radial, 2] - hand.vertices[self.ulnar, 2])


def find_landmarks(hand: HandSubject, thumb_weight: Float) -> Landmarks:
    """Outermost vertices beside the index and the little knuckle, thumb excluded."""

    def outermost(knuckle: int, sign: float) -> int:
        near = np.abs(hand.vertices[:, 0] - hand.keypoints[knuckle, 0]) < 0.004
        candidates = np.flatnonzero(near & (thumb_weight < 0.05))
        return int(candidates[np.argmax(sign * hand.vertices[candidates, 2])])

    return Landmarks(radial=outermost(5, 1.0), ulnar=outermost(17, -1.0))
