"""Messages of the chosen topics as values in the environment's coordinates."""

from collections.abc import Collection, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from coopenv.backends.bags.selection import Chosen
from coopenv.backends.bags.topic_map import Frame, TopicMap
from coopenv.backends.svea.binding import Binding
from coopenv.scenario.starts import rotation_of
from coopenv.svea.reading import read
from coopenv.svea.samples import Calibration, Pose, Twist, Value
from coopenv.svea.topics import Role


class Values:
    """Reads messages as the map says."""

    def __init__(
        self, given: TopicMap, binding: Binding, told: Mapping[str, Calibration], chosen: Collection[Chosen]
    ) -> None:
        """Prepare.

        Args:
            given: the map.
            binding: the cars and their vehicles, whose cameras are those of the environment.
            told: calibrations that cars tell themselves, which count first.
            chosen: the topics that are read.
        """
        self._calibrations = {
            name: told.get(name) or calibration_of(binding, vehicle) for name, vehicle in binding.cars.items()
        }
        self._distorted, self._known = given.distorted, frozenset(binding.targets)
        self._frames = {role: given.frames.map for role in Role} | {Role.TRUTH: given.frames.truth or given.frames.map}
        self._turning = {entry.car for entry in chosen if entry.role is Role.IMU}

    def read(self, chosen: Chosen, message: Any) -> Value:
        """Return what a message tells. Raises CoopenvError: it makes no sense."""
        calibration = self._calibrations.get(chosen.car)
        value = read(chosen.role, message, calibration, distorted=self._distorted, known=self._known)
        if isinstance(value, Pose):
            return in_frame(value, self._frames[chosen.role])
        if isinstance(value, Twist) and chosen.role is Role.WHEEL and chosen.car in self._turning:
            return Twist(value.linear, None)  # the IMU knows better
        return value


def calibration_of(binding: Binding, vehicle: int) -> Calibration:
    """Return the calibration of a vehicle's camera in the environment."""
    camera = binding.scenario.cameras[vehicle]
    return Calibration(camera.image_size, camera.focal_length, camera.principal_point, camera.distortion)


def in_frame(pose: Pose, frame: Frame) -> Pose:
    """Return a pose of a frame in the environment's coordinates."""
    if frame == Frame():
        return pose
    R = rotation_of(frame.yaw, None)
    covariance = pose.covariance
    if covariance is not None:
        both = np.kron(np.eye(2), R)
        covariance = both @ covariance @ both.T
    rotation = None if pose.rotation is None else R @ pose.rotation
    return replace(
        pose, position=R @ pose.position + np.array(frame.position), rotation=rotation, covariance=covariance
    )
