"""Folders of MR.CLAM whose files are cut, swapped or hold other numbers."""

from __future__ import annotations

import tempfile
import warnings
from functools import cache
from pathlib import Path

import numpy as np

from coopenv.api.parallel_env import CooperativeLocalisationEnv
from coopenv.mrclam.recording import VARIANTS, load_dataset, recording_of
from coopenv.observers import Recording
from coopenv.sources.worlds import Replay
from tests.fuzz.harness import go_through, taken
from tests.helpers import mrclam_files

WORDS = (
    *("nan", "inf", "-inf", "1e400", "1e300", "-1e300", "1e9", "-1", "0", "1e-320", "x", "", "1,5", "0x10", "1_0"),
    *("9" * 400, "#", "\0", "\x1b[2J", "5.5", "20", "21", "1248444187.0", "1e18", "99999999999"),
)
STEPS = 8


@cache
def written() -> dict[str, bytes]:
    """Return the files of a folder that is as it should be."""
    with tempfile.TemporaryDirectory() as parent:
        return {path.name: path.read_bytes() for path in mrclam_files.write(Path(parent), seconds=5.0).iterdir()}


def copy(parent: str) -> Path:
    """Write that folder and return it."""
    folder = Path(parent) / "MRCLAM_Dataset6"
    folder.mkdir()
    for name, content in written().items():
        (folder / name).write_bytes(content)
    return folder


def prepare() -> None:
    """Compile what the cases run in."""
    with tempfile.TemporaryDirectory() as parent:
        copy(parent)
        for number in (0, 1):
            replay(read(Path(parent), number), number)


def read(parent: Path, number: int) -> Recording:
    """Read a dataset in one of its variants."""
    return recording_of(load_dataset("mrclam_6", parent), VARIANTS[number % 3])


def replay(recording: Recording, number: int) -> None:
    """Go through a dataset with an embedded observer or one on the host."""
    name = ("riccati", "planar_ekf")[number % 2]
    for value in (recording.translation, recording.velocity, recording.start_covariance, recording.landmarks):
        assert np.isfinite(value).all()
    env = CooperativeLocalisationEnv(Replay(recording, "mrclam_6", {"observer.name": name}), "mrclam_6")
    go_through(env, STEPS)


def mutate(rng: np.random.Generator, folder: Path) -> None:
    """Change one file, or have a folder in its place, or nothing."""
    files = sorted(path for path in folder.glob("*.dat") if path.is_file())
    path, other = (files[rng.integers(len(files))] for _ in range(2))
    data, kind = path.read_bytes(), rng.integers(6)
    if kind == 0:
        path.unlink()
        if rng.random() < 0.5:
            path.mkdir()
    elif kind == 1:
        path.write_bytes(data[: rng.integers(len(data) + 1)])
    elif kind == 2:
        path.write_bytes(other.read_bytes())
    elif kind == 3:
        k = int(rng.integers(len(data) + 1))
        path.write_bytes(data[:k] + rng.choice([b"\0", b"\xff\xfe", b"#", b"\r", b"\n", b"e", b" 1 "]) + data[k:])
    else:
        path.write_bytes(b"\n".join(other_lines(rng, data.split(b"\n"))))


def other_lines(rng: np.random.Generator, lines: list[bytes]) -> list[bytes]:
    """Return lines of which two are swapped, some are missing, or some have other columns or numbers."""
    rows = [n for n, line in enumerate(lines) if line.split() and not line.startswith(b"#")]
    if not rows:
        return lines
    a, b = rng.choice(rows, 2)
    kind = rng.integers(5)
    if kind == 0:
        lines[a], lines[b] = lines[b], lines[a]
    elif kind == 1:
        del lines[a : a + int(rng.integers(1, len(rows) + 1))]
    else:
        for row in (a, b):
            lines[row] = b" ".join(other_fields(rng, lines[row].split(), kind))
    return lines


def other_fields(rng: np.random.Generator, fields: list[bytes], kind: int) -> list[bytes]:
    """Return a line's columns with one too many or too few, or with another number in one of them."""
    column = rng.integers(len(fields))
    if kind == 2:
        return [*fields[:column], *fields[column + 1 :]] if rng.random() < 0.5 else [*fields, b"1.0"]
    if kind == 3:
        fields[column] = str(float(fields[column]) * rng.choice([-1, 1e3, 1e6, 1e-6])).encode()
    else:
        fields[column] = str(rng.choice(WORDS)).encode()
    return fields


def case(number: int) -> str:
    """Load a mutated folder, and replay it if it is taken."""
    rng = np.random.default_rng((3, number))
    with tempfile.TemporaryDirectory() as parent, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        folder = copy(parent)
        for _ in range(rng.integers(1, 3)):
            mutate(rng, folder)
        return taken(lambda: read(Path(parent), number), lambda recording: replay(recording, number))
