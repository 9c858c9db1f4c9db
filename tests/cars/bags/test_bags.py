"""Bags of ROS 1 and 2: they give the ticks of the drive that they are of, and observers do as well on them."""

from __future__ import annotations

import sqlite3
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

import coopenv
from coopenv import CoopenvError, DataError
from coopenv.base.errors import DataWarning
from coopenv.bench.observers import sources
from coopenv.cars.backend.recorded_drive import DriveRecorder
from coopenv.cars.backend.sources import BAG, DRIVE
from coopenv.cars.bags.bag import Bag
from coopenv.cars.bags.topics import regularity
from coopenv.cars.bags.tracks import Shift, reconcile, recorders
from coopenv.cars.messages import codec
from coopenv.cli.app import main
from coopenv.observers import Recording, run
from coopenv.observers.sensed import Sensed
from coopenv.runs.recorder import record
from coopenv.scenario import load_scenario
from coopenv.sources.mcap import read_recording
from coopenv.sources.registry import LOG, kind_of
from coopenv.sources.sources import open_backend, open_recording
from tests.helpers import bags

SAMPLES = Path(__file__).resolve().parents[3] / "examples" / "bags"
pytest.importorskip("rosbags", reason="needs the extra 'log'")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the same drive in every form, and its map."""
    folder = tmp_path_factory.mktemp("bags")
    (folder / "topics.toml").write_text(bags.MAP, encoding="utf-8")
    for form in ("ros1", "sqlite3", "mcap"):
        bags.write(folder / form, bags.sent(), form)
    return folder


@pytest.fixture(scope="module")
def reference(folder: Path) -> list[Sensed]:
    """Ticks of the drive."""
    return ticks_of(Bag([folder / "ros1.bag"], folder / "topics.toml"))


@pytest.fixture(scope="module")
def recorded(folder: Path) -> Recording:
    return record(Bag([folder / "ros1.bag"], folder / "topics.toml"))


def open_bag(path: Path, folder: Path, text: str = bags.MAP) -> Bag:
    given = folder / "own.toml"
    given.write_text(text, encoding="utf-8")
    return Bag([path], given)


def ticks_of(bag: Bag) -> list[Sensed]:
    return list(bag.episode(None, {}))


def assert_same(first: list[Sensed], second: list[Sensed], atol: float = 0.0) -> None:
    assert len(first) == len(second)
    for a, b in zip(first, second, strict=True):
        for name in ("rotation", "translation", "velocity", "bearings", "visible", "landmarks", "bearing_age"):
            assert_allclose(getattr(a, name), getattr(b, name), atol=atol, rtol=0.0, err_msg=f"{name}, tick {a.index}")
        assert a.truth is not None and b.truth is not None
        assert_allclose(a.truth.position, b.truth.position, atol=atol, rtol=0.0)


@pytest.mark.parametrize("name", ["ros1.bag", "sqlite3", "sqlite3/sqlite3.db3", "mcap", "mcap/mcap.mcap"])
def test_ticks_are_those_of_the_drive_from_folders_and_from_bare_files(name: str, folder: Path) -> None:
    assert kind_of(folder / name) is BAG
    made, bag = bags.drive(), Bag([folder / name], folder / "topics.toml")
    ticks = ticks_of(bag)
    assert len(ticks) == bag.capabilities.ticks == made.ticks - 1  # the first frame is before tick 0
    assert made.visible[:, 0].any(axis=0).tolist() == [True] * 5 + [False]
    for k in range(2, len(ticks)):
        tick = ticks[k]
        assert_array_equal(tick.visible, made.visible[k + 1])
        for name in ("bearings", "rotation", "translation", "landmarks"):
            assert_allclose(getattr(tick, name), getattr(made, name)[k + 1], atol=1e-8, err_msg=f"{name}, tick {k}")
        assert tick.truth is not None
        assert_allclose(tick.truth.position, made.truth.position[k + 1], atol=1e-9)
        assert_allclose(tick.truth.rotation, made.truth.rotation[k + 1], atol=1e-9)


@pytest.mark.parametrize("observer", ["riccati", "robust", "ukf"])
def test_observers_do_as_well_as_in_the_simulation(observer: str, recorded: Recording) -> None:
    simulated, replayed = run(observer, bags.drive()), run(observer, recorded)
    assert not replayed.failure
    expected, found = (r.position_rmse(2.8)[0] for r in (simulated, replayed))
    assert expected < 0.05 and abs(found - expected) < 0.2 * expected + 1e-3
    before, after = replayed.position_error[0, 0], replayed.position_error[-1, 0]
    assert before > 0.2 and after < 0.05


def test_an_imported_bag_is_a_recording(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out, given = folder / "imported.mcap", str(folder / "topics.toml")
    line = ["import", str(folder / "sqlite3"), "--map", given, "--out", str(out)]
    assert main(line) == 0
    printed = capsys.readouterr().out
    assert "/agent8/pixy_node/objectsInfo" in printed and "svea3 detections" in printed and "240 ticks" in printed
    assert kind_of(out) is LOG
    recording, direct = read_recording(out), record(Bag([folder / "sqlite3"], given))
    for name in ("rotation", "translation", "bearings", "visible", "start_position"):
        assert_array_equal(getattr(recording, name), getattr(direct, name))
    assert main(line) == 2
    assert "exists already" in capsys.readouterr().err


def test_topics_are_listed_without_a_map(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["import", str(folder / "ros1.bag")]) == 0
    printed = capsys.readouterr().out
    assert "/agent8/actuation_twist" in printed and "geometry_msgs/msg/PointStamped" in printed


def test_commands_take_a_bag_with_its_map(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag, given = str(folder / "mcap"), ["--map", str(folder / "topics.toml")]
    assert main(["run", bag, *given, "--no-figures", "--steps", "2", "--out", str(folder / "out"), "--seed", "1"]) == 0
    assert main(["describe", bag, *given]) == 0
    bench = ["bench", "observers", bag, *given, "--observers", "dead_reckoning", "--seeds", "1", "--jobs", "1"]
    assert main(bench) == 0
    assert "dead_reckoning" in capsys.readouterr().out
    assert main(["record", bag, *given, "--out", str(folder / "recorded.mcap")]) == 0
    assert read_recording(folder / "recorded.mcap").ticks == 240
    assert main(["run", bag]) == 2
    assert "needs a map of its topics, --map topics.toml" in capsys.readouterr().err
    assert main(["run", "crossing_path", *given]) == 2
    assert "is for ROS bags" in capsys.readouterr().err


def test_a_comparison_reads_a_bag_once_and_again_after_a_change(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    opened, given = [], folder / "again.toml"
    monkeypatch.setattr(sources, "open_backend", lambda *a, **k: opened.append(a) or open_backend(*a, **k))
    given.write_text(bags.MAP, encoding="utf-8")
    source = sources.find_source(folder / "mcap", topics=given)
    source.check()
    for seed in (3, 4):
        expected = record(Bag([folder / "mcap"], given), seed)
        assert_array_equal(source.recording("nominal", seed).start_position, expected.start_position)
    assert len(opened) == 1
    given.write_text(f"duration = 1.0\n{bags.MAP}", encoding="utf-8")
    assert source.recording("nominal", 3).ticks < expected.ticks and len(opened) == 2


def test_a_part_of_a_bag_begins_later(folder: Path, reference: list[Sensed]) -> None:
    bag = Bag([folder / "ros1.bag"], folder / "topics.toml", start=1.0, until=2.0)
    ticks, rate = ticks_of(bag), bag.scenario.rates.camera
    assert len(ticks) == rate + 1
    first = reference[round(rate)]
    assert ticks[0].truth is not None and first.truth is not None
    assert_allclose(ticks[0].truth.position, first.truth.position, atol=1e-9)
    assert_allclose(ticks[-1].bearings, reference[round(2 * rate)].bearings, atol=1e-9)
    for options, line in (
        ({"start": 9.0}, r"from: 9 s; 3\.975 s are recorded"),
        ({"until": 9.0}, r"until: 9 s; 3\.975 s are"),
        ({"robots": ["svea9"]}, "robots: unknown robot 'svea9'.* known: svea3, vehicle_1"),
    ):
        with pytest.raises(DataError, match=rf"ros1\.bag: {line}"):
            Bag([folder / "ros1.bag"], folder / "topics.toml", None, **options)


@pytest.mark.filterwarnings("ignore::coopenv.base.errors.DataWarning")
def test_a_car_that_is_left_out_needs_no_topics(tmp_path: Path) -> None:
    given = tmp_path / "topics.toml"
    text = (SAMPLES / "topics.toml").read_text(encoding="utf-8")
    given.write_text(text.replace('"svea1"', '"absent"'), encoding="utf-8")
    with pytest.raises(DataError, match="absent has no odometry"):
        Bag([SAMPLES / "mcap"], given)
    bag = Bag([SAMPLES / "mcap"], given, {"horizon": 1.0}, robots=["svea7"])
    recording = record(bag)
    assert bag.capabilities.estimated == (0,) and recording.left_out.tolist() == [False, True]
    assert recording.visible[:, 0].any() and not run("robust", recording).failure


def test_goals_and_contacts_of_the_environment_do_not_end_a_bag(folder: Path) -> None:
    ends = """
