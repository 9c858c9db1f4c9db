"""The beginning of an episode of cars: they are heard, checked, and armed if that is asked for."""

import gc
import time
from collections.abc import Callable, Collection

from coopenv.backends.svea.checks import Fleet, problems_of
from coopenv.backends.svea.gates import Gates
from coopenv.backends.svea.watchdog import Watchdog
from coopenv.errors import CoopenvError
from coopenv.svea.codec import encode, make
from coopenv.svea.topics import RESET_TOPIC, Role, topic_of
from coopenv.svea.transport.base import Transport

FIRST_WORD = 3.0  # s that cars have to be heard in at the first reset
CAMERA_WORD = 1.5  # s in which a camera has to say of itself what it is; some never do
READY_WORD = 2.0  # s in which all has to be at once as arming wants it; cars tell of themselves once a second
SETTLE = 0.5  # s that fakes have to stand where they were put


class Start:
    """Begins episodes."""

    def __init__(
        self,
        fleet: Fleet,
        transport: Transport,
        gates: Gates,
        watchdog: Watchdog,
        odometry: Collection[Role],
        drain: Callable[[], None],
    ) -> None:
        """Say of what.

        Args:
            fleet: what is checked.
            transport: the network.
            gates: of the cars.
            watchdog: looks after them.
            odometry: what each car has to measure.
            drain: takes what has come.
        """
        self._fleet, self._transport, self._gates, self._watchdog = fleet, transport, gates, watchdog
        self._topics = [topic_of(name, role) for name in fleet.calibrations for role in odometry]
        self._drain, self._heard_once = drain, False

    def prepare(self, seed: int) -> None:
        """Free memory now, as that would take longer than a decision may, and put fakes at the start of a seed."""
        gc.unfreeze()
        gc.collect()
        gc.freeze()  # what is left is not looked through again while cars drive
        if self._fleet.deployment.fakes:
            signed = (seed + 2**63) % 2**64 - 2**63  # the same 64 bits
            self._transport.publish(RESET_TOPIC, encode(make("std_msgs/msg/Int64", data=signed)), reliable=True)
            time.sleep(SETTLE)

    def listen(self, arm: bool) -> None:
        """Wait until the cars have been heard, but not for ever: they need not be there as long as nobody drives."""
        silence, board = self._fleet.station.silence, self._fleet.board
        _wait(lambda: all(silence(topic) < 1.0 for topic in self._topics), 0 if self._heard_once else FIRST_WORD)
        if arm:
            _wait(lambda: all(board.calibration(name) is not None for name in self._fleet.calibrations), CAMERA_WORD)
        self._heard_once = True
        self._drain()

    def arm(self, release: bool) -> None:
        """Open the gates and look after the cars.

        Args:
            release: whether cars, too, that somebody else has stopped.

        Raises:
            CoopenvError: something is not as it has to be before wheels turn.
        """
        _wait(lambda: self._problem() is None, READY_WORD)
        if found := self._problem():
            raise CoopenvError(f"not armed: {found}")
        self._watchdog.forget()
        self._fleet.board.begin()
        self._gates.begin(release or self._fleet.deployment.fakes)
        self._watchdog.arm()

    def _problem(self) -> str | None:
        self._drain()
        return next(problems_of(self._fleet), None)


def _wait(ready: Callable[[], bool], patience: float) -> None:
    """Wait for something to become true, s at most."""
    until = time.monotonic() + patience
    while time.monotonic() < until and not ready():
        time.sleep(0.02)
