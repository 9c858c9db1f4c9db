"""Messages of other detectors and of rectified or rolling-shutter cameras, beside OpenCV-free pinhole geometry."""

from types import SimpleNamespace as Fields
from typing import Any

import numpy as np
import pytest

from coopenv.cars.messages.codec import decode, encode, header, make, stamp_of, warm_up
from coopenv.cars.messages.readings import calibration_of, read
from coopenv.cars.messages.vision import Calibration
from coopenv.cars.settings.profile import Role, VisionSettings, load_profile

CAMERA = Calibration((640, 480), (450.0, 455.0), (322.0, 236.0), (0.0,) * 5)
PIXELS = {7: (100.0, 50.0), 3: (500.5, 400.0)}
RAYS = {n: np.array([(u - 322.0) / 450.0, (v - 236.0) / 455.0, 1.0]) for n, (u, v) in PIXELS.items()}


def xyz(x: float, y: float, z: float = 0.0) -> Fields:
    return Fields(x=x, y=y, z=z)


SQUARE = [(-9.0, -9.0), (9.0, -9.0), (9.0, 9.0), (-9.0, 9.0)]
NO_NUMBER = [{"hypothesis": {"class_id": "chair", "score": 1.0}}]
LIVE: dict[str, dict[str, Any]] = {
    "apriltag_msgs/msg/AprilTagDetectionArray": {
        "detections": [{"id": n, "centre": (u + 0.5, v + 0.5), "corners": SQUARE} for n, (u, v) in PIXELS.items()]
    },
    "vision_msgs/msg/Detection2DArray": {
        "detections": [
            {
                "results": [
                    {"hypothesis": {"class_id": name, "score": score}} for name, score in (("12", 0.2), (str(n), 0.9))
                ],
                "bbox": {"center": {"position": pixel}, "size_x": 20.0, "size_y": 20.0},
            }
            for n, pixel in PIXELS.items()
        ]
        + [{"results": NO_NUMBER}, {"results": []}]
    },
    "aruco_msgs/msg/MarkerArray": {
        "markers": [{"id": n, "pose": {"pose": {"position": 3.0 * ray}}, "confidence": 1.0} for n, ray in RAYS.items()]
    },
}
"""Fields of messages by type; AprilTag's library counts from the corner of the first pixel, not from its middle."""


def assert_rays_of_the_pixels(found: Any) -> None:
    assert found.markers == (3, 7)
    for marker, ray in zip(found.markers, found.bearings, strict=True):
        np.testing.assert_allclose(ray, RAYS[marker] / np.linalg.norm(RAYS[marker]), atol=1e-12)


@pytest.mark.parametrize("kind", LIVE)
def test_messages_of_other_detectors_are_read_live(kind: str) -> None:
    """From the bytes on the network, by the definitions that come with coopenv, as a station reads them."""
    profile = load_profile({"base": "svea", "topics": {"detections": {"name": "fleet/{car}/found", "type": kind}}})
    warm_up(profile)
    message = decode(encode(make(kind, header=header(5 * 10**9), **LIVE[kind])), kind)
    assert_rays_of_the_pixels(read(Role.DETECTIONS, message, CAMERA, vision=profile.vision))
    assert stamp_of(message) == 5 * 10**9


def test_messages_of_ros_1_and_of_the_authors_are_read_in_bags() -> None:
    """Types without a definition in coopenv: hypothesis and centre are not nested, but the marker is."""
    square = {"size_x": 20.0, "size_y": 20.0}
    boxes = [
        Fields(results=[Fields(id=12, score=0.2), Fields(id=n, score=0.9)], bbox=Fields(center=xyz(*pixel), **square))
        for n, pixel in PIXELS.items()
    ]
    poses = {n: Fields(pose=Fields(position=xyz(*(2.0 * ray)))) for n, ray in RAYS.items()}
    arucos = [Fields(marker=Fields(id=n, pose=pose)) for n, pose in poses.items()]
    for kind, fields in (
        ("vision_msgs/msg/Detection2DArray", {"detections": boxes}),
        ("svea_msgs/msg/ArucoArray", {"arucos": arucos}),
    ):
        assert_rays_of_the_pixels(read(Role.DETECTIONS, Fields(__msgtype__=kind, **fields), CAMERA))


def posed(ray: np.ndarray, depth: int) -> Fields:
    """Return a pose within others: of a stamp and a covariance."""
    return Fields(pose=posed(ray, depth - 1)) if depth else Fields(position=xyz(*(2.0 * ray)))


CORNERS = {
    n: [(u + du, v + dv) for du, dv in ((-9.0, -7.2), (6.0, -5.4), (8.0, 6.4), (-10.0, 9.0))]
    for n, (u, v) in PIXELS.items()
}
DETECTIONS: dict[str, dict[str, Any]] = {
    "apriltag_ros/msg/AprilTagDetectionArray": {
        "detections": [
            *(Fields(id=np.array([n]), size=np.array([0.1]), pose=posed(ray, 2)) for n, ray in RAYS.items()),
            Fields(id=np.array([8, 9]), size=np.array([0.1, 0.1]), pose=posed(RAYS[3], 2)),  # a bundle of tags
        ]
    },
    "apriltags_ros/msg/AprilTagDetectionArray": {
        "detections": [Fields(id=n, size=0.1, pose=posed(ray, 1)) for n, ray in RAYS.items()]
    },
    "ar_track_alvar_msgs/msg/AlvarMarkers": {
        "markers": [Fields(id=n, confidence=0, pose=posed(ray, 1)) for n, ray in RAYS.items()]
    },
    "fiducial_msgs/msg/FiducialTransformArray": {
        "transforms": [
            Fields(fiducial_id=n, transform=Fields(translation=xyz(*(2.0 * ray)), rotation=None))
            for n, ray in RAYS.items()
        ]
    },
    "fiducial_msgs/msg/FiducialArray": {
        "fiducials": [
            Fields(fiducial_id=n, **{f"{axis}{k}": c[axis == "y"] for k, c in enumerate(corners) for axis in "xy"})
            for n, corners in CORNERS.items()
        ]
    },
}
"""Fields of messages of ROS 1 by type; the diagonals of the last ones intersect in the pixels."""


