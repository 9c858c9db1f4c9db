"""Transports carry bytes by topic between processes: one protocol, several networks. Endpoints and certificates.

Endpoints are written as Zenoh writes them.
"""

import ipaddress
import re
import socket
import ssl
import stat
import threading
import time
import uuid
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, Self, Unpack

from pydantic import model_validator

from coopenv.base.errors import CoopenvError, listed, shown
from coopenv.base.sections import Section
from coopenv.cars.link.clock import CLOCK, Clock
from coopenv.cars.settings.profile import Way


class LinkError(CoopenvError):
    """The network, or a process on it, cannot be reached."""


@dataclass(frozen=True, slots=True)
class Arrival:
    """A message that has come."""

    topic: str
    payload: bytes
    received: int  # ns, wall clock of the receiver
    attachment: bytes = b""  # what came beside it: its signature


MOST_BYTES = 65_536
"""Of one message."""

Callback = Callable[[Arrival], None]
"""Called in a thread of the transport: it is to keep the message and return."""

Change = Callable[[str, bool], None]
"""Called with a name and whether it is there."""


class Transport(Protocol):
    """A connection to the network; used from any thread."""

    clock: Clock
    """Of this end, for times of reception and ages."""

    def publish(self, topic: str, payload: bytes, attachment: bytes = b"", **way: Unpack[Way]) -> None:
        """Send a message to its subscribers; a message that cannot be sent is lost, nothing is raised."""
        ...

    def subscribe(self, pattern: str, callback: Callback) -> None:
        """Be called for every message from now on whose topic matches; `*` stands for one part, `**` for any."""
        ...

    def announce(self, name: str) -> None:
        """Announce the presence of `name` until this connection ends."""
        ...

    def watch(self, pattern: str, callback: Change) -> None:
        """Be called with (name, whether it is there) for every announced name that matches, now and later."""
        ...

    def close(self) -> None:
        """End the connection; may be called again."""
        ...


class ReceivingTransport:
    """A transport on which nothing is sent: of a program that only watches."""

    def __init__(self, transport: Transport) -> None:
        """Wrap a transport."""
        self.subscribe, self.watch, self.close = transport.subscribe, transport.watch, transport.close
        self.clock = transport.clock

    def publish(self, topic: str, payload: bytes, attachment: bytes = b"", **way: Unpack[Way]) -> None:
        """Send nothing."""

    def announce(self, name: str) -> None:
        """Announce nothing."""


def matcher(pattern: str) -> Callable[[str], bool]:
    """Return the test whether a topic matches: `*` stands for one part of it, `**` for any number, none included."""
    wild = {"*": "[^/]+/", "**": "(?:[^/]+/)*"}
    expression = re.compile("".join(wild.get(part, f"{re.escape(part)}/") for part in pattern.split("/")))
    return lambda topic: expression.fullmatch(f"{topic}/") is not None


PERIOD = 0.25  # s between two heartbeats
LEASE = 1.0  # s of silence after which a name counts as gone
MOST_PRESENT, LONGEST = 256, 256
"""Names of other ends that count at a time, and bytes of a name with its sender: any program can send heartbeats."""


