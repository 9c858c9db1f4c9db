"""Bags that are none, broken or too large, and maps with mistakes."""

from __future__ import annotations

import re
import shutil
import sqlite3
import tracemalloc
import warnings
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from coopenv import CoopenvError, DataError
from coopenv.base.errors import DataWarning
from coopenv.cars.backend.sources import BAG, metadata_names
from coopenv.cars.bags import files, streams
from coopenv.cars.bags.bag import Bag
from coopenv.cars.bags.files import BagFile
from coopenv.cars.bags.topic_map import TopicMapError, load_map
from coopenv.cars.messages import codec
from coopenv.cars.messages.readings import Detections, Twist
from coopenv.cars.settings.profile import Role
from coopenv.cli.app import main
from coopenv.estimation.poses import exp_so3
from coopenv.scenario import load_scenario
from coopenv.sources import mcap_container as container
from coopenv.sources.registry import ENVIRONMENT, LOG, kind_of
from tests.helpers import bags
from tests.helpers.bags import MAP

pytest.importorskip("rosbags", reason="needs the extra 'log'")


@cache
def short() -> list[bags.Message]:
    """Half a second of a drive."""
    return [m for m in bags.sent() if m.stamp < 500_000_000]


def longer(seconds: int = 4) -> list[bags.Message]:
    """Some seconds of it, at most four."""
    return [m for m in bags.sent() if m.stamp < seconds * 10**9]


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The short drive as a file of each form."""
    folder, found = tmp_path_factory.mktemp("short"), {}
    for form in ("ros1", "sqlite3", "mcap"):
        whole = bags.write(folder / form, short(), form)
        found[form] = whole if whole.is_file() else next(whole.glob(f"{form}.*"))
    return found


@pytest.fixture
def topics(tmp_path: Path) -> Path:
    (tmp_path / "topics.toml").write_text(MAP, encoding="utf-8")
    return tmp_path / "topics.toml"


def opened(folder: Path, text: str, drive: list[bags.Message] | None = None, form: str = "ros1") -> Bag:
    folder.mkdir(exist_ok=True)
    (folder / "topics.toml").write_text(text, encoding="utf-8")
    return Bag([bags.write(folder / "drive", short() if drive is None else drive, form)], folder / "topics.toml")


def bag_or_line(path: Path, topics: Path) -> tuple[Bag | None, list[str]]:
    """Return a bag and the warnings at its opening; None where it is refused, in one line that names it."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            return Bag([path], topics), [str(w.message) for w in caught if issubclass(w.category, DataWarning)]
        except CoopenvError as error:
            assert re.search(rf"{path.name}(: | has)", str(error)) and "\n" not in str(error)
            return None, []


def without(topic: str) -> list[bags.Message]:
    return [m for m in short() if m.topic != topic]


@pytest.mark.parametrize(
    ("topic", "line"),
    [
        ("/agent8/actuation_twist", r"svea3 has no odometry: .* has no topic /agent8/actuation_twist .*; it has "),
        ("/agent8/pixy_node/objectsInfo", r"svea3 has no camera: .* has no topic /agent8/pixy_node/objectsInfo"),
        ("/agent7/riccatiPoint", r"svea1 has no position: .* has no topic /agent7/riccatiPoint"),
    ],
)
def test_a_missing_topic_is_named(topic: str, line: str, tmp_path: Path) -> None:
    with pytest.raises(DataError, match=line):
        opened(tmp_path, MAP, without(topic))


def test_a_bag_without_truth_is_one(tmp_path: Path) -> None:
    bag = opened(tmp_path, MAP, without("/qualisys/svea3/pose"))
    assert not bag.capabilities.truth
    assert all(tick.truth is None for tick in bag.episode(None, {}))


@pytest.mark.parametrize("form", ["ros1", "sqlite3", "mcap"])
def test_an_empty_bag_is_refused(form: str, tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"has no topic .*; it has none at all"):
        opened(tmp_path, MAP, [], form)


def test_a_bag_of_one_frame_is_too_short(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="too few for two ticks"):
        opened(tmp_path, MAP, [m for m in short() if m.stamp == 0])


FORMS = ["ros1", "ros1 BZ2", "ros1 LZ4", "sqlite3", "mcap", "mcap STORAGE"]


