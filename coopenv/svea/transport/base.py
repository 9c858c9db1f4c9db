"""What every transport does: carry bytes by topic between processes, without looking at them."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from coopenv.errors import CoopenvError


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
        """Send a message to whoever has subscribed; what cannot be sent is lost, nothing is raised."""
        ...

    def subscribe(self, pattern: str, callback: Callback) -> None:
        """Be called for every message from now on whose topic matches; `*` stands for one part, `**` for any."""
        ...

    def announce(self, name: str) -> None:
        """Let others see that `name` is there, until this connection ends."""
        ...

    def watch(self, pattern: str, callback: Callable[[str, bool], None]) -> None:
        """Be called with (name, whether it is there) for every announced name that matches, now and later."""
        ...

    def close(self) -> None:
        """End the connection; may be called again."""
        ...
