"""The SVEA backend: cars on a network in place of the simulated ones."""

import gc
import threading
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from coopenv.base.errors import CoopenvError, DataWarning, ScenarioError, listed
from coopenv.base.installation import scenario_path
from coopenv.cars.backend.assembler import BROADCAST, Assembler, Intake
from coopenv.cars.backend.binding import Binding, bind, reset_options
from coopenv.cars.backend.buffers import ROLES, StatusBoard
from coopenv.cars.backend.recorded_drive import PRESENCE, DriveRecorder, RecordedTransport, head_of
from coopenv.cars.backend.station import UNTRIED, Gates, Pacer, Station
from coopenv.cars.backend.watchdog import LinkMonitor, Trip, Watchdog, bearing_nis, since
from coopenv.cars.doctor.finding import Finding, Treatment
from coopenv.cars.doctor.live import StreamMonitor, examined
from coopenv.cars.gate.wheel_command import MotionCommand
from coopenv.cars.link.connect import open_transport
from coopenv.cars.link.keys import Signer, Verifier, load_keys
from coopenv.cars.link.transport import Arrival, ReceivingTransport, Transport
from coopenv.cars.messages.codec import encode, make, warm_up
from coopenv.cars.messages.readings import Sample, implausible
from coopenv.cars.messages.v2x import estimate_message, report_message
from coopenv.cars.settings.deployment import Deployment, load_deployment
from coopenv.cars.settings.profile import RESET_TOPIC, VELOCITY, Role, presence_of
from coopenv.estimation.poses import left_covariance
from coopenv.observers.sensed import Sensed
from coopenv.scenario import Scenario, load_scenario
from coopenv.scenario.files import OVERRIDES
from coopenv.sources.base import EPISODE_OVER, Capabilities, Command, Health, VehicleBroadcast

EXPECTED = ("reset", "closed", EPISODE_OVER)
"""Reasons to stop that are no emergency."""

FIRST_MESSAGES_TIME = 3.0  # s to wait for first messages at the first reset
CAMERA_INFO_TIME = 1.5  # s to wait for the calibration of a camera; some publish none
READY_TIME = 2.0  # s to wait until all conditions of arming hold at once; cars publish theirs once a second
SETTLE = 0.5  # s for fakes to settle at their start


