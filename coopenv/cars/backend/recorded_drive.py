"""A recorded drive of cars in their place: the same messages, the same ticks.

The file is a ROS 2 bag that other tools read: every message stands under its own topic and type. What goes beyond that
is the topic `coopenv/tick` and an attachment with the fleet and the environment. With both, a replay makes the
same ticks again, bit for bit. `coopenv/stopped` gives the reason for which the watchdog stopped the cars.
"""

import json
import queue
import threading
import time
import warnings
from collections.abc import Iterable, Mapping
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Unpack

from coopenv.base.errors import CoopenvError, DataError, DataWarning, OutputError
from coopenv.base.files import writing
from coopenv.base.installation import install_command, version
from coopenv.cars.backend.assembler import Assembler, Intake
from coopenv.cars.backend.binding import OPTIONS, Binding, bind, reset_options
from coopenv.cars.backend.sources import DRIVE_METADATA
from coopenv.cars.backend.station import refusal
from coopenv.cars.link.transport import Arrival, Transport
from coopenv.cars.messages.codec import STOPPED, TICK, decode, encode, header, make, stamp_of
from coopenv.cars.settings.deployment import Deployment, parse_deployment
from coopenv.cars.settings.profile import STOPPED_TOPIC, TICK_TOPIC, Way, presence_of
from coopenv.scenario import parse_scenario
from coopenv.scenario.files import override
from coopenv.scenario.own_terms import without_own_terms
from coopenv.sources.base import Capabilities, TickGenerator, TickStream
from coopenv.sources.mcap_format import CUT_OFF, RosLog, codec, reading

FORMAT = "coopenv drive 1"
ATTACHMENT = "drive.json"
MARKS = {TICK_TOPIC: TICK, STOPPED_TOPIC: STOPPED}
"""Types of the messages of ticks and stops, by topic."""

FLUSH = 0.5
"""Longest time (s) until records reach the system; a killed process loses no more."""


