"""The observer `robust` as Warp functions: observer.py is one tick, and the place to begin.

They run embedded in the world's kernels, and for one vehicle on the host.
`tests/observers/robust` compares functions with SciPy, and whole filters with their invariances and bounds.
"""
