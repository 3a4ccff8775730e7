"""The trained forests as arrays: stages of a cascade, saved without pickle."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from handtrack.artifacts import artifact_path
from handtrack.errors import DamagedFileError, InputError, MissingFileError
from handtrack.files import UNREADABLE, whole_file
from handtrack.forest.config import ForestConfig

FORMAT_VERSION = 1

PALM_KEYPOINTS: tuple[int, ...] = (0, 1, 5, 9, 13, 17)
"""Keypoints that move with the palm: wrist, thumb CMC, four knuckles; the palm's points."""

MIDDLE_POINT = PALM_KEYPOINTS.index(9)
"""The middle finger's knuckle among them."""

FINGER_KEYPOINTS: tuple[int, ...] = (2, 3, 4, 6, 7, 8, 10, 11, 12, 14, 15, 16, 18, 19, 20)
"""Outer joints of the fingers, three each; a finger's points."""

_SMALL = {
    "anchors": np.int16, "offsets": np.float16, "node_points": np.uint16,
    "thresholds": np.float32, "children": np.int32, "roots": np.int32, "tree_parts": np.int16,
    "updates": np.float16, "leaf_weights": np.float16,
}  # fmt: skip
"""Types on disk."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ForestStage:
    """One stage of a cascade: the trees of one part (palm, hand) or of the five fingers."""

    anchors: NDArray[np.int32]
    """Entry of `Forest.anchor_vertices` of each reference point, -1 for the frame's origin, shape
    (npart, npoint)."""
    offsets: NDArray[np.float32]
    """Offset of each reference point from it in the part's frame [m], shape (npart, npoint, 3)."""
    tree_parts: NDArray[np.int32]
    """Part of each tree, shape (ntree,)."""
    roots: NDArray[np.int32]
    """Root of each tree, shape (ntree,)."""
    node_points: NDArray[np.int32]
    """The two reference points of each node, shape (nnode, 2)."""
    thresholds: NDArray[np.float32]
    """Smaller differences of depth go left [m], shape (nnode,)."""
    children: NDArray[np.int32]
    """Left child, the right one follows; -1 - leaf in leaves; shape (nnode,)."""
    updates: NDArray[np.float32]
    """Displacements of the part's points in its frame [m], shape (nleaf, nmode, npoint, 3)."""
    leaf_weights: NDArray[np.float32]
    """Share of the leaf's samples in each mode, shape (nleaf, nmode)."""


@dataclass(frozen=True, kw_only=True)
class Forest:
    """A trained regressor: cascades for palm and fingers, or for the whole hand."""

    config: ForestConfig
    """How it was made."""
    anchor_vertices: NDArray[np.int32]
    """Vertices of the hand that reference points hang on, shape (nanchor,)."""
    palm: tuple[ForestStage, ...]
    """Stages of the palm, or of the whole hand when `config.structure` is holistic."""
    fingers: tuple[ForestStage, ...] = ()
    """Stages of the fingers; none when holistic."""
    presence: ForestStage | None = None
    """Trees that judge regions: the first coordinate of their updates is the chance that a hand is
    there; None when that was not learnt."""
    facts: dict[str, Any] = field(default_factory=dict)
    """How it was trained: command, seed, time, machine, licence."""

    @property
    def holistic(self) -> bool:
        """Whether one regressor covers the whole hand."""
        return self.config.structure == "holistic"

    def save(self, path: str | Path) -> None:
        """Write the forest to an .npz file, complete or not at all."""
        arrays: dict[str, NDArray] = {"anchor_vertices": self.anchor_vertices.astype(np.int16)}
        groups = {"palm": self.palm, "fingers": self.fingers}
        groups["presence"] = () if self.presence is None else (self.presence,)
        for group, stages in groups.items():
            for number, stage in enumerate(stages):
                for name, dtype in _SMALL.items():
                    arrays[f"{group}_{number}_{name}"] = getattr(stage, name).astype(dtype)
        facts = {"config": asdict(self.config), **self.facts}
        with whole_file(Path(path)) as file:
            np.savez_compressed(
                file, format_version=FORMAT_VERSION, facts=json.dumps(facts), allow_pickle=False,
                **arrays,
            )  # fmt: skip

    @classmethod
    def load(cls, path: str | Path | None = None) -> Forest:
        """Read a forest; the one that comes with handtrack when no path is given.

        Raises:
            MissingFileError: There is no such file.
            DamagedFileError: It is not a forest, or not of this version.
        """
        found = artifact_path("models/forest.npz") if path is None else Path(path)
        if not found.is_file():
            raise MissingFileError(
                f"no forest at {found}: train one with handtrack train-forest --out {found}"
            )
        try:
            with np.load(found, allow_pickle=False) as data:
                if int(data["format_version"]) != FORMAT_VERSION:
                    raise ValueError(
                        f"format {int(data['format_version'])}; this version reads {FORMAT_VERSION}"
                    )
                facts = json.loads(str(data["facts"]))
                config = ForestConfig(**facts.pop("config"))
                forest = cls(
                    config=config,
                    anchor_vertices=data["anchor_vertices"].astype(np.int32),
                    palm=_stages(data, "palm"),
                    fingers=_stages(data, "fingers"),
                    presence=next(iter(_stages(data, "presence")), None),
                    facts=facts,
                )
            _check(forest)
        except (*UNREADABLE, InputError) as error:
            raise DamagedFileError(f"{found} is not a forest: {error}") from error
        return forest


