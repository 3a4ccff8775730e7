"""Receive the frames that `handtrack live --publish` sends, from any Python program.

It needs the package websockets and nothing of handtrack:

    python examples/04_receive_published_frames.py --url ws://127.0.0.1:8765 --frames 300
"""

import argparse
import json

from websockets.sync.client import connect

INDEX_TIP = 8


def main(url: str, frames: int | None = None) -> int:
    """Print the index fingertip; returns how many frames the publisher sent past us."""
    received = missed = 0
    last = None
    with connect(url) as connection:
        for message in connection:
            hand = json.loads(message)
            if (hand["format"], hand["version"]) != ("handtrack-frame", 1):
                raise ValueError(f"unknown format {hand['format']} {hand['version']}")
            if last is not None:
                missed += hand["frame"] - last - 1
            last = hand["frame"]
            received += 1
            # "lost" comes with the last pose that was seen: a robot had better not follow it.
            if hand["state"] in ("tracking", "recovered"):
                x, y, z = hand["keypoints"][INDEX_TIP]
                bend = hand["angles"]["index_pip_flexion"]
                print(f"{last:6} index tip {x:+.3f} {y:+.3f} {z:.3f} m, bent by {bend:+.2f} rad")
            else:
                print(f"{last:6} {hand['state']}: {hand['problem']}")
            if frames is not None and received == frames:
                break
    print(f"{received} frames, {missed} missed")
    return missed


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Receive published frames.")
    parser.add_argument("--url", default="ws://127.0.0.1:8765")
    parser.add_argument("--frames", type=int, default=None, help="stop after so many")
    arguments = parser.parse_args()
    main(arguments.url, arguments.frames)
