"""Bags of the detectors in the field, written by rosbags and mcap with their own definitions, in ROS 1 and ROS 2."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from coopenv import CoopenvError
from coopenv.cars.bags.definitions import BagChannel, decode
from coopenv.cars.bags.files import BagFile
from coopenv.cars.messages.readings import Detections, read
from coopenv.cars.messages.vision import Calibration
from coopenv.cars.settings.profile import Role

pytest.importorskip("rosbags", reason="needs the extra 'log'")
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

CAMERA = Calibration((640, 480), (450.0, 455.0), (322.0, 236.0), (0.0,) * 5)
PIXELS = {7: (100.0, 50.0), 3: (500.5, 400.0)}
RAYS = {n: np.array([(u - 322.0) / 450.0, (v - 236.0) / 455.0, 1.0]) for n, (u, v) in PIXELS.items()}
HEADER = {"stamp": {"sec": 5, "nanosec": 7}, "frame_id": "camera"}


def at(ray: np.ndarray) -> dict[str, float]:
    """Return a position along a ray."""
    return dict(zip("xyz", (2.0 * ray).tolist(), strict=True))


def corners(n: int) -> list[dict[str, float]]:
    u, v = PIXELS[n]
    return [{"x": u + du, "y": v + dv} for du, dv in ((-9.0, -9.0), (9.0, -9.0), (9.0, 9.0), (-9.0, 9.0))]


POSE = {"orientation": {"w": 1.0}}
FIELD: dict[str, tuple[dict[str, str], dict[str, Any]]] = {
    "apriltag_msgs/msg/AprilTagDetectionArray": (
        {
            "AprilTagDetectionArray": "std_msgs/Header header\nAprilTagDetection[] detections",
            "AprilTagDetection": "string family\nint32 id\nint32 hamming\nfloat32 goodness\nfloat32 decision_margin\n"
            "Point centre\nPoint[4] corners\nfloat64[9] homography",
            "Point": "float64 x\nfloat64 y",
        },
        {
            "detections": [
                {"id": n, "centre": {"x": u + 0.5, "y": v + 0.5}, "corners": corners(n), "hamming": 1}
                for n, (u, v) in PIXELS.items()
            ]
        },
    ),
    "apriltag_ros/msg/AprilTagDetectionArray": (
        {
            "AprilTagDetectionArray": "std_msgs/Header header\nAprilTagDetection[] detections",
            "AprilTagDetection": "int32[] id\nfloat64[] size\ngeometry_msgs/PoseWithCovarianceStamped pose",
        },
        {
            "detections": [
                {"id": [n], "size": [0.1], "pose": {"pose": {"pose": {"position": at(r), **POSE}}}}
                for n, r in RAYS.items()
            ]
        },
    ),
    "aruco_msgs/msg/MarkerArray": (
        {
            "MarkerArray": "std_msgs/Header header\nMarker[] markers",
            "Marker": "std_msgs/Header header\nuint32 id\ngeometry_msgs/PoseWithCovariance pose\nfloat64 confidence",
        },
        {
            "markers": [
                {"id": n, "pose": {"pose": {"position": at(r), **POSE}}, "confidence": 0.5} for n, r in RAYS.items()
            ]
        },
    ),
    "aruco_opencv_msgs/msg/ArucoDetection": (
        {
            "ArucoDetection": "std_msgs/Header header\nMarkerPose[] markers\nBoardPose[] boards",
            "MarkerPose": "uint16 marker_id\ngeometry_msgs/Pose pose",
            "BoardPose": "string board_name\ngeometry_msgs/Pose pose",
        },
        {"markers": [{"marker_id": n, "pose": {"position": at(r), **POSE}} for n, r in RAYS.items()]},
    ),
    "ros2_aruco_interfaces/msg/ArucoMarkers": (
        {"ArucoMarkers": "std_msgs/Header header\nint64[] marker_ids\ngeometry_msgs/Pose[] poses"},
        {"marker_ids": [*RAYS], "poses": [{"position": at(r), **POSE} for r in RAYS.values()]},
    ),
    "isaac_ros_apriltag_interfaces/msg/AprilTagDetectionArray": (
        {
            "AprilTagDetectionArray": "std_msgs/Header header\nAprilTagDetection[] detections",
            "AprilTagDetection": "string family\nint32 id\nCorner center\nCorner[4] corners\n"
            "geometry_msgs/PoseWithCovarianceStamped pose",
            "Corner": "float64 x\nfloat64 y\nfloat64 z",
        },
        {
            "detections": [
                {"id": n, "pose": {"pose": {"pose": {"position": at(r), **POSE}}}, "corners": [{}] * 4}
                for n, r in RAYS.items()
            ]
        },
    ),
    "ar_track_alvar_msgs/msg/AlvarMarkers": (
        {
            "AlvarMarkers": "std_msgs/Header header\nAlvarMarker[] markers",
            "AlvarMarker": "std_msgs/Header header\nuint32 id\nuint32 confidence\ngeometry_msgs/PoseStamped pose",
        },
        {"markers": [{"id": n, "pose": {"pose": {"position": at(r), **POSE}}} for n, r in RAYS.items()]},
    ),
    "fiducial_msgs/msg/FiducialTransformArray": (
        {
            "FiducialTransformArray": "std_msgs/Header header\nint32 image_seq\nFiducialTransform[] transforms",
            "FiducialTransform": "int32 fiducial_id\ngeometry_msgs/Transform transform\nfloat64 image_error",
        },
        {"transforms": [{"fiducial_id": n, "transform": {"translation": at(r)}} for n, r in RAYS.items()]},
    ),
    "fiducial_msgs/msg/FiducialArray": (
        {
            "FiducialArray": "std_msgs/Header header\nint32 image_seq\nFiducial[] fiducials",
            "Fiducial": "int32 fiducial_id\nint32 direction\n"
            + "\n".join(f"float64 {a}{k}" for k in range(4) for a in "xy"),
        },
        {
            "fiducials": [
                {"fiducial_id": n, **{f"{a}{k}": c[a] for k, c in enumerate(corners(n)) for a in "xy"}} for n in PIXELS
            ]
        },
    ),
    "vision_msgs/msg/Detection2DArray": (
        {
            "Detection2DArray": "std_msgs/Header header\nDetection2D[] detections",
            "Detection2D": "std_msgs/Header header\nHypothesis[] results\nBoundingBox2D bbox",
            "Hypothesis": "int64 id\nfloat64 score",
            "BoundingBox2D": "geometry_msgs/Pose2D center\nfloat64 size_x\nfloat64 size_y",
        },
        {
            "detections": [
                {
                    "results": [{"id": n, "score": 0.9}],
                    "bbox": {"center": {"x": u, "y": v}, "size_x": 9.0, "size_y": 9.0},
                }
                for n, (u, v) in PIXELS.items()
            ]
        },
    ),
    "vision_msgs/msg/Detection3DArray": (
        {
            "Detection3DArray": "std_msgs/Header header\nDetection3D[] detections",
            "Detection3D": "std_msgs/Header header\nHypothesisWithPose[] results\nBoundingBox3D bbox",
            "HypothesisWithPose": "Hypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose",
            "Hypothesis": "string class_id\nfloat64 score",
            "BoundingBox3D": "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size",
        },
        {
            "detections": [
                {
                    "results": [{"hypothesis": {"class_id": str(n), "score": 0.9}}],
                    "bbox": {"center": {"position": at(r)}},
                }
                for n, r in RAYS.items()
            ]
        },
    ),
}
"""By the type of the message its definition, with those of its parts, and its fields."""


def store_of(kind: str, encoding: str) -> Any:
    """Return the types of ROS and of a detector."""
    store = get_typestore(Stores.ROS1_NOETIC if encoding == "ros1" else Stores.ROS2_JAZZY)
    package = kind.split("/")[0]
    for name, text in FIELD[kind][0].items():
        found = get_types_from_msg(text, f"{package}/msg/{name}")
        store.fielddefs.pop(f"{package}/msg/{name}", None)
        store.register(found)
    return store


def build(store: Any, kind: str, fields: Mapping[str, Any]) -> Any:
    """Return a message by some of its fields, the others are zero and empty."""
    made = {name: value_of(store, node, fields.get(name)) for name, node in store.fielddefs[kind][1]}
    return store.types[kind](**made)


def value_of(store: Any, node: Any, given: Any) -> Any:
    what, of = node
    if what == Nodetype.NAME:
        return build(store, of, given or {})
    if what == Nodetype.BASE:
        return ("" if of[0] == "string" else np.dtype(of[0]).type(0).item()) if given is None else given
    element, count = of
    entries = list(given or ()) or [None] * (count if what == Nodetype.ARRAY else 0)
    found = [value_of(store, element, entry) for entry in entries]
    return np.array(found, element[1][0]) if element[0] == Nodetype.BASE and element[1][0] != "string" else found


def payload(kind: str, encoding: str) -> tuple[bytes, str]:
    """Return the bytes of the detector's message, and the definition that a bag has."""
    store = store_of(kind, encoding)
    message = build(store, kind, {"header": HEADER, **FIELD[kind][1]})
    data = store.serialize_ros1(message, kind) if encoding == "ros1" else store.serialize_cdr(message, kind)
    return bytes(data), store.generate_msgdef(kind, ros_version=1 if encoding == "ros1" else 2)[0]


