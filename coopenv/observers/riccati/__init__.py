"""The Riccati observer of the paper: kernels with its equations, plug-in, derivatives."""
