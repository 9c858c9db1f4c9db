"""Warp's private interface is used in one file."""

import ast
from pathlib import Path

import coopenv

PRIVATE = {"_cls", "_wp_scalar_type_", "native_func", "hooks", "adj", "runtime"}
PACKAGE = Path(coopenv.__file__).parent
OWN = PACKAGE / "world" / "warp_internals.py"


def private_uses(path: Path) -> list[int]:
    """Return the lines of a file in which private names of Warp stand, as attributes, texts or imports."""
    uses = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if (
            (isinstance(node, ast.Attribute) and (node.attr in PRIVATE or (node.attr == "_src")))
            or (isinstance(node, ast.Attribute) and node.attr == "__class__" and isinstance(node.ctx, ast.Store))
            or (isinstance(node, ast.Constant) and node.value == "_wp_scalar_type_")
            or (isinstance(node, ast.ImportFrom) and (node.module or "").startswith("warp._"))
            or (isinstance(node, ast.Import) and any(alias.name.startswith("warp._") for alias in node.names))
        ):
            uses.append(node.lineno)
    return uses


def test_no_other_file_uses_the_private_interface_of_warp() -> None:
    assert private_uses(OWN)
    found = {str(path): lines for path in PACKAGE.rglob("*.py") if path != OWN and (lines := private_uses(path))}
    assert found == {}