@pytest.mark.parametrize("kind", DETECTIONS)
def test_detections_of_ros_1_are_read(kind: str) -> None:
    assert_rays_of_the_pixels(read(Role.DETECTIONS, Fields(__msgtype__=kind, **DETECTIONS[kind]), CAMERA))


def test_corners_outside_the_image_give_no_bearing() -> None:
    outside = {f"{axis}{k}": (650.0 if axis == "x" and k == 1 else 100.0 + 9.0 * k) for k in range(4) for axis in "xy"}
    message = Fields(__msgtype__="fiducial_msgs/msg/FiducialArray", fiducials=[Fields(fiducial_id=3, **outside)])
    assert read(Role.DETECTIONS, message, CAMERA).markers == ()


def test_a_stamp_is_moved_to_the_exposure_of_the_rows_of_the_tags() -> None:
    vision = VisionSettings(exposure=0.01, row_time=2e-5)
    assert vision.late([100.0, 300.0], 480) == 5_000_000 + 4_000_000
    assert vision.late([], 480) == 5_000_000 + 4_800_000
    bearing = [Fields(id=3, bearing_x=0.0, bearing_y=0.0, bearing_z=-1.0)]
    message = Fields(__msgtype__="pixy_camera/msg/ObjectBearingArrayStamped", bearing=bearing)
    bearings: Any = read(Role.BEARINGS, message, CAMERA, vision=vision)
    assert bearings.markers == (3,) and bearings.late == 0  # they are stamped by who has seen the frame


def test_rectified_frames_have_the_projection_of_camera_info() -> None:
    info = Fields(
        width=640,
        height=480,
        distortion_model="plumb_bob",
        k=np.array([450.0, 0, 322, 0, 455, 236, 0, 0, 1]),
        d=np.array([-0.3, 0.1, 0, 0, 0]),
        p=np.array([400.0, 0, 310, 0, 0, 410, 230, 0, 0, 0, 1, 0]),
    )
    assert calibration_of(info) == Calibration((640, 480), (450.0, 455.0), (322.0, 236.0), (-0.3, 0.1, 0.0, 0.0, 0.0))
    assert calibration_of(info, rectified=True) == Calibration((640, 480), (400.0, 410.0), (310.0, 230.0), (0.0,) * 5)


@pytest.mark.parametrize(
    ("fields", "size", "focal", "centre"),
    [
        ({}, (640, 480), (450.0, 455.0), (322.0, 236.0)),
        ({"binning_x": 1, "binning_y": 1}, (640, 480), (450.0, 455.0), (322.0, 236.0)),
        ({"binning_x": 2, "binning_y": 4}, (320, 120), (225.0, 113.75), (161.0, 59.0)),
        (
            {"roi": {"x_offset": 100, "y_offset": 50, "width": 320, "height": 200}},
            (320, 200),
            (450.0, 455.0),
            (222.0, 186.0),
        ),
        (
            {"binning_x": 2, "binning_y": 2, "roi": {"x_offset": 100, "y_offset": 50, "width": 320, "height": 200}},
            (160, 100),
            (225.0, 227.5),
            (111.0, 93.0),
        ),
    ],
)
def test_a_calibration_of_the_whole_sensor_becomes_that_of_its_images(
    fields: dict[str, Any], size: tuple[int, int], focal: tuple[float, float], centre: tuple[float, float]
) -> None:
    k = [450.0, 0.0, 322.0, 0.0, 455.0, 236.0, 0.0, 0.0, 1.0]
    info = make("sensor_msgs/msg/CameraInfo", width=640, height=480, k=k, d=[0.0] * 5, **fields)
    assert calibration_of(info) == Calibration(size, focal, centre, (0.0,) * 5)


POOR: dict[str, list[dict[str, Any]]] = {
    "apriltag_msgs/msg/AprilTagDetectionArray": [
        {"id": 3, "centre": (100.0, 50.0), "corners": SQUARE, "hamming": bits, "decision_margin": margin}
        for bits, margin in ((2, 80.0), (0, 5.0))
    ],
    "vision_msgs/msg/Detection2DArray": [
        {"results": [{"hypothesis": {"class_id": "3", "score": 0.1}}], "bbox": {"center": {"position": PIXELS[3]}}}
    ],
}


@pytest.mark.parametrize("kind", POOR)
def test_detections_of_low_quality_are_left_out_and_counted(kind: str) -> None:
    message = make(kind, detections=[*LIVE[kind]["detections"][:1], *POOR[kind]])
    found = read(Role.DETECTIONS, message, CAMERA)
    assert found.markers == (7,) and found.poor == len(POOR[kind])  # type: ignore[union-attr]
    loose = VisionSettings(most_hamming=10, least_margin=0.0, least_score=0.0)
    assert read(Role.DETECTIONS, message, CAMERA, vision=loose).markers == (3, 7)  # type: ignore[union-attr]
