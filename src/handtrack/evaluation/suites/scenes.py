"""Suite `scenes`: whole scenes with a hand and without, and whether the tracker knows which."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from handtrack.camera.camera import Camera
from handtrack.evaluation.runner import Run, bench_case, join_runs, run_tracker
from handtrack.evaluation.suites.scene_frames import SceneFrames, render_scene
from handtrack.evaluation.suites.suite import (
    Overlay,
    SuiteResult,
    SuiteSettings,
    chosen,
    judged,
)
from handtrack.hand.model import HandModel
from handtrack.tracking.result import TrackState
from handtrack.tracking.tracker import HandTracker

ALL = "all"
"""Case over all scenes."""


def scenes_suite(settings: SuiteSettings, cases: Mapping[str, Any]) -> SuiteResult:
    """Run the suite; see `benchmarks/scenes.toml`."""
    data = chosen(settings, cases)
    model = HandModel.load()
    shape = model.sample_shape(np.random.default_rng(data["subject"]))
    trackers = {
        name: HandTracker(
            Camera.from_dict(data["camera"]), shape=shape if settings.shape == "given" else None,
            device=settings.device, tracker=name, seed=settings.seed, model=model,
        )
        for name in data["trackers"]
    }  # fmt: skip
    runs: dict[str, list[tuple[Run, NDArray[np.bool_]]]] = {name: [] for name in trackers}
    found, overlays = [], []
    for plan in data["scenes"]:
        scene = render_scene(plan, data, settings, model.shaped(shape))
        for name, tracker in trackers.items():
            run = run_tracker(
                tracker, scene.frames, _start(scene), progress=settings.progress,
                text=f"{scene.case}, {name}",
            )  # fmt: skip
            runs[name].append((run, scene.in_view))
            found.append(_case(scene.case, name, [(run, scene.in_view)], data, settings))
            overlays += _overlays(scene, name, run, tracker, data)
    errors = {}
    for name, parts in runs.items():
        found.append(_case(ALL, name, parts, data, settings))
        whole = join_runs([_seen(run, in_view) for run, in_view in parts])
        if whole.labelled.any():
            errors[name] = whole.errors_mm
    return SuiteResult(
        suite="scenes",
        cases=found,
        targets=judged(found, data["targets"], data["trackers"][0]),
        errors_mm=errors,
        overlays=overlays,
        notes=[
            f"wrong: the tracker vouches for its pose (tracking or recovered), but no hand is in "
            f"view or the mean error is over {data['wrong_mm']:g} mm",
            f"found: it vouches for a pose within {data['found_mm']:g} mm; errors are over the "
            "frames with at least half of the keypoints in view",
        ],
    )


def _start(scene: SceneFrames) -> dict[int, NDArray[np.float64]]:
    """True pose where the hand is in view for the first time, for trackers that need one."""
    for place in np.flatnonzero(scene.in_view).tolist():
        truth = scene.frames[place].truth
        assert truth is not None and truth.pose is not None
        return {place: truth.pose}
    return {}


def wrong_frames(run: Run, wrong_mm: float) -> NDArray[np.bool_]:
    """Frames whose pose the tracker vouches for, but which is wrong, shape (n,).

    Args:
        run: The run; frames without truth are those without a hand.
        wrong_mm: Mean keypoint error of a wrong pose [mm].
    """
    errors = run.frame_errors_mm
    return run.sure & (np.isnan(errors) | (errors > wrong_mm))


def stretches(flags: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """First entry and end of each stretch of entries that are set, of flags of shape (n,)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(np.int8), [0]]))).tolist()
    return list(zip(edges[::2], edges[1::2], strict=True))


def frames_to_find(run: Run, in_view: NDArray[np.bool_], found_mm: float) -> list[int | None]:
    """Frames from each appearance of the hand until it is found, 1 for at once, None for never.

    Args:
        run: The run.
        in_view: Frames with the hand in view, shape (n,).
        found_mm: Largest mean keypoint error of a pose that has found it [mm].
    """
    # A comparison with NaN, the error where nothing is known, is false.
    good = run.sure & (run.frame_errors_mm <= found_mm)
    found: list[int | None] = []
    for first, end in stretches(in_view):
        places = np.flatnonzero(good[first:end])
        found.append(int(places[0]) + 1 if len(places) else None)
    return found


def _seen(run: Run, in_view: NDArray[np.bool_]) -> Run:
    """The run with truth where the hand is in view, and nowhere else."""
    return replace(run, truth=np.where(in_view[:, None, None], run.truth, np.nan))


def _case(
    case: str,
    tracker: str,
    parts: Sequence[tuple[Run, NDArray[np.bool_]]],
    data: Mapping[str, Any],
    settings: SuiteSettings,
) -> dict[str, Any]:
    """The case of one or several scenes."""
    wrong = [wrong_frames(run, data["wrong_mm"]) for run, _ in parts]
    searches = [n for run, seen in parts for n in frames_to_find(run, seen, data["found_mm"])]
    waited = [frames for frames in searches if frames is not None]
    more: dict[str, Any] = {
        "shape": settings.shape,
        "in_view": int(sum(seen.sum() for _, seen in parts)),
        "confident_wrong": float(np.concatenate(wrong).mean()),
        "longest_wrong": max(
            (end - first for flags in wrong for first, end in stretches(flags)), default=0
        ),
        "frames_to_find": searches,
        "never_found": len(searches) - len(waited),
    }
    if waited:
        more["longest_search"] = max(waited)
    run = join_runs([_seen(run, in_view) for run, in_view in parts])
    return bench_case(run, case=case, tracker=tracker, **more)


def _overlays(
    scene: SceneFrames, name: str, run: Run, tracker: HandTracker, data: Mapping[str, Any]
) -> list[Overlay]:
    """Frames spread over the scene, and the first of each stretch of wrong poses."""
    count = int(data["pictures"])
    wrong = wrong_frames(run, data["wrong_mm"])
    starts = [first for first, _ in stretches(wrong)][:count]
    spread = ((np.arange(count) + 0.5) * len(run) / count).astype(int)
    found = []
    for place in sorted({*spread.tolist(), *starts}):
        frame, error = scene.frames[place], run.frame_errors_mm[place]
        told = f"{error:.1f} mm" if np.isfinite(error) else "no hand in view"
        state = run.states[place]
        word = "-wrong" if wrong[place] else ""
        found.append(
            Overlay(
                name=f"scenes-{scene.case.replace(', ', '-').replace(' ', '-')}-{name}-"
                f"{frame.index:03d}{word}",
                depth=frame.depth, camera=frame.camera, hand=tracker.hand, pose=run.poses[place],
                text=f"{state.value.replace('_', ' ')}, {told}", zoom=None,
                lost=state is TrackState.LOST,
            )
        )  # fmt: skip
    return found
