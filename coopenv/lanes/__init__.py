"""Eight worlds side by side in the vector registers of a CPU, from the same Python functions as one world.

Warp compiles C++ for one world. `source` reads it, and `translator` writes it for eight worlds, with the numbers of
`lanes.h`. Worlds that cannot be computed so keep Warp's own kernels.
"""

from coopenv.lanes.translator import in_lanes, lanes_option

__all__ = ["WIDTH", "in_lanes", "lanes_option"]

WIDTH = 8
"""Worlds per vector register of 256 bits."""
