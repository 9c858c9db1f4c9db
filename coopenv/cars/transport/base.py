"""Transports carry bytes by topic between processes. Endpoints (as Zenoh writes them) and certificates."""

import ipaddress
import re
import socket
import ssl
import stat
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from coopenv.base.errors import CoopenvError, listed, shown


class LinkError(CoopenvError):
    """The network, or a process on it, cannot be reached."""


@dataclass(frozen=True, slots=True)
class Arrival:
    """A message that has come."""

    topic: str
    payload: bytes
    received: int  # ns, wall clock of the receiver
    attachment: bytes = b""  # what came beside it: its signature


Callback = Callable[[Arrival], None]
"""Called in a thread of the transport: it is to keep the message and return."""


class Transport(Protocol):
    """A connection to the network; used from any thread."""

    def publish(
        self, topic: str, payload: bytes, attachment: bytes = b"", *, urgent: bool = False, reliable: bool = False
    ) -> None:
        """Send a message to its subscribers; a message that cannot be sent is lost, nothing is raised."""
        ...

    def subscribe(self, pattern: str, callback: Callback) -> None:
        """Be called for every message from now on whose topic matches; `*` stands for one part, `**` for any."""
        ...

    def announce(self, name: str) -> None:
        """Announce the presence of `name` until this connection ends."""
        ...

    def watch(self, pattern: str, callback: Callable[[str, bool], None]) -> None:
        """Be called with (name, whether it is there) for every announced name that matches, now and later."""
        ...

    def close(self) -> None:
        """End the connection; may be called again."""
        ...


def matcher(pattern: str) -> Callable[[str], bool]:
    """Return the test whether a topic matches: `*` stands for one part of it, `**` for any number, none included."""
    wild = {"*": "[^/]+/", "**": "(?:[^/]+/)*"}
    expression = re.compile("".join(wild.get(part, f"{re.escape(part)}/") for part in pattern.split("/")))
    return lambda topic: expression.fullmatch(f"{topic}/") is not None


PROTOCOLS = ("tcp", "tls", "quic", "udp", "nats")
SECURE = ("tls", "quic")
NO_ANSWER = "no answer"

WRITTEN = re.compile(r"([a-z]+)/(\[[0-9A-Fa-f:.]+\]|[^\s/:?#\[\]]+):(\d{1,5})(?:[?#]\S*)?")


@dataclass(frozen=True, slots=True)
class Address:
    """An endpoint."""

    protocol: str
    host: str  # without the brackets of IPv6
    port: int

    @property
    def authority(self) -> str:
        """Host and port as URLs have them."""
        return f"[{self.host}]:{self.port}" if ":" in self.host else f"{self.host}:{self.port}"

    @property
    def loopback(self) -> bool:
        """Whether it is on this computer, whatever its networks: 127.0.0.0/8, ::1 or localhost."""
        try:
            return ipaddress.ip_address(self.host).is_loopback
        except ValueError:
            return self.host.lower() == "localhost"


def address_of(endpoint: str) -> Address:
    """Return the parts of an endpoint such as tcp/127.0.0.1:7447. Raises CoopenvError: it is none."""
    found = WRITTEN.fullmatch(endpoint)
    if found is None or found[1] not in PROTOCOLS or int(found[3]) > 65_535:
        known = listed(PROTOCOLS)
        raise CoopenvError(f"{shown(endpoint)} is no endpoint, expected for example tcp/127.0.0.1:7447 (or {known})")
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
        with socket.create_connection((address.host, address.port), timeout) as plain:
            return _tls_trouble(plain, address.host, context) if address.protocol == "tls" and context else None
    except TimeoutError:
        return NO_ANSWER
    except OSError as error:
        return error.strerror or str(error)


def _tls_trouble(plain: socket.socket, host: str, context: ssl.SSLContext) -> str | None:
    try:
        with context.wrap_socket(plain, server_hostname=host) as secured:
            secured.settimeout(0.2)
            secured.recv(1)  # a peer asks for our certificate, or refuses it, only now
    except ssl.SSLCertVerificationError as error:
        return f"its certificate is refused: {error.verify_message}"
    except ssl.SSLError as error:
        return f"TLS: {(error.reason or str(error)).replace('_', ' ').lower()}"
    except TimeoutError:
        pass
    return None


FORBIDDEN = stat.S_IRWXG | stat.S_IRWXO


@dataclass(frozen=True, slots=True)
class Certificates:
    """Files in PEM. A listener with a certificate asks clients for theirs (mutual TLS)."""

    root_ca: Path  # authority of the others' certificates
    certificate: Path | None = None  # own one
    key: Path | None = None  # private key of it

    def __post_init__(self) -> None:
        """Refuse files that cannot be used. Raises CoopenvError: one line names the field and the file."""
        _check("root_ca", self.root_ca)
        if self.certificate is not None and self.key is not None:
            _check("certificate", self.certificate)
            _check("key", self.key)
            if self.key.stat().st_mode & FORBIDDEN:
                raise CoopenvError(f"tls.key: {self.key} can be read by others; run: chmod 600 {self.key}")
        self.context()

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


def _check(field: str, path: Path) -> None:
    try:
        with path.open("rb"):
            return
    except OSError as error:
        raise CoopenvError(f"tls.{field}: {path}: cannot be read ({error.strerror or error})") from None
