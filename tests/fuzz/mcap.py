"""Recordings in MCAP files with other contents and valid check sums, and some whose bytes are damaged."""

from __future__ import annotations

import struct
import tempfile
import warnings
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from coopenv.api.parallel_env import CooperativeLocalisationEnv
from coopenv.mrclam.recording import load_dataset, recording_of
from coopenv.observers.recording import Recording
from coopenv.sources.mcap import read_recording, write_recording
from coopenv.sources.worlds import Replay
from tests.fuzz.harness import go_through, taken
from tests.fuzz.scenarios import at, mutate, places
from tests.helpers import mrclam_files
from tests.helpers.four_way import FOUR_WAY
from tests.helpers.mcap_edits import Sent, edit
from tests.helpers.recordings import simulated

NUMBERS = (0.0, 1.0, -1.0, 1e-300, 0.5, 1e9, 1.1e9, 1e300, np.nan, np.inf, -np.inf)
OBSERVERS = ("riccati", "robust", "mekf")


@cache
def written() -> list[bytes]:
    """Return files that are as they should be."""
    made = [
        simulated("busy_intersection", horizon=0.2, v2x__delay=1),
        simulated(FOUR_WAY, horizon=0.2),
        simulated("crossing_path", horizon=0.2, observer__k=2.0),
        robots(),
    ]
    files = []
    with tempfile.TemporaryDirectory() as folder:
        for recording in made:
            write_recording(recording, Path(folder) / "a.mcap")
            files.append((Path(folder) / "a.mcap").read_bytes())
    return files


def robots() -> Recording:
    """Return recorded robots, of whom no scenario is known."""
    with tempfile.TemporaryDirectory() as parent:
        mrclam_files.write(Path(parent), seconds=2.5)
        return recording_of(load_dataset("mrclam_6", parent), "landmarks+robots")


def prepare() -> None:
    """Compile what the cases run in."""
    with tempfile.TemporaryDirectory() as folder:
        for data in written():
            path = Path(folder) / "a.mcap"
            path.write_bytes(data)
            recording = read_recording(path)
            for observer in OBSERVERS:
                replay(recording, observer)


def replay(recording: Recording, observer: str) -> None:
    """Go through a recording; nothing may be NaN but truth that is not known."""
    go_through(CooperativeLocalisationEnv(Replay(recording, "drive", {"observer.name": observer}), "drive"))


def other_header(rng: np.random.Generator, facts: dict[str, Any]) -> dict[str, Any]:
    """Return a header in which something is different."""
    for _ in range(rng.integers(1, 3)):
        whole = [place for place in places(facts)[1:] if type(at(facts, place)) is int]
        if rng.random() < 0.3:
            *path, last = whole[rng.integers(len(whole))]
            at(facts, path)[last] = int(rng.choice([0, 1, 2, 3, 7, -1, 99, 10**6, 2**31 - 1, 2**40]))
        else:
            mutate(rng, facts)
    return facts


class Editor:
    """Changes some messages."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng, self.kind = rng, int(rng.integers(8))
        self.left = int(rng.integers(1, 4))
        self.topic = str(rng.choice(["increment", "bearings", "v2x", "truth_exact", "landmarks"]))

    def __call__(self, sent: Sent) -> Iterable[Sent]:
        if self.left == 0 or not sent.topic.endswith(self.topic) or self.rng.random() < 0.7:
            return [sent]
        self.left -= 1
        rng, data, kind = self.rng, bytearray(sent.data), self.kind
        if kind == 0:
            return []
        if kind == 1:
            return [sent, sent]
        if kind == 2:
            return [sent._replace(tick=int(rng.choice([0, 1, 5, sent.tick + 1, 10**6, 2**32 - 1])))]
        if kind == 3:
            return [sent._replace(data=bytes(data[: rng.integers(len(data) + 1)]))]
        if kind == 4:
            return [sent._replace(topic=str(rng.choice(["/vehicle_1/v2x", "/vehicle_2/bearings", "/landmarks", "/x"])))]
        k = int(rng.integers(len(data)))
        if kind == 5:
            data[k] ^= 1 << int(rng.integers(8))
        elif kind == 6 and len(data) > 12:  # numbers stand at multiples of 8 behind the four bytes of the encoding
            k = 4 + 8 * int(rng.integers((len(data) - 4) // 8))
            data[k : k + 8] = struct.pack("<d", float(rng.choice(NUMBERS)))
        else:
            data[k : k + 4] = struct.pack("<I", int(rng.choice([0, 1, 7, 2**31, 2**32 - 1])))
        return [sent._replace(data=bytes(data))]


def damaged(rng: np.random.Generator, data: bytes) -> bytes:
    """Return a file some of whose bytes are others, check sums and lengths of records among them."""
    changed = bytearray(data)
    for _ in range(rng.integers(1, 4)):
        k = int(rng.integers(len(changed)))
        if rng.random() < 0.5:
            changed[k] = int(rng.integers(256))
        else:
            changed[k : k + 8] = struct.pack("<Q", int(rng.choice([0, 1, 2**16, 2**31, 2**40, 2**63 - 1])))
    return bytes(changed)


def case(number: int) -> str:
    """Read a changed file, and replay it if it is taken."""
    rng = np.random.default_rng((4, number))
    data = written()[rng.integers(len(written()))]
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        good, path = Path(folder) / "good.mcap", Path(folder) / "drive.mcap"
        kind = rng.random()
        if kind < 0.1:
            path.write_bytes(damaged(rng, data))
        else:
            good.write_bytes(data)
            header = {"header": lambda facts: other_header(rng, facts)} if kind < 0.6 else {}
            edit(good, path, **header, **({"messages": Editor(rng)} if kind > 0.5 else {}))
        return taken(lambda: read_recording(path), lambda made: replay(made, str(rng.choice(OBSERVERS))))
