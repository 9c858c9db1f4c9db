"""Findings: mistakes that are planted in the tutorial's filter are named, and observers without one have none."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from coopenv.bench.observers import compare
from coopenv.bench.observers.command import report_text
from coopenv.bench.observers.findings import findings_on
from coopenv.observers import Tick, run
from coopenv.observers.recording import Recording
from coopenv.runs.recorder import record
from coopenv.scenario import load_scenario
from tests.helpers.sessions import ROOT, blocks

SHORT = {"horizon": 2.0, "rates.camera": 20.0, "rates.odometry": 20.0}
CODE = next(block.code for block in blocks(ROOT / "docs" / "tutorials" / "own_observer.md") if block.file)


@pytest.fixture(scope="module")
def crossing() -> Recording:
    return record(load_scenario("busy_intersection_tracking", SHORT), 1)


def changed(*replaced: tuple[str, str]) -> Any:
    """Return the tutorial's filter with other code."""
    code, names = CODE, {}
    for old, new in replaced:
        assert old in code
        code = code.replace(old, new)
    exec(compile(code, "own_observer.md", "exec"), names)
    return names["Mine"]


def late(old: Callable[[Tick, Tick], Tick]) -> Any:
    """Return the tutorial's filter with parts of the tick four frames ago."""

    class Late(changed()):  # type: ignore[misc]
        def update(self, tick: Tick) -> Any:
            self.ticks = [*getattr(self, "ticks", []), tick][-5:]
            return super().update(old(tick, self.ticks[0]))

    return Late


RETURNED = "to_body @ self.P @ to_body.T)"
SKIP = "            if message is not None:\n                continue\n            # Frames"
UNGATED = ("> GATE", "> 1e30")
FLAWS = {
    "gate": (changed(UNGATED), "no gate"),
    "gate, no covariance": (changed(UNGATED, (f", {RETURNED}", ")")), "no gate"),
    "bearings in the body": (changed(("correct(self.R @ bearing", "correct(bearing")), "wrong frame"),
    "camera axes": (changed(("self.R @ bearing", "self.R @ bearing[[2, 0, 1]]")), "wrong frame"),
    "steps in the body": (changed(("self.R @ tick.translation", "tick.translation")), "wrong frame"),
    "covariance in the map": (changed((RETURNED, "self.P)")), "wrong frame"),
    "covariance": (changed((RETURNED, f"{RETURNED[:-1]} / 10)")), "times too small"),
    "messages": (changed(("            # Frames", SKIP)), "messages ignored"),
    "bearings": (changed(("in tick.usable()", "in []")), "bearings ignored"),
    "old ticks": (late(lambda now, then: then), "stale clock (0.2 s)"),
    "old bearings": (late(lambda now, then: replace(now, bearings=then.bearings)), "stale clock (0.2 s)"),
    "old messages": (late(lambda now, then: replace(now, messages=then.messages)), "stale clock (0.2 s)"),
}


@pytest.mark.parametrize("flaw", FLAWS)
def test_a_planted_mistake_is_named(flaw: str, crossing: Recording) -> None:
    observer, named = FLAWS[flaw]
    found = findings_on(observer, crossing, run(observer, crossing), 1.4)
    assert len(found) == 1 + (flaw == "bearings") and named in found[0]  # without bearings no message counts either


@pytest.mark.parametrize("scene", ["busy_intersection_tracking", "lane:4"])
@pytest.mark.parametrize("observer", [changed(), "mekf_covariance", "schmidt_kalman", "robust"])
def test_observers_without_a_mistake_have_no_finding(scene: str, observer: Any) -> None:
    made = record(load_scenario(scene, SHORT), 1)
    assert findings_on(observer, made, run(observer, made), 1.4) == ()


@pytest.mark.parametrize("rate", [1.0, 0.25])
def test_a_record_of_a_slow_camera_is_not_examined(rate: float) -> None:
    """It has no frame until the change."""
    rates = {f"rates.{name}": rate for name in ("camera", "odometry", "decision")}
    made = record(load_scenario("busy_intersection_tracking", {"horizon": 2.0 / rate, **rates}), 1)
    assert findings_on("riccati", made, run("riccati", made), 0.0) == ()


def test_a_frame_without_measurements_is_not_the_one_that_is_changed(crossing: Recording) -> None:
    hidden = (crossing.t > 0.35) & (crossing.t < 0.6)
    visible = crossing.visible & ~hidden[:, None, None]
    made = replace(crossing, visible=visible, bearings=np.where(visible[..., None], crossing.bearings, np.nan))
    ungated = changed(UNGATED)
    assert findings_on(changed(), made, run(changed(), made), 1.4) == ()
    assert findings_on(ungated, made, run(ungated, made), 1.4) == ("no gate",)


def test_the_zoo_has_the_findings_that_its_page_states(crossing: Recording) -> None:
    named = {"dead_reckoning": ("bearings ignored", "messages ignored"), "hamel_samson": ("messages ignored",)}
    named |= {"mekf_covariance_ungated": ("no gate",), "riccati": ("no gate",), "ukf": (), "centralised": ()}
    for name, expected in named.items():
        assert findings_on(name, crossing, run(name, crossing), 1.4) == expected, name


def test_tables_and_report_have_the_finding_of_the_first_record() -> None:
    found = compare(["mekf_covariance_ungated", "mekf_covariance"], "lane:4", 2, overrides=SHORT, steady_from=1.4)
    words = {row.observer: row.finding for row in found.rows}
    assert words == {"mekf_covariance_ungated": "no gate", "mekf_covariance": ""}
    report = report_text(found, {"versions": {}, "command": ""})
    assert "no gate" in str(found) and report.count("<td>no gate</td>") == 2
    assert [bool(sample.findings) for sample in found.samples] == [True, False, False, False]


def test_an_observer_that_fails_on_the_changed_record_has_no_finding(crossing: Recording) -> None:
    class NeedsMessages(changed()):  # type: ignore[misc]
        def update(self, tick: Tick) -> Any:
            assert np.nanmax(tick.bearings[:, 0], initial=-1.0) < 2.0 and tick.time == tick.index * tick.dt
            return super().update(tick)

    assert findings_on(NeedsMessages, crossing, run(NeedsMessages, crossing), 1.4) == ()