@dataclass(eq=False, repr=False)
class Svea:
    """Cars as a source of ticks.

    `reset(options={"arm": True})` lets them drive; without it everything happens but that commands are sent. An episode
    ends early when the watchdog stops the cars; `notes` give the reason.
    """

    deployment: Deployment
    binding: Binding
    transport: Transport  # by whose clock ticks are due; closed with the backend
    signer: Signer | None = None  # signs sent messages (None: they are not signed)
    verifier: Verifier | None = None  # knows the cars' keys (None: signatures do not count)
    recorder: DriveRecorder | None = None  # records the messages of the ticks, and the reasons of stops

    def __post_init__(self) -> None:
        """Listen to the cars."""
        deployment, binding, transport = self.deployment, self.binding, self.transport
        self.scenario, self._clock = binding.scenario, transport.clock
        self.capabilities = Capabilities(
            truth=deployment.sensors.truth,
            driven=True,
            real_time=True,
            simulated_clock=transport.clock.simulated,
            ticks=None,
            batched=False,
            estimated=None if not binding.remote else binding.local,
        )
        self.health = Health()
        self.refused: dict[str, int] = {}
        """Samples that were not used, by reason."""
        self.pacer = Pacer(1.0 / self.scenario.rates.camera, self.scenario.ticks_per_decision, self._clock)
        self._origin = np.array(self.scenario.map.origin)
        landmarks = self.scenario.landmarks
        self._landmarks = np.array([mark.position for mark in landmarks]).reshape(-1, 3) - self._origin
        self._static = np.array([mark.motion.kind == "static" for mark in landmarks], dtype=bool)
        self._armed, self._received_once, self._began, self._index = False, False, 0, 0
        self._key, self._episode = 0, 0
        self._closed = threading.Lock()
        profile, fleet = binding.profile, (*binding.cars, *binding.leaders)
        self._local = {binding.names[i]: i for i in binding.local}
        cars, others = tuple(self._local), tuple(name for name in fleet if name not in self._local)
        self._odometry = VELOCITY[deployment.sensors.odometry]
        self.intake, self._assembler = Intake(binding, deployment.sensors), Assembler(binding)
        identity, zenoh = deployment.security.identity, deployment.network.kind == "zenoh"
        signers = {profile.topic_of(name, role): (name, identity) for name in fleet for role in BROADCAST}
        self.station = Station(transport, self.intake.topics, self.verifier, signers)
        self.gates = Gates(transport, cars, deployment.limits, self.signer, self.verifier, profile, zenoh)
        self.board = StatusBoard(transport, cars, deployment.remote, deployment.conditions, profile)
        self.monitor = LinkMonitor(deployment.safety.judge)
        self._streams = StreamMonitor(binding, deployment.sensors.trust, self.intake.lenses)
        self.watchdog = Watchdog(
            *(deployment.safety, self.station, self.gates, self.monitor, cars, others, self._odometry),
            *(1.0 / self.scenario.rates.decision, self.board.happened, self._write_down),
        )
        transport.watch(presence_of("*"), self.watchdog.set_present)
        transport.announce(presence_of(identity))
        warm_up(profile)

    @property
    def clock(self) -> float:
        """Time since the reset, s."""
        return (self.pacer.now() - self._began) * 1e-9 if self._began else 0.0

    def reset(self, seed: int | None, options: Mapping[str, Any]) -> Sensed:
        """Begin an episode; cars move only with the option `arm`.

        Raises:
            CoopenvError: an option is not known, or a condition of arming does not hold.
        """
        self.stop("reset")
        arm, release = reset_options(options)
        gc.unfreeze()
        gc.collect()  # now, as that would take longer than a decision may
        gc.freeze()  # what is left is not looked through again while cars drive
        if self.deployment.fakes:
            self._streams.begin()
            signed = ((seed or 0) + 2**63) % 2**64 - 2**63  # the same 64 bits
            self.transport.publish(RESET_TOPIC, encode(make("std_msgs/msg/Int64", data=signed)), reliable=True)
            self._clock.sleep(SETTLE)  # they go to the start of the seed
        self.monitor.begin(self.pacer.now())
        self._listen(arm)
        self.station.dropped.clear()
        if arm:
            self._arm(release)
        self.drain()
        self._began, self._index = self.pacer.start(), 0
        self._key, self._episode = (self._key, self._episode + 1) if seed is None else (seed, 0)
        if self.recorder is not None:
            self.recorder.tick(0, self._began, self._key % 2**64, self._episode)
        return self._counted(self._assembler.begin(self._began))

    def _listen(self, arm: bool) -> None:
        """Wait a limited time for messages of the cars: only driving needs them."""
        topics = [self.binding.profile.topic_of(name, role) for name in self._local for role in self._odometry]
        patience = 0.0 if self._received_once else FIRST_MESSAGES_TIME
        self._clock.wait(lambda: all(self.station.silence(topic) < 1.0 for topic in topics), patience)
        if arm:
            self._clock.wait(lambda: self.board.calibrations.keys() >= self._local.keys(), CAMERA_INFO_TIME)
        self._received_once = True
        self.drain()

    def _arm(self, release: bool) -> None:
        """Open the gates, with `release` also of cars that another station has stopped, and watch the cars.

        Raises:
            CoopenvError: a condition of arming does not hold.
        """
        for finding in self._streams.constants():
            warnings.warn(str(finding), DataWarning, stacklevel=2)
        self._clock.wait(lambda: self._obstacle() is None, READY_TIME)
        if found := self._obstacle():
            raise CoopenvError(f"not armed: {found}")
        if (kind := self.deployment.network.kind) != "zenoh":
            warnings.warn(f"network.kind = {kind} {UNTRIED}", DataWarning, stacklevel=2)
        self.watchdog.forget()
        self.board.begin()
        self.gates.begin(release or self.deployment.fakes)
        self.watchdog.arm()
        self._armed = True

    def _obstacle(self) -> str | None:
        """Return the most basic condition of arming that is violated; None: all hold."""
        self.drain()
        return next((f"{car}: {why}" for car, why in self._obstacles()), None)

    def _obstacles(self) -> Iterator[tuple[str, str]]:
        safety, profile = self.deployment.safety, self.binding.profile
        for car in self._local:
            clocks = self.intake.unsynchronised(car, safety.max_clock_offset)  # other ages depend on them
            yield from (
                (car, f"{why}: let chrony or PTP synchronise them, or is a computer too busy?") for why in clocks
            )
            yield from ((car, why) for why in self.watchdog.silent(car))
            camera = profile.topic_of(car, Role(self.deployment.sensors.detections))
            if (age := self.station.silence(camera)) > safety.odometry_age:
                yield car, f"no camera frames on {camera} {since(age)}"
            right = self.deployment.sensors.corrections.get(car)
            own = self.board.obstacles(car, safety.min_battery, self.intake.calibrations[car], right)
            yield from ((car, why) for why in own)
            if why := self._streams.contradiction(car):
                yield car, f"its turn rate {why}"
            found = [finding for finding in self._streams.findings() if finding.car == car]
            yield from ((car, str(finding)) for finding in found if finding.treatment is Treatment.REFUSED)
        if safety.judge == "truth":  # estimates are not known before cars drive
            yield from self.watchdog.misplaced()

    def advance(self, command: Command) -> Iterator[Sensed]:
        """Send the commands and yield the ticks of one decision, each when it is due."""
        self._check_turns(command)
        self.pacer.decide()
        self.watchdog.beat(self.pacer.in_a_row)
        if self._armed:
            self.gates.next()
            for name, i in self._local.items():
                speed = float(command.speed[i]) if self.monitor.settled(name) else 0.0
                self.gates.command(name, speed, float(command.steering[i]), float(command.acceleration[i]))
        for _ in range(self.scenario.ticks_per_decision):
            if self._armed and self.watchdog.trip is not None:
                self._armed = False
                return
            now = self.pacer.wait()
            self.drain()
            self._index += 1
            if self.recorder is not None:
                self.recorder.tick(self._index, now)
            yield self._counted(self._assembler.tick(self._index, now))

    def _check_turns(self, command: Command) -> None:
        """Stop the cars, or warn if they are not armed, if a turn rate contradicts all else."""
        now = self.pacer.now()
        for name, i in self._local.items():
            sent = MotionCommand(float(command.steering[i]), float(command.speed[i]))
            self._streams.put(Sample(name, Role.COMMAND, now, now, sent))
            if why := self._streams.contradiction(name):
                text = f"{name}: its turn rate {why}"
                if self._armed:
                    self.watchdog.stop(text, name)
                else:
                    warnings.warn(text, DataWarning, stacklevel=2)

    def drain(self) -> None:
        """Take the messages that have come."""
        arrivals = self.station.drain()
        self.health.received += len(arrivals)
        for arrival in arrivals:
            if self.recorder is not None:
                self.recorder.write(arrival.topic, arrival.payload, arrival.received)
            for sample in self.intake.samples(arrival):
                if self._assembler.put(sample):
                    self.monitor.put(sample)
                elif why := implausible(sample):
                    self.monitor.odd[sample.car, sample.role] = why
                else:
                    continue
                self._streams.put(sample)  # in whatever unit: the streams together show it
        self.monitor.looked = self.pacer.now()

    def _counted(self, tick: Sensed) -> Sensed:
        self._tick = tick
        self.health.count(tick, list(self.binding.local))
        refused = sum(self.intake.rejected.values(), self._assembler.refused + self.station.dropped)
        self.refused, self.health.rejected = dict(refused), sum(refused.values())
        return tick

    def broadcast(self, sent: Sequence[VehicleBroadcast]) -> None:
        """Send the estimates of the vehicles estimated here at the present tick."""
        for each in sent:
            name, moment = self.binding.names[each.vehicle], self._assembler.moment(each.vehicle)
            if not all(np.isfinite(part).all() for part in (each.rotation, each.position, each.covariance)):
                continue
            self._judge(name, each)
            if self.deployment.safety.judge == "estimate" and self.monitor.settled(name):  # it jumps before
                self.monitor.place(name, each.position + self._origin, moment)
            self.gates.send(name, Role.ESTIMATE, encode(estimate_message(each, moment, self._origin)))
            if (report := report_message(each, moment, self._origin)) is not None:
                self.gates.send(name, Role.REPORT, encode(report))

    def _judge(self, name: str, sent: VehicleBroadcast) -> None:
        """Compare an estimate with the truth, the bearings and its own covariance at its tick."""
        tick, i = self._tick, sent.vehicle
        seen = np.flatnonzero(tick.visible[i][: len(self._static)] & self._static)
        R, p, P = sent.rotation, sent.position, sent.covariance
        stated, lever = bool(P.any()), np.array(self.scenario.cameras[i].position)
        nis = bearing_nis(sent, self._landmarks[seen], lever, tick.bearings[i][seen]) if stated else np.zeros(0)
        std = float(np.sqrt(max(np.linalg.eigvalsh(left_covariance(R.T @ p, P)[3:, 3:])[-1], 0.0)))
        error = turn = float("nan")
        if tick.truth is not None:
            error = float(np.linalg.norm(p - tick.truth.position[i]))
            turn = float(np.arccos(np.clip(0.5 * (np.vdot(R, tick.truth.rotation[i]) - 1.0), -1.0, 1.0)))
        known = sent.message is None or sent.message.position is not None
        self.monitor.judge(name, self.deployment.safety, error, turn, std, sent.protection_level, nis, known)

    def notes(self, vehicle: int) -> dict[str, Any]:
        """Return the entries of a vehicle's info about its car and the network; it is one that is estimated here."""
        name = self.binding.names[vehicle]
        trip = self.watchdog.trip or Trip("")
        return {
            "name": name,
            "armed": self._armed,
            "stopped": trip.reason,
            "stopped_by": trip.car,
            "gate": self.gates.states[name].state,
            "gate_rejections": self.gates.refused(name),
            "rejections": dict(self.refused),
            "missed_deadlines": self.pacer.missed,
            "lateness": self.pacer.lateness[-1] if self.pacer.lateness else 0.0,
            "clock_offset": self.intake.offset_of(name),
        }

    def _write_down(self, trip: Trip) -> None:
        if self.recorder is not None:
            self.recorder.stopped(trip.reason, trip.car, self.pacer.now())

    def stop(self, reason: str) -> None:
        """Bring the cars to a stand at once and end the episode."""
        if self._armed and reason in EXPECTED:
            self.watchdog.disarm()
            self.gates.end()
        elif self._armed:
            self.watchdog.stop(reason)
        self._armed = False

    def close(self) -> None:
        """Stop, and leave the network. Raises OutputError: the messages could not be written to the end."""
        if not self._closed.acquire(blocking=False):
            return
        self.stop("closed")
        self.watchdog.close()
        try:
            if self.recorder is not None:
                self.recorder.close()
        finally:
            self.transport.close()
            gc.unfreeze()