class DriveRecorder:
    """Writes a drive into a file, in a thread of its own, so that no tick waits for the disk."""

    def __init__(self, path: Path, head: bytes, types: Mapping[str, str]) -> None:
        """Open a file.

        Args:
            path: of the file, which must not be there.
            head: fleet and environment, for the replay.
            types: type of every topic.

        Raises:
            OutputError: the file is there, or cannot be written.
            CoopenvError: the extra is not installed.
        """
        if find_spec("mcap") is None:
            raise CoopenvError(f"recording cars needs an extra: {install_command('svea')}")
        if path.suffix != ".mcap":
            raise OutputError(f"{path}: the name must end in .mcap")
        if path.exists():
            raise OutputError(f"{path}: exists already")
        self._path, self._types = path, {**types, **MARKS}
        self.begun = False
        """True after the first episode has begun: before it there is nothing to replay."""
        self._sequence = 0
        self._error: OSError | None = None
        with writing(path):
            self._stream = path.open("xb")
            self._log = RosLog(self._stream)
            self._writer = self._log.writer
            self._writer.add_metadata(DRIVE_METADATA, {"format": FORMAT, "version": version()})
            self._writer.add_attachment(0, 0, ATTACHMENT, "application/json", head)
            self._stream.flush()
        encode(make(STOPPED))  # the first message of a type takes long, and this one must not
        self._queue: queue.SimpleQueue[tuple[str, bytes, int] | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._write_all, name="coopenv recorder", daemon=True)
        self._thread.start()

    def tick(self, index: int, now: int, key: int = 0, episode: int = 0) -> None:
        """Mark that a tick was made at a time in ns from the earlier messages.

        With tick 0 an episode begins; its key and number fix what was drawn.
        """
        message = make(TICK, header=header(now), index=index, key=key, episode=episode)
        self._queue.put((TICK_TOPIC, encode(message), now))
        self.begun |= index == 0

    def write(self, topic: str, payload: bytes, now: int) -> None:
        """Write a message that came, or went, at a time in ns; of unknown topics none are."""
        if topic in self._types:
            self._queue.put((topic, payload, now))

    def stopped(self, reason: str, car: str, now: int) -> None:
        """Write the reason and the car for which the watchdog stopped the cars at a time in ns, and flush."""
        message = make(STOPPED, header=header(now), reason=reason, car=car)
        self._queue.put((STOPPED_TOPIC, encode(message), now))

    def close(self) -> None:
        """Write the rest and close the file; a file without an episode is removed.

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
            while True:
                try:
                    item = self._queue.get(timeout=max(0.0, due - time.monotonic()))
                except queue.Empty:
                    item = "", b"", 0
                if item is None:
                    return
                topic, payload, now = item
                if topic:
                    self._sequence += 1
                    channel = self._log.channel(f"/{topic}", self._types[topic])
                    self._writer.add_message(channel, now, payload, now, self._sequence % 2**32)
                if topic == STOPPED_TOPIC or time.monotonic() >= due:
                    self._writer.flush()
                    due = time.monotonic() + FLUSH
        except OSError as error:  # the disk is full: nothing more is written, but nor does the memory fill
            self._error = error
            while self._queue.get() is not None:
                pass


def head_of(deployment: Deployment, binding: Binding, only: str | None) -> bytes:
    """Return the description of the fleet in a recorded drive: JSON."""
    head = {
        "deployment": deployment.model_dump(mode="json", exclude={"security", "network"}),
        "scenario": binding.scenario.model_dump(mode="json"),
        "only": only,
    }
    return json.dumps(head).encode()


class Drive(TickGenerator):
    """A drive as a backend: actions change nothing. Every reset goes on to its next episode, and round again.

    Of one whose end is missing, as the process that wrote it was killed, what is whole is replayed.
    """

    options = OPTIONS

    def __init__(self, path: str | Path, overrides: Mapping[str, Any] | None = None) -> None:
        """Open a file that `coopenv svea run --record` has written.

        Args:
            path: the file.
            overrides: dotted keys of its environment, for example another observer's name.

        Raises:
            DataError: it is none, or is damaged.
            CoopenvError: an override is not valid, or the extra is missing.
        """
        codec()  # its error names the missing extra
        from coopenv.sources.mcap_container import Container

        self._where = str(path)
        with reading(self._where):
            container = Container(Path(path), truncated=True)
            metadata, attachments = container.extras()
        nothing = f"{path}: {f'{CUT_OFF}, and ' if container.cut_off else ''}no episode begins in it"
        if container.cut_off and ATTACHMENT not in attachments:
            raise DataError(nothing)
        if metadata.get(DRIVE_METADATA, {}).get("format") != FORMAT or ATTACHMENT not in attachments:
            raise DataError(f"{path}: no recorded drive of coopenv (format '{FORMAT}')")
        self._deployment, self.binding = self._read_head(attachments[ATTACHMENT], overrides or {})
        with reading(self._where):
            self._messages: list[Any] = []
            """Arrivals, and decoded marks of ticks and stops among them."""
            for channel, _, message in container.messages():
                topic = channel.topic.lstrip("/")
                kind, data = MARKS.get(topic), bytes(message.data)
                self._messages.append(decode(data, kind) if kind else Arrival(topic, data, message.log_time))
        indices = [m.index for m in self._messages if not isinstance(m, Arrival) and m.__msgtype__ == TICK]
        if 0 not in indices:
            raise DataError(nothing)
        if container.cut_off:
            times = [m.received if isinstance(m, Arrival) else stamp_of(m) for m in self._messages]
            over = f"nothing after {(max(times) - min(times)) * 1e-9:.1f} s is replayed"
            warnings.warn(f"{path}: {CUT_OFF}: {over}", DataWarning, stacklevel=2)
        self._episodes, self._next = indices.count(0), 0
        self.drawn = (0, 0)
        self.stopped = ""
        local = self.binding.local if self.binding.remote else None
        truth, ticks = self._deployment.sensors.truth, max(indices) + 1
        super().__init__(
            self.binding.scenario,
            Capabilities(truth, False, False, ticks, batched=False, recorded=True, estimated=local),
        )

    def _read_head(self, text: bytes, overrides: Mapping[str, Any]) -> tuple[Deployment, Binding]:
        try:
            head = json.loads(text)
            raw, given, only = head["scenario"], head["deployment"], head["only"]
        except (ValueError, TypeError, LookupError):
            raise DataError(f"{self._where}: {ATTACHMENT} is damaged") from None
        raw = without_own_terms(raw)
        override(raw, overrides)
        scenario = parse_scenario(raw, f"{self._where}: {ATTACHMENT}")
        deployment = parse_deployment(given, Path(self._where))
        return deployment, bind(scenario, deployment.cars, deployment.markers, self._where, only, deployment.profile)

    def episode(self, seed: int | None, options: Mapping[str, Any]) -> TickStream:
        """Go through the messages from the begin, yielding the ticks of one episode; `arm` has no effect."""
        reset_options(options)
        wanted, self._next = self._next, (self._next + 1) % self._episodes
        intake, assembler = Intake(self.binding, self._deployment.sensors), Assembler(self.binding)
        number, self.stopped = -1, ""
        for message in self._messages:
            if isinstance(message, Arrival):
                for sample in intake.samples(message):
                    assembler.put(sample)
                continue
            if message.__msgtype__ == STOPPED:
                self.stopped = message.reason if number == wanted else ""
                continue
            if message.index == 0:
                number += 1
                if number > wanted:
                    return
                self.drawn = message.key, message.episode
                tick = assembler.begin(stamp_of(message))
            else:
                tick = assembler.tick(message.index, stamp_of(message))
            if number == wanted:
                yield tick


PRESENCE = "std_msgs/msg/Bool"
"""Type of messages of presence in a recorded drive, under the names of the tokens."""


class RecordedTransport:
    """A transport of which all that is sent, presence and some topics are recorded, in the thread of each message.

    Messages of which ticks are made are recorded by the backend, in the order in which it takes them.
    """

    def __init__(self, transport: Transport, recorder: DriveRecorder, aside: Iterable[str] = ()) -> None:
        """Wrap a transport; what comes on topics `aside`, of which no ticks are made, is written at once."""
        self._transport, self._recorder, self.clock = transport, recorder, transport.clock
        self.subscribe, self.announce, self.watch = transport.subscribe, transport.announce, transport.watch
        self.close = transport.close
        for topic in aside:
            transport.subscribe(topic, self._write_aside)
        transport.watch(presence_of("*"), self._write_presence)

    def publish(self, topic: str, payload: bytes, attachment: bytes = b"", **way: Unpack[Way]) -> None:
        """Send, see `Transport`, and record the message."""
        self._transport.publish(topic, payload, attachment, **way)
        self._recorder.write(topic, payload, self.clock.wall())

    def _write_aside(self, arrival: Arrival) -> None:
        if not refusal(arrival):
            self._recorder.write(arrival.topic, arrival.payload, arrival.received)

    def _write_presence(self, name: str, there: bool) -> None:
        self._recorder.write(name, encode(make(PRESENCE, data=there)), self.clock.wall())
