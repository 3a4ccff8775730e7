"""JSON lines: one `frame_document` per line, for programs in any language."""

from __future__ import annotations

from handtrack.export.frame_document import bone_quats, frame_document, to_json
from handtrack.export.track import Track


def json_lines(track: Track) -> bytes:
    """Every frame; what is not known is null."""
    quats = bone_quats(track.hand, track.poses)
    lines = [
        to_json(
            frame_document(
                frame=int(track.frames[place]),
                time=track.times[place],
                side=track.side,
                state=track.states[place],
                problem=track.problems[place],
                depth_error=track.depth_errors[place],
                pose=track.poses[place],
                keypoints=track.keypoints[place],
                keypoint_std=track.keypoint_std[place],
                bone_quats=quats[place],
            )
        )
        for place in range(len(track))
    ]
    return ("\n".join(lines) + "\n").encode("utf-8")
