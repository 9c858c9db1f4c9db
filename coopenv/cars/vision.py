"""Square tags, AprilTag and ArUco, in frames of a camera, and tags by other detectors."""

import os
from collections.abc import Callable
from functools import cache
from typing import Annotated, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, Field
from scipy.ndimage import map_coordinates

from coopenv.base.errors import CoopenvError, check_one_of, listed, shown
from coopenv.base.installation import install_command, needing
from coopenv.base.sections import Section
from coopenv.estimation.poses import Array

FAMILIES = (
    *("tag16h5", "tag25h9", "tag36h10", "tag36h11"),
    *(f"DICT_{n}X{n}_{count}" for n in (4, 5, 6, 7) for count in (50, 100, 250, 1000)),
    *("DICT_ARUCO_ORIGINAL", "DICT_ARUCO_MIP_36h12"),
)
"""AprilTag's as they are called there, ArUco's as in OpenCV."""


def _family(name: str) -> str:
    try:
        check_one_of("unknown family", name, FAMILIES)
    except CoopenvError as error:
        raise ValueError(str(error)) from None
    return name


class VisionSettings(Section):
    """Frames of a camera, and tags that were detected in them."""

    family: Annotated[str, AfterValidator(_family)] = "tag36h11"
    """Family of the tags: `tag16h5` to `tag36h11` of AprilTag, `DICT_4X4_50` to `DICT_7X7_1000` of ArUco."""
    exposure: float = Field(default=0.0, ge=0.0, le=1.0)
    """Time of exposure, s: half of it is added to the stamps, which are those of its begin."""
    row_time: float = Field(default=0.0, ge=0.0, le=1e-3)
    """Time from a row to the next of a rolling shutter, s: that of the tags is added to the stamps, which are those of
    the first row."""
    rectified: bool = False
    """Whether pixels are those of rectified frames (`image_rect`): the matrix P of CameraInfo counts, no distortion."""

    def late(self, rows: list[float], height: int) -> int:
        """Return the time, ns, from a stamp to the middle of the exposure of rows; none: of the middle row."""
        row = sum(rows) / len(rows) if rows else 0.5 * height
        return round(1e9 * (0.5 * self.exposure + self.row_time * row))


class Lens(NamedTuple):
    """What a frame needs of a camera."""

    image_size: tuple[int, int]
    rays: Callable[[Array], tuple[Array, NDArray[np.bool_]]]
    """Of pixels (m, 2): unit vectors (m, 3) in the optical frame, and which are rays."""


class Tag(NamedTuple):
    """A tag in a frame."""

    number: int
    size: float  # larger ones of the same number are preferred
    ray: Array | None  # (3,) unit vector camera -> its centre, optical frame; None: it has none
    row: float | None = None  # of the image


Find = Callable[[Any, VisionSettings, Lens], list[Tag]]
"""Returns the tags of a message. Raises CoopenvError: it is malformed, or no extra."""


def _frame(message: Any, settings: VisionSettings, lens: Lens) -> list[Tag]:
    """Return the tags in an Image or CompressedImage."""
    gray = gray_of(message)
    if gray.shape[::-1] != lens.image_size:
        width, height = lens.image_size
        raise CoopenvError(f"{gray.shape[1]} x {gray.shape[0]} pixels, the camera model has {width} x {height}")
    return find_tags(gray, settings.family, lens)


def _apriltags(message: Any, _settings: VisionSettings, lens: Lens) -> list[Tag]:
    """Return those of an AprilTagDetectionArray; its centres are those of the projection."""
    found = [
        (d.id, np.ptp([p.x for p in d.corners]) * np.ptp([p.y for p in d.corners]), d.centre.x, d.centre.y)
        for d in message.detections
    ]
    return _centred(found, lens)


def _boxes(message: Any, _settings: VisionSettings, lens: Lens) -> list[Tag]:
    """Return those of a Detection2DArray: the class of the best hypothesis is the number."""
    found = []
    for detection in message.detections:
        guesses: list[Any] = [getattr(result, "hypothesis", result) for result in detection.results]
        named: Any = max(guesses, key=lambda guess: guess.score) if guesses else None
        label = str(getattr(named, "class_id", getattr(named, "id", "")))
        if label.isdecimal():
            box = detection.bbox
            place = getattr(box.center, "position", box.center)
            found.append((int(label), box.size_x * box.size_y, place.x, place.y))
    return _centred(found, lens)


def _centred(found: list[tuple[int, float, float, float]], lens: Lens) -> list[Tag]:
    """Return tags of number, size, and centre in pixels."""
    table = np.array(found, dtype=np.float64).reshape(-1, 4)
    with np.errstate(all="ignore"):  # what is not finite is no ray
        units, there = lens.rays(table[:, 2:])
    rows = zip(found, units, there, strict=True)
    return [Tag(int(n), size, ray if known else None, v if known else None) for (n, size, _, v), ray, known in rows]


