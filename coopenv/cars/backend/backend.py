"""The SVEA backend: cars on a network in place of the simulated ones."""

import gc
import threading
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from coopenv.backends.base import EPISODE_OVER, Capabilities, Command, Health, VehicleBroadcast
from coopenv.base.errors import CoopenvError, DataWarning, ScenarioError, listed
from coopenv.base.installation import scenario_path
from coopenv.cars.backend.assembler import Assembler
from coopenv.cars.backend.binding import (
    Binding,
    bind,
    estimate_message,
    is_finite,
    report_message,
    reset_options,
)
from coopenv.cars.backend.drive import PRESENCE, DriveRecorder, RecordedTransport, head_of
from coopenv.cars.backend.start import ROLES, Links
from coopenv.cars.backend.station import Pacer
from coopenv.cars.backend.watchdog import Trip
from coopenv.cars.codec import encode, warm_up
from coopenv.cars.deployment import Deployment, load_deployment
from coopenv.cars.keys import Signer, Verifier, check_known, load_signer, load_verifier
from coopenv.cars.profile import RESET_TOPIC, Role, presence_of
from coopenv.cars.transport.base import Transport
from coopenv.cars.transport.zenoh import open_transport
from coopenv.observers.recording import Sensed
from coopenv.scenario import Scenario, load_scenario
from coopenv.scenario.files import OVERRIDES

EXPECTED = ("reset", "closed", EPISODE_OVER)
"""Reasons to stop that are no emergency."""


@dataclass
class LinkHealth(Health):
    """What has come over the network as well."""

    missed: int = 0  # decisions that came too late for their first tick
    refused: dict[str, int] = field(default_factory=dict)  # samples that were not used, by reason


class Svea(Links):
    """Cars as a source of ticks.

    `reset(options={"arm": True})` lets them drive; without it everything happens but that commands are sent. An episode
    ends early when the watchdog stops the cars; `notes` give the reason.
    """

    def __init__(
        self,
        deployment: Deployment,
        binding: Binding,
        transport: Transport,
        signer: Signer | None = None,
        verifier: Verifier | None = None,
        recorder: DriveRecorder | None = None,
    ) -> None:
        """Listen to the cars.

        Args:
            deployment: the fleet.
            binding: vehicles and markers of its cars.
            transport: the network; closed with the backend.
            signer: signs sent messages (None: they are not signed).
            verifier: knows the cars' keys (None: signatures do not count).
            recorder: records the messages of the ticks, and the reasons of stops.
        """
        self.recorder = recorder
        self.capabilities = Capabilities(
            truth=deployment.sensors.truth,
            driven=True,
            real_time=True,
            ticks=None,
            batched=False,
            estimated=None if not binding.remote else binding.local,
        )
        self.link = LinkHealth()
        self.health: Health = self.link
        self.pacer = Pacer(1.0 / binding.scenario.rates.camera, binding.scenario.ticks_per_decision)
        self._assembler = Assembler(binding)
        self._origin = np.array(binding.scenario.map.origin)
        self._armed, self._began, self._index = False, 0, 0
        self._key, self._episode = 0, 0
        self._closed = threading.Lock()
        super().__init__(deployment, binding, transport, signer, verifier, self._write_down)
        warm_up(binding.profile)

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
        self.prepare(0 if seed is None else seed)
        self.monitor.begin(self.pacer.now())
        self.listen(arm)
        self.station.dropped.clear()
        if arm:
            self.arm(release)
            self._armed = True
        self.drain()
        self._began, self._index = self.pacer.start(), 0
        self._key, self._episode = (self._key, self._episode + 1) if seed is None else (seed, 0)
        if self.recorder is not None:
            self.recorder.tick(0, self._began, self._key % 2**64, self._episode)
        return self._counted(self._assembler.begin(self._began))

    def advance(self, command: Command) -> Iterator[Sensed]:
        """Send the commands and yield the ticks of one decision, each when it is due."""
        self.pacer.decide()
        self.link.missed = self.pacer.missed
        self.watchdog.beat(self.pacer.in_a_row)
        if self._armed:
            self.gates.next()
            for name, i in self._local.items():
                speed, steering, acceleration = command.speed[i], command.steering[i], command.acceleration[i]
                self.gates.command(name, float(speed), float(steering), float(acceleration))
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

    def drain(self) -> None:
        """Take the messages that have come."""
        arrivals = self.station.drain()
        self.health.received += len(arrivals)
        for arrival in arrivals:
            if self.recorder is not None:
                self.recorder.write(arrival.topic, arrival.payload, arrival.received)
            for sample in self.intake.samples(arrival):
                self._assembler.put(sample)
                self.monitor.put(sample)
        self.monitor.looked = self.pacer.now()

    def _counted(self, tick: Sensed) -> Sensed:
        local = list(self.binding.local)
        missing = np.asarray(tick.missing)[local]
        self.health.ticks += 1
        self.health.late += int(np.asarray(tick.late)[local].sum())
        self.health.missing += int(missing.sum())
        self.health.empty += int((~tick.visible[local].any(axis=-1) & ~missing).sum())
        refused = self._assembler.refused + self.station.dropped
        for counts in self.intake.rejected.values():
            refused += counts
        self.link.refused, self.health.rejected = dict(refused), sum(refused.values())
        return tick

    def broadcast(self, sent: Sequence[VehicleBroadcast]) -> None:
        """Send the estimates of the vehicles estimated here at the present tick."""
        for each in sent:
            name, moment = self.binding.names[each.vehicle], self._assembler.moment(each.vehicle)
            if not is_finite(each):
                continue
            if self.deployment.safety.judge == "estimate":
                self.monitor.place(name, each.position + self._origin, moment)
            self._publish(name, Role.ESTIMATE, estimate_message(each, moment, self._origin))
            report = report_message(each, moment, self._origin)
            if report is not None:
                self._publish(name, Role.REPORT, report)

    def _publish(self, name: str, role: Role, message: Any) -> None:
        topic, payload = self.binding.profile.topic_of(name, role), encode(message)
        signature = b"" if self._signer is None else self._signer.sign(topic, payload)
        self._transport.publish(topic, payload, signature)

    def notes(self, vehicle: int) -> dict[str, Any]:
        """Return the entries of a vehicle's info about its car and the network."""
        name = self.binding.names[vehicle]
        gate, trip = self.gates.states.get(name), self.watchdog.trip
        offset = self.intake.offsets[name].seconds
        return {
            "name": name,
            "armed": self._armed,
            "stopped": "" if trip is None else trip.reason,
            "stopped_by": "" if trip is None else trip.car or "",
            "gate": "unknown" if gate is None else gate.state,
            "gate_rejections": {} if gate is None else self.gates.refused(name),
            "rejections": dict(self.link.refused),
            "missed_deadlines": self.link.missed,
            "lateness": self.pacer.lateness[-1] if self.pacer.lateness else 0.0,
            "clock_offset": float("nan") if offset is None else offset,
        }

    def _write_down(self, trip: Trip) -> None:
        if self.recorder is not None:
            self.recorder.stopped(trip.reason, trip.car or "", self.pacer.now())

    def stop(self, reason: str) -> None:
        """Bring the cars to a stand at once and end the episode."""
        if self._armed and reason in EXPECTED:
            self.watchdog.disarm()
            self.gates.end()
        elif self._armed:
            self.watchdog.stop(reason)
        self._armed = False

    def close(self) -> None:
        """Stop, and leave the network. Raises OutputError: what comes and goes could not be written to the end."""
        if not self._closed.acquire(blocking=False):
            return
        self.stop("closed")
        self.watchdog.close()
        try:
            if self.recorder is not None:
                self.recorder.close()
        finally:
            self._transport.close()
            gc.unfreeze()