def contents(path: Path) -> tuple[set[tuple[str, int, str]], list[str]]:
    """Return the messages of a bag, and the warnings that it gives."""
    with warnings.catch_warnings(record=True) as caught, BagFile(path) as bag:
        warnings.simplefilter("always")
        found = {(topic, received, repr(decode())) for topic, received, decode in bag.messages(bag.topics)}
    return found, [str(w.message) for w in caught]


@pytest.mark.parametrize("form", FORMS)
def test_a_truncated_bag_is_read_up_to_the_break(form: str, tmp_path: Path) -> None:
    sent = longer(3)
    whole = bags.write(tmp_path / "whole", sent, form)
    file = whole if whole.is_file() else next(whole.glob("whole.*"))
    data, (given, quiet) = file.read_bytes(), contents(whole)
    assert len(given) == len(sent) and not quiet
    cut = tmp_path / f"cut{file.suffix}"
    for share in (0.4, 0.7, 0.999):
        cut.write_bytes(data[: int(share * len(data))])
        try:
            kept, warned = contents(cut)
        except DataError as error:
            assert " " in form and "\n" not in str(error)  # of a compressed block that is not whole nothing is known
            continue
        assert kept <= given and (" " in form or len(kept) > (share - 0.1) * len(given))
        assert len(warned) == 1 and re.search(r"cut\.\w+: damaged after \d\.\d s \(.*what came before", warned[0])


