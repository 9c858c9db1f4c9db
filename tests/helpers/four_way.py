"""Scenario and programs of the examples: fixed places, the paper's observer, fast, and a bit of everything."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

EXAMPLES = Path(__file__).parents[2] / "examples"
FOUR_WAY = str(EXAMPLES / "four_way.toml")
"""Four driven cars between four buildings; everybody sees landmarks ahead."""


def example(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = sys.modules[name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
