"""Poses proposed from one depth image: shape-indexed features, regression forests, modes."""
