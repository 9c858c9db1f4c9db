"""Fixed-lag smoother over a factor graph, with the neighbours' covariance as prior on their positions.

Source: Dellaert and Kaess, Factor graphs for robot perception, Foundations and Trends in Robotics 6, 2017; fixed-lag
smoother of GTSAM. Variables are the camera's pose at key frames and the points seen from them. Factors: odometry
between key frames, points known to lie at a position, and bearings, which are averaged between key frames: of each
target the mean residual to the predicted bearing, in map axes, added to the bearing predicted at the key frame.
Bearings are gated one by one before.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import gtsam
import numpy as np

from coopenv.estimation.compiled import adjoint
from coopenv.estimation.poses import Array
from coopenv.observers.contract import Estimate, Setup, Tick
from coopenv.observers.correction import NO_CONSTANTS, NO_CROSSES, NO_PLACES, InnovationGate, judged_frame
from coopenv.observers.frame import CAMERA, usable_measurements
from coopenv.observers.pose_filters import PoseObserver, unit
from coopenv.observers.uncertain_pose import LEFT, UncertainPose

LAG = 1.0  # s
KEY_PERIOD = 0.1  # s between key frames
RELINEARISE = 0.01  # rad and m, by which a variable moves before its factors are linearised anew
EXACT = 1e-10 * np.eye(3)  # m^2, of points that are known

gaussian = gtsam.noiseModel.Gaussian.Covariance


@dataclass
class Residuals:
    """Residuals of the bearings to one target since the last key frame."""

    position: Array = field(default_factory=lambda: np.zeros(3))  # m, map frame, last one
    covariance: Array = field(default_factory=lambda: np.zeros((3, 3)))  # m^2, of it
    total: Array = field(default_factory=lambda: np.zeros(3))  # rad, map axes
    count: int = 0


class FactorGraph(PoseObserver):
    """Factor graph smoothed at key frames; sends covariances.

    Between key frames it adds odometry.
    """

    def __init__(self, setup: Setup) -> None:
        super().__init__(setup)
        self.lever_arm, self.noise = np.asarray(setup.lever_arm, float), setup.noise
        self.to_camera = adjoint(np.eye(3), -self.lever_arm)
        self.to_body = adjoint(np.eye(3), self.lever_arm)

    def reset(self, initial_pose: tuple[Array, Array], initial_covariance: Array) -> None:
        """Start at a pose."""
        super().reset(initial_pose, initial_covariance)
        self.gate = InnovationGate()
        self.time = 0.0
        self.keys = 0
        self.restart()

    def restart(self) -> None:
        """Begin a graph at the present pose."""
        parameters = gtsam.ISAM2Params()
        parameters.relinearizeSkip = 1
        parameters.setRelinearizeThreshold(RELINEARISE)
        self.smoother = gtsam.IncrementalFixedLagSmoother(LAG, parameters)
        self.clear()
        self.pose_key = self.add(self.camera())
        prior = self.to_camera @ self.state.P @ self.to_camera.T
        self.graph.add(gtsam.PriorFactorPose3(self.pose_key, self.camera(), gaussian(prior)))

    def clear(self) -> None:
        """Begin to collect for the next key frame."""
        self.graph, self.values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        self.stamps: dict[int, float] = {}
        self.key_time = self.time
        self.increment = UncertainPose(LEFT, np.eye(3), np.zeros(3), np.zeros((6, 6)))
        self.residuals: dict[int, Residuals] = {}

    def camera(self) -> gtsam.Pose3:
        """Return the camera's pose, with the axes of the body."""
        return gtsam.Pose3(gtsam.Rot3(self.state.R), self.state.p + self.state.R @ self.lever_arm)

    def add(self, value: gtsam.Pose3 | Array) -> int:
        """Add a variable at the present time and return its key."""
        self.keys += 1
        self.values.insert(self.keys, value)
        self.stamps[self.keys] = self.time
        return self.keys

    def update(self, tick: Tick) -> Estimate:
        """Append the increment, collect the bearings, and smooth when a key frame is due."""
        self.state, self.increment = self.state.predicted(tick), self.increment.predicted(tick)
        self.time = tick.time
        if tick.due:
            self.collect(tick)
            if self.time - self.key_time > KEY_PERIOD - 0.5 * tick.dt:
                self.smooth()
        return self.state.estimate()

    def collect(self, tick: Tick) -> None:
        """Add up the residuals of a frame."""
        usable, R, p = usable_measurements(tick), self.state.R, self.state.p
        if usable is None or not len((measured := usable.of_camera()).entries):
            return
        judgement = judged_frame(*self.state, measured.frame, NO_CONSTANTS, NO_CROSSES, NO_PLACES)
        measured = measured.only(self.gate.passed(tick.time, judgement))
        lever_arm = measured.sensors["position"][CAMERA]  # at the time of the frame
        for n, target in enumerate(measured.targets.tolist()):
            position = measured.positions[n]
            seen = self.residuals.setdefault(target, Residuals())
            seen.position, seen.covariance = position, measured.entries["covariance"][n, 3:, 3:]
            seen.total = seen.total + R @ (measured.bearings[n] - unit((position - p) @ R - lever_arm))
            seen.count += 1

    def smooth(self) -> None:
        """Add a key frame and take the smoother's pose and covariance; start anew where it fails."""
        self.add_odometry()
        for seen in self.residuals.values():
            self.add_bearing(seen)
        try:
            self.smoother.update(self.graph, self.values, self.stamps)
            pose = self.smoother.calculateEstimatePose3(self.pose_key)
            covariance = self.smoother.marginalCovariance(self.pose_key)
        except RuntimeError:  # the factors do not determine the variables
            self.restart()
            return
        R, P = pose.rotation().matrix(), self.to_body @ covariance @ self.to_body.T
        self.state = UncertainPose(LEFT, R, pose.translation() - R @ self.lever_arm, (P + P.T) / 2)
        self.clear()

    def add_odometry(self) -> None:
        """Add the pose of a key frame, with odometry as the factor to the last one."""
        before, turn, c = self.pose_key, self.increment.R, self.lever_arm
        moved = gtsam.Pose3(gtsam.Rot3(turn), self.increment.p + turn @ c - c)
        spread = self.to_camera @ self.increment.P @ self.to_camera.T
        self.pose_key = self.add(self.camera())
        self.graph.add(gtsam.BetweenFactorPose3(before, self.pose_key, moved, gaussian(spread)))

    def add_bearing(self, seen: Residuals) -> None:
        """Add a point and the bearing to it."""
        point = self.add(seen.position)
        self.graph.add(gtsam.PriorFactorPoint3(point, seen.position, gaussian(seen.covariance + EXACT)))
        line = self.state.R.T @ (seen.position - self.camera().translation())
        mean = gtsam.Unit3(unit(line) + self.state.R.T @ seen.total / seen.count)
        noise = gtsam.noiseModel.Isotropic.Sigma(2, self.noise.bearing_std / np.sqrt(seen.count))
        self.graph.add(gtsam.BearingFactor3D(self.pose_key, point, mean, noise))
