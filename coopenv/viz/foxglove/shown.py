"""A recording as it is shown: which ticks, where everybody is, in which colours."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from foxglove import messages as fox
from matplotlib.colors import to_rgba
from scipy.spatial.transform import Rotation

from coopenv.backends.mcap.view import Clock
from coopenv.estimation.arrays import Array
from coopenv.observers import Run
from coopenv.observers.recording import Recording
from coopenv.scenario.bodies import Body
from coopenv.scenario.sensing import ROTATION_OF_CAMERA, Camera
from coopenv.viz.style import vehicle_colour

RATE = 20.0
"""Hz, at most, of everything that moves."""
MAP = "map"
_ROBOT = Body(size=(0.35, 0.3, 0.15), center=(0.0, 0.0, 0.08))  # of recorded robots, whose size no file tells


@dataclass(frozen=True)
class Shown:
    """A recording, an observer's run on it, and when it was."""

    recording: Recording
    run: Run
    clock: Clock
    gain: bool
    """Whether the observer's P is a gain matrix, and no covariance."""

    @cached_property
    def ticks(self) -> list[int]:
        """The ticks that are shown."""
        stride = max(1, round(1.0 / (RATE * self.recording.dt)))
        return list(range(0, self.recording.ticks, stride))

    @cached_property
    def names(self) -> list[str]:
        """Of the vehicles."""
        return [setup.name for setup in self.recording.setups]

    def stamp(self, tick: int) -> Any:
        """Return the time of a tick."""
        seconds, nanoseconds = divmod(self.clock.nanoseconds(tick), 10**9)
        return fox.Timestamp(sec=seconds, nsec=nanoseconds)

    def frame(self, vehicle: int) -> str:
        """Return the frame of a vehicle's true body, or of its estimate where no truth is known."""
        return self.names[vehicle] if self._true[vehicle] else self.estimate_frame(vehicle)

    @cached_property
    def _true(self) -> list[bool]:
        """Whether the truth of each vehicle is known at some tick."""
        return [bool(known) for known in np.atleast_1d(self.recording.truth.known.any(axis=0))]

    def estimate_frame(self, vehicle: int) -> str:
        """Return the frame of a vehicle's estimated body."""
        return f"{self.names[vehicle]}/estimate"

    def pose(self, k: int, vehicle: int) -> tuple[Array, Array] | None:
        """Return rotation and position of a vehicle: the truth, or the estimate where there is no truth at all."""
        truth, run = self.recording.truth, self.run
        true = self.frame(vehicle) == self.names[vehicle]
        source = (truth.rotation, truth.position) if true else (run.rotation, run.position)
        R, p = source[0][k, vehicle], source[1][k, vehicle]
        return (R, p) if np.isfinite(R).all() and np.isfinite(p).all() else None

    def body(self, vehicle: int) -> Body:
        """Return the box that stands for a vehicle."""
        scenario = self.recording.scenario
        return (scenario.vehicles[vehicle].body if scenario is not None else None) or _ROBOT

    def camera(self, vehicle: int) -> Camera | None:
        """Return a vehicle's camera, None where it has no image."""
        return self._cameras[vehicle]

    @cached_property
    def _cameras(self) -> list[Camera | None]:
        scenario = self.recording.scenario
        if scenario is None or scenario.topology.mode != "sensed":
            return [None] * len(self.names)
        return [camera if camera.model == "pinhole" else None for camera in scenario.cameras]

    def optical(self, k: int, vehicle: int) -> Array:
        """Return the rotation (3, 3) of a vehicle's optical frame to its body at a tick."""
        camera = self.camera(vehicle)
        assert camera is not None
        if isinstance(camera.orientation, str):
            mounted = ROTATION_OF_CAMERA[camera.orientation]
        else:
            mounted = Rotation.from_quat(camera.orientation, scalar_first=True).as_matrix()
        pan = 0.0 if self.recording.pan is None else float(self.recording.pan[k, vehicle])
        return np.asarray(Rotation.from_euler("z", pan).as_matrix() @ mounted)


def short(values: Any) -> list[float]:
    """Return numbers in single precision: enough to look at, and files stay small."""
    return list(np.asarray(values, np.float32).astype(float).tolist())


def vector(values: Any) -> Any:
    """Return a `foxglove.Vector3`."""
    x, y, z = short(values)
    return fox.Vector3(x=x, y=y, z=z)


def point(values: Any) -> Any:
    """Return a `foxglove.Point3`."""
    x, y, z = short(values)
    return fox.Point3(x=x, y=y, z=z)


def quaternion(rotation: Array) -> Any:
    """Return the `foxglove.Quaternion` of a rotation matrix."""
    x, y, z, w = short(Rotation.from_matrix(rotation).as_quat())
    return fox.Quaternion(x=x, y=y, z=z, w=w)


def pose(position: Any = (0.0, 0.0, 0.0), rotation: Array | None = None) -> Any:
    """Return a `foxglove.Pose`."""
    return fox.Pose(position=vector(position), orientation=quaternion(np.eye(3) if rotation is None else rotation))


def colour(name: str, alpha: float = 1.0) -> Any:
    """Return a `foxglove.Color`."""
    r, g, b, _ = to_rgba(name)
    return fox.Color(r=r, g=g, b=b, a=alpha)


def colour_of(vehicle: int, alpha: float = 1.0) -> Any:
    """Return the colour of a vehicle, the same as in figures."""
    return colour(vehicle_colour(vehicle), alpha)
