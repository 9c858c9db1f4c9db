"""The files of one MR.CLAM sub-dataset, as they are: text columns, comments behind `#`, times in absolute seconds."""

from __future__ import annotations

import os
import re
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

import numpy as np
from numpy.typing import NDArray

from coopenv.errors import DataError, suggest

ROBOTS = (1, 2, 3, 4, 5)
NAMES = tuple(f"mrclam_{number}" for number in range(1, 10))
ENVIRONMENT_VARIABLE = "COOPENV_DATA"

MAX_PAUSE_S = 3600.0
"""Between two rows; more is a broken time stamp."""
MAX_LENGTH_S = 6 * 3600.0
"""Longest time that a sub-dataset may span, whose clocks agree; the longest one takes 40 minutes."""

Array = NDArray[np.float64]
Subjects = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Landmark:
    """A surveyed landmark.

    Attributes:
        subject: 6..20.
        x: m, inertial frame.
        y: m, inertial frame.
        x_std: m, standard deviation of the survey.
        y_std: m, standard deviation of the survey.
    """

    subject: int
    x: float
    y: float
    x_std: float
    y_std: float


@dataclass(frozen=True, slots=True, eq=False)
class RobotRecord:
    """What one robot recorded, and what motion capture recorded of it.

    Attributes:
        subject: 1..5.
        truth: (N, 4): absolute time s, x m, y m, heading rad.
        odometry: (N, 3): absolute time s, commanded forward velocity m/s, commanded angular velocity rad/s.
        detection_time: (N,) absolute time s.
        detection_subject: (N,) who was seen, 1..20.
        detection_range: (N,) m.
        detection_bearing: (N,) rad, counter-clockwise from the heading.
        skipped: how many detections had a barcode that nobody carries (misread by the camera) and were left out.
    """

    subject: int
    truth: Array
    odometry: Array
    detection_time: Array
    detection_subject: Subjects
    detection_range: Array
    detection_bearing: Array
    skipped: int


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """One sub-dataset.

    Attributes:
        name: such as `mrclam_6`.
        folder: where it was read.
        barcodes: barcode number -> subject.
        landmarks: in the order of their subjects.
        robots: of subjects 1..5.
    """

    name: str
    folder: Path
    barcodes: dict[int, int]
    landmarks: tuple[Landmark, ...]
    robots: tuple[RobotRecord, ...]


