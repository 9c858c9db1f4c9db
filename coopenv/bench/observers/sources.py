"""Where the benchmark's records come from: a simulated environment, recorded robots, or a log file.

A source is small and picklable, so that a worker process makes the record itself.
"""

import math
import warnings
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar

from coopenv.backends.base import Backend
from coopenv.backends.sources import SourceKind, is_bag, kind_of, open_backend, open_recording
from coopenv.base.errors import CoopenvError, DataWarning, suggest
from coopenv.bench.observers.faults import (
    NO_FOLLOWERS,
    NOMINAL,
    ROBOT_VARIANTS,
    VARIANTS,
    FaultVariant,
    check_recorded,
    leaders_of,
    variant_of,
    with_world,
)
from coopenv.estimation.metrics import STEADY_SHARE, steady_start
from coopenv.observers.recording import Recording
from coopenv.policies import load_policy
from coopenv.runs.recorder import record
from coopenv.scenario import Scenario, load_scenario


@dataclass(frozen=True)
class Source(ABC):
    """Records of one environment in several variants; by default with faults, and of vehicles in space.

    Whatever looks at recorded data raises a `CoopenvError` where they are not there or not well-formed.
    """

    name: str
    """As it stands in the rows."""
    added: tuple[FaultVariant, ...] = field(default=(), kw_only=True)
    """Variants with faults that have parameters."""
    named: ClassVar[Mapping[str, str]] = {name: variant.summary for name, variant in VARIANTS.items()}
    """The others, each with what it is."""
    usual: ClassVar[tuple[str, ...]] = (NOMINAL,)
    """Those that are run unless others are asked for."""
    seeded: ClassVar[bool] = False
    """Whether another seed gives another record."""

    @property
    def variants(self) -> dict[str, str]:
        """All variants there are, each with what it is."""
        return {**self.named, **{variant.name: variant.summary for variant in self.added}}

    def fault(self, variant: str) -> FaultVariant:
        """Return the faults of a variant."""
        known = VARIANTS | {made.name: made for made in self.added}
        return known.get(variant, FaultVariant(variant))

    @property
    def planar(self) -> bool:
        """Whether its vehicles are robots on a plane; observers suit either these or vehicles in space."""
        return False

    @abstractmethod
    def recording(self, variant: str, seed: int) -> Recording:
        """Return a record with the faults of a variant."""

    def followed(self) -> bool:
        """Return whether a vehicle has another one as its neighbour, so that one can lie to another."""
        return True

    def obstacle(self, variant: str) -> str:
        """Return why it cannot have one of the variants; empty where it can."""
        return NO_FOLLOWERS if self.fault(variant).needs_followers and not self.followed() else ""

    def check(self) -> None:  # noqa: B027
        """Look at recorded data, so that errors and warnings come before the work."""

    def steady_from(self, given: float | None, recording: Recording | None = None) -> float:
        """Return when the steady state starts, s; without a record only what is asked for is checked.

        Recorded robots are judged from the start on, where their poses are known.

        Raises:
            CoopenvError: what was asked for does not lie within the record.
        """
        if given is not None:
            if not 0.0 <= given < math.inf:
                raise CoopenvError(f"start of the steady state at {given:g} s: not within the run")
            return given if recording is None else steady_start(given, float(recording.t[-1]))
        if recording is None or _is_planar(recording):
            return 0.0
        return STEADY_SHARE * float(recording.t[-1])


@dataclass(frozen=True)
class Simulated(Source):
    """A scenario, once per seed, as it is and with faults."""

    scenario: Scenario
    policy: str = "zero"
    """Policy of the driven vehicles, as for `coopenv.runs.recorder.record`."""
    seeded: ClassVar[bool] = True

    def recording(self, variant: str, seed: int) -> Recording:
        """Return the world of a seed with a fault."""
        fault = self.fault(variant)
        return fault.applied(record(fault.scenario or self.scenario, seed, self.policy), seed)

    def followed(self) -> bool:
        """Return whether a vehicle has another one as its neighbour."""
        return bool(leaders_of(self.scenario))

    def steady_from(self, given: float | None, recording: Recording | None = None) -> float:
        """Return when the steady state starts, s."""
        return steady_start(given, self.scenario.horizon)


@dataclass(frozen=True)
class Robots(Source):
    """A sub-dataset of MR.CLAM."""

    data: Path | None
    """The folder with the data; None: the environment variable COOPENV_DATA."""
    named: ClassVar[Mapping[str, str]] = ROBOT_VARIANTS
    usual: ClassVar[tuple[str, ...]] = tuple(ROBOT_VARIANTS)
    friendly: ClassVar[str] = (
        "Friendly: robots start at their true pose and are judged from t = 0 on; who is seen is known from barcodes, "
        "their own left out; planar_robust's wheels were fitted to these robots; all hear all, 10 Hz, no loss."
    )
    """What tables of recorded robots are to be read with."""

    @property
    def planar(self) -> bool:
        """Its robots drive on a plane."""
        return True

    def recording(self, variant: str, seed: int) -> Recording:
        """Return the robots' record."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DataWarning)  # `check` has warned
            return open_recording(self.name, self.data, variant)

    def check(self) -> None:
        """Read the data once."""
        open_recording(self.name, self.data)


@dataclass(frozen=True)
class LogFile(Source):
    """A record in a file, as it is and with faults."""

    path: Path

    @property
    def planar(self) -> bool:
        """Whether its vehicles are robots on a plane."""
        return _is_planar(open_recording(self.path))

    def recording(self, variant: str, seed: int) -> Recording:
        """Return the file's record with a fault."""
        recording = open_recording(self.path)
        if recording.scenario is not None and any(faults.any for faults in recording.scenario.all_faults):
            again = record(
                open_backend(self.path, None, {}), seed
            )  # messages are not recorded: the same is drawn again
            recording = replace(recording, interference=again.interference)
        return self.fault(variant).applied(recording, seed)

    def followed(self) -> bool:
        """Return whether a vehicle has another one as its neighbour."""
        return bool(leaders_of(open_recording(self.path)))

    def check(self) -> None:
        """Read the file once."""
        for variant in self.added:
            check_recorded(variant, open_recording(self.path))


