"""Subjects of the synthetic suites: recorded motion, worn by a drawn hand, seen by a camera."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from handtrack.camera.camera import Camera
from handtrack.camera.frame import DepthFrame
from handtrack.evaluation.runner import Run, run_tracker
from handtrack.evaluation.suites.calibration_images import calibration_images
from handtrack.evaluation.suites.suite import SuiteSettings
from handtrack.evaluation.visibility import visible_keypoints
from handtrack.hand.model import HandModel
from handtrack.hand.shape import HandShape
from handtrack.synthesis.motion import Motion
from handtrack.synthesis.noise import noise_preset
from handtrack.synthesis.sequence import synthesize_sequence
from handtrack.tracking.model_based import ModelBasedConfig
from handtrack.tracking.shape_calibration import fit_shape
from handtrack.tracking.tracker import HandTracker


@dataclass(frozen=True, slots=True, kw_only=True)
class SubjectFrames:
    """One subject's frames of a motion, rendered once for all trackers and frame rates."""

    seed: int
    """Seed that drew the subject."""
    shape: HandShape
    """The subject's hand."""
    frames: list[DepthFrame]
    """Every frame of the motion, with truth."""
    segment_starts: NDArray[np.int64]
    """First frame of each take, shape (k,)."""
    visible: NDArray[np.bool_]
    """Whether each true keypoint is in sight, shape (n, 21)."""
    fitted: HandShape | None = None
    """The shape as it was fitted to images of the subject, where that was asked for."""

    def every(self, stride: int) -> tuple[list[DepthFrame], dict[int, NDArray[np.float64]]]:
        """Every n-th frame, and the true pose of the first one kept of each take, by its place."""
        chosen = np.arange(0, len(self.frames), stride)
        take = np.searchsorted(self.segment_starts, chosen, side="right")
        frames = [self.frames[k] for k in chosen]
        starts = {}
        for place in np.flatnonzero(np.diff(take, prepend=-1)).tolist():
            truth = frames[place].truth
            assert truth is not None and truth.pose is not None
            starts[place] = truth.pose
        return frames, starts


def motion_of(data: Mapping[str, Any]) -> Motion:
    """The suite's motion, or the part of it that it names."""
    motion = Motion.load(data["motion"])
    if "frames" in data:
        first, last = data["frames"]
        motion = motion.take(first, last)
    return motion


def render_subject(
    data: Mapping[str, Any], seed: int, settings: SuiteSettings, model: HandModel
) -> SubjectFrames:
    """Draw a subject and render the suite's motion with it.

    Args:
        data: The suite's `motion`, `frames`, `camera`, `noise` and `forearm`, and `calibration` for
            fitted shapes.
        seed: Seed of the subject.
        settings: Device and seed of the noise.
        model: The parametric hand.
    """
    motion = motion_of(data)
    shape = model.sample_shape(np.random.default_rng(seed))
    hand, camera = model.shaped(shape), Camera.from_dict(data["camera"])
    frames = synthesize_sequence(
        motion, hand, camera, noise_preset(data["noise"]),
        seed=settings.seed, forearm=bool(data["forearm"]), device=settings.device,
    )  # fmt: skip
    shown = settings.progress(frames, len(motion), f"rendering subject {seed}")
    fitted = None
    if settings.shape == "fitted":
        images = calibration_images(
            hand, data["calibration"] | {"camera": data["camera"], "noise": data["noise"]},
            [settings.seed, seed], device=settings.device,
        )  # fmt: skip
        fitted = fit_shape(
            images.depths, camera, device=settings.device, seed=settings.seed, model=model
        )
    return SubjectFrames(
        seed=seed,
        shape=shape,
        fitted=fitted,
        frames=list(shown),
        segment_starts=motion.segment_starts,
        visible=visible_keypoints(hand, camera, motion.to_poses(), device=settings.device),
    )


def subject_tracker(
    subject: SubjectFrames,
    settings: SuiteSettings,
    model: HandModel,
    *,
    tracker: str,
    config: ModelBasedConfig | None = None,
) -> HandTracker:
    """A tracker for a subject's frames, told of the subject's shape what the settings say."""
    shapes = {"given": subject.shape, "fitted": subject.fitted}
    return HandTracker(
        subject.frames[0].camera,
        shape=shapes.get(settings.shape or "given"),
        adapt_shape=settings.shape == "adapted",
        device=settings.device,
        tracker=tracker,
        config=config,
        seed=settings.seed,
        model=model,
    )


def track_subject(
    subject: SubjectFrames,
    stride: int,
    settings: SuiteSettings,
    model: HandModel,
    *,
    tracker: str,
    config: ModelBasedConfig | None = None,
    starts: Mapping[int, NDArray[np.float64]] | None = None,
    text: str = "",
) -> Run:
    """Run a tracker over every n-th frame of a subject.

    Args:
        subject: The rendered frames.
        stride: n.
        settings: Device, seed, and whether the tracker knows the shape.
        model: The parametric hand.
        tracker: Name of the tracker.
        config: Settings instead of its own.
        starts: Poses given to a tracker that does not start by itself, by place among the frames;
            the true ones at the first frame of each take without.
        text: What the progress says.
    """
    frames, truth = subject.every(stride)
    made = subject_tracker(subject, settings, model, tracker=tracker, config=config)
    return run_tracker(
        made, frames, truth if starts is None else starts, visible=subject.visible[::stride],
        progress=settings.progress, text=text or tracker,
    )  # fmt: skip


def case_facts(
    settings: SuiteSettings, subjects: Sequence[int], stride: int, run: Run
) -> dict[str, Any]:
    """Entries of a case that say what was tracked, and what the tracker was told."""
    return {
        "subjects": list(subjects),
        "stride": stride,
        "shape": settings.shape,
        "first_pose": settings.first_pose if run.poses_given else "none",
    }
