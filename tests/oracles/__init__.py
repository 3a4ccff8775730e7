"""Independent float64 NumPy oracles, written from equations and docstrings, not from kernels."""
