"""Variants with faults: changes of a recording, or keys of a scenario.

The spelling is that of `coopenv.base.fault_text`; `/` joins several faults of one variant, for example
`vehicle_2:lie=drift:0.05@10/gyro_bias=0.0175`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

from coopenv.base.errors import CoopenvError, listed, shown, suggest
from coopenv.base.fault_text import Bounds, Fault, FaultError, FaultKind, parse_fault
from coopenv.base.sections import LARGEST
from coopenv.bench.observers import changes
from coopenv.bench.observers.changes import FAULT_MODELS, NO_FOLLOWERS, leaders_of, usual_sender
from coopenv.scenario import Scenario, load_scenario
from coopenv.scenario.bodies import MOST_LANDMARKS
from coopenv.scenario.sensing import LONGEST_REPLAY
from coopenv.sources.registry import kinds

if TYPE_CHECKING:
    from coopenv.observers.recording import Recording

NOMINAL = "nominal"
SIZE, ANY = (0.0, LARGEST), (-LARGEST, LARGEST)
"""Bounds of options."""


Change = Callable[["Recording", Fault, int], "Recording"]


@dataclass(frozen=True)
class RecordFault(FaultKind):
    """A fault that changes a recording, logs included: (recording, fault, seed) -> recording."""

    change: Change = lambda recording, fault, seed: recording


@dataclass(frozen=True)
class WorldFault(FaultKind):
    """A fault of simulated environments: keys of a vehicle in the scenario."""

    key: str = ""
    """Key of the value; start and options are keys of the same section."""
    renamed: Mapping[str, str] = field(default_factory=dict)
    """Keys whose name differs from that of the option, or from `start`."""
    vehicles: bool = True
    of_one: bool = False
    """Apply the fault by default to the usual sender alone; otherwise to all vehicles."""


OF_BURSTS: dict[str, Bounds] = {"share": (0.0, 1.0), "burst": (1e-3, LARGEST)}
LOWEST = {"relative": -1.0}
"""Least values, by unit."""


def _undeclared(value: str, meaning: str, unit: str, default: float, change: Change) -> RecordFault:
    """Return an error that observers do not know of, from its start on."""
    about = f"{meaning} from START on, {unit}; undeclared"
    return RecordFault(value, about, default, LOWEST.get(unit, -LARGEST), start=True, vehicles=True, change=change)


def _of_model(value: str, meaning: str, unit: str, default: float, change: Change) -> RecordFault:
    """Return the same, of an error that goes on by one of `FAULT_MODELS`."""
    return replace(
        _undeclared(f"MODEL[:{value}]", f"{meaning} by the model {', '.join(FAULT_MODELS)}", unit, default, change),
        words=dict.fromkeys(FAULT_MODELS, default),
        options=OF_BURSTS,
        unused={model: tuple(OF_BURSTS) for model in FAULT_MODELS if model != "intermittent"},
    )


FAULTS: dict[str, RecordFault | WorldFault] = {
    "v2x_loss": RecordFault("SHARE", "of the messages that is lost", 0.3, high=1.0, change=changes.with_loss),
    "v2x_delay": RecordFault("SECONDS", "by which messages arrive later", 0.2, change=changes.with_delay),
    "wrong_association": RecordFault(
        "SHARE",
        "of the bearings that is swapped with another one of its frame, some of them twice",
        0.05,
        high=1.0,
        change=changes.with_wrong_association,
    ),
    "random_bearings": RecordFault(
        "SHARE",
        "of the bearings that points in a uniform direction",
        0.1,
        high=1.0,
        change=changes.with_random_bearings,
    ),
    "reflections": RecordFault(
        "SHARE",
        "of the time in which a landmark is seen in a mirror, in bursts of 0.5 s",
        0.2,
        high=1.0,
        options={"burst": (1e-3, LARGEST)},
        vehicles=True,
        change=changes.with_reflections,
    ),
    "late_frames": RecordFault(
        "SECONDS",
        "by which camera frames are older than stated; undeclared",
        0.03,
        vehicles=True,
        change=changes.with_late_frames,
    ),
    "correlated_bearings": RecordFault(
        "STD",
        "of an error of bearings that lasts for a time, 1 s, rad; undeclared",
        0.003,
        options={"time": SIZE},
        vehicles=True,
        change=changes.with_correlated_bearings,
    ),
    "gyro_step": _undeclared(
        "RATE", "by which gyros are biased about the vertical", "rad/s", 0.02, changes.with_gyro_error
    ),
    "gyro": _of_model("RATE", "gyros have a bias about the vertical", "rad/s", 0.02, changes.with_gyro_error),
    "camera_step": _undeclared(
        "ANGLE", "by which cameras are turned to the left on their mountings", "rad", 0.05, changes.with_camera_error
    ),
    "camera": _of_model(
        "ANGLE", "cameras are turned to the left on their mountings", "rad", 0.05, changes.with_camera_error
    ),
    "focal_step": _undeclared(
        "SHARE", "by which focal lengths are too large", "relative", 0.05, changes.with_focal_error
    ),
    "focal": _of_model("SHARE", "focal lengths are too large", "relative", 0.05, changes.with_focal_error),
    "scale_drift": _undeclared(
        "SHARE", "to which the scale error of odometries grows up to the end", "relative", 0.1, changes.with_scale_drift
    ),
    "scale": _of_model("SHARE", "odometries read too much", "relative", 0.005, changes.with_scale_error),
    "landmark": replace(
        _of_model(
            "METRES", "a landmark, drawn or by its number, is off on all maps", "m", 1.0, changes.with_landmark_error
        ),
        options={"landmark": range(1, MOST_LANDMARKS + 1), "angle": ANY, **OF_BURSTS},
        vehicles=False,
    ),
    "landmarks_lost": RecordFault(
        "", "no landmark is visible", 0.0, start=True, duration=True, change=changes.without_landmarks
    ),
    "map_error": RecordFault(
        "[LANDMARK:]METRES",
        "by which a landmark, or each, is off on the map",
        1.0,
        free_word=True,
        start=True,
        options={"angle": ANY, "spread": SIZE},
        vehicles=True,
        change=changes.with_map_error,
    ),
    "map_noise": RecordFault(
        "STD", "of the error of all landmarks on all maps, per axis, m; undeclared", 0.05, change=changes.with_map_noise
    ),
    "map_exchange": RecordFault("", "two landmarks are exchanged on all maps", 0.0, change=changes.with_map_exchange),
    "prior_error": RecordFault(
        "METRES",
        "by which initial estimates are off on the map; undeclared",
        3.0,
        options={"angle": ANY},
        vehicles=True,
        change=changes.with_prior_error,
    ),
    "jammer": RecordFault(
        "METRES",
        "around a vehicle or a place (x, y, z) in which no message arrives; without a range: everywhere",
        math.inf,
        start=True,
        duration=True,
        options={"x": ANY, "y": ANY, "z": ANY, "period": (1e-3, LARGEST), "duty": (0.0, 1.0)},
        vehicles=True,
        change=changes.with_jammer,
    ),
    "lie": RecordFault(
        "KIND[:AMOUNT]",
        "a vehicle broadcasts another pose: jump or collude (m), drift (m/s), replay (s)",
        words={"jump": 5.0, "drift": 0.05, "replay": 1.0, "collude": 5.0},
        start=True,
        options={"std": SIZE, "turn": ANY, "angle": ANY, "honest_odometry": range(2)},
        unused={"replay": ("turn", "angle")},
        vehicles=True,
        change=changes.with_lie,
    ),
    "odometry_scale": WorldFault("STD", "of the odometry's scale error", key="noise.odometry_scale"),
    "gyro_bias": WorldFault("STD", "of the gyro's bias per axis, rad/s", key="noise.gyro_bias"),
    "slip": WorldFault(
        "RATE",
        "at which wheels begin to slip, 1/s",
        options={"duration": SIZE, "size": SIZE, "angle": SIZE},
        key="noise.slip.rate",
    ),
    "extrinsics": WorldFault(
        "STD",
        "per axis of the rotation of the true camera against the nominal one, rad; position: likewise, m",
        options={"position": SIZE},
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
        options={"spread": SIZE},
        key="faults.restart.chance",
        renamed={"start": "time", "spread": "time_spread"},
        of_one=True,
    ),
    "corruption": WorldFault(
        "CHANCE",
        "that a message's pose is altered on the way",
        high=1.0,
        start=True,
        options={"size": SIZE, "turn": SIZE},
        key="faults.corruption.probability",
    ),
}
"""Faults of the benchmark, by name."""


@dataclass(frozen=True)
class FaultVariant:
    """A variant of the benchmark with its faults; small enough to travel to a worker."""

    name: str
    faults: tuple[Fault, ...] = ()
    scenario: Scenario | None = None
    """The world with the faults that are keys of a scenario; None: there are none."""
    sensors: tuple[str, ...] | None = None
    """Names of the only sensors that measure, "camera" among them or not; None: all."""

    @property
    def summary(self) -> str:
        """Its faults in words."""
        words = [] if self.sensors is None else [f"measurements of {' and '.join(self.sensors)} alone"]
        for fault in self.faults:
            kind = FAULTS[fault.name]
            meaning = kind.meaning.partition(": ")[0]
            words.append(f"{fault.text}: {meaning if kind.words else f'{kind.value.lower()} {meaning}'.strip()}")
        return "; ".join(words) or "as simulated"

    def applied(self, recording: Recording, seed: int) -> Recording:
        """Return the changed record; `recording` is of the variant's scenario."""
        if self.sensors is not None:
            recording = changes.with_sensors(recording, self.sensors)
        for fault in self.faults:
            kind, end = FAULTS[fault.name], float(recording.t[-1])
            if fault.start_in(end) > end:
                raise CoopenvError(f"fault {fault.text}: it begins after the run's end at {end:g} s")
            if isinstance(kind, RecordFault):
                recording = kind.change(recording, fault, seed)
        return recording


