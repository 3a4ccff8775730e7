"""Seeing results: overlay pictures and videos, drawn without a window or a GPU's help."""
