"""Learning a hand model from scans (thesis II.3.5, Eq. II.10).

    scans -> first poses -> [ correspondences -> bones, offsets, poses of each subject
                              -> weights on all subjects ] x rounds -> PCA -> HandModel

Subjects are independent of each other within a round and are spread over processes; a scan is read
when its subject's turn comes, so memory does not grow with their number.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, cast

import numpy as np
from joblib import Parallel, delayed
from numpy.typing import NDArray

from handtrack.errors import InputError
from handtrack.files import whole_file
from handtrack.hand.learning.options import LearningOptions
from handtrack.hand.learning.posed_template import Template
from handtrack.hand.learning.scans import Scan, ScanFile, read_scan
from handtrack.hand.learning.shape_bases import ShapeBases, learn_bases
from handtrack.hand.learning.subject import (
    PopulationMean,
    SubjectFit,
    SubjectFitter,
    start_subject,
)
from handtrack.hand.learning.weights import (
    WeightSupport,
    learn_weights,
    slot_weights,
)
from handtrack.hand.model import FORMAT_VERSION, HandModel

Float = NDArray[np.float64]
Scans = Sequence[ScanFile] | Sequence[Scan]

Progress = Callable[[int, int, int], None]
"""Called with the round, the subjects done in it, and their number."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LearntHand:
    """What was learnt."""

    model: HandModel
    """Hand model with learnt weights and shape space."""
    bases: ShapeBases
    """Its shape space with the variance that each component explains."""
    subjects: Mapping[str, SubjectFit]
    """Shape and poses of every subject, with the weights of the last round."""
    residuals: tuple[tuple[float, ...], ...]
    """Mean distance of vertices from their matches [m] by round and step, over all subjects."""

    def save(self, path: str | Path, *, source: str, licence: str) -> None:
        """Write the model in the format of `HandModel.load`.

        Args:
            path: The .npz file.
            source: Where the scans came from.
            licence: Licence of the result.
        """
        arrays: dict[str, Any] = {
            "format_version": FORMAT_VERSION,
            "source": source,
            "licence": licence,
            "scale_variance": self.bases.scale_variance,
            "offset_variance": self.bases.offset_variance,
        }
        arrays |= {f.name: np.asarray(getattr(self.model, f.name)) for f in fields(HandModel)}
        with whole_file(Path(path)) as file:
            np.savez_compressed(file, **arrays)


def learn_hand(
    scans: Mapping[str, Scans],
    poses: Mapping[str, Float],
    *,
    template: HandModel | None = None,
    options: LearningOptions | None = None,
    jobs: int = 1,
    progress: Progress | None = None,
) -> LearntHand:
    """Learn skinning weights and shape space from scans.

    Args:
        scans: Scans by subject, as `find_scans` finds them or in memory.
        poses: Joint angles [rad], shape (21,), by the names of poses that scans carry.
        template: Model that gives the template mesh, its skeleton and the first weights; its shape
            space is not used. The one that comes with handtrack when None.
        options: Settings.
        jobs: Processes; -1 for one per core.
        progress: Told after every subject.

    Returns:
        The model, and what was found of every subject.

    Raises:
        InputError: There are fewer than two subjects, or a scan's pose has no angles.
        DamagedFileError: A file is no mesh.
    """
    options = options or LearningOptions()
    current = Template.of(template if template is not None else HandModel.load())
    _check_scans(scans, poses)
    support = WeightSupport.of(current.model)
    mean = PopulationMean.of(current, [current.shape()])
    weights = support.first
    fits: dict[str, SubjectFit] = {}
    history: list[tuple[float, ...]] = []
    with Parallel(n_jobs=jobs, return_as="generator") as parallel:
        for number in range(options.rounds):
            last = number == options.rounds - 1
            calls = (
                delayed(_fit_subject)(
                    current, scans[name], poses, fits.get(name), mean, support.bones, options
                )
                for name in scans
            )
            outcomes = cast("Iterable[tuple[SubjectFit, Float]]", parallel(calls))
            forms = np.zeros((len(support.bones), *2 * support.bones.shape[1:]))
            for done, (name, (fit, said)) in enumerate(zip(scans, outcomes, strict=True), 1):
                fits[name] = fit
                forms += said
                if progress is not None:
                    progress(number, done, len(scans))
            steps = np.mean([fit.residuals for fit in fits.values()], axis=0)
            history.append(tuple(steps[sum(map(len, history)) :].tolist()))
            if not last:
                mean = PopulationMean.of(current, [fit.shape for fit in fits.values()])
                if options.learn_weights:
                    weights = learn_weights(
                        forms, support, weights, current.model.faces, options.weight_std
                    )
                    current = current.with_weights(*slot_weights(weights))
    bases = learn_bases(current, [fit.shape for fit in fits.values()], options.share)
    return LearntHand(
        model=bases.model(current), bases=bases, subjects=fits, residuals=tuple(history)
    )


def _check_scans(scans: Mapping[str, Scans], poses: Mapping[str, Float]) -> None:
    """Refuse what cannot be learnt from before any time is spent."""
    if len(scans) < 2:
        raise InputError(f"scans of {len(scans)} subject: a shape space needs two subjects or more")
    for subject, own in scans.items():
        for scan in own:
            if scan.pose not in poses:
                raise InputError(
                    f"subject {subject} was scanned in a pose {scan.pose!r} that has no angles;"
                    f" known are {', '.join(sorted(poses))}"
                )


def _fit_subject(
    template: Template,
    scans: Scans,
    poses: Mapping[str, Float],
    fit: SubjectFit | None,
    mean: PopulationMean,
    bones: NDArray[np.intp],
    options: LearningOptions,
) -> tuple[SubjectFit, Float]:
    """One subject's round, and what it says about the weights."""
    read = [
        scan
        if isinstance(scan, Scan)
        else read_scan(scan, template_faces=template.model.faces, max_points=options.max_points)
        for scan in scans
    ]
    angles = np.array([poses[scan.pose] for scan in read])
    fitter = SubjectFitter(template, read, angles, mean, options)
    if fit is None:
        fit = fitter.begin(start_subject(template, read, angles))
    fit = fitter.improve(fit, options.steps)
    return fit, fitter.weight_terms(fit, bones)
