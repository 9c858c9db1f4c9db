"""The sample bags of examples/bags in three forms, their defects, and the map that is proposed for an unknown bag."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

import coopenv
from coopenv.base.errors import DataWarning
from coopenv.cars.bags.bag import Bag
from coopenv.cars.bags.files import BagFile
from coopenv.cars.bags.topic_map import load_map
from coopenv.cars.bags.topics import TopicRow, cars_of, examined, proposed, role_of
from coopenv.cars.calibration import identify
from coopenv.cars.settings.profile import Role
from coopenv.cli.app import main
from tests.helpers.commands import refused

pytest.importorskip("rosbags", reason="needs the extra 'log'")

SAMPLES = Path(__file__).parents[3] / "examples" / "bags"
FORMS = ("mcap", "sqlite3", "ros1.bag")
BLOCKS, INFO = "pixy_camera/msg/ObjectInfoArrayStamped", "sensor_msgs/msg/CameraInfo"
TWIST, ODOMETRY, POSE = "geometry_msgs/msg/TwistStamped", "nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseStamped"


def test_the_samples_are_copied(tmp_path: Path) -> None:
    for _ in range(2):  # a notebook may run its cells again
        folder = coopenv.sample_bags(tmp_path / "bags")
        assert {path.name for path in folder.iterdir()} == {*FORMS, "topics.toml"}
    (tmp_path / "file").touch()
    with pytest.raises(coopenv.OutputError, match=r"^cannot write to .*file: it is not a folder$"):
        coopenv.sample_bags(tmp_path / "file")


def test_the_samples_hold_the_same_drive_with_its_defects() -> None:
    found = []
    for form in FORMS:
        with BagFile(SAMPLES / form) as file:
            found.append(examined([file]))
    assert found[0] == found[1] == found[2]
    rows, notes = found[0]
    table = {row.topic: row for row in rows}
    blocks = table["/fleet/svea7/pixy/objects_info"]
    with BagFile(SAMPLES / "mcap") as file:
        [(stamps, received)] = [found for name, found in file.times().items() if name == blocks.topic]
    assert blocks.outlying == (stamps - received > 2 * 10**9).sum() == pytest.approx(0.01 * len(stamps), rel=0.5)
    assert any(f"{blocks.outlying} of {len(stamps)} stamps are wrong" in note for note in notes)
    assert blocks.rate is not None and 56.0 < blocks.rate < 59.0  # 3 % of 60 Hz are lost
    imu = table["/fleet/svea1/mavros/imu/data_raw"]
    assert imu.offset == pytest.approx(-0.12 - 6.0 * 0.0002, abs=0.003)  # in the middle of 12 s
    drifts = [float(m[1]) for note in notes if (m := re.search(r"svea1/mavros/imu.* drifts by ([-+]\d+) us", note))]
    assert drifts == [pytest.approx(-200.0, abs=40.0)]


def test_commands_of_the_samples_identify_the_fake_that_made_them(monkeypatch: pytest.MonkeyPatch) -> None:
    """The tutorial on logs calibrates them."""
    monkeypatch.setattr(identify, "COMPARED", 0.5)
    with pytest.warns(DataWarning):
        bag = Bag([SAMPLES / "mcap"], SAMPLES / "topics.toml")
    assert {car for car, role in bag.log.sent if role is Role.MANUAL} == {"svea7", "svea1"}
    rows = {row.name: row for row in identify.identify(bag).rows}
    for name in ("fake.latency", "fake.speed_gain", "fake.steering_gain", "dynamics.speed_time_constant"):
        assert not rows[name].finding and rows[name].value == pytest.approx(rows[name].given, abs=0.03)


def test_a_sample_gives_the_accuracy_of_a_clean_drive(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The other forms hold the same drive; tests/cars/bags/test_bags.py reads each of them."""
    command = ["run", str(SAMPLES / "mcap"), "--map", str(SAMPLES / "topics.toml"), "--set", "horizon=8.0"]
    assert main([*command, "--no-figures", "--out", str(tmp_path / "out")]) == 0
    rows = re.findall(r"^(vehicle_\d)((?: +[\d.]+)+)$", capsys.readouterr().out, re.MULTILINE)
    rmse = {name: float(numbers.split()[4]) for name, numbers in rows}
    assert len(rmse) == 2 and all(value < 0.03 for value in rmse.values())


