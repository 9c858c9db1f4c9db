"""The observer `robust` in NumPy: the specification of its kernels."""