def _stages(data: Any, group: str) -> tuple[ForestStage, ...]:
    """Stages of one cascade, as many as there are."""
    stages = []
    while f"{group}_{len(stages)}_roots" in data.files:
        number = len(stages)
        stages.append(ForestStage(**{
            name: data[f"{group}_{number}_{name}"].astype(
                np.float32 if np.issubdtype(dtype, np.floating) else np.int32
            )
            for name, dtype in _SMALL.items()
        }))  # fmt: skip
    return tuple(stages)


def _check(forest: Forest) -> None:
    """Raise ValueError where an index would lead a kernel out of its arrays."""
    if not forest.palm or (not forest.holistic and not forest.fingers):
        raise ValueError("stages are missing")
    presence = () if forest.presence is None else (forest.presence,)
    joints, modes = len(FINGER_KEYPOINTS), forest.config.leaf_modes
    moved = len(PALM_KEYPOINTS) + joints * forest.holistic
    if forest.anchor_vertices.ndim != 1 or forest.anchor_vertices.min(initial=0) < 0:
        raise ValueError("anchor_vertices are not numbers of vertices")
    for group, parts, output in (
        (forest.palm, 1, (modes, moved, 3)), (forest.fingers, 5, (1, joints // 5, 3)),
        (presence, 1, (1, 1, 3)),
    ):  # fmt: skip
        # All stages of a group share the arrays that rows allocate for the first.
        each = len(group[0].roots) // parts if group else 0
        for stage in group:
            npart, npoint = stage.anchors.shape
            nnode, nleaf = len(stage.children), len(stage.updates)
            inner = stage.children >= 0
            ranges = (
                (stage.anchors, -1, len(forest.anchor_vertices)),
                (stage.tree_parts, 0, npart), (stage.roots, 0, nnode),
                (stage.node_points, 0, npoint), (stage.children[inner] + 1, 0, nnode),
                (-1 - stage.children[~inner], 0, nleaf),
            )  # fmt: skip
            if any(len(v) and (v.min() < low or v.max() >= high) for v, low, high in ranges):
                raise ValueError("an index is out of range")
            # Children after parents: traversal ends.
            if (stage.children[inner] <= np.flatnonzero(inner)).any():
                raise ValueError("a node's child does not follow it")
            shapes = (
                (npart, npoint) == (parts, forest.config.points),
                each > 0, parts == 1 or each <= 64,  # the kernel of medians takes no more
                np.array_equal(stage.tree_parts, np.repeat(np.arange(parts), each)),
                stage.updates.shape == (nleaf, *output), stage.children.shape == (nnode,),
                stage.offsets.shape == (npart, npoint, 3), stage.thresholds.shape == (nnode,),
                stage.node_points.shape == (nnode, 2), stage.roots.shape == stage.tree_parts.shape,
                stage.leaf_weights.shape == stage.updates.shape[:2],
                np.isfinite(stage.updates).all(), np.isfinite(stage.offsets).all(),
            )  # fmt: skip
            if not all(shapes):
                raise ValueError("arrays do not fit together")


def join_trees(stage: ForestStage, trees: list[ForestStage]) -> ForestStage:
    """One stage out of trees that were grown one by one.

    Args:
        stage: Reference points; its trees are ignored.
        trees: One tree each, with its nodes and leaves counted from 0.
    """
    nodes = np.cumsum([0, *(len(tree.children) for tree in trees)])
    leaves = np.cumsum([0, *(len(tree.updates) for tree in trees)])
    children = [
        np.where(tree.children >= 0, tree.children + node, tree.children - leaf)
        for tree, node, leaf in zip(trees, nodes, leaves, strict=False)
    ]
    joined = {
        f.name: np.concatenate([getattr(tree, f.name) for tree in trees])
        for f in fields(ForestStage) if f.name not in ("anchors", "offsets", "children", "roots")
    }  # fmt: skip
    return replace(
        stage, children=np.concatenate(children), roots=nodes[:-1].astype(np.int32), **joined
    )
