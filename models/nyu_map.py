"""Estimate where NYU's 36 annotated points lie on our skeleton; write `nyu_joints.json`.

    python models/nyu_map.py RECORDINGS/nyu_test_joints36.npz

The annotations hold three hands of constant size (two people, one of them calibrated twice). For
some hundred frames of them the pose of our mean hand, one overall scale per hand and the place of
every point in its bone's frame are found together: damped Gauss-Newton, poses eliminated frame by
frame (Schur complement). The frames of the two sample images and their neighbours stay out.

Which bone a point is fixed to follows from the annotations: points of one bone keep their distance
within 0.1 mm in every frame. The annotations' hinges are not where ours are, so the residual alone
would bend and stretch fingers to hide that; weak anatomical priors (`_prior`) hold the points where
an annotator puts them: in the middle of the finger's flesh, fingertips one fingertip's radius
inside the tip, one point near every joint, the wrist's at the wrist.
"""

from __future__ import annotations

import argparse
import json
import re
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from handtrack.artifacts import artifact_path
from handtrack.evaluation.nyu import PROTOCOL_JOINTS, JointMap, bone_units
from handtrack.hand.inverse_kinematics import (
    BonePoints,
    initial_pose,
    point_jacobian,
    solve_poses,
)
from handtrack.hand.kinematics import bone_frames, keypoints
from handtrack.hand.model import HandModel, ShapedHand
from handtrack.hand.skeleton import BONES
from handtrack.transforms import apply_increment

Float = NDArray[np.float64]
Index = NDArray[np.intp]

OUT = Path(__file__).resolve().parents[1] / "src" / "handtrack" / "evaluation" / "nyu_joints.json"

HANDS = ((0, 2440), (2440, 3136), (3136, 8252))
"""Frames over which the annotated hand keeps its size."""
SAMPLE_FRAMES = (0, 1739)
"""Frames of the sample images, 0-based."""
MARGIN = 50
"""Frames before and after a sample image that are left out too."""

JOINT_BONES = np.array([
    *(distal - k for distal in (15, 12, 9, 6) for k in (0, 0, 1, 1, 2, 2)), 3, 3, 2, 2, 1, *[0] * 7
])  # fmt: skip
"""Bone of every point: little finger first, tip first; thumb; palm."""

SIGMA_M = 0.003
"""Residual [m] that counts as one deviation."""
LIMIT_RAD, REST_RAD = 0.05, 10.0
"""Excess over a joint limit, and departure from the rest angles, that count as one deviation."""
INDEPENDENT_FRAMES = 3.0
"""All frames together weigh against the priors as so many independent ones: what is left of the
residual is the difference of two hand models, the same in every frame."""
FREE = 10.0
"""Deviation of a fraction without a prior."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Estimate:
    """State of the estimation."""

    poses: Float
    """Poses with translations in metres, shape (n, 28)."""
    scales: Float
    """Overall scale of each hand, shape (3,)."""
    fractions: Float
    """The map, shape (36, 3)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Problem:
    """What the estimate must explain."""

    hand: ShapedHand
    targets: Float
    """Annotated points [m], shape (n, 36, 3)."""
    hands: NDArray[np.intp]
    """Hand of each frame, shape (n,)."""
    mean: Float
    """Prior of the fractions, shape (36, 3)."""
    weight: Float
    """Inverse variance of the prior, times the weight of a frame, shape (36, 3)."""

    def points(self, fractions: Float) -> BonePoints:
        """The points on the unscaled hand."""
        return JointMap(bones=JOINT_BONES, fractions=fractions).points(self.hand)

    def residuals(self, state: Estimate) -> Float:
        """Residuals in deviations, shape (n, 36, 3)."""
        local = state.poses.copy()
        local[:, :3] = 0.0
        placed = self.points(state.fractions).place(self.hand, local)
        placed = state.poses[:, None, :3] + state.scales[self.hands, None, None] * placed
        return (placed - self.targets) / SIGMA_M

    def cost(self, state: Estimate) -> float:
        """Sum of squares that the steps lower."""
        over, away = self.angle_terms(state)
        prior = self.weight * (state.fractions - self.mean) ** 2
        return float(
            (self.residuals(state) ** 2).sum() + (over**2).sum() + (away**2).sum() + prior.sum()
        )

    def angle_terms(self, state: Estimate) -> tuple[Float, Float]:
        """Excess over the limits and departure from rest in deviations, shapes (n, 21)."""
        angles = state.poses[:, 7:]
        low, high = self.hand.limits.T
        over = np.minimum(angles - low, 0.0) + np.maximum(angles - high, 0.0)
        return over / LIMIT_RAD, (angles - self.hand.rest_angles) / REST_RAD


