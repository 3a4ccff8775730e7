"""Things that are no hand: a cup, and a renderer for any mesh."""

from __future__ import annotations

import numpy as np
import trimesh
import warp as wp
from numpy.typing import ArrayLike, NDArray

from handtrack.camera.camera import Camera
from handtrack.device import resolve_device
from handtrack.kernels.render import render_keys, unpack_depth

_SEGMENTS = 48


def cup_mesh(
    *, radius: float = 0.041, height: float = 0.095, wall: float = 0.004
) -> trimesh.Trimesh:
    """An open cup with a handle: axis y, opening at -y, handle at +x, origin in the middle.

    Args:
        radius: Of the outside [m].
        height: Of the cup [m].
        wall: Thickness of wall and bottom [m].

    Returns:
        Outward triangles, lengths in metres.
    """
    shell = trimesh.creation.annulus(radius - wall, radius, height, sections=_SEGMENTS)
    bottom = trimesh.creation.cylinder(radius - 0.5 * wall, wall, sections=_SEGMENTS)
    bottom.apply_translation([0.0, 0.0, -0.5 * (height - wall)])
    handle = trimesh.creation.torus(
        0.30 * height, 0.005, major_sections=_SEGMENTS, minor_sections=12
    )
    handle.apply_transform(trimesh.transformations.rotation_matrix(0.5 * np.pi, [1, 0, 0]))
    handle.apply_translation([radius, 0.0, 0.0])
    # Half of the ring would lie inside the cup.
    outside = np.linalg.norm(handle.vertices[:, :2], axis=1) > radius - wall
    handle.update_faces(outside[handle.faces].all(axis=1))
    cup = trimesh.util.concatenate([shell, bottom, handle])
    assert isinstance(cup, trimesh.Trimesh)
    # trimesh builds upwards along z; here up is -y.
    cup.apply_transform(trimesh.transformations.rotation_matrix(0.5 * np.pi, [1, 0, 0]))
    return cup


class MeshRenderer:
    """Renders one rigid mesh with one camera; buffers are kept between calls."""

    def __init__(self, mesh: trimesh.Trimesh, camera: Camera, *, device: str | None = None) -> None:
        """Prepare for a mesh and a camera.

        Args:
            mesh: Outward triangles, lengths in metres.
            camera: The camera that sees it.
            device: "cpu", "cuda:N" or None for the best there is.
        """
        self._device = resolve_device(device)
        self._points = np.asarray(mesh.vertices, np.float64)
        intrinsics = np.array([[camera.fx, camera.fy, camera.cx, camera.cy]], np.float32)
        self._cameras = wp.array(intrinsics, dtype=float, device=self._device)
        self._faces = wp.array(np.asarray(mesh.faces, np.int32), dtype=int, device=self._device)
        self._vertices = wp.zeros((1, len(self._points)), dtype=wp.vec3, device=self._device)
        self._keys = wp.zeros((1, *camera.shape), dtype=wp.int64, device=self._device)
        self._depth = wp.zeros((1, *camera.shape), dtype=float, device=self._device)
        self._row_hand = wp.zeros(1, dtype=int, device=self._device)

    def render(self, rotation: ArrayLike, place: ArrayLike) -> NDArray[np.float32]:
        """Depth image [m], shape (height, width), 0 = background.

        Args:
            rotation: R_camera_mesh, shape (3, 3).
            place: Origin of the mesh [m], camera frame, shape (3,).
        """
        points = self._points @ np.asarray(rotation, np.float64).T + np.asarray(place, np.float64)
        self._vertices.assign(points[None].astype(np.float32))
        render_keys(
            self._faces, self._row_hand, self._cameras, self._vertices, keys=self._keys
        )  # fmt: skip
        unpack_depth(self._keys, depth=self._depth)
        return self._depth.numpy()[0].copy()
