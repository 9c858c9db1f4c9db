"""A browser without a screen, which may talk to nobody outside this computer."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image, ImageFilter

APPROVED = Path(__file__).parent / "approved"
SIZES = {"laptop": (1280, 800), "phone": (390, 844)}
LOADING = 60_000  # ms
_COARSE = (64, 64)
_DIFFERENT = 0.06  # mean difference of two pictures, of the whole range
HARMLESS = ("THREE.Clock", "GPU stall due to ReadPixels", "GL Driver Message")
"""Warnings of the drawing library and of drawing without a graphics card."""


@dataclass
class Watched:
    """A page, with what it has asked for and complained of."""

    page: Any
    requests: list[str] = field(default_factory=list)
    complaints: list[str] = field(default_factory=list)

    def listen(self) -> None:
        """Write down requests and complaints from now on."""
        self.page.on("request", lambda request: self.requests.append(request.url))
        self.page.on("websocket", lambda socket: self.requests.append(socket.url))
        self.page.on("pageerror", lambda error: self.complaints.append(str(error)))
        self.page.on("console", self._hear)

    def _hear(self, message: Any) -> None:
        if message.type in ("error", "warning") and not any(known in message.text for known in HARMLESS):
            self.complaints.append(f"{message.type}: {message.text}")

    def opened(self, url: str) -> Any:
        """Open an address and return the page, without the note that there is no graphics card."""
        self.page.goto(url, timeout=LOADING)
        self.page.wait_for_selector("canvas", timeout=LOADING)
        note = self.page.get_by_text("Software WebGL rendering detected")
        note.wait_for(timeout=LOADING)
        self.page.evaluate(
            "() => document.querySelectorAll('[class*=Notifications]').forEach(e => e.style.display = 'none')"
        )
        return self.page

    def strangers(self) -> list[str]:
        """Return the addresses outside this computer that were asked for."""
        own = ("file:", "data:", "blob:", "http://127.0.0.1:", "ws://127.0.0.1:")
        return [url for url in self.requests if not url.startswith(own)]


@pytest.fixture(params=SIZES)
def size(request: pytest.FixtureRequest) -> str:
    """Of the window: that of a laptop, or that of a phone."""
    return str(request.param)


@pytest.fixture
def watched(browser: Any, size: str) -> Iterator[Watched]:
    """An empty page of a size."""
    width, height = SIZES[size]
    page = browser.new_page(viewport={"width": width, "height": height})
    found = Watched(page)
    found.listen()
    yield found
    page.close()


@pytest.fixture
def resembles(tmp_path: Path) -> Callable[[Any, str], None]:
    """Compare a page with its approved picture, as seen from afar; one that has none yet is to be approved."""

    def compare(page: Any, name: str) -> None:
        taken = tmp_path / f"{name}.png"
        page.screenshot(path=str(taken), timeout=LOADING)
        approved = APPROVED / f"{name}.webp"
        if os.environ.get("APPROVE"):
            with Image.open(taken) as picture:
                picture.convert("RGB").save(approved, quality=60)
        assert approved.exists(), f"look at {taken}; APPROVE=1 takes what is shown as {approved.name}"
        difference = float(np.abs(_coarse(taken) - _coarse(approved)).mean())
        assert difference < _DIFFERENT, f"{taken} differs from {approved} by {difference:.3f}"

    return compare


def _coarse(path: Path) -> np.ndarray:
    with Image.open(path) as picture:
        blurred = picture.convert("RGB").filter(ImageFilter.GaussianBlur(6)).resize(_COARSE)
    return np.asarray(blurred, float) / 255.0
