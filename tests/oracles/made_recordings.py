"""Recordings of grasps from formulas: smooth, each a little different, quick to make."""

from __future__ import annotations

import numpy as np

from handtrack.grasp.recording import GraspDatabase, GraspRecording, turned_poses
from handtrack.grasp.taxonomy import grip_mode
from handtrack.synthesis.motion import minimum_jerk as smooth
from handtrack.transforms import matrix_to_quat, quat_to_matrix, rotvec_to_matrix


def make_recording(
    rng: np.random.Generator, *, grip: str = "tripod", trial: int = 0, name: str = "ball_45",
    releases: bool = True, frame_rate: float = 120.0,
) -> GraspRecording:  # fmt: skip
    """One recording in the grasp frame; size and timing are drawn."""
    mode = grip_mode(grip)
    size, lag, length = rng.uniform(-1.0, 1.0), rng.uniform(0.6, 1.6), rng.uniform(0.8, 1.2)
    scale = length * frame_rate / 120.0
    nreach, nclose, ncarry, nfree = (max(round(n * scale), 4) for n in (80, 40, 90, 40))
    grasp = np.zeros(28)
    grasp[:3] = [-0.1 - 0.01 * size, 0.01 * rng.normal(), 0.05]
    grasp[3:7] = matrix_to_quat(rotvec_to_matrix(0.1 * rng.normal(size=3) + [0.0, 0.4, 0.0]))
    grasp[7:] = np.array(mode.closed) - 0.2 * size * np.array(mode.opening)
    opened = grasp.copy()
    opened[0] -= 0.02
    opened[7:] += np.array(mode.opening)
    away = opened.copy()
    away[:3] += [-0.2, 0.05 * rng.normal(), 0.1]
    away[3:7] = matrix_to_quat(
        quat_to_matrix(opened[3:7]) @ rotvec_to_matrix(0.3 * rng.normal(size=3))
    )

    def between(first: np.ndarray, last: np.ndarray, share: np.ndarray) -> np.ndarray:
        part = smooth(share)[:, None]
        mixed = first + part * (last - first)
        mixed[:, 3:7] /= np.linalg.norm(mixed[:, 3:7], axis=1, keepdims=True)
        return mixed

    reach = between(away, opened, np.linspace(0.0, 1.0, nreach))[:-1]
    close = between(opened, grasp, np.linspace(0.0, 1.0, nclose) ** lag)
    heading = rng.uniform(-np.pi, np.pi)
    path = np.zeros((ncarry, 7))
    share = np.linspace(0.0, 1.0, ncarry)
    path[:, :2] = np.outer(smooth(share), 0.2 * np.array([np.cos(heading), np.sin(heading)]))
    path[:, 2] = 0.1 * (np.sin(np.pi * smooth(share)) if releases else smooth(share))
    turn = rng.normal(0.0, 0.3)
    path[:, 3:] = matrix_to_quat(rotvec_to_matrix(np.outer(smooth(share), [0.0, 0.0, turn])))
    carry = np.array([turned_poses(grasp, turn * s) for s in smooth(share)])
    carry[:, :3] += path[:, :3]
    hands, things = [reach, close, carry], [np.repeat(path[:1], nreach - 1 + nclose, 0), path]
    names, counts = ["reaching", "closing", "manipulation"], [nreach - 1, nclose, ncarry]
    if releases:
        free = carry[-1].copy()
        free[7:] += np.array(mode.opening)
        free[0] -= 0.05
        hands.append(between(carry[-1], free, np.linspace(0.0, 1.0, nfree)))
        things.append(np.repeat(path[-1:], nfree, 0))
        names.append("releasing")
        counts.append(nfree)
    points = rng.normal(0.0, 0.02, (len(mode.pads), 3))
    return GraspRecording(
        grip=grip, object=name, trial=trial, provenance="formula", frame_rate=frame_rate,
        hand_poses=np.concatenate(hands), object_poses=np.concatenate(things),
        phases=np.repeat(names, counts), contact_bones=mode.bones, contact_local=0.5 * points,
        contact_points=points,
        contact_normals=points / np.linalg.norm(points, axis=1, keepdims=True),
    )  # fmt: skip


def make_database(count: int = 8, *, grips: tuple[str, ...] = ("tripod",)) -> GraspDatabase:
    """`count` recordings of each grip mode; every other one ends with a release."""
    rng = np.random.default_rng(11)
    return GraspDatabase(
        tuple(
            make_recording(rng, grip=grip, trial=k, releases=k % 2 == 1)
            for grip in grips
            for k in range(count)
        )
    )
