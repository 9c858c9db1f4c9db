"""Tags (AprilTag, ArUco) or colours in the frames of a camera, and their rays through its lens."""

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import Any, Literal, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from coopenv.base.errors import CoopenvError, listed, shown
from coopenv.base.files import muted_errors
from coopenv.base.installation import install_command, needing
from coopenv.cars.settings.profile import VisionSettings
from coopenv.estimation.lens import distort, undistort
from coopenv.estimation.poses import Array


@dataclass(frozen=True, slots=True)
class Calibration:
    """Intrinsics of a camera; the number of coefficients is that of a model of `coopenv.estimation.lens`."""

    image_size: tuple[int, int]
    focal_length: tuple[float, float]
    principal_point: tuple[float, float]
    distortion: tuple[float, ...]

    @classmethod
    def of(cls, camera: Any) -> Self:
        """Return the intrinsics of a camera of the scenario."""
        return cls(camera.image_size, camera.focal_length, camera.principal_point, camera.distortion)

    def pixels(self, points: Array) -> Array:
        """Return the pixels (m, 2) of points (m, 3) ahead, in the optical frame."""
        flat = distort(points[:, :2] / points[:, 2:], self.distortion)
        return np.asarray(flat * self.focal_length + np.asarray(self.principal_point))

    @property
    def info(self) -> dict[str, Any]:
        """Fields of its CameraInfo, but for the header."""
        (width, height), (fx, fy), (cx, cy) = self.image_size, self.focal_length, self.principal_point
        matrices = {"k": (fx, 0, cx, 0, fy, cy, 0, 0, 1), "r": np.eye(3), "p": (fx, 0, cx, 0, 0, fy, cy, 0, 0, 0, 1, 0)}
        return {"width": width, "height": height, "distortion_model": "plumb_bob", "d": self.distortion, **matrices}


def rays(pixels: Array, calibration: Calibration) -> tuple[Array, NDArray[np.bool_]]:
    """Return the rays of pixels.

    Args:
        pixels: (m, 2) to the right and down from the image's corner.
        calibration: of the camera.

    Returns:
        (m, 3) unit vectors in the optical frame, and (m,) which are rays: of pixels in the image that the lens gives.
    """
    size, focal, centre = (
        np.asarray(v, dtype=np.float64)
        for v in (calibration.image_size, calibration.focal_length, calibration.principal_point)
    )
    inside = ((pixels >= 0.0) & (pixels < size)).all(axis=-1)
    flat, there = undistort((pixels - centre) / focal, calibration.distortion)
    through = np.concatenate([flat, np.ones((len(flat), 1))], axis=-1)
    return through / np.linalg.norm(through, axis=-1, keepdims=True), inside & there


TILE = 32  # pixels of the side of a square whose rays are computed together, which costs as much as one ray


@lru_cache(maxsize=2**12)
def _tile(calibration: Calibration, column: int, row: int) -> tuple[list[list[float]], list[bool]]:
    v, u = np.indices((TILE, TILE)).reshape(2, -1)
    units, there = rays(np.column_stack([u + TILE * column, v + TILE * row]).astype(np.float64), calibration)
    return units.tolist(), there.tolist()


def ray_of(calibration: Calibration, u: int, v: int) -> list[float] | None:
    """Return the ray of a whole pixel, as `rays` does; None: it has none."""
    (column, u), (row, v) = divmod(u, TILE), divmod(v, TILE)
    units, there = _tile(calibration, column, row)
    return units[TILE * v + u] if there[TILE * v + u] else None


class Quality(NamedTuple):
    """Quality of a detection as its detector states it, untested; NaN: not stated."""

    margin: float = math.nan  # decision margin of AprilTag: contrast of black and white
    score: float = math.nan  # 0 to 1
    hamming: float = math.nan  # bits of the code that were corrected

    def is_poor(self, least: VisionSettings) -> bool:
        """Return whether a stated quality is too low; a margin or score of 0 is not stated."""
        low = 0.0 < self.margin < least.least_margin or 0.0 < self.score < least.least_score
        return low or self.hamming > least.most_hamming


