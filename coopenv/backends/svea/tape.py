"""What goes over the network, written to an MCAP file as it comes, and marks of when ticks were made of it.

The file is a ROS 2 bag that other tools read: every message stands under its own topic and type. What goes beyond that
is the topic `coopenv/tick` and an attachment that says which fleet and environment it was; with both, a replay makes
the same ticks again, bit for bit (`coopenv.backends.svea.drive`).
"""

import queue
import threading
import time
from collections.abc import Mapping
from pathlib import Path

from coopenv.errors import CoopenvError, OutputError
from coopenv.files import writing
from coopenv.shipped import version
from coopenv.svea.codec import encode, header, make, ros2
from coopenv.svea.definitions import TICK
from coopenv.svea.topics import TICK_TOPIC
from coopenv.svea.transport.base import Transport

FORMAT = "coopenv drive 1"
NAME = "coopenv-drive"
ATTACHMENT = "drive.json"


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
        self._types = {**types, TICK_TOPIC: TICK}
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}
        self._sequence = 0
        with writing(path):
            self._stream = path.open("xb")
        self._writer = Writer(self._stream)
        self._writer.start(profile="ros2", library=f"coopenv {version()}")
        self._writer.add_metadata(NAME, {"format": FORMAT, "version": version()})
        self._writer.add_attachment(0, 0, ATTACHMENT, "application/json", head)
        self._queue: queue.SimpleQueue[tuple[str, bytes, int] | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._write_all, name="coopenv tape", daemon=True)
        self._thread.start()

    def begin(self, now: int, key: int, episode: int) -> None:
        """Mark that tick 0 of an episode was made at a time in ns; key and episode fix what was drawn."""
        self._mark(0, now, key, episode)

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

    def close(self) -> None:
        """Write what is left and close the file."""
        self._queue.put(None)
        self._thread.join()
        self._writer.finish()
        self._stream.close()

    def _write_all(self) -> None:
        while (item := self._queue.get()) is not None:
            topic, payload, now = item
            self._sequence += 1
            self._writer.add_message(self._channel(topic), now, payload, now, self._sequence % 2**32)

    def _channel(self, topic: str) -> int:
        if topic not in self._channels:
            kind = self._types[topic]
            if kind not in self._schemas:
                text, _ = ros2().generate_msgdef(kind, ros_version=2)
                self._schemas[kind] = self._writer.register_schema(kind, "ros2msg", text.encode())
            self._channels[topic] = self._writer.register_channel(f"/{topic}", "cdr", self._schemas[kind])
        return self._channels[topic]


class Taped:
    """A transport whose outgoing messages are written to a tape as well."""

    def __init__(self, transport: Transport, tape: Tape) -> None:
        """Wrap a transport."""
        self._transport, self._tape = transport, tape
        self.subscribe, self.announce = transport.subscribe, transport.announce
        self.watch, self.close = transport.watch, transport.close

    def publish(
        self, topic: str, payload: bytes, attachment: bytes = b"", *, urgent: bool = False, reliable: bool = False
    ) -> None:
        """Send, see `Transport`, and write down."""
        self._transport.publish(topic, payload, attachment, urgent=urgent, reliable=reliable)
        self._tape.write(topic, payload, time.time_ns())