@pytest.mark.parametrize("form", ["sqlite3", "mcap"])
def test_a_folder_after_a_loss_of_power(form: str, topics: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Its recorder has written neither metadata nor the end of the file."""
    folder = bags.write(topics.with_name("drive"), longer(), form)
    file = next(folder.glob("drive*.*"))
    file.write_bytes(file.read_bytes()[: 2 * file.stat().st_size // 3])
    for change in (lambda: None, (folder / "metadata.yaml").unlink):
        change()
        bag, warned = bag_or_line(folder, topics)
        assert bag is not None and len(bag.log.samples) > len(longer()) / 3
        assert len([line for line in warned if "damaged after 2." in line]) == 1
    main(["doctor", str(folder), "--map", str(topics)])
    assert capsys.readouterr().out.count("damaged after 2.") == 1


@pytest.mark.parametrize(("form", "tool"), [("sqlite3", "sqlite3 FILE .recover"), ("mcap", "mcap recover")])
def test_a_file_without_a_message_names_the_tool_that_mends_it(form: str, tool: str, tmp_path: Path) -> None:
    folder = bags.write(tmp_path / "drive", short(), form)
    file = next(folder.glob("drive*.*"))
    file.write_bytes(file.read_bytes()[:200])
    assert main(["import", str(folder)]) == 2
    with pytest.raises(DataError, match=re.escape(f"`{tool}` mends it")):
        BagFile(folder)


def test_a_recording_with_its_scene_is_no_bag(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = str(tmp_path / "own.mcap")
    assert main(["record", "crossing_path", "--set", "horizon=0.2", "--out", log, "--no-replay"]) == 0
    assert main(["import", log]) == 2
    assert "coopenv run reads a recording of coopenv" in capsys.readouterr().err


@pytest.mark.parametrize("form", ["ros1", "mcap"])
def test_changed_bytes_give_one_error_line_or_a_bag(form: str, written: dict[str, Path], topics: Path) -> None:
    data, generator = written[form].read_bytes(), np.random.default_rng(5)
    for number in range(6):
        changed = bytearray(data)
        for place in generator.integers(0, len(data), 4):
            changed[place] = int(generator.integers(256))
        path = topics.with_name(f"changed{number}{written[form].suffix}")
        path.write_bytes(changed)
        bag_or_line(path, topics)


MISTAKES: list[tuple[Callable[[str], str], str]] = [
    (lambda t: t.replace("SL2 = 2", "SL2 = 1"), "markers: the number 1 is used twice"),
    (lambda t: t.replace("marker = 3", "marker = 7"), "markers: the number 7 is used twice"),
    (lambda t: t.replace('"svea1"', '"svea3"'), "cars: the name 'svea3' is used twice"),
    (lambda t: t.replace("SL2 = 2", "SL3 = 2"), "markers: unknown name 'SL3'"),
    (lambda t: t.replace('"ML"', '"MX"'), "cars.svea1.landmark: unknown name 'MX'"),
    (lambda t: t.replace("agent =", "agnt ="), "agnt: unknown key .did you mean 'agent'"),
    (lambda t: t + '[cars.topics]\npont = "/a"\n', "pont: unknown key .did you mean 'point'"),
    (lambda t: t + '[cars.topics]\npoint = "/agent7/riccatiPoin"\n',
     r"cars\.svea1\.topics\.point: .* has no topic /agent7/riccatiPoin .did you mean '/agent7/riccatiPoint'"),
    (lambda t: t + '[cars.topics]\npoint = "/agent8/pixy_node/objectsInfo"\n',
     "objectsInfo of svea1 holds pixy_camera/msg/ObjectInfoArrayStamped, point is one of geometry_msgs/msg/Point"),
    (lambda t: t.replace('"authors"', '"none"'), r"cars\.svea3\.topics: names no topic of its odometry"),
    (lambda t: t.replace('"authors"', '"author"'),
     "names: unknown profile 'author'; known: diffdrive, svea, or a TOML file; also: authors, none"),
    (lambda t: t.replace('"crossing_path"', '"crossing_pth"'),
     r"topics\.toml: environment: .*did you mean 'crossing_path'"),
    (lambda t: t.replace('"crossing_path"', '"there.toml"'), r"topics\.toml: environment: .*there\.toml"),
    (lambda t: t + "[corrections.svea3]\ngyro_factor = 0\n", r"corrections\.svea3\.gyro_factor: is 0, which leaves"),
    (lambda t: t + "[corrections.svea3]\nwheel_factor = 0.0\n", r"corrections\.svea3\.wheel_factor: is 0, which"),
    (lambda t: t + "[clocks]\noffsets = { svea2 = 1.0 }\n", "clocks.offsets: 'svea2' is none of svea1, svea3, truth"),
    (lambda t: t + "[frames]\nmap = { yaw = 90.0 }\n", r"frames\.map\.yaw: .* less than or equal to 6\.28.*, got 90"),
    (lambda t: t + "[corrections.svea2]\ngyro_bias = 0.1\n", "corrections: unknown car 'svea2'.*; known: svea1, svea3"),
    (lambda t: t + "[corrections.svea3]\ndistortion = [0.1, 0.2, 0.3, 0.4, 0.5, 0.6]\n",
     r"corrections\.svea3\.distortion: has 6 coefficients, a model has 4, 5 or 8"),
    (lambda t: t + '[cars.topics]\nestimate = "/qualisys/svea3/pose"\n',
     r"topics\.toml: cars\.svea3\.topics\.truth and cars\.svea1\.topics\.estimate are one topic, /qualisys/svea3/pose"),
    (lambda t: 'calibration = "topics.toml"\n' + t, r"topics\.toml: calibration: topics\.toml: .*unknown key"),
    (lambda t: 'start = 99.0\n' + t, "too few for two ticks"),
    (lambda t: t + "[", "not valid TOML"),
    (lambda t: t.replace("[overrides]", '[overrides]\n"noise.enabld" = true'), "did you mean 'enabled'"),
]  # fmt: skip


@pytest.mark.parametrize(("change", "line"), MISTAKES)
def test_a_mistake_in_a_map_is_one_line(change: Callable[[str], str], line: str, tmp_path: Path) -> None:
    with pytest.raises(CoopenvError, match=line) as caught:
        opened(tmp_path, change(MAP))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["nowhere.bag", "nowhere.db3", "nowhere.mcap", "nofolder"])
def test_a_bag_that_is_not_there(name: str, topics: Path) -> None:
    with pytest.raises(DataError, match=f"no such bag: .*{name}"):
        Bag([topics.with_name(name)], topics)
    with pytest.raises(TopicMapError, match=r"nowhere\.toml: cannot be read"):
        load_map(topics.with_name("nowhere.toml"))


def test_offsets_in_a_calibration_are_refused(topics: Path) -> None:
    old = topics.with_name("old.toml")
    old.write_text("[overrides]\n[clocks]\nleads = {}\noffsets = { svea3 = 0.1 }\n[constants]\n")
    topics.write_text('calibration = "old.toml"\n' + topics.read_text())
    with pytest.raises(TopicMapError, match=r"calibration: old\.toml: clocks\.offsets: unknown key"):
        load_map(topics)


def test_a_folder_that_is_no_bag_is_an_error(topics: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = topics.with_name("empty")
    folder.mkdir()
    for command in ("run", "import"):
        assert main([command, str(folder), "--map", str(topics)]) == 2
        assert "empty: a folder without metadata.yaml, which a bag of ROS 2 has" in capsys.readouterr().err


def test_a_topic_of_which_nothing_is_of_use(tmp_path: Path) -> None:
    lost = {"twist": {"twist": ((np.nan,) * 3, (np.nan,) * 3)}}
    drive = [replace(m, fields=lost) if "twist" in m.topic else m for m in short()]
    with pytest.raises(
        DataError, match=r"actuation_twist of svea3: none of 30 messages is of use: wheel: twist.linear"
    ):
        opened(tmp_path, MAP, drive)


def test_files_of_other_programs_are_distinguished(
    written: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    foreign, text = tmp_path / "foreign.mcap", tmp_path / "text.mcap"
    shutil.copy(written["mcap"], foreign)
    assert metadata_names(foreign) == frozenset()
    assert kind_of(foreign) is kind_of(written["mcap"].parent) is BAG
    assert main(["run", str(foreign)]) == 2
    assert "foreign.mcap: a ROS bag, which needs a map" in capsys.readouterr().err
    text.write_bytes(b"no log")
    assert metadata_names(text) is None and kind_of(text) is LOG
    assert kind_of(text, "topics.toml") is BAG and ENVIRONMENT is kind_of("a\0b") is kind_of("crossing_path")


def test_the_camera_publishes_its_own_calibration(tmp_path: Path) -> None:
    matrices: dict[str, Any] = {"k": [400.0, 0, 160, 0, 410.0, 100, 0, 0, 1], "d": np.zeros(5)}
    fields = {**matrices, "height": 208, "width": 316, "distortion_model": "plumb_bob"}
    info = bags.Message("/agent8/pixy_node/camera_info", "sensor_msgs/msg/CameraInfo", 0, 0, fields)
    bag = opened(tmp_path, MAP, [*short(), info], "mcap")
    frame = next(sample.value for sample in bag.log.samples if isinstance(sample.value, Detections))
    blocks = next(m for m in short() if "objectsInfo" in m.topic).fields["objects"]
    largest = {b["signature"]: b for b in blocks if b["width"] == 9}
    assert frame.markers == tuple(sorted(largest))
    for marker, ray in zip(frame.markers, frame.bearings, strict=True):
        block = largest[marker]
        assert_allclose(ray[0] / ray[2], (block["center_x"] - 160.0) / 400.0)
        assert_allclose(ray[1] / ray[2], (block["center_y"] - 100.0) / 410.0)


def test_corrections_replace_the_published_calibration(tmp_path: Path) -> None:
    fields = {"k": [400.0, 0, 160, 0, 410.0, 100, 0, 0, 1], "d": np.zeros(5)}
    fields |= {"height": 208, "width": 316, "distortion_model": "plumb_bob"}
    info = bags.Message("/agent8/pixy_node/camera_info", "sensor_msgs/msg/CameraInfo", 0, 0, fields)
    lines = (
        "[corrections.svea3]\nfocal_length = [200.0, 201.0]\ndistortion = [0.1, 0.0, 0.0, 0.0]\nwheel_scale = 0.25\n"
    )
    given = [*short(), info]
    plain, bag = opened(tmp_path, MAP, given), opened(tmp_path / "new", MAP + lines + "gyro_bias = 0.5\n", given)
    lens = replace(plain.log.streams.lenses["svea3"], focal_length=(200.0, 201.0), distortion=(0.1, 0.0, 0.0, 0.0))
    assert bag.log.streams.lenses["svea3"] == lens and lens.principal_point == (160.0, 100.0)
    pairs = [(a.value, b.value) for a, b in zip(plain.log.samples, bag.log.samples, strict=True)]
    twists = [(a, b) for a, b in pairs if isinstance(a, Twist) and isinstance(b, Twist)]
    for a, b in twists:
        assert_allclose(b.linear, a.linear / 1.25)  # type: ignore[operator]
        assert_allclose(b.angular, a.angular - [0.0, 0.0, 0.5])  # type: ignore[operator]
    assert twists


def test_a_lead_of_a_topic_holds_for_any_clock_of_its_car(tmp_path: Path) -> None:
    lead, twist = 0.015, "/agent8/actuation_twist"
    for ahead in (0.0, 0.4):
        drive = bags.later(bags.later(short(), stamps=ahead, topics="/agent8"), stamps=-lead, topics=twist)
        lines = f'[clocks]\nleads = {{ "{twist}" = {lead} }}\n'
        bag = opened(tmp_path / f"{ahead}", MAP + lines, drive)
        gaps = [s.stamp - bags.BEGIN for s in bag.log.samples if isinstance(s.value, Twist)]
        at = [m.stamp for m in short() if m.topic == twist]
        assert_allclose(gaps, at, atol=2e6)
        assert bag.log.streams.added["svea3", Role.WHEEL][1] == pytest.approx(lead - ahead, abs=2e-3)


def test_motion_capture_far_from_the_map_is_warned_of(tmp_path: Path) -> None:
    drive = [m for m in short() if "qualisys" not in m.topic]
    for m in (m for m in short() if "qualisys" in m.topic):
        place = m.fields["pose"].position
        pose = codec.pose(np.eye(3), np.array([place.x + 1500.0, place.y, place.z]))
        drive.append(replace(m, fields={"pose": pose}))
    with pytest.warns(
        DataWarning, match=r"motion capture of svea3, topic .*, is .* m from landmarks that span .* right\?"
    ):
        opened(tmp_path, MAP, drive)


def test_an_uncalibrated_camera_has_the_calibration_of_the_environment(tmp_path: Path) -> None:
    fields = {"k": np.zeros(9), "d": [], "height": 208, "width": 316, "distortion_model": ""}
    info = bags.Message("/agent8/pixy_node/camera_info", "sensor_msgs/msg/CameraInfo", 0, 0, fields)
    with pytest.warns(DataWarning, match=r"camera_info: says that the camera is not calibrated \(k is zero\)"):
        bag = opened(tmp_path / "with", MAP, [*short(), info], "mcap")
    assert bag.log.streams.lenses == opened(tmp_path / "without", MAP, short(), "mcap").log.streams.lenses


def test_a_clock_that_was_set_leaves_a_gap_that_is_named(tmp_path: Path) -> None:
    day, drive = 86_400 * 10**9, sorted(short(), key=lambda message: message.received)
    half = drive[len(drive) // 2].received
    later = [
        m if m.received < half else replace(m, received=m.received + day, stamp=m.stamp + day if m.stamp else 0)
        for m in drive
    ]
    with pytest.raises(DataError, match=r"drive: nothing for 8\.64e\+04 s after .* start and duration in topics\.toml"):
        opened(tmp_path, MAP, later, "mcap")
    part = opened(tmp_path / "part", f"duration = 0.1\n{MAP}", later, "mcap")
    assert part.capabilities.ticks == 7


def test_messages_at_impossible_times_are_left_out(tmp_path: Path) -> None:
    path = bags.write(tmp_path / "late", [*short()[:-1], replace(short()[-1], received=2**62)], "sqlite3")
    with BagFile(path) as bag, pytest.warns(DataWarning, match="left out that were received after 2096"):
        assert sum(len(received) for _, received in bag.times().values()) == len(short()) - 1


def test_a_database_whose_messages_are_a_query_or_damaged(tmp_path: Path) -> None:
    path = next(bags.write(tmp_path / "bag", short(), "sqlite3").glob("*.db3"))
    with sqlite3.connect(path) as database:
        database.execute("UPDATE messages SET data = 5 WHERE id = 9")
        database.execute("UPDATE messages SET timestamp = 1.5e300 WHERE id = 10")
    with BagFile(path) as bag:
        assert sum(len(received) for _, received in bag.times().values()) == len(short()) - 2
    with sqlite3.connect(path) as database:
        database.execute("ALTER TABLE messages RENAME TO kept")
        endless = "WITH RECURSIVE more(n) AS (SELECT 1 UNION ALL SELECT n + 1 FROM more) SELECT n FROM more"
        database.execute(f"CREATE VIEW Messages AS SELECT kept.* FROM kept, ({endless})")
    with pytest.raises(DataError, match="Messages is no table"):
        BagFile(path)


def test_the_imu_measures_turns_where_there_is_one(tmp_path: Path) -> None:
    turning = {"angular_velocity": (0.0, 0.0, 0.7), "linear_acceleration": (0.0, 0.0, 9.8)}
    wheels = [m for m in short() if "twist" in m.topic]
    imu = [replace(m, topic="/imu", kind="sensor_msgs/msg/Imu", fields=turning) for m in wheels]
    text = MAP.replace("agent = 8", 'agent = 8\ntopics = { imu = "/imu" }')
    *_, last = opened(tmp_path, text, [*short(), *imu], "mcap").episode(None, {})
    assert_allclose(last.angular_velocity, [[0.0, 0.0, 0.7]])
    with pytest.warns(DataWarning, match=r"turn rates of svea3 are the wheels'; unread: /imu, of type sensor_msgs"):
        opened(tmp_path / "unread", MAP, [*short(), *imu], "mcap")


def test_frames_of_the_laboratory_become_the_environments(tmp_path: Path) -> None:
    frames = "[frames]\nmap = { position = [1.0, 2.0, 0.5] }\ntruth = { yaw = 1.5707963267948966 }\n"
    plain, turned = opened(tmp_path, MAP), opened(tmp_path / "turned", MAP + frames)
    for a, b in zip(plain.episode(None, {}), turned.episode(None, {}), strict=True):
        assert_allclose(b.landmarks[4], a.landmarks[4] + [1.0, 2.0, 0.5])
        assert a.truth is not None and b.truth is not None
        x, y, z = a.truth.position[0]
        assert_allclose(b.truth.position[0], [-y, x, z], atol=1e-12)
        x, y, z = a.truth.rotation[0, :, 0]
        assert_allclose(b.truth.rotation[0, :, 0], [-y, x, z], atol=1e-12)


def test_a_camera_with_another_rate_is_reported(tmp_path: Path) -> None:
    with pytest.warns(DataWarning, match=r'60\.0 frames per second, the environment has 30: .* "rates.camera" = 60\.0'):
        opened(tmp_path, MAP.replace("[overrides]", '[overrides]\n"rates.camera" = 30.0\n"rates.observer" = 30.0'))


def test_odometry_that_comes_seldom_is_reported(tmp_path: Path) -> None:
    """The environment has five times as many samples; twice as many are common."""
    rate = re.search(r'"rates.odometry" = (\d+)', MAP)
    assert rate is not None
    often = MAP.replace(rate[0], f'"rates.odometry" = {5 * int(rate[1])}')
    with pytest.warns(DataWarning, match=rf'messages per second, the environment has {5 * int(rate[1])}: .*"rates.odo'):
        opened(tmp_path, often)


def test_the_rate_of_a_camera_may_be_any(tmp_path: Path) -> None:
    """The environment's decisions are 20 Hz; a recording has none."""
    for rate in (15.0, 50.0, 59.4):
        bag = opened(
            tmp_path / str(rate), MAP.replace('"rates.odometry"', f'"rates.camera" = {rate}\n"rates.odometry"')
        )
        assert bag.scenario.rates.camera == rate and bag.capabilities.ticks == pytest.approx(0.5 * rate, abs=3)


def test_messages_that_came_before_the_recorders_clock_was_set_count(tmp_path: Path) -> None:
    """Their time of reception is 0; their stamps are right."""
    sent = longer(2)
    early = [replace(m, received=-bags.BEGIN) if m.stamp < 500_000_000 else m for m in sent]
    for form in ("ros1", "mcap"):
        whole, found = (opened(tmp_path / f"{form}{k}", MAP, drive, form) for k, drive in enumerate((sent, early)))
        assert found.capabilities.ticks == whole.capabilities.ticks
        assert len(found.log.samples) == len(whole.log.samples)


def test_a_turn_rate_that_is_always_0_is_named(tmp_path: Path) -> None:
    """Motion capture turns by 57 deg; see `tests/cars/test_turning.py` for bearings and commands."""

    def turning(m: bags.Message) -> bags.Message:
        pose = {"pose": codec.pose(exp_so3(np.array([0.0, 0.0, 0.25e-9 * m.stamp])), (0.0, 0.0, 0.0))}
        return replace(m, fields=pose) if "qualisys" in m.topic else m

    def dead(m: bags.Message) -> bags.Message:
        still = {"twist": (m.fields["twist"]["twist"][0], (0.0, 0.0, 0.0))} if "twist" in m.topic else {}
        return replace(m, fields={"twist": still}) if still else m

    drive = [*map(turning, bags.sent())]
    assert not [line for line in warned(tmp_path / "sound", MAP, drive) if "turn rate" in line]
    [line] = [line for line in warned(tmp_path / "dead", MAP, [*map(dead, drive)]) if "turn rate" in line]
    assert re.search(r"actuation_twist: .* of svea3 is 0 rad/s in all \d+ messages, while motion .* by 57 deg$", line)


def test_a_bag_is_no_scenario() -> None:
    with pytest.raises(CoopenvError, match=r"drive\.bag: a ROS bag is no scenario; .* run BAG --map topics.toml"):
        load_scenario("drive.bag")


TOPIC, KIND = "/blob", "std_msgs/msg/String"
LARGE = 40 * 2**20
"""Bytes of a message of zeros, more than any may have."""


def bomb(path: Path, form: str, size: int = LARGE, count: int = 1) -> Path:
    """Write a bag whose messages are zeros."""
    path, bag, store = bags.writer(path, form)
    with bag:
        connection = bag.add_connection(TOPIC, KIND, typestore=store)
        for number in range(count):
            bag.write(connection, 10**9 + number, bytes(size))
    return path


def read(path: Path) -> int:
    """Return how many messages a bag yields."""
    with files.BagFile(path) as bag:
        return sum(1 for _ in bag.messages([TOPIC]))


@pytest.mark.parametrize(
    "form", ["mcap STORAGE", "mcap MESSAGE", "mcap FILE", "sqlite3 MESSAGE", "sqlite3 FILE", "ros1 BZ2", "ros1 LZ4"]
)
def test_a_bag_that_unpacks_to_far_more_than_it_is(form: str, tmp_path: Path) -> None:
    assert read(bomb(tmp_path / "small", form, 2**20, 3)) == 3
    path = bomb(tmp_path / "drive", form)
    tracemalloc.start()
    with pytest.raises(DataError, match=r"drive\S*: .*would unpack to .*more than") as caught:
        read(path)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert "\n" not in str(caught.value)
    assert peak < 2.5 * container.AT_ONCE


def test_a_value_of_a_database_that_is_too_large(tmp_path: Path) -> None:
    assert read(bomb(tmp_path / "small", "sqlite3", 2**20, 3)) == 3
    with BagFile(bomb(tmp_path / "drive", "sqlite3")) as bag:
        (decode,) = (decode for _, _, decode in bag.messages(bag.topics))
    with pytest.raises(CoopenvError, match="cannot be read"):
        decode()


def test_chunks_that_unpack_to_much_together(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = bomb(tmp_path / "drive", "mcap STORAGE", 2**20, 4)
    assert read(path) == 4
    monkeypatch.setattr(container, "AT_ONCE", 2 * 2**20)
    monkeypatch.setitem(streams.EXPANSION, ".mcap", 50)
    with pytest.raises(DataError, match="would unpack to"):
        read(path)


def warned(folder: Path, text: str, drive: list[bags.Message]) -> list[str]:
    """Return the warnings at the opening of a bag."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        opened(folder, text, drive)
    return [str(w.message) for w in caught if issubclass(w.category, DataWarning)]


def test_truth_in_another_unit_or_frame_is_noticed(tmp_path: Path) -> None:
    def changed(turn: float, scale: float) -> list[bags.Message]:
        def of(m: bags.Message) -> bags.Message:
            pose = m.fields["pose"]
            R, p = exp_so3(np.array([0.0, 0.0, turn])), pose.position
            return replace(m, fields={"pose": codec.pose(R, np.array([p.x, p.y, p.z]) * scale)})

        return [of(m) if "qualisys" in m.topic else m for m in longer()]

    assert not warned(tmp_path / "right", MAP, longer())
    [line] = warned(tmp_path / "turned", MAP, changed(-1.5, 1.0))
    assert re.search(r"motion capture of svea3, topic /qualisys/svea3/pose, is \d+ deg off the bearings", line)
    [line] = warned(tmp_path / "mm", MAP, changed(1.8, 1000.0))
    assert "m from landmarks" in line and "/qualisys/svea3/pose" in line


def test_markers_of_one_side_alone_are_counted(tmp_path: Path) -> None:
    text = MAP.replace("SL1 = 1, SL2 = 2", "SL1 = 9, SL2 = 2")
    lines = warned(tmp_path, text, longer())
    assert any("markers of landmarks that were never detected: 9 (SL1)" in line for line in lines)
    assert any(re.search(r"detected markers that are not in the map: 1 \(\d+ times\)", line) for line in lines)
