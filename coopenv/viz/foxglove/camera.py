"""What each camera sees, as an image panel shows it: calibration, an empty image, and targets as circles with names."""

import json
from collections.abc import Iterator
from io import BytesIO

import numpy as np
from foxglove import messages as fox
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial.transform import Rotation

from coopenv.backends.mcap.format import codec
from coopenv.base.format import jsonable
from coopenv.estimation.lens import distort
from coopenv.estimation.poses import Array, covariance_in_map
from coopenv.scenario.sensing import Camera
from coopenv.viz.foxglove.scene import MAP, Shown, colour, colour_of, short
from coopenv.viz.style import DARK_BLUE
from coopenv.viz.topview_geometry import SIGMAS

_CANVAS = (236, 239, 244)  # RGB of an image without anything
_RING, _WORDS = 10.0, 11.0  # px
_NEAREST = 1e-3  # of a unit bearing's depth: beside the camera there is no image


def calibration(shown: Shown, vehicle: int, camera: Camera) -> Iterator[tuple[int, bytes]]:
    """Yield a camera's calibration, once."""
    (fx, fy), (cx, cy) = camera.focal_length, camera.principal_point
    width, height = camera.image_size
    yield (
        0,
        fox.CameraCalibration(
            timestamp=shown.stamp(0),
            frame_id=f"{shown.names[vehicle]}/camera",
            width=int(width),
            height=int(height),
            distortion_model="plumb_bob",
            D=list(camera.distortion),
            K=[fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0],
            R=[1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
            P=[fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0],
        ).encode(),
    )


def image(shown: Shown, vehicle: int, camera: Camera) -> Iterator[tuple[int, bytes]]:
    """Yield an empty image, once: a canvas for the annotations, as simulated cameras have no pixels."""
    file = BytesIO()
    Image.new("RGB", (int(camera.image_size[0]), int(camera.image_size[1])), _CANVAS).save(file, "png")
    frame = f"{shown.names[vehicle]}/camera"
    picture = fox.CompressedImage(timestamp=shown.stamp(0), frame_id=frame, data=file.getvalue(), format="png")
    yield 0, picture.encode()


def camera_annotations(shown: Shown, vehicle: int, camera: Camera) -> Iterator[tuple[int, bytes]]:
    """Yield circles where the measured bearings hit the image, with the names of the targets."""
    r = shown.recording
    names, L = r.setups[vehicle].target_names, r.landmarks.shape[1]
    for k in shown.ticks:
        stamp, targets = shown.stamp(k), np.flatnonzero(r.visible[k, vehicle])
        places, ahead = pixels(r.bearings[k, vehicle, targets] @ shown.optical(k, vehicle), camera)
        circles, words = [], []
        for target, place in zip(targets[ahead].tolist(), places[ahead].tolist(), strict=True):
            look = colour(DARK_BLUE) if target < L else colour_of(target - L)
            center = fox.Point2(x=place[0], y=place[1])
            circles.append(
                fox.CircleAnnotation(
                    timestamp=stamp, position=center, diameter=_RING, thickness=2.0, outline_color=look
                )
            )
            beside = fox.Point2(x=place[0] + _RING, y=place[1])
            words.append(
                fox.TextAnnotation(
                    timestamp=stamp, position=beside, text=names[target], font_size=_WORDS, text_color=look
                )
            )
        yield k, fox.ImageAnnotations(circles=circles, texts=words).encode()


def pixels(rays: Array, camera: Camera) -> tuple[Array, NDArray[np.bool_]]:
    """Return where rays (m, 3) in the optical frame hit the image, (m, 2) px, and which are ahead of the camera."""
    ahead = rays[:, 2] > _NEAREST
    flat = rays[:, :2] / np.where(ahead, rays[:, 2], 1.0)[:, None]
    return distort(flat, camera.distortion) * camera.focal_length + camera.principal_point, ahead


POSE = "geometry_msgs/msg/PoseWithCovarianceStamped"
ERROR = "coopenv.EstimateError"
_NUMBERS = {
    "position_error_m": "norm of the difference of true and estimated position, m",
    "orientation_error_deg": "angle between true and estimated orientation, deg",
    "three_sigma_m": "three times the largest standard deviation of the position that the observer states, m",
    "nees": "e^T P^-1 e; its mean is the number of states for an honest observer",
}
ERROR_SCHEMA = json.dumps(
    {
        "title": ERROR,
        "type": "object",
        "properties": {name: {"type": ["number", "null"], "description": about} for name, about in _NUMBERS.items()},
    }
).encode()


def poses(shown: Shown, vehicle: int) -> Iterator[tuple[int, bytes]]:
    """Yield a vehicle's estimate; a covariance of zeros, as ROS has it, where the observer states none."""
    store, run = codec(), shown.run
    types = {name.rpartition("/")[2]: kind for name, kind in store.types.items() if "geometry_msgs" in name}
    time, header = (store.types[name] for name in ("builtin_interfaces/msg/Time", "std_msgs/msg/Header"))
    R, p = run.rotation[:, vehicle], run.position[:, vehicle]
    covariance = covariance_in_map(run.coordinates, R, p, run.covariance[:, vehicle])
    for k in shown.ticks:
        if not (np.isfinite(R[k]).all() and np.isfinite(p[k]).all()):
            continue
        stated = not shown.gain and bool(np.isfinite(covariance[k]).all())
        P = np.array(short(covariance[k])).ravel() if stated else np.zeros(36)
        q = short(Rotation.from_matrix(R[k]).as_quat())
        place = types["Pose"](types["Point"](*short(p[k])), types["Quaternion"](*q))
        stamp = time(*divmod(shown.clock.nanoseconds(k), 10**9))
        message = types["PoseWithCovarianceStamped"](header(stamp, MAP), types["PoseWithCovariance"](place, P))
        yield k, bytes(store.serialize_cdr(message, POSE))


def errors(shown: Shown, vehicle: int) -> Iterator[tuple[int, bytes]]:
    """Yield a vehicle's errors as JSON; what is not known is null."""
    run = shown.run
    P = covariance_in_map(
        run.coordinates, run.rotation[:, vehicle], run.position[:, vehicle], run.covariance[:, vehicle]
    )[:, :3, :3]
    stated = np.asarray(np.isfinite(P).all(axis=(1, 2)) & (not shown.gain))
    largest = np.linalg.eigvalsh(np.where(stated[:, None, None], P, 0.0))[:, -1]
    sigma = np.where(stated, SIGMAS * np.sqrt(np.maximum(largest, 0.0)), np.nan)
    nees = np.where(stated, run.nees[:, vehicle], np.nan)
    columns = (run.position_error[:, vehicle], run.orientation_error[:, vehicle], sigma, nees)
    for k in shown.ticks:
        row = {name: float(f"{column[k]:.6g}") for name, column in zip(_NUMBERS, columns, strict=True)}
        yield k, json.dumps(jsonable(row), separators=(",", ":")).encode()
