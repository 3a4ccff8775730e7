"""Builds `data/grasps.npz`, the database of grasping motions; prints what was kept and refused.

python models/build_grasps.py --out data/grasps.npz
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT / "models"), str(ROOT / "src")]

import numpy as np  # noqa: E402
from grasp_builder.building import BuildConfig, BuildLog, build_recordings  # noqa: E402

from handtrack.grasp.recording import GraspDatabase  # noqa: E402
from handtrack.grasp.taxonomy import GRIPS  # noqa: E402
from handtrack.hand.model import HandModel  # noqa: E402


def main() -> None:
    """Build, write and report."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, default=ROOT / "data" / "grasps.npz")
    parser.add_argument("--trials", type=int, default=BuildConfig().trials)
    parser.add_argument("--seed", type=int, default=BuildConfig().seed)
    parser.add_argument(
        "--friction-share", type=float, default=BuildConfig().friction_share,
        help="share of the friction that the test of feasibility may use",
    )  # fmt: skip
    args = parser.parse_args()
    started, log = time.perf_counter(), BuildLog()
    config = BuildConfig(
        trials=args.trials, seed=args.seed, friction_share=args.friction_share
    )  # fmt: skip
    made = build_recordings(HandModel.load().shaped(), config, log, GRIPS)
    GraspDatabase(tuple(made)).save(args.out)
    report = {
        "recordings": len(made),
        "kept": dict(log.kept),
        "refused": dict(log.refused.most_common()),
        "deepest skin, mean and largest [mm]": [
            round(1000 * float(f(log.depths)), 2) for f in (np.mean, np.max)
        ],
        "file bytes": args.out.stat().st_size,
        "seconds": round(time.perf_counter() - started, 1),
    }
    print(json.dumps(report, indent=2))


if __name__ == "__main__":
    main()
