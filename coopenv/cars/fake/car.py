"""A fake car: its world, sensors and wheels on one clock, and its end of the network."""

import sched
import sys
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import KW_ONLY, dataclass
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np

from coopenv.base.errors import CoopenvError
from coopenv.base.fault_text import Fault
from coopenv.cars.backend.binding import Binding
from coopenv.cars.fake.sensors import LEADER_RATE, TRUTH_RATE, Act, CarSensors, FakeCamera, SensorPublisher
from coopenv.cars.fake.settings import USUAL, CarFaults, FakeSettings, Wire, end_process, fake_fault, fault_topic
from coopenv.cars.fake.world import Actuators, CarWorld, Neighbours
from coopenv.cars.gate.gate import PERIOD, GateClock
from coopenv.cars.gate.process import GateConnection
from coopenv.cars.gate.wheel_command import MotionCommand, read_drive, write_drive
from coopenv.cars.link.clock import Clock
from coopenv.cars.link.transport import Callback, Transport
from coopenv.cars.messages.cdr import Malformed
from coopenv.cars.messages.codec import decode, pose, stamp_of, warm_up
from coopenv.cars.messages.readings import READERS, CarPose, Sample, read
from coopenv.cars.messages.vision import Calibration
from coopenv.cars.settings.profile import RESET_TOPIC, Role, presence_of

LATE = 50_000_000
"""ns: measurements that are overdue for longer than this are left out, as after a computer that stood still."""
MOST_WAITING, MOST_LINES = 256, 100
"""Messages that wait for the next turn, the oldest of more are dropped; and errors of messages that are printed."""


@dataclass(eq=False, repr=False)
class Fake:
    """A fake car, a vehicle or a moving landmark; `advance` runs all due events in one thread."""

    binding: Binding
    name: str
    transport: Transport  # stays the caller's; its wall clock is that of motion capture
    _: KW_ONLY
    seed: int = 0  # of where it starts and of its errors, which are those of the simulation with that key
    differential: bool = False  # the wheels measure a turn rate, because no other sensor does
    gate: Callable[[Transport, GateClock], GateConnection] | None = None
    """Connects a gate of its own, through which commands come; None: it obeys ManualControl on the network."""
    settings: FakeSettings = USUAL

    def __post_init__(self) -> None:
        """Put the car at the start of a seed. Its gate announces it; a moving landmark announces itself."""
        binding, name, transport, settings = self.binding, self.name, self.transport, self.settings
        self._clock = clock = transport.clock
        self._profile, self._faults = binding.profile, CarFaults()
        scenario, self._drives = binding.scenario, name in binding.cars
        agent = len(scenario.landmarks) + binding.cars[name] if self._drives else binding.leaders[name]
        self.world = CarWorld(scenario, agent, frames=self._profile.sees_frames)
        self._origin = np.array(scenario.map.origin)
        self._wire = Wire(transport, self._faults, clock.steady, self.seed, settings)
        self._inbox: deque[Callable[[], None]] = deque(maxlen=MOST_WAITING)
        self._errors = 0  # of messages
        self._others = Neighbours(self.world, binding, name, transport)
        self._link: GateConnection | None = None
        self._outside = SensorPublisher(name, self._profile, transport)  # motion capture: not the car's own link
        self._publisher = SensorPublisher(name, self._profile, self._wire)
        acts: list[tuple[float, Act]] = [(TRUTH_RATE, self._truth)]
        if self._drives:
            self._camera = FakeCamera(self.world, binding, self._others, self._faults, self._publisher, settings)
            self._sensors = CarSensors(self.world, self._publisher, settings, differential=self.differential)
            latency = scenario.limits[self.world.vehicle].latency if settings.latency is None else settings.latency
            self._wheels = Actuators(latency, self._profile.command.timeout)
            acts += [*self._camera.acts, *self._sensors.acts]
        else:
            acts.append((LEADER_RATE, self._leader))
        self.begin(self.seed)
        warm_up(self._profile)  # once what takes long at the first time: codecs and kernels are compiled, or loaded
        self._move(self._began + 1)
        if self._drives:
            self.world.look(0)
        transport.subscribe(RESET_TOPIC, self._later(self._reset))
        transport.subscribe(fault_topic(name), self._later(self._fault))
        if self._drives and self.gate is not None:
            car_clock = GateClock(lambda: clock.wall() + self._faults.clock_error(clock.steady()), clock.steady)
            self._link = self.gate(self._wire, car_clock)
            acts.append((1e9 / PERIOD, self._tick_gate))
        elif self._drives:  # presence is the gate's, and ends with it
            transport.subscribe(self._profile.topic_of(name, Role.MANUAL), self._later(self.obey))  # on the car
        else:
            transport.announce(presence_of(name))
        self._now = start = clock.steady()
        self._events, self._phases = sched.scheduler(lambda: self._now, lambda _: None), self._rng
        for number, (rate, act) in enumerate(acts):
            self._repeat(number, start + 1e9 / rate * self._phases.uniform(0.1, 1.0), 1e9 / rate, act)

    def begin(self, seed: int) -> None:
        """Go to the start of a seed; wheels and commands are as if nothing had been."""
        self._began = self._moved = self._clock.steady()
        self._rng = np.random.default_rng([seed % 2**64, self.world.agent])
        self.world.begin(seed)
        self._others.begin()
        if self._drives:
            self._wheels.clear()
            self._sensors.begin(self._rng)
            self._camera.begin(self._rng)

    @property
    def next(self) -> int:
        """Time of the next event, steady clock, ns."""
        return int(min(self._events.queue[0].time, self._wire.next))

    def add_fault(self, fault: Fault) -> None:
        """Let a fault happen, its start counted from now."""
        self._faults.add(fault, self._clock.steady())

    def advance(self) -> None:
        """Do all that is due by the clock."""
        self._now = now = self._clock.steady()  # what falls due meanwhile waits: messages go out first
        if self._faults.value("kill", now):
            end_process()
            return
        self._wire.flush()
        while self._inbox:
            try:
                self._inbox.popleft()()
            except CoopenvError as error:
                self._errors += 1
                if self._errors <= MOST_LINES:
                    last = "; further errors are not printed" if self._errors == MOST_LINES else ""
                    print(f"{self.name}: {error}{last}", file=sys.stderr, flush=True)
        self._events.run(blocking=False)
        if self._link is not None and self._link.news.is_set():
            self._link.publish_status()

    def _repeat(self, number: int, regular: float, period: float, act: Act) -> None:
        """Let something be done at a regular time, ns, jitter aside, and again after each period."""
        due = int(regular + period * self.settings.jitter * self._phases.uniform(-1.0, 1.0))
        self._events.enterabs(due, number, self._do, (due, number, regular, period, act))

    def _do(self, due: int, number: int, regular: float, period: float, act: Act) -> None:
        self._repeat(number, regular + period, period, act)
        if due >= self._clock.steady() - LATE:
            self._move(due)
            act(due, self._stamp(due) + self._faults.clock_error(due))

    def close(self) -> None:
        """Stop the wheels, and discard the messages under way."""
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
                self._drive(duration, drive)
            self._moved = to

    def _drive(self, duration: float, drive: MotionCommand) -> None:
        s, brake = self.settings, self._profile.command.brake
        deceleration = brake.deceleration if brake and drive.brake else s.deceleration
        speed, steering = s.speed_gain * drive.speed, s.steering_gain * drive.steering + s.steering_offset
        self.world.drive(duration, speed, steering, deceleration)

    def _truth(self, due: int, _stamp: int) -> None:
        """Publish the message of motion capture, whose clock is right."""
        placed, twist = {"pose": self._pose()}, {"twist": self.world.twist}
        self._outside.send(Role.TRUTH, self._stamp(due), "mocap", child_frame_id=self.name, pose=placed, twist=twist)

    def _leader(self, _due: int, stamp: int) -> None:
        self._publisher.send(Role.ESTIMATE, stamp, "map", pose={"pose": self._pose()})

    def _pose(self) -> object:
        R, p = self.world.pose(self.world.agent)
        return pose(R, p + self._origin)

    def _tick_gate(self, due: int, _stamp: int) -> None:
        """Obey the gate's command; a frozen computer sends none."""
        if self._link is not None and not self._faults.value("freeze", due):
            # The dead time of the scenario is that from a command to its effect, the gate's turn in it.
            begin = max(self._link.commanded, due - PERIOD) if self.settings.latency is None else due
            self.obey(self._link.tick(), begin)

    def _later(self, act: Callable[[bytes, int], None]) -> Callback:
        """Return a callback for threads of the transport, which keeps a message and when it came, steady clock, ns."""
        return lambda arrival: self._inbox.append(partial(act, arrival.payload, self._clock.steady()))

    def obey(self, payload: bytes, at: int) -> None:
        """Take a message of a gate at a time, steady clock, ns; a frozen computer does not."""
        if self._faults.value("freeze", at):
            return
        try:
            self._wheels.receive(read_drive(payload, self._profile.command), at)
        except Malformed as error:
            raise CoopenvError(f"{self._profile.topics[Role.MANUAL].type}: cannot be read ({error})") from None

    def _reset(self, payload: bytes, _at: int) -> None:
        self.begin(int(decode(payload, "std_msgs/msg/Int64").data))

    def _fault(self, payload: bytes, _at: int) -> None:
        self.add_fault(fake_fault(str(decode(payload, "std_msgs/msg/String").data)))