def step(problem: Problem, state: Estimate, damping: float) -> tuple[Estimate, float]:
    """One damped Gauss-Newton step; raises the damping until the cost falls.

    Returns:
        The new state, the same one when no step helps, and the damping for the next.
    """
    n, njoint = problem.targets.shape[:2]
    nshared = 3 * njoint + len(state.scales)
    scale = state.scales[problem.hands]
    local = state.poses.copy()
    local[:, :3] = 0.0
    placed, by_pose = point_jacobian(problem.hand, problem.points(state.fractions), local)
    by_pose[..., 3:] *= scale[:, None, None, None]
    by_pose = by_pose.reshape(n, -1, by_pose.shape[-1]) / SIGMA_M

    rotations, _ = bone_frames(problem.hand, local)
    columns = rotations[:, JOINT_BONES] * bone_units(problem.hand)[JOINT_BONES][None, :, None, :]
    by_shared = np.zeros((n, njoint, 3, nshared))
    for joint in range(njoint):
        by_shared[:, joint, :, 3 * joint : 3 * joint + 3] = scale[:, None, None] * columns[:, joint]
    by_shared[np.arange(n), :, :, 3 * njoint + problem.hands] = placed
    by_shared = by_shared.reshape(n, -1, nshared) / SIGMA_M

    residual = problem.residuals(state).reshape(n, -1, 1)
    over, away = problem.angle_terms(state)
    transposed = np.swapaxes(by_pose, 1, 2)
    a = transposed @ by_pose  # (n, 27, 27)
    b = transposed @ by_shared  # (n, 27, nshared)
    c = np.tensordot(by_shared, by_shared, ((0, 1), (0, 1)))
    slope_pose = (transposed @ residual)[..., 0]
    slope_shared = np.tensordot(by_shared, residual[..., 0], ((0, 1), (0, 1)))
    angle = np.arange(6, a.shape[1])
    a[:, angle, angle] += (over != 0.0) / LIMIT_RAD**2 + 1.0 / REST_RAD**2
    slope_pose[:, 6:] += over / LIMIT_RAD + away / REST_RAD
    fraction = np.arange(3 * njoint)
    c[fraction, fraction] += problem.weight.ravel()
    slope_shared[: 3 * njoint] += (problem.weight * (state.fractions - problem.mean)).ravel()

    before, diagonal = problem.cost(state), np.arange(a.shape[1])
    while damping < 1e6:
        damped = a.copy()
        damped[:, diagonal, diagonal] *= 1.0 + damping
        damped[:, diagonal, diagonal] += 1e-6
        solved = np.linalg.solve(damped, np.concatenate([b, slope_pose[..., None]], axis=2))
        reduced = (
            c + damping * np.diag(np.diag(c)) - np.tensordot(b, solved[..., :-1], ((0, 1), (0, 1)))
        )
        shared = -np.linalg.solve(
            reduced, slope_shared - np.tensordot(b, solved[..., -1], ((0, 1), (0, 1)))
        )
        move = -solved[..., -1] - solved[..., :-1] @ shared
        move /= np.maximum(np.abs(move[:, 3:]).max(axis=1, keepdims=True) / 0.5, 1.0)
        tried = Estimate(
            poses=apply_increment(state.poses, move),
            scales=state.scales + shared[3 * njoint :],
            fractions=state.fractions + shared[: 3 * njoint].reshape(-1, 3),
        )
        if problem.cost(tried) < before:
            return tried, max(0.3 * damping, 1e-9)
        damping *= 8.0
    return state, damping


def first_guess(problem: Problem) -> Estimate:
    """Poses and scales from keypoints guessed half-way between the annotated points."""
    guess = guessed_keypoints(problem.targets)
    rest = np.zeros((1, 28))
    rest[:, 3], rest[:, 7:] = 1.0, problem.hand.rest_angles
    own = _size(keypoints(problem.hand, rest))
    scales = np.array(
        [_size(guess[problem.hands == hand]) / own for hand in range(problem.hands.max() + 1)]
    )
    scale = scales[problem.hands]
    goals = guess / scale[:, None, None]
    on_keypoints = BonePoints.of_keypoints(problem.hand)
    poses = solve_poses(problem.hand, on_keypoints, goals, initial_pose(problem.hand, goals))
    rotations, origins = bone_frames(problem.hand, poses)
    away = problem.targets / scale[:, None, None] - origins[:, JOINT_BONES]
    local = np.einsum("nkji,nkj->nki", rotations[:, JOINT_BONES], away)
    poses[:, :3] *= scale[:, None]
    fractions = (local / bone_units(problem.hand)[JOINT_BONES]).mean(axis=0)
    return Estimate(poses=poses, scales=scales, fractions=fractions)


