"""Labelled depth frames from motion, subjects and sensor noise: for tests, samples and training."""
