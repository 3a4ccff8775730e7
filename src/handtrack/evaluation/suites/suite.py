"""What all suites share: their settings, their result, their targets, and where their data lies."""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib import import_module
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from handtrack.artifacts import artifact_path
from handtrack.camera.camera import Camera
from handtrack.camera.frame import DepthFrame
from handtrack.errors import DamagedFileError, InputError
from handtrack.evaluation.runner import Progress, no_progress
from handtrack.hand.model import ShapedHand
from handtrack.hand.shape import HandShape
from handtrack.tracking.tracker import TRACKERS

SUITES: dict[str, str] = {
    "selftest": "self-occlusion: two fists, noise-free, own model (Hamer 4.4.1)",
    "tracking": "recorded motion with forearm and sensor noise, three subjects, three frame rates",
    "single-frame": "frames without memory: unseen subjects, any viewpoint, noise, forearm",
    "recovery": "the tracked pose is scrambled: how many frames until tracking is back",
    "scenes": "whole scenes: nobody, people, a hand that leaves, a cup, things held in front",
    "speed": "time per frame and stage for 1 to 64 hypotheses, start-up",
    "live": "the live loop for minutes: memory, dropped frames, age of results",
    "viewer": "what the web viewer costs the tracking loop",
    "regression": "the forest alone: features and structures, cross-validated over subjects",
    "ablation": "the tracker with every switch changed, one after the other",
    "shape": "hand shape from images and while tracking: unseen subjects, real images with --data",
    "grasp": "unseen objects grasped under physics: success, penetration, accuracy, speed",
    "real": "real images with labelled joints or fingertips (needs --data)",
    "sequence": "any recorded sequence (needs --sequence)",
}
"""Suite -> what it measures. Each is a module of this package, with a function NAME_suite, and a
file in `benchmarks/`; dashes become underscores there."""

CONTROLLERS = ("full", "pd", "pollard-zordan")
"""What the suite grasp compares in place of trackers: `grasp.controller.VARIANTS`, named here so
that other suites need not load MuJoCo."""

FIRST_POSE_SUITES = ("tracking",)
"""Suites that can let an automatic tracker find the first poses."""

_GOAL = ("value", "at_most", "at_least")
"""What a target asks for; its other entries say of which cases."""

ShapeTold = Literal["given", "mean", "fitted", "adapted"]
"""The subject's own shape, the mean hand's, what `fit_shape` finds in images of the subject, or the
mean hand's at first, adapted while tracking. The last two are for the suite `tracking`."""

FirstPose = Literal["truth", "found"]
"""Where trackers that do not start by themselves get the first pose of each take from."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordedFrames:
    """A recorded sequence with all that a tracker is told about it."""

    name: str
    """Name of the sequence."""
    frames: Sequence[DepthFrame]
    """Its frames, with whatever truth they carry; they may be read only when asked for."""
    starts: Mapping[int, NDArray[np.float64]]
    """Place among the frames -> pose given there, shape (28,)."""
    side: str
    """Which hand."""
    shape: HandShape
    """Its shape."""
    notes: tuple[str, ...] = ()
    """Where shape and first pose come from."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SuiteSettings:
    """What the user of a suite may choose."""

    trackers: tuple[str, ...] = ()
    """Trackers to measure; empty takes the suite's own."""
    subjects: tuple[int, ...] = ()
    """Seeds of the subjects; empty takes the suite's own."""
    strides: tuple[int, ...] = ()
    """Every so many frames; empty takes the suite's own."""
    sections: tuple[str, ...] = ()
    """Parts of the suite `grasp` to run; empty runs all."""
    device: str | None = None
    """"cpu", "cuda:N" or None for the best there is."""
    seed: int = 0
    """Seed of the sensor noise and of the trackers."""
    quick: bool = False
    """Run the small part of the suite that its file in `benchmarks/` names, to see that it
    works."""
    shape: ShapeTold | None = None
    """What trackers know of the subject's shape; None takes the suite's own."""
    first_pose: FirstPose = "truth"
    """First pose of each take, for trackers that do not start by themselves: the true one, or what
    an automatic tracker finds there without memory."""
    data: Path | None = None
    """Folder with recordings of others, for the suites that need them."""
    sequence: RecordedFrames | None = None
    """Recorded sequence, for the suite of that name."""
    cold: bool = False
    """Measure the start without compiled kernels too, which takes minutes."""
    minutes: float | None = None
    """How long the suite `live` runs [min]; None takes the suite's own."""
    progress: Progress = no_progress
    """Shows how far the suite is."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Target:
    """What a suite should reach, and what it reached."""

    case: str
    """Name of the case."""
    tracker: str
    """Name of the tracker."""
    value: str
    """Path of the number in the case, such as "keypoint_error_mm.mean"."""
    bound: float
    """The target."""
    at_most: bool
    """Whether the number must not be over the target; else not under it."""
    reached: float
    """The number."""

    @property
    def passed(self) -> bool:
        """Whether the target is met."""
        return self.reached <= self.bound if self.at_most else self.reached >= self.bound

    def to_dict(self) -> dict[str, Any]:
        """Return the target's entry in the benchmark file."""
        return {
            "case": self.case, "tracker": self.tracker, "value": self.value,
            "at_most" if self.at_most else "at_least": self.bound,
            "reached": self.reached, "passed": self.passed,
        }  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class Overlay:
    """A pose over an image, for a picture."""

    name: str
    """Name of the picture."""
    depth: NDArray[np.float32]
    """Depth image [m], shape (height, width) of the camera."""
    camera: Camera
    """Its camera."""
    hand: ShapedHand
    """The hand."""
    pose: NDArray[np.float64]
    """Its pose, shape (28,)."""
    text: str = ""
    """What to write into the picture."""
    zoom: float | None = 0.35
    """Width of the view at the hand's distance [m]; None shows the whole image."""
    lost: bool = False
    """Whether the tracker itself says that the pose does not explain the image."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Curves:
    """Curves for a picture beside those of `SuiteResult.errors_mm`."""

    name: str
    """Name of the picture."""
    title: str
    """Text above."""
    xlabel: str
    """Text under the x axis, with its unit."""
    ylabel: str
    """Text beside the y axis, with its unit."""
    lines: dict[str, tuple[NDArray[np.float64], NDArray[np.float64]]]
    """Legend text -> x and y, each of shape (n,)."""
    y_range: tuple[float, float] | None = None
    """Ends of the y axis; from the lines without."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SuiteResult:
    """What a suite measured."""

    suite: str
    """Name of the suite."""
    cases: list[dict[str, Any]]
    """Cases in the layout of the benchmark file."""
    targets: list[Target] = field(default_factory=list)
    """Targets that apply to them."""
    errors_mm: dict[str, NDArray[np.float64]] = field(default_factory=dict)
    """Name of a curve -> error of every keypoint [mm], shape (n, njoint), frame after frame."""
    curves: list[Curves] = field(default_factory=list)
    """Further curves."""
    overlays: list[Overlay] = field(default_factory=list)
    """Pictures worth a look."""
    notes: list[str] = field(default_factory=list)
    """What a reader of the numbers should know."""
    more: dict[str, Any] = field(default_factory=dict)
    """Further entries of the benchmark file, beside the cases."""