def guessed_keypoints(joints: Float) -> Float:
    """Rough places of our 21 keypoints among the 36 points, shape (n, 21, 3)."""
    guess = np.empty((len(joints), 21, 3))
    guess[:, 0], guess[:, 1], guess[:, 4] = joints[:, 35], joints[:, 29], joints[:, 24]
    guess[:, 2] = (joints[:, 27] + joints[:, 28]) / 2
    guess[:, 3] = (joints[:, 25] + joints[:, 26]) / 2
    for finger, first in ((1, 18), (2, 12), (3, 6), (4, 0)):
        base = 4 * finger + 1
        guess[:, base] = joints[:, first + 5]
        guess[:, base + 1] = (joints[:, first + 3] + joints[:, first + 4]) / 2
        guess[:, base + 2] = (joints[:, first + 1] + joints[:, first + 2]) / 2
        guess[:, base + 3] = joints[:, first]
    return guess


def _size(points: Float) -> float:
    """Sum of the mean lengths of some bones of hands, shape (n, 21, 3)."""
    bones = ((0, 9), (9, 10), (10, 11), (0, 5), (5, 6), (6, 7), (0, 13), (13, 14))
    return sum(np.linalg.norm(points[:, a] - points[:, b], axis=1).mean() for a, b in bones)


def _prior(hand: ShapedHand) -> tuple[Float, Float]:
    """Mean and deviation of the fractions, shapes (36, 3); see the module's docstring."""
    mean, deviation = np.zeros((36, 3)), np.full((36, 3), 0.03)
    for joint, bone in enumerate(JOINT_BONES[:28]):
        mean[joint, 1:] = _finger(hand, bone)[0] / hand.bone_lengths[0]
    along = {1: (0.1, 0.1), 2: (0.5, FREE), 3: (0.05, 0.1), 4: (0.5, FREE), 5: (0.1, 0.15)}
    for first in (0, 6, 12, 18):
        for k, (value, spread) in along.items():
            mean[first + k, 0], deviation[first + k, 0] = value, spread
    for joint, value, spread in ((25, 0.05, 0.1), (26, 0.5, FREE), (27, 0.05, 0.1)):
        mean[joint, 0], deviation[joint, 0] = value, spread
    for joint in (0, 6, 12, 18, 24):
        bone = JOINT_BONES[joint]
        _, radius, end = _finger(hand, bone)
        mean[joint, 0], deviation[joint, 0] = (end - radius) / hand.bone_lengths[bone], 0.06
    # The thumb's metacarpal has no outline of its own in the palm.
    mean[28], deviation[28] = (0.5, 0.0, 0.0), (FREE, 0.1, 0.1)
    mean[29], deviation[29] = hand.bone_origins[1] / hand.bone_lengths[0], 0.1
    deviation[[30, 31]] = (0.03, 0.1, 0.3)
    deviation[35] = (0.03, 0.1, 0.05)
    deviation[32:35] = FREE
    return mean, deviation


def _finger(hand: ShapedHand, bone: int) -> tuple[Float, float, float]:
    """Outline of a finger bone's flesh from the mesh, in the bone's frame.

    Returns:
        Middle of its cross-section (y, z) [m], half its thickness [m], largest x [m].
    """
    places = np.argwhere((hand.weight_bones == bone) & (hand.weights > 0.7))
    points = hand.local_vertices[places[:, 0], places[:, 1]]
    along = points[:, 0] / hand.bone_lengths[bone]
    across = points[(along > 0.2) & (along < 0.8), 1:]
    low, high = across.min(axis=0), across.max(axis=0)
    return (low + high) / 2, float(high[0] - low[0]) / 2, float(points[:, 0].max())


