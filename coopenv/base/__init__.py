"""Errors, files, numbers and seeds that all other packages use, and names that are loaded at their first use."""

import ast
import re
import sys
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

from coopenv.base.errors import listed, suggest


def lazy_names(package: str) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """Return `__getattr__` and `__dir__` of a package whose names are loaded at their first use (PEP 562).

    They are the names that the package imports for type checkers alone, in its block `if TYPE_CHECKING`.
    """
    module = sys.modules[package]
    source = ast.parse(Path(str(module.__file__)).read_text(encoding="utf-8"))
    blocks = [node for node in source.body if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"]
    imports = [node for block in blocks for node in block.body if isinstance(node, ast.ImportFrom)]
    module_of = {of.name: node.module for node in imports for of in node.names}

    def get(name: str) -> Any:
        if name not in module_of:
            near = suggest(name, module.__all__) or f"; known: {listed(module.__all__, 40)}"
            there = "" if name.startswith("_") else below(name) or near
            raise AttributeError(f"module '{package}' has no attribute '{name}'{there}")
        value = getattr(import_module(str(module_of[name])), name)
        setattr(module, name, value)
        return value

    def below(name: str) -> str:
        """Return in which package below this one a public name is, or that it is a command."""
        for file in Path(str(module.__file__)).parent.glob("*/__init__.py"):
            text = file.read_text(encoding="utf-8")
            if re.search(rf'^__all__ = \[[^\]]*"{name}"', text, re.MULTILINE):
                return f" (from {package}.{file.parent.name} import {name})"
            if re.search(rf"^(from {package}\.cli\.\w+ import .*\b|def ){name}\b", text, re.MULTILINE):
                return f" (in the shell: {package} {name})"
        return ""

    def public_names() -> list[str]:
        return sorted(module.__all__)

    return get, public_names
