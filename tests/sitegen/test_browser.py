"""Every page of the site in Chromium, from disk: nothing fails, nothing is asked of another machine, nothing is cut."""

from __future__ import annotations

from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest

pytestmark = pytest.mark.browser
SIZES = {"laptop": (1280, 800), "phone": (390, 844)}
CUT = """() => {
    const edge = window.innerWidth + 1, found = [];
    const rolls = part => ['auto', 'scroll'].includes(getComputedStyle(part).overflowX);
    const scrolls = part => part && (rolls(part) || scrolls(part.parentElement));
    const wide = document.documentElement.scrollWidth - window.innerWidth;
    if (wide > 0) found.push(`the page is ${wide} px too wide`);
    for (const part of document.querySelectorAll('article *')) {
        const style = getComputedStyle(part), box = part.getBoundingClientRect(), text = part.textContent.trim();
        if (!text || style.display === 'inline' || !box.width || part.closest('.md-clipboard, .md-code__nav')) continue;
        const hides = ['hidden', 'clip'].includes(style.overflowX) && part.scrollWidth > part.clientWidth + 1;
        if (hides || (box.right > edge && !scrolls(part))) found.push(`cut: ${text.slice(0, 60)}`);
    }
    return found.slice(0, 3);
}"""
"""Text outside the window: wide tables and code scroll in boxes of their own."""
SPLIT = """() => [...document.querySelectorAll('article :is(.option, .quantity, .numbers)')]
    .filter(part => {
        const range = document.createRange();
        range.selectNodeContents(part);
        return new Set([...range.getClientRects()].map(box => Math.round(box.bottom))).size > 1;
    }).map(part => part.textContent)"""
"""Options and numbers with lines broken in them."""
COVERED = """() => {
    const found = [], range = document.createRange();
    for (const block of document.querySelectorAll('article .wraps')) {
        const button = block.querySelector('button').getBoundingClientRect();
        const texts = document.createTreeWalker(block.querySelector('code'), NodeFilter.SHOW_TEXT);
        while (texts.nextNode()) for (const word of texts.currentNode.data.matchAll(/\\S+/g)) {
            range.setStart(texts.currentNode, word.index);
            range.setEnd(texts.currentNode, word.index + word[0].length);
            for (const box of range.getClientRects())
                if (box.right > button.left && box.top < button.bottom && box.bottom > button.top) found.push(word[0]);
        }
    }
    return found;
}"""
"""Words of wrapped code that lie under the button that copies it."""


@pytest.mark.parametrize("size", SIZES)
def test_every_page_opens(site: Path, browser: Any, size: str) -> None:
    width, height = SIZES[size]
    page = browser.new_page(viewport={"width": width, "height": height})
    problems: list[str] = []
    here = ""
    page.on("console", lambda message: message.type == "error" and problems.append(f"{here}: {message.text}"))
    page.on("pageerror", lambda error: problems.append(f"{here}: {error}"))
    left = ((site / "assets/images/favicon.png").as_uri(), "net::ERR_ABORTED")  # the next page may come before the icon
    page.on(
        "requestfailed",
        lambda request: (request.url, request.failure) == left or problems.append(f"{here}: {request.url} failed"),
    )
    page.on(
        "request",
        lambda request: (
            request.url.startswith(("file:", "data:", "blob:")) or problems.append(f"{here}: asks {request.url}")
        ),
    )
    pages = sorted(site.rglob("*.html"))
    assert len(pages) > 80
    for path in pages:
        here = str(path.relative_to(site))
        page.goto(path.as_uri(), wait_until="load")
        problems += [f"{here}: {found}" for found in page.evaluate(CUT)]
        assert page.inner_text("article h1").strip()
    page.close()
    assert not problems, "\n".join(problems)


