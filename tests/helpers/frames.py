"""A node of `coopenv svea see`, and the messages of the camera that it reads."""

from __future__ import annotations

import subprocess
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from coopenv.cars.backend.backend import scenario_of
from coopenv.cars.link.transport import Transport
from coopenv.cars.messages.codec import encode, header, make
from coopenv.cars.settings.deployment import load_deployment
from tests.helpers.processes import COOPENV, ROOT, start, wait_until

FLEET = ROOT / "examples" / "fleet" / "tags.toml"
CAMERA_INFO, FRAMES, BEARINGS = (
    f"fleet/svea7/{name}" for name in ("camera/camera_info", "camera/image_raw", "pixy/objects_bearing")
)


def camera_info() -> bytes:
    """Return the calibration of the fleet's cameras."""
    camera = scenario_of(load_deployment(FLEET), None, {}).cameras[0]
    (fx, fy), (cx, cy), (width, height) = camera.focal_length, camera.principal_point, camera.image_size
    fields = {"width": width, "height": height, "distortion_model": "plumb_bob", "d": camera.distortion}
    return encode(make("sensor_msgs/msg/CameraInfo", **fields, k=(fx, 0, cx, 0, fy, cy, 0, 0, 1)))


def grey_frame(width: int = 632, height: int = 416, encoding: str = "mono8", stamp: int = 1) -> bytes:
    """Return a frame without tags."""
    fields = {"width": width, "height": height, "step": width, "encoding": encoding}
    data = np.full(width * height, 90, np.uint8)
    return encode(make("sensor_msgs/msg/Image", header=header(stamp), **fields, data=data))


@contextmanager
def seeing(fleet: Path, endpoint: str, camera: Transport) -> Iterator[subprocess.Popen[str]]:
    """Run the node of svea7, to which a camera gives its calibration, until the block is left."""
    command = (*COOPENV, "svea", "see", str(fleet), "--car", "svea7", "--connect", endpoint, "--patience", "60")
    node, lines, info = start(command, ROOT), list[str](), camera_info()

    try:
        assert node.stdout is not None
        threading.Thread(target=lambda out=node.stdout: lines.append(out.readline()), daemon=True).start()
        wait_until(lambda: lines, lambda: camera.publish(CAMERA_INFO, info, reliable=True))
        assert lines == [f"svea7: see ready at {endpoint}\n"], lines
        yield node
    finally:
        node.kill()
        node.wait()
