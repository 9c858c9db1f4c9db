"""Titles that a phone can break between the parts of a name."""

import re
from collections.abc import Sequence

from sitegen.text import Tag, changed, names

JOINT = re.compile(r"(?<=[_/])(?=[^\W_])|(?<=\w)(?=\.[A-Za-z])")


def breakable(html: str) -> str:
    """Return a page whose title may be broken after an underscore or a slash and before a dot."""

    def change(text: str, inside: Sequence[Tag]) -> str:
        around = names(inside)
        return JOINT.sub("<wbr>", text) if "h1" in around and "a" not in around else text

    return changed(html, change)
