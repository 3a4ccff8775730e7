"""The shape of a person's hand from a few depth images, or from a recording (thesis II.3.6).

The hybrid tracker finds the first poses with the mean hand; named poses join what it finds where
they are told. Where an image is explained worse than the others after the first fit, it looks again
with the hand that was found: what it misread, small and large hands above all, gets another chance.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from handtrack.camera.camera import Camera
from handtrack.camera.frame import check_depth
from handtrack.camera.segmentation import find_hand_regions
from handtrack.errors import InputError
from handtrack.fitting.fitter import Fitter
from handtrack.fitting.shape_certainty import ShapeCertainty
from handtrack.fitting.shape_config import ShapeFitConfig
from handtrack.fitting.shape_fitter import ShapeFit, ShapeFitter
from handtrack.hand.kinematics import keypoints
from handtrack.hand.model import HandModel, ShapedHand
from handtrack.hand.shape import HandShape
from handtrack.hand.side import mirror_pose
from handtrack.synthesis.poses import load_poses
from handtrack.synthesis.viewpoints import R_CAMERA_UPRIGHT
from handtrack.tracking.best_fit import fit_best
from handtrack.tracking.frame_choice import choose_frames
from handtrack.tracking.result import TrackState
from handtrack.tracking.tracker import HandTracker
from handtrack.transforms import matrix_to_quat, rotvec_to_matrix

Float = NDArray[np.float64]

MOST_IMAGES = 10
"""More images than this are a recording, of which so many frames are chosen."""

LOOKS = 3
"""Most fits; between them the images are looked at anew with the hand found."""

DOUBTED = (1.4, 0.006)
"""The images are looked at anew when the depth error of one is above so many times that of the
median image, and above so many metres."""

UNEXPLAINED = (1.4, 0.008)
"""An image does not count when its depth error is above so many times that of the median image,
and above so many metres."""

BETTER = 0.95
"""A new pose replaces an image's pose when its depth error is below so much of it."""


