"""Sources of the benchmark's records: a simulated environment, a log file, or a ROS bag.

A source is small and picklable, so that a worker process makes the record itself.
"""

import math
import pickle
import warnings
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from coopenv.base.errors import CoopenvError, DataWarning, listed, suggest
from coopenv.base.plugins import call
from coopenv.bench.observers.changes import CAMERA, NO_FOLLOWERS, leaders_of
from coopenv.bench.observers.faults import (
    NOMINAL,
    VARIANTS,
    FaultVariant,
    check_recorded,
    variant_of,
    with_world,
)
from coopenv.estimation.metrics import steady_start
from coopenv.observers.recording import Recording
from coopenv.policies import load_policy
from coopenv.policies.base import played_back
from coopenv.runs.recorder import record
from coopenv.scenario import Scenario, ScenarioLike, load_scenario, scenario_name
from coopenv.sources.base import Backend
from coopenv.sources.registry import ENVIRONMENT, kind_of
from coopenv.sources.selection import WHOLE, Selection
from coopenv.sources.sources import OBJECT, allow_kinds, is_recording, open_backend, open_recording

already_warned = partial(warnings.catch_warnings, action="ignore", category=DataWarning)
"""Silences the warnings on recorded data that `Source.check` has given."""


@dataclass(frozen=True)
class RecordSource(ABC):
    """Records of one environment in several variants; by default with faults, and of vehicles in space.

    Whatever looks at recorded data raises a `CoopenvError` where they are not there or not well-formed.
    """

    name: str
    """Name of the source in the rows."""
    added: tuple[FaultVariant, ...] = field(default=(), kw_only=True)
    """Variants with faults that have parameters."""
    named: ClassVar[Mapping[str, str]] = {name: variant.summary for name, variant in VARIANTS.items()}
    """The other variants, with a description each."""
    usual: ClassVar[tuple[str, ...]] = (NOMINAL,)
    """Variants that are run by default."""
    seeded: ClassVar[bool] = False
    """True if the record depends on the seed."""
    recorded: ClassVar[bool] = True
    """True if all of its records are the same recording."""
    windowed: ClassVar[bool] = True
    """Judge windows of time from the start on by default."""

    @property
    def variants(self) -> dict[str, str]:
        """All variants, with a description each."""
        return {**self.named, **{variant.name: variant.summary for variant in self.added}}

    @property
    def sensor_sets(self) -> tuple[str, ...]:
        """Names of the variants in which some sensors alone measure."""
        return tuple(variant.name for variant in self.added if variant.sensors is not None)

    def fault(self, variant: str) -> FaultVariant:
        """Return the faults of a variant."""
        known = VARIANTS | {made.name: made for made in self.added}
        return known.get(variant, FaultVariant(variant))

    @abstractmethod
    def world(self) -> Recording | Scenario:
        """Return the vehicles of all variants, and the targets that each of them may measure."""

    @abstractmethod
    def recording(self, variant: str, seed: int) -> Recording:
        """Return a record with the faults of a variant."""

    def obstacle(self, variant: str) -> str:
        """Return why it cannot have one of the variants; empty where it can."""
        unnamed = any(fault.name == "lie" and not fault.vehicles for fault in self.fault(variant).faults)
        return NO_FOLLOWERS if unnamed and not leaders_of(self.world()) else ""

    def check(self) -> None:
        """Look at recorded data, so that errors and warnings come before the work."""
        world = self.world()
        if isinstance(world, Recording):
            check_truth(self.name, bool(world.truth.known.any()))
        self._check_faults(world)

    def _check_faults(self, world: Recording | Scenario) -> None:
        if isinstance(world, Scenario):
            vehicles, targets = world.vehicle_names, world.target_names
        else:
            vehicles, targets = [setup.name for setup in world.setups], list(world.setups[0].target_names)
        for variant in self.added:
            check_recorded(variant, vehicles, targets[: len(targets) - len(vehicles)])

    def steady_from(self, given: float | None, recording: Recording | None = None) -> float:
        """Return the start of the steady state, s; without a record only a given start is checked.

        Recorded robots are judged from the start on, where their poses are known.

        Raises:
            CoopenvError: the given start does not lie within the record.
        """
        if given is not None and not 0.0 <= given < math.inf:
            raise CoopenvError(f"start of the steady state at {given:g} s: not within the run")
        if recording is None or (given is None and recording.on_a_plane):
            return given or 0.0
        return steady_start(given, float(recording.t[-1]))


