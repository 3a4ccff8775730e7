"""Puts the builder together: template, population, shape space, checks, artifact."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hand_builder import anatomy, population, skeleton
from hand_builder.anatomy import BONE_FACTORS
from hand_builder.artifact import artifact_arrays
from hand_builder.limits import LIMITS_DEGREES
from hand_builder.makehuman import Phenotype
from hand_builder.population import Population, Subject
from hand_builder.shape_space import (
    Encoding,
    LinearSpace,
    Template,
    decode,
    encode,
    make_template,
    principal_space,
    scale_weights,
)
from hand_builder.skeleton import template_skeleton
from hand_builder.subjects import CUT_ABOVE_WRIST, REFERENCE, HandSubject, SubjectMaker
from hand_builder.survey import ADULTS, LENGTH_BREADTH_CORRELATION, Landmarks, find_landmarks
from hand_builder.weights import bone_weights, smoothed, sparse_weights
from handtrack.hand.skeleton import NBONE

Float = NDArray[np.float64]

TEMPLATE: Phenotype = replace(
    REFERENCE,
    local=(
        ("hands/r-hand-fingers-length-decr", 0.36),
        ("hands/r-hand-fingers-distance-incr", 0.22),
    ),
)
"""The template: half-way between the sexes, with the mean adult's ratio of breadth to length."""

