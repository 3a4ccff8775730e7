"""Draw asl_poses.png: every pose of data/poses/asl.toml, from the palm's and from the thumb's side.

Usage: python docs/pictures/make_pose_sheet.py [--out docs/pictures/asl_poses.png]
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np

from handtrack.camera.camera import Camera
from handtrack.evaluation.curves import write_picture
from handtrack.hand.model import HandModel
from handtrack.synthesis.poses import load_poses
from handtrack.synthesis.renderer import DepthRenderer
from handtrack.transforms import matrix_to_quat, rotvec_to_matrix
from handtrack.viewer.pictures import FINGER_COLOURS, contact_sheet
from handtrack.viewer.shading import finger_tints, shade_mesh, wrist_fade

WIDTH, HEIGHT, FINE = 104, 126, 3
CAMERA = Camera(width=WIDTH * FINE, height=HEIGHT * FINE, fx=1740.0, fy=1740.0, cx=156.0, cy=189.0)
DISTANCE = 1.05
GROUND = np.array([250.0, 248.0, 246.0])
VIEWS = (-12.0, 62.0)
"""Turns of the hand about its upright axis [degrees]: seen from the palm, and from the thumb."""


def draw(renderer: DepthRenderer, angles: np.ndarray, turn: float, tilt: float) -> np.ndarray:
    """One view of a hand with its fingers up."""
    upright = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    rotation = rotvec_to_matrix(np.array([np.radians(tilt), 0, 0]))
    rotation = rotation @ rotvec_to_matrix(np.array([0, np.radians(turn), 0])) @ upright
    # The middle of the palm's far half stays in the middle of the picture.
    origin = np.array([0.0, 0.012, DISTANCE]) - rotation @ [0.085, 0.012, 0.008]
    pose = np.concatenate([origin, matrix_to_quat(rotation), angles])
    tints = finger_tints(renderer.hand, (178, 201, 226), FINGER_COLOURS, 0.45)
    mesh = shade_mesh(renderer, pose, tints, wrist_fade(renderer.hand))
    cover = mesh.opacity[..., None]
    picture = mesh.picture * cover + GROUND * (1 - cover)
    return cv2.resize(picture, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA)


def main() -> None:
    """Draw all poses, two views each."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "asl_poses.png")
    parser.add_argument("--poses", type=Path, help="another file of poses")
    parser.add_argument("--only", nargs="*", help="names of the poses to draw")
    parser.add_argument("--columns", type=int, default=8)
    options = parser.parse_args()
    renderer = DepthRenderer(HandModel.load().shaped(), CAMERA, device="cpu", batch=1)
    pictures = []
    for name, angles in load_poses(options.poses).items():
        if options.only and name not in options.only:
            continue
        cell = np.hstack([draw(renderer, angles, turn, -8.0) for turn in VIEWS])
        # Fewer tones compress better, and nobody sees it at this size.
        cell = (np.rint(cell / 12) * 12).clip(0, 252).astype(np.uint8)
        cv2.putText(
            cell, name, (4, 15), cv2.FONT_HERSHEY_SIMPLEX, 0.48, (40, 40, 40), 1, cv2.LINE_AA
        )
        pictures.append(cell)
    while len(pictures) % options.columns:
        pictures.append(np.full_like(pictures[0], 252))
    write_picture(options.out, contact_sheet(pictures, options.columns))


if __name__ == "__main__":
    main()
