"""A fake car: its world, sensors and wheels on one clock, and its end of the network."""

import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import partial

import numpy as np

from coopenv.base.errors import CoopenvError
from coopenv.base.fault_text import Fault
from coopenv.cars.backend.binding import Binding
from coopenv.cars.codec import decode, warm_up
from coopenv.cars.deployment import Deployment
from coopenv.cars.fake.faults import Faults, Wire, end_process, fake_fault, fault_topic
from coopenv.cars.fake.sensors import Act, CarSensors, Pixy, SensorPublisher
from coopenv.cars.fake.world import Actuators, CarWorld, Neighbours
from coopenv.cars.gate.core import PERIOD, Gate, GateClock, Malformed, read_drive
from coopenv.cars.gate.process import GateConnection
from coopenv.cars.keys import Signer, Verifier
from coopenv.cars.profile import RESET_TOPIC, Role, presence_of
from coopenv.cars.transport.base import Arrival, Transport

JITTER = 0.05  # of a period, largest deviation to either side of a regular time
LATE = 50_000_000
"""ns: measurements that are overdue for longer than this are left out, as after a computer that stood still."""


class Schedule:
    """Times of several sensors; in ns on one clock."""

    def __init__(self, rates: Mapping[str, float], start: int, rng: np.random.Generator) -> None:
        """Begin.

        Args:
            rates: Hz by name.
            start: from when on.
            rng: of phases and jitter.
        """
        self._rng, self._periods = rng, {name: 1e9 / rate for name, rate in rates.items()}
        self._regular, self._due = dict[str, float](), dict[str, int]()  # the next time, ns, without and with jitter
        for name, period in self._periods.items():
            self._regular[name] = start + period * rng.uniform(0.1, 1.0)
            self._draw(name)

    @property
    def next(self) -> int:
        """When something is due next."""
        return min(self._due.values())

    def until(self, now: int) -> Iterator[tuple[int, str]]:
        """Yield (when, name) of all that is due up to now, in the order of time."""
        while (due := self.next) <= now:
            name = next(name for name, when in self._due.items() if when == due)
            self._regular[name] += self._periods[name]
            self._draw(name)
            if due >= now - LATE:
                yield due, name

    def _draw(self, name: str) -> None:
        jitter = self._periods[name] * JITTER * self._rng.uniform(-1.0, 1.0)
        self._due[name] = int(self._regular[name] + jitter)


REAL = GateClock(time.time_ns, time.monotonic_ns)


