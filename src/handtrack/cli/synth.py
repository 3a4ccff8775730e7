"""`handtrack synth`: labelled depth sequences from recorded motion, and data sets for training."""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

if TYPE_CHECKING:
    from handtrack.camera.camera import Camera
    from handtrack.camera.frame import DepthFrame
    from handtrack.hand.model import HandModel
    from handtrack.hand.shape import HandShape
    from handtrack.synthesis.motion import Motion

DEFAULT_NOISE = "time-of-flight"
"""Noise model of a sequence's sensor."""

CLEAN_UNIT = 0.0001
"""Step of the depth that is written where the noise model does not round it itself [m]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SynthOptions:
    """Render depth with truth: a motion, worn by a subject, seen by a noisy camera; or a data set.

    MOTION is an .npz motion file, or the name of one that comes with handtrack
    (recorded_hand_motion, leap_hand_motion). With --dataset there is no motion: subjects, poses and
    viewpoints are drawn at random, and a folder that was begun is gone on with.

    Examples::

        handtrack synth recorded_hand_motion --out fist.npz --frames 270:420 --subject 7
        handtrack synth leap_hand_motion --out seq/ --camera realsense --noise coded-light
        handtrack synth --dataset train/ --preset small --seed 1
    """

    motion: Annotated[str | None, tyro.conf.Positional, tyro.conf.arg(metavar="MOTION")] = None
    """Motion file, or name of a motion that comes with handtrack."""
    out: Path | None = None
    """Where to: FILE.npz, or a folder for 16-bit PNG images with camera.json and truth.npz."""
    dataset: Path | None = None
    """Folder for a data set instead of a sequence; of the other options --preset, --side, --camera,
    --noise, --seed and --device count."""
    preset: Literal["small", "paper"] = "small"
    """Size of the data set: small (1,000 samples) or paper (40 subjects x 200 poses x 40 viewpoints
    = 320,000 samples)."""
    subject: str = "mean"
    """Whose hand: mean, a number that draws a subject of the population, or a shape .npz."""
    side: Literal["right", "left"] = "right"
    """Which hand; a left hand gets the mirrored motion."""
    camera: str = "creative"
    """Camera: creative (320x240), realsense, primesense (640x480), or a camera.json."""
    noise: Literal["time-of-flight", "structured-light", "coded-light", "none"] | None = None
    """Noise model of the sensor; without it time-of-flight, in data sets one of the three sensors
    at random."""
    stride: int = 1
    """Keep every n-th frame."""
    frames: str = ":"
    """Frames of the motion, as A:B (from A to before B)."""
    bare: bool = False
    """Leave the forearm out: only the hand model's own stub is seen."""
    seed: int = 0
    """Seed of the noise; with --dataset of everything."""
    device: str = "auto"
    """auto, cpu or cuda:0."""


def run(options: SynthOptions) -> int:
    """Render and write.

    Args:
        options: The command's options.

    Returns:
        Exit code 0.

    Raises:
        HandtrackError: An input is missing, damaged or does not fit.
    """
    if options.dataset is not None:
        from handtrack.cli.synth_dataset import write_dataset

        return write_dataset(options, options.dataset)
    return _write_sequence(options)


def _write_sequence(options: SynthOptions) -> int:
    """Render and write a motion."""
    # Imported here: `handtrack --help` need not wait for Warp.
    from rich.console import Console

    from handtrack.cli import compute_device
    from handtrack.cli.progress import progress
    from handtrack.errors import InputError
    from handtrack.hand.model import HandModel
    from handtrack.synthesis.motion import Motion
    from handtrack.synthesis.noise import noise_preset
    from handtrack.synthesis.sequence import frames_out_of_view, synthesize_sequence

    if options.motion is None or options.out is None:
        raise InputError("expected MOTION and --out for a sequence, or --dataset for a data set")
    out = options.out
    _check_target(out)
    motion = Motion.load(options.motion)
    start, stop = parse_frames(options.frames)
    motion = motion.take(start, stop)
    count = len(motion.take(stride=options.stride))
    camera = find_camera(options.camera)
    model = HandModel.load()
    shape = find_subject(options.subject, model)
    hand = model.shaped(shape, side=options.side)
    device = compute_device(options.device)
    frames = synthesize_sequence(
        motion, hand, camera, noise_preset(_noise(options)), stride=options.stride,
        seed=options.seed, forearm=not options.bare,
        device=device.alias,
    )  # fmt: skip
    frames = progress(frames, count, "rendering")
    write = _write_npz if out.suffix == ".npz" else _write_folder
    write(out, options, frames, motion, camera, shape)
    away = int(frames_out_of_view(motion, hand, camera)[:: options.stride].sum())
    Console(stderr=True, soft_wrap=True, highlight=False).print(
        f"{out}: {count} frames of {camera.width}x{camera.height}"
        + (f"; in {away} of them a part of the hand is out of view" if away else "")
    )
    return 0


def parse_frames(text: str) -> tuple[int, int | None]:
    """First frame and the one after the last of "A:B", "A:", ":B" or ":".

    Raises:
        InputError: The text is something else.
    """
    from handtrack.errors import InputError

    first, colon, last = text.partition(":")
    try:
        if colon:
            return int(first or 0), int(last) if last else None
    except ValueError:
        pass
    raise InputError(f"frames {text!r}: expected A:B, such as 100:250, 100: or :250")


