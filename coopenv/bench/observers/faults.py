"""Variants with faults: changes of a recording, or keys of a scenario.

The truth and the odometry of a recording are never changed. Every random draw is a function of the seed and the fault.
The spelling is that of `coopenv.base.fault_text`; `/` joins several faults of one variant, for example
`vehicle_2:lie=drift:0.05@10/gyro_bias=0.0175`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from coopenv.base.errors import CoopenvError, listed, suggest
from coopenv.base.fault_text import Fault, FaultError, FaultKind, parse_fault
from coopenv.scenario import Scenario, load_scenario
from coopenv.scenario.schema import neighbour_sets, processing_order
from coopenv.scenario.sensing import LONGEST_REPLAY

if TYPE_CHECKING:
    from coopenv.observers.recording import Recording

NOMINAL = "nominal"
DIRECTION = np.array([0.6, 0.8, 0.0])
"""Of a false position, map axes: horizontal, and along no road."""


def with_loss(recording: Recording, fault: Fault, seed: int) -> Recording:
    """Lose each message, per receiver, with a probability in [0, 1]; the last received message stays known."""
    inbox = recording.inbox_tick
    news = np.diff(inbox, axis=0, prepend=-1) > 0
    kept = news & (np.random.default_rng([seed, 1]).random(inbox.shape) >= fault.value)
    return replace(recording, inbox_tick=np.maximum.accumulate(np.where(kept, inbox, -1), axis=0))


def with_delay(recording: Recording, fault: Fault, seed: int) -> Recording:
    """Deliver every message later, by a time that is rounded to whole ticks."""
    ticks = min(round(fault.value / recording.dt), recording.ticks)
    inbox = np.full_like(recording.inbox_tick, -1)
    inbox[ticks:] = recording.inbox_tick[: recording.ticks - ticks]
    return replace(recording, inbox_tick=inbox)


def with_wrong_association(recording: Recording, fault: Fault, seed: int) -> Recording:
    """Swap bearings within frames so that a share of all bearings carry the identity of another visible target.

    Every bearing starts a swap with another one of its frame, drawn at random, with half that probability, so that
    it is part of one with (nearly) the whole. A frame with a single bearing stays as it is.
    """
    bearings = recording.bearings.copy()
    generator = np.random.default_rng([seed, 2])
    starts = recording.visible & (generator.random(recording.visible.shape) < fault.value / 2)
    partners = generator.random(recording.visible.shape)
    for k, i, target in np.argwhere(starts):
        others = np.flatnonzero(recording.visible[k, i])
        others = others[others != target]
        if len(others):
            pair = [target, others[int(partners[k, i, target] * len(others))]]
            bearings[k, i, pair] = bearings[k, i, pair[::-1]]
    return replace(recording, bearings=bearings)


def without_landmarks(recording: Recording, fault: Fault, seed: int) -> Recording:
    """Hide all landmarks from a time on, for a duration."""
    start = fault.start_in(float(recording.t[-1]))
    lost = (recording.t >= start) & (recording.t < start + fault.duration)
    landmarks = np.arange(recording.visible.shape[2]) < recording.landmarks.shape[1]
    hidden = lost[:, None, None] & landmarks
    bearings = np.where(hidden[..., None], np.nan, recording.bearings)
    return replace(recording, visible=recording.visible & ~hidden, bearings=bearings)


def with_lie(recording: Recording, fault: Fault, seed: int) -> Recording:
    """Let vehicles broadcast another pose, as `[faults.lie]` of a scenario does; default: the usual sender."""
    from coopenv.observers.mailbox import Interference

    names, period = [setup.name for setup in recording.setups], recording.period
    K, N = recording.ticks, len(names)
    senders = [names.index(name) for name in fault.vehicles] or [usual_sender(recording)]
    since = np.arange(K) - math.ceil(fault.start_in(float(recording.t[-1])) / recording.dt - 1e-6)
    lying = since >= 0
    none = (np.zeros((K, N, 3)), np.zeros((K, N, 3)), np.zeros((K, N)), np.zeros((K, N), np.int64))
    false = deepcopy(recording.interference) or Interference(
        *none,
        clock=np.zeros(N, np.int64),
        restarts=np.zeros((K, N), bool),
        kept=np.zeros(N, np.int64),
        consistent=np.zeros(N, bool),
    )
    for sender in senders:
        if fault.word == "replay":
            false.kept[sender] = period * max(1, round(fault.value / (recording.dt * period)))
            false.replay[lying, sender] = false.kept[sender]
        else:
            size = fault.value * (since * recording.dt if fault.word == "drift" else np.ones(K))
            false.shift[lying, sender] += (size[:, None] * DIRECTION)[lying]
            false.turn[lying, sender, 2] += fault.options.get("turn", 0.0)
        false.consistent[sender] = fault.options.get("honest_odometry", 0.0) == 0.0
        if "std" in fault.options:
            false.std[lying, sender] = fault.options["std"]
    return replace(recording, interference=false)


NO_FOLLOWERS = "no vehicle has another one as its neighbour"


def leaders_of(world: Recording | Scenario) -> list[int]:
    """Return the vehicles, in the order of estimation, that another one has as its neighbour."""
    sets: Sequence[Any]
    if isinstance(world, Scenario):
        sets, landmarks = neighbour_sets(world), len(world.landmarks)
        order: Iterable[int] = processing_order(world, sets)
    else:
        sets, landmarks, order = [setup.targets for setup in world.setups], world.setups[0].landmarks, world.order
    return [i for i in order if any(landmarks + i in targets for targets in sets)]


def usual_sender(world: Recording | Scenario) -> int:
    """Return the second vehicle, in the order of estimation, that has followers, or the only one.

    The first one is mostly seen by vehicles that see the landmarks, too.

    Raises:
        CoopenvError: no vehicle has followers.
    """
    leaders = leaders_of(world)
    if not leaders:
        raise CoopenvError(NO_FOLLOWERS)
    return leaders[min(1, len(leaders) - 1)]


@dataclass(frozen=True)
class RecordFault(FaultKind):
    """A fault that changes a recording, logs included: (recording, fault, seed) -> recording."""

    change: Callable[[Recording, Fault, int], Recording] = lambda recording, fault, seed: recording


@dataclass(frozen=True)
class WorldFault(FaultKind):
    """A fault of simulated environments: keys of a vehicle in the scenario."""

    key: str = ""
    """Of the value; start and options are keys of the same section."""
    renamed: Mapping[str, str] = field(default_factory=dict)
    """Those keys that are not called like the option, or `start`."""
    vehicles: bool = True
    of_one: bool = False
    """Whether the usual sender alone has the fault by default; else all vehicles."""


FAULTS: dict[str, RecordFault | WorldFault] = {
    "v2x_loss": RecordFault("SHARE", "of the messages that is lost", 0.3, high=1.0, change=with_loss),
    "v2x_delay": RecordFault("SECONDS", "by which messages arrive later", 0.2, change=with_delay),
    "wrong_association": RecordFault(
        "SHARE",
        "of the bearings that carries the identity of another target in view",
        0.05,
        high=1.0,
        change=with_wrong_association,
    ),
    "landmarks_lost": RecordFault(
        "",
        "no landmark is visible",
        0.0,
        start=True,
        duration=True,
        change=without_landmarks,
    ),
    "lie": RecordFault(
        "KIND[:AMOUNT]",
        "a vehicle broadcasts another pose: jump or collude (m), drift (m/s), replay (s)",
        words={"jump": 5.0, "drift": 0.05, "replay": 1.0, "collude": 5.0},
        start=True,
        options=("std", "turn", "honest_odometry"),
        vehicles=True,
        change=with_lie,
    ),
    "odometry_scale": WorldFault("STD", "of the odometry's scale error", key="noise.odometry_scale"),
    "gyro_bias": WorldFault("STD", "of the gyro's bias per axis, rad/s", key="noise.gyro_bias"),
    "slip": WorldFault(
        "RATE", "at which wheels begin to slip, 1/s", options=("duration", "size", "angle"), key="noise.slip.rate"
    ),
    "extrinsics": WorldFault(
        "STD",
        "per axis of the rotation of the true camera against the nominal one, rad; position: likewise, m",
        options=("position",),
        key="camera.extrinsics_error",
        renamed={"position": "extrinsics_position_error"},
    ),
    "focal_length": WorldFault("STD", "of the focal length's error, relative", key="camera.focal_length_error"),
    "clock": WorldFault("STD", "of the clocks' offset, s", key="faults.clock_offset"),
    "restart": WorldFault(
        "",
        "at START a vehicle's observer loses its state and starts anew",
        1.0,
        start=True,
        options=("spread",),
        key="faults.restart.chance",
        renamed={"start": "time", "spread": "time_spread"},
        of_one=True,
    ),
    "corruption": WorldFault(
        "CHANCE",
        "that a message's pose is altered on the way",
        high=1.0,
        start=True,
        options=("size", "turn"),
        key="faults.corruption.probability",
    ),
}
"""By name."""


@dataclass(frozen=True)
class FaultVariant:
    """A variant of the benchmark with its faults; small enough to travel to a worker."""

    name: str
    faults: tuple[Fault, ...] = ()
    scenario: Scenario | None = None
    """The world with those faults that are keys of a scenario; None: there are none."""

    @property
    def summary(self) -> str:
        """Its faults in words."""
        words = []
        for fault in self.faults:
            kind = FAULTS[fault.name]
            meaning = kind.meaning.partition(": ")[0]
            words.append(f"{fault.text}: {meaning if kind.words else f'{kind.value.lower()} {meaning}'.strip()}")
        return "; ".join(words) or "as simulated"

    @property
    def needs_followers(self) -> bool:
        """Whether a vehicle lies that is not named."""
        return any(fault.name == "lie" and not fault.vehicles for fault in self.faults)

    def applied(self, recording: Recording, seed: int) -> Recording:
        """Return the changed record; `recording` is of the variant's scenario."""
        for fault in self.faults:
            kind = FAULTS[fault.name]
            if isinstance(kind, RecordFault):
                recording = kind.change(recording, fault, seed)
        return recording