def find_folder(name: str, data: str | Path | None = None) -> Path:
    """Return the folder of a sub-dataset.

    Args:
        name: `mrclam_1` .. `mrclam_9`.
        data: the sub-dataset's folder or its parent; by default what COOPENV_DATA says.

    Raises:
        DataError: unknown name, nothing said where the data are, or they are not there.
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


def read_recording(name: str, data: str | Path | None = None) -> Recording:
    """Read a whole sub-dataset.

    Args:
        name: `mrclam_1` .. `mrclam_9`.
        data: the sub-dataset's folder or its parent; by default what COOPENV_DATA says.

    Raises:
        DataError: a folder, file or line is not what the format says; the message names file and line.
    """
    folder = find_folder(name, data)
    barcodes = _barcodes(folder / "Barcodes.dat")
    landmarks = _landmarks(folder / "Landmark_Groundtruth.dat", set(barcodes.values()))
    known = {
        barcode: who for barcode, who in barcodes.items() if who in ROBOTS or who in {m.subject for m in landmarks}
    }
    robots = tuple(_robot(folder, number, known) for number in ROBOTS)
    _check_clocks(folder, robots)
    return Recording(name=name, folder=folder, barcodes=barcodes, landmarks=landmarks, robots=robots)


def _barcodes(path: Path) -> dict[int, int]:
    table = _table(path, 2, least=len(ROBOTS) + 1)
    whole = _whole(path, table, (0, 1))
    result: dict[int, int] = {}
    seen: set[int] = set()
    for row, (subject, barcode) in enumerate(whole.tolist()):
        if not 1 <= subject <= 20:
            _fail(path, row, f"subject {subject} is not in 1..20")
        if subject in seen or barcode in result:
            _fail(path, row, f"subject {subject} or barcode {barcode} occurs twice")
        seen.add(subject)
        result[barcode] = subject
    missing = set(ROBOTS) - seen
    if missing:
        raise DataError(f"{path}: no barcode for robot {min(missing)}")
    return result


def _landmarks(path: Path, with_barcode: set[int]) -> tuple[Landmark, ...]:
    table = _table(path, 5, least=1)
    subjects = _whole(path, table, (0,))[:, 0].tolist()
    for row, subject in enumerate(subjects):
        if not 6 <= subject <= 20:
            _fail(path, row, f"subject {subject} is not in 6..20")
        if subject in subjects[:row]:
            _fail(path, row, f"subject {subject} occurs twice")
        if subject not in with_barcode:
            _fail(path, row, f"landmark {subject} has no barcode")
    rows = zip(subjects, table[:, 1:].tolist(), strict=True)
    return tuple(sorted((Landmark(s, *values) for s, values in rows), key=lambda landmark: landmark.subject))


def _robot(folder: Path, number: int, barcodes: dict[int, int]) -> RobotRecord:
    truth = _timed(folder / f"Robot{number}_Groundtruth.dat", 4, least=2)
    odometry = _timed(folder / f"Robot{number}_Odometry.dat", 3, least=2)
    path = folder / f"Robot{number}_Measurement.dat"
    seen = _timed(path, 4, least=0)
    codes = _whole(path, seen, (1,))[:, 0]
    for row in np.flatnonzero(seen[:, 2] < 0):
        _fail(path, int(row), f"negative range {seen[row, 2]:g}")
    subject = np.array([barcodes.get(code, 0) for code in codes.tolist()], dtype=np.int64)
    known = subject > 0
    return RobotRecord(
        subject=number,
        truth=truth,
        odometry=odometry,
        detection_time=seen[known, 0],
        detection_subject=subject[known],
        detection_range=seen[known, 2],
        detection_bearing=seen[known, 3],
        skipped=int(np.count_nonzero(~known)),
    )


def _timed(path: Path, columns: int, least: int) -> Array:
    table = _table(path, columns, least)
    back = np.flatnonzero(np.diff(table[:, 0]) < 0)
    if back.size:
        row = int(back[0]) + 1
        _fail(path, row, f"time runs backwards, {table[row, 0]:.14g} after {table[row - 1, 0]:.14g}")
    for before in np.flatnonzero(np.diff(table[:, 0]) > MAX_PAUSE_S).tolist():
        pause = table[before + 1, 0] - table[before, 0]
        _fail(path, before + 1, f"{pause:g} s after the row above, at most {MAX_PAUSE_S:g}")
    for late in np.flatnonzero(table[:, 0] - table[:1, 0] > MAX_LENGTH_S).tolist():
        _fail(path, late, f"{table[late, 0] - table[0, 0]:g} s after the first row, at most {MAX_LENGTH_S:g}")
    return table


def _check_clocks(folder: Path, robots: Sequence[RobotRecord]) -> None:
    begin = robots[0].odometry[0, 0]
    for robot in robots:
        apart = abs(robot.odometry[0, 0] - begin)
        if apart > MAX_LENGTH_S:
            why = f"{apart:g} s apart from Robot{robots[0].subject}_Odometry.dat, at most {MAX_LENGTH_S:g}"
            _fail(folder / f"Robot{robot.subject}_Odometry.dat", 0, why)


def _whole(path: Path, table: Array, columns: tuple[int, ...]) -> Subjects:
    values = table[:, columns]
    for row in np.flatnonzero((values != np.round(values)).any(axis=1)):
        _fail(path, int(row), "subject and barcode numbers must be whole")
    return values.astype(np.int64)


def _table(path: Path, columns: int, least: int) -> Array:
    if not path.is_file():
        raise DataError(f"{path}: no such file")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # a file without rows
            table = np.loadtxt(path, dtype=np.float64, comments="#", ndmin=2, encoding="latin-1")
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror})") from None
    except ValueError:
        _explain(path, columns)
    if table.size == 0:
        table = np.empty((0, columns))
    if table.shape[1] != columns:
        _explain(path, columns)
    for row in np.flatnonzero(~np.isfinite(table).all(axis=1)):
        _fail(path, int(row), "a value is not finite")
    if table.shape[0] < least:
        raise DataError(f"{path}:{_last_line(path)}: {table.shape[0]} rows of data, expected at least {least}")
    _check_end(path)
    return table


def _rows(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Yield line number and fields of each line that holds data."""
    with path.open(encoding="latin-1") as file:
        for number, line in enumerate(file, start=1):
            fields = line.split("#", 1)[0].split()
            if fields:
                yield number, fields


def _explain(path: Path, columns: int) -> NoReturn:
    """Find the line that the fast reader refused."""
    for number, fields in _rows(path):
        if len(fields) != columns:
            raise DataError(f"{path}:{number}: {len(fields)} columns, expected {columns}")
        for field in fields:
            try:
                float(field)
            except ValueError:
                raise DataError(f"{path}:{number}: {field[:40]!r} is not a number") from None
    raise DataError(f"{path}: not a table of {columns} columns of numbers")


def _fail(path: Path, row: int, why: str) -> NoReturn:
    """Blame a row of data, by its line in the file."""
    for index, (number, _) in enumerate(_rows(path)):
        if index == row:
            raise DataError(f"{path}:{number}: {why}")
    raise DataError(f"{path}: {why}")


def _last_line(path: Path) -> int:
    with path.open(encoding="latin-1") as file:
        return max(sum(1 for _ in file), 1)


def _check_end(path: Path) -> None:
    """Refuse a last line without a line end whose last number is shorter than the one above it: cut in the middle."""
    with path.open("rb") as file:
        file.seek(0, os.SEEK_END)
        size = file.tell()
        file.seek(max(size - 1024, 0))
        tail = file.read().decode("latin-1")
    if not tail or tail.endswith("\n"):
        return
    lines = [line.split() for line in tail.splitlines()]
    if len(lines) < 2 or not lines[-2] or not lines[-1] or lines[-2][0].startswith("#"):
        return
    decimals = [len(line[-1].partition(".")[2]) for line in lines[-2:]]
    if decimals[1] < decimals[0]:
        raise DataError(f"{path}:{_last_line(path)}: cut off in the middle of the last number {lines[-1][-1]!r}")
