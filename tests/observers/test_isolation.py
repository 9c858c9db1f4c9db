"""Observers in processes of their own: they find neither truth nor seed, and give the same results as in the parent."""

from __future__ import annotations

import re
import weakref
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from coopenv.base.errors import CoopenvError
from coopenv.base.installation import load_reference
from coopenv.observers.contract import SensorNoise
from coopenv.observers.isolation import Isolated, load, started
from coopenv.observers.recording import Drawn, Recording
from coopenv.observers.runner import Run, run
from coopenv.runs.recorder import record
from coopenv.scenario import load_scenario

SPY = """
import gc, os, sys
import numpy as np
from coopenv.observers import Estimate, Message

def is_secret(value):
    if issubclass(type(value), np.ndarray) and value.dtype == float:
        return bool((np.abs(value - 31415926.0) < 9.0).any())
    return type(value) is int and value - 1 == 987654320

def parts(thing):
    yield thing
    kind = type(thing)  # isinstance would ask a weak reference for the class of what it has lost
    yield from list(thing.values()) if issubclass(kind, dict) else thing if issubclass(kind, (list, tuple)) else ()
    try:
        yield from list(vars(thing).values())
    except Exception:  # has no attributes, or is a placeholder of Pydantic's
        pass

def secrets():
    frame, things = sys._getframe(), gc.get_objects()
    while frame is not None:
        things += frame.f_locals.values()
        frame = frame.f_back
    for module in list(sys.modules.values()):
        things += vars(module).values() if module else ()
    texts = [str(dict(os.environ))]
    for name in ("environ", "cmdline", *(f"fd/{n}" for n in os.listdir("/proc/self/fd"))):
        if os.path.isfile(f"/proc/self/{name}"):
            texts.append(open(f"/proc/self/{name}", "rb").read(10000).decode(errors="replace"))
    found = sum(is_secret(part) for thing in things for part in list(parts(thing)))
    return found + sum(text.count("98765" + "4321") for text in texts)

class Spy:
    def __init__(self, setup):
        self.setup = setup
    def reset(self, pose, covariance):
        self.start = pose, covariance
    def update(self, tick):
        self.found = secrets()
        return Estimate(np.eye(3), np.array([self.found, "coopenv.bench.frozen" in sys.modules, 0.0]))
    def message(self):
        return Message()
"""


@pytest.fixture(scope="module")
def two() -> Recording:
    """Two vehicles that send messages, for 0.3 s."""
    return record(load_scenario("overtaking", {"horizon": 0.3}), 3)


def apart(reference: str, recording: Recording) -> Run:
    with started(Isolated(reference)) as observer:
        return run(observer, recording)


def test_an_observer_that_looks_everywhere_finds_neither_truth_nor_seed(tmp_path: Path) -> None:
    """In the parent it finds the truth."""
    (tmp_path / "spy.py").write_text(SPY)
    zero = np.zeros((2, 1, 3))
    recording = Recording.from_arrays(
        dt=0.1,
        landmarks=[[1.0, 0.0, 0.0]],
        velocity=zero,
        angular_velocity=zero,
        bearings=np.full((2, 1, 2, 3), np.nan),
        noise=SensorNoise(0.1, 0.1, 0.1, 0.01),
        start_position=[[0.0, 0.0, 0.0]],
        truth_position=zero + 31415926.0,
        truth_rotation=np.tile(np.eye(3), (2, 1, 1, 1)),
    )
    recording = replace(recording, drawn=Drawn(987654321, 0, ()))
    reference = f"{tmp_path / 'spy.py'}:Spy"
    result = apart(reference, recording)
    assert result.failure == "" and not result.position[1:].any()
    lost = weakref.proxy(set())  # which other tests leave, too
    result = run(load_reference(reference), recording)
    del lost
    assert result.failure == "" and result.position[-1, 0, 0] > 0.0


OWN = '''
from coopenv.observers.centralised import Centralised
from coopenv.observers.schmidt_kalman import SchmidtKalman

class Fine(SchmidtKalman):
    """Its messages have entries of their own, and its estimate depends on which messages are new."""
    last = None
    def update(self, tick):
        estimate = super().update(tick)
        messages = [received.message for received in tick.messages.values()]
        if self.last != [*map(id, messages)]:
            self.last, self.kept = [*map(id, messages)], messages
            estimate.position[2] += 1.0
        return estimate

class Joint(Centralised):
    pass
'''

FAULTY = '''
import os
import numpy as np
from coopenv.observers import Message

class Faulty:
    """Each run fails in another way, the last one with the process."""
    runs = iter((lambda: 1 / 0, lambda: "nothing", object, lambda: os.write(1, b"said"), lambda: os._exit(3)))

    def __init__(self, setup):
        if setup.vehicle == 0:
            Faulty.fail = next(Faulty.runs)

    def reset(self, pose, covariance):
        pass

    def update(self, tick):
        return Faulty.fail()

    def message(self):
        return Message()

class Babbles(Faulty):
    def update(self, tick):
        for n in range(3, 256):
            try:
                os.write(n, bytes(3) + b"\\7garbage")
            except OSError:
                pass

class Long(Faulty):
    def message(self):
        return Message(extra={"many": np.zeros(1 << 20)})
'''


@pytest.mark.parametrize("name", ["Fine", "Joint"])
def test_results_are_those_of_the_same_process(two: Recording, tmp_path: Path, name: str) -> None:
    (tmp_path / "mine.py").write_text(OWN)
    reference = f"{tmp_path / 'mine.py'}:{name}"
    here, there = run(load_reference(reference), two), apart(reference, two)
    assert here.failure == there.failure == ""
    for field in ("rotation", "position", "covariance", "nees", "nis", "bytes_per_second", "refused"):
        np.testing.assert_array_equal(getattr(here, field), getattr(there, field), field)


def test_failures_are_one_line(two: Recording, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "mine.py").write_text(FAULTY)
    with started(Isolated(f"{tmp_path / 'mine.py'}:Faulty")) as observer:
        failures = [run(observer, two).failure.partition(" s: ")[2] for _ in range(5)]
    assert failures[2].startswith("returned <object object at ")
    assert failures[:2] + failures[3:] == [
        "ZeroDivisionError: division by zero (mine.py:8)",
        "CoopenvError: update returned 'nothing', expected an Estimate",
        "CoopenvError: update returned 4, expected an Estimate",
        "its process ended with status 3",
    ]
    assert capfd.readouterr().out == ""


@pytest.mark.parametrize(("name", "why"), [("Babbles", "Expecting value.*"), ("Long", "bad message length")])
def test_answers_that_cannot_be_read_end_the_process(two: Recording, tmp_path: Path, name: str, why: str) -> None:
    (tmp_path / "mine.py").write_text(FAULTY)
    failure = apart(f"{tmp_path / 'mine.py'}:{name}", two).failure
    assert re.fullmatch(f"at vehicle_1 at [0-9.]+ s: {why}; its process ended with SIGKILL", failure)


def test_an_observer_that_ends_while_it_is_loaded_is_named(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text("import os\nos._exit(0)\nMine = 0\n")
    with pytest.raises(CoopenvError, match=r"mine\.py:Mine' cannot be loaded: its process ended with status 0$"):
        load(f"{tmp_path / 'mine.py'}:Mine")
