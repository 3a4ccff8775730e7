"""The parametric hand by itself: draw a shape, bend it, read keypoints, write a mesh."""

from pathlib import Path

import numpy as np
import trimesh

import handtrack as ht
from handtrack.hand.kinematics import keypoints, skin
from handtrack.hand.skeleton import ANGLES, KEYPOINTS


def main(out: Path = Path("hand.ply")) -> Path:
    """Write the mesh of a pointing left hand and return its path."""
    model = ht.HandModel.load()
    hand = model.shaped(model.sample_shape(np.random.default_rng(1)), side="left")
    pose = np.zeros(28)
    pose[2], pose[3] = 0.5, 1.0
    for name, angle in zip(ANGLES, pose[7:], strict=True):
        fist = "flexion" in name and not name.startswith(("thumb", "index"))
        pose[7 + ANGLES.index(name)] = 1.4 if fist else angle
    tips = {n: p for n, p in zip(KEYPOINTS, keypoints(hand, pose), strict=True) if "tip" in n}
    for name, place in tips.items():
        print(f"{name:11s} {place.round(3)} m")
    trimesh.Trimesh(skin(hand, pose), hand.faces, process=False).export(out)
    print(f"wrote {out}")
    return out


if __name__ == "__main__":
    main()
