"""Arrays in which motions are scored on a device, and the order of the kernels that do it."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from handtrack.device import FrameGraph
from handtrack.hand.skeleton import NANGLE, NBONE, NQ
from handtrack.kernels.grasp_motion import NPLACE, Placing, decode_particles, decode_rows
from handtrack.kernels.grasp_score import (
    GraspTask,
    measure_overlaps,
    score_contacts,
    weigh_contacts,
    weigh_overlaps,
)
from handtrack.kernels.kinematics import pose_bones

if TYPE_CHECKING:
    from handtrack.grasp.grip_device import GripDevice

Float = NDArray[np.float64]

STAGES = (0, 1, 3)
"""Frames, from the last one back, from which on only particles that may still be good are scored:
collisions are in the last frames most, and a GPU scores many frames as fast as one."""


class ScoreBatch:
    """Scores so many motions of so many frames at a time."""

    def __init__(self, grips: GripDevice, count: int, nframe: int) -> None:
        """Allocate.

        Args:
            grips: The hand and its grip modes.
            count: Number of motions.
            nframe: Frames of each; for coordinates at least two.
        """
        self.count, self.nframe, self._grips = count, nframe, grips
        edges = (*(first for first in STAGES if first < nframe), nframe)
        self._stages = list(pairwise(edges))
        rows = count * nframe

        def make(shape: tuple[int, ...] | int, dtype: Any) -> wp.array:
            return wp.zeros(shape, dtype=dtype, device=grips.device)

        self._kept: Any = None  # arrays that structs in arrays point to
        self._tasks, self._placings = make(1, GraspTask), make(1, Placing)
        self._positions = make((count, grips.motions.nweight + int(NPLACE)), float)
        self._bounds, self._grip_numbers = make(count, float), make(count, int)
        self._warps = make((count, grips.motions.nref), float)
        self._lows, self._parts = make((nframe, count), int), make((nframe, count), float)
        self._turns, self._shifts = make(count, wp.vec4), make(count, wp.vec3)
        self._bases, self._densities = make(count, wp.vec4), make(count, float)
        self._row_hand, self._pose = make(rows, int), make((rows, NQ), float)
        self._rotations = make((rows, NBONE), wp.mat33)
        self._origins = make((rows, NBONE), wp.vec3)
        self._axes = make((rows, NANGLE), wp.vec3)
        self._depths = make(rows, float)
        self._points = make((count, grips.ncontact), wp.vec3)
        self._normals = make((count, grips.ncontact), wp.vec3)
        self._scores, self._terms = make((count, 5), float), make((count, 4), float)
        self._totals, self._limits = make(count, float), make(count, float)
        self._graph = FrameGraph(self._launch_search, grips.device)

    # What is scored

    def bind(self, task: Any, grips: NDArray[np.intp], placing: Any = None) -> None:
        """Choose the object.

        Args:
            task: The `GraspTask`.
            grips: Number of each motion's grip mode, shape (count,).
            placing: The `Placing` of coordinates; None where motions are scored.
        """
        self._kept = task
        self._tasks.assign([task])
        self._grip_numbers.assign(grips.astype(np.int32))
        if placing is not None:
            self._placings.assign([placing])
            if not self._graph.replays:
                # The first run, which captures, must not meet launches from other threads.
                self._graph()

    def search(self, positions: Float, bounds: Float) -> Float:
        """Costs of coordinates without the control term, shape (count,).

        Args:
            positions: Weights of the motion model and placements, shape (count, ndim).
            bounds: A cost that is no lower than its bound may come out as inf, shape (count,).
        """
        self._positions.assign(positions.astype(np.float32))
        self._bounds.assign(bounds.astype(np.float32))
        self._graph()
        return self._totals.numpy().astype(np.float64)

    def score(self, motions: Float, densities: Float) -> None:
        """Score given motions, shape (count, nframe, 28), of given log densities, (count,)."""
        rows = np.ascontiguousarray(np.swapaxes(motions[:, ::-1], 0, 1), np.float32)
        self._pose.assign(rows.reshape(-1, NQ))
        self._densities.assign(densities.astype(np.float32))
        self._bounds.fill_(np.inf)
        for stage in self._stages:
            self._launch_stage(*stage)

    # What came out

    @property
    def terms(self) -> Float:
        """Terms prior, collision, contact and quality, shape (count, 4)."""
        return self._terms.numpy().astype(np.float64)

    @property
    def points(self) -> Float:
        """Contacts on the surface [m], shape (count, ncontact, 3)."""
        return self._points.numpy().astype(np.float64)

    @property
    def normals(self) -> Float:
        """Outward normals there, shape (count, ncontact, 3)."""
        return self._normals.numpy().astype(np.float64)

    @property
    def depths(self) -> Float:
        """Deepest overlap in each frame [m], shape (count, nframe)."""
        return self._depths.numpy().astype(np.float64).reshape(self.nframe, self.count)[::-1].T

    @property
    def grasping(self) -> Float:
        """Grasping poses, object's frame, shape (count, 28)."""
        return _part(self._pose, slice(self.count)).numpy().astype(np.float64)

    # Launches

    def _launch_search(self) -> None:
        motions = self._grips.motions
        decode_particles(
            motions.counts, motions.bases, motions.times, motions.log_shares, motions.means,
            motions.whiteners, self._placings, self._positions, self._grip_numbers,
            warps=self._warps, lows=self._lows, parts=self._parts, turns=self._turns,
            shifts=self._shifts, placed_bases=self._bases, densities=self._densities,
        )  # fmt: skip
        for begin, end in self._stages:
            frames, rows = slice(begin, end), slice(begin * self.count, end * self.count)
            decode_rows(
                motions.counts, motions.shapes, _part(self._row_hand, rows), self._positions,
                self._grip_numbers, _part(self._lows, frames), _part(self._parts, frames),
                self._turns, self._shifts, self._bases, pose=_part(self._pose, rows),
            )  # fmt: skip
            self._launch_stage(begin, end)

    def _launch_stage(self, begin: int, end: int) -> None:
        """Score some frames, from the last one back."""
        bones, grips = self._grips.bones, self._grips
        rows = slice(begin * self.count, end * self.count)
        row_hand, rotations, origins = (
            _part(array, rows) for array in (self._row_hand, self._rotations, self._origins)
        )
        pose_bones(
            bones.bone_rotations, bones.bone_origins, bones.bone_parents, bones.bone_angles,
            bones.angle_axes, row_hand, _part(self._pose, rows), rotations=rotations,
            origins=origins, axes=_part(self._axes, rows),
        )  # fmt: skip
        if begin == 0:
            score_contacts(
                *grips.contacts, self._tasks, self._grip_numbers, rotations, origins,
                points=self._points, normals=self._normals, scores=self._scores,
            )  # fmt: skip
            weigh_contacts(
                self._tasks, self._densities, self._scores, self._bounds, self.nframe,
                terms=self._terms, limits=self._limits,
            )  # fmt: skip
        measure_overlaps(
            *grips.skin, self._tasks, self._limits, row_hand, rotations, origins,
            depths=_part(self._depths, rows),
        )  # fmt: skip
        weigh_overlaps(
            self._tasks, self._bounds, self._depths, (begin, end), self.nframe,
            terms=self._terms, totals=self._totals, limits=self._limits, row_hand=self._row_hand,
        )  # fmt: skip


def _part(array: wp.array, rows: slice) -> Any:
    """Some rows of an array, in its own memory."""
    return array[rows]
