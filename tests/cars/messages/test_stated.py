"""Context that messages state beside their values, and the image of a camera that bins pixels or reads a region."""

import math
from dataclasses import replace
from types import SimpleNamespace as Fields
from typing import Any

import numpy as np
import pytest

from coopenv.cars.messages.codec import header, make
from coopenv.cars.messages.readings import Detections, calibration_of, read
from coopenv.cars.messages.stated import NOTHING, stated
from coopenv.cars.messages.vision import Calibration
from coopenv.cars.settings.profile import Role

INFO: dict[str, Any] = {
    "width": 640,
    "height": 480,
    "k": [450.0, 0, 322, 0, 455, 236, 0, 0, 1],
    "d": [-0.3, 0.1, 0, 0, 0],
    "distortion_model": "plumb_bob",
}


def test_frames_are_kept_unchanged() -> None:
    found = stated(make("nav_msgs/msg/Odometry", header=header(5, "odom"), child_frame_id="base_link"))
    assert (found.frame, found.child_frame) == ("odom", "base_link")


@pytest.mark.parametrize(
    "message", [Fields(), Fields(header=None, pose=3, roi=None), Fields(pose=Fields(covariance=[1.0]))]
)
def test_a_message_without_context_states_nothing(message: Any) -> None:
    assert stated(message) == NOTHING


def test_binning_and_region_give_the_intrinsics_of_the_image() -> None:
    """A point ahead is in the pixel of the whole sensor, less the region's corner, divided by the binning."""
    whole = calibration_of(make("sensor_msgs/msg/CameraInfo", **INFO))
    region = {"x_offset": 40, "y_offset": 20, "width": 320, "height": 240}
    message = make("sensor_msgs/msg/CameraInfo", **INFO, binning_x=2, binning_y=4, roi=region)
    image, about = calibration_of(message), stated(message)
    points = np.array([[0.1, 0.2, 1.0], [-0.3, 0.1, 2.0]])
    expected = (whole.pixels(points) - (40.0, 20.0)) / (2.0, 4.0)
    np.testing.assert_allclose(image.pixels(points), expected, atol=1e-12)
    assert image.image_size == (160, 60)
    assert (about.binning, about.region) == ((2, 4), (40, 20, 320, 240))
    assert calibration_of(make("sensor_msgs/msg/CameraInfo", **INFO, binning_x=1, binning_y=0)) == whole


def test_the_quality_of_the_detection_that_counts_is_kept() -> None:
    square = [(-9.0, -9.0), (9.0, -9.0), (9.0, 9.0), (-9.0, 9.0)]
    large = {"id": 7, "centre": (100.0, 50.0), "corners": square, "decision_margin": 80.0, "hamming": 1}
    small = {**large, "corners": np.array(square) * 0.5, "decision_margin": 5.0, "hamming": 2}
    camera = Calibration((640, 480), (450.0, 455.0), (322.0, 236.0), (0.0,) * 5)
    small["corners"] = [tuple(corner) for corner in small["corners"]]
    message = make("apriltag_msgs/msg/AprilTagDetectionArray", detections=[small, large])
    found = read(Role.DETECTIONS, message, camera)
    assert isinstance(found, Detections)
    [quality] = found.qualities
    assert (quality.margin, quality.hamming) == (80.0, 1.0) and math.isnan(quality.score)
    assert replace(found, qualities=()).markers == (7,)
