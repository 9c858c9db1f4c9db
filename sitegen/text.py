"""Changes of what a page says that leave its tags alone."""

import re
from collections.abc import Callable, Sequence
from typing import NamedTuple

START = r"(?P<name>[a-zA-Z][\w:-]*)(?:\"[^\"]*\"|'[^']*'|[^'\">])*"
PART = re.compile(rf"<!--.*?-->|<(?P<end>/?){START}>|[^<]+|<", re.DOTALL)
VOID = {"area", "base", "br", "col", "embed", "hr", "img", "input", "link", "meta", "source", "track", "wbr"}


class Tag(NamedTuple):
    """An element that is open where a text stands."""

    name: str
    start: str
    """Its start tag as it stands, with attributes."""


def changed(html: str, change: Callable[[str, Sequence[Tag]], str]) -> str:
    """Return a page with other texts: `change` gets each, escaped as it stands, and the elements around it."""
    parts, inside = [], list[Tag]()
    for match in PART.finditer(html):
        part, name = match[0], (match["name"] or "").lower()
        if match["end"]:
            while name in names(inside) and inside.pop().name != name:
                pass
        elif name:
            if name not in VOID and not part.endswith("/>"):
                inside.append(Tag(name, part))
        elif not part.startswith("<"):
            part = change(part, inside)
        parts.append(part)
    return "".join(parts)


def names(inside: Sequence[Tag]) -> set[str]:
    """Return the names of elements."""
    return {tag.name for tag in inside}
