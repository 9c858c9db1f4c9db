"""A line at the build of a wheel without compiled kernels, which are compiled at the first step instead."""

from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class KernelsHook(BuildHookInterface):
    """Looks for the kernels that `python -m benchmarks.kernels` compiles."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Warn of a wheel without kernels."""
        if version != "editable" and not Path(self.root, "coopenv", "data", "kernels").is_dir():
            self.app.display_warning(
                "THIS WHEEL HAS NO COMPILED KERNELS: the first step of each user compiles them for some 15 s. "
                "Run `python -m benchmarks.kernels` before the build."
            )
