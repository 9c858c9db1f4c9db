"""Variants with faults: changes of a recording, or keys of a scenario.

The truth and the odometry of a recording are never changed. Every random draw is a function of the seed and the fault.
The spelling is that of `coopenv.base.fault_text`; `/` joins several faults of one variant, for example
`vehicle_2:lie=drift:0.05@10/gyro_bias=0.0175`.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from coopenv.base.errors import CoopenvError, listed, suggest
from coopenv.base.fault_text import Fault, FaultError, FaultKind, parse_fault
from coopenv.scenario import Scenario, load_scenario
from coopenv.scenario.schema import neighbour_sets, processing_order
from coopenv.scenario.sensing import LONGEST_REPLAY

if TYPE_CHECKING:
    from coopenv.observers.interference import Interference
    from coopenv.observers.recording import Recording

NOMINAL = "nominal"
DIRECTION = np.array([0.6, 0.8, 0.0])
"""Of a false position, map axes: horizontal, and along no road."""


def with_loss(recording: Recording, probability: float, seed: int = 0) -> Recording:
    """Lose each message, per receiver, with a probability in [0, 1]; the last received message stays known."""
    inbox = recording.inbox_tick
    news = np.diff(inbox, axis=0, prepend=-1) > 0
    kept = news & (_generator(seed, 1).random(inbox.shape) >= probability)
    return changed(recording, inbox_tick=np.maximum.accumulate(np.where(kept, inbox, -1), axis=0))


def with_delay(recording: Recording, seconds: float) -> Recording:
    """Deliver every message later, by a time that is rounded to whole ticks."""
    ticks = min(round(seconds / recording.dt), recording.ticks)
    inbox = np.full_like(recording.inbox_tick, -1)
    inbox[ticks:] = recording.inbox_tick[: recording.ticks - ticks]
    return changed(recording, inbox_tick=inbox)


def with_wrong_association(recording: Recording, share: float, seed: int = 0) -> Recording:
    """Swap bearings within frames so that a share of all bearings carry the identity of another visible target.

    Every bearing starts a swap with another one of its frame, drawn at random, with half that probability, so that
    it is part of one with (nearly) the whole. A frame with a single bearing stays as it is.
    """
    bearings = recording.bearings.copy()
    generator = _generator(seed, 2)
    starts = recording.visible & (generator.random(recording.visible.shape) < share / 2)
    partners = generator.random(recording.visible.shape)
    for k, i, target in np.argwhere(starts):
        others = np.flatnonzero(recording.visible[k, i])
        others = others[others != target]
        if len(others):
            pair = [target, others[int(partners[k, i, target] * len(others))]]
            bearings[k, i, pair] = bearings[k, i, pair[::-1]]
    return changed(recording, bearings=bearings)


def without_landmarks(recording: Recording, start: float, duration: float) -> Recording:
    """Hide all landmarks from a time on, for a duration, s."""
    lost = (recording.t >= start) & (recording.t < start + duration)
    landmarks = np.arange(recording.visible.shape[2]) < recording.landmarks.shape[1]
    hidden = lost[:, None, None] & landmarks
    bearings = np.where(hidden[..., None], np.nan, recording.bearings)
    return changed(recording, visible=recording.visible & ~hidden, bearings=bearings)


def with_lie(recording: Recording, fault: Fault) -> Recording:
    """Let vehicles broadcast another pose, as `[faults.lie]` of a scenario does; default: the usual sender."""
    names = [setup.name for setup in recording.setups]
    senders = [names.index(name) for name in fault.vehicles] or [usual_sender(recording)]
    first = math.ceil(fault.start_in(float(recording.t[-1])) / recording.dt - 1e-6)
    since = np.arange(recording.ticks) - first
    lying = since >= 0
    false = recording.interference or _honest(recording)
    shift, std, replay, kept = false.shift.copy(), false.std.copy(), false.replay.copy(), false.kept.copy()
    for sender in senders:
        if fault.word == "replay":
            period = recording.period
            kept[sender] = period * max(1, round(fault.value / (recording.dt * period)))
            replay[lying, sender] = kept[sender]
        else:
            size = fault.value * (since * recording.dt if fault.word == "drift" else np.ones(len(since)))
            shift[lying, sender] += (size[:, None] * DIRECTION)[lying]
        if "std" in fault.options:
            std[lying, sender] = fault.options["std"]
    return replace(recording, interference=replace(false, shift=shift, std=std, replay=replay, kept=kept))


def _honest(recording: Recording) -> Interference:
    """Return no interference, in arrays of a recording's size."""
    from coopenv.observers.interference import Interference

    K, N = recording.ticks, len(recording.setups)
    vectors, zeros = np.zeros((K, N, 3)), np.zeros((K, N), np.int64)
    none = zeros[0].copy()
    return Interference(vectors, vectors.copy(), np.zeros((K, N)), zeros, none, np.zeros((K, N), bool), none.copy())


