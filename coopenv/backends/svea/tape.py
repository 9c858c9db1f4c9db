"""What goes over the network, written to an MCAP file as it comes, and marks of when ticks were made of it.

The file is a ROS 2 bag that other tools read: every message stands under its own topic and type. What goes beyond that
is the topic `coopenv/tick` and an attachment that says which fleet and environment it was; with both, a replay makes
the same ticks again, bit for bit (`coopenv.backends.svea.drive`). `coopenv/stopped` tells why the watchdog stopped the
cars.
"""

import queue
import threading
import time
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

from coopenv.errors import CoopenvError, OutputError
from coopenv.files import writing
from coopenv.shipped import version
from coopenv.svea.codec import encode, header, make, ros2
from coopenv.svea.definitions import STOPPED, TICK
from coopenv.svea.topics import STOPPED_TOPIC, TICK_TOPIC

FORMAT = "coopenv drive 1"
NAME = "coopenv-drive"
ATTACHMENT = "drive.json"

FLUSH = 0.5
"""s after which at the latest the system has what was written: so much is lost if the process is killed."""


class Tape:
    """A file under way; a thread of its own writes, so that no tick waits for a disk."""

    def __init__(self, path: Path, head: bytes, types: Mapping[str, str]) -> None:
        """Open a file.

        Args:
            path: of the file, which must not be there.
            head: what the replay has to know.
            types: type of every topic.

        Raises:
            OutputError: the file is there, or cannot be written.
            CoopenvError: the extra is not installed.
        """
        try:
            from mcap.writer import Writer
        except ImportError:
            raise CoopenvError("recording cars needs an extra: pip install '.[svea]'") from None
        if path.suffix != ".mcap":
            raise OutputError(f"{path}: the name must end in .mcap")
        if path.exists():
            raise OutputError(f"{path}: exists already")
        self._path, self._types = path, {**types, TICK_TOPIC: TICK, STOPPED_TOPIC: STOPPED}
        self.begun = False
        """Whether an episode has begun: without one there is nothing to replay."""
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}
        self._sequence = 0
        self._error: OSError | None = None
        with writing(path):
            self._stream = path.open("xb")
            self._writer = Writer(self._stream)
            self._writer.start(profile="ros2", library=f"coopenv {version()}")
            self._writer.add_metadata(NAME, {"format": FORMAT, "version": version()})
            self._writer.add_attachment(0, 0, ATTACHMENT, "application/json", head)
            self._stream.flush()
        _stopped("", "", 0)  # the first message of a type takes long, and this one must not
        self._queue: queue.SimpleQueue[tuple[str, bytes, int] | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._write_all, name="coopenv tape", daemon=True)
        self._thread.start()

    def begin(self, now: int, key: int, episode: int) -> None:
        """Mark that tick 0 of an episode was made at a time in ns; key and episode fix what was drawn."""
        self._mark(0, now, key, episode)
        self.begun = True

    def tick(self, index: int, now: int) -> None:
        """Mark that a tick was made at a time in ns of what had come before."""
        self._mark(index, now, 0, 0)

    def _mark(self, index: int, now: int, key: int, episode: int) -> None:
        message = make(TICK, header=header(now), index=index, key=key, episode=episode)
        self._queue.put((TICK_TOPIC, encode(message), now))

    def write(self, topic: str, payload: bytes, now: int) -> None:
        """Write a message that came, or went, at a time in ns; of unknown topics none are."""
        if topic in self._types:
            self._queue.put((topic, payload, now))

    def stopped(self, reason: str, car: str, now: int) -> None:
        """Write why the watchdog stopped the cars at a time in ns, and whose fault it was; that cannot get lost."""
        self._queue.put((STOPPED_TOPIC, _stopped(reason, car, now), now))

    def close(self) -> None:
        """Write what is left and close the file; one without an episode is removed.

        Raises:
            OutputError: it could not be written to the end; what stands in it can be replayed.
        """
        self._queue.put(None)
        self._thread.join()
        try:
            with writing(self._path):
                if self._error is not None:
                    raise self._error
                self._writer.finish()
                self._stream.flush()
        finally:
            with suppress(OSError):
                self._stream.close()
            if not self.begun:
                self._path.unlink(missing_ok=True)

    def _write_all(self) -> None:
        due = time.monotonic() + FLUSH
        try:
            while (item := self._next(due)) is not None:
                topic, payload, now = item
                if topic:
                    self._sequence += 1
                    self._writer.add_message(self._channel(topic), now, payload, now, self._sequence % 2**32)
                if topic == STOPPED_TOPIC or time.monotonic() >= due:
                    self._writer.flush()
                    due = time.monotonic() + FLUSH
        except OSError as error:  # the disk is full: nothing more is written, but nor does the memory fill
            self._error = error
            while self._queue.get() is not None:
                pass

    def _next(self, until: float) -> tuple[str, bytes, int] | None:
        """Return what is to be written next; nothing, without a topic, where nothing comes until then."""
        try:
            return self._queue.get(timeout=max(0.0, until - time.monotonic()))
        except queue.Empty:
            return "", b"", 0

    def _channel(self, topic: str) -> int:
        if topic not in self._channels:
            kind = self._types[topic]
            if kind not in self._schemas:
                text, _ = ros2().generate_msgdef(kind, ros_version=2)
                self._schemas[kind] = self._writer.register_schema(kind, "ros2msg", text.encode())
            self._channels[topic] = self._writer.register_channel(f"/{topic}", "cdr", self._schemas[kind])
        return self._channels[topic]


def _stopped(reason: str, car: str, now: int) -> bytes:
    return encode(make(STOPPED, header=header(now), reason=reason, car=car))
