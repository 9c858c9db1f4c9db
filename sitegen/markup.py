"""Changes of built pages: code that wraps, links of paths and pictures, titles that break, and 404.html."""

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
    """Return a page with changed texts: `change` gets each text, escaped, and the elements around it."""
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


BLOCK = re.compile(r'<div class="highlight">((?:<span class="filename">[^<]*</span>)?)(<pre>.*?</pre>)', re.DOTALL)
_TAG = re.compile(r"<[^>]+>")
COMMAND = re.compile(r"(coopenv|docker|evo_ape|git|make|openssl|pip|python) [\w.-]")
RULE = re.compile("[\u2500-\u257f]")
"""Characters of lines in tables and trees."""
OPTION = re.compile(r"(?<![\w&-])--?[A-Za-z][\w-]*")


def with_wrapped_code(html: str) -> str:
    """Return a page whose blocks of code have the class `wraps` where lines may be broken, but in no option's name."""

    def mark(match: re.Match[str]) -> str:
        title, code = match.groups()
        text = _TAG.sub("", code)
        wraps = ('<span class="' in code or COMMAND.match(text)) and not RULE.search(text)
        return f'<div class="highlight wraps">{title}{code}' if wraps else match[0]

    return changed(BLOCK.sub(mark, html), _whole_options)


def _whole_options(text: str, inside: Sequence[Tag]) -> str:
    """Return a text whose options stay on one line in code that may be wrapped."""
    around = names(inside)
    if "code" not in around or ("pre" in around and not any("highlight wraps" in tag.start for tag in inside)):
        return text
    return OPTION.sub(r'<span class="option">\g<0></span>', text)


PATH = re.compile(r"(?<![\w/.-])((?:docs/[\w/-]+|agents/README)\.md)\b(#[\w-]+)?")
WITHOUT = {"a", "pre", "h1", "h2", "h3", "h4", "h5", "h6", "script", "style"}


def with_linked_paths(html: str, address: Callable[[str], str | None]) -> str:
    """Return a page on which paths of documents are links.

    Args:
        html: the page.
        address: returns the address of a file of the repository, relative to the page; None: it is no other page.
    """

    def link(match: re.Match[str]) -> str:
        found = address(match[1])
        return match[0] if found is None else f'<a href="{found}{match[2] or ""}">{match[0]}</a>'

    def change(text: str, inside: Sequence[Tag]) -> str:
        return text if names(inside) & WITHOUT else PATH.sub(link, text)

    return changed(html, change)


PICTURE = re.compile(r"<a\b.*?</a>|<img\b[^>]*>", re.DOTALL)
_SOURCE = re.compile(r'\bsrc="(?!data:|https?:|//)([^"]+)"')
ICON = re.compile(r'\bclass="[^"]*(?:twemoji|emojione|icon|badge)')


def with_linked_pictures(html: str) -> str:
    """Return a page whose pictures of its own are links to their files; icons and what is a link already stay."""

    def link(match: re.Match[str]) -> str:
        part = match[0]
        source = _SOURCE.search(part)
        if part.startswith("<a") or ICON.search(part) or source is None:
            return part
        return f'<a class="picture" href="{source[1]}">{part}</a>'

    return PICTURE.sub(link, html)


JOINT = re.compile(r"(?<=[_/])(?=[^\W_])|(?<=\w)(?=\.[A-Za-z])")


def with_breakable_titles(html: str) -> str:
    """Return a page whose title may be broken after an underscore or a slash and before a dot."""

    def change(text: str, inside: Sequence[Tag]) -> str:
        around = names(inside)
        return JOINT.sub("<wbr>", text) if "h1" in around and "a" not in around else text

    return changed(html, change)


FROM_ROOT = re.compile(r'\b(href|src)="/(?!/)')
SERVED = 'location.protocol!="file:"'
BASE = f"<script>if({SERVED})document.write('<base href=\"/\">')</script>"
"""A server's pages are below its root, wherever the missing one was looked for."""
WORDS = (
    '<p>There is no such page. <a href="index.html">The front page</a> leads on; the search above finds the rest.</p>'
)
SETTINGS = '<script>if({})__config.textContent=__config.textContent.replace(\'"base": "."\',\'"base": "/"\')</script>'


def with_own_addresses(html: str) -> str:
    """Return the page with addresses beside itself, on a server from its root."""
    html = html.replace("</h1>", f"</h1>\n{WORDS}", 1)
    html = FROM_ROOT.sub(r'\1="', html).replace("<head>", f"<head>{BASE}", 1)
    html = html.replace('new URL("/",location)', "new URL(document.baseURI)")
    html = html.replace('"base": "/"', '"base": "."').replace('"search": "/', '"search": "')
    start = html.index('id="__config"')
    end = html.index("</script>", start) + len("</script>")
    return html[:end] + SETTINGS.format(SERVED) + html[end:]