class HeartbeatTransport(ABC):
    """A transport on a network without presence: its ends send heartbeats of the names that they announce."""

    def __init__(self) -> None:
        self.clock = CLOCK
        self._self = uuid.uuid4().bytes  # two ends may announce one name, of which one goes
        self._own: list[str] = []
        self._last: dict[tuple[str, bytes], float] = {}
        self._watchers: list[tuple[Callable[[str], bool], Change]] = []
        self._presence = threading.RLock()
        self._closed = threading.Event()

    @abstractmethod
    def _send_heartbeat(self, name: str, payload: bytes) -> None:
        """Send a heartbeat to the other ends."""

    @abstractmethod
    def _receive_heartbeats(self) -> None:
        """Begin to call `heartbeat` with those of other ends."""

    @abstractmethod
    def _end(self) -> None:
        """End the connection, for `close`."""

    def announce(self, name: str) -> None:
        """Announce, see `Transport`."""
        with self._presence:
            self._own.append(name)
        self._send_heartbeat(name, b"+" + self._self)

    def watch(self, pattern: str, callback: Change) -> None:
        """Watch, see `Transport`."""
        matches = matcher(pattern)
        with self._presence:
            first = not self._watchers
            self._watchers.append((matches, callback))
            for name in sorted(filter(matches, self._present())):
                callback(name, True)
        if first:
            self._receive_heartbeats()

    def heartbeat(self, name: str, payload: bytes) -> None:
        """Take a heartbeat: `+` or `-` and the sender's bytes."""
        with self._presence:
            before, key = self._present(), (name, payload[1:])
            if payload[:1] != b"+":
                self._last.pop(key, None)
            elif key in self._last or (len(self._last) < MOST_PRESENT and len(name) + len(payload) <= LONGEST):
                self._last[key] = time.monotonic()
            self._notify(before)

    def beat(self) -> None:
        """Send the heartbeats and find silent names; to be called every `PERIOD`."""
        with self._presence:
            own, late, before = list(self._own), time.monotonic() - LEASE, self._present()
            self._last = {who: last for who, last in self._last.items() if last >= late}
            self._notify(before)
        for name in own:
            self._send_heartbeat(name, b"+" + self._self)

    def _beat_on(self) -> None:
        while not self._closed.wait(PERIOD):
            self.beat()

    def close(self) -> None:
        """End the connection, and before it the presence of what was announced."""
        if self._closed.is_set():
            return
        with self._presence:
            own, self._own = self._own, []
            self._watchers.clear()
        for name in own:
            self._send_heartbeat(name, b"-" + self._self)
        self._end()

    def _present(self) -> set[str]:
        return {name for name, _ in self._last}

    def _notify(self, before: set[str]) -> None:
        """Call the watchers of names that have come or gone."""
        for name in sorted(before ^ self._present()):
            for matches, callback in self._watchers:
                if matches(name):
                    callback(name, name not in before)


UNIX = "unixsock-stream"
PROTOCOLS = ("tcp", "tls", "quic", "udp", "nats", UNIX)
SECURE = ("tls", "quic")

WRITTEN_UNIX = re.compile(rf"({UNIX})/(/[^\s?#]{{1,106}})")  # the kernel takes 107 bytes
WRITTEN = re.compile(r"([a-z]+)/(\[[0-9A-Fa-f:.]+\]|[^\s/:?#\[\]]+):(\d{1,5})(?:[?#]\S*)?")


@dataclass(frozen=True, slots=True)
class Address:
    """An endpoint."""

    protocol: str
    host: str  # without the brackets of IPv6; the absolute path of a unix socket
    port: int  # 0 for a unix socket

    @property
    def authority(self) -> str:
        """Host and port as URLs have them."""
        return f"[{self.host}]:{self.port}" if ":" in self.host else f"{self.host}:{self.port}"

    @property
    def loopback(self) -> bool:
        """True if it is on this computer: 127.0.0.0/8, ::1, localhost or a unix socket."""
        if self.protocol == UNIX:
            return True
        try:
            return ipaddress.ip_address(self.host).is_loopback
        except ValueError:
            return self.host.lower() == "localhost"


def address_of(endpoint: str) -> Address:
    """Return the parts of an endpoint such as tcp/127.0.0.1:7447. Raises CoopenvError: it is none."""
    if unix := WRITTEN_UNIX.fullmatch(endpoint):
        return Address(UNIX, unix[2], 0)
    found, known = WRITTEN.fullmatch(endpoint), PROTOCOLS[:-1]
    if found is None or found[1] not in known or int(found[3]) > 65_535:
        example = f"tcp/127.0.0.1:7447 (or {listed(known)}), or {UNIX}//run/SOCKET"
        raise CoopenvError(f"{shown(endpoint)} is no endpoint, expected for example {example}")
    return Address(found[1], found[2].strip("[]"), int(found[3]))


