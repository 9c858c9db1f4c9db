"""Addresses on the network as Zenoh writes them, `PROTOCOL/HOST:PORT`, whatever transport they are for."""

import ipaddress
import re
import socket
import ssl
from dataclasses import dataclass

from coopenv.base.errors import CoopenvError, listed, shown

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
    """Try a connection by hand, because libraries often only say that it did not work.

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
            secured.recv(1)  # who wants a certificate of ours, or refuses it, says so only now
    except ssl.SSLCertVerificationError as error:
        return f"its certificate is refused: {error.verify_message}"
    except ssl.SSLError as error:
        return f"TLS: {(error.reason or str(error)).replace('_', ' ').lower()}"
    except TimeoutError:
        pass
    return None