"vehicles.0.goal" = { position = [0.0, 0.0, 0.0], radius = 50.0 }
"horizon" = 1.0
"""
    given = folder / "goal.toml"
    given.write_text(bags.MAP.replace("[overrides]", f"[overrides]{ends}"), encoding="utf-8")
    whole = coopenv.run(folder / "ros1.bag", topics=given)
    assert np.isnan(whole.metrics["vehicles"][0]["ended_at_s"]) and whole.trajectory.t[-1] == pytest.approx(1.0)
    ended = coopenv.run(folder / "ros1.bag", topics=given, overrides={"termination.arrival": True})
    assert ended.metrics["vehicles"][0]["ended_at_s"] < 0.5


def test_frames_count_while_odometry_is_silent(folder: Path, tmp_path: Path) -> None:
    kept = [m for m in bags.sent() if "twist" not in m.topic or not 1.0e9 < m.stamp < 2.5e9]
    bag = Bag([bags.write(tmp_path / "ros1", kept, "ros1")], folder / "topics.toml")
    recording = record(bag)
    silent = slice(round(1.6 / recording.dt), round(2.4 / recording.dt))
    assert recording.visible[silent, 0].any(axis=-1).mean() > 0.9
    assert np.linalg.norm(recording.translation[silent, 0], axis=-1).min() > 0.0, "it continues with its last twist"


def test_the_python_interface_takes_a_bag(folder: Path) -> None:
    overrides = {"horizon": 1.0}
    env: Any = coopenv.parallel_env(
        folder / "ros1.bag", topics=folder / "topics.toml", observer="ukf", overrides=overrides
    )
    observations, _ = env.reset(seed=0)
    steps = 0
    while env.agents:
        observations, _, _, _, infos = env.step({agent: env.action_space(agent).sample() for agent in env.agents})
        steps += 1
    assert steps == 10 and all(np.isfinite(o).all() for o in observations.values())
    assert np.isfinite(infos["vehicle_1"]["truth"]["position"]).all()
    with pytest.raises(CoopenvError, match=r"horizon: 60 s are more than .*ros1\.bag has"):
        Bag([folder / "ros1.bag"], folder / "topics.toml", {"horizon": 60.0})
    with pytest.raises(DataError, match="coopenv import"):
        open_recording(folder / "ros1.bag")


def test_definitions_that_a_bag_lacks_are_known(folder: Path, tmp_path: Path, reference: list[Sensed]) -> None:
    path = tmp_path / "old.db3"
    path.write_bytes((folder / "sqlite3" / "sqlite3.db3").read_bytes())
    with sqlite3.connect(path) as database:
        database.execute("delete from message_definitions")
    database.close()
    assert_same(ticks_of(open_bag(path, tmp_path)), reference)


def test_two_files_with_clocks_apart_are_as_one(folder: Path, tmp_path: Path, reference: list[Sensed]) -> None:
    drive = bags.sent()
    captured = [m for m in drive if m.topic.startswith("/qualisys")]
    first = [m for m in drive if m.topic.startswith("/agent8")] + captured
    second = [m for m in drive if m.topic.startswith("/agent7")]
    apart = bags.later(second, stamps=0.5, received=0.5) + bags.later(captured, received=0.5)
    a, b = bags.write(tmp_path / "a", first, "ros1"), bags.write(tmp_path / "b", apart, "sqlite3")
    with pytest.warns(DataWarning, match=r"clock of svea1: stamps are 0\.500 s ahead, and were moved"):
        two = Bag([a, b], folder / "topics.toml")
    assert_same(ticks_of(two), reference)
    offsets = {row.topic: row.offset for row in two.log.rows}
    assert offsets["/agent7/riccatiPoint"] == pytest.approx(-0.5) and offsets["/qualisys/svea3/pose"] == 0.0


def test_messages_without_stamps_count_when_received(folder: Path, tmp_path: Path, reference: list[Sensed]) -> None:
    unstamped = [replace(m, stamp=-bags.BEGIN) if "twist" in m.topic else m for m in bags.sent()]
    path = bags.write(tmp_path / "unstamped", unstamped, "ros1")
    with pytest.warns(DataWarning, match="actuation_twist: messages without stamps count when they were received"):
        bag = Bag([path], folder / "topics.toml")
    assert_same(ticks_of(bag), reference)


def test_messages_that_make_no_sense_are_left_out(folder: Path, tmp_path: Path, reference: list[Sensed]) -> None:
    drive = bags.sent()
    nowhere = {"pose": ((np.nan,) * 3, (0.0, 0.0, 0.0, 1.0))}
    broken = [replace(m, fields=nowhere) if m.kind.endswith("PoseStamped") and m.stamp % 7 == 0 else m for m in drive]
    path = bags.write(tmp_path / "broken", broken, "mcap")
    with pytest.warns(DataWarning, match=r"svea3/pose: \d+ of 241 messages left out: truth: pose.position"):
        bag = Bag([path], folder / "topics.toml")
    assert_same(ticks_of(bag), reference, atol=1e-3)


TWO_CARS = """
environment = "overtaking"
markers = { SL1 = 1, SL2 = 2, SL4 = 4, SL5 = 5 }
overrides = { "rates.odometry" = 60.0 }

