"""Tracked hands for other programs: files in their formats, and frames over a WebSocket."""