def variant_of(text: str, name: str = "") -> FaultVariant:
    """Read the faults of one variant, named as they are written or otherwise.

    Raises:
        FaultError: one is not valid.
    """
    text = text.strip()
    faults = tuple(parse_fault(word, FAULTS) for word in text.split("/")) if text else ()
    for fault in faults:
        if fault.word == "collude" and len(fault.vehicles) < 2:
            raise FaultError(f"fault {fault.text}: two vehicles collude, such as vehicle_2,vehicle_3:lie=collude:5")
        if fault.word == "replay" and fault.value > LONGEST_REPLAY:
            raise FaultError(f"fault {fault.text}: expected an age up to {LONGEST_REPLAY:g} s")
        if fault.name == "landmarks_lost" and (fault.start is None or math.isinf(fault.duration)):
            raise FaultError(f"fault {fault.text}: expected landmarks_lost@START+DURATION")
        if fault.name == "restart" and fault.start is None:
            raise FaultError(f"fault {fault.text}: expected restart@START")
    return FaultVariant(name or text, faults)


VARIANTS = {
    name: variant_of(text, name)
    for name, text in {
        NOMINAL: "",
        "v2x_loss": "v2x_loss=0.3",
        "v2x_delay": "v2x_delay=0.2",
        "wrong_association": "wrong_association=0.05",
        "lying_neighbour": "lie=jump:5@40%,std=0.01",
        "landmarks_lost": "landmarks_lost@60%+10",
    }.items()
}
"""Variants with a name of their own."""

