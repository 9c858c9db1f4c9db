"""NATS, as the authors' cars talk to each other: a topic's name with dots for slashes, the payload as it is."""

import asyncio
import base64
import binascii
import queue
import ssl
import threading
import time
import uuid
from collections.abc import Callable, Coroutine, Sequence
from contextlib import suppress
from typing import Any

from coopenv.base.errors import CoopenvError
from coopenv.cars.transport.base import (
    Address,
    Arrival,
    Callback,
    Certificates,
    LinkError,
    address_of,
    matcher,
    trouble_at,
)

ATTACHMENT = "Coopenv-Attachment"
"""Header, base64; the authors' connector looks at no headers."""


def subject_of(topic: str) -> str:
    """Return a topic's name on the wire."""
    return topic.replace("/", ".")


def topic_of(subject: str) -> str:
    """Return the topic of a name on the wire."""
    return subject.replace(".", "/")


def subjects_of(pattern: str) -> tuple[str, ...]:
    """Return subjects that hold at least what a pattern matches; NATS has no `**` but at the end, for one or more."""
    parts = pattern.split("/")
    if "**" not in parts:
        return (subject_of(pattern),)
    first = parts.index("**")
    before = ".".join(parts[:first])
    if not before:
        return (">",)
    alone = all(part == "**" for part in parts[first:])
    return (before, f"{before}.>") if alone else (f"{before}.>",)


def attachment_of(headers: dict[str, str] | None) -> bytes:
    """Return what is beside a message; nothing, if its header is none of ours."""
    try:
        return base64.b64decode((headers or {}).get(ATTACHMENT, ""), validate=True)
    except (binascii.Error, ValueError):
        return b""


PERIOD = 0.25  # s between two times
LEASE = 1.0  # s of silence after which a name counts as gone

Change = Callable[[str, bool], None]


class Presence:
    """Names announced by this end and by others, by heartbeats."""

    def __init__(self, send: Callable[[str, bytes], None], listen: Callable[[], None] = lambda: None) -> None:
        """Take what sends a heartbeat, (name, payload), and what begins to receive those of others."""
        self._send, self._listen, self._listening = send, listen, False
        self._self = uuid.uuid4().bytes  # two ends may announce one name, of which one goes
        self._own: list[str] = []
        self._last: dict[tuple[str, bytes], float] = {}
        self._watchers: list[tuple[Callable[[str], bool], Change]] = []
        self._lock = threading.RLock()

    def announce(self, name: str) -> None:
        """Announce `name` from now on."""
        with self._lock:
            self._own.append(name)
        self._send(name, b"+" + self._self)

    def watch(self, pattern: str, callback: Change) -> None:
        """Call back for every name that matches, now and when it comes or goes."""
        matches = matcher(pattern)
        with self._lock:
            self._watchers.append((matches, callback))
            for name in sorted({name for name, _ in self._last if matches(name)}):
                callback(name, True)
            first, self._listening = not self._listening, True
        if first:
            self._listen()

    def receive(self, name: str, payload: bytes) -> None:
        """Take a heartbeat."""
        who = name, payload[1:]
        with self._lock:
            if payload[:1] == b"+":
                new = all(known != name for known, _ in self._last)
                self._last[who] = time.monotonic()
                if new:
                    self._notify(name, True)
            elif self._last.pop(who, None) is not None:
                self._notify_if_gone(name)

    def beat(self) -> None:
        """Send the heartbeats and find silent names; to be called every `PERIOD`."""
        with self._lock:
            own, late = list(self._own), time.monotonic() - LEASE
            for who in [who for who, last in self._last.items() if last < late]:
                del self._last[who]
                self._notify_if_gone(who[0])
        for name in own:
            self._send(name, b"+" + self._self)

    def leave(self) -> None:
        """Send that this end leaves."""
        with self._lock:
            own, self._own = self._own, []
            self._watchers.clear()
        for name in own:
            self._send(name, b"-" + self._self)

    def _notify_if_gone(self, name: str) -> None:
        if all(known != name for known, _ in self._last):
            self._notify(name, False)

    def _notify(self, name: str, there: bool) -> None:
        for matches, callback in self._watchers:
            if matches(name):
                callback(name, there)


