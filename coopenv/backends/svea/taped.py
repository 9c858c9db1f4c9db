"""A transport that writes down what goes over it."""

import time
from collections.abc import Callable, Collection

from coopenv.backends.svea.tape import Tape
from coopenv.svea.codec import encode, make
from coopenv.svea.transport.base import Arrival, Callback, Transport

PRESENCE = "std_msgs/msg/Bool"
"""Type of what a tape says of who is there, under the names of their tokens."""


class Taped:
    """A transport whose messages are written to a tape, by whatever thread sends or receives them.

    What ticks are made of is left to those who make them, as it has to stand on the tape in the order in which they
    take it.
    """

    def __init__(
        self, transport: Transport, tape: Tape, aside: Collection[str] = (), unread: Collection[str] = ()
    ) -> None:
        """Wrap a transport.

        Args:
            transport: the network.
            tape: where everything that is sent is written, and who comes and goes.
            aside: topics of which no ticks are made: what comes on them is written at once.
            unread: topics that nobody here listens to and that belong on the tape all the same.
        """
        self._transport, self._tape, self._aside = transport, tape, frozenset(aside)
        self.announce, self.close = transport.announce, transport.close
        for topic in unread:
            transport.subscribe(topic, self._write)

    def publish(
        self, topic: str, payload: bytes, attachment: bytes = b"", *, urgent: bool = False, reliable: bool = False
    ) -> None:
        """Send, see `Transport`, and write down."""
        self._transport.publish(topic, payload, attachment, urgent=urgent, reliable=reliable)
        self._tape.write(topic, payload, time.time_ns())

    def subscribe(self, pattern: str, callback: Callback) -> None:
        """Subscribe, see `Transport`."""

        def take(arrival: Arrival) -> None:
            self._write(arrival)
            callback(arrival)

        self._transport.subscribe(pattern, take if pattern in self._aside else callback)

    def watch(self, pattern: str, callback: Callable[[str, bool], None]) -> None:
        """Watch, see `Transport`, and write down who comes and goes."""

        def change(name: str, there: bool) -> None:
            self._tape.write(name, encode(make(PRESENCE, data=there)), time.time_ns())
            callback(name, there)

        self._transport.watch(pattern, change)

    def _write(self, arrival: Arrival) -> None:
        self._tape.write(arrival.topic, arrival.payload, arrival.received)
