"""One subject: bone scales, vertex offsets and the poses of all its scans, weights fixed.

Each step looks up the correspondences, then solves for bones and poses together (Gauss-Newton), and
then for the offsets (a sparse linear system). First half of the alternation of Eq. II.10.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import bsr_array, csc_array, eye_array, kron
from scipy.sparse.linalg import splu

from handtrack.hand.learning.alignment import first_pose
from handtrack.hand.learning.correspondence import Matches, ScanSurface
from handtrack.hand.learning.options import LearningOptions
from handtrack.hand.learning.posed_template import PosedTemplate, SubjectShape, Template
from handtrack.hand.learning.scans import Scan
from handtrack.hand.skeleton import NBONE, NV
from handtrack.transforms import apply_increment

Float = NDArray[np.float64]

_NSHAPE = NBONE + 15
"""Unknowns of the bones: stretches and base joints."""
_ASTRAY = 1.3
"""A scan whose residual is so many times the median of its subject's is not trusted."""
_LONGEST_STEP = 0.35
"""Largest change of a joint angle in one step [rad]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PopulationMean:
    """What subjects have in common: their priors are centred here."""

    scales: Float
    """Bone scales s_j, shape (16,)."""
    joints: Float
    """Offsets of the base joints [m], shape (5, 3)."""
    offsets: Float
    """Offsets of the vertices [m], shape (nvert, 3)."""

    @classmethod
    def of(cls, template: Template, shapes: Sequence[SubjectShape]) -> PopulationMean:
        """Mean of subjects."""
        return cls(
            scales=np.mean([template.scales(shape)[1:] for shape in shapes], axis=0),
            joints=np.mean([shape.joints for shape in shapes], axis=0),
            offsets=np.mean([shape.offsets for shape in shapes], axis=0),
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class SubjectFit:
    """What is known about a subject."""

    shape: SubjectShape
    poses: Float
    """Poses of its scans, shape (nscan, 28)."""
    residuals: tuple[float, ...] = ()
    """Mean distance of the vertices from their matches [m] before each step so far, and at the
    end."""
    scan_residuals: tuple[float, ...] = ()
    """The same for each scan, at the end."""
    matched: float = 0.0
    """Share of the vertices that have a match."""

    @property
    def astray(self) -> NDArray[np.bool_]:
        """Scans that are met much worse than the subject's others, shape (nscan,)."""
        left = np.array(self.scan_residuals)
        return np.asarray(left > _ASTRAY * np.median(left))


def neighbour_laplacian(faces: NDArray) -> csc_array:
    """Matrix whose quadratic form sums squared differences along edges, shape (nvert, nvert)."""
    edges = np.unique(np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0)
    count = int(faces.max()) + 1
    ones = np.ones(len(edges))
    beside = csc_array((ones, (edges[:, 0], edges[:, 1])), shape=(count, count))
    beside = beside + beside.T
    degree = np.asarray(beside.sum(axis=1)).ravel()
    return csc_array((degree, (np.arange(count), np.arange(count))), shape=(count, count)) - beside


def start_subject(template: Template, scans: Sequence[Scan], angles: Float) -> SubjectFit:
    """The template, in the subject's size, laid on its scans.

    Args:
        template: The template.
        scans: Scans of one subject.
        angles: Angles that it was asked for in each [rad], shape (nscan, 21).
    """
    plain = template.shape()
    found = [
        first_pose(template, plain, scan, asked) for scan, asked in zip(scans, angles, strict=True)
    ]
    size = float(np.median([size for _, size in found]))
    return SubjectFit(shape=template.shape(size), poses=np.stack([pose for pose, _ in found]))


