"""Frames of fake cars, the node that reads them, and the way from frame to estimate through real processes."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import coopenv
from coopenv.base.errors import CoopenvError
from coopenv.cars.backend.assembler import Intake
from coopenv.cars.backend.binding import bind
from coopenv.cars.fake.lockstep import LockstepFakes
from coopenv.cars.fake.settings import FakeSettings
from coopenv.cars.link.transport import Arrival
from coopenv.cars.link.zenoh import open_zenoh
from coopenv.cars.messages.codec import decode, encode, header, make, stamp_of
from coopenv.cars.messages.readings import read
from coopenv.cars.messages.see import FrameReader
from coopenv.cars.messages.vision import Calibration, opencv
from coopenv.cars.settings.deployment import DeploymentError, Sensors, load_deployment
from coopenv.cars.settings.profile import SVEA, CarProfile, Role, load_profile
from tests.helpers.cars import PATIENT
from tests.helpers.commands import refused
from tests.helpers.fakes import CAMERA, EXACT, MARKER, MARKERS, OVERTAKING, Stage
from tests.helpers.frames import BEARINGS, FLEET, FRAMES, grey_frame, seeing
from tests.helpers.processes import wait_until
from tests.helpers.wire import free_endpoint, heard_by

pytest.importorskip("cv2", reason="needs the extra 'vision'")

KIND = "apriltag_msgs/msg/AprilTagDetection"
IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
SHIPPED = load_deployment(FLEET)
LENS = dict(SHIPPED.overrides)


def profile_with(kind: str, **vision: Any) -> CarProfile:
    topic = {"name": "fleet/{car}/camera/frames", "type": kind}
    given = {"base": "svea", "topics": {"detections": topic}, "markers": [0, 29]}
    return load_profile({**given, "vision": {"family": "tag16h5", **vision}})


class Eyes(Stage):
    """Fakes whose cameras publish frames, and a reader of those of svea7."""

    def __init__(self, kind: str = IMAGE, **vision: Any) -> None:
        profile, sensors = profile_with(kind, **vision), Sensors(detections="bearings", distorted=False)
        super().__init__(
            "svea_overtaking", OVERTAKING, EXACT | LENS, sensors, profile, settings=FakeSettings(marker=0.2)
        )
        self.reader = FrameReader("svea7", profile, Calibration.of(self.scenario.cameras[0]), self.hub.connect())
        self.put("svea7", 0.0, -1.0, 0.5 * np.pi)
        self.put("svea8", 0.3, 0.5, 0.5 * np.pi)

    def see(self) -> Any:
        """Return the bearings of the next frame."""
        self.forget()
        while not (frames := self._said[self.fleet.profile.topic_of("svea7", Role.DETECTIONS)]):
            self.run(0.01)
        self.reader.publish(frames[-1])
        return self.arrivals("svea7", Role.BEARINGS)[-1]


def rays_of(message: Any) -> dict[int, np.ndarray]:
    """Return the rays (3,), camera to tag, optical frame."""
    return {b.id: -np.array([b.bearing_x, b.bearing_y, b.bearing_z]) for b in message.bearing}


def true_rays(eyes: Eyes) -> dict[int, np.ndarray]:
    """Return where tags are as seen by svea7, by coordinates alone."""
    (R, p), (Q, q) = map(eyes.pose, eyes.cars)
    points = {MARKERS[mark.name]: np.array(mark.position) for mark in eyes.scenario.landmarks}
    points[6] = q + Q @ MARKER
    found = {}
    for number, point in points.items():
        forward, left, up = R.T @ (point - p) - CAMERA
        found[number] = np.array([-left, -up, forward]) / np.linalg.norm([forward, left, up])
    return found


@pytest.mark.parametrize("kind", [IMAGE, COMPRESSED])
def test_bearings_of_frames_are_those_of_the_tags(kind: str) -> None:
    eyes = Eyes(kind)
    found, true = rays_of(eyes.see()), true_rays(eyes)
    assert {1, 2, 5, 6} <= found.keys() <= true.keys()  # svea8 hides one of them
    for number, ray in found.items():
        assert np.degrees(np.linalg.norm(ray - true[number])) < 0.1, number


def test_blocks_of_a_camera_are_read_as_well() -> None:
    stage = Stage("svea_overtaking", OVERTAKING, EXACT)
    reader = FrameReader("svea7", SVEA, Calibration.of(stage.scenario.cameras[0]), stage.hub.connect())
    stage.run(0.1)
    blocks = stage._said[SVEA.topic_of("svea7", Role.DETECTIONS)][-1]
    reader.publish(blocks)
    numbers = {block.signature for block in decode(blocks.payload, SVEA.topics[Role.DETECTIONS].type).objects}
    assert rays_of(stage.arrivals("svea7", Role.BEARINGS)[-1]).keys() == numbers and numbers


def test_bearings_are_stamped_with_the_middle_of_the_exposure() -> None:
    eyes = Eyes(exposure=0.02)
    about = eyes.see()
    frame = eyes.arrivals("svea7", Role.DETECTIONS)[-1]
    assert stamp_of(about) - stamp_of(frame) == 10_000_000
    assert 0 <= eyes.wall + eyes.now - stamp_of(about) < 10_000_000  # when it was taken


def test_a_rolling_shutter_is_read_at_the_time_of_its_rows() -> None:
    """While the car turns, bearings hold for their stamps, exactly for their rows; without settings for neither."""
    eyes = Eyes(exposure=0.008, row_time=4e-5)
    camera, vision = Calibration.of(eyes.scenario.cameras[0]), eyes.fleet.profile.vision
    eyes.put("svea7", -0.3, -1.2, 0.7 * np.pi)
    eyes.drive("svea7", 0.4, -0.45, 2.0)
    poses = eyes.arrivals("svea7", Role.TRUTH)
    table = np.array([(stamp_of(m) - eyes.wall, *place_of(m)) for m in poses], dtype=np.float64)

    def error(ray: np.ndarray, marker: int, stamp: float) -> float:
        x, y, yaw = (np.interp(stamp - eyes.wall, table[:, 0], column) for column in table[:, 1:].T)
        eyes.put("svea7", x, y, yaw)
        return float(np.degrees(np.linalg.norm(ray - true_rays(eyes)[marker])))

    at_stamp, at_row, unset = list[float](), list[float](), list[float]()
    for message in eyes.arrivals("svea7", Role.DETECTIONS)[10:]:
        found: Any = read(Role.DETECTIONS, message, camera, vision=vision)
        rows, begin = camera.pixels(found.bearings)[:, 1], stamp_of(message)
        for marker, ray, row in zip(found.markers, found.bearings, rows, strict=True):
            at_stamp.append(error(ray, marker, begin + found.late))
            at_row.append(error(ray, marker, begin + vision.late([row], 0)))
            unset.append(error(ray, marker, begin))
    assert len(unset) > 100 and max(at_stamp) < 0.1 and max(at_row) < 0.03 and np.mean(unset) > 0.3


def place_of(message: Any) -> tuple[float, float, float]:
    """Return x, y and yaw."""
    p, q = message.pose.pose.position, message.pose.pose.orientation
    return p.x, p.y, float(2.0 * np.arctan2(q.z, q.w))


def test_identities_are_lost_and_wrong() -> None:
    eyes = Eyes()
    before = rays_of(eyes.see())
    eyes.ask("swapped_signatures@0+1")
    swapped = rays_of(eyes.see())
    assert swapped.keys() == before.keys()
    assert max(np.degrees(np.linalg.norm(swapped[n] - before[n])) for n in before) > 5.0
    eyes.run(1.0)
    eyes.put("svea7", 0.0, -9.0, 0.5 * np.pi)  # tags of 7 pixels
    assert rays_of(eyes.see()).keys() < before.keys()
    eyes.ask("false_blocks=100")
    assert any(rays_of(eyes.see()).keys() - true_rays(eyes).keys() for _ in range(10))


@pytest.fixture
def fleet(tmp_path: Path) -> Path:
    path = tmp_path / "tags.toml"
    text = FLEET.read_text().replace('"rates.camera" = 20.0', '"rates.camera" = 10.0\n"rates.decision" = 10.0')
    path.write_text(text + PATIENT)  # half the work: computers that run tests are slow
    return path


def test_from_frames_to_an_estimate(fleet: Path) -> None:
    """On a simulated clock; the cars drive, then stand until they know where."""
    with closing(coopenv.parallel_env("cars", backend=LockstepFakes(fleet).station())) as env:
        assert drive(env) == ""


def drive(env: Any) -> str:
    """Drive until all know where they are; return what went wrong: a computer that is too slow stops the cars."""
    try:
        env.reset(seed=3, options={"arm": True})
    except CoopenvError as error:
        return str(error)
    for tick in range(200):
        infos = env.step(dict.fromkeys(env.agents, np.array([0.2 if tick < 15 else 0.0, 0.0])))[-1]
        if reason := next((info["car"]["stopped"] for info in infos.values()), ""):
            return str(reason)
        errors = [(info["position_error"], info["orientation_error"]) for info in infos.values()]
        if tick >= 15 and all(info["car"]["armed"] for info in infos.values()) and np.all(errors < np.array([0.1, 2])):
            return ""
    return f"errors in m and degrees: {errors}"


# What is wrong is one line


@pytest.fixture
def endpoint() -> Iterator[str]:
    there = free_endpoint()
    with closing(open_zenoh("router", listen=[there])):
        yield there


def test_the_node_needs_a_calibration_and_opencv(fleet: Path, endpoint: str, monkeypatch: pytest.MonkeyPatch) -> None:
    given = ("svea", "see", str(fleet), "--car", "svea7", "--connect", endpoint, "--patience", "0.2")
    assert "svea7: no calibration of its camera for 0.2 s on fleet/svea7/camera/camera_info" in refused(*given)
    monkeypatch.setitem(sys.modules, "cv2", None)
    opencv.cache_clear()
    assert "tags in images need an extra" in refused(*given)


def test_the_node_names_each_trouble_once_and_goes_on(fleet: Path, endpoint: str) -> None:
    with closing(open_zenoh("client", [endpoint])) as here, seeing(fleet, endpoint, here) as node:
        bearings = heard_by(here, BEARINGS)
        for frame in (grey_frame(encoding="yuv444"), grey_frame(encoding="yuv444"), grey_frame(640), b"", b"frame"):
            here.publish(FRAMES, frame, reliable=True)
            time.sleep(0.3)
        assert not bearings
        here.publish(FRAMES, grey_frame(stamp=7), reliable=True)
        wait_until(lambda: bearings)
        assert stamp_of(decode(bearings[-1].payload, "pixy_camera/msg/ObjectBearingArrayStamped")) == 7
        node.terminate()
        assert node.stderr is not None
        said = node.stderr.read().splitlines()
        assert said[0].startswith("svea7: detections: encoding: 'yuv444' is none of mono8")
        assert said[1] == "svea7: detections: 640 x 416 pixels, the camera model has 632 x 416"
        assert said[2].startswith("svea7: sensor_msgs/msg/Image: cannot be read (")
        assert len(said) <= 5 and "svea7 sees no more" in said[-1]


def test_stamps_of_another_detector_are_moved_to_the_exposure_on_the_way_to_the_station() -> None:
    """Tags from elsewhere go to the station as they are: it adds the time to the middle of the tag's rows."""
    topic = {"name": "fleet/{car}/tags", "type": "apriltag_msgs/msg/AprilTagDetectionArray", "max_age": 0.1}
    vision = {"exposure": 0.02, "row_time": 1e-5}
    profile = load_profile({"base": "svea", "topics": {"detections": topic}, "vision": vision})
    scenario = Eyes().scenario
    intake = Intake(bind(scenario, OVERTAKING, MARKERS, "test", None, profile), Sensors())
    square = [(u, v) for u, v in ((300.0, 180.0), (340.0, 180.0), (340.0, 220.0), (300.0, 220.0))]
    found = [{"id": 4, "centre": (320.5, 200.5), "corners": square}]
    message = make(topic["type"], header=header(10**9), detections=[make(KIND, **tag) for tag in found])
    [sample] = intake.samples(Arrival("fleet/svea7/tags", encode(message), 10**9 + 1))
    assert sample.stamp == 10**9 + 10_000_000 + 2_000_000 and sample.value.markers == (4,)


