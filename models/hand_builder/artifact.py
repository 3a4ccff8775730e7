"""Writes and describes `hand.npz`."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hand_builder.limits import joint_limits
from hand_builder.shape_space import LinearSpace, Template

FORMAT_VERSION = 1
LICENCE = "CC0-1.0"


def artifact_arrays(
    template: Template,
    faces: NDArray[np.int32],
    ring: NDArray[np.int64],
    scales: LinearSpace,
    offsets: LinearSpace,
    *,
    source: str,
    config_hash: str,
) -> dict[str, NDArray]:
    """All entries of `hand.npz`, as `HandModel.load` expects them."""
    nrow = len(template.vertices) + 5
    skeleton = template.skeleton
    return {
        "format_version": np.array(FORMAT_VERSION),
        "licence": np.array(LICENCE),
        "source": np.array(source),
        "config_hash": np.array(config_hash),
        "vertices": template.vertices.astype(np.float32),
        "faces": faces.astype(np.int32),
        "weight_bones": template.weight_bones.astype(np.int32),
        "weights": template.weights.astype(np.float32),
        "bone_rotations": skeleton.bone_rotations,
        "bone_origins": template.bone_origins,
        "tip_offsets": template.tip_offsets,
        "dof_axes": skeleton.dof_axes,
        "rest_angles": skeleton.rest_angles,
        "limits": joint_limits(),
        "scale_mean": scales.mean,
        "scale_basis": scales.basis,
        "offset_mean": offsets.mean.reshape(nrow, 3).astype(np.float32),
        "offset_basis": offsets.basis.reshape(nrow, 3, -1).astype(np.float32),
        "scale_variance": scales.variance,
        "offset_variance": offsets.variance,
        "cut_x": np.array(template.vertices[ring, 0].mean()),
    }


def write_artifact(path: Path, arrays: dict[str, NDArray]) -> None:
    """Writes the file under a temporary name first, so that a reader never sees half of it."""
    partial = path.with_name(path.name + ".partial.npz")
    np.savez_compressed(partial, **arrays)
    os.replace(partial, path)
