"""Independent float64 NumPy oracles, written from the equations and docstrings, not from the kernels."""
