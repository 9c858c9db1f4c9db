"""Poses of cars in transforms, through a static tree; unstamped twists and poses; mountings of cameras."""

import warnings
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from coopenv import DataError
from coopenv.cars.bags.bag import Bag
from coopenv.cars.bags.transforms import StaticTree
from coopenv.cars.messages import codec
from coopenv.cars.messages.readings import CarPose
from coopenv.cars.settings.profile import Role
from tests.helpers import bags

pytest.importorskip("rosbags", reason="needs the extra 'log'")

TREE = "tf2_msgs/msg/TFMessage"
CAPTURED, MARKERS = np.eye(4), np.eye(4)
CAPTURED[:3, :3], CAPTURED[:3, 3] = Rotation.from_euler("zyx", [30, 5, -4], degrees=True).as_matrix(), (1.0, -2.0, 0.3)
MARKERS[:3, :3], MARKERS[:3, 3] = Rotation.from_euler("zyx", [-70, 2, 8], degrees=True).as_matrix(), (0.1, 0.02, 0.2)
"""Pose of the frame of motion capture in the map, and of the markers on the car in its body."""

Row = tuple[str, str, int, Any]  # topic, type, ns, message


def matrix(pose: Any) -> np.ndarray:
    """Return the homogeneous matrix of a Pose."""
    q, found = pose.orientation, np.eye(4)
    found[:3, :3] = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
    found[:3, 3] = pose.position.x, pose.position.y, pose.position.z
    return found


def transform(parent: str, child: str, place: np.ndarray, t: int = 0) -> dict[str, Any]:
    """Return the fields of a TransformStamped."""
    turned = Rotation.from_matrix(place[:3, :3]).as_quat()
    about = {"header": codec.header(bags.BEGIN + t, parent), "child_frame_id": child}
    return {**about, "transform": {"translation": place[:3, 3], "rotation": turned}}


@cache
def rows() -> tuple[Row, ...]:
    """The first two seconds of the drive."""
    return tuple((m.topic, m.kind, m.received, bags.made(m)) for m in bags.sent() if m.stamp < 2 * 10**9)


def in_transforms(static: Iterable[dict[str, Any]]) -> Iterator[Row]:
    """Yield the drive with its motion capture as transforms of the markers on the car."""
    yield "/tf_static", TREE, 0, codec.make(TREE, transforms=[*static])
    for topic, kind, t, message in rows():
        if not topic.startswith("/qualisys"):
            yield topic, kind, t, message
            continue
        place = np.linalg.inv(CAPTURED) @ matrix(message.pose) @ MARKERS
        moved = [transform("mocap", "/svea3/markers", place, t), transform("mocap", "table", np.eye(4), t)]
        yield "/tf", TREE, t, codec.make(TREE, transforms=moved)
        yield "/tf", TREE, t, codec.make(TREE, transforms=[transform("mocap", "table", np.eye(4), t)])


def write(path: Path, given: Iterable[Row], form: str = "mcap") -> Path:
    path, opened, store = bags.writer(path, form)
    connections: dict[str, Any] = {}
    with opened as bag:
        for topic, kind, t, message in sorted(given, key=lambda row: row[2]):
            if topic not in connections and kind == TREE and store is codec.ros1():  # which has not this type
                one = "geometry_msgs/TransformStamped"
                text, _ = store.generate_msgdef("geometry_msgs/msg/TransformStamped", ros_version=1)
                text = f"{one}[] transforms\n{'=' * 80}\nMSG: {one}\n{text}"
                connections[topic] = bag.add_connection(topic, kind, msgdef=text, md5sum="0" * 32)
            elif topic not in connections:
                connections[topic] = bag.add_connection(topic, kind, typestore=store)
            payload = codec.encode(message)
            payload = payload if store is codec.ros2() else codec.ros1_of(payload, kind)
            bag.write(connections[topic], bags.BEGIN + t, payload)
    return path


def read(path: Path, text: str = bags.MAP) -> tuple[Bag, list[str]]:
    """Return a bag and its warnings."""
    topics = path.parent / "topics.toml"
    topics.write_text(text, encoding="utf-8")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        bag = Bag([path], topics)
    return bag, [str(w.message).partition(": ")[2] for w in caught]


def truth_of(bag: Bag) -> list[CarPose]:
    return [s.value for s in bag.log.samples if s.role is Role.TRUTH and isinstance(s.value, CarPose)]


STATIC = [transform("map", "mocap", CAPTURED), transform("svea3/markers", "svea3/body", np.linalg.inv(MARKERS))]
OF_TREE = bags.MAP.replace("agent = 8", 'agent = 8\nbody = "svea3/body"\n[cars.topics]\ntruth = "/tf"')


