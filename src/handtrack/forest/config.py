"""Settings of the regression forests and of their training (thesis II.4)."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from handtrack.errors import InputError
from handtrack.synthesis.dataset import DATASETS, DatasetConfig

Features = Literal["shape-indexed", "pose-indexed"]
"""Reference points of features: mesh vertices (Eq. II.15), or frame origins (Eq. II.14)."""

Structure = Literal["hierarchical", "holistic"]
"""Palm first and then every finger (Eq. II.17, II.18), or all joints at once (Eq. II.16)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ForestConfig:
    """What a forest looks at and how large it is."""

    features: Features = "shape-indexed"
    """How reference points are chosen."""
    structure: Structure = "hierarchical"
    """What one regressor covers."""
    stages: int = 3
    """Length C of the cascade."""
    trees: int = 10
    """Trees per forest and stage."""
    depth: int = 15
    """Deepest level of a tree."""
    min_leaf: int = 10
    """Fewest samples in a leaf."""
    points: int = 400
    """Reference points per part and stage; a feature is the difference of two of them."""
    candidates: int = 160
    """Features tried per node, each with one threshold."""
    node_samples: int = 3000
    """Samples of a node at most on which a feature is judged."""
    leaf_modes: int = 2
    """Modes kept per leaf of the palm's forest."""
    presence_trees: int = 30
    """Trees that tell hands from other regions."""
    presence_candidates: int = 600
    """Features that these try per node."""
    bag: float = 0.65
    """Share of samples that a tree learns from; the others tell the next stage honestly what this
    one leaves over."""

    crop_cells: int = 112
    """Cells along one side of the crop that features read."""
    crop_span: float = 0.448
    """Width of that crop at the hand's distance [m]."""
    gate_radius: float = 0.15
    """Radius of the ball around the expected hand outside of which everything is background [m]."""
    depth_range: float = 0.15
    """Depths are clipped to so much before and behind a frame's origin; background counts as that
    far behind [m]."""

    modes: int = 8
    """Palm hypotheses carried through the cascade."""
    mode_radius: float = 0.03
    """Votes whose palm points lie closer than this on average belong to one mode [m]."""

    def __post_init__(self) -> None:
        """Check ranges.

        Raises:
            InputError: A setting is out of range.
        """
        if self.features not in ("shape-indexed", "pose-indexed"):
            raise InputError(
                f"features are {self.features!r}; expected shape-indexed or pose-indexed"
            )
        if self.structure not in ("hierarchical", "holistic"):
            raise InputError(f"structure is {self.structure!r}; expected hierarchical or holistic")
        for name in (
            "stages", "trees", "depth", "min_leaf", "candidates", "node_samples", "modes",
            "presence_trees", "presence_candidates",
        ):  # fmt: skip
            if getattr(self, name) < 1:
                raise InputError(f"{name} is {getattr(self, name)}; expected at least 1")
        if not 1 <= self.leaf_modes <= 4 or not 2 <= self.points <= 4096:
            raise InputError(
                f"leaf_modes and points are {self.leaf_modes} and {self.points}; expected 1 to 4 "
                "and 2 to 4096"
            )
        if not 0 < self.bag < 1:
            raise InputError(f"bag is {self.bag}; expected between 0 and 1")
        if self.trees > 64 or self.depth_range > 0.3:
            raise InputError(
                f"trees and depth_range are {self.trees} and {self.depth_range}; expected at most "
                "64, of which medians are taken, and 0.3 m, which 16 bits hold"
            )
        for name in ("crop_span", "gate_radius", "depth_range", "mode_radius"):
            if not 0 < getattr(self, name) < 10:
                raise InputError(f"{name} is {getattr(self, name)}; expected metres above 0")
        if self.crop_cells < 16:
            raise InputError(f"crop_cells is {self.crop_cells}; expected at least 16")


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainingConfig:
    """What a forest learns from."""

    forest: ForestConfig = field(default_factory=ForestConfig)
    """The forest."""
    dataset: DatasetConfig = field(default_factory=DatasetConfig)
    """Labelled frames."""
    scenes: DatasetConfig = field(
        default_factory=lambda: DatasetConfig(subjects=40, poses=100, viewpoints=2, seed=1000)
    )
    """Hands of the scenes from which the forest learns what is no hand."""
    starts: int = 2
    """Start poses per frame that the palm's forest learns from, of the four that the axes allow."""
    centre_spread: float = 0.02
    """Deviation of the expected hand's centre from what is seen of the hand [m]."""
    forearm_shift: float = 0.09
    """Farthest that centre slips towards the forearm [m]."""
    mean_share: float = 0.5
    """Share of frames that are learnt with the mean hand's mesh instead of the subject's own, as
    trackers see people whose shape they do not know."""
    palm_spread: float = 0.006
    """Deviation of the palm under which fingers are learnt [m]."""
    palm_turn: float = 0.12
    """Deviation of its direction [rad]."""
    seed: int = 0
    """Seed of features, bags and start poses."""


PRESETS: dict[str, TrainingConfig] = {
    "small": TrainingConfig(
        forest=ForestConfig(
            trees=5, depth=10, points=200, candidates=80, presence_trees=5, presence_candidates=80
        ),
        dataset=DATASETS["small"],
        scenes=DatasetConfig(subjects=4, poses=25, viewpoints=2, seed=1000),
    ),
    "medium": TrainingConfig(dataset=DatasetConfig(subjects=80, poses=150, viewpoints=4)),
    "large": TrainingConfig(dataset=DatasetConfig(subjects=200, poses=300, viewpoints=2)),
    "paper": TrainingConfig(dataset=DATASETS["paper"]),
}
"""1,000 frames, minutes, for tests; 48,000; 120,000; the thesis' 320,000 frames."""
