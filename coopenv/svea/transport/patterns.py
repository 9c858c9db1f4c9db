"""Which topics a pattern means; the same as Zenoh's key expressions, for networks that have others or none."""

import re
from collections.abc import Callable


def matcher(pattern: str) -> Callable[[str], bool]:
    """Return what tells whether a topic matches: `*` stands for one part of it, `**` for any number, none included."""
    parts = ("(?:[^/]+/)*" if part == "**" else _part(part) + "/" for part in pattern.split("/"))
    expression = re.compile("".join(parts))
    return lambda topic: expression.fullmatch(f"{topic}/") is not None


def _part(part: str) -> str:
    return "[^/]+" if part == "*" else re.escape(part)