def usual_sender(recording: Recording) -> int:
    """Return the second vehicle, in the order of estimation, that has followers, or the only one.

    The first one is mostly seen by vehicles that see the landmarks, too.

    Raises:
        CoopenvError: no vehicle has followers.
    """
    leaders = [i for i in recording.order if followers(recording, i)]
    if not leaders:
        raise CoopenvError(NO_FOLLOWERS)
    return leaders[min(1, len(leaders) - 1)]


NO_FOLLOWERS = "no vehicle has another one as its neighbour"


def followers(recording: Recording, vehicle: int) -> list[int]:
    """Return the vehicles that have this one as a neighbour."""
    return [i for i, setup in enumerate(recording.setups) if setup.landmarks + vehicle in setup.targets]


@dataclass(frozen=True)
class RecordFault(FaultKind):
    """A fault that changes a recording, logs included: (recording, fault, seed) -> recording."""

    change: Callable[[Recording, Fault, int], Recording] = lambda recording, fault, seed: recording


@dataclass(frozen=True)
class WorldFault(FaultKind):
    """A fault of simulated environments: keys of a vehicle in the scenario, by section."""

    section: str = ""
    key: str = ""
    """Of the value."""
    start_key: str = ""
    option_keys: Mapping[str, str] | None = None
    constants: Mapping[str, Any] | None = None
    vehicles: bool = True
    of_one: bool = False
    """Whether the usual sender alone has the fault by default; else all vehicles."""

    def keys_of(self, fault: Fault, horizon: float) -> dict[str, Any]:
        """Return the keys of the section; the horizon is in s."""
        keys = dict(self.constants or {})
        keys |= {self.key: fault.value} if self.key else {}
        keys |= {self.start_key: fault.start_in(horizon)} if self.start_key else {}
        return keys | {(self.option_keys or {}).get(name, name): value for name, value in fault.options.items()}