def open_svea(
    path: str | Path,
    environment: str | None = None,
    overrides: Mapping[str, Any] | None = None,
    car: str | None = None,
    record: str | Path | None = None,
    transport: Transport | None = None,
    connect: str | None = None,
    watch: bool = False,
) -> Svea:
    """Return the cars of a deployment file as a backend.

    Args:
        path: the file.
        environment: name or path in place of the file's own.
        overrides: dotted keys of the environment, after the file's.
        car: estimate and drive this car alone, receive from the others (None: estimate all, as an edge server does).
        record: MCAP file to write what comes and goes to.
        transport: a network that is open already (None: that of the file).
        connect: endpoint in place of the file's.
        watch: only receive: nothing is sent, fakes are not moved, and no car can be armed.

    A `DataWarning` names landmarks and vehicles that cameras cannot identify.

    Raises:
        CoopenvError: one line that names the file and the field, or what cannot be reached.
    """
    deployment = load_deployment(path, connect)
    scenario = scenario_of(deployment, environment, overrides or {})
    binding = bind(scenario, deployment.cars, deployment.markers, Path(path).name, car, deployment.profile)
    if binding.unmarked:
        remark = f"{Path(path).name}: no markers, so cameras cannot identify them: {listed(binding.unmarked)}"
        warnings.warn(DataWarning(remark), stacklevel=2)
    signer, verifier = load_keys(deployment.keys, car or deployment.security.identity, binding.cars)
    link = open_transport(deployment) if transport is None else transport
    link = ReceivingTransport(link) if watch else link
    try:
        types = _types(binding, deployment.security.identity)
        recorder = None if record is None else DriveRecorder(Path(record), head_of(deployment, binding, car), types)
    except CoopenvError:
        link.close()
        raise
    if recorder is not None:
        roles, names = (Role.GATE, Role.STOP, *ROLES), [binding.names[i] for i in binding.local]
        aside = [binding.profile.topic_of(name, role) for name in names for role in roles]
        link = RecordedTransport(link, recorder, aside)
    return Svea(deployment, binding, link, signer, verifier, recorder)