Letter = tuple[str, bytes, bytes]
"""A message in the outbox: topic, payload, attachment."""


class Outbox:
    """Two queues; used from any thread."""

    def __init__(self, most: int, patience: float) -> None:
        """Make it.

        Args:
            most: messages of each queue; then the oldest is dropped.
            patience: s that the sender of a reliable message waits before that.
        """
        self._patience = patience
        self._urgent, self._other = queue.Queue[Letter](most), queue.Queue[Letter](most)

    def put(self, letter: Letter, *, urgent: bool, patient: bool) -> None:
        """Add a message; if there is no room, a patient sender waits for some, and then the oldest goes."""
        letters = self._urgent if urgent else self._other
        while True:
            try:
                return letters.put(letter, patient, self._patience)
            except queue.Full:
                with suppress(queue.Empty):
                    letters.get_nowait()

    def take(self) -> Letter | None:
        """Return the next message; None: there is none."""
        for letters in (self._urgent, self._other):
            with suppress(queue.Empty):
                return letters.get_nowait()
        return None


HEARTBEATS = "presence/"
"""Topics of heartbeats; no topic of a car."""

MOST_WAITING = 1024  # messages to send, and received ones per subscription; then the oldest, or the new ones, are lost
PATIENCE = 1.0  # s
PENDING_BYTES = 131_072  # that the library may hold: what waits longer than a broker's hiccup is of no use

OPTIONS = {
    "max_reconnect_attempts": -1,
    "reconnect_time_wait": 0.2,
    "ping_interval": 1,
    "max_outstanding_pings": 2,
    "pending_size": PENDING_BYTES,
}


