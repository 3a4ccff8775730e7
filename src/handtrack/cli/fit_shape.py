"""`handtrack fit-shape`: the shape of a person's hand from depth images or a recording."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

if TYPE_CHECKING:
    from handtrack.camera.camera import Camera
    from handtrack.hand.model import ShapedHand
    from handtrack.tracking.shape_calibration import Calibration


@dataclass(frozen=True, slots=True, kw_only=True)
class FitShapeOptions:
    """Fit the hand model to its owner; write a shape for --shape, and a page of before and after.

    SOURCE is three to ten depth images, as files or as one recording, or a longer recording of one
    hand, of which the frames that show it best are used. Show the hand open, then bent, from about
    half a metre; fists alone tell little. The hand is found without being told where it is.

    Examples::

        handtrack fit-shape calibration/ --out me.npz
        handtrack fit-shape open.png bent.png hook.png --pose 5 --pose C --pose hook --out me.npz
        handtrack track recording/ --shape me.npz --out out/run
    """

    source: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="SOURCE")]
    """Recording, or several images of one camera."""
    out: Path
    """Shape file (.npz) to write; the page goes beside it (.png)."""
    pose: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
    """Name of the pose in each image, in their order (data/poses/asl.toml); not needed."""
    side: Literal["right", "left"] | None = None
    """Which hand; without it what the recording says, else right."""
    frames: int = 300
    """Read so many frames of a recording at most."""
    format: Literal["npz", "png", "nyu", "msra", "icvl"] | None = None
    """Format of the recording, told from its content when not given."""
    device: str = "auto"
    """auto, cpu or cuda:0."""
    seed: int = 0
    """Seed of whatever is random."""


def run(options: FitShapeOptions) -> int:
    """Fit, print, write.

    Args:
        options: The command's options.

    Returns:
        Exit code 0, also when the images leave the shape open; a warning says so.

    Raises:
        HandtrackError: A source or an option is unusable.
    """
    # Imported here: `handtrack --help` need not wait for Warp.
    from handtrack.cli import compute_device
    from handtrack.errors import InputError
    from handtrack.evaluation.curves import write_picture
    from handtrack.hand.model import HandModel
    from handtrack.tracking.shape_calibration import calibrate
    from handtrack.viewer.shape_page import shape_page

    if options.out.suffix != ".npz" or not options.out.resolve().parent.is_dir():
        raise InputError(f"--out is {options.out}: expected a .npz file in a folder that exists")
    if options.frames < 1:
        raise InputError(f"--frames is {options.frames}: expected at least 1")
    depths, camera, told_side = _read(options)
    side = options.side or told_side or "right"
    device, model = compute_device(options.device), HandModel.load()
    fit = calibrate(
        depths, camera, side=side, poses=options.pose or None, device=device.alias,
        seed=options.seed, model=model,
    )  # fmt: skip
    fit.shape.save(options.out)
    page = options.out.with_suffix(".png")
    mean = model.shaped(side=side)
    write_picture(page, shape_page(fit, camera, mean))
    _print(options, fit, mean, len(depths), page)
    return 0


def _read(options: FitShapeOptions) -> tuple[list[Any], Camera, str | None]:
    """Depth images, their camera, and the side that they say."""
    from handtrack.camera.source import open_sequence
    from handtrack.errors import InputError

    depths: list[Any] = []
    cameras, side = [], None
    for source in options.source:
        with open_sequence(source, format=options.format) as sequence:
            frames = list(islice(sequence, options.frames - len(depths)))
            cameras.append(sequence.camera)
            truths = [frame.truth.side for frame in frames if frame.truth is not None]
            told = sequence.subject.side if sequence.subject else next(iter(truths), None)
            side = side or told
            depths += [frame.depth for frame in frames]
    if any(camera != cameras[0] for camera in cameras):
        raise InputError("the images are of different cameras: give those of one camera")
    return depths, cameras[0], side


def _print(
    options: FitShapeOptions, fit: Calibration, mean: ShapedHand, count: int, page: Path
) -> None:
    """What was found, how sure it is, and what is wrong with it."""
    import sys

    import numpy as np
    from rich.console import Console

    from handtrack.evaluation.report import terminal_table
    from handtrack.hand.skeleton import BONES

    console = Console(soft_wrap=True, highlight=False)
    rows = [
        [bone.replace("_", " "), f"{1e3 * before:.1f}", f"{1e3 * after:.1f}", f"{1e3 * std:.1f}"]
        for bone, before, after, std in zip(
            BONES, mean.bone_lengths, fit.hand.bone_lengths, fit.certainty.lengths, strict=True
        )
    ]
    console.print(terminal_table("bone lengths, mm", ["bone", "mean hand", "fitted", "±"], rows))
    rows = [
        [str(image), f"{1e3 * before:.2f}", f"{1e3 * after:.2f}", "" if used else "left out"]
        for image, before, after, used in zip(
            fit.images, fit.mean_errors, fit.errors, fit.used, strict=True
        )
    ]
    console.print(terminal_table("depth error, mm", ["image", "mean hand", "fitted", ""], rows))
    console.print(
        f"{len(fit.images)} of {count} images, depth error {1e3 * np.mean(fit.mean_errors):.2f} mm"
        f" before, {1e3 * np.mean(fit.errors):.2f} mm after; {fit.rounds} rounds"
        f"{'' if fit.converged else ', not settled'}"
    )
    console.print(f"written to {options.out} and {page}")
    if fit.shape.problem is not None:
        print(f"handtrack: warning: {fit.shape.problem}", file=sys.stderr)
