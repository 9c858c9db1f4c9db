"""Detections of a camera as tags: blocks, bearings, frames, and the messages of other detectors."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from coopenv.base.errors import CoopenvError, shown
from coopenv.cars.messages.vision import (
    Calibration,
    Quality,
    Tag,
    centred_tags,
    diagonals_crossing,
    find_blobs,
    find_tags,
    frame_of,
    opencv,
    ray_of,
    rays,
)
from coopenv.cars.settings.profile import IMAGES, VisionSettings
from coopenv.estimation.poses import Array

UNIT = 1e-3
"""Tolerance of the length of a bearing; single precision and rounded decimals are within it."""

Find = Callable[[Any, VisionSettings, Any], list[Tag]]
"""Returns the tags of a message by the Calibration of its camera (None: bearings without distortion).

Raises CoopenvError: it is malformed, or no extra."""


def _blocks(message: Any, _settings: VisionSettings, camera: Calibration) -> list[Tag]:
    """Return the detections of an ObjectInfoArrayStamped; without an area, or outside the image, they have no ray."""
    found, (width, height) = [], camera.image_size
    for block in message.objects:
        u, v, area = int(block.center_x), int(block.center_y), int(block.width) * int(block.height)
        valid = 0 <= u < width and 0 <= v < height and block.width >= 0 and block.height >= 0
        found.append(Tag(int(block.signature), area, ray_of(camera, u, v) if valid else None, v if valid else None))
    return found


def _bearings(message: Any, _settings: VisionSettings, camera: Calibration | None) -> list[Tag]:
    """Return the detections of an ObjectBearingArrayStamped; its vectors point from the target to the camera.

    The authors' node keeps the order of its camera, largest block first. With a camera, distortion was not removed from
    the pixels of the vectors: then they give back the pixels. Those without length 1 have no ray.
    """
    table = np.array([(b.id, b.bearing_x, b.bearing_y, b.bearing_z) for b in message.bearing]).reshape(-1, 4)
    with np.errstate(all="ignore"):
        units = -table[:, 1:]
        lengths = np.linalg.norm(units, axis=-1)
        there = np.abs(lengths - 1.0) <= UNIT
        units /= lengths[:, None]
        if camera is not None:
            there &= units[:, 2] > 1e-6
            flat = np.where(there[:, None], units[:, :2] / units[:, 2:], 0.0)
            pixels = flat * camera.focal_length + np.asarray(camera.principal_point)
            units, imaged = rays(np.round(pixels, 3), camera)  # of single precision
            there &= imaged
    return [Tag(int(n), 0.0, ray if ok else None) for n, ray, ok in zip(table[:, 0], units, there, strict=True)]


def _frame(message: Any, settings: VisionSettings, camera: Calibration) -> list[Tag]:
    """Return the tags, or the blobs of colour, in an Image or CompressedImage."""
    try:
        frame = frame_of(message, "BGR" if settings.colours else "GRAY")
        if frame.shape[1::-1] != camera.image_size:
            width, height = camera.image_size
            raise CoopenvError(f"{frame.shape[1]} x {frame.shape[0]} pixels, the camera model has {width} x {height}")
        if settings.colours:
            return find_blobs(frame, settings.colours, camera)
        return find_tags(frame, settings.family, camera)
    except opencv().error as error:  # such as an odd width of a format that has a colour for two pixels
        kind = f"{message.width} x {message.height} {message.encoding}" if hasattr(message, "encoding") else "a frame"
        raise CoopenvError(f"data: OpenCV does not read {kind}: {shown(error.err)}") from None


def _apriltags(message: Any, _settings: VisionSettings, camera: Calibration) -> list[Tag]:
    """Return the detections of an AprilTagDetectionArray; its centres are the projection's.

    AprilTag's library counts pixels from the corner of the first one, CameraInfo from its middle.
    """
    found = [
        (d.id, np.ptp([p.x for p in d.corners]) * np.ptp([p.y for p in d.corners]), d.centre.x - 0.5, d.centre.y - 0.5)
        for d in message.detections
    ]
    stated = [Quality(float(d.decision_margin), hamming=float(d.hamming)) for d in message.detections]
    return centred_tags(found, camera, stated)


def _boxes(message: Any, _settings: VisionSettings, camera: Calibration) -> list[Tag]:
    """Return the detections of a Detection2DArray or Detection3DArray: the class of the best hypothesis is the number.

    A box has its centre in pixels, or its position in the camera's optical frame.
    """
    found, stated, placed = [], list[Quality](), list[Tag]()
    for detection in message.detections:
        guesses: list[Any] = [getattr(result, "hypothesis", result) for result in detection.results]
        named: Any = max(guesses, key=lambda guess: guess.score) if guesses else None
        label = str(getattr(named, "class_id", getattr(named, "id", "")))
        if label.isdecimal():
            box, quality = detection.bbox, Quality(score=float(named.score))
            place = getattr(box.center, "position", box.center)
            if hasattr(box, "size"):  # of three dimensions
                placed.append(_tag_at(int(label), place, quality))
            else:
                found.append((int(label), box.size_x * box.size_y, place.x, place.y))
                stated.append(quality)
    return centred_tags(found, camera, stated) + placed


LISTS = ("arucos", "markers", "transforms", "detections")
"""Names of what a detector of poses has found, by the type of its message."""
NUMBERS = ("fiducial_id", "marker_id", "id")
"""Names of the number of a marker."""


def _poses(message: Any, _settings: VisionSettings, _: Calibration) -> list[Tag]:
    """Return the markers of a message that has their positions in the camera's optical frame; bundles have no number.

    Read are the authors' ArucoArray, aruco_msgs, aruco_opencv_msgs, apriltag_ros, fiducial_msgs, ar_track_alvar_msgs,
    Isaac ROS, and ros2_aruco, whose numbers stand in a list beside the poses.
    """
    if hasattr(message, "marker_ids"):
        pairs = zip(message.marker_ids, message.poses, strict=True)
        return [_tag_at(int(number), pose.position, Quality()) for number, pose in pairs]
    found = []
    entries: Any = next(getattr(message, name) for name in LISTS if hasattr(message, name))
    for entry in entries:
        marker = getattr(entry, "marker", entry)
        numbers = np.atleast_1d(next((getattr(marker, name) for name in NUMBERS if hasattr(marker, name)), ()))
        if len(numbers) == 1:
            score = float(getattr(marker, "confidence", 0.0)) or math.nan  # most detectors leave it at 0
            found.append(_tag_at(int(numbers[0]), _place_of(marker), Quality(score=score)))
    return found


def _tag_at(number: int, place: Any, quality: Quality) -> Tag:
    """Return the tag at a position in the camera's optical frame, m; nearer ones are preferred."""
    position = np.array([place.x, place.y, place.z], dtype=np.float64)
    far = float(np.linalg.norm(position))
    return Tag(number, -far, position / far if 0.0 < far < np.inf else None, quality=quality)


