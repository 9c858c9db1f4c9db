"""Which code is wrapped."""

import pytest

from sitegen.code import marked


def block(code: str) -> str:
    return f'<div class="highlight"><pre><span></span><code>{code}\n</code></pre></div>'


@pytest.mark.parametrize(
    ("code", "wraps"),
    [
        ('<span class="kn">import</span> coopenv', True),
        ("coopenv run urban_crossing   # a comment", True),
        ("pip install '.[view]'", True),
        ("vehicle   error [m]   3 sigma [m]", False),
        ("coopenv/\n  errors.py   errors", False),
    ],
)
def test_programs_and_commands_are_wrapped_and_columns_are_not(code: str, wraps: bool) -> None:
    page = f"<p>coopenv run</p>{block(code)}"
    named = page.replace("<pre>", '<span class="filename">mine.py</span><pre>')
    assert marked(named) == (named.replace('"highlight"', '"highlight wraps"') if wraps else named)
    assert marked(page) == (page.replace('"highlight"', '"highlight wraps"') if wraps else page)
