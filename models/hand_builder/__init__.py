"""Builds `models/hand.npz` from the CC0 MakeHuman files; see `models/README.md`."""
