"""Ends of a network in processes of their own: `python -m tests.helpers.wire router|echo ENDPOINT`."""

from __future__ import annotations

import signal
import socket
import subprocess
import sys
from contextlib import AbstractContextManager
from pathlib import Path

from coopenv.cars.link.transport import Arrival, Transport
from tests.helpers.processes import started

PING, PONG, ECHO = "fleet/ping", "fleet/pong", "fleet/alive/echo"


def free_port() -> int:
    """Return a port of the loopback that nobody listens at."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def free_endpoint() -> str:
    """Return an endpoint of the loopback that nobody listens at."""
    return f"tcp/127.0.0.1:{free_port()}"


def heard_by(receiver: Transport, pattern: str) -> list[Arrival]:
    """Return what a receiver hears from now on, filled as it comes."""
    heard: list[Arrival] = []
    receiver.subscribe(pattern, heard.append)
    return heard


def seen_by(receiver: Transport) -> list[tuple[str, bool]]:
    """Return who comes and goes from now on, filled as it happens."""
    seen: list[tuple[str, bool]] = []
    receiver.watch("fleet/alive/*", lambda *change: seen.append(change))
    return seen


def running(*arguments: str) -> AbstractContextManager[subprocess.Popen[str]]:
    """Run an end until the block is left; it has said that it is ready."""
    return started((sys.executable, "-m", "tests.helpers.wire", *arguments), Path.cwd())


def listening(pid: int) -> list[str]:
    """Return the local addresses, hex, at which a process listens by TCP or has a UDP socket (Linux)."""
    sockets = set()
    for link in Path(f"/proc/{pid}/fd").iterdir():
        try:
            sockets.add(str(link.readlink()))
        except OSError:  # closed meanwhile
            continue
    found = []
    for table in ("tcp", "tcp6", "udp", "udp6"):
        for line in Path(f"/proc/{pid}/net/{table}").read_text().splitlines()[1:]:
            fields = line.split()
            if f"socket:[{fields[9]}]" in sockets and (fields[3] == "0A" or table.startswith("udp")):
                found.append(f"{table} {fields[1]}")
    return found


def _main(kind: str, endpoint: str) -> None:
    from coopenv.cars.link.zenoh import open_zenoh

    if kind == "router":
        transport = open_zenoh("router", listen=[endpoint])
    else:
        transport = open_zenoh("client", connect=[endpoint])
        transport.subscribe(PING, lambda a: transport.publish(PONG, a.payload[::-1], a.attachment))
        transport.announce(ECHO)
    print("ready", flush=True)
    signal.pause()


if __name__ == "__main__":
    _main(*sys.argv[1:])
