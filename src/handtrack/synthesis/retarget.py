"""Retarget recorded keypoints onto our skeleton: joint angles that any of our hands can wear."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handtrack.hand.inverse_kinematics import BonePoints, initial_pose, solve_poses
from handtrack.hand.kinematics import bone_frames
from handtrack.hand.model import ShapedHand
from handtrack.hand.skeleton import BASE_BONES, BONE_PARENTS, DISTAL_BONES, NBONE

Float = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class Retargeted:
    """Result of `retarget_keypoints`."""

    poses: Float
    """Poses of our skeleton, shape (n, 28)."""
    hand: ShapedHand
    """Our skeleton with the recorded hand's proportions."""
    residual: Float
    """Distance of each used keypoint from its recorded place [m], shape (n, nused)."""


def retarget_keypoints(
    hand: ShapedHand, keypoints: ArrayLike, *, use: list[int] | None = None, rounds: int = 6
) -> Retargeted:
    """Joint angles that reproduce recorded keypoints.

    Recordings come from hands of other proportions and other joint definitions, so the lengths of
    the finger bones and the places of the five base joints are estimated with the poses, in turn.

    Args:
        hand: Our hand, whose axes and limits are kept.
        keypoints: Recorded keypoints [m], shape (n, 21, 3); NaN where not recorded.
        use: Keypoints to trust; None leaves out the wrist and the thumb's CMC, which recordings
            define differently.
        rounds: Alternations.

    Returns:
        Poses, the re-proportioned hand and what is left.
    """
    keypoints = np.asarray(keypoints, np.float64)
    use = use if use is not None else [2, 3, 4, *range(5, 21)]
    poses = initial_pose(hand, keypoints)
    # Lengths need few frames; poses need all.
    sample = np.unique(np.linspace(0, len(keypoints) - 1, 150).round().astype(int))
    few = poses[sample]
    for turn in range(rounds):
        points = _used(hand, use)
        few = solve_poses(
            hand, points, keypoints[sample][:, use], few, iterations=40 if turn == 0 else 15
        )
        hand = _fit_lengths(hand, few, keypoints[sample])
    points = _used(hand, use)
    poses = solve_poses(hand, points, keypoints[:, use], initial_pose(hand, keypoints))
    # A second start from the neighbour's pose frees frames stuck in another minimum.
    residual = np.linalg.norm(points.place(hand, poses) - keypoints[:, use], axis=-1)
    again = solve_poses(hand, points, keypoints[:, use], np.roll(poses, 1, axis=0))
    retried = np.linalg.norm(points.place(hand, again) - keypoints[:, use], axis=-1)
    better = np.nanmean(retried, 1) < np.nanmean(residual, 1)
    poses[better], residual[better] = again[better], retried[better]
    return Retargeted(poses=poses, hand=hand, residual=residual)


def _used(hand: ShapedHand, use: list[int]) -> BonePoints:
    points = BonePoints.of_keypoints(hand)
    return BonePoints(bones=points.bones[use], offsets=points.offsets[use])


def _fit_lengths(hand: ShapedHand, poses: Float, keypoints: Float) -> ShapedHand:
    """Bone lengths and base joints that suit the recorded keypoints best at given poses."""
    rotations, _ = bone_frames(hand, poses)
    origins, tips = hand.bone_origins.copy(), hand.tip_offsets.copy()
    for bone in range(1, NBONE):
        parent, finger = BONE_PARENTS[bone], (bone - 1) // 3
        if bone == BASE_BONES[0]:  # the thumb's base is not recorded as ours; leave it
            continue
        here = keypoints[:, bone + finger]
        if bone in BASE_BONES:
            local = np.swapaxes(rotations[:, 0], 1, 2) @ (here - poses[:, :3])[..., None]
            origins[bone] = np.nanmean(local[..., 0], axis=0)
        else:
            previous = keypoints[:, parent + finger]
            if parent == 1:
                # Metacarpal of the thumb: from our own base joint.
                base = (rotations[:, 0] @ origins[1]) + poses[:, :3]
                previous = base
            origins[bone] = [np.nanmedian(np.linalg.norm(here - previous, axis=1)), 0, 0]
        if bone in DISTAL_BONES:
            tip = keypoints[:, bone + finger + 1]
            tips[finger] = [np.nanmedian(np.linalg.norm(tip - here, axis=1)), 0, 0]
    return replace(hand, bone_origins=origins, tip_offsets=tips)
