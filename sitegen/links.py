"""Checks of a site that is built: every link leads somewhere, and nothing is loaded from another machine."""

from collections.abc import Iterator
from functools import cache
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

LOADED = {"script": "src", "img": "src", "iframe": "src", "source": "src", "video": "src", "link": "href"}


class Page(HTMLParser):
    """Anchors, links and what a page loads."""

    def __init__(self, path: Path) -> None:
        """Read a page."""
        super().__init__()
        self.anchors: set[str] = {"", "__skip", "__top"}
        self.links: list[str] = []
        self.loads: list[str] = []
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Note a tag."""
        values = dict(attrs)
        self.anchors.update(filter(None, (values.get("id"), values.get("name"))))
        if tag == "a" and (link := values.get("href")):
            self.links.append(link)
        if (key := LOADED.get(tag)) and (link := values.get(key)) and values.get("rel") != "canonical":
            self.loads.append(link)


def problems(site: Path) -> Iterator[str]:
    """Yield a line for each link that leads nowhere, and for whatever is loaded from another machine."""
    page = cache(Page)
    for path in sorted(site.rglob("*.html")):
        here = path.relative_to(site)
        for link in page(path).loads:
            if urlsplit(link).scheme not in ("", "data") or link.startswith("//"):
                yield f"{here}: loads {link}"
        for link in [*page(path).links, *page(path).loads]:
            parts = urlsplit(link)
            if parts.scheme or parts.netloc:
                continue
            target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            if target.is_dir():
                target /= "index.html"
            if not target.is_file():
                yield f"{here}: no file for {link}"
            elif target.suffix == ".html" and unquote(parts.fragment) not in page(target).anchors:
                yield f"{here}: no anchor for {link}"
