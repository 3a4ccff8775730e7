"""Videos: they read back, appear whole or not at all, and say what they need."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from handtrack.errors import InputError
from handtrack.viewer import video
from handtrack.viewer.video import VideoError, VideoWriter


def moving_square(count: int = 12) -> list[np.ndarray]:
    """A bright square that moves to the right, 8 pixels a picture."""
    pictures = []
    for place in range(count):
        picture = np.full((96, 160, 3), 30, np.uint8)
        picture[30:60, 8 * place : 8 * place + 30] = (40, 200, 120)
        pictures.append(picture)
    return pictures


def read_back(path: Path) -> tuple[list[np.ndarray], float]:
    """Pictures and frame rate of a video."""
    reader = cv2.VideoCapture(str(path))
    rate, pictures = reader.get(cv2.CAP_PROP_FPS), []
    while True:
        good, picture = reader.read()
        if not good:
            reader.release()
            return pictures, rate
        pictures.append(picture)


@pytest.mark.parametrize("suffix", [".mp4", ".webm", ".avi"])
def test_a_video_reads_back(tmp_path: Path, suffix: str) -> None:
    pictures = moving_square()
    with VideoWriter(tmp_path / f"v{suffix}", frames_per_second=25) as writer:
        for picture in pictures:
            writer.write(picture)
        assert not (tmp_path / f"v{suffix}").exists(), "not before it is complete"
    assert writer.count == 12
    assert list(tmp_path.iterdir()) == [writer.path]
    again, rate = read_back(writer.path)
    assert len(again) == 12 and rate == pytest.approx(25)
    for one, other in zip(pictures, again, strict=True):
        assert np.abs(one.astype(int) - other).mean() < 6


def test_an_animated_picture_reads_back(tmp_path: Path) -> None:
    if not hasattr(cv2, "Animation"):
        pytest.skip("this OpenCV is older than 4.11, it has no animated pictures")
    with VideoWriter(tmp_path / "v.webp", frames_per_second=20) as writer:
        for picture in moving_square(5):
            writer.write(picture)
    good, animation = cv2.imreadanimation(str(tmp_path / "v.webp"))
    assert good and len(animation.frames) == 5
    assert np.abs(animation.frames[4][..., :3].astype(int) - moving_square(5)[4]).mean() < 8


def test_nothing_is_left_behind_after_an_error(tmp_path: Path) -> None:
    (tmp_path / "v.mp4").write_bytes(b"the video of yesterday")
    with pytest.raises(RuntimeError, match="halfway"), VideoWriter(tmp_path / "v.mp4") as writer:
        writer.write(moving_square()[0])
        raise RuntimeError("halfway")
    assert (tmp_path / "v.mp4").read_bytes() == b"the video of yesterday"
    with VideoWriter(tmp_path / "empty.mp4"):
        pass
    assert [path.name for path in tmp_path.iterdir()] == ["v.mp4"]


def test_another_codec_stands_in_for_a_missing_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(video.CODECS, ".mp4", "zzzz")
    with VideoWriter(tmp_path / "v.mp4") as writer:
        for picture in moving_square():
            writer.write(picture)
    assert writer.path == tmp_path / "v.avi"
    assert len(read_back(writer.path)[0]) == 12
    monkeypatch.setitem(video.CODECS, ".avi", "zzzz")
    with pytest.raises(VideoError, match=r"neither \.mp4 nor \.avi"):
        VideoWriter(tmp_path / "w.mp4").write(moving_square()[0])
    assert sorted(path.name for path in tmp_path.iterdir()) == ["v.avi"]


@pytest.mark.skipif(not hasattr(cv2, "Animation"), reason="this OpenCV writes no animations")
def test_a_webp_of_less_quality_is_smaller(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    pictures = [
        cv2.blur(rng.integers(0, 256, (96, 160, 3), np.uint8), (5, 5)) for _ in range(4)
    ]  # fmt: skip
    sizes = []
    for quality in (90, 20):
        path = tmp_path / f"{quality}.webp"
        with VideoWriter(path, frames_per_second=10, quality=quality) as writer:
            for picture in pictures:
                writer.write(picture)
        found, animation = cv2.imreadanimation(str(path))
        assert found and len(animation.frames) == 4 and list(animation.durations) == [100] * 4
        sizes.append(path.stat().st_size)
    assert sizes[0] > 1.5 * sizes[1]
    for suffix, quality in ((".mp4", 50), (".webp", 0), (".webp", 101)):
        with pytest.raises(InputError, match="quality"):
            VideoWriter(tmp_path / f"v{suffix}", quality=quality)


def test_what_is_no_video_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"\.mp4"):
        VideoWriter(tmp_path / "v.txt")
    with pytest.raises(InputError, match="is no folder"):
        VideoWriter(tmp_path / "none" / "v.mp4")
    with pytest.raises(InputError, match="frames_per_second"):
        VideoWriter(tmp_path / "v.mp4", frames_per_second=0)
    with VideoWriter(tmp_path / "v.mp4") as writer:
        with pytest.raises(InputError, match="uint8"):
            writer.write(np.zeros((96, 160, 3), np.float32))  # type: ignore[arg-type]
        with pytest.raises(InputError, match="even sides"):
            writer.write(np.zeros((95, 160, 3), np.uint8))
        writer.write(moving_square()[0])
        with pytest.raises(InputError, match="the first one was 160x96"):
            writer.write(np.zeros((96, 162, 3), np.uint8))
