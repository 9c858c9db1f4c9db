"""Errors, files, numbers and seeds that all other packages use, and names that are loaded at their first use."""

import ast
import sys
from collections.abc import Callable
from importlib import import_module
from importlib.util import find_spec
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
            raise AttributeError(f"module '{package}' has no attribute '{name}'{hint(name)}")
        value = getattr(import_module(str(module_of[name])), name)
        setattr(module, name, value)
        return value

    def hint(name: str) -> str:
        """Return a hint for an unknown public name: a package below this one, the shell, or a similar name."""
        if name.startswith("_"):
            return ""
        for file in Path(str(module.__file__)).parent.glob("*/__init__.py"):
            lists = [n for n in ast.parse(file.read_text(encoding="utf-8")).body if isinstance(n, ast.Assign)]
            if any(ast.unparse(n.targets[0]) == "__all__" and name in ast.literal_eval(n.value) for n in lists):
                return f" (from {package}.{file.parent.name} import {name})"
        commands = import_module(f"{package}.cli.app").app if find_spec(f"{package}.cli") else None
        if commands and name in import_module("typer.main").get_group(commands).commands:
            return f" (in the shell: {package} {name})"
        return suggest(name, module.__all__) or f"; known: {listed(module.__all__, 40)}"

    return get, lambda: sorted(module.__all__)