class Nats:
    """A connection to a broker as a transport; it lives in a thread of its own and comes back by itself."""

    def __init__(self) -> None:
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="nats", daemon=True)
        self._thread.start()
        self._client: Any = None
        self._outbox = Outbox(MOST_WAITING, PATIENCE)
        self._wake = asyncio.Event()
        self._presence = Presence(lambda name, payload: self.publish(HEARTBEATS + name, payload), self._hear)
        self.announce, self.watch = self._presence.announce, self._presence.watch
        self._closed = False

    def open(self, connect: Callable[[], Coroutine[Any, Any, Any]], timeout: float) -> None:
        """Connect within s; errors are the library's."""
        self._client = self._wait(asyncio.wait_for(connect(), timeout), timeout + 5.0)
        self._wait(self._start(), 5.0)

    async def _start(self) -> None:
        self._tasks = [asyncio.create_task(self._send()), asyncio.create_task(self._beat())]

    def publish(
        self, topic: str, payload: bytes, attachment: bytes = b"", *, urgent: bool = False, reliable: bool = False
    ) -> None:
        """Send, see `Transport`."""
        if self._closed:
            return
        patient = reliable and threading.current_thread() is not self._thread
        self._outbox.put((topic, payload, attachment), urgent=urgent or reliable, patient=patient)
        with suppress(RuntimeError):  # closed meanwhile
            self._loop.call_soon_threadsafe(self._wake.set)

    async def _send(self) -> None:
        while True:
            await self._wake.wait()
            self._wake.clear()
            while (letter := self._outbox.take()) is not None:
                if self._client.is_connected:  # else it is lost: it would be too old later
                    await self._post(letter)

    async def _post(self, letter: Letter) -> None:
        topic, payload, attachment = letter
        headers = {ATTACHMENT: base64.b64encode(attachment).decode()} if attachment else None
        with suppress(Exception):  # whatever keeps it from being sent, it is lost
            await self._client.publish(subject_of(topic), payload, headers=headers)

    async def _beat(self) -> None:
        while True:
            await asyncio.sleep(PERIOD)
            self._presence.beat()

    def subscribe(self, pattern: str, callback: Callback) -> None:
        """Subscribe, see `Transport`."""
        matches = matcher(pattern)

        async def arrive(message: Any) -> None:
            topic = topic_of(message.subject)
            if matches(topic) and not topic.startswith(HEARTBEATS):
                callback(Arrival(topic, message.data, time.time_ns(), attachment_of(message.headers)))

        self._listen(pattern, arrive)

    def _hear(self) -> None:
        async def receive(message: Any) -> None:
            self._presence.receive(topic_of(message.subject).removeprefix(HEARTBEATS), message.data)

        self._listen(HEARTBEATS + "**", receive)

    def _listen(self, pattern: str, arrive: Callable[[Any], Coroutine[Any, Any, None]]) -> None:
        async def subscribe() -> None:
            for subject in subjects_of(pattern):
                await self._client.subscribe(subject, cb=arrive, pending_msgs_limit=MOST_WAITING)
            await self._client.flush(PATIENCE)

        with suppress(Exception):  # the broker is away: the library subscribes when it is back
            self._wait(subscribe(), 2.0 * PATIENCE)

    def _wait(self, work: Coroutine[Any, Any, Any], timeout: float) -> Any:
        """Have the loop do something; wait for it, unless this is the loop's own thread."""
        future = asyncio.run_coroutine_threadsafe(work, self._loop)
        return None if threading.current_thread() is self._thread else future.result(timeout)

    def close(self) -> None:
        """End the connection and its thread."""
        if self._closed:
            return
        self._presence.leave()
        self._closed = True
        with suppress(Exception):
            self._wait(self._end(), 2.0 * PATIENCE)
        with suppress(Exception):  # what still waits for a silent broker
            self._wait(self._cancel(), PATIENCE)
        self._loop.call_soon_threadsafe(self._loop.stop)
        if threading.current_thread() is not self._thread:
            self._thread.join(PATIENCE)
            if not self._thread.is_alive():
                self._loop.close()

    async def _cancel(self) -> None:
        others = asyncio.all_tasks() - {asyncio.current_task()}
        for task in others:
            task.cancel()
        await asyncio.gather(*others, return_exceptions=True)

    async def _end(self) -> None:
        if self._client is None:
            return
        for task in self._tasks:
            task.cancel()
        while (letter := self._outbox.take()) is not None and self._client.is_connected:
            await self._post(letter)
        await self._client.close()


def open_nats(connect: Sequence[str], tls: Certificates | None = None, timeout: float = 2.0) -> Nats:
    """Connect to a broker.

    Args:
        connect: endpoints of one or of several brokers of a cluster, e.g. "nats/127.0.0.1:4222" or "tls/broker:4222".
        tls: certificates, for endpoints `tls/...`.
        timeout: s to wait for one of them.

    Raises:
        CoopenvError: the extra is not installed, or an endpoint is not one.
        LinkError: no broker answers.
    """
    addresses = [address_of(endpoint) for endpoint in connect]
    try:
        import nats
    except ImportError:
        raise CoopenvError("NATS needs an extra: pip install '.[nats]'") from None

    last: list[Exception] = []

    async def keep(error: Exception) -> None:
        """Keep the library from printing what it will try again."""
        last[:] = [error]

    context = tls.context() if tls else None
    servers = [f"{'tls' if address.protocol == 'tls' else 'nats'}://{address.authority}" for address in addresses]
    made = Nats()
    try:
        made.open(lambda: nats.connect(servers, error_cb=keep, tls=context, **OPTIONS), timeout)
    except Exception as error:  # the library's own, of the network, of TLS
        made.close()
        reason = _reason(last[0] if last else error, addresses)
        raise LinkError(f"{', '.join(connect)}: no NATS broker there ({reason})") from None
    return made


def _reason(error: Exception, addresses: Sequence[Address]) -> str:
    """Return why no broker has answered."""
    if isinstance(error, ssl.SSLCertVerificationError):
        return f"its certificate is refused: {error.verify_message}"
    troubles = (trouble_at(address, None, 1.0) for address in addresses)
    return next(filter(None, troubles), str(error) or "no answer in the language of NATS")
