"""The authors' names and types on the wire, those of `coopenv.svea.topics` for whoever uses it.

What has a counterpart goes out under the authors' name as a ROS 1 message. If that loses something (an estimate becomes
a position alone) or there is none, it goes out under our own name as well, as CDR, to be heard by other coopenv ends.
"""

import threading
from collections import Counter
from collections.abc import Callable, Iterable

from coopenv.errors import CoopenvError
from coopenv.svea.transport.base import Arrival, Callback, Transport
from coopenv.svea.transport.counterparts import Route
from coopenv.svea.transport.patterns import matcher


class Authors:
    """A transport whose topics are translated on their way to and from another one.

    Signatures count for the CDR bytes under our names. They go along with exact counterparts, whose bytes come back as
    they were, and otherwise with the message under our own name.
    """

    def __init__(self, wire: Transport, routes: Iterable[Route]) -> None:
        """Take a network with the authors' messages, which is closed with this, and what is translated."""
        self._wire = wire
        self._routes = {route.topic: route for route in routes}
        self._names = {route.name for route in self._routes.values()}
        self._lock = threading.Lock()
        self.refused: Counter[str] = Counter()
        """Messages that are not of their topic's type, by topic, ours or theirs."""
        warmed = {(route.ours, route.theirs.type): route for route in self._routes.values()}
        for route in warmed.values():
            route.warm_up()

    def publish(
        self, topic: str, payload: bytes, attachment: bytes = b"", *, urgent: bool = False, reliable: bool = False
    ) -> None:
        """Send, see `Transport`."""
        route = self._routes.get(topic)
        if route is None or not route.theirs.exact:
            self._wire.publish(topic, payload, attachment, urgent=urgent, reliable=reliable)
        if route is None:
            return
        translated = self._translated(route.out, payload, topic)
        if translated is not None:
            beside = attachment if route.theirs.exact else b""
            self._wire.publish(route.name, translated, beside, urgent=urgent, reliable=reliable)

    def subscribe(self, pattern: str, callback: Callback) -> None:
        """Subscribe, see `Transport`."""
        matches = matcher(pattern)
        for route in self._routes.values():
            if route.theirs.exact and matches(route.topic):
                self._wire.subscribe(route.name, self._translating(route, callback))
        if pattern in self._routes and self._routes[pattern].theirs.exact:
            return

        def pass_on(arrival: Arrival) -> None:
            if arrival.topic not in self._names:
                callback(arrival)

        self._wire.subscribe(pattern, pass_on)

    def _translating(self, route: Route, callback: Callback) -> Callback:
        def arrive(arrival: Arrival) -> None:
            payload = self._translated(route.back, arrival.payload, route.name)
            if payload is not None:
                callback(Arrival(route.topic, payload, arrival.received, arrival.attachment))

        return arrive

    def _translated(self, translate: Callable[[bytes], bytes], payload: bytes, name: str) -> bytes | None:
        try:
            return translate(payload)
        except CoopenvError:
            with self._lock:
                self.refused[name] += 1
            return None

    def announce(self, name: str) -> None:
        """Announce, see `Transport`."""
        self._wire.announce(name)

    def watch(self, pattern: str, callback: Callable[[str, bool], None]) -> None:
        """Watch, see `Transport`."""
        self._wire.watch(pattern, callback)

    def close(self) -> None:
        """End the connection."""
        self._wire.close()
