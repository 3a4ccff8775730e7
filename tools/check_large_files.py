"""Keep large files out of the repository: history never forgets them.

Usage: python tools/check_large_files.py [FILE...]   (all files git tracks by default)
"""

from __future__ import annotations

import subprocess
import sys
from fnmatch import fnmatch
from pathlib import Path

LIMITS_MB: dict[str, float] = {
    "models/hand.npz": 4.0,
    "models/pose_prior.npz": 1.0,
    "models/forest.npz": 40.0,
    "data/*": 3.0,
    "docs/*": 2.0,
    "*": 0.5,
}
"""Largest size [MB] by pattern; the first pattern that fits a path counts."""


def problem_with(name: str, size: int) -> str | None:
    """What is wrong with a file of that name and size in bytes, or None."""
    limit = next(limit for pattern, limit in LIMITS_MB.items() if fnmatch(name, pattern))
    if size <= limit * 1e6:
        return None
    return f"{name} has {size / 1e6:.1f} MB, at most {limit:g} MB may be committed"


def main(arguments: list[str]) -> int:
    """Check files and print which are too large; 1 if any is."""
    root = Path(__file__).resolve().parents[1]
    if not arguments:
        listing = subprocess.run(
            ["git", "ls-files", "-z"], cwd=root, capture_output=True, text=True, check=False
        )
        arguments = [name for name in listing.stdout.split("\0") if name]
    problems = [
        problem
        for name in arguments
        if (root / name).is_file() and (problem := problem_with(name, (root / name).stat().st_size))
    ]
    for problem in problems:
        print(problem)
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
