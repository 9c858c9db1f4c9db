"""The sensors of the page about users' sensors, in everything that the page lists."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import coopenv
from coopenv import CoopenvError
from coopenv.bench.observers.changes import with_sensors
from coopenv.cli.app import main
from coopenv.observers import run
from coopenv.observers.bound import cramer_rao
from coopenv.observers.recording import Recording
from coopenv.runs.recorder import record
from coopenv.scenario import load_scenario
from coopenv.sources.sources import open_recording
from tests.helpers.commands import printed, refused
from tests.helpers.sessions import ROOT, blocks

SCENE = ROOT / "examples" / "own_sensors.toml"
CLASSES = ROOT / "examples" / "own_sensors.py"
PAGE = ROOT / "docs" / "contributing" / "sensor.md"
SETS = ("camera", "beacons", "doppler", "camera+beacons", "camera+doppler", "camera+beacons+doppler")
SHORT = {"horizon": 0.4}


@cache
def recorded() -> Recording:
    return record(load_scenario(SCENE, SHORT), seed=2)


def test_the_page_shows_the_example() -> None:
    shown = {block.file: block.code for block in blocks(PAGE) if block.file}
    classes, scene = (file.read_text(encoding="utf-8") for file in (CLASSES, SCENE))
    assert shown["own_sensors.toml"].strip() == scene.partition("\n")[2].strip()
    program = shown["own_sensors.py"].partition("import numpy as np")[2].strip()
    assert program in classes
    assert len(program.splitlines()) <= 60


def test_a_world_measures_what_the_classes_predict() -> None:
    made = record(load_scenario(SCENE, {**SHORT, "noise.enabled": False}), seed=2)
    marks = dict(zip(made.setups[0].target_names, made.landmarks[-1], strict=False))
    p, L = made.truth.position[-1, 0], made.landmarks.shape[1]
    beacons = {name: made.readings["beacons"][-1, 0, n, 0] for n, name in enumerate(marks)}
    assert np.isnan([beacons[name] for name in ("sign", "lamp", "mast")]).all()
    for name in ("roof", "gate", "tree"):
        assert_allclose(beacons[name], np.linalg.norm(marks[name] - p) - np.linalg.norm(marks["mast"] - p), atol=1e-9)
    arm, step = np.array([0.5, 0.0, 0.8]), 1
    at = made.truth.position[:, 0] + made.truth.rotation[:, 0] @ arm
    before, now = (np.linalg.norm(marks["sign"] - at[k]) for k in (-1 - step, -1))
    assert_allclose(made.readings["doppler"][-1, 0, 0, 0], (now - before) / (step * made.dt), atol=0.02)
    assert np.isfinite(made.readings["doppler"][-1, 0, L + 1, 0])


def test_filters_and_the_bound_use_the_landmarks_of_the_map() -> None:
    """Range differences alone keep a vehicle on its path; without them it drifts."""
    alone, blind = with_sensors(recorded(), ["beacons"]), with_sensors(recorded(), [])
    assert not alone.visible.any()
    bounds = [cramer_rao(of).position[-1] for of in (alone, blind)]
    assert (bounds[0] < 0.5 * bounds[1]).all()
    for observer in ("mekf", "schmidt_kalman", "centralised"):
        results = [run(observer, of) for of in (alone, blind)]
        assert not any(result.failure for result in results)
        found, lost = (result.position_error[-1].mean() for result in results)
        assert found < 0.5 * lost, observer


def test_the_bound_is_that_of_an_independent_recursion_of_one_vehicle() -> None:
    recording = with_sensors(recorded(), ["beacons"])
    marks = dict(zip(recording.setups[0].target_names, recording.landmarks[0], strict=False))
    R, p, dt = recording.truth.rotation[:, 0], recording.truth.position[:, 0], recording.dt
    seen = np.isfinite(recording.readings["beacons"][:, 0, :, 0])
    noise = recording.setups[0].noise
    std = [noise.angular_velocity] * 3 + [noise.velocity] * 3
    Q = np.diag(np.square(std)) * noise.odometry_period * dt
    P = recording.start_covariance[0]
    for k in range(1, recording.ticks):
        turn, step = recording.truth.rotation[k - 1, 0].T @ R[k], R[k - 1].T @ (p[k] - p[k - 1])
        F = np.zeros((6, 6))
        F[:3, :3] = F[3:, 3:] = turn.T
        F[3:, :3] = -turn.T @ np.cross(np.eye(3), step)
        P = F @ P @ F.T + Q
        rows = []
        for n in np.flatnonzero(seen[k]):
            u, v = (mark - p[k] for mark in (recording.landmarks[k, n], marks["mast"]))
            rows.append([0.0, 0.0, 0.0, *(R[k].T @ (v / np.linalg.norm(v) - u / np.linalg.norm(u)))])
        if rows:
            H = np.array(rows)
            P = np.linalg.inv(np.linalg.inv(P) + H.T @ H / 0.05**2)
        assert_allclose(cramer_rao(recording, joint=False).covariance[k, 0], P, rtol=1e-6, atol=1e-12)


def test_a_comparison_has_a_row_for_each_set_of_sensors_below_its_bound(tmp_path: Path) -> None:
    found = coopenv.compare("mekf", SCENE, seeds=1, overrides=SHORT, sensors=True)
    assert tuple(found.variants) == found.sensor_sets == SETS
    assert not any(row.failure for row in found.rows)
    bounds = {variant: found.bounds_in(variant)["bound_ancestors_m"] for variant in SETS}
    assert max(bounds["camera+beacons+doppler"]) < min(max(bounds["camera"]), max(bounds["beacons"]))
    text = printed(found)
    table = text[text.index("sensors ") :]
    assert [table.index(name) for name in SETS[3:]] == sorted(table.index(name) for name in SETS[3:])
    assert table.count("bound (ancestors)") == table.count("mekf") == len(SETS)


def test_sets_of_sensors_are_refused_where_there_is_nothing_to_compare() -> None:
    assert refused("bench", "observers", "busy_intersection", "--sensors") == (
        "error: --sensors: busy_intersection has no [[sensors]] beside the camera\n"
    )


def test_an_environment_estimates_with_the_sensors(monkeypatch: pytest.MonkeyPatch) -> None:
    env = coopenv.parallel_env(SCENE, overrides=SHORT)
    _, infos = env.reset(seed=0)
    while env.agents:
        _, _, _, _, infos = env.step({agent: env.action_space(agent).sample() for agent in env.agents})
    assert max(info["position_error"] for info in infos.values()) < 0.2


def test_a_log_brings_the_measurements_back(tmp_path: Path) -> None:
    pytest.importorskip("mcap", reason="needs the extra 'log'")
    from coopenv.sources.mcap import read_recording, write_recording

    path = tmp_path / "drive.mcap"
    write_recording(recorded(), path)
    back = read_recording(path)
    for name, values in recorded().readings.items():
        assert_array_equal(back.readings[name], values)
    results = [run("schmidt_kalman", of).position for of in (recorded(), back)]
    assert_array_equal(*results)


FAILING = """
import numpy as np