class Fake:
    """One fake car, a vehicle or a moving landmark; `advance` does all that is due, in one thread."""

    def __init__(
        self,
        deployment: Deployment,
        binding: Binding,
        name: str,
        transport: Transport,
        *,
        seed: int = 0,
        faults: Iterable[Fault] = (),
        gate: bool = True,
        signer: Signer | None = None,
        verifier: Verifier | None = None,
        clock: GateClock = REAL,
        die: Callable[[], None] = end_process,
        complain: Callable[[str], None] = lambda _: None,
    ) -> None:
        """Put the car at the start of a seed and announce it.

        Args:
            deployment: the fleet.
            binding: vehicles and markers of its cars.
            name: of the car.
            transport: the network; stays the caller's.
            seed: of where it starts and of its errors, which are those of the simulation with that key.
            faults: that it has, by times from now on.
            gate: whether commands come through a gate of its own; else it obeys ManualControl on the network.
            signer: signs the gate's status, as the car (None: it is not signed).
            verifier: knows the station's key, for the gate (None: signatures do not count).
            clock: wall and steady; the wall clock is that of motion capture.
            die: what the fault `kill` does.
            complain: called with one line about a malformed message.
        """
        self.name, self._clock, self._faults = name, clock, Faults()
        self._die, self._complain = die, complain
        scenario, self._drives = binding.scenario, name in binding.cars
        leader = binding.leaders.get(name, 0)
        agent = len(scenario.landmarks) + binding.cars[name] if self._drives else leader
        self._profile = binding.profile
        self.world = CarWorld(scenario, agent)
        self._wire = Wire(transport, self._faults, clock.steady, seed)
        self._inbox: deque[Callable[[], None]] = deque()
        self._others = Neighbours(self.world, binding, name, transport)
        self._acts: dict[str, Act] = {}
        self._link: GateConnection | None = None
        if self._drives:  # the wheels measure a turn rate only where no other sensor does
            self._pixy = Pixy(self.world, binding, self._others, self._faults)
            self._sensors = CarSensors(self.world, differential=deployment.sensors.odometry == "wheel")
            limits = scenario.limits[self.world.vehicle]
            self._wheels = Actuators(limits.latency, self._profile.command.timeout)
        vehicle = (self._pixy, self._sensors) if self._drives else None
        publisher = SensorPublisher(name, self.world, self._profile, self._wire, transport, self._stamp, vehicle)
        self.begin(seed)
        self._warm_up()
        transport.subscribe(RESET_TOPIC, self._receive_reset)
        transport.subscribe(fault_topic(name), self._receive_fault)
        rates = {name: rate for name, (rate, _) in publisher.acts.items()}
        self._acts = {name: act for name, (_, act) in publisher.acts.items()}
        if self._drives and gate:
            car_clock = GateClock(lambda: clock.wall() + self._faults.clock_error(clock.steady()), clock.steady)
            identity = deployment.security.identity
            decides = Gate(name, deployment.limits, car_clock, verifier, identity, self._profile)
            self._link = GateConnection(
                decides, name, self._wire, signer, self._profile
            )  # which lets others see the car
            rates["gate"], self._acts["gate"] = 1e9 / PERIOD, self._tick_gate
        else:
            if self._drives:
                self._wire.subscribe(self._profile.topic_of(name, Role.MANUAL), self._receive_manual)
            transport.announce(presence_of(name))
        self._schedule = Schedule(rates, clock.steady(), self._rng)
        for fault in faults:
            self._faults.add(fault, clock.steady())

    def begin(self, seed: int) -> None:
        """Go to the start of a seed; wheels and commands are as if nothing had been."""
        self._began = self._moved = self._clock.steady()
        self._rng = np.random.default_rng([seed % 2**64, self.world.agent])
        self.world.begin(seed)
        self._others.begin()
        if self._drives:
            self._wheels.clear()
            self._sensors.begin(self._rng)
            self._pixy.begin(self._rng)

    def _warm_up(self) -> None:
        """Do once what takes long at the first time: kernels and codecs are compiled, or loaded."""
        warm_up(self._profile)
        if not self._drives:
            self.world.follow(0.0)
            return
        self.world.drive(0.0, 0.0, 0.0)
        self.world.look(0)

    @property
    def next(self) -> int:
        """When something is due next, steady clock, ns."""
        return self._schedule.next

    def advance(self) -> None:
        """Do all that is due by the clock."""
        now = self._clock.steady()
        if self._faults.value("kill", now):
            self._die()
            return
        self._wire.flush()
        self._take_inbox()
        for due, name in self._schedule.until(now):
            self._move(due)
            self._acts[name](due, self._stamp(due) + self._faults.clock_error(due))
        if self._link is not None and self._link.news.is_set():
            self._link.publish_status()

    def _take_inbox(self) -> None:
        while self._inbox:
            try:
                self._inbox.popleft()()
            except CoopenvError as error:
                self._complain(f"{self.name}: {error}")

    def close(self) -> None:
        """Tell the wheels to stand, and forget what is under way."""
        if self._link is not None:
            self._link.neutral()
        self._wire.close()

    def _stamp(self, due: int) -> int:
        """Return the wall clock's time, ns, at a time of the steady clock."""
        return self._clock.wall() - self._clock.steady() + due

    def _move(self, to: int) -> None:
        """Carry the body to a time, unless it is there already."""
        if not self._drives:
            self.world.follow(max(to - self._began, 0) * 1e-9)
        elif to > self._moved:
            for duration, drive in self._wheels.pieces(self._moved, to):
                self.world.drive(duration, drive.speed, drive.steering)
            self._moved = to

    def _tick_gate(self, due: int, _stamp: int) -> None:
        """Obey the gate's command; a frozen computer sends none."""
        if self._link is not None and not self._faults.value("freeze", due):
            # The dead time of the scenario is that from a command to its effect, the gate's turn in it.
            self._obey(self._link.tick(), max(self._link.commanded, due - PERIOD))

    def _obey(self, payload: bytes, at: int) -> None:
        try:
            self._wheels.receive(read_drive(payload, self._profile.command), at)
        except Malformed as error:
            raise CoopenvError(f"{self._profile.topics[Role.MANUAL].type}: cannot be read ({error})") from None

    # Called in threads of the transport: they only keep what has come.

    def _receive_manual(self, arrival: Arrival) -> None:
        self._inbox.append(partial(self._obey, arrival.payload, self._clock.steady()))

    def _receive_reset(self, arrival: Arrival) -> None:
        def begin() -> None:
            self.begin(int(decode(arrival.payload, "std_msgs/msg/Int64").data))

        self._inbox.append(begin)

    def _receive_fault(self, arrival: Arrival) -> None:
        def add() -> None:
            text = str(decode(arrival.payload, "std_msgs/msg/String").data)
            self._faults.add(fake_fault(text), self._clock.steady())

        self._inbox.append(add)
