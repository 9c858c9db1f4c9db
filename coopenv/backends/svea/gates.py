"""The other side of the gates: sessions are begun and ended, commands go out, and what gates say is kept."""

import secrets
import threading
import time
from dataclasses import dataclass, field
from typing import Any

from coopenv.errors import CoopenvError
from coopenv.svea.codec import decode, encode, header, make
from coopenv.svea.limits import Limits
from coopenv.svea.signing import Signer, Verifier
from coopenv.svea.topics import TOPICS, Role, topic_of
from coopenv.svea.transport.base import Arrival, Transport

PATIENCE = 1.0  # s in which a gate has to answer
OLD = 1.0  # s after which a gate that says nothing counts as gone
POLL = 0.01  # s


@dataclass
class GateState:
    """What a gate has said last."""

    state: str = "unknown"
    session: str = ""
    nonce: str = ""
    accepted: int = 0
    rejections: dict[str, int] = field(default_factory=dict)
    heard: float = float("-inf")  # by the monotonic clock, s

    @property
    def age(self) -> float:
        """How long ago it spoke, s."""
        return time.monotonic() - self.heard


class Gates:
    """The gates of some cars."""

    def __init__(
        self,
        transport: Transport,
        cars: tuple[str, ...],
        limits: Limits,
        signer: Signer | None,
        verifier: Verifier | None = None,
    ) -> None:
        """Listen to the gates; with a verifier only to what they have signed."""
        self._transport, self._limits, self._signer, self._verifier = transport, limits, signer, verifier
        self._lock = threading.Lock()
        self._states = {car: GateState() for car in cars}
        self._cars = {topic_of(car, Role.GATE): car for car in cars}
        self.session = ""
        self._sequence = 0
        for topic in self._cars:
            transport.subscribe(topic, self._hear)

    @property
    def states(self) -> dict[str, GateState]:
        """What each gate has said last."""
        with self._lock:
            return dict(self._states)

    def _hear(self, arrival: Arrival) -> None:
        car, v = self._cars[arrival.topic], self._verifier
        if v is not None and v.signer(arrival.topic, arrival.payload, arrival.attachment) != car:
            return
        try:
            m = decode(arrival.payload, TOPICS[Role.GATE].type)
        except CoopenvError:
            return
        counts = dict(zip(m.rejections, (int(n) for n in m.counts), strict=False))
        state = GateState(m.state, m.session, m.nonce, int(m.accepted), counts, time.monotonic())
        with self._lock:
            self._states[car] = state

    def begin(self) -> None:
        """Arm all gates for a new session.

        Raises:
            CoopenvError: a gate is not there or does not open; all are closed again then.
        """
        self.session, self._sequence = secrets.token_hex(8), 0
        for car in self._states:
            if self._states[car].age > OLD:
                raise CoopenvError(
                    f"{car}: no gate has spoken on {topic_of(car, Role.GATE)}: is `coopenv svea gate` running there?"
                )
        until = time.monotonic() + PATIENCE
        while closed := [c for c, s in self.states.items() if (s.state, s.session) != ("armed", self.session)]:
            if time.monotonic() > until:
                self.end()
                state = self.states[closed[0]]
                why = "; ".join(f"{reason}: {count}" for reason, count in state.rejections.items()) or "no reason told"
                raise CoopenvError(f"{closed[0]}: the gate did not open, it is {state.state} ({why})")
            for car in closed:
                self._arm(car, True)
            time.sleep(5 * POLL)

    def end(self) -> None:
        """Close all gates; cars come to a stand."""
        for car in self._states:
            self._arm(car, False)
        self.session = ""

    def _arm(self, car: str, armed: bool) -> None:
        nonce = self.states[car].nonce
        message = make(
            TOPICS[Role.ARM].type, header=header(time.time_ns()), session=self.session, nonce=nonce, armed=armed
        )
        self._send(car, Role.ARM, message)

    def stop(self) -> None:
        """Tell every gate to stop at once and to stay so."""
        for car in self._states:
            self._send(car, Role.STOP, make(TOPICS[Role.STOP].type, data=True))

    def command(self, car: str, speed: float, steering: float, acceleration: float) -> None:
        """Send a command: m/s, rad, m/s^2, clipped to the limits."""
        limits = self._limits
        speed = min(max(speed, -limits.speed if limits.reverse else 0.0), limits.speed)
        steering = min(max(steering, -limits.steering), limits.steering)
        drive = make(
            "ackermann_msgs/msg/AckermannDrive",
            steering_angle=steering,
            steering_angle_velocity=limits.steering_rate,
            speed=speed,
            acceleration=min(acceleration, limits.acceleration),
            jerk=0.0,
        )
        about = header(time.time_ns(), f"{self.session}:{self._sequence}")
        self._send(car, Role.COMMAND, make(TOPICS[Role.COMMAND].type, header=about, drive=drive))

    def next(self) -> None:
        """Begin the commands of the next decision."""
        self._sequence += 1

    def _send(self, car: str, role: Role, message: Any) -> None:
        topic, payload = topic_of(car, role), encode(message)
        signature = b"" if self._signer is None else self._signer.sign(topic, payload)
        kind = TOPICS[role]
        self._transport.publish(topic, payload, signature, urgent=kind.urgent, reliable=kind.reliable)