class Failing:
    noise, has_target = 0.1, False

    def predict(self, own, target):
        if abs(own.position[0] - 1.0) < 0.5:
            {failure}
        return own.position[0]
"""


def scene(folder: Path, failure: str, **sensor: Any) -> dict[str, Any]:
    """Return a vehicle that drives along x at 1 m/s, with a class that fails at 0.5 m."""
    file = folder / "mine.py"
    file.write_text(FAILING.format(failure=failure), encoding="utf-8")
    motion = {"kind": "constant", "linear": [1.0, 0.0, 0.0]}
    return {
        "title": "failing",
        "horizon": 2.0,
        "rates": {"camera": 20.0, "odometry": 20.0, "decision": 10.0},
        "observer": {"name": "mekf"},
        "landmarks": [{"name": f"L{n}", "position": [5.0, 4.0 * n - 4.0, 1.0]} for n in range(3)],
        "vehicles": [{"motion": motion, "initial_pose": {"position": [-20.0, 0.0, 0.0]}}],
        "sensors": [{"kind": f"{file}:Failing", **sensor}],
    }


@pytest.mark.parametrize(
    ("failure", "problem"),
    [
        ("raise OSError('no device')", "predict: OSError: no device"),
        ("return np.nan", "predict: not finite"),
        ("return np.ones(2)", "predict: expected shape (1,), got array([1., 1.])"),
    ],
)
def test_a_run_whose_sensor_fails_keeps_what_it_has(tmp_path: Path, failure: str, problem: str) -> None:
    given, out = scene(tmp_path, failure), tmp_path / "out"
    given["vehicles"][0]["initial_pose"] = {"position": [0.0, 0.0, 0.0]}
    with pytest.raises(CoopenvError) as caught:
        coopenv.run(given, out=out)
    kind, text = given["sensors"][0]["kind"], str(caught.value)
    assert f"sensor '{kind}': {problem} (the " in text
    assert text.endswith(f" s before it are in {out})")
    with np.load(out / "trajectory.npz") as arrays:
        assert 0.4 < arrays["t"][-1] < 0.6


def test_a_log_of_a_sensor_that_fails_has_the_ticks_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("mine.py").write_text(FAILING.format(failure="raise OSError('no device')"), encoding="utf-8")
    text = """title = "failing"
