"""Scans of people that `models/hand.npz` never saw, with their truth: the test of `learn_hand.py`.

Subjects are drawn as those of the hand model are (`hand_builder.population`), with another seed;
they are posed with the skinning weights of MakeHuman's rig, not with the model's, and scanned by
`handtrack.hand.learning.virtual_scanner`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from hand_builder.artifact import write_artifact
from hand_builder.build import HandBuilder
from hand_builder.population import Subject
from hand_builder.shape_space import encode
from hand_builder.weights import bone_weights, sparse_weights
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from handtrack.errors import DamagedFileError, MissingFileError
from handtrack.files import UNREADABLE
from handtrack.hand.kinematics import skin
from handtrack.hand.learning.virtual_scanner import ScannerOptions, open_faces, virtual_scan
from handtrack.hand.model import HandModel
from handtrack.hand.skeleton import NBONE
from handtrack.synthesis.poses import load_poses
from handtrack.transforms import matrix_to_quat

Float = NDArray[np.float64]

POSES = ("5", "flat", "relaxed", "C", "grasp", "hook", "W", "D")
"""What a subject is asked for, names of `data/poses/asl.toml`: a scanner sees most of the skin in
them, and together they bend every joint."""

ANGLE_DEVIATION = np.radians(5.0)
"""How well people do what they are asked for [rad]."""

TRUTH_FILE = "truth.npz"
"""Beside the scans; learning does not read it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Truth:
    """What the scans were made from."""

    names: tuple[str, ...]
    """File of each scan, shape (nscan,)."""
    vertices: Float
    """Vertices of the scanned hands in the frames of their scans [m], shape (nscan, nvert, 3)."""
    weight_bones: NDArray[np.int32]
    """Bones of the skinning weights that posed them, shape (nvert, 3)."""
    weights: Float
    """Those weights, shape (nvert, 3)."""

    def save(self, folder: Path) -> None:
        """Write the truth beside its scans."""
        write_artifact(
            folder / TRUTH_FILE,
            {
                "names": np.array(self.names),
                "vertices": self.vertices.astype(np.float32),
                "weight_bones": self.weight_bones,
                "weights": self.weights,
            },
        )

    @classmethod
    def load(cls, folder: Path) -> Truth:
        """Read the truth of a folder of scans.

        Raises:
            MissingFileError: The folder has no truth.
            DamagedFileError: The file is something else.
        """
        path = folder / TRUTH_FILE
        if not path.is_file():
            raise MissingFileError(f"no {path}: only scans made by learn_hand.py have a truth")
        try:
            with np.load(path, allow_pickle=False) as data:
                return cls(
                    names=tuple(str(name) for name in data["names"]),
                    vertices=data["vertices"].astype(np.float64),
                    weight_bones=data["weight_bones"],
                    weights=data["weights"],
                )
        except UNREADABLE as error:
            raise DamagedFileError(f"{path} is not the truth of scans: {error}") from error


def rig_weights(builder: HandBuilder) -> tuple[NDArray[np.int32], Float]:
    """Weights of MakeHuman's rig at the hand's vertices, not smoothed: bones and weights."""
    rows = bone_weights(builder.maker.rig_weights, builder.maker.topology.base_ids)
    return sparse_weights(np.vstack([rows, np.eye(NBONE)[:1]]))


def make_scans(
    builder: HandBuilder,
    subjects: Sequence[Subject],
    folder: Path,
    seed: int,
    options: ScannerOptions | None = None,
) -> Truth:
    """Scan each subject in one to five poses, from anywhere, and write the meshes and their truth.

    Args:
        builder: Source of the rig's weights and of the template.
        subjects: Who is scanned.
        folder: Where to; made if it is not there.
        seed: Seed of poses and scanner.
        options: What the scanner does.

    Returns:
        The truth, which is in the folder too.
    """
    folder.mkdir(parents=True, exist_ok=True)
    bones, weights = rig_weights(builder)
    template = replace(builder.template, weight_bones=bones, weights=weights)
    model = replace(HandModel.load(), weight_bones=bones, weights=weights)
    faces, named = open_faces(model), load_poses()
    names, truths = [], []
    for number, subject in enumerate(subjects):
        # Each subject has its own random numbers: a longer list keeps the first subjects' scans.
        rng = np.random.default_rng([seed, number])
        code = encode(template, subject.hand)
        hand = replace(model, scale_mean=code.scales, offset_mean=code.offsets).shaped()
        for name in rng.choice(POSES, rng.integers(1, 6), replace=False):
            angles = named[str(name)] + ANGLE_DEVIATION * rng.standard_normal(len(model.limits))
            pose = np.concatenate(
                [
                    0.5 * rng.standard_normal(3),
                    matrix_to_quat(Rotation.random(rng=rng).as_matrix()),
                    np.clip(angles, *model.limits.T),
                ]
            )
            vertices = skin(hand, pose)
            file = f"s{number:03d}_{name}.ply"
            virtual_scan(vertices, faces, rng, options).export(folder / file)
            names.append(file)
            truths.append(vertices)
    truth = Truth(
        names=tuple(names), vertices=np.array(truths), weight_bones=bones, weights=weights
    )
    truth.save(folder)
    return truth
