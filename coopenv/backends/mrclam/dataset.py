"""One sub-dataset on a common clock: landmarks, and per robot odometry, detections and interpolated truth."""

import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from coopenv.backends.mrclam.tables import MAX_LENGTH_S, Table, find_folder, timed
from coopenv.base.errors import DataError, DataWarning
from coopenv.estimation.arrays import Array

ROBOTS = (1, 2, 3, 4, 5)
MAX_TRUTH_GAP_S = 0.5  # motion capture runs at 60 to 70 Hz; a longer pause is a robot out of its sight

# Headings that motion capture got wrong, in s of the robot's own ground truth file: (data set, robot) -> spans.
CORRUPT_HEADING = {("mrclam_9", 3): ((757.0, 1100.0),)}


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """Motion capture of one robot."""

    t: Array  # (N,) s since the time origin
    position: Array  # (N, 2) m, inertial frame
    heading: Array  # (N,) rad, unwrapped
    corrupt_heading: tuple[tuple[float, float], ...] = ()  # spans of s since the origin in which the heading is wrong

    def at(self, t: Array) -> tuple[Array, Array, NDArray[np.bool_], NDArray[np.bool_]]:
        """Interpolate linearly at times (K,), the heading along the shorter way round.

        Returns:
            Position (K, 2) m, heading (K,) rad in [-pi, pi), and where (K,) position and heading are valid: inside
            the recording, not in a gap longer than 0.5 s, and, for the heading, not in a corrupt span.
        """
        x, y, heading = (np.interp(t, self.t, values) for values in (*self.position.T, self.heading))
        after = np.clip(np.searchsorted(self.t, t, side="left"), 1, self.t.size - 1)
        gap = self.t[after] - self.t[after - 1]
        exact = (self.t[after] == t) | (self.t[after - 1] == t)
        valid = (t >= self.t[0]) & (t <= self.t[-1]) & ((gap <= MAX_TRUTH_GAP_S) | exact)
        heading_valid = valid.copy()
        for start, end in self.corrupt_heading:
            heading_valid &= (t < start) | (t > end)
        return np.stack([x, y], axis=-1), (heading + np.pi) % (2 * np.pi) - np.pi, valid, heading_valid


@dataclass(frozen=True, slots=True, eq=False)
class Robot:
    """One robot on the common clock."""

    subject: int  # 1..5
    odometry: Array  # (N, 3): s since the time origin, commanded m/s forward, commanded rad/s
    detections: Array
    """(n, 4): s since the time origin, who was seen (1..20), range m, bearing rad, counter-clockwise from the heading;
    those of one time are one camera frame."""
    truth: Truth  # for judging, and for starting where an observer is given its start
    skipped: int  # detections left out because nobody carries their barcode (misread by the camera)


@dataclass(frozen=True, slots=True, eq=False)
class Dataset:
    """One sub-dataset."""

    name: str  # such as `mrclam_6`
    duration_s: float  # from the time origin, the first odometry sample of any robot, to the last one
    landmarks: dict[int, Array]  # subject -> (2,) m, inertial frame, in the order of their subjects
    robots: tuple[Robot, ...]  # of subjects 1..5


def load_dataset(name: str, data: str | Path | None = None) -> Dataset:
    """Read a sub-dataset and put it on a common clock, with a `DataWarning` of what of it is of no use.

    Args:
        name: `mrclam_1` .. `mrclam_9`.
        data: the sub-dataset's folder or its parent; by default what COOPENV_DATA says.

    Raises:
        DataError: a folder, file or line is not what the format says; the message names file and line.
    """
    folder = find_folder(name, data)
    barcodes = _barcodes(Table(folder / "Barcodes.dat", 2, least=len(ROBOTS) + 1))
    landmarks = _landmarks(Table(folder / "Landmark_Groundtruth.dat", 5, least=1), set(barcodes.values()))
    known = {barcode: subject for barcode, subject in barcodes.items() if subject in (*ROBOTS, *landmarks)}
    tables = [_tables(folder, robot) for robot in ROBOTS]
    starts = [float(odometry.values[0, 0]) for _, odometry, _ in tables]
    for start, (_, odometry, _) in zip(starts, tables, strict=True):
        if (apart := abs(start - starts[0])) > MAX_LENGTH_S:
            odometry.refuse(0, f"{apart:g} s apart from Robot1_Odometry.dat, at most {MAX_LENGTH_S:g}")
    origin, end = min(starts), max(float(odometry.values[-1, 0]) for _, odometry, _ in tables)
    robots = tuple(_robot(name, robot, origin, known, *tables[i]) for i, robot in enumerate(ROBOTS))
    dataset = Dataset(name, end - origin, landmarks, robots)
    if remarks := [*_remarks_on(dataset), *_repairs_of([table for three in tables for table in three])]:
        warnings.warn(DataWarning(f"{name}: {'; '.join(remarks)}"), stacklevel=2)
    return dataset


