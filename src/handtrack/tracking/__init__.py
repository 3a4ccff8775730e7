"""Memory over frames: trackers, their states and results."""
