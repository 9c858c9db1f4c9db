"""The station's end of the network: inbox, clock of the ticks, and sessions with the gates."""

import secrets
import threading
from collections import Counter, deque
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field

from coopenv.base.errors import CoopenvError
from coopenv.cars.gate.gate import ARM, BOOL, COMMAND, MOST_AHEAD, STATUS, GateMode, Reason
from coopenv.cars.gate.wheel_command import NEUTRAL, write_drive
from coopenv.cars.link.clock import CLOCK, Clock
from coopenv.cars.link.keys import Signer, Verifier
from coopenv.cars.link.transport import MOST_BYTES, Arrival, Transport
from coopenv.cars.messages.cdr import Malformed, read, write
from coopenv.cars.settings.limits import Limits
from coopenv.cars.settings.profile import SVEA, CarProfile, Role

MOST_WAITING = 256
"""Messages of one topic that wait for the next tick; older ones are dropped, so that a flood fills nothing."""


def refusal(arrival: Arrival, verifier: Verifier | None = None, signers: Collection[str] | None = None) -> str:
    """Return why not to read a message: its length, or its signature where only some may sign it; empty: it is read."""
    if len(arrival.payload) > MOST_BYTES:
        return "too long"
    if verifier is None or signers is None:
        return ""
    return "" if verifier.signer(arrival.topic, arrival.payload, arrival.attachment) in signers else "signature"


@dataclass(eq=False, repr=False)
class Station:
    """Keeps messages by topic; its callbacks run in threads of the transport and only store."""

    transport: Transport
    topics: Iterable[str]  # to subscribe to
    verifier: Verifier | None  # checks signatures; None: nothing is signed
    signers: Mapping[str, Collection[str]]  # identities that may sign a topic, for topics that could be forged

    def __post_init__(self) -> None:
        """Subscribe."""
        self._lock, self._clock = threading.Lock(), self.transport.clock
        self._waiting: dict[str, deque[Arrival]] = {topic: deque(maxlen=MOST_WAITING) for topic in self.topics}
        self._last: dict[str, float] = {}
        self.dropped: Counter[str] = Counter()
        """Messages dropped before they were decoded, by reason: overflow, signature, too long."""
        for topic in self._waiting:
            self.transport.subscribe(topic, self._keep)

    def _keep(self, arrival: Arrival) -> None:
        waiting = self._waiting[arrival.topic]
        why = refusal(arrival, self.verifier, self.signers.get(arrival.topic))
        with self._lock:
            if why:
                self.dropped[why] += 1
                return
            if len(waiting) == MOST_WAITING:
                self.dropped["overflow"] += 1
            waiting.append(arrival)
            self._last[arrival.topic] = self._clock.seconds()

    def drain(self) -> list[Arrival]:
        """Return the messages since the last call, in the order of reception."""
        with self._lock:
            taken = [arrival for waiting in self._waiting.values() for arrival in waiting]
            for waiting in self._waiting.values():
                waiting.clear()
        return sorted(taken, key=lambda arrival: (arrival.received, arrival.topic))

    def silence(self, topic: str) -> float:
        """Return for how long nothing has come on a topic, s; inf: never anything."""
        with self._lock:
            return self._clock.seconds() - self._last.get(topic, float("-inf"))


KEPT = 100_000  # lateness of so many ticks is kept for the statistics


