"""The suites of `handtrack bench`: one file each, their cases as data in `benchmarks/`."""
