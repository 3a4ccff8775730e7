"""Which poses are plausible."""