ROBOT_VARIANTS = {
    "landmarks": "no robot sees another",
    "landmarks+robots": "everything that was seen counts",
    "blind": "robots 3 to 5 see no landmark",
}
"""Variants of recorded robots, each with its meaning."""


def variant_rows() -> list[dict[str, str]]:
    """Return the rows of `list variants`."""
    named = {name: variant.summary for name, variant in VARIANTS.items()}
    faults = {f"{name}={kind.value}" if kind.value else name: kind.meaning for name, kind in FAULTS.items()}
    kinds = {"environments, logs": named, "recorded robots": ROBOT_VARIANTS, "--fault": faults}
    return [{"name": n, "of": of, "about": text} for of, variants in kinds.items() for n, text in variants.items()]


def with_world(variant: FaultVariant, text: str, scenario: Scenario, overrides: Mapping[str, Any]) -> FaultVariant:
    """Return a variant with the world that has its faults, where any is of the world.

    Args:
        variant: which one.
        text: name or file of the environment.
        scenario: the environment with its overrides.
        overrides: these.

    Raises:
        CoopenvError: unknown vehicle, no followers, errors of sensors without noise, or a value is not possible.
    """
    found: dict[str, Any] = {}
    for fault in variant.faults:
        kind, names = FAULTS[fault.name], fault.vehicles or scenario.vehicle_names
        check_vehicles(fault, scenario.vehicle_names)
        if not isinstance(kind, WorldFault):
            continue
        if kind.of_one and not fault.vehicles:
            if not leaders_of(scenario):
                raise CoopenvError(f"fault {fault.text}: {NO_FOLLOWERS}; name one, VEHICLE:{fault.text}")
            names = [scenario.vehicle_names[usual_sender(scenario)]]
        section, _, key = kind.key.rpartition(".")
        start = {"start": fault.start_in(scenario.horizon)} if kind.start else {}
        given = {kind.renamed.get(k, k): value for k, value in {key: fault.value, **start, **fault.options}.items()}
        for name in names:
            if (
                section.startswith(("noise", "camera"))
                and not scenario.noises[scenario.vehicle_names.index(name)].enabled
            ):
                raise CoopenvError(f"fault {fault.text}: needs noise.enabled = true, which is off")
            found |= {f"vehicles.{name}.{section}.{k}": value for k, value in given.items()}
    return replace(variant, scenario=load_scenario(text, {**overrides, **found})) if found else variant


def check_vehicles(fault: Fault, known: Sequence[str]) -> None:
    """Refuse unknown vehicles. Raises CoopenvError: it names the known ones."""
    for name in fault.vehicles:
        if name not in known:
            raise CoopenvError(
                f"fault {fault.text}: unknown vehicle '{name}'{suggest(name, known)}; there are {listed(known)}"
            )


def check_recorded(variant: FaultVariant, vehicles: Sequence[str]) -> None:
    """Refuse faults that a finished record of these vehicles cannot have. Raises CoopenvError."""
    for fault in variant.faults:
        if isinstance(FAULTS[fault.name], WorldFault):
            raise CoopenvError(f"fault {fault.text}: is of a simulated world, this one is recorded")
        check_vehicles(fault, vehicles)