class Pacer:
    """Ticks of a fixed period; times are in ns of a clock that never jumps, set by the wall clock at the start.

    A decision has as long as it lasts: its first ticks may come late where the one before took long, its last one is
    on time again. Where it has not even begun by the time of its last tick, it has missed its deadline: that time is
    left out, and the next decisions follow at whole decisions after it.
    """

    def __init__(self, period: float, per_decision: int, clock: Clock = CLOCK) -> None:
        """Give the period of ticks in s, how many make a decision, and the clock."""
        self._period, self._clock = round(period * 1e9), clock
        self._decision = self._period * per_decision
        self.lateness: deque[float] = deque(maxlen=KEPT)
        """Lateness (s) of the last ticks."""
        self.start()

    def now(self) -> int:
        """Return the time."""
        return self._clock.steady() + self._wall

    def start(self) -> int:
        """Begin anew: time counts from the first decision on. Returns the time now."""
        self._wall = self._clock.wall() - self._clock.steady()
        self._due, self._late = 0, False  # before the first decision
        self.missed = self.in_a_row = 0
        """Decisions that missed their deadline, in all and in a row up to now."""
        self.lateness.clear()
        return self.now()

    def decide(self) -> None:
        """Begin a decision: where even its last tick is due already, count it and go on from now."""
        self._due, self._late = self._due or self.now(), False
        self._leave_out()
        self.in_a_row = self.in_a_row + 1 if self._late else 0

    def wait(self) -> int:
        """Sleep until the next tick is due and return the time then."""
        self._leave_out()  # where the computer stood still within a decision
        self._due += self._period
        left = self._due - self.now()
        if left > 0:
            self._clock.sleep(left * 1e-9)
        now = self.now()
        self.lateness.append((now - self._due) * 1e-9)
        return now

    def _leave_out(self) -> None:
        """Skip decisions whose time is over; the present one counts as late once."""
        if (over := (self.now() - self._due) // self._decision) > 0:
            self.missed += not self._late
            self._late = True
            self._due += over * self._decision

    def late(self, share: float) -> float:
        """Return the lateness that a share of the ticks did not exceed, s; 0 where there were none."""
        late = sorted(self.lateness)
        return late[round(share * (len(late) - 1))] if late else 0.0


PATIENCE = 1.0  # s for a gate to answer
RETRY = 0.05  # s between armings
STATUS_TIME = 0.5  # s for a new status of every gate
LATE = 500_000_000  # ns by which a status may be old
OLD = 1.0  # s without a status after which a gate counts as gone
OPEN = ("armed", "timed_out")
"""States of a gate that takes commands: after a time-out the car stands until the next one."""


@dataclass
class GateState:
    """Last status of a gate."""

    state: str = "unknown"
    session: str = ""
    nonce: str = ""
    stamp: int = 0  # ns, by the clock of the car
    rejections: Counter[str] = field(default_factory=Counter)
    accepted: int = 0  # commands, since its start
    received: float = float("-inf")  # by the steady clock, s
    clock: Clock = CLOCK

    @property
    def age(self) -> float:
        """Age of the status, s."""
        return self.clock.seconds() - self.received


@dataclass(eq=False, repr=False)
class Gates:
    """Sessions with the gates of some cars."""

    transport: Transport
    cars: tuple[str, ...]
    limits: Limits
    signer: Signer | None
    verifier: Verifier | None = None
    """With it only signed messages are received."""
    profile: CarProfile = SVEA
    probed: bool = True
    """Arming tries from here a neutral command to the wheels: a gate that notices it stays shut."""

    def __post_init__(self) -> None:
        """Receive from the gates."""
        self.clock, self._lock = self.transport.clock, threading.Lock()
        self._states = {car: GateState(clock=self.clock) for car in self.cars}
        self._before: dict[str, Counter[str]] = {}
        self._cars = {self.profile.topic_of(car, Role.GATE): car for car in self.cars}
        self._stopping = False
        self.stopped_by_others: set[str] = set()
        """Cars stopped by another station, or on the spot, since their last arming."""
        self.dropped = {car: Counter[str]() for car in self.cars}
        """Status messages that were dropped, by car and reason."""
        self.session = ""
        self._sequence = 0
        for topic in self._cars:
            self.transport.subscribe(topic, self._receive)

    @property
    def states(self) -> dict[str, GateState]:
        """Last status of each gate."""
        with self._lock:
            return dict(self._states)

    def refused(self, car: str) -> dict[str, int]:
        """Return the refusals of a gate by reason, since it was armed for this session or since its first status.

        The gate itself counts since its start.
        """
        with self._lock:
            counts, before = self._states[car].rejections, self._before.get(car, Counter())
        since = {reason: count - before[reason] for reason, count in counts.items()}
        return dict(counts) if any(count < 0 for count in since.values()) else since  # the gate was started anew

    def _receive(self, arrival: Arrival) -> None:
        car = self._cars[arrival.topic]
        if why := refusal(arrival, self.verifier, (car,)):
            self.dropped[car][why] += 1
            return
        try:
            stamp, _, session, nonce, state, accepted, _, reasons, numbers = read(arrival.payload, STATUS)
            mode = GateMode(state)
        except (Malformed, ValueError):
            self.dropped[car]["malformed"] += 1
            return
        if not -MOST_AHEAD <= arrival.received - stamp <= LATE:
            self.dropped[car]["stale" if stamp < arrival.received else "future"] += 1
            return
        counts = Counter(dict(zip(reasons, numbers, strict=False)))
        with self._lock:
            if stamp < self._states[car].stamp:
                self.dropped[car]["out of order"] += 1
                return
            known = mode, session, nonce, stamp, counts, accepted
            self._states[car] = GateState(*known, self.clock.seconds(), self.clock)
            if mode is GateMode.STOPPED and not self._stopping:
                self.stopped_by_others.add(car)
            self._before.setdefault(car, counts)

    def begin(self, release: bool = False) -> None:
        """Arm all gates for a new session; gates stopped by another station only with `release`.

        Raises:
            CoopenvError: a gate is absent, does not open, or is stopped meanwhile; all are closed again then.
        """
        self.session, self._sequence = secrets.token_hex(8), 0
        before = self.fresh_states()
        with self._lock:
            stopped = sorted(car for car in self.stopped_by_others if before[car].state == "stopped")
        if stopped and not release:
            raise CoopenvError(
                f"not armed: {stopped[0]}: it was stopped elsewhere; once you know why, release it "
                '(`coopenv svea run --release`, options={"arm": True, "release": True})'
            )
        until = self.clock.seconds() + PATIENCE
        while closed := [c for c, s in self.states.items() if (s.state, s.session) != ("armed", self.session)]:
            states = self.states
            for car in closed:
                if states[car].state == "stopped" and states[car].nonce != before[car].nonce:
                    self.end()
                    self.stopped_by_others.add(car)
                    if states[car].rejections[Reason.FOREIGN] > before[car].rejections[Reason.FOREIGN]:
                        raise CoopenvError(f"not armed: {car}: {BYPASSED}")
                    raise CoopenvError(f"{car}: was stopped while it was being armed")
            if self.clock.seconds() > until:
                self.end()
                raise CoopenvError(f"{closed[0]}: {_why_closed(before[closed[0]], states[closed[0]])}")
            for car in closed:
                if self.probed:  # like the arming, so that it comes before it
                    self.transport.publish(*neutral_command(self.profile, car, self.clock), reliable=True)
                self._arm(car, True, states[car].nonce)  # of that status: a later stop invalidates it
            self.clock.sleep(RETRY)
        with self._lock:
            self._stopping = False
            self.stopped_by_others.clear()
            self._before = {car: state.rejections for car, state in self._states.items()}

    def fresh_states(self, patience: float = STATUS_TIME) -> dict[str, GateState]:
        """Return a status of each gate, waiting `patience` s for new ones. Raises CoopenvError: a gate is silent."""
        asked, known = self.clock.seconds(), {car: counts.copy() for car, counts in self.dropped.items()}
        self.clock.wait(lambda: all(state.received >= asked for state in self.states.values()), patience)
        for car, state in self.states.items():
            if state.age <= OLD:
                continue
            if dropped := self.dropped[car] - known[car]:
                why = ", ".join(f"{reason} {count}" for reason, count in dropped.items())
                raise CoopenvError(f"{car}: the status of its gate is dropped ({why}): are keys and clocks the same?")
            topic = self.profile.topic_of(car, Role.GATE)
            raise CoopenvError(f"{car}: no gate status on {topic}: is `coopenv svea gate` running there?")
        return self.states

    def end(self) -> None:
        """Close all gates; cars come to a stand."""
        for car in self._states:
            self._arm(car, False, "")
        self.session = ""

    def _arm(self, car: str, armed: bool, nonce: str) -> None:
        self.send(car, Role.ARM, write(ARM, self.clock.wall(), "", self.session, nonce, armed))

    def stop(self) -> None:
        """Stop every gate at once, until the next arming."""
        with self._lock:
            self._stopping = True
        for car in self._states:
            self.send(car, Role.STOP, write(BOOL, True))

    def command(self, car: str, speed: float, steering: float, acceleration: float) -> None:
        """Send a command: m/s, rad, m/s^2, clipped to the limits."""
        limits = self.limits
        speed = min(max(speed, -limits.speed if limits.reverse else 0.0), limits.speed)
        steering = min(max(steering, -limits.steering), limits.steering)
        numbers = steering, limits.steering_rate, speed, min(acceleration, limits.acceleration), 0.0
        frame = f"{self.session}:{self._sequence}"
        self.send(car, Role.COMMAND, write(COMMAND, self.clock.wall(), frame, *numbers))

    def next(self) -> None:
        """Begin the commands of the next decision."""
        self._sequence += 1

    def send(self, car: str, role: Role, payload: bytes) -> None:
        """Send a message on a topic of a car, signed."""
        topic = self.profile.topic_of(car, role)
        signature = b"" if self.signer is None else self.signer.sign(topic, payload)
        self.transport.publish(topic, payload, signature, **self.profile.topics[role].way)


BYPASSED = (
    "commands get to its wheels that this gate has not sent: stop a second gate, or give its bridge "
    "docker/car-zenoh.json5 (docs/cars_safety.md#ways-around-the-gate)"
)

UNTRIED = "has no access rules: past the gate, any of its programs can command the wheels; arming cannot try that"
"""Warning for networks other than Zenoh."""


def neutral_command(profile: CarProfile, car: str, clock: Clock = CLOCK) -> tuple[str, bytes]:
    """Return topic and bytes of a command to the wheels of a car to stand, such as its gate alone may send."""
    return profile.topic_of(car, Role.MANUAL), write_drive(clock.wall(), profile.command, NEUTRAL)


def _why_closed(before: GateState, now: GateState) -> str:
    """Return why a gate has not opened, by what it has refused since."""
    news = now.rejections - before.rejections
    if "signature" in news:
        return (
            "its gate refuses this end's signature: does it trust this station (--station), "
            "and is its public.toml that of this end's key?"
        )
    why = ", ".join(f"{reason} {count}" for reason, count in news.items()) or "no reason given"
    if now.state in OPEN:
        return f"the gate did not open: another station drives the car ({why})"
    return f"the gate did not open, it is {now.state} ({why})"