def find_camera(name: str) -> Camera:
    """Camera of a preset's name or of a JSON file.

    Raises:
        InputError: There is no such preset, or the file does not describe a camera.
    """
    from handtrack.camera.camera import Camera
    from handtrack.camera.readers.png_folder import read_json
    from handtrack.errors import InputError
    from handtrack.synthesis.sequence import CAMERAS

    if name in CAMERAS:
        return CAMERAS[name]
    if not Path(name).suffix:
        raise InputError(f"camera {name!r}: expected {', '.join(CAMERAS)} or a camera.json")
    facts = read_json(Path(name))
    return Camera.from_dict(facts.get("camera", facts))


def find_subject(name: str, model: HandModel) -> HandShape:
    """Shape of "mean", of a number, or of a file written by `HandShape.save`.

    Raises:
        InputError: The text is none of these.
    """
    import numpy as np

    from handtrack.errors import InputError
    from handtrack.hand.shape import HandShape

    if name == "mean":
        return HandShape()
    if name.isdecimal():
        return model.sample_shape(np.random.default_rng(int(name)))
    if Path(name).suffix == ".npz":
        return HandShape.load(name)
    raise InputError(f"subject {name!r}: expected mean, a whole number, or a shape .npz")


def _check_target(out: Path) -> None:
    """Refuse to mix a sequence into a folder that holds something."""
    from handtrack.errors import InputError

    if out.suffix == ".npz":
        if out.is_dir():
            raise InputError(f"{out} is a folder: name a file in it")
    elif out.suffix:
        raise InputError(f"{out} ends in {out.suffix!r}: expected FILE.npz, or a folder")
    elif out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(f"{out} exists and is not an empty folder: choose another one")


def _source(options: SynthOptions, motion: Motion) -> str:
    """Where a synthesised sequence comes from, in one line."""
    return (
        f"synthesised by handtrack from frames {options.frames} (stride {options.stride}) of "
        f"{motion.name} ({motion.source}), subject {options.subject}, camera {options.camera}, "
        f"noise {_noise(options)}, seed {options.seed}"
    )


def _noise(options: SynthOptions) -> str:
    """Name of the sequence's noise model."""
    return options.noise or DEFAULT_NOISE


def _unit(options: SynthOptions) -> float:
    """Step of the stored depth [m]: the sensor's own."""
    from handtrack.synthesis.noise import noise_preset

    return noise_preset(_noise(options)).depth_step or CLEAN_UNIT


def _rate(options: SynthOptions, motion: Motion) -> float | None:
    """Frame rate of the sequence [1/s], None where the motion's is not known."""
    rate = motion.frames_per_second
    return None if rate is None else rate / options.stride


def _write_npz(
    out: Path,
    options: SynthOptions,
    frames: Iterator[DepthFrame],
    motion: Motion,
    camera: Camera,
    shape: HandShape,
) -> None:
    """One file with depth, camera, time stamps, labels and the subject's shape."""
    from handtrack.camera.readers.npz import write_npz_sequence

    # The lists of labels fill while the depth is read, which comes first.
    kept = _Labels()
    write_npz_sequence(
        out, kept.depths(frames), camera, depth_unit=_unit(options),
        source=_source(options, motion), licence=motion.licence, side=options.side,
        shape_alpha=shape.alpha, shape_beta=shape.beta, scale=shape.scale,
        frames_per_second=_rate(options, motion),
        time=kept.times, truth_pose=kept.poses, truth_keypoints=kept.keypoints,
    )  # fmt: skip


class _Labels:
    """Labels of frames, collected while their depth is handed on."""

    def __init__(self) -> None:
        self.times: list[float] = []
        self.poses: list[Any] = []
        self.keypoints: list[Any] = []

    def depths(self, frames: Iterator[DepthFrame]) -> Iterator[Any]:
        """Depth of each frame."""
        for frame in frames:
            assert frame.truth is not None
            self.times.append(frame.time)
            self.poses.append(frame.truth.pose)
            self.keypoints.append(frame.truth.keypoints)
            yield frame.depth


def _write_folder(
    out: Path,
    options: SynthOptions,
    frames: Iterator[DepthFrame],
    motion: Motion,
    camera: Camera,
    shape: HandShape,
) -> None:
    """16-bit PNG images, camera.json and truth.npz, moved into place as a whole."""
    import cv2
    import numpy as np

    out.parent.mkdir(parents=True, exist_ok=True)
    part = Path(tempfile.mkdtemp(prefix=f".{out.name}.", dir=out.parent))
    try:
        kept = _Labels()
        for number, depth in enumerate(kept.depths(frames)):
            steps = np.rint(np.asarray(depth, np.float64) / _unit(options))
            steps = np.clip(steps, 0, 65535).astype(np.uint16)
            written, data = cv2.imencode(".png", steps)
            assert written, "OpenCV always has PNG"
            (part / f"{number:06d}.png").write_bytes(data.tobytes())
        facts = {
            **camera.to_dict(), "depth_unit_m": _unit(options), "hand": options.side,
            "times_s": kept.times, "frames_per_second": _rate(options, motion),
            "source": _source(options, motion), "licence": motion.licence,
        }  # fmt: skip
        (part / "camera.json").write_text(json.dumps(facts, indent=1) + "\n", encoding="utf-8")
        np.savez_compressed(
            part / "truth.npz", truth_pose=np.array(kept.poses),
            truth_keypoints=np.array(kept.keypoints), side=options.side,
            shape_alpha=shape.alpha, shape_beta=shape.beta, scale=shape.scale,
        )  # fmt: skip
        if out.is_dir():
            out.rmdir()
        os.chmod(part, 0o755)
        part.replace(out)
    finally:
        shutil.rmtree(part, ignore_errors=True)