def open_cars(name: str, overrides: Mapping[str, Any], deployment: str | Path | None = None, **options: Any) -> Svea:
    """Return the cars of a deployment file: the given one, or `name` itself.

    Raises:
        CoopenvError: there is no deployment, or as for `open_svea`, which has the options.
    """
    if deployment is None and not str(name).endswith(".toml"):
        raise CoopenvError(f"deployment: needed by backend='svea': the file with the cars that drive {name}")
    return open_svea(deployment or name, None if deployment is None else name, overrides, **options)


def scenario_of(deployment: Deployment, environment: str | None, overrides: Mapping[str, Any]) -> Scenario:
    """Return the environment of a deployment.

    Args:
        deployment: names it, and has overrides of it.
        environment: name or path in place of its own.
        overrides: after the deployment's.

    Raises:
        CoopenvError: there is no such environment, or an override is not valid.
    """
    own, file = deployment.environment, deployment.file.name
    if own.endswith(".toml"):
        own = str(deployment.folder / own)
    try:
        scenario_path(own if environment is None else environment)
    except CoopenvError as error:
        raise error if environment is not None else CoopenvError(f"{file}: environment: {error}") from None
    try:
        return load_scenario(environment or own, {**deployment.overrides, **overrides})
    except ScenarioError as error:
        try:
            load_scenario(environment or own, deployment.overrides)
        except ScenarioError as of_the_file:
            if str(of_the_file).startswith("override"):
                raise CoopenvError(f"{file}: {str(of_the_file).replace(OVERRIDES, 'overrides', 1)}") from None
        raise error


def examined_arrivals(arrivals: Sequence[Arrival], fleet: Deployment) -> list[Finding]:
    """Return the streams of a fleet's cars that others contradict, by messages in the order of their reception."""
    scenario = scenario_of(fleet, None, {})
    binding = bind(scenario, fleet.cars, fleet.markers, fleet.file.name, None, fleet.profile)
    intake = Intake(binding, fleet.sensors)
    samples = [sample for arrival in arrivals for sample in intake.samples(arrival)]
    found = examined(samples, binding, fleet.sensors.trust, intake.lenses, constants=True)
    return [finding for some in found.values() for finding in some]


def _types(binding: Binding, identity: str) -> dict[str, str]:
    """Return the type of every topic of the cars, presence included."""
    names = (*binding.cars, *binding.leaders)
    profile = binding.profile
    types = {profile.topic_of(name, role): topic.type for name in names for role, topic in profile.topics.items()}
    present = {presence_of(name): PRESENCE for name in (*names, identity)}
    return {**types, **present, RESET_TOPIC: "std_msgs/msg/Int64"}
