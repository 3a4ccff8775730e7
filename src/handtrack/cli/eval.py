"""`handtrack eval`: accuracy of published predictions by a protocol, or of our own results."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

if TYPE_CHECKING:
    from handtrack.evaluation.protocols import Evaluation


@dataclass(frozen=True, slots=True, kw_only=True)
class EvalOptions:
    """Measure predictions against the truth: mean error, share of frames within 20, 30, 40 mm.

    FILE is a published text file (one frame per line, u v d per joint; give --protocol), or the
    results.npz that `handtrack track` writes, or its folder.

    Examples::

        handtrack eval nyu_DeepPrior.txt --protocol nyu
        handtrack eval run/results.npz --truth data/demo --curve success.png
    """

    files: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="FILE...")]
    """Files of predictions, compared in one table."""
    protocol: Literal["nyu", "icvl"] | None = None
    """Published protocol that the files follow; none for our own results."""
    truth: Path | None = None
    """File with the true joints; for a protocol searched beside FILE when not given."""
    partial: bool = False
    """Accept files with fewer frames than the protocol has: they are its first ones."""
    joints: bool = False
    """Show the mean error of every joint too."""
    json: Path | None = None
    """Write the numbers to this file, in the layout of `handtrack bench`."""
    curve: Path | None = None
    """Draw the share of frames over the distance of their worst joint into this picture."""
    over_time: Path | None = None
    """Draw the mean error of every frame into this picture."""


def run(options: EvalOptions) -> int:
    """Measure, print, write what was asked for.

    Args:
        options: The command's options.

    Returns:
        Exit code 0.

    Raises:
        HandtrackError: A file is missing, damaged, or does not fit.
    """
    # Imported here: `handtrack --help` need not wait for OpenCV.
    from rich.console import Console

    from handtrack.errors import InputError
    from handtrack.evaluation.report import terminal_table, write_bench

    if not options.files:
        raise InputError("name at least one file of predictions")
    for target in (options.json, options.curve, options.over_time):
        if target is not None and not target.resolve().parent.is_dir():
            raise InputError(f"{target.resolve().parent} is no folder: create it first")
    evaluations = [_evaluate(path, options) for path in options.files]
    names = [evaluation.name for evaluation in evaluations]
    if len(set(names)) < len(names):
        names = [str(path) for path in options.files]

    console = Console(width=None if Console().is_terminal else 32 + 24 * len(names))
    console.print(terminal_table("", ["", *names], _rows(evaluations, joints=options.joints)))
    if options.json is not None:
        cases = [
            {
                "case": name,
                "tracker": evaluation.name,
                "protocol": evaluation.protocol,
                **evaluation.summary.to_dict(),
                "joint_error_mm": evaluation.joint_means_mm,
            }
            for name, evaluation in zip(names, evaluations, strict=True)
        ]
        write_bench(options.json, "eval", "none", cases)
    _draw(dict(zip(names, evaluations, strict=True)), options)
    return 0


def _evaluate(path: Path, options: EvalOptions) -> Evaluation:
    """Measure one file by the protocol asked for, or as our own results."""
    from handtrack.errors import InputError
    from handtrack.evaluation.protocols import evaluate_predictions, protocol_named
    from handtrack.evaluation.results import evaluate_results

    if options.protocol is not None:
        protocol = protocol_named(options.protocol)
        return evaluate_predictions(path, protocol, options.truth, partial=options.partial)
    if path.suffix == ".txt":
        raise InputError(f"{path}: pass --protocol nyu or icvl to measure a text file")
    return evaluate_results(path, options.truth)


def _rows(evaluations: list[Evaluation], *, joints: bool) -> list[list[str]]:
    """Rows of the table: a measure's name, then one cell per evaluation."""
    summaries = [evaluation.summary for evaluation in evaluations]
    rows = [
        ["protocol", *(evaluation.protocol for evaluation in evaluations)],
        ["frames", *(str(s.frames) for s in summaries)],
        ["mean joint error", *(f"{s.mean_mm:.3f} mm" for s in summaries)],
        ["median", *(f"{s.median_mm:.3f} mm" for s in summaries)],
        ["95th percentile", *(f"{s.p95_mm:.3f} mm" for s in summaries)],
    ]
    for threshold in summaries[0].success_rate:
        shares = (f"{s.success_rate[threshold]:.2%}" for s in summaries)
        rows.append([f"worst joint within {threshold} mm", *shares])
    rows.append(["lost (mean over 20 mm)", *(f"{s.lost_rate:.2%}" for s in summaries)])
    if any(s.missing_rate for s in summaries):
        rows.append(["without prediction", *(f"{s.missing_rate:.2%}" for s in summaries)])
    if joints:
        means = [evaluation.joint_means_mm for evaluation in evaluations]
        rows += [[joint, *(f"{m[joint]:.3f} mm" for m in means)] for joint in means[0]]
    return rows


def _draw(evaluations: dict[str, Evaluation], options: EvalOptions) -> None:
    """Write the pictures that were asked for."""
    if options.curve is None and options.over_time is None:
        return
    from handtrack.evaluation.curves import (
        draw_errors_over_time,
        draw_success_curves,
        write_picture,
    )

    errors = {name: evaluation.errors_mm for name, evaluation in evaluations.items()}
    if options.curve is not None:
        write_picture(options.curve, draw_success_curves(errors))
    if options.over_time is not None:
        write_picture(options.over_time, draw_errors_over_time(errors))
