"""One sub-dataset of MR.CLAM on a common clock: landmarks, and per robot odometry, detections and truth."""

import os
import re
import warnings
from dataclasses import dataclass
from functools import cached_property
from io import StringIO
from pathlib import Path
from typing import NoReturn

import numpy as np
from numpy.typing import NDArray

from coopenv.base.errors import DataError, DataWarning, regular, suggest
from coopenv.estimation.poses import MISFIT_DEG, Array, about_z, bearing_misfit_deg

NAMES = tuple(f"mrclam_{number}" for number in range(1, 10))
IN_SPACE = "_space"
"""May stand behind a name, which it does not change."""
ENVIRONMENT_VARIABLE = "COOPENV_DATA"

MAX_PAUSE_S = 3600.0  # between two rows; more is a broken time stamp
MAX_LENGTH_S = 6 * 3600.0
"""Longest time that a sub-dataset may span, whose clocks agree; the longest one takes 40 minutes."""
MAX_DISORDER_S = 1.0  # by which a row may be late, as some are that were published; more is a broken time stamp


def find_folder(name: str, data: str | Path | None = None) -> Path:
    """Return the folder of a sub-dataset: `data` or a folder in it, by default that of COOPENV_DATA.

    Raises:
        DataError: unknown name, no folder given, or they are not there.
    """
    if name not in NAMES:
        raise DataError(f"unknown data set {name!r}{suggest(str(name), NAMES)}; there are {NAMES[0]} .. {NAMES[-1]}")
    where = data if data is not None else os.environ.get(ENVIRONMENT_VARIABLE)
    if not where:
        raise DataError(f"{name}: name its folder with --data DIR or {ENVIRONMENT_VARIABLE} (docs/data.md)")
    root = Path(where).expanduser()
    wanted = f"MRCLAM_Dataset{name.removeprefix('mrclam_')}"
    if (root / wanted).is_dir():
        return root / wanted
    if not root.is_dir():
        raise DataError(f"{name}: folder {root} does not exist")
    other = re.fullmatch(r"MRCLAM_Dataset\d+", root.resolve().name)
    if root.resolve().name == wanted or ((root / "Barcodes.dat").is_file() and other is None):
        return root
    if other:
        raise DataError(f"{name}: {root} is another sub-dataset, expected {wanted}")
    raise DataError(f"{name}: neither {wanted} nor Barcodes.dat in {root}")


