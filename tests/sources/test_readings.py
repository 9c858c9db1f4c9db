"""Measurements of sensors beside the camera on their way: recordings, logs, replay, ticks of other sources."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from coopenv import CoopenvError, DataError
from coopenv.api.engine import Engine
from coopenv.bench.observers.sources import find_source
from coopenv.cli.app import main
from coopenv.measurements import named
from coopenv.measurements.sensor import MAP, Sensor
from coopenv.measurements.table import KINDS
from coopenv.observers import Recording, run
from coopenv.observers.contract import SensorNoise
from coopenv.observers.sensed import Sensed
from coopenv.runs.recorder import record
from coopenv.scenario import Scenario
from coopenv.sources.base import Capabilities, TickGenerator, TickStream
from coopenv.sources.mcap import read_recording, write_recording
from coopenv.sources.selection import Selection
from coopenv.sources.sources import open_backend
from coopenv.sources.tick_world import TickWorld
from coopenv.sources.worlds import Replay, Simulated, scenario_of
from tests.helpers.builders import circling, scenario
from tests.helpers.recordings import differences

DOPPLER = "tests.helpers.doppler:Doppler"
OTHERS = [["L1", "L2", "vehicle_2"], ["L1", "vehicle_1", "vehicle_3"], ["L3", "vehicle_1"]]


def described(**sections: Any) -> Scenario:
    """Return three vehicles on circles with every shipped kind, and a user's."""
    sensors = [{"kind": kind, "towards": ["landmarks", "vehicles"]} for kind in KINDS]
    sensors[2] |= {"rate": 5.0, "vehicles": ["vehicle_1", "vehicle_3"]}
    given = {"sensors": [*sensors, {"kind": DOPPLER, "noise": 0.02}], "topology": {"acyclic": False}}
    return scenario(circling(OTHERS), horizon=0.5, **{**given, **sections})


@cache
def recorded() -> Recording:
    return record(described(), seed=3)


def test_a_recording_has_the_readings_of_every_sensor_towards_its_targets() -> None:
    made = recorded()
    assert [*made.readings] == [*KINDS, "doppler"]
    for name, values in made.readings.items():
        there = np.isfinite(values).all(axis=-1)
        for i, setup in enumerate(made.setups):
            own = [sensor for sensor in setup.sensors if sensor.name == name]
            targets = np.maximum(own[0].targets, 0).tolist() if own else []
            assert np.flatnonzero(there[:, i].any(axis=0)).tolist() == targets, (name, i)
            tick = made.tick(7, i, {})
            for reading in tick.readings if own else ():
                if reading.sensor.name == name:
                    assert_array_equal(reading.values, values[7, i, targets])


def test_a_recording_comes_back_from_its_log_and_replays_bit_for_bit(tmp_path: Path) -> None:
    pytest.importorskip("mcap", reason="needs the extra 'log'")
    made, path = recorded(), tmp_path / "drive.mcap"
    write_recording(made, path)
    back = read_recording(path)
    assert differences(made, back) == []
    assert differences(back, replace(record(Replay(back, "drive")), drawn=made.drawn)) == []


def test_a_log_without_sensors_holds_no_entry_about_them(tmp_path: Path) -> None:
    pytest.importorskip("mcap", reason="needs the extra 'log'")
    from coopenv.sources.mcap_container import Container
    from coopenv.sources.mcap_format import ATTACHMENT

    path = tmp_path / "drive.mcap"
    write_recording(record(described(sensors=[])), path)
    header = json.loads(Container(path).extras()[1][ATTACHMENT])
    assert not {"sensors", "landmark_rotation"} & header["setups"][0].keys()


def test_a_log_whose_sensor_class_is_gone_is_refused_in_one_line(tmp_path: Path) -> None:
    pytest.importorskip("mcap", reason="needs the extra 'log'")
    own = tmp_path / "mine.py"
    own.write_text("class Height:\n    noise, towards, has_target = 0.1, ('map',), False\n"
                   "    def predict(self, own, target):\n        return own.position[2]\n")  # fmt: skip
    path = tmp_path / "drive.mcap"
    write_recording(record(described(sensors=[{"kind": f"{own}:Height"}])), path)
    assert "height" in read_recording(path).readings
    own.unlink()
    with pytest.raises(DataError, match=r"drive\.mcap.*mine\.py") as caught:
        read_recording(path)
    assert "\n" not in str(caught.value)


