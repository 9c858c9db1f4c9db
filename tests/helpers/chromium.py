"""Debian's Chromium for tests, headless."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import pytest

SOFTWARE = ("--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
"""Draws without a graphics card."""
REASON = "needs chromium and playwright: make test-browser"


@contextmanager
def chromium(arguments: Sequence[str] = SOFTWARE) -> Iterator[Any]:
    """Start a browser and end it; skip the test where there is none."""
    playwright = pytest.importorskip("playwright.sync_api", reason=REASON)
    program = shutil.which("chromium")
    if program is None:
        pytest.skip(REASON)
    with playwright.sync_playwright() as tools:
        browser = tools.chromium.launch(executable_path=program, args=list(arguments))
        yield browser
        browser.close()
