"""Spheres inside the fingers on a device, for the self-collision term."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp
from numpy.typing import NDArray

from handtrack.hand.model import ShapedHand
from handtrack.hand.skeleton import finger_of_bone
from handtrack.hand.spheres import finger_spheres

Float = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class CollisionSpheres:
    """Spheres of one or several hands on a device."""

    bones: wp.array
    """Bone of each sphere, shape (nsphere,)."""
    centres: wp.array
    """Centres in the bones' frames [m], shape (nhand, nsphere) vec3."""
    radii: wp.array
    """Radii [m], shape (nhand, nsphere)."""
    pairs: wp.array
    """Spheres of different fingers, which may not overlap, shape (npair, 2)."""

    @property
    def count(self) -> int:
        """Number of spheres per hand."""
        return self.bones.shape[0]

    def resize(self, hands: Sequence[ShapedHand]) -> None:
        """Overwrite centres and radii, in place, with those of hands of other shapes."""
        fitted = [_latest.spheres(hand) for hand in hands]
        self.centres.assign(np.stack([centres for _, centres, _ in fitted]).astype(np.float32))
        self.radii.assign(np.stack([radii for *_, radii in fitted]).astype(np.float32))

    @classmethod
    def build(cls, hands: Sequence[ShapedHand], device: wp.Device) -> CollisionSpheres:
        """Fit spheres to each hand's skin, centred in the flesh along every finger bone."""
        fitted = [_latest.spheres(hand) for hand in hands]
        bones = fitted[0][0]
        fingers = np.array([finger_of_bone(int(b)) for b in bones])
        first, second = np.triu_indices(len(bones), 1)
        apart = fingers[first] != fingers[second]
        # The metacarpal of the thumb lies in the palm's flesh beside the index' root.
        rooted = (bones[first] == 1) | (bones[second] == 1)
        pairs = np.stack([first, second], 1)[apart & ~rooted]
        return cls(
            bones=wp.array(bones.astype(np.int32), dtype=int, device=device),
            centres=wp.array(
                np.stack([centres for _, centres, _ in fitted]).astype(np.float32),
                dtype=wp.vec3,
                device=device,
            ),
            radii=wp.array(
                np.stack([radii for *_, radii in fitted]).astype(np.float32),
                dtype=float,
                device=device,
            ),
            pairs=wp.array(pairs.astype(np.int32), dtype=int, device=device),
        )


class _Latest:
    """Spheres of the latest hand: it stands for many images, and in many fitters at once."""

    def __init__(self) -> None:
        self._known: tuple[ShapedHand, tuple[NDArray[np.intp], Float, Float]] | None = None

    def spheres(self, hand: ShapedHand) -> tuple[NDArray[np.intp], Float, Float]:
        """As `finger_spheres`."""
        known = self._known
        if known is None or known[0] is not hand:
            known = (hand, finger_spheres(hand))
            self._known = known
        return known[1]


_latest = _Latest()