[[cars]]
name = "svea7"
vehicle = "vehicle_2"
marker = 7

[[cars]]
name = "svea8"
vehicle = "vehicle_1"
marker = 6
"""


def test_two_cars_that_recorded_themselves_see_each_other(tmp_path: Path) -> None:
    """Each on its own computer and in its own way, half a second apart; motion capture is in both files."""
    drive = [{"duration": 0.3}, {"duration": 9.0, "linear": [0.26, 0.0, 0.0]}]
    moving = {f"vehicles.{i}.motion": {"kind": "segments", "segments": drive} for i in (0, 1)}
    ahead = {
        "vehicles.0.initial_pose.position": [0.0, -1.2, 0.0],
        "vehicles.0.initial_estimate.position": [0.1, -1.2, 0],
    }
    made = record(load_scenario("overtaking", {"horizon": 1.0, "rates.odometry": 60.0, **moving, **ahead}))
    assert made.visible[:, 1, 4].all()  # vehicle_2 sees the other one
    numbers, found = {0: 1, 1: 2, 2: 4, 3: 5, 4: 6, 5: 7}, []
    for i, car in enumerate(("svea8", "svea7")):
        own = {"blocks": f"/fleet/{car}/pixy/objects_info", "twist": f"/{car}/mavros/wheel_odometry/velocity"}
        found.append(bags.of_vehicle(made, i, {**own, "truth": f"/qualisys/{car}/pose"}, numbers, (0.0,) * 5))
    truth = [m for m in found[0] + found[1] if m.topic.startswith("/qualisys")]
    first = bags.later(found[1] + truth, received=0.003)
    second = bags.later([m for m in found[0] if m not in truth], stamps=0.5) + truth
    paths = [
        bags.write(tmp_path / "svea7", first, "mcap"),
        bags.write(tmp_path / "svea8", bags.later(second, received=0.503), "ros1"),
    ]
    (tmp_path / "topics.toml").write_text(TWO_CARS, encoding="utf-8")
    with pytest.warns(DataWarning, match=r"clock of svea8: stamps are 0\.497 s ahead"):
        bag = Bag(paths, tmp_path / "topics.toml")
    ticks = ticks_of(bag)
    assert len(ticks) > 55
    for k in range(2, len(ticks) - 1):
        assert_array_equal(ticks[k].visible, made.visible[k + 1])
        assert_allclose(ticks[k].bearings, made.bearings[k + 1], atol=1e-8)
        assert_allclose(ticks[k].translation, made.translation[k + 1], atol=2e-3)
    replayed = run("robust", record(bag))
    assert not replayed.failure and (replayed.bytes_per_second > 0.0).any()


def test_a_recorded_drive_is_a_bag_with_a_map(folder: Path, tmp_path: Path, reference: list[Sensed]) -> None:
    names = {"/agent8/pixy_node/objectsInfo": "fleet/svea3/pixy/objects_info",
             "/agent8/actuation_twist": "fleet/svea3/mavros/wheel_odometry/velocity",
             "/qualisys/svea3/pose": "fleet/qualisys/svea3/pose",
             "/agent7/riccatiPoint": "fleet/svea1/point"}  # fmt: skip
    drive = bags.sent()
    path = tmp_path / "recorder.mcap"
    recorder = DriveRecorder(path, b"{}", {names[m.topic]: m.kind for m in drive})
    recorder.tick(0, bags.BEGIN)  # a recorder in which nothing begins leaves no file
    for m in drive:
        recorder.write(names[m.topic], codec.encode(bags.made(m)), bags.BEGIN + m.received)
    recorder.close()
    assert kind_of(path) is DRIVE  # which is replayed as it was
    text = bags.MAP.replace('"authors"', '"svea"') + '[cars.topics]\npoint = "/fleet/svea1/point"\n'
    assert_same(ticks_of(open_bag(path, tmp_path, text)), reference)


MS = 1_000_000
clocks = st.integers(-(10**12), 10**12)


@given(st.lists(clocks, min_size=2, max_size=4), clocks)
def test_recorders_that_share_a_source_are_brought_together(ahead: list[int], truth: int) -> None:
    """Everything is received at once; `ahead` are the clocks of cars that record themselves and motion capture."""
    files = [{f"car{i}": 0, "truth": clock - truth} for i, clock in enumerate(ahead)]
    found = reconcile(files, 20 * MS, {})
    assert found.recorders == tuple(ahead[0] - clock for clock in ahead)
    for i, clock in enumerate(ahead):
        offset = ahead[0] - clock
        shift = found.shifts[f"car{i}"]
        assert shift.offset == offset and shift.added == (offset if abs(offset) > 20 * MS else 0)
    assert found.shifts["truth"].offset == ahead[0] - truth


def test_recorders_are_reached_through_others() -> None:
    files = [{"a": 0}, {"b": 7}, {"b": 10, "a": 5}]
    assert recorders(files) == [0, -2, -5]  # -5 by a, and 10 - 7 back by b


def test_files_with_nothing_in_common_keep_their_stamps() -> None:
    found = reconcile([{"a": 900 * MS}, {"b": 900 * MS}], 20 * MS, {})
    assert found.shifts["a"].added == 900 * MS
    assert found.shifts["b"] == Shift(None, 0)


def test_stated_offsets_replace_estimated_offsets() -> None:
    found = reconcile([{"a": 900 * MS, "b": 3 * MS}], 20 * MS, {"a": 5 * MS})
    assert found.shifts["a"].added == 5 * MS and found.shifts["b"].added == 0
    assert reconcile([{"a": 900 * MS}], float("inf"), {}).shifts["a"].added == 0


def test_gaps_are_counted() -> None:
    stamps = np.array([0, 10, 20, 30, 130, 140]) * MS
    rate, gap, gaps = regularity(stamps)
    assert rate is not None and abs(rate - 5 / 0.14) < 1e-9 and gap == 0.1 and gaps == 1
    assert regularity(stamps[:1]) == (None, None, None)
