"""Zenoh under the keys of zenoh-bridge-ros2dds (no leading slash, plain CDR)."""

import atexit
import json
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any, Literal, Unpack
from weakref import WeakSet

from coopenv.base.errors import CoopenvError
from coopenv.base.installation import install_command, needing
from coopenv.cars.link.clock import CLOCK
from coopenv.cars.link.transport import (
    SECURE,
    UNIX,
    Arrival,
    Callback,
    LinkError,
    Tls,
    address_of,
    first_trouble,
)
from coopenv.cars.settings.profile import Way

LEASE = 1000  # ms after which a process that has frozen no longer counts as present
RETRY = {"period_init_ms": 200, "period_max_ms": 1000, "period_increase_factor": 2}
"""Periods of reconnecting to a lost router: a session resumes about a second after the router is back."""


class Zenoh:
    """A Zenoh session as a transport."""

    def __init__(self, session: Any, module: Any) -> None:
        self.session, self.library, self.clock = session, module, CLOCK
        self._kept: list[Any] = []  # a declaration ends with its last reference
        _sessions().add(self)

    def publish(self, topic: str, payload: bytes, attachment: bytes = b"", **way: Unpack[Way]) -> None:
        """Send, see `Transport`."""
        z = self.library
        with suppress(z.ZError):  # the session is closed
            self.session.put(
                topic,
                payload,
                attachment=attachment or None,
                express=way.get("urgent", False),
                priority=z.Priority.REAL_TIME if way.get("urgent") else z.Priority.DATA,
                congestion_control=z.CongestionControl.BLOCK if way.get("reliable") else z.CongestionControl.DROP,
            )

    def subscribe(self, pattern: str, callback: Callback) -> None:
        """Subscribe, see `Transport`. What is put under a wildcard key reaches patterns with a wildcard alone."""
        wild = "*" in pattern

        def arrive(sample: Any) -> None:
            if "*" in str(sample.key_expr) and not wild:
                return
            attachment = b"" if sample.attachment is None else sample.attachment.to_bytes()
            callback(Arrival(str(sample.key_expr), sample.payload.to_bytes(), time.time_ns(), attachment))

        self._kept.append(self.session.declare_subscriber(pattern, arrive))

    def announce(self, name: str) -> None:
        """Announce, see `Transport`."""
        self._kept.append(self.session.liveliness().declare_token(name))

    def watch(self, pattern: str, callback: Callable[[str, bool], None]) -> None:
        """Watch, see `Transport`."""

        def change(sample: Any) -> None:
            callback(str(sample.key_expr), sample.kind == self.library.SampleKind.PUT)

        self._kept.append(self.session.liveliness().declare_subscriber(pattern, change, history=True))

    def close(self) -> None:
        """End the session."""
        self._kept.clear()
        if not self.session.is_closed():
            self.session.close()


@cache
def _sessions() -> WeakSet[Zenoh]:
    """Return the sessions of this process, which end with its main thread: Zenoh's own threads would keep it alive."""
    sessions: WeakSet[Zenoh] = WeakSet()
    closing = threading.Lock()

    def close_all() -> None:
        with closing, suppress(KeyError):  # no session is left
            while True:
                sessions.pop().close()

    def close_at_end() -> None:
        threading.main_thread().join()
        close_all()

    threading.Thread(target=close_at_end, name="coopenv sessions", daemon=True).start()
    atexit.register(close_all)  # waits for the thread, which the interpreter would stop within Zenoh
    return sessions


def library() -> Any:
    """Return the library. Raises CoopenvError: the extra is not installed."""
    with needing(f"Zenoh needs an extra: {install_command('svea')}"):
        import zenoh
    return zenoh


def open_zenoh(
    mode: Literal["client", "peer", "router"],
    connect: Sequence[str] = (),
    listen: Sequence[str] = (),
    tls: Tls | None = None,
    timeout: float = 2.0,
    config: Path | None = None,
) -> Zenoh:
    """Open a session that uses the given endpoints and nothing else: nothing is looked for by multicast.

    Args:
        mode: "client" of a router, "peer" of other peers, or a "router" itself.
        connect: endpoints to connect to, e.g. "tcp/127.0.0.1:7447" or "tls/car:7447".
        listen: endpoints to listen at.
        tls: certificates, which endpoints `tls/...` need; others are refused then, so that nothing goes in the clear.
        timeout: s to wait for the endpoints to connect to.
        config: Zenoh's own file in place of all that; endpoints replace those in it, where any are given.

    Raises:
        CoopenvError: the extra is not installed, an endpoint is not one, or the file cannot be used.
        LinkError: an endpoint cannot be reached, or cannot be listened at.
    """
    for endpoint in (*connect, *listen):
        protocol = address_of(endpoint).protocol
        if (protocol in SECURE) != (tls is not None) and protocol != UNIX and config is None:
            raise CoopenvError(f"{endpoint}: tls/... and certificates (tls) go together")
    zenoh = library()
    try:
        made = zenoh.Config.from_file(config) if config else zenoh.Config()
    except zenoh.ZError as error:
        reason = " ".join(str(error).split(" at /")[0].split())
        raise CoopenvError(f"{config}: no configuration of Zenoh: {reason}") from None
    entries: dict[str, Any] = {"connect/endpoints": list(connect), "listen/endpoints": list(listen)}
    if config is None:
        entries |= {
            "mode": mode,
            "scouting/multicast/enabled": False,
            "scouting/gossip/enabled": False,
            "connect/timeout_ms": int(timeout * 1000),
            "connect/exit_on_failure": bool(connect),
            "connect/retry": RETRY,
            "transport/link/tx/lease": LEASE,
            # Longest wait of a sender for a reliable message, us, before the link counts as broken.
            "transport/link/tx/queue/congestion_control/block/wait_before_close": LEASE * 1000,
            **{f"transport/link/tls/{key}": value for key, value in (tls.for_zenoh() if tls else {}).items()},
        }
    try:
        for key, value in entries.items() if config is None or connect or listen else ():
            made.insert_json5(key, json.dumps(value))
        return Zenoh(zenoh.open(made), zenoh)
    except zenoh.ZError as error:
        where = ", ".join([*connect, *listen]) or "no endpoints"
        text = str(error).split(" at /")[0].split("\n")[0][:120]  # the first sentence
        text = f"no answer within {timeout:g} s" if connect and "Timeout" in text else text
        reason = first_trouble(connect, tls.context() if tls else None, text)
        raise LinkError(f"{where}: no Zenoh there ({reason})") from None