def _markers(message: Any, _settings: VisionSettings, _lens: Lens) -> list[Tag]:
    """Return those of the authors' ArucoArray, or of a MarkerArray: positions in the camera's optical frame."""
    found = []
    entries: Any = message.arucos if hasattr(message, "arucos") else message.markers
    for entry in entries:
        marker = getattr(entry, "marker", entry)
        position = marker.pose.pose.position
        place = np.array([position.x, position.y, position.z], dtype=np.float64)
        far = float(np.linalg.norm(place))
        found.append(Tag(int(marker.id), -far, place / far if 0.0 < far < np.inf else None))
    return found


IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
FINDERS: dict[str, Find] = {
    **dict.fromkeys(IMAGES, _frame),
    "apriltag_msgs/msg/AprilTagDetectionArray": _apriltags,
    "vision_msgs/msg/Detection2DArray": _boxes,
    "aruco_msgs/msg/MarkerArray": _markers,
    "svea_thesis/msg/ArucoArray": _markers,
    "svea_msgs/msg/ArucoArray": _markers,
}
"""By the type of the message."""


@cache
def opencv() -> Any:
    """Return OpenCV, one thread of it. Raises CoopenvError: the extra is not installed."""
    os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(2**25))  # before a file fills the memory
    with needing(f"tags in images need an extra: {install_command('vision')}"):
        import cv2
    cv2.setNumThreads(1)
    return cv2


ENCODINGS = {
    **dict.fromkeys(("mono8", "8UC1"), (1, "u1", "")),
    **dict.fromkeys(("mono16", "16UC1"), (1, "u2", "")),
    **dict.fromkeys(("bgr8", "8UC3"), (3, "u1", "BGR2GRAY")),
    **dict.fromkeys(("bgra8", "8UC4"), (4, "u1", "BGRA2GRAY")),
    "rgb8": (3, "u1", "RGB2GRAY"),
    "rgba8": (4, "u1", "RGBA2GRAY"),
    **dict.fromkeys(("yuv422", "uyvy"), (2, "u1", "YUV2GRAY_UYVY")),
    **dict.fromkeys(("yuv422_yuy2", "yuyv"), (2, "u1", "YUV2GRAY_YUY2")),
    "bayer_rggb8": (1, "u1", "BayerBG2GRAY"),
    "bayer_bggr8": (1, "u1", "BayerRG2GRAY"),
    "bayer_gbrg8": (1, "u1", "BayerGR2GRAY"),
    "bayer_grbg8": (1, "u1", "BayerGB2GRAY"),
}
"""Numbers per pixel, their type, and OpenCV's conversion."""


def gray_of(message: Any) -> NDArray[np.uint8]:
    """Return the frame (height, width) of an Image or CompressedImage in shades of grey."""
    cv2, data = opencv(), np.ascontiguousarray(message.data, dtype=np.uint8)
    if not hasattr(message, "encoding"):
        try:
            found = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION) if len(data) else None
        except cv2.error:  # beyond its limits
            found = None
        if found is None:
            raise CoopenvError(f"data: no image that OpenCV reads, its format is {shown(message.format)}")
        return np.asarray(found)
    if message.encoding not in ENCODINGS:
        raise CoopenvError(f"encoding: {shown(message.encoding)} is none of {listed(list(ENCODINGS))}")
    channels, kind, conversion = ENCODINGS[message.encoding]
    width, height, step = int(message.width), int(message.height), int(message.step)
    dtype = np.dtype(kind).newbyteorder(">" if message.is_bigendian else "<")
    used = width * channels * dtype.itemsize
    if not (0 < used <= step and height > 0 and len(data) >= height * step):
        raise CoopenvError(f"data: {len(data)} bytes are no {width} x {height} pixels with a step of {step}")
    frame = np.ascontiguousarray(data[: height * step].reshape(height, step)[:, :used]).view(dtype)
    if dtype.itemsize == 2:
        return np.asarray(cv2.normalize(frame.astype(np.float32), None, 0, 255, cv2.NORM_MINMAX, cv2.CV_8U))
    frame = frame if channels == 1 else frame.reshape(height, width, channels)
    return np.asarray(cv2.cvtColor(frame, getattr(cv2, f"COLOR_{conversion}"))) if conversion else frame


@cache
def dictionary_of(family: str) -> Any:
    """Return the tags of a family as OpenCV has them."""
    aruco = opencv().aruco
    return aruco.getPredefinedDictionary(getattr(aruco, family.replace("tag", "DICT_APRILTAG_")))