def test_a_log_runs_no_class_that_its_user_has_not_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("mcap", reason="needs the extra 'log'")
    from coopenv.sources.mcap_container import Container
    from coopenv.sources.mcap_format import ATTACHMENT

    own, path = tmp_path / "hers.py", tmp_path / "drive.mcap"
    own.write_text("class Height:\n    noise, towards, has_target = 0.1, ('map',), False\n"
                   "    def predict(self, own, target):\n        return own.position[2]\n")  # fmt: skip
    write_recording(record(described(sensors=[{"kind": f"{own}:Height", "name": "height"}])), path)
    assert str(tmp_path).encode() not in Container(path).extras()[1][ATTACHMENT]
    monkeypatch.setattr(named, "_references", {})
    with pytest.raises(DataError, match=r"drive\.mcap.*--set sensors\.height\.kind=hers\.py:Height"):
        read_recording(path)
    with pytest.raises(CoopenvError, match=r"drive\.mcap: sensors\.hight\.kind: unknown sensor 'hight'.*'height'"):
        open_backend(str(path), None, {"sensors.hight.kind": f"{own}:Height"})
    replay = open_backend(str(path), None, {"sensors.height.kind": f"{own}:Height"})
    assert [section.label for section in replay.scenario.sensors] == ["height"]


def test_a_log_is_compared_and_recorded_again_with_the_class_that_its_user_names(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("mcap", reason="needs the extra 'log'")
    path, again = tmp_path / "drive.mcap", tmp_path / "again.mcap"
    write_recording(record(described(sensors=[{"kind": DOPPLER, "name": "radar"}])), path)
    monkeypatch.setattr(named, "_references", {})
    change = f"sensors.radar.kind={DOPPLER}"
    with pytest.raises(CoopenvError, match=r"overrid.*is recorded"):
        find_source(path, {"noise.enabled": False})
    assert main(["record", str(path), "--out", str(again), "--no-replay", "--set", change]) == 0
    monkeypatch.setattr(named, "_references", {})
    source = find_source(path, dict([change.split("=")]))
    assert_array_equal(source.recording("nominal", 0).readings["radar"], read_recording(again).readings["radar"])


def test_the_state_of_a_replay_holds_the_readings_of_each_tick() -> None:
    made = recorded()
    world = Replay(made, "drive").world(1, "float64", "cpu", 1)
    world.reset([0])
    for k in range(5):
        for d, (name, values) in enumerate(made.readings.items()):
            now = world.view("reading_tick")[0, :, d] == k
            targets = values.shape[2]
            assert_array_equal(now[:, :targets], np.isfinite(values[k]).all(axis=-1), err_msg=f"{k} {name}")
            held = world.view("reading")[0, :, d, :targets, : values.shape[3]]
            assert_array_equal(held[now[:, :targets]], values[k][now[:, :targets]])
        world.advance(1)


def test_a_selection_of_vehicles_leaves_out_measurements_by_and_of_the_others() -> None:
    part = Selection.of(0.1, 0.4, ["vehicle_1", "vehicle_2"]).applied(recorded(), "drive")
    L, first = 4, 6
    for name, values in part.readings.items():
        assert len(values) == part.ticks
        assert np.isnan(values[:, 2]).all()
        assert values.shape[2] == 1 or np.isnan(values[:, :, L + 2]).all()
        assert_array_equal(values[:, :2, :L], recorded().readings[name][first : first + part.ticks, :2, :L])
    assert L + 2 not in part.setups[1].sensors[0].targets
    assert not run("dead_reckoning", part).failure
    assert record(Replay(part, "part")).ticks == part.ticks


def arrays(**more: Any) -> dict[str, Any]:
    """Return arguments of `Recording.from_arrays` for two robots that stand."""
    K, N, L = 4, 2, 1
    noise = SensorNoise(velocity=0.1, angular_velocity=0.1, odometry_period=0.1, bearing=0.01)
    anchor = Sensor("uwb", "range", np.array([0.1]), np.array([0, 1, 2]), np.zeros(3), np.eye(3))
    receiver = Sensor("gnss", "position", np.ones(3), np.array([MAP]), np.zeros(3), np.eye(3))
    given = {
        "dt": 0.1,
        "landmarks": np.zeros((L, 3)),
        "velocity": np.zeros((K, N, 3)),
        "angular_velocity": np.zeros((K, N, 3)),
        "bearings": np.full((K, N, L + N, 3), np.nan),
        "noise": noise,
        "start_position": np.array([[1.0, 0.0, 0.0], [5.0, 0.0, 0.0]]),
        "start_rotation": np.tile(np.eye(3), (N, 1, 1)),
        "sensors": [anchor, receiver],
        "readings": {"uwb": np.full((K, N, L + N, 1), 2.0), "gnss": np.full((K, N, 1, 3), np.nan)},
    }
    return {**given, **more}


def test_readings_of_robots_make_a_recording_that_replays() -> None:
    made = Recording.from_arrays(**arrays())
    assert made.setups[0].sensors[0].targets.tolist() == [0, 2]
    assert made.setups[1].sensors[0].targets.tolist() == [0, 1]
    again = record(Replay(made, "robots"))
    for name, values in made.readings.items():
        assert_array_equal(again.readings[name], values)
    sections = scenario_of(made, "robots", {}).sensors
    assert [(section.label, section.kind) for section in sections] == [("uwb", "range"), ("gnss", "position")]


@pytest.mark.parametrize(
    ("readings", "problem"),
    [
        ({}, "recording: readings.(uwb|gnss): missing"),
        ({"uwb": np.zeros((4, 2, 3, 2))}, r"readings\.uwb: expected numbers of shape \(4, 2, 3, 1\)"),
        ({"uwb": np.full((4, 2, 3, 1), np.inf)}, r"readings\.uwb of vehicle_1, tick 0: not finite"),
        ({"gnss": [[1.0, "a"]]}, r"readings\.gnss: not an array of numbers"),
        ({"lidar": np.zeros((4, 2, 3, 1))}, "no vehicle has a sensor 'lidar'; known: uwb, gnss"),
    ],
)
def test_wrong_readings_of_robots_are_named(readings: dict[str, Any], problem: str) -> None:
    given = {**arrays()["readings"], **readings} if readings else {}
    with pytest.raises(DataError, match=problem):
        Recording.from_arrays(**arrays(readings=given))


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"std": np.array([0.1, 0.1])}, r"setups\.0\.sensors\.'uwb'\.std: not an array of shape \(1,\)"),
        ({"reference": "sonar"}, r"sensors\.'uwb': unknown kind of sensor 'sonar'"),
        ({"rotation": 2.0 * np.eye(3)}, r"sensors\.'uwb'\.rotation: not a rotation"),
        ({"targets": np.array([MAP])}, r"sensors\.'uwb'\.targets: not among the targets of vehicle_1"),
    ],
)
def test_a_wrong_sensor_of_robots_is_named(change: dict[str, Any], problem: str) -> None:
    given = arrays()
    with pytest.raises(DataError, match=problem):
        Recording.from_arrays(**{**given, "sensors": [replace(given["sensors"][0], **change), given["sensors"][1]]})