def test_the_proposed_map_gives_the_samples_of_the_written_map(tmp_path: Path) -> None:
    path = tmp_path / "topics.toml"
    assert main(["import", str(SAMPLES / "mcap"), "--propose", str(path)]) == 0
    assert load_map(path).environment == "my_environment.toml"
    text = path.read_text(encoding="utf-8").replace("my_environment.toml", "svea_overtaking")
    text = text.replace("markers = {}", "markers = { SL1 = 1, SL2 = 2, SL4 = 4, SL5 = 5 }")
    for car, vehicle, marker in (("svea1", "vehicle_2", 6), ("svea7", "vehicle_1", 7)):
        text = text.replace(f'name = "{car}"', f'name = "{car}"\nvehicle = "{vehicle}"\nmarker = {marker}')
    path.write_text(text, encoding="utf-8")
    own, written = (Bag([SAMPLES / "mcap"], where) for where in (path, SAMPLES / "topics.toml"))
    assert sorted(map(repr, own.log.samples)) == sorted(map(repr, written.log.samples))
    assert main(["import", str(SAMPLES / "mcap"), "--propose", str(path)]) == 2  # is there


def test_a_map_is_written_where_there_is_a_folder(tmp_path: Path) -> None:
    path = tmp_path / "none" / "topics.toml"
    assert f"{path.parent} does not exist" in refused("import", str(SAMPLES / "mcap"), "--propose", str(path))


def row(topic: str, kind: str, messages: int = 10) -> TopicRow:
    return TopicRow(topic, kind, messages, 1.0)


@pytest.mark.parametrize(
    ("rows", "cars"),
    [
        (
            [row("/camera/blocks", BLOCKS), row("/camera/info", INFO), row("/odom", ODOMETRY), row("/vrpn/a", POSE)],
            {"car": {"detections": "/camera/blocks", "camera_info": "/camera/info", "odometry": "/odom",
                     "truth": "/vrpn/a"}},
        ),
        (
            [row("/r2/blocks", BLOCKS), row("/r2/twist", TWIST), row("/r2/twist_old", TWIST, 3),
             row("/r2/cmd_vel", TWIST, 99)],
            {"r2": {"detections": "/r2/blocks", "wheel": "/r2/twist"}},
        ),
        (
            [row("/a/1/blocks", BLOCKS), row("/a/2/blocks", BLOCKS), row("/a/2/odom", ODOMETRY),
             row("/mocap/1/pose", POSE)],
            {"car_1": {"detections": "/a/1/blocks", "truth": "/mocap/1/pose"},
             "car_2": {"detections": "/a/2/blocks", "odometry": "/a/2/odom"}},
        ),
    ],
)  # fmt: skip
def test_cars_are_found_by_names_and_types(rows: list[TopicRow], cars: dict[str, dict[str, str]]) -> None:
    assert cars_of(rows) == {car: {Role(r): t for r, t in topics.items()} for car, topics in cars.items()}


def test_topics_of_other_types_are_left_out_and_commands_to_the_wheels_are_not() -> None:
    assert role_of(row("/words", "std_msgs/msg/String")) is None
    assert role_of(row("/send", "mavros_msgs/msg/ManualControl")) is Role.MANUAL


def test_without_a_camera_nothing_is_proposed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from tests.helpers import bags

    drive = [m for m in bags.messages(bags.drive()) if "pixy" not in m.topic]
    path = bags.write(tmp_path / "drive", drive, "mcap")
    assert main(["import", str(path), "--propose", str(tmp_path / "map.toml")]) == 2
    assert "no topic has detections of a camera (pixy_camera/" in capsys.readouterr().err
    with BagFile(path) as file, pytest.raises(Exception, match="no map can be proposed"):
        proposed([file], examined([file])[0])
