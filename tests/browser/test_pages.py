"""The page of an episode and the live view in a real browser: they draw, complain of nothing and ask nobody."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from tests.browser.conftest import LOADING, Watched
from tests.helpers.processes import COOPENV, start

pytestmark = [pytest.mark.browser, pytest.mark.slow]

CUT = """() => [...document.querySelectorAll('#about, #about *, label, button, th, td')].filter(e => {
    const box = e.getBoundingClientRect(), style = getComputedStyle(e);
    if (!box.width || style.visibility === 'hidden' || e.closest('svg')) return false;
    const outside = box.left < -1 || box.right > innerWidth + 1;
    const hidden = style.overflowX === 'hidden' && e.scrollWidth > e.clientWidth + 1;
    return outside || hidden;
}).map(e => e.tagName + ': ' + e.textContent.trim().slice(0, 60))"""
SCROLLS = "() => document.documentElement.scrollWidth > innerWidth + 1"


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folders of two short runs, one of an honest observer and one of the paper's."""
    folder = tmp_path_factory.mktemp("runs")
    for name, more in (
        ("urban_crossing", ("--set", "observer.name=robust", "--policy", "route_follower")),
        ("busy_intersection", ()),
    ):
        command = (*COOPENV, "run", name, "--set", "horizon=12.0", "--out", name, *more)
        process = start(command, folder)
        _, errors = process.communicate(timeout=300)
        assert process.returncode == 0, errors
    return folder


def checked(watched: Watched) -> None:
    """Make sure that nothing was complained of, asked for elsewhere, or cut."""
    assert watched.complaints == []
    assert watched.strangers() == []
    assert not watched.page.evaluate(SCROLLS)
    assert watched.page.evaluate(CUT) == []


def colours(page: Any) -> int:
    """Return the number of coarsely distinguished colours of the page."""
    with Image.open(BytesIO(page.screenshot(timeout=LOADING))) as picture:
        small = np.asarray(picture.convert("RGB").resize((200, 120))) >> 5
    return len(np.unique(small.reshape(-1, 3), axis=0))


def go_to(page: Any, time: float) -> None:
    """Stop the replay at a time, s."""
    page.keyboard.press("Space")
    box = page.locator("input[inputmode]").first
    for _ in range(5):  # while it plays it overwrites what is written
        box.fill(f"{time}")
        page.keyboard.press("Tab")
        page.wait_for_timeout(1500)
        if float(box.input_value()) == time:
            return
    pytest.fail(f"the replay does not stop at {time} s")


@pytest.mark.parametrize("name", ["urban_crossing", "busy_intersection"])
def test_the_replay_opens_from_disk(
    name: str, size: str, runs: Path, watched: Watched, resembles: Callable[[Any, str], None]
) -> None:
    page = watched.opened((runs / name / "replay.html").as_uri())
    about = page.locator("#about")
    assert about.is_visible()
    before = page.locator("input[inputmode]").first.input_value()
    page.wait_for_timeout(4000)
    assert page.locator("input[inputmode]").first.input_value() != before  # it plays by itself
    go_to(page, 8.0)
    assert colours(page) > 8
    if size == "phone":
        assert not page.get_by_text("vehicle, true").is_visible()
        about.locator("summary").click()
    assert page.get_by_text("vehicle, true").is_visible()
    assert page.get_by_text("P is a gain matrix").is_visible() == (name == "busy_intersection")
    checked(watched)
    if size == "phone":
        about.locator("summary").click()
    resembles(page, f"replay_{name}_{size}")


@pytest.fixture
def view(tmp_path: Path) -> Iterator[str]:
    """The address of a live view that has just begun."""
    command = (*COOPENV, "view", "urban_crossing", "--observer", "robust", "--vehicle", "f2", "--no-browser")
    process = start(command, tmp_path)
    assert process.stdout is not None
    line = process.stdout.readline()
    assert "http" in line, process.communicate()
    yield line.split()[0]
    os.kill(process.pid, signal.SIGINT)
    _, errors = process.communicate(timeout=30)
    assert "Traceback" not in errors and "Error" not in errors, errors


def test_the_live_view_can_be_worked(
    size: str, view: str, watched: Watched, resembles: Callable[[Any, str], None]
) -> None:
    page = watched.opened(view)
    if size == "phone":
        page.get_by_role("button", name="Pause").wait_for(state="hidden")
        page.get_by_text("coopenv controls").click()
    page.get_by_role("button", name="Pause").click()
    page.get_by_role("button", name="Restart").click()
    page.get_by_role("button", name="Pause").wait_for()
    page.get_by_role("button", name="Pause").click()
    page.get_by_role("button", name="Play").wait_for()
    assert page.get_by_text("sees").first.is_visible()  # the table
    checked(watched)
    page.get_by_role("tab", name="Vehicle").click()
    page.locator("img[src^='data:image/jpeg'], img[src^='blob:']").first.wait_for()
    page.wait_for_timeout(1500)
    plot = page.get_by_text("NEES; dashed: 95 % if consistent")
    assert plot.is_visible()
    for name, shown in (("none", False), ("f2", True)):
        page.get_by_label("Vehicle", exact=True).first.click()
        page.get_by_role("option", name=name, exact=True).click()
        plot.wait_for(state="visible" if shown else "hidden")
    page.get_by_role("tab", name="Show").click()
    page.get_by_text("its estimate").wait_for()
    checked(watched)
    page.get_by_role("tab", name="Errors").click()
    row = page.get_by_text("Time [s]", exact=True).locator("xpath=ancestor::*[.//input[@inputmode]][1]")
    row.locator("input[inputmode]").fill("10")  # the same picture on a slow machine
    box = page.get_by_label("Observer", exact=True)
    box.click()
    page.get_by_role("option", name="dead_reckoning").click()
    page.get_by_text("observer dead").wait_for(timeout=120_000)
    page.wait_for_timeout(1500)
    assert colours(page) > 8
    checked(watched)
    resembles(page, f"view_{size}")
