"""Hands of MakeHuman subjects: rest mesh and keypoints in the palm frame, one topology."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hand_builder.anatomy import RIG_BONES, KeypointMap, keypoint_map, to_palm_frame
from hand_builder.cut import HandTopology, cut_hand
from hand_builder.makehuman import (
    PackageFiles,
    Phenotype,
    TargetStore,
    read_base_mesh,
    read_joints,
    read_weights,
    target_weights,
)

Float = NDArray[np.float64]

CUT_ABOVE_WRIST = 0.052
"""Where the forearm is cut on the base mesh [m]; the edge ring beyond it is about 45 mm away."""

REFERENCE = Phenotype(
    gender=0.5, age=0.55, muscle=0.5, weight=0.5, height=0.5, proportions=0.5,
    race=(1 / 3, 1 / 3, 1 / 3),
)  # fmt: skip
"""The subject half-way between everything: finds the fingertips and gives the template."""


@dataclass(frozen=True, slots=True, kw_only=True)
class HandSubject:
    """One subject's right hand at rest, palm frame, metres."""

    vertices: Float
    """Shape (nvert, 3)."""
    keypoints: Float
    """Shape (21, 3)."""

    def scaled(self, factor: float) -> HandSubject:
        """The same hand, larger by `factor`."""
        return HandSubject(vertices=self.vertices * factor, keypoints=self.keypoints * factor)


class SubjectMaker:
    """Makes hands from phenotypes."""

    def __init__(self, wheel: Path | None = None) -> None:
        files = PackageFiles(wheel)
        self.source = files.source
        mesh = read_base_mesh(files)
        joints = read_joints(files, mesh, RIG_BONES)

        def at(name: str) -> Float:
            return mesh.vertices[joints[name].vertex_ids].mean(axis=0)

        self.topology: HandTopology = cut_hand(
            mesh.vertices,
            mesh.groups["body"],
            wrist=at("wrist.R.head"),
            elbow=at("lowerarm01.R.head"),
            above=CUT_ABOVE_WRIST,
        )
        everything = TargetStore(files, np.arange(len(mesh.vertices)))
        reference = mesh.vertices.copy()
        for name, weight in target_weights(REFERENCE).items():
            displacement = everything.get(name)
            if displacement is not None:
                reference += weight * displacement
        self._map: KeypointMap = keypoint_map(joints, reference, self.topology.base_ids)

        self._rows = np.union1d(self.topology.base_ids, self._map.base_ids)
        self._base = mesh.vertices[self._rows]
        self._store = TargetStore(files, self._rows)
        self._skin = np.searchsorted(self._rows, self.topology.base_ids)
        self._marks = np.searchsorted(self._rows, self._map.base_ids)
        self.rig_weights = read_weights(files, len(mesh.vertices))

    def make(self, person: Phenotype) -> HandSubject:
        """The right hand of a subject, in the palm frame."""
        rows = self._base.copy()
        for name, weight in target_weights(person).items():
            displacement = self._store.get(name)
            if displacement is not None:
                rows += weight * displacement
        keypoints = self._map.keypoints(rows[self._marks])
        vertices = self.topology.hand_vertices(rows[self._skin])
        return HandSubject(
            vertices=to_palm_frame(vertices, keypoints),
            keypoints=to_palm_frame(keypoints, keypoints),
        )
