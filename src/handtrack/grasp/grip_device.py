"""A hand and its grip modes on a device: all that a search for grasps needs but the object."""

from __future__ import annotations

import os
from collections.abc import Sequence

import numpy as np
import warp as wp

from handtrack.device import resolve_device
from handtrack.errors import InputError
from handtrack.grasp.device_models import DeviceModels
from handtrack.grasp.motion_model import GripModel
from handtrack.grasp.score_batch import ScoreBatch
from handtrack.grasp.skin_points import SkinPoints
from handtrack.grasp.taxonomy import GripPads, grip_pads
from handtrack.hand.device_hand import DeviceHand
from handtrack.hand.model import ShapedHand


class GripDevice:
    """Uploads once what every search needs, and lends the arrays that searches work in."""

    def __init__(
        self,
        hand: ShapedHand,
        models: Sequence[GripModel],
        *,
        skin_points: int = 320,
        threads: int | None = None,
        device: str | None = None,
    ) -> None:
        """Upload.

        Args:
            hand: A right hand.
            models: Motion models of the grip modes.
            skin_points: Points of the skin that are tested for collision.
            threads: Host threads that a search is shared among; one for each core by default. A GPU
                needs one only.
            device: "cpu", "cuda:N" or None for the best there is.

        Raises:
            InputError: There are no grip modes, no skin points, or no threads.
        """
        if skin_points < 1:
            raise InputError(f"skin_points is {skin_points}; expected at least 1")
        if threads is None:
            threads = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 1
        if threads < 1:
            raise InputError(f"threads is {threads}; expected at least 1")
        self.device = resolve_device(device)
        self.threads = 1 if self.device.is_cuda else threads
        self.hand, self.models = hand, tuple(models)
        self.motions = DeviceModels.upload(self.models, self.device)
        self.pads = tuple(grip_pads(hand, model.grip) for model in self.models)
        self.bones = DeviceHand.upload([hand], self.device)
        self.skin = _skin_arrays(SkinPoints.of(hand, skin_points), self.device)
        self.ncontact = max(len(pads.bones) for pads in self.pads)
        self.contacts = _contact_arrays(self.pads, self.device)
        self._free: dict[tuple[int, int], list[ScoreBatch]] = {}

    def number(self, grip: str) -> int:
        """Number of a grip mode.

        Raises:
            InputError: It is not among the models.
        """
        names = [model.grip for model in self.models]
        if grip not in names:
            raise InputError(f"no grip {grip!r} on the device; there are {', '.join(names)}")
        return names.index(grip)

    def borrow(self, count: int, nframe: int) -> ScoreBatch:
        """Arrays for so many motions of so many frames, of which nobody else has hold."""
        try:
            return self._free.setdefault((count, nframe), []).pop()
        except IndexError:
            return ScoreBatch(self, count, nframe)

    def give_back(self, batch: ScoreBatch) -> None:
        """Let others borrow a batch."""
        self._free.setdefault((batch.count, batch.nframe), []).append(batch)


def _skin_arrays(
    skin: SkinPoints, device: wp.Device
) -> tuple[wp.array, wp.array, wp.array, wp.array, wp.array]:
    """Skin as `kernels.grasp_score.measure_overlaps` takes it."""
    return (
        wp.array(skin.group_bones.astype(np.int32), dtype=int, device=device),
        wp.array(skin.group_starts.astype(np.int32), dtype=int, device=device),
        wp.array(skin.group_centres.astype(np.float32), dtype=wp.vec3, device=device),
        wp.array(skin.group_radii.astype(np.float32), dtype=float, device=device),
        wp.array(skin.points.offsets.astype(np.float32), dtype=wp.vec3, device=device),
    )


def _contact_arrays(
    grips: Sequence[GripPads], device: wp.Device
) -> tuple[wp.array, wp.array, wp.array, wp.array]:
    """Contacts as `kernels.grasp_score.score_contacts` takes them."""
    shape = (len(grips), max(len(grip.bones) for grip in grips))
    bones = np.full(shape, -1, np.int32)
    points, normals = np.zeros((2, *shape, 3), np.float32)
    pairs = np.full((len(grips), max(len(g.pairs) for g in grips), 2), -1, np.int32)
    for k, grip in enumerate(grips):
        count = len(grip.bones)
        bones[k, :count], points[k, :count] = grip.bones, grip.points
        normals[k, :count], pairs[k, : len(grip.pairs)] = grip.normals, grip.pairs
    return (
        wp.array(bones, dtype=int, device=device),
        wp.array(points, dtype=wp.vec3, device=device),
        wp.array(normals, dtype=wp.vec3, device=device),
        wp.array(pairs, dtype=int, device=device),
    )
