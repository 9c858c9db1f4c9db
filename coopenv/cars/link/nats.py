"""NATS, as the authors' cars talk to each other: a topic's name with dots for slashes, the payload as it is."""

import asyncio
import base64
import ssl
import threading
import time
from collections import deque
from collections.abc import Callable, Coroutine, Sequence
from concurrent.futures import Future
from contextlib import suppress
from typing import Any, Unpack

from coopenv.base.installation import install_command, needing
from coopenv.cars.link.transport import (
    Arrival,
    Callback,
    HeartbeatTransport,
    LinkError,
    Tls,
    address_of,
    first_trouble,
    matcher,
)
from coopenv.cars.settings.profile import Way

ATTACHMENT = "Coopenv-Attachment"
"""Header, base64; the authors' connector looks at no headers."""


def subject_of(topic: str) -> str:
    """Return a topic's name on the wire."""
    return topic.replace("/", ".")


def subjects_of(pattern: str) -> tuple[str, ...]:
    """Return subjects that hold at least what a pattern matches; NATS has no `**` but at the end, for one or more."""
    parts = pattern.split("/")
    if "**" not in parts:
        return (subject_of(pattern),)
    before = ".".join(parts[: parts.index("**")])
    return (before, f"{before}.>") if before else (">",)


def attachment_of(headers: dict[str, str] | None) -> bytes:
    """Return the attachment of a message; nothing, if its header is foreign."""
    try:
        return base64.b64decode((headers or {}).get(ATTACHMENT, ""), validate=True)
    except ValueError:
        return b""


Letter = tuple[str, bytes, bytes]
"""A message in the outbox: topic, payload, attachment."""

POLL = 0.002  # s


class Outbox:
    """Two queues; used from any thread."""

    def __init__(self, most: int) -> None:
        """Make it for so many messages of each queue; then the oldest is dropped."""
        self._urgent, self._other = (deque[Letter](maxlen=most) for _ in range(2))

    def put(self, letter: Letter, *, urgent: bool, patience: float = 0.0) -> None:
        """Add a message; if there is no room, the sender waits for some, s at most, and then the oldest goes."""
        letters, give_up = self._urgent if urgent else self._other, time.monotonic() + patience
        while len(letters) == letters.maxlen and time.monotonic() < give_up:
            time.sleep(POLL)
        letters.append(letter)

    def take(self) -> Letter | None:
        """Return the next message; None: there is none."""
        with suppress(IndexError):
            return (self._urgent or self._other).popleft()
        return None


HEARTBEATS = "presence/"
"""Topics of heartbeats; no topic of a car."""

MOST_WAITING = 1024  # messages to send, and received ones per subscription; then the oldest, or the new ones, are lost
PATIENCE = 1.0  # s that the sender of a reliable message waits for room
PENDING_BYTES = 131_072  # that the library may hold: what waits longer than a broker's hiccup is of no use

OPTIONS = {
    "max_reconnect_attempts": -1,
    "reconnect_time_wait": 0.2,
    "ping_interval": 1,
    "max_outstanding_pings": 2,
    "pending_size": PENDING_BYTES,
}