class Rows:
    """A file's rows of finite numbers, which know their lines."""

    unknown = 0  # rows left out because a value in them is not known
    late = 0  # rows that stood below a later one
    _kept: NDArray[np.int64] | None = None  # of each row, which of the file's it is; None: the same

    def __init__(self, path: Path, columns: int, least: int, gaps: bool = False) -> None:
        """Read a file that has so many columns, and at least so many rows; a DataError names a line that is not so.

        Where `gaps` are allowed, rows are left out that have NaN behind their first column.
        """
        try:
            self.path, self._text = path, regular(path).read_text(encoding="utf-8-sig", errors="replace")
        except OSError as error:
            why = f"cannot be read ({error.strerror})" if path.exists() else "no such file"
            raise DataError(f"{path}: {why}") from None
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # a file without rows
                self.values = np.loadtxt(StringIO(self._text), dtype=np.float64, ndmin=2)
        except ValueError:
            self._explain(columns)
        if self.values.size == 0:
            self.values = np.empty((0, columns))
        if self.values.shape[1] != columns:
            self._explain(columns)
        if gaps:
            known = ~np.isnan(self.values[:, 1:]).any(axis=1)
            self.unknown = int(np.count_nonzero(~known))
            self._take(np.flatnonzero(known))
        for row in np.flatnonzero(~np.isfinite(self.values).all(axis=1)).tolist():
            self.refuse(row, "a value is not finite")
        if len(self.values) < least:
            end = max(len(self._text.rstrip("\n").split("\n")), 1)
            raise DataError(f"{path}:{end}: {len(self.values)} rows of data, expected at least {least}")
        if len(self.values) > 1 and not self._text.endswith("\n"):  # cut in the middle of a number?
            above, (number, last) = self._rows[-2][1][-1], (self._rows[-1][0], self._rows[-1][1][-1])
            if number == self._text.count("\n") + 1 and len(last.partition(".")[2]) < len(above.partition(".")[2]):
                self.refuse(-1, f"cut off in the middle of the last number {last!r}")

    @cached_property
    def _rows(self) -> list[tuple[int, list[str]]]:
        """Number and fields of each line that holds data."""
        split = ((number, line.partition("#")[0].split()) for number, line in enumerate(self._text.split("\n"), 1))
        return [(number, fields) for number, fields in split if fields]

    def _explain(self, columns: int) -> NoReturn:
        """Blame the line that the fast reader has refused."""
        for row, (_, fields) in enumerate(self._rows):
            if len(fields) != columns:
                self.refuse(row, f"{len(fields)} columns, expected {columns}")
            for field in fields:
                try:
                    float(field)
                except ValueError:
                    self.refuse(row, f"{field[:40]!r} is not a number")
        raise DataError(f"{self.path}: not a table of {columns} columns of numbers")

    def refuse(self, row: int, why: str) -> NoReturn:
        """Blame a row of data, by its line in the file."""
        number = row if self._kept is None else self._kept[row]
        raise DataError(f"{self.path}:{self._rows[number][0]}: {why}")

    def sort(self, late: NDArray[np.bool_]) -> None:
        """Put rows in the order of their first column, and remember how many were late."""
        self.late = int(np.count_nonzero(late))
        if self.late:
            self._take(np.argsort(self.values[:, 0], kind="stable"))

    def _take(self, rows: NDArray[np.int64]) -> None:
        self.values, self._kept = self.values[rows], rows if self._kept is None else self._kept[rows]

    def whole(self, column: int) -> list[int]:
        """Return a column of whole numbers. Raises DataError: a number is not whole."""
        values = self.values[:, column]
        for row in np.flatnonzero(values != np.round(values)).tolist():
            self.refuse(row, "subject and barcode numbers must be whole")
        return [int(value) for value in values]


def timed(path: Path, columns: int, least: int) -> Rows:
    """Return a table whose first column is the time, s, which does not run ahead by hours.

    Rows that stand up to a second too late are put in order, and rows with NaN are left out; the table counts both. A
    DataError names a row that is later.
    """
    table = Rows(path, columns, least, gaps=True)
    t = table.values[:, 0]
    behind = np.maximum.accumulate(t) - t
    for row in np.flatnonzero(behind >= MAX_DISORDER_S).tolist():
        why = f"time runs backwards, {t[row]:.14g} after {t[row - 1]:.14g}"
        table.refuse(row, f"{why}; rows may be out of order by less than {MAX_DISORDER_S:g} s")
    table.sort(behind > 0)
    t = table.values[:, 0]
    steps, length = np.diff(t, prepend=t[:1]), t - t[:1]
    for row in np.flatnonzero(steps > MAX_PAUSE_S).tolist():
        table.refuse(row, f"{steps[row]:g} s after the row above, at most {MAX_PAUSE_S:g}")
    for row in np.flatnonzero(length > MAX_LENGTH_S).tolist():
        table.refuse(row, f"{length[row]:g} s after the first row, at most {MAX_LENGTH_S:g}")
    return table


ROBOTS = (1, 2, 3, 4, 5)
MAX_TRUTH_GAP_S = 0.5  # motion capture runs at 60 to 70 Hz; a longer pause is a robot out of its sight

# Headings that motion capture got wrong, in s of the robot's own ground truth file: (data set, robot) -> spans.
CORRUPT_HEADING = {("mrclam_9", 3): ((757.0, 1100.0),)}


