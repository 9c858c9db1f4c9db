"""An observer in a process of its own, which holds neither truth nor seeds nor the judge.

The process is started anew, not forked. It receives setups, initial poses and ticks. It answers with JSON that holds
arrays as hexadecimal text: the parent unpickles no answer, and checks each estimate and message as usual.
"""

import io
import json
import os
import pickle
import re
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, fields
from functools import lru_cache, partial
from multiprocessing.connection import Connection
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from coopenv.base.errors import CoopenvError, shown
from coopenv.base.installation import file_digest
from coopenv.base.interrupts import end_with_parent
from coopenv.base.processes import ChildProcess
from coopenv.estimation.poses import Coordinates
from coopenv.observers.contract import Estimate, Factory, Message
from coopenv.observers.group import ObserverError, failure_text
from coopenv.observers.registry import find

MOST_ANSWERED = 1 << 24  # bytes of one answer
NUMBERS = re.compile(r"[<>|]?[biufc]\d{1,2}")  # types of arrays
METHODS = ("reset", "update", "message", "messages", "tampered")


@dataclass(frozen=True)
class Isolated:
    """An observer that runs in a process of its own, by its import path or its installed name."""

    reference: str


@contextmanager
def started(observer: str | Factory) -> Iterator[Any]:
    """Start the process of an `Isolated` observer and yield it as a factory; yield any other observer itself."""
    if not isinstance(observer, Isolated):
        yield observer
        return
    process = ObserverProcess(observer.reference)
    try:
        process.joint, process.digest = process.ask("load", observer.reference)
        yield process
    finally:
        process.end()


def load(reference: str) -> tuple[bool, str]:
    """Load an observer in a process that then ends; return whether it is a joint one, and the digest of its file.

    Raises:
        ObserverError: it cannot be loaded.
    """
    with started(Isolated(reference)) as process:
        return bool(process.joint), str(process.digest)


class ObserverProcess(ChildProcess):
    """The process of an observer, and the factory of one object per vehicle that stands for the observer in it."""

    def __init__(self, reference: str) -> None:
        super().__init__(_serve)
        self.reference, self.joint, self.digest = reference, False, ""

    def __call__(self, of: Any) -> SimpleNamespace:
        """Build the observer of a setup, or a joint one of several, see `contract.Observer` and `JointObserver`."""
        number, methods = self.ask("build", of)
        return SimpleNamespace(**{name: partial(self.ask, "call", number, name) for name in METHODS if name in methods})

    def ask(self, *request: Any) -> Any:
        """Return the answer of the process. Raises ObserverError: the observer has failed, or its process has ended."""
        data = io.BytesIO()
        _Pickler(data, pickle.HIGHEST_PROTOCOL).dump(request)
        try:
            self.pipe.send_bytes(data.getvalue())
            found, failure = json.loads(self.pipe.recv_bytes(MOST_ANSWERED), object_hook=_unpacked)
        except Exception as error:
            whose = f"'{self.reference}' cannot be loaded: " if request[0] == "load" else ""
            why = f"{error}; " if str(error) else ""
            raise ObserverError(f"{whose}{why}{self.end()}") from None
        if failure:
            raise ObserverError(" ".join(str(failure)[:1000].split()))
        return found


class _Pickler(pickle.Pickler):
    """Pickles requests. A message stays the same object in the process: some observers ask whether it is a new one."""

    def reducer_override(self, value: Any) -> Any:
        return (_message, (pickle.dumps(value),)) if isinstance(value, Message) else NotImplemented


@lru_cache(maxsize=1024)
def _message(pickled: bytes) -> Any:
    return pickle.loads(pickled)


def _packed(value: Any) -> dict[str, Any]:
    """Return a part of an answer for JSON. Raises CoopenvError: it is of no such kind."""
    if isinstance(value, Mapping):
        return dict(value)
    if isinstance(value, Coordinates):
        return {"Coordinates": value.value}
    for kind in (Estimate, Message):
        if isinstance(value, kind):
            return {kind.__name__: {field.name: getattr(value, field.name) for field in fields(kind)}}
    array = np.asarray(value)
    if array.dtype.kind not in "biufc":
        raise CoopenvError(f"returned {shown(value)}, which is neither an estimate, a message nor an array of numbers")
    return {"array": [array.dtype.str, array.shape, array.tobytes().hex()]}


def _unpacked(packed: dict[str, Any]) -> Any:
    """Return the value of `_packed`."""
    match packed:
        case {"array": [kind, shape, text]} if NUMBERS.fullmatch(kind):
            return np.ndarray(shape, np.dtype(kind), bytes.fromhex(text))
        case {"Coordinates": name}:
            return Coordinates(name)
        case {"Estimate": values}:
            return Estimate(**values)
        case {"Message": values}:
            return Message(**values)
    return packed


class _Served:
    """The observers of this process."""

    def load(self, reference: str) -> tuple[bool, str]:
        self.factory, self.observers = find(reference), list[Any]()
        source = getattr(sys.modules[self.factory.__module__], "__file__", None)
        return bool(getattr(self.factory, "joint", False)), file_digest(Path(source)) if source else ""

    def build(self, of: Any) -> tuple[int, list[str]]:
        self.observers.append(self.factory(of))
        return len(self.observers) - 1, [name for name in METHODS if hasattr(self.observers[-1], name)]

    def call(self, number: int, method: str, *arguments: Any) -> Any:
        return getattr(self.observers[number], method)(*arguments)


def _serve(pipe: Connection) -> None:
    """Answer the parent until it closes the pipe. Whatever the observer prints goes to standard error."""
    end_with_parent()
    os.dup2(2, 1)
    sys.modules["coopenv.bench"] = None  # type: ignore[assignment]  # so that it is not imported by accident
    served = _Served()
    with suppress(EOFError):
        while True:
            name, *arguments = pipe.recv()
            try:
                answer = json.dumps([getattr(served, name)(*arguments), ""], default=_packed)
            except BaseException as error:
                text = str(error) if isinstance(error, CoopenvError) else failure_text(error)
                answer = json.dumps([None, text])
            pipe.send_bytes(answer.encode())
