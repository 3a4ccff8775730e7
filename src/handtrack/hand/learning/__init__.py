"""Learning the hand model from scans of people (thesis II.3.5, Eq. II.10).

    scans -> first poses -> [ correspondences -> bones, offsets, poses of each subject
                              -> weights on all subjects ] x rounds -> PCA -> HandModel

`models/learn_hand.py` is the command; docs/learning.md describes scans, commands and results.
"""

from handtrack.hand.learning.learn import LearntHand, learn_hand
from handtrack.hand.learning.options import LearningOptions
from handtrack.hand.learning.scans import Scan, ScanFile, find_scans, read_scan

__all__ = [
    "LearningOptions",
    "LearntHand",
    "Scan",
    "ScanFile",
    "find_scans",
    "learn_hand",
    "read_scan",
]