def sample(per_hand: tuple[int, ...], rng: np.random.Generator) -> tuple[Index, Index]:
    """Frames drawn from every hand without the sample images: numbers and hands, shapes (n,)."""
    allowed = np.ones(HANDS[-1][1], bool)
    for frame in SAMPLE_FRAMES:
        allowed[max(0, frame - MARGIN) : frame + MARGIN + 1] = False
    frames = [
        rng.choice(np.flatnonzero(allowed[start:end]) + start, count, replace=False)
        for (start, end), count in zip(HANDS, per_hand, strict=True)
    ]
    return np.concatenate(frames), np.repeat(np.arange(len(HANDS)), per_hand)


def check(problem: Problem, state: Estimate, joints: Float, frames: Index, hands: Index) -> Float:
    """Errors [mm] of the fixed map and scales on other frames, shape (n, 36)."""
    scale = state.scales[hands][:, None, None]
    goals = joints[frames] / scale
    points = problem.points(state.fractions)
    poses = initial_pose(problem.hand, guessed_keypoints(goals))
    poses = solve_poses(problem.hand, points, goals, poses)
    return 1e3 * np.linalg.norm((points.place(problem.hand, poses) - goals) * scale, axis=-1)


def main() -> None:
    """Estimate, check, write."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("annotations", type=Path, help="nyu_test_joints36.npz")
    parser.add_argument("--out", type=Path, default=OUT, help="file to write (%(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="seed of the choice of frames")
    arguments = parser.parse_args()
    with np.load(arguments.annotations, allow_pickle=False) as data:
        joints = data["joints"].astype(np.float64)

    rng = np.random.default_rng(arguments.seed)
    frames, hands = sample((140, 60, 150), rng)
    hand = HandModel.load().shaped()
    mean, deviation = _prior(hand)
    problem = Problem(
        hand=hand,
        targets=joints[frames],
        hands=hands,
        mean=mean,
        weight=len(frames) / INDEPENDENT_FRAMES / deviation**2,
    )
    state, damping, cost = first_guess(problem), 1e-3, np.inf
    for iteration in range(60):
        state, damping = step(problem, state, damping)
        before, cost = cost, problem.cost(state)
        if iteration > 8 and before - cost < 1e-5 * cost:
            break
    fitted = 1e3 * SIGMA_M * np.linalg.norm(problem.residuals(state), axis=-1)
    other, other_hands = sample((100, 50, 100), rng)
    unseen = ~np.isin(other, frames)
    other, other_hands = other[unseen], other_hands[unseen]
    tested = check(problem, state, joints, other, other_hands)

    state = replace(state, fractions=np.round(state.fractions, 4))
    document = {
        "what": "NYU's 36 annotated points on our skeleton: x in bone lengths, y z in palm lengths",
        "source": "NYU hand pose data set, test annotations (Tompson et al. 2014)",
        "made_by": f"models/nyu_map.py --seed {arguments.seed}",
        "hand_model": hand_model_hash(),
        "frames": len(frames),
        "scales": np.round(state.scales, 4).tolist(),
        "residual_mm": {
            "fitted_36": round(float(fitted.mean()), 2),
            "fitted_14": round(float(fitted[:, PROTOCOL_JOINTS].mean()), 2),
            "unseen_frames": len(other),
            "unseen_36": round(float(tested.mean()), 2),
            "unseen_14": round(float(tested[:, PROTOCOL_JOINTS].mean()), 2),
        },
        "joints": [
            {"bone": BONES[bone], "fractions": fractions.tolist(), "residual_mm": round(error, 2)}
            for bone, fractions, error in zip(
                JOINT_BONES, state.fractions, tested.mean(axis=0).tolist(), strict=True
            )
        ],
    }
    text = json.dumps(document, indent=1)
    arguments.out.write_text(_one_line_each(text), encoding="utf-8")
    print(f"{iteration + 1} iterations, scales {document['scales']}, {document['residual_mm']}")
    for k, row in enumerate(document["joints"]):
        print(f"{k:2d} {row['bone']:18s} {row['fractions']}  {row['residual_mm']:.2f} mm")


def hand_model_hash() -> str:
    """Configuration hash of the hand model that the map was estimated with."""
    with np.load(artifact_path("hand.npz"), allow_pickle=False) as data:
        return str(data["config_hash"])


def _one_line_each(text: str) -> str:
    """JSON with the innermost lists on one line."""
    return re.sub(r"\[\s+([-\d.,\s]+?)\s+\]", lambda m: f"[{' '.join(m[1].split())}]", text) + "\n"


if __name__ == "__main__":
    main()