horizon = 2.0
rates = {camera = 20.0, odometry = 20.0, decision = 10.0}
observer.name = "mekf"
landmarks = [{name = "ahead", position = [5, 0, 1]}, {name = "left", position = [5, 4, 1]}]
vehicles = [{motion = {kind = "constant", linear = [1, 0, 0]}, initial_pose.position = [0, 0, 0]}]
sensors = [{kind = "mine.py:Failing"}]
"""
    Path("failing.toml").write_text(text, encoding="utf-8")
    assert main(["record", "failing.toml", "--out", "failing.mcap"]) == 2
    line = capsys.readouterr().err.splitlines()[-1]
    assert re.search(r"predict: OSError: no device \(the 0\.\d+ s before it are in failing\.mcap\)$", line)
    recorded = open_recording("failing.mcap")
    assert 0.4 < recorded.t[-1] < 0.6 and recorded.visible.any()


@pytest.mark.parametrize(
    ("sensor", "problem"),
    [
        ({"kind": "sonar"}, r"sensors\.0.*kind: unknown kind of sensor 'sonar'"),
        ({"kind": "none.py:Mine"}, r"sensors\.0.*kind: '.*none\.py:Mine': no such file"),
        ({"noise": [0.1, 0.2]}, r"sensors\.failing\.noise: 2 numbers for 1 rows"),
        ({"bias": [0.1, 0.2]}, r"sensors\.failing\.bias: 2 numbers for 1 rows"),
        ({"noise": -1.0}, r"sensors\.0\.noise"),
        ({"noise": "nan"}, r"sensors\.0\.noise"),
        ({"options": {"reach": 1.0}}, r"mine\.py:Failing': its start: TypeError: Failing"),
    ],
)
def test_a_wrong_entry_of_a_sensor_is_named_in_one_line(tmp_path: Path, sensor: dict[str, Any], problem: str) -> None:
    with pytest.raises(CoopenvError, match=problem) as caught:
        coopenv.parallel_env(scene(tmp_path, "pass", **sensor)).reset(seed=0)
    assert "\n" not in str(caught.value)


def test_an_observer_whose_sensor_fails_loses_its_own_row_alone(tmp_path: Path) -> None:
    """The vehicle starts 20 m from the place at which the class fails, and its observer at that place."""
    made = record(load_scenario(scene(tmp_path, "raise OSError('no device')")), seed=0)
    start = made.start_position + np.array([20.5, 0.0, 0.0])
    found = coopenv.compare(["mekf", "dead_reckoning"], replace(made, start_position=start))
    rows = {row.observer: row.failure for row in found.rows}
    assert re.search(r"mine\.py:Failing': predict: OSError: no device", rows["mekf"])
    assert not rows["dead_reckoning"]