WEIGHT_SMOOTHING = 1
"""Rounds of averaging that the rig's weights get."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BuildConfig:
    """What decides the artifact, besides the source files and the code."""

    subjects: int = 1000
    """Subjects the shape space is learnt from."""
    seed: int = 1
    """Seed of their draw."""
    held_out: int = 100
    """Further subjects, drawn with the next seed, on which the shape space is checked."""
    share: float = 0.98
    """Share of the variance that the components have to explain."""

    def digest(self) -> str:
        """Hash of this configuration and of every constant of the builder that shapes the hand."""
        constants = [
            asdict(TEMPLATE), WEIGHT_SMOOTHING, CUT_ABOVE_WRIST, anatomy.keypoint_mixtures(),
            anatomy.BONE_FACTORS.tolist(), anatomy.TIP_DEPTH, skeleton.FINGER_ROLL.tolist(),
            skeleton.ZERO_AZIMUTH.tolist(), skeleton.THUMB_REST_ABDUCTION, LIMITS_DEGREES,
            population.CHILD_SHARE, population.CANDIDATES, population.FINGER_DEVIATION,
            population.BONE_DEVIATION, population.PALM_DEVIATION, population.BUILD_CORRELATION,
            [asdict(s) for s in ADULTS.values()], LENGTH_BREADTH_CORRELATION,
        ]  # fmt: skip
        text = json.dumps([asdict(self), constants], sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:16]


class HandBuilder:
    """Template and population; the shape space comes from `build`."""

    def __init__(self, wheel: Path | None = None) -> None:
        self.maker = SubjectMaker(wheel)
        topology = self.maker.topology
        rows = bone_weights(self.maker.rig_weights, topology.base_ids)
        dense = np.vstack([rows, np.eye(NBONE)[:1]])  # the cap's centre belongs to the palm
        dense = smoothed(dense, topology.faces, WEIGHT_SMOOTHING)
        weight_bones, weights = sparse_weights(dense)

        hand = self.maker.make(TEMPLATE)
        self.landmarks: Landmarks = find_landmarks(hand, dense[:, 1:4].sum(axis=1))
        mean_length = np.mean([s.length_mean for s in ADULTS.values()])
        hand = hand.scaled(float(mean_length / self.landmarks.length(hand)))
        hand = _with_bone_factors(hand, weight_bones, weights)
        self.template: Template = make_template(
            hand, template_skeleton(hand.keypoints), weight_bones, weights
        )
        self.population = Population(self.maker, self.template, self.landmarks, dense[:, 0])


def _with_bone_factors(
    hand: HandSubject, weight_bones: NDArray[np.int32], weights: Float
) -> HandSubject:
    """The hand with its bones lengthened by `BONE_FACTORS`."""
    template = make_template(hand, template_skeleton(hand.keypoints), weight_bones, weights)
    nothing = np.zeros((len(hand.vertices) + 5, 3))
    scales = np.concatenate([[1.0], BONE_FACTORS])
    return decode(template, scales, nothing, template.skeleton.rest_angles)


@dataclass(frozen=True, slots=True, kw_only=True)
class ShapeSpaces:
    """Shape space and what it is worth."""

    scales: LinearSpace
    offsets: LinearSpace
    report: dict[str, object]
    """Numbers for `models/README.md`."""


def learn(builder: HandBuilder, config: BuildConfig) -> ShapeSpaces:
    """Learns the shape space and measures it on subjects that took no part."""
    template = builder.template
    subjects = builder.population.draw(config.subjects, config.seed)
    codes = [encode(template, s.hand) for s in subjects]
    _check_exact(template, codes, subjects)
    scales = principal_space(
        np.array([c.scales for c in codes]), share=config.share, weights=scale_weights(template)
    )
    offsets = principal_space(np.array([c.offsets.ravel() for c in codes]), share=config.share)

    unseen = builder.population.draw(config.held_out, config.seed + 1)
    errors = np.array([_error(template, scales, offsets, s) for s in unseen])
    size_only = np.array(
        [_error(template, scales.truncated(1), offsets.truncated(0), s) for s in unseen]
    )
    report: dict[str, object] = {
        "components": {"alpha": scales.basis.shape[1], "beta": offsets.basis.shape[1]},
        "explained": {
            "alpha": round(float(scales.variance.sum()), 4),
            "beta": round(float(offsets.variance.sum()), 4),
        },
        "scale deviations": np.std([c.scales for c in codes], axis=0).round(3).tolist(),
        "held-out mean vertex distance [mm]": {
            "alpha and beta": round(1e3 * float(errors.mean()), 3),
            "worst subject": round(1e3 * float(errors.max()), 3),
            "one alpha only": round(1e3 * float(size_only.mean()), 3),
        },
        "sizes [mm]": size_table(subjects),
        "template lengths [mm]": (1e3 * template.lengths).round(1).tolist(),
    }
    return ShapeSpaces(scales=scales, offsets=offsets, report=report)


def build(builder: HandBuilder, spaces: ShapeSpaces, config: BuildConfig) -> dict[str, NDArray]:
    """Entries of `hand.npz`."""
    arrays = artifact_arrays(
        builder.template,
        builder.maker.topology.faces,
        builder.maker.topology.ring,
        spaces.scales,
        spaces.offsets,
        source=f"MakeHuman/MPFB2 assets (CC0) from {builder.maker.source}; see models/README.md",
        config_hash=config.digest(),
    )
    _check_template(builder.template, arrays)
    return arrays


def size_table(subjects: list[Subject]) -> dict[str, list[float]]:
    """Count, mean and deviation of length and breadth of the adults of each sex [mm]."""
    table = {}
    for sex in ADULTS:
        sizes = [
            (s.length, s.breadth) for s in subjects if s.person.sex == sex and s.person.age >= 18
        ]
        values = 1e3 * np.array(sizes)
        mean, deviation = values.mean(axis=0), values.std(axis=0, ddof=1)
        table[sex] = [len(sizes), *np.stack([mean, deviation], 1).ravel().round(1).tolist()]
    return table


def _error(
    template: Template, scales: LinearSpace, offsets: LinearSpace, subject: Subject
) -> float:
    """Mean vertex distance [m] between a subject and its projection on the shape space."""
    code = encode(template, subject.hand)
    alpha, beta = scales.project(code.scales), offsets.project(code.offsets.ravel())
    near_scales = scales.mean + scales.basis @ alpha
    near_offsets = (offsets.mean + offsets.basis @ beta).reshape(-1, 3)
    near = decode(template, near_scales, near_offsets, code.angles)
    return float(np.linalg.norm(near.vertices - subject.hand.vertices, axis=1).mean())


def _check_exact(template: Template, codes: list[Encoding], subjects: list[Subject]) -> None:
    """Every tenth subject must come back exactly from its code."""
    for code, subject in zip(codes[::10], subjects[::10], strict=True):
        back = decode(template, code.scales, code.offsets, code.angles)
        miss = float(np.abs(back.vertices - subject.hand.vertices).max())
        if miss > 1e-9:
            raise ValueError(f"Eq. II.9 misses a subject by {miss} m; encode and decode disagree")


def _check_template(template: Template, arrays: dict[str, NDArray]) -> None:
    """The template at its rest angles with identity shape must be the stored vertices."""
    count = len(template.vertices)
    back = decode(template, np.ones(NBONE + 1), np.zeros((count + 5, 3)), arrays["rest_angles"])
    miss = float(np.abs(back.vertices - arrays["vertices"]).max())
    if miss > 1e-7:  # float32 rounding of values up to 0.2 m
        raise ValueError(f"Eq. II.9 misses the template by {miss} m")
    low, high = arrays["limits"].T
    for name, angles in (("rest", arrays["rest_angles"]), ("zero", np.zeros(len(low)))):
        if (angles < low).any() or (angles > high).any():
            raise ValueError(f"the {name} pose lies outside the joint limits")
