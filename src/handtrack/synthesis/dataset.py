"""Training data: subjects x poses x viewpoints, rendered with sensor noise (thesis II.4.4).

Every random choice of sample i follows from (seed, i) alone, whatever is rendered with it, so parts
can be made in any order, on several machines, or again.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

from handtrack.artifacts import artifact_path
from handtrack.camera.camera import Camera
from handtrack.errors import InputError
from handtrack.hand.kinematics import keypoints
from handtrack.hand.model import HandModel, ShapedHand
from handtrack.hand.shape import HandShape
from handtrack.hand.side import mirror_pose
from handtrack.priors.gaussian import GaussianPrior
from handtrack.synthesis.collision import HandSpheres
from handtrack.synthesis.noise import noise_preset
from handtrack.synthesis.pose_sampler import PoseSampler
from handtrack.synthesis.poses import POSES_FILE, load_poses
from handtrack.synthesis.renderer import DepthRenderer
from handtrack.synthesis.scenery import add_body, add_occluder, camera_rays
from handtrack.synthesis.sequence import CAMERAS
from handtrack.synthesis.viewpoints import place_in_view, random_elbow, random_rotation
from handtrack.transforms import matrix_to_quat

_SUBJECT, _POSE, _VIEW, _ORDER = 1, 2, 3, 4
"""Streams of random numbers, apart from each other."""

_SOURCES = ("models/hand.npz", "models/pose_prior.npz", POSES_FILE)
"""What samples are made from, beside the settings."""

_MIRROR = np.array([-1.0, 1.0, 1.0])
"""Mirror of the camera frame that goes with `mirror_pose`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DatasetConfig:
    """What is in a data set; the defaults are the thesis' numbers."""

    subjects: int = 40
    """Hands drawn from the shape space."""
    poses: int = 200
    """Joint angles per subject."""
    viewpoints: int = 40
    """Places of the hand before the camera per pose."""
    seed: int = 0
    """Seed of everything."""
    side: str = "right"
    """right or left."""
    camera: Camera = CAMERAS["creative"]
    """Camera that sees the hands."""
    noises: tuple[str, ...] = ("time_of_flight", "structured_light", "coded_light")
    """Sensor noise, one of these presets for each sample."""
    library_share: float = 0.6
    """Share of poses that are named ones with perturbations; the others follow the prior."""
    perturbation: float = math.radians(9.0)
    """Standard deviation of the angles about a named pose [rad]."""
    max_penetration: float = 0.005
    """Deepest overlap of fingers [m]; recorded fists reach twice that on the same spheres."""
    shape_deviation: float = 1.0
    """Spread of the subjects, in standard deviations of the population."""
    distance: tuple[float, float] = (0.2, 0.9)
    """Smallest and largest depth of the palm [m]."""
    occluder_share: float = 0.15
    """Share of samples with an object before the hand."""
    body_share: float = 0.3
    """Share of samples with a surface 0.1 to 0.5 m behind the hand."""

    def __post_init__(self) -> None:
        """Check ranges.

        Raises:
            InputError: A setting is out of range.
        """
        for name in ("subjects", "poses", "viewpoints"):
            if getattr(self, name) < 1:
                raise InputError(f"{name} is {getattr(self, name)}: expected 1 or more")
        if self.seed < 0:
            raise InputError(f"seed is {self.seed}: expected 0 or more")
        if self.side not in ("right", "left"):
            raise InputError(f"side is {self.side!r}: expected 'right' or 'left'")
        if not self.noises:
            raise InputError("noises is empty: expected names of presets, such as 'none'")
        for name in self.noises:
            noise_preset(name)
        for name in ("library_share", "occluder_share", "body_share"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise InputError(f"{name} is {getattr(self, name)}: expected 0 to 1")
        for name in ("perturbation", "max_penetration", "shape_deviation"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) >= 0.0):
                raise InputError(f"{name} is {getattr(self, name)}: expected a number from 0")
        low, high = self.distance
        if not 0.0 < low <= high <= 5.0:
            raise InputError(f"distance is {self.distance}: expected 0 < smallest <= largest <= 5")

    def __len__(self) -> int:
        return self.subjects * self.poses * self.viewpoints