def variant_of(text: str, name: str = "") -> FaultVariant:
    """Read the faults of one variant, named as they are written or otherwise.

    Raises:
        FaultError: one is not valid.
    """
    if not isinstance(text, str):
        raise FaultError(f"fault: expected a text, got {shown(text)}")
    text = text.strip()
    faults = tuple(parse_fault(word, FAULTS) for word in text.split("/")) if text or not name else ()
    for fault in faults:
        if fault.word == "collude" and len(set(fault.vehicles)) < 2:
            raise FaultError(f"fault {fault.text}: two vehicles collude, such as vehicle_2,vehicle_3:lie=collude:5")
        if fault.word == "replay" and fault.value > LONGEST_REPLAY:
            raise FaultError(f"fault {fault.text}: expected an age up to {LONGEST_REPLAY:g} s")
        if fault.name == "landmarks_lost" and (fault.start is None or math.isinf(fault.duration)):
            raise FaultError(f"fault {fault.text}: expected landmarks_lost@START+DURATION")
        if fault.name == "restart" and fault.start is None:
            raise FaultError(f"fault {fault.text}: expected restart@START")
        fixed = not {"x", "y", "z"}.isdisjoint(fault.options)
        if fault.name == "jammer" and fixed + bool(fault.vehicles) != (fault.value < math.inf):
            raise FaultError(f"fault {fault.text}: expected jammer, VEHICLE:jammer=METRES or jammer=METRES,x=X,y=Y")
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