def trouble_at(address: Address, context: ssl.SSLContext | None, timeout: float) -> str | None:
    """Try a connection: the errors of libraries often lack the reason.

    Args:
        address: where to.
        context: certificates, for TLS.
        timeout: s.

    Returns:
        Why it fails; None: it does not, or it cannot be tried.
    """
    if address.protocol in ("udp", "quic"):
        return None
    try:
        if address.protocol == UNIX:
            with socket.socket(socket.AF_UNIX) as plain:
                plain.settimeout(timeout)
                plain.connect(address.host)
            return None
        with socket.create_connection((address.host, address.port), timeout) as plain:
            if address.protocol == "tls" and context is not None:
                with context.wrap_socket(plain, server_hostname=address.host) as secured, suppress(TimeoutError):
                    secured.settimeout(0.2)
                    secured.recv(1)  # a peer asks for our certificate, or refuses it, only now
    except TimeoutError:
        return "no answer"
    except ssl.SSLCertVerificationError as error:
        return f"its certificate is refused: {error.verify_message}"
    except ssl.SSLError as error:
        return f"TLS: {(error.reason or str(error)).replace('_', ' ').lower()}"
    except OSError as error:
        return error.strerror or str(error)
    return None


def first_trouble(endpoints: Sequence[str], context: ssl.SSLContext | None, otherwise: str) -> str:
    """Return why a connection to the first of the endpoints with a trouble fails, or else what a library says."""
    troubles = (trouble_at(address_of(endpoint), context, 1.0) for endpoint in endpoints)
    return next(filter(None, troubles), otherwise)


FORBIDDEN = stat.S_IRWXG | stat.S_IRWXO


class Tls(Section):
    """Certificates in PEM; paths are relative to the file. A listener with a certificate asks clients for theirs."""

    root_ca: Path
    """Certificate of the authority that signs the others."""
    certificate: Path | None = None
    """Own certificate, if this end listens or the other one asks for it."""
    key: Path | None = None
    """Private key of the certificate, readable by its owner alone."""

    @model_validator(mode="after")
    def _both_or_none(self) -> Self:
        if (self.certificate is None) != (self.key is None):
            raise ValueError("certificate and key: give both or none")
        return self

    def checked(self, folder: Path) -> Self:
        """Return them with whole paths. Raises CoopenvError: one cannot be used; the line names field and file."""
        made = type(self)(**{name: folder / path for name, path in self if path is not None})
        for name, path in made:
            try:
                (path or made.root_ca).open("rb").close()
            except OSError as error:
                raise CoopenvError(f"tls.{name}: {path}: cannot be read ({error.strerror or error})") from None
        if made.key is not None and made.key.stat().st_mode & FORBIDDEN:
            raise CoopenvError(f"tls.key: {made.key} can be read by others; run: chmod 600 {made.key}")
        made.context()
        return made

    def context(self) -> ssl.SSLContext:
        """Return what Python connects with. Raises CoopenvError: the files do not hold what they should."""
        try:
            made = ssl.create_default_context(cafile=self.root_ca)
        except (ssl.SSLError, OSError):
            raise CoopenvError(f"tls.root_ca: {self.root_ca} holds no certificate in PEM") from None
        if self.certificate is None or self.key is None:
            return made
        try:
            made.load_cert_chain(self.certificate, self.key, password="")  # never ask at the terminal
        except (ssl.SSLError, OSError):
            files = f"{self.certificate} and {self.key}"
            raise CoopenvError(
                f"tls.certificate, tls.key: {files} are no certificate and its key, in PEM without a password"
            ) from None
        return made

    def for_zenoh(self) -> dict[str, object]:
        """Return the entries of Zenoh's `transport/link/tls`."""
        entries: dict[str, object] = {"root_ca_certificate": str(self.root_ca)}
        if self.certificate is not None:
            for side in ("listen", "connect"):
                entries |= {f"{side}_certificate": str(self.certificate), f"{side}_private_key": str(self.key)}
            entries["enable_mtls"] = True
        return entries