class Echo(TickGenerator):
    """A source on the host that gives the ticks of a simulation, with readings changed."""

    def __init__(self, description: Scenario, readings: Mapping[str, Any] | None = None) -> None:
        super().__init__(
            description, Capabilities(truth=True, driven=False, real_time=False, ticks=None, batched=False)
        )
        self._simulated, self._readings = Simulated(description), readings

    def episode(self, seed: int | None, options: Mapping[str, Any]) -> TickStream:
        def changed(tick: Sensed) -> Sensed:
            return tick if self._readings is None else replace(tick, readings=self._readings)

        stream = self._simulated.episode(seed, {})
        tick = next(stream)
        while True:
            command = yield changed(tick)
            tick = stream.send(command)


def test_ticks_of_a_source_on_the_host_carry_their_readings_to_state_and_observers() -> None:
    description = described()
    engine = Engine(description, 1, "float64", backend=Echo(description))
    engine.reset([3])
    assert isinstance(engine.world, TickWorld)
    expected = recorded().at(0).readings
    for name, values in engine.world.sensed(0, 0).readings.items():
        assert_array_equal(values, expected[name], err_msg=name)


def test_a_source_on_the_host_may_leave_readings_out() -> None:
    description = described()
    engine = Engine(description, 1, "float64", backend=Echo(description, {}))
    engine.reset([3])
    readings = engine.world.sensed(0, 0).readings
    assert [*readings] == [*KINDS, "doppler"]
    assert all(np.isnan(values).all() for values in readings.values())
    assert (engine.world.view("reading_tick") == -1).all()


@pytest.mark.parametrize(
    ("readings", "problem"),
    [
        ({"sonar": np.zeros((3, 7, 1))}, "tick 0: readings: no vehicle has a sensor 'sonar'; known: bearing"),
        ({"range": np.zeros((3, 7))}, r"tick 0: readings\.range: expected numbers of shape \(3, 7, 1\), got float64"),
        ({"range": np.full((3, 7, 1), np.inf)}, r"tick 0: readings\.range of vehicle_1: not finite"),
    ],
)
def test_wrong_readings_of_a_source_on_the_host_are_named(readings: dict[str, Any], problem: str) -> None:
    description = described()
    with pytest.raises(CoopenvError, match=problem):
        Engine(description, 1, "float64", backend=Echo(description, readings)).reset([3])