@dataclass(frozen=True)
class Bags(Source):
    """A ROS bag, with faults; what its environment draws follows from the seed."""

    path: Path
    topics: Path | None
    overrides: Mapping[str, Any]
    seeded: ClassVar[bool] = True

    def recording(self, variant: str, seed: int) -> Recording:
        """Return the bag as a record, with a fault."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DataWarning)  # `check` has warned
            recording = record(self._backend(), seed)
        for made in self.added:
            check_recorded(made, recording)
        return self.fault(variant).applied(recording, seed)

    def followed(self) -> bool:
        """Return whether a vehicle has another one as its neighbour."""
        return bool(leaders_of(self._backend().scenario))

    def check(self) -> None:
        """Read the bag once."""
        self._backend()

    def _backend(self) -> Backend:
        return open_backend(self.path, None, self.overrides, topics=self.topics)


def _is_planar(recording: Recording) -> bool:
    return all(setup.planar for setup in recording.setups)


ALL = "all"  # asks for every variant that the source can have


def find_source(
    text: str,
    overrides: Mapping[str, Any] | None = None,
    data: Path | None = None,
    topics: Path | None = None,
    faults: Sequence[str] = (),
    policy: str | None = None,
) -> Source:
    """Return the source of an environment's name, a scenario file, a sub-dataset's name, a log file or a ROS bag.

    Args:
        text: which one.
        overrides: dotted keys of its scenario.
        data: folder of recorded data sets.
        topics: what the topics of a ROS bag are.
        faults: variants with parameters, see `coopenv.bench.observers.faults`.
        policy: of the driven vehicles of a simulated environment; None: action zero.

    Raises:
        CoopenvError: there is none of that name, or an option for what is no such source.
    """
    kind, added = kind_of(text), tuple(variant_of(text) for text in dict.fromkeys(faults))
    bag, name = is_bag(text, topics), Path(text).stem
    if kind is SourceKind.ENVIRONMENT and not bag and topics is None and data is None:
        scenario = load_scenario(text, overrides)
        worlds = tuple(with_world(made, text, scenario, overrides or {}) for made in added)
        if policy is not None:
            if not scenario.driven:
                raise CoopenvError(f"--policy {policy}: no vehicle of this environment is driven")
            load_policy(policy, scenario, 0)
        return Simulated(name, scenario, policy or "zero", added=worlds)
    if policy is not None:
        raise CoopenvError(f"--policy {policy}: {text} is recorded, its vehicles cannot be driven")
    if faults and kind is SourceKind.DATASET:
        raise CoopenvError(
            f"--fault {faults[0]}: recorded robots have variants of their own, {', '.join(Robots.named)}"
        )
    if data is not None and kind is not SourceKind.DATASET:
        raise CoopenvError(f"--data {data}: {text} is not one of the recorded robots, mrclam_1 .. mrclam_9")
    if bag:
        return Bags(name, Path(text), topics, dict(overrides or {}), added=added)
    if topics is not None:
        raise CoopenvError(f"--map {topics}: is for ROS bags, {text} is none")
    if overrides:
        raise CoopenvError(f"--set {next(iter(overrides))}: {text} is recorded, it has no scenario to change")
    if kind is SourceKind.DATASET:
        return Robots(text, data)
    if not Path(text).is_file():
        raise CoopenvError(f"no such log file: {text}")
    return LogFile(name, Path(text), added=added)


def variants_of(source: Source, asked: str | None) -> tuple[str, ...]:
    """Return the variants to run: names with commas between, `all` that there can be, or None for the usual ones.

    Raises:
        CoopenvError: there is none of that name, or the source cannot have it.
    """
    added = [variant.name for variant in source.added]
    names = [*source.usual] if asked is None else [name.strip() for name in asked.split(",")]
    if names == [ALL]:
        return tuple(name for name in source.variants if not source.obstacle(name))
    names = list(dict.fromkeys([*names, *added]))
    for name in names:
        if name not in source.variants:
            known = ", ".join((*source.variants, ALL))
            raise CoopenvError(f"unknown variant '{name}'{suggest(name, list(source.variants))}; known: {known}")
        if reason := source.obstacle(name):
            raise CoopenvError(f"variant '{name}': {reason}")
    return tuple(names)
