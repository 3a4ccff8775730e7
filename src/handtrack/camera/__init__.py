"""Depth in: the pinhole camera, depth frames, recorded sequences, and where a hand may be."""
