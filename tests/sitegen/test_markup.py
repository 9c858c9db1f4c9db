"""Texts change, tags do not: links for paths and pictures, titles that can be broken."""

from __future__ import annotations

from collections.abc import Sequence

import pytest

from sitegen import markup
from sitegen.tables import marked


def test_texts_come_with_their_elements() -> None:
    html = '<!-- <b>no</b> --><p title="a > b">one<br><img alt=">"><b class=\'x>\'>two</b></p>three < four<p>five'
    seen: list[tuple[str, list[str]]] = []

    def note(part: str, inside: Sequence[markup.Tag]) -> str:
        seen.append((part, [tag.name for tag in inside]))
        return part.upper()

    changed = markup.changed(html, note)
    assert seen == [("one", ["p"]), ("two", ["p", "b"]), ("three ", []), (" four", []), ("five", ["p"])]
    assert changed == html.replace("one", "ONE").replace("two", "TWO").replace("three", "THREE").replace(
        "four", "FOUR"
    ).replace("five", "FIVE")


def test_an_end_without_a_start_closes_nothing() -> None:
    inside: list[list[str]] = []
    markup.changed("<p><b>x</p></i>y<p>z</p>", lambda part, around: inside.append([tag.name for tag in around]) or part)
    assert inside == [["p", "b"], [], ["p"]]


PICTURE = '<img alt="A car" src="../images/car.png" />'


@pytest.mark.parametrize(
    ("html", "wanted"),
    [
        (f"<p>{PICTURE}</p>", f'<p><a class="picture" href="../images/car.png">{PICTURE}</a></p>'),
        (f'<a href="x.html"><b>{PICTURE}</b></a>', None),
        ('<img class="twemoji" src="x.svg">', None),
        ('<img src="data:image/png;base64,AA">', None),
        ('<img src="https://mcap.dev/x.png">', None),
    ],
)
def test_pictures_lead_to_their_files(html: str, wanted: str | None) -> None:
    assert markup.with_linked_pictures(html) == (wanted or html)


@pytest.mark.parametrize(
    ("title", "parts"),
    [
        ("behind_truck_privileged", ["behind_", "truck_", "privileged"]),
        ("envs/behind_truck.toml", ["envs/", "behind_", "truck", ".toml"]),
        ("Version 1.2, a/ b and __init__", ["Version 1.2, a/ b and __", "init__"]),
    ],
)
def test_titles_break_between_parts(title: str, parts: list[str]) -> None:
    link = '<a class="headerlink" href="#a_b">a_b</a>'
    assert markup.with_breakable_titles(f'<h1 id="a_b">{title}{link}</h1><h2>a_b</h2>') == (
        f'<h1 id="a_b">{"<wbr>".join(parts)}{link}</h1><h2>a_b</h2>'
    )


def test_paths_of_documents_lead_to_their_pages() -> None:
    known = {"docs/method.md": "../method.html", "agents/README.md": "agents/index.html"}
    html = "<p>See docs/method.md#start, <code>docs/method.md</code> and agents/README.md.</p>"
    assert markup.with_linked_paths(html, known.get) == (
        '<p>See <a href="../method.html#start">docs/method.md#start</a>, '
        '<code><a href="../method.html">docs/method.md</a></code> and '
        '<a href="agents/index.html">agents/README.md</a>.</p>'
    )


@pytest.mark.parametrize(
    "html",
    [
        "<pre><code>docs/method.md</code></pre>",
        '<a href="x.html">docs/method.md</a>',
        "<h2>docs/method.md</h2>",
        "<p>docs/none.md, old/docs/method.md, docs/method.mdx</p>",
    ],
)
def test_other_paths_stay(html: str) -> None:
    assert markup.with_linked_paths(html, {"docs/method.md": "method.html"}.get) == html


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
    assert markup.with_wrapped_code(named) == (named.replace('"highlight"', '"highlight wraps"') if wraps else named)
    assert markup.with_wrapped_code(page) == (page.replace('"highlight"', '"highlight wraps"') if wraps else page)


# Tables


@pytest.mark.parametrize(
    ("cell", "kind"),
    [
        ("<td>pure pursuit of its way at full speed, gives way</td>", "words"),
        ('<td style="text-align: left;">pure <code>pursuit</code> of its way at full speed</td>', "words"),
        ("<td>23.5 [23.4, 23.6]</td>", "numbers"),
        ("<td>23 % [17, 26]</td>", "numbers"),
        ("<td>-16 [-29, 1]</td>", "numbers"),
        ("<td>0.0133 ± 0.0050 m (0.0286)</td>", "numbers"),
        ("<td>&lt; 1e-13 m</td>", "numbers"),
        ("<td>17 k .. 103 k</td>", "numbers"),
        ("<th>95 %</th>", "numbers"),
        ("<td>(-9.2, 0.8, 0.3)</td>", ""),
        ("<td>2.93, 7.73, 9.70</td>", ""),
        ("<th>a column with a head of many words</th>", ""),
        ("<td>scripted</td>", ""),
        ('<td><a href="a/long/address/that/is/no/text.html">short</a></td>', ""),
        ('<td class="own">pure pursuit of its way at full speed, gives way</td>', ""),
    ],
)
def test_cells(cell: str, kind: str) -> None:
    wanted = cell.replace(">", f' class="{kind}">', 1) if kind else cell
    assert marked(f"<tr>{cell}</tr>") == f"<tr>{wanted}</tr>"
