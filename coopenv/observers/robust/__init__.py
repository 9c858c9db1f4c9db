"""The observer `robust` (specified in reference/) as Warp functions, embedded in the world's kernels.

Equation by equation it is that observer; its constants are read from there. It computes in float64 whatever the
world's precision, because what a neighbour has learnt is a small difference of large inverses.
"""