@pytest.mark.parametrize("name", ["results", "benchmarks", "how-to/figures", "reference/command_line", "bags"])
def test_options_and_numbers_are_whole_and_nothing_covers_code(site: Path, browser: Any, name: str) -> None:
    page = browser.new_page(viewport={"width": 390, "height": 844})
    page.goto((site / f"{name}.html").as_uri())
    if page.locator("article .wraps").count():
        page.wait_for_selector("article .wraps button")
    assert page.locator("article :is(.option, .numbers)").count() > 5
    assert page.evaluate(SPLIT) == [] == page.evaluate(COVERED)
    page.add_style_tag(content=".md-typeset :is(.option, .numbers) { white-space: normal !important; width: 1px }")
    page.add_style_tag(content=".md-typeset .wraps pre > code { padding-right: 0 !important }")
    if name in ("results", "how-to/figures"):
        assert page.evaluate(SPLIT), "the check itself sees what is split"
    if name == "how-to/figures":
        assert page.evaluate(COVERED), "and what is covered"
    page.close()


def test_code_is_copied_as_it_stands(site: Path, browser: Any) -> None:
    page = browser.new_page(viewport={"width": 390, "height": 844})
    page.goto((site / "how-to" / "figures.html").as_uri())
    page.evaluate("document.addEventListener('copy', () => { window.copied = document.getSelection().toString(); })")
    page.locator("article .wraps button").first.click()
    page.wait_for_function("window.copied")
    lines = page.evaluate("window.copied").splitlines()
    assert lines[0] == "coopenv run busy_intersection --override horizon=5 --figures pdf --width ieee1 --out out/paper"
    assert len(lines) == 2
    page.close()


def test_a_picture_opens_by_itself(site: Path, browser: Any) -> None:
    page = browser.new_page(viewport={"width": 390, "height": 844})
    page.goto((site / "environments" / "behind_truck.html").as_uri())
    page.locator("article a.picture").first.click()
    page.wait_for_url("**/environments/behind_truck.png")
    page.close()


@pytest.mark.parametrize("size", SIZES.values(), ids=SIZES)
def test_the_replay_of_the_home_page_can_be_worked(site: Path, browser: Any, size: tuple[int, int]) -> None:
    page = browser.new_page(viewport={"width": size[0], "height": size[1]})
    page.goto((site / "index.html").as_uri())
    page.get_by_role("button", name="Pause").click()
    time = page.get_by_label("Time")
    for part in (time, page.get_by_role("button", name="robust" if size[0] > 1000 else "Play", exact=True)):
        box = part.bounding_box()
        assert box["y"] + box["height"] <= size[1]  # the first screen
    time.fill(time.get_attribute("max"))
    verdict = page.locator("#replay .verdict")
    assert verdict.inner_text() == "riccati: 5 of 5 lost"
    page.get_by_role("button", name="robust", exact=True).click()
    assert verdict.inner_text() == "robust: found"
    painted = "document.querySelector('#replay canvas').toDataURL()"
    whole = page.evaluate(painted)
    page.get_by_role("button", name="f1", exact=True).click()
    assert page.evaluate(painted) != whole
    page.close()


def test_search_works_from_disk(site: Path, browser: Any) -> None:
    page = browser.new_page(viewport={"width": 1280, "height": 800})
    page.goto((site / "index.html").as_uri())
    page.fill("input.md-search__input", "basin")
    page.wait_for_selector(".md-search-result__item a", timeout=20_000)
    found = page.eval_on_selector_all(
        ".md-search-result__item a", "links => links.map(link => link.getAttribute('href'))"
    )
    assert any("glossary.html" in link or "observers.html" in link for link in found), found
    page.close()


def test_a_page_that_is_missing_leads_on(site: Path, browser: Any) -> None:
    """A server shows 404.html whatever the folder that was asked for."""

    def serve(route: Any) -> None:
        path = site / urlsplit(route.request.url).path.removeprefix("/")
        route.fulfill(path=path if path.is_file() else site / "404.html")

    page = browser.new_page(viewport={"width": 1280, "height": 800})
    page.route("http://site.test/**", serve)
    page.goto("http://site.test/some/where/else")
    assert page.evaluate("getComputedStyle(document.querySelector('.md-header')).position") == "sticky"
    page.fill("input.md-search__input", "basin")
    page.locator(".md-search-result__item a").first.click(timeout=20_000)
    page.wait_for_url("http://site.test/*.html*")
    assert page.inner_text("article h1") != "404 - Not found"
    page.close()
