"""Tables that can be read on a phone: cells with sentences keep a width, numbers with intervals stay on one line."""

import re

CELL = re.compile(r"<td([^>]*)>(.*?)</td>", re.DOTALL)
EMPTY_HEAD = re.compile(r"<thead>\s*<tr>(\s*<th[^>]*></th>)+\s*</tr>\s*</thead>\s*")
TAG = re.compile(r"<[^>]+>")
INTERVAL = re.compile(r"\S+( %)? \[[^\[\]]{1,20}\]")
LONG = 30
"""Characters, from which on a cell is one of words."""


def marked(html: str) -> str:
    """Return a page whose cells have the class `words` or `interval` where they are that; empty heads are left out."""

    def mark(match: re.Match[str]) -> str:
        text = TAG.sub("", match[2]).strip()
        kind = "interval" if INTERVAL.fullmatch(text) else "words" if len(text) > LONG else ""
        return f'<td{match[1]} class="{kind}">{match[2]}</td>' if kind and "class=" not in match[1] else match[0]

    return CELL.sub(mark, EMPTY_HEAD.sub("", html))