class Nats(HeartbeatTransport):
    """A connection to a broker as a transport; it lives in a thread of its own and comes back by itself."""

    def __init__(self) -> None:
        super().__init__()
        self._outbox = Outbox(MOST_WAITING)
        self._opened: Future[None] = Future()

    def open(self, connect: Callable[[], Coroutine[Any, Any, Any]], timeout: float) -> None:
        """Connect within s; errors are the library's."""
        self._thread = threading.Thread(target=asyncio.run, args=(self._live(connect, timeout),), daemon=True)
        self._thread.start()
        self._opened.result(timeout + 5.0)
        threading.Thread(target=self._beat_on, name="presence", daemon=True).start()

    async def _live(self, connect: Callable[[], Coroutine[Any, Any, Any]], timeout: float) -> None:
        """Connect, and send until the end."""
        self._loop, self._wake = asyncio.get_running_loop(), asyncio.Event()
        self._task: Any = asyncio.current_task()
        try:
            self._client = await asyncio.wait_for(connect(), timeout)
        except Exception as error:
            self._opened.set_exception(error)
            return
        self._opened.set_result(None)
        with suppress(Exception, asyncio.CancelledError):  # of `_end`, where a broker is silent
            while not self._closed.is_set() or self._wake.is_set():
                await self._wake.wait()
                self._wake.clear()
                while (letter := self._outbox.take()) is not None:
                    if self._client.is_connected:  # else it is lost: it would be too old later
                        await self._post(letter)
            await self._client.close()

    def publish(self, topic: str, payload: bytes, attachment: bytes = b"", **way: Unpack[Way]) -> None:
        """Send, see `Transport`."""
        if self._closed.is_set():
            return
        reliable = way.get("reliable", False)
        patience = PATIENCE if reliable and threading.current_thread() is not self._thread else 0.0
        self._outbox.put((topic, payload, attachment), urgent=reliable or way.get("urgent", False), patience=patience)
        self._call(self._wake.set)

    def _call(self, act: Callable[[], object]) -> None:
        with suppress(RuntimeError):  # closed meanwhile
            self._loop.call_soon_threadsafe(act)

    async def _post(self, letter: Letter) -> None:
        topic, payload, attachment = letter
        headers = {ATTACHMENT: base64.b64encode(attachment).decode()} if attachment else None
        with suppress(Exception):  # whatever keeps it from being sent, it is lost
            await self._client.publish(subject_of(topic), payload, headers=headers)

    def subscribe(self, pattern: str, callback: Callback) -> None:
        """Subscribe, see `Transport`."""
        matches = matcher(pattern)

        def arrive(arrival: Arrival) -> None:
            if matches(arrival.topic) and not arrival.topic.startswith(HEARTBEATS):
                callback(arrival)

        self._listen(pattern, arrive)

    def _send_heartbeat(self, name: str, payload: bytes) -> None:
        self.publish(HEARTBEATS + name, payload)

    def _receive_heartbeats(self) -> None:
        self._listen(f"{HEARTBEATS}**", lambda a: self.heartbeat(a.topic.removeprefix(HEARTBEATS), a.payload))

    def _listen(self, pattern: str, callback: Callback) -> None:
        async def arrive(message: Any) -> None:
            topic = message.subject.replace(".", "/")
            callback(Arrival(topic, message.data, time.time_ns(), attachment_of(message.headers)))

        async def subscribe() -> None:
            for subject in subjects_of(pattern):
                await self._client.subscribe(subject, cb=arrive, pending_msgs_limit=MOST_WAITING)
            await self._client.flush(PATIENCE)

        with suppress(Exception):  # the broker is away: the library subscribes when it is back
            future = asyncio.run_coroutine_threadsafe(subscribe(), self._loop)
            if threading.current_thread() is not self._thread:
                future.result(2.0 * PATIENCE)

    def _end(self) -> None:
        self._closed.set()
        self._call(self._wake.set)
        if threading.current_thread() is self._thread:
            return
        self._thread.join(2.0 * PATIENCE)
        if self._thread.is_alive():  # what still waits for a silent broker
            self._call(self._task.cancel)
            self._thread.join(PATIENCE)


def open_nats(connect: Sequence[str], tls: Tls | None = None, timeout: float = 2.0) -> Nats:
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
    with needing(f"NATS needs an extra: {install_command('nats')}"):
        import nats

    last: list[Exception] = []

    async def keep(error: Exception) -> None:
        """Suppress the library's messages about attempts that it repeats."""
        last[:] = [error]

    context = tls.context() if tls else None
    servers = [f"{'tls' if address.protocol == 'tls' else 'nats'}://{address.authority}" for address in addresses]
    made = Nats()
    try:
        made.open(lambda: nats.connect(servers, error_cb=keep, tls=context, **OPTIONS), timeout)
    except Exception as error:  # the library's own, of the network, of TLS
        made.close()
        cause = last[0] if last else error
        if isinstance(cause, ssl.SSLCertVerificationError):
            reason = f"its certificate is refused: {cause.verify_message}"
        else:
            reason = first_trouble(connect, None, str(cause) or "no answer in the language of NATS")
        raise LinkError(f"{', '.join(connect)}: no NATS broker there ({reason})") from None
    return made