Suite = Callable[[SuiteSettings, Mapping[str, Any]], SuiteResult]


def run_suite(name: str, settings: SuiteSettings) -> SuiteResult:
    """Run a suite.

    Raises:
        InputError: There is no such suite, or it needs a setting that is missing.
        HandtrackError: Something that the suite needs is missing or damaged.
    """
    if name not in SUITES:
        raise InputError(f"there is no suite {name!r}: expected one of {', '.join(SUITES)}")
    known = CONTROLLERS if name == "grasp" else tuple(TRACKERS)
    for tracker in settings.trackers:
        if tracker not in known:
            raise InputError(f"tracker is {tracker!r}; expected one of {', '.join(known)}")
    if len(set(settings.trackers)) < len(settings.trackers):
        raise InputError(f"trackers are {', '.join(settings.trackers)}: name each one once")
    if settings.first_pose == "found" and name not in FIRST_POSE_SUITES:
        raise InputError(
            f"the suite {name} does not let a tracker find first poses; "
            f"{' and '.join(FIRST_POSE_SUITES)} does"
        )
    if settings.sections and name != "grasp":
        raise InputError(f"the suite {name} has no sections; grasp has")
    if settings.shape in ("fitted", "adapted") and name != "tracking":
        raise InputError(
            f"the suite {name} does not fit shapes; tracking does, and shape measures them"
        )
    module = name.replace("-", "_")
    run: Suite = getattr(import_module(f"{__package__}.{module}"), f"{module}_suite")
    cases = load_cases(name)
    shape = settings.shape or cases.get("shape", "given")
    return run(replace(settings, shape=shape), cases)


def load_cases(name: str) -> dict[str, Any]:
    """Content of a suite's file in `benchmarks/`.

    Raises:
        MissingFileError: It does not come with this installation.
        DamagedFileError: It is not TOML.
    """
    path = artifact_path(f"benchmarks/{name.replace('-', '_')}.toml")
    try:
        with path.open("rb") as file:
            return tomllib.load(file)
    except (tomllib.TOMLDecodeError, OSError) as error:
        raise DamagedFileError(f"{path} is not readable as TOML: {error}") from error


def chosen(settings: SuiteSettings, cases: Mapping[str, Any]) -> dict[str, Any]:
    """The suite's data, with the entries of its table `quick` in their place when asked for."""
    data = {key: value for key, value in cases.items() if key != "quick"}
    if settings.quick:
        data |= cases.get("quick", {})
    for name in ("trackers", "subjects", "strides"):
        wanted = getattr(settings, name)
        if not wanted:
            continue
        if not isinstance(data.get(name), list):
            raise InputError(f"this suite has no {name} to choose from")
        data[name] = list(wanted)
    return data


def judged(
    cases: Sequence[Mapping[str, Any]], targets: Sequence[Mapping[str, Any]], tracker: str
) -> list[Target]:
    """Compare cases with the targets of a suite.

    Args:
        cases: Measured cases.
        targets: Entries `value` and `at_most` or `at_least`. All others are conditions: they must
            be entries of a case, with the same value, for the target to apply to it, such as
            `case`, `tracker` and `shape`.
        tracker: The tracker whose cases must meet the targets that name none.

    Returns:
        The targets whose case was measured.
    """
    found = []
    for target in targets:
        conditions = {"tracker": tracker} | {
            key: value for key, value in target.items() if key not in _GOAL
        }
        for case in cases:
            if any(case.get(key) != value for key, value in conditions.items()):
                continue
            reached: Any = case
            for key in target["value"].split("."):
                reached = reached[key]
            found.append(
                Target(
                    case=case["case"],
                    tracker=case["tracker"],
                    value=target["value"],
                    bound=float(target.get("at_most", target.get("at_least"))),
                    at_most="at_most" in target,
                    reached=float(reached),
                )
            )
    return found
