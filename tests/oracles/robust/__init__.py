"""The observer `robust` in NumPy, written apart from its kernels, which it checks; the constants alone are theirs."""