def written(folder: Path, kind: str, form: str) -> Path:
    """Write one message: by rosbags as ROS 1, sqlite3 or mcap, or by mcap, where names of types may be short."""
    encoding = "ros1" if "ros1" in form else "cdr"
    data, text = payload(kind, encoding)
    if form.startswith("file"):
        from mcap.writer import Writer

        path = folder / "one.mcap"
        with path.open("wb") as stream:
            writer = Writer(stream)
            writer.start(profile="", library="test")
            schema = writer.register_schema(
                kind.replace("/msg/", "/"), f"{'ros1' if encoding == 'ros1' else 'ros2'}msg", text.encode()
            )
            writer.add_message(writer.register_channel("/tags", encoding, schema), 6 * 10**9, data, 6 * 10**9)
            writer.finish()
        return path
    if form == "ros1":
        from rosbags.rosbag1 import Writer as Writer1

        with Writer1(folder / "one.bag") as bag:
            bag.write(bag.add_connection("/tags", kind, msgdef=text, md5sum="0" * 32), 6 * 10**9, data)
        return folder / "one.bag"
    from rosbags.rosbag2 import StoragePlugin
    from rosbags.rosbag2 import Writer as Writer2

    with Writer2(folder / "bag", version=9, storage_plugin=StoragePlugin[form.upper()]) as bag:
        bag.write(bag.add_connection("/tags", kind, msgdef=text, rihs01="RIHS01_0"), 6 * 10**9, data)
    return folder / "bag"


