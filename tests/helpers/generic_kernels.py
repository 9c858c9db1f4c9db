"""A plugin of pytest: Warp compiles kernels for any processor, whose last bits differ from those of this machine's."""

from __future__ import annotations

import warp as wp

wp.config.cpu_compiler_flags = ""
