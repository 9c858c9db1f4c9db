"""Errors, files, numbers and seeds that all other packages use, and names that are loaded at their first use."""

import sys
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from typing import Any


def lazy_names(
    package: str, homes: Mapping[str, Sequence[str]]
) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """Return `__getattr__` and `__dir__` of a package whose names are loaded at their first use (PEP 562).

    Args:
        package: its name.
        homes: module to the names that it holds.
    """
    module_of = {name: module for module, names in homes.items() for name in names}
    module = sys.modules[package]

    def get(name: str) -> Any:
        if name not in module_of:
            raise AttributeError(f"module '{package}' has no attribute '{name}'")
        value = getattr(import_module(module_of[name]), name)
        setattr(module, name, value)
        return value

    def public_names() -> list[str]:
        return sorted(module.__all__)

    return get, public_names
