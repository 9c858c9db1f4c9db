"""What a file shows to viewers beside the recording: further topics, which nobody reads back."""

from collections.abc import Iterable
from typing import NamedTuple

from coopenv.backends.mcap.messages import codec


class View(NamedTuple):
    """A topic with its messages."""

    topic: str
    schema: str
    """Name of the type of its messages."""
    schema_encoding: str
    definition: bytes
    """Of the type, in that encoding."""
    encoding: str
    """Of the messages."""
    messages: Iterable[tuple[int, bytes]]
    """(tick, contents), in the order of ticks."""


class Clock(NamedTuple):
    """When ticks were."""

    dt: float
    """s, between ticks."""
    start: float = 0.0
    """s since 1970, of tick 0."""

    def nanoseconds(self, tick: int) -> int:
        """Return the time of a tick, ns since 1970."""
        return round(self.start * 1e9) + round(tick * self.dt * 1e9)


def ros_definition(kind: str) -> bytes:
    """Return the definition of a ROS 2 type as MCAP files hold it (`ros2msg`)."""
    return str(codec().generate_msgdef(kind, ros_version=2)[0]).encode()