class SubjectFitter:
    """Improves what is known about one subject."""

    def __init__(
        self,
        template: Template,
        scans: Sequence[Scan],
        angles: Float,
        mean: PopulationMean,
        options: LearningOptions,
    ) -> None:
        self._template = template
        self._surfaces = [ScanSurface(scan) for scan in scans]
        self._angles = angles
        self._mean = mean
        self._options = options
        # Registered scans are exact, others only as good as their correspondences.
        self._precision = np.array(
            [1.0 / (options.exact_std if s.registered else options.data_std) ** 2 for s in scans]
        )
        smooth = neighbour_laplacian(template.model.faces) / options.bend_std**2
        smooth = smooth + eye_array(len(template.model.vertices)) / options.offset_std**2
        self._offset_prior = csc_array(kron(smooth, eye_array(3)))

    def begin(self, fit: SubjectFit) -> SubjectFit:
        """Bones and poses of a subject whose offsets are still the population's.

        A scan that is met much worse than the subject's others has two fingers in one, or so. It
        is laid anew, this time with the subject's own proportions, and the better result is kept.
        """
        fit = self._approach(fit)
        astray = np.flatnonzero(fit.astray)
        if not len(astray):
            return fit
        poses = fit.poses.copy()
        for index in astray:
            poses[index], _ = first_pose(
                self._template, fit.shape, self._surfaces[index].scan, self._angles[index]
            )
        again = self._approach(replace(fit, poses=poses, residuals=()))
        better = np.mean(again.scan_residuals) < np.mean(fit.scan_residuals)
        return again if better else fit

    def _approach(self, fit: SubjectFit) -> SubjectFit:
        """Steps with a falling reach."""
        far, near = self._options.reach
        reaches = np.geomspace(far, near, self._options.first_steps)
        for step, reach in enumerate(reaches):
            posed = PosedTemplate(self._template, fit.shape, fit.poses)
            matches = self._match(posed, float(reach))
            fit = self._note(fit, posed, matches)
            back = self._match_back(posed, float(reach))
            # Base joints stay until the fingers lie in their scans.
            late = step >= len(reaches) // 2
            fit = self._move_bones(fit, posed, [matches, back], joints=late)
        posed = PosedTemplate(self._template, fit.shape, fit.poses)
        return self._note(fit, posed, self._match(posed, near))

    def improve(self, fit: SubjectFit, steps: int) -> SubjectFit:
        """Bones, poses and offsets."""
        for step in range(steps + 1):
            posed = PosedTemplate(self._template, fit.shape, fit.poses)
            matches = self._match(posed, self._options.reach[1])
            fit = self._note(fit, posed, matches)
            if step < steps:
                fit = self._move_bones(fit, posed, [matches], joints=True)
                fit = self._move_offsets(fit, matches)
        return fit

    def weight_terms(self, fit: SubjectFit, bones: NDArray[np.intp]) -> Float:
        """What this subject says about the skinning weights.

        Args:
            fit: The subject.
            bones: Bones to consider for each vertex, shape (nvert, n).

        Returns:
            Quadratic forms of the weights, which sum to one: w G w is the squared residual in
            standard deviations, shape (nvert, n, n).
        """
        posed = PosedTemplate(self._template, fit.shape, fit.poses)
        matches = self._match(posed, self._options.reach[1])
        forms = np.zeros((len(bones), bones.shape[1], bones.shape[1]))
        for index, placed in enumerate(posed.by_weights(bones)):
            if fit.astray[index]:
                continue
            away = placed - matches[index].targets[:, None]
            pulled = away @ matches[index].metric()
            forms += self._precision[index] * (pulled @ np.swapaxes(away, 1, 2))
        return forms

    def _match(self, posed: PosedTemplate, reach: float) -> list[Matches]:
        return [
            surface.match(vertices, normals, reach=reach)
            for surface, vertices, normals in zip(
                self._surfaces, posed.vertices, posed.normals, strict=True
            )
        ]

    def _match_back(self, posed: PosedTemplate, reach: float) -> list[Matches]:
        return [
            surface.match_back(vertices, normals, self._template.stub, reach=reach)
            for surface, vertices, normals in zip(
                self._surfaces, posed.vertices, posed.normals, strict=True
            )
        ]

    def _note(
        self, fit: SubjectFit, posed: PosedTemplate, matches: Sequence[Matches]
    ) -> SubjectFit:
        """The same fit with its residuals: distances from matched planes, or exact points."""
        residuals = []
        for vertices, found in zip(posed.vertices, matches, strict=True):
            distances = found.distances(vertices)
            residuals.append(float(distances.mean()) if len(distances) else np.inf)
        return replace(
            fit,
            residuals=(*fit.residuals, float(np.mean(residuals))),
            scan_residuals=tuple(residuals),
            matched=float(np.mean([(found.weights > 0).mean() for found in matches])),
        )

    def _move_bones(
        self,
        fit: SubjectFit,
        posed: PosedTemplate,
        families: Sequence[Sequence[Matches]],
        *,
        joints: bool,
    ) -> SubjectFit:
        """One Gauss-Newton step for stretches, base joints and poses; matches of all scans."""
        options, nscan = self._options, len(fit.poses)
        by_pose = posed.by_pose()
        by_bones = np.concatenate([posed.by_stretches(), posed.by_joints()], axis=3)
        system = np.zeros((_NSHAPE + NV * nscan,) * 2)
        slope = np.zeros(len(system))
        for index in range(nscan):
            own = slice(_NSHAPE + NV * index, _NSHAPE + NV * (index + 1))
            columns = np.r_[0:_NSHAPE, own]
            jacobian = np.concatenate([by_bones[index], by_pose[index]], axis=2)
            for matches in families:
                rows, away = matches[index].rows(jacobian, posed.vertices[index])
                system[np.ix_(columns, columns)] += self._precision[index] * (rows.T @ rows)
                slope[columns] += self._precision[index] * (away @ rows)
            self._add_angle_prior(system[own, own], slope[own], fit.poses[index], index)

        lengths = self._template.lengths
        spread = np.eye(NBONE) - np.outer(self._mean.scales, lengths / lengths.sum())
        spread /= options.scale_std * self._template.overall(fit.shape)
        system[:NBONE, :NBONE] += spread.T @ spread
        slope[:NBONE] += spread.T @ spread @ fit.shape.stretches
        at = np.arange(NBONE, _NSHAPE)
        system[at, at] += 1.0 / (options.joint_std if joints else 1e-6) ** 2
        slope[at] += (fit.shape.joints - self._mean.joints).ravel() / options.joint_std**2 * joints

        system[np.diag_indices(len(system))] *= 1.0 + 1e-6
        step = -np.linalg.solve(system, slope)
        moves = step[_NSHAPE:].reshape(nscan, NV)
        longest = np.abs(moves[:, 3:]).max()
        shorten = min(1.0, _LONGEST_STEP / max(float(longest), 1e-12))
        shape = replace(
            fit.shape,
            stretches=np.clip(fit.shape.stretches + shorten * step[:NBONE], 0.4, 2.5),
            joints=fit.shape.joints + shorten * step[NBONE:_NSHAPE].reshape(5, 3),
        )
        return replace(fit, shape=shape, poses=apply_increment(fit.poses, shorten * moves))

    def _add_angle_prior(self, system: Float, slope: Float, pose: Float, index: int) -> None:
        """Add, in place, that angles are near what was asked for, and inside their limits."""
        low, high = self._template.model.limits.T
        at = np.arange(6, NV)
        over = np.minimum(pose[7:] - low, 0.0) + np.maximum(pose[7:] - high, 0.0)
        system[at, at] += 1.0 / self._options.angle_std**2
        slope[at] += (pose[7:] - self._angles[index]) / self._options.angle_std**2
        system[at, at] += (over != 0) / self._options.limit_std**2
        slope[at] += over / self._options.limit_std**2

    def _move_offsets(self, fit: SubjectFit, matches: Sequence[Matches]) -> SubjectFit:
        """Offsets that suit all scans, bones and poses fixed: one sparse linear system."""
        posed = PosedTemplate(self._template, fit.shape, fit.poses)
        blocks = np.zeros((len(fit.shape.offsets), 3, 3))
        pull = np.zeros_like(fit.shape.offsets)
        for index, (push, found) in enumerate(zip(posed.by_offsets(), matches, strict=True)):
            pulled = self._precision[index] * np.swapaxes(push, 1, 2) @ found.metric()
            blocks += pulled @ push
            away = posed.vertices[index] - found.targets
            pull += (pulled @ away[..., None])[..., 0]
        count = np.arange(len(blocks) + 1)
        data = bsr_array((blocks, count[:-1], count), shape=(3 * len(blocks),) * 2)
        departure = (fit.shape.offsets - self._mean.offsets).ravel()
        slope = pull.ravel() + self._offset_prior @ departure
        factors = splu(
            csc_array(data + self._offset_prior),
            permc_spec="MMD_AT_PLUS_A",
            options={"SymmetricMode": True},
            diag_pivot_thresh=0.0,
        )
        offsets = fit.shape.offsets - factors.solve(slope).reshape(-1, 3)
        return replace(fit, shape=replace(fit.shape, offsets=offsets))