@dataclass(frozen=True)
class SimulatedRecords(RecordSource):
    """A scenario, once per seed, as it is and with faults."""

    scenario: Scenario
    policy: str = "zero"
    """Policy of the driven vehicles, as for `coopenv.runs.recorder.record`."""
    actions: Mapping[int, np.ndarray] | None = field(default=None, compare=False)
    """Actions (decisions, rows, A) by seed, which driven vehicles take in place of the policy's."""
    seeded: ClassVar[bool] = True
    recorded: ClassVar[bool] = False

    def world(self) -> Scenario:
        """Return the scenario."""
        return self.scenario

    def recording(self, variant: str, seed: int) -> Recording:
        """Return the world of a seed with a fault."""
        fault = self.fault(variant)
        policy = self.policy if self.actions is None else played_back(self.actions[seed])
        return fault.applied(record(fault.scenario or self.scenario, seed, policy), seed)

    def check(self) -> None:
        """Nothing is recorded, and faults have become keys of the scenario."""

    def steady_from(self, given: float | None, recording: Recording | None = None) -> float:
        """Return when the steady state starts, s."""
        return steady_start(given, self.scenario.horizon)


@dataclass(frozen=True)
class GivenRecord(RecordSource):
    """A record, or the file that has one, as it is and with faults."""

    given: Recording | Path = field(repr=False)
    selection: Selection = WHOLE
    kinds: Mapping[str, str] = field(default_factory=dict)
    """Overrides that name the classes of its sensors."""

    def world(self) -> Recording:
        """Return the record."""
        return self.selection.applied(self._whole(), self.name)

    def recording(self, variant: str, seed: int) -> Recording:
        """Return the record with a fault, and with the faults of its scenario."""
        whole = _with_faults(self._whole(), seed)
        return self.fault(variant).applied(self.selection.applied(whole, self.name), seed)

    def _whole(self) -> Recording:
        allow_kinds(self.kinds)
        return open_recording(self.given) if isinstance(self.given, Path) else self.given


def _with_faults(recording: Recording, seed: int) -> Recording:
    """Return a recording with its scenario's faults, drawn again: files have no messages."""
    from coopenv.sources.worlds import Replay, has_faults

    if recording.interference is not None or not has_faults(recording):
        return recording
    return replace(recording, interference=record(Replay(recording, OBJECT), seed).interference)


@dataclass(frozen=True)
class Bags(RecordSource):
    """A ROS bag, with faults; the draws of its environment follow from the seed."""

    path: Path
    topics: Path | None
    overrides: Mapping[str, Any]
    selection: Selection = WHOLE
    seeded: ClassVar[bool] = True

    def check(self) -> None:
        """Look for motion capture, and whether the faults fit."""
        _opened.cache_clear()
        backend = self._backend()
        check_truth(self.name, backend.capabilities.truth)
        self._check_faults(backend.scenario)

    def world(self) -> Scenario:
        """Return the scenario that the bag is read into."""
        return self._backend().scenario

    def recording(self, variant: str, seed: int) -> Recording:
        """Return the bag as a record, with a fault."""
        with already_warned():
            return self.fault(variant).applied(record(self._backend(), seed), seed)

    def _backend(self) -> Backend:
        times = [path.stat().st_mtime_ns for path in (self.path, self.topics) if path is not None and path.exists()]
        return _opened(pickle.dumps((self.path, self.topics, self.overrides, self.selection, times)))


@lru_cache(maxsize=1)
def _opened(key: bytes) -> Backend:
    """Return a bag; the last one is kept: reading it takes seconds, and every seed and fault needs the same."""
    path, topics, overrides, selection, _ = pickle.loads(key)
    return open_backend(path, None, overrides, selection, topics=topics)


def check_truth(name: str, known: bool) -> None:
    """Raise CoopenvError where no true pose is known."""
    if not known:
        raise CoopenvError(f"{name}: no true poses are known, which a comparison needs; coopenv run gives estimates")


ALL = "all"  # asks for every variant that the source can have


