"""Track the sample sequence and compare with its labels: `python examples/01_track_sequence.py`."""

import numpy as np

import handtrack as ht
from handtrack.artifacts import artifact_path


def main(frames: int | None = None) -> float:
    """Track, print a line per tenth frame, return the mean keypoint error [mm]."""
    errors = []
    with ht.open_sequence(artifact_path("data/demo.npz")) as sequence:
        tracker = ht.HandTracker(sequence.camera, side="right", shape=sequence.subject)
        for frame in sequence:
            if frames is not None and frame.index >= frames:
                break
            hand = tracker.track(frame.depth)
            gap = np.linalg.norm(hand.keypoints - frame.truth.keypoints, axis=1)
            errors.append(1e3 * gap.mean())
            if frame.index % 10 == 0:
                print(f"{frame.index:4d} {hand.state.value:9s} {errors[-1]:6.2f} mm")
    print(f"mean keypoint error {np.mean(errors):.2f} mm over {len(errors)} frames")
    return float(np.mean(errors))


if __name__ == "__main__":
    main()
