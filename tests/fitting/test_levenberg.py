"""Levenberg damping: steps are accepted when the energy falls, else taken back."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from handtrack.fitting.config import FitConfig
from handtrack.kernels import solve
from handtrack.transforms import pose_difference


class Judgements:
    """Every accept-or-reject of a fitter that runs eagerly: energies, poses, damping."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.tried, self.best, self.damping = [], [], []
        self.tried_poses, self.best_poses = [], []
        judge = solve.judge_step

        def spy(totals, pose, *rest, **options):
            judge(totals, pose, *rest, **options)
            self.tried.append(totals.numpy().copy())
            self.best.append(options["best_totals"].numpy().copy())
            self.damping.append(options["damping"].numpy().copy())
            self.tried_poses.append(pose.numpy().copy())
            self.best_poses.append(options["best_pose"].numpy().copy())

        monkeypatch.setattr(solve, "judge_step", spy)


LEVENBERG = FitConfig(
    levenberg=True,
    damping=1e-4,
    crop_cells=64,
    smooth_weight=0.01,
    robust_start=0.015,
    robust_scale=0.015,
)
"""Bold steps on one and the same energy, so that some are rejected."""


def energies(scene, device, monkeypatch, config: FitConfig, poses: np.ndarray) -> np.ndarray:
    """Energy of Eq. II.21 and the other terms at given poses, the starts as references."""
    single = replace(config, iterations=1, robust_start=config.robust_scale, levenberg=True)
    with monkeypatch.context() as patch:
        judged = Judgements(patch)
        fitter = scene.fitter(device, config=single, graph=False)
        fitter.set_poses(poses, scene.start)
        fitter.run()
        return judged.tried[0]


def test_accepted_steps_never_raise_the_energy(make_scene, device, monkeypatch) -> None:
    scene = make_scene(count=6)
    judged = Judgements(monkeypatch)
    fitter = scene.fitter(device, config=replace(LEVENBERG, iterations=12), graph=False)
    fitter.run()
    tried, best = np.array(judged.tried), np.array(judged.best)
    assert len(tried) >= 12
    # The best so far is the running minimum of what was tried, and only better poses are kept.
    np.testing.assert_array_equal(best, np.minimum.accumulate(tried))
    accepted = (np.array(judged.tried_poses) == np.array(judged.best_poses)).all(-1)
    np.testing.assert_array_equal(accepted[1:], tried[1:] <= best[:-1])
    damping = np.array(judged.damping)
    assert (damping[1:][accepted[1:]] <= damping[:-1][accepted[1:]]).all()
    assert (damping[1:][~accepted[1:]] > damping[:-1][~accepted[1:]]).all()
    # Both paths were taken, and the fit did fall far below its start.
    assert accepted[1:].any() and not accepted[1:].all()
    assert (best[-1] < 0.5 * tried[0]).all()


def test_a_step_is_judged_by_one_energy(make_scene, device, monkeypatch) -> None:
    # While the robust scale shrinks from step to step, energies of different steps do not compare.
    scene = make_scene(count=6)
    config = replace(LEVENBERG, iterations=6, robust_start=0.05, robust_scale=0.01)
    with monkeypatch.context() as patch:
        judged = Judgements(patch)
        scene.fitter(device, config=config, graph=False).run()
    for step in range(1, 6):
        same = replace(config, robust_scale=config.robust_scales()[step])
        before = energies(scene, device, monkeypatch, same, judged.best_poses[step - 1])
        after = energies(scene, device, monkeypatch, same, judged.best_poses[step])
        assert (after <= before * (1 + 1e-5)).all(), f"step {step}"


@pytest.mark.parametrize("iterations", [1, 2, 3, 4, 6])
def test_the_pose_handed_back_has_the_lowest_energy_found(
    make_scene, device, monkeypatch, iterations
) -> None:
    scene = make_scene(count=12)
    config = replace(LEVENBERG, iterations=iterations)
    with monkeypatch.context() as patch:
        judged = Judgements(patch)
        fitter = scene.fitter(device, config=config, graph=False)
        fitter.run()
    after = energies(scene, device, monkeypatch, config, fitter.poses)
    assert (after <= np.min(judged.tried, axis=0) * (1 + 1e-5)).all()


@pytest.mark.parametrize("levenberg", [False, True])
def test_an_unusable_start_pose_is_never_replaced_by_an_older_one(
    make_scene, device, quick_config, levenberg
) -> None:
    scene = make_scene(count=2)
    fitter = scene.fitter(device, config=replace(quick_config, levenberg=levenberg))
    fitter.run()
    older = fitter.poses
    starts = scene.start.copy()
    starts[1] = np.nan
    fitter.set_poses(starts)
    fitter.run()
    # What cannot be fitted stays what it was: the caller sees it, and no stale pose passes for new.
    assert not np.isfinite(fitter.poses[1]).all()
    assert np.abs(pose_difference(fitter.poses[0], older[0])).max() < 1e-5