def _place_of(marker: Any) -> Any:
    """Return the position of a marker: that of a transform, or of a pose with a stamp, a covariance or not."""
    while hasattr(marker, "pose"):
        marker = marker.pose
    return marker.position if hasattr(marker, "position") else marker.transform.translation


def _corners(message: Any, _settings: VisionSettings, camera: Calibration) -> list[Tag]:
    """Return the markers of a FiducialArray, which has the pixels of corners: the ray is where diagonals intersect."""
    pixels = np.array(
        [[(getattr(f, f"x{n}"), getattr(f, f"y{n}")) for n in range(4)] for f in message.fiducials], np.float64
    ).reshape(-1, 4, 2)
    with np.errstate(all="ignore"):  # values that are not finite give no ray
        corners, there = rays(pixels.reshape(-1, 2), camera)
        corners = corners.reshape(-1, 4, 3)
        centre: Array = diagonals_crossing(corners, corners.sum(axis=1))
    whole = np.asarray(there.reshape(-1, 4).all(axis=-1) & np.isfinite(centre).all(axis=-1))
    areas = np.ptp(pixels, axis=1).prod(axis=-1)
    rows = zip(message.fiducials, areas, centre, pixels[..., 1].mean(axis=-1), whole, strict=True)
    return [Tag(int(f.fiducial_id), area, ray if ok else None, row if ok else None) for f, area, ray, row, ok in rows]


BEARINGS = "pixy_camera/msg/ObjectBearingArrayStamped"
PLACED = (
    "aruco_msgs/msg/MarkerArray",
    "aruco_opencv_msgs/msg/ArucoDetection",
    "ros2_aruco_interfaces/msg/ArucoMarkers",
    "apriltag_ros/msg/AprilTagDetectionArray",
    "apriltags_ros/msg/AprilTagDetectionArray",
    "apriltags2_ros/msg/AprilTagDetectionArray",
    "isaac_ros_apriltag_interfaces/msg/AprilTagDetectionArray",
    "ar_track_alvar_msgs/msg/AlvarMarkers",
    "fiducial_msgs/msg/FiducialTransformArray",
    "svea_thesis/msg/ArucoArray",
    "svea_msgs/msg/ArucoArray",
)
"""Types whose tags have positions in the camera's optical frame, so that no calibration is needed."""
FINDERS: dict[str, Find] = {
    "pixy_camera/msg/ObjectInfoArrayStamped": _blocks,
    BEARINGS: _bearings,
    **dict.fromkeys(IMAGES, _frame),
    "apriltag_msgs/msg/AprilTagDetectionArray": _apriltags,
    "vision_msgs/msg/Detection2DArray": _boxes,
    "vision_msgs/msg/Detection3DArray": _boxes,
    "fiducial_msgs/msg/FiducialArray": _corners,
    **dict.fromkeys(PLACED, _poses),
}
"""Decoders by the type of the message."""
