"""Where the benchmark's records come from: a simulated environment, recorded robots, or a log file.

A source is small and picklable, so that a worker process makes the record itself.
"""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Protocol

from coopenv.bench.observers.faults import FAULTS, NOMINAL, Lie, followers
from coopenv.errors import CoopenvError, DataWarning, suggest
from coopenv.estimation.metrics import STEADY_SHARE, steady_start
from coopenv.observers.recording import Recording
from coopenv.runs.recorder import record
from coopenv.scenario import Scenario, load_scenario
from coopenv.scenario.topology import neighbour_sets

ALL = "all"
"""Asks for every variant that the source can have."""
NOBODY_FOLLOWS = "no vehicle has another one as its neighbour"
LOG_SUFFIX = ".mcap"
ROBOTS = re.compile(r"mrclam_\d+")


class Source(Protocol):
    """Records of one environment in several variants."""

    @property
    def name(self) -> str:
        """As it stands in the rows."""
        ...

    @property
    def variants(self) -> Mapping[str, str]:
        """All there are, each with what it is."""
        ...

    @property
    def usual(self) -> tuple[str, ...]:
        """Those that are run unless others are asked for."""
        ...

    @property
    def seeded(self) -> bool:
        """Whether another seed gives another record."""
        ...

    @property
    def planar(self) -> bool:
        """Whether its vehicles are robots on a plane, which some observers are for and others are not."""
        ...

    def recording(self, variant: str, seed: int) -> tuple[Recording, Lie | None]:
        """Return a record, and the lie that somebody tells on it."""
        ...

    def obstacle(self, variant: str) -> str:
        """Return why it cannot have one of the variants; empty where it can."""
        ...

    def check(self) -> None:
        """Look at recorded data, so that errors and warnings come before the work.

        Raises:
            CoopenvError: they are not there or not well-formed.
        """
        ...

    def steady_from(self, given: float | None, recording: Recording | None = None) -> float:
        """Return when the steady state starts, s; without a record only what is asked for is checked."""
        ...


@dataclass(frozen=True)
class Simulated:
    """A scenario, once per seed, as it is and with faults."""

    name: str
    scenario: Scenario
    variants: ClassVar[Mapping[str, str]] = {name: fault.summary for name, fault in FAULTS.items()}
    usual: ClassVar[tuple[str, ...]] = (NOMINAL,)
    seeded: ClassVar[bool] = True
    planar: ClassVar[bool] = False

    def recording(self, variant: str, seed: int) -> tuple[Recording, Lie | None]:
        """Return the world of a seed with a fault."""
        return FAULTS[variant].applied(record(self.scenario, seed), seed)

    def obstacle(self, variant: str) -> str:
        """Return why no vehicle can lie to another, where that is so."""
        L = len(self.scenario.landmarks)
        followed = any(target >= L for targets in neighbour_sets(self.scenario) for target in targets)
        return NOBODY_FOLLOWS if FAULTS[variant].lies and not followed else ""

    def check(self) -> None:
        """Do nothing: the scenario has been checked."""

    def steady_from(self, given: float | None, recording: Recording | None = None) -> float:
        """Return when the steady state starts, s.

        Raises:
            CoopenvError: what was asked for does not lie within the horizon.
        """
        return steady_start(given, self.scenario.horizon)


@dataclass(frozen=True)
class Robots:
    """A sub-dataset of MR.CLAM. It is judged from the start on, where the robots' poses are known."""

    name: str
    data: Path | None
    """The folder with the data; None: as the environment variable COOPENV_DATA says."""
    variants: ClassVar[Mapping[str, str]] = {
        "landmarks": "no robot sees another",
        "landmarks+robots": "everything that was seen counts",
        "blind": "robots 3 to 5 see no landmark",
    }
    usual: ClassVar[tuple[str, ...]] = tuple(variants)
    seeded: ClassVar[bool] = False
    planar: ClassVar[bool] = True

    def recording(self, variant: str, seed: int) -> tuple[Recording, Lie | None]:
        """Return the robots' record.

        Raises:
            CoopenvError: the data are not there or not well-formed.
        """
        from coopenv.backends.mrclam import load_dataset
        from coopenv.backends.mrclam.recording import recording_of
        from coopenv.backends.mrclam.variants import VARIANTS

        known = next(name for name in VARIANTS if name == variant)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DataWarning)  # `check` has told
            return recording_of(load_dataset(self.name, self.data), known), None

    def obstacle(self, variant: str) -> str:
        """Return nothing: every sub-dataset has all variants."""
        return ""

    def check(self) -> None:
        """Read the data once.

        Raises:
            CoopenvError: the data are not there or not well-formed.
        """
        from coopenv.backends.mrclam import load_dataset

        load_dataset(self.name, self.data)

    def steady_from(self, given: float | None, recording: Recording | None = None) -> float:
        """Return when judging starts, s: as given, or at the start.

        Raises:
            CoopenvError: what was asked for does not lie within the record.
        """
        return 0.0 if given is None else _within(given, recording)