Sent = Mapping[Role, Sequence[Sample]]
"""Samples by role in the order of their stamps, by the sender's clock, with times of reception."""


def replay(
    binding: Binding,
    car: str,
    commands: Sequence[tuple[int, MotionCommand]],
    settings: FakeSettings,
    seed: int,
    start: CarPose | None = None,
) -> Sent:
    """Return a fake's messages under commands at times in ns, up to the last one; `start` is its pose (None: any)."""
    now = commands[0][0]
    arrived: list[tuple[str, bytes, int]] = []
    network: Any = SimpleNamespace(**dict.fromkeys(("subscribe", "announce", "watch", "close"), lambda *_: None))
    network.clock = Clock(lambda: now, lambda: now)
    network.publish = lambda topic, payload, *_, **__: arrived.append((topic, payload, now))  # without other ends
    fake = Fake(binding, car, network, seed=seed, settings=settings)
    if start is not None and start.rotation is not None:
        fake.world.put(fake.world.agent, start.rotation, start.position - np.array(binding.scenario.map.origin))
    waiting = list(reversed(commands))
    while waiting:
        now = max(now + 1, min(fake.next, waiting[-1][0]))
        fake.advance()
        while waiting and waiting[-1][0] <= now:
            at, drive = waiting.pop()
            fake.obey(write_drive(at, binding.profile.command, drive), at)
    roles = {binding.profile.topic_of(car, role): role for role in READERS}
    found: dict[Role, list[Sample]] = {}
    lens = Calibration.of(binding.scenario.cameras[binding.cars[car]])
    for topic, payload, received in arrived:
        with suppress(CoopenvError):  # of no use to readers either
            role = roles[topic]
            message = decode(payload, binding.profile.topics[role].type)
            value = read(role, message, lens, known=binding.targets, vision=binding.profile.vision)
            found.setdefault(role, []).append(Sample(car, role, stamp_of(message), received, value))
    return {role: sorted(samples, key=lambda sample: sample.stamp) for role, samples in found.items()}
