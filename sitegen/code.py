"""Code of which nothing is cut: programs, settings and commands are wrapped, columns of text scroll."""

import re
from collections.abc import Sequence

from sitegen.text import Tag, changed, names

BLOCK = re.compile(r'<div class="highlight">((?:<span class="filename">[^<]*</span>)?)(<pre>.*?</pre>)', re.DOTALL)
TAG = re.compile(r"<[^>]+>")
COMMAND = re.compile(r"(coopenv|docker|evo_ape|git|make|openssl|pip|python) [\w.-]")
RULE = re.compile("[\u2500-\u257f]")
"""What lines of tables and trees are drawn with."""
OPTION = re.compile(r"(?<![\w&-])--?[A-Za-z][\w-]*")


def marked(html: str) -> str:
    """Return a page whose blocks of code have the class `wraps` where lines may be broken, but in no option's name."""

    def mark(match: re.Match[str]) -> str:
        title, code = match.groups()
        text = TAG.sub("", code)
        wraps = ('<span class="' in code or COMMAND.match(text)) and not RULE.search(text)
        return f'<div class="highlight wraps">{title}{code}' if wraps else match[0]

    return changed(BLOCK.sub(mark, html), _whole_options)


def _whole_options(text: str, inside: Sequence[Tag]) -> str:
    """Return a text whose options stay on one line where it is code that may be wrapped."""
    around = names(inside)
    if "code" not in around or ("pre" in around and not any("highlight wraps" in tag.start for tag in inside)):
        return text
    return OPTION.sub(r'<span class="option">\g<0></span>', text)
