"""Code of which nothing is cut: programs, settings and commands are wrapped, columns of text scroll."""

import re

BLOCK = re.compile(r'<div class="highlight">((?:<span class="filename">[^<]*</span>)?)(<pre>.*?</pre>)', re.DOTALL)
TAG = re.compile(r"<[^>]+>")
COMMAND = re.compile(r"(coopenv|docker|evo_ape|git|make|openssl|pip|python) ")


def marked(html: str) -> str:
    """Return a page whose blocks of code have the class `wraps` where lines may be broken."""

    def mark(match: re.Match[str]) -> str:
        title, code = match.groups()
        wraps = '<span class="' in code or COMMAND.match(TAG.sub("", code))
        return f'<div class="highlight wraps">{title}{code}' if wraps else match[0]

    return BLOCK.sub(mark, html)