def open_svea(
    path: str | Path,
    environment: str | None = None,
    overrides: Mapping[str, Any] | None = None,
    car: str | None = None,
    record: str | Path | None = None,
    transport: Transport | None = None,
    connect: str | None = None,
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
    signer, verifier = _keys(deployment, binding, car)
    link = open_transport(deployment) if transport is None else transport
    try:
        types = _types(binding, deployment.security.identity)
        recorder = None if record is None else DriveRecorder(Path(record), head_of(deployment, binding, car), types)
    except CoopenvError:
        link.close()
        raise
    if recorder is not None:
        names = [binding.names[i] for i in binding.local]
        aside = {binding.profile.topic_of(name, role) for name in names for role in (Role.GATE, *ROLES)}
        link = RecordedTransport(link, recorder, aside, {binding.profile.topic_of(name, Role.STOP) for name in names})
    return Svea(deployment, binding, link, signer, verifier, recorder)


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


def _keys(deployment: Deployment, binding: Binding, car: str | None) -> tuple[Signer | None, Verifier | None]:
    folder = deployment.keys
    if folder is None:
        return None, None
    verifier = load_verifier(folder)
    for name in binding.cars:
        check_known(verifier, name, folder)
    return load_signer(folder, car or deployment.security.identity), verifier


def _types(binding: Binding, identity: str) -> dict[str, str]:
    """Return the type of every topic of the cars, presence included."""
    names = (*binding.cars, *binding.leaders)
    profile = binding.profile
    types = {profile.topic_of(name, role): topic.type for name in names for role, topic in profile.topics.items()}
    present = {presence_of(name): PRESENCE for name in (*names, identity)}
    return {**types, **present, RESET_TOPIC: "std_msgs/msg/Int64"}
