"""Texts change, tags do not: links for paths and pictures, titles that can be broken."""

from __future__ import annotations

from collections.abc import Sequence

import pytest

from sitegen import paths, pictures, text, titles


def test_texts_are_told_what_they_stand_in() -> None:
    html = '<!-- <b>no</b> --><p title="a > b">one<br><img alt=">"><b class=\'x>\'>two</b></p>three < four<p>five'
    seen: list[tuple[str, list[str]]] = []

    def note(part: str, inside: Sequence[text.Tag]) -> str:
        seen.append((part, [tag.name for tag in inside]))
        return part.upper()

    changed = text.changed(html, note)
    assert seen == [("one", ["p"]), ("two", ["p", "b"]), ("three ", []), (" four", []), ("five", ["p"])]
    assert changed == html.replace("one", "ONE").replace("two", "TWO").replace("three", "THREE").replace(
        "four", "FOUR"
    ).replace("five", "FIVE")


def test_an_end_without_a_start_closes_nothing() -> None:
    inside: list[list[str]] = []
    text.changed("<p><b>x</p></i>y<p>z</p>", lambda part, around: inside.append([tag.name for tag in around]) or part)
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
    assert pictures.linked(html) == (wanted or html)


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
    assert titles.breakable(f'<h1 id="a_b">{title}{link}</h1><h2>a_b</h2>') == (
        f'<h1 id="a_b">{"<wbr>".join(parts)}{link}</h1><h2>a_b</h2>'
    )


def test_paths_of_documents_lead_to_their_pages() -> None:
    known = {"docs/method.md": "../method.html", "agents/README.md": "agents/index.html"}
    html = "<p>See docs/method.md#start, <code>docs/method.md</code> and agents/README.md.</p>"
    assert paths.linked(html, known.get) == (
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
    assert paths.linked(html, {"docs/method.md": "method.html"}.get) == html