@dataclass(frozen=True)
class LogFile:
    """A record in a file, as it is and with faults."""

    name: str
    path: Path
    variants: ClassVar[Mapping[str, str]] = {name: fault.summary for name, fault in FAULTS.items()}
    usual: ClassVar[tuple[str, ...]] = (NOMINAL,)
    seeded: ClassVar[bool] = False

    @property
    def planar(self) -> bool:
        """Whether its vehicles are robots on a plane.

        Raises:
            CoopenvError: the file is no record.
        """
        return _is_planar(self.recording(NOMINAL, 0)[0])

    def recording(self, variant: str, seed: int) -> tuple[Recording, Lie | None]:
        """Return the file's record with a fault.

        Raises:
            CoopenvError: the file is no such record.
        """
        from coopenv.backends.mcap import read_recording

        return FAULTS[variant].applied(read_recording(self.path), seed)

    def obstacle(self, variant: str) -> str:
        """Return why no vehicle can lie to another, where that is so.

        Raises:
            CoopenvError: the file is no record.
        """
        if not FAULTS[variant].lies:
            return ""
        recording, _ = self.recording(NOMINAL, 0)
        return "" if any(followers(recording, i) for i in recording.order) else NOBODY_FOLLOWS

    def check(self) -> None:
        """Do nothing: `planar` has read the file."""

    def steady_from(self, given: float | None, recording: Recording | None = None) -> float:
        """Return when the steady state starts, s: recorded robots are judged from the start on.

        Raises:
            CoopenvError: what was asked for does not lie within the record.
        """
        if given is not None:
            return _within(given, recording)
        if recording is None or _is_planar(recording):
            return 0.0
        return STEADY_SHARE * float(recording.t[-1])


def _is_planar(recording: Recording) -> bool:
    return all(setup.planar for setup in recording.setups)


def _within(given: float, recording: Recording | None) -> float:
    """Return a start of the steady state that lies within the record, as far as that is known."""
    if not 0.0 <= given < math.inf:
        raise CoopenvError(f"--steady-from {given:g} is not within the run")
    return given if recording is None else steady_start(given, float(recording.t[-1]))


def find_source(text: str, overrides: Mapping[str, Any] | None = None, data: Path | None = None) -> Source:
    """Return the source of an environment's name, a scenario file, a sub-dataset's name or a log file.

    Args:
        text: what the user named.
        overrides: of a scenario, by dotted key.
        data: folder of recorded data.

    Raises:
        CoopenvError: there is none of that name, or an option for what is no such source.
    """
    if data is not None and not ROBOTS.fullmatch(text):
        raise CoopenvError(f"--data {data}: {text} is not one of the recorded robots, mrclam_1 .. mrclam_9")
    if not (ROBOTS.fullmatch(text) or text.endswith(LOG_SUFFIX)):
        return Simulated(Path(text).stem, load_scenario(text, overrides))
    if overrides:
        raise CoopenvError(f"--set {next(iter(overrides))}: {text} is recorded, it has no scenario to change")
    if text.endswith(LOG_SUFFIX):
        if not Path(text).is_file():
            raise CoopenvError(f"no such log file: {text}")
        return LogFile(Path(text).stem, Path(text))
    return Robots(text, data)


def variants_of(source: Source, asked: str | None) -> tuple[str, ...]:
    """Return the variants to run.

    Args:
        source: which has them.
        asked: names with commas between, `all` that there can be, or None for the usual ones.

    Raises:
        CoopenvError: there is none of that name, or the source cannot have it.
    """
    if asked is None:
        return source.usual
    names = tuple(dict.fromkeys(name.strip() for name in asked.split(",")))
    if names == (ALL,):
        return tuple(name for name in source.variants if not source.obstacle(name))
    for name in names:
        if name not in source.variants:
            known = ", ".join((*source.variants, ALL))
            raise CoopenvError(f"unknown variant '{name}'{suggest(name, list(source.variants))}; known: {known}")
        if reason := source.obstacle(name):
            raise CoopenvError(f"variant '{name}': {reason}")
    return names
