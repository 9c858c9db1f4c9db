"""Which code is wrapped, and where."""

import re

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
        ("coopenv (f32) over its peers, at the same number of worlds", False),
        ("coopenv stands here\n\nname   value\n──── ─────", False),
        ('<span class="c1"># \u251c\u2500 a tree</span>', False),
        ("vehicle   error [m]   3 sigma [m]", False),
        ("coopenv/\n  errors.py   errors", False),
    ],
)
def test_programs_and_commands_are_wrapped_and_columns_are_not(code: str, wraps: bool) -> None:
    page = f"<p>coopenv run</p>{block(code)}"
    named = page.replace("<pre>", '<span class="filename">mine.py</span><pre>')
    assert marked(named) == (named.replace('"highlight"', '"highlight wraps"') if wraps else named)
    assert marked(page) == (page.replace('"highlight"', '"highlight wraps"') if wraps else page)


@pytest.mark.parametrize(
    ("html", "options"),
    [
        ("<p>With <code>coopenv run --seeds 20 -m slow</code> or --none.</p>", ["--seeds", "-m"]),
        ("<td><code>busy-x a - b -1 [--json] &lt;--out&gt;</code></td>", ["--json", "--out"]),
        (block("coopenv run a --seed-block 0 \\\n    --ideal"), ["--seed-block", "--ideal"]),
        (block('coopenv<span class="w"> </span>run<span class="w"> </span>--set<span class="o">=</span>1'), ["--set"]),
        (block('<span class="n">a</span><span class="o">-</span><span class="n">b</span>'), []),
        (block("option   --width is a column"), []),
    ],
)
def test_options_are_not_split(html: str, options: list[str]) -> None:
    page = marked(html)
    whole = r'<span class="option">([^<]*)</span>'
    assert re.findall(whole, page) == options
    assert re.sub(whole, r"\1", page).replace(" wraps", "") == html