def _remarks_on(dataset: Dataset) -> list[str]:
    """Return which robots saw nothing and how many detections were left out."""
    skipped, used = (
        sum(counts) for counts in zip(*((r.skipped, len(r.detections)) for r in dataset.robots), strict=True)
    )
    blind = [str(robot.subject) for robot in dataset.robots if not len(robot.detections)]
    remarks = [f"no detections of robot {', '.join(blind)}"] if blind else []
    if skipped:
        remarks.append(f"{skipped} of {skipped + used} detections left out, nobody carries their barcode")
    return remarks


def _repairs_of(tables: list[Table]) -> list[str]:
    """Return what of the files' rows was put in order or left out."""
    late = [f"{table.late} of {table.path.name}" for table in tables if table.late]
    unknown = [f"{table.unknown} of {table.path.name}" for table in tables if table.unknown]
    remarks = [f"rows that stood too late put in order: {', '.join(late)}"] if late else []
    return [*remarks, f"rows with NaN left out: {', '.join(unknown)}"] if unknown else remarks


def _barcodes(table: Table) -> dict[int, int]:
    """Return barcode -> subject."""
    result: dict[int, int] = {}
    for row, (subject, barcode) in enumerate(zip(table.whole(0), table.whole(1), strict=True)):
        if not 1 <= subject <= 20:
            table.refuse(row, f"subject {subject} is not in 1..20")
        if subject in result.values() or barcode in result:
            table.refuse(row, f"subject {subject} or barcode {barcode} occurs twice")
        result[barcode] = subject
    for robot in set(ROBOTS) - set(result.values()):
        raise DataError(f"{table.path}: no barcode for robot {robot}")
    return result


def _landmarks(table: Table, with_barcode: set[int]) -> dict[int, Array]:
    result: dict[int, Array] = {}
    for row, subject in enumerate(table.whole(0)):
        if not 6 <= subject <= 20:
            table.refuse(row, f"subject {subject} is not in 6..20")
        if subject in result:
            table.refuse(row, f"subject {subject} occurs twice")
        if subject not in with_barcode:
            table.refuse(row, f"landmark {subject} has no barcode")
        result[subject] = table.values[row, 1:3].copy()
    return dict(sorted(result.items()))


def _tables(folder: Path, robot: int) -> tuple[Table, Table, Table]:
    """Return a robot's truth, odometry and detections."""
    truth = timed(folder / f"Robot{robot}_Groundtruth.dat", 4, least=2)
    odometry = timed(folder / f"Robot{robot}_Odometry.dat", 3, least=2)
    seen = timed(folder / f"Robot{robot}_Measurement.dat", 4, least=0)
    for row in np.flatnonzero(seen.values[:, 2] < 0).tolist():
        seen.refuse(row, f"negative range {seen.values[row, 2]:g}")
    return truth, odometry, seen


def _robot(
    name: str, subject: int, origin: float, barcodes: dict[int, int], truth: Table, odometry: Table, seen: Table
) -> Robot:
    subjects = np.array([barcodes.get(barcode, 0) for barcode in seen.whole(1)], dtype=np.float64)
    clock = np.array([origin, 0.0, 0.0, 0.0])
    detections = np.column_stack([seen.values[:, 0], subjects, seen.values[:, 2:]]) - clock
    _, first = np.unique(truth.values[:, 0], return_index=True)  # a repeated time stamp counts once
    rows = truth.values[first] - clock
    spans = [rows[0, 0] + np.array(span) for span in CORRUPT_HEADING.get((name, subject), ())]
    corrupt = tuple((float(start), float(end)) for start, end in spans)
    known = subjects > 0
    return Robot(
        subject,
        odometry.values - clock[:3],
        detections[known],
        Truth(rows[:, 0], rows[:, 1:3], np.unwrap(rows[:, 3]), corrupt),
        int(np.count_nonzero(~known)),
    )
