"""Pictures that can be enlarged: each leads to its own file."""

import re

PART = re.compile(r"<a\b.*?</a>|<img\b[^>]*>", re.DOTALL)
SOURCE = re.compile(r'\bsrc="(?!data:|https?:|//)([^"]+)"')
ICON = re.compile(r'\bclass="[^"]*(?:twemoji|emojione|icon|badge)')


def linked(html: str) -> str:
    """Return a page whose pictures of its own are links to their files; icons and what is a link already stay."""

    def link(match: re.Match[str]) -> str:
        part = match[0]
        source = SOURCE.search(part)
        if part.startswith("<a") or ICON.search(part) or source is None:
            return part
        return f'<a class="picture" href="{source[1]}">{part}</a>'

    return PART.sub(link, html)
