"""Depth images of posed hands, rendered by the kernels, with a forearm when asked for."""

from __future__ import annotations

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from handtrack.camera.camera import Camera
from handtrack.device import resolve_device
from handtrack.errors import InputError
from handtrack.hand.kinematics import skin
from handtrack.hand.model import ShapedHand
from handtrack.kernels.render import key_item_numpy, render_keys, unpack_depth
from handtrack.synthesis.forearm import RINGS, SEGMENTS, forearm_faces, forearm_vertices
from handtrack.transforms import quat_to_matrix


class DepthRenderer:
    """Renders one hand in many poses with one camera; buffers are kept between calls."""

    def __init__(
        self, hand: ShapedHand, camera: Camera, *, device: str | None = None, batch: int = 16
    ) -> None:
        """Prepare for a hand and a camera.

        Args:
            hand: The hand to draw.
            camera: The camera that sees it.
            device: "cpu", "cuda:N" or None for the best there is.
            batch: Images drawn per call of the kernels.
        """
        self.hand, self.camera = hand, camera
        self._device = resolve_device(device)
        self._batch = batch
        stub = hand.stub_vertices[hand.faces].all(axis=1)
        self._bare = hand.faces
        self._sleeved = np.concatenate([hand.faces[~stub], forearm_faces(hand.nvert)])
        self._faces: dict[bool, wp.array] = {
            arm: wp.array(faces.astype(np.int32), dtype=int, device=self._device)
            for arm, faces in ((False, self._bare), (True, self._sleeved))
        }
        nvert = hand.nvert + RINGS * SEGMENTS
        self._vertices = wp.zeros((batch, nvert), dtype=wp.vec3, device=self._device)
        shape = (batch, camera.height, camera.width)
        self._keys = wp.zeros(shape, dtype=wp.int64, device=self._device)
        self._depth = wp.zeros(shape, dtype=float, device=self._device)
        self._row_hand = wp.zeros(batch, dtype=int, device=self._device)
        self._cameras = wp.zeros((1, 4), dtype=float, device=self._device)
        self.aim(camera)

    def aim(self, camera: Camera) -> None:
        """Go on with another camera of the same image size, for views that follow the hand.

        Raises:
            InputError: The image size differs.
        """
        if camera.shape != self.camera.shape:
            raise InputError(
                f"the camera is {camera.width}x{camera.height}; this renderer was made for "
                f"{self.camera.width}x{self.camera.height}"
            )
        self.camera = camera
        intrinsics = np.array([[camera.fx, camera.fy, camera.cx, camera.cy]], np.float32)
        self._cameras.assign(intrinsics)

    def render(self, poses: ArrayLike, *, elbows: ArrayLike | None = None) -> NDArray[np.float32]:
        """Depth images [m], shape (n, height, width), 0 = background.

        Args:
            poses: Poses, shape (n, 28).
            elbows: Elbows [m], camera frame, shape (n, 3); None draws the model's own stub.
        """
        poses = np.asarray(poses, np.float64).reshape(-1, 28)
        images = np.empty((len(poses), self.camera.height, self.camera.width), np.float32)
        for start in range(0, len(poses), self._batch):
            part = slice(start, min(start + self._batch, len(poses)))
            self._draw(poses[part], None if elbows is None else np.asarray(elbows)[part])
            unpack_depth(self._keys, depth=self._depth)
            images[part] = self._depth.numpy()[: part.stop - part.start]
        return images

    def surface(
        self, pose: ArrayLike, *, elbow: ArrayLike | None = None
    ) -> tuple[NDArray[np.float32], NDArray[np.int64], NDArray[np.float64], NDArray[np.int32]]:
        """One image with what is seen in each pixel, for pictures.

        Returns:
            Depth [m], shape (height, width); triangle, -1 for none, same shape; vertices [m], shape
            (n, 3); triangles, shape (nface, 3).
        """
        pose = np.asarray(pose, np.float64).reshape(1, 28)
        elbows = None if elbow is None else np.asarray(elbow, np.float64).reshape(1, 3)
        self._draw(pose, elbows)
        unpack_depth(self._keys, depth=self._depth)
        depth = self._depth.numpy()[0].copy()
        items = np.where(depth > 0, key_item_numpy(self._keys.numpy()[0]), -1)
        faces = self._bare if elbow is None else self._sleeved
        return depth, items, self._vertices.numpy()[0].astype(np.float64), faces

    def _draw(self, poses: NDArray, elbows: NDArray | None) -> None:
        vertices = np.zeros((*self._vertices.shape, 3), np.float32)
        vertices[: len(poses), : self.hand.nvert] = skin(self.hand, poses)
        if elbows is not None:
            for k, (pose, elbow) in enumerate(zip(poses, elbows, strict=True)):
                vertices[k, self.hand.nvert :] = forearm_vertices(
                    self.hand, quat_to_matrix(pose[3:7]), pose[:3], elbow
                )
        self._vertices.assign(vertices)
        render_keys(
            self._faces[elbows is not None], self._row_hand, self._cameras, self._vertices,
            keys=self._keys,
        )  # fmt: skip
