"""Tables that can be read on a phone: cells with sentences keep a width, long names break, numbers keep their units."""

import re
from collections.abc import Sequence

from sitegen.markup import JOINT, Tag, changed, names

CELL = re.compile(r"<(t[dh])\b([^>]*)>(.*?)</\1>", re.DOTALL)
EMPTY_HEAD = re.compile(r"<thead>\s*<tr>(\s*<th[^>]*></th>)+\s*</tr>\s*</thead>\s*")
TAG = re.compile(r"<[^>]+>")
INTERVAL = re.compile(r"\S+( %)? \[[^\[\]]{1,20}\]")
NUMBER = r"[+-]?\d+(?:[.,/:]\d+)*(?:e[+-]?\d+)?"
UNIT = r"(?:%|[kM]?i?B|[kMG]?Hz|[mnuµ]?s|[ckm]?m|m?rad|deg|min|h|in|pt|px|k|M)(?:/s(?:\^2|²)?)?"
ONE = (
    r"(?<![\w.-])(?:(?:&lt;|&gt;|[≤≥~±]|\+-) ?)?"
    rf"{NUMBER}(?: ?%)?(?: ?(?:±|\+-) ?{NUMBER})?(?: ?{UNIT}(?![\w/]))?"
)
QUANTITY = re.compile(ONE)
RANGE = rf"{ONE}(?:(?: to| \.\.|,) {ONE})?"
FIGURE = re.compile(rf"{ONE}(?:(?: to| \.\.) {ONE})?(?: ?[(\[]{RANGE}[)\]])?")
"""A quantity or a range, and what stands in brackets behind it."""
BREAKS = re.compile(r" |e[+-]|/")
LONG = 30
"""Characters, from which on a cell is one of words."""


def marked(html: str) -> str:
    """Return a page whose cells have the class `words` or `numbers` where they are that; empty heads are left out."""

    def mark(match: re.Match[str]) -> str:
        name, attributes, content = match.groups()
        kind = _kind(name, TAG.sub("", content).strip())
        if kind != "numbers":
            content = changed(content, _with_breaks)
        given = f' class="{kind}"' if kind and "class=" not in attributes else ""
        return f"<{name}{attributes}{given}>{content}</{name}>"

    return CELL.sub(mark, EMPTY_HEAD.sub("", html))


def _kind(name: str, text: str) -> str:
    """Return the class of a cell with a text; empty: it needs none."""
    if INTERVAL.fullmatch(text) or FIGURE.fullmatch(text):
        return "numbers"
    return "words" if name == "td" and len(text) > LONG else ""


def _with_breaks(text: str, inside: Sequence[Tag]) -> str:
    """Return a text whose names in code may break, and whose numbers stay on one line with their signs and units."""

    def whole(match: re.Match[str]) -> str:
        return f'<span class="quantity">{match[0]}</span>' if BREAKS.search(match[0]) else match[0]

    return JOINT.sub("<wbr>", text) if "code" in names(inside) else QUANTITY.sub(whole, text)