FAULTS: dict[str, RecordFault | WorldFault] = {
    "v2x_loss": RecordFault(
        "SHARE", "of the messages that is lost", 0.3, high=1.0, change=lambda r, f, seed: with_loss(r, f.value, seed)
    ),
    "v2x_delay": RecordFault(
        "SECONDS", "by which messages arrive later", 0.2, change=lambda r, f, seed: with_delay(r, f.value)
    ),
    "wrong_association": RecordFault(
        "SHARE",
        "of the bearings that carries the identity of another target in view",
        0.05,
        high=1.0,
        change=lambda r, f, seed: with_wrong_association(r, f.value, seed),
    ),
    "landmarks_lost": RecordFault(
        "",
        "no landmark is visible",
        0.0,
        start=True,
        duration=True,
        change=lambda r, f, seed: without_landmarks(r, f.start_in(float(r.t[-1])), f.duration),
    ),
    "lie": RecordFault(
        "KIND[:AMOUNT]",
        "a vehicle broadcasts another pose: jump or collude (m), drift (m/s), replay (s)",
        words={"jump": 5.0, "drift": 0.05, "replay": 1.0, "collude": 5.0},
        start=True,
        options=("std",),
        vehicles=True,
        change=lambda r, f, seed: with_lie(r, f),
    ),
    "odometry_scale": WorldFault("STD", "of the odometry's scale error", section="noise", key="odometry_scale"),
    "gyro_bias": WorldFault("STD", "of the gyro's bias per axis, rad/s", section="noise", key="gyro_bias"),
    "slip": WorldFault(
        "RATE",
        "at which wheels begin to slip, 1/s",
        section="noise.slip",
        key="rate",
        options=("duration", "size", "angle"),
    ),
    "extrinsics": WorldFault(
        "STD",
        "per axis of the rotation of the true camera against the nominal one, rad; position: likewise, m",
        section="camera",
        key="extrinsics_error",
        options=("position",),
        option_keys={"position": "extrinsics_position_error"},
    ),
    "focal_length": WorldFault(
        "STD", "of the focal length's error, relative", section="camera", key="focal_length_error"
    ),
    "clock": WorldFault("STD", "of the clocks' offset, s", section="faults", key="clock_offset"),
    "restart": WorldFault(
        "",
        "at START a vehicle's observer loses its state and starts anew",
        0.0,
        start=True,
        section="faults.restart",
        start_key="time",
        options=("spread",),
        option_keys={"spread": "time_spread"},
        constants={"chance": 1.0},
        of_one=True,
    ),
    "corruption": WorldFault(
        "CHANCE",
        "that a message's pose is altered on the way",
        high=1.0,
        start=True,
        section="faults.corruption",
        key="probability",
        start_key="start",
        options=("size", "turn"),
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
        return "; ".join(f"{fault.text}: {_in_words(fault)}" for fault in self.faults) or "as simulated"

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


def _in_words(fault: Fault) -> str:
    kind = FAULTS[fault.name]
    meaning = kind.meaning.partition(": ")[0]
    return meaning if kind.words else f"{kind.value.lower()} {meaning}".strip()


def variant_of(text: str, name: str = "") -> FaultVariant:
    """Read the faults of one variant, named as they are written or otherwise.

    Raises:
        FaultError: one is not valid; a spelling of earlier versions is named with the present one.
    """
    text = text.strip()
    if (now := present_spelling(text)) != text:
        raise FaultError(f"fault {text}: @ and + are times now; write {now}")
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


_OLD = re.compile(r"@[A-Za-z_]|,from=|\+[A-Za-z_]+=|^(lying_neighbour|restart|landmarks_lost)=")


def present_spelling(text: str) -> str:
    """Return a variant in the present grammar, in which `@` and `+` are times; one that is in it stays."""
    if not _OLD.search(text):
        return text
    made = []
    for part in re.split(r"\+(?=[A-Za-z_])", text):
        first, *options = part.split(",")
        first, _, vehicles = first.partition("@")
        name, _, value = first.partition("=")
        start = next((f"@{option[5:]}" for option in options if option.startswith("from=")), "")
        options = [option for option in options if not option.startswith("from=")]
        if name == "lying_neighbour":
            name, value = "lie", f"jump:{value}"
            options += [] if any(option.startswith("std=") for option in options) else ["std=0.01"]
        elif name == "restart":
            start, value = f"@{value}", ""
        elif name == "landmarks_lost":
            start, value = f"{start or '@60%'}+{value}", ""
        who = f"{vehicles.replace(':', ',')}:" if vehicles else ""
        made.append(",".join([f"{who}{name}{f'={value}' if value else ''}{start}", *options]))
    return "/".join(made)


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
        CoopenvError: as for `overrides_of`, or a value is not possible.
    """
    keys = overrides_of(variant, scenario)
    return replace(variant, scenario=load_scenario(text, {**overrides, **keys})) if keys else variant


def overrides_of(variant: FaultVariant, scenario: Scenario) -> dict[str, Any]:
    """Return the dotted keys of a scenario that realise a variant's faults.

    Raises:
        CoopenvError: unknown vehicle, no followers, or errors of sensors without noise.
    """
    found: dict[str, Any] = {}
    for fault in variant.faults:
        kind = FAULTS[fault.name]
        check_vehicles(fault, scenario.vehicle_names)
        if not isinstance(kind, WorldFault):
            continue
        for name in fault.vehicles or (_usual_sender(fault, scenario) if kind.of_one else scenario.vehicle_names):
            noisy = scenario.noises[scenario.vehicle_names.index(name)].enabled
            if kind.section.partition(".")[0] in ("noise", "camera") and not noisy:
                raise CoopenvError(f"fault {fault.text}: needs noise.enabled = true, which is off")
            keys = kind.keys_of(fault, scenario.horizon)
            found |= {f"vehicles.{name}.{kind.section}.{key}": value for key, value in keys.items()}
    return found


def check_vehicles(fault: Fault, names: Iterable[str]) -> None:
    """Refuse unknown vehicles. Raises CoopenvError: it names the known ones."""
    known = list(names)
    for name in fault.vehicles:
        if name not in known:
            raise CoopenvError(
                f"fault {fault.text}: unknown vehicle '{name}'{suggest(name, known)}; there are {listed(known)}"
            )


def check_recorded(variant: FaultVariant, recording: Recording) -> None:
    """Refuse faults that a finished record cannot have. Raises CoopenvError."""
    for fault in variant.faults:
        if isinstance(FAULTS[fault.name], WorldFault):
            raise CoopenvError(f"fault {fault.text}: is of a simulated world, this one is recorded")
        check_vehicles(fault, [setup.name for setup in recording.setups])


def _usual_sender(fault: Fault, scenario: Scenario) -> tuple[str, ...]:
    """Return the name of the vehicle of `usual_sender`."""
    sets, L = neighbour_sets(scenario), len(scenario.landmarks)
    leaders = [i for i in processing_order(scenario, sets) if any(L + i in targets for targets in sets)]
    if not leaders:
        raise CoopenvError(f"fault {fault.text}: {NO_FOLLOWERS}; name one, VEHICLE:{fault.text}")
    return (scenario.vehicle_names[leaders[min(1, len(leaders) - 1)]],)


def _generator(seed: int, stream: int) -> np.random.Generator:
    return np.random.default_rng([seed, stream])


def changed(recording: Recording, **arrays: Any) -> Recording:
    """Return the record with other arrays, which are read-only."""
    for array in arrays.values():
        array.setflags(write=False)
    return replace(recording, **arrays)
