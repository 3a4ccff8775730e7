"""Readers of recorded depth sequences, one file per format (docs/formats.md)."""