@pytest.mark.parametrize(
    ("kind", "form"), [*product(FIELD, ["ros1", "file"]), *product([*FIELD][:1], ["sqlite3", "mcap", "file ros1"])]
)
def test_detections_are_read_by_the_definition_of_the_bag(kind: str, form: str, tmp_path: Path) -> None:
    with BagFile(written(tmp_path, kind, form)) as bag:
        assert bag.topics == {"/tags": kind}
        [(_, received, decoded)] = bag.messages(["/tags"])
        message = decoded()
        found = read(Role.DETECTIONS, message, CAMERA)
    assert received == 6 * 10**9 and message.header.stamp.sec == 5 and message.header.frame_id == "camera"
    assert isinstance(found, Detections) and found.markers == (3, 7)
    for marker, ray in zip(found.markers, found.bearings, strict=True):
        assert_allclose(ray, RAYS[marker] / np.linalg.norm(RAYS[marker]), atol=1e-7)


@settings(max_examples=40, deadline=None)
@given(st.sampled_from([*FIELD]), st.sampled_from(["cdr", "ros1"]), st.data())
def test_changed_bytes_and_definitions_give_detections_or_a_line(kind: str, encoding: str, data: st.DataObject) -> None:
    """Of every detector: bytes and characters are replaced, and ends cut off."""
    raw, text = payload(kind, encoding)
    for place, value in data.draw(st.lists(st.tuples(st.integers(4, len(raw) - 1), st.integers(0, 255)), max_size=4)):
        raw = raw[:place] + bytes([value]) + raw[place + 1 :]
    raw = raw[: data.draw(st.sampled_from([len(raw), len(raw) // 2, 5]))]
    for place, value in data.draw(st.lists(st.tuples(st.integers(0, len(text) - 1), st.characters()), max_size=2)):
        text = text[:place] + value + text[place + 1 :]
    try:
        message = decode(BagChannel("/tags", kind, encoding, "ros1msg", text), raw)
        found = read(Role.DETECTIONS, message, CAMERA)
    except CoopenvError as error:
        assert "\n" not in str(error)
    else:
        assert isinstance(found, Detections) and np.isfinite(found.bearings).all()
