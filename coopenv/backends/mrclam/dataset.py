"""One sub-dataset on a common clock: landmarks, and per robot odometry, camera frames and interpolated truth."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from coopenv.backends.mrclam.files import Array, Recording, RobotRecord, Subjects, read_recording
from coopenv.errors import DataWarning

MAX_TRUTH_GAP_S = 0.5  # motion capture runs at 60 to 70 Hz; a longer pause is a robot out of its sight

# Headings that motion capture got wrong, in s of the robot's own ground truth file: (data set, robot) -> spans.
CORRUPT_HEADING = {("mrclam_9", 3): ((757.0, 1100.0),)}


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """What one camera saw at one time stamp.

    Attributes:
        t: s since the time origin.
        subjects: (n,) who was seen.
        ranges: (n,) m.
        bearings: (n,) rad, counter-clockwise from the heading.
    """

    t: float
    subjects: Subjects
    ranges: Array
    bearings: Array


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """Motion capture of one robot.

    Attributes:
        t: (N,) s since the time origin.
        position: (N, 2) m, inertial frame.
        heading: (N,) rad, unwrapped.
        corrupt_heading: spans of s since the time origin in which the heading is wrong.
    """

    t: Array
    position: Array
    heading: Array
    corrupt_heading: tuple[tuple[float, float], ...] = ()

    def at(self, t: Array) -> tuple[Array, Array, NDArray[np.bool_], NDArray[np.bool_]]:
        """Interpolate linearly, the heading along the shorter way round.

        Args:
            t: (K,) s since the time origin.

        Returns:
            Position (K, 2) m, heading (K,) rad in [-pi, pi), and where (K,) position and heading are valid: inside
            the recording, not in a gap longer than 0.5 s, and, for the heading, not in a corrupt span.
        """
        t = np.asarray(t, dtype=np.float64)
        x, y = (np.interp(t, self.t, self.position[:, axis]) for axis in (0, 1))
        heading = wrap(np.interp(t, self.t, self.heading))
        after = np.clip(np.searchsorted(self.t, t, side="left"), 1, self.t.size - 1)
        gap = self.t[after] - self.t[after - 1]
        exact = (self.t[after] == t) | (self.t[after - 1] == t)
        valid = (t >= self.t[0]) & (t <= self.t[-1]) & ((gap <= MAX_TRUTH_GAP_S) | exact)
        heading_valid = valid.copy()
        for start, end in self.corrupt_heading:
            heading_valid &= (t < start) | (t > end)
        return np.stack([x, y], axis=-1), heading, valid, heading_valid


@dataclass(frozen=True, slots=True, eq=False)
class Robot:
    """One robot on the common clock.

    Attributes:
        subject: 1..5.
        odometry: (N, 3): s since the time origin, commanded m/s forward, commanded rad/s.
        frames: in the order of time.
        truth: for judging, and for starting where an observer is given its start.
        skipped: detections left out because nobody carries their barcode.
    """

    subject: int
    odometry: Array
    frames: tuple[Frame, ...]
    truth: Truth
    skipped: int


@dataclass(frozen=True, slots=True, eq=False)
class Dataset:
    """One sub-dataset.

    Attributes:
        name: such as `mrclam_6`.
        origin_s: absolute time of t = 0: the first odometry sample of any robot.
        duration_s: s from the origin to the last odometry sample of any robot.
        landmarks: subject -> (2,) m, inertial frame.
        robots: of subjects 1..5.
    """

    name: str
    origin_s: float
    duration_s: float
    landmarks: dict[int, Array]
    robots: tuple[Robot, ...]


def wrap(angle: Array) -> Array:
    """Return angles in [-pi, pi)."""
    return np.asarray((np.asarray(angle) + np.pi) % (2 * np.pi) - np.pi)


def load_dataset(name: str, data: str | Path | None = None) -> Dataset:
    """Read a sub-dataset and put it on a common clock, with a `DataWarning` of what of it is of no use.

    Args:
        name: `mrclam_1` .. `mrclam_9`.
        data: the sub-dataset's folder or its parent; by default what COOPENV_DATA says.

    Raises:
        DataError: a folder, file or line is not what the format says.
    """
    dataset = make_dataset(read_recording(name, data))
    if remark := remark_on(dataset):
        warnings.warn(DataWarning(remark), stacklevel=2)
    return dataset


def remark_on(dataset: Dataset) -> str:
    """Return, in one line, which robots saw nothing and how many detections were left out; empty where neither is."""
    skipped = sum(robot.skipped for robot in dataset.robots)
    used = sum(frame.subjects.size for robot in dataset.robots for frame in robot.frames)
    blind = [str(robot.subject) for robot in dataset.robots if not robot.frames]
    remarks = [f"no detections of robot {', '.join(blind)}"] if blind else []
    if skipped:
        remarks.append(f"{skipped} of {skipped + used} detections left out, nobody carries their barcode")
    return f"{dataset.name}: {'; '.join(remarks)}" if remarks else ""


def make_dataset(recording: Recording) -> Dataset:
    """Put a recording on a common clock."""
    origin = min(float(robot.odometry[0, 0]) for robot in recording.robots)
    end = max(float(robot.odometry[-1, 0]) for robot in recording.robots)
    return Dataset(
        name=recording.name,
        origin_s=origin,
        duration_s=end - origin,
        landmarks={landmark.subject: np.array([landmark.x, landmark.y]) for landmark in recording.landmarks},
        robots=tuple(_robot(record, recording.name, origin) for record in recording.robots),
    )


def _robot(record: RobotRecord, name: str, origin: float) -> Robot:
    odometry = record.odometry.copy()
    odometry[:, 0] -= origin
    _, first = np.unique(record.truth[:, 0], return_index=True)  # a repeated time stamp counts once
    rows = record.truth[first]
    t = rows[:, 0] - origin
    spans = CORRUPT_HEADING.get((name, record.subject), ())
    truth = Truth(
        t=t,
        position=rows[:, 1:3].copy(),
        heading=np.unwrap(rows[:, 3]),
        corrupt_heading=tuple((float(t[0] + start), float(t[0] + end)) for start, end in spans),
    )
    return Robot(record.subject, odometry, _frames(record, origin), truth, record.skipped)


def _frames(record: RobotRecord, origin: float) -> tuple[Frame, ...]:
    if record.detection_time.size == 0:
        return ()
    cuts = np.flatnonzero(np.diff(record.detection_time) > 0) + 1
    groups = np.split(np.arange(record.detection_time.size), cuts)
    return tuple(
        Frame(
            t=float(record.detection_time[rows[0]] - origin),
            subjects=record.detection_subject[rows],
            ranges=record.detection_range[rows],
            bearings=record.detection_bearing[rows],
        )
        for rows in groups
    )