DATASETS: dict[str, DatasetConfig] = {
    "small": DatasetConfig(subjects=4, poses=50, viewpoints=5),
    "paper": DatasetConfig(),
}
"""Presets: 1,000 samples in a minute or so, and the thesis' 320,000."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DatasetBatch:
    """Rendered samples with their truth."""

    indices: NDArray[np.int64]
    """Number of each sample, shape (n,)."""
    depth: NDArray[np.float32]
    """Depth [m], shape (n, height, width), 0 = no measurement."""
    poses: NDArray[np.float64]
    """True poses, shape (n, 28)."""
    keypoints: NDArray[np.float32]
    """True keypoints [m], camera frame, shape (n, 21, 3)."""
    elbows: NDArray[np.float32]
    """Elbows [m], camera frame, shape (n, 3)."""
    subject: NDArray[np.int32]
    """Subject, shape (n,)."""
    named_pose: NDArray[np.int32]
    """Named pose that was perturbed, index into `SyntheticDataset.pose_names`; -1: prior; (n,)."""
    noise: NDArray[np.int32]
    """Index into `DatasetConfig.noises`, shape (n,)."""
    hidden: NDArray[np.float32]
    """Share of the hand's and forearm's pixels behind an occluder, 0 without one, shape (n,)."""
    body: NDArray[np.bool_]
    """There is a surface behind the hand, shape (n,)."""

    def __len__(self) -> int:
        return len(self.indices)


class SyntheticDataset:
    """Makes samples of a configuration on demand; holds one subject's buffers at a time."""

    def __init__(
        self, config: DatasetConfig, *, device: str | None = None, batch: int = 16
    ) -> None:
        """Load models.

        Args:
            config: What to make.
            device: "cpu", "cuda:N" or None for the best there is.
            batch: Images rendered per call of the kernels; does not change the samples.
        """
        self.config = config
        self._device, self._batch = device, batch
        self._model = HandModel.load()
        self._prior = GaussianPrior.load()
        unique: dict[bytes, tuple[str, NDArray[np.float64]]] = {}
        for name, angles in load_poses().items():
            unique.setdefault(angles.tobytes(), (name, angles))
        self.pose_names = tuple(name for name, _ in unique.values())
        """Named poses, each shape once."""
        self._library = np.array([angles for _, angles in unique.values()])
        self._rays = camera_rays(config.camera)
        self._noises = [noise_preset(name) for name in config.noises]
        self._subject = -1

    def __len__(self) -> int:
        return len(self.config)

    @property
    def fingerprint(self) -> str:
        """Hash of all settings and of the files that samples are made from."""
        told = hashlib.sha256(json.dumps(asdict(self.config), sort_keys=True).encode())
        for name in _SOURCES:
            told.update(artifact_path(name).read_bytes())
        return told.hexdigest()[:16]

    def shape(self, subject: int) -> HandShape:
        """Hand shape of a subject."""
        rng = self._rng(_SUBJECT, subject)
        return self._model.sample_shape(rng, deviation=self.config.shape_deviation)

    def subjects(self) -> list[ShapedHand]:
        """Right hands of all subjects."""
        return [self._model.shaped(self.shape(number)) for number in range(self.config.subjects)]

    def batches(
        self, start: int = 0, stop: int | None = None, *, size: int = 64
    ) -> Iterator[DatasetBatch]:
        """Samples from `start` to before `stop`, in order, `size` at a time.

        Raises:
            InputError: The range is not within the data set.
        """
        stop = len(self) if stop is None else stop
        if not 0 <= start <= stop <= len(self) or size < 1:
            raise InputError(
                f"samples {start}:{stop} in batches of {size}: expected a range within "
                f"0:{len(self)} and batches of 1 or more"
            )
        for first in range(start, stop, size):
            yield self.render(range(first, min(first + size, stop)))

    def render(self, indices: Sequence[int]) -> DatasetBatch:
        """Make any samples, such as a shuffled batch; fastest where subjects come in runs.

        Raises:
            InputError: There is no sample of such a number.
        """
        wanted = np.asarray(indices, np.int64)
        if wanted.ndim != 1 or ((wanted < 0) | (wanted >= len(self))).any():
            raise InputError(f"samples {indices}: expected numbers of 0 to {len(self) - 1}")
        count, camera = len(wanted), self.config.camera
        batch = DatasetBatch(
            indices=wanted,
            depth=np.zeros((count, *camera.shape), np.float32),
            poses=np.zeros((count, 28)),
            keypoints=np.zeros((count, 21, 3), np.float32),
            elbows=np.zeros((count, 3), np.float32),
            subject=(wanted // (self.config.poses * self.config.viewpoints)).astype(np.int32),
            named_pose=np.full(count, -1, np.int32),
            noise=np.zeros(count, np.int32),
            hidden=np.zeros(count, np.float32),
            body=np.zeros(count, bool),
        )
        for subject in np.unique(batch.subject):
            self._wear(int(subject))
            self._fill(batch, np.flatnonzero(batch.subject == subject))
        return batch

    def _rng(self, stream: int, *numbers: int) -> np.random.Generator:
        return np.random.default_rng([self.config.seed, stream, *numbers])

    def _wear(self, subject: int) -> None:
        """Get ready for a subject."""
        if subject == self._subject:
            return
        config = self.config
        shape = self.shape(subject)
        self._right = self._model.shaped(shape)
        self._hand = self._model.shaped(shape, side=config.side)
        self._renderer = DepthRenderer(
            self._hand, config.camera, device=self._device, batch=self._batch
        )
        self._sampler = PoseSampler(
            HandSpheres.of(self._right), self._prior,
            perturbation=config.perturbation, max_penetration=config.max_penetration,
        )  # fmt: skip
        # Named poses take turns, in another order for each subject.
        self._order = self._rng(_ORDER, subject).permutation(len(self._library))
        self._angles: dict[int, tuple[int, NDArray[np.float64]]] = {}
        self._subject = subject

    def _pose(self, number: int) -> tuple[int, NDArray[np.float64]]:
        """Named pose, -1 for none, and joint angles [rad] of one of the subject's poses."""
        if number not in self._angles:
            rng = self._rng(_POSE, self._subject, number)
            if number < round(self.config.library_share * self.config.poses):
                named = int(self._order[number % len(self._order)])
                self._angles[number] = named, self._sampler.around(self._library[named], rng)
            else:
                self._angles[number] = -1, self._sampler.from_prior(rng)
        return self._angles[number]

    def _fill(self, batch: DatasetBatch, rows: NDArray[np.intp]) -> None:
        """Make the samples of one subject."""
        config = self.config
        rngs, elbows = [], np.zeros((len(rows), 3))
        for place, row in enumerate(rows):
            sample = int(batch.indices[row])
            batch.named_pose[row], angles = self._pose(sample // config.viewpoints % config.poses)
            rng = self._rng(_VIEW, sample)
            batch.poses[row], elbows[place] = self._view(angles, rng)
            rngs.append(rng)
        points = keypoints(self._hand, batch.poses[rows])
        batch.keypoints[rows], batch.elbows[rows] = points, elbows
        clean = self._renderer.render(batch.poses[rows], elbows=elbows)
        for row, image, point, rng in zip(rows, clean, points, rngs, strict=True):
            occluded, batch.body[row] = rng.random(2) < (config.occluder_share, config.body_share)
            batch.noise[row] = rng.integers(len(self._noises))
            if occluded:
                image, batch.hidden[row] = add_occluder(image, self._rays, point, rng)
            if batch.body[row]:
                image = add_body(image, self._rays, point, rng)
            batch.depth[row] = self._noises[batch.noise[row]].apply(image, config.camera, rng)

    def _view(
        self, angles: NDArray[np.float64], rng: np.random.Generator
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Pose, shape (28,), and elbow [m], camera frame, shape (3,), of one viewpoint."""
        rotation = random_rotation(rng)
        pose = np.concatenate([np.zeros(3), matrix_to_quat(rotation), angles])
        elbow = rotation @ random_elbow(rng)
        points = keypoints(self._right, pose)
        if self.config.side == "left":
            pose, points, elbow = mirror_pose(pose), points * _MIRROR, elbow * _MIRROR
        pose[:3] = place_in_view(
            points, elbow, self.config.camera, rng, distance=self.config.distance
        )
        return pose, elbow + pose[:3]