class NoHandError(InputError):
    """The hand was not found in any image."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Calibration:
    """A fitted shape, and how it came about."""

    shape: HandShape
    """The shape, with its uncertainty, and what is wrong with it."""
    hand: ShapedHand
    """Its hand."""
    certainty: ShapeCertainty
    """How sure it is."""
    images: list[int]
    """Numbers of the images that it was fitted to."""
    depths: NDArray[np.float32]
    """Those images [m], shape (n, height, width)."""
    used: list[bool]
    """Whether each of them counted in the end: some may show what the hand cannot explain."""
    poses: Float
    """Pose in each of them, shape (n, 28)."""
    errors: Float
    """Depth error of each [m], shape (n,)."""
    mean_poses: Float
    """Poses of the mean hand, as found before, shape (n, 28)."""
    mean_errors: Float
    """Its depth errors [m], shape (n,)."""
    rounds: int
    """Rounds of poses and shape in all."""
    converged: bool
    """Whether the last fit settled."""


def fit_shape(
    depths: Iterable[Any],
    camera: Camera,
    *,
    side: str = "right",
    poses: Sequence[str | None] | None = None,
    device: str | None = None,
    seed: int = 0,
    model: HandModel | None = None,
) -> HandShape:
    """Find the shape of a person's hand in depth images.

    Args:
        depths: Three to ten depth images of the same hand [m], each of the camera's shape (height,
            width), 0 = no measurement; or the images of a recording in their order, of which those
            that show the hand best are used.
        camera: Their camera.
        side: "right" or "left".
        poses: Name of the pose in each image (see `data/poses/asl.toml`), None where not known.
        device: "cpu", "cuda:N" or None for the best there is.
        seed: Seed of whatever is random.
        model: The parametric hand; the one that comes with handtrack when None.

    Returns:
        The shape, for `HandTracker(shape=...)`. Its `problem` says what the images did not
        determine, its `*_std` how sure it is.

    Raises:
        InputError: There is no image, or a pose has no such name.
        NoHandError: No image shows a hand.
    """
    return calibrate(
        depths, camera, side=side, poses=poses, device=device, seed=seed, model=model
    ).shape


def calibrate(
    depths: Iterable[Any],
    camera: Camera,
    *,
    side: str = "right",
    poses: Sequence[str | None] | None = None,
    device: str | None = None,
    seed: int = 0,
    model: HandModel | None = None,
    config: ShapeFitConfig | None = None,
) -> Calibration:
    """Find the shape of a person's hand; see `fit_shape`, which returns only the shape.

    Args:
        depths: As there.
        camera: As there.
        side: As there.
        poses: As there.
        device: As there.
        seed: As there.
        model: As there.
        config: Settings of the fit.
    """
    model = model if model is not None else HandModel.load()
    checked = [check_depth(depth, camera) for depth in depths]
    names = _pose_names(poses, len(checked))
    good = [k for k, (_, problem) in enumerate(checked) if problem is None]
    if not good:
        told = f": {checked[0][1]}" if checked else ""
        raise InputError(f"none of {len(checked)} depth images can be used{told}")
    images = np.stack([checked[k][0] for k in good])
    tracker = HandTracker(camera, side=side, device=device, seed=seed, model=model)
    if len(good) > MOST_IMAGES and not any(names):
        places, starts = _track(tracker, images)
    else:
        places, starts = _find(tracker, images, [names[k] for k in good], device)
    fitter = ShapeFitter(
        model, camera, images=min(len(places), MOST_IMAGES), side=side, config=config,
        device=device,
    )  # fmt: skip
    if len(places) > MOST_IMAGES:
        chosen = choose_frames(fitter, images[places], starts, MOST_IMAGES)
        places, starts = places[chosen], starts[chosen]
    return _Looks(tracker, fitter, images[places], [good[k] for k in places], starts).run()


class _Looks:
    """Fits, and looks at the images anew with the hand found."""

    def __init__(
        self, tracker: HandTracker, fitter: ShapeFitter, depths: NDArray[np.float32],
        images: list[int], poses: Float,
    ) -> None:  # fmt: skip
        self._tracker, self._fitter = tracker, fitter
        self._depths, self._images, self._poses = depths, images, poses

    def run(self) -> Calibration:
        """The shape after all looks."""
        before = self._fitter.run(self._depths, self._poses, rounds=0)
        rounds, used = 0, np.ones(len(self._poses), bool)
        fit, poses = before, before.poses
        for look in range(LOOKS):
            fit = self._fitter.run(self._depths, poses, fit.unknowns, used.astype(float))
            rounds += fit.rounds
            poses, errors = fit.poses, fit.errors
            if look == LOOKS - 1 or (used.all() and _explained(errors, DOUBTED).all()):
                break
            again, found = self._look_again(fit)
            better = found < BETTER * errors
            poses = np.where(better[:, None], again, poses)
            explained = _explained(np.where(better, found, errors), UNEXPLAINED)
            if not better.any() and (explained == used).all():
                break
            used = explained
        return self._result(before, fit, used, rounds)

    def _look_again(self, fit: ShapeFit) -> tuple[Float, Float]:
        """What the tracker finds with the hand of a fit: poses and depth errors."""
        self._tracker.reshape(self._fitter.unknowns.shape(fit.unknowns))
        results = self._tracker.track_batch(self._depths)
        poses = np.stack([
            one.pose if one.state is TrackState.TRACKING else old
            for one, old in zip(results, fit.poses, strict=True)
        ])  # fmt: skip
        fitted = self._fitter.run(self._depths, poses, fit.unknowns, rounds=0)
        return fitted.poses, fitted.errors

    def _result(
        self, before: ShapeFit, fit: ShapeFit, used: NDArray[np.bool_], rounds: int
    ) -> Calibration:
        unknowns = self._fitter.unknowns
        certainty = fit.certainty(unknowns, np.flatnonzero(used).tolist())
        shape = unknowns.with_deviations(unknowns.shape(fit.unknowns), certainty.deviations)
        return Calibration(
            shape=replace(shape, problem=certainty.problem), hand=unknowns.hand(fit.unknowns),
            certainty=certainty, images=self._images, depths=self._depths, used=used.tolist(),
            poses=fit.poses, errors=fit.errors, mean_poses=before.poses,
            mean_errors=before.errors, rounds=rounds, converged=fit.converged,
        )  # fmt: skip


def _explained(errors: Float, bound: tuple[float, float]) -> NDArray[np.bool_]:
    """Images whose depth the hand explains about as well as that of the others."""
    times, least = bound
    return errors <= max(times * float(np.median(errors)), least)


# First poses


def _track(tracker: HandTracker, images: NDArray[np.float32]) -> tuple[NDArray[np.intp], Float]:
    """Frames of a recording that show the hand, and its pose there."""
    results = [tracker.track(image) for image in images]
    found = [k for k, one in enumerate(results) if one.state.sure]
    if not found:
        raise NoHandError(f"no hand was found in {len(images)} frames")
    errors = np.array([results[k].depth_error for k in found])
    # What is explained well is most of what is right.
    kept = [k for k, fine in zip(found, _explained(errors, UNEXPLAINED), strict=True) if fine]
    return np.array(kept), np.stack([results[k].pose for k in kept])


def _find(
    tracker: HandTracker, images: NDArray[np.float32], names: list[str | None], device: str | None
) -> tuple[NDArray[np.intp], Float]:
    """Images in which the hand is found, and its pose there."""
    results = tracker.track_batch(images)
    named = load_poses() if any(names) else {}
    places, starts = [], []
    for place, (result, name) in enumerate(zip(results, names, strict=True)):
        pose = result.pose if result.state is TrackState.TRACKING else None
        if name is not None:
            pose = _named_pose(tracker, images[place], pose, named[name], device)
        if pose is not None:
            places.append(place)
            starts.append(pose)
    if not places:
        raise NoHandError(
            f"no hand was found in {len(images)} images: show one bare {tracker.side} hand at 0.3 "
            "to 0.6 m, or name the poses"
        )
    return np.array(places), np.stack(starts)


def _named_pose(
    tracker: HandTracker, image: NDArray[np.float32], found: Float | None, angles: Float,
    device: str | None,
) -> Float | None:  # fmt: skip
    """The best fit of a named pose, from what the tracker found and from palm or back upright."""
    hand, camera = tracker.hand, tracker.camera
    starts = []
    if found is not None:
        starts += [found, np.concatenate([found[:7], angles])]
        centre = keypoints(hand, found).mean(axis=0)
    else:
        regions = find_hand_regions(image, camera, max_regions=1)
        if not regions:
            return None
        centre = regions[0].centre
    for rotation in _facing_rotations():
        pose = np.concatenate([np.zeros(3), matrix_to_quat(rotation), angles])
        pose = pose if hand.side == "right" else mirror_pose(pose)
        pose[:3] = centre - keypoints(hand, pose).mean(axis=0)
        starts.append(pose)
    fitter = Fitter([hand], camera, nhyp=len(starts), device=device, graph=False)
    return fit_best(fitter, hand, image, np.stack(starts), centre=centre)[0]


def _facing_rotations() -> list[Float]:
    """R_camera_palm of right hands with fingers up: palm and back to us, rolled a little."""
    rolls = [rotvec_to_matrix(np.array([0.0, 0.0, roll])) for roll in (-0.6, 0.0, 0.6)]
    turned = R_CAMERA_UPRIGHT * np.array([1.0, -1.0, -1.0])
    return [roll @ facing for facing in (R_CAMERA_UPRIGHT, turned) for roll in rolls]


def _pose_names(poses: Sequence[str | None] | None, count: int) -> list[str | None]:
    """A name or None per image."""
    names: list[str | None] = [None] * count if poses is None else list(poses)
    if len(names) != count:
        raise InputError(f"{len(names)} poses are named for {count} images: name each, or none")
    if any(names):
        known = load_poses()
        wrong = next((name for name in names if name is not None and name not in known), None)
        if wrong is not None:
            raise InputError(f"there is no pose {wrong!r}: expected one of {', '.join(known)}")
    return names
