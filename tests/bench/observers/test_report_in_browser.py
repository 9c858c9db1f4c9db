"""The report in a real browser, on a desk and on a phone: it draws, asks for nothing, and nothing is cut."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from coopenv.bench.observers import compare
from coopenv.bench.observers.command import report_text

pytestmark = pytest.mark.browser
SIZES = {"desk": (1280, 800), "phone": (390, 844)}


@pytest.fixture(scope="module")
def page_of_report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    found = compare(
        ["riccati", "dead_reckoning", "split_covariance_intersection"],
        "busy_intersection_tracking",
        2,
        variants=["nominal", "v2x_loss"],
        overrides={"horizon": 2.0},
    )
    path = tmp_path_factory.mktemp("report") / "report.html"
    path.write_text(report_text(found, {"command": "coopenv bench observers", "versions": {"numpy": "2"}}))
    return path


@pytest.mark.parametrize("size", SIZES)
def test_the_report_draws_offline_and_fits(size: str, browser: Any, page_of_report: Path) -> None:
    width, height = SIZES[size]
    page = browser.new_page(viewport={"width": width, "height": height})
    said: list[str] = []
    page.on("console", lambda message: said.append(f"{message.type}: {message.text}"))
    page.on("pageerror", lambda error: said.append(f"error: {error}"))
    asked: list[str] = []
    page.on("request", lambda request: asked.append(request.url))
    page.goto(page_of_report.as_uri())
    page.wait_for_function("document.body.dataset.charts === 'drawn'", timeout=60_000)
    assert said == []
    assert asked == [page_of_report.as_uri()]
    assert page.evaluate("document.documentElement.scrollWidth") <= width  # what is wider scrolls within itself
    summary = page.locator("#summary").bounding_box()
    assert summary["y"] + summary["height"] <= height  # one screen
    glance = page.locator(".glance").bounding_box()
    assert glance["x"] >= 0 and glance["x"] + glance["width"] <= width
    for chart in ("errors", "consistency", "cost"):
        box = page.locator(f"#{chart}-chart .main-svg").first.bounding_box()
        assert box["x"] >= 0 and box["x"] + box["width"] <= width and box["height"] > 300
        assert page.locator(f"#{chart}-chart .ytitle").text_content().endswith(", log")
        assert not page.locator(f"#{chart}-chart .ytick tspan").count()  # numbers without exponents, of one size
    before = page.locator("#errors-chart .scatterlayer path.js-line").first.get_attribute("d")
    page.select_option("#errors-vehicle", label="vehicle_5")
    page.select_option("#errors-variant", label="v2x_loss")
    after = page.locator("#errors-chart .scatterlayer path.js-line").first.get_attribute("d")
    assert before != after and said == []
    page.close()
