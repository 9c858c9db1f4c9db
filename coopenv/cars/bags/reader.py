"""The reader process: libraries unpack foreign files in a child with limits of memory, time and files.

What the child yields comes back as numbers, texts and bytes through a pipe. A crash, a loop or a want of memory of a
library ends the child, and is one line of the program. Reading is in the program where the system has no such limits.
"""

import faulthandler
import gc
import json
import os
import resource
import signal
import struct
import sys
import warnings
from collections.abc import Callable, Generator, Iterator
from pathlib import Path
from typing import BinaryIO, NoReturn

from coopenv.base.errors import error_text
from coopenv.cars.bags.definitions import BagChannel
from coopenv.sources.mcap_container import TooLargeError

MEMORY = 2**30
"""Bytes that the child may take beyond the memory of the program, from which it begins."""
SECONDS, SECONDS_PER_BYTE = 60, 2e-6
"""CPU time of the child, and more of it for the bytes of the files: the usual speed is over ten times that."""
APART = sys.platform == "linux"
"""Whether there is a child."""
LARGEST = 2**27  # bytes of a record; a frame of 2^25 pixels has three colours

Record = tuple[BagChannel, int, bytes | None]
"""Channel, time of reception (ns), bytes; None: the channel alone, or a message whose bytes are not wanted."""

HEAD = struct.Struct("<cIqI")  # kind, number of the channel, time, bytes that follow
CHANNEL, BYTES, NOTHING, ERROR, END = b"C", b"B", b"N", b"E", b"."


class ReaderError(ValueError):
    """The reader process has ended before the file, or has raised an error of the subclass's name."""


def in_reader(make: Callable[[], Iterator[Record]], size: int) -> Iterator[Record]:
    """Yield the records that a generator makes in a child process.

    Args:
        make: makes the generator, in the child.
        size: bytes of the files.

    Raises:
        ReaderError: the child has crashed, or exceeded its limits.
        TooLargeError: the generator raised it; other errors of it are raised as a ReaderError of that name.
    """
    if not APART:
        yield from make()
        return
    receive, send = os.pipe()
    with warnings.catch_warnings(action="ignore", category=DeprecationWarning):  # of forks beside other threads
        child = os.fork()
    if child == 0:
        os.close(receive)
        _run_child(make, send, size)
    os.close(send)
    try:
        with os.fdopen(receive, "rb", buffering=2**16) as stream:
            finished = yield from _received(stream)
    finally:
        os.kill(child, signal.SIGKILL)
        _, status = os.waitpid(child, 0)
    if not finished:
        code = os.waitstatus_to_exitcode(status)
        why = signal.Signals(-code).name if code < 0 else f"status {code}"
        raise ReaderError(f"the process that reads the file ended by {why}")


def _received(stream: BinaryIO) -> Generator[Record, None, bool]:
    """Yield the records of a child; return whether it came to an end."""
    channels: list[BagChannel] = []
    while len(head := stream.read(HEAD.size)) == HEAD.size:
        kind, number, time, size = HEAD.unpack(head)
        if kind == END:
            return True
        data = stream.read(size) if size <= LARGEST else b""
        if len(data) < size or (kind in (BYTES, NOTHING) and number >= len(channels)):
            break
        if kind == CHANNEL:
            channels.append(BagChannel(*map(str, json.loads(data))))
        elif kind == ERROR:
            name, text = json.loads(data)
            raise (TooLargeError if name == TooLargeError.__name__ else type(name, (ReaderError,), {}))(text)
        else:
            yield channels[number], time, data if kind == BYTES else None
    return False


def _run_child(make: Callable[[], Iterator[Record]], send: int, size: int) -> NoReturn:
    """Send the records of a generator, and end the process."""
    status = 1
    try:
        faulthandler.disable()
        gc.freeze()
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        _limit(size)
        with os.fdopen(send, "wb", buffering=2**16) as stream:
            _send_all(make, stream)
        status = 0
    finally:  # whatever is raised: nothing of the program may run here
        os._exit(status)


def _limit(size: int) -> None:
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    seconds = round(SECONDS + SECONDS_PER_BYTE * size)
    memory = pages * resource.getpagesize() + MEMORY
    for limit, most in ((resource.RLIMIT_AS, memory), (resource.RLIMIT_CPU, seconds), (resource.RLIMIT_CORE, 0)):
        hard = resource.getrlimit(limit)[1]
        most = most if hard == resource.RLIM_INFINITY else min(most, hard)
        resource.setrlimit(limit, (most, most))
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))  # it writes no file


def _send_all(make: Callable[[], Iterator[Record]], stream: BinaryIO) -> None:
    numbers: dict[BagChannel, int] = {}
    try:
        for channel, time, data in make():
            if channel not in numbers:
                numbers[channel] = len(numbers)
                _send(stream, CHANNEL, 0, 0, json.dumps(channel).encode())
            kind = NOTHING if data is None else BYTES
            _send(stream, kind, numbers[channel], max(-(2**63), min(time, 2**63 - 1)), data or b"")
    except Exception as error:
        name, text = type(error).__name__, error_text(error).partition(": ")[2]
        _send(stream, ERROR, 0, 0, json.dumps((name, text)).encode())
    else:
        _send(stream, END, 0, 0, b"")


def _send(stream: BinaryIO, kind: bytes, number: int, time: int, data: bytes) -> None:
    stream.write(HEAD.pack(kind, number, time, len(data)))
    stream.write(data)
