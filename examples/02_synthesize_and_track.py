"""Render a drawn subject in a recorded motion with sensor noise, and track it on fewer steps."""

from dataclasses import replace

import numpy as np

import handtrack as ht
from handtrack.hand.kinematics import keypoints
from handtrack.synthesis.motion import Motion
from handtrack.synthesis.noise import noise_preset
from handtrack.synthesis.renderer import DepthRenderer
from handtrack.tracking.model_based import ModelBasedConfig


def main(frames: int = 60) -> float:
    """Render, track, return the mean keypoint error [mm]."""
    model = ht.HandModel.load()
    shape = model.sample_shape(np.random.default_rng(5))
    hand = model.shaped(shape)
    camera = ht.Camera(width=320, height=240, fx=241.42, fy=241.42, cx=160.0, cy=120.0)

    motion = Motion.load("recorded_hand_motion")
    poses, elbows = motion.to_poses()[:frames], motion.elbows[:frames]
    clean = DepthRenderer(hand, camera).render(poses, elbows=elbows)
    depth = noise_preset("time_of_flight").apply(clean, camera, np.random.default_rng(0))

    default = ModelBasedConfig()
    fast = replace(default, fit=replace(default.fit, iterations=6))
    tracker = ht.HandTracker(camera, shape=shape, config=fast)
    tracker.reset(poses[0])
    results = [tracker.track(image) for image in depth]
    truth = np.stack([keypoints(hand, pose) for pose in poses])
    errors = np.linalg.norm(np.stack([r.keypoints for r in results]) - truth, axis=-1)
    print(f"{len(results)} frames, mean keypoint error {1e3 * errors.mean():.2f} mm")
    return float(1e3 * errors.mean())


if __name__ == "__main__":
    main()