def find_source(
    text: ScenarioLike | Recording,
    overrides: Mapping[str, Any] | None = None,
    data: str | Path | None = None,
    topics: str | Path | None = None,
    faults: Sequence[str] = (),
    policy: str | None = None,
    selection: Selection = WHOLE,
) -> RecordSource:
    """Return the source of an environment as for `load_scenario`, of recorded data by name, or of a `Recording`.

    Args:
        text: which one.
        overrides: dotted keys of its scenario.
        data: folder of recorded data sets.
        topics: map of a ROS bag's topics.
        faults: variants with parameters, see `coopenv.bench.observers.faults`.
        policy: of the driven vehicles of a simulated environment; None: action zero.
        selection: the part of recorded data that is used.

    Raises:
        CoopenvError: there is none of that name, or an option for what is no such source.
    """
    given = [faults] if isinstance(faults, str) else faults
    added = tuple(variant_of(fault) for fault in dict.fromkeys(given))
    if is_recording(text):
        options = {"overrides": overrides, "data": data, "topics": topics, "policy": policy}
        for option in [option for option, value in options.items() if value]:
            raise CoopenvError(f"{option}: is for names of environments or files, a Recording was given")
        return GivenRecord(OBJECT, selection.applied(text, OBJECT), added=added)
    kind = kind_of(text, topics)
    if kind is ENVIRONMENT and topics is None and data is None:
        for option, value in selection.given.items():
            raise CoopenvError(f"--{option} {value}: is for recorded data, {scenario_name(text)} is simulated")
        scenario = load_scenario(text, overrides)
        worlds = tuple(with_world(made, scenario) for made in added)
        if policy is not None:
            if not scenario.driven:
                raise CoopenvError(f"--policy {policy}: no vehicle of this environment is driven")
            load_policy(policy, scenario, 0)
        return SimulatedRecords(scenario_name(text), scenario, policy or "zero", added=worlds)
    ticks = kind is not ENVIRONMENT and not kind.reader
    kinds = dict(overrides or {})
    overrides = kinds if ticks else allow_kinds(kinds)
    path = Path(str(text))
    folder, topic_map = (None if given is None else Path(given) for given in (data, topics))
    refused = {
        f"--policy {policy}: {text} is recorded, its vehicles cannot be driven": policy is not None,
        f"--fault {next(iter(faults), '')}: recorded robots have variants of their own, {', '.join(kind.variants)}": (
            kind.comparison and faults
        ),
        f"--data {data}: {text} is not one of the recorded robots, mrclam_1 .. mrclam_9": data and not kind.comparison,
        f"--map {topics}: is for ROS bags, {text} is none": topics and "topics" not in kind.options,
        f"--override {next(iter(overrides or ()), '')}: {text} is recorded, and compared as it is": (
            overrides and not ticks
        ),
        f"no such log file: {text}": not (ticks or kind.comparison or path.is_file()),
    }
    for reason, holds in refused.items():
        if holds:
            raise CoopenvError(reason)
    if ticks:
        return Bags(path.stem + selection.remark, path, topic_map, dict(overrides or {}), selection, added=added)
    if kind.comparison:
        made: RecordSource = call(kind.comparison, str(text), folder, selection)
        return made
    return GivenRecord(path.stem, path, selection, kinds, added=added)


def with_sensor_sets(source: RecordSource) -> RecordSource:
    """Return a source with a variant for the camera, for each other sensor, for the camera with each, and for all.

    Raises:
        CoopenvError: there is no sensor beside the camera, or the source has variants of its own.
    """
    world = source.world()
    if source.named is not RecordSource.named:
        raise CoopenvError(f"--sensors: {source.name} has variants of its own, {listed([*source.named])}")
    if isinstance(world, Recording):
        names = [*dict.fromkeys(sensor.name for setup in world.setups for sensor in setup.sensors)]
        camera = bool(world.visible.any())
    else:
        names = [section.label for section in world.sensors]
        camera = any(section.model != "none" for section in world.cameras)
    if not names:
        raise CoopenvError(f"--sensors: {source.name} has no [[sensors]] beside the camera")
    sets = [(CAMERA,), *((name,) for name in names), *((CAMERA, name) for name in names), (CAMERA, *names)]
    if not camera:
        sets = [*((name,) for name in names), tuple(names)]
    made = (FaultVariant("+".join(one), sensors=one) for one in dict.fromkeys(sets))
    return replace(source, added=(*source.added, *made))


def variants_of(source: RecordSource, asked: str | Iterable[str] | None) -> tuple[str, ...]:
    """Return the variants to run: names (a text has commas between), `all` that there can be, or None for the usual.

    Raises:
        CoopenvError: there is none of that name, or the source cannot have it.
    """
    usual = () if source.sensor_sets else source.usual  # the last of these sets is all sensors
    given = usual if asked is None else asked.split(",") if isinstance(asked, str) else asked
    names = [name.strip() for name in given]
    if not (names or source.sensor_sets):
        raise CoopenvError(f"variants: expected at least one; known: {', '.join((*source.variants, ALL))}")
    if names == [ALL]:
        return tuple(name for name in source.variants if not source.obstacle(name))
    names = list(dict.fromkeys([*names, *(variant.name for variant in source.added)]))
    for name in names:
        if name not in source.variants:
            known = ", ".join((*source.variants, ALL))
            raise CoopenvError(f"unknown variant '{name}'{suggest(name, list(source.variants))}; known: {known}")
        if reason := source.obstacle(name):
            raise CoopenvError(f"variant '{name}': {reason}")
    return tuple(names)