def test_frames_are_refused_at_the_station(tmp_path: Path) -> None:
    path, text = tmp_path / "tags.toml", FLEET.read_text()
    for sensors in ("", 'sensors = { detections = "bearings" }', "sensors = { distorted = false }"):
        lines = [sensors if line.startswith("sensors") else line for line in text.splitlines()]
        path.write_text("\n".join(lines))
        with pytest.raises(DeploymentError, match=r"tags\.toml: .*`coopenv svea see` makes bearings"):
            load_deployment(path)
    path.write_text(text.replace('"tag16h5"', '"tag16h6"'))
    with pytest.raises(DeploymentError, match=r"tags\.toml: .*vision\.family.*unknown family 'tag16h6'"):
        load_deployment(path)
    path.write_text(text.replace('base = "svea"', 'base = "sveta"'))
    with pytest.raises(DeploymentError, match=r"tags\.toml: profile: unknown profile 'sveta'"):
        load_deployment(path)


def test_a_profile_inherits_from_its_base() -> None:
    made, svea = profile_with(IMAGE), load_profile("svea")
    assert made.topics[Role.DETECTIONS].name == "fleet/{car}/camera/frames" and made.markers == (0, 29)
    assert made.sees_frames and not svea.sees_frames
    for role in Role:
        assert role is Role.DETECTIONS or made.topics[role] == svea.topics[role]
    assert made.command == svea.command and made.hardest == svea.hardest
    with pytest.raises(CoopenvError, match=r"topics\.detections"):
        load_profile({"base": "svea", "topics": {"detections": {"type": IMAGE}}})