def variant_rows() -> list[dict[str, str]]:
    """Return the rows of `list variants`."""
    named = {name: variant.summary for name, variant in VARIANTS.items()}
    faults = {f"{name}={kind.value}" if kind.value else name: kind.meaning for name, kind in FAULTS.items()}
    robots = {name: about for kind in kinds().values() for name, about in kind.variants.items()}
    tables = {"environments, logs": named, "recorded robots": robots, "--fault": faults}
    return [{"name": n, "of": of, "about": text} for of, variants in tables.items() for n, text in variants.items()]


def with_world(variant: FaultVariant, scenario: Scenario) -> FaultVariant:
    """Return a variant with the world that has its faults, where any is of the world.

    Args:
        variant: which one.
        scenario: the environment with its overrides.

    Raises:
        CoopenvError: unknown vehicle, no followers, errors of sensors without noise, or a value is not possible.
    """
    found: dict[str, Any] = {}
    for fault in variant.faults:
        kind, names = FAULTS[fault.name], fault.vehicles or scenario.vehicle_names
        check_names(fault, scenario.vehicle_names, scenario.target_names[: len(scenario.landmarks)])
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
    return replace(variant, scenario=load_scenario(scenario, found)) if found else variant


def check_names(fault: Fault, vehicles: Sequence[str], landmarks: Sequence[str]) -> None:
    """Refuse unknown vehicles and landmarks. Raises CoopenvError: it names the known ones."""
    given = {
        "vehicle": (fault.vehicles, vehicles),
        "landmark": ([fault.word] * FAULTS[fault.name].free_word, landmarks),
    }
    for kind, (names, known) in given.items():
        for name in names:
            if name and name not in known:
                raise CoopenvError(
                    f"fault {fault.text}: unknown {kind} '{name}'{suggest(name, known)}; there are {listed(known)}"
                )


def check_recorded(variant: FaultVariant, vehicles: Sequence[str], landmarks: Sequence[str]) -> None:
    """Refuse faults that a finished record of these vehicles and landmarks cannot have. Raises CoopenvError."""
    for fault in variant.faults:
        if isinstance(FAULTS[fault.name], WorldFault):
            raise CoopenvError(f"fault {fault.text}: is of a simulated world, this one is recorded")
        check_names(fault, vehicles, landmarks)
