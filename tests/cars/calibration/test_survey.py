"""The map from a drive: markers at unknown places, on drives that are computed here and on the sample bag."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from coopenv.cars.calibration.batch import Batch
from coopenv.cars.calibration.drives import CalibrationDrive
from coopenv.cars.calibration.survey import first_constants, meeting_point, only, place_errors, solved, sorted_markers
from coopenv.cli.app import main
from coopenv.scenario import load_scenario
from tests.cars.calibration.test_calibrate import MARKERS, drive
from tests.helpers.commands import refused

ROOT = Path(__file__).resolve().parents[3]
SAMPLE = str(ROOT / "examples/bags/mcap")


@given(st.integers(0, 2**32 - 1))
def test_lines_through_a_point_meet_there_whatever_one_line_in_six_does(seed: int) -> None:
    rng = np.random.default_rng(seed)
    point, origin = rng.normal(size=3) * 3.0, rng.normal(size=(30, 3)) * [2.0, 2.0, 0.1]
    line = point - origin
    line[::6] = rng.normal(size=(5, 3))
    found, angle, std = meeting_point(origin, line / np.linalg.norm(line, axis=-1, keepdims=True))
    assert_allclose(found, point, atol=1e-3)
    assert angle < 1e-3 and std < 0.1


def unknown(given: CalibrationDrive) -> CalibrationDrive:
    return replace(given, places=np.zeros_like(given.places))


def solved_of(given: CalibrationDrive, truth: bool) -> Any:
    return solved(given, truth, first_constants(Batch(given, truth)))


@cache
def without_truth() -> Any:
    return solved_of(unknown(drive()), False)


def test_markers_are_solved_with_motion_capture() -> None:
    _, _, places, starts = solved_of(unknown(drive()), True)
    assert np.sqrt(np.mean(np.sum((places - MARKERS) ** 2, axis=-1))) < 0.01
    assert np.hypot(starts[0, 0], starts[0, 1]) < 3.0


def test_markers_are_solved_without_motion_capture_in_the_frame_of_the_start() -> None:
    """Up to where the frame lies; the scale of the wheels, 2 % off, is seen by the camera's lever."""
    _, _, places, starts = without_truth()
    assert_allclose(starts, 0.0, atol=1e-12)
    true, found = (table[:, 0] + 1j * table[:, 1] for table in (MARKERS, places))
    true, found = true - true.mean(), found - found.mean()
    fit = np.vdot(found, true) / np.vdot(found, found)
    assert abs(fit) == pytest.approx(1.0, abs=0.005)
    assert np.abs(fit * found - true).max() < 0.02
    assert_allclose(places[:, 2], MARKERS[:, 2], atol=0.01)


def test_errors_without_motion_capture_are_about_the_markers_themselves() -> None:
    batch, fit, places, _ = without_truth()
    error = place_errors(batch, fit)
    assert error.shape == places.shape and error.min() > 0.0 and error.max() < 0.05
    given = unknown(drive())
    (car,) = given.cars
    first = car.time < car.time[0] + 3.0
    short = replace(car, **{key: getattr(car, key)[first] for key in ("time", "target", "ray", "pixel")})
    batch, fit, _, _ = solved_of(replace(given, cars=(short,)), False)
    assert place_errors(batch, fit).max() > 3.0 * error.max()


def test_a_marker_that_moves_is_left_out_with_the_reason() -> None:
    given = unknown(drive())
    (car,) = given.cars
    target = np.where((car.target == 1) & (car.time > np.median(car.time)), 0, car.target)  # one number for two places
    moving = replace(given, cars=(replace(car, target=target),))
    batch = Batch(moving, True)
    own, standing, notes = sorted_markers(batch, first_constants(batch), [10, 11, 12, 13, 14, 15])
    assert own == {} and 10 not in standing and {12, 13, 14, 15} <= set(standing)
    assert "it moves, or two are alike" in notes[10]
    kept = only(moving, [2, 3])
    assert kept.landmarks == ("M2", "M3") and set(kept.cars[0].target) == {0, 1}


def test_the_command_writes_a_map_with_which_the_bag_runs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "room"
    assert main(["calibrate", SAMPLE, "--propose", str(folder)]) == 0
    printed = capsys.readouterr().out
    assert "carried by svea1" in printed and f"--map {folder / 'topics.toml'}" in printed.replace("\n", " ")
    known = {mark.name: mark.position for mark in load_scenario("svea_overtaking").landmarks}
    solved_marks = {mark.name: mark.position for mark in load_scenario(folder / "environment.toml").landmarks}
    assert solved_marks.keys() == known.keys()
    error = [np.linalg.norm(np.subtract(solved_marks[name], known[name])) for name in known]
    assert np.sqrt(np.mean(np.square(error))) < 0.01
    assert main(["import", SAMPLE, "--map", str(folder / "topics.toml")]) == 0


BAD = [
    (["nowhere.bag", "--propose", "room"], "no such bag: nowhere.bag"),
    ([SAMPLE, "--propose", "room", "--like", "nowhere"], "nowhere"),
    ([SAMPLE, "--propose", "room", "--map", "topics.toml"], "--propose: writes an environment and a map"),
    ([SAMPLE, "--propose", "room", "--set", "horizon=3"], "--override is for a map that is there"),
]


@pytest.mark.parametrize(("words", "said"), BAD)
def test_mistakes_are_one_line(words: list[str], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert said in refused("calibrate", *words)
    assert not list(tmp_path.iterdir())
