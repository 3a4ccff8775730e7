"""Ten grip modes after the GRASP taxonomy (Feix et al. 2016): what touches, opposes and closes.

A grip mode is independent of hand and object: it names pads of skin, pairs of pads that press
against each other, and hand postures before and after closing. `grip_pads` finds the pads on the
skin of one person's hand.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from handtrack.errors import InputError
from handtrack.hand.model import ShapedHand
from handtrack.hand.skeleton import ANGLES, BONES, FINGERS, NANGLE

Float = NDArray[np.float64]

PAD_WIDTH = 0.003
"""Standard deviation of the patch of skin that is averaged to one pad [m]."""

DIP_SHARE = 2.0 / 3.0
"""Flexion of a finger's end joint by that of its middle joint; one tendon bends both."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Pad:
    """A place on the skin, found from the axis of a bone."""

    bone: str
    """Name of the bone."""
    along: float
    """How far along the bone, as a share of its length."""
    across: float = 0.0
    """How far to the radial side of the bone's axis, as a share of the bone's length."""


def _pad(finger: str, bone: str = "distal") -> Pad:
    # The pulp of a fingertip is thickest near its middle; a thumb presses nearer to its end.
    return Pad(bone=f"{finger}_{bone}", along=0.62 if finger == "thumb" else 0.55)


@dataclass(frozen=True, slots=True, kw_only=True)
class GripMode:
    """One way to hold things."""

    name: str
    """Name, as used in files."""
    title: str
    """Name in the GRASP taxonomy, or how it departs from it."""
    number: int
    """Number in the GRASP taxonomy; of the nearest grasp where the mode is a variant."""
    power: bool
    """Whether the palm takes part, rather than fingertips alone."""
    pads: tuple[Pad, ...]
    """What touches: the thumb's pad first."""
    pairs: tuple[tuple[int, int], ...]
    """Numbers of pads that oppose each other."""
    fingers: tuple[str, ...]
    """Fingers that close; the others keep their posture."""
    closed: tuple[float, ...]
    """Typical joint angles of the grasp [rad], order of `ANGLES`, shape (21,)."""
    opening: tuple[float, ...]
    """What is added to the closed angles for an open hand [rad], shape (21,)."""

    @property
    def bones(self) -> NDArray[np.int64]:
        """Bone of each pad, shape (npad,)."""
        return np.array([BONES.index(pad.bone) for pad in self.pads], np.int64)


@dataclass(frozen=True, slots=True, kw_only=True)
class GripPads:
    """The pads of a grip mode on one hand. Bone frames."""

    bones: NDArray[np.int64]
    """Bone of each pad, shape (npad,)."""
    points: Float
    """Places on the skin [m], shape (npad, 3)."""
    normals: Float
    """Outward unit normals of the skin there, shape (npad, 3)."""
    pairs: NDArray[np.int64]
    """Pads that oppose each other, shape (npair, 2)."""


def grip_pads(hand: ShapedHand, grip: GripMode | str) -> GripPads:
    """Where a grip mode's pads are on a hand.

    Args:
        hand: One person's hand; a left hand has the mirrored places.
        grip: The grip mode or its name.
    """
    mode = grip_mode(grip) if isinstance(grip, str) else grip
    found = [_on_skin(hand, pad) for pad in mode.pads]
    return GripPads(
        bones=mode.bones,
        points=np.array([point for point, _ in found]),
        normals=np.array([normal for _, normal in found]),
        pairs=np.array(mode.pairs, np.int64).reshape(-1, 2),
    )


def _on_skin(hand: ShapedHand, pad: Pad) -> tuple[Float, Float]:
    """Place [m] and normal of one pad: where the palmar ray from the axis leaves the skin."""
    bone = BONES.index(pad.bone)
    length = hand.bone_lengths[bone]
    # Bone frames have y palmar on both sides, and z radial on a right hand.
    radial = 1.0 if hand.side == "right" else -1.0
    start = length * np.array([pad.along, 0.0, radial * pad.across])
    own = (hand.weight_bones == bone) & (hand.weights >= 0.5)
    points, normals = hand.local_vertices[own], hand.local_normals[own]
    beside = np.linalg.norm((points - start)[:, [0, 2]], axis=1)
    palmar = normals[:, 1] > 0.0
    width = max(PAD_WIDTH, float(beside[palmar].min()))
    weight = np.where(palmar, np.exp(-0.5 * (beside / width) ** 2), 0.0)
    weight /= weight.sum()
    normal = weight @ normals
    start[1] = weight @ points[:, 1]
    return start, normal / np.linalg.norm(normal)


def posture(**degrees: tuple[float, ...]) -> Float:
    """Joint angles [rad], shape (21,), from degrees by finger.

    Args:
        degrees: For the thumb its five angles in the order of `ANGLES`; for a finger the flexion of
            its knuckle, its abduction and the flexion of its middle joint, to which the end joint
            is coupled by `DIP_SHARE`.
    """
    angles = np.zeros(NANGLE)
    for finger, values in degrees.items():
        first = next(k for k, name in enumerate(ANGLES) if name.startswith(f"{finger}_"))
        given = (*values, DIP_SHARE * values[2]) if finger != "thumb" else values
        angles[first : first + len(given)] = np.deg2rad(given)
    return angles


