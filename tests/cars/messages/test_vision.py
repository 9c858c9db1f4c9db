"""Bags with images: rendered tags are found, imported as bearings, and estimated with."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from coopenv import CoopenvError
from coopenv.cars.bags.bag import Bag
from coopenv.cars.bags.files import BagFile
from coopenv.cars.bags.topics import examined, proposed
from coopenv.cars.fake.frames import FrameRenderer, PlacedTag
from coopenv.cars.messages import vision
from coopenv.cars.messages.codec import make
from coopenv.cars.messages.readings import Detections, read
from coopenv.cars.messages.vision import Calibration, find_tags, frame_of
from coopenv.cars.settings.profile import Role, VisionSettings
from coopenv.observers import run
from coopenv.runs.recorder import record
from coopenv.scenario import load_scenario
from coopenv.scenario.sensing import ROTATION_OF_CAMERA
from tests.helpers import bags

cv2 = pytest.importorskip("cv2", reason="needs the extra 'vision'")

LENSES = {
    "plumb_bob": (-0.30, 0.10, 0.002, 0.0006, 0.0),
    "rational": (0.3, -0.1, 0.001, -0.0007, 0.02, 0.6, 0.05, 0.003),
    "fisheye": (-0.03, 0.01, -0.004, 0.001),
}


@pytest.mark.parametrize(
    ("name", "family"),
    [*((name, "tag36h11") for name in LENSES), *(("plumb_bob", f) for f in ("tag16h5", "DICT_4X4_50", "DICT_6X6_250"))],
)
def test_bearings_of_oblique_tags(name: str, family: str) -> None:
    calibration = Calibration((640, 480), (450.0, 455.0), (322.3, 236.1), LENSES[name])
    renderer, rng = FrameRenderer(calibration, family), np.random.default_rng(1)
    errors, placed = [], 0
    for _ in range(5):
        tags = [tag_at(np.array([x, y, 1.0]) * rng.uniform(0.6, 2.0), n, rng) for n, (x, y) in enumerate(PLACES)]
        found = {tag.number: tag.ray for tag in find_tags(renderer.render(tags, 0.5, 2.0, rng), family, calibration)}
        placed += len(tags)
        for tag in tags:
            if (ray := found.get(tag.number)) is not None:
                errors.append(np.linalg.norm(ray - tag.place / np.linalg.norm(tag.place)))
    assert len(errors) >= 0.9 * placed
    assert np.degrees(max(errors)) < 0.1


def test_tags_are_found_in_dark_frames() -> None:
    calibration = Calibration((640, 480), (450.0, 455.0), (322.3, 236.1), LENSES["plumb_bob"])
    renderer, rng = FrameRenderer(calibration, "tag36h11"), np.random.default_rng(2)
    tags = [PlacedTag(n, np.eye(3), 2.0 * np.array([x, y, 1.0]), 0.16) for n, (x, y) in enumerate(PLACES)]
    frame = renderer.render(tags, 0.5, 0.0, rng)
    dark = np.rint(10.0 + 0.07 * frame + rng.normal(size=frame.shape)).astype(np.uint8)  # 19 shades from black to white
    assert {tag.number for tag in find_tags(dark, "tag36h11", calibration)} == set(range(len(PLACES)))


PLACES = ((-0.42, -0.28), (0.42, -0.28), (-0.42, 0.28), (0.42, 0.28))


def tag_at(place: np.ndarray, number: int, rng: np.random.Generator) -> PlacedTag:
    """Return a tag that is turned by up to 60 degrees away from the camera."""
    facing = Rotation.align_vectors([place / np.linalg.norm(place)], [[0.0, 0.0, 1.0]])[0]
    tilt = Rotation.from_rotvec(rng.uniform(0.0, np.pi / 3) * np.array([*unit(rng.normal(size=2)), 0.0]))
    return PlacedTag(number, (facing * tilt).as_matrix(), place, 0.16)


def unit(v: np.ndarray) -> np.ndarray:
    return v / np.linalg.norm(v)


def test_a_bag_of_images_is_estimated_with(tmp_path: Path) -> None:
    drive, camera = bags.drive(), load_scenario("crossing_path").cameras[0]
    calibration = Calibration(camera.image_size, camera.focal_length, camera.principal_point, bags.DISTORTION)
    renderer, C = FrameRenderer(calibration, "tag36h11"), ROTATION_OF_CAMERA["forward"]
    rng = np.random.default_rng(0)
    given = [m for m in bags.sent() if m.topic != bags.AUTHORS["blocks"]]
    width, height = camera.image_size
    for k in range(drive.ticks):
        R, p = drive.truth.rotation[k, 0], drive.truth.position[k, 0]
        tags = []
        for target in range(4):
            place = C.T @ (R.T @ (drive.landmarks[k, target] - p) - np.array(camera.position))
            across = unit(np.cross([0.0, 1.0, 0.0], place))  # upright, and facing the camera
            tags.append(
                PlacedTag(
                    bags.NUMBERS[target], np.stack([across, [0, 1, 0], np.cross(across, [0, 1, 0])], -1), place, 0.12
                )
            )
        frame, t = renderer.render(tags, 0.0, 2.0, rng), round(k * 1e9 * drive.dt)
        fields = {"width": width, "height": height, "step": width, "encoding": "mono8", "data": frame.ravel()}
        given.append(bags.Message("/camera/image_raw", "sensor_msgs/msg/Image", t, t, fields))
    text = bags.MAP.replace("agent = 8\n", 'agent = 8\n[cars.topics]\ndetections = "/camera/image_raw"\n')
    (tmp_path / "topics.toml").write_text(text, encoding="utf-8")
    bag = Bag([bags.write(tmp_path / "mcap", given, "mcap")], tmp_path / "topics.toml")
    with BagFile(tmp_path / "mcap") as file:
        assert "has seen images" in proposed([file], examined([file])[0])
    recording = record(bag)
    assert recording.visible[:, 0, :4].any(axis=0).all()
    result = run("riccati", recording)
    assert not result.failure
    assert result.position_rmse(2.8)[0] < 0.05


DISCS = {1: ((255, 40, 20), 100.0, 60.0), 2: ((20, 220, 60), 300.5, 200.0), 3: ((30, 60, 255), 50.0, 300.25)}
"""Colour (red, green, blue) and centre, pixels, of discs by number."""
COLOURS = {1: (340.0, 20.0), 2: (100.0, 150.0), 3: (210.0, 250.0), 4: (280.0, 320.0)}


@pytest.mark.parametrize("encoding", ["rgb8", "bgr8", "rgba8", "png"])
def test_blobs_of_colour(encoding: str) -> None:
    frame = np.full((360, 480, 3), 128, np.uint8)
    across, down = np.meshgrid(np.arange(480), np.arange(360))
    for colour, u, v in DISCS.values():
        frame[(across - u) ** 2 + (down - v) ** 2 < 15.0**2] = colour
    frame[10:12, 200:203] = DISCS[2][0]  # smaller than any blob
    frame[5:25, 400:420] = (40, 20, 20)  # dark red
    if encoding == "png":
        data = cv2.imencode(".png", frame[..., ::-1])[1]
        message = make("sensor_msgs/msg/CompressedImage", format="png", data=data)
    else:
        opaque = np.dstack([frame, np.full((360, 480), 255, np.uint8)])
        part = {"rgb8": frame, "bgr8": frame[..., ::-1], "rgba8": opaque}[encoding]
        size = {"width": 480, "height": 360, "step": 480 * part.shape[2]}
        message = make("sensor_msgs/msg/Image", encoding=encoding, data=part, **size)
    camera = Calibration((480, 360), (400.0, 410.0), (240.0, 180.0), (0.0,) * 5)
    found = read(Role.DETECTIONS, message, camera, vision=VisionSettings(colours=COLOURS))
    assert isinstance(found, Detections) and found.markers == (1, 2, 3) and found.dropped == 0
    for (_, u, v), ray in zip(DISCS.values(), found.bearings, strict=True):
        exact = np.array([(u - 240.0) / 400.0, (v - 180.0) / 410.0, 1.0])
        assert np.degrees(np.linalg.norm(ray - unit(exact))) < 0.02


def test_unreadable_frames_are_one_line() -> None:
    with pytest.raises(ValueError, match=r"unknown family 'tag36h12'.*tag36h11"):
        VisionSettings(family="tag36h12")
    with pytest.raises(CoopenvError, match="encoding: 'yuv444' is none of mono8"):
        frame_of(make("sensor_msgs/msg/Image", width=1, height=1, step=1, encoding="yuv444", data=[0]))
    with pytest.raises(CoopenvError, match="no JPEG or PNG image that OpenCV reads"):
        frame_of(make("sensor_msgs/msg/CompressedImage", format="jpeg", data=[1, 2, 3]))
    odd = {"width": 63, "height": 48, "step": 126, "encoding": "yuv422", "data": np.zeros(126 * 48, np.uint8)}
    with pytest.raises(CoopenvError, match=r"detections: data: OpenCV does not read 63 x 48 yuv422: ") as caught:
        camera, settings = (
            Calibration((63, 48), (50.0, 50.0), (32.0, 24.0), (0.0,) * 5),
            VisionSettings(colours=COLOURS),
        )
        read(Role.DETECTIONS, make("sensor_msgs/msg/Image", **odd), camera, vision=settings)
    assert "\n" not in str(caught.value)


OTHERS = (".bmp", ".tiff", ".webp", ".jp2", ".hdr", ".sr", ".gif")


@pytest.mark.parametrize("suffix", [".jpg", ".png", *OTHERS])
def test_compressed_frames_are_jpeg_or_png_and_damaged_ones_are_quiet(
    capfd: pytest.CaptureFixture[str], suffix: str
) -> None:
    cv2, rng = vision.opencv(), np.random.default_rng(0)
    frame = cv2.cvtColor(rng.integers(0, 255, (40, 60), dtype=np.uint8), cv2.COLOR_GRAY2BGR)
    try:
        data = cv2.imencode(suffix, frame.astype(np.float32) if suffix == ".hdr" else frame)[1].ravel()
    except cv2.error:
        pytest.skip("this OpenCV does not write it")
    capfd.readouterr()
    message = make("sensor_msgs/msg/CompressedImage", format=suffix, data=data)
    if suffix in (".jpg", ".png"):
        assert frame_of(message).shape == (40, 60)
        for cut in range(20, len(data), 97):
            for broken in (data[:cut], np.where(np.arange(len(data)) % 97 == cut % 97, 0x55, data).astype(np.uint8)):
                with suppress(CoopenvError):
                    frame_of(make("sensor_msgs/msg/CompressedImage", format=suffix, data=broken))
    else:
        with pytest.raises(CoopenvError, match=r"data: no JPEG or PNG image that OpenCV reads, its format is '\.\w+'"):
            frame_of(message)
    assert capfd.readouterr() == ("", "")
