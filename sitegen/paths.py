"""Paths of documents in docstrings and help texts, which lead to the pages of the site."""

import re
from collections.abc import Callable, Sequence

from sitegen.text import Tag, changed, names

PATH = re.compile(r"(?<![\w/.-])((?:docs/[\w/-]+|agents/README)\.md)\b(#[\w-]+)?")
WITHOUT = {"a", "pre", "h1", "h2", "h3", "h4", "h5", "h6", "script", "style"}


def linked(html: str, address: Callable[[str], str | None]) -> str:
    """Return a page on which paths of documents are links.

    Args:
        html: the page.
        address: returns where a file of the repository stands, as seen from the page; None: it is no other page.
    """

    def link(match: re.Match[str]) -> str:
        found = address(match[1])
        return match[0] if found is None else f'<a href="{found}{match[2] or ""}">{match[0]}</a>'

    def change(text: str, inside: Sequence[Tag]) -> str:
        return text if names(inside) & WITHOUT else PATH.sub(link, text)

    return changed(html, change)