@dataclass(frozen=True, slots=True, eq=False)
class MotionCapture:
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
    """(n, 4): s since the time origin, subject (1..20), range m, bearing rad, counter-clockwise from the heading;
    those of one time are one camera frame."""
    truth: MotionCapture  # for judging, and for starting where an observer is given its start
    skipped: int  # detections left out because no robot carries their barcode (misread by the camera)
    outside: int = 0  # detections left out because no robot has odometry yet, or has any more


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
        data: the sub-dataset's folder or its parent; by default that of COOPENV_DATA.

    Raises:
        DataError: a folder, file or line does not have the format; the message names file and line.
    """
    folder = find_folder(name, data)
    barcodes = _barcodes(Rows(folder / "Barcodes.dat", 2, least=len(ROBOTS) + 1))
    landmarks = _landmarks(Rows(folder / "Landmark_Groundtruth.dat", 5, least=1), set(barcodes.values()))
    known = {barcode: subject for barcode, subject in barcodes.items() if subject in (*ROBOTS, *landmarks)}
    tables = [_tables(folder, robot) for robot in ROBOTS]
    starts = [float(odometry.values[0, 0]) for _, odometry, _ in tables]
    for start, (_, odometry, _) in zip(starts, tables, strict=True):
        if (apart := abs(start - starts[0])) > MAX_LENGTH_S:
            odometry.refuse(0, f"{apart:g} s apart from Robot1_Odometry.dat, at most {MAX_LENGTH_S:g}")
    origin, end = min(starts), max(float(odometry.values[-1, 0]) for _, odometry, _ in tables)
    robots = tuple(_robot(name, robot, (origin, end), known, *tables[i]) for i, robot in enumerate(ROBOTS))
    dataset = Dataset(name, end - origin, landmarks, robots)
    if remarks := _remarks_on(dataset, [table for three in tables for table in three]):
        warnings.warn(DataWarning(f"{name}: {'; '.join(remarks)}"), stacklevel=2)
    return dataset


def _remarks_on(dataset: Dataset, tables: list[Rows]) -> list[str]:
    """Return notes on robots without detections, and on parts of the files left out or put in order."""
    skipped, outside = (sum(getattr(robot, name) for robot in dataset.robots) for name in ("skipped", "outside"))
    total = skipped + outside + sum(len(robot.detections) for robot in dataset.robots)
    blind = [str(robot.subject) for robot in dataset.robots if not len(robot.detections)]
    remarks = [f"no detections of robot {', '.join(blind)}"] if blind else []
    if skipped:
        remarks.append(f"{skipped} of {total} detections left out: no robot or landmark of the map has their barcode")
    if outside:
        time = f"0 to {dataset.duration_s:.0f} s, in which there is odometry"
        remarks.append(f"{outside} of {total} detections left out: not within {time}")
    for robot in dataset.robots:
        if (misfit := _misfit(dataset, robot)) > MISFIT_DEG:
            off = f"bearings to landmarks are {misfit:.0f} deg off (median)"
            remarks.append(f"Robot{robot.subject}_Groundtruth.dat: {off}: are columns 2 and 3 in m and 4 in rad?")
    for what, count in (("rows that stood too late put in order", "late"), ("rows with NaN left out", "unknown")):
        counts = [f"{number} of {table.path.name}" for table in tables if (number := getattr(table, count))]
        remarks += [f"{what}: {', '.join(counts)}"] if counts else []
    return remarks


def _misfit(dataset: Dataset, robot: Robot) -> float:
    """Return by how much a robot's bearings to landmarks differ from its true poses, deg; NaN: not known."""
    seen = robot.detections[np.isin(robot.detections[:, 1], list(dataset.landmarks))]
    position, heading, _, known = robot.truth.at(seen[:, 0])
    places = np.array([dataset.landmarks[int(subject)] for subject in seen[:, 1]]).reshape(-1, 2)
    flat = [np.column_stack([values, np.zeros(len(seen))])[known] for values in (position, places)]
    rays = np.column_stack([np.cos(seen[:, 3]), np.sin(seen[:, 3]), np.zeros(len(seen))])[known]
    return bearing_misfit_deg(about_z(heading[known]), flat[0], rays, flat[1])


def _barcodes(table: Rows) -> dict[int, int]:
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


def _landmarks(table: Rows, with_barcode: set[int]) -> dict[int, Array]:
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