@cache
def _detector(family: str) -> tuple[Any, int]:
    """Return OpenCV's detector of a family, and the cells along a side of its tags, black border included."""
    aruco, dictionary = opencv().aruco, dictionary_of(family)
    chosen = aruco.DetectorParameters()  # faster than the usual thresholds in cluttered frames, and no tag fewer
    chosen.adaptiveThreshWinSizeMin, chosen.adaptiveThreshWinSizeMax, chosen.adaptiveThreshWinSizeStep = 5, 25, 20
    chosen.perspectiveRemovePixelPerCell = 8
    return aruco.ArucoDetector(dictionary, chosen), int(dictionary.markerSize) + 2


def find_tags(gray: NDArray[np.uint8], family: str, lens: Lens) -> list[Tag]:
    """Return the tags of a family in a frame.

    OpenCV finds and reads them. The places of their edges are then measured along normals of the sides, and each side
    is a plane through the rays of its edge, which is straight behind any lens. The ray of the centre is where the
    diagonals intersect: the mean of the corners is none for a tag that is seen obliquely.
    """
    detector, cells = _detector(family)
    quads, numbers, _ = detector.detectMarkers(gray)
    if numbers is None or not len(numbers):
        return []
    corners = np.array(quads, dtype=np.float64).reshape(-1, 4, 2)
    edges, weights = _edges(gray, corners, cells)
    units, there = lens.rays(edges.reshape(-1, 2))
    units, weights = units.reshape((*edges.shape[:-1], 3)), weights * there.reshape(weights.shape)
    moments = np.einsum("msk,mski,mskj->msij", weights, units, units)
    planes = np.linalg.eigh(moments)[1][..., 0]  # (m, 4, 3) normals
    turned = np.cross(np.roll(planes, 1, axis=1), planes)  # (m, 4, 3) corners
    centre = np.cross(np.cross(turned[:, 0], turned[:, 2]), np.cross(turned[:, 1], turned[:, 3]))
    ahead = np.einsum("msk,mski->mi", weights, units)
    with np.errstate(all="ignore"):
        centre /= np.linalg.norm(centre, axis=-1, keepdims=True) * np.sign((centre * ahead).sum(axis=-1))[:, None]
    areas = [opencv().contourArea(quad) for quad in corners.astype(np.float32)]
    full = (np.count_nonzero(weights, axis=-1) >= LEAST).all(axis=-1) & np.isfinite(centre).all(axis=-1)
    rows = zip(numbers.ravel().tolist(), areas, centre, corners[..., 1].mean(axis=-1).tolist(), full, strict=True)
    return [Tag(number, area, ray if whole else None, row) for number, area, ray, row, whole in rows]


ALONG = np.linspace(0.12, 0.88, 16)
"""Where a side is measured, as shares of its length: nearer to the corners its neighbours disturb."""

SMOOTH = (np.vander(ALONG, 3) @ np.linalg.pinv(np.vander(ALONG, 3))).T
"""Replaces values along a side by those of the parabola through them: behind a lens a side is bent."""

STEPS = np.linspace(-1.0, 1.0, 13)
"""Across a side, in shares of the reach."""

LEAST = 6  # measured points of a side


def _edges(gray: NDArray[np.uint8], corners: Array, cells: int) -> tuple[Array, Array]:
    """Return points (m, 4, k, 2) on the sides of quadrilaterals (m, 4, 2) in pixels, and their weights (m, 4, k).

    Black is inside. Across a side, the place of its edge is the mean of the places weighted by how much it gets
    brighter there; the second time the search is around the parabola through the first.
    """
    sides = np.roll(corners, -1, axis=1) - corners
    lengths = np.maximum(np.linalg.norm(sides, axis=-1), 1e-6)
    normals = np.stack([sides[..., 1], -sides[..., 0]], axis=-1) / lengths[..., None]  # outwards: corners go clockwise
    points = corners[:, :, None] + ALONG[:, None] * sides[:, :, None]
    reach = np.maximum(1.6, 0.4 * lengths.min(axis=-1) / cells)[:, None, None, None] * STEPS  # less than the border
    offset = np.zeros(points.shape[:-1])
    for _ in range(2):
        across = offset[..., None] + reach
        places = points[..., None, :] + across[..., None] * normals[:, :, None, None]
        shade = map_coordinates(gray, (places[..., 1], places[..., 0]), np.float64, order=1, mode="nearest")
        rise = np.maximum(np.diff(shade, axis=-1), 0.0)
        weights = rise.sum(axis=-1)
        middle = 0.5 * (across[..., 1:] + across[..., :-1])
        measured = (rise * middle).sum(axis=-1) / np.maximum(weights, 1e-9)
        offset = measured @ SMOOTH
    return points + measured[..., None] * normals[:, :, None], weights