def _mode(
    name: str, title: str, number: int, *, fingers: tuple[str, ...], closed: Float,
    opening: Float, wraps: bool = False,
) -> GripMode:  # fmt: skip
    pads = [_pad(finger) for finger in fingers]
    pairs = [(0, k) for k in range(1, len(pads))]
    if wraps:
        pads.append(Pad(bone="palm", along=0.72))
    return GripMode(
        name=name, title=title, number=number, power=wraps, pads=tuple(pads), pairs=tuple(pairs),
        fingers=fingers, closed=tuple(closed.tolist()), opening=tuple(opening.tolist()),
    )  # fmt: skip


_OPEN = posture(
    thumb=(-14.0, 6.0, -6.0, 0.0, -14.0), index=(-14.0, 0.0, -20.0), middle=(-14.0, 0.0, -20.0),
    ring=(-14.0, 0.0, -20.0), little=(-14.0, 0.0, -20.0),
)  # fmt: skip
"""How far an open hand is from a closed one; fingers that do not close are left out."""


def _open(*fingers: str, wide: float = 1.0) -> Float:
    moved = [name.split("_")[0] in fingers for name in ANGLES]
    return wide * np.where(moved, _OPEN, 0.0)


_ALL = FINGERS
_MODES = (
    _mode(
        "palmar_pinch", "Palmar Pinch", 9, fingers=("thumb", "index"),
        closed=posture(
            thumb=(12, 42, 12, 0, 18), index=(48, 0, 34), middle=(30, 0, 24),
            ring=(32, 0, 26), little=(32, 0, 26),
        ),
        opening=_open("thumb", "index"),
    ),
    _mode(
        "middle_pinch", "Palmar Pinch with the middle finger", 9, fingers=("thumb", "middle"),
        closed=posture(
            thumb=(20, 44, 12, 0, 18), index=(22, 0, 18), middle=(48, 0, 36),
            ring=(30, 0, 24), little=(30, 0, 24),
        ),
        opening=_open("thumb", "middle"),
    ),
    _mode(
        "tripod", "Tripod", 14, fingers=("thumb", "index", "middle"),
        closed=posture(
            thumb=(16, 44, 12, 0, 18), index=(46, 2, 34), middle=(46, 0, 36),
            ring=(34, 0, 30), little=(34, 0, 30),
        ),
        opening=_open("thumb", "index", "middle"),
    ),
    _mode(
        "quadpod", "Quadpod", 27, fingers=("thumb", "index", "middle", "ring"),
        closed=posture(
            thumb=(20, 46, 12, 0, 18), index=(44, 4, 32), middle=(46, 0, 34),
            ring=(46, 2, 34), little=(32, 4, 26),
        ),
        opening=_open("thumb", "index", "middle", "ring"),
    ),
    _mode(
        "prismatic_4_finger", "Prismatic 4 Finger", 6, fingers=_ALL,
        closed=posture(
            thumb=(22, 46, 12, 0, 18), index=(46, 2, 30), middle=(46, 0, 32),
            ring=(46, 0, 32), little=(48, 4, 28),
        ),
        opening=_open(*_ALL),
    ),
    _mode(
        "without_index", "Prismatic grasp of all fingers without the index", 6,
        fingers=("thumb", "middle", "ring", "little"),
        closed=posture(
            thumb=(28, 46, 14, 0, 18), index=(12, 6, 14), middle=(46, 0, 34),
            ring=(46, 0, 34), little=(48, 4, 30),
        ),
        opening=_open("thumb", "middle", "ring", "little"),
    ),
    _mode(
        "precision_sphere", "Precision Sphere", 13, fingers=_ALL,
        closed=posture(
            thumb=(14, 50, 10, 0, 18), index=(38, 12, 34), middle=(40, 0, 36),
            ring=(40, 8, 36), little=(40, 18, 34),
        ),
        opening=_open(*_ALL),
    ),
    _mode(
        "power_sphere", "Power Sphere", 11, fingers=_ALL, wraps=True,
        closed=posture(
            thumb=(10, 52, 14, 0, 22), index=(34, 12, 44), middle=(36, 0, 46),
            ring=(36, 8, 46), little=(36, 16, 44),
        ),
        opening=_open(*_ALL, wide=1.4),
    ),
    _mode(
        "medium_wrap", "Medium Wrap", 3, fingers=_ALL, wraps=True,
        closed=posture(
            thumb=(14, 50, 16, 0, 24), index=(46, 0, 56), middle=(46, 0, 58),
            ring=(46, 0, 58), little=(46, 0, 56),
        ),
        opening=_open(*_ALL, wide=1.6),
    ),
    _mode(
        "precision_disk", "Precision Disk", 12, fingers=_ALL,
        closed=posture(
            thumb=(10, 52, 6, 0, 14), index=(36, 14, 26), middle=(38, 0, 28),
            ring=(38, 8, 28), little=(38, 20, 26),
        ),
        opening=_open(*_ALL),
    ),
)  # fmt: skip

GRIP_MODES: dict[str, GripMode] = {mode.name: mode for mode in _MODES}
"""Grip modes by name."""

GRIPS: tuple[str, ...] = tuple(GRIP_MODES)
"""Names of the grip modes."""


def grip_mode(name: str) -> GripMode:
    """The grip mode of that name.

    Raises:
        InputError: There is none.
    """
    if name not in GRIP_MODES:
        raise InputError(f"no grip mode {name!r}; there are {', '.join(GRIPS)}")
    return GRIP_MODES[name]
