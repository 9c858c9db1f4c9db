"""Objects in notebooks: their `repr` on one line, facts, printed tables and pictures as HTML."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Mapping
from html import escape
from io import BytesIO, StringIO
from typing import Any

from coopenv.base.errors import shown

WIDTH = 110
"""Characters on a line of a notebook."""


def one_line(kind: object, title: str, facts: Mapping[str, object]) -> str:
    """Return the `repr` of an object: `Kind('title', fact=value, ...)`."""
    return f"{type(kind).__name__}({', '.join([repr(title), *(f'{key}={shown(facts[key])}' for key in facts)])})"


def facts_html(title: str, facts: Mapping[str, object]) -> str:
    """Return a heading, and a table with a line per fact."""
    rows = "".join(f"<tr><th>{escape(key)}</th><td>{escape(str(fact))}</td></tr>" for key, fact in facts.items())
    return f"<b>{escape(title)}</b><table>{rows}</table>"


def terminal_html(printable: Any) -> str:
    """Return rich's output of an object, its alignment kept."""
    from coopenv.report.terminal import Terminal

    console = Terminal(file=StringIO(), record=True, width=WIDTH)
    console.print(printable)
    return console.export_html(inline_styles=True, code_format='<pre style="line-height: 1.2">{code}</pre>')


def picture_html(picture: Any) -> str:
    """Return a figure of Matplotlib, or pixels (H, W, 3) uint8, as a picture in the page itself."""
    data = BytesIO()
    if hasattr(picture, "savefig"):
        picture.savefig(data, format="png", dpi=100)
    else:
        from PIL import Image

        Image.fromarray(picture).save(data, "png")
    return f'<img style="max-width: 100%" src="data:image/png;base64,{b64encode(data.getvalue()).decode()}">'