@pytest.mark.parametrize("form", ["ros1", "sqlite3", "mcap"])
def test_motion_capture_in_transforms_is_that_in_poses(form: str, tmp_path: Path) -> None:
    expected, _ = read(write(tmp_path / "plain", rows()))
    found, warned = read(write(tmp_path / "tree", in_transforms(STATIC), form), OF_TREE)
    assert not [line for line in warned if "transforms" in line or "left out" in line]
    pairs = [*zip(truth_of(found), truth_of(expected), strict=True)]
    assert len(pairs) == 120
    for a, b in pairs:
        assert a.rotation is not None and b.rotation is not None
        assert_allclose(a.position, b.position, atol=1e-9)
        assert_allclose(a.rotation, b.rotation, atol=1e-9)


def test_without_the_key_the_poses_in_transforms_are_named(tmp_path: Path) -> None:
    _, warned = read(write(tmp_path / "tree", in_transforms(STATIC)))
    [line] = [line for line in warned if "transforms" in line]
    assert "/tf: mocap -> /svea3/markers; `truth` and `body` name topic and frame" in line and "table" not in line


def test_two_cars_share_a_topic_of_transforms(tmp_path: Path) -> None:
    text = f'{OF_TREE}body = "table"\n[cars.topics]\ntruth = "/tf"\n'
    given = [row for row in in_transforms(STATIC) if row[0] != "/agent7/riccatiPoint"]
    bag, _ = read(write(tmp_path / "tree", given), text)
    places = {s.car: s.value.position for s in bag.log.samples if isinstance(s.value, CarPose)}
    assert_allclose(places["svea1"], CAPTURED[:3, 3], atol=1e-9)
    assert set(places) == {"svea1", "svea3"}


def test_a_tree_with_a_circle_ends() -> None:
    tree = StaticTree({"a": ("b", CarPose(np.ones(3), np.eye(3))), "b": ("a", CarPose(np.ones(3), np.eye(3)))})
    frame, pose = tree.up("a")
    assert frame in "ab" and np.isfinite(pose.position).all()


@pytest.mark.parametrize("kind", ["Twist", "TwistWithCovariance"])
def test_unstamped_twists_count_when_they_were_received(kind: str, tmp_path: Path) -> None:
    def unstamped() -> Iterator[Row]:
        for topic, name, t, message in rows():
            if topic == bags.AUTHORS["twist"]:
                name, message = f"geometry_msgs/msg/{kind}", message.twist if "With" in kind else message.twist.twist
            yield topic, name, t, message

    expected, _ = read(write(tmp_path / "plain", rows()))
    found, warned = read(write(tmp_path / "bare", unstamped()))
    assert [line for line in warned if "when they were received" in line] == [
        "topic /agent8/actuation_twist: messages without stamps count when they were received"
    ]
    for a, b in zip(found.episode(None, {}), expected.episode(None, {}), strict=True):
        assert_allclose(a.translation, b.translation, atol=1e-12)
        assert_allclose(a.rotation, b.rotation, atol=1e-12)


def test_transforms_are_no_odometry(tmp_path: Path) -> None:
    text = bags.MAP.replace("agent = 8", 'agent = 8\n[cars.topics]\nwheel = "/tf"')
    with pytest.raises(DataError, match=r"/tf of svea3 holds tf2_msgs/msg/TFMessage, wheel is one of "):
        read(write(tmp_path / "tree", in_transforms(STATIC)), text)


@pytest.mark.parametrize(("degrees", "noted"), [(0.0, False), (5.0, True)])
def test_another_mounting_of_a_camera_is_named(degrees: float, noted: bool, tmp_path: Path) -> None:
    """The optical frame looks along the body's x axis: x right, y down."""
    mounted = np.eye(4)
    forward = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    mounted[:3, :3] = Rotation.from_euler("z", degrees, degrees=True).as_matrix() @ forward
    camera = bags.lens()
    mounted[:3, 3] = camera.position
    static = [transform("base_footprint", "base_link", MARKERS), transform("base_link", "svea3/eye", mounted)]

    def framed() -> Iterator[Row]:
        yield "/tf_static", TREE, 0, codec.make(TREE, transforms=static)
        for topic, kind, t, message in rows():
            if topic == bags.AUTHORS["blocks"]:
                message = codec.decode(codec.encode(message), kind)
                message.header.frame_id = "svea3/eye"
            yield topic, kind, t, message

    _, warned = read(write(tmp_path / "framed", framed()))
    lines = [line for line in warned if "mount it" in line]
    assert bool(lines) == noted
    assert not noted or ("of base_link, 5 deg and 0 m off" in lines[0] and "camera of svea3" in lines[0])
