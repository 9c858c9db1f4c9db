"""Changed recordings, as `python -m benchmarks.evidence` makes them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks import evidence
from coopenv.observers.recording import Recording
from coopenv.runs import record
from coopenv.scenario import load_scenario


@pytest.fixture(scope="module")
def recording() -> Recording:
    return record(load_scenario(evidence.BASE, {"horizon": 14.0}), 0)


def changed(recording: Recording, change: evidence.Change) -> Recording:
    return change(recording, np.random.default_rng(0))


def test_a_landmark_is_moved_in_the_map_alone(recording: Recording) -> None:
    moved = changed(recording, evidence.landmark_moved(0.3))
    assert moved.interference is not None
    for vehicle, k in ((0, 0), (4, recording.ticks - 1)):
        error = moved.interference.map_error_of(vehicle, k)
        np.testing.assert_allclose(error, [[0.0, 0.0, 0.0], [0.24, 0.18, 0.0], [0.0, 0.0, 0.0]], atol=1e-12)
    assert moved.bearings is recording.bearings


def test_odometry_has_a_bias_from_its_step_on(recording: Recording) -> None:
    late = recording.t > evidence.STEP_AT
    difference = changed(recording, evidence.bias_step(0.01)).angular_velocity - recording.angular_velocity
    np.testing.assert_allclose(difference[late, :, 2], 0.01)
    assert not difference[~late].any()


def test_the_scale_error_grows(recording: Recording) -> None:
    velocity = changed(recording, evidence.scale_drift(0.1)).velocity
    np.testing.assert_allclose(velocity[-1], 1.1 * recording.velocity[-1])
    np.testing.assert_allclose(velocity[0], recording.velocity[0])


def test_a_share_of_the_bearings_is_random(recording: Recording) -> None:
    bearings = changed(recording, evidence.random_bearings(0.1)).bearings
    wrong = (bearings != recording.bearings).any(axis=-1)[recording.visible]
    assert wrong.mean() == pytest.approx(0.1, abs=0.02)
    np.testing.assert_allclose(np.linalg.norm(bearings[recording.visible], axis=-1), 1.0)


def test_the_road_has_two_platoons() -> None:
    scenario = evidence.road()
    assert (len(scenario.vehicles), len(scenario.landmarks)) == (7, 34)


def test_a_page_without_marks_is_left_as_it_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    page = tmp_path / "page.md"
    page.write_text("A page.\n")
    monkeypatch.setitem(evidence.PARTS, "scenes", lambda seeds, jobs: "| a |")
    assert evidence.main(["scenes", "--page", str(page)]) == 2 and "expected the marks" in capsys.readouterr().err
    page.write_text("A <!-- scenes: begin --> old <!-- scenes: end --> page.\n")
    assert evidence.main(["scenes", "--page", str(page)]) == 0
    assert "| a |" in page.read_text() and "old" not in page.read_text()
