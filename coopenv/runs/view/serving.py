"""The server of the live view: its address, port and token."""

import errno
import socket
from contextlib import AbstractContextManager
from typing import Any

from coopenv.base.errors import CoopenvError
from coopenv.viz.web.extra import guarded_server

PORT, PORTS = 8080, 20
"""The first port that is tried where none is asked for, and how many."""


def serving(host: str, port: int | None) -> AbstractContextManager[tuple[Any, str]]:
    """Return a context of viser's server and the address of its page, with the token that it needs.

    Args:
        host: address of this computer.
        port: the one to listen on (None: the first free one from `PORT` on).

    Raises:
        CoopenvError: the port is taken, or the address is none of this computer's.
    """
    return guarded_server(host, free_port(host, port))


def free_port(host: str, port: int | None) -> int:
    """Return a port that nobody listens on; arguments and errors as for `serving`."""
    for candidate in (port,) if port is not None else range(PORT, PORT + PORTS):
        reason = _obstacle(host, candidate)
        if not reason:
            return candidate
        if port is not None:
            raise CoopenvError(f"--port {port}: {reason}")
    raise CoopenvError(f"--port: {PORT} to {PORT + PORTS - 1} are taken; name another one")


def _obstacle(host: str, port: int) -> str:
    """Return why nobody can listen on a port; empty: one can. Raises CoopenvError: there is no such address here."""
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind, protocol) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(address)
    except socket.gaierror:
        raise CoopenvError(f"--host {host}: no such address") from None
    except PermissionError:
        return "ports below 1024 are for the administrator; name another one"
    except OSError as error:
        if error.errno == errno.EADDRNOTAVAIL:
            raise CoopenvError(f"--host {host}: is no address of this computer") from None
        return "another program listens there; name another one"
    return ""
