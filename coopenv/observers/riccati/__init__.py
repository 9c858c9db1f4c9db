"""The Riccati observer of the paper: equations, kernels, plug-in, derivatives."""