class Tag(NamedTuple):
    """A tag in a frame."""

    number: int
    size: float  # larger ones of the same number are preferred
    ray: Sequence[float] | Array | None  # (3,) unit vector camera -> its centre, optical frame; None: it has none
    row: float | None = None  # of the image
    quality: Quality = Quality()


def centred_tags(
    found: list[tuple[int, float, float, float]], camera: Calibration, stated: Sequence[Quality] | None = None
) -> list[Tag]:
    """Return tags of number, size, and centre in pixels; `stated` is the quality of each."""
    table = np.array(found, dtype=np.float64).reshape(-1, 4)
    with np.errstate(all="ignore"):  # values that are not finite give no ray
        units, there = rays(table[:, 2:], camera)
    rows = zip(found, units, there, stated or [Quality()] * len(found), strict=True)
    return [Tag(int(n), size, ray if ok else None, v if ok else None, q) for (n, size, _, v), ray, ok, q in rows]


def diagonals_crossing(corners: Array, ahead: Array) -> Array:
    """Return the rays (m, 3) where the diagonals of quadrilaterals intersect.

    Args:
        corners: (m, 4, 3) rays of the corners, of any length and sign, in their order.
        ahead: (m, 3) a vector on the side of the target.
    """
    first, second = (np.cross(corners[:, n], corners[:, n + 2]) for n in range(2))
    centre = np.cross(first, second)
    centre /= np.linalg.norm(centre, axis=-1, keepdims=True) * np.sign((centre * ahead).sum(axis=-1))[:, None]
    return np.asarray(centre)


@cache
def opencv() -> Any:
    """Return OpenCV, one thread of it. Raises CoopenvError: the extra is not installed."""
    os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(2**25))  # before a file fills the memory
    with needing(f"tags in images need an extra: {install_command('vision')}"):
        import cv2
    cv2.setNumThreads(1)
    return cv2


FORMATS = {"JPEG": b"\xff\xd8\xff", "PNG": b"\x89PNG\r\n\x1a\n"}
"""First bytes of the compressed images that are decoded, as ROS has no others."""

ENCODINGS = {
    **dict.fromkeys(("mono8", "8UC1"), (1, "u1", "GRAY2{}")),
    **dict.fromkeys(("mono16", "16UC1"), (1, "u2", "GRAY2{}")),
    **dict.fromkeys(("bgr8", "8UC3"), (3, "u1", "BGR2{}")),
    **dict.fromkeys(("bgra8", "8UC4"), (4, "u1", "BGRA2{}")),
    "rgb8": (3, "u1", "RGB2{}"),
    "rgba8": (4, "u1", "RGBA2{}"),
    **dict.fromkeys(("yuv422", "uyvy"), (2, "u1", "YUV2{}_UYVY")),
    **dict.fromkeys(("yuv422_yuy2", "yuyv"), (2, "u1", "YUV2{}_YUY2")),
    "bayer_rggb8": (1, "u1", "BayerBG2{}"),
    "bayer_bggr8": (1, "u1", "BayerRG2{}"),
    "bayer_gbrg8": (1, "u1", "BayerGR2{}"),
    "bayer_grbg8": (1, "u1", "BayerGB2{}"),
}
"""Numbers per pixel, their type, and OpenCV's conversion."""


def frame_of(message: Any, wanted: Literal["GRAY", "BGR"] = "GRAY") -> NDArray[np.uint8]:
    """Return the frame of an Image or CompressedImage: (height, width) shades of grey, or with three colours each."""
    cv2, data = opencv(), np.ascontiguousarray(message.data, dtype=np.uint8)
    if not hasattr(message, "encoding"):
        try:
            mode = cv2.IMREAD_GRAYSCALE if wanted == "GRAY" else cv2.IMREAD_COLOR
            known = bytes(data[:8]).startswith((*FORMATS.values(),))
            with muted_errors():  # of damaged frames the decoders print lines
                found = cv2.imdecode(data, mode | cv2.IMREAD_IGNORE_ORIENTATION) if known else None
        except cv2.error:  # beyond its limits
            found = None
        if found is None:
            raise CoopenvError(
                f"data: no {' or '.join(FORMATS)} image that OpenCV reads, its format is {shown(message.format)}"
            )
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
        frame = np.asarray(cv2.normalize(frame.astype(np.float32), None, 0, 255, cv2.NORM_MINMAX, cv2.CV_8U))
    frame = frame if channels == 1 else frame.reshape(height, width, channels)
    code = getattr(cv2, f"COLOR_{conversion.format(wanted)}", None)  # None: it is as wanted
    return frame if code is None else np.asarray(cv2.cvtColor(frame, code))