def _tables(folder: Path, robot: int) -> tuple[Rows, Rows, Rows]:
    """Return a robot's truth, odometry and detections."""
    truth = timed(folder / f"Robot{robot}_Groundtruth.dat", 4, least=2)
    odometry = timed(folder / f"Robot{robot}_Odometry.dat", 3, least=2)
    seen = timed(folder / f"Robot{robot}_Measurement.dat", 4, least=0)
    for row in np.flatnonzero(seen.values[:, 2] < 0).tolist():
        seen.refuse(row, f"negative range {seen.values[row, 2]:g}")
    for row in np.flatnonzero(np.abs(seen.values[:, 3]) > 2.0 * np.pi).tolist():
        seen.refuse(row, f"bearing {seen.values[row, 3]:g}, expected radians, -pi to pi")
    return truth, odometry, seen


def _robot(
    name: str,
    subject: int,
    recorded: tuple[float, float],
    barcodes: dict[int, int],
    truth: Rows,
    odometry: Rows,
    seen: Rows,
) -> Robot:
    """Return a robot from its tables; `recorded` is from when to when, s, there is odometry of any robot."""
    subjects = np.array([barcodes.get(barcode, 0) for barcode in seen.whole(1)], dtype=np.float64)
    clock = np.array([recorded[0], 0.0, 0.0, 0.0])
    detections = np.column_stack([seen.values[:, 0], subjects, seen.values[:, 2:]]) - clock
    _, first = np.unique(truth.values[:, 0], return_index=True)  # a repeated time stamp counts once
    rows = truth.values[first] - clock
    spans = [rows[0, 0] + np.array(span) for span in CORRUPT_HEADING.get((name, subject), ())]
    corrupt = tuple((float(start), float(end)) for start, end in spans)
    known, within = subjects > 0, (seen.values[:, :1] - recorded).prod(axis=1) <= 0.0
    return Robot(
        subject,
        odometry.values - clock[:3],
        detections[known & within],
        MotionCapture(rows[:, 0], rows[:, 1:3], np.unwrap(rows[:, 3]), corrupt),
        int(np.count_nonzero(~known)),
        int(np.count_nonzero(known & ~within)),
    )


MAX_HOLD_S = 2.0
"""A command holds until the next one, but no longer than this: where a log ends, its robot does not drive on."""


class HeldCommands:
    """One robot's odometry as a function of time. Before its first command a robot stands."""

    def __init__(self, robot: Robot) -> None:
        t, v, omega = robot.odometry.T
        long = np.flatnonzero(np.diff(t, append=np.inf) > MAX_HOLD_S)
        self._t = np.insert(t, long + 1, t[long] + MAX_HOLD_S)
        self._v, self._omega = np.insert(v, long + 1, 0.0), np.insert(omega, long + 1, 0.0)

    def sums(self, t: Array) -> Array:
        """Return (K, 2) by how many rad and m the robot was to turn and to drive until times t (K,) in s."""
        rates = np.column_stack([self._omega, self._v])
        until = np.concatenate([np.zeros((1, 2)), np.cumsum(rates[:-1] * np.diff(self._t)[:, None], axis=0)])
        k = np.searchsorted(self._t, t, side="right") - 1
        return np.where((k < 0)[:, None], 0.0, until[k] + rates[k] * (t - self._t[k])[:, None])

    def pose(self, t: Array) -> Array:
        """Return x, y in m and heading in rad (K, 3), seen from the pose at the first command, at times t (K,) in s."""
        k = np.searchsorted(self._t, t, side="right") - 1
        start, dt = self._at_samples[k], t - self._t[k]
        turn = self._omega[k] * dt
        moved = start[:, :2] + arc(start[:, 2], self._v[k] * dt, turn)
        return np.where((k < 0)[:, None], 0.0, np.column_stack([moved, start[:, 2] + turn]))

    @cached_property
    def _at_samples(self) -> Array:
        """(N, 3) x, y, heading when each command begins."""
        dt = np.diff(self._t)
        turn, path = self._omega[:-1] * dt, self._v[:-1] * dt
        heading = np.concatenate([[0.0], np.cumsum(turn)])
        steps = arc(heading[:-1], path, turn)
        return np.column_stack([np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)]), heading])


def arc(heading: Array, path: Array, turn: Array) -> Array:
    """Return the displacement (K, 2) along arcs that begin at a heading: a chord at half the turn."""
    chord, middle = path * np.sinc(turn / (2 * np.pi)), heading + turn / 2
    return np.stack([chord * np.cos(middle), chord * np.sin(middle)], axis=-1)