SATURATED, BRIGHT, FEWEST = 100, 60, 12
"""Least saturation and brightness (of 255) and number of the pixels of a blob."""


def find_blobs(frame: NDArray[np.uint8], colours: Mapping[int, tuple[float, float]], camera: Calibration) -> list[Tag]:
    """Return the blobs of colours, hues in deg by number, in a frame of blue, green and red.

    The ray is that of the mean of a blob's pixels.
    """
    cv2, found = opencv(), list[tuple[int, float, float, float]]()
    hue, saturation, value = cv2.split(cv2.cvtColor(cv2.GaussianBlur(frame, (0, 0), 1.0), cv2.COLOR_BGR2HSV_FULL))
    vivid = (saturation >= SATURATED) & (value >= BRIGHT)
    for number, (first, last) in colours.items():
        meant = (np.arange(256) * 360.0 / 256.0 - first) % 360.0 <= (last - first) % 360.0
        mask = (meant[hue] & vivid).astype(np.uint8)
        _, _, boxes, means = cv2.connectedComponentsWithStats(mask)
        rows = zip(boxes[1:, cv2.CC_STAT_AREA], means[1:], strict=True)  # the first one is the background
        found += [(number, area, x, y) for area, (x, y) in rows if area >= FEWEST]
    return centred_tags(found, camera)


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


CONTRAST = 0.3
"""Threshold of edges, share of the standard deviation of a frame's shades: finds tags in dark frames, and makes fewer
contours of the texture of bright ones."""


def find_tags(gray: NDArray[np.uint8], family: str, camera: Calibration) -> list[Tag]:
    """Return the tags of a family in a frame.

    OpenCV finds and reads them. The places of their edges are then measured along normals of the sides, and each side
    is a plane through the rays of its edge, which is straight behind any lens. The ray of the centre is where the
    diagonals intersect: the mean of the corners is none for a tag that is seen obliquely.
    """
    detector, cells = _detector(family)
    chosen, spread = detector.getDetectorParameters(), float(opencv().meanStdDev(gray)[1][0, 0])
    chosen.adaptiveThreshConstant = float(np.clip(CONTRAST * spread, 2.0, 12.0))
    detector.setDetectorParameters(chosen)
    quads, numbers, _ = detector.detectMarkers(gray)
    if numbers is None or not len(numbers):
        return []
    corners = np.array(quads, dtype=np.float64).reshape(-1, 4, 2)
    edges, weights = _edges(gray, corners, cells)
    units, there = rays(edges.reshape(-1, 2), camera)
    units, weights = units.reshape((*edges.shape[:-1], 3)), weights * there.reshape(weights.shape)
    moments = np.einsum("msk,mski,mskj->msij", weights, units, units)
    planes = np.linalg.eigh(moments)[1][..., 0]  # (m, 4, 3) normals
    turned = np.cross(np.roll(planes, 1, axis=1), planes)  # (m, 4, 3) corners
    ahead = np.einsum("msk,mski->mi", weights, units)
    with np.errstate(all="ignore"):
        centre = diagonals_crossing(turned, ahead)
    areas = [opencv().contourArea(quad) for quad in corners.astype(np.float32)]
    full = (np.count_nonzero(weights, axis=-1) >= LEAST).all(axis=-1) & np.isfinite(centre).all(axis=-1)
    rows = zip(numbers.ravel().tolist(), areas, centre, corners[..., 1].mean(axis=-1).tolist(), full, strict=True)
    return [Tag(number, area, ray if whole else None, row) for number, area, ray, row, whole in rows]


ALONG = np.linspace(0.12, 0.88, 16)
"""Sample points on a side, as shares of its length; nearer to the corners the adjacent sides disturb."""

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
